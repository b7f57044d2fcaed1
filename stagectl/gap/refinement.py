"""From a hypothesis at a place of its grid to the shape that the recordings ask for.

A pitch, a Stribeck speed, a delay are searched by one line after the other, the amplitudes and all known parameters
solved for at each point (variable projection, Golub and Pereyra 1973). Effects whose size is no factor (a delay, an
edge that moves by more than the stage touches) are searched in all their parameters, at their size. Pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize_scalar

from stagectl.effects import CATALOGUE
from stagectl.gap import balance, hypotheses
from stagectl.gap.balance import Recording
from stagectl.gap.grids import FREE_SHAPES
from stagectl.gap.hypotheses import Term
from stagectl.gap.selection import Group, Sums, active_slots, normal_of

_SWEEPS = 2
_BRACKET = 2.2  # from the grid's place, up and down
_PITCH_SPANS = 0.6  # a pitch moves by so many of what turns its phase by one turn over the travel
_TOLERANCE_RATIO = 3e-3
_WORST = 1e300


@dataclass(slots=True)
class Evidence:
    """Whitened innovations and columns of all hypotheses, recording by recording, with their products."""

    recordings: Sequence[Recording]
    blocks: list[np.ndarray]  # (rows, 1 + columns); row scale is the noise
    sums: list[Sums]
    scales: list[np.ndarray]  # by which each row of a new column is divided
    terms: dict[int, Term]  # by first column
    made: dict[tuple, Group] = field(default_factory=dict)

    def columns_of(self, term: Term) -> list[np.ndarray]:
        """Return the columns of a term, one array (rows, amplitudes) a recording."""
        return [
            np.column_stack([balance.column(r, forces) for forces in term.forces(r)]) / scale[:, None]
            for r, scale in zip(self.recordings, self.scales, strict=True)
        ]

    def append(self, term: Term, columns: list[np.ndarray], prior_sds: tuple[float, ...], searched: int) -> Group:
        """Add the columns of a term to all products; returns them as a group."""
        first = self.blocks[0].shape[1]
        for k, new in enumerate(columns):
            old, s = self.blocks[k], self.sums[k]
            cross, own = old.T @ new, new.T @ new
            gram = np.block([[s.gram, cross], [cross.T, own]])
            nulls = np.hstack([s.nulls, np.zeros((s.nulls.shape[0], new.shape[1]))])
            self.sums[k] = replace(s, gram=gram, nulls=nulls)
            self.blocks[k] = np.hstack([old, new])
        self.terms[first] = term
        place = tuple(range(first, first + columns[0].shape[1]))
        return Group(term.key, place, term.scope, prior_sds, term.bounds, searched)


class Refiner:
    """Searches the shapes of single terms beside groups that stay as they are."""

    def __init__(self, evidence: Evidence, beside: Sequence[Group]):
        """Eliminate `beside` once; every trial costs its own columns only."""
        self._evidence = evidence
        self._slots, precision = active_slots(beside, evidence.sums)
        normal, right = normal_of(self._slots, precision, evidence.sums)
        scale = np.sqrt(np.diag(normal))
        scale[scale == 0.0] = 1.0
        weights = np.outer(scale, scale)
        self._inverse = np.linalg.inv(normal / weights + 1e-10 * np.eye(scale.size)) / weights
        self._values = self._inverse @ right

    def refined(self, group: Group) -> Group:
        """Return the group at its best shape, as new columns; the same group where nothing is to be searched."""
        term = self._evidence.terms[group.columns[0]]
        if term.acts_on == "parameter":
            return group
        free = FREE_SHAPES.get(term.name, ())
        entire = whole_of(term)
        if not free and not entire:
            return group
        if entire:
            term = self._at_size(term, group)
            free = tuple(dict.fromkeys((*CATALOGUE[term.name].parameters[:1], *free)))
        shape = dict(term.shape)
        best = self._gain(term)
        for sweep in range(_SWEEPS if len(free) > 1 else 1):
            for name in free:
                shape, best = self._line(term, shape, name, best, 0.5**sweep)
        found = _with_shape(term, shape)
        key = (found.key, tuple(sorted(shape.items())), self._slots)
        columns = self._evidence.columns_of(found)
        priors = tuple(max(abs(low), abs(high)) for low, high in found.bounds)
        searched = max(group.searched, len(free) - (0 if found.linear else 1))
        del key
        return self._evidence.append(found, columns, priors, searched)

    def _at_size(self, term: Term, group: Group) -> Term:
        """Take the amplitude that a first-order solution asks for into the shape."""
        effect = CATALOGUE[term.name]
        amplitude = effect.parameters[0]
        if term.linear:
            columns = [block[:, list(group.columns)] for block in self._evidence.blocks]
            value = float(self._amplitudes(columns, term)[0])
            shape = {name: term.shape.get(name, 0.0) for name in effect.parameters} | {amplitude: value}
        else:
            columns = [block[:, list(group.columns)] for block in self._evidence.blocks]
            share = float(self._amplitudes(columns, term)[0])
            low, high = effect.bounds[amplitude]
            value = float(np.clip(share * term.shape[amplitude], 0.02 * term.shape[amplitude], high))
            shape = dict(term.shape) | {amplitude: max(value, low)}
        return hypotheses.term_at_size(effect, term.acts_on, shape)

    def _line(
        self, term: Term, shape: dict[str, float], name: str, best: float, narrow: float
    ) -> tuple[dict[str, float], float]:
        """Search one parameter of the shape near where it is."""
        effect = CATALOGUE[term.name]
        at = shape[name]
        low, high = effect.bounds[name]
        if name == "pitch_m":
            span = max(float(np.ptp(r.position_m(_axis(term)))) for r in self._evidence.recordings)
            reach = narrow * _PITCH_SPANS * at * at / span
            low, high = max(low, at - reach), min(high, at + reach)
        elif name == "frequency_hz" and effect.name == "base_vibration":
            reach = narrow * 0.5 / max(r.log.samples_count * r.log.period_s for r in self._evidence.recordings)
            low, high = max(low, at - reach), min(high, at + reach)
        else:
            factor = _BRACKET**narrow
            ends = sorted((at / factor, at * factor))
            low, high = max(low, ends[0]), min(high, ends[1])
        if not high > low:
            return shape, best

        def loss(value: float) -> float:
            return -self._gain(_with_shape(term, shape | {name: float(value)}))

        outcome = minimize_scalar(
            loss,
            bounds=(low, high),
            method="bounded",
            options={"xatol": _TOLERANCE_RATIO * (high - low), "maxiter": 16},
        )
        if -outcome.fun > best:
            return shape | {name: float(outcome.x)}, float(-outcome.fun)
        return shape, best

    def _gain(self, term: Term) -> float:
        """Return what a term gains beside the others; at its size without any freedom of its own."""
        try:
            columns = self._evidence.columns_of(term)
        except (FloatingPointError, ValueError):
            return -_WORST
        normal, right = self._reduced(columns, term)
        if not term.linear:
            ones = np.ones(right.size)
            return float(2.0 * ones @ right - ones @ normal @ ones)
        return float(right @ self._solved(normal, right))

    def _amplitudes(self, columns: list[np.ndarray], term: Term) -> np.ndarray:
        return self._solved(*self._reduced(columns, term))

    @staticmethod
    def _solved(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        weights = np.outer(scale, scale)
        return np.linalg.solve(normal / weights + 1e-10 * np.eye(scale.size), right / scale) / scale

    def _reduced(self, columns: list[np.ndarray], term: Term) -> tuple[np.ndarray, np.ndarray]:
        """Return (normal matrix, right side) of a term's amplitudes with everything beside it eliminated."""
        sums = self._evidence.sums
        places = scopes_of(term.scope, sums)
        width = columns[0].shape[1]
        size = width * len(places)
        normal, right = np.zeros((size, size)), np.zeros(size)
        cross = np.zeros((len(self._slots), size))
        for s, block, new in zip(sums, self._evidence.blocks, columns, strict=True):
            at = next(k for k, scope in enumerate(places) if scope in ("", f"session {s.session}", f"run {s.run}"))
            mine = slice(at * width, (at + 1) * width)
            here = [
                k for k, (_, scope) in enumerate(self._slots) if scope in ("", f"session {s.session}", f"run {s.run}")
            ]
            active = block[:, [self._slots[k][0] for k in here]]
            cross[here, mine] += active.T @ new
            normal[mine, mine] += new.T @ new
            right[mine] += new.T @ block[:, 0]
        return normal - cross.T @ self._inverse @ cross, right - cross.T @ self._values


def scopes_of(scope: str, sums: Sequence[Sums]) -> tuple[str, ...]:
    """Return the places that amplitudes of a scope belong to."""
    if scope == "session":
        return tuple(sorted({f"session {s.session}" for s in sums}))
    if scope == "run":
        return tuple(sorted({f"run {s.run}" for s in sums}))
    return ("",)


def whole_of(term: Term) -> bool:
    """Tell whether an effect has to be taken at its size: its column is only the beginning of what it does."""
    effect = CATALOGUE[term.name]
    moves = term.acts_on == "contact_edge" or (term.acts_on.endswith("_sensor") and term.name != "cyclic_error")
    return moves or not effect.linear


def _axis(term: Term) -> str:
    return "macro" if term.acts_on.startswith("macro") else "end"


def _with_shape(term: Term, shape: dict[str, float]) -> Term:
    effect = CATALOGUE[term.name]
    if term.linear:
        return hypotheses.term_of(effect, term.acts_on, shape)
    return hypotheses.term_at_size(effect, term.acts_on, shape)
