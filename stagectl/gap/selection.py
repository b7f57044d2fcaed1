"""Which hypotheses stay: generalised least squares on whitened columns, thresholds from the workflow's own null.

Everything is algebra on one Gram matrix a recording, so hundreds of hypotheses and hundreds of nulls cost seconds. A
term stays when it gains on the recordings it was fitted on AND on recordings that no fit saw, each beyond what the
best of the whole library gains on noise, and when it explains a share of what is reducible at all. Pure.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

NULL_QUANTILE = 0.99
MATERIAL_RATIO = 0.005
"""Share of everything gained so far that a further hypothesis must gain: below it, laws are not that exact."""

SEARCH_PRICE = 2.0
"""What a shape that is searched beyond the grid gains on noise, at most about (chi square of one number)."""

MEASURED_COLUMNS = frozenset({"flexible_mode"})
MEASURED_GAIN = 120.0
"""Columns made of the measured acceleration share noise with the innovations, which no draw of noise through them
shows: a flexible mode gained 61 where nothing was missing."""

RIVALS_COUNT = 6
"""Names whose shapes are searched in each round."""

ALIAS_GAIN = 8.6
"""Log-likelihood ratio (twice) below which two names can't be told apart: power 0.9 at 5 % false alarms."""

ALIAS_SHARE = 0.002
LATE_READINGS = frozenset({"sensor_delay", "sensor_lag"})
LATE_SHARE = 0.12
"""Late readings and prompt commands disagree on the velocity that both laws are made of: a lag of 0.45 ms at d' 45 lost
a tenth of its gain to a delay."""

_JITTER = 1e-10
_BOUND_SDS = 2.0


@dataclass(frozen=True, slots=True)
class Sums:
    """One recording: Gram matrix of [innovations, columns...] in units of the noise, and how many numbers it sums."""

    gram: np.ndarray
    count: float
    session: str
    run: str
    nulls: np.ndarray  # what the columns make of white noise in the innovations' place, shape (draws, columns)


@dataclass(frozen=True, slots=True)
class Group:
    """Columns that stay or go together; `prior_sds` says how far each amplitude may be from zero, inf = any."""

    key: object
    columns: tuple[int, ...]
    scope: str = "structural"  # structural | session | run: how far its amplitudes reach
    prior_sds: tuple[float, ...] = ()
    bounds: tuple[tuple[float, float], ...] = ()  # of each amplitude; a friction that drives is no friction
    searched: int = 0  # shape parameters that a grid or a spectrum chose

    @property
    def complexity(self) -> int:
        """Numbers that it takes from the data."""
        return len(self.columns) + self.searched


@dataclass(frozen=True, slots=True)
class Solution:
    """Amplitudes of some groups on some recordings, and what they gain over none at all."""

    groups: tuple[Group, ...]
    slots: tuple[tuple[int, str], ...]  # (column, "" or the session or run that it is of)
    values: np.ndarray
    covariance: np.ndarray
    gain: float

    def of(self, group: Group) -> tuple[np.ndarray, np.ndarray]:
        """Return values and standard deviations of one group, sessions one after the other."""
        places = [k for k, (column, _) in enumerate(self.slots) if column in group.columns]
        return self.values[places], np.sqrt(np.maximum(np.diag(self.covariance)[places], 0.0))


def solve(groups: Sequence[Group], sums: Sequence[Sums]) -> Solution:
    """Solve the amplitudes of `groups` on all of `sums`."""
    slots, precision = active_slots(groups, sums)
    size = len(slots)
    normal, right = normal_of(slots, precision, sums)
    if not size:
        return Solution(tuple(groups), (), np.zeros(0), np.zeros((0, 0)), 0.0)
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0.0] = 1.0  # a column that nothing excites
    scaled = normal / np.outer(scale, scale) + _JITTER * np.eye(size)
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    values = inverse @ right
    # what these values do lower the squares by: near-collinear columns make the inverse coarse, and r'v too large
    gain = float(2.0 * right @ values - values @ normal @ values)
    return Solution(tuple(groups), tuple(slots), values, inverse, gain)


def within_bounds(solution: Solution) -> bool:
    """Tell whether no amplitude is outside what its effect can be, by more than twice its standard deviation."""
    allowed = {
        column: bounds
        for group in solution.groups
        if group.bounds
        for column, bounds in zip(group.columns, group.bounds, strict=True)
    }
    for (column, _), value, variance in zip(solution.slots, solution.values, np.diag(solution.covariance), strict=True):
        if column in allowed:
            low, high = allowed[column]
            slack = _BOUND_SDS * float(np.sqrt(max(variance, 0.0)))
            if not low - slack <= value <= high + slack:
                return False
    return True


def held_out_gain(solution: Solution, held: Sequence[Sums]) -> float:
    """Return by how much amplitudes from elsewhere lower the squares of recordings that no fit saw.

    Amplitudes that belong to a session are solved there, and cost what so many free amplitudes gain on noise.
    """
    fixed = [k for k, (_, scope) in enumerate(solution.slots) if scope == ""]
    own = sorted({column for column, scope in solution.slots if scope != ""})
    total = 0.0
    columns = [solution.slots[k][0] for k in fixed]
    theta = solution.values[fixed]
    for s in held:
        total += float(2.0 * theta @ s.gram[columns, 0] - theta @ s.gram[np.ix_(columns, columns)] @ theta)
        if own:
            right = s.gram[own, 0] - s.gram[np.ix_(own, columns)] @ theta
            normal = s.gram[np.ix_(own, own)]
            normal = normal + (_JITTER * np.trace(normal) + 1e-300) * np.eye(len(own))
            total += float(right @ np.linalg.solve(normal, right)) - len(own)
    return total


class Source(Protocol):
    """Where sums come from; they grow as hypotheses get new columns."""

    sums: list[Sums]


Refine = Callable[[Sequence[Group], Group], Group]
"""(groups beside it, a group of the grid) -> the same hypothesis at its best shape."""


@dataclass(slots=True)
class Judge:
    """Training recordings, recordings that no fit sees, and the library that competes."""

    source: Source
    training_count: int
    base: list[Group]
    library: list[Group]
    refine: Refine
    gain_at_size: Callable[[Sequence[Group]], Callable[[Group], float]]
    threshold: float = 0.0
    modelled: float = (
        0.0  # what laws of the model explain already that are known to be inexact, in squares of the noise
    )
    trace: list[str] = field(default_factory=list)
    _known_rivals: dict[frozenset[tuple[int, ...]], list[Group]] = field(default_factory=dict)

    @property
    def training(self) -> list[Sums]:
        """Recordings that fits may see."""
        return self.source.sums[: self.training_count]

    @property
    def held(self) -> list[Sums]:
        """Recordings that no fit sees."""
        return self.source.sums[self.training_count :]

    def gains(self, groups: Sequence[Group]) -> tuple[float, float]:
        """Return (gain on training, gain on held-out recordings) of base and `groups`.

        Without recordings kept apart, each training recording is held out once.
        """
        training, held = self.training, self.held
        whole = solve([*self.base, *groups], training)
        if held:
            return whole.gain, held_out_gain(whole, held)
        if len(training) == 1:
            return whole.gain, whole.gain
        apart = 0.0
        for k in range(len(training)):
            others = training[:k] + training[k + 1 :]
            apart += held_out_gain(solve([*self.base, *groups], others), [training[k]])
        return whole.gain, apart

    def gain(self, groups: Sequence[Group]) -> float:
        """Return the gain of base and `groups` on all recordings together."""
        return solve([*self.base, *groups], self.source.sums).gain

    def calibrate(self) -> None:
        """Set the threshold: the quantile of the best gain of the whole library on noise."""
        fold = Fold(self.base, self.source.sums, self.source.sums, on_noise=True)
        best = np.zeros(self.source.sums[0].nulls.shape[0])
        for group in self.library:
            best = np.maximum(best, fold.added(group)[0])
        self.threshold = float(np.quantile(best, NULL_QUANTILE))

    def reducible(self, groups: Sequence[Group]) -> tuple[float, float]:
        """Return what is left above the floor on training and held-out recordings, in squares of the noise."""
        gain = self.gains(groups)
        held = self.held or self.training
        left = sum(s.gram[0, 0] - s.count for s in self.training) - gain[0]
        apart = sum(s.gram[0, 0] - s.count for s in held) - gain[1]
        return max(left, 0.0), max(apart, 0.0)

    def select(
        self, start: Sequence[Group] = (), most: int = 6, until: Callable[[Group], bool] = lambda group: False
    ) -> list[Group]:
        """Add the best hypothesis as long as one stays; then let every one compete again beside the others.

        Ends early with a hypothesis of which `until` says that everything has to be looked at anew.
        """
        chosen = list(start)
        seen: set[frozenset[object]] = set()
        while len(chosen) < most:
            rivals = self.rivals(chosen)
            passing = [group for group in rivals if self._stays(chosen, group) and self._allowed([*chosen, group])]
            self._note(chosen, rivals)
            if not passing:
                break
            chosen = [*chosen, self._simplest(chosen, passing)]
            chosen = self._without_superfluous(self._competed(chosen))
            state = frozenset(group.key for group in chosen)
            if state in seen or any(until(group) for group in chosen):
                break
            seen.add(state)
        return chosen

    def rivals(self, chosen: Sequence[Group]) -> list[Group]:
        """Return the names that gain most beside `chosen`, each at its best shape."""
        state = frozenset(group.columns for group in chosen)
        if state not in self._known_rivals:
            self._known_rivals[state] = self._ranked(chosen, RIVALS_COUNT)
        return self._known_rivals[state]

    def _ranked(self, chosen: Sequence[Group], most: int) -> list[Group]:
        """Rank names by what they gain on all recordings, as columns or at their size, and search their shapes."""
        fold = Fold([*self.base, *chosen], self.source.sums, self.source.sums, on_noise=False)
        best: dict[object, tuple[float, Group]] = {}
        taken = {group.key for group in chosen}
        at_size = self.gain_at_size([*self.base, *chosen])
        for group in self.library:
            if group.key in taken:
                continue
            gain = max(float(fold.added(group)[0][0]), at_size(group))
            worth = gain - self.price() * group.complexity
            if group.key not in best or worth > best[group.key][0]:
                best[group.key] = (worth, group)
        ranked = [group for _, group in sorted(best.values(), key=lambda row: -row[0])]
        possible = (group for group in ranked[: 4 * most] if self._allowed([*chosen, group]))
        return [self.refine([*self.base, *chosen], group) for group in itertools.islice(possible, most)]

    def _note(self, chosen: Sequence[Group], rivals: Sequence[Group]) -> None:
        now = self.gains(chosen)
        left = self.reducible(chosen)
        said = []
        for group in rivals:
            gains = self.gains([*chosen, group])
            said.append(f"{group.key} {gains[0] - now[0]:.0f} / {gains[1] - now[1]:.0f}")
        self.trace.append(f"left {left[0]:.0f} / {left[1]:.0f}: " + "; ".join(said))

    def price(self) -> float:
        """Return what an amplitude must gain to be worth itself (Schwarz 1978)."""
        return float(np.log(sum(s.count for s in self.training)))

    def _worth(self, groups: Sequence[Group]) -> float:
        """Return the gain on all recordings, less the price of the amplitudes."""
        return self.gain(groups) - self.price() * sum(group.complexity for group in groups)

    def _simplest(self, beside: Sequence[Group], candidates: Sequence[Group]) -> Group:
        """Return the candidate that is worth most; of those that can't be told from it, one with the least numbers."""
        now = self.gain(beside)
        gains = {id(group): self.gain([*beside, group]) - now for group in candidates}
        best = max(candidates, key=lambda group: gains[id(group)] - self.price() * group.complexity)
        limit = gains[id(best)] - ALIAS_GAIN - ALIAS_SHARE * gains[id(best)]
        near = [group for group in candidates if gains[id(group)] > limit and group.complexity < best.complexity]
        return max(near, key=lambda group: gains[id(group)] - self.price() * group.complexity, default=best)

    def _allowed(self, groups: Sequence[Group]) -> bool:
        """Tell whether every amplitude is one that its effect can have."""
        return within_bounds(solve([*self.base, *groups], self.source.sums))

    def _competed(self, chosen: list[Group]) -> list[Group]:
        """Let each hypothesis compete again beside the others: what came first need not be true."""
        for _ in range(2):
            before = [group.key for group in chosen]
            for k in range(len(chosen)):
                rest = [*chosen[:k], *chosen[k + 1 :]]
                candidates = [chosen[k], *self.rivals(rest)]
                allowed = [group for group in candidates if self._allowed([*rest, group])] or [chosen[k]]
                best = self._simplest(rest, allowed)
                if best.key != chosen[k].key or self._worth([*rest, best]) > self._worth(chosen) + 1e-6:
                    chosen = [*chosen[:k], best, *chosen[k + 1 :]]
            if [group.key for group in chosen] == before:
                break
        return chosen

    def _stays(self, chosen: Sequence[Group], group: Group) -> bool:
        """Tell whether a hypothesis gains beyond noise, on both kinds of recordings, more than it costs, and enough."""
        now, gains = self.gains(chosen), self.gains([*chosen, group])
        trained, apart = gains[0] - now[0], gains[1] - now[1]
        whole = self.gain([*chosen, group])
        least = MATERIAL_RATIO * (whole - self.gain([]) + self.modelled)
        gained = whole - self.gain(chosen)
        return (
            trained > 0.0
            and apart > 0.0
            and gained > max(self._threshold_of(group), least, self.price() * group.complexity)
        )

    def _threshold_of(self, group: Group) -> float:
        """Return what a hypothesis has to gain to stand out of noise, searched shapes and measured columns included."""
        measured = MEASURED_GAIN if group.key[0] in MEASURED_COLUMNS else 0.0  # pyright: ignore[reportIndexIssue]
        return self.threshold + SEARCH_PRICE * group.searched + measured

    def _without_superfluous(self, chosen: list[Group]) -> list[Group]:
        """Take hypotheses back whose loss is too small now, the least useful first."""
        while len(chosen) > 1:
            losses = []
            for group in chosen:
                rest = [other for other in chosen if other is not group]
                losses.append((self.gain(chosen) - self.gain(rest), group, rest))
            _, weakest, rest = min(losses, key=lambda row: row[0])
            if self._stays(rest, weakest):
                return chosen
            chosen = rest
        return chosen

    def aliases(self, chosen: Sequence[Group], group: Group) -> list[tuple[object, float]]:
        """Return the keys that would do as well as `group` beside the others, with the margin that they lose by."""
        rest = [other for other in chosen if other is not group]
        with_it = self.gain(chosen)
        gained = with_it - self.gain(rest)
        margins: dict[object, float] = {}
        taken = {other.key for other in chosen}
        for other in self.rivals(rest):
            if other.key in taken or other.complexity > group.complexity or not self._allowed([*rest, other]):
                continue
            margin = with_it - self.gain([*rest, other])
            late = {str(key[0]) for key in (group.key, other.key)} <= LATE_READINGS  # pyright: ignore[reportIndexIssue]
            if margin < ALIAS_GAIN + (LATE_SHARE if late else ALIAS_SHARE) * gained:
                margins[other.key] = margin
        return sorted(margins.items(), key=lambda row: row[1])


class Fold:
    """Groups solved on some recordings and judged on others, ready to say what one more group would gain."""

    def __init__(self, groups: Sequence[Group], fitted: Sequence[Sums], judged: Sequence[Sums], on_noise: bool):
        self._fitted, self._judged, self._on_noise = fitted, judged, on_noise
        self._slots, precision = active_slots(groups, fitted)
        self._rights = {id(s): _right(s, on_noise) for s in [*fitted, *judged]}
        normal = self._cross(self._slots, self._slots, fitted) + np.diag(precision)
        scale = np.sqrt(np.diag(normal))
        scale[scale == 0.0] = 1.0
        weights = np.outer(scale, scale)
        self._inverse = np.linalg.inv(normal / weights + _JITTER * np.eye(scale.size)) / weights
        self._values = self._inverse @ self._seen(self._slots, fitted)
        self._apart = self._judged_gain(self._slots, self._values)

    def added(self, group: Group) -> tuple[np.ndarray, np.ndarray]:
        """Return (gain where it is fitted, gain where it is judged) of one group more, one element a right side."""
        slots, precision = active_slots([group], self._fitted)
        cross = self._cross(self._slots, slots, self._fitted)
        back = self._inverse @ cross
        normal = self._cross(slots, slots, self._fitted) + np.diag(precision) - cross.T @ back
        right = self._seen(slots, self._fitted) - cross.T @ self._values
        scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
        if not np.all(scale > 0.0):
            return np.zeros(right.shape[1]), np.zeros(right.shape[1])
        weights = np.outer(scale, scale)
        scaled = normal / weights + _JITTER * np.eye(scale.size)
        values = np.linalg.solve(scaled, right / scale[:, None]) / scale[:, None]
        together = np.vstack([self._values - back @ values, values])
        gain = 2.0 * np.einsum("ij,ij->j", right, values) - np.einsum("ij,ij->j", values, normal @ values)
        return gain, self._judged_gain([*self._slots, *slots], together) - self._apart

    def _judged_gain(self, slots: list[tuple[int, str]], values: np.ndarray) -> np.ndarray:
        fixed = [k for k, (_, scope) in enumerate(slots) if scope == ""]
        own = sorted({column for column, scope in slots if scope != ""})
        columns, theta = [slots[k][0] for k in fixed], values[fixed]
        total = np.zeros(values.shape[1])
        for s in self._judged:
            right = self._rights[id(s)]
            bent = s.gram[np.ix_(columns, columns)] @ theta
            total += 2.0 * np.einsum("ij,ij->j", theta, right[columns]) - np.einsum("ij,ij->j", theta, bent)
            if own:
                rest = right[own] - s.gram[np.ix_(own, columns)] @ theta
                normal = s.gram[np.ix_(own, own)]
                normal = normal + (_JITTER * np.trace(normal) + 1e-300) * np.eye(len(own))
                total += np.einsum("ij,ij->j", rest, np.linalg.solve(normal, rest)) - len(own)
        return total

    def _seen(self, slots: list[tuple[int, str]], sums: Sequence[Sums]) -> np.ndarray:
        total = np.zeros((len(slots), self._rights[id(sums[0])].shape[1]))
        for s in sums:
            here = [k for k, (_, scope) in enumerate(slots) if covers(scope, s)]
            total[here] += self._rights[id(s)][[slots[k][0] for k in here]]
        return total

    @staticmethod
    def _cross(a: list[tuple[int, str]], b: list[tuple[int, str]], sums: Sequence[Sums]) -> np.ndarray:
        total = np.zeros((len(a), len(b)))
        for s in sums:
            rows = [k for k, (_, scope) in enumerate(a) if covers(scope, s)]
            columns = [k for k, (_, scope) in enumerate(b) if covers(scope, s)]
            part = s.gram[np.ix_([a[k][0] for k in rows], [b[k][0] for k in columns])]
            total[np.ix_(rows, columns)] += part
        return total


def covers(scope: str, s: Sums) -> bool:
    """Tell whether an amplitude of a scope reaches a recording."""
    return scope in ("", f"session {s.session}", f"run {s.run}")


def _right(s: Sums, on_noise: bool) -> np.ndarray:
    """Return what the columns see, row 0 the innovations' own square, shape (1 + columns, right sides)."""
    if not on_noise:
        return s.gram[:, :1]
    return np.vstack([np.full(s.nulls.shape[0], s.count), s.nulls.T])


def normal_of(
    slots: Sequence[tuple[int, str]], precision: Sequence[float], sums: Sequence[Sums]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix, priors included, and the right side of some amplitudes."""
    normal, right = np.diag(np.array(precision, float)), np.zeros(len(slots))
    for s in sums:
        here = [k for k, (_, scope) in enumerate(slots) if covers(scope, s)]
        columns = [slots[k][0] for k in here]
        normal[np.ix_(here, here)] += s.gram[np.ix_(columns, columns)]
        right[here] += s.gram[columns, 0]
    return normal, right


def active_slots(groups: Sequence[Group], sums: Sequence[Sums]) -> tuple[list[tuple[int, str]], list[float]]:
    """Return (column, scope) of every amplitude of some groups, and how well each is known beforehand."""
    scopes = {
        "structural": ("",),
        "session": tuple(sorted({f"session {s.session}" for s in sums})),
        "run": tuple(sorted({f"run {s.run}" for s in sums})),
    }
    slots: list[tuple[int, str]] = []
    precision: list[float] = []
    for group in groups:
        for scope in scopes[group.scope]:
            for number, column in enumerate(group.columns):
                slots.append((column, scope))
                precision.append(group.prior_sds[number] ** -2 if group.prior_sds else 0.0)
    return slots, precision
