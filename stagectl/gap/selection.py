"""Which hypotheses stay: rounds of competition, each of which every name has to stand again. Pure."""

import itertools
from collections.abc import Callable, Sequence

from stagectl.gap.findings import PARAMETER
from stagectl.gap.judge import ALIAS_GAIN, ALIAS_SHARE, CURVE_GAIN, EXACT_RATIO, MATERIAL_RATIO, SMOOTH_RATIO, Judge
from stagectl.gap.kinds import form, has_akin, is_smooth
from stagectl.gap.normal_equations import Group
from stagectl.gap.parts import as_one, as_two_others, in_parts, levelled

NAMES_BESIDE_CURVE_COUNT = 3
"""From so many names on a curve that explains more than any further name ends the search: it is unknown. To six names
and back, each competing beside the others again, took a force that no effect is a quarter of an hour or more."""

MOST_NAMES_COUNT = 6
"""So many names a competition lets stand: a machine that has more of them has an effect that nobody has a law for."""

_HOPEFUL_SHARE = 0.3
"""Of what a name gains, what another gains at least that may be it once the shapes beside it are its own."""


def select(
    judge: Judge,
    start: Sequence[Group] = (),
    most: int = MOST_NAMES_COUNT,
    until: Callable[[Group], bool] = lambda group: False,
) -> list[Group]:
    """Add the best hypothesis as long as one stays; then let every one compete again beside the others.

    Ends early with a hypothesis of which `until` says that everything has to be looked at anew, and where what is
    left lacks a name.
    """
    chosen = _admissible(judge, start)
    seen: set[frozenset[tuple[str, str]]] = set()
    while len(chosen) < most:
        rivals = judge.rivals(chosen)
        if lacks_a_name(judge, chosen):
            _note(judge, chosen, rivals)
            break
        passing = judge.passing(chosen)
        _note(judge, chosen, rivals)
        more = _likeliest(judge, chosen, passing, rivals) if passing else _pair(judge, chosen, rivals)
        grown = [*chosen, *more] if more else _reshaped_with_one(judge, chosen, rivals)
        if not grown:
            break
        chosen = grown
        chosen = _without_superfluous(judge, _competed(judge, chosen))
        state = frozenset(group.key for group in chosen)
        if state in seen or any(until(group) for group in chosen) or judge.has_named_noise(chosen):
            break
        seen.add(state)
    alike = as_one(judge, in_parts(judge, _beside_other_shapes(judge, chosen)))
    return levelled(judge, as_two_others(judge, alike))


def _beside_other_shapes(judge: Judge, chosen: list[Group]) -> list[Group]:
    """Let names compete once more where a shape beside them on the same body has taken a part of one of them.

    Each rival with the shapes searched again that it has beside it: a sub-linear friction with an exponent of 0.513
    for 0.508 had taken most of a viscous friction, and a drag gained 153 squares where that gained 119; beside the
    exponent that it would have with it, 185. None of more numbers: bristles took the place of a level so.
    """
    for k in range(len(chosen)):
        group, rest = chosen[k], [*chosen[:k], *chosen[k + 1 :]]
        if not any(other.searched and other.key[1] == group.key[1] for other in rest):
            continue
        alone, with_it = judge.gain(rest), judge.gain(chosen)
        for rival in judge.rivals(rest):
            hopeful = judge.gain([*rest, rival]) - alone > _HOPEFUL_SHARE * (with_it - alone)
            if rival.key == group.key or form(rival) > form(group) or not hopeful:
                continue
            anew = judge.reshaped([*rest, rival])
            if judge.worth(anew) > judge.worth(chosen) + ALIAS_GAIN and judge.stays(anew[:-1], anew[-1]):
                chosen = [*anew[:k], anew[-1], *anew[k:-1]]
    return chosen


def _likeliest(judge: Judge, chosen: Sequence[Group], passing: Sequence[Group], rivals: Sequence[Group]) -> list[Group]:
    """Return the best of those that pass; of known parameters two where one alone is much less to be believed.

    A push back that is stated exactly and 4 % off is a mass and a force constant of the micro that are both off by
    that, but for a square of 52: each of those by seven of its stated deviations (1011144).
    """
    best = _simplest(judge, chosen, passing)
    if best.key[1] != PARAMETER:
        return [best]
    two = _pair(judge, chosen, [group for group in rivals if group.key[1] == PARAMETER])

    def likely(groups: Sequence[Group]) -> float:
        surprises = (judge.surprise([*chosen, *(one for one in groups if one is not group)], group) for group in groups)
        return judge.gain([*chosen, *groups]) - sum(surprises)

    return two if two and likely(two) > likely([best]) + ALIAS_GAIN else [best]


def _pair(judge: Judge, chosen: Sequence[Group], rivals: Sequence[Group]) -> list[Group]:
    """Return the two that gain most of those that stay beside each other; none where there are no such two.

    A mass and a force constant that are both wrong: each alone is a compromise that recordings speak against.
    """
    now = judge.gain(chosen)
    hopeful = [group for group in rivals if judge.gain([*chosen, group]) - now > judge.threshold_of(chosen, group)]
    standing = [
        list(two)
        for two in itertools.combinations(hopeful, 2)
        if judge.stays([*chosen, two[0]], two[1])
        and judge.stays([*chosen, two[1]], two[0])
        and judge.foretells(chosen, two)
        and judge.allows([*chosen, *two])
    ]
    return max(standing, key=lambda two: judge.gain([*chosen, *two]), default=[])


def _reshaped_with_one(judge: Judge, chosen: Sequence[Group], rivals: Sequence[Group]) -> list[Group]:
    """Return what leaves no curve when one more friction of a body stands beside those there are, reshaped with it.

    What rises towards standstill stands on a level: alone, its speed is a compromise (22 mm/s for 15), beside which
    the level gained 330 squares of 160 000, too little to stay, and a curve over velocity was left.
    """
    if not judge.leaves_curve(chosen):
        return []
    now = judge.gain(chosen)
    grown = []
    for group in rivals:
        if not has_akin(chosen, group) or judge.gain([*chosen, group]) - now <= judge.threshold_of(chosen, group):
            continue
        anew = judge.reshaped([*chosen, group])
        if not judge.leaves_curve(anew) and judge.allows(anew) and judge.foretold(anew) > judge.foretold(chosen):
            grown.append(anew)
    return max(grown, key=judge.worth, default=[])


def _competed(judge: Judge, chosen: list[Group]) -> list[Group]:
    """Let each hypothesis compete again beside the others: what came first need not be true."""
    for _ in range(2):
        before = [group.key for group in chosen]
        for k in range(len(chosen)):
            rest = [*chosen[:k], *chosen[k + 1 :]]
            rivals = [group for group in judge.rivals(rest) if judge.stays(rest, group)]
            allowed = [group for group in (chosen[k], *rivals) if judge.allows([*rest, group])] or [chosen[k]]
            best = _simplest(judge, rest, allowed)
            if best.key != chosen[k].key or judge.worth([*rest, best]) > judge.worth(chosen) + 1e-6:
                chosen = [*chosen[:k], best, *chosen[k + 1 :]]
        if [group.key for group in chosen] == before:
            break
    return chosen


def _simplest(judge: Judge, beside: Sequence[Group], candidates: Sequence[Group]) -> Group:
    """Return the candidate that is worth most; of those that can't be told from it, one with the least numbers."""
    now = judge.gain(beside)
    gains = {id(group): judge.gain([*beside, group]) - now for group in candidates}
    best = max(candidates, key=lambda group: gains[id(group)] - judge.price() * form(group))
    if best.key[1] == PARAMETER:
        known = [group for group in candidates if group.key[1] == PARAMETER]
        return max(known, key=lambda group: gains[id(group)] - judge.surprise(beside, group))
    excused = _excused_beside(judge, [*beside, best])
    near = [
        group
        for group in candidates
        if group.complexity < best.complexity
        and gains[id(best)] - gains[id(group)] < excused(best, group, gains[id(best)])
    ]
    return max(near, key=lambda group: gains[id(group)] - judge.price() * group.complexity, default=best)


def _excused_beside(judge: Judge, chosen: Sequence[Group]) -> Callable[[Group, Group, float], float]:
    """Return (better, simpler, gain of the better) -> by how much less the simpler one may gain; `chosen` stay.

    Smooth laws are as exact as they come; where no curve is left beside what stays, others are more so than where
    one is. By more than all that is left no law is inexact: bristles that left nothing gained 4700 squares of 10
    million more than Dahl's, and were a level beside those.
    """
    share = ALIAS_SHARE if judge.leaves_curve(chosen) else EXACT_RATIO
    left = judge.left_at_most(chosen)

    def excused(better: Group, simpler: Group, gained: float) -> float:
        ratio = SMOOTH_RATIO if is_smooth(better) and is_smooth(simpler) else share
        return ALIAS_GAIN + min(ratio * gained, left)

    return excused


def _admissible(judge: Judge, start: Sequence[Group]) -> list[Group]:
    """Take hypotheses back, the least useful first, until every amplitude is one that its effect can have.

    And until none gains less than the best of the library does on noise: a contact that seemed soft (491 squares)
    was one whose edges wear, and gained 3 where they had been put.
    """
    chosen = list(start)
    while chosen:
        without = [[other for other in chosen if other is not group] for group in chosen]
        rest = max(without, key=judge.gain)
        (weakest,) = (group for group in chosen if group not in rest)
        least = min(judge.threshold, judge.threshold_of(rest, weakest))
        if judge.allows(chosen) and judge.gain(chosen) - judge.gain(rest) > least:
            break
        chosen = rest
    return chosen


def _without_superfluous(judge: Judge, chosen: list[Group]) -> list[Group]:
    """Take hypotheses back whose loss is too small now, the least useful first."""
    while len(chosen) > 1:
        losses = []
        for group in chosen:
            rest = [other for other in chosen if other is not group]
            losses.append((judge.gain(chosen) - judge.gain(rest), group, rest))
        _, weakest, rest = min(losses, key=lambda row: row[0])
        if judge.stays(rest, weakest):
            return chosen
        chosen = rest
    return chosen


def lacks_a_name(judge: Judge, chosen: Sequence[Group]) -> bool:
    """Tell whether beside some names already a curve explains more than any further name: what is left has none.

    Beside one or two, the curve may be of two effects that follow the same quantity.
    """
    if len(chosen) < NAMES_BESIDE_CURVE_COUNT:
        return False
    now = judge.gain(chosen)
    left = sum(float(s.gram[0, 0]) - s.count for s in judge.source.sums) - judge.gain([])
    least = max(CURVE_GAIN * judge.threshold, MATERIAL_RATIO * max(left, 0.0))
    named = max((judge.gain([*chosen, group]) - now for group in judge.rivals(chosen)), default=0.0)
    return any(judge.gain([*chosen, curve]) - now > max(least, named) for curve in judge.curves)


def _note(judge: Judge, chosen: Sequence[Group], rivals: Sequence[Group]) -> None:
    now = judge.gains(chosen)
    left = judge.reducible(chosen)
    said = []
    for group in rivals:
        gains = judge.gains([*chosen, group])
        said.append(f"{group.key} {gains[0] - now[0]:.0f} / {gains[1] - now[1]:.0f}")
    judge.trace.append(f"left {left[0]:.0f} / {left[1]:.0f}: " + "; ".join(said))
