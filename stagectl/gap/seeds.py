"""Where to look for what repeats: pitches in position and frequencies in time, from what every other hypothesis leaves.

The gain of a force on whitened innovations is a scalar product; its adjoint turns the innovations into one signal of
force, whose spectrum over position or time shows every period at once. Pure.
"""

from collections.abc import Sequence

import numpy as np

from stagectl.gap import innovations
from stagectl.gap.interval_parts import PARTS_COUNT
from stagectl.gap.recording import Recording

PEAKS_COUNT = 4
_CELLS_PER_PITCH = 6.0
_LEAST_PITCH_M = 4e-4
LINE_RATIO = 50.0  # of the power of a line over time to its neighbours; the highest place of noise has 20
_LOWEST_HZ = 2.5
_HIGHEST_HZ = 120.0
_NEIGHBOURS = 41
_LEAST_PERIODS = 1.5  # over the way
_DRAWS_COUNT = 8
_SMOOTHED_COUNT = 5


def force_signal(recording: Recording, axis: str, rest: np.ndarray) -> np.ndarray:
    """Return the adjoint of the whitening on `rest` (innovations at judged samples), one element a sample."""
    level, steps = recording.filters[axis]
    whole = np.zeros(recording.log.samples_count)
    whole[recording.judged[axis]] = rest
    n = whole.size
    settled = np.repeat(steps[n // 2 : n // 2 + 1], n, axis=0)
    out = innovations.innovations(
        np.empty(0), np.repeat(whole[::-1, None], PARTS_COUNT, axis=1), 1.0, settled, np.ones(n, bool),
        recording.mass_kg(axis), recording.log.period_s, level.corner_rad_per_s, 0.0,
    )  # fmt: skip
    return -out[::-1]


def in_step_with_motor(recordings: Sequence[Recording], axis: str, signals: list[np.ndarray]) -> list[np.ndarray]:
    """Return signals times the motor's force: over position they show what repeats in the force constant.

    A ripple of 2 % turns its sign with every acceleration. Over position alone its line was split in two, 4 % off on
    either side, and no search came back from there to a pitch of 15.4 mm.
    """
    found = []
    for recording, signal in zip(recordings, signals, strict=True):
        motor_n = recording.macro_motor_n if axis == "macro" else recording.micro_motor_n
        found.append(np.zeros_like(signal) if motor_n is None else signal * motor_n.mean(axis=1))
    return found


def of_noise(recordings: Sequence[Recording], axis: str, random: np.random.Generator) -> list[list[np.ndarray]]:
    """Return what white innovations make of the signals of all recordings, some draws of it."""
    return [
        [force_signal(r, axis, random.standard_normal(int(r.judged[axis].sum()))) for r in recordings]
        for _ in range(_DRAWS_COUNT)
    ]


def pitches_m(
    recordings: Sequence[Recording], axis: str, signals: list[np.ndarray], noise: Sequence[list[np.ndarray]] = ()
) -> list[float]:
    """Return the pitches with the highest peaks over position, several recordings together, m.

    noise: draws of what noise alone gives, above which peaks are high; without them, above their neighbours. A line of
    a few periods over the way is as wide as its neighbourhood: of a ripple of 41 mm under a stroke of 157 mm no peak
    stood out. Short ones have a background that other effects leave, and no noise.
    """
    span_m = max(float(np.ptp(r.position_m(axis))) for r in recordings)
    if not span_m > 4.0 * _LEAST_PITCH_M:
        return []
    cell_m = _LEAST_PITCH_M / _CELLS_PER_PITCH
    count = int(2 ** np.ceil(np.log2(2.0 * span_m / cell_m)))
    power = _over_position(recordings, axis, signals, cell_m, count)
    background = None
    if noise:
        mean = np.mean([_over_position(recordings, axis, draw, cell_m, count) for draw in noise], axis=0)
        background = np.convolve(mean, np.full(_SMOOTHED_COUNT, 1.0 / _SMOOTHED_COUNT), "same")
    low = (_LEAST_PERIODS if noise else 2.0) / span_m
    return [1.0 / f for f in _peaks(power, 1.0 / (count * cell_m), low, 1.0 / _LEAST_PITCH_M, background)]


def _over_position(
    recordings: Sequence[Recording], axis: str, signals: Sequence[np.ndarray], cell_m: float, count: int
) -> np.ndarray:
    """Return the power of signals over position, summed over recordings, shape (count / 2 + 1,)."""
    power = np.zeros(count // 2 + 1)
    for recording, signal in zip(recordings, signals, strict=True):
        position_m = recording.motion(axis).position_m[:, 0]
        moving = ~recording.motion(axis).slow
        cell = np.floor((position_m - position_m.min()) / cell_m).astype(int)
        sums = np.bincount(cell[moving], signal[moving], minlength=count)[:count]
        power += np.abs(np.fft.rfft(sums)) ** 2
    return power


def frequencies_hz(
    recordings: Sequence[Recording], axis: str, signals: list[np.ndarray], least_ratio: float = 0.0
) -> list[float]:
    """Return the frequencies with the highest peaks over time, Hz; least_ratio: of their power to their neighbours'."""
    period_s = recordings[0].log.period_s
    count = int(2 ** np.ceil(np.log2(2 * max(s.size for s in signals))))
    power = np.zeros(count // 2 + 1)
    for signal in signals:
        power += np.abs(np.fft.rfft(signal, count)) ** 2
    return _peaks(power, 1.0 / (count * period_s), _LOWEST_HZ, _HIGHEST_HZ, least_ratio=least_ratio)


def _peaks(
    power: np.ndarray,
    step: float,
    low: float,
    high: float,
    background: np.ndarray | None = None,
    least_ratio: float = 0.0,
) -> list[float]:
    """Return the places of the highest peaks above a background, their neighbourhood's median, in units of `step`.

    None of those that are lower than `least_ratio` times the background.
    """
    first, last = max(int(np.ceil(low / step)), 2), min(int(high / step), power.size - 2)
    if last - first < _NEIGHBOURS:
        return []
    part = power[first:last]
    if background is None:
        padded = np.pad(part, _NEIGHBOURS // 2, mode="reflect")
        below = np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS), axis=1)
    else:
        below = background[first:last]
    height = part / np.maximum(below, 1e-300)
    found: list[float] = []
    for k in np.argsort(-height):
        if height[k] < least_ratio:
            break
        here = first + int(k)
        if all(abs(here - f / step) > 3.0 for f in found):
            a, b, c = power[here - 1], power[here], power[here + 1]
            curve = a - 2.0 * b + c
            shift = 0.5 * (a - c) / curve if curve < 0.0 else 0.0
            found.append((here + float(np.clip(shift, -0.5, 0.5))) * step)
        if len(found) == PEAKS_COUNT:
            break
    return found
