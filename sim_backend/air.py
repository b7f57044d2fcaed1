"""The air that the rig's laser beams run through: phase index after Ciddor (Applied Optics 35, 1566, 1996).

Written a second time on purpose: an index that rig and drivers shared could be wrong without anybody seeing it.
Pure.
"""

import math

_GAS_J_PER_MOL_K = 8.314472


def _saturation_pressure_pa(kelvin: float) -> float:
    """Vapour pressure over water, Davis 1992 as in Ciddor's appendix A."""
    exponent = 1.2378847e-5 * kelvin * kelvin - 1.9121316e-2 * kelvin + 33.93711047 - 6.3431645e3 / kelvin
    return math.exp(exponent)


def _density_mol_per_m3(kelvin: float, pressure_pa: float, water_ratio: float) -> float:
    """n/V of moist air with the compressibility of the BIPM equation."""
    t = kelvin - 273.15
    linear = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t * t
    linear += (5.707e-6 - 2.051e-8 * t) * water_ratio + (1.9898e-4 - 2.376e-6 * t) * water_ratio * water_ratio
    quotient = pressure_pa / kelvin
    compressibility = 1.0 - quotient * linear + quotient * quotient * (1.83e-11 - 0.765e-8 * water_ratio * water_ratio)
    return pressure_pa / (compressibility * _GAS_J_PER_MOL_K * kelvin)


def index_of(air) -> float:
    """Return n of a machine's [air] table (wavelength_vacuum_m, temperature_degc, pressure_pa, ...)."""
    kelvin = air.temperature_degc + 273.15
    wave_number_2 = 1.0 / (1e6 * air.wavelength_vacuum_m) ** 2  # 1/um^2
    dry_refractivity = 5792105.0 / (238.0185 - wave_number_2) + 167917.0 / (57.362 - wave_number_2)
    dry_refractivity *= 1e-8 * (1.0 + 0.534e-6 * (air.co2_ppm - 450.0))
    polynomial = 295.235 + 2.6422 * wave_number_2 - 0.032380 * wave_number_2**2 + 0.004028 * wave_number_2**3
    vapour_refractivity = 1.022e-8 * polynomial
    enhancement = 1.00062 + 3.14e-8 * air.pressure_pa + 5.6e-7 * air.temperature_degc**2
    water_ratio = 0.01 * air.relative_humidity_percent * enhancement * _saturation_pressure_pa(kelvin) / air.pressure_pa
    density = _density_mol_per_m3(kelvin, air.pressure_pa, water_ratio)
    dry_standard = _density_mol_per_m3(288.15, 101325.0, 0.0)  # 15 degC, dry
    vapour_standard = _density_mol_per_m3(293.15, 1333.0, 1.0)  # 20 degC, pure vapour
    dry = (1.0 - water_ratio) * density / dry_standard * dry_refractivity
    return 1.0 + dry + water_ratio * density / vapour_standard * vapour_refractivity
