"""The trajectory that `stagectl run` was asked for; an option that belongs to another trajectory is refused."""

import math
from dataclasses import dataclass, fields
from pathlib import Path

from stagectl import trajectory as trajectories
from stagectl.errors import RequestError
from stagectl.profile import Profile
from stagectl.suggestion import closest

KINDS = ("trapezoid", "sine", "move")
_BELONG = {
    "trapezoid": ("stroke_m", "velocity_m_per_s", "dwell_s", "start_m"),
    "sine": ("amplitude_m", "frequency_hz", "duration_s", "start_m"),
    "move": ("target_m",),
    "file": (),
}
_TRAVEL_SHARE = 8.0 / 9.0


@dataclass(frozen=True, slots=True)
class Shape:
    """The options of a trajectory; None where they were not given."""

    stroke_m: float | None = None
    velocity_m_per_s: float | None = None
    dwell_s: float | None = None
    start_m: float | None = None
    amplitude_m: float | None = None
    frequency_hz: float | None = None
    duration_s: float | None = None
    target_m: float | None = None


def kind_of(trajectory: str, shape: Shape) -> str:
    """Return trapezoid, sine, move or file. Errors: RequestError."""
    kind = trajectory if trajectory in KINDS else "file"
    if kind == "file" and not trajectory.lower().endswith(".csv"):
        raise RequestError(
            f"--trajectory {trajectory!r}: give {', '.join(KINDS)} or a CSV file with the header t_s,position_m"
            f"{closest(trajectory, KINDS)}"
        )
    for field in fields(shape):
        if getattr(shape, field.name) is not None and field.name not in _BELONG[kind]:
            option = "--" + field.name.replace("_", "-")
            owners = ", ".join(name for name, options in _BELONG.items() if field.name in options)
            raise RequestError(f"{option} belongs to {owners}, not to --trajectory {trajectory}; leave it out")
    if kind == "move" and shape.target_m is None:
        raise RequestError("--trajectory move needs --target-m, a position in metres from the homed zero")
    return kind


def target(profile: Profile, shape: Shape) -> float:
    """Return where a move goes, m; refused before anything opens, because homing is motion too."""
    low_m, high_m = profile.macro.travel_m
    target_m = math.nan if shape.target_m is None else shape.target_m
    if not low_m <= target_m <= high_m:
        raise RequestError(
            f"--target-m is {target_m:g}, the travel of {profile.name} is [{low_m:g}, {high_m:g}] m; "
            "give a position within it"
        )
    return target_m


def planned(profile: Profile, trajectory: str, shape: Shape) -> trajectories.Trajectory:
    """Plan a trapezoid, a sine or a file's motion, and refuse before anything moves what the stage can't do."""
    plan = _planned(profile, trajectory, shape)
    macro = profile.macro
    trajectories.check(
        plan,
        macro.travel_m,
        macro.velocity_limit_m_per_s,
        macro.acceleration_limit_m_per_s2,
        stop_deceleration_m_per_s2=macro.stop_deceleration_m_per_s2,
    )
    return plan


def _planned(profile: Profile, trajectory: str, shape: Shape) -> trajectories.Trajectory:
    kind = kind_of(trajectory, shape)
    low_m, high_m = profile.macro.travel_m
    middle_m, span_m = 0.5 * (low_m + high_m), high_m - low_m
    dt_s = profile.cycle.period_s
    if kind == "file":
        return trajectories.from_file(Path(trajectory), dt_s)
    speed = min(0.2, 0.8 * profile.macro.velocity_limit_m_per_s)
    if kind == "trapezoid":
        stroke_m = _or(shape.stroke_m, min(0.8, _TRAVEL_SHARE * span_m))
        return trajectories.trapezoid(
            stroke_m,
            _or(shape.velocity_m_per_s, speed),
            dwell_s=_or(shape.dwell_s, 1.0),
            dt_s=dt_s,
            start_m=_or(shape.start_m, middle_m - 0.5 * stroke_m),
        )
    amplitude_m = _or(shape.amplitude_m, min(0.4, 0.5 * _TRAVEL_SHARE * span_m))
    frequency_hz = _or(shape.frequency_hz, speed / (2.0 * math.pi * amplitude_m) if amplitude_m > 0.0 else 1.0)
    if not 0.0 < frequency_hz < math.inf:
        raise RequestError(f"--frequency-hz is {frequency_hz:g}; a finite number above 0 is needed")
    return trajectories.sine(
        amplitude_m,
        2.0 * math.pi * frequency_hz,
        _or(shape.duration_s, 3.0 / frequency_hz),
        _or(shape.start_m, middle_m),
        dt_s,
    )


def _or(given: float | None, otherwise: float) -> float:
    return otherwise if given is None else given
