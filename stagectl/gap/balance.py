"""The balance of forces on each body along the measured motion, and what is left of it, whitened.

Forces of spring, damping and contact are taken on the measured relative position (30 nm on 13 N/mm is 0.4 mN), so the
bodies fall apart into one mass each: `stagectl.gap.innovations` whitens them one by one. Pure.
"""

import numpy as np

from stagectl.gap import innovations
from stagectl.gap.believed import Believed
from stagectl.gap.effect_forces import known_forces
from stagectl.gap.forces import Forces
from stagectl.gap.innovations import Noise
from stagectl.gap.late_readings import Row
from stagectl.gap.log import Log
from stagectl.gap.motion import Motion, motion_of, motion_under
from stagectl.gap.recording import AXES, EdgesOut, Recording, put_together

_SETTLE_S = 0.3  # the filter forgets how it began


_ENDING_S = 0.01  # where a late sensor would still have read is not recorded


_LOOSE_N = 1e3


def recording_of(
    log: Log,
    believed: Believed,
    at_size: tuple[Row, ...] = (),
    late: tuple[Row, ...] = (),
    edges_out_m: EdgesOut = (0.0, 0.0),
) -> Recording:
    """Prepare a log: motion, commands on parts of intervals, contact geometry.

    at_size, late, edges_out_m: effects of command path and contact, of readings that are late, and what has become of
    the edges, beside what is believed.
    """
    macro = motion_of(log.macro_position_m, log.period_s, believed.macro.noise_m)
    rough = put_together(log, believed, macro, None, at_size, late, edges_out_m)
    return foretold_under(rough, known_forces(rough))


def foretold_under(
    recording: Recording, forces: Forces, found: Forces | None = None, found_reaction_ratio: float = 0.0
) -> Recording:
    """Return a recording with the motion that follows from its past, forces and sensor errors that are thought to act.

    found: what of these drives a share of the mass that swings, besides what is believed; found_reaction_ratio: the
    share of whatever changes the micro's motor force that pushes the macro back, besides what is believed.
    """
    log, believed = recording.log, recording.believed
    motions: list[Motion | None] = [None, None]
    errors_m = forces.macro_sensor_m, forces.end_sensor_m
    for k, (axis, force_n) in enumerate(zip(AXES, (forces.macro_n, forces.end_n), strict=True)):
        if axis in recording.axes and force_n is not None:
            read_m, error_m = recording.position_m(axis), errors_m[k]
            motions[k] = motion_under(
                recording.motion(axis), read_m if error_m is None else read_m - error_m, log.valid, force_n,
                recording.mass_kg(axis), log.period_s, recording.belief(axis).noise_m,
            )  # fmt: skip
    there = put_together(
        log, believed, motions[0] or recording.macro, motions[1],
        recording.at_size, recording.late, recording.edges_out_m,
    )  # fmt: skip
    there.found = recording.found if found is None else found
    there.found_reaction_ratio = found_reaction_ratio
    return there


def set_noise(recording: Recording, noise: dict[str, Noise], mask_slow: bool = True) -> None:
    """Build the whitening filters; samples at which a sign of velocity can't be trusted are let loose."""
    log = recording.log
    for axis in recording.axes:
        level = noise[axis]
        motion = recording.motion(axis)
        loose = motion.slow if mask_slow else np.zeros(log.samples_count, bool)
        gain, variance = innovations.gains(
            log.valid, loose, recording.mass_kg(axis), log.period_s, level.sensor_m, level.force_n,
            level.corner_rad_per_s, level.white_force_n, _LOOSE_N,
        )  # fmt: skip
        recording.filters[axis] = (
            level,
            innovations.filter_steps(gain, variance, recording.mass_kg(axis), log.period_s, level.corner_rad_per_s),
        )
        judged = log.valid & ~np.concatenate([[False], loose[:-1]])
        judged[: round(_SETTLE_S / log.period_s)] = False
        judged[max(log.samples_count - round(_ENDING_S / log.period_s), 0) :] = False
        recording.judged[axis] = judged


_NO_FORCE_N, _NO_POSITION_M = np.empty((0, 0)), np.empty(0)


def whitened(
    recording: Recording, axis: str, force_n: np.ndarray | None, position_m: np.ndarray | None, sign: float = 1.0
) -> np.ndarray:
    """Return innovations of one body under `sign` times forces and from positions, at judged samples, shape (m,)."""
    level, steps = recording.filters[axis]
    return innovations.innovations(
        _NO_POSITION_M if position_m is None else np.ascontiguousarray(position_m),
        _NO_FORCE_N if force_n is None else np.ascontiguousarray(force_n), sign, steps,
        recording.judged[axis], recording.mass_kg(axis), recording.log.period_s, level.corner_rad_per_s,
        0.0 if position_m is None else float(position_m[0]),
    )  # fmt: skip


def channels(recording: Recording) -> list[tuple[str, int]]:
    """Return (name, rows) of each part of a column: innovations of the bodies, then what their drives report."""
    bodies = [(axis, int(recording.judged[axis].sum())) for axis in recording.axes]
    return bodies + [(f"{axis}_current", int(_settled(recording).sum())) for axis in recording.reported_a]


def observed(recording: Recording) -> list[np.ndarray]:
    """Return the innovations of all channels under what is believed."""
    known = known_forces(recording)
    parts = [
        whitened(recording, axis, known.macro_n if axis == "macro" else known.end_n, recording.position_m(axis))
        for axis in recording.axes
    ]
    for axis, reported_a in recording.reported_a.items():
        known_a = known.macro_current_a if axis == "macro" else known.end_current_a
        parts.append(_scaled(recording, axis, reported_a if known_a is None else reported_a - known_a))
    return parts


def unexplained(recording: Recording, forces: Forces) -> list[np.ndarray]:
    """Return the innovations of all channels under what is believed and under more forces."""
    columns = column(recording, forces)
    return [z if part is None else z - part for z, part in zip(observed(recording), columns, strict=True)]


def column(recording: Recording, forces: Forces) -> list[np.ndarray | None]:
    """Return what forces and errors that the filter knows nothing of add to the innovations, by channel; None is 0."""
    parts: list[np.ndarray | None] = []
    for axis, force_n, sensor_m in (
        ("macro", forces.macro_n, forces.macro_sensor_m),
        ("end", forces.end_n, forces.end_sensor_m),
    ):
        if axis in recording.axes:
            is_nothing = all(values is None or innovations.is_nothing(values) for values in (force_n, sensor_m))
            parts.append(None if is_nothing else whitened(recording, axis, force_n, sensor_m, sign=-1.0))
    for axis in recording.reported_a:
        current_a = forces.macro_current_a if axis == "macro" else forces.end_current_a
        parts.append(None if current_a is None else _scaled(recording, axis, current_a))
    return parts


def _settled(recording: Recording) -> np.ndarray:
    """Tell at which samples reported currents count."""
    judged = recording.log.valid.copy()
    judged[: round(_SETTLE_S / recording.log.period_s)] = False
    return judged


def _scaled(recording: Recording, axis: str, current_a: np.ndarray) -> np.ndarray:
    noise_a = recording.belief(axis).current_noise_a
    if noise_a is None:
        raise KeyError(axis)
    return (current_a / noise_a)[_settled(recording)]
