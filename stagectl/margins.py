"""How far a loop is from instability: sensitivity peak, gain, phase and delay margin (Skogestad, Postlethwaite, 2.4).

All of the loop broken at the command of the axis that carries the end (`stagectl.linear_loop`). Pure numpy.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.linear_loop import Linearised

_POINTS = 1500
_LOWEST_HZ = 0.05
_DELAY_STEP_S = 0.1e-3
_DELAY_MOST_S = 10e-3
_DELAY_FINE_S = 1e-6


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of one loop; nan where the loop gain never crosses what they count from."""

    is_stable: bool
    sensitivity_peak_ratio: float  # Ms = max |1 / (1 + L)|
    sensitivity_peak_hz: float
    crossover_hz: float  # the highest frequency with |L| = 1
    phase_margin_rad: float  # least over all crossovers
    gain_margin_ratio: float  # by which the gain may rise
    gain_reduction_ratio: float  # to which it may fall
    delay_margin_s: float  # by which commands may come late; `_DELAY_MOST_S` where more


def grid_hz(period_s: float) -> np.ndarray:
    """Return frequencies from 0.05 Hz to just below half the rate, evenly spaced in their logarithm."""
    return np.geomspace(_LOWEST_HZ, 0.499 / period_s, _POINTS)


def margins(loop: Linearised) -> Margins:
    """Return the margins of a loop; an unstable one has a delay margin of 0."""
    frequency_hz = grid_hz(loop.period_s)
    gain = loop.loop_gain(frequency_hz)
    stable = loop.closed().is_stable()
    peak = int(np.argmax(1.0 / np.abs(1.0 + gain)))
    fine_hz = np.linspace(frequency_hz[max(peak - 1, 0)], frequency_hz[min(peak + 1, frequency_hz.size - 1)], 41)
    sensitivity = 1.0 / np.abs(1.0 + loop.loop_gain(fine_hz))
    crossings = _crossings(np.abs(gain) - 1.0)
    at_one = [_between(gain, *place) for place in crossings]
    real = [_between(gain, *place).real for place in _crossings(np.imag(gain))]
    return Margins(
        is_stable=stable,
        sensitivity_peak_ratio=float(np.max(sensitivity)),
        sensitivity_peak_hz=float(fine_hz[int(np.argmax(sensitivity))]),
        crossover_hz=float(_between(frequency_hz, *crossings[-1]).real) if crossings else float("nan"),
        phase_margin_rad=min((abs(float(np.angle(-value))) for value in at_one), default=float("nan")),
        gain_margin_ratio=min((-1.0 / value for value in real if -1.0 < value < 0.0), default=float("nan")),
        gain_reduction_ratio=max((-1.0 / value for value in real if value < -1.0), default=float("nan")),
        delay_margin_s=_delay_margin_s(loop) if stable else 0.0,
    )


def _delay_margin_s(loop: Linearised) -> float:
    """Return the least delay more at which the closed loop is unstable: eigenvalues, exact for a held command."""
    low_s = 0.0
    while low_s < _DELAY_MOST_S and loop.closed(low_s + _DELAY_STEP_S).is_stable():
        low_s += _DELAY_STEP_S
    if low_s >= _DELAY_MOST_S:
        return _DELAY_MOST_S
    high_s = low_s + _DELAY_STEP_S
    while high_s - low_s > _DELAY_FINE_S:
        middle_s = 0.5 * (low_s + high_s)
        low_s, high_s = (middle_s, high_s) if loop.closed(middle_s).is_stable() else (low_s, middle_s)
    return low_s


def _crossings(values: np.ndarray) -> list[tuple[int, float]]:
    """Return where a sequence changes its sign: the index before, and the share of the step to it."""
    places = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    return [(int(k), float(values[k] / (values[k] - values[k + 1]))) for k in places]


def _between(values: np.ndarray, index: int, share: float) -> complex:
    return complex(values[index] + share * (values[index + 1] - values[index]))
