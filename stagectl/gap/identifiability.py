"""Which hypotheses a set of recordings can't tell apart: rank of their Fisher information, and the directions it lacks.

With whitened columns c_j at stated sizes s_j, what else is free eliminated (known parameters within what is stated),

    F = C'C - C'B (B'B + P)^-1 B'C

says what the recordings hold of a set. Scaled to columns of unit energy its eigenvectors are combinations of members
that would do the same; the largest amplitudes along one that keep to the stated sizes change twice the log-likelihood
by its loss. A direction whose loss is below `ALIAS_GAIN` is not seen: the power to separate is below 0.9 at 5 % false
alarms. No data enters but the motion, so planned moves can be asked as well. Pure.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from stagectl.gap import balance, hypotheses
from stagectl.gap.alias_sets import SIGNALS, AliasSet, alias_sets
from stagectl.gap.believed import Believed
from stagectl.gap.evidence import Evidence
from stagectl.gap.hypotheses import Term
from stagectl.gap.judge import ALIAS_GAIN
from stagectl.gap.log import Log
from stagectl.gap.moves import Move
from stagectl.gap.noise import noise_of, slow_noise
from stagectl.gap.normal_equations import Group, Sums, active_slots, normal_of
from stagectl.gap.planned import planned_log
from stagectl.gap.recording import Recording

_JITTER = 1e-10
_HIGH_SHARE = 0.3  # of the sample rate
_PART = 0.02  # of a unit direction: members that take less part in it are not of it
_FALSE_RATE = 0.05


@dataclass(frozen=True, slots=True)
class Separation:
    """What some recordings can tell of one set."""

    name: str
    why: str
    rank: int
    columns: int
    inseparable: tuple[tuple[str, ...], ...]  # members of which only combinations are known
    power: float  # to separate the closest that are excited; 1 at most
    not_excited: tuple[str, ...]
    remedies: tuple[str, ...]

    @property
    def whole(self) -> bool:
        """Whether every member is told from all others."""
        return self.rank == self.columns

    @property
    def text(self) -> str:
        """One line for a report."""
        alike = "; ".join(" / ".join(names) for names in self.inseparable)
        unseen = f"not excited: {', '.join(self.not_excited)}" if self.not_excited else ""
        split = f"splits: {', '.join(self.remedies)}" if self.remedies else ""
        return f"{self.name}: " + (". ".join(part for part in (alike, unseen, split) if part) or "told apart")


def not_separable(recordings: Sequence[Recording]) -> tuple[Separation, ...]:
    """Return the sets of which these recordings, whose noise is set, can't tell the members apart: for a report."""
    return tuple(one for one in separations(recordings) if one.inseparable)


def separations(
    recordings: Sequence[Recording],
    sets: Sequence[AliasSet] | None = None,
    *,
    signals: Collection[str] = (),
    absent: Mapping[str, Collection[str]] | None = None,
) -> list[Separation]:
    """Judge sets (default: all that the machine can have) by recordings whose noise is set.

    signals: names out of `SIGNALS` that are taken as recorded besides.
    absent: by the name of a member, the recordings in which it is known not to act (a cable that was unhooked).
    """
    sets = alias_sets(recordings) if sets is None else sets
    table = _Table(recordings, sets, signals, absent or {})
    return [table.judged(one) for one in sets]


def separations_of(
    believed: Believed,
    logs: Sequence[Log],
    *,
    signals: Collection[str] = (),
    absent: Mapping[str, Collection[str]] | None = None,
) -> list[Separation]:
    """Judge all sets of a believed machine by logs; see `separations`."""
    recordings = [balance.recording_of(log, believed) for log in logs]
    noise = noise_of(recordings)
    for recording in recordings:
        balance.set_noise(recording, noise)
    return separations(recordings, signals=signals, absent=absent)


def splitting(recordings: Sequence[Recording], one: AliasSet, moves: Sequence[Move]) -> tuple[str, ...]:
    """Name the moves and signals that, recorded besides, would tell all members of a set apart, one at a time."""
    believed = recordings[0].believed
    found = []
    for move in moves:
        planned = balance.recording_of(planned_log(move.trajectory, believed), believed)
        balance.set_noise(planned, slow_noise(believed, planned))
        if separations([*recordings, planned], [one])[0].whole:
            found.append(move.name)
    found += [name for name in SIGNALS if separations(recordings, [one], signals=(name,))[0].whole]
    return tuple(found)


class _Table:
    """Columns of all members on all recordings, and their products."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        sets: Sequence[AliasSet],
        signals: Collection[str],
        absent: Mapping[str, Collection[str]],
    ):
        self._evidence = Evidence(recordings)
        self._groups: dict[object, Group] = {}
        self.known: dict[str, Group] = {}
        for term, sd in hypotheses.parameter_terms(recordings[0]):
            self.known[term.name] = replace(self.group(term), prior_sds=(sd,))
        known_sds = np.array([group.prior_sds[0] for group in self.known.values()])
        for one in sets:
            for term in (*(member.term for member in one.members), *one.beside):
                self.group(term)
        gone = {self.group(m.term): absent[m.name] for one in sets for m in one.members if m.name in absent}
        self.sums: list[Sums] = []
        for k, recording in enumerate(recordings):
            gram = self._products(k, known_sds) + self._signal_products(recording, signals)
            for group, runs in gone.items():
                if recording.log.name in runs:
                    gram[list(group.columns)] = gram[:, list(group.columns)] = 0.0
            log = recording.log
            self.sums.append(Sums(gram, float(log.samples_count), log.session, log.name, np.zeros((0, 0))))

    def group(self, term: Term) -> Group:
        """Return the columns of a term, made where they are asked for first."""
        key = (term.key, tuple(sorted(term.shape.items())), term.amplitudes)
        if key not in self._groups:
            self._groups[key] = Group(term.key, self._evidence.add(term), term.scope)
        return self._groups[key]

    def _products(self, number: int, known_sds: np.ndarray) -> np.ndarray:
        """Return the Gram matrix of one recording, every channel in units of its noise: what is stated, or more."""
        size = 1 + sum(len(group.columns) for group in self._groups.values())
        gram = np.zeros((size, size))
        for place, channel in enumerate(self._evidence.channels[number]):
            if not channel.rows[0].size:  # an axis that stood still
                continue
            left = self._evidence.rest(number, place, known_sds)
            high = np.fft.rfftfreq(left.size) > _HIGH_SHARE
            scale = max(float(np.sqrt(np.mean(np.abs(np.fft.rfft(left)[high]) ** 2) / left.size)), 1.0)
            rows = np.stack(channel.rows) / scale
            gram[np.ix_(channel.numbers, channel.numbers)] += rows @ rows.T
        return gram

    def _signal_products(self, recording: Recording, signals: Collection[str]) -> np.ndarray:
        """Return the Gram matrix of what further signals would show."""
        size = 1 + sum(len(group.columns) for group in self._groups.values())
        gram = np.zeros((size, size))
        for name in signals:
            numbers: list[int] = []
            rows: list[np.ndarray] = []
            for group in self._groups.values():
                term = self._evidence.terms[group.columns[0]]
                for number, forces in zip(group.columns, term.forces(recording), strict=True):
                    row = SIGNALS[name](recording, forces)
                    if row is not None:
                        numbers.append(number)
                        rows.append(row)
            if rows:
                gram[np.ix_(numbers, numbers)] += np.stack(rows) @ np.stack(rows).T
        return gram

    def judged(self, one: AliasSet) -> Separation:
        """Judge one set."""
        groups = [self.group(member.term) for member in one.members]
        taken = {group.columns for group in groups}
        free = [self.group(term) for term in one.beside]
        free += [g for name, g in self.known.items() if g.columns not in taken and name not in one.holds]
        slots, precision = active_slots([*groups, *free], self.sums)
        normal, _ = normal_of(slots, precision, self.sums)
        owner: list[int] = []
        sizes: list[float] = []
        for number, (member, group) in enumerate(zip(one.members, groups, strict=True)):
            for column, size in zip(group.columns, member.sizes, strict=True):
                count = sum(slot[0] == column for slot in slots)
                owner += [number] * count
                sizes += [size] * count
        order = [k for g in groups for c in g.columns for k, slot in enumerate(slots) if slot[0] == c]
        rest = [k for k in range(len(slots)) if k not in set(order)]
        information = _eliminated(normal, order, rest) * np.outer(sizes, sizes)
        return _separation(one, information, np.array(owner))


def _eliminated(normal: np.ndarray, kept: list[int], free: list[int]) -> np.ndarray:
    """Return the information of some amplitudes with the others free (Schur complement)."""
    whole = normal[np.ix_(kept, kept)]
    if not free:
        return whole
    scale = np.sqrt(np.diag(normal)[free])
    scale[scale == 0.0] = 1.0
    others = normal[np.ix_(free, free)] / np.outer(scale, scale) + _JITTER * np.eye(len(free))
    cross = normal[np.ix_(free, kept)] / scale[:, None]
    return whole - cross.T @ np.linalg.solve(others, cross)


def _separation(one: AliasSet, information: np.ndarray, owner: np.ndarray) -> Separation:
    """Read rank and lost directions off the information of amplitudes in units of their sizes, shape (k, k)."""
    seen = np.flatnonzero(np.diag(information) >= ALIAS_GAIN)
    names = [member.name for member in one.members]
    unseen = [name for k, name in enumerate(names) if not np.any(owner[seen] == k)]
    length = np.sqrt(np.diag(information)[seen])
    values, directions = np.linalg.eigh(information[np.ix_(seen, seen)] / np.outer(length, length))
    # along a direction v amplitudes are t v / length: t as large as the sizes allow
    reach = np.min(length[:, None] / np.maximum(np.abs(directions), 1e-12), axis=0, initial=np.inf)
    losses = np.maximum(values, 0.0) * reach**2
    lost = losses < ALIAS_GAIN
    shares = directions[:, lost] @ directions[:, lost].T
    inseparable = tuple(tuple(names[k] for k in alike) for alike in _connected(shares, owner[seen]))
    return Separation(
        one.name,
        one.why,
        rank=int(np.sum(~lost)),
        columns=len(owner),
        inseparable=inseparable,
        power=float(norm.cdf(np.sqrt(losses.min(initial=np.inf)) + norm.ppf(_FALSE_RATE))),
        not_excited=tuple(unseen),
        remedies=_useful(one, inseparable),
    )


def _useful(one: AliasSet, inseparable: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """Name what would split what is left together."""
    together = {name for names in inseparable for name in names}
    return tuple(r.name for r in one.remedies if together and (not r.frees or r.frees in together))


def _connected(shares: np.ndarray, owner: np.ndarray) -> list[list[int]]:
    """Return the members that lost directions run through, those of one direction together, shape of shares (k, k)."""
    sets: list[set[int]] = []
    for k in range(len(owner)):
        if shares[k, k] > _PART:
            alike = {int(owner[j]) for j in range(len(owner)) if abs(shares[k, j]) > _PART * 0.5} | {int(owner[k])}
            apart = [known for known in sets if not known & alike]
            for known in sets:
                if known & alike:
                    alike |= known
            sets = [*apart, alike]
    return [sorted(alike) for alike in sets]
