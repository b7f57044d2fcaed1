"""Cascaded PID with feed-forward: the honest rival, on the same loop.

    e = x_r - x,  e_v = de/dt (filtered difference) + k_p e
    F = m (a_r + k_v e_v + k_i int e_v dt) + feed-forward of known forces at the reference

x is the newest sample; no machine runs beside it, so nothing is predicted. Reference and sample pass the same
difference and filter: differencing x alone lags v_r by half a period, 6 um at 1 m/s^2 (measured). The gains are
k_p = w / 4, k_v = w, k_i = k_v w / 10 for a velocity loop of bandwidth w (Leonhard, Control of Electrical Drives,
chapter 15: spacing of cascaded loops). Pure; knows no bus and no clock.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl.compiled import compiled
from stagectl.laws.reference import between, felt_after_s, gap_centre, precise_current_loop_s
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

LAW = np.dtype(
    [
        ("precision_position_per_s", "f8"),
        ("precision_velocity_per_s", "f8"),
        ("precision_integral_per_s2", "f8"),
        ("macro_position_per_s", "f8"),
        ("macro_velocity_per_s", "f8"),
        ("macro_integral_per_s2", "f8"),
        ("filter_ratio", "f8"),
        ("precision_force_limit_n", "f8"),
        ("macro_force_limit_n", "f8"),
        ("macro_feed_forward_ratio", "f8"),  # of the reference's acceleration
        ("precision_integral_m", "f8"),
        ("macro_integral_m", "f8"),
        ("precision_error_m", "f8"),
        ("precision_error_rate_m_per_s", "f8"),
        ("macro_error_m", "f8"),
        ("macro_error_rate_m_per_s", "f8"),
        ("started", "f8"),
        ("macro_started", "f8"),
        ("error_m", "f8"),
        ("sliding_variable_m_per_s", "f8"),  # none here; kept so that rows of all laws look alike
        ("adaptive_gain_ratio", "f8"),
        ("parked", "f8"),
    ]
)

LINEAR_STATES = tuple(
    f"{axis}_{name}" for axis in ("precision", "macro") for name in ("integral_m", "error_m", "error_rate_m_per_s")
)
"""What a cycle leaves to the next about e = 0."""

_POSITION_RATIO = 0.25
_INTEGRAL_RATIO = 0.1
_FILTER_RATIO = 8.0  # the difference is smoothed this much above the velocity loop


def init(profile: "Profile") -> np.ndarray:
    """Make LAW from a profile's [control] and limits; state at rest."""
    law = np.zeros(1, LAW)
    control = profile.control
    precise_hz = control.pid_bandwidth_hz if profile.micro is not None else control.macro_bandwidth_hz
    for name, bandwidth_hz in (("precision", precise_hz), ("macro", control.macro_bandwidth_hz)):
        w = 2.0 * np.pi * bandwidth_hz
        law[f"{name}_position_per_s"] = _POSITION_RATIO * w
        law[f"{name}_velocity_per_s"] = w
        law[f"{name}_integral_per_s2"] = _INTEGRAL_RATIO * w * w
    dt_s = 1.0 / profile.cycle.rate_hz
    law["filter_ratio"] = 1.0 - np.exp(-_FILTER_RATIO * 2.0 * np.pi * precise_hz * dt_s)
    precise = profile.micro if profile.micro is not None else profile.macro
    law["precision_force_limit_n"] = precise.force_limit_n
    law["macro_force_limit_n"] = profile.macro.force_limit_n
    law["macro_feed_forward_ratio"] = control.macro_feed_forward_ratio
    return law


@compiled
def middle(after: Record, later: Record, q: Record, law: Record, dt_s: float) -> None:
    """Take known forces at the reference: no noise, no feedback."""
    after.middle_end_position_m = later.position_m
    after.middle_end_velocity_m_per_s = later.velocity_m_per_s
    after.end_acceleration_m_per_s2 = later.acceleration_m_per_s2
    after.macro_acceleration_m_per_s2 = later.acceleration_m_per_s2 - later.relative_acceleration_m_per_s2
    after.middle_macro_position_m = later.position_m - later.relative_position_m + gap_centre(q)
    after.middle_macro_velocity_m_per_s = later.velocity_m_per_s - later.relative_velocity_m_per_s
    after.contact_side = 0.0
    after.penetration_m = 0.0
    after.penetration_velocity_m_per_s = 0.0


@compiled
def precision(
    law: Record,
    ahead: Record,
    after: Record,
    seen: Record,
    now: Record,
    later: Record,
    mass_kg: float,
    known_n: float,
    disturbance_n: float,
    low_n: float,
    high_n: float,
    q: Record,
    dt_s: float,
) -> float:
    """Return the force of the axis that carries the end, N, within what its motor makes at its limits."""
    error = now.position_m - seen.end_seen_m
    if law.started == 0.0:
        law.precision_error_m = error
        law.started = 1.0
    rate = (error - law.precision_error_m) / dt_s
    law.precision_error_rate_m_per_s += law.filter_ratio * (rate - law.precision_error_rate_m_per_s)
    law.precision_error_m = error
    law.error_m = -error
    velocity_error = law.precision_error_rate_m_per_s + law.precision_position_per_s * error
    wanted = (
        later.acceleration_m_per_s2
        + felt_after_s(precise_current_loop_s(q), dt_s) * later.jerk_m_per_s3
        + law.precision_velocity_per_s * velocity_error
        + law.precision_integral_per_s2 * law.precision_integral_m
    )
    asked_n = mass_kg * wanted - known_n
    force_n = between(asked_n, low_n, high_n)
    if force_n == asked_n:
        law.precision_integral_m += velocity_error * dt_s
    return force_n


@compiled
def carrier(
    law: Record,
    ahead: Record,
    after: Record,
    seen: Record,
    now: Record,
    later: Record,
    mass_kg: float,
    known_n: float,
    disturbance_n: float,
    low_n: float,
    high_n: float,
    q: Record,
    dt_s: float,
) -> float:
    """Return the force of the macro that keeps the end in the middle of the gap, N, within what its motor makes."""
    error = now.position_m - now.relative_position_m + gap_centre(q) - seen.macro_seen_m
    if law.macro_started == 0.0:
        law.macro_error_m = error
        law.macro_started = 1.0
    rate = (error - law.macro_error_m) / dt_s
    law.macro_error_rate_m_per_s += law.filter_ratio * (rate - law.macro_error_rate_m_per_s)
    law.macro_error_m = error
    velocity_error = law.macro_error_rate_m_per_s + law.macro_position_per_s * error
    felt_s = felt_after_s(q.macro_current_loop_s, dt_s)
    acceleration = later.acceleration_m_per_s2 + felt_s * later.jerk_m_per_s3 - later.relative_acceleration_m_per_s2
    wanted = (
        law.macro_feed_forward_ratio * acceleration
        + law.macro_velocity_per_s * velocity_error
        + law.macro_integral_per_s2 * law.macro_integral_m
    )
    asked_n = mass_kg * wanted - known_n
    force_n = between(asked_n, low_n, high_n)
    if force_n == asked_n:
        law.macro_integral_m += velocity_error * dt_s
    return force_n
