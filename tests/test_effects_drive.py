"""The way of the command: dead band, lag, dead time; the force constant."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stagectl.effects import CATALOGUE
from tests.test_effects import along


def passed(
    name: str, command_a: np.ndarray, dt_s: float, *parameters: float, current_loop_s: float = 0.0
) -> np.ndarray:
    """Return what goes into a drive's current loop for a command, a mean a step."""
    rows = command_a.size
    quantities = {"command_a": command_a, "t_s": dt_s * np.arange(rows), "dt_s": np.full(rows, dt_s)}
    quantities["current_loop_s"] = np.full(rows, current_loop_s)
    return command_a + along(name, parameters, quantities)


def test_dead_time_of_whole_steps_is_a_shift():
    command = np.random.default_rng(1).normal(size=200)
    found = passed("command_delay", command, 1e-3, 3e-3)
    np.testing.assert_allclose(found[3:], command[:-3], rtol=0.0, atol=1e-12)
    assert np.all(found[:3] == 0.0)


def test_dead_time_of_a_part_of_a_step_is_a_mean_of_two():
    command = np.random.default_rng(2).normal(size=200)
    found = passed("command_delay", command, 1e-3, 0.25e-3)
    np.testing.assert_allclose(found[1:], 0.75 * command[1:] + 0.25 * command[:-1], rtol=0.0, atol=1e-11)


@given(st.floats(1e-4, 5e-3), st.integers(0, 2**31))
def test_dead_time_loses_no_area(delay_s, seed):
    """Whatever happens while commands come faster than eight in a delay, in the end the last one holds."""
    rng = np.random.default_rng(seed)
    command = np.concatenate([rng.normal(size=100), np.full(150, 0.7)])
    found = passed("command_delay", command, 50e-6, delay_s)
    assert np.all(np.isfinite(found))
    assert np.max(np.abs(found)) <= np.max(np.abs(command)) * (1.0 + 1e-12)
    assert found[-1] == pytest.approx(0.7, rel=1e-9)


def test_lag_follows_a_step_with_its_time_constant():
    found = passed("current_loop_lag", np.ones(4000), 1e-6, 1e-3)
    assert found[999] == pytest.approx(1.0 - math.exp(-0.9995), rel=1e-6)  # the mean over the thousandth microsecond


@pytest.mark.parametrize("current_loop_s", [0.0, 1e-3])
def test_a_ramp_comes_as_much_later_as_the_time_constant(current_loop_s):
    """Into the loop; what that adds itself comes on top."""
    ramp = 1e-3 * np.arange(20000)
    found = passed("current_loop_lag", ramp, 50e-6, 2e-3, current_loop_s=current_loop_s)
    # 40 steps, less half a step: the command is held over each
    assert ramp[-1] - found[-1] == pytest.approx(40e-3, rel=0.02)


def test_a_dead_band_passes_what_is_beyond_it():
    command = np.array([-0.5, -0.02, -0.01, 0.0, 0.01, 0.02, 0.5])
    found = command + CATALOGUE["amplifier_dead_band"].law(command, 0.02)
    np.testing.assert_allclose(found, [-0.48, 0.0, 0.0, 0.0, 0.0, 0.0, 0.48], atol=1e-16)


def test_saturation_never_turns_a_force_around():
    force = np.linspace(-2000.0, 2000.0, 4001)
    whole = force + CATALOGUE["force_constant_saturation"].law(force, 800.0)
    assert np.all(np.diff(whole) >= 0.0)
    assert np.all(np.diff(whole[np.abs(force) < 800.0]) > 0.0)
    assert np.max(np.abs(whole)) == pytest.approx(2.0 / 3.0 * 800.0)
    small = CATALOGUE["force_constant_saturation"].law(40.0, 800.0)
    assert small == pytest.approx(-(40.0**3) / (3.0 * 800.0**2), rel=2e-3)
