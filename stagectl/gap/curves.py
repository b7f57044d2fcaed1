"""Curves over one quantity: what stands for an effect that no library has.

Some compete from the start, over place, velocity, time and where the joint is. Finer ones are asked at the end, of what
names leave. Pure.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline

from stagectl.effects import CATALOGUE
from stagectl.effects.table import KNOTS_COUNT
from stagectl.gap.effect_forces import SPREADS, between, edges_moved, spread_out
from stagectl.gap.forces import Forces
from stagectl.gap.hypotheses import Term
from stagectl.gap.interval_parts import PARTS_COUNT
from stagectl.gap.late_readings import Row
from stagectl.gap.quantities import quantities
from stagectl.gap.reading_errors import misread
from stagectl.gap.recording import Recording
from stagectl.gap.reversals import since_reversal

_OVER = ("position_m", "velocity_m_per_s", "t_s")  # not acceleration: its line is a mass, and shrinks any rest
_FINE_KNOTS_COUNT = 48
_LEAST_CURVE_N = 1.0  # as large as what drives, or so much: free, curves and known parameters cancel out at kilonewtons

SINCE_REVERSAL = "since_reversal_s"
_SINCE_REVERSAL_S = np.geomspace(0.02, 5.0, 16)
_TURN_NOISES = 20.0  # of a sensor's noise, the way back from which on a body has turned round

AGO = "motor_force_ago_s"
_AGO_PERIODS = (0.25, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)

_MOST_MISREAD_M = 1e-4

LATENESS = "lateness_s"
_MOST_SPREAD_RATIO = 2.0

LOAD = "mass_kg"

CLOSING = "penetration_velocity_m_per_s"
_CLOSING_RATIO = np.array([-1.0, -0.3, -0.1, -0.03, -0.01, 0.0, 0.01, 0.03, 0.1, 0.3, 1.0])  # of the fastest

_EDGE = "contact_edge"
_CENTRE = "contact_centre"
_EDGE_KNOTS_COUNT = 8
_MOST_MOVED_M = 1e-3


def curve_terms(recordings: Sequence[Recording]) -> Iterator[Term]:
    """Yield tables of a force over one quantity of each body."""
    axes = recordings[0].axes
    for axis in axes:
        relative = ("relative_position_m",) if len(axes) > 1 else ()
        for quantity in (*_OVER, *relative):
            yield from _over(recordings, axis, quantity, KNOTS_COUNT)


def finer_curve_terms(recordings: Sequence[Recording]) -> Iterator[Term]:
    """Yield what tells a law from those that almost do its work: curves that would cost too much from the start.

    Over position with steps of a quarter of those of other curves, over the time since each body turned round, over the
    past of each motor, of what a sensor reads too much over where it is, over how fast the joint closes in contact, and
    of where its edges and its middle are over time; whether a force grows with what is carried, and whether what is
    late is spread out.
    """
    for axis in recordings[0].axes:
        yield from _over(recordings, axis, "position_m", _FINE_KNOTS_COUNT)
        yield _table(recordings, axis, SINCE_REVERSAL, _SINCE_REVERSAL_S, partial(_hats_since, axis))
        yield _of_the_past(recordings[0], axis)
        yield from _misread_over_position(recordings, axis)
        yield from _over_load(recordings, axis)
    yield from _over_closing(recordings)
    yield from _edges_over_time(recordings)
    yield from _spread_of_lateness(recordings[0])


def unit_of(term: Term) -> str:
    """Return what the values of a curve are: N of a force, m of a reading or an edge, a ratio of a force or a time."""
    if term.name in (f"curve over {AGO}", f"curve over {LATENESS}"):
        return "ratio"
    return "m" if term.acts_on.endswith(("_sensor", _EDGE, _CENTRE)) else "N"


def _over(recordings: Sequence[Recording], axis: str, quantity: str, knots_count: int) -> Iterator[Term]:
    """Yield the table over one quantity of a body; none where that never changes."""
    knots = _even(recordings, axis, "macro_force", quantity, knots_count)
    if knots is not None:
        yield _table(recordings, axis, quantity, knots, partial(_hats, axis, quantity, knots))


def _even(recordings: Sequence[Recording], axis: str, place: str, quantity: str, knots_count: int) -> np.ndarray | None:
    spans = [quantities(r, axis, place)[quantity] for r in recordings]
    low, high = min(float(s.min()) for s in spans), max(float(s.max()) for s in spans)
    return np.linspace(low, high, knots_count) if high > low else None


def _table(
    recordings: Sequence[Recording],
    axis: str,
    quantity: str,
    knots: np.ndarray,
    forces: Callable[[Recording], list[Forces]],
) -> Term:
    place = {"macro": "macro_force", "end": "micro_force"}.get(axis, axis)
    commands = [r.log.macro_command_n if place == "macro_force" else r.log.micro_command_n for r in recordings]
    most_n = max(_LEAST_CURVE_N, *(float(np.std(c)) for c in commands if c is not None))
    return _curve(quantity, place, knots, forces, most_n)


def _curve(
    quantity: str, place: str, knots: np.ndarray, forces: Callable[[Recording], list[Forces]], most: float
) -> Term:
    names = tuple(f"{knot:.6g}" for knot in knots)
    return Term(f"curve over {quantity}", place, {}, names, forces, bounds=((-most, most),) * knots.size)


def _hats(axis: str, quantity: str, knots: np.ndarray, r: Recording) -> list[Forces]:
    return _on(axis, _weights(quantities(r, axis, "macro_force")[quantity], knots))


def _hats_since(axis: str, r: Recording) -> list[Forces]:
    position_m = r.motion(axis).position_m
    turn_m = _TURN_NOISES * r.belief(axis).noise_m
    since_s, direction = since_reversal(position_m.ravel(), turn_m, r.log.period_s / PARTS_COUNT)
    weights = _weights(np.log(np.maximum(since_s, 1e-9)), np.log(_SINCE_REVERSAL_S))
    return _on(axis, [(direction * weight).reshape(position_m.shape) for weight in weights])


def _of_the_past(recording: Recording, axis: str) -> Term:
    """Return what a body feels of its motor's force of so long ago: all that is late or swings is a sum of those.

    It found 96 squares of a delay of 92 that had no name, and 4500 of the 6000 that wrong parameters in a delay's place
    had left. What acts at once and long ago is no part of it: that foretells a slow disturbance, which the controller
    answers (110 squares where nothing is missing).
    """
    place = "macro_actuator" if axis == "macro" else "micro_actuator"
    ago_s = np.array(_AGO_PERIODS) * recording.log.period_s
    return _curve(AGO, place, ago_s, partial(_felt_before, axis), 1.0)


def _felt_before(axis: str, r: Recording) -> list[Forces]:
    felt_n = r.felt_n[axis]
    line_n = felt_n.ravel()
    later = [round(periods * PARTS_COUNT) for periods in _AGO_PERIODS]
    past = [np.concatenate([np.full(count, line_n[0]), line_n[: line_n.size - count]]) for count in later]
    return _on(axis, [(one - line_n).reshape(felt_n.shape) for one in past])


def _spread_of_lateness(recording: Recording) -> Iterator[Term]:
    """Yield the share that each late reading is spread out by, as a lag spreads it, or is not where it lags already.

    1 is the other law in its place. A lag of 368 us was a delay to a library that knew none, by 13 squares of 23 600;
    the past of the motor, seven numbers, found 31 of them and of noise, this one 33.
    """
    for row in recording.late:
        if row["name"] in SPREADS:
            (late_s,) = (row[name] for name in CATALOGUE[row["name"]].parameters)
            if late_s > 0.0:
                yield _curve(LATENESS, row["acts_on"], np.array([late_s]), partial(_spread, row), _MOST_SPREAD_RATIO)


def _spread(row: Row, r: Recording) -> list[Forces]:
    return [spread_out(r, row)]


def _misread_over_position(recordings: Sequence[Recording], axis: str) -> Iterator[Term]:
    """Yield what a sensor reads too much over where it is.

    Of an Abbe error of 121 000 squares five names on five places had left 1600: no curve of a force found more than 112
    of them, this one 856. It is smooth: where a line turns into another one, a reading of 5 nm would have to jump by
    0.1 mm/s. And it is nothing at both ends: all readings by a share too large, with a force constant as much too
    small, shrink whatever is left.
    """
    place = f"{axis}_sensor"
    knots = _even(recordings, axis, place, "position_m", KNOTS_COUNT)
    if knots is not None:
        yield _curve("position_m", place, knots[1:-1], partial(_misread, axis, place, knots), _MOST_MISREAD_M)


def _misread(axis: str, place: str, knots: np.ndarray, r: Recording) -> list[Forces]:
    within = np.eye(knots.size)[:, 1:-1]  # nothing at both ends: what is known but for a line
    through = CubicSpline(knots, within, bc_type="natural")(quantities(r, axis, place)["position_m"][:, 0])
    return [misread(r, axis, one[:, None], whole=False) for one in through.T]


def _over_load(recordings: Sequence[Recording], axis: str) -> Iterator[Term]:
    """Yield by how much a force is larger with the heaviest load than with the lightest; none where all weigh the same.

    A tilt of both bodies, of 76 600 squares, was an offset of each but for 83, as the end carried another payload in
    each recording: of those the other curves found what noise gives, this one 38.
    """
    masses_kg = [r.mass_kg(axis) for r in recordings]
    lightest_kg, heaviest_kg = min(masses_kg), max(masses_kg)
    if heaviest_kg > lightest_kg:
        yield _table(recordings, axis, LOAD, np.array([heaviest_kg]), partial(_loaded, axis, lightest_kg, heaviest_kg))


def _loaded(axis: str, lightest_kg: float, heaviest_kg: float, r: Recording) -> list[Forces]:
    share = (r.mass_kg(axis) - lightest_kg) / (heaviest_kg - lightest_kg)
    return _on(axis, [np.full_like(r.motion(axis).position_m, share)])


def _over_closing(recordings: Sequence[Recording]) -> Iterator[Term]:
    """Yield what the contact pushes more over how fast it closes; none where nothing touches.

    Edges that wear, of 43 000 squares, were a soft contact in a wider gap but for 1100: this finds 635 of them, the
    other curves 48 and less.
    """
    fastest = max((float(np.max(np.abs(rate[inside]), initial=0.0)) for rate, inside in map(_closing, recordings)))
    if fastest > 0.0:
        knots = fastest * _CLOSING_RATIO
        yield _table(recordings, "contact", CLOSING, knots, partial(_hats_closing, knots))


def _closing(r: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return how fast the joint closes, and where it touches."""
    depth_m, rate = r.penetration_m, r.penetration_velocity_m_per_s
    return (np.zeros(1), np.zeros(1, bool)) if depth_m is None or rate is None else (rate, depth_m > 0.0)


def _hats_closing(knots: np.ndarray, r: Recording) -> list[Forces]:
    rate, inside = _closing(r)
    return [between(r, np.where(inside, r.side * weight, 0.0)) for weight in _weights(rate, knots)]


def _edges_over_time(recordings: Sequence[Recording]) -> Iterator[Term]:
    """Yield by how much both edges lie further out, and to which side, than at the first touch, over time.

    None where nothing touches. Edges that wear by 0.2 um/s, of 128 000 squares, were a gap that is wider but for 1200,
    at a floor that scatters by 780: of those the other curves found 37 and less, this one all. A sensor that drifts, of
    16 600 squares, was a joint that lies elsewhere but for 200, of which edges further out found 10. Knots lie where it
    touches, equally often between any two; a constant is none of it, that is the width, or the centre.
    """
    touched_s = [_edge_times(r)[inside] for r in recordings for _, inside in [_closing(r)] if np.any(inside)]
    if not touched_s:
        return
    knots = np.unique(np.quantile(np.concatenate(touched_s), np.linspace(0.0, 1.0, _EDGE_KNOTS_COUNT)))
    if knots.size > 1:
        for place, left_ratio in ((_EDGE, 1.0), (_CENTRE, -1.0)):
            yield _curve("t_s", place, knots[1:], partial(_hats_moved, left_ratio, knots), _MOST_MOVED_M)


def _edge_times(r: Recording) -> np.ndarray:
    return quantities(r, "end", _EDGE)["t_s"]


def _hats_moved(left_ratio: float, knots: np.ndarray, r: Recording) -> list[Forces]:
    weights = _weights(_edge_times(r), knots)[1:]
    return [edges_moved(r, left_ratio * weight, weight, whole=False) for weight in weights]


def _weights(value: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return each knot's share in a value between two of them, shape (knots, *value.shape); ends are held."""
    flat = value.ravel()
    below = np.clip(np.searchsorted(knots, flat, side="right") - 1, 0, knots.size - 2)
    share = np.clip((flat - knots[below]) / (knots[below + 1] - knots[below]), 0.0, 1.0)
    weights, at = np.zeros((knots.size, flat.size)), np.arange(flat.size)
    weights[below, at], weights[below + 1, at] = 1.0 - share, share
    return weights.reshape(knots.size, *value.shape)


def _on(axis: str, weights: Iterable[np.ndarray]) -> list[Forces]:
    return [Forces(macro_n=weight) if axis == "macro" else Forces(end_n=weight) for weight in weights]
