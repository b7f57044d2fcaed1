"""What a law may ask for at a place of the machine, and a law run along it. Pure."""

from collections.abc import Callable

import numpy as np

from stagectl import compose
from stagectl.effects import Effect
from stagectl.gap.contact import side_stiffness_n_per_m
from stagectl.gap.interval_parts import PARTS_COUNT
from stagectl.gap.motion import way_per_s
from stagectl.gap.recording import Recording, relative_motion


def quantities(recording: Recording, axis: str, place: str) -> dict[str, np.ndarray]:
    """Everything that a law at one place may ask for, on parts of intervals."""
    known, made = _known(recording, axis, place)
    for name, make in made.items():
        if name not in known:
            known[name] = make()
    return known


def arguments_of(recording: Recording, axis: str, place: str, effect: Effect) -> list[np.ndarray]:
    """Return what an effect asks for, in its order; nothing else is made: recordings that are late live for one law."""
    known, made = _known(recording, axis, place)
    names = list(effect.quantities)
    if effect.memory:
        names = [_QUIET[name] if _QUIET.get(name) in made else name for name in names]
    for name in names:
        if name not in known:
            known[name] = made[name]()
    return [known[name] for name in names]


_QUIET_VELOCITY, _QUIET_CLOSING = "quiet_m_per_s", "quiet_penetration_m_per_s"
_QUIET = {"velocity_m_per_s": _QUIET_VELOCITY, "penetration_velocity_m_per_s": _QUIET_CLOSING}
"""What a law with a memory is given for its velocity: bristles lose what they hold by the amount of the way that they
are moved, and where a stage sticks that of the noise is larger than all of it (3.1 um in half a second, of 0.2). A
contact that is held is turned so at any speed: of a loss of 0.226, beside readings of 14 and 24 nm, 0.19 was found, and
4200 squares of 27 300 left."""


def _known(
    recording: Recording, axis: str, place: str
) -> tuple[dict[str, np.ndarray], dict[str, Callable[[], np.ndarray]]]:
    """Return what is known at one place already, and how all of it is made."""
    kind = "joint" if place == "joint" else "sensor" if place.endswith("_sensor") else "force"
    known = recording.known.setdefault((axis, kind), {})
    if kind != "sensor":
        return known, _made(recording, axis, kind)
    if not known:
        known |= _of_sensor(recording, axis)
    return known, {}


def _made(recording: Recording, axis: str, kind: str) -> dict[str, Callable[[], np.ndarray]]:
    """Return how everything at a place of forces is made, on parts of intervals."""
    motion, h = recording.motion(axis), recording.log.period_s

    def all_over(value: float) -> np.ndarray:
        return np.full_like(motion.position_m, value)

    def apart(which: int) -> np.ndarray:
        return -relative_motion(recording)[which] if recording.end is not None else all_over(0.0)

    def times_s() -> np.ndarray:
        middles_s = (np.arange(PARTS_COUNT) + 0.5)[None, :] / PARTS_COUNT * h
        return recording.log.start_s + recording.log.times_s[:, None] + middles_s

    motor_n, micro_n = recording.felt_n[axis], recording.micro_motor_n
    made: dict[str, Callable[[], np.ndarray]] = {
        "position_m": lambda: apart(0) if kind == "joint" else motion.position_m,
        "velocity_m_per_s": lambda: apart(1) if kind == "joint" else motion.velocity_m_per_s,
        _QUIET_VELOCITY: lambda: apart(1) if kind == "joint" else motion.quiet_m_per_s,
        "acceleration_m_per_s2": lambda: motion.acceleration_m_per_s2,
        "relative_position_m": lambda: apart(0),
        "relative_velocity_m_per_s": lambda: apart(1),
        "motor_force_n": lambda: motor_n,
        "current_a": lambda: motor_n / recording.force_constant_n_per_a(axis),
        "micro_motor_force_n": lambda: all_over(0.0) if micro_n is None else micro_n,
        "mass_kg": lambda: all_over(recording.mass_kg(axis)),
        "t_s": times_s,
        "dt_s": lambda: all_over(h / PARTS_COUNT),
    }
    joint, side = recording.believed.joint, recording.side
    depth_m, rate_m_per_s = recording.penetration_m, recording.penetration_velocity_m_per_s
    if joint is not None and side is not None and depth_m is not None and rate_m_per_s is not None:
        made |= {
            "penetration_m": lambda: depth_m,
            "penetration_velocity_m_per_s": lambda: rate_m_per_s,
            _QUIET_CLOSING: lambda: _closing_way_per_s(recording, side),
            "contact_side_ratio": lambda: side,
            "contact_stiffness_n_per_m": lambda: side_stiffness_n_per_m(joint, side),
        }
    return made


_STOPS_RATIO = 0.5
"""Of the joint's noise, half the play that it is carried with: smoothed, it scatters by nine tenths of that."""


def _closing_way_per_s(recording: Recording, side: np.ndarray) -> np.ndarray:
    """Return how fast the joint closes beyond what its readings scatter by, late as they are, on parts of intervals."""
    noise_m = float(np.hypot(recording.belief("macro").noise_m, recording.belief("end").noise_m))
    late_m = relative_motion(recording)[0] - (recording.macro.position_m - recording.motion("end").position_m)
    read_m = recording.position_m("macro") - recording.position_m("end") + late_m[:, 0]
    return side * way_per_s(read_m, _STOPS_RATIO * noise_m, recording.log.period_s)[:, None]


def _of_sensor(recording: Recording, axis: str) -> dict[str, np.ndarray]:
    """Return everything at a sensor. A reading is of the sample's instant: one column, not parts of intervals."""
    motion, log = recording.motion(axis), recording.log
    known = {name: _at_samples(make()) for name, make in _made(recording, axis, "sensor").items()}
    for place, name in enumerate(("position_m", "velocity_m_per_s", "acceleration_m_per_s2")):
        known[name] = motion.at_samples[:, place : place + 1]
    place_m, sd_m = _at_readings(recording, axis)
    return known | {
        AT_READING: place_m[:, None],
        AT_READING_SD: sd_m[:, None],
        "t_s": (log.start_s + log.times_s)[:, None],
        "dt_s": np.full((log.samples_count, 1), log.period_s),
    }


AT_READING, AT_READING_SD = "position_at_reading_m", "position_at_reading_sd_m"
"""Where a body is at a sample, by that sample too, and how surely: for errors that repeat within what a foretold place
is uncertain by. Every other error is taken at the place foretold: taken where the sample itself says, a scale error of
234 ppm made readings and their noise smaller by so much, and left 32 squares less as one of the macro's sensor than as
the one of the end's that it was, from which nobody can tell it; foretold, both leave the same to 0.001."""

_MOVED_NOISES = 10.0
"""Way from sample to sample, over the sensor's noise, beyond which a sample may say where it was taken: where a stage
stands the noise of its readings would be explained by itself."""


def _at_readings(recording: Recording, axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Return where a body is at the samples, and how surely: as foretold, or with the sample where that knows better.

    An error that repeats every 0.3 um puts the foretold place 0.1 um off: 17.9 nm came out as 2.7 nm. So it is until
    the sensor's error is known, and where what pushes the body is too little known to foretell it as well as it is
    read: beside forces of 50 N that nobody knew an error of 16.8 nm every 158 nm, of a sensor with 1.2 nm of noise, was
    taken out at places that were known to 28 nm, half of it, and was nothing in the closer look.
    """
    motion, found = recording.motion(axis), recording.found
    foretold_m, rate_m_per_s, _ = motion.at_samples.T
    error_m = found.macro_sensor_m if axis == "macro" else found.end_sensor_m
    way_m = np.abs(rate_m_per_s) * recording.log.period_s
    noise_m = recording.belief(axis).noise_m
    moves = ((error_m is None) | (motion.sds_m[:, 0] > noise_m)) & (way_m > _MOVED_NOISES * noise_m)
    return np.where(moves, motion.known_m, foretold_m), np.where(moves, motion.sds_m[:, 1], motion.sds_m[:, 0])


def in_order(effect: Effect, values: dict[str, float]) -> list[float]:
    return [values[name] for name in effect.parameters]


def _at_samples(fine: np.ndarray) -> np.ndarray:
    """Bring values at middles of parts back to the instants that begin the intervals, shape (n, 1)."""
    ends = np.concatenate([fine[:1, 0], 0.5 * (fine[1:, 0] + fine[:-1, -1])])
    return ends[:, None]


def along_motion(effect: Effect, arguments: list[np.ndarray], parameters: list[float]) -> np.ndarray:
    """Run a law in time order over arrays of its quantities, all of shape (n, parts); shape kept."""
    columns = tuple(np.require(values, np.float64, ["C", "W"]).ravel() for values in arguments)
    memory = np.zeros(max(effect.memory, 1))
    out = compose.along_one_machine(effect)(columns, np.array([*parameters, 0.0]), memory)
    return np.asarray(out).reshape(arguments[0].shape)
