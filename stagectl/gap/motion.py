"""The motion that was measured, smoothed without delay, at the middles of equal parts of every sample interval.

Force laws are evaluated on it. Smoothing must not invent physics: a law with a step at reversal is taken on parts of
an interval, and reversals and standstill themselves are left to the simulation (`slow`). Pure.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter, savgol_filter

PARTS_COUNT = 4
"""Parts of a sample interval: friction on whole milliseconds left 57 times its noise, on quarters 8 (prototype)."""

_WINDOW = 21
_ORDER = 3
_SLOW_SHARE = 0.02
"""Of the peak speed: below it the sign of a velocity is not trusted in the ranking stage."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Position, velocity, acceleration of one body on parts of intervals, shape (n, PARTS_COUNT); `slow` shape (n,)."""

    position_m: np.ndarray
    velocity_m_per_s: np.ndarray
    acceleration_m_per_s2: np.ndarray
    slow: np.ndarray


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
    noise_m_per_s = 3.0 * sensor_m / (period_s * _WINDOW**1.5) * 3.5
    limit = max(_SLOW_SHARE * float(np.max(np.abs(v))), 3.0 * noise_m_per_s)
    slow = np.min(np.abs(velocity), axis=1) < limit
    wide = np.convolve(slow, np.ones(5), "same") > 0.0
    return Motion(position, velocity, acceleration, wide)


def delayed(command: np.ndarray, latch_ratio: float) -> np.ndarray:
    """Return a held command on parts of intervals, (n, parts): it takes over `latch_ratio` periods after its sample.

    Before the first command acts the first is taken.
    """
    whole = int(np.floor(latch_ratio))
    rest = latch_ratio - whole
    edges = np.arange(PARTS_COUNT + 1) / PARTS_COUNT
    late = np.clip((rest - edges[:-1]) * PARTS_COUNT, 0.0, 1.0)  # share of a part in which the earlier still acts
    index = np.arange(command.size) - whole
    now, before = command[np.clip(index, 0, command.size - 1)], command[np.clip(index - 1, 0, command.size - 1)]
    return before[:, None] * late[None, :] + now[:, None] * (1.0 - late)[None, :]


def lagged(fine: np.ndarray, lag_s: float, period_s: float) -> np.ndarray:
    """Pass held forces on parts through a first-order lag (the current loop), shape kept."""
    if lag_s <= 0.0:
        return fine
    flat = fine.ravel()
    dt_s = period_s / fine.shape[1]
    decay = float(np.exp(-dt_s / lag_s))
    mean_share = (1.0 - decay) * lag_s / dt_s
    ends = lfilter([1.0 - decay], [1.0, -decay], flat, zi=[decay * flat[0]])[0]
    starts = np.concatenate([[flat[0]], ends[:-1]])
    return (flat + (starts - flat) * mean_share).reshape(fine.shape)
