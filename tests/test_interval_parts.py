"""What forces on parts of sample intervals move, against closed forms."""

import numpy as np
import pytest

from stagectl.effects import CATALOGUE
from stagectl.gap.command_path import behind, changed_by, driven, driven_later
from stagectl.gap.innovations import filter_steps, gains, innovations
from stagectl.gap.interval_parts import PARTS_COUNT, moments, with_early

PERIOD_S = 1e-3
COMMAND = np.cumsum(np.random.default_rng(5).standard_normal(200))
DRIVES = [(0.57e-3, 0.15e-3), (0.57e-3, 0.0), (0.0, 0.0), (0.5e-3, 0.02e-3), (1.2e-3, 0.3e-3), (-0.4e-3, 0.1e-3)]
FINE = 4000
"""Steps of an interval in a plain integral, on whose borders all of these latches lie."""


@pytest.mark.parametrize("power", [0, 1, 2])
def test_what_goes_on_a_parabola_moves_as_far_as_its_integral_says(power):
    """The mean of s^p is 1 / (p + 1); 2 (1 - s) s^p has the integral 2 / ((p + 1) (p + 2))."""
    edges = np.arange(PARTS_COUNT + 1) / PARTS_COUNT
    parts = PARTS_COUNT * np.diff(edges ** (power + 1)) / (power + 1)
    mean, early = moments(parts[None, :])
    assert mean[0] == pytest.approx(1.0 / (power + 1), rel=1e-12)
    assert early[0] == pytest.approx(2.0 / ((power + 1) * (power + 2)), rel=1e-12)


def test_tilted_parts_have_the_moment_they_are_told_and_their_mean():
    parts = np.random.default_rng(1).standard_normal((50, PARTS_COUNT))
    wanted = np.random.default_rng(2).standard_normal(50)
    mean, early = moments(with_early(parts, wanted))
    assert mean == pytest.approx(moments(parts)[0], abs=1e-12)
    assert early == pytest.approx(wanted, abs=1e-12)


def _plainly(latch_s, lag_s):
    """Return means over the steps of a fine grid, (n * FINE,), of what a drive makes of the commands, step by step."""
    t = (np.arange(COMMAND.size * FINE) + 0.5) / FINE
    acting = COMMAND[np.clip(np.floor(t - latch_s / PERIOD_S).astype(int), 0, COMMAND.size - 1)]
    if lag_s == 0.0:
        return acting
    decay = np.exp(-PERIOD_S / FINE / lag_s)
    out = np.empty(acting.size)
    value = acting[0]
    for k in range(acting.size):
        after = acting[k] + (value - acting[k]) * decay
        out[k] = acting[k] + (value - acting[k]) * (1.0 - decay) / -np.log(decay)
        value = after
    return out


def _moments_of(fine):
    rows = fine.reshape(-1, FINE)
    return rows.mean(axis=1), rows @ (2.0 * (1.0 - (np.arange(FINE) + 0.5) / FINE)) / FINE


def _agree(parts, wanted, within):
    inner = slice(10, -10)
    for found, true in zip(moments(parts), wanted, strict=True):
        assert np.abs(found[inner] - true[inner]).max() < within


@pytest.mark.parametrize(("latch_s", "lag_s"), DRIVES)
def test_a_drive_moves_its_mass_as_far_as_its_force_says(latch_s, lag_s):
    """Held over parts it was 0.03 N off where a step of up to 2.7 N lies within one."""
    _agree(driven(COMMAND, latch_s, lag_s, PERIOD_S)[0], _moments_of(_plainly(latch_s, lag_s)), 2e-6)


@pytest.mark.parametrize(("latch_s", "lag_s"), DRIVES)
@pytest.mark.parametrize(("late_s", "rate"), [(0.3e-3, 1e-4), (0.0, 2e-3), (-0.2e-3, -1e-3)])
def test_so_does_one_that_is_late_by_a_time_that_grows(latch_s, lag_s, late_s, rate):
    edges_s = PERIOD_S * np.arange(COMMAND.size * PARTS_COUNT + 1) / PARTS_COUNT
    at = (np.arange(COMMAND.size * FINE) + 0.5) / FINE * (1.0 - rate) - late_s / PERIOD_S
    plain = _plainly(latch_s, lag_s)
    later = plain[np.clip((at * FINE).astype(int), 0, plain.size - 1)]
    _agree(driven_later(COMMAND, latch_s, lag_s, PERIOD_S, late_s + rate * edges_s), _moments_of(later), 4e-3)


@pytest.mark.parametrize(("latch_s", "lag_s"), DRIVES)
@pytest.mark.parametrize("delay_s", [0.25e-3, 102e-6, 2.3e-3])
def test_so_does_an_effect_with_a_memory(latch_s, lag_s, delay_s):
    more = _plainly(latch_s + delay_s, lag_s) - _plainly(latch_s, lag_s)
    found = changed_by(CATALOGUE["command_delay"], [delay_s], COMMAND, latch_s, lag_s, PERIOD_S)[0]
    _agree(found, _moments_of(more), 4e-3)


def test_a_lag_behind_a_drive_moves_as_far_as_one_lag_that_is_as_long():
    found = behind(0.2e-3, COMMAND, 0.57e-3, 0.0, PERIOD_S)[0]
    more = _plainly(0.57e-3, 0.2e-3) - _plainly(0.57e-3, 0.0)
    _agree(found, _moments_of(more), 4e-3)


def test_a_mass_that_a_sine_moves_leaves_nothing():
    """40 kg at 13 Hz under 100 N, 0.4 mm: held over parts, its force left innovations of a reading of 1 nm 13 high."""
    mass_kg, turn, n = 40.0, 2.0 * np.pi * 13.0, 4000
    position_m = -100.0 / (mass_kg * turn**2) * np.sin(turn * PERIOD_S * np.arange(n))
    edges_s = PERIOD_S * np.arange(n * PARTS_COUNT + 1) / PARTS_COUNT
    force_n = -100.0 * np.diff(np.cos(turn * edges_s)) / turn * PARTS_COUNT / PERIOD_S
    every = np.ones(n, bool)
    gain, variance = gains(every, ~every, mass_kg, PERIOD_S, 1e-9, 1e-4, 12.0, 0.0, 1e3)
    steps = filter_steps(gain, variance, mass_kg, PERIOD_S, 12.0)
    left = innovations(position_m, force_n.reshape(n, -1), 1.0, steps, every, mass_kg, PERIOD_S, 12.0, 0.0)
    assert np.abs(left[500:]).max() < 0.02
