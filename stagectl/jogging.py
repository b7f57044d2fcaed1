"""Jogging: which way to plan on, from where the reference will be shortly, while somebody holds a key.

Every plan ends at rest by itself, so that nothing has to come in time for the stage to stop. Pure; knows no stage, no
bus and no clock.
"""

import math
from typing import NamedTuple

import numpy as np

from stagectl import trajectory as trajectories
from stagectl.errors import RequestError
from stagectl.trajectory import Limits, MotionState, Trajectory

HORIZON_S = 10.0
"""As far as a jog is planned; it is planned on before half of that is used up."""

AHEAD_S = 0.15
"""From the plan to its first row: seven of the supervisor's steps."""

_SLOWEST_M_PER_S = 1e-6


class Splice(NamedTuple):
    """A segment that goes on behind row `at_row` of the one under way."""

    at_row: int
    setpoints: np.ndarray


def wanted_speed(velocity_m_per_s: float, limits: Limits) -> float:
    """Check a jog's velocity; RequestError where it is none, or more than `limits` allow."""
    top = limits.velocity_m_per_s
    if not abs(velocity_m_per_s) <= top:
        raise RequestError(
            f"velocity_m_per_s is {velocity_m_per_s:g}, a jog may do {top:g} m/s either way; ask for less"
        )
    return velocity_m_per_s if abs(velocity_m_per_s) >= _SLOWEST_M_PER_S else 0.0


def way(start: MotionState, velocity_m_per_s: float, limits: Limits, travel_m: tuple[float, float], dt_s: float):
    """Plan from a state: to that velocity and on for the horizon, to rest at the end of travel; 0 brakes at once."""
    if velocity_m_per_s == 0.0:
        return trajectories.brake(start, limits, dt_s)
    reach_m = start.position_m + velocity_m_per_s * HORIZON_S
    target_m = min(max(reach_m, travel_m[0]), travel_m[1])
    slower = Limits(abs(velocity_m_per_s), limits.acceleration_m_per_s2, limits.jerk_m_per_s3)
    return trajectories.move(start, target_m, slower, dt_s)


def splice(
    under_way: np.ndarray,
    done_rows: int,
    velocity_m_per_s: float,
    limits: Limits,
    travel_m: tuple[float, float],
    dt_s: float,
) -> tuple[Splice, Trajectory] | None:
    """Plan on from a row of the segment under way that is `AHEAD_S` from now; None where that pays no more.

    So it is where the one under way ends before that, brakes already, or where the new one would leave the travel: the
    same way to rest, planned once more from one of its rows, ends 1e-17 m further.
    """
    at_row = done_rows + math.ceil(AHEAD_S / dt_s)
    if at_row >= under_way.size:
        return None
    row = under_way[at_row - 1]
    start = MotionState(float(row["position_m"]), float(row["velocity_m_per_s"]), float(row["acceleration_m_per_s2"]))
    planned = way(start, velocity_m_per_s, limits, travel_m, dt_s)
    if velocity_m_per_s == 0.0 and under_way.size - at_row < planned.setpoints.size:
        return None
    position_m = planned.setpoints["position_m"]
    low_m, high_m = min(travel_m[0], start.position_m), max(travel_m[1], start.position_m)
    if position_m.min() < low_m or position_m.max() > high_m:
        return None
    return Splice(at_row, planned.setpoints[1:]), planned
