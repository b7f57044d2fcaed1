"""What a law may ask for at a place of the machine, and a law run along it. Pure."""

import numpy as np

from stagectl import compose
from stagectl.effects import Effect
from stagectl.gap.command_path import PARTS_COUNT
from stagectl.gap.contact import side_stiffness_n_per_m
from stagectl.gap.recording import Recording, relative_motion


def quantities(recording: Recording, axis: str, place: str) -> dict[str, np.ndarray]:
    """Everything that a law at one place may ask for, on parts of intervals."""
    kind = "joint" if place == "joint" else "sensor" if place.endswith("_sensor") else "force"
    key = (axis, kind)
    if key not in recording.known:
        recording.known[key] = _quantities(recording, axis, kind)
    return recording.known[key]


def _quantities(recording: Recording, axis: str, kind: str) -> dict[str, np.ndarray]:
    motion = recording.motion(axis)
    h = recording.log.period_s
    whole = np.ones_like(motion.position_m)
    x_b, x_b_rate = relative_motion(recording) if recording.end is not None else (0.0 * whole, 0.0 * whole)
    relative_m, relative_m_per_s = -x_b, -x_b_rate
    motor_n = recording.felt_n[axis]
    known = {
        "position_m": relative_m if kind == "joint" else motion.position_m,
        "velocity_m_per_s": relative_m_per_s if kind == "joint" else motion.velocity_m_per_s,
        "acceleration_m_per_s2": motion.acceleration_m_per_s2,
        "relative_position_m": relative_m,
        "relative_velocity_m_per_s": relative_m_per_s,
        "motor_force_n": motor_n,
        "current_a": motor_n / recording.force_constant_n_per_a(axis),
        "micro_motor_force_n": 0.0 * whole if recording.micro_command_n is None else recording.micro_command_n,
        "mass_kg": recording.mass_kg(axis) * whole,
        "t_s": recording.log.start_s
        + recording.log.times_s[:, None]
        + (np.arange(PARTS_COUNT) + 0.5)[None, :] / PARTS_COUNT * h,
        "dt_s": h / PARTS_COUNT * whole,
    }
    if kind == "sensor":  # a reading is of the sample's instant: one column, where all else has parts of intervals
        known = {name: _at_samples(values) for name, values in known.items()}
        for place, name in enumerate(("position_m", "velocity_m_per_s", "acceleration_m_per_s2")):
            known[name] = motion.at_samples[:, place : place + 1]
        place_m, sd_m = _at_readings(recording, axis)
        known |= {
            "position_m": place_m[:, None],
            "position_sd_m": sd_m[:, None],
            "t_s": (recording.log.start_s + recording.log.times_s)[:, None],
            "dt_s": np.full((recording.log.samples_count, 1), h),
        }
        return known
    joint = recording.believed.joint
    if joint is not None and recording.side is not None:
        known["penetration_m"] = recording.penetration_m
        known["penetration_velocity_m_per_s"] = recording.penetration_velocity_m_per_s
        known["contact_side_ratio"] = recording.side
        known["contact_stiffness_n_per_m"] = side_stiffness_n_per_m(joint, recording.side)
    return known


_MOVED_NOISES = 10.0
"""Way from sample to sample, over the sensor's noise, beyond which a sample may say where it was taken: where a stage
stands the noise of its readings would be explained by itself."""


def _at_readings(recording: Recording, axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Return where a body is at the samples, and how surely: as foretold; until its sensor's error is known with them.

    An error that repeats every 0.3 um puts the foretold place 0.1 um off: 17.9 nm came out as 2.7 nm.
    """
    motion, found = recording.motion(axis), recording.found
    foretold_m, rate_m_per_s, _ = motion.at_samples.T
    error_m = found.macro_sensor_m if axis == "macro" else found.end_sensor_m
    way_m = np.abs(rate_m_per_s) * recording.log.period_s
    moves = (error_m is None) & (way_m > _MOVED_NOISES * recording.belief(axis).noise_m)
    return np.where(moves, motion.known_m, foretold_m), np.where(moves, motion.sds_m[:, 1], motion.sds_m[:, 0])


def in_order(effect: Effect, values: dict[str, float]) -> list[float]:
    return [values[name] for name in effect.parameters]


def _at_samples(fine: np.ndarray) -> np.ndarray:
    """Bring values at middles of parts back to the instants that begin the intervals, shape (n, 1)."""
    ends = np.concatenate([fine[:1, 0], 0.5 * (fine[1:, 0] + fine[:-1, -1])])
    return ends[:, None]


def along_motion(effect: Effect, arguments: list[np.ndarray], parameters: list[float]) -> np.ndarray:
    """Run a law in time order over arrays of its quantities, all of shape (n, parts); shape kept."""
    flat = [np.ascontiguousarray(values).ravel() for values in arguments]
    columns = flat[0][:, None] if len(flat) == 1 else np.column_stack(flat)
    memory = np.zeros(max(effect.memory, 1))
    out = compose.along(effect)(columns, np.array([*parameters, 0.0]), memory)
    return np.asarray(out).reshape(arguments[0].shape)
