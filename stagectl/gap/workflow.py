"""From recordings to findings: whiten, compete, judge on recordings that no fit saw, and say what can't be said.

Values in, values out; same input, same answer. Pure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.gap import balance, hypotheses, seeds
from stagectl.gap.balance import Recording
from stagectl.gap.believed import Believed
from stagectl.gap.evidence import Evidence
from stagectl.gap.grids import FREE_SHAPES, grids_for
from stagectl.gap.hypotheses import Term
from stagectl.gap.innovations import Noise
from stagectl.gap.log import Log
from stagectl.gap.refinement import Refiner
from stagectl.gap.selection import Group, Judge, Solution, Sums, solve

_LEFT_SDS = 4.0
_LEFT_SHARE = 0.03
_CURVE_SHARE = 0.03
_CORNER_RAD_PER_S = 2.0 * np.pi * 1.34
_FORCE_N = 0.05
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
    thresholds: tuple[float, float]
    remarks: tuple[str, ...] = ()
    trace: tuple[str, ...] = field(default=())


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
    for recording in recordings:
        balance.set_noise(recording, _first_noise(believed, recording))
    base = hypotheses.parameter_terms(recordings[0])
    wrong = [term for term in hypotheses.wrong_parameter_terms(recordings[0]) if term.name not in without]
    curves = list(hypotheses.curve_terms(recordings))
    grids = grids_for(recordings)
    terms = [term for term in hypotheses.effect_terms(recordings, grids) if term.name not in without]
    say("looking for what repeats in position and time")
    evidence = Evidence(recordings)
    groups = _Groups()
    for term, sd in base:
        groups.add("base", evidence.add(term), term, (sd,))
    for term in [*wrong, *terms]:
        groups.add("library", evidence.add(term), term)
    for term in curves:
        groups.add("curves", evidence.add(term), term)
    for term in _periodic_terms(evidence, groups.prior_sds()):
        if term.name not in without:
            groups.add("library", evidence.add(term), term)
    evidence.finish(np.array([sd for _, sd in base]), nulls_count, seed)
    say(f"{len(groups.library)} hypotheses of {len({g.key for g in groups.library})} names on {len(logs)} recordings")
    judge = Judge(
        evidence,
        len(training),
        groups.base,
        groups.library,
        lambda beside, group: Refiner(evidence, beside).refined(group),
        lambda beside: Refiner(evidence, beside).gain_at_size,
    )
    say("what the library gains on noise")
    judge.calibrate()
    say("effects compete")
    before = judge.reducible([])
    chosen = judge.select()
    after = judge.reducible(chosen)
    solution = solve([*judge.base, *chosen], evidence.sums)
    unknown = _unknown(judge, chosen, groups.curves, evidence)
    effects = [group for group in chosen if evidence.terms[group.columns[0]].acts_on != "parameter"]
    named = tuple(_named(judge, chosen, group, solution, evidence) for group in effects)
    verdict = "unknown" if unknown is not None else "found" if named else "nothing"
    if unknown is not None:
        unknown["beside"] = [list(group.key) for group in effects]
        named = ()
    excited = {
        group.key for group in judge.library if any(_energy(group, s) > _EXCITED_GAIN * s.count for s in judge.training)
    }
    return Findings(
        profile=believed.name,
        runs=tuple(log.name for log in training),
        holdout=tuple(log.name for log in held),
        verdict=verdict,
        named=named,
        parameter_errors=_parameter_errors(judge, chosen, base, solution, evidence),
        refitted=_refitted(judge, chosen, base, solution, evidence),
        not_excited=tuple(
            sorted(
                f"{term.name} on {term.acts_on}"
                for term in {t.key: t for t in terms}.values()
                if term.key not in excited
            )
        ),
        unknown=unknown,
        reducible_before=before,
        reducible_after=after,
        thresholds=judge.thresholds,
        remarks=tuple(remark for log in logs for remark in log.remarks),
        trace=tuple(judge.trace),
    )


def _first_noise(believed: Believed, recording: Recording) -> dict[str, Noise]:
    noise = {"macro": Noise(believed.macro.noise_m, _FORCE_N, _CORNER_RAD_PER_S, _FORCE_N * 0.1)}
    if believed.micro is not None and "end" in recording.axes:
        noise["end"] = Noise(believed.micro.noise_m, _FORCE_N, _CORNER_RAD_PER_S, _FORCE_N * 0.1)
    return noise


class _Groups:
    """Which columns belong to which hypothesis."""

    def __init__(self) -> None:
        self.base: list[Group] = []
        self.library: list[Group] = []
        self.curves: list[Group] = []
        self._sds: list[float] = []

    def add(self, kind: str, columns: tuple[int, ...], term: Term, sds: tuple[float, ...] | None = None) -> None:
        """Take a hypothesis in; without `sds` its amplitudes may be as large as its effect can be."""
        sds = _widest(term) if sds is None else sds
        searched = 0
        if kind == "library":
            searched = max(len(FREE_SHAPES.get(term.name, ())) - (0 if term.linear else 1), 0)
        getattr(self, kind).append(Group(term.key, columns, term.scope, sds, term.bounds, searched))
        self._sds += sds

    def prior_sds(self) -> np.ndarray:
        """Return how large each amplitude may be, by column."""
        return np.array(self._sds)


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


def _named(judge: Judge, chosen: list[Group], group: Group, solution: Solution, evidence: Evidence) -> Named:
    term = evidence.terms[group.columns[0]]
    values, sds = solution.of(group)
    rest = judge.gains([other for other in chosen if other is not group])
    whole = judge.gains(chosen)
    parameters, errors = _readable(term, values, sds, _places(term, solution, group))
    return Named(
        name=term.name,
        acts_on=term.acts_on,
        parameters=parameters if not term.linear else term.shape | parameters,
        sds=errors,
        gain=whole[0] - rest[0],
        held_out_gain=whole[1] - rest[1],
        aliases=tuple((*key, margin) for key, margin in judge.aliases(chosen, group)),  # pyright: ignore[reportGeneralTypeIssues]
    )


def _places(term: Term, solution: Solution, group: Group) -> list[str]:
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


def _parameter_errors(
    judge: Judge, chosen: list[Group], base: list[tuple[Term, float]], solution: Solution, evidence: Evidence
) -> tuple[ParameterError, ...]:
    """Return the known parameters that competed with the effects and stayed, each with what would do as well."""
    stated = {term.name: sd for term, sd in base}
    found = []
    for group in chosen:
        term = evidence.terms[group.columns[0]]
        if term.acts_on == "parameter":
            values, sds = solution.of(group)
            own = stated.get(term.name, stated.get(_PART_OF.get(term.name, ""), 0.0))
            aliases = tuple(str(key[0]) for key, _ in judge.aliases(chosen, group) if key[1] == "parameter")  # type: ignore[index]
            found.append(ParameterError(term.name, float(values[0]), float(sds[0]), own, aliases))
    return tuple(found)


_PART_OF = {"contact_stiffness_n_per_m": "left_stiffness_n_per_m", "backlash_width_m": "left_m"}


def _refitted(
    judge: Judge, chosen: list[Group], base: list[tuple[Term, float]], solution: Solution, evidence: Evidence
) -> dict[str, float]:
    """Return every known parameter's error as fitted, what it is off beyond its stated uncertainty included."""
    found = {term.name: float(solution.of(group)[0][0]) for (term, _), group in zip(base, judge.base, strict=True)}
    for group in chosen:
        term = evidence.terms[group.columns[0]]
        if term.acts_on == "parameter":
            value = float(solution.of(group)[0][0])
            for name in (term.name, *(("left", "right") if term.name in _PART_OF else ())):
                own = f"{name}{_PART_OF[term.name].removeprefix('left')}" if name in ("left", "right") else name
                if own in found:
                    found[own] += value
    return found


def _unknown(judge: Judge, chosen: list[Group], curves: list[Group], evidence: Evidence) -> dict[str, Any] | None:
    """Return what no effect explains, with the curve that goes furthest, or None where the floor is reached.

    Names are worth stating only where with them nothing is left: a law of the library that fits an unknown force half
    is a wrong name.
    """
    count = sum(s.count for s in evidence.sums)
    total = sum(float(s.gram[0, 0]) for s in evidence.sums)
    left = total - count - judge.gain(chosen)
    first = total - count - judge.gain([])
    noise = np.sqrt(2.0 * count)
    best, gained = None, 0.0
    for curve in curves:
        gain = judge.gain([*chosen, curve]) - judge.gain(chosen)
        if gain > gained:
            best, gained = curve, gain
    judge.trace.append(f"left over {left:.0f} of {first:.0f}, noise {noise:.0f}, best curve {gained:.0f}")
    floor = _LEFT_SDS * noise + _LEFT_SHARE * max(first, 0.0)
    material = best is not None and gained > max(3.0 * sum(judge.thresholds), _CURVE_SHARE * max(first, 0.0))
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
