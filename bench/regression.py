"""The gap as a regression: what the balance of forces leaves, and a column for every effect of the library.

This is the form in which general tools can compete: both sides pass the same filter, reversals are masked, parameters
that are known but uncertain are taken out under their priors. Nothing here decides on names. Pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import butter, sosfiltfilt

from stagectl.gap import balance, hypotheses
from stagectl.gap.believed import Believed
from stagectl.gap.effect_forces import known_forces
from stagectl.gap.forces import Forces
from stagectl.gap.grids import grids_for
from stagectl.gap.hypotheses import Term
from stagectl.gap.log import Log
from stagectl.gap.recording import Recording

LEFT_OUT = ("scale_error",)
"""A reading that is all too large makes the whole balance too large: with it and a wrong mass a regression without
bounds explains everything, whatever the truth."""

BAND_HZ = 40.0
_ROWS_PER_S = 100.0
_EDGE_S = 0.5
_PITCHES_COUNT = 4
_SHORTEST_PITCH_M = 1e-3
_FINENESS, _APART = 0.1, 3.0  # of the grid of pitches, and between two of them, in lines of the spectrum


@dataclass(frozen=True, slots=True)
class Side:
    """Rows of some recordings: what is left of the balance, in units of its noise, and the columns."""

    left: np.ndarray
    columns: np.ndarray
    base: np.ndarray
    runs: np.ndarray  # number of the recording of each row
    scale: np.ndarray  # N of one unit, each row


@dataclass(frozen=True, slots=True)
class Problem:
    """Training and held-out rows, and which term each column belongs to."""

    terms: tuple[Term, ...]
    owner: np.ndarray  # place of its term, each column
    base: tuple[str, ...]  # known parameters
    base_precision: np.ndarray
    training: Side
    held: Side

    def cleaned(self) -> tuple[np.ndarray, np.ndarray]:
        """Return training rows and columns, free of what known parameters within their uncertainty explain."""
        side = self.training
        normal = side.base.T @ side.base + np.diag(self.base_precision)
        taken = np.linalg.solve(normal, side.base.T @ np.column_stack([side.left, side.columns]))
        rest = np.column_stack([side.left, side.columns]) - side.base @ taken
        return rest[:, 0], rest[:, 1:]

    def gap_n(self, coefficients: np.ndarray) -> tuple[float, float]:
        """Return the rms force that is left on training and held-out rows, known parameters refitted on training."""
        base = self._base(coefficients)
        left = [
            (one.left - one.columns @ coefficients - one.base @ base) * one.scale for one in (self.training, self.held)
        ]
        return float(np.sqrt(np.mean(left[0] ** 2))), float(np.sqrt(np.mean(left[1] ** 2)))

    def refitted(self, coefficients: np.ndarray) -> dict[str, float]:
        """Return the error of every known parameter, beside these coefficients: a ratio, or metres, or seconds."""
        return dict(zip(self.base, self._base(coefficients).tolist(), strict=True))

    def _base(self, coefficients: np.ndarray) -> np.ndarray:
        side = self.training
        normal = side.base.T @ side.base + np.diag(self.base_precision)
        return np.linalg.solve(normal, side.base.T @ (side.left - side.columns @ coefficients))

    def chosen(self, coefficients: np.ndarray) -> list[Term]:
        """Return the terms that have a coefficient."""
        return [self.terms[k] for k in sorted({int(self.owner[c]) for c in np.flatnonzero(coefficients)})]

    def force_laws(self) -> "Problem":
        """Return the same rows with forces on an axis alone that have an amplitude: no contact, drive, sensor, mode."""
        kept = [k for k, term in enumerate(self.terms) if term.acts_on.endswith("_force") and term.linear]
        columns = np.isin(self.owner, kept)
        sides = (replace(side, columns=side.columns[:, columns]) for side in (self.training, self.held))
        owner = np.searchsorted(kept, self.owner[columns])
        return Problem(tuple(self.terms[k] for k in kept), owner, self.base, self.base_precision, *sides)


def problem_of(believed: Believed, training: Sequence[Log], held: Sequence[Log]) -> Problem:
    """Put recordings into the form of a regression; without a recording kept apart the last one is held out."""
    if not held:
        training, held = training[:-1], training[-1:]
    recordings = [balance.recording_of(log, believed) for log in (*training, *held)]
    base = hypotheses.parameter_terms(recordings[0])
    terms = [term for term in hypotheses.effect_terms(recordings, grids_for(recordings)) if term.name not in LEFT_OUT]
    blocks = [_block(recording, [term for term, _ in base], terms) for recording in recordings]
    periodic = _periodic(recordings[: len(training)], blocks[: len(training)])
    more = [_columns(recording, periodic) for recording in recordings]
    terms += periodic
    scale = _noise_n(blocks[: len(training)], recordings)
    owner = np.concatenate([np.full(len(term.amplitudes), k) for k, term in enumerate(terms)])
    sides = [
        _side(blocks[part], more[part], scale, offset)
        for part, offset in ((slice(None, len(training)), 0), (slice(len(training), None), len(training)))
    ]
    names = tuple(term.name for term, _ in base)
    return Problem(tuple(terms), owner, names, np.array([sd**-2.0 for _, sd in base]), *sides)


@dataclass(frozen=True, slots=True)
class _Rows:
    left: np.ndarray
    base: np.ndarray
    columns: np.ndarray
    axis: np.ndarray


def _block(recording: Recording, base: list[Term], terms: list[Term]) -> _Rows:
    known = known_forces(recording)
    parts, axes = [], []
    for number, axis in enumerate(recording.axes):
        known_n = known.macro_n if axis == "macro" else known.end_n
        inertia_n = recording.mass_kg(axis) * _second(recording, recording.position_m(axis))
        left = _sampled(recording, axis, inertia_n - _between(recording, known_n))
        parts.append(left)
        axes.append(np.full(left.size, number))
    return _Rows(np.concatenate(parts), _columns(recording, base), _columns(recording, terms), np.concatenate(axes))


def _columns(recording: Recording, terms: list[Term]) -> np.ndarray:
    found = [_column(recording, forces) for term in terms for forces in term.forces(recording)]
    rows = sum(_sampled(recording, axis, np.zeros(recording.log.samples_count)).size for axis in recording.axes)
    return np.column_stack(found) if found else np.zeros((rows, 0))


def _column(recording: Recording, forces: Forces) -> np.ndarray:
    parts = []
    for axis, force_n, sensor_m in (
        ("macro", forces.macro_n, forces.macro_sensor_m),
        ("end", forces.end_n, forces.end_sensor_m),
    ):
        if axis in recording.axes:
            total = _between(recording, force_n)
            if sensor_m is not None:
                total = total + recording.mass_kg(axis) * _second(recording, sensor_m)
            parts.append(_sampled(recording, axis, total))
    return np.concatenate(parts)


def _second(recording: Recording, values: np.ndarray) -> np.ndarray:
    """Return the second difference over the square of the period: a mean of the acceleration over two intervals."""
    inner = np.diff(values, 2) / recording.log.period_s**2
    return np.concatenate([inner[:1], inner, inner[-1:]])


def _between(recording: Recording, force_n: np.ndarray | None) -> np.ndarray:
    """Return the mean of a force over the same two intervals."""
    if force_n is None:
        return np.zeros(recording.log.samples_count)
    means = force_n.mean(axis=1)
    return 0.5 * (means + np.concatenate([means[:1], means[:-1]]))


def _sampled(recording: Recording, axis: str, values: np.ndarray) -> np.ndarray:
    """Filter, take every tenth or so, and leave out the ends and where the sign of the velocity can't be trusted."""
    period_s = recording.log.period_s
    sos = butter(4, 2.0 * BAND_HZ * period_s, output="sos")
    step, edge = round(1.0 / (_ROWS_PER_S * period_s)), round(_EDGE_S / period_s)
    reach = round(0.02 / period_s)
    slow = np.convolve(recording.motion(axis).slow, np.ones(2 * reach + 1), "same") > 0.5
    keep = recording.log.valid & ~slow
    keep[:edge] = keep[-edge:] = False
    return np.asarray(sosfiltfilt(sos, values))[::step][keep[::step]]


def _noise_n(blocks: list[_Rows], recordings: list[Recording]) -> np.ndarray:
    """Return what each axis leaves at best, all columns at hand, N: the unit in which rows are compared."""
    found = []
    for number in range(len(recordings[0].axes)):
        left = np.concatenate([block.left[block.axis == number] for block in blocks])
        columns = np.vstack([np.column_stack([b.base, b.columns])[b.axis == number] for b in blocks])
        size = np.sqrt(np.mean(columns**2, axis=0))
        used = columns[:, size > 0.0] / size[size > 0.0]
        rest = left - used @ np.linalg.lstsq(used, left, rcond=1e-8)[0] if left.size else left
        found.append(float(np.sqrt(np.mean(rest**2))) if left.size else 1.0)
    return np.array(found)


def _side(blocks: list[_Rows], more: list[np.ndarray], scale: np.ndarray, offset: int) -> Side:
    each = np.concatenate([scale[block.axis] for block in blocks])
    return Side(
        np.concatenate([block.left for block in blocks]) / each,
        np.vstack([np.column_stack([b.columns, m]) for b, m in zip(blocks, more, strict=True)]) / each[:, None],
        np.vstack([block.base for block in blocks]) / each[:, None],
        np.concatenate([np.full(block.left.size, offset + k) for k, block in enumerate(blocks)]),
        each,
    )


def _periodic(recordings: list[Recording], blocks: list[_Rows]) -> list[Term]:
    """Make terms of the pitches that stand out of what all other columns leave, as a user would from a spectrum."""
    terms: list[Term] = []
    for number, axis in enumerate(recordings[0].axes):
        left = np.concatenate([block.left[block.axis == number] for block in blocks])
        columns = np.vstack([np.column_stack([b.base, b.columns])[b.axis == number] for b in blocks])
        if left.size < 2 * columns.shape[1]:
            continue
        size = np.sqrt(np.mean(columns**2, axis=0))
        used = columns[:, size > 0.0] / size[size > 0.0]
        rest = left - used @ np.linalg.lstsq(used, left, rcond=1e-8)[0]
        place_m = np.concatenate([_sampled_place(recording, axis) for recording in recordings])
        pitches = _pitches_m(place_m, rest)
        terms += hypotheses.periodic_terms(recordings, axis, pitches, pitches, [])
    return terms


def _sampled_place(recording: Recording, axis: str) -> np.ndarray:
    return _sampled(recording, axis, recording.position_m(axis))


def _pitches_m(place_m: np.ndarray, rest: np.ndarray) -> list[float]:
    """Return the periods over position at which most of the rest is found, by least squares (Lomb-Scargle)."""
    span_m = float(np.ptp(place_m))
    if not span_m > 4.0 * _SHORTEST_PITCH_M:
        return []
    waves_per_m = np.arange(2.0 / span_m, 1.0 / _SHORTEST_PITCH_M, _FINENESS / span_m)
    power = np.array([abs(np.exp(2j * np.pi * f * place_m) @ rest) ** 2 for f in waves_per_m])
    found: list[float] = []
    for k in np.argsort(-power):
        if all(abs(waves_per_m[k] - f) > _APART / span_m for f in found):
            found.append(float(waves_per_m[k]))
        if len(found) == _PITCHES_COUNT:
            break
    return [1.0 / f for f in found]
