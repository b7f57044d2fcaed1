"""The setpoint at the instant a command acts, and where the macro should be for it. Pure."""

from stagectl.compiled import compiled
from stagectl.signals import Record


@compiled
def extrapolate(later: Record, now: Record, delay_s: float) -> None:
    """Write the setpoint `delay_s` after the sample's into `later` (constant jerk)."""
    later.jerk_m_per_s3 = now.jerk_m_per_s3
    later.acceleration_m_per_s2 = now.acceleration_m_per_s2 + now.jerk_m_per_s3 * delay_s
    later.velocity_m_per_s = (
        now.velocity_m_per_s + now.acceleration_m_per_s2 * delay_s + 0.5 * now.jerk_m_per_s3 * delay_s * delay_s
    )
    later.position_m = (
        now.position_m
        + now.velocity_m_per_s * delay_s
        + 0.5 * now.acceleration_m_per_s2 * delay_s * delay_s
        + now.jerk_m_per_s3 * delay_s * delay_s * delay_s / 6.0
    )
    later.relative_acceleration_m_per_s2 = now.relative_acceleration_m_per_s2
    later.relative_velocity_m_per_s = now.relative_velocity_m_per_s + now.relative_acceleration_m_per_s2 * delay_s
    later.relative_position_m = (
        now.relative_position_m
        + now.relative_velocity_m_per_s * delay_s
        + 0.5 * now.relative_acceleration_m_per_s2 * delay_s * delay_s
    )


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
