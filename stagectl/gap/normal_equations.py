"""Generalised least squares on whitened columns: amplitudes and gains of groups of columns, from Gram matrices.

Everything is algebra on one Gram matrix a recording, so hundreds of hypotheses and hundreds of nulls cost seconds.
Pure.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import eigh
from scipy.special import stdtrit

from stagectl.gap.findings import SIGMAS

_JITTER = 1e-10
_BOUND_SDS = 2.0


class Placed(Protocol):
    """What comes from one recording."""

    @property
    def session(self) -> str: ...

    @property
    def run(self) -> str: ...


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

    key: tuple[str, str]  # what it is called and where it acts
    columns: tuple[int, ...]
    scope: str = "structural"  # structural | session | run: how far its amplitudes reach
    prior_sds: tuple[float, ...] = ()
    bounds: tuple[tuple[float, float], ...] = ()  # of each amplitude; a friction that drives is no friction
    searched: int = 0  # shape parameters that a grid or a spectrum chose
    places_count: int = 1  # sessions or runs that have amplitudes of their own
    is_slope: bool = False  # what held-out recordings say of it is asked at its size

    @property
    def complexity(self) -> int:
        """Numbers that it takes from the data."""
        return len(self.columns) * self.places_count + self.searched


_LEAST_FREEDOM = 3.0  # of one stretch alone nothing is known, and t would be any number


@dataclass(frozen=True, slots=True)
class Scatter:
    """How amplitudes scatter from stretch to stretch of the recordings.

        f = (sum_s w_s)^2 / sum_s w_s^2 - 1,   w_s = a' N_s a

    a are the weights of a sum of amplitudes, N_s what white noise in one stretch makes of the amplitudes, f how many
    degrees of freedom the scatter of that sum has: one stretch that tells most of it says little of how it scatters
    (Satterthwaite 1946; Bell, McCaffrey 2002). A deviation is stated so that 1.96 of them hold 95 % of Student's t.
    """

    covariance: np.ndarray
    of_noise: np.ndarray  # shape (stretches, amplitudes, amplitudes)

    def variance_of(self, weights: np.ndarray) -> float:
        """Return the variance of a weighted sum of all amplitudes."""
        parts = np.einsum("i,sij,j->s", weights, self.of_noise, weights)
        squares = float(parts @ parts)
        freedom = float(parts.sum()) ** 2 / squares - 1.0 if squares > 0.0 else np.inf
        factor = float(stdtrit(max(freedom, _LEAST_FREEDOM), 0.975)) / SIGMAS
        return factor**2 * float(weights @ self.covariance @ weights)


@dataclass(frozen=True, slots=True)
class Solution:
    """Amplitudes of some groups on some recordings, and what they gain over none at all."""

    groups: tuple[Group, ...]
    slots: tuple[tuple[int, str], ...]  # (column, "" or the session or run that it is of)
    values: np.ndarray
    covariance: np.ndarray
    normal: np.ndarray  # of the amplitudes, priors included
    gain: float  # over none of them, and over what is fixed
    scattered: tuple[Scatter, ...] = ()  # by stretches of several lengths, where asked for

    def of(self, group: Group) -> tuple[np.ndarray, np.ndarray]:
        """Return values and standard deviations of one group, sessions one after the other."""
        places = [k for k, (column, _) in enumerate(self.slots) if column in group.columns]
        return self.values[places], np.array([self.sd_of(one) for one in np.eye(len(self.slots))[places]])

    def sd_of(self, weights: np.ndarray) -> float:
        """Return the standard deviation of a weighted sum of all amplitudes: the largest of all that are known."""
        scattered = [one.variance_of(weights) for one in self.scattered]
        return float(np.sqrt(max(float(weights @ self.covariance @ weights), *scattered, 0.0)))

    def covariance_of(self, weights: np.ndarray, others: np.ndarray) -> float:
        """Return the covariance of two weighted sums of all amplitudes, by what their sum and difference scatter."""
        return 0.25 * (self.sd_of(weights + others) ** 2 - self.sd_of(weights - others) ** 2)

    def total_of(self, groups: Sequence[Group]) -> tuple[float, float]:
        """Return the sum of the first amplitudes of some groups, and its standard deviation."""
        columns = {group.columns[0] for group in groups}
        weights = np.array([float(column in columns) for column, _ in self.slots])
        return float(weights @ self.values), self.sd_of(weights)


def solve(groups: Sequence[Group], sums: Sequence[Sums], fixed: Sequence[int] = ()) -> Solution:
    """Solve the amplitudes of `groups` on all of `sums`; columns that are `fixed` stand beside them at 1."""
    slots, precision = active_slots(groups, sums)
    size = len(slots)
    normal, right = normal_of(slots, precision, sums, fixed)
    if not size:
        return Solution(tuple(groups), (), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0)), 0.0)
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0.0] = 1.0  # a column that nothing excites
    scaled = normal / np.outer(scale, scale) + _JITTER * np.eye(size)
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    values = inverse @ right
    # what these values do lower the squares by: near-collinear columns make the inverse coarse, and r'v too large
    gain = float(2.0 * right @ values - values @ normal @ values)
    return Solution(tuple(groups), tuple(slots), values, inverse, normal, gain)


def within_bounds(solution: Solution, scale_sd_ratio: float = 0.0) -> bool:
    """Tell whether no amplitude is outside what its effect can be, by more than twice its standard deviation.

    scale_sd_ratio: what amplitudes are uncertain by beside that, as a share of the bound: they are told of believed
    masses and force constants. All of a reaction, 1.0 of a micro's force that is 0.5 % larger than believed, was
    refused at the exponent that a friction beside it has.
    """
    allowed = {
        column: bounds
        for group in solution.groups
        if group.bounds
        for column, bounds in zip(group.columns, group.bounds, strict=True)
    }
    for (column, _), value, variance in zip(solution.slots, solution.values, np.diag(solution.covariance), strict=True):
        if column in allowed:
            low, high = allowed[column]
            sd = float(np.sqrt(max(variance, 0.0)))
            below, above = (_BOUND_SDS * np.hypot(sd, scale_sd_ratio * bound) for bound in (low, high))
            if not low - below <= value <= high + above:
                return False
    return not any(_drives(solution, group) for group in solution.groups)


def _drives(solution: Solution, group: Group) -> bool:
    """Tell whether the levels of a friction are less than none together, by more than twice the deviation of their sum.

    Each alone may be: of two directions that an offset tells apart, -2.7 and -5.1 mN were within 3.6 of none, and their
    mean was six deviations below it.
    """
    if len(group.columns) < 2 or not group.bounds or any(low != 0.0 for low, _ in group.bounds):
        return False
    for scope in {scope for column, scope in solution.slots if column in group.columns}:
        weights = np.array([float(one in group.columns and there == scope) for one, there in solution.slots])
        variance = float(weights @ solution.covariance @ weights)
        if not float(weights @ solution.values) >= -_BOUND_SDS * math.sqrt(max(variance, 0.0)):
            return True
    return False


def held_out_gain(solution: Solution, held: Sequence[Sums]) -> float:
    """Return by how much amplitudes from elsewhere lower the squares of recordings that no fit saw.

    Amplitudes that belong to a session are solved there, and cost what so many free amplitudes gain on noise. What
    their recordings leave open is not foretold, see `_foretelling`.
    """
    fixed = [k for k, (_, scope) in enumerate(solution.slots) if scope == ""]
    own = sorted({column for column, scope in solution.slots if scope != ""})
    columns = [solution.slots[k][0] for k in fixed]
    elsewhere = sum((_beside_own(s, columns, own) for s in held), np.zeros((len(fixed), len(fixed))))
    theta = _foretelling(solution, fixed, elsewhere)
    total = 0.0
    for s in held:
        total += float(2.0 * theta @ s.gram[columns, 0] - theta @ s.gram[np.ix_(columns, columns)] @ theta)
        if own:
            right = s.gram[own, 0] - s.gram[np.ix_(own, columns)] @ theta
            total += float(right @ np.linalg.solve(_normal_of_own(s, own), right)) - len(own)
    return total


OPEN_SDS = math.sqrt(2.0)
"""Deviations below which a sum of amplitudes is as good as open. One that was found at v of its deviations costs 1 by
its noise and is worth its true square, v^2 - 1 as far as anybody knows: it foretells more than it spoils from v^2 = 2
on. From 5 deviations on only, 38 000 squares of wrong masses were not foretold of which all but 1200 could be."""


def _foretelling(solution: Solution, fixed: Sequence[int], elsewhere: np.ndarray) -> np.ndarray:
    """Return amplitudes that say nothing of other recordings where their own leave open what that would be.

    elsewhere: normal matrix of the same amplitudes there. Sums of amplitudes that are independent on both sides
    (eigenvectors of one normal matrix in the metric of the other) are taken one by one, and those within `OPEN_SDS`
    deviations of zero are zero: their own recordings are explained as well without. An error of a reading that one
    recording shows by contact, and others by a soft spring only, was foretold to a hundred times what it is.
    """
    if not fixed:
        return np.zeros(0)
    rest = [k for k in range(len(solution.slots)) if k not in fixed]
    normal = solution.normal[np.ix_(fixed, fixed)]
    if rest:
        cross = solution.normal[np.ix_(fixed, rest)]
        inner = solution.normal[np.ix_(rest, rest)]
        normal = normal - cross @ np.linalg.pinv(inner, hermitian=True) @ cross.T
    scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
    scale[scale == 0.0] = 1.0  # nothing is known of it
    weights = np.outer(scale, scale)
    known, directions = np.linalg.eigh(normal / weights)
    # by rounding less than nothing may be known of what amplitudes of their own explain
    metric = (directions * np.maximum(known, _JITTER)) @ directions.T
    _, sums = eigh(elsewhere / weights, metric)
    sizes = sums.T @ (normal / weights) @ (solution.values[list(fixed)] * scale)
    return sums @ np.where(np.abs(sizes) > OPEN_SDS, sizes, 0.0) / scale


def _beside_own(s: Sums, columns: Sequence[int], own: Sequence[int]) -> np.ndarray:
    """Return the normal matrix of columns beside those whose amplitudes a recording has to itself."""
    normal = s.gram[np.ix_(columns, columns)]
    if not own:
        return normal
    cross = s.gram[np.ix_(columns, own)]
    return normal - cross @ np.linalg.solve(_normal_of_own(s, own), cross.T)


def _normal_of_own(s: Sums, own: Sequence[int]) -> np.ndarray:
    normal = s.gram[np.ix_(own, own)]
    return normal + (_JITTER * np.trace(normal) + 1e-300) * np.eye(len(own))


class Fold:
    """Groups solved on some recordings, ready to say what one more group would gain there."""

    def __init__(self, groups: Sequence[Group], sums: Sequence[Sums], on_noise: bool):
        """Eliminate `groups` once; on_noise: in place of the innovations, draws of white noise."""
        self._sums = sums
        self._rights = [_right(s, on_noise) for s in sums]
        self._slots, precision = active_slots(groups, sums)
        normal = self._cross(self._slots, self._slots) + np.diag(precision)
        scale = np.sqrt(np.diag(normal))
        scale[scale == 0.0] = 1.0
        weights = np.outer(scale, scale)
        self._inverse = np.linalg.inv(normal / weights + _JITTER * np.eye(scale.size)) / weights
        self._values = self._inverse @ self._seen(self._slots)
        self._everywhere = np.zeros((len(self._slots), sums[0].gram.shape[0]))  # of columns with one amplitude each
        for s in sums:
            here = [k for k, (_, scope) in enumerate(self._slots) if covers(scope, s)]
            self._everywhere[here] += s.gram[[self._slots[k][0] for k in here]]

    def added(self, group: Group) -> np.ndarray:
        """Return the gain of one group more, one element a right side."""
        slots, precision = active_slots([group], self._sums)
        columns = list(group.columns)
        cross = self._everywhere[:, columns] if group.scope == "structural" else self._cross(self._slots, slots)
        normal = self._cross(slots, slots) + np.diag(precision) - cross.T @ (self._inverse @ cross)
        right = self._seen(slots) - cross.T @ self._values
        scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
        if not np.all(scale > 0.0):
            return np.zeros(right.shape[1])
        weights = np.outer(scale, scale)
        scaled = normal / weights + _JITTER * np.eye(scale.size)
        values = np.linalg.solve(scaled, right / scale[:, None]) / scale[:, None]
        return 2.0 * np.einsum("ij,ij->j", right, values) - np.einsum("ij,ij->j", values, normal @ values)

    def _seen(self, slots: list[tuple[int, str]]) -> np.ndarray:
        total = np.zeros((len(slots), self._rights[0].shape[1]))
        for s, right in zip(self._sums, self._rights, strict=True):
            here = [k for k, (_, scope) in enumerate(slots) if covers(scope, s)]
            total[here] += right[[slots[k][0] for k in here]]
        return total

    def _cross(self, a: list[tuple[int, str]], b: list[tuple[int, str]]) -> np.ndarray:
        total = np.zeros((len(a), len(b)))
        for s in self._sums:
            rows = [k for k, (_, scope) in enumerate(a) if covers(scope, s)]
            columns = [k for k, (_, scope) in enumerate(b) if covers(scope, s)]
            part = s.gram[np.ix_([a[k][0] for k in rows], [b[k][0] for k in columns])]
            total[np.ix_(rows, columns)] += part
        return total


def covers(scope: str, s: Placed) -> bool:
    """Tell whether an amplitude of a scope reaches a recording."""
    return scope in ("", f"session {s.session}", f"run {s.run}")


def _right(s: Sums, on_noise: bool) -> np.ndarray:
    """Return what the columns see, row 0 the innovations' own square, shape (1 + columns, right sides)."""
    if not on_noise:
        return s.gram[:, :1]
    return np.vstack([np.full(s.nulls.shape[0], s.count), s.nulls.T])


def normal_of(
    slots: Sequence[tuple[int, str]], precision: Sequence[float], sums: Sequence[Sums], fixed: Sequence[int] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix, priors included, and the right side of some amplitudes."""
    normal, right = np.diag(np.array(precision, float)), np.zeros(len(slots))
    for s in sums:
        here = [k for k, (_, scope) in enumerate(slots) if covers(scope, s)]
        columns = [slots[k][0] for k in here]
        normal[np.ix_(here, here)] += s.gram[np.ix_(columns, columns)]
        right[here] += s.gram[columns, 0] - s.gram[np.ix_(columns, list(fixed))].sum(axis=1)
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
