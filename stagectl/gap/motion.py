"""The motion that laws are evaluated along, at the middles of equal parts of every sample interval.

First a rough one, smoothed without delay; then the one that the past foretells. Neither may invent physics: a law with
a step at reversal is taken on parts of an interval, and reversals and standstill are left to the simulation (`slow`).
Pure.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from stagectl.compiled import compiled
from stagectl.gap.innovations import certainty, filtered
from stagectl.gap.interval_parts import PARTS_COUNT, moments

_WINDOW = 21
_ORDER = 3
_SLOW_SDS = 6.0
"""Below so many standard deviations the sign of a smoothed velocity is not trusted."""

_UNSURE_SDS = 1.4
"""The same of what the filter knows of it: at 1.0 a Stribeck friction of 5 N drew a second name, at 2.0 a stage that is
held still said nothing of what pushes it."""

_QUIET_WINDOW = 11
"""Samples that a velocity is smoothed over where the stage sticks. Over 21 to 81 a break-away is smeared and what
a drive shakes the bristles by is lost: forces of 7 N were 0.12 to 0.16 N off in place of 0.06. By the filter's own
velocity they were 1.3 N off."""

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
    at_samples: np.ndarray  # position, velocity, acceleration foretold for the samples themselves, shape (n, 3)
    known_m: np.ndarray  # position with the samples, shape (n,)
    sds_m: np.ndarray  # how well it is known before the samples and with them, shape (n, 2)
    carried_m_per_s: np.ndarray  # of samples on both sides, beyond their noise, shape (n,)
    put_right_m_per_s: np.ndarray  # by each sample, over the interval that it begins, shape (n,)

    @property
    def quiet_m_per_s(self) -> np.ndarray:
        """Velocity for what adds it up, shape (n, PARTS_COUNT): it leads where the body is, and no farther.

        Foretold velocities alone lead away from there by what every sample puts right: bristles of 1 to 4 um, with
        their law and the machine known exactly, left 73 900, 49 800, 23 000 and 3700 squares (1010219, 1010003,
        1007004, 1009010) in place of 400, 140, 1300 and 160. Where the stage is slow, its amount counts, too.
        """
        along_m_per_s = self.velocity_m_per_s + self.put_right_m_per_s[:, None]
        return np.where(self.slow[:, None], self.carried_m_per_s[:, None], along_m_per_s)


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
    sds_m = np.full((x.size, 2), sensor_m)
    carried_m_per_s = way_per_s(position_m, _QUIET_STOPS_RATIO * sensor_m, period_s)
    at_samples = np.column_stack([x, v, a])
    return Motion(position, velocity, acceleration, wide, at_samples, x, sds_m, carried_m_per_s, np.zeros(x.size))


_QUIET_STOPS_RATIO = 0.25
"""Of a reading's noise, half the play that a stage is carried with where it sticks. With 0.5 bristles that slip over 2
and 10 um left 82 000 and 4200 squares in place of 31 400 and none; 0.15 is worse again."""


def way_per_s(read_m: np.ndarray, stops_m: float, period_s: float) -> np.ndarray:
    """Return how fast a reading goes beyond what it scatters by, for what adds up its amount, shape (n,).

    It carries what lies between two stops (play), `stops_m` to either side. By a smoothed velocity 10 nm of noise went
    2 um in a second, in place of 0.9, by which bristles let go of a stage that stands: of 20 sets with such frictions
    (1003002 to 3428) eleven left less, from 128 000 squares to 60 000 and from 335 to 111, and none 15 more.

    Where a contact was pressed by 40 um, or pressed and let go by 50 um, readings of 20 nm made errors of 24 and 27 %
    in what turns over 6 um by the filter's velocity, of 4 and 10 % by smoothed ones, and of 0.2 and 0.6 % by this. With
    stops as far apart again reversals come late: a loss came out 2.4 % too small.
    """
    smoothed_m = np.asarray(savgol_filter(read_m, _QUIET_WINDOW, _ORDER))
    carried_m = _carried(smoothed_m, stops_m)
    return np.diff(carried_m, append=carried_m[-1]) / period_s


@compiled
def _carried(position_m: np.ndarray, half_m: float) -> np.ndarray:
    carried_m = np.empty_like(position_m)
    at_m = position_m[0]
    for k in range(position_m.size):
        at_m = min(max(at_m, position_m[k] - half_m), position_m[k] + half_m)
        carried_m[k] = at_m
    return carried_m


SLOW_FORCE_N = 0.05
SLOW_CORNER_RAD_PER_S = 2.0 * np.pi * 1.5
"""The force that nobody models, where a profile says nothing of it: 0.05 N rms below 2 Hz, in amplitude falling with
the square. On development sets with nothing missing 1.5 Hz is the likeliest corner: 1.25 and 1.75 leave 2300 and 1400
squares more of a million samples, two poles at one place 1700 more."""

_DOUBTS = ((SLOW_FORCE_N, SLOW_CORNER_RAD_PER_S), *((0.05 * 4.0**k, 2.0 * np.pi * 20.0) for k in range(6)))
"""Slow forces (N, corner in rad/s) of which the likeliest stands for what the believed forces lack."""

_LOOSE_N = 4.0
"""Force of a stage that is slow, which nobody knows as long as noise decides on the sign of its friction: 10 ms after a
stop one of 3.6 N pulled the wrong way, and left 10 200 of 13 000 squares (1010222). With all known exactly that left
2100 squares without it, 370 with this, and 1600, 5500 and 370 with 1, 20 and 100 N; of 16 sets with one dry friction 15
left the same within 120."""

_KEPT_COUNT = 64
"""Filters that are kept, 1 MB for 20 s: two bodies with two payloads in a few lengths of recording."""


def motion_under(
    rough: Motion, position_m: np.ndarray, valid: np.ndarray, force_n: np.ndarray, mass_kg: float,
    period_s: float, sensor_m: float,
) -> Motion:  # fmt: skip
    """Return the motion that the past foretells, sample by sample, under forces that are believed to act (n, parts).

    A filter takes the sample that begins an interval and runs the body through it; nothing of a later sample is in it.
    With motion smoothed over all samples every law along it held some of the noise that it was to explain: flexible
    modes gained up to 1200 squares on machines that have none, and the micro's reaction came out 6 % wrong. How far the
    believed forces can be trusted is what makes the samples likeliest; where the stage is slow, less, or as elsewhere.

    A stage that creeps (24 um/s) is thrown back by a friction of 0.8 N in a millisecond, once its sign is wrong: where
    that went against smoothed samples, and counted, a known friction left 417 squares in place of 78 (7006).
    """
    mean_n, early_n = moments(force_n)

    def tried(doubt: tuple[float, float], loose: np.ndarray) -> tuple[Any, ...]:
        gain, variance, spread_m_per_s = _certainty(
            valid.tobytes(), loose.tobytes(), mass_kg, period_s, sensor_m, *doubt
        )
        outcome = filtered(position_m, valid, mean_n, early_n, gain, variance, mass_kg, period_s, doubt[1])
        known_m2 = np.column_stack([variance - sensor_m**2, gain[:, 0] * sensor_m**2])
        return *outcome, spread_m_per_s, known_m2, doubt

    steady = min((tried(doubt, np.zeros_like(valid)) for doubt in _DOUBTS), key=lambda one: one[2])
    known, foretold, _, spread_m_per_s, variances_m2, _ = min(
        steady, tried(steady[-1], rough.slow), key=lambda one: one[2]
    )
    step_s = period_s / force_n.shape[1]
    acceleration = (force_n + known[:, 2:]) / mass_kg
    velocity = known[:, 1:2] + step_s * (np.cumsum(acceleration, axis=1) - 0.5 * acceleration)
    position = known[:, :1] + step_s * (np.cumsum(velocity, axis=1) - 0.5 * velocity) - step_s**2 / 12.0 * acceleration
    before = np.concatenate([acceleration[:1, 0], acceleration[:-1, -1]])
    at_samples = np.column_stack([foretold, before])
    unsure = np.min(np.abs(velocity), axis=1) < _UNSURE_SDS * spread_m_per_s
    unsure |= np.min(velocity, axis=1) * np.max(velocity, axis=1) <= 0.0  # where it turns round within the interval
    unsure |= np.min(velocity * rough.velocity_m_per_s, axis=1) <= 0.0  # where samples on both sides say otherwise
    slow = rough.slow | (np.convolve(unsure, np.ones(3), "same") > 0.5)
    sds_m = np.sqrt(np.maximum(variances_m2, 0.0))
    put_right_m_per_s = (known[:, 0] - foretold[:, 0]) / period_s
    return Motion(
        position, velocity, acceleration, slow, at_samples, known[:, 0], sds_m, rough.carried_m_per_s, put_right_m_per_s
    )


@functools.lru_cache(maxsize=_KEPT_COUNT)
def _certainty(
    samples: bytes,
    loose: bytes,
    mass_kg: float,
    period_s: float,
    sensor_m: float,
    force_n: float,
    corner_rad_per_s: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a filter knows along samples that are valid or not, and where a stage is slow: often the same."""
    valid, slow = (np.frombuffer(flags, dtype=bool) for flags in (samples, loose))
    return certainty(valid, slow, mass_kg, period_s, sensor_m, force_n, corner_rad_per_s, _LOOSE_N)
