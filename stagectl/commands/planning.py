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
_SETPOINTS_PER_PERIOD = 20  # fewer draw another curve than the sine that was asked for; below 2 an alias of it


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
    _check_options(profile, shape)
    low_m, high_m = profile.macro.travel_m
    middle_m, span_m = 0.5 * (low_m + high_m), high_m - low_m
    dt_s = profile.cycle.period_s
    if kind == "file":
        return trajectories.from_file(Path(trajectory), dt_s)
    speed = min(0.2, 0.8 * profile.macro.velocity_limit_m_per_s)
    if kind == "trapezoid":
        stroke_m = _or(shape.stroke_m, min(0.8, _TRAVEL_SHARE * span_m))
        longest_s = trajectories.ROWS_MAX_COUNT * dt_s / 4.0  # four stretches: there, rest, back, rest
        if shape.velocity_m_per_s is not None and not abs(stroke_m) / shape.velocity_m_per_s < longest_s:
            raise RequestError(
                f"--velocity-m-per-s is {shape.velocity_m_per_s:g}: {abs(stroke_m):g} m take "
                f"{abs(stroke_m) / shape.velocity_m_per_s:.3g} s, {longest_s:g} s is the limit; give a higher speed"
            )
        return trajectories.trapezoid(
            stroke_m,
            _or(shape.velocity_m_per_s, speed),
            dwell_s=_or(shape.dwell_s, 1.0),
            dt_s=dt_s,
            start_m=_or(shape.start_m, middle_m - 0.5 * stroke_m),
        )
    amplitude_m = _or(shape.amplitude_m, min(0.4, 0.5 * _TRAVEL_SHARE * span_m))
    frequency_hz = _or(shape.frequency_hz, speed / (2.0 * math.pi * amplitude_m))
    highest_hz = profile.cycle.rate_hz / _SETPOINTS_PER_PERIOD
    if shape.frequency_hz is None and not frequency_hz <= highest_hz:
        raise RequestError(
            f"--amplitude-m is {amplitude_m:g}: at {speed:g} m/s its frequency would be {frequency_hz:.3g} Hz, "
            f"{highest_hz:g} Hz is the limit; give a larger amplitude, or --frequency-hz"
        )
    period_s = 1.0 / frequency_hz
    duration_s = _or(shape.duration_s, 3.0 * period_s)
    if shape.duration_s is None and not duration_s / dt_s < trajectories.ROWS_MAX_COUNT:
        raise RequestError(
            f"--frequency-hz is {frequency_hz:g}: three periods take {duration_s:.3g} s, "
            f"{trajectories.ROWS_MAX_COUNT * dt_s:g} s is the limit; give a higher frequency"
        )
    if not duration_s >= 2.0 * period_s:
        raise RequestError(
            f"--duration-s is {duration_s:g}: the ramps at both ends take a period each, {2.0 * period_s:g} s; "
            "give a longer duration or a higher --frequency-hz"
        )
    return trajectories.sine(amplitude_m, 2.0 * math.pi * frequency_hz, duration_s, _or(shape.start_m, middle_m), dt_s)


def _check_options(profile: Profile, shape: Shape) -> None:
    """Refuse, by its name, an option that no stage of this profile can follow; nan fits nowhere."""
    macro, rate_hz = profile.macro, profile.cycle.rate_hz
    low_m, high_m = macro.travel_m
    travel = f"the travel of {profile.name} is [{low_m:g}, {high_m:g}] m"
    longest_s = trajectories.ROWS_MAX_COUNT / rate_hz
    highest_hz = rate_hz / _SETPOINTS_PER_PERIOD
    limits = {
        "stroke_m": (lambda v: 0.0 < abs(v) <= high_m - low_m, f"{travel}; give a distance within it, not 0"),
        "velocity_m_per_s": (
            lambda v: 0.0 < v <= macro.velocity_limit_m_per_s,
            f"the limit of {profile.name} is {macro.velocity_limit_m_per_s:g} m/s; give a speed above 0 up to it",
        ),
        "dwell_s": (lambda v: 0.0 <= v < longest_s / 4.0, f"give 0 or more, below {longest_s / 4.0:g} s"),
        "start_m": (lambda v: low_m <= v <= high_m, f"{travel}; give a position within it"),
        "amplitude_m": (lambda v: 0.0 < 2.0 * v <= high_m - low_m, f"{travel}; give a swing above 0 within it"),
        "frequency_hz": (
            lambda v: 0.0 < v <= highest_hz,
            f"setpoints come at {rate_hz:g} Hz, and a period needs {_SETPOINTS_PER_PERIOD} of them or it is another "
            f"motion; give a frequency above 0 up to {highest_hz:g} Hz",
        ),
        "duration_s": (lambda v: 0.0 < v < longest_s, f"give a time above 0, below {longest_s:g} s"),
    }
    for key, (fits, remedy) in limits.items():
        value = getattr(shape, key)
        if value is not None and not fits(value):
            raise RequestError(f"--{key.replace('_', '-')} is {value:g}: {remedy}")


def _or(given: float | None, otherwise: float) -> float:
    return otherwise if given is None else given
