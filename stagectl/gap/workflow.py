"""From recordings to findings: whiten, compete, judge on recordings that no fit saw, and say what can't be said.

Values in, values out; same input, same answer. Pure.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stagectl.effects import CATALOGUE, Effect
from stagectl.errors import RequestError
from stagectl.gap import balance, hypotheses, seeds
from stagectl.gap.balance import Recording
from stagectl.gap.believed import Believed
from stagectl.gap.evidence import Evidence
from stagectl.gap.grids import free_shapes, grids_for
from stagectl.gap.hypotheses import Term
from stagectl.gap.innovations import Noise
from stagectl.gap.log import Log
from stagectl.gap.noise import noise_of
from stagectl.gap.refinement import Refiner, whole_of
from stagectl.gap.selection import Group, Judge, Solution, Sums, solve

_LEFT_SDS = 4.0
_LEFT_SHARE = 0.03
_CURVE_SHARE = 0.03
_EDGE_PASSES = 3
_EDGE_SDS = 2.0
_DEVIATION_SD = 0.5  # of the size of an effect that is part of the operating point, a ratio
_EXCITED_GAIN = 1e-6

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Named:
    """One effect that the recordings show."""

    name: str
    acts_on: str
    parameters: dict[str, float]
    sds: dict[str, float]
    gain: float
    held_out_gain: float
    aliases: tuple[tuple[str, str, float], ...]
    confirmed: bool = False


@dataclass(frozen=True, slots=True)
class ParameterError:
    """A known parameter that the recordings contradict."""

    name: str
    error: float  # ratio, or metres for an edge
    sd: float
    stated_sd: float
    aliases: tuple[str, ...] = ()  # parameters that would do as well


@dataclass(frozen=True, slots=True)
class Findings:
    """What a set of recordings says of a machine."""

    profile: str
    runs: tuple[str, ...]
    holdout: tuple[str, ...]
    verdict: str  # nothing | found | unknown
    named: tuple[Named, ...]
    parameter_errors: tuple[ParameterError, ...]
    refitted: dict[str, float]  # every known parameter's error as fitted: a ratio, or metres for an edge
    not_excited: tuple[str, ...]
    unknown: dict[str, Any] | None
    reducible_before: tuple[float, float]
    reducible_after: tuple[float, float]
    threshold: float
    remarks: tuple[str, ...] = ()
    trace: tuple[str, ...] = field(default=())


Moved = tuple[Effect, str, dict[str, float]]
"""An effect that moves the joint's geometry or the readings, its place, its parameters."""


def find(
    believed: Believed,
    training: Sequence[Log],
    held: Sequence[Log] = (),
    *,
    nulls_count: int = 200,
    seed: int = 0,
    without: frozenset[str] = frozenset(),
    say: Say = lambda text: None,
) -> Findings:
    """Find what is missing from a believed machine, `without` some effects of the library.

    Errors: RequestError where a log is on both sides.
    """
    if {log.name for log in training} & {log.name for log in held}:
        raise RequestError("a recording is both training and holdout; give recordings that no fit sees as --holdout")
    logs = [*training, *held]
    say("reading the motion")
    recordings = [balance.recording_of(log, believed) for log in logs]
    noise = noise_of(recordings)
    unsettled = recordings
    recordings, _ = _settled(unsettled, noise)
    first = Competition(recordings, len(training), nulls_count=nulls_count, seed=seed, without=without, noise=noise)
    judge = first.judge
    say(f"{len(judge.library)} hypotheses of {len({g.key for g in judge.library})} names on {len(logs)} recordings")
    judge.calibrate()
    say("effects compete")
    before = judge.reducible([])
    chosen = judge.select(until=lambda group: _moves_joint(first, group))
    last, named = first, _all_named(first, chosen)
    moving = [group for group in chosen if _moves_joint(first, group)]
    if moving:
        say("once more, at the place where the joint is now known to be")
        moved = tuple(_moved(first, chosen, group) for group in moving)
        kept = tuple(first.term(group) for group in chosen if group not in moving)
        there, moved = _settled(unsettled, noise, moved)
        last = Competition(there, len(training), seed=seed, without=without, moved=moved, kept=kept, noise=noise)
        last.judge.threshold = judge.threshold
        last.judge.trace = judge.trace
        chosen = last.judge.select(last.kept)
        named = _remeasured(last, chosen, named, moved) + _all_named(last, chosen)
    after = last.judge.reducible(chosen)
    unknown = _unknown(last, chosen, before_excess=_excess(first, []))
    verdict = "unknown" if unknown is not None else "found" if named else "nothing"
    if unknown is not None:
        unknown["beside"] = [[effect.name, effect.acts_on] for effect in named]
        named = ()
    solution = solve([*last.judge.base, *chosen], last.evidence.sums)
    return Findings(
        profile=believed.name,
        runs=tuple(log.name for log in training),
        holdout=tuple(log.name for log in held),
        verdict=verdict,
        named=named,
        parameter_errors=_parameter_errors(last, chosen, solution),
        refitted=_refitted(last, chosen, solution, believed),
        not_excited=first.not_excited(),
        unknown=unknown,
        reducible_before=before,
        reducible_after=after,
        threshold=judge.threshold,
        remarks=tuple(remark for log in logs for remark in log.remarks),
        trace=tuple(judge.trace),
    )


def _settled(
    recordings: list[Recording], noise: dict[str, Noise], moved: tuple[Moved, ...] = ()
) -> tuple[list[Recording], tuple[Moved, ...]]:
    """Put the joint's edges, and effects that move it, where the recordings have them; returns both as they are then.

    What an edge does is known to first order only: half a micrometre of error left 30 squares of the noise, which an
    edge that moves at its size then explained in machines without any fault. An edge goes no further than is stated.
    """
    if not any(r.side is not None and bool(np.any(r.side)) for r in recordings):
        return recordings, moved
    out_m = {"left": 0.0, "right": 0.0}
    there = recordings
    for _ in range(_EDGE_PASSES):
        there = [balance.with_edges_moved(r, out_m["left"], out_m["right"]) for r in recordings]
        there = [balance.operating_point(r, moved) for r in there] if moved else there
        for recording in there:
            balance.set_noise(recording, noise)
        evidence = Evidence(there)
        parameters = hypotheses.parameter_terms(there[0])
        base = [Group(t.key, evidence.add(t), t.scope, (sd,), t.bounds) for t, sd in parameters]
        for one in moved:
            term = hypotheses.deviation_term(*one)
            base.append(Group(term.key, evidence.add(term), term.scope, (_DEVIATION_SD,), term.bounds))
        evidence.finish(np.array([sd for _, sd in parameters]), 0, 0)
        solution = solve(base, evidence.sums)
        moved = tuple(
            _changed(one, float(solution.of(group)[0][0]))
            for one, group in zip(moved, base[len(parameters) :], strict=True)
        )
        for (term, sd), group in zip(parameters, base[: len(parameters)], strict=True):
            side = term.name.removesuffix("_m")
            if side in out_m:
                out_m[side] = float(np.clip(out_m[side] + solution.of(group)[0][0], -_EDGE_SDS * sd, _EDGE_SDS * sd))
        if not moved and max(abs(out) for out in out_m.values()) >= _EDGE_SDS * _edge_sd_m(there[0]):
            return recordings, moved  # something else pulls at them
    there = [balance.with_edges_moved(r, out_m["left"], out_m["right"]) for r in recordings]
    return [balance.operating_point(r, moved) for r in there] if moved else there, moved


def _edge_sd_m(recording: Recording) -> float:
    """Return how well an edge is believed to be known, m."""
    joint = recording.believed.joint
    return np.inf if joint is None else joint.width_sd_m


def _changed(moved: Moved, ratio: float) -> Moved:
    effect, place, values = moved
    first = effect.parameters[0]
    return effect, place, {**values, first: values[first] * (1.0 + float(np.clip(ratio, -_DEVIATION_SD, 1.0)))}


class Competition:
    """All hypotheses on recordings at one operating point, ready to compete."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        training_count: int,
        *,
        nulls_count: int = 0,
        seed: int = 0,
        without: frozenset[str] = frozenset(),
        moved: tuple[Moved, ...] = (),
        kept: tuple[Term, ...] = (),
        noise: dict[str, Noise],
    ):
        """Whiten, make the columns, sum. `moved` effects are part of the recordings already, `kept` terms start."""
        for recording in recordings:
            balance.set_noise(recording, noise)
        self.moved = moved
        self.evidence = evidence = Evidence(recordings)
        self.parameters = hypotheses.parameter_terms(recordings[0])
        self.curves: list[Group] = []
        self.kept: list[Group] = []
        self._sds: list[float] = []
        base: list[Group] = []
        library: list[Group] = []
        for term, sd in self.parameters:
            base.append(self._taken(term, (sd,)))
        for effect, place, values in moved:
            base.append(self._taken(hypotheses.deviation_term(effect, place, values), (_DEVIATION_SD,)))
        taken = {(effect.name, place) for effect, place, _ in moved}
        grids = grids_for(recordings)
        wrong = hypotheses.wrong_parameter_terms(recordings[0])

        def searched(terms: Iterable[Term]) -> list[Group]:
            return [self._taken(term) for term in terms if term.name not in without and term.key not in taken]

        library += searched([*wrong, *hypotheses.effect_terms(recordings, grids)])
        self.kept += [self._taken(term) for term in kept]
        self.curves += [self._taken(term) for term in hypotheses.curve_terms(recordings)]
        library += searched(_periodic_terms(evidence, np.array(self._sds)))
        evidence.finish(np.array([sd for _, sd in self.parameters]), nulls_count, seed)
        self.judge = Judge(
            evidence,
            training_count,
            base,
            library,
            lambda beside, group: Refiner(evidence, beside).refined(group),
            lambda beside: Refiner(evidence, beside).gain_at_size,
        )

        self.judge.modelled = self._modelled()

    def _modelled(self) -> float:
        """Return what dry friction of the model explains: a law with a step is never as exact as the noise is small."""
        dry = {
            f"{row['name']} on {row['acts_on']}"
            for row in self.evidence.recordings[0].believed.effects
            if "smoothing_m_per_s" in CATALOGUE[row["name"]].parameters
        }
        columns = [g.columns[0] for (t, _), g in zip(self.parameters, self.judge.base, strict=False) if t.name in dry]
        return float(sum(s.gram[c, c] for s in self.evidence.sums for c in columns))

    def _taken(self, term: Term, sds: tuple[float, ...] | None = None) -> Group:
        """Take a hypothesis in; without `sds` its amplitudes may be as large as its effect can be."""
        known = sds is not None
        sds = sds if sds is not None else _widest(term)
        self._sds += sds
        searched = 0
        if not known and term.name in CATALOGUE:
            searched = max(len(free_shapes(CATALOGUE[term.name])) - (0 if term.linear else 1), 0)
        return Group(term.key, self.evidence.add(term), term.scope, sds, term.bounds, searched)

    def term(self, group: Group) -> Term:
        """Return what a group stands for."""
        return self.evidence.terms[group.columns[0]]

    def not_excited(self) -> tuple[str, ...]:
        """Name the effects that would not show in these recordings at any size."""
        terms = {group.key: self.term(group) for group in self.judge.library}
        excited = {
            group.key
            for group in self.judge.library
            if any(_energy(group, s) > _EXCITED_GAIN * s.count for s in self.judge.training)
        }
        return tuple(sorted(f"{term.name} on {term.acts_on}" for key, term in terms.items() if key not in excited))


def _moves_joint(search: Competition, group: Group) -> bool:
    """Tell whether an effect puts the joint elsewhere: what was learnt of contact has to be learnt again."""
    term = search.term(group)
    touches = any(r.side is not None and bool(np.any(r.side)) for r in search.evidence.recordings)
    return touches and whole_of(term) and term.acts_on.endswith(("_sensor", "contact_edge"))


def _moved(search: Competition, chosen: list[Group], group: Group) -> Moved:
    """Return an effect at its fitted size, sessions pooled."""
    term = search.term(group)
    values, sds = solve([*search.judge.base, *chosen], search.evidence.sums).of(group)
    share = float(np.average(values, weights=1.0 / np.maximum(sds, 1e-12) ** 2))
    first = next(iter(term.shape))
    return CATALOGUE[term.name], term.acts_on, {**term.shape, first: share * term.shape[first]}


def _remeasured(
    search: Competition, chosen: list[Group], named: tuple[Named, ...], moved: tuple[Moved, ...]
) -> tuple[Named, ...]:
    """Return the effects that moved the joint with the sizes and intervals that hold where they have put it."""
    solution = solve([*search.judge.base, *chosen], search.evidence.sums)
    first = len(search.parameters)
    found = []
    for number, (effect, place, values) in enumerate(moved):
        value, sd = solution.of(search.judge.base[first + number])
        name = effect.parameters[0]
        size = values[name]
        before = next(one for one in named if (one.name, one.acts_on) == (effect.name, place))
        parameters = {**values, name: size * (1.0 + float(value[0]))}
        found.append(replace(before, parameters=parameters, sds={name: abs(size) * float(sd[0])}))
    return tuple(found)


def _periodic_terms(evidence: Evidence, prior_sds: np.ndarray) -> list[Term]:
    """Make terms of pitches and frequencies that stand out of what all other hypotheses leave."""
    recordings = evidence.recordings
    found: list[Term] = []
    for place, axis in enumerate(recordings[0].axes):
        signals = [seeds.force_signal(r, axis, evidence.rest(k, place, prior_sds)) for k, r in enumerate(recordings)]
        pitches = seeds.pitches_m(recordings, axis, signals)
        frequencies = seeds.frequencies_hz(recordings, axis, signals)
        found += hypotheses.periodic_terms(recordings, axis, pitches, frequencies)
    return found


def _widest(term: Term) -> tuple[float, ...]:
    """Return how large each amplitude can be at all: the far end of what its effect is declared for."""
    if not term.bounds:
        return (np.inf,) * len(term.amplitudes)
    return tuple(max(abs(low), abs(high)) for low, high in term.bounds)


def _energy(group: Group, s: Sums) -> float:
    return float(max(s.gram[c, c] for c in group.columns))


def _all_named(search: Competition, chosen: list[Group]) -> tuple[Named, ...]:
    """Return every chosen effect, known parameters left out."""
    judge, solution = search.judge, solve([*search.judge.base, *chosen], search.evidence.sums)
    whole = judge.gains(chosen)
    found = []
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            continue
        values, sds = solution.of(group)
        rest = judge.gains([other for other in chosen if other is not group])
        parameters, errors = _readable(term, values, sds, _places(solution, group))
        found.append(
            Named(
                name=term.name,
                acts_on=term.acts_on,
                parameters=parameters if not term.linear else term.shape | parameters,
                sds=errors,
                gain=whole[0] - rest[0],
                held_out_gain=whole[1] - rest[1],
                aliases=tuple((*key, margin) for key, margin in judge.aliases(chosen, group)),  # pyright: ignore[reportGeneralTypeIssues]
            )
        )
    return tuple(found)


def _places(solution: Solution, group: Group) -> list[str]:
    """Name the sessions or runs that the values of a group belong to, in their order; one empty name where to none."""
    return [scope for column, scope in solution.slots if column == group.columns[0]]


def _readable(
    term: Term, values: np.ndarray, sds: np.ndarray, places: list[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Turn pairs of a sine and a cosine into amplitude and phase, session by session, and a share into its value."""
    parameters: dict[str, float] = {}
    errors: dict[str, float] = {}
    per = len(term.amplitudes)
    if not term.linear:
        (first, at), *rest = term.shape.items()
        for place, value, sd in zip(places, values, sds, strict=True):
            mark = f" of {place}" if place else ""
            parameters[first + mark] = float(value) * at
            errors[first + mark] = float(sd) * abs(at)
        return parameters | dict(rest), errors
    for number, place in enumerate(places):
        mark = f" of {place}" if place else ""
        here, sd = values[number * per : (number + 1) * per], sds[number * per : (number + 1) * per]
        if all(name.endswith("*") for name in term.amplitudes):
            effect = CATALOGUE[term.name]
            for pair in range(0, per, 2):
                name = term.amplitudes[pair].removesuffix("*")
                phase = hypotheses.phase_of(effect, name)
                parameters[name + mark] = float(np.hypot(here[pair], here[pair + 1]))
                parameters[f"{phase}{mark}"] = float(np.arctan2(here[pair + 1], here[pair]))
                errors[name + mark] = float(np.mean(sd[pair : pair + 2]))
        else:
            for name, value, one in zip(term.amplitudes, here, sd, strict=True):
                parameters[name + mark] = float(value)
                errors[name + mark] = float(one)
    return parameters, errors


def _parameter_errors(search: Competition, chosen: list[Group], solution: Solution) -> tuple[ParameterError, ...]:
    """Return the known parameters that competed with the effects and stayed, each with what would do as well."""
    stated = {term.name: sd for term, sd in search.parameters}
    found = []
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            values, sds = solution.of(group)
            own = stated.get(term.name, stated.get(_PART_OF.get(term.name, ""), 0.0))
            aliases = tuple(str(key[0]) for key, _ in search.judge.aliases(chosen, group) if key[1] == "parameter")  # pyright: ignore[reportIndexIssue]
            found.append(ParameterError(term.name, float(values[0]), float(sds[0]), own, aliases))
    return tuple(found)


_PART_OF = {"contact_stiffness_n_per_m": "left_stiffness_n_per_m", "backlash_width_m": "left_m"}


def _refitted(search: Competition, chosen: list[Group], solution: Solution, believed: Believed) -> dict[str, float]:
    """Return every known parameter's error as fitted, what it is off beyond its stated uncertainty included."""
    base = search.judge.base[: len(search.parameters)]
    found = {
        term.name: float(solution.of(group)[0][0]) for (term, _), group in zip(search.parameters, base, strict=True)
    }
    settled = search.evidence.recordings[0].believed.joint
    if believed.joint is not None and settled is not None and not search.moved:
        found["left_m"] += settled.left_m - believed.joint.left_m
        found["right_m"] += settled.right_m - believed.joint.right_m
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            value = float(solution.of(group)[0][0])
            part = _PART_OF.get(term.name)
            own = (part, part.replace("left", "right")) if part else (term.name,)
            for name in own:
                if name in found:
                    found[name] += value
    return found


def _excess(search: Competition, chosen: list[Group]) -> float:
    """Return what is left above the noise, in squares of it."""
    sums = search.evidence.sums
    return sum(float(s.gram[0, 0]) - s.count for s in sums) - search.judge.gain(chosen)


def _unknown(search: Competition, chosen: list[Group], before_excess: float) -> dict[str, Any] | None:
    """Return what no effect explains, with the curve that goes furthest, or None where the floor is reached.

    Names are worth stating only where with them nothing is left: a law of the library that fits an unknown force half
    is a wrong name.
    """
    judge, evidence = search.judge, search.evidence
    count = sum(s.count for s in evidence.sums)
    left, first = _excess(search, chosen), before_excess
    noise = np.sqrt(2.0 * count)
    best, gained = None, 0.0
    for curve in search.curves:
        gain = judge.gain([*chosen, curve]) - judge.gain(chosen)
        if gain > gained:
            best, gained = curve, gain
    judge.trace.append(f"left over {left:.0f} of {first:.0f}, noise {noise:.0f}, best curve {gained:.0f}")
    floor = _LEFT_SDS * noise + _LEFT_SHARE * max(first, 0.0)
    material = best is not None and gained > max(3.0 * judge.threshold, _CURVE_SHARE * max(first, 0.0))
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
