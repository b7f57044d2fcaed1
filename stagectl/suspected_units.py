"""Which units a table of motion seems to have, where it does not look like seconds and metres. Pure.

A guess never converts anything: it stands in the refusal, or in a remark, for a person to decide.
"""

from collections.abc import Sequence

from stagectl.trajectory import Trajectory

_LENGTHS = (("millimetres", 1e3), ("micrometres", 1e6), ("nanometres", 1e9), ("inches", 1.0 / 0.0254))
_SLOWEST_SHARE = 1e-3
_LONG_S = 100.0


def of_positions(planned: Trajectory, travel_m: Sequence[float]) -> str:
    """Ask whether positions beyond the travel are in another unit; empty where they are within it, or fit in none."""
    low_m, high_m = float(planned.setpoints["position_m"].min()), float(planned.setpoints["position_m"].max())
    if travel_m[0] <= low_m and high_m <= travel_m[1]:
        return ""
    for name, per_metre in _LENGTHS:
        if travel_m[0] <= low_m / per_metre and high_m / per_metre <= travel_m[1]:
            return f"position_m goes from {low_m:g} to {high_m:g}: are these {name}? Divide by {per_metre:g}"
    return ""


def of_times(planned: Trajectory, velocity_limit_m_per_s: float) -> str:
    """Ask whether the times are milliseconds: a long motion that is slower than this stage by a thousand."""
    fastest = float(abs(planned.setpoints["velocity_m_per_s"]).max())
    if planned.duration_s > _LONG_S and 0.0 < fastest < _SLOWEST_SHARE * velocity_limit_m_per_s:
        return (
            f"the motion takes {planned.duration_s:g} s at {fastest:.2g} m/s at most: are the times milliseconds? "
            "Divide by 1000"
        )
    return ""
