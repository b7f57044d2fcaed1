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
from stagectl.gap.grids import FREE_SHAPES, grids_for
from stagectl.gap.hypotheses import Term
from stagectl.gap.innovations import Noise
from stagectl.gap.log import Log
from stagectl.gap.refinement import Evidence, Refiner
from stagectl.gap.selection import Group, Judge, Solution, Sums, solve

_HIGH_SHARE = 0.3  # of the sample rate: above it forces move nothing
_LEAST_SCALE = 0.5
_LEFT_SDS = 4.0
_LEFT_SHARE = 0.03
_CURVE_SHARE = 0.03
_REST_PASSES = 3
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
    fixed = [term for term, _ in base] + wrong + terms + curves
    blocks = [_columns(recording, fixed) for recording in recordings]
    periodic = [term for term in _periodic_terms(recordings, blocks, base, [*wrong, *terms], curves)]
    periodic = [term for term in periodic if term.name not in without]
    blocks = [
        np.column_stack([block, *(balance.column(r, f) for term in periodic for f in term.forces(r))])
        for block, r in zip(blocks, recordings, strict=True)
    ]
    say(f"{len(terms)} hypotheses of {len({term.key for term in terms})} effects on {len(logs)} recordings")
    members = [("base", term, (sd,)) for term, sd in base]
    members += [("library", term, _widest(term)) for term in [*wrong, *terms]]
    members += [("curves", term, _widest(term)) for term in curves]
    members += [("library", term, _widest(term)) for term in periodic]
    groups, evidence = _evidence(recordings, blocks, members, nulls_count, seed)
    judge = Judge(
        evidence,
        len(training),
        groups["base"],
        groups["library"],
        lambda beside, group: Refiner(evidence, beside).refined(group),
    )
    say("what the library gains on noise")
    judge.calibrate()
    say("effects compete")
    before = judge.reducible([])
    chosen = judge.select()
    after = judge.reducible(chosen)
    solution = solve([*judge.base, *chosen], evidence.sums)
    unknown = _unknown(judge, chosen, groups["curves"], evidence)
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


def _evidence(
    recordings: Sequence[Recording],
    blocks: list[np.ndarray],
    members: list[tuple[str, Term, tuple[float, ...]]],
    nulls_count: int,
    seed: int,
) -> tuple[dict[str, list[Group]], Evidence]:
    """Say which columns belong to which hypothesis, scale every recording by its noise, and sum."""
    groups: dict[str, list[Group]] = {"base": [], "library": [], "curves": []}
    terms: dict[int, Term] = {}
    searched = _searched([term for kind, term, _ in members if kind == "library"])
    place = 1
    for kind, term, sds in members:
        columns = tuple(range(place, place + len(term.amplitudes)))
        place += len(columns)
        more = searched.get(term.key, 0) if kind == "library" else 0
        groups[kind].append(Group(term.key, columns, term.scope, sds, term.bounds, more))
        terms[columns[0]] = term
    prior_sds = np.concatenate([np.asarray(sds) for _, _, sds in members])
    known = sum(len(sds) for kind, _, sds in members if kind == "base")
    sums, scales, scaled = [], [], []
    for number, (recording, block) in enumerate(zip(recordings, blocks, strict=True)):
        scale = _noise_scale(recording, block[:, : 1 + known], prior_sds[:known])
        block = block / scale[:, None]
        random = np.random.default_rng([seed, number])
        nulls = random.standard_normal((nulls_count, block.shape[0])) @ block[:, 1:]
        sums.append(Sums(block.T @ block, float(block.shape[0]), recording.log.session, recording.log.name, nulls))
        scales.append(scale)
        scaled.append(block)
    return groups, Evidence(recordings, scaled, sums, scales, terms)


def _searched(terms: list[Term]) -> dict[object, int]:
    """Count, by name, the shape parameters that are searched: but one where they are all that an effect has."""
    return {term.key: max(len(FREE_SHAPES.get(term.name, ())) - (0 if term.linear else 1), 0) for term in terms}


def _periodic_terms(
    recordings: list[Recording],
    blocks: list[np.ndarray],
    base: list[tuple[Term, float]],
    terms: list[Term],
    curves: list[Term],
) -> list[Term]:
    """Make terms of pitches and frequencies that stand out of what all other hypotheses leave."""
    signals: dict[str, list[np.ndarray]] = {axis: [] for axis in recordings[0].axes}
    for recording, z in zip(recordings, blocks, strict=True):
        sds = np.concatenate([[sd for _, sd in base], *(_widest(term) for term in terms + curves)])
        start = 0
        for axis in recording.axes:
            size = int(recording.judged[axis].sum())
            signals[axis].append(seeds.force_signal(recording, axis, _rest(z[start : start + size], sds)))
            start += size
    found = []
    for axis, of_axis in signals.items():
        pitches = seeds.pitches_m(recordings, axis, of_axis)
        frequencies = seeds.frequencies_hz(recordings, axis, of_axis)
        found += hypotheses.periodic_terms(recordings, axis, pitches, frequencies)
    return found


def _columns(recording: Recording, terms: Sequence[Term]) -> np.ndarray:
    """Return the whitened innovations and the columns of all terms, shape (m, 1 + columns)."""
    columns = [balance.observed(recording)]
    for term in terms:
        columns += [balance.column(recording, forces) for forces in term.forces(recording)]
    return np.column_stack(columns)


def _widest(term: Term) -> tuple[float, ...]:
    """Return how large each amplitude can be at all: the far end of what its effect is declared for."""
    if not term.bounds:
        return (np.inf,) * len(term.amplitudes)
    return tuple(max(abs(low), abs(high)) for low, high in term.bounds)


def _noise_scale(recording: Recording, z: np.ndarray, prior_sds: np.ndarray) -> np.ndarray:
    """Return, by row, the noise in units of what was believed of it: as large as it is at the highest frequencies.

    z: innovations and the columns of known parameters. At high frequencies no effect reaches far; taken from all that
    is left it would hide whatever nobody explains, and beside all columns of the library, some of which hold measured
    accelerations, it came out a tenth too small.
    """
    scale = np.ones(z.shape[0])
    start = 0
    for _, size in balance.channels(recording):
        rest = _rest(z[start : start + size], prior_sds)
        power = np.abs(np.fft.rfft(rest)) ** 2 / size
        high = np.fft.rfftfreq(size) > _HIGH_SHARE
        scale[start : start + size] = max(float(np.sqrt(np.mean(power[high]))), _LEAST_SCALE)
        start += size
    return scale


def _rest(block: np.ndarray, prior_sds: np.ndarray) -> np.ndarray:
    """Return the innovations without everything that any hypothesis explains: what is left is noise, if anything is.

    Amplitudes keep to their priors: free, a scale error of the sensor and one of the forces explain any motion whole.
    """
    columns = block[:, 1:]
    scale = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    used = scale > 0.0
    columns, scale = columns[:, used] / scale[used], scale[used]
    normal = columns.T @ columns
    right = columns.T @ block[:, 0]
    variance = 1.0
    rest = block[:, 0]
    for _ in range(_REST_PASSES):
        precision = variance / (scale * prior_sds[used]) ** 2 + 1e-9
        theta = np.linalg.solve(normal + np.diag(precision), right)
        rest = block[:, 0] - columns @ theta
        variance = float(np.mean(rest * rest))
    return rest


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
        (first, value), *rest = term.shape.items()
        return {first: float(values[0]) * value, **dict(rest)}, {first: float(sds[0]) * abs(value)}
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
