"""What is left when everything that has a name is taken away: nothing, or a rest that is called unknown. Pure."""

from typing import Any

import numpy as np

from stagectl.gap.competition import Competition
from stagectl.gap.normal_equations import Group, solve
from stagectl.gap.selection import CURVE_GAIN, MATERIAL_RATIO

_LEFT_SDS = 4.0
_LEFT_SHARE = 0.03
_CURVE_SHARE = MATERIAL_RATIO  # more than what an inexact law leaves


def excess(search: Competition, chosen: list[Group]) -> float:
    """Return what is left above the noise, in squares of it."""
    sums = search.evidence.sums
    return sum(float(s.gram[0, 0]) - s.count for s in sums) - search.judge.gain(chosen)


def _noise(search: Competition) -> float:
    """Return the standard error of the floor, in squares of the noise."""
    return float(np.sqrt(2.0 * sum(s.count for s in search.evidence.sums)))


def unknown_rest(search: Competition, chosen: list[Group], before_excess: float) -> dict[str, Any] | None:
    """Return what no effect explains, with the curve that goes furthest, or None where the floor is reached.

    Names are worth stating only where with them nothing is left: a law of the library that fits an unknown force half
    is a wrong name.
    """
    judge, evidence = search.judge, search.evidence
    left, first = excess(search, chosen), before_excess
    noise = _noise(search)
    best, gained = None, 0.0
    for curve in search.curves:
        gain = judge.gain([*chosen, curve]) - judge.gain(chosen)
        if gain > gained:
            best, gained = curve, gain
    judge.trace.append(f"left over {left:.0f} of {first:.0f}, noise {noise:.0f}, best curve {gained:.0f}")
    floor = _LEFT_SDS * noise + _LEFT_SHARE * max(first, 0.0)
    material = best is not None and gained > max(CURVE_GAIN * judge.threshold, _CURVE_SHARE * max(first, 0.0))
    if not left > floor and not material:
        return None
    found: dict[str, Any] = {"left": left, "before": first, "gain": gained}
    if best is not None:
        term = evidence.terms[best.columns[0]]
        values, sds = solve([*judge.base, *chosen, best], evidence.sums).of(best)
        found |= {
            "over": term.name.removeprefix("curve over "),
            "acts_on": term.acts_on,
            "knots": [float(name) for name in term.amplitudes],
            "values_n": values.tolist(),
            "sds_n": sds.tolist(),
        }
    return found
