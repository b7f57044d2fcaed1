"""What a finding says of a motion that nobody has recorded yet, written down before the fact, and judged after it.

A finding predicts by how much the gap falls when its effect is known: with whitened innovations z of a recording, B the
known parameters at the values of the findings and s what the effect alone does to them,

    |z - B b|^2 - |z - B b - s|^2 = |s|^2 (2 a - 1),        a = s'(z - B b) / |s|^2

a is 1 where the effect is there as found, 0 where it is not. In newtons the gap falls from a f to (1 - a) f, f being
the rms of the force that was found, along the motion. The spread of a comes from noise, from what the recordings of the
findings leave open in b and in the effect itself, and from how a scatters between them. Nothing is refitted but the
phase of what repeats in position, where each homing has its own. A known parameter that is wrong is judged alike: its
column is that of the parameter, as long as its error. Pure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.gap import balance, hypotheses
from stagectl.gap.addition import parted
from stagectl.gap.believed import Believed
from stagectl.gap.coloured_rest import filters_of, whitened_rest
from stagectl.gap.effect_forces import effect_forces
from stagectl.gap.findings import SIGMAS, Findings, Named, ParameterError
from stagectl.gap.forces import Forces, scaled_forces
from stagectl.gap.grids import grids_for
from stagectl.gap.hypotheses import Term
from stagectl.gap.innovations import Noise
from stagectl.gap.log import Log
from stagectl.gap.noise import noise_of
from stagectl.gap.predicted_columns import (
    effect_columns,
    mean_values,
    observed,
    prepared,
    stacked_columns,
)
from stagectl.gap.recording import Recording

LAW_SD_RATIO = 0.003
"""How exact a law is along a motion that is only measured: a true friction of 6 N showed 99.6 % of itself."""


DETECTED = 5.0
"""Distance in standard deviations from which an effect counts as seen."""


SEPARATED = 9.0
"""Twice the log of the likelihood ratio beyond which of two names one is out."""


_MATERIAL_RATIO = 0.01
"""Share of an effect's own energy below which a margin may be the model's, not the name's."""


_MOTION_RATIO = 0.01
"""Standard deviation of an effect's size on a motion against that on the motion as planned."""


Columns = Callable[[Recording, np.ndarray], np.ndarray]
"""What a hypothesis does to a recording's innovations, shape (m, k); the second argument is where phases come from."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What one effect will do on one motion; intervals are 95 %, forces in N and sensor errors in m, rms."""

    name: str
    acts_on: str
    unit: str
    gap_before: float
    gap_after: float  # what noise and uncertainty leave
    fall: float  # of the gap: the effect's own size where it is there as found
    fall_interval: tuple[float, float]
    gain: float  # of log-likelihood, twice; of the motion as planned
    share_interval: tuple[float, float]  # of the effect as found; 1 is exactly as found
    d_prime: float
    separations: tuple[tuple[str, str, float], ...] = ()  # d' to each effect that explains the findings as well

    @property
    def decides(self) -> bool:
        """Whether the outcome can tell the effect from nothing, and from one half of it."""
        return self.share_interval[0] > 0.5 and self.d_prime >= DETECTED


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a recording said of one prediction."""

    name: str
    acts_on: str
    unit: str
    gap_before: float
    gap_after: float
    fall: float
    gain: float
    share: float
    inside: bool
    better: tuple[tuple[str, str, float], ...]  # aliases that the recording prefers, by how much
    out: tuple[tuple[str, str, float], ...]  # aliases that it rules out

    @property
    def confirmed(self) -> bool:
        """Whether the prediction held and no other name does better."""
        return self.inside and not self.better


@dataclass(slots=True)
class _Model:
    """Known parameters and effects with the values of the findings, and what the recordings leave open."""

    columns: Columns
    values: np.ndarray
    covariance: np.ndarray


@dataclass(slots=True)
class Evidence:
    """What the recordings of some findings say, ready to predict others."""

    believed: Believed
    noise: dict[str, Noise]
    named: tuple[Named, ...]
    wrong: tuple[ParameterError, ...]
    base: list[tuple[Term, float]]
    base_values: np.ndarray
    filters: dict[str, tuple[np.ndarray, float]]  # autoregression of what is left, by channel
    model: _Model
    rivals: dict[tuple[str, str], dict[tuple[str, str], _Model]]
    late_ratio: float  # share of samples that the recordings lack
    scatter: np.ndarray  # of each target's share between recordings

    @property
    def targets(self) -> tuple[Named | ParameterError, ...]:
        """Everything that is predicted: effects, then parameters."""
        return (*self.named, *self.wrong)

    def along(self, target: Named | ParameterError) -> np.ndarray:
        """Return the amplitudes, of the base and of the effects, that a target stands for; shape (k,)."""
        if isinstance(target, Named):
            here = [None] * len(self.base) + [(one.name, one.acts_on) for one in self.named]
            return np.array([float(key == (target.name, target.acts_on)) for key in here])
        parts = hypotheses.parts_of(target.name)
        here = [target.error * (term.name in parts) for term, _ in self.base]
        return np.array(here + [0.0] * len(self.named))


def evidence(believed: Believed, logs: Sequence[Log], findings: Findings) -> Evidence:
    """Read findings and their recordings for prediction. Errors: RequestError where there is nothing to predict."""
    named = tuple(effect for effect in findings.named if not _per_run(effect))
    wrong = findings.parameter_errors if findings.unknown is None else ()  # beside an unknown force nothing is sure
    if not named and not wrong:
        raise RequestError("these findings name no effect that could be predicted; `next` shows what to excite")
    noise = noise_of([balance.recording_of(log, believed) for log in logs])
    recordings = [prepared(log, believed) for log in logs]
    base = hypotheses.parameter_terms(recordings[0])
    base_values = np.array([findings.refitted.get(term.name, 0.0) for term, _ in base])

    known: list[tuple[Recording, np.ndarray]] = []

    def base_columns(recording: Recording) -> np.ndarray:
        for other, block in known:
            if other is recording:
                return block
        return stacked_columns(recording, [forces for term, _ in base for forces in term.forces(recording)])

    def columns(recording: Recording, rest: np.ndarray) -> np.ndarray:
        found = base_columns(recording)
        free = rest - found @ base_values
        return np.column_stack([found, *effect_columns(recording, named, free)])

    values = np.concatenate([base_values, np.ones(len(named))])
    blocks = []
    for recording in recordings:
        known.append((recording, base_columns(recording)))
        z = observed(recording)
        blocks.append((recording, z, columns(recording, z)))
    free = {part for error in wrong for part in hypotheses.parts_of(error.name)}  # beyond what is stated of them
    prior = np.array([0.0 if term.name in free else 1.0 / sd**2 for term, sd in base] + [0.0] * len(named))
    wanted = {alias[:2] for one in named for alias in one.aliases}
    terms = [term for term in hypotheses.effect_terms(recordings, grids_for(recordings)) if term.key in wanted]
    filters = filters_of(blocks, prior, terms)
    white = [(whitened_rest(r, z, filters), whitened_rest(r, d, filters)) for r, z, d in blocks]
    covariance = np.linalg.inv(sum((d.T @ d for _, d in white), np.diag(prior)))
    model = _Model(columns, values, covariance)
    late_ratio = float(np.mean([1.0 - log.valid.mean() for log in logs]))
    rivals = {
        (one.name, one.acts_on): _rivals(one, named, terms, base_columns, prior, base_values, blocks, filters)
        for one in named
    }
    seen = Evidence(believed, noise, named, wrong, base, base_values, filters, model, rivals, late_ratio, np.zeros(0))
    seen.scatter = np.array([_scatter(white, values, seen.along(target)) for target in seen.targets])
    return seen


def expected(seen: Evidence, log: Log) -> list[Expected]:
    """Say what each effect and wrong parameter will do on a planned motion, in the order of the targets.

    Samples come late as often as in the recordings of the findings.
    """
    late = np.random.default_rng(0).random(log.samples_count) < seen.late_ratio
    log = replace(log, valid=log.valid & ~late)
    recording = prepared(log, seen.believed, seen.noise)  # a planned motion has none that could be read off it
    nothing = np.zeros(sum(size for _, size in balance.channels(recording)))
    raw = seen.model.columns(recording, nothing)
    d = whitened_rest(recording, raw, seen.filters)
    first = len(seen.base)
    found = []
    for number, target in enumerate(seen.targets):
        along = seen.along(target)
        s = d @ along
        energy = float(s @ s)
        if not energy > 0.0:
            continue
        unit, size = _size(recording, target, seen)
        sd = _share_sd(d, s, seen.model.covariance, float(seen.scatter[number]))
        spread_ratio = SIGMAS * float(np.hypot(sd, LAW_SD_RATIO))
        low, high = 1.0 - spread_ratio, 1.0 + spread_ratio
        spread = SIGMAS * size * float(np.hypot(2.0 * sd, _MOTION_RATIO))
        planned = raw @ along + raw[:, :first] @ seen.base_values
        separations = tuple(
            (*key, _separation(recording, seen, d[:, :first], s, rival, planned))
            for key, rival in seen.rivals.get((target.name, target.acts_on), {}).items()
        )
        free = _free_energy(s, d, seen.model.covariance, np.flatnonzero(along[:first] == 0.0))
        found.append(
            Expected(
                target.name, target.acts_on, unit, size, size * sd, size,
                (size - spread, size + spread), energy, (low, high), float(np.sqrt(free)),
                separations,
            )
        )  # fmt: skip
    return found


def judged(seen: Evidence, log: Log, predictions: Sequence[Expected]) -> list[Outcome]:
    """Judge predictions by a recording that nobody had seen: values as found, nothing refitted."""
    recording = prepared(log, seen.believed)
    z = observed(recording)
    raw = seen.model.columns(recording, z)
    d, zw = whitened_rest(recording, raw, seen.filters), whitened_rest(recording, z, seen.filters)
    whole = zw - d @ seen.model.values
    mine = _surprise(whole, d, seen.model.covariance)
    outcomes = []
    targets = {(one.name, one.acts_on): one for one in seen.targets}
    for prediction in predictions:
        target = targets[prediction.name, prediction.acts_on]
        s = d @ seen.along(target)
        energy = float(s @ s)
        share = 1.0 + float(s @ whole) / energy if energy > 0.0 else 0.0
        unit, size = _size(recording, target, seen)
        fall = size * (2.0 * share - 1.0)
        margins = []
        for key, rival in seen.rivals.get((target.name, target.acts_on), {}).items():
            other = whitened_rest(recording, rival.columns(recording, z), seen.filters)
            margins.append((*key, _surprise(zw - other @ rival.values, other, rival.covariance) - mine))
        low, high = prediction.share_interval
        # how large the forces are that a wrong parameter scales is part of what the plan can't know
        as_large = isinstance(target, ParameterError) or (
            prediction.fall_interval[0] <= fall <= prediction.fall_interval[1]
        )
        inside = prediction.decides and low <= share <= high and as_large
        limit = max(SEPARATED, _MATERIAL_RATIO * energy)
        outcomes.append(
            Outcome(
                prediction.name, prediction.acts_on, unit, size * abs(share), size * abs(1.0 - share),
                fall, energy * (2.0 * share - 1.0), share, inside,
                tuple(row for row in margins if row[2] < -limit),
                tuple(row for row in margins if row[2] > limit),
            )
        )  # fmt: skip
    return outcomes


def _per_run(effect: Named) -> bool:
    """Tell whether an effect has another size in each run: there is nothing to predict."""
    return any(parted(name)[1].startswith("run ") for name in effect.parameters)


def _scatter(white: Sequence[tuple[np.ndarray, np.ndarray]], values: np.ndarray, along: np.ndarray) -> float:
    """Return by how much more than noise a target's share scatters between recordings, at least 1."""
    squares = 0.0
    for z, d in white:
        s = d @ along
        energy = float(s @ s)
        squares += float(s @ (z - d @ values)) ** 2 / energy if energy > 0.0 else 0.0
    return max(1.0, float(np.sqrt(squares / max(len(white) - 1, 1))))


def _share_sd(d: np.ndarray, s: np.ndarray, covariance: np.ndarray, scatter: float) -> float:
    """Return the standard deviation of an effect's share on a new recording."""
    energy = float(s @ s)
    along = d.T @ s / energy
    return scatter * float(np.sqrt(1.0 / energy + along @ covariance @ along))


def _free_energy(s: np.ndarray, d: np.ndarray, covariance: np.ndarray, others: np.ndarray) -> float:
    """Return the energy of one column that errors of other known parameters can't take over."""
    b = d[:, others]
    inner = np.linalg.inv(covariance[np.ix_(others, others)]) + b.T @ b
    along = b.T @ s
    return max(float(s @ s - along @ np.linalg.solve(inner, along)), 0.0)


def _surprise(rest: np.ndarray, d: np.ndarray, covariance: np.ndarray) -> float:
    """Return minus twice the log-likelihood of a new recording under a model that others were fitted to."""
    inner = np.linalg.inv(covariance) + d.T @ d
    along = d.T @ rest
    sign, size = np.linalg.slogdet(inner @ covariance)
    return float(rest @ rest - along @ np.linalg.solve(inner, along) + (size if sign > 0 else 0.0))


def _size(recording: Recording, target: Named | ParameterError, seen: Evidence) -> tuple[str, float]:
    """Return (unit, rms) of what a target adds along a motion: a force, or the error of a reading."""
    if isinstance(target, Named):
        known = CATALOGUE[target.name]
        values = mean_values(target)
        forces = effect_forces(recording, known, target.acts_on, [values[name] for name in known.parameters])
    else:
        forces = Forces()
        parts = hypotheses.parts_of(target.name)
        for one in (force for term, _ in seen.base if term.name in parts for force in term.forces(recording)):
            forces = scaled_forces(one, target.error, forces)
    error_m = forces.macro_sensor_m if forces.macro_sensor_m is not None else forces.end_sensor_m
    if error_m is not None:
        return "m", _rms(error_m)
    if isinstance(target, Named):
        return "N", _rms(forces.end_n if target.acts_on.startswith("micro") else forces.macro_n)
    return "N", max(_rms(forces.macro_n), _rms(forces.end_n))


def _rms(values: np.ndarray | None) -> float:
    return 0.0 if values is None else float(np.sqrt(np.mean(values * values)))


def _rivals(
    one: Named,
    named: Sequence[Named],
    terms: Sequence[Term],
    base_columns: Callable[[Recording], np.ndarray],
    prior: np.ndarray,
    base_values: np.ndarray,
    blocks: Sequence[tuple[Recording, np.ndarray, np.ndarray]],
    filters: dict[str, tuple[np.ndarray, float]],
) -> dict[tuple[str, str], _Model]:
    """Fit each alias of an effect in its place, at the shape that suits the recordings best."""
    wanted = {(name, place) for name, place, _ in one.aliases}
    if not wanted:
        return {}
    others = [effect for effect in named if effect is not one]
    best: dict[tuple[str, str], tuple[float, _Model]] = {}
    for term in terms:
        if term.key not in wanted or term.scope == "run":
            continue

        def columns(recording: Recording, rest: np.ndarray, term: Term = term) -> np.ndarray:
            found = base_columns(recording)
            free = rest - found @ base_values
            fixed = effect_columns(recording, others, free) if others else []
            return np.column_stack([found, *fixed, stacked_columns(recording, term.forces(recording))])

        white = [(whitened_rest(r, z, filters), whitened_rest(r, columns(r, z), filters)) for r, z, _ in blocks]
        precision = np.concatenate([prior[: base_values.size], np.zeros(white[0][1].shape[1] - base_values.size)])
        normal = sum((d.T @ d for _, d in white), np.diag(precision))
        normal += 1e-9 * np.diag(np.diag(normal))
        right = sum((d.T @ z for z, d in white), np.zeros(precision.size))
        values = np.linalg.solve(normal, right)
        gain = float(right @ values)
        if term.key not in best or gain > best[term.key][0]:
            best[term.key] = (gain, _Model(columns, values, np.linalg.inv(normal)))
    return {key: model for key, (_, model) in best.items()}


def _separation(
    recording: Recording, seen: Evidence, base: np.ndarray, s: np.ndarray, rival: _Model, planned: np.ndarray
) -> float:
    """Return d' between an effect as found and its best rival, after what known parameters may take over."""
    other = whitened_rest(recording, rival.columns(recording, planned), seen.filters)
    first = base.shape[1]
    mine = s + base @ seen.base_values
    apart = mine - other @ rival.values
    # Other effects stand on both sides with about the same values: they cancel.
    for number in range(other.shape[1]):
        if first <= number < first + len(seen.named) - 1:
            apart = apart + other[:, number] * rival.values[number]
    inner = np.linalg.inv(seen.model.covariance[:first, :first]) + base.T @ base
    along = base.T @ apart
    return float(np.sqrt(max(float(apart @ apart - along @ np.linalg.solve(inner, along)), 0.0)))


def with_outcomes(findings: Findings, outcomes: Sequence[Outcome]) -> Findings:
    """Return findings in which what held is confirmed, without the aliases that the run ruled out.

    A parameter that no outcome speaks of stays as it was.
    """
    by_key = {(one.name, one.acts_on): one for one in outcomes}
    named = []
    for effect in findings.named:
        outcome = by_key.get((effect.name, effect.acts_on))
        if outcome is None:
            named.append(effect)
            continue
        out = {(name, place) for name, place, _ in outcome.out}
        aliases = tuple(alias for alias in effect.aliases if alias[:2] not in out)
        named.append(replace(effect, confirmed=outcome.confirmed, aliases=aliases))
    wrong = tuple(
        replace(error, confirmed=by_key[error.name, error.acts_on].confirmed)
        if (error.name, error.acts_on) in by_key
        else error
        for error in findings.parameter_errors
    )
    return replace(findings, named=tuple(named), parameter_errors=wrong)
