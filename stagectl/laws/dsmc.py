"""Decoupling sliding mode control (Kang et al. 2023, section 4, in the corrected reading).

Micro, adaptive integral sliding mode (32)-(40):

    e = d - d_r,  s = e' + eta e + gamma z,  z' = y(e)
    y(e) = 2 e - e |e| / phi inside |e| < phi, else phi sgn e          (33) corrected, E13
    F_2  = m2 (d_r'' - eta e' - gamma y - (k/m2) s - (k Omega / (r m2)) s) - known forces
    Omega' = (alpha k / r) s^2 - sigma (Omega - Omega_0), bounded, frozen in saturation   (40) corrected, E14

with eta >= 2 sqrt(gamma) (E16). Known forces are those of the believed machine, predicted to the instant the
command acts: spring, contact (its feed-forward), effects, and the observer's unknown force; with it comes the mass
that was found to be missing times the reference's acceleration at that instant (`stagectl.fed_forward`). Macro: state
feedback on the centre of the gap (for (21), E11) with the micro's reaction decoupled (26), static with current drives.
Pure; knows no bus and no clock.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl import plant
from stagectl.compiled import compiled
from stagectl.laws.reference import between, felt_after_s, gap_centre, precise_current_loop_s
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

LAW = np.dtype(
    [
        ("eta_per_s", "f8"),
        ("gamma_per_s2", "f8"),
        ("phi_m", "f8"),
        ("sliding_gain_per_s", "f8"),  # k / m
        ("adaptation_per_s", "f8"),  # alpha k / r, of Omega / r; Omega counts in r
        ("adaptation_scale_m_per_s", "f8"),
        ("leak_per_s", "f8"),  # sigma
        ("adaptive_gain_floor_ratio", "f8"),
        ("adaptive_gain_ceiling_ratio", "f8"),
        ("macro_stiffness_per_s2", "f8"),
        ("macro_damping_per_s", "f8"),
        ("precision_force_limit_n", "f8"),
        ("macro_force_limit_n", "f8"),
        ("macro_feed_forward_ratio", "f8"),  # of the reference's acceleration
        ("park_error_m", "f8"),
        ("park_stiffness_per_s2", "f8"),
        ("park_damping_per_s", "f8"),
        ("bump_decay_ratio", "f8"),  # what is left a cycle later of a jump in force at a change of mode
        ("error_integral_m_s", "f8"),
        ("adaptive_gain_ratio", "f8"),
        ("error_m", "f8"),
        ("sliding_variable_m_per_s", "f8"),
        ("parked", "f8"),
        ("bump_n", "f8"),
        ("last_force_n", "f8"),
        ("started", "f8"),
    ]
)

LINEAR_STATES = ("error_integral_m_s",)
"""What a cycle leaves to the next about e = 0; the adaptive gain counts there as a parameter (s = 0)."""

_PARK_BANDWIDTH_HZ = 15.0
_BUMP_S = 0.02


def init(profile: "Profile") -> np.ndarray:
    """Make LAW from a profile's [control] and limits; state at rest."""
    law = np.zeros(1, LAW)
    control = profile.control
    w = 2.0 * np.pi * control.micro_bandwidth_hz
    if profile.micro is None:
        w = 2.0 * np.pi * control.macro_bandwidth_hz
    law["eta_per_s"] = control.eta_ratio * w
    law["gamma_per_s2"] = control.gamma_ratio * w * w
    law["sliding_gain_per_s"] = control.sliding_ratio * w
    law["phi_m"] = control.phi_m
    law["adaptation_per_s"] = control.adaptation_per_s
    law["adaptation_scale_m_per_s"] = control.adaptation_scale_m_per_s
    law["leak_per_s"] = control.leak_per_s
    law["adaptive_gain_floor_ratio"] = 0.0
    law["adaptive_gain_ceiling_ratio"] = control.adaptive_gain_ceiling_ratio
    w = 2.0 * np.pi * control.macro_bandwidth_hz
    law["macro_stiffness_per_s2"] = w * w
    law["macro_damping_per_s"] = 2.0 * control.macro_damping_ratio * w
    precise = profile.micro if profile.micro is not None else profile.macro
    law["precision_force_limit_n"] = precise.force_limit_n
    law["macro_force_limit_n"] = profile.macro.force_limit_n
    law["macro_feed_forward_ratio"] = control.macro_feed_forward_ratio
    law["park_error_m"] = control.park_error_m
    w = 2.0 * np.pi * _PARK_BANDWIDTH_HZ
    law["park_stiffness_per_s2"] = w * w
    law["park_damping_per_s"] = 2.0 * w
    law["bump_decay_ratio"] = np.exp(-1.0 / (profile.cycle.rate_hz * _BUMP_S))
    return law


@compiled
def integrand(e: float, phi: float) -> float:
    """Return y(e) of (33), corrected, m: odd, slope 2 at 0, phi sgn e beyond phi."""
    if e >= phi:
        return phi
    if e <= -phi:
        return -phi
    return 2.0 * e - e * abs(e) / phi


@compiled
def middle(after: Record, later: Record, q: Record, law: Record, dt_s: float) -> None:
    """Take known forces at the predicted motion when the command is felt: in the middle of its period, and the lag."""
    twice_s = 2.0 * felt_after_s(precise_current_loop_s(q), dt_s)
    plant.half_step(after, q, twice_s, 0.0, 0.0, plant.BRIDGE_CURRENT, plant.BRIDGE_CURRENT)


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
    """Return the force of the axis that carries the end, N, within what its motor makes at its limits: (27)-(32), (39).

    Advances z of (32), m s, and the adaptive gain of (40), in r, where that force is within them.
    """
    known_n += disturbance_n
    felt_s = felt_after_s(precise_current_loop_s(q), dt_s)
    acceleration = later.acceleration_m_per_s2 + felt_s * later.jerk_m_per_s3
    e = ahead.end_position_m - later.position_m
    de = ahead.end_velocity_m_per_s - later.velocity_m_per_s
    law.error_m = e
    was_parked = law.parked
    if q.has_micro != 0.0:
        if law.parked == 0.0 and not abs(e) <= law.park_error_m:
            law.parked = 1.0
        elif law.parked != 0.0 and abs(e) <= 0.5 * law.park_error_m and abs(de) * 0.02 <= law.park_error_m:
            law.parked = 0.0
            law.error_integral_m_s = 0.0
    s = de + law.eta_per_s * e + law.gamma_per_s2 * law.error_integral_m_s
    law.sliding_variable_m_per_s = s
    if law.parked != 0.0:
        relative = ahead.end_position_m - ahead.macro_position_m + gap_centre(q) - later.relative_position_m
        relative_rate = ahead.end_velocity_m_per_s - ahead.macro_velocity_m_per_s - later.relative_velocity_m_per_s
        wanted = acceleration - law.park_stiffness_per_s2 * relative - law.park_damping_per_s * relative_rate
    else:
        gain = law.sliding_gain_per_s * (1.0 + law.adaptive_gain_ratio)
        y = integrand(e, law.phi_m)
        wanted = acceleration - law.eta_per_s * de - law.gamma_per_s2 * y - gain * s
    free_n = mass_kg * wanted - known_n
    if law.started != 0.0 and was_parked != law.parked:
        law.bump_n = law.last_force_n - free_n
    law.started = 1.0
    asked_n = free_n + law.bump_n
    law.bump_n *= law.bump_decay_ratio
    force_n = between(asked_n, low_n, high_n)
    if force_n == asked_n and law.parked == 0.0:
        law.error_integral_m_s += integrand(e, law.phi_m) * dt_s
        ratio = s / law.adaptation_scale_m_per_s
        growth = law.adaptation_per_s * ratio * ratio - law.leak_per_s * (
            law.adaptive_gain_ratio - law.adaptive_gain_floor_ratio
        )
        law.adaptive_gain_ratio = min(
            max(law.adaptive_gain_ratio + growth * dt_s, law.adaptive_gain_floor_ratio), law.adaptive_gain_ceiling_ratio
        )
    law.last_force_n = force_n
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
    known_n += disturbance_n
    e = ahead.macro_position_m - (later.position_m - later.relative_position_m + gap_centre(q))
    de = ahead.macro_velocity_m_per_s - (later.velocity_m_per_s - later.relative_velocity_m_per_s)
    felt_s = felt_after_s(q.macro_current_loop_s, dt_s)
    acceleration = later.acceleration_m_per_s2 + felt_s * later.jerk_m_per_s3 - later.relative_acceleration_m_per_s2
    acceleration *= law.macro_feed_forward_ratio
    wanted = acceleration - law.macro_stiffness_per_s2 * e - law.macro_damping_per_s * de
    return between(mass_kg * wanted - known_n, low_n, high_n)
