"""What a name's ending means."""

import pytest

from stagectl.plant import PLANT_PARAMETERS
from stagectl.signals import MEASUREMENT, SETPOINT
from stagectl.units import unit_of


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("position_m", "m"),
        ("velocity_m_per_s", "m/s"),
        ("acceleration_m_per_s2", "m/s^2"),
        ("jerk_m_per_s3", "m/s^3"),
        ("damping_n_s_per_m", "N s/m"),
        ("stiffness_n_per_m", "N/m"),
        ("force_constant_n_per_a", "N/A"),
        ("back_emf_v_s_per_m", "V s/m"),
        ("drift_n_per_sqrt_s", "N/sqrt(s)"),
        ("angular_frequency_rad_per_s", "rad/s"),
        ("bitrate_bit_per_s", "bit/s"),
        ("scale_counts_per_m", "counts/m"),
        ("stiffness_n_per_m3", "N/m^3"),
        ("drag_n_s2_per_m2", "N s^2/m^2"),
        ("bow_per_m", "1/m"),
        ("leak_per_s", "1/s"),
        ("relative_humidity_percent", "%"),
        ("gamma_ratio", "1"),
        ("samples_count", "1"),
        ("clock_ppm", "1e-6"),
        ("rate_hz", "Hz"),
        ("mass_kg", "kg"),
        ("t_ns", "ns"),
        ("phase_rad", "rad"),
        ("resistance_ohm", "ohm"),
        ("temperature_degc", "degC"),
        ("pressure_pa", "Pa"),
        ("temperature_k", "K"),
        ("t_s", "s"),
        ("level_n", "N"),
        ("current_a", "A"),
        ("supply_v", "V"),
        ("inductance_h", "H"),
        ("error_integral_m_s", "m s"),
        ("impulse_n_s", "N s"),
        ("torque_n_m", "N m"),
        ("field_v_per_m", "V/m"),
        ("density_kg_per_m_s", "kg/(m s)"),
        ("torque_slope_n_m_per_a", "N m/A"),
        ("noise_m_per_sqrt_hz", "m/sqrt(Hz)"),
        ("macro_stiffness_per_s2", "1/s^2"),
        ("counts_per_m", "counts/m"),
    ],
)
def test_ending_states_the_unit(name, unit):
    assert unit_of(name) == unit


@pytest.mark.parametrize(
    "name",
    [
        "position",
        "torque_nm",
        "speed_mm_per_sec",
        "speed_mm_per_s",
        "speed_m_per",
        "drift_n_per_sqrt",
        "m",
        "",
        "level_N",
        "gain",
    ],
)
def test_a_name_without_a_unit_has_none(name):
    assert unit_of(name) is None


def test_values_between_modules_state_their_units():
    plain = {"seed", "draws_noise", "has_micro"}
    names = [n for n in PLANT_PARAMETERS.names if n not in plain] + list(SETPOINT.names)
    names += [n for n in MEASUREMENT.names if MEASUREMENT[n].kind == "f"]
    assert [n for n in names if unit_of(n) is None] == []
