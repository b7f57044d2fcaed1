"""Looks at the same recordings: along the motion as believed, then along the motion under what was found so far.

An effect is known along a motion that knows of the effect, and an edge where the joint is. Everything competes again in
each closer look; one more is taken where a name has moved the joint again. Pure.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from stagectl.effects import CATALOGUE, Trait
from stagectl.gap.aliases import aliases_of
from stagectl.gap.competition import Competition
from stagectl.gap.crew import Crew
from stagectl.gap.curvature import at_best_shapes
from stagectl.gap.curves import LATENESS
from stagectl.gap.findings import Alias, Named
from stagectl.gap.innovations import Noise
from stagectl.gap.judge import ALIAS_GAIN, LEFT_SDS, Judge
from stagectl.gap.kinds import form
from stagectl.gap.known_motion import moved_under
from stagectl.gap.left_over import are_exact, excess, unknown_rest
from stagectl.gap.naming import all_named, measured
from stagectl.gap.noise import noise_of
from stagectl.gap.normal_equations import Group, Solution, solve
from stagectl.gap.operating_point import Moved
from stagectl.gap.recording import Recording
from stagectl.gap.selection import MOST_NAMES_COUNT, lacks_a_name, select
from stagectl.gap.settling import (
    Left,
    belief_under,
    is_elsewhere,
    is_of_readings,
    is_taken_at_size,
    left_at_size,
    moved_by,
    moved_now,
    moves_joint,
    moves_readings,
    remeasured,
    stands,
)

_CLOSER_LOOKS = 4
_FORMS_RATIO = 0.02
"""Share of a gain by which laws that move readings may lose as columns and still be better at their sizes."""

_AT_SIZE_RATIO = 2e-4
"""Of a gain, what a law that moves readings is inexact by at its size at most, beside names that are not found yet: of
two scale errors of 244 000 squares that leave the same beside a cable, one left 19 less without it."""

_CURVES_REST_RATIO = 0.5
"""Share of what is left that one curve has to find for it to be that curve's."""


class Look(NamedTuple):
    """Who competed, who stayed, and what that is in words."""

    search: Competition
    chosen: list[Group]
    named: tuple[Named, ...]
    solution: Solution | None = None
    belief: Judge | None = None  # of what the belief leaves, in units of this look's noise


class _Case(NamedTuple):
    """What every look at the same recordings is taken of."""

    first: Competition
    unsettled: Sequence[Recording]  # before the joint's edges were put where they are
    without: frozenset[str]
    crew: Crew


class _Course(NamedTuple):
    """What the next look is taken under, and what was learnt on the way there."""

    known: Look
    plain: Look  # what is told in the first competition
    compared: frozenset[tuple[str, str]]  # beside which names the forms of what moves readings were told apart
    noise: dict[str, Noise]  # and above which
    moved: tuple[Moved, ...] = ()
    refused: frozenset[tuple[str, str]] = frozenset()


def looked_closely(
    first: Competition,
    unsettled: Sequence[Recording],
    without: frozenset[str],
    say: Callable[[str], None],
    crew: Crew,
) -> Look:
    """Return the closer look at what stays in the first competition; the first look where nothing does.

    unsettled: the recordings before the joint's edges were put where they are.
    """
    case = _Case(first, unsettled, without, crew)
    found = select(first.judge, until=lambda group: moves_joint(first, group))
    look = _told_anew(Look(first, found, all_named(first, found)), unsettled, crew)
    told, is_unknown = _followed(case, look, say)
    if is_unknown and (other := _late_in_another_way(look)) is not None:
        again, is_still_unknown = _followed(case, other, say)
        told = told if is_still_unknown else again
    return _measured(told)._replace(belief=told.belief)


def _followed(case: _Case, look: Look, say: Callable[[str], None]) -> tuple[Look, bool]:
    """Return the closest look that is taken from a first one, and whether it leaves what has no name."""
    course = _Course(look, look, _keys(look), case.first.noise)
    for _ in range(_CLOSER_LOOKS):
        if not course.known.chosen and not course.moved:
            break
        say("once more, along the motion and at the place where the joint is now known to be")
        look, at_size = _taken(case, course)
        if _is_unknown(case, look):
            break  # no further look gives it a name
        look, further = _without_nothing(case, course, look, at_size) or _further(case, course, look)
        if further is None:
            break
        course = further
    belief = belief_under(case.first, look.search, case.crew)
    rest = unknown_rest(look.search, look.chosen, excess(belief, []))
    if rest is not None and _has_reached_floor(course.plain, look, rest):
        plain = _as_of_exact_laws(course.plain) if are_exact(look.search, look.chosen) else course.plain
        return plain._replace(belief=case.first.judge), False
    return look._replace(belief=belief), rest is not None


def _late_in_another_way(look: Look) -> Look | None:
    """Return a first look in which a late reading is late by the other law; None where there is none that may be.

    What is left behind one law may be what the other lacks: a sensor's lag of 252 us beside commands 134 us late was a
    delay of 290 us, by 50 squares of 8000, beside which no delay of the commands was the same in all recordings.
    """
    search = look.search
    for k, group in enumerate(look.chosen):
        if not (moves_readings(search, group) and _are_late(group.key[0])):
            continue
        rest = [*look.chosen[:k], *look.chosen[k + 1 :]]
        for other in search.judge.rivals(rest):
            if _are_late(other.key[0]) and other.key[1] == group.key[1] and other.key != group.key:
                chosen = [*look.chosen[:k], other, *look.chosen[k + 1 :]]
                return Look(search, chosen, all_named(search, chosen))
    return None


def _are_late(*names: str) -> bool:
    return all(name in CATALOGUE and Trait.LATE_READING in CATALOGUE[name].traits for name in names)


def _has_reached_floor(plain: Look, look: Look, rest: dict[str, Any]) -> bool:
    """Tell whether the first look leaves nothing unknown, and less than a closer one with this rest.

    Edges that wear were a wider gap to it, of which it left 1294 squares; along the motion under that 1116 were left,
    and how fast the joint closes found 635 of them. Above more noise than there is in the closer look it says nothing
    of a curve's rest: others, 22 um further out, had left 16 mN of force noise, and above that 8600 squares too few;
    of 1200 that were left where they are, a curve over time found all. Of what laws are inexact by none finds much:
    beside a friction along its own motion 500 of 21 700. What laws leave that are exact in the closer look is no
    force noise of the first one: under that a Dahl friction in the place of bristles left 28 600 of 7.8 million.
    Whether what is late is spread out it is not asked, as nothing is late in it.
    """
    if rest.get("over") == LATENESS:
        return False
    if _is_quieter(look.search.noise, plain.search.noise) and rest["gain"] > _CURVES_REST_RATIO * rest["left"]:
        return False
    left, first = excess(plain.search.judge, plain.chosen), excess(plain.search.judge, [])
    if not left < excess(look.search.judge, look.chosen):
        return False
    return unknown_rest(plain.search, plain.chosen, first, are_exact(look.search, look.chosen)) is None


def _as_of_exact_laws(plain: Look) -> Look:
    """Return a first look without aliases that are some for its force noise alone, of which a closer look found none.

    Above the 4 mN that an asymmetric friction seemed to make, a symmetric one lost 110 000 squares and was its alias.
    """
    judge, named = plain.search.judge, []
    exact = replace(judge, is_rough=False)
    for one in plain.named:
        group = next((group for group in plain.chosen if group.key == (one.name, one.acts_on)), None)
        if group is not None:
            found, stay = (dict(aliases_of(of, plain.chosen, group)) for of in (judge, exact))
            gone = found.keys() - stay.keys()
            one = replace(one, aliases=tuple(alias for alias in one.aliases if alias[:2] not in gone))
        named.append(one)
    return plain._replace(named=tuple(named))


def _taken(case: _Case, course: _Course) -> tuple[Look, tuple[Named, ...]]:
    """Return the next look, and those of its names that are part of the operating point."""
    search = _under(course.known, course.moved, case.first, case.unsettled, case.without, course.refused, case.crew)
    chosen = select(search.judge, search.judge.reshaped(search.kept), until=lambda group: group.is_slope)
    solution = solve([*search.judge.base, *chosen], search.evidence.sums)
    at_size = remeasured(search, solution, course.known.named, search.moved) if search.moved else ()
    return Look(search, chosen, at_size + all_named(search, chosen)), at_size


def _is_unknown(case: _Case, look: Look) -> bool:
    """Tell whether what is left lacks a name, with the joint in its place.

    Or has more of them than a competition lets stand, in all: in the place of a base that shakes, two dead bands, two
    late sensors and a late drive stood at their sizes, five more beside them, and each look had found others.
    """
    search, chosen = look.search, look.chosen
    lacks = lacks_a_name(search.judge, chosen) and not any(moves_joint(search, group) for group in chosen)
    lacks = lacks or len(chosen) + len(search.moved) > MOST_NAMES_COUNT
    return lacks and unknown_rest(search, chosen, excess(belief_under(case.first, search, case.crew), [])) is not None


_Told = tuple[Look, _Course | None]
"""A look as it is told, and what the next one is taken under; None where it is the last."""


def _without_nothing(case: _Case, course: _Course, look: Look, at_size: tuple[Named, ...]) -> _Told | None:
    """Return the look before, without what at its size is nothing; None where all of it is something.

    The look itself where nothing else was found before: a centre of the joint was 0.3 um where it was put, beside the
    drift that it had been 6 um of, and the drift was lost with it.
    """
    before = course.known
    gone = {(one.name, one.acts_on) for one in at_size if not stands(one, look.search.evidence.recordings[0])}
    if not gone:
        return None
    is_first = before.search is case.first
    left, here = _without(before, gone), _without(look, gone)
    known = left
    if here.chosen and not left.chosen:
        known = _in_place_of_all(case.first, here) if is_first else here
    return known, course._replace(
        known=known,
        plain=left if is_first else course.plain,
        moved=tuple(one for one in course.moved if (one[0].name, one[1]) not in gone),
        refused=course.refused if is_first else course.refused | gone,
    )


def _in_place_of_all(first: Competition, look: Look) -> Look:
    """Return the names of a closer look as all of the first competition, with the aliases that they have there."""
    told = _told_in(first, [], [group.key for group in look.chosen])
    if told is None:
        return look
    aliases = {(one.name, one.acts_on): one.aliases for one in look.named}
    named = tuple(replace(one, aliases=aliases.get((one.name, one.acts_on), one.aliases)) for one in told.named)
    return told._replace(named=named)


def _without(look: Look, gone: Collection[tuple[str, str]]) -> Look:
    left = [group for group in look.chosen if group.key not in gone]
    return Look(look.search, left, tuple(one for one in look.named if (one.name, one.acts_on) not in gone))


def _further(case: _Case, course: _Course, look: Look) -> _Told:
    """Return how a look is told, and what the next one is taken under where it has to be another one."""
    search, chosen = look.search, look.chosen
    is_at_size = any(is_taken_at_size(search, group) for group in chosen)
    if any(group.is_slope for group in chosen):
        return _at_their_sizes(case, course, look)
    if _is_otherwise(look, course.known) or is_elsewhere(search, chosen):
        return look, course._replace(known=look, moved=moved_now(search, chosen))
    if _keys(look) > course.compared or _is_quieter(search.noise, course.noise):
        anew = _again_in(case.first, course.plain, look, case.unsettled, case.crew)
        if anew is not None:
            course = course._replace(compared=_keys(look), noise=search.noise)
            if _keys(anew) != course.compared:
                return anew, course._replace(known=anew, plain=anew, moved=())
            look = _with_forms_of(look, anew)
            return look, course._replace(known=look, moved=moved_now(search, chosen)) if is_at_size else None
    return _at_their_sizes(case, course, look) if is_at_size else (look, None)


def _is_quieter(noise: dict[str, Noise], before: dict[str, Noise]) -> bool:
    """Tell whether a body has less force noise than it seemed to have, above which forms were told apart.

    Beside bristles that nobody had named yet a lag left 22 squares less than the delay of 138 us that there was; above
    the noise of the next look it leaves 115 more.
    """
    return any(level.white_force_n < before[axis].white_force_n for axis, level in noise.items())


def _at_their_sizes(case: _Case, course: _Course, look: Look) -> _Told:
    """Return a look told anew, under which all is at its size."""
    told = _told_anew(look, case.unsettled, case.crew)
    return told, course._replace(known=told, moved=moved_now(look.search, told.chosen))


_ALONG_ITSELF = frozenset({Trait.FIRST_ORDER, Trait.SWINGS})
"""Effects that are known along readings or motion without themselves, so that a look depends on the one before."""


def _is_otherwise(look: Look, before: Look) -> bool:
    """Tell whether such an effect has another size than in the look before, by more than its deviation.

    A cyclic error of 18 nm was 16 nm in the first look. A share of the mass that swings is driven by what known
    parameters and other effects make of the axis, as large as they were found beside it.
    """
    sizes = {(one.name, one.acts_on): one for one in before.named if _ALONG_ITSELF & CATALOGUE[one.name].traits}
    return any(
        abs(one.parameters[name] - sizes[one.name, one.acts_on].parameters.get(name, 0.0)) > sd
        for one in look.named
        if (one.name, one.acts_on) in sizes
        for name, sd in one.sds.items()
    )


def _told_anew(look: Look, unsettled: Sequence[Recording], crew: Crew) -> Look:
    """Return a look with names that stand at their sizes, and what moves readings as the law that leaves least."""
    return _of_best_form(_told_at_size(look, unsettled, crew), unsettled, crew)


def _of_best_form(look: Look, unsettled: Sequence[Recording], crew: Crew, closer: Look | None = None) -> Look:
    """Return a look with what moves readings as the law that leaves least at its size; delay and lag begin alike.

    Columns that are no more than beginnings tell them apart by more than that: beside bristles a lag gained 36 squares
    of 14 200 more than the delay of 138 us that there was, beside a drift a delay 24 of 10 900 more than a lag of
    174 us. So the one that was chosen has no advantage, but that of fewer numbers. closer: another look
    at the same names, above whose noise they are told apart and whose sizes they begin with, if not the look's own.
    """
    search, chosen, named = look.search, list(look.chosen), look.named
    for k, group in enumerate(look.chosen):
        if not moves_readings(search, group):
            continue
        told_closer = () if closer is None else _aliases_in_readings(closer, group.key)
        own = (alias for one in named if (one.name, one.acts_on) == group.key for alias in one.aliases)
        rest = [*chosen[:k], *chosen[k + 1 :]]
        gained = search.judge.gain(chosen) - search.judge.gain(rest)
        forms = _forms_of(search, rest, group, gained, {alias[:2] for alias in (*own, *told_closer)})
        models = [[*rest, one] for one in forms] if len(forms) > 1 else []
        left = _left_under(search, models, unsettled, crew, closer)
        prices = [search.judge.price() * form(one) for one in forms]
        best = min(range(len(left)), key=lambda j: left[j].squares + prices[j], default=0)
        gone = {
            one.key
            for one, more in zip(forms, left, strict=False)
            if more.squares - left[best].squares > ALIAS_GAIN + _AT_SIZE_RATIO * gained + _scatter(more, left[best])
        }
        chosen[k] = forms[best]
        also = [alias for alias in told_closer if not best and alias[:2] in {one.key for one in forms}]
        told = _named_as(look, chosen, k, gone, also)
        named = (*(one for one in named if (one.name, one.acts_on) != group.key), *told)
    return Look(search, chosen, named)


def _forms_of(
    search: Competition, rest: list[Group], group: Group, gained: float, stated: Collection[tuple[str, str]]
) -> list[Group]:
    """Return a name that moves readings, and what gains nearly as much as its column, or is `stated` as its alias.

    gained: by the name beside the `rest`.
    """
    least = search.judge.gain([*rest, group]) - max(ALIAS_GAIN, _FORMS_RATIO * gained)
    others = (other for other in search.judge.rivals(rest) if _is_other_form(search, group, other, stated))
    return [group, *(one for one in others if one.key in stated or search.judge.gain([*rest, one]) > least)]


def _is_other_form(search: Competition, group: Group, other: Group, stated: Collection[tuple[str, str]] = ()) -> bool:
    """Tell whether two names move readings, by one law or at one place, or where one is `stated` as an alias.

    A scale error of 1080 ppm that was looked for without the joint at its place gained 421 squares of 207 000 more than
    one of the other sensor: as much as laws may be inexact by. Each at its size, they are no less exact than others.
    """
    near = other.key[0] == group.key[0] or other.key[1] == group.key[1] or other.key in stated
    return moves_readings(search, other) and near and other.key != group.key


def _told_at_size(look: Look, unsettled: Sequence[Recording], crew: Crew) -> Look:
    """Return a look without a name that, as it was chosen, was no better than one that leaves less at its size.

    What moves readings puts the joint elsewhere, which its column says nothing of: a scale error of 0.19 % was worth 3
    squares more than the spring of 1.1 N/m that there was, and put the joint 109 um and 12 000 squares off. What was
    chosen beside it is to be found anew. What would not have stayed in its place is none of them: a rise that a
    sub-linear friction is inexact by gained 400 squares where a lag of the sensor gained 240. Noise and samples that
    one alone tells of may both favour a wrong one: of a gap 4.5 um wider than stated a soft contact left 11 squares
    less (1010218).
    """
    search, judge = look.search, look.search.judge
    for k, group in enumerate(look.chosen):
        before = look.chosen[:k]
        least = judge.gain([*before, group]) - ALIAS_GAIN
        forms = [group]
        for other in judge.passing(before):
            told = moves_readings(search, group) or moves_readings(search, other)
            known = "parameter" in (group.key[1], other.key[1]) or other.key == group.key
            if told and not known and not _is_other_form(search, group, other) and judge.gain([*before, other]) > least:
                forms.append(other)
        left = _left_under(search, [[*before, form] for form in forms], unsettled, crew) if len(forms) > 1 else []
        best = min(range(len(left)), key=lambda j: left[j].squares, default=0)
        if best and left[0].squares - left[best].squares > ALIAS_GAIN + _scatter(left[0], left[best]):
            chosen = [*before, forms[best]]
            return Look(search, chosen, _at_size(look) + all_named(search, chosen))
    return look


def _scatter(one: Left, other: Left) -> float:
    """Return by how much noise makes two rests differ where the joint is elsewhere, and other samples tell of it."""
    return LEFT_SDS * float(np.sqrt(2.0 * abs(one.count - other.count)))


def _keys(look: Look) -> frozenset[tuple[str, str]]:
    at_size = {(effect.name, place) for effect, place, _ in look.search.moved}
    return frozenset(group.key for group in look.chosen) | at_size


def _again_in(first: Competition, plain: Look, look: Look, unsettled: Sequence[Recording], crew: Crew) -> Look | None:
    """Return all names of a look in the first competition, where what moves readings is of the form that leaves least.

    None where nothing that was found at first moves readings, or a name is none of the first competition's. A sensor's
    delay of 0.25 ms and a lag of it were 14 squares apart as long as nobody had named the 89 us that the commands are
    late besides, and 1 with that. All of them stay: without a wear of 890 squares, in whose place a spring that was
    found beside it left less, the true delay was 9 squares behind a lag, and no name for it.
    """
    if not any(moves_readings(first, group) for group in plain.chosen):
        return None
    known = _told_in(first, [group for group in plain.chosen if group.key in _keys(look)], _keys(look))
    return known and _of_best_form(known, unsettled, crew, look)


def _told_in(first: Competition, start: Sequence[Group], keys: Collection[tuple[str, str]]) -> Look | None:
    """Return all names of `keys` in the first competition, `start` as it is; None where one is none of that."""
    chosen = list(start)
    for key in sorted(set(keys) - {group.key for group in chosen}):
        shapes = [group for group in first.judge.library if group.key == key]
        if not shapes:
            return None
        chosen.append(max(shapes, key=lambda group: first.judge.gain([*chosen, group])))
    chosen = first.judge.reshaped(chosen)
    return Look(first, chosen, all_named(first, chosen))


def _aliases_in_readings(look: Look, key: tuple[str, str]) -> tuple[Alias, ...]:
    found = (alias for one in look.named if (one.name, one.acts_on) == key for alias in one.aliases)
    return tuple(alias for alias in found if is_of_readings(alias[1]))


def _with_forms_of(look: Look, other: Look) -> Look:
    """Return a look in which what moves readings has the forms that it has in another look of the same names.

    Of what else would do as well the closer look says more: in the first one, beside a clock 0.7 ppm off, a lag of
    62 us was 8 us and no other than a delay of either drive.
    """
    moving = {group.key for group in other.chosen if moves_readings(other.search, group)}
    named = []
    for one in look.named:
        own = [alias for alias in one.aliases if not is_of_readings(alias[1])]
        there = _aliases_in_readings(other, (one.name, one.acts_on))
        told = tuple(sorted([*own, *there], key=lambda alias: alias[2]))
        named.append(replace(one, aliases=told) if (one.name, one.acts_on) in moving else one)
    return look._replace(named=tuple(named))


def _named_as(
    look: Look, chosen: list[Group], k: int, gone: set[tuple[str, str]], also: Sequence[Alias]
) -> tuple[Named, ...]:
    """Return one of `chosen` in words, with what is its alias elsewhere `also`, without the aliases that are `gone`."""
    return tuple(
        replace(one, aliases=tuple(alias for alias in _in_either(one.aliases, also) if alias[:2] not in gone))
        for one in all_named(look.search, chosen)
        if (one.name, one.acts_on) == chosen[k].key
    )


def _in_either(own: Sequence[Alias], also: Sequence[Alias]) -> tuple[Alias, ...]:
    known = {alias[:2] for alias in own}
    return (*own, *(alias for alias in also if alias[:2] not in known))


def _left_under(
    search: Competition,
    models: Sequence[list[Group]],
    unsettled: Sequence[Recording],
    crew: Crew,
    closer: Look | None = None,
) -> list[Left]:
    """Return what models leave above the noise of the first, with all that moves the joint at its size.

    closer: the look above whose noise and from whose sizes on. From where a soft contact of 23 um was 20 um and a
    scale error of 134 ppm 17, beside a delay the way to those led elsewhere, and 77 000 squares were left.
    """
    found: list[Left] = []
    scales = None
    noise = search.noise if closer is None else closer.search.noise
    for chosen in models:
        moving = [group for group in chosen if is_taken_at_size(search, group)]
        moved = (*moved_now(search, chosen), *(moved_by(search, chosen, group) for group in moving))
        beside = tuple(search.term(group) for group in chosen if group not in moving)
        if closer is not None:
            moved = tuple(_as_large_as(closer, one, models[0][-1].key) for one in moved)
            shapes = {group.key: closer.search.term(group) for group in closer.chosen}
            beside = tuple(shapes.get(term.key, term) for term in beside)
        left = left_at_size(unsettled, noise, moved, beside, crew, scales)
        scales = scales or left.scales
        found.append(left)
    said = [f"{chosen[-1].key} leaves {left.squares:.0f}" for chosen, left in zip(models, found, strict=True)]
    if said:
        search.judge.trace.append("at their sizes: " + "; ".join(said))
    return found


def _as_large_as(closer: Look, one: Moved, instead_of: tuple[str, str]) -> Moved:
    """Return an effect as large as a closer look has it, or has the one in whose place it stands by the same number."""
    effect, place, values = one
    sizes = {
        (told.name, told.acts_on): told.parameters[CATALOGUE[told.name].parameters[0]]
        for told in closer.named
        if CATALOGUE[told.name].parameters[0] in told.parameters
    }
    size = sizes.get((effect.name, place))
    if size is None and (effect.name == instead_of[0] or _are_late(effect.name, instead_of[0])):
        size = sizes.get(instead_of)
    first = effect.parameters[0]
    return one if size is None else (effect, place, {**values, first: float(np.copysign(size, values[first]))})


def _measured(look: Look) -> Look:
    """Return a look with every shape at its best, and deviations that hold what shapes are uncertain by."""
    search = look.search
    chosen, solution = at_best_shapes(search, look.chosen)
    named = measured(search, chosen, solution, look.named)
    at_size = _at_size(look._replace(named=named))
    others = tuple(one for one in named if one not in at_size)
    return Look(search, chosen, remeasured(search, solution, at_size, search.moved) + others, solution)


def _at_size(look: Look) -> tuple[Named, ...]:
    """Return the names of a look that are part of its operating point."""
    moved = {(effect.name, place) for effect, place, _ in look.search.moved}
    return tuple(one for one in look.named if (one.name, one.acts_on) in moved)


def _under(
    known: Look,
    moved: tuple[Moved, ...],
    first: Competition,
    unsettled: Sequence[Recording],
    without: frozenset[str],
    refused: frozenset[tuple[str, str]],
    crew: Crew,
) -> Competition:
    """Make the competition along the motion that known effects make, at the place where they put the joint."""
    motion = moved_under(known.chosen, moved, known.search, unsettled, crew)
    search = Competition(
        motion.recordings,
        first.judge.training_count,
        without=without,
        refused=refused,
        moved=motion.moved,
        kept=motion.kept,
        noise=noise_of(motion.recordings, motion.explained, first.noise),
        crew=crew,
    )
    search.judge.threshold, search.judge.trace = first.judge.threshold, first.judge.trace
    search.judge.is_closer = True
    if motion.moved:  # in units of this noise: of a clock of 495 million squares the look before knew 1.5 million
        search.judge.at_size = max(excess(belief_under(first, search, crew), []), 0.0)
    return search
