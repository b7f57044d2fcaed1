"""The sweep of the micro that touches both edges: how far, how fast and how long, from what is believed of the joint.

In contact the joint answers k p + c p'. Swept too fast it presses harder than it may on the way in, and lets go
early on the way out, so that stiffness and edge are told from what is mostly damping: on kang-2023 (15 mm, c / k of
0.3 s) 1 Hz pressed with 14 N where 4 N are allowed, and gave the width 5 % off. And a side that nobody knows yet is
pressed for as long as the identification's filter remembers. Pure; knows no bus and no clock.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from stagectl import trajectory as trajectories
from stagectl.backlash import HOLD_RATIO, filter_time_s
from stagectl.errors import RequestError
from stagectl.profile import Profile

TOUCH_HZ, TOUCH_S, TOUCH_SHARE = 0.7, 6.0, 0.6
"""Homing's sweep where the joint allows it; the share of the touch force is low, for the edges are not known yet."""

IDENTIFY_HZ, IDENTIFY_SHARE = 1.0, 0.8
"""Identification's sweep where the joint allows it."""

_HOLD_MARGIN_RATIO = 2.25  # of what the filter remembers: the joint is met earlier or later than it is believed
_LEAST_SWINGS = 5.0  # of a slowed sweep; the first and the last are ramps


class Joint(NamedTuple):
    """What is believed of the joint, and how hard it may be pressed."""

    left_m: float
    right_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float
    damping_n_s_per_m: float
    touch_force_n: float
    hold_s: float = 0.0
    """How long a side must be pressed before its samples count, while it is unknown."""

    found: str = ""
    """How it was found, for whoever is refused by it."""

    def press_m(self, force_share: float) -> float:
        """Return how deep a sweep presses: the stiffer side answers with `force_share` of the touch force."""
        return force_share * self.touch_force_n / max(self.left_stiffness_n_per_m, self.right_stiffness_n_per_m)


KNOWN_OF_JOINT = Joint._fields[:4]
"""What an identification finds, and a sweep is planned by: edges and stiffnesses."""


def could_be(joint: Mapping[str, float]) -> bool:
    """Tell whether such edges and stiffnesses are those of a joint: all finite, width and stiffnesses above 0."""
    left_m, right_m, *stiffnesses = (joint[name] for name in KNOWN_OF_JOINT)
    return 0.0 < left_m + right_m < math.inf and all(0.0 < stiffness < math.inf for stiffness in stiffnesses)


class TouchSweep(NamedTuple):
    """A swing of end minus macro about the middle of the gap."""

    amplitude_m: float
    frequency_hz: float
    duration_s: float


def planned(
    profile: Profile,
    force_share: float,
    usual_hz: float,
    duration_s: float,
    asked_hz: float | None = None,
    believed: Mapping[str, float] | None = None,
    centre_m: float = 0.0,
    found: str = "",
) -> trajectories.Trajectory:
    """Plan a sweep as `plan` does, about where the macro stands, and check that the end can follow it.

    `believed` are the edges and stiffnesses that are believed by now, and `found` says how they were found; the
    profile's without. Errors: RequestError.
    """
    micro, macro = profile.micro, profile.macro
    if micro is None:
        raise RequestError(f"profile {profile.name}: this stage has no micro; there is no backlash to identify")
    joint = joint_of(profile, believed, found)
    swing = trajectories.sweep(
        *plan(joint, force_share, usual_hz, duration_s, asked_hz), centre_m=centre_m, dt_s=profile.cycle.period_s
    )
    trajectories.check(
        swing,
        (-math.inf, math.inf),  # the macro stands, so its travel says nothing
        macro.velocity_limit_m_per_s,
        macro.acceleration_limit_m_per_s2,
        loads=(trajectories.Load("micro", micro.mass_kg, micro.force_limit_n, micro.damping_n_s_per_m),),
        stroke_m=micro.stroke_m,
    )
    return swing


def joint_of(profile: Profile, believed: Mapping[str, float] | None = None, found: str = "") -> Joint:
    """Return the joint that a sweep goes by: `believed` edges and stiffnesses, else the profile's. RequestError."""
    backlash = profile.backlash
    if backlash is None:
        raise RequestError(f"profile {profile.name}: this stage has no micro; there is no backlash to identify")
    return Joint(
        **(believed or {name: getattr(backlash, name) for name in KNOWN_OF_JOINT}),
        damping_n_s_per_m=contact_damping_n_s_per_m(profile.effects),
        touch_force_n=backlash.touch_force_n,
        hold_s=HOLD_RATIO * filter_time_s(profile),
        found=found,
    )


def contact_damping_n_s_per_m(effects: Iterable[Mapping[str, Any]]) -> float:
    """Return the damping of the joint in contact that a profile's effects hold."""
    return sum(float(row["damping_n_s_per_m"]) for row in effects if row["name"] == "contact_damping")


def plan(
    joint: Joint, force_share: float, usual_hz: float, duration_s: float, asked_hz: float | None = None
) -> TouchSweep:
    """Plan a sweep that presses both sides with `force_share` of the touch force, and never with more than all of it.

    Without `asked_hz` it runs at `usual_hz`, or slower where the joint asks for it, and then long enough to swing five
    times. Errors: RequestError where `asked_hz` would press too hard, or might, as nobody says how the joint is damped,
    and where `duration_s` is too short.
    """
    half_m = 0.5 * (joint.left_m + joint.right_m)
    amplitude_m = half_m + joint.press_m(force_share)
    limit_hz = min(
        _limit_hz(half_m, amplitude_m, stiffness, joint.damping_n_s_per_m, joint.touch_force_n)
        for stiffness in (joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m)
    )
    if asked_hz is None:
        if joint.hold_s > 0.0:
            pressed_share = math.acos(half_m / amplitude_m) / math.pi
            limit_hz = min(limit_hz, pressed_share / (_HOLD_MARGIN_RATIO * joint.hold_s))
        if usual_hz <= limit_hz:
            return TouchSweep(amplitude_m, usual_hz, duration_s)
        return TouchSweep(amplitude_m, limit_hz, max(duration_s, _LEAST_SWINGS / limit_hz))
    if joint.damping_n_s_per_m == 0.0 and not asked_hz <= usual_hz:
        raise RequestError(
            f"frequency_hz = {asked_hz:g}: the profile says no damping of the joint, and faster than {usual_hz:g} Hz "
            f"it may be pressed harder than backlash.touch_force_n = {joint.touch_force_n:g} N; ask for at most "
            f"{usual_hz:g} Hz, or give the effect contact_damping"
        )
    if not asked_hz <= limit_hz:
        raise RequestError(
            f"frequency_hz = {asked_hz:g}: with a gap of {2e3 * half_m:g} mm and {joint.damping_n_s_per_m:g} N s/m the "
            f"joint would be pressed harder than backlash.touch_force_n = {joint.touch_force_n:g} N; "
            f"ask for at most {math.floor(limit_hz * 1e3) * 1e-3:g} Hz{f'; {joint.found}' if joint.found else ''}"
        )
    if not duration_s >= 2.0 / asked_hz:
        raise RequestError(
            f"duration_s = {duration_s:g}: at {asked_hz:g} Hz the first and the last swing, the ramps, take "
            f"{2.0 / asked_hz:g} s; give a longer duration_s, or a higher frequency_hz"
        )
    return TouchSweep(amplitude_m, asked_hz, duration_s)


def _limit_hz(half_m: float, amplitude_m: float, stiffness: float, damping: float, force_n: float) -> float:
    """Return where k (A cos wt - half) - c A w sin wt, at most A sqrt(k^2 + c^2 w^2) - k half, reaches `force_n`."""
    if damping == 0.0:
        return math.inf
    reach = (half_m + force_n / stiffness) / amplitude_m
    return stiffness / damping * math.sqrt(reach * reach - 1.0) / (2.0 * math.pi)
