"""The motion that was measured, smoothed without delay, at the middles of equal parts of every sample interval.

Force laws are evaluated on it. Smoothing must not invent physics: a law with a step at reversal is taken on parts of
an interval, and reversals and standstill themselves are left to the simulation (`slow`). Pure.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter, savgol_coeffs, savgol_filter

from stagectl.gap.innovations import moments, smoothed

PARTS_COUNT = 4
"""Parts of a sample interval: friction on whole milliseconds left 57 times its noise, on quarters 8 (prototype)."""

_WINDOW = 21
_ORDER = 3
_SLOW_SDS = 6.0
"""Below so many standard deviations the sign of a velocity is not trusted in the ranking stage."""

_REST_SAMPLES = 10
_REST_REACH = 12
"""A stage that sticks leaves with a kink, which smoothing spreads over half its window."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Position, velocity, acceleration of one body on parts of intervals, shape (n, PARTS_COUNT); `slow` shape (n,)."""

    position_m: np.ndarray
    velocity_m_per_s: np.ndarray
    acceleration_m_per_s2: np.ndarray
    slow: np.ndarray
    measured_m_per_s2: np.ndarray  # acceleration by the positions alone, shape (n,)


def motion_of(position_m: np.ndarray, period_s: float, sensor_m: float) -> Motion:
    """Smooth positions (cubic over 21 samples) and put them on parts of intervals."""
    x = np.asarray(savgol_filter(position_m, 7, _ORDER))
    v = np.asarray(savgol_filter(position_m, _WINDOW, _ORDER, deriv=1, delta=period_s))
    a = np.asarray(savgol_filter(position_m, _WINDOW + 10, _ORDER, deriv=2, delta=period_s))
    share = (np.arange(PARTS_COUNT) + 0.5) / PARTS_COUNT
    following = np.minimum(np.arange(x.size) + 1, x.size - 1)

    def between(values: np.ndarray) -> np.ndarray:
        return values[:, None] + share[None, :] * (values[following] - values)[:, None]

    bow = -0.5 * (period_s**2) * (share * (1.0 - share))[None, :]
    acceleration = between(a)
    position = between(x) + bow * acceleration
    velocity = between(v)
    weights = savgol_coeffs(_WINDOW, _ORDER, deriv=1, delta=period_s)
    sd_m_per_s = sensor_m * float(np.linalg.norm(weights))
    slow = np.min(np.abs(velocity), axis=1) < _SLOW_SDS * sd_m_per_s
    rests = np.convolve(slow, np.ones(_REST_SAMPLES), "same") >= _REST_SAMPLES
    wide = (np.convolve(slow, np.ones(3), "same") > 0.5) | (
        np.convolve(rests, np.ones(2 * _REST_REACH + 1), "same") > 0.5
    )
    return Motion(position, velocity, acceleration, wide, a)


_SMOOTHING_RAD_PER_S = 2.0 * np.pi * 20.0
_LEAST_FORCE_N = 0.05


def motion_under(
    rough: Motion, position_m: np.ndarray, valid: np.ndarray, force_n: np.ndarray, mass_kg: float,
    period_s: float, sensor_m: float,
) -> Motion:  # fmt: skip
    """Smooth positions once more, knowing the forces that are believed to act, shape (n, parts).

    A polynomial through the positions alone keeps so much of their noise that delays and lags of a sensor, which are
    made of the velocity, fitted noise (a gain of 149 on clean data); what commands do to the motion needs no smoothing.
    How far the believed forces can be trusted is read off the rough motion.
    """
    apart_n = mass_kg * rough.measured_m_per_s2 - force_n.mean(axis=1)
    spread_n = max(float(np.sqrt(np.mean(apart_n[valid] ** 2))), _LEAST_FORCE_N)
    mean_n, early_n = moments(force_n)
    x, v, slow_n = smoothed(
        position_m, valid, mean_n, early_n, mass_kg, period_s, sensor_m, spread_n, _SMOOTHING_RAD_PER_S
    )
    parts = force_n.shape[1]
    step_s = period_s / parts
    acceleration = (force_n + slow_n[:, None]) / mass_kg
    share = (np.arange(parts) + 0.5) / parts
    gained = step_s * (np.cumsum(acceleration, axis=1) - 0.5 * acceleration)
    following = np.minimum(np.arange(x.size) + 1, x.size - 1)
    missed = v[following] - v - step_s * acceleration.sum(axis=1)  # at the next sample, by what is not a force so far
    missed[-1] = 0.0
    velocity = v[:, None] + gained + missed[:, None] * share[None, :]
    way = step_s * (np.cumsum(velocity, axis=1) - 0.5 * velocity)
    lost = x[following] - x - step_s * velocity.sum(axis=1)
    lost[-1] = 0.0
    position = x[:, None] + way + lost[:, None] * share[None, :]
    return Motion(position, velocity, acceleration, rough.slow, rough.measured_m_per_s2)


def delayed(command: np.ndarray, latch_ratio: float, parts: int = PARTS_COUNT) -> np.ndarray:
    """Return a held command on parts of intervals, (n, parts): it takes over `latch_ratio` periods after its sample.

    Before the first command acts the first is taken.
    """
    now, before, rest = _held(command, latch_ratio)
    edges = np.arange(parts + 1) / parts
    late = np.clip((rest - edges[:-1]) * parts, 0.0, 1.0)  # share of a part in which the earlier still acts
    return before[:, None] * late[None, :] + now[:, None] * (1.0 - late)[None, :]


def _held(command: np.ndarray, latch_ratio: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return, by interval, the command that takes over, the one before, and when, as a share of the interval."""
    whole = int(np.floor(latch_ratio))
    index = np.arange(command.size) - whole
    last = command.size - 1
    return command[np.clip(index, 0, last)], command[np.clip(index - 1, 0, last)], latch_ratio - whole


def driven(command: np.ndarray, latch_s: float, lag_s: float, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what a drive makes of held commands: means over parts of intervals (n, parts), values at samples (n,).

    A command takes over `latch_s` after its sample and passes a first-order lag, exactly: with commands averaged over
    parts the current was off by a fiftieth of each step at the next sample, which looks like 40 us of delay.
    """
    now, before, rest = _held(command, latch_s / period_s)
    if not lag_s > 0.0:
        held = delayed(command, latch_s / period_s)
        return held, np.where(rest > 0.0, before, now)
    latch, whole = np.exp(-rest * period_s / lag_s), np.exp(-period_s / lag_s)
    after = np.exp(-(1.0 - rest) * period_s / lag_s)
    gained = now * (1.0 - after) + before * (after - whole)
    ends = np.asarray(lfilter([1.0], [1.0, -whole], gained, zi=[whole * command[0]])[0])
    starts = np.concatenate([command[:1], ends[:-1]])
    at_latch = before + (starts - before) * latch
    edges = np.arange(PARTS_COUNT + 1) / PARTS_COUNT
    means = np.empty((command.size, PARTS_COUNT))
    for part in range(PARTS_COUNT):
        low, high = edges[part], edges[part + 1]
        turn = min(max(rest, low), high)
        means[:, part] = _area(starts, before, low, turn, 0.0, lag_s / period_s)
        means[:, part] += _area(at_latch, now, turn, high, rest, lag_s / period_s)
    return means * PARTS_COUNT, starts


def _area(start: np.ndarray, goal: np.ndarray, low: float, high: float, origin: float, lag: float) -> np.ndarray:
    """Integrate goal + (start - goal) exp(-(s - origin) / lag) from low to high."""
    if not high > low:
        return np.zeros_like(goal)
    fading = lag * (np.exp(-(low - origin) / lag) - np.exp(-(high - origin) / lag))
    return goal * (high - low) + (start - goal) * fading


def lagged(fine: np.ndarray, lag_s: float, period_s: float) -> np.ndarray:
    """Pass held forces on parts through a first-order lag (the current loop), shape kept."""
    if lag_s <= 0.0:
        return fine
    dt_s = period_s / fine.shape[1]
    mean_share = -float(np.expm1(-dt_s / lag_s)) * lag_s / dt_s
    starts = _starts(fine, lag_s, dt_s)
    return fine + (starts - fine) * mean_share


def lagged_at_samples(fine: np.ndarray, lag_s: float, period_s: float) -> np.ndarray:
    """Return what a first-order lag makes of held values at the sample instants, shape (n,)."""
    return _starts(fine, lag_s, period_s / fine.shape[1])[:, 0]


def _starts(fine: np.ndarray, lag_s: float, dt_s: float) -> np.ndarray:
    """Return the lag's output at the beginning of each part."""
    flat = fine.ravel()
    decay = float(np.exp(-dt_s / lag_s)) if lag_s > 0.0 else 0.0
    ends = lfilter([1.0 - decay], [1.0, -decay], flat, zi=[decay * flat[0]])[0]
    return np.concatenate([[flat[0]], ends[:-1]]).reshape(fine.shape)
