"""Which hypotheses stay: rounds of competition, with thresholds from the workflow's own null.

A term stays when it gains on all recordings together more than the best of the whole library does on noise and a share
of what is reducible at all, and when recordings that no fit saw do not speak against it. Pure.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.stats import chi2

from stagectl.effects import CATALOGUE, Trait
from stagectl.gap.normal_equations import Fold, Group, Sums, covers, held_out_gain, solve, within_bounds

NULL_QUANTILE = 0.99
MATERIAL_RATIO = 0.005
"""Share of everything gained so far that a further hypothesis must gain: below it, laws are not that exact."""

REPEATING_RATIO = 0.002
"""The same of what repeats over a pitch or a period."""

EXACT_RATIO = 0.0005
"""The same where with it no curve finds anything any more: a wrong name explains only a part of what laws leave."""

EXPLAINED_SHARE = 0.2
"""Of what is left beyond what the floor scatters by, what such a hypothesis explains at least."""

SMOOTH_RATIO = 2e-5
"""The same of what smooth laws have gained: forces of place, time, command and speed along a motion that is measured to
nanometres. Beside a ripple of 7.1 million squares a lag of 239 was left out, and of all that only 900 were left."""

PARTS_RATIO = 5e-5
"""Of what bristles gain, what a level and a rise in their place may lose: 1.9e-5 and 2.9e-5 where they were those, on
sets that it is set on. Dahl's in place of others lost 4.7e-4."""

AT_SIZE_RATIO = 1e-6
"""The same of what readings and commands explain that are taken at their size: beside a clock of 367 million squares
one of the other sensor gained 67, which was no clock."""

CURVE_GAIN = 3.0
"""Of what the best of the library gains on noise, what a curve has to gain to be a rest that something has left."""

NAMES_BESIDE_CURVE_COUNT = 3
"""From so many names on a curve that explains more than any further name ends the search: it is unknown. To six names
and back, each competing beside the others again, took a force that no effect is a quarter of an hour or more."""

SEARCH_PRICE = 2.0
"""What a shape that is searched beyond the grid gains on noise, at most about (chi square of one number)."""

NAMING_RATIO = 1.75
"""Of what the best of the library gains on noise, what a name has to gain. Columns are not as exact as noise is white:
on development sets in which nothing was missing the best one gained up to 1.3 times the quantile; an effect at twice
its detection limit (d' = 10) gains four times as much."""

CONTRADICTION = 6.6
"""Loss on recordings that no fit saw from which they speak against a hypothesis; one that they don't excite costs them
what its size is uncertain by (chi square of one number, 99 %; a lag that 95 % spoke against was the truth)."""

RIVALS_COUNT = 6
"""Names whose shapes are searched in each round."""

ALIAS_GAIN = 8.6
"""Square of the distance between what two names say, in units of the noise, below which recordings can't tell them
apart: power 0.9 at 5 % false alarms. Of the likelihoods as they came out (whose ratio scatters by twice the distance
about it) half of all pairs at that distance would count as one."""

ALIAS_SHARE = 0.002
"""Of what a name gains, the margin below which two names are one set where recordings lie between what they say."""

BETWEEN_SDS = 3.0
"""From so many deviations of the noise on, what two names say differently is said by neither."""

LEFT_SDS = 3.0
"""Deviations of the floor by which more may be left than is seen."""

_HOPEFUL_SHARE = 0.9
"""Of what two laws gain, what one in their place has to gain at a shape of the grid to be searched."""

_PAIRS_COUNT = 3
"""Of names that may replace one, that are searched."""

_PAIR_STARTS_COUNT = 4
"""Shapes of the first of two names, each with the best of the other, from which they are searched."""

_PART_PASSES = 2
"""Times that each of two laws that replace one is searched beside the other."""

LOW_SPEED_SHARE = 0.03
"""Of a machine with more force noise than its sensors explain, no friction is an exact law: where a real axis passes
through low speeds on its way only, dry friction, bristles and sub-linear friction differ by 1.6 to 2.4 % of their gain,
and a Stribeck friction by 9 %. Slow reversals tell them apart."""


FLOOR_VARIANCE = 3.0
"""Variance of a sum of N squares of noise, by N, less N of what noise is taken to be: where that is the mean over the
upper share h = 0.4 of all frequencies of the same recording, 2 (1 - h) / h."""

_STIFFNESSES = {(f"{side}_stiffness_n_per_m", "parameter") for side in ("left", "right")}


class Source(Protocol):
    """Where sums come from; they grow as hypotheses get new columns."""

    sums: list[Sums]


Refine = Callable[[Sequence[Group], Sequence[Group]], list[Group]]
"""(groups beside them, groups of the grid) -> the same hypotheses, each at its best shape."""

GainsAtSize = Callable[[Sequence[Group], Sequence[Group]], list[float]]
"""(groups beside them, groups of the grid) -> what each gains at its size, 0 where its column tells."""


@dataclass(slots=True)
class Judge:
    """Training recordings, recordings that no fit sees, and the library that competes."""

    source: Source
    training_count: int
    base: list[Group]
    library: list[Group]
    refine: Refine
    gains_at_size: GainsAtSize
    brought_near: Callable[[Group, Group], Sequence[Group]] = lambda other, group: (other,)
    """(law, name that it may be an alias of) -> the same law at the shapes at which it may be that."""
    curves: list[Group] = field(default_factory=list)
    threshold: float = 0.0
    modelled: float = (
        0.0  # what laws of the model explain already that are known to be inexact, in squares of the noise
    )
    at_size: float = 0.0  # what laws explain that are part of the operating point, in squares of the noise
    scale_sd_ratio: float = 0.0  # what masses and force constants are believed to be uncertain by
    is_rough: bool = False  # a force noise besides that of the sensors
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
        model = [*self.base, *groups]
        whole = solve(model, self.training).gain
        folds = self._folds()
        return whole, sum(held_out_gain(solve(model, learnt), told) for learnt, told in folds) if folds else whole

    def foretold(self, groups: Sequence[Group]) -> float:
        """Return how well training foretells held-out recordings: what all gain together, less what training does.

        Amplitudes that training leaves open cost nothing where they turn out otherwise: by their values alone a wrong
        mass that only one recording shows spoke against itself (-937 squares on a set of which it was the truth).
        """
        whole = self.gain(groups)
        folds = self._folds()
        return sum(whole - solve([*self.base, *groups], learnt).gain for learnt, _ in folds) if folds else whole

    def gain(self, groups: Sequence[Group]) -> float:
        """Return the gain of base and `groups` on all recordings together."""
        return solve([*self.base, *groups], self.source.sums).gain

    def calibrate(self) -> None:
        """Set the threshold: the quantile of the best gain of the whole library on noise."""
        fold = Fold(self.base, self.source.sums, on_noise=True)
        best = np.zeros(self.source.sums[0].nulls.shape[0])
        for group in self.library:
            best = np.maximum(best, fold.added(group))
        self.threshold = float(np.quantile(best, NULL_QUANTILE))

    def reducible(self, groups: Sequence[Group]) -> tuple[float, float]:
        """Return what is left above the floor on training and held-out recordings, in squares of the noise.

        Without recordings kept apart, each is held out once of which the others can know.
        """
        model = [*self.base, *groups]
        left = apart = _above_floor(self.training) - solve(model, self.training).gain
        if folds := self._foretellable():
            apart = sum(_above_floor(told) - held_out_gain(solve(model, learnt), told) for learnt, told in folds)
        return max(left, 0.0), max(apart, 0.0)

    def _folds(self) -> list[tuple[list[Sums], list[Sums]]]:
        """Return (learnt from, held out) of recordings; none of a single one."""
        training, held = self.training, self.held
        if held:
            return [(training, held)]
        if len(training) == 1:
            return []
        return [(training[:k] + training[k + 1 :], [s]) for k, s in enumerate(training)]

    def _foretellable(self) -> list[tuple[list[Sums], list[Sums]]]:
        """Return the folds of which those that are learnt from can know what is held out.

        One that alone touches a side of the joint is never held out: a knee of 13 um, of which the others had not met
        the contact, left a third of all that there was, though it was named with its size.
        """
        folds = self._folds()
        if self.held:
            return folds
        touching = [
            [k for k, s in enumerate(self.training) if any(s.gram[c, c] * sd * sd >= 1.0 for c, sd in stiffness)]
            for stiffness in (
                list(zip(group.columns, group.prior_sds, strict=True))
                for group in self.base
                if group.key in _STIFFNESSES
            )
        ]
        return [fold for k, fold in enumerate(folds) if [k] not in touching]

    def floor_sds(self) -> tuple[float, float]:
        """Return by how much the floor of training and of held-out recordings scatters, in squares of the noise."""
        told = [s for _, some in self._foretellable() for s in some] or self.training
        sizes = (sum(s.count for s in some) for some in (self.training, told))
        one, other = (float(np.sqrt(FLOOR_VARIANCE * size)) for size in sizes)
        return one, other

    def reducible_before(self) -> tuple[float, float]:
        """Return what the belief leaves, as it is or with its known parameters fitted, whichever is less.

        Fitted beside an effect that nobody names yet, known parameters can make a recording worse that no fit saw.
        """
        told = [s for _, some in self._foretellable() for s in some] or self.training
        left, apart = self.reducible([])
        return min(left, max(_above_floor(self.training), 0.0)), min(apart, max(_above_floor(told), 0.0))

    def select(
        self, start: Sequence[Group] = (), most: int = 6, until: Callable[[Group], bool] = lambda group: False
    ) -> list[Group]:
        """Add the best hypothesis as long as one stays; then let every one compete again beside the others.

        Ends early with a hypothesis of which `until` says that everything has to be looked at anew, and where what is
        left lacks a name.
        """
        chosen = self._admissible(start)
        seen: set[frozenset[tuple[str, str]]] = set()
        while len(chosen) < most:
            rivals = self.rivals(chosen)
            if self.lacks_a_name(chosen):
                self._note(chosen, rivals)
                break
            passing = self.passing(chosen)
            self._note(chosen, rivals)
            more = [self._simplest(chosen, passing)] if passing else self._pair(chosen, rivals)
            grown = [*chosen, *more] if more else self._reshaped_with_one(chosen, rivals)
            if not grown:
                break
            chosen = grown
            chosen = self._without_superfluous(self._competed(chosen))
            state = frozenset(group.key for group in chosen)
            if state in seen or any(until(group) for group in chosen):
                break
            seen.add(state)
        return self._as_one(self._in_parts(chosen))

    def _as_one(self, chosen: Sequence[Group]) -> list[Group]:
        """Return two names of a place as one of fewer numbers that can't be told from them.

        An offset and a spring about zero are a cable. No round in which one name takes another's place comes by: beside
        either of them a cable says what the other says, with a number more.
        """
        found = list(chosen)
        for two in itertools.combinations(chosen, 2):
            if two[0].key[1] != two[1].key[1] or two[0].key[1] == "parameter" or any(one not in found for one in two):
                continue
            rest = [group for group in found if group not in two]
            least = self._worth(found) - ALIAS_GAIN
            whole = [
                one
                for one in self._like_both(rest, two)
                if self._worth([*rest, one]) > least and self._allowed([*rest, one])
            ]
            if whole:
                at = found.index(two[0])
                rest.insert(at, max(whole, key=lambda one: self._worth([*rest, one])))
                found = rest
        return found

    def _like_both(self, rest: Sequence[Group], two: tuple[Group, Group]) -> list[Group]:
        """Return names of the same place, of fewer numbers, that may do what two do, each at its best shape."""
        taken = {other.key for other in (*rest, *two)}
        fold = Fold([*self.base, *rest], self.source.sums, on_noise=False)
        enough = _HOPEFUL_SHARE * (self.gain([*rest, *two]) - self.gain(rest))
        hopeful: dict[tuple[str, str], tuple[float, Group]] = {}
        for group in self.library:
            if group.key[1] != two[0].key[1] or group.key in taken or _form(group) >= sum(map(_form, two)):
                continue
            gain = float(fold.added(group)[0])
            if gain > max(enough, hopeful.get(group.key, (0.0, group))[0]):
                hopeful[group.key] = gain, group
        return self.refine([*self.base, *rest], [group for _, group in hopeful.values()])

    def _pair(self, chosen: Sequence[Group], rivals: Sequence[Group]) -> list[Group]:
        """Return the two that gain most of those that stay beside each other; none where there are no such two.

        A mass and a force constant that are both wrong: each alone is a compromise that recordings speak against.
        """
        now = self.gain(chosen)
        hopeful = [group for group in rivals if self.gain([*chosen, group]) - now > self._threshold_of(chosen, group)]
        standing = [
            list(two)
            for two in itertools.combinations(hopeful, 2)
            if self._stays([*chosen, two[0]], two[1])
            and self._stays([*chosen, two[1]], two[0])
            and self._foretells(chosen, two)
            and self._allowed([*chosen, *two])
        ]
        return max(standing, key=lambda two: self.gain([*chosen, *two]), default=[])

    def _reshaped_with_one(self, chosen: Sequence[Group], rivals: Sequence[Group]) -> list[Group]:
        """Return what leaves no curve when one more friction of a body stands beside those there are, reshaped with it.

        What rises towards standstill stands on a level: alone, its speed is a compromise (22 mm/s for 15), beside which
        the level gained 330 squares of 160 000, too little to stay, and a curve over velocity was left.
        """
        if not self.leaves_curve(chosen):
            return []
        now = self.gain(chosen)
        grown = []
        for group in rivals:
            if not _has_akin(chosen, group) or self.gain([*chosen, group]) - now <= self._threshold_of(chosen, group):
                continue
            anew = self.reshaped([*chosen, group])
            if not self.leaves_curve(anew) and self._allowed(anew) and self.foretold(anew) > self.foretold(chosen):
                grown.append(anew)
        return max(grown, key=self._worth, default=[])

    def _in_parts(self, chosen: Sequence[Group]) -> list[Group]:
        """Return frictions of many numbers as two of fewer that can't be told from them.

        What rises towards standstill on a level is two laws, and bristles that slip by nothing are both of them at
        once. Alone, neither gains what the bristles do: no round in which one name takes another's place comes by.
        """
        found = list(chosen)
        for group in chosen:
            if not _shows_at_low_speed(group):
                continue
            rest = [other for other in found if other is not group]
            parts = self._two_like(rest, group)
            as_good = self._worth([*rest, *parts]) > self._worth(found) - self._excused_of_parts(found, group)
            if parts and as_good and self._allowed([*rest, *parts]):
                at = found.index(group)
                found = [*found[:at], *parts, *found[at + 1 :]]  # in its place: a closer look goes by who was there
        return found

    def _two_like(self, rest: Sequence[Group], group: Group) -> list[Group]:
        """Return the two frictions of the same body, of fewer numbers in all, that gain most, at their best shapes.

        Of some pairs of names, each from the shapes of the grid that gain most, of several shapes of the first: between
        speeds of the grid (5.5 mm/s) a round step and a sharp rise gain most, and end 29 000 squares of 10 million
        below the sharp level and rise that it was.
        """
        taken = {other.key for other in (*rest, group)}
        akin = [
            other
            for other in self.library
            if other.key[1] == group.key[1] and other.key not in taken and _shows_at_low_speed(other)
        ]
        pairs = [
            [one, other]
            for one, other in itertools.combinations(akin, 2)
            if one.key != other.key and _form(one) + _form(other) < _form(group)
        ]
        pairs.sort(key=lambda pair: -self._worth([*rest, *pair]))
        hopeful: dict[frozenset[tuple[str, str]], dict[tuple[int, ...], list[Group]]] = {}
        for pair in pairs:
            names = frozenset(one.key for one in pair)
            starts = hopeful.get(names, {})
            if (
                (starts or len(hopeful) < _PAIRS_COUNT)
                and len(starts) < _PAIR_STARTS_COUNT
                and pair[0].columns not in starts
                and self._allowed([*rest, *pair])
            ):
                hopeful.setdefault(names, {})[pair[0].columns] = pair
        started = [pair for starts in hopeful.values() for pair in starts.values()]
        for pair in started:
            for _ in range(_PART_PASSES):
                for k in range(2):
                    (pair[k],) = self.refine([*self.base, *rest, pair[1 - k]], [pair[k]])
        return max(started, key=lambda pair: self._worth([*rest, *pair]), default=[])

    def rivals(self, chosen: Sequence[Group]) -> list[Group]:
        """Return the names that gain most beside `chosen`, each at its best shape."""
        state = frozenset(group.columns for group in chosen)
        if state not in self._known_rivals:
            self._known_rivals[state] = self._ranked(chosen, RIVALS_COUNT)
        return self._known_rivals[state]

    def passing(self, chosen: Sequence[Group]) -> list[Group]:
        """Return the rivals that would stay beside `chosen`, at sizes that they can have."""
        return [
            group for group in self.rivals(chosen) if self._stays(chosen, group) and self._allowed([*chosen, group])
        ]

    def reshaped(self, chosen: Sequence[Group]) -> list[Group]:
        """Return groups at the shapes that are best here: what they were along another motion need not be it."""
        found = list(chosen)
        for k, group in enumerate(found):
            rest = [*found[:k], *found[k + 1 :]]
            (anew,) = self.refine([*self.base, *rest], [group])
            if self._allowed([*rest, anew]) and self._worth([*rest, anew]) > self._worth(found):
                found[k] = anew
        return found

    def _ranked(self, chosen: Sequence[Group], most: int) -> list[Group]:
        """Rank names by what they gain on all recordings, as columns or at their size, and search their shapes."""
        beside = [*self.base, *chosen]
        fold = Fold(beside, self.source.sums, on_noise=False)
        by_name: dict[tuple[str, str], list[tuple[float, Group]]] = {}
        taken = {group.key for group in chosen}
        open_ones = [group for group in self.library if group.key not in taken]
        for group, at_size in zip(open_ones, self.gains_at_size(beside, open_ones), strict=True):
            gain = max(float(fold.added(group)[0]), at_size)
            shapes = by_name.setdefault(group.key, [])
            shapes.append((gain - self.price() * group.complexity, group))
            shapes.sort(key=lambda row: -row[0])
            # at a few sizes only: which of two places is better shows when each has its own
            del shapes[2 if at_size > 0.0 and not CATALOGUE[group.key[0]].searched else 1 :]
        ranked = sorted(by_name.values(), key=lambda shapes: -shapes[0][0])
        possible = (shapes for shapes in ranked[: 4 * most] if self._allowed([*chosen, shapes[0][1]]))
        found: dict[tuple[str, str], Group] = {}
        for group in self.refine(beside, [group for shapes in itertools.islice(possible, most) for _, group in shapes]):
            if group.key not in found or self._worth([*chosen, group]) > self._worth([*chosen, found[group.key]]):
                found[group.key] = group
        return list(found.values())

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
        best = max(candidates, key=lambda group: gains[id(group)] - self.price() * _form(group))
        excused = self._excused_beside([*beside, best])
        near = [
            group
            for group in candidates
            if group.complexity < best.complexity
            and gains[id(best)] - gains[id(group)] < excused(best, group, gains[id(best)])
        ]
        return max(near, key=lambda group: gains[id(group)] - self.price() * group.complexity, default=best)

    def _allowed(self, groups: Sequence[Group]) -> bool:
        """Tell whether every amplitude is one that its effect can have."""
        return within_bounds(solve([*self.base, *groups], self.source.sums), self.scale_sd_ratio)

    def _competed(self, chosen: list[Group]) -> list[Group]:
        """Let each hypothesis compete again beside the others: what came first need not be true."""
        for _ in range(2):
            before = [group.key for group in chosen]
            for k in range(len(chosen)):
                rest = [*chosen[:k], *chosen[k + 1 :]]
                rivals = [group for group in self.rivals(rest) if self._stays(rest, group)]
                allowed = [group for group in (chosen[k], *rivals) if self._allowed([*rest, group])] or [chosen[k]]
                best = self._simplest(rest, allowed)
                if best.key != chosen[k].key or self._worth([*rest, best]) > self._worth(chosen) + 1e-6:
                    chosen = [*chosen[:k], best, *chosen[k + 1 :]]
            if [group.key for group in chosen] == before:
                break
        return chosen

    def _stays(self, chosen: Sequence[Group], group: Group) -> bool:
        """Tell whether a hypothesis gains beyond noise, more than it costs, enough, and nothing speaks against it."""
        whole = self.gain([*chosen, group])
        known = CATALOGUE.get(group.key[0])
        repeats = known is not None and known.period != ""  # at one pitch: inexact laws leave little there
        ratio = REPEATING_RATIO if repeats else MATERIAL_RATIO
        least = ratio * (whole - self.gain([]) + self.modelled)
        gained = whole - self.gain(chosen)
        if gained <= least and gained > self._inexact(chosen, group) and self._is_exact_with(chosen, group):
            least = 0.0
        enough = max(
            self._threshold_of(chosen, group), least, self.price() * group.complexity, AT_SIZE_RATIO * self.at_size
        )
        if not self._training_shows(chosen, group):
            enough = max(enough, EXACT_RATIO * (whole - self.gain([]) + self.modelled + self.at_size))
        return gained > enough and self._foretells(chosen, [group])

    def _training_shows(self, chosen: Sequence[Group], group: Group) -> bool:
        """Tell whether recordings that fits may see show a hypothesis by themselves; all do where none is kept apart.

        What one recording alone shows, nothing but its size tells from what laws are inexact by there: beside a clock
        of 1.3 million squares, one of the other sensor gained 2 in four recordings and 249 in the one kept apart.
        """
        if not self.held or group.is_slope:
            return True
        now, with_it = (solve([*self.base, *some], self.training).gain for some in (chosen, [*chosen, group]))
        return with_it - now > ALIAS_GAIN

    def _inexact(self, chosen: Sequence[Group], group: Group) -> float:
        """Return what the laws that are chosen may be inexact by where no curve is left beside them and `group`.

        Frictions are as exact as smooth laws there: beside 0.2 to 15 million squares of theirs, in twelve sets in which
        nothing else was hidden, no other law gained more than 1e-5 of them. A cubic stiffness that gained 500 beside
        6.8 million was left out. Only another friction of the body may be what they are inexact by: beside Dahl's, with
        a slip of 1.3 um, one along the way gained 2.4e-5.
        """
        now = self.gain(chosen)
        smooth = sum(
            now - self.gain([one for one in chosen if one is not other])
            for other in chosen
            if _is_smooth(other) or (_is_friction(other) and not (_is_friction(group) and other.key[1] == group.key[1]))
        )
        total = self.gain([*chosen, group]) - self.gain([]) + self.modelled
        return EXACT_RATIO * max(total - smooth, 0.0) + SMOOTH_RATIO * smooth

    def _is_exact_with(self, chosen: Sequence[Group], group: Group) -> bool:
        """Tell whether no curve finds anything any more with a hypothesis, which is a good part of what was left.

        A second friction of a body may be what the first one's law is inexact by (56 squares of 12 000 at 0.1 mm/s,
        with a sub-linear friction that nobody else met): it has to take away a curve that there was. What explains a
        small part of what laws leave is what they are inexact by: beside a mode that left 4300 squares, 7 deviations of
        the floor, a base that shakes at its frequency gained 286.
        """
        if _has_akin(chosen, group) and not self.leaves_curve(chosen):
            return False
        now = self.gain(chosen)
        left = _above_floor(self.source.sums) - now
        if self.gain([*chosen, group]) - now < EXPLAINED_SHARE * (left - self._floor_scatter()):
            return False
        return not self.leaves_curve([*chosen, group])

    def leaves_curve(self, chosen: Sequence[Group]) -> bool:
        """Tell whether a table over position, velocity or time still finds something."""
        now = self.gain(chosen)
        return any(self.gain([*chosen, curve]) - now > CURVE_GAIN * self.threshold for curve in self.curves)

    def lacks_a_name(self, chosen: Sequence[Group]) -> bool:
        """Tell whether beside some names already a curve explains more than any further name: what is left has none.

        Beside one or two, the curve may be of two effects that follow the same quantity.
        """
        if len(chosen) < NAMES_BESIDE_CURVE_COUNT:
            return False
        now = self.gain(chosen)
        left = sum(float(s.gram[0, 0]) - s.count for s in self.source.sums) - self.gain([])
        least = max(CURVE_GAIN * self.threshold, MATERIAL_RATIO * max(left, 0.0))
        named = max((self.gain([*chosen, group]) - now for group in self.rivals(chosen)), default=0.0)
        return any(self.gain([*chosen, curve]) - now > max(least, named) for curve in self.curves)

    def _foretells(self, chosen: Sequence[Group], more: Sequence[Group]) -> bool:
        """Tell whether held-out recordings do not speak against what comes on top.

        Of two bodies that are both late one slope, along which no contact moves, is far from where both are: a
        recording that grazes an edge foretells another size there (67 us of 249) than at the place itself.
        """
        if any(group.is_slope for group in more):
            return True
        return self.foretold([*chosen, *more]) - self.foretold(chosen) > -CONTRADICTION

    def _threshold_of(self, chosen: Sequence[Group], group: Group) -> float:
        """Return what a hypothesis has to gain beside `chosen` to stand out of noise, searched shapes included.

        What a known parameter does is exact, and its stated uncertainty is paid for by its prior.
        """
        if group.key[1] != "parameter":
            return NAMING_RATIO * self.threshold + SEARCH_PRICE * group.searched
        is_alone = not chosen and not self.at_size
        return self._threshold_of_parameters() if is_alone else self.threshold

    def _threshold_of_parameters(self) -> float:
        """Return what a known parameter has to gain beyond its prior where no effect is found beside it.

        All as stated, each gains a chi square of one number, and the largest of them counts: by what the best of the
        whole library gains on noise an error of 5.5 deviations, half of which the mass took, was none (15 squares of
        25). Beside effects, laws are not that exact: a spring of the joint that gained 12 was 23 deviations off.
        """
        return _largest_chi_square(sum(group.key[1] == "parameter" for group in self.library))

    def _admissible(self, start: Sequence[Group]) -> list[Group]:
        """Take hypotheses back, the least useful first, until every amplitude is one that its effect can have.

        And until none gains less than the best of the library does on noise: a contact that seemed soft (491 squares)
        was one whose edges wear, and gained 3 where they had been put.
        """
        chosen = list(start)
        while chosen:
            without = [[other for other in chosen if other is not group] for group in chosen]
            rest = max(without, key=self.gain)
            (weakest,) = (group for group in chosen if group not in rest)
            least = min(self.threshold, self._threshold_of(rest, weakest))
            if self._allowed(chosen) and self.gain(chosen) - self.gain(rest) > least:
                break
            chosen = rest
        return chosen

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

    def aliases(self, chosen: Sequence[Group], group: Group) -> list[tuple[tuple[str, str], float]]:
        """Return the keys that would do as well as `group` beside the others, with the margin that they lose by.

        What acts about a place does so from along the travel: anchored ten metres away, a cable is an offset, whose set
        it was named in. The same law elsewhere does so at the same shape: a drift of the end's sensor over 52 s and one
        of the macro's over 36 s were 10 squares apart, over 52 s both are one.
        """
        rest = [other for other in chosen if other is not group]
        with_it = self.gain(chosen)
        gained = with_it - self.gain(rest)
        left = self._left_at_most(chosen)
        margins: dict[tuple[str, str], float] = {}
        taken = {other.key for other in chosen}
        for rival in self.rivals(rest):
            if rival.key in taken or _form(rival) > _form(group):
                continue
            forms = [one for one in self.brought_near(rival, group) if self._allowed([*rest, one])]
            if not forms:
                continue
            distances = [self.distance([*rest, group], [*rest, one]) for one in forms]
            apart = min(distances)
            other = forms[distances.index(apart)]
            margin = with_it - self.gain([*rest, other])
            share = margin / max(gained, 1e-300)
            inexact = margin < left and share < ALIAS_SHARE and _lies_between(margin, apart)
            if apart < ALIAS_GAIN or inexact or self._is_rough_friction(group, other, share):
                margins[other.key] = margin
        return sorted(margins.items(), key=lambda row: row[1])

    def _left_at_most(self, chosen: Sequence[Group]) -> float:
        """Return what is left above the floor at most, in squares of the noise.

        It is what laws are inexact by: a law that loses by more than that is not excused by it. On a set of which an
        asymmetric friction left 60 000 squares of 167 million, others lost by 160 000 and more.
        """
        return max(_above_floor(self.source.sums) - self.gain(chosen), 0.0) + self._floor_scatter()

    def _floor_scatter(self) -> float:
        """Return what may be left by the noise alone, in squares of it."""
        return LEFT_SDS * float(np.sqrt(2.0 * sum(s.count for s in self.source.sums)))

    def distance(self, groups: Sequence[Group], others: Sequence[Group]) -> float:
        """Return the square of the distance between what two models say of all recordings, in units of the noise.

        Known parameters are part of what they say: a wrong mass of the micro is every other mass and force constant
        wrong by as much, which nobody who has weighed them believes.
        """
        sums = self.source.sums
        one, other = (solve([*self.base, *model], sums) for model in (groups, others))
        known = {column: sd for group in self.base for column, sd in zip(group.columns, group.prior_sds, strict=True)}
        values = [
            {slot: float(value) for slot, value in zip(model.slots, model.values, strict=True) if slot[0] in known}
            for model in (one, other)
        ]
        total = sum(((value - values[1][slot]) / known[slot[0]]) ** 2 for slot, value in values[0].items())
        for s in sums:
            apart = np.zeros(s.gram.shape[0])
            for solution, sign in ((one, 1.0), (other, -1.0)):
                for (column, scope), value in zip(solution.slots, solution.values, strict=True):
                    if covers(scope, s):
                        apart[column] += sign * value
            total += float(apart @ s.gram @ apart)
        return total

    def _excused_beside(self, chosen: Sequence[Group]) -> Callable[[Group, Group, float], float]:
        """Return (better, simpler, gain of the better) -> by how much less the simpler one may gain; `chosen` stay.

        Smooth laws are as exact as they come; where no curve is left beside what stays, others are more so than where
        one is. By more than all that is left no law is inexact: bristles that left nothing gained 4700 squares of 10
        million more than Dahl's, and were a level beside those.
        """
        share = ALIAS_SHARE if self.leaves_curve(chosen) else EXACT_RATIO
        left = self._left_at_most(chosen)

        def excused(better: Group, simpler: Group, gained: float) -> float:
            ratio = SMOOTH_RATIO if _is_smooth(better) and _is_smooth(simpler) else share
            return ALIAS_GAIN + min(ratio * gained, left)

        return excused

    def _excused_of_parts(self, chosen: Sequence[Group], group: Group) -> float:
        """Return by how much less than bristles, one of `chosen`, a level and a rise may gain and still be as good.

        As laws they are as exact as smooth ones, up to the speed over which a sign turns, which the grid has: bristles
        that slip by 12 nm gained 47 squares of 2.5 million more than the level and rise that they were, and by 10 nm
        235 of 8 million.
        """
        gained = self.gain(chosen) - self.gain([other for other in chosen if other is not group])
        return ALIAS_GAIN + PARTS_RATIO * gained

    def _is_rough_friction(self, group: Group, other: Group, share: float) -> bool:
        """Tell whether two frictions of a rough machine differ by no more of a gain than such laws are inexact by."""
        frictions = _shows_at_low_speed(group) and _shows_at_low_speed(other)
        return self.is_rough and frictions and share < LOW_SPEED_SHARE


@functools.cache
def _largest_chi_square(count: int) -> float:
    """Return the quantile of the largest of so many squares of one deviation each."""
    return float(chi2.ppf(NULL_QUANTILE ** (1.0 / max(count, 1)), 1))


def _above_floor(sums: Sequence[Sums]) -> float:
    """Return what recordings hold beyond their noise, in squares of it."""
    return float(sum(s.gram[0, 0] - s.count for s in sums))


def _lies_between(margin: float, apart: float) -> bool:
    """Tell whether recordings lie between two names, `apart` squares from each other, by more than noise does.

    An exact law beats the other one by their distance, give or take twice its root. What gains less than that is no
    exact law, and its margin no proof.
    """
    return margin < apart - BETWEEN_SDS * 2.0 * float(np.sqrt(max(apart, 0.0)))


def _form(group: Group) -> int:
    """Return the numbers that a law is made of, without the place about which it acts.

    A cable pulls towards its anchor wherever that is: with one near zero it is still a cable, and no wider a law than a
    spring about zero. A Stribeck friction without a rise would be none.
    """
    known = CATALOGUE.get(group.key[0])
    return group.complexity - (1 if known is not None and Trait.PLACED in known.traits else 0)


def _has_akin(chosen: Sequence[Group], group: Group) -> bool:
    """Tell whether another friction acts where a friction does."""
    return _shows_at_low_speed(group) and any(
        _shows_at_low_speed(other) and other.key[1] == group.key[1] for other in chosen
    )


def _is_smooth(group: Group) -> bool:
    """Tell whether a law of the library is a force without step and memory, away from the joint.

    Of a user's own nobody knows that its shape is found to the end: one that left 0.9 % drew three more names.
    """
    known = CATALOGUE.get(group.key[0])
    return (
        known is not None
        and not known.origin
        and not known.has_step
        and not known.memory
        and not _shows_at_low_speed(group)
        and group.key[1].endswith(("_force", "_actuator"))
    )


def _is_friction(group: Group) -> bool:
    """Tell whether a law of the library, none of a user's own, is a friction that turns with the direction."""
    known = CATALOGUE.get(group.key[0])
    return known is not None and not known.origin and (known.has_step or _shows_at_low_speed(group))


def _shows_at_low_speed(group: Group) -> bool:
    known = CATALOGUE.get(group.key[0])
    return known is not None and known.shown_by == "low speed"
