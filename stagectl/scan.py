"""Scan programs: segments one after the other, dwells, the whole repeated; planned before the first cycle.

Pure; knows no stage, no bus and no clock.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stagectl import trajectory as trajectories
from stagectl.errors import RequestError
from stagectl.trajectory import Limits, Trajectory, Waypoint

_PART_S = 1.0


class Program(NamedTuple):
    """A scan as the stage follows it: `first` from its start, then `again` for `again_count` times.

    `again` begins where `first` ends, and ends there. Both hold whole repetitions.
    """

    first: Trajectory
    again: Trajectory
    again_count: int

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last of the last repetition."""
        return self.first.duration_s + self.again_count * (self.again.duration_s + self.again.dt_s)


def plan(
    start_m: float,
    waypoints: Sequence[Waypoint],
    repeat_count: int,
    limits: Limits,
    dt_s: float = 1e-3,
    longest_s: float = math.inf,
) -> Program:
    """Plan a scan from rest at `start_m`, jerk-limited, every part in its own velocity.

    One repetition takes `longest_s` at most. RequestError names the segment, the value, its limit and what to do.
    """
    if not waypoints:
        raise RequestError("segments: there is none; give one or more")
    if repeat_count < 1:
        raise RequestError(f"repeat_count is {repeat_count}; give 1 or more")
    _check(waypoints, limits)
    first = trajectories.chain(start_m, waypoints, limits, dt_s, "scan", longest_s)
    again = trajectories.chain(waypoints[-1].target_m, waypoints, limits, dt_s, "scan", longest_s)
    again_rows = again.setpoints[1:]  # its first row is the last one before
    # A repetition that is over before the next is asked for would leave a pause: short ones go together.
    together = max(1, math.ceil(_PART_S / (again_rows.size * dt_s)))
    full, rest = divmod(repeat_count - 1, together)
    first_rows = np.concatenate([first.setpoints, *[again_rows] * rest])
    return Program(
        Trajectory("scan", first.parameters, dt_s, first_rows),
        Trajectory("scan", again.parameters, dt_s, np.concatenate([again_rows] * together)),
        full,
    )


def _check(waypoints: Sequence[Waypoint], limits: Limits) -> None:
    """Refuse what no start could lead to."""
    entering = 0.0
    for i, point in enumerate(waypoints):
        place, passing = f"segments[{i}]", point.pass_velocity_m_per_s
        top = limits.velocity_m_per_s
        if not 0.0 < point.velocity_m_per_s <= top:
            raise RequestError(
                f"{place}.velocity_m_per_s is {point.velocity_m_per_s:g}, a scan may do {top:g} m/s; "
                "give a speed above 0 up to it"
            )
        if not abs(passing) <= point.velocity_m_per_s:
            raise RequestError(
                f"{place}.pass_velocity_m_per_s is {passing:g}, above the segment's velocity of "
                f"{point.velocity_m_per_s:g} m/s; lower it, or raise velocity_m_per_s"
            )
        if not abs(entering) <= point.velocity_m_per_s:
            raise RequestError(
                f"{place} is entered with {entering:g} m/s, its velocity_m_per_s is {point.velocity_m_per_s:g}; "
                f"raise it, or lower segments[{i - 1}].pass_velocity_m_per_s"
            )
        if not 0.0 <= point.dwell_s < math.inf:
            raise RequestError(f"{place}.dwell_s is {point.dwell_s:g}; give 0 or more seconds")
        if point.dwell_s > 0.0 and passing != 0.0:
            raise RequestError(
                f"{place} dwells for {point.dwell_s:g} s and passes with {passing:g} m/s; "
                "leave dwell_s or pass_velocity_m_per_s out"
            )
        entering = passing
    if entering != 0.0:
        raise RequestError(
            f"segments[{len(waypoints) - 1}].pass_velocity_m_per_s is {entering:g}; the last segment must end at "
            "rest: leave it out, or add a segment to brake in"
        )
