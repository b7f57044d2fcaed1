"""What an error of a sensor does: to its readings, and to the joint's forces that are taken at a wrong place. Pure."""

import numpy as np

from stagectl.effects import Effect, Trait
from stagectl.gap.command_path import PARTS_COUNT
from stagectl.gap.contact import contact_at
from stagectl.gap.forces import Forces
from stagectl.gap.quantities import along_motion, quantities
from stagectl.gap.recording import Recording, contact_push_n, relative_motion

_READING_PASSES = 2

SMALL_M = 1e-9
"""Shift of an edge that slopes are taken over."""


def reading_error_m(
    recording: Recording, effect: Effect, place: str, parameters: list[float], whole: bool
) -> np.ndarray:
    """Return what a sensor effect adds to the readings, shape (n, 1); `whole`: along the motion without the error."""
    axis = "macro" if place.startswith("macro") else "end"
    known = quantities(recording, axis, place)
    if Trait.FIRST_ORDER in effect.traits:
        return _mean_error_m(effect, known, parameters)
    error_m = along_motion(effect, [known[name] for name in effect.quantities], parameters)
    if not whole:
        return error_m
    for _ in range(_READING_PASSES):
        true = known | {
            "position_m": known["position_m"] - error_m,
            "velocity_m_per_s": known["velocity_m_per_s"] - np.gradient(error_m, recording.log.period_s, axis=0),
        }
        error_m = along_motion(effect, [true[name] for name in effect.quantities], parameters)
    return error_m


_POINTS = ((0.0, 2.0 / 3.0), (-np.sqrt(3.0), 1.0 / 6.0), (np.sqrt(3.0), 1.0 / 6.0))  # Gauss, Hermite; share of each


def _mean_error_m(effect: Effect, known: dict[str, np.ndarray], parameters: list[float]) -> np.ndarray:
    """Return an error's mean over all places where the body may be: beside 26 nm of noise 15.0 nm came out as 14.3."""
    total = np.zeros_like(known["position_m"])
    for place, share in _POINTS:
        there = known | {"position_m": known["position_m"] + place * known["position_sd_m"]}
        total += share * along_motion(effect, [there[name] for name in effect.quantities], parameters)
    return total


def moved_m(recording: Recording, effect: Effect, place: str, values: dict[str, float]) -> float:
    """Return by how much an effect moves a reading or an edge at most, m."""
    known = quantities(recording, "macro" if place.startswith("macro") else "end", place)
    moved = along_motion(effect, [known[name] for name in effect.quantities], [values[n] for n in effect.parameters])
    return float(np.max(np.abs(moved)))


def misread(recording: Recording, axis: str, error_m: np.ndarray, whole: bool) -> Forces:
    """Return what a sensor error does: to the position, and to the joint's forces that were taken at a wrong place."""
    sampled_m = np.ascontiguousarray(error_m[:, 0])
    joint, end = recording.believed.joint, recording.end
    forces = Forces(macro_sensor_m=sampled_m) if axis == "macro" else Forces(end_sensor_m=sampled_m)
    if joint is None or end is None or recording.side is None:
        return forces
    away_m = error_m if axis == "end" else -error_m  # by which end minus macro is read too large
    if whole:
        fine_m = _between_samples(sampled_m if axis == "end" else -sampled_m, PARTS_COUNT)
        slope = np.gradient(fine_m.ravel(), recording.log.period_s / PARTS_COUNT).reshape(fine_m.shape)
        spring_n = joint.spring_n_per_m * fine_m + joint.damping_n_s_per_m * slope
        forces.end_n = spring_n + more_contact_n(recording, fine_m, slope)
    else:
        slope_n_per_m = joint.spring_n_per_m + more_contact_n(recording, SMALL_M, 0.0) / SMALL_M
        forces.end_n = slope_n_per_m * _between_samples(away_m[:, 0], PARTS_COUNT)
    forces.macro_n = -forces.end_n
    return forces


def _between_samples(values: np.ndarray, parts: int) -> np.ndarray:
    """Put values at samples on the middles of parts of the intervals that they begin, on straight lines."""
    share = (np.arange(parts) + 0.5) / parts
    following = np.concatenate([values[1:], values[-1:]])
    return values[:, None] + share[None, :] * (following - values)[:, None]


def more_contact_n(
    recording: Recording,
    apart_m: np.ndarray | float,
    apart_m_per_s: np.ndarray | float,
    left_out_m: np.ndarray | float = 0.0,
    right_out_m: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return by how much the contact pushes the end more with x_b larger by `apart_m`, and edges moved outward."""
    joint = recording.believed.joint
    if recording.end is None or joint is None:
        raise KeyError("joint")
    x_b, x_b_rate = relative_motion(recording)
    damping = recording.contact_damping_n_s_per_m
    left_m, right_m = recording.edges_out_m
    part_s = recording.log.period_s / x_b.shape[1]
    there = contact_at(
        joint, damping, x_b + apart_m, x_b_rate + apart_m_per_s, part_s, left_m + left_out_m, right_m + right_out_m
    )
    return there.push_n(joint, damping) - contact_push_n(recording, damping)
