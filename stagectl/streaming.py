"""Set-points that a client sends ahead: taken in order, checked, kept until the stage needs them.

Knows no stage, no bus and no clock. Two threads meet in a buffer: the one that answers clients and the stage's.

Between the set-points the reference is a quintic through their positions; velocity and acceleration are the central
differences over one period, so a set-point is no reference before the one behind it is there.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stagectl import trajectory as trajectories
from stagectl.errors import RequestError
from stagectl.signals import SETPOINT
from stagectl.trajectory import Limits, MotionState

AHEAD_MOST_S = 10.0
"""As far ahead as a client may send."""

AHEAD_LEAST_S = 0.3
"""Less than this ahead may come too late."""

_START_TOLERANCE_M = 1e-6
_LEAST_COUNT = 64
_SMOOTHER = "send a smoother motion"


@dataclass(frozen=True, slots=True)
class Room:
    """What a stage allows a stream to do."""

    travel_m: tuple[float, float]
    limits: Limits
    stop_deceleration_m_per_s2: float


class SetpointBuffer:
    """Set-points of one stream, from the first to the last."""

    def __init__(self, start_m: float, period_s: float, room: Room, dt_s: float):
        """The stage holds at `start_m`; RequestError where a period is no whole number of cycles."""
        cycles = round(period_s / dt_s)
        if cycles < 1 or abs(cycles * dt_s - period_s) > 1e-9:
            raise RequestError(
                f"period_s is {period_s:g}: set-points come a whole number of cycles of {dt_s:g} s apart; "
                f"give {max(cycles, 1) * dt_s:g}"
            )
        self._cycles, self._dt_s, self._room = cycles, dt_s, room
        self.period_s = cycles * dt_s
        self._start_m = start_m
        self._lock = threading.Lock()
        self._known = np.zeros(0)  # positions whose interval is not a reference yet: the last two taken
        self._state: MotionState | None = None  # at the end of what is a reference
        self._rows: list[np.ndarray] = []
        self._taken_count = 0
        self._last = False
        self._over = ""
        self._newest: tuple[int, tuple[float, ...], bool] | None = None

    # ---- what clients do -------------------------------------------------------------------------------------

    @property
    def next_number(self) -> int:
        """Number of the set-point that must come next."""
        return self._taken_count

    @property
    def ahead_s(self) -> float:
        """How long what is kept lasts."""
        return sum(rows.size for rows in self._rows) * self._dt_s

    @property
    def room_count(self) -> int:
        """How many set-points may come now."""
        most = max(_LEAST_COUNT, round(AHEAD_MOST_S / self.period_s))
        return max(0, most - round(self.ahead_s / self.period_s))

    def take(self, first_number: int, position_m: Sequence[float], last: bool = False) -> None:
        """Take set-points over, or none of them; the same ones again are no error.

        RequestError names the set-point, the value, its limit and what to do.
        """
        with self._lock:
            block = (first_number, tuple(position_m), last)
            if block == self._newest:
                return
            self._refuse_out_of_order(first_number, len(position_m))
            positions = np.asarray(position_m, dtype=float)
            odd = np.flatnonzero(~np.isfinite(positions))
            if odd.size:
                value = positions[odd[0]]
                raise RequestError(f"set-point {first_number + odd[0]} is {value}; every one must be a finite number")
            if first_number == 0 and abs(positions[0] - self._start_m) > _START_TOLERANCE_M:
                raise RequestError(
                    f"set-point 0 is {positions[0]:.9g} m and the stage holds at {self._start_m:.9g} m, more than "
                    f"{_START_TOLERANCE_M:g} m away; move there first, or begin where it holds"
                )
            self._extend(positions, last)
            self._taken_count += positions.size
            self._last, self._newest = last, block

    def _refuse_out_of_order(self, first_number: int, count: int) -> None:
        if self._over:
            raise RequestError(f"set-point {first_number} comes too late: {self._over}; begin again with number 0")
        if self._last:
            raise RequestError(f"set-point {first_number}: {self._taken_count - 1} was said to be the last one")
        if first_number != self._taken_count:
            raise RequestError(
                f"set-point {first_number} is out of order: {self._taken_count} must come next; send from there on"
            )
        if count > self.room_count:
            raise RequestError(
                f"set-points {first_number} to {first_number + count - 1} are {count}, and {self.room_count} have "
                f"room ({AHEAD_MOST_S:g} s ahead at most); send the others later"
            )

    def _extend(self, positions: np.ndarray, last: bool) -> None:
        """Make a reference of every interval whose end has a neighbour; checked before any of it is kept."""
        points = np.concatenate([self._known, positions])
        if last:  # as if it went on straight
            points = np.append(points, 2.0 * points[-1] - points[-2] if points.size > 1 else points[-1])
        state = self._state or MotionState(self._start_m)
        if points.size < (2 if self._state is None else 3):
            self._known = points
            return
        h = self.period_s
        # points: [begin of the first interval, ..., end of the last interval, its neighbour]
        v = np.concatenate([[state.velocity_m_per_s], (points[2:] - points[:-2]) / (2.0 * h)])
        a = np.concatenate([[state.acceleration_m_per_s2], (points[2:] - 2.0 * points[1:-1] + points[:-2]) / (h * h)])
        p = points[:-1]
        count = p.size - 1
        if count < 1:
            self._known, self._state = points, state
            return
        at_s = np.arange(1, count * self._cycles + 1) * self._dt_s
        rows = trajectories.through_states(np.arange(count + 1) * h, p, v, a, at_s)
        end = MotionState(float(p[-1]), float(v[-1]), float(a[-1]))
        self._check(rows, end, self._taken_count + positions.size - count - (0 if last else 1))
        self._rows.append(rows)
        self._state, self._known = end, points[-2:]

    def _check(self, rows: np.ndarray, end: MotionState, first_number: int) -> None:
        room, limits = self._room, self._room.limits
        (low_m, high_m), top, hardest = room.travel_m, limits.velocity_m_per_s, limits.acceleration_m_per_s2
        position_m, velocity = rows["position_m"], rows["velocity_m_per_s"]
        acceleration = rows["acceleration_m_per_s2"]
        left_m = np.where(velocity > 0.0, high_m - position_m, position_m - low_m)
        stopping_m = velocity**2 / (2.0 * room.stop_deceleration_m_per_s2)
        travel = f"the travel [{low_m:g}, {high_m:g}] m"
        checks = (
            ("position_m", position_m, (low_m <= position_m) & (position_m <= high_m), travel, "stay within it"),
            ("velocity_m_per_s", velocity, np.abs(velocity) <= top, f"{top:g} m/s", "send them closer together"),
            ("acceleration_m_per_s2", acceleration, np.abs(acceleration) <= hardest, f"{hardest:g} m/s^2", _SMOOTHER),
            ("stopping distance_m", stopping_m, stopping_m <= left_m, travel, "go slower near its end"),
        )
        failed = [(int(np.argmin(one[2])), one) for one in checks if not np.all(one[2])]
        if failed:
            row, (field, values, _, limit, remedy) = min(failed, key=lambda found: found[0])
            raise RequestError(
                f"set-point {first_number + row // self._cycles}: on the way there {field} is {values[row]:.6g}, "
                f"beyond {limit}: {remedy}"
            )
        tail = self._brake(end)
        ends_m = tail["position_m"]
        if not (low_m <= ends_m.min() and ends_m.max() <= high_m):
            far_m = ends_m.max() if ends_m.max() > high_m else ends_m.min()
            raise RequestError(
                f"set-point {first_number + rows.size // self._cycles - 1}: braking from there ends at {far_m:.6g} m, "
                f"beyond {travel}: go slower near its end"
            )

    def _brake(self, state: MotionState) -> np.ndarray:
        return trajectories.brake(state, self._room.limits, self._dt_s).setpoints[1:]

    # ---- what the stage's thread does ------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether there is enough to begin with."""
        return self.ahead_s >= AHEAD_LEAST_S or (self._last and bool(self._rows))

    @property
    def ended(self) -> bool:
        """Whether the last set-point was handed to the stage."""
        return self._last and not self._over and not self._rows

    def next_rows(self, most_s: float, state: MotionState) -> tuple[np.ndarray, np.ndarray, MotionState]:
        """Take rows for at most so long (one block at least), the way to rest behind them, and the state between.

        `state` is where the rows before ended; without new rows there are none, and only the way to rest.
        """
        with self._lock:
            taken: list[np.ndarray] = []
            room_count = round(most_s / self._dt_s)
            while self._rows and room_count > 0:
                rows = self._rows[0]
                taken.append(rows[:room_count])
                self._rows[0] = rows[room_count:]
                room_count -= taken[-1].size
                if self._rows[0].size == 0:
                    del self._rows[0]
        rows = np.concatenate(taken) if taken else np.zeros(0, SETPOINT)
        if rows.size:
            end = rows[-1]
            state = MotionState(
                *(float(end[name]) for name in ("position_m", "velocity_m_per_s", "acceleration_m_per_s2"))
            )
        at_rest = state.velocity_m_per_s == 0.0 and state.acceleration_m_per_s2 == 0.0
        return rows, rows[:0] if at_rest else self._brake(state), state

    def close(self, why: str) -> None:
        """Take no more."""
        with self._lock:
            self._over = self._over or why
            self._rows.clear()
