"""From recordings to findings: whiten, compete, judge on recordings that no fit saw, and say what can't be said.

Values in, values out; same input, same answer. Pure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.gap import balance, hypotheses, seeds
from stagectl.gap.balance import Recording
from stagectl.gap.believed import Believed
from stagectl.gap.grids import grids_for
from stagectl.gap.hypotheses import Term
from stagectl.gap.innovations import Noise
from stagectl.gap.log import Log
from stagectl.gap.selection import Group, Judge, Solution, Sums, solve

_AR_ORDER = 12
_REST_PASSES = 3
_CORNER_RAD_PER_S = 2.0 * np.pi * 1.34
_FORCE_N = 0.05
_EXCITED_GAIN = 1e-6
_PARAMETER_SDS = 3.0  # beyond so many stated standard deviations a known parameter counts as wrong
_PARAMETER_SIGMAS = 5.0  # ... and so well must the data show it

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
    say: Say = lambda text: None,
) -> Findings:
    """Find what is missing from a believed machine. Errors: RequestError where a log is on both sides."""
    if {log.name for log in training} & {log.name for log in held}:
        raise RequestError("a recording is both training and holdout; give recordings that no fit sees as --holdout")
    logs = [*training, *held]
    say("reading the motion")
    recordings = [balance.recording_of(log, believed) for log in logs]
    for recording in recordings:
        balance.set_noise(recording, _first_noise(believed, recording))
    base = hypotheses.parameter_terms(recordings[0])
    curves = list(hypotheses.curve_terms(recordings))
    grids = grids_for(recordings)
    terms = list(hypotheses.effect_terms(recordings, grids))
    say("looking for what repeats in position and time")
    fixed = [term for term, _ in base] + terms + curves
    blocks = [_columns(recording, fixed) for recording in recordings]
    periodic = _periodic_terms(recordings, blocks, base, terms, curves)
    blocks = [
        np.column_stack([block, *(balance.column(r, f) for term in periodic for f in term.forces(r))])
        for block, r in zip(blocks, recordings, strict=True)
    ]
    say(f"{len(terms)} hypotheses of {len({term.key for term in terms})} effects on {len(logs)} recordings")
    layout, sums = _sums(recordings, blocks, base, terms, curves, periodic, nulls_count, seed)
    terms += periodic
    groups = layout.groups
    judge = Judge(sums[: len(training)], sums[len(training) :], groups["base"], groups["library"])
    say("what the library gains on noise")
    judge.calibrate()
    say("effects compete")
    before = judge.reducible([])
    chosen = judge.select()
    solution = solve([*judge.base, *chosen], sums)
    after = judge.reducible(chosen)
    unknown = _unknown(judge, chosen, groups["curves"], layout)
    by_key = {term.key: term for term in terms}
    named = tuple(_named(judge, chosen, group, solution, layout) for group in chosen)
    verdict = "unknown" if unknown is not None else "found" if named else "nothing"
    excited = {
        group.key for group in judge.library if any(_energy(group, s) > _EXCITED_GAIN * s.count for s in judge.training)
    }
    return Findings(
        profile=believed.name,
        runs=tuple(log.name for log in training),
        holdout=tuple(log.name for log in held),
        verdict=verdict,
        named=named,
        parameter_errors=_parameter_errors(base, judge.base, solution),
        refitted={
            term.name: float(solution.of(group)[0][0]) for (term, _), group in zip(base, judge.base, strict=True)
        },
        not_excited=tuple(sorted(f"{name} on {place}" for name, place in by_key if (name, place) not in excited)),
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


@dataclass(slots=True)
class Layout:
    """Which column belongs to which hypothesis."""

    terms: dict[int, Term]
    groups: dict[str, list[Group]]


def _sums(
    recordings: Sequence[Recording],
    blocks: list[np.ndarray],
    base: list[tuple[Term, float]],
    terms: list[Term],
    curves: list[Term],
    periodic: list[Term],
    nulls_count: int,
    seed: int,
) -> tuple[Layout, list[Sums]]:
    """Say which columns belong to which hypothesis, and sum every recording."""
    layout = Layout({}, {"base": [], "library": [], "curves": []})
    place = 1
    members = [("base", term, (sd,)) for term, sd in base]
    members += [("library", term, _widest(term)) for term in terms]
    members += [("curves", term, _widest(term)) for term in curves]
    members += [("library", term, _widest(term)) for term in periodic]
    for kind, term, sds in members:
        columns = tuple(range(place, place + len(term.amplitudes)))
        place += len(columns)
        layout.groups[kind].append(Group(term.key, columns, term.scope, sds, term.bounds))
        layout.terms[columns[0]] = term
    for name, searched in _searched([*terms, *periodic]).items():
        layout.groups["library"] = [
            replace(group, searched=searched) if group.key == name else group for group in layout.groups["library"]
        ]
    prior_sds = np.concatenate([np.asarray(sds) for _, _, sds in members])
    sums = []
    for number, (recording, block) in enumerate(zip(recordings, blocks, strict=True)):
        random = np.random.default_rng([seed, number])
        sums.append(_whitened_sums(recording, block, prior_sds, nulls_count, random))
    return layout, sums


def _searched(terms: list[Term]) -> dict[object, int]:
    """Count, by name, the shape parameters that differ between the hypotheses of one effect, periods always."""
    found: dict[object, int] = {}
    for key in {term.key for term in terms}:
        shapes = [term.shape for term in terms if term.key == key]
        found[key] = sum(
            len({shape[name] for shape in shapes}) > 1 or name in ("pitch_m", "frequency_hz") for name in shapes[0]
        )
    return found


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


def _whitened_sums(
    recording: Recording, z: np.ndarray, prior_sds: np.ndarray, nulls_count: int, random: np.random.Generator
) -> Sums:
    """Take what correlation is left out of one recording, by what no hypothesis explains, and sum."""
    start = 0
    gram = np.zeros((z.shape[1], z.shape[1]))
    nulls = np.zeros((nulls_count, z.shape[1] - 1))
    count = 0.0
    for _, size in balance.channels(recording):
        block = z[start : start + size]
        start += size
        rest = _rest(block, prior_sds)
        coefficients, sd = _autoregression(rest)
        block = np.asarray(lfilter(np.concatenate([[1.0], -coefficients]), [1.0], block, axis=0))[_AR_ORDER:] / sd
        gram += block.T @ block
        nulls += random.standard_normal((nulls_count, block.shape[0])) @ block[:, 1:]
        count += block.shape[0]
    return Sums(gram, count, recording.log.session, recording.log.name, nulls)


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


def _autoregression(rest: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit an autoregression (Yule-Walker); return its coefficients and what it leaves."""
    n = rest.size
    covariance = np.array([rest[: n - k] @ rest[k:] / n for k in range(_AR_ORDER + 1)])
    matrix = covariance[np.abs(np.subtract.outer(np.arange(_AR_ORDER), np.arange(_AR_ORDER)))]
    coefficients = np.linalg.solve(matrix + 1e-9 * covariance[0] * np.eye(_AR_ORDER), covariance[1:])
    left = covariance[0] - coefficients @ covariance[1:]
    return coefficients, float(np.sqrt(max(left, 1e-300)))


def _energy(group: Group, s: Sums) -> float:
    return float(max(s.gram[c, c] for c in group.columns))


def _named(judge: Judge, chosen: list[Group], group: Group, solution: Solution, layout: Layout) -> Named:
    term = layout.terms[group.columns[0]]
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
    base: list[tuple[Term, float]], groups: list[Group], solution: Solution
) -> tuple[ParameterError, ...]:
    found = []
    for (term, stated), group in zip(base, groups, strict=True):
        values, sds = solution.of(group)
        error, sd = float(values[0]), float(sds[0])
        if abs(error) > _PARAMETER_SDS * stated and abs(error) > _PARAMETER_SIGMAS * sd:
            found.append(ParameterError(term.name, error, sd, stated))
    return tuple(found)


_UNKNOWN_SHARE = 0.2


def _unknown(judge: Judge, chosen: list[Group], curves: list[Group], layout: Layout) -> dict[str, Any] | None:
    """Return the curve that explains what no effect does, where one repeats on recordings that no fit saw."""
    now = judge.gains(chosen)
    left = judge.reducible(chosen)
    best = None
    for curve in curves:
        gains = judge.gains([*chosen, curve])
        gain = (gains[0] - now[0], gains[1] - now[1])
        free = 2.0 * len(curve.columns)
        passes = gain[0] > judge.thresholds[0] + free and gain[1] > max(judge.thresholds[1], _UNKNOWN_SHARE * left[1])
        if passes and (best is None or gain[1] > best[1][1]):
            best = (curve, gain)
    if best is None:
        return None
    curve, gain = best
    term = layout.terms[curve.columns[0]]
    solution = solve([*judge.base, *chosen, curve], [*judge.training, *judge.held])
    values, sds = solution.of(curve)
    return {
        "over": term.name.removeprefix("curve over "),
        "acts_on": term.acts_on,
        "knots": [float(name) for name in term.amplitudes],
        "values_n": values.tolist(),
        "sds_n": sds.tolist(),
        "gain": gain[0],
        "held_out_gain": gain[1],
    }
