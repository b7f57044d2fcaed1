"""The moves that `stagectl gap next` chooses from: a declared library, each within what the stage may do. Pure."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from stagectl import trajectory as trajectories
from stagectl.errors import RequestError
from stagectl.signals import SETPOINT
from stagectl.touch_sweep import IDENTIFY_HZ, IDENTIFY_SHARE, Joint, TouchSweep, contact_damping_n_s_per_m, plan
from stagectl.trajectory import Limits, Trajectory

if TYPE_CHECKING:
    from stagectl.profile import Profile

_MOVE_S = 10.0
_SHARE = 0.8
"""Of a limit, and of the travel: what is left is for the control error."""

_JERK_S = 0.1
_PLACES_COUNT = 5
_HOLD_S = 1.5
_LEAD_S = 0.3
_CARRIED_HZ = 0.3
_CARRIED_M = 5e-3


@dataclass(frozen=True, slots=True)
class Room:
    """Where and how fast a stage may move, at a sample period."""

    low_m: float
    high_m: float
    limits: Limits
    period_s: float
    touch: TouchSweep | None = None  # over both edges of the joint

    @property
    def middle_m(self) -> float:
        """Middle of the travel."""
        return 0.5 * (self.low_m + self.high_m)

    @property
    def reach_m(self) -> float:
        """Longest stroke."""
        return _SHARE * (self.high_m - self.low_m)


@dataclass(frozen=True, slots=True)
class Move:
    """One candidate: its name in the library, what it is good for, and the motion."""

    name: str
    shows: str
    trajectory: Trajectory


def room_of(profile: "Profile") -> Room:
    """Return what a profile allows."""
    macro = profile.macro
    acceleration = _SHARE * min(macro.acceleration_limit_m_per_s2, 0.5 * macro.stop_deceleration_m_per_s2)
    limits = Limits(_SHARE * macro.velocity_limit_m_per_s, acceleration, acceleration / _JERK_S)
    touch = None
    if profile.micro is not None and profile.backlash is not None:
        b = profile.backlash
        joint = Joint(
            b.left_m,
            b.right_m,
            b.left_stiffness_n_per_m,
            b.right_stiffness_n_per_m,
            contact_damping_n_s_per_m(profile.effects),
            b.touch_force_n,
        )
        touch = plan(joint, IDENTIFY_SHARE, IDENTIFY_HZ, _MOVE_S)
    return Room(*macro.travel_m, limits, profile.cycle.period_s, touch)


def room_of_motion(positions_m: list[np.ndarray], period_s: float) -> Room:
    """Return the room that recordings used, where no profile says what is allowed: no further and no faster."""
    width = max(3, round(0.02 / period_s))
    mean = np.ones(width) / width
    speeds = [np.convolve(np.diff(x) / period_s, mean, "valid") for x in positions_m]
    accelerations = [np.convolve(np.diff(v) / period_s, mean, "valid") for v in speeds]
    acceleration = max(float(np.max(np.abs(a))) for a in accelerations)
    limits = Limits(max(float(np.max(np.abs(v))) for v in speeds), acceleration, acceleration / _JERK_S)
    return Room(min(float(x.min()) for x in positions_m), max(float(x.max()) for x in positions_m), limits, period_s)


def library(room: Room, allowed: Callable[[Trajectory], None] = lambda planned: None) -> list[Move]:
    """Return the moves that fit into the room; `allowed` raises RequestError at a motion that the stage can't do."""
    found: list[Move] = []
    for move in _all(room):
        try:
            allowed(move.trajectory)
        except RequestError:
            continue
        found.append(move)
    return found


def _all(room: Room) -> Iterator[Move]:
    limits, middle_m, dt_s = room.limits, room.middle_m, room.period_s
    yield Move("slow reversals", "friction at low speed", _swing(room, 0.5, min(2e-3, 0.5 * room.reach_m)))
    yield Move("creep", "friction at low speed, forces periodic over a short way", _stroke(room, 2e-3))
    for name, share in (("slow stroke", 0.1), ("middle stroke", 0.35), ("fast stroke", 1.0)):
        speed = share * limits.velocity_m_per_s
        yield Move(name, "forces over position, friction over speed", _stroke(room, speed))
    for frequency_hz in (0.3, 1.0, 3.0):
        yield Move(f"sine {frequency_hz:g} Hz", "inertia, delays, what follows the current", _swing(room, frequency_hz))
    yield Move("holds at several places", "springs, tilt, cables", _staircase(room))
    yield Move("one minute of strokes", "drift and wear", _swing(room, 0.3, duration_s=60.0))
    if room.touch is not None:
        swept = trajectories.sweep(*room.touch, centre_m=middle_m, dt_s=dt_s)
        yield Move("sweep over both edges", "the joint in contact, the bodies moving apart", _carried(swept, room))


def _swing(
    room: Room, frequency_hz: float, amplitude_m: float | None = None, duration_s: float = _MOVE_S
) -> Trajectory:
    """Swing about the middle as far as speed, acceleration and travel let it."""
    omega = 2.0 * math.pi * frequency_hz
    largest_m = min(
        0.5 * room.reach_m, room.limits.velocity_m_per_s / omega, room.limits.acceleration_m_per_s2 / omega**2
    )
    amplitude_m = largest_m if amplitude_m is None else min(amplitude_m, largest_m)
    ramp_s = min(max(1.0 / frequency_hz, 1.0), 0.25 * duration_s)
    return trajectories.sine(amplitude_m, omega, duration_s, room.middle_m, room.period_s, ramp_s)


def _carried(swept: Trajectory, room: Room) -> Trajectory:
    """Let the macro carry a sweep to and fro: where it stands, its friction takes what the micro's drive pushes back.

    Measured on the simulated printer, whose decoupling keeps the macro within 0.1 um: power to tell the reaction from
    the macro's mass 0.19 standing, 1.0 carried.
    """
    way = _swing(room, _CARRIED_HZ, _CARRIED_M, swept.duration_s).setpoints
    rows = swept.setpoints.copy()
    rows["position_m"] += way["position_m"] - room.middle_m
    for name in ("velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3"):
        rows[name] += way[name]
    return replace(swept, name="carried sweep", setpoints=rows)


def _stroke(room: Room, speed_m_per_s: float) -> Trajectory:
    """Go there and back at constant speed, as far as time and travel allow."""
    speed = min(speed_m_per_s, room.limits.velocity_m_per_s)
    rounded_s = max(speed / room.limits.acceleration_m_per_s2, 0.1)
    stroke_m = min(room.reach_m, speed * 0.5 * _MOVE_S)
    return trajectories.trapezoid(
        stroke_m,
        speed,
        (rounded_s, 0.5 * rounded_s, 0.25 * rounded_s),
        dwell_s=0.3,
        dt_s=room.period_s,
        start_m=room.middle_m - 0.5 * stroke_m,
        lead_s=_LEAD_S,
    )


def _staircase(room: Room) -> Trajectory:
    """Rest at places all over the travel, in an order that comes to them from both sides."""
    places_m = room.middle_m + room.reach_m * np.linspace(-0.5, 0.5, _PLACES_COUNT)
    order = [0, 2, 4, 3, 1, 0]
    parts: list[np.ndarray] = []
    for here, there in itertools.pairwise(order):
        parts.append(_rest(float(places_m[here]), _HOLD_S, room.period_s))
        moved = trajectories.move(float(places_m[here]), float(places_m[there]), room.limits, room.period_s)
        parts.append(moved.setpoints)
    parts.append(_rest(float(places_m[order[-1]]), _HOLD_S, room.period_s))
    rows = np.concatenate(parts)
    return Trajectory("staircase", {"kind": "staircase", "places_m": places_m.tolist()}, room.period_s, rows)


def _rest(position_m: float, duration_s: float, period_s: float) -> np.ndarray:
    rows = np.zeros(round(duration_s / period_s), SETPOINT)
    rows["position_m"] = position_m
    return rows
