"""From a hypothesis at a place of its grid to the shape that the recordings ask for.

A pitch, a Stribeck speed, a delay are searched by one line after the other, the amplitudes and all known parameters
solved for at each point (variable projection, Golub and Pereyra 1973). Effects whose size is no factor (a delay, an
edge that moves by more than the stage touches) are searched in all their parameters, at their size. Pure.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize_scalar

from stagectl.effects import CATALOGUE, Effect, Trait
from stagectl.gap import hypotheses
from stagectl.gap.effect_forces import edges_out_m
from stagectl.gap.evidence import Columns, Evidence
from stagectl.gap.forces import squares_of
from stagectl.gap.grids import along_travel_m, free_shapes
from stagectl.gap.hypotheses import Term
from stagectl.gap.late_readings import makes_late
from stagectl.gap.normal_equations import Group, Placed, active_slots, covers, normal_of
from stagectl.gap.reading_errors import moved_m
from stagectl.gap.recording import Recording, relative_motion

_SWEEPS = 2
_MOST_SWEEPS = 7
_SWEPT_GAIN = 1.0
"""Squares of the noise that a sweep must gain for another one, narrower: of a ripple with 60 million of them a pitch
that is 1e-4 off leaves a thousand."""

_BRACKET = 2.2  # from the grid's place, up and down
_PITCH_SPANS = 0.6  # a pitch moves by so many of what turns its phase by one turn over the travel
_ANCHOR_M = 1.0
_MOVED_PLACE_M = 0.1  # any: between two places a law about a place is a straight line
_NEAR_ZERO = 0.05
_ALONG_THE_WAY, _END = "position_dependent_friction", "ends_m"
LATCH_SDS = 2.0
_STEPS = (0.3, 1.0, 3.0)
_LEAST_ASKED = 0.02
_LATE_M = (0.3e-6, 1e-6, 3e-6, 10e-6, 30e-6, 100e-6, 500e-6)
"""How far late readings may be from where a body is; a body that rests is read where it is."""

_MISREAD_M = (0.3e-6, 1e-6, 3e-6, 10e-6, *np.geomspace(30e-6, 500e-6, 12))
"""The same of other errors of a sensor: one of 140 um gained nothing at 30 and at 500 um, and little at 100."""

_EDGE_MOVED_M = (0.3e-6, 1e-6, 3e-6, *np.arange(5e-6, 60e-6, 5e-6), *np.geomspace(60e-6, 500e-6, 22))
"""How far an edge may lie elsewhere. Its gain stands out no wider than contacts are deep, however far it has moved:
10 um under 100 N. An edge 23 um out gained nothing at 10 and at 30 um, where half of all contact is another one."""

_MOST_STEPS = 8
_STEP_PARTS = (1.0, 0.3)
_STEPPED_GAIN = 0.1
_SLOPE_RATIO = 1e-4
"""Share of the range of a search that a slope is taken over."""

_TOLERANCE_RATIO = 3e-3
_WORST = 1e300
_LARGEST = 1e100


class Refiner:
    """Searches the shapes of single terms beside groups that stay as they are.

    It travels without recordings and columns: `on` gives them back to it where it works.
    """

    def __init__(self, evidence: Evidence, beside: Sequence[Group]):
        """Eliminate `beside` once; every trial costs its own columns only."""
        self._slots, precision = active_slots(beside, evidence.sums)
        normal, right = normal_of(self._slots, precision, evidence.sums)
        scale = np.sqrt(np.diag(normal))
        scale[scale == 0.0] = 1.0
        weights = np.outer(scale, scale)
        self._inverse = np.linalg.inv(normal / weights + 1e-10 * np.eye(scale.size)) / weights
        self._values = self._inverse @ right
        self._terms = {group.columns[0]: evidence.terms[group.columns[0]] for group in beside}
        self._attach(evidence)

    def _attach(self, evidence: Evidence) -> None:
        active = []  # by recording: slots that reach it, and by channel which of them are not zero, their rows
        for origin, channels in zip(evidence.origins, evidence.channels, strict=True):
            here = [k for k, (_, scope) in enumerate(self._slots) if covers(scope, origin)]
            wanted = [self._slots[k][0] for k in here]
            active.append((here, [channel.of(wanted) for channel in channels]))
        self._active = active
        self._evidence = evidence

    def __getstate__(self) -> dict[str, Any]:
        """Leave the recordings and their columns behind."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_evidence", "_active")}

    def on(self, evidence: Evidence) -> Self:
        """Return this, at work on the evidence of this process."""
        if "_evidence" not in self.__dict__:
            evidence.hold(self._terms)
            self._attach(evidence)
        return self

    def refined(self, term: Term) -> tuple[Term, int] | None:
        """Return the term at its best shape, and how many numbers were searched.

        None where there are none to search, or where no size that its effect can have is near what recordings ask for.
        """
        if term.acts_on == "parameter":
            return None
        free = free_shapes(CATALOGUE[term.name])
        entire = whole_of(term)
        if not free and not entire:
            return None
        slope, moves = term, entire and term.acts_on.endswith(("_sensor", "contact_edge"))
        if entire:
            at_size = self._at_size(term)
            if at_size is None:
                return None
            term = at_size
            free = tuple(dict.fromkeys((*CATALOGUE[term.name].parameters[:1], *free)))
        if Trait.PLACED in CATALOGUE[term.name].traits:
            return self._at_its_place(term), len(free)
        term, best = self._ended(term)
        shape = dict(term.shape)
        for sweep in range(_MOST_SWEEPS):
            before = best
            for name in free:
                shape, best = self._line(term, shape, name, best, 2.0 if entire and not sweep else 0.4**sweep)
            if sweep + 1 >= _SWEEPS and (_has_valley(term, free) or not best - before > _SWEPT_GAIN):
                break
        found = with_shape(term, shape)
        if found.scope == "structural" and (not found.linear or _has_valley(found, free)):
            found, best = self._stepped(found, free, best)
        if moves and self._is_beside_slopes and self._free_gain(slope) > best:
            found = replace(slope, is_slope=True)  # its size is found together with theirs
        if Trait.LATE_READING in CATALOGUE[found.name].traits and not found.linear:
            # what a latch may be off by is no effect of a sensor
            stated_s = LATCH_SDS * self._evidence.recordings[0].belief(_axis(found)).latch_sd_s
            least = stated_s / found.shape[CATALOGUE[found.name].parameters[0]]
            found = replace(found, bounds=((max(found.bounds[0][0], least), found.bounds[0][1]),))
        return found, len(free) - (0 if found.linear else 1)

    def _ended(self, term: Term) -> tuple[Term, float]:
        """Return a term, and its gain, with an end where its straight line is nothing, if recordings go on from there.

        A search from an end beyond the travel leads nowhere. One 30 mm from the travel's 320 gained 0.04 % more beyond
        it than at the nearest place of the grid, and was 2 % too large with its line driving from there on.
        """
        best = self._gain(term)
        if term.name != _ALONG_THE_WAY:
            return term, best
        farthest_m = _farthest_m(self._evidence.recordings, term)
        if abs(term.shape[_END]) < farthest_m:
            return term, best
        level, slope = self._amplitudes(self._evidence.columns_of(term), term)
        if not abs(level) < abs(slope) * farthest_m:
            return term, best
        ended = with_shape(term, {_END: float(-level / slope)})
        return max((term, best), (ended, self._gain(ended)), key=lambda found: found[1])

    def _at_its_place(self, term: Term) -> Term:
        """Return a law that acts about a place at the place that is asked for: size, and size times place, are factors.

        Searched line by line from the middle of the travel, a cable whose anchor lay beside it was never a rival: there
        its pull gains less than the offset that it mostly is. No farther than along the travel: 0.9 and 1.4 m away a
        cable was an offset and a cubic stiffness, an offset and a spring.
        """
        (name,) = free_shapes(CATALOGUE[term.name])
        here = self._evidence.columns_of(term)
        moved = self._evidence.columns_of(with_shape(term, {name: term.shape[name] + _MOVED_PLACE_M}))
        both = _side_by_side([here, _difference(moved, here)])
        size, shift = self._amplitudes(both, replace(term, amplitudes=(*term.amplitudes, name)))
        if not abs(size) > 0.0:
            return term
        place_m = term.shape[name] + _MOVED_PLACE_M * shift / size
        return with_shape(term, {name: float(np.clip(place_m, *along_travel_m(self._evidence.recordings)))})

    def gain_at_size(self, term: Term) -> float:
        """Return what a hypothesis gains at the best of a few sizes, where its column is of no use: in contact."""
        gains = (self._gain(trial, self._evidence.columns_of_trial) for trial in self._trials(term))
        return max(gains, default=0.0)

    def _at_size(self, term: Term) -> Term | None:
        """Take an amplitude into the shape: the best of some; None where its effect can have none of them."""
        trials = self._trials(term)
        return max(trials, key=lambda trial: self._gain(trial, self._evidence.columns_of_trial), default=None)

    def _trials(self, term: Term) -> list[Term]:
        """Return a term at amplitudes that move readings or edges by some micrometres.

        Elsewhere, at a few steps about what the column asks for: iron that saturates at 360 N asks for 70 times what it
        does at 3000 N, and was looked for at 200 kN. None of those that its effect can't have: a motor that grows
        stronger with its force asks for less than no saturation.
        """
        effect = CATALOGUE[term.name]
        amplitude = effect.parameters[0]
        low, high = effect.bounds[amplitude]
        shape = {name: term.shape.get(name, 0.0) for name in effect.parameters}
        if term.acts_on.endswith(("_sensor", "contact_edge")):
            unit = 1e-3 * high
            moves_m = max(
                _moves_m(r, effect, term.acts_on, shape | {amplitude: unit}) for r in self._evidence.recordings
            )
            tried_m = _tried_m(effect, term.acts_on)
            sizes = [sign * size_m * unit / max(moves_m, 1e-300) for size_m in tried_m for sign in (1.0, -1.0)]
        else:
            asked = float(self._amplitudes(self._evidence.columns_of(term), term)[0])
            here = hypotheses.term_at_size(effect, term.acts_on, shape)
            power = power_of_size(here, self._evidence.recordings)  # where it is, and none that it has everywhere
            grown = {max(asked, _LEAST_ASKED) ** (1.0 / p): None for p in (1.0, power)}
            sizes = [step * share * term.shape[amplitude] for share in grown for step in _STEPS]
        return [
            hypotheses.term_at_size(effect, term.acts_on, shape | {amplitude: size})
            for size in sizes
            if low <= size <= high
        ]

    def _line(
        self, term: Term, shape: dict[str, float], name: str, best: float, narrow: float
    ) -> tuple[dict[str, float], float]:
        """Search one parameter of the shape near where it is."""
        low, high = reach_of(self._evidence.recordings, replace(term, shape=shape), name, narrow)
        if not high > low:
            return shape, best

        def loss(value: float) -> float:
            return -self._gain(with_shape(term, shape | {name: float(value)}))

        outcome = minimize_scalar(
            loss,
            bounds=(low, high),
            method="bounded",
            options={"xatol": _TOLERANCE_RATIO * (high - low), "maxiter": 16},
        )
        if -outcome.fun > best:
            return shape | {name: float(outcome.x)}, float(-outcome.fun)
        return shape, best

    def _stepped(self, term: Term, free: Sequence[str], best: float) -> tuple[Term, float]:
        """Return a term at the shapes that its slopes ask for, as long as a step gains (Gauss-Newton).

        Line by line a search goes zigzag where shapes depend on each other: a share of 15 % of the mass at 18.8 Hz came
        out as 26 % at 18.5 Hz, with a third of a million squares left; five steps from there left none.
        """
        for _ in range(_MOST_STEPS):
            changes = self._asked_of_slopes(term, free)
            gain = -_WORST
            for part in _STEP_PARTS:
                there = {name: term.shape[name] + part * change for name, change in changes.items()}
                bounds = CATALOGUE[term.name].bounds
                tried = with_shape(term, {name: float(np.clip(at, *bounds[name])) for name, at in there.items()})
                gain = self._gain(tried)
                if gain > best:
                    break
            if not gain > best + _STEPPED_GAIN:
                break
            term, best = tried, gain
        return term, best

    def _asked_of_slopes(self, term: Term, free: Sequence[str]) -> dict[str, float]:
        """Return by how much shapes are to change, all of them together, and amplitudes that are solved for with them.

        Slopes over shapes are those of what the term does at the amplitudes that are best before the step.
        """
        here = self._evidence.columns_of(term)
        parts, spans = [here], {}
        try:
            sizes = self._amplitudes(here, term) if term.linear else np.ones(1)
            for name in free:
                low, high = reach_of(self._evidence.recordings, term, name, _SLOPE_RATIO)
                if high > low:
                    ends = (self._evidence.columns_of(with_shape(term, {name: at})) for at in (high, low))
                    parts.append(_weighted(_difference(*ends), sizes))
                    spans[name] = high - low
            normal, right = self._reduced(_side_by_side(parts), replace(term, amplitudes=(*term.amplitudes, *spans)))
            if term.linear:
                steps = self._solved(normal, right)[sizes.size :]
            else:
                steps = self._solved(normal[1:, 1:], right[1:] - normal[1:, 0])
        except np.linalg.LinAlgError:  # two shapes that do the same
            return {}
        return {name: float(step) * span for step, (name, span) in zip(steps, spans.items(), strict=True)}

    @property
    def _is_beside_slopes(self) -> bool:
        """Tell whether beside it the size of something that moves readings or edges is known as a slope."""
        return any(
            hypotheses.is_deviation(term) and term.acts_on.endswith(("_sensor", "contact_edge"))
            for term in self._terms.values()
        )

    def _free_gain(self, term: Term) -> float:
        """Return what a term's columns gain at the amplitudes that are best."""
        normal, right = self._reduced(self._evidence.columns_of(term), term)
        return float(right @ self._solved(normal, right))

    def _gain(self, term: Term, columns_of: Callable[[Term], Columns] | None = None) -> float:
        """Return what a term gains beside the others; at its size without any freedom of its own."""
        try:
            columns = (columns_of or self._evidence.columns_of)(term)
        except (FloatingPointError, ValueError):
            return -_WORST
        if any(
            part is not None and not -_LARGEST < part.min() <= part.max() < _LARGEST for one in columns for part in one
        ):
            return -_WORST  # a shape at which a law runs away
        normal, right = self._reduced(columns, term)
        if not term.linear:
            ones = np.ones(right.size)
            return float(2.0 * ones @ right - ones @ normal @ ones)
        return float(right @ self._solved(normal, right))

    def _amplitudes(self, columns: Columns, term: Term) -> np.ndarray:
        return self._solved(*self._reduced(columns, term))

    @staticmethod
    def _solved(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        weights = np.outer(scale, scale)
        return np.linalg.solve(normal / weights + 1e-10 * np.eye(scale.size), right / scale) / scale

    def _reduced(self, columns: Columns, term: Term) -> tuple[np.ndarray, np.ndarray]:
        """Return (normal matrix, right side) of a term's amplitudes with everything beside it eliminated."""
        origins = self._evidence.origins
        places = scopes_of(term.scope, origins)
        width = len(term.amplitudes)
        size = width * len(places)
        normal, right = np.zeros((size, size)), np.zeros(size)
        cross = np.zeros((len(self._slots), size))
        for origin, channels, (here, active), parts in zip(
            origins, self._evidence.channels, self._active, columns, strict=True
        ):
            at = next(k for k, scope in enumerate(places) if covers(scope, origin))
            mine = slice(at * width, (at + 1) * width)
            for channel, (present, rows), part in zip(channels, active, parts, strict=True):
                if part is None:
                    continue
                normal[mine, mine] += part @ part.T
                right[mine] += part @ channel.rows[0]
                if rows is not None:
                    cross[[here[k] for k in present], mine] += rows @ part.T
        return normal - cross.T @ self._inverse @ cross, right - cross.T @ self._values


def _difference(a: Columns, b: Columns) -> Columns:
    """Return one term's columns minus another's."""

    def of(one: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
        if one is None or other is None:
            return one if other is None else -other
        return one - other

    return [[of(*pair) for pair in zip(*pairs, strict=True)] for pairs in zip(a, b, strict=True)]


def _weighted(columns: Columns, weights: np.ndarray) -> Columns:
    """Return the sum of a term's columns, each so many times, as the one column of a term."""
    return [[None if part is None else weights[None, :] @ part for part in parts] for parts in columns]


def _has_valley(term: Term, free: Sequence[str]) -> bool:
    """Tell whether several shapes of a linear law are searched: they depend on each other, as bristles do.

    Line by line a friction of bristles ended at 0.68 ms of damping for 0.95, with 1300 squares left of 6 million.
    """
    return term.linear and term.scope == "structural" and len(free) > 1


def _side_by_side(columns: Sequence[Columns]) -> Columns:
    """Return the columns of several terms as those of one."""

    def of(parts: tuple[np.ndarray | None, ...]) -> np.ndarray | None:
        there = next((part for part in parts if part is not None), None)
        if there is None:
            return None
        return np.concatenate([np.zeros_like(there) if part is None else part for part in parts])

    return [[of(parts) for parts in zip(*channels, strict=True)] for channels in zip(*columns, strict=True)]


def _tried_m(effect: Effect, place: str) -> tuple[float, ...]:
    """Return by how much an effect that moves edges or readings is tried to move them."""
    if place == "contact_edge":
        return _EDGE_MOVED_M
    return _LATE_M if makes_late(effect) else _MISREAD_M


def _moves_m(recording: Recording, effect: Effect, place: str, values: dict[str, float]) -> float:
    """Return by how much an effect moves a reading or an edge at most, touched or not, m."""
    if place != "contact_edge":
        return moved_m(recording, effect, place, values)
    return float(np.max(np.abs(edges_out_m(recording, effect, [values[name] for name in effect.parameters]))))


def gain_at_size(evidence: Evidence, refiner: Refiner, term: Term) -> float:
    """Do one task of a crew: see Refiner.gain_at_size."""
    return refiner.on(evidence).gain_at_size(term)


def refined(evidence: Evidence, refiner: Refiner, term: Term) -> tuple[Term, int] | None:
    """Do one task of a crew: see Refiner.refined."""
    return refiner.on(evidence).refined(term)


def searched_count(term: Term) -> int:
    """Return how much there is to search of a term, by which crews begin with what takes longest.

    Bristles of four shapes take half a second, a pitch a twentieth: begun last, they were waited for by all others.
    """
    if term.acts_on == "parameter":
        return 0
    effect = CATALOGUE[term.name]
    return (len(free_shapes(effect)) + whole_of(term)) * (2 if effect.memory else 1)


def counts_at_size(evidence: Evidence, term: Term) -> bool:
    """Tell whether the column of a term is of no use, because what it moves decides about contact.

    Where no contact is believed to be, too: an edge that lay 14 um further in was reached at one end of the way, and
    what it did there was told as a scale error; a scale error of 548 ppm that hid where the joint touched, of 4260
    squares, was a drift and a cable.
    """
    if not (term.acts_on.endswith(("_sensor", "contact_edge")) and whole_of(term)):
        return False
    return any(term.acts_on == "contact_edge" or _may_touch(r) for r in evidence.recordings if r.side is not None)


def _may_touch(recording: Recording) -> bool:
    """Tell whether readings come as near to an edge as they are tried to be wrong."""
    joint, apart_m = recording.believed.joint, relative_motion(recording)[0]
    farthest_m = float(np.max(np.abs(apart_m))) + _MISREAD_M[-1]
    return joint is not None and farthest_m > min(joint.left_m, joint.right_m)


def but_for_size(term: Term) -> tuple[str, str, tuple[tuple[str, float], ...]]:
    """Return what tells a term from others of its effect when its size is searched: name, place, the other shapes."""
    size = CATALOGUE[term.name].parameters[0]
    return *term.key, tuple((name, value) for name, value in term.shape.items() if name != size)


def scopes_of(scope: str, sums: Sequence[Placed]) -> tuple[str, ...]:
    """Return the places that amplitudes of a scope belong to."""
    if scope == "session":
        return tuple(sorted({f"session {s.session}" for s in sums}))
    if scope == "run":
        return tuple(sorted({f"run {s.run}" for s in sums}))
    return ("",)


def reach_of(recordings: Sequence[Recording], term: Term, name: str, narrow: float) -> tuple[float, float]:
    """Return within what one parameter of a shape is searched about where it is; `narrow` falls from 1 on."""
    effect = CATALOGUE[term.name]
    at = term.shape[name]
    low, high = effect.bounds[name]
    if name == "pitch_m":
        span = max(float(np.ptp(r.position_m(_axis(term)))) for r in recordings)
        reach = narrow * _PITCH_SPANS * at * at / span
        # a spring less a cogging of 1 m was a cubic stiffness over 0.32 m: nobody has seen that repeat
        return max(low, at - reach), max(at, min(high, at + reach, span))
    if name == effect.period == "frequency_hz":
        reach = narrow * 0.5 / max(r.log.samples_count * r.log.period_s for r in recordings)
        return max(low, at - reach), min(high, at + reach)
    if name == "anchor_m":
        reach = narrow * _ANCHOR_M
        return max(low, at - reach), min(high, at + reach)
    factor = _BRACKET**narrow
    if name == _END:
        ends = sorted((at / factor, at * factor)) if abs(at) < _farthest_m(recordings, term) else [at, at]
        return max(low, ends[0]), min(high, ends[1])
    reach = narrow * _NEAR_ZERO * (high - low)  # of a shape that may be zero, factors lead nowhere
    sized = name == effect.parameters[0] and not term.linear  # found by trials: its sign and its decade are known
    by_factor = sized or abs(at) > reach or low >= 0.0
    ends = sorted((at / factor, at * factor)) if by_factor else (at - reach, at + reach)
    return max(low, ends[0]), min(high, ends[1])


def _farthest_m(recordings: Sequence[Recording], term: Term) -> float:
    """Return how far from zero a term's body was recorded, m."""
    return max(float(np.max(np.abs(r.position_m(_axis(term))))) for r in recordings)


def whole_of(term: Term) -> bool:
    """Tell whether an effect has to be taken at its size: its column is only the beginning of what it does."""
    if term.acts_on == "parameter":
        return False
    effect = CATALOGUE[term.name]
    moves = term.acts_on == "contact_edge" or (
        term.acts_on.endswith("_sensor") and Trait.FIRST_ORDER not in effect.traits
    )
    return moves or not effect.linear


def _axis(term: Term) -> str:
    return "macro" if term.acts_on.startswith("macro") else "end"


def with_shape(term: Term, changed: dict[str, float]) -> Term:
    """Return a term with some of its shape changed."""
    effect, shape = CATALOGUE[term.name], term.shape | changed
    if term.linear:
        return hypotheses.term_of(effect, term.acts_on, shape)
    return hypotheses.term_at_size(effect, term.acts_on, shape)


def anchor_of(term: Term) -> str | None:
    """Return the name of the place that a law acts about; None of others."""
    if term.acts_on == "parameter" or Trait.PLACED not in CATALOGUE[term.name].traits:
        return None
    (name,) = free_shapes(CATALOGUE[term.name])
    return name


_GROWN_RATIO = 0.01
_LEAST_POWER = 0.1


def power_of_size(term: Term, recordings: Sequence[Recording]) -> float:
    """Return the power of its size that an effect follows where it is: -2 of a force at which iron saturates."""
    name = CATALOGUE[term.name].parameters[0]
    larger = with_shape(term, {name: term.shape[name] * (1.0 + _GROWN_RATIO)})
    here, there = (sum(squares_of(f) for r in recordings for f in one.forces(r)) for one in (term, larger))
    if not (here > 0.0 and there > 0.0):
        return 1.0
    power = 0.5 * float(np.log(there / here) / np.log1p(_GROWN_RATIO))
    return power if abs(power) > _LEAST_POWER else 1.0
