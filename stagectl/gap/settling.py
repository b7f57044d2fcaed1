"""Where the joint is: its edges, and the effects that move them or the readings, put where the recordings have them.

What an effect of the joint does is known to first order only, so recordings are taken anew at the place that was found.
Pure.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from stagectl.effects import CATALOGUE, Trait
from stagectl.gap import balance, hypotheses
from stagectl.gap.believed import Believed
from stagectl.gap.competition import Competition
from stagectl.gap.contact import CONTACT_DAMPING, contact_damping_n_s_per_m
from stagectl.gap.crew import Crew, Serial
from stagectl.gap.evidence import Evidence, Scales
from stagectl.gap.findings import Named
from stagectl.gap.hypotheses import DEVIATION_SD, Term, widest_amplitudes
from stagectl.gap.innovations import Noise
from stagectl.gap.judge import Judge
from stagectl.gap.normal_equations import Group, Solution, solve
from stagectl.gap.operating_point import Moved, operating_point, with_joint_changed
from stagectl.gap.recording import Recording
from stagectl.gap.refinement import LATCH_SDS, power_of_size, whole_of
from stagectl.gap.scatter import INEXACT_RATIO

_EDGE_PASSES = 3
_PASSES_BESIDE = 6  # a knee and an edge pull at each other
_MOST_PASSES = 24
_SETTLED_RATIO = 0.002  # of a size, and
_SETTLED_SDS = 0.5  # of its deviation: it stands where a pass changes it by no more than the larger one
_ELSEWHERE_SDS = 3.0
_EDGE_SDS = 2.0
_LEAST_SDS = 5.0
_DAMPING = f"{CONTACT_DAMPING} on contact"


def settled(
    recordings: Sequence[Recording],
    noise: dict[str, Noise],
    moved: tuple[Moved, ...] = (),
    beside: Sequence[Term] = (),
    crew: Crew | None = None,
) -> tuple[Sequence[Recording], tuple[Moved, ...], Sequence[Term]]:
    """Put the joint, and effects that move it, where the recordings have them; returns all of it as it is then.

    beside: what else is thought to act, at the size that it has then. A soft contact of 25 um pulled at both
    edges by 2 um where it was left out.

    What an edge does is known to first order only: half a micrometre of error left 30 squares of the noise, which an
    edge that moves at its size then explained in machines without any fault. So it is with the contact's damping, which
    decides where a contact lets go: 16 % too little of it made a knee of 24 um one of 27. None goes further than is
    stated.

    Passes go on as long as a size still changes: beside a soft contact of 23 um a scale error of 134 ppm was 93 ppm
    after six of them and is where it belongs after seventeen; in between an Abbe error was named for the rest.
    """
    if not moved and not touches(recordings):
        return recordings, moved, beside
    crew = crew or Serial()
    out = {"left_m": 0.0, "right_m": 0.0, _DAMPING: 0.0}
    there = recordings
    least = _PASSES_BESIDE if beside or _lets_go(moved) else _EDGE_PASSES
    for number in range(_MOST_PASSES):
        there = crew.here(partial(_put, out, moved), recordings)
        parameters = hypotheses.parameter_terms(there[0])
        base, solution, _ = _fitted(there, noise, moved, beside, crew)
        effects = base[len(parameters) :]
        is_last = number + 1 >= least and not _still_changes(solution, effects, moved, beside)
        moved = tuple(
            _changed(one, float(solution.of(group)[0][0])) for one, group in zip(moved, effects, strict=False)
        )
        beside = [
            _resized(term, float(np.mean(solution.of(group)[0])), there)
            for term, group in zip(beside, effects[len(moved) :], strict=True)
        ]
        for (term, sd), group in zip(parameters, base[: len(parameters)], strict=True):
            if term.name in out:
                change = float(solution.of(group)[0][0])
                out[term.name] = float(np.clip(out[term.name] + change, -_EDGE_SDS * sd, _EDGE_SDS * sd))
        if is_last:
            break
    if not moved and max(abs(out["left_m"]), abs(out["right_m"])) >= _EDGE_SDS * _edge_sd_m(there[0]):
        return recordings, moved, beside  # something else pulls at them
    return crew.here(partial(_put, out, moved), recordings), moved, beside


def _still_changes(
    solution: Solution, effects: Sequence[Group], moved: Sequence[Moved], beside: Sequence[Term]
) -> bool:
    """Tell whether a size was just found to be another one, by more than its deviation lets it be."""
    sized = [(group, 0.0) for group, _ in zip(effects, moved, strict=False)]
    sized += [
        (group, 1.0)
        for group, term in zip(effects[len(moved) :], beside, strict=True)
        if not (term.linear or term.acts_on == "parameter")
    ]
    found = [(solution.of(group), share) for group, share in sized]
    return any(
        abs(float(np.mean(value)) - share) > max(_SETTLED_RATIO, _SETTLED_SDS * float(np.mean(sd)))
        for (value, sd), share in found
    )


def _lets_go(moved: tuple[Moved, ...]) -> bool:
    return any(place == "contact" for _, place, _ in moved)


def _fitted(
    recordings: Sequence[Recording],
    noise: dict[str, Noise],
    moved: tuple[Moved, ...],
    beside: Sequence[Term],
    crew: Crew,
    scales: Scales | None = None,
) -> tuple[list[Group], Solution, Evidence]:
    """Fit known parameters, sizes of what has moved the joint, and what acts beside."""
    crew.here(lambda recording: balance.set_noise(recording, noise), recordings)
    evidence = Evidence(recordings, crew)
    parameters = hypotheses.parameter_terms(recordings[0])
    terms = [*(term for term, _ in parameters), *(hypotheses.deviation_term(*one) for one in moved), *beside]
    sds = [(sd,) for _, sd in parameters] + [(DEVIATION_SD,)] * len(moved)
    sds += [widest_amplitudes(term) for term in beside]
    base = [
        Group(term.key, columns, term.scope, prior, term.bounds)
        for term, columns, prior in zip(terms, evidence.add_all(terms), sds, strict=True)
    ]
    evidence.finish(np.concatenate(sds), 0, 0, scales)
    return base, solve(base, evidence.sums), evidence


class Left(NamedTuple):
    """What a model leaves above the noise, in squares of it, of how many samples, and that noise."""

    squares: float
    count: int
    scales: Scales


def left_at_size(
    recordings: Sequence[Recording],
    noise: dict[str, Noise],
    moved: tuple[Moved, ...],
    beside: Sequence[Term],
    crew: Crew,
    scales: Scales | None = None,
) -> Left:
    """Return what is left above the noise where all of `moved` is where the recordings have it.

    scales: the noise of another that this is compared with. Each beside its own, two that nobody can tell apart were
    14 squares apart: of 80 000 samples, a noise that came out 1e-4 smaller.
    """
    there, moved, beside = settled(recordings, noise, moved, beside, crew)
    _, solution, evidence = _fitted(there, noise, moved, beside, crew, scales)
    squares = sum(float(s.gram[0, 0]) - s.count for s in evidence.sums) - solution.gain
    return Left(squares, round(sum(s.count for s in evidence.sums)), evidence.scales)


def belief_under(first: Competition, search: Competition, crew: Crew) -> Judge:
    """Return the judge of what the belief alone leaves, above the noise that a closer look found and in units of it.

    What nobody has explained yet looks like noise: of a cyclic error of 7 nm, 618 000 squares of the sensor's noise,
    224 were left above what was taken for it in the first look.
    """
    if search is first:
        return first.judge
    recordings = first.evidence.recordings
    base, _, evidence = _fitted(recordings, search.noise, (), (), crew, search.evidence.scales)
    crew.here(lambda recording: balance.set_noise(recording, first.noise), recordings)  # as they were
    return replace(first.judge, source=evidence, base=base, library=[], curves=[])


def _put(out: dict[str, float], moved: tuple[Moved, ...], recording: Recording) -> Recording:
    """Return a recording with a joint that is changed, and with effects that move it taken out."""
    there = with_joint_changed(recording, out["left_m"], out["right_m"], out[_DAMPING])
    return operating_point(there, moved) if moved else there


def settled_by(believed: Believed, recording: Recording) -> dict[str, float]:
    """Return by how much a recording's joint was changed from what is believed, by the names of known parameters."""
    joint, there = believed.joint, recording.believed.joint
    if joint is None or there is None:
        return {}
    found = {name: getattr(there, name) - getattr(joint, name) for name in ("left_m", "right_m")}
    damping = contact_damping_n_s_per_m(believed.effects)
    if damping > 0.0:
        found[_DAMPING] = contact_damping_n_s_per_m(recording.believed.effects) / damping - 1.0
    return found


def _edge_sd_m(recording: Recording) -> float:
    """Return how well an edge is believed to be known, m."""
    joint = recording.believed.joint
    return np.inf if joint is None else joint.width_sd_m


def _resized(term: Term, share: float, recordings: Sequence[Recording]) -> Term:
    """Return a term that is taken at its size at the size that was found.

    A force constant that saturates loses with the inverse square of its size: resized in proportion, a share of 1.01
    became 1.03, and after six passes 155 N had become 651 N.
    """
    if term.linear or term.acts_on == "parameter":
        return term
    effect = CATALOGUE[term.name]
    size = effect.parameters[0]
    low, high = effect.bounds[size]
    share = float(np.clip(share, 1.0 - DEVIATION_SD, 1.0 + DEVIATION_SD))
    return hypotheses.term_at_size(
        effect, term.acts_on, {**term.shape, size: float(np.clip(_grown(term, share, recordings), low, high))}
    )


def _grown(term: Term, share: float, recordings: Sequence[Recording]) -> float:
    """Return the size at which an effect does `share` times what it does."""
    size = term.shape[CATALOGUE[term.name].parameters[0]]
    return size * max(share, 0.0) ** (1.0 / power_of_size(term, recordings))


def _changed(moved: Moved, ratio: float) -> Moved:
    effect, place, values = moved
    first = effect.parameters[0]
    return effect, place, {**values, first: values[first] * (1.0 + float(np.clip(ratio, -DEVIATION_SD, 1.0)))}


def touches(recordings: Sequence[Recording]) -> bool:
    """Tell whether the joint is ever believed to be in contact."""
    return any(r.side is not None and bool(np.any(r.side)) for r in recordings)


def moves_joint(search: Competition, group: Group) -> bool:
    """Tell whether an effect puts the joint elsewhere: what was learnt of contact has to be learnt again."""
    return touches(search.evidence.recordings) and moves_readings(search, group)


def moves_readings(search: Competition, group: Group) -> bool:
    """Tell whether an effect puts readings or edges elsewhere by more than a column says."""
    term = search.term(group)
    return whole_of(term) and is_of_readings(term.acts_on)


def is_of_readings(acts_on: str) -> bool:
    """Tell whether what acts there puts readings or edges elsewhere."""
    return acts_on.endswith(("_sensor", "contact_edge"))


def is_taken_at_size(search: Competition, group: Group) -> bool:
    """Tell whether what an effect does at its size is where everything else is learnt anew."""
    return any(tells(search, group) for tells in (moves_readings, _changes_commands, _decides_letting_go))


def _changes_commands(search: Competition, group: Group) -> bool:
    """Tell whether an effect changes by more than a column says what a drive makes of its commands.

    Taken for known, the drive's own delay and lag are uncertain where they then are: their columns and that of the
    effect are one and the same there, and its interval is no narrower than what is stated of the drive.
    """
    term = search.term(group)
    return whole_of(term) and term.acts_on.endswith("_command")


def _decides_letting_go(search: Competition, group: Group) -> bool:
    """Tell whether an effect decides where a contact lets go, and what an edge or a late reading is worth there.

    Along the contact as believed, without damping, one of 132 N s/m came out 1.1 % off at a stated 0.33 %, and an edge
    by 4.6 deviations.
    """
    term = search.term(group)
    return (term.name, term.acts_on) == (CONTACT_DAMPING, "contact") and touches(search.evidence.recordings)


def moved_by(search: Competition, chosen: list[Group], group: Group) -> Moved:
    """Return an effect at its fitted size, sessions pooled."""
    term = search.term(group)
    values, sds = solve([*search.judge.base, *chosen], search.evidence.sums).of(group)
    share = float(np.average(values, weights=1.0 / np.maximum(sds, 1e-300) ** 2))
    effect = CATALOGUE[term.name]
    first = effect.parameters[0]
    return effect, term.acts_on, {**term.shape, first: share * term.shape.get(first, 1.0)}


def moved_now(search: Competition, chosen: list[Group]) -> tuple[Moved, ...]:
    """Return the effects that are part of the operating point at the sizes that they have beside `chosen`."""
    solution = solve([*search.judge.base, *chosen], search.evidence.sums)
    first = len(search.parameters)
    return tuple(
        _changed(one, float(solution.of(group)[0][0]))
        for one, group in zip(search.moved, search.judge.base[first : first + len(search.moved)], strict=True)
    )


def is_elsewhere(search: Competition, chosen: list[Group]) -> bool:
    """Tell whether an effect of the operating point is found to be of another size beside `chosen` than it has there.

    Beside a friction that was another one a clock of 33 ppm was taken for 34.5, and the drive's delay was lost in that.
    """
    solution = solve([*search.judge.base, *chosen], search.evidence.sums)
    first = len(search.parameters)
    deviations = [solution.of(group) for group in search.judge.base[first : first + len(search.moved)]]
    return any(abs(value[0]) > max(_SETTLED_RATIO, _ELSEWHERE_SDS * sd[0]) for value, sd in deviations)


def remeasured(
    search: Competition, solution: Solution, named: tuple[Named, ...], moved: tuple[Moved, ...]
) -> tuple[Named, ...]:
    """Return the effects that moved the joint with the sizes and intervals that hold where they have put it.

    What came out as nothing at its size has no name any more, though the look was taken under it.
    """
    first = len(search.parameters)
    names = {(one.name, one.acts_on): one for one in named}
    found = []
    for number, (effect, place, values) in enumerate(moved):
        before = names.get((effect.name, place))
        if before is None:
            continue
        value, sd = solution.of(search.judge.base[first + number])
        name = effect.parameters[0]
        size = values[name]
        parameters = {**values, name: size * (1.0 + float(value[0]))}
        found.append(
            replace(before, parameters=parameters, sds={name: abs(size) * float(np.hypot(sd[0], INEXACT_RATIO))})
        )
    return tuple(found)


def stands(one: Named, recording: Recording) -> bool:
    """Tell whether an effect that was measured at its size is anything: beyond its deviation, and what is stated."""
    effect = CATALOGUE[one.name]
    name = effect.parameters[0]
    least = _LEAST_SDS * one.sds[name]
    if Trait.LATE_READING in effect.traits:
        axis = "macro" if one.acts_on.startswith("macro") else "end"
        least = max(least, LATCH_SDS * recording.belief(axis).latch_sd_s)
    return abs(one.parameters[name]) > least
