"""Whether a hypothesis may stay beside others: its gain against thresholds from the workflow's own null.

A term stays when it gains on all recordings together more than the best of the whole library does on noise and a share
of what is reducible at all, and when recordings that no fit saw do not speak against it. Pure.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.stats import chi2

from stagectl.effects import CATALOGUE
from stagectl.gap.findings import PARAMETER
from stagectl.gap.kinds import act_apart, has_akin, is_friction, is_off_joint, is_smooth
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

MOST_SHARE = 0.8
"""Of all that is left at most, from what on a hypothesis is what was left, whatever a curve still finds: beside 215
million squares of a Stribeck friction and a base that shakes, a saturation that was there gained 31 900 of 34 900, and
of the 3000 behind it the best curve found 770. Not of a machine with force noise: what is left of that counts as noise,
and a cable gained 930 of 65."""

OFF_JOINT_RATIO = 2e-5
"""The same of what laws have gained that act away from the joint. Least exact are frictions: what turns over
micrometres goes by readings, and beside bristles that slip over 6 um and 11 million squares another friction gained
420, which was none. Beside cyclic errors of 80 000 to 2.9 million squares (1001106, 1004048, 1004110, 1010110), dead
bands of 1.9 and 3.2 million (3416, 3426) and modes of 10 000 to 580 000 (1004116, 1008109, 1008113) no other law
gained more than on noise."""

SMOOTH_RATIO = 2e-6
"""The same of what smooth laws have gained: forces of place, time, command and speed along a motion that is measured to
nanometres. Beside 13 to 29 million squares of a shaking base, a reaction and bristles the best other law gained 5 to
10, as on noise."""

AT_SIZE_RATIO = 1e-6
"""The same of what readings and commands explain that are taken at their size: beside a clock of 367 million squares
one of the other sensor gained 67, which was no clock."""

CURVE_GAIN = 3.0
"""Of what the best of the library gains on noise, what a curve has to gain to be a rest that something has left."""

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

LEFT_SDS = 3.0
"""Deviations of the floor by which more may be left than is seen."""

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
    anchors_moved: Callable[[Sequence[Group], Group], Sequence[Group]] = lambda chosen, group: ()
    """(names, one of them) -> what the others change by where they act about another place."""
    curves: list[Group] = field(default_factory=list)
    threshold: float = 0.0
    modelled: float = 0.0  # what laws of the model explain already that are inexact, in squares of the noise
    at_size: float = 0.0  # what laws explain that are part of the operating point, in squares of the noise
    stated_sds: dict[str, float] = field(default_factory=dict)  # of each known parameter that competes
    scale_sd_ratio: float = 0.0  # what masses and force constants are believed to be uncertain by
    is_rough: bool = False  # a force noise besides that of the sensors
    is_closer: bool = False  # columns are along the motion under what the look before has found
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

    def rivals(self, chosen: Sequence[Group]) -> list[Group]:
        """Return the names that gain most beside `chosen`, each at its best shape."""
        state = frozenset(group.columns for group in chosen)
        if state not in self._known_rivals:
            self._known_rivals[state] = self._ranked(chosen, RIVALS_COUNT)
        return self._known_rivals[state]

    def passing(self, chosen: Sequence[Group]) -> list[Group]:
        """Return the rivals that would stay beside `chosen`, at sizes that they can have."""
        return [group for group in self.rivals(chosen) if self.stays(chosen, group) and self.allows([*chosen, group])]

    def reshaped(self, chosen: Sequence[Group]) -> list[Group]:
        """Return groups at the shapes that are best here: what they were along another motion need not be it."""
        found = list(chosen)
        for k, group in enumerate(found):
            rest = [*found[:k], *found[k + 1 :]]
            (anew,) = self.refine([*self.base, *rest], [group])
            if self.allows([*rest, anew]) and self.worth([*rest, anew]) > self.worth(found):
                found[k] = anew
        return found

    def _ranked(self, chosen: Sequence[Group], most: int) -> list[Group]:
        """Rank names by what they gain on all recordings, as columns or at their size, and search their shapes.

        Of an error of one sensor the same of the other one, too: of what puts the joint elsewhere seven gained as much
        but for 400 of 33 000, and a scale error was told without the other sensor's, which was the seventh (1007071).
        """
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
            # at a few sizes only: which of two places is better shows when each has its own; and which of two pitches
            # when each is searched: of one of 54.8 mm the other half of its line, at 60.7 mm, gained less than a half
            searched = CATALOGUE[group.key[0]].searched if group.key[0] in CATALOGUE else ()
            del shapes[2 if "pitch_m" in searched or (at_size > 0.0 and not searched) else 1 :]
        ranked = sorted(by_name.values(), key=lambda shapes: -shapes[0][0])
        possible = (shapes for shapes in ranked[: 4 * most] if self.allows([*chosen, shapes[0][1]]))
        picked = list(itertools.islice(possible, most))
        laws = {shapes[0][1].key[0] for shapes in picked}
        picked += [
            shapes for shapes in possible if shapes[0][1].key[1].endswith("_sensor") and shapes[0][1].key[0] in laws
        ]
        found: dict[tuple[str, str], Group] = {}
        for group in self.refine(beside, [group for shapes in picked for _, group in shapes]):
            if group.key not in found or self.worth([*chosen, group]) > self.worth([*chosen, found[group.key]]):
                found[group.key] = group
        return list(found.values())

    def price(self) -> float:
        """Return what an amplitude must gain to be worth itself (Schwarz 1978)."""
        return float(np.log(sum(s.count for s in self.training)))

    def worth(self, groups: Sequence[Group]) -> float:
        """Return the gain on all recordings, less the price of the amplitudes."""
        return self.gain(groups) - self.price() * sum(group.complexity for group in groups)

    def allows(self, groups: Sequence[Group]) -> bool:
        """Tell whether every amplitude is one that its effect can have."""
        return within_bounds(solve([*self.base, *groups], self.source.sums), self.scale_sd_ratio)

    def stays(self, chosen: Sequence[Group], group: Group) -> bool:
        """Tell whether a hypothesis gains beyond noise, more than it costs, enough, and nothing speaks against it.

        Enough of what laws gained that may be inexact here: iron of the macro's motor of 570 million squares, which
        left 28 000 and curves over the macro, hid a friction of the micro of 139 (1010103).
        """
        whole = self.gain([*chosen, group])
        known = CATALOGUE.get(group.key[0])
        repeats = known is not None and known.period != ""  # at one pitch: inexact laws leave little there
        ratio = REPEATING_RATIO if repeats else MATERIAL_RATIO
        here = [other for other in chosen if not act_apart(other, group)]
        gained = whole - self.gain(chosen)
        least = ratio * (self.gain(here) - self.gain([]) + gained + self.modelled)
        if gained <= least and gained > self._inexact(chosen, group) and self._is_exact_with(chosen, group):
            least = 0.0
        enough = max(
            self.threshold_of(chosen, group), least, self.price() * group.complexity, AT_SIZE_RATIO * self.at_size
        )
        if not self._training_shows(chosen, group):
            enough = max(enough, EXACT_RATIO * (whole - self.gain([]) + self.modelled + self.at_size))
        return gained > enough and self.foretells(chosen, [group])

    def _training_shows(self, chosen: Sequence[Group], group: Group) -> bool:
        """Tell whether recordings that fits may see show a hypothesis by themselves; all do where none is kept apart.

        What one recording alone shows, nothing but its size tells from what laws are inexact by there: beside a clock
        of 1.3 million squares, one of the other sensor gained 2 in four recordings and 249 in the one kept apart.
        """
        if not self.held:
            return True
        now, with_it = (solve([*self.base, *some], self.training).gain for some in (chosen, [*chosen, group]))
        return with_it - now > ALIAS_GAIN

    def _inexact(self, chosen: Sequence[Group], group: Group) -> float:
        """Return what the laws that are chosen may be inexact by where no curve is left beside them and `group`.

        Frictions are nearly as exact as smooth laws there: beside 0.2 to 15 million squares of theirs, in twelve sets
        in which nothing else was hidden, no other law gained more than 1e-5 of them. A cubic stiffness that gained 500
        beside 6.8 million was left out. Only another friction of the body may be what they are inexact by: beside
        Dahl's, with a slip of 1.3 um, one along the way gained 2.4e-5. What a law of one body is inexact by shows in
        its own motion: beside a mode of the macro of 1.7 million squares a drag of the micro that gained 252 was left
        out, and was a curve that nothing explained. Of two frictions each explains most of what the other does: one by
        one they were worth little of their 754 000 squares, and a spring of 205 was left out (1009049); so was a cable
        of 490 beside 11 million squares of a cyclic error (1010150). Along the motion under them they leave what smooth
        laws do: frictions of 69 to 220 million squares 10 to 37 for any other law.
        """
        here = [other for other in chosen if not act_apart(other, group)]
        rough = [other for other in here if not is_smooth(other)]
        rougher = [
            other
            for other in rough
            if not is_off_joint(other) or (is_friction(other) and is_friction(group) and other.key[1] == group.key[1])
        ]
        smooth, off_joint = self.gain(here) - self.gain(rough), self.gain(rough) - self.gain(rougher)
        gained = self.gain([*chosen, group]) - self.gain(chosen)
        rest = self.gain(rougher) - self.gain([]) + gained + self.modelled
        ratio = SMOOTH_RATIO if self.is_closer else OFF_JOINT_RATIO
        return EXACT_RATIO * rest + ratio * off_joint + SMOOTH_RATIO * smooth

    def _is_exact_with(self, chosen: Sequence[Group], group: Group) -> bool:
        """Tell whether no curve finds anything any more with a hypothesis, which is a good part of what was left.

        A second friction of a body may be what the first one's law is inexact by (56 squares of 12 000 at 0.1 mm/s,
        with a sub-linear friction that nobody else met): it has to take away a curve that there was. What explains a
        small part of what laws leave is what they are inexact by: beside a mode that left 4300 squares, 7 deviations of
        the floor, a base that shakes at its frequency gained 286.
        """
        if has_akin(chosen, group) and not self.leaves_curve(chosen):
            return False
        now = self.gain(chosen)
        left = _above_floor(self.source.sums) - now
        gained = self.gain([*chosen, group]) - now
        if gained < EXPLAINED_SHARE * (left - self._floor_scatter()):
            return False
        is_most = not self.is_rough and gained > MOST_SHARE * self.left_at_most(chosen)
        return is_most or not self.leaves_curve([*chosen, group])

    def leaves_curve(self, chosen: Sequence[Group]) -> bool:
        """Tell whether a table over position, velocity or time still finds something."""
        now = self.gain(chosen)
        return any(self.gain([*chosen, curve]) - now > CURVE_GAIN * self.threshold for curve in self.curves)

    def foretells(self, chosen: Sequence[Group], more: Sequence[Group]) -> bool:
        """Tell whether held-out recordings do not speak against what comes on top.

        Of two bodies that are both late one slope, along which no contact moves, is far from where both are: a
        recording that grazes an edge foretells another size there (67 us of 249) than at the place itself.
        """
        if any(group.is_slope for group in more):
            return True
        return self.foretold([*chosen, *more]) - self.foretold(chosen) > -CONTRADICTION

    def threshold_of(self, chosen: Sequence[Group], group: Group) -> float:
        """Return what a hypothesis has to gain beside `chosen` to stand out of noise, searched shapes included.

        What a known parameter does is exact, and its stated uncertainty is paid for by its prior.
        """
        if group.key[1] != PARAMETER:
            return NAMING_RATIO * self.threshold + SEARCH_PRICE * group.searched
        is_alone = not self.at_size and all(other.key[1] == PARAMETER for other in chosen)
        return self._threshold_of_parameters() if is_alone else self.threshold

    def _threshold_of_parameters(self) -> float:
        """Return what a known parameter has to gain beyond its prior where no effect is found beside it.

        All as stated, each gains a chi square of one number, and the largest of them counts: by what the best of the
        whole library gains on noise an error of 5.5 deviations, half of which the mass took, was none (15 squares of
        25). Beside effects, laws are not that exact: a spring of the joint that gained 12 was 23 deviations off.
        """
        return _largest_chi_square(sum(group.key[1] == PARAMETER for group in self.library))

    def surprise(self, beside: Sequence[Group], group: Group) -> float:
        """Return what speaks against a known parameter that is off by so much, in squares of the noise; 0 of an effect.

        By how many of its stated deviations one is off that is wrong nobody knows: twice as many are half as likely. A
        push back that is stated exactly was 3.4 % off, by one square more than a force constant that was.
        """
        if group.key[1] != PARAMETER:
            return 0.0
        error = float(solve([*self.base, *beside, group], self.source.sums).of(group)[0][0])
        return 2.0 * math.log(max(abs(error) / self.stated_sds[group.key[0]], 1.0))

    def left_at_most(self, chosen: Sequence[Group]) -> float:
        """Return what is left above the floor at most, in squares of the noise.

        It is what laws are inexact by: a law that loses by more than that is not excused by it. On a set of which an
        asymmetric friction left 60 000 squares of 167 million, others lost by 160 000 and more.
        """
        return max(_above_floor(self.source.sums) - self.gain(chosen), 0.0) + self._floor_scatter()

    def has_named_noise(self, chosen: Sequence[Group]) -> bool:
        """Tell whether what has a name now was taken for force noise: less is left than the floor.

        Above noise that is not there innovations are no longer independent, and what turns phases gains by that: beside
        a friction of 32 mN of force noise, of which 17 600 squares too few were left, a mode at 34 Hz gained 286.
        """
        left = _above_floor(self.source.sums) - self.gain(chosen)
        return self.is_rough and left < -self._floor_scatter()

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


@functools.cache
def _largest_chi_square(count: int) -> float:
    """Return the quantile of the largest of so many squares of one deviation each."""
    return float(chi2.ppf(NULL_QUANTILE ** (1.0 / max(count, 1)), 1))


def _above_floor(sums: Sequence[Sums]) -> float:
    """Return what recordings hold beyond their noise, in squares of it."""
    return float(sum(s.gram[0, 0] - s.count for s in sums))
