"""The setpoint at the instant a command acts, and where the macro should be for it. Pure."""

from stagectl.compiled import compiled
from stagectl.signals import Record


@compiled
def snap_m_per_s4(jerk: float, jerk_before: float, change_before: float, dt_s: float) -> float:
    """Return the change of jerk that goes on: the lesser of the last two, 0 where they differ in sign (minmod).

    A jump of jerk, as moves in the least time have, is no snap; a jerk that rises evenly for two cycles has one.
    """
    change = jerk - jerk_before
    if not change * change_before > 0.0:
        return 0.0
    return (change if abs(change) < abs(change_before) else change_before) / dt_s


@compiled
def extrapolate(later: Record, now: Record, delay_s: float, snap_m_per_s4: float) -> None:
    """Write the setpoint `delay_s` after the sample's into `later` (constant snap).

    Constant jerk leaves 11 mN of 40 kg out where corners of 50 ms change it by 200 m/s^4: 4.4 nm.
    """
    later.jerk_m_per_s3 = now.jerk_m_per_s3 + snap_m_per_s4 * delay_s
    jerk = now.jerk_m_per_s3 + snap_m_per_s4 * delay_s / 3.0  # the constant one that gives the same velocity
    later.acceleration_m_per_s2 = now.acceleration_m_per_s2 + 0.5 * (now.jerk_m_per_s3 + later.jerk_m_per_s3) * delay_s
    later.velocity_m_per_s = now.velocity_m_per_s + now.acceleration_m_per_s2 * delay_s + 0.5 * jerk * delay_s * delay_s
    later.position_m = (
        now.position_m
        + now.velocity_m_per_s * delay_s
        + 0.5 * now.acceleration_m_per_s2 * delay_s * delay_s
        + (now.jerk_m_per_s3 + 0.25 * snap_m_per_s4 * delay_s) * delay_s * delay_s * delay_s / 6.0
    )
    later.relative_acceleration_m_per_s2 = now.relative_acceleration_m_per_s2
    later.relative_velocity_m_per_s = now.relative_velocity_m_per_s + now.relative_acceleration_m_per_s2 * delay_s
    later.relative_position_m = (
        now.relative_position_m
        + now.relative_velocity_m_per_s * delay_s
        + 0.5 * now.relative_acceleration_m_per_s2 * delay_s * delay_s
    )


@compiled
def felt_after_s(current_loop_s: float, dt_s: float) -> float:
    """Return how long after a command begins to act its mean is felt, s: half a period and the current loop's lag.

    A force that changes by 400 N/s and is fed forward for half a period alone is 60 mN short behind 0.15 ms.
    """
    return 0.5 * dt_s + current_loop_s


@compiled
def precise_current_loop_s(q: Record) -> float:
    """Return the time constant of the current loop of the axis that carries the end, s."""
    return q.micro_current_loop_s if q.has_micro != 0.0 else q.macro_current_loop_s


@compiled
def gap_centre(q: Record) -> float:
    """Return x_b in the middle of the gap, (b_r - b_l) / 2: where the macro leads the end in rest (after E11)."""
    if q.has_micro == 0.0 or not q.right_m < 1e3 or not q.left_m < 1e3:
        return 0.0
    return 0.5 * (q.right_m - q.left_m)


@compiled
def between(force_n: float, low_n: float, high_n: float) -> float:
    """Clamp a force; nan passes as nan, so that the guard sees it."""
    if force_n > high_n:
        return high_n
    if force_n < low_n:
        return low_n
    return force_n


@compiled
def limited(force_n: float, limit_n: float) -> float:
    """Clamp a force to either side; nan passes as nan, so that the guard sees it."""
    return between(force_n, -limit_n, limit_n)
