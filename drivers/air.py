"""Refractive index of moist air after Ciddor (Applied Optics 35, 1566, 1996).

Constants and steps as in the NIST Engineering Metrology Toolbox (Stone and Zimmerman), emtoolbox.nist.gov/wavelength.
Never extrapolates. Pure.
"""

import math

from stagectl.errors import RequestError

_RANGES = {
    "wavelength_vacuum_m": (300e-9, 1700e-9),
    "temperature_degc": (-40.0, 100.0),
    "pressure_pa": (10_000.0, 140_000.0),
    "relative_humidity_percent": (0.0, 100.0),
    "co2_ppm": (0.0, 2000.0),
}
_GAS_CONSTANT = 8.314472
_WATER_KG_PER_MOL = 0.018015


def _saturation_pressure_pa(temperature_degc: float) -> float:
    """Vapour pressure over water (IAPWS), below 0 degC over ice."""
    kelvin = temperature_degc + 273.15
    if temperature_degc < 0.0:
        theta = kelvin / 273.16
        return 611.657 * math.exp(-13.928169 * (1.0 - theta**-1.5) + 34.7078238 * (1.0 - theta**-1.25))
    omega = kelvin - 2.38555575678e-01 / (kelvin - 6.50175348448e02)
    a = omega * omega + 1.16705214528e03 * omega - 7.24213167032e05
    b = -1.70738469401e01 * omega * omega + 1.20208247025e04 * omega - 3.23255503223e06
    c = 1.49151086135e01 * omega * omega - 4.82326573616e03 * omega + 4.05113405421e05
    x = -b + math.sqrt(b * b - 4.0 * a * c)
    return 1e6 * (2.0 * c / x) ** 4


def _compressibility(kelvin: float, temperature_degc: float, pressure_pa: float, water: float) -> float:
    """Z of moist air; `water` is the mole fraction of water vapour."""
    t = temperature_degc
    ratio = pressure_pa / kelvin
    first = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t * t
    first += (5.707e-6 - 2.051e-8 * t) * water + (1.9898e-4 - 2.376e-6 * t) * water * water
    return 1.0 - ratio * first + ratio * ratio * (1.83e-11 - 0.765e-8 * water * water)


def ciddor_index(
    wavelength_vacuum_m: float,
    temperature_degc: float,
    pressure_pa: float,
    relative_humidity_percent: float,
    co2_ppm: float,
) -> float:
    """Phase refractive index of air, a few 1e-8 in truth, to 1e-10 as printed; RequestError outside its range."""
    given = {
        "wavelength_vacuum_m": wavelength_vacuum_m,
        "temperature_degc": temperature_degc,
        "pressure_pa": pressure_pa,
        "relative_humidity_percent": relative_humidity_percent,
        "co2_ppm": co2_ppm,
    }
    for name, value in given.items():
        low, high = _RANGES[name]
        if not low <= value <= high:
            raise RequestError(
                f"air.{name} = {value} is outside {low:g} .. {high:g}, where Ciddor's equation holds; "
                "check the sensor or the profile"
            )
    kelvin = temperature_degc + 273.15
    s = 1e-12 / (wavelength_vacuum_m * wavelength_vacuum_m)  # (1/um)^2
    dry = 1e-8 * (5792105.0 / (238.0185 - s) + 167917.0 / (57.362 - s)) * (1.0 + 5.34e-7 * (co2_ppm - 450.0))
    vapour = 1.022e-8 * (295.235 + 2.6422 * s - 0.03238 * s * s + 0.004028 * s * s * s)
    enhancement = 1.00062 + 3.14e-8 * pressure_pa + 5.60e-7 * temperature_degc * temperature_degc
    water = enhancement * relative_humidity_percent / 100.0 * _saturation_pressure_pa(temperature_degc) / pressure_pa
    if not water <= 1.0:
        raise RequestError(
            f"air: {relative_humidity_percent} % at {temperature_degc} degC would be more vapour than the pressure of "
            f"{pressure_pa} Pa holds; check the sensors"
        )
    air_kg_per_mol = 0.0289635 + 1.2011e-8 * (co2_ppm - 400.0)
    z = _compressibility(kelvin, temperature_degc, pressure_pa, water)
    density = pressure_pa / (z * _GAS_CONSTANT * kelvin)  # mol/m^3
    density_dry_reference = 101325.0 * air_kg_per_mol / (0.9995922115 * _GAS_CONSTANT * 288.15)
    dry_part = (1.0 - water) * density * air_kg_per_mol / density_dry_reference
    vapour_part = water * density * _WATER_KG_PER_MOL / 0.00985938
    return 1.0 + dry_part * dry + vapour_part * vapour


def ramped_index(previous: float, target: float, position_m: float, limit_m: float = 1e-10) -> float:
    """The index to use in the next cycle: towards `target`, moving no position up to |position_m| by more than limit_m.

    Position is proportional to 1/n, so a change dn moves it by position dn / n. What is not finite changes nothing.
    """
    if not (math.isfinite(target) and math.isfinite(position_m)):
        return previous
    change = target - previous
    if abs(change) * abs(position_m) <= limit_m * previous:
        return target
    return previous + math.copysign(limit_m * previous / abs(position_m), change)
