"""What a profile knows of its machine's effects, laws and observer undo: the same machine, known and unknown."""

import numpy as np
import pytest

from stagectl import compose, estimator, trajectory
from tests.effect_numbers import table
from tests.stage import centre_m, exact, followed, rms, true_error_m, with_values

MOVE = trajectory.trapezoid(0.05, 0.1, dwell_s=0.3, lead_s=0.2).setpoints

FORCES = [
    table("lugre_friction", "micro_force", level_n=0.5),
    table("cable_hysteresis", "micro_force", level_n=1.0),
    table("dahl_friction", "macro_force"),
    table("flexible_mode", "macro_force"),
    table("current_ripple", "micro_actuator", ripple_ratio=0.05),
    table("base_vibration", "micro_force", amplitude_m_per_s2=0.005),
    table("cubic_stiffness", "joint", stiffness_n_per_m3=1e13),
]
COMMANDS = [
    table("amplifier_dead_band", "micro_command"),
    table("command_delay", "micro_command", delay_s=0.5e-3),
    table("current_loop_lag", "macro_command"),
    table("amplifier_dead_band", "macro_command"),
]
SENSORS = [
    table("sensor_delay", "end_sensor"),
    table("sensor_lag", "end_sensor"),
    table("sensor_lag", "macro_sensor"),
    table("cyclic_error", "end_sensor", first_m=50e-9),
    table("scale_error", "end_sensor", error_ppm=50.0),
    table("clock_skew", "end_sensor"),
]


@pytest.fixture(scope="module")
def plain_machine(oled_profile, oled_machine):
    """What the profile believes, but for noise of the sensor and the size of a substep."""
    joint = {f"backlash__{name}": getattr(oled_profile.backlash, name) for name in ("left_m", "right_m")}
    quiet = {"macro__force_noise_n": 0.0, "micro__force_noise_n": 0.0, "interferometer__clock_ppm": 0.0}
    return with_values(exact(oled_machine, oled_profile), effects=oled_profile.effects, **joint, **quiet)


def errors_m(profile, machine, law: str, extra: list[dict], known: bool) -> tuple[float, float]:
    """Return (end, macro) true error rms over a move of a machine with these effects."""
    machine = with_values(machine, effects=(*machine.effects, *extra))
    believed = with_values(profile, effects=(*profile.effects, *extra)) if known else profile
    recording = followed(believed, machine, law, MOVE)
    assert recording.commands["stop"][-1] == 0
    x_b = recording.truth["macro_position_m"] - recording.truth["end_position_m"]
    return rms(true_error_m(recording)), rms(x_b - centre_m(profile))


@pytest.mark.parametrize(
    ("extra", "law", "unknown_nm", "known_nm"),
    [
        (FORCES, "dsmc", 73.0, 2.7),
        (FORCES, "pid", 390.0, 12.2),
        (COMMANDS, "dsmc", 238.0, 13.9),
        (SENSORS, "dsmc", 51_800.0, 3.6),  # what delay and lag leave of the sensor's noise and of its own rounding
    ],
    ids=["forces-dsmc", "forces-pid", "commands-dsmc", "sensors-dsmc"],
)
def test_a_known_effect_costs_little(oled_profile, plain_machine, extra, law, unknown_nm, known_nm):
    """Without any of them the end errs by 2.8 nm (DSMC) and 3.4 nm (PID), the macro by 8 and 11 nm."""
    unknown_m, unknown_macro_m = errors_m(oled_profile, plain_machine, law, extra, known=False)
    known_m, known_macro_m = errors_m(oled_profile, plain_machine, law, extra, known=True)
    assert unknown_m == pytest.approx(1e-9 * unknown_nm, rel=0.25)
    assert known_m == pytest.approx(1e-9 * known_nm, rel=0.25)
    assert known_macro_m < 0.4e-6
    assert known_macro_m < 0.5 * unknown_macro_m


def test_the_lag_of_the_command_is_what_a_step_loses(oled_profile):
    """0.5 ms of dead time and 0.4 ms of lag; a dead band delays nothing."""
    tables = [*COMMANDS, table("current_loop_lag", "micro_command", time_constant_s=0.3e-3)]
    assert compose.command_lag_s(tables, "micro_command") == pytest.approx(0.8e-3, rel=1e-9)
    assert compose.command_lag_s(tables, "macro_command") == pytest.approx(0.4e-3, rel=1e-9)
    assert compose.command_lag_s(oled_profile.effects, "micro_command") == 0.0
    e = estimator.init(with_values(oled_profile, effects=tables))
    assert e["lead_s"][0] == pytest.approx(0.8e-3, rel=1e-9)
    assert e["macro_lead_s"][0] == pytest.approx(-0.4e-3, rel=1e-9)
    assert np.all([estimator.init(oled_profile)[name] == 0.0 for name in ("lead_s", "macro_lead_s")])
