"""Two laws that are one, and one that is two: what no round in which one name takes another's place comes by. Pure."""

import itertools
from collections.abc import Sequence

from stagectl.gap.judge import ALIAS_GAIN, Judge
from stagectl.gap.kinds import form, is_smooth, shows_at_low_speed
from stagectl.gap.normal_equations import Fold, Group

_HOPEFUL_SHARE = 0.9
"""Of what two laws gain, what one in their place has to gain at a shape of the grid to be searched."""

_PAIRS_COUNT = 3
"""Of names that may replace one, that are searched."""

_PAIR_STARTS_COUNT = 4
"""Shapes of the first of two names, each with the best of the other, from which they are searched."""

_PART_PASSES = 2
"""Times that each of two laws that replace one is searched beside the other."""

PARTS_RATIO = 5e-5
"""Of what bristles gain, what a level and a rise in their place may lose: 1.9e-5 and 2.9e-5 where they were those, on
sets that it is set on. Dahl's in place of others lost 4.7e-4."""


def as_one(judge: Judge, chosen: Sequence[Group]) -> list[Group]:
    """Return two names of a place as one of fewer numbers that can't be told from them.

    An offset and a spring about zero are a cable. No round in which one name takes another's place comes by: beside
    either of them a cable says what the other says, with a number more.
    """
    found = list(chosen)
    for two in itertools.combinations(chosen, 2):
        if two[0].key[1] != two[1].key[1] or two[0].key[1] == "parameter" or any(one not in found for one in two):
            continue
        rest = [group for group in found if group not in two]
        least = judge.worth(found) - ALIAS_GAIN
        whole = [
            one
            for one in _like_both(judge, rest, two)
            if judge.worth([*rest, one]) > least and judge.allows([*rest, one])
        ]
        if whole:
            at = found.index(two[0])
            rest.insert(at, max(whole, key=lambda one: judge.worth([*rest, one])))
            found = rest
    return found


def _like_both(judge: Judge, rest: Sequence[Group], two: tuple[Group, Group]) -> list[Group]:
    """Return names of the same place, of fewer numbers, that may do what two do, each at its best shape."""
    taken = {other.key for other in (*rest, *two)}
    fold = Fold([*judge.base, *rest], judge.source.sums, on_noise=False)
    enough = _HOPEFUL_SHARE * (judge.gain([*rest, *two]) - judge.gain(rest))
    hopeful: dict[tuple[str, str], tuple[float, Group]] = {}
    for group in judge.library:
        if group.key[1] != two[0].key[1] or group.key in taken or form(group) >= sum(map(form, two)):
            continue
        gain = float(fold.added(group)[0])
        if gain > max(enough, hopeful.get(group.key, (0.0, group))[0]):
            hopeful[group.key] = gain, group
    return judge.refine([*judge.base, *rest], [group for _, group in hopeful.values()])


def in_parts(judge: Judge, chosen: Sequence[Group]) -> list[Group]:
    """Return frictions of many numbers as two of fewer that can't be told from them.

    What rises towards standstill on a level is two laws, and bristles that slip by nothing are both of them at
    once. Alone, neither gains what the bristles do: no round in which one name takes another's place comes by.
    """
    found = list(chosen)
    for group in chosen:
        if not shows_at_low_speed(group):
            continue
        rest = [other for other in found if other is not group]
        parts = _two_like(judge, rest, group)
        as_good = judge.worth([*rest, *parts]) > judge.worth(found) - _excused_of_parts(judge, found, group)
        if parts and as_good and judge.allows([*rest, *parts]):
            at = found.index(group)
            found = [*found[:at], *parts, *found[at + 1 :]]  # in its place: a closer look goes by who was there
    return found


def levelled(judge: Judge, chosen: Sequence[Group]) -> list[Group]:
    """Return two levels that a rise towards standstill stands on as one level and a push that can't be told from them.

    Along the motion they are one and the same, of as many numbers; which a search meets first is chance, and a rise is
    stated above one level (1010006: a tilt of 27 deviations beside a Stribeck friction was an asymmetry of its level).
    """
    found = list(chosen)
    for group in chosen:
        place = group.key[1]
        if group.key[0] != "asymmetric_coulomb_friction" or ("stribeck_friction", place) not in {g.key for g in found}:
            continue
        rest = [other for other in found if other is not group]
        taken = {other.key for other in rest}
        levels, pushes = (
            [
                other
                for other in judge.library
                if other.key[1] == place and other.key[0] in names and other.key not in taken
            ]
            for names in (("coulomb_friction",), ("offset", "gravity_tilt"))
        )
        parts = [[level, push] for level, push in itertools.product(levels, pushes)]
        if not parts:
            continue
        best = max(parts, key=lambda two: round(judge.worth([*rest, *two]), 3))  # the first of those that are the same
        as_good = judge.worth([*rest, *best]) > judge.worth(found) - _excused_of_parts(judge, found, group)
        if as_good and judge.allows([*rest, *best]):
            at = found.index(group)
            found = [*found[:at], *best, *found[at + 1 :]]
    return found


def as_two_others(judge: Judge, chosen: Sequence[Group]) -> list[Group]:
    """Return two smooth laws as two others, of one number each, that can't be told from them.

    A tilt and a cable of the macro are a spring of it and an offset of the micro: the same forces, with a number more,
    and no round in which one name takes another's place comes by (1011134).
    """
    found = list(chosen)
    for two in itertools.combinations(chosen, 2):
        if not all(one in found and is_smooth(one) for one in two) or sum(one.complexity for one in two) <= 2:
            continue
        rest = [group for group in found if group not in two]
        taken = {group.key for group in found}
        others = [group for group in judge.library if is_smooth(group) and group.complexity == 1]
        pairs = itertools.combinations([group for group in others if group.key not in taken], 2)
        best = max(pairs, key=lambda pair: judge.gain([*rest, *pair]), default=())
        as_good = judge.gain([*rest, *best]) > judge.gain(found) - ALIAS_GAIN
        if as_good and judge.allows([*rest, *best]):
            found = [*best, *rest]
    return found


def _two_like(judge: Judge, rest: Sequence[Group], group: Group) -> list[Group]:
    """Return the two frictions of the same body, of fewer numbers in all, that gain most, at their best shapes.

    Of some pairs of names, each from the shapes of the grid that gain most, of several shapes of the first: between
    speeds of the grid (5.5 mm/s) a round step and a sharp rise gain most, and end 29 000 squares of 10 million
    below the sharp level and rise that it was.
    """
    taken = {other.key for other in (*rest, group)}
    akin = [
        other
        for other in judge.library
        if other.key[1] == group.key[1] and other.key not in taken and shows_at_low_speed(other)
    ]
    pairs = [
        [one, other]
        for one, other in itertools.combinations(akin, 2)
        if one.key != other.key and form(one) + form(other) < form(group)
    ]
    pairs.sort(key=lambda pair: -judge.worth([*rest, *pair]))
    hopeful: dict[frozenset[tuple[str, str]], dict[tuple[int, ...], list[Group]]] = {}
    for pair in pairs:
        names = frozenset(one.key for one in pair)
        starts = hopeful.get(names, {})
        if (
            (starts or len(hopeful) < _PAIRS_COUNT)
            and len(starts) < _PAIR_STARTS_COUNT
            and pair[0].columns not in starts
            and judge.allows([*rest, *pair])
        ):
            hopeful.setdefault(names, {})[pair[0].columns] = pair
    started = [pair for starts in hopeful.values() for pair in starts.values()]
    for pair in started:
        for _ in range(_PART_PASSES):
            for k in range(2):
                (pair[k],) = judge.refine([*judge.base, *rest, pair[1 - k]], [pair[k]])
    return max(started, key=lambda pair: judge.worth([*rest, *pair]), default=[])


def _excused_of_parts(judge: Judge, chosen: Sequence[Group], group: Group) -> float:
    """Return by how much less than bristles, one of `chosen`, a level and a rise may gain and still be as good.

    As laws they are as exact as smooth ones, up to the speed over which a sign turns, which the grid has: bristles
    that slip by 12 nm gained 47 squares of 2.5 million more than the level and rise that they were, and by 10 nm
    235 of 8 million.
    """
    gained = judge.gain(chosen) - judge.gain([other for other in chosen if other is not group])
    return ALIAS_GAIN + PARTS_RATIO * gained
