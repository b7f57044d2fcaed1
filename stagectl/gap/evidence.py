"""What the recordings say to every hypothesis: whitened innovations and columns, and all their products.

Most hypotheses move one body only, so a column is kept channel by channel, and only where it is not zero: a quarter of
the products of the whole table. Pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stagectl.gap import balance
from stagectl.gap.balance import Recording
from stagectl.gap.hypotheses import Term
from stagectl.gap.normal_equations import Group, Sums

INNOVATIONS = 0
"""Number of the column that the others are to explain."""

_REST_PASSES = 3
_HIGH_SHARE = 0.3  # of the sample rate: above it forces move nothing
_LEAST_SCALE = 0.5

Columns = list[list[np.ndarray | None]]
"""By recording, by channel: (amplitudes, rows) of a term, None where it is zero."""


@dataclass(slots=True)
class Channel:
    """Rows of one channel of one recording; `rows[k]` is the column of number `numbers[k]`."""

    name: str
    numbers: list[int]
    rows: list[np.ndarray]
    scale: float = 1.0

    def of(self, wanted: Sequence[int]) -> tuple[list[int], np.ndarray | None]:
        """Return (which of the wanted columns are not zero here, their rows)."""
        at = {number: k for k, number in enumerate(self.numbers)}
        here = [place for place, number in enumerate(wanted) if number in at]
        return here, np.stack([self.rows[at[wanted[place]]] for place in here]) if here else None


class Evidence:
    """All columns of all recordings, growing as hypotheses get new ones."""

    def __init__(self, recordings: Sequence[Recording]):
        """Begin with the innovations alone."""
        self.recordings = recordings
        self.terms: dict[int, Term] = {}
        self.sums: list[Sums] = []
        self.channels: list[list[Channel]] = []
        self._count = 1
        for recording in recordings:
            names = [name for name, _ in balance.channels(recording)]
            observed = balance.observed(recording)
            self.channels.append([Channel(name, [INNOVATIONS], [z]) for name, z in zip(names, observed, strict=True)])

    def places_count(self, scope: str) -> int:
        """Return how many amplitudes of its own a term of this scope has for each of its columns."""
        logs = [recording.log for recording in self.recordings]
        return {"session": len({log.session for log in logs}), "run": len(logs)}.get(scope, 1)

    def columns_of(self, term: Term) -> Columns:
        """Return the columns of a term in units of the noise."""
        found: Columns = []
        for recording, channels in zip(self.recordings, self.channels, strict=True):
            parts = [balance.column(recording, forces) for forces in term.forces(recording)]
            found.append([_stacked([part[c] for part in parts], channel.scale) for c, channel in enumerate(channels)])
        return found

    def add(self, term: Term) -> tuple[int, ...]:
        """Take the columns of a term in, before anything is summed."""
        return self._keep(term, self.columns_of(term))

    def _keep(self, term: Term, columns: Columns) -> tuple[int, ...]:
        numbers = tuple(range(self._count, self._count + len(term.amplitudes)))
        self._count += len(numbers)
        for channels, parts in zip(self.channels, columns, strict=True):
            for channel, part in zip(channels, parts, strict=True):
                if part is not None:
                    channel.numbers += numbers
                    channel.rows += list(part)
        self.terms[numbers[0]] = term
        return numbers

    def rest(self, recording: int, channel: int, prior_sds: np.ndarray) -> np.ndarray:
        """Return the innovations of one channel without everything that columns with these priors explain.

        prior_sds: by column number from 1 on. Amplitudes keep to their priors: free, a scale error of the sensor and
        one of the forces explain any motion whole.
        """
        one = self.channels[recording][channel]
        z = one.rows[0]
        used = [k for k, number in enumerate(one.numbers) if 0 < number <= prior_sds.size]
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

    def finish(self, known_sds: np.ndarray, nulls_count: int, seed: int) -> None:
        """Scale every channel by its noise, and sum.

        The noise is as large as it is at the highest frequencies, where no force reaches, once the known parameters
        (`known_sds`, the first columns) are free within what is stated. Taken from all that is left it would hide
        whatever nobody explains; beside the whole library, some columns of which hold measured accelerations, it came
        out a tenth too small.
        """
        size = self._count
        for k, (recording, channels) in enumerate(zip(self.recordings, self.channels, strict=True)):
            random = np.random.default_rng([seed, k])
            gram, nulls, count = np.zeros((size, size)), np.zeros((nulls_count, size - 1)), 0
            for c, channel in enumerate(channels):
                left = self.rest(k, c, known_sds)
                power = np.abs(np.fft.rfft(left)) ** 2 / left.size
                high = np.fft.rfftfreq(left.size) > _HIGH_SHARE
                channel.scale = max(float(np.sqrt(np.mean(power[high]))), _LEAST_SCALE)
                rows = np.stack(channel.rows) / channel.scale
                channel.rows = list(rows)
                gram[np.ix_(channel.numbers, channel.numbers)] += rows @ rows.T
                at = np.array(channel.numbers[1:], dtype=int) - 1
                nulls[:, at] += random.standard_normal((nulls_count, left.size)) @ rows[1:].T
                count += left.size
            self.sums.append(Sums(gram, float(count), recording.log.session, recording.log.name, nulls))

    def append(self, term: Term, columns: Columns, prior_sds: tuple[float, ...], searched: int) -> Group:
        """Add the columns of a term to all products; returns them as a group."""
        before = self._count
        products = []
        for channels, parts in zip(self.channels, columns, strict=True):
            cross = np.zeros((before, len(term.amplitudes)))
            own = np.zeros((len(term.amplitudes), len(term.amplitudes)))
            for channel, part in zip(channels, parts, strict=True):
                if part is not None:
                    for number, row in zip(channel.numbers, channel.rows, strict=True):
                        cross[number] += part @ row
                    own += part @ part.T
            products.append((cross, own))
        numbers = self._keep(term, columns)
        for k, (cross, own) in enumerate(products):
            s = self.sums[k]
            nulls = np.hstack([s.nulls, np.zeros((s.nulls.shape[0], len(numbers)))])
            self.sums[k] = replace(s, gram=np.block([[s.gram, cross], [cross.T, own]]), nulls=nulls)
        return Group(term.key, numbers, term.scope, prior_sds, term.bounds, searched, self.places_count(term.scope))


def _stacked(parts: list[np.ndarray | None], scale: float) -> np.ndarray | None:
    """Return (amplitudes, rows) of one channel, None where all are zero."""
    size = next((part.size for part in parts if part is not None), 0)
    if not size:
        return None
    return np.stack([np.zeros(size) if part is None else part for part in parts]) / scale
