"""Trajectories: tables of setpoints on the sensor's sample grid, planned and checked before the first cycle.

Pure; knows no stage, no bus and no clock. Every derivative is the exact derivative of the position, never a difference.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ruckig

from stagectl.errors import RequestError
from stagectl.signals import SETPOINT

ROWS_MAX_COUNT = 4_000_000
"""More rows than this is a slip of the pen, not a trajectory (over an hour at 1 kHz, 128 MB)."""

_COLUMNS = ("position_m", "velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3")
_RELATIVE_COLUMNS = ("relative_position_m", "relative_velocity_m_per_s", "relative_acceleration_m_per_s2")


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Motion over time: row i of `setpoints` (SETPOINT, shape (n,)) is due at the sample instant i * dt_s."""

    name: str
    parameters: dict[str, Any]
    dt_s: float
    setpoints: np.ndarray

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last."""
        return (len(self.setpoints) - 1) * self.dt_s

    @property
    def t_s(self) -> np.ndarray:
        """Instants of the rows, from 0, shape (n,)."""
        return np.arange(len(self.setpoints)) * self.dt_s


@dataclass(frozen=True, slots=True)
class Limits:
    """What a planned move keeps to."""

    velocity_m_per_s: float
    acceleration_m_per_s2: float
    jerk_m_per_s3: float


@dataclass(frozen=True, slots=True)
class MotionState:
    """Where a move starts from, when not at rest."""

    position_m: float
    velocity_m_per_s: float = 0.0
    acceleration_m_per_s2: float = 0.0


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Where one part of a chain ends, and how fast it may go on the way there."""

    target_m: float
    velocity_m_per_s: float
    pass_velocity_m_per_s: float = 0.0
    dwell_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Load:
    """What one drive has to accelerate, and the force it may use for that."""

    name: str
    mass_kg: float
    force_limit_n: float
    damping_n_s_per_m: float = 0.0


def sine(
    amplitude_m: float,
    angular_frequency_rad_per_s: float,
    duration_s: float,
    start_m: float = 0.0,
    dt_s: float = 1e-3,
    ramp_s: float | None = None,
) -> Trajectory:
    """Swing about `start_m`; the amplitude grows from nothing and fades again over `ramp_s` (default: one period).

    Position to jerk are continuous and zero at both ends. RequestError when the duration can't hold both ramps.
    """
    omega = _positive("angular_frequency_rad_per_s", angular_frequency_rad_per_s)
    ramp = _ramp(2.0 * math.pi / omega if ramp_s is None else ramp_s, duration_s)
    parameters = {
        "kind": "sine",
        "amplitude_m": _positive("amplitude_m", amplitude_m),
        "angular_frequency_rad_per_s": omega,
        "duration_s": duration_s,
        "start_m": _finite("start_m", start_m),
        "ramp_s": ramp,
    }
    return _swing("sine", parameters, _grid(duration_s, dt_s), dt_s, amplitude_m, start_m, (omega, omega), ramp)


def sweep(
    amplitude_m: float,
    frequency_hz: float,
    duration_s: float,
    centre_m: float = 0.0,
    dt_s: float = 1e-3,
    end_frequency_hz: float | None = None,
    ramp_s: float | None = None,
) -> Trajectory:
    """Swing for identification: the micro moves about the macro, which stands at `centre_m`, and meets both contacts.

    The frequency moves linearly to `end_frequency_hz` where one is given. Ramps as in `sine`.
    """
    start_hz = _positive("frequency_hz", frequency_hz)
    end_hz = start_hz if end_frequency_hz is None else _positive("end_frequency_hz", end_frequency_hz)
    ramp = _ramp(1.0 / start_hz if ramp_s is None else ramp_s, duration_s)
    parameters = {
        "kind": "sweep",
        "amplitude_m": _positive("amplitude_m", amplitude_m),
        "frequency_hz": start_hz,
        "end_frequency_hz": end_hz,
        "duration_s": duration_s,
        "centre_m": _finite("centre_m", centre_m),
        "ramp_s": ramp,
    }
    omegas = (2.0 * math.pi * start_hz, 2.0 * math.pi * end_hz)
    trajectory = _swing("sweep", parameters, _grid(duration_s, dt_s), dt_s, amplitude_m, centre_m, omegas, ramp)
    rows = trajectory.setpoints
    for relative, column in zip(_RELATIVE_COLUMNS, _COLUMNS, strict=False):
        rows[relative] = rows[column]
    rows["relative_position_m"] -= centre_m
    return trajectory


def trapezoid(
    stroke_m: float = 0.8,
    velocity_m_per_s: float = 0.2,
    corners_s: Sequence[float] = (0.2, 0.1, 0.05),
    dwell_s: float = 4.0,
    dt_s: float = 1e-3,
    start_m: float = 0.0,
    lead_s: float = 1.0,
) -> Trajectory:
    """There and back at constant speed, corners rounded by one moving average after another (widths `corners_s`).

    Rest for `lead_s`, move by `stroke_m` (its sign is the direction), rest for `dwell_s`, and back likewise.
    The defaults are the "realistic" set (1 m/s^2); corners of 0.6, 0.3, 0.15 s are the "paper" set (Kang 2023, 5.3).
    """
    if not (_finite("stroke_m", stroke_m) != 0.0):
        raise RequestError("stroke_m is 0 m: a trapezoid needs a distance to go; give one, its sign is the direction")
    speed = _positive("velocity_m_per_s", velocity_m_per_s)
    corners = [_positive(f"corners_s[{i}]", width) for i, width in enumerate(corners_s)]
    if not 2 <= len(corners) <= 4:
        raise RequestError(
            f"corners_s has {len(corners)} widths; 2 to 4 keep the jerk finite: give for example 0.2, 0.1, 0.05"
        )
    start = _finite("start_m", start_m)
    lead = _not_negative("lead_s", lead_s)
    dwell = _not_negative("dwell_s", dwell_s)
    knots_s, states = _rounded_move(stroke_m, speed, corners)
    move_s = float(knots_s[-1])
    t_s = _grid(lead + 2.0 * (move_s + dwell), dt_s)
    there = _evaluate(knots_s, states, t_s - lead)
    back = _evaluate(knots_s, states, t_s - lead - move_s - dwell)
    setpoints = _table(t_s.size)
    for order, column in enumerate(_COLUMNS):
        setpoints[column] = there[order] - back[order]
    setpoints["position_m"] += start
    _end_at_rest(setpoints, start)
    parameters = {
        "kind": "trapezoid",
        "stroke_m": stroke_m,
        "velocity_m_per_s": speed,
        "corners_s": corners,
        "dwell_s": dwell,
        "lead_s": lead,
        "start_m": start,
        "dt_s": dt_s,
    }
    return Trajectory("trapezoid", parameters, dt_s, setpoints)


def move(start: float | MotionState, target_m: float, limits: Limits, dt_s: float = 1e-3) -> Trajectory:
    """Fastest jerk-limited move from `start` (a position at rest, or a state) to rest at `target_m`."""
    state = start if isinstance(start, MotionState) else MotionState(start)
    planned = _planned_from(state, limits)
    planned.target_position = [_finite("target_m", target_m)]
    setpoints = _calculated(planned, f"no move from {state} to {target_m} m within {limits}", dt_s, target_m)
    parameters = {
        "kind": "move",
        "start_position_m": state.position_m,
        "start_velocity_m_per_s": state.velocity_m_per_s,
        "start_acceleration_m_per_s2": state.acceleration_m_per_s2,
        "target_m": target_m,
        "velocity_m_per_s": limits.velocity_m_per_s,
        "acceleration_m_per_s2": limits.acceleration_m_per_s2,
        "jerk_m_per_s3": limits.jerk_m_per_s3,
        "dt_s": dt_s,
    }
    return Trajectory("move", parameters, dt_s, setpoints)


def brake(start: MotionState, limits: Limits, dt_s: float = 1e-3) -> Trajectory:
    """Fastest jerk-limited way from a state to rest, wherever that ends."""
    planned = _planned_from(start, limits)
    planned.control_interface = ruckig.ControlInterface.Velocity
    setpoints = _calculated(planned, f"no way from {start} to rest within {limits}", dt_s)
    parameters = {
        "kind": "brake",
        "start_position_m": start.position_m,
        "start_velocity_m_per_s": start.velocity_m_per_s,
        "start_acceleration_m_per_s2": start.acceleration_m_per_s2,
        "acceleration_m_per_s2": limits.acceleration_m_per_s2,
        "jerk_m_per_s3": limits.jerk_m_per_s3,
        "dt_s": dt_s,
    }
    return Trajectory("brake", parameters, dt_s, setpoints)


def chain(
    start_m: float,
    waypoints: Sequence[Waypoint],
    limits: Limits,
    dt_s: float = 1e-3,
    name: str = "chain",
    longest_s: float = math.inf,
) -> Trajectory:
    """From rest at `start_m` from waypoint to waypoint, each part the fastest within its velocity and `limits`.

    A part begins at the instant and in the state in which the one before ends, not at the next row.
    """
    knots: list[np.ndarray] = []
    parts: list[np.ndarray] = []
    state, begin_s = MotionState(start_m), 0.0
    for i, point in enumerate(waypoints):
        slower = Limits(point.velocity_m_per_s, limits.acceleration_m_per_s2, limits.jerk_m_per_s3)
        planned = _planned_from(state, slower)
        planned.target_position = [_finite(f"segments[{i}].target_m", point.target_m)]
        planned.target_velocity = [_finite(f"segments[{i}].pass_velocity_m_per_s", point.pass_velocity_m_per_s)]
        plan = _plan(
            planned,
            f"segments[{i}]: no way from {state.position_m:g} m at {state.velocity_m_per_s:g} m/s to "
            f"{point.target_m:g} m at {point.pass_velocity_m_per_s:g} m/s with {point.velocity_m_per_s:g} m/s at most",
        )
        knots_s, states = _planned_phases(plan, point.target_m)
        end_s = begin_s + float(knots_s[-1])
        moves = knots_s[-1] > 0.0
        knots.append(begin_s + knots_s[: -1 if moves else 0])
        parts.append(states[: -1 if moves else 0])
        state = MotionState(point.target_m, point.pass_velocity_m_per_s)
        if point.dwell_s > 0.0:
            knots.append(np.array([end_s]))
            parts.append(np.array([[point.target_m, 0.0, 0.0, 0.0, 0.0, 0.0]]))
        begin_s = end_s + point.dwell_s
    if begin_s > longest_s:
        raise RequestError(
            f"segments: one repetition takes {begin_s:g} s, {longest_s:g} s is the limit; give fewer segments or "
            "shorter dwells"
        )
    end_m = state.position_m
    knots.append(np.array([begin_s]))
    parts.append(np.array([[end_m, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    t_s = _grid(max(begin_s, dt_s), dt_s)
    setpoints = _table(t_s.size)
    values = _evaluate(np.concatenate(knots), np.concatenate(parts), t_s)
    for column, value in zip(_COLUMNS, values, strict=True):
        setpoints[column] = value
    _end_at_rest(setpoints, end_m)
    parameters = {"kind": "chain", "start_m": start_m, "segments_count": len(waypoints), "dt_s": dt_s}
    return Trajectory(name, parameters, dt_s, setpoints)


def _planned_from(state: MotionState, limits: Limits) -> ruckig.InputParameter:
    planned = ruckig.InputParameter(1)
    planned.current_position = [_finite("start position_m", state.position_m)]
    planned.current_velocity = [_finite("start velocity_m_per_s", state.velocity_m_per_s)]
    planned.current_acceleration = [_finite("start acceleration_m_per_s2", state.acceleration_m_per_s2)]
    planned.max_velocity = [_positive("limits.velocity_m_per_s", limits.velocity_m_per_s)]
    planned.max_acceleration = [_positive("limits.acceleration_m_per_s2", limits.acceleration_m_per_s2)]
    planned.max_jerk = [_positive("limits.jerk_m_per_s3", limits.jerk_m_per_s3)]
    return planned


def _calculated(planned: ruckig.InputParameter, refusal: str, dt_s: float, target_m: float | None = None) -> np.ndarray:
    """Return the setpoints of a plan that ends at rest, at `target_m` or where braking ends."""
    plan = _plan(planned, refusal)
    end_m = float(plan.at_time(plan.duration)[0][0]) if target_m is None else target_m
    knots_s, states = _planned_phases(plan, end_m)
    t_s = _grid(max(float(knots_s[-1]), dt_s), dt_s)
    setpoints = _table(t_s.size)
    for column, values in zip(_COLUMNS, _evaluate(knots_s, states, t_s), strict=True):
        setpoints[column] = values
    _end_at_rest(setpoints, end_m)
    return setpoints


def _plan(planned: ruckig.InputParameter, refusal: str) -> ruckig.Trajectory:
    plan = ruckig.Trajectory(1)
    try:
        result = ruckig.Ruckig(1).calculate(planned, plan)
    except ruckig.RuckigError as error:
        raise RequestError(f"{refusal}: ruckig finds none; widen the limits") from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise RequestError(f"{refusal}: {result}; widen the limits")
    return plan


def from_table(t_s: np.ndarray, position_m: np.ndarray, dt_s: float = 1e-3, name: str = "table") -> Trajectory:
    """Smooth motion through every row of a table (shapes (n,), time rising): a quintic spline at rest at both ends.

    Snap is continuous at the rows. A table with kinks comes out with large accelerations: `check` says where.
    """
    times = np.asarray(t_s, dtype=float)
    positions = np.asarray(position_m, dtype=float)
    if times.ndim != 1 or times.shape != positions.shape or times.size < 2:
        raise RequestError(
            f"trajectory '{name}': t_s has shape {times.shape}, position_m {positions.shape}; "
            "two columns of equal length with at least 2 rows are needed"
        )
    for column, values in (("t_s", times), ("position_m", positions)):
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise RequestError(
                f"trajectory '{name}', row {bad[0]}: {column} is {values[bad[0]]}; every value must be a number"
            )
    steps = np.diff(times)
    if not np.all(steps > 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise RequestError(
            f"trajectory '{name}', row {row}: t_s goes from {times[row - 1]} s to {times[row]} s; "
            "time must rise: sort the rows"
        )
    grid_s = _grid(float(times[-1] - times[0]), dt_s)
    knots_s, states = _spline(times - times[0], positions)
    setpoints = _table(grid_s.size)
    for column, values in zip(_COLUMNS, _evaluate(knots_s, states, grid_s), strict=True):
        setpoints[column] = values
    _end_at_rest(setpoints, float(positions[-1]))
    parameters = {"kind": "table", "name": name, "rows_count": int(times.size), "dt_s": dt_s}
    return Trajectory(name, parameters, dt_s, setpoints)


def from_file(path: str | Path, dt_s: float = 1e-3) -> Trajectory:
    """Read a CSV file with the header `t_s,position_m` and smooth it as `from_table` does."""
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(
            f"trajectory {file}: {error}; give a readable CSV file with the header t_s,position_m"
        ) from error
    return from_text(text, dt_s, file.stem, str(file))


def from_text(
    text: str, dt_s: float = 1e-3, name: str = "table", place: str = "", longest_s: float = math.inf
) -> Trajectory:
    """Read CSV with the header `t_s,position_m` and smooth it as `from_table` does; `place` is where it is from."""
    place = place or f"'{name}'"
    header = ["t_s", "position_m"]
    try:
        rows = [row for row in csv.reader(text.removeprefix("\ufeff").splitlines()) if row]
    except csv.Error as error:
        raise RequestError(f"trajectory {place}: {error}; give CSV with the header t_s,position_m") from error
    if not rows or [cell.strip() for cell in rows[0]] != header:
        found = ",".join(rows[0])[:60] if rows else "nothing"
        raise RequestError(
            f"trajectory {place}, line 1: the header is {found!r}; it must be 't_s,position_m'{_other_units(found)}"
        )
    values = np.empty((len(rows) - 1, 2))
    for i, row in enumerate(rows[1:]):
        try:
            at_s, position_m = row
            values[i] = float(at_s), float(position_m)
        except ValueError as error:
            raise RequestError(
                f"trajectory {place}, row {i + 1}: {','.join(row)[:60]!r}; two numbers are needed"
            ) from error
    if values.size and not values[-1, 0] - values[0, 0] <= longest_s:
        raise RequestError(
            f"trajectory {place} takes {values[-1, 0] - values[0, 0]:g} s, {longest_s:g} s is the limit; cut it in "
            "parts. Are the times milliseconds? Divide by 1000"
        )
    return from_table(values[:, 0], values[:, 1], dt_s, name)


def _other_units(header: str) -> str:
    """Say what to do with a header that names other units."""
    other = [unit for unit in ("ms", "us", "min", "mm", "um", "nm", "inch") if f"_{unit}" in header.lower()]
    return f"; it says {', '.join(other)}: convert times to seconds, positions to metres" if other else ""


def check(
    trajectory: Trajectory,
    travel_m: Sequence[float],
    velocity_limit_m_per_s: float,
    acceleration_limit_m_per_s2: float,
    jerk_limit_m_per_s3: float = math.inf,
    loads: Sequence[Load] = (),
    stop_deceleration_m_per_s2: float = math.inf,
    stroke_m: Sequence[float] = (-math.inf, math.inf),
    start_m: float | None = None,
    start_tolerance_m: float = 1e-6,
) -> None:
    """Refuse what the stage can't do: RequestError names the first instant, value, limit and remedy.

    `stop_deceleration_m_per_s2` is what the drive stops with: v^2 / (2 a) must be left before each end of travel.
    `stroke_m` bounds the relative position.
    `start_m` is where the stage stands; None leaves that unchecked.
    """
    (low_m, high_m), (relative_low_m, relative_high_m) = travel_m, stroke_m
    rows = trajectory.setpoints
    if rows.dtype != SETPOINT or rows.ndim != 1 or rows.size < 2:
        raise RequestError(f"trajectory '{trajectory.name}' is no table of setpoints with two rows or more")
    for column in SETPOINT.names or ():
        _within(trajectory, np.isfinite(rows[column]), rows[column], column, "a finite number", "repair the table")
    position_m, velocity_m_per_s, acceleration_m_per_s2, jerk_m_per_s3 = (rows[column] for column in _COLUMNS)
    inside = (low_m <= position_m) & (position_m <= high_m)
    limit = f"the travel [{low_m:g}, {high_m:g}] m"
    _within(trajectory, inside, position_m, "position_m", limit, "shorten the stroke or start elsewhere")
    relative_m = rows["relative_position_m"]
    inside = (relative_low_m <= relative_m) & (relative_m <= relative_high_m)
    limit = f"the micro's stroke [{relative_low_m:g}, {relative_high_m:g}] m"
    _within(trajectory, inside, relative_m, "relative_position_m", limit, "ask for a smaller amplitude")
    limit = f"the limit of {velocity_limit_m_per_s:g} m/s"
    slow = np.abs(velocity_m_per_s) <= velocity_limit_m_per_s
    _within(trajectory, slow, velocity_m_per_s, "velocity_m_per_s", limit, "ask for less speed")
    gentle = np.abs(acceleration_m_per_s2) <= acceleration_limit_m_per_s2
    limit = f"the limit of {acceleration_limit_m_per_s2:g} m/s^2"
    _within(
        trajectory,
        gentle,
        acceleration_m_per_s2,
        "acceleration_m_per_s2",
        limit,
        "take longer corners or a lower frequency",
    )
    smooth = np.abs(jerk_m_per_s3) <= jerk_limit_m_per_s3
    limit = f"the limit of {jerk_limit_m_per_s3:g} m/s^3"
    _within(trajectory, smooth, jerk_m_per_s3, "jerk_m_per_s3", limit, "take longer corners or ramps")
    for load in loads:
        force_n = load.mass_kg * acceleration_m_per_s2 + load.damping_n_s_per_m * velocity_m_per_s
        limit = f"the {load.name} drive's limit of {load.force_limit_n:g} N"
        able = np.abs(force_n) <= load.force_limit_n
        _within(trajectory, able, force_n, "force_n", limit, "accelerate less")
    room_m = np.where(velocity_m_per_s > 0.0, high_m - position_m, position_m - low_m)
    stopping_m = velocity_m_per_s**2 / (2.0 * stop_deceleration_m_per_s2)
    limit = "what is left before the end of travel"
    _within(
        trajectory, stopping_m <= room_m, stopping_m, "stopping distance_m", limit, "go slower near the end of travel"
    )
    if not (velocity_m_per_s[-1] == 0.0 and acceleration_m_per_s2[-1] == 0.0):
        raise RequestError(
            f"trajectory '{trajectory.name}' ends at {trajectory.duration_s:.4g} s with "
            f"{velocity_m_per_s[-1]:.4g} m/s and {acceleration_m_per_s2[-1]:.4g} m/s^2; it must end at rest: add a ramp"
        )
    if start_m is not None and not abs(position_m[0] - start_m) <= start_tolerance_m:
        raise RequestError(
            f"trajectory '{trajectory.name}' begins at {position_m[0]:.9g} m and the stage stands at {start_m:.9g} m, "
            f"more than {start_tolerance_m:g} m away: move there first"
        )


def _within(trajectory: Trajectory, good: np.ndarray, values: np.ndarray, what: str, limit: str, remedy: str) -> None:
    """Raise RequestError at the first row that is not good."""
    if np.all(good):
        return
    row = int(np.argmin(good))
    raise RequestError(
        f"trajectory '{trajectory.name}' at {row * trajectory.dt_s:.4f} s: {what} is {values[row]:.6g}, "
        f"outside {limit}: {remedy}"
    )


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise RequestError(f"{name} is {value}; a finite number is needed")
    return float(value)


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise RequestError(f"{name} is {value}; a finite number above 0 is needed")
    return float(value)


def _not_negative(name: str, value: float) -> float:
    if not (math.isfinite(value) and value >= 0.0):
        raise RequestError(f"{name} is {value}; a finite number of 0 or more is needed")
    return float(value)


def _ramp(ramp_s: float, duration_s: float) -> float:
    """Check that the ramps at both ends fit into the duration."""
    ramp = _positive("ramp_s", ramp_s)
    if not _positive("duration_s", duration_s) >= 2.0 * ramp:
        raise RequestError(
            f"duration_s is {duration_s:g} s and the ramps at its ends take {2.0 * ramp:g} s: "
            "ask for a longer duration or a shorter ramp_s"
        )
    return ramp


def _grid(duration_s: float, dt_s: float) -> np.ndarray:
    """Sample instants from 0 to the first at or after `duration_s`."""
    steps = _positive("duration_s", duration_s) / _positive("dt_s", dt_s)
    if not steps < ROWS_MAX_COUNT:
        raise RequestError(
            f"{duration_s:g} s at {dt_s:g} s a row is {steps:.3g} rows; {ROWS_MAX_COUNT} is the limit: "
            "ask for a shorter trajectory"
        )
    # A duration that is a whole number of steps but for rounding gets no extra row.
    return np.arange(math.ceil(steps - 1e-6) + 1) * dt_s


def _table(rows_count: int) -> np.ndarray:
    return np.zeros(rows_count, SETPOINT)


def _end_at_rest(setpoints: np.ndarray, position_m: float) -> None:
    """Clear what rounding leaves in the last row, so that rest is exactly rest."""
    setpoints[-1] = np.zeros(1, SETPOINT)[0]
    setpoints["position_m"][-1] = position_m


def _swing(
    name: str,
    parameters: dict[str, Any],
    t_s: np.ndarray,
    dt_s: float,
    amplitude_m: float,
    centre_m: float,
    omegas_rad_per_s: tuple[float, float],
    ramp_s: float,
) -> Trajectory:
    """centre + amplitude w(t) sin(phase(t)), the frequency linear in time; derivatives by the product rule."""
    duration_s = parameters["duration_s"]
    first, last = omegas_rad_per_s
    rate = (last - first) / duration_s
    omega = first + rate * t_s
    phase = (first + 0.5 * rate * t_s) * t_s
    sin, cos = np.sin(phase), np.cos(phase)
    s = (sin, omega * cos, rate * cos - omega**2 * sin, -3.0 * omega * rate * sin - omega * omega**2 * cos)
    w = _envelope(t_s, ramp_s, duration_s)
    setpoints = _table(t_s.size)
    setpoints["position_m"] = centre_m + amplitude_m * w[0] * s[0]
    setpoints["velocity_m_per_s"] = amplitude_m * (w[1] * s[0] + w[0] * s[1])
    setpoints["acceleration_m_per_s2"] = amplitude_m * (w[2] * s[0] + 2.0 * w[1] * s[1] + w[0] * s[2])
    setpoints["jerk_m_per_s3"] = amplitude_m * (w[3] * s[0] + 3.0 * (w[2] * s[1] + w[1] * s[2]) + w[0] * s[3])
    _end_at_rest(setpoints, centre_m)
    return Trajectory(name, parameters | {"dt_s": dt_s}, dt_s, setpoints)


def _envelope(t_s: np.ndarray, ramp_s: float, duration_s: float) -> tuple[np.ndarray, ...]:
    """0 to 1 over `ramp_s` and back before the end, with three derivatives: 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7."""
    rising = np.clip(t_s / ramp_s, 0.0, 1.0)
    falling = np.clip((duration_s - t_s) / ramp_s, 0.0, 1.0)
    fading = falling < rising
    u = np.where(fading, falling, rising)
    sign = np.where(fading, -1.0, 1.0)
    u2 = u * u
    v = 1.0 - u
    return (
        u2 * u2 * (35.0 + u * (-84.0 + u * (70.0 - 20.0 * u))),
        sign * 140.0 * u2 * u * v * v * v / ramp_s,
        420.0 * u2 * v * v * (1.0 - 2.0 * u) / ramp_s**2,
        sign * 840.0 * u * v * (1.0 - 5.0 * u + 5.0 * u2) / (ramp_s * ramp_s**2),
    )


def _evaluate(
    knots_s: np.ndarray, states: np.ndarray, t_s: np.ndarray, side: Literal["left", "right"] = "right"
) -> tuple[np.ndarray, ...]:
    """Position to jerk of a piecewise polynomial at `t_s`; before the first and after the last knot it stands.

    At a knot the jerk is that of the piece on this `side`.

    `states[i]` holds the derivatives 0 .. 5 just after knot i, shape (knots, 6); the last row is the state of rest.
    """
    segment = np.clip(np.searchsorted(knots_s, t_s, side=side) - 1, 0, knots_s.size - 1)
    h = np.maximum(t_s - knots_s[segment], 0.0)
    d = states[segment].T
    before = t_s < knots_s[0]
    out = []
    for order in range(4):
        value = d[5]
        for k in range(4, order - 1, -1):
            value = d[k] + value * h / (k + 1 - order)
        out.append(np.where(before, states[0, 0] if order == 0 else 0.0, value))
    return tuple(out)


def _rounded_move(stroke_m: float, speed_m_per_s: float, corners_s: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """One rounded ramp from 0 to `stroke_m`: knots and derivatives for `_evaluate`.

    A rectangle of speed after k moving averages has a k-th derivative that is piecewise constant: a sum of steps
    +-speed / (T1 .. Tk), one for every choice of "with or without T_i" and of start or end. Counting the steps as
    integers and integrating forward from knot to knot leaves nothing to cancel.
    """
    steps = [(0.0, 1), (abs(stroke_m) / speed_m_per_s, -1)]
    for width_s in corners_s:
        steps += [(t + width_s, -sign) for t, sign in steps]
    steps.sort()
    knots_s = np.array([t for t, _ in steps])
    order = len(corners_s) + 1
    step = math.copysign(speed_m_per_s, stroke_m) / math.prod(corners_s)
    states = np.zeros((knots_s.size, 6))
    states[:, order] = np.cumsum([sign for _, sign in steps]) * step
    for i in range(1, knots_s.size):
        h = knots_s[i] - knots_s[i - 1]
        for low in range(order):
            states[i, low] = sum(
                states[i - 1, k] * h ** (k - low) / math.factorial(k - low) for k in range(low, order + 1)
            )
    states[-1] = (stroke_m, 0.0, 0.0, 0.0, 0.0, 0.0)
    return knots_s, states


def _planned_phases(plan: ruckig.Trajectory, target_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Phases of constant jerk of a one-axis plan, the braking before it included, as knots and derivatives."""
    profile = plan.profiles[0][0]
    phases = [
        (duration_s, (p, v, a, j, 0.0, 0.0))
        for part in (profile.brake, profile)
        for duration_s, p, v, a, j in zip(part.t, part.p, part.v, part.a, part.j, strict=False)
        if duration_s > 0.0
    ]
    knots_s = np.concatenate([[0.0], np.cumsum([duration_s for duration_s, _ in phases])])
    return knots_s, np.array([state for _, state in phases] + [(target_m, 0.0, 0.0, 0.0, 0.0, 0.0)])


def _spline(t_s: np.ndarray, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quintic spline through the rows, velocity and acceleration zero at both ends.

    Unknown are velocity and acceleration at the inner rows; jerk and snap are continuous there: a block
    tridiagonal system of 2 x 2 blocks, solved by elimination. Time is counted in mean steps while solving.
    """
    n = t_s.size
    unit_s = float(t_s[-1] / (n - 1))
    h = np.diff(t_s) / unit_s
    rise = np.diff(position_m)
    gain, shift = np.zeros((n, 2, 2)), np.zeros((n, 2))
    for i in range(1, n - 1):
        left, right = h[i - 1], h[i]
        l2, l3, r2, r3 = left**2, left * left**2, right**2, right * right**2
        # Rows: jerk after minus jerk before the knot, snap likewise; columns: velocity, acceleration.
        before = np.array([[24.0 / l2, 3.0 / left], [168.0 / l3, 24.0 / l2]])
        here = np.array(
            [[36.0 / l2 - 36.0 / r2, -9.0 / left - 9.0 / right], [192.0 / l3 + 192.0 / r3, 36.0 / r2 - 36.0 / l2]]
        )
        after = np.array([[-24.0 / r2, 3.0 / right], [168.0 / r3, -24.0 / r2]])
        known = np.array([60.0 * (rise[i - 1] / l3 - rise[i] / r3), 360.0 * (rise[i - 1] / l2**2 + rise[i] / r2**2)])
        inverse = np.linalg.inv(here - before @ gain[i - 1])
        gain[i] = inverse @ after
        shift[i] = inverse @ (known - before @ shift[i - 1])
    slopes = np.zeros((n, 2))
    for i in range(n - 2, 0, -1):
        slopes[i] = shift[i] - gain[i] @ slopes[i + 1]
    return t_s, _quintics(t_s, position_m, slopes[:, 0] / unit_s, slopes[:, 1] / unit_s**2)


def through_states(t_s: np.ndarray, p_m: np.ndarray, v_m_per_s: np.ndarray, a_m_per_s2: np.ndarray, at_s: np.ndarray):
    """Return SETPOINT rows at `at_s` of the quintics through states at `t_s`, shapes (n,); jerk of what ends there."""
    setpoints = _table(at_s.size)
    states = _quintics(t_s, p_m, v_m_per_s, a_m_per_s2)
    for column, values in zip(_COLUMNS, _evaluate(t_s, states, at_s, "left"), strict=True):
        setpoints[column] = values
    return setpoints


def _quintics(t_s: np.ndarray, position_m: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Derivatives 0 .. 5 just after every knot, shape (n, 6), of quintics through position, velocity, acceleration."""
    step_s, rise = np.diff(t_s), np.diff(position_m)
    v0, v1, a0, a1 = v[:-1] * step_s, v[1:] * step_s, a[:-1] * step_s**2, a[1:] * step_s**2
    states = np.zeros((t_s.size, 6))
    states[:, 0], states[:, 1], states[:, 2] = position_m, v, a
    states[:-1, 3] = (60.0 * rise - 36.0 * v0 - 24.0 * v1 - 9.0 * a0 + 3.0 * a1) / (step_s * step_s**2)
    states[:-1, 4] = (-360.0 * rise + 192.0 * v0 + 168.0 * v1 + 36.0 * a0 - 24.0 * a1) / (step_s**2 * step_s**2)
    states[:-1, 5] = (720.0 * rise - 360.0 * (v0 + v1) - 60.0 * (a0 - a1)) / (step_s * step_s**2 * step_s**2)
    return states
