"""What is left when everything that has a name is taken away: nothing, or a rest that is called unknown. Pure."""

from typing import Any

import numpy as np
from scipy.stats import chi2

from stagectl.effects import CATALOGUE
from stagectl.gap.competition import Competition
from stagectl.gap.curves import unit_of
from stagectl.gap.judge import ALIAS_GAIN, CURVE_GAIN, MATERIAL_RATIO, Judge
from stagectl.gap.kinds import is_dry
from stagectl.gap.normal_equations import Fold, Group, solve

_LEFT_SDS = 4.0
_LEFT_SHARE = 0.03
_LOUDEST_RATIO = 1.0
"""Of the noise's own squares, what laws of the library are inexact by at most: right ones left 0.14 of them and less.
Dahl's law and a Stribeck friction in the place of bristles left 540 000 of 49 million, within 3 % of what there was,
and 2.4 times the noise; of that, 4 mN had been taken for force noise."""

_CURVE_SHARE = MATERIAL_RATIO  # more than what an inexact law leaves
_FINER_SHARE = 2.0 * MATERIAL_RATIO
"""The same of a finer curve: beside a hill that a user declared, of 945 000 squares, a machine that answers 50 us
sooner than is believed left 5200 to the curve over the motor's past. Forces without a law left 1.3 and 1.5 %."""

_EXACT_LEFT_SHARE = 1e-3
_EXACT_CURVE_SHARE = 1e-4
"""The same where only laws of the library stand, on a machine without force noise of its own: beside right names of 35
sets, of 2000 to 1640 million squares, 19 500 of 140 million were left at most (1.4e-4), or three deviations of the
floor, and curves found 3700 of those (2.6e-5), or what noise gives. A Dahl friction in the place of bristles left
72 300 of 16.3 million, of which a curve over the time since each reversal found 3400."""

_FINER_TAIL = 1e-6
"""How seldom a finer curve finds as much on noise as makes it a rest. Beside the right names of 13 sets none found that
much but 60 squares (51 is so much) beside 1.4 million, where 700 are material; beside five names in the place of a
clock of 6000 squares, what is late found 46, where noise gives 40 so seldom."""

_NUMBER_TAIL = 1e-4
"""The same of a single number, whether what is late is spread out: a lag in a delay's place gained 33 and 22 squares,
beside the right one of 18 sets it gained 5 at most (15 is what noise gives so seldom)."""

_SHARED_TAIL = 0.01
"""The same of all recordings but one, for what is not a single one's."""

_ALONE_RATIO = 2.0
"""So many times as much makes a rest of what a single recording has: beside the right names of 2 of 61 sets the past of
a motor's force found 41 and 48 squares (40 is what noise gives so seldom), of which one recording had 33 and 115, the
others 3 to 11 each, and 7 and 8 together."""

_CROWD_COUNT = 3
"""So many names on one body that a single curve does as well as are one effect that has no name: a spring with a dead
zone came out as a spring, a cable that slips, a cogging as long as the travel and an offset, 4 squares of 107 000
better than a curve over position."""

_MOST_DRY_COUNT = 3
"""Laws that rub on one body at most: what takes four of them is one that has no name. A friction that grows with the
time since each reversal was a level, a rise, a sub-linear friction and a slipping cable, and left nothing (1011107)."""


def excess(judge: Judge, chosen: list[Group]) -> float:
    """Return what is left above the noise, in squares of it."""
    return sum(float(s.gram[0, 0]) - s.count for s in judge.source.sums) - judge.gain(chosen)


def _noise(search: Competition) -> float:
    """Return the standard error of the floor, in squares of the noise."""
    return float(np.sqrt(2.0 * sum(s.count for s in search.evidence.sums)))


def unknown_rest(
    search: Competition, chosen: list[Group], before_excess: float, is_exact: bool = False
) -> dict[str, Any] | None:
    """Return what no effect explains, with the curve that goes furthest, or None where the floor is reached.

    is_exact: what stands is known to be exact from a look at the same machine above less noise.

    Names are worth stating only where with them nothing is left: a law of the library that fits an unknown force half
    is a wrong name.
    """
    judge = search.judge
    crowd, instead = one_curve_for_many(judge, chosen)
    if instead is not None:
        beside = [group for group in chosen if not any(group is other for other in crowd)]
        gained = judge.gain([*beside, instead]) - judge.gain(beside)
        return _curve_found(search, beside, instead, excess(judge, beside), before_excess, gained)
    left, first = excess(judge, chosen), before_excess
    noise = _noise(search)
    best, gained = None, 0.0
    for curve in search.curves:
        gain = judge.gain([*chosen, curve]) - judge.gain(chosen)
        if gain > gained:
            best, gained = curve, gain
    judge.trace.append(f"left over {left:.0f} of {first:.0f}, noise {noise:.0f}, best curve {gained:.0f}")
    is_exact_here = are_exact(search, chosen)
    finer_share = _EXACT_CURVE_SHARE if is_exact_here else _FINER_SHARE
    left_share, curve_share = _LEFT_SHARE, _CURVE_SHARE
    if is_exact or is_exact_here:
        left_share, curve_share = _EXACT_LEFT_SHARE, _EXACT_CURVE_SHARE
    floor = _LEFT_SDS * noise + left_share * max(first, 0.0)
    if not _has_users(search, chosen):
        loudest = _LOUDEST_RATIO * sum(s.count for s in search.evidence.sums)
        floor = min(floor, _LEFT_SDS * noise + loudest)
    least = max(CURVE_GAIN * judge.threshold, curve_share * max(first, 0.0))
    if not (left > floor or gained > least or _rubs_too_often(chosen)):
        finer = finer_curve(search, chosen, finer_share * max(first, 0.0))
        if finer is None:
            return None
        if finer.key not in {curve.key for curve in search.curves}:  # of place there is a coarse one, as tables are
            best, gained = finer, judge.gain([*chosen, finer]) - judge.gain(chosen)
    return _curve_found(search, chosen, best, left, first, gained)


def _rubs_too_often(chosen: list[Group]) -> bool:
    """Tell whether more laws rub on one body than there are on any."""
    places = [group.key[1] for group in chosen if is_dry(group)]
    return any(places.count(place) > _MOST_DRY_COUNT for place in places)


def are_exact(search: Competition, chosen: list[Group]) -> bool:
    """Tell whether what stands is laws of the library alone, and the machine has no force noise of its own.

    Of a user's own effect nobody knows that its shape is found to the end: one left 0.9 % of what it had explained.
    """
    return not search.judge.is_rough and not _has_users(search, chosen)


def _has_users(search: Competition, chosen: list[Group]) -> bool:
    """Tell whether a user's own effect is among the names."""
    names = [*(group.key[0] for group in chosen), *(effect.name for effect, *_ in search.moved)]
    return any(name in CATALOGUE and CATALOGUE[name].origin for name in names)


def finer_curve(search: Competition, chosen: list[Group], material: float) -> Group | None:
    """Return the finer curve that finds most, where that is more than on noise, and than is material; else None.

    A spring with a dead zone is a cable and two ripples as long as the travel, but for its two kinks: 5800 squares of
    388 000 were left, of which twelve knots found 350 and forty-eight 5000. A friction that grows with the time since
    each reversal is a friction and a cable that slips, but for 7900 squares of 305 000: over place twelve knots found
    360 and forty-eight 200, over that time sixteen found 4600.
    """
    now = search.judge.gain(chosen)
    found = []
    for curve in search.finer_curves():
        gained = search.judge.gain([*chosen, curve]) - now
        search.judge.trace.append(f"{search.term(curve).name}, finer, on {curve.key[1]} finds {gained:.0f}")
        count = len(curve.columns)
        by_noise = float(chi2.isf(_FINER_TAIL if count > 1 else _NUMBER_TAIL, count))
        if gained > max(material, by_noise) and (
            gained > _ALONE_RATIO * by_noise or not _is_in_one_alone(search, chosen, curve)
        ):
            found.append((gained, curve))
    return max(found, key=lambda one: one[0])[1] if found else None


def _is_in_one_alone(search: Competition, chosen: list[Group], curve: Group) -> bool:
    """Tell whether a curve finds something in one of several recordings, and in the others what it finds on noise."""
    sums = search.evidence.sums
    if len(sums) == 1:
        return False
    beside = [*search.judge.base, *chosen]
    without_one = [[*sums[:k], *sums[k + 1 :]] for k in range(len(sums))]
    found = [float(Fold(beside, others, on_noise=False).added(curve)[0]) for others in without_one]
    return min(found) < float(chi2.isf(_SHARED_TAIL, len(curve.columns)))


def one_curve_for_many(judge: Judge, chosen: list[Group]) -> tuple[list[Group], Group | None]:
    """Return names on one body and the curve that does as well as all of them; none where there is no such body."""
    for place in sorted({group.key[1] for group in chosen}):
        crowd = [group for group in chosen if group.key[1] == place]
        if len(crowd) < _CROWD_COUNT:
            continue
        beside = [group for group in chosen if group.key[1] != place]
        curves = [curve for curve in judge.curves if curve.key[1] == place]
        best = max(curves, key=lambda curve: judge.gain([*beside, curve]), default=None)
        if best is not None and judge.gain([*beside, best]) > judge.gain(chosen) - ALIAS_GAIN:
            return crowd, best
    return [], None


def _curve_found(
    search: Competition, beside: list[Group], curve: Group | None, left: float, first: float, gained: float
) -> dict[str, Any]:
    """Return what is left, of how much, and the curve that goes furthest, with its gain."""
    found: dict[str, Any] = {"left": left, "before": first, "gain": gained}
    if curve is not None:
        term = search.evidence.terms[curve.columns[0]]
        values, sds = solve([*search.judge.base, *beside, curve], search.evidence.sums).of(curve)
        found |= {
            "over": term.name.removeprefix("curve over "),
            "acts_on": term.acts_on,
            "knots": [float(name) for name in term.amplitudes],
            "unit": unit_of(term),
            "values": values.tolist(),
            "sds": sds.tolist(),
        }
    return found
