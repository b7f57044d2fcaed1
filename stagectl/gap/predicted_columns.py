"""What effects, with the values of findings, add to the innovations of a recording. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.gap import balance, hypotheses
from stagectl.gap.addition import parted
from stagectl.gap.believed import Believed
from stagectl.gap.effect_forces import effect_forces
from stagectl.gap.findings import Named
from stagectl.gap.forces import Forces
from stagectl.gap.innovations import Noise
from stagectl.gap.log import Log
from stagectl.gap.noise import noise_of
from stagectl.gap.recording import Recording


def prepared(log: Log, believed: Believed, noise: dict[str, Noise] | None = None) -> Recording:
    """Prepare a log with the noise that a search of it begins with, or that of other recordings of its machine."""
    recording = balance.recording_of(log, believed)
    balance.set_noise(recording, noise_of([recording]) if noise is None else noise)
    return recording


def observed(recording: Recording) -> np.ndarray:
    """Return the innovations of all channels, one behind the other."""
    return np.concatenate(balance.observed(recording))


def column(recording: Recording, forces: Forces) -> np.ndarray:
    """Return what forces add to the innovations of all channels, one behind the other."""
    parts = zip(balance.channels(recording), balance.column(recording, forces), strict=True)
    return np.concatenate([np.zeros(size) if part is None else part for (_, size), part in parts])


@dataclass(frozen=True, slots=True)
class _Part:
    """What an effect does as found: one column, or for each amplitude with a free phase its sine and cosine."""

    column: np.ndarray | None
    pairs: tuple[tuple[np.ndarray, np.ndarray], ...] = ()


def effect_columns(recording: Recording, named: Sequence[Named], rest: np.ndarray) -> list[np.ndarray]:
    """Return what each effect does as found; phases of a homing are those that suit the rest best."""
    parts = [_part(recording, effect) for effect in named]
    waves = [wave for part in parts for pair in part.pairs for wave in pair]
    shares = np.zeros(0)
    if waves:
        fixed = sum((part.column for part in parts if part.column is not None), np.zeros(rest.size))
        stacked = np.column_stack(waves)
        scale = np.maximum(np.sqrt(np.einsum("ij,ij->j", stacked, stacked)), 1e-300)
        shares = np.linalg.lstsq(stacked / scale, rest - fixed, rcond=1e-9)[0] / scale
    found, place = [], 0
    for part in parts:
        total = np.zeros(rest.size) if part.column is None else part.column
        for sine, cosine in part.pairs:
            a, b = shares[place], shares[place + 1]
            place += 2
            length = float(np.hypot(a, b))
            a, b = (a / length, b / length) if length > 0.0 else (1.0, 0.0)
            total = total + a * sine + b * cosine
        found.append(total)
    return found


def _part(recording: Recording, effect: Named) -> _Part:
    """Evaluate an effect as found; where its phases are those of homings, at both quadratures."""
    known = CATALOGUE[effect.name]
    values = mean_values(effect)
    pairs = [(name, hypotheses.phase_of(known, name)) for name in known.linear]
    free = [(name, phase) for name, phase in pairs if phase is not None]
    if not free or {parted(name)[1] for name in effect.parameters} == {""}:
        return _Part(effect_column(recording, effect, values))
    found = []
    for name, phase in free:
        alone = values | {other: 0.0 for other, _ in free if other != name}
        sine, cosine = (effect_column(recording, effect, alone | {phase: angle}) for angle in (0.0, 0.5 * np.pi))
        found.append((sine, cosine))
    return _Part(None, tuple(found))


def mean_values(effect: Named) -> dict[str, float]:
    """Return every parameter's value, of those that differ from homing to homing the mean."""
    values: dict[str, list[float]] = {}
    for name, value in effect.parameters.items():
        values.setdefault(parted(name)[0], []).append(value)
    known = CATALOGUE[effect.name].parameters
    return {name: float(np.mean(values.get(name, [0.0]))) for name in known}


def effect_column(recording: Recording, effect: Named, values: dict[str, float]) -> np.ndarray:
    known = CATALOGUE[effect.name]
    forces = effect_forces(recording, known, effect.acts_on, [values[name] for name in known.parameters])
    return column(recording, forces)


def stacked_columns(recording: Recording, forces: Sequence[Forces]) -> np.ndarray:
    return np.column_stack([column(recording, one) for one in forces])
