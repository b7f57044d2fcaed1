"""A flexible mode of which the frequency is roughly known, and the notch that a loop needs for it.

The mode is of the bad kind: it moves the sensor against the motor (not collocated, a negative residue), so that its
resonance turns the phase round. The loop gain is a third still where such modes are, and the resonance has up to ten
times that. The notch is as wide as what is known of the frequency asks for, and no wider: its width is phase that the
loop has less of.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stagectl import compose
from stagectl.linear_loop import Body, Linearised

_WIDTHS = (0.1, 0.2, 0.3, 0.5)  # damping ratios of a notch's denominator that are tried
_DEPTHS = (0.05, 0.1, 0.2)
HARD_COUNT = 3  # corners that a search looks at: the least damped, with the whole residue
_SLOWER, _SLOWEST = 0.92, 0.2  # steps of the bandwidth, and its end
_LOW_HZ = 3.0
_GRID_COUNT = 160
_FINE_COUNT = 120
_FINE_RATIO = 0.08  # of the mode's frequency, on either side


@dataclass(frozen=True, slots=True)
class Mode:
    """What is known of a mode: the worst of each number counts, and half the residue and twice the damping too."""

    frequency_hz: float
    frequency_off_ratio: float = 0.03
    residue_ratio: float = 0.1  # of the rigid body's, against it
    damping_ratio: float = 0.01

    def corners(self) -> Iterator[dict[str, Any]]:
        """Give the effect tables of what the mode may be."""
        offs = (-self.frequency_off_ratio, 0.0, self.frequency_off_ratio)
        for damping, residue, off in itertools.product((1.0, 2.0), (1.0, 0.5), offs):  # the worst ones first
            yield effect(self.frequency_hz * (1.0 + off), self.residue_ratio * residue, self.damping_ratio * damping)


def effect(frequency_hz: float, residue_ratio: float, damping_ratio: float, axis: str = "micro") -> dict[str, Any]:
    """Return the effect of a mode that an axis with its motor free rings at, its residue against the rigid body's.

    A share mu of the mass on a spring has the residue mu / (1 - mu) of the rigid body's: here mu is negative, and the
    resonance comes before the zeros that follow it. The axis' whole mass stays what it is.
    """
    share = -residue_ratio / (1.0 - residue_ratio)
    held = np.sqrt(1.0 - share)  # the law's frequency and damping are those with the axis held
    return {
        "name": "flexible_mode",
        "acts_on": f"{axis}_force",
        "share_ratio": share,
        "frequency_hz": float(frequency_hz * held),
        "damping_ratio": float(damping_ratio * held),
    }


def with_effect(body: Body, row: dict[str, Any]) -> Body:
    """Return a body that has one effect more."""
    effects = [*body.effects, row]
    return replace(body, module=compose.plant_module(effects), effects=effects)


def worst_sensitivity(loop: Linearised, mode: Mode, corners_count: int | None = None) -> float:
    """Return the greatest sensitivity over what the mode may be; infinite where one of them is unstable."""
    worst = 0.0
    for row in itertools.islice(mode.corners(), corners_count):
        one = replace(loop, body=with_effect(loop.body, row))
        if not one.closed().is_stable():
            return float("inf")
        worst = max(worst, sensitivity(one, mode))
    return worst


def sensitivity(loop: Linearised, mode: Mode) -> float:
    """Return the greatest sensitivity of a loop whose body has the mode, looked for closely around it."""
    return float(np.max(1.0 / np.abs(1.0 + loop.loop_gain(grid_around(loop.period_s, mode)))))


def grid_around(period_s: float, mode: Mode) -> np.ndarray:
    """Return rising frequencies below half the rate, close to each other where the mode may be."""
    half_hz = 0.499 / period_s
    around_hz = mode.frequency_hz * np.linspace(1.0 - _FINE_RATIO, 1.0 + _FINE_RATIO, _FINE_COUNT)
    return np.unique(np.concatenate([np.geomspace(_LOW_HZ, half_hz, _GRID_COUNT), around_hz[around_hz < half_hz]]))


def notches(mode: Mode) -> list[dict[str, float]]:
    """Return what is tried, by keys of [control]: none, and notches of several widths and depths."""
    tried = [{"notch_frequency_hz": 0.0}]
    for width, depth in itertools.product(_WIDTHS, _DEPTHS):
        tried.append(
            {"notch_frequency_hz": mode.frequency_hz, "notch_damping_ratio": width, "notch_depth_ratio": depth}
        )
    return tried


def searched(
    made: Callable[[float, Mapping[str, float]], Linearised],
    mode: Mode,
    max_sensitivity: float,
    bandwidth_hz: float,
    *,
    may_slow: bool = True,
) -> tuple[float, dict[str, float]]:
    """Return the greatest bandwidth, from `bandwidth_hz` down, that some notch keeps to a sensitivity, and that notch.

    Where none does, the last one tried: who asked looks at its margins.
    """
    value, best = bandwidth_hz, notches(mode)[0]
    while True:
        found = [(worst_sensitivity(made(value, notch), mode, HARD_COUNT), k) for k, notch in enumerate(notches(mode))]
        least, k = min(found)
        best = notches(mode)[k]
        if least <= max_sensitivity and worst_sensitivity(made(value, best), mode) <= max_sensitivity:
            return value, best
        if not may_slow or value * _SLOWER < _SLOWEST * bandwidth_hz:
            return value, best
        value *= _SLOWER
