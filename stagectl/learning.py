"""Iterative learning over repeated scans: what an error repeats is taken out of the next scan's reference.

    c_0 = 0,   c_(j+1) = Q (c_j - g e_j),   reference of scan j: r + c_j          (Bristow, Tharayil, Alleyne, IEEE CSM
                                                                                  26(3), 2006: P-type with Q filter)

e_j is the measured error of scan j against r, row for row. The loop follows its reference one to one up to its
bandwidth, so that the plain gain g converges wherever Q is not far beyond it; Q is a zero-phase Gaussian, so that c has
exact derivatives, which are fed forward like those of any reference.

The law never knows. The guard of the tick watches the corrected scan like any other; this module has its own besides:
c is bounded in size and acceleration; a scan that went worse than the best throws its lesson away and halves the gain;
one that went worse than the scan with nothing learnt forgets all, for the machine has changed; too many of either end
the learning. Pure; `init` and `step` make new states.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from stagectl.errors import RequestError
from stagectl.signals import SETPOINT

_EDGE_S = 0.1  # over which a correction fades at both ends: a scan begins and ends at rest where it was planned
_HALF = math.log(2.0) / 2.0  # a Gaussian of this exponent is 3 dB down at its bandwidth


@dataclass(frozen=True, slots=True)
class Limits:
    """How fast, how far and how long learning may go."""

    gain_ratio: float = 0.5
    bandwidth_hz: float = 40.0
    correction_m: float = 300e-9
    correction_m_per_s2: float = 5e-3
    worse_ratio: float = 1.25  # of the best scan's rms in the band, or of the first one's: more is worse
    rejections_max_count: int = 3


@dataclass(frozen=True, slots=True, eq=False)
class Learning:
    """What has been learnt; `correction_m` (rows,) belongs to the next scan, `best_m` to the best so far."""

    limits: Limits
    period_s: float
    gain_ratio: float
    correction_m: np.ndarray
    best_m: np.ndarray
    best_rms_m: float
    first_rms_m: float  # of the scan that nothing was learnt for
    scans_count: int = 0
    rejections_count: int = 0
    bounded: bool = False  # the last lesson ran into a limit of size or acceleration
    stopped: str = ""  # why nothing more is learnt; empty while it is


def init(rows_count: int, period_s: float, limits: Limits | None = None) -> Learning:
    """Begin with nothing learnt, for scans of so many rows. RequestError for limits that make no sense."""
    limits = Limits() if limits is None else limits
    for name, low, high in (("gain_ratio", 0.0, 1.0), ("bandwidth_hz", 0.0, 0.25 / period_s)):
        value = getattr(limits, name)
        if not low < value <= high:
            raise RequestError(f"learning: {name} is {value:g}; a number above {low:g} and up to {high:g} is needed")
    if rows_count * period_s < 4.0 * _EDGE_S:
        raise RequestError(
            f"learning: a scan of {rows_count} rows lasts {rows_count * period_s:g} s; {4.0 * _EDGE_S:g} s at least "
            "are needed to fade a correction in and out"
        )
    nothing = np.zeros(rows_count)
    return Learning(limits, period_s, limits.gain_ratio, nothing, nothing, math.inf, math.inf)


def step(state: Learning, error_m: np.ndarray) -> Learning:
    """Take the measured error, end minus planned reference, of the scan that `state.correction_m` was for, (rows,).

    Rows that were not measured are nan. RequestError where the scan has another length.
    """
    if error_m.shape != state.correction_m.shape:
        raise RequestError(
            f"learning: the scan has {error_m.size} rows, the ones before had {state.correction_m.size}; learn a "
            "motion of its own for another scan"
        )
    if state.stopped:
        return replace(state, scans_count=state.scans_count + 1)
    seen = np.isfinite(error_m)
    if np.count_nonzero(seen) < 0.9 * error_m.size:
        return _rejected(state, math.inf)
    rows = np.arange(error_m.size)
    filtered = _low_passed(np.interp(rows, rows[seen], error_m[seen]), state)
    rms_m = float(np.sqrt(np.mean(filtered**2)))
    if math.isinf(state.first_rms_m):
        state = replace(state, first_rms_m=rms_m)
    if not rms_m <= state.limits.worse_ratio * state.best_rms_m:
        return _rejected(state, rms_m)
    best = state
    if rms_m < state.best_rms_m:
        best = replace(state, best_m=state.correction_m, best_rms_m=rms_m)
    wanted = _faded(state.correction_m - state.gain_ratio * filtered, state)
    kept, bounded = _bounded(_low_passed(wanted, state), state)
    return replace(best, correction_m=kept, scans_count=state.scans_count + 1, bounded=bounded)


def corrected(setpoints: np.ndarray, state: Learning) -> np.ndarray:
    """Return the reference (SETPOINT) of the next scan: the planned one with the correction and its derivatives."""
    if setpoints.size != state.correction_m.size:
        raise RequestError(
            f"learning: the scan has {setpoints.size} rows, what was learnt has {state.correction_m.size}; it is of "
            "another motion"
        )
    rows = np.zeros(setpoints.size, SETPOINT)
    for name in SETPOINT.names or ():
        rows[name] = setpoints[name]
    for order, name in enumerate(("position_m", "velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3")):
        rows[name] += _derivative(state.correction_m, state.period_s, order)
    return rows


def _rejected(state: Learning, rms_m: float) -> Learning:
    """Go back to the best scan's correction and learn half as fast from it, or to none at all; or stop."""
    count = state.rejections_count + 1
    gain = 0.5 * state.gain_ratio
    stopped = ""
    if not rms_m <= state.limits.worse_ratio * state.first_rms_m:
        nothing = np.zeros(state.correction_m.size)
        state = replace(state, best_m=nothing, best_rms_m=math.inf, first_rms_m=math.inf)
    if count >= state.limits.rejections_max_count:
        stopped = f"{count} scans went worse than the best before them, the last with {rms_m * 1e9:.3g} nm"
    return replace(
        state,
        gain_ratio=gain,
        correction_m=state.best_m,
        scans_count=state.scans_count + 1,
        rejections_count=count,
        bounded=False,
        stopped=stopped,
    )


def _low_passed(values: np.ndarray, state: Learning) -> np.ndarray:
    return _spectrally(values, lambda hertz: np.exp(-_HALF * (hertz / state.limits.bandwidth_hz) ** 2), state.period_s)


def _derivative(values: np.ndarray, period_s: float, order: int) -> np.ndarray:
    return values if order == 0 else _spectrally(values, lambda hertz: (2j * np.pi * hertz) ** order, period_s)


def _spectrally(values: np.ndarray, factor, period_s: float) -> np.ndarray:
    """Multiply a spectrum by a function of frequency; the mirrored end keeps what does not fade from wrapping round."""
    mirrored = np.concatenate([values, values[::-1]])
    spectrum = np.fft.rfft(mirrored) * factor(np.fft.rfftfreq(mirrored.size, period_s))
    return np.fft.irfft(spectrum, mirrored.size)[: values.size]


def _faded(values: np.ndarray, state: Learning) -> np.ndarray:
    """Let a correction rise from nothing and fall to nothing (raised cosine)."""
    count = round(_EDGE_S / state.period_s)
    ramp = 0.5 - 0.5 * np.cos(np.pi * np.clip((np.arange(values.size) - count) / count, 0.0, 1.0))
    return values * ramp * ramp[::-1]


def _bounded(values: np.ndarray, state: Learning) -> tuple[np.ndarray, bool]:
    """Shrink a correction as a whole until its size and acceleration keep to the limits; a clipped one would jerk."""
    limits = state.limits
    size = float(np.max(np.abs(values)))
    push = float(np.max(np.abs(_derivative(values, state.period_s, 2))))
    share = min(1.0, limits.correction_m / max(size, 1e-15), limits.correction_m_per_s2 / max(push, 1e-15))
    return values * share, share < 1.0
