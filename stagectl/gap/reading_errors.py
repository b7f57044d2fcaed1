"""What an error of a sensor does: to its readings, and to the joint's forces that are taken at a wrong place. Pure."""

import numpy as np

from stagectl.compiled import compiled
from stagectl.effects import Effect, Trait
from stagectl.gap.contact import more_push_n
from stagectl.gap.forces import Forces
from stagectl.gap.interval_parts import PARTS_COUNT
from stagectl.gap.quantities import AT_READING, AT_READING_SD, along_motion, quantities
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
    asked = {"position_m", "velocity_m_per_s"}.intersection(effect.quantities)
    if not whole or not asked:
        return error_m
    for _ in range(_READING_PASSES):
        true = known | {"position_m": known["position_m"] - error_m}
        if "velocity_m_per_s" in asked:
            true["velocity_m_per_s"] = known["velocity_m_per_s"] - np.gradient(error_m, recording.log.period_s, axis=0)
        error_m = along_motion(effect, [true[name] for name in effect.quantities], parameters)
    return error_m


_POINTS = ((0.0, 2.0 / 3.0), (-np.sqrt(3.0), 1.0 / 6.0), (np.sqrt(3.0), 1.0 / 6.0))  # Gauss, Hermite; share of each


def _mean_error_m(effect: Effect, known: dict[str, np.ndarray], parameters: list[float]) -> np.ndarray:
    """Return an error's mean over all places where the body may be: beside 26 nm of noise 15.0 nm came out as 14.3."""
    total = np.zeros_like(known["position_m"])
    for place, share in _POINTS:
        there = known | {"position_m": known[AT_READING] + place * known[AT_READING_SD]}
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
        fine_m, slope = _on_parts(sampled_m if axis == "end" else -sampled_m, recording.log.period_s)
        more_n = more_contact_n(recording, fine_m, slope)
        forces.end_n = _sprung_more_n(joint.spring_n_per_m, fine_m, joint.damping_n_s_per_m, slope, more_n)
    else:
        slope_n_per_m = joint.spring_n_per_m + more_contact_n(recording, SMALL_M, 0.0) / SMALL_M
        forces.end_n = slope_n_per_m * _on_parts(away_m[:, 0], recording.log.period_s)[0]
    forces.macro_n = -forces.end_n
    return forces


@compiled
def _on_parts(values: np.ndarray, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Put values at samples on parts of the intervals that they begin, on straight lines, (n, parts); and their rate.

    The rate is that of central differences; here in one pass: a search does it a thousand times.
    """
    n = values.size
    fine, rate = np.empty((n, PARTS_COUNT)), np.empty((n, PARTS_COUNT))
    for k in range(n):
        following = values[min(k + 1, n - 1)]
        for part in range(PARTS_COUNT):
            fine[k, part] = values[k] + (part + 0.5) / PARTS_COUNT * (following - values[k])
    line, slope, step_s = fine.reshape(-1), rate.reshape(-1), period_s / PARTS_COUNT
    slope[0], slope[-1] = (line[1] - line[0]) / step_s, (line[-1] - line[-2]) / step_s
    for j in range(1, line.size - 1):
        slope[j] = (line[j + 1] - line[j - 1]) / (2.0 * step_s)
    return fine, rate


@compiled
def _sprung_more_n(
    spring_n_per_m: float, apart_m: np.ndarray, damping_n_s_per_m: float, apart_m_per_s: np.ndarray, more_n: np.ndarray
) -> np.ndarray:
    """Return what spring and damping do, and more, shapes (n, parts)."""
    return spring_n_per_m * apart_m + damping_n_s_per_m * apart_m_per_s + more_n


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
    return more_push_n(
        joint, damping, x_b, x_b_rate, part_s, apart_m, apart_m_per_s, left_m + left_out_m, right_m + right_out_m,
        contact_push_n(recording, damping),
    )  # fmt: skip
