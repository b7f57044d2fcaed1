"""What the recordings say to every hypothesis: whitened innovations and columns, and all their products.

Most hypotheses move one body only, so a column is kept channel by channel, and only where it is not zero: a quarter of
the products of the whole table. Pure.
"""

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from stagectl import effect_text
from stagectl.gap import balance
from stagectl.gap.crew import Crew, Serial
from stagectl.gap.hypotheses import Term
from stagectl.gap.noise import is_low_passed, scale_of
from stagectl.gap.normal_equations import Group, Sums
from stagectl.gap.recording import Recording

INNOVATIONS = 0
"""Number of the column that the others are to explain."""

_REST_PASSES = 3
_LEAST_SCALE = 0.5

_KEPT_BYTES = 1.6e9
"""Columns of trials at their size are kept up to here, first come: a rank asks for the same ones beside others. With
0.4e9 four recordings of 20 s took 28.1 s in place of 26.6, and 3.1 GB in place of 4.0."""

Scales = list[list[float]]
"""By recording, by channel: its noise."""

Columns = list[list[np.ndarray | None]]
"""By recording, by channel: (amplitudes, rows) of a term, None where it is zero."""


@dataclass(slots=True)
class Channel:
    """Rows of one channel of one recording; `rows[k]` is the column of number `numbers[k]`."""

    name: str
    numbers: list[int]
    rows: list[np.ndarray]
    scale: float = 1.0
    blocks: list[np.ndarray] = field(default_factory=list)
    """The same rows in their order, as the tables that they are parts of: products are taken table by table."""

    def of(self, wanted: Sequence[int]) -> tuple[list[int], np.ndarray | None]:
        """Return (which of the wanted columns are not zero here, their rows)."""
        at = {number: k for k, number in enumerate(self.numbers)}
        here = [place for place, number in enumerate(wanted) if number in at]
        return here, np.stack([self.rows[at[wanted[place]]] for place in here]) if here else None


class Origin(NamedTuple):
    """Where a recording comes from: amplitudes may belong to its session, or to it alone."""

    session: str
    run: str


class Added(NamedTuple):
    """A term that is to be one of those that compete."""

    term: Term
    columns: Columns
    prior_sds: tuple[float, ...]
    searched: int


class Evidence:
    """All columns of all recordings, growing as hypotheses get new ones.

    In another process it begins with the innovations, and takes those columns in that are asked for there.
    """

    def __init__(self, recordings: Sequence[Recording], crew: Crew | None = None):
        """Begin with the innovations alone; `crew` does what is to be done for many terms or recordings."""
        self.recordings = recordings
        self.crew: Crew = crew or Serial()
        self.terms: dict[int, Term] = {}
        self.sums: list[Sums] = []
        self._count = 1
        self.channels: list[list[Channel]] = self.crew.here(_innovations_of, recordings)
        self._begin()

    def _begin(self) -> None:
        self._kept: dict[object, Columns] = {}
        self._kept_bytes = 0
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Leave behind what another process makes for itself: columns, their sums, quantities along the motion."""
        return {
            "recordings": [
                replace(recording, known={}, exchanged={}, others_n={}, pushed_n={}, driven_n={})
                for recording in self.recordings
            ],
            "channels": [
                [replace(one, numbers=[INNOVATIONS], rows=one.rows[:1]) for one in channels]
                for channels in self.channels
            ],
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin in another process, where the user's own effects may be unknown yet."""
        self.recordings, self.channels = state["recordings"], state["channels"]
        for title, text in self.recordings[0].believed.effect_texts:
            effect_text.declare(text, title)
        self.crew, self.terms, self.sums, self._count = Serial(), {}, [], 1
        self._begin()

    @property
    def origins(self) -> list[Origin]:
        """Session and run of each recording."""
        return [Origin(recording.log.session, recording.log.name) for recording in self.recordings]

    def places_count(self, scope: str) -> int:
        """Return how many amplitudes of its own a term of this scope has for each of its columns."""
        logs = [recording.log for recording in self.recordings]
        return {"session": len({log.session for log in logs}), "run": len(logs)}.get(scope, 1)

    def columns_of(self, term: Term) -> Columns:
        """Return the columns of a term in units of the noise."""

        def of_one(number: int) -> list[np.ndarray | None]:
            recording, channels = self.recordings[number], self.channels[number]
            parts = [balance.column(recording, forces) for forces in term.forces(recording)]
            return [_stacked([part[c] for part in parts], channel.scale) for c, channel in enumerate(channels)]

        return self.crew.helped(of_one, range(len(self.recordings)))

    def columns_of_trial(self, term: Term) -> Columns:
        """Return the columns of a term that is looked at beside other groups again."""
        key = (term.key, tuple(term.shape.items()))
        with self._lock:
            kept = self._kept.get(key)
        if kept is not None:
            return kept
        columns = self.columns_of(term)
        size = sum(part.nbytes for parts in columns for part in parts if part is not None)
        with self._lock:
            if key not in self._kept and self._kept_bytes + size <= _KEPT_BYTES:
                self._kept[key] = columns
                self._kept_bytes += size
        return columns

    def forget_trials(self) -> None:
        """Give back what is kept of trials."""
        with self._lock:
            self._kept, self._kept_bytes = {}, 0

    def add(self, term: Term) -> tuple[int, ...]:
        """Take the columns of a term in, before anything is summed; returns their numbers."""
        return self._keep(term, self.columns_of(term))

    def add_all(self, terms: Iterable[Term]) -> list[tuple[int, ...]]:
        """Take the columns of terms in, before anything is summed; returns their numbers, term by term."""
        terms = list(terms)
        return [
            self._keep(term, columns)
            for term, columns in zip(terms, self.crew.here(self.columns_of, terms), strict=True)
        ]

    def hold(self, terms: Mapping[int, Term]) -> None:
        """Take the columns of terms in that are not here yet, under the numbers that they have elsewhere."""
        with self._lock:
            for first, term in terms.items():
                if first not in self.terms:
                    self._put(term, self.columns_of(term), first)

    def _keep(self, term: Term, columns: Columns) -> tuple[int, ...]:
        numbers = self._put(term, columns, self._count)
        self._count += len(numbers)
        return numbers

    def _put(self, term: Term, columns: Columns, first: int) -> tuple[int, ...]:
        numbers = tuple(range(first, first + len(term.amplitudes)))
        for channels, parts in zip(self.channels, columns, strict=True):
            for channel, part in zip(channels, parts, strict=True):
                if part is not None:
                    channel.numbers += numbers
                    channel.rows += list(part)
                    channel.blocks.append(part)
        self.terms[numbers[0]] = term
        return numbers

    def rest(self, recording: int, channel: int, prior_sds: np.ndarray) -> np.ndarray:
        """Return the innovations of one channel without everything that columns with these priors explain.

        prior_sds: by column number from 1 on. Amplitudes keep to their priors: free, a scale error of the sensor and
        one of the forces explain any motion whole.
        """
        one = self.channels[recording][channel]
        z = one.rows[0]
        used = [k for k, number in enumerate(one.numbers) if 0 < number <= prior_sds.size and one.rows[k].any()]
        if not used:
            return z
        rows = np.stack([one.rows[k] for k in used])
        sds = prior_sds[[one.numbers[k] - 1 for k in used]]
        normal, right = rows @ rows.T, rows @ z
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        normal, right = normal / np.outer(scale, scale), right / scale
        variance, square = 1.0, float(z @ z)
        theta = np.zeros(right.size)
        for _ in range(_REST_PASSES):
            theta = np.linalg.solve(normal + np.diag(variance / (scale * sds) ** 2 + 1e-9), right)
            variance = max(square - 2.0 * float(theta @ right) + float(theta @ normal @ theta), 1e-300) / z.size
        return z - (theta / scale) @ rows

    @property
    def scales(self) -> Scales:
        """What every channel was scaled by."""
        return [[channel.scale for channel in channels] for channels in self.channels]

    def finish(self, known_sds: np.ndarray, nulls_count: int, seed: int, scales: Scales | None = None) -> None:
        """Scale every channel by its noise, or by `scales` of other evidence that is compared with this, and sum.

        The noise is as large as it is at the highest frequencies, where no force reaches, once the known parameters
        (`known_sds`, the first columns) are free within what is stated. Taken from all that is left it would hide
        whatever nobody explains; beside the whole library, some columns of which hold measured accelerations, it came
        out a tenth too small.
        """

        def summed(k: int) -> Sums:
            given = None if scales is None else scales[k]
            return self._summed(k, known_sds, nulls_count, np.random.default_rng([seed, k]), given)

        self.sums += self.crew.here(summed, range(len(self.recordings)))

    def _summed(
        self, k: int, known_sds: np.ndarray, nulls_count: int, random: np.random.Generator, scales: list[float] | None
    ) -> Sums:
        """Scale the channels of one recording and sum them."""
        size = self._count
        gram, nulls, count = np.zeros((size, size)), np.zeros((nulls_count, size - 1)), 0
        for c, channel in enumerate(self.channels[k]):
            channel.scale = self._noise(k, c, known_sds) if scales is None else scales[c]
            rows = np.stack(channel.rows) / channel.scale
            channel.rows, channel.blocks = list(rows), [rows]
            gram[np.ix_(channel.numbers, channel.numbers)] += rows @ rows.T
            at = np.array(channel.numbers[1:], dtype=int) - 1
            nulls[:, at] += random.standard_normal((nulls_count, rows.shape[1])) @ rows[1:].T
            count += rows.shape[1]
        return Sums(gram, float(count), *self.origins[k], nulls)

    def _noise(self, recording: int, channel: int, known_sds: np.ndarray) -> float:
        """Return how large innovations are at the highest frequencies beside known parameters."""
        one, axis = self.recordings[recording], self.channels[recording][channel].name
        low_passed = axis in one.axes and is_low_passed(one, axis)
        return max(scale_of(self.rest(recording, channel, known_sds), low_passed), _LEAST_SCALE)

    def append(self, term: Term, columns: Columns, prior_sds: tuple[float, ...], searched: int) -> Group:
        """Add the columns of a term to all products; returns them as a group."""
        return self.append_all([Added(term, columns, prior_sds, searched)])[0]

    def append_all(self, added: Sequence[Added]) -> list[Group]:
        """Add the columns of some terms to all products at once; returns them as groups.

        One after the other each of six reads all the rows there are: three times the time.
        """
        if not added:
            return []
        firsts = np.cumsum([0, *(len(one.term.amplitudes) for one in added)])
        products = self.crew.here(
            lambda k: self._products(k, [one.columns[k] for one in added], firsts), range(len(self.sums))
        )
        groups = []
        for term, columns, prior_sds, searched in added:
            numbers = self._keep(term, columns)
            places_count = self.places_count(term.scope)
            is_slope = term.is_slope
            groups.append(
                Group(term.key, numbers, term.scope, prior_sds, term.bounds, searched, places_count, is_slope)
            )
        for k, (cross, own) in enumerate(products):
            s = self.sums[k]
            nulls = np.hstack([s.nulls, np.zeros((s.nulls.shape[0], own.shape[0]))])
            self.sums[k] = replace(s, gram=np.block([[s.gram, cross], [cross.T, own]]), nulls=nulls)
        return groups

    def _products(
        self, k: int, parts: Sequence[list[np.ndarray | None]], firsts: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the products of terms' columns in recording `k` with all that there are, and with each other.

        parts: by term, by channel; firsts: which of the new columns is the first one of each term, and how many.
        """
        cross, own = np.zeros((self._count, firsts[-1])), np.zeros((firsts[-1], firsts[-1]))
        for channel, here in zip(self.channels[k], zip(*parts, strict=True), strict=True):
            there = [j for j, part in enumerate(here) if part is not None]
            if not there:
                continue
            at = [k for j in there for k in range(firsts[j], firsts[j + 1])]
            rows = np.concatenate([part for part in here if part is not None])
            cross[np.ix_(channel.numbers, at)] += np.concatenate([block @ rows.T for block in channel.blocks])
            own[np.ix_(at, at)] += rows @ rows.T
        return cross, own


def _innovations_of(recording: Recording) -> list[Channel]:
    names = [name for name, _ in balance.channels(recording)]
    innovations = zip(names, balance.observed(recording), strict=True)
    return [Channel(name, [INNOVATIONS], [z], blocks=[z[None, :]]) for name, z in innovations]


def _stacked(parts: list[np.ndarray | None], scale: float) -> np.ndarray | None:
    """Return (amplitudes, rows) of one channel, None where all are zero."""
    size = next((part.size for part in parts if part is not None), 0)
    if not size:
        return None
    if len(parts) == 1 and parts[0] is not None:
        return parts[0][None, :] / scale
    return np.stack([np.zeros(size) if part is None else part for part in parts]) / scale
