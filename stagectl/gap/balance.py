"""The balance of forces on each body along the measured motion, and what is left of it, whitened.

Forces of spring, damping and contact are taken on the measured relative position (30 nm on 13 N/mm is 0.4 mN), so the
bodies fall apart into one mass each: `stagectl.gap.innovations` whitens them one by one. Pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.interpolate import CubicSpline

from stagectl import compose
from stagectl.effects import CATALOGUE, Effect, Trait
from stagectl.gap import innovations
from stagectl.gap.believed import Believed, BelievedAxis, BelievedJoint
from stagectl.gap.command_path import PARTS_COUNT, changed_by, delayed, driven
from stagectl.gap.contact import CONTACT_DAMPING, Contact, contact_at, contact_damping_n_s_per_m, side_stiffness_n_per_m
from stagectl.gap.innovations import Noise
from stagectl.gap.log import Log
from stagectl.gap.motion import Motion, motion_of, motion_under

AXES = ("macro", "end")
"""Bodies; the second one is the micro's, its position the end's."""

_SETTLE_S = 0.3  # the filter forgets how it began
_ENDING_S = 0.01  # where a late sensor would still have read is not recorded
_LOOSE_N = 1e3
_READING_PASSES = 2

Moved = tuple[Effect, str, dict[str, float]]
"""An effect that moves the joint's geometry or the readings, its place, its parameters."""


@dataclass(slots=True)
class Forces:
    """What acts on the bodies on parts of intervals, and what the sensors add; None is nothing."""

    macro_n: np.ndarray | None = None
    end_n: np.ndarray | None = None
    macro_sensor_m: np.ndarray | None = None
    end_sensor_m: np.ndarray | None = None
    macro_current_a: np.ndarray | None = None  # at the samples, shape (n,)
    end_current_a: np.ndarray | None = None


@dataclass(slots=True)
class Recording:
    """One log with all that does not depend on a hypothesis."""

    log: Log
    believed: Believed
    macro: Motion
    end: Motion | None
    macro_command_n: np.ndarray
    micro_command_n: np.ndarray | None
    penetration_m: np.ndarray | None
    penetration_velocity_m_per_s: np.ndarray | None
    side: np.ndarray | None
    filters: dict[str, tuple[Noise, np.ndarray, np.ndarray]]
    judged: dict[str, np.ndarray]
    known: dict[tuple[str, str], dict[str, np.ndarray]]  # quantities by axis and kind of place, once asked for
    reported_a: dict[str, np.ndarray]  # reported minus believed current at the samples, by axis, where it is known

    @property
    def axes(self) -> tuple[str, ...]:
        """Bodies that this log has."""
        return AXES if self.end is not None else AXES[:1]

    @property
    def reaction_ratio(self) -> float:
        """Share of the micro's motor force that is believed to push the macro back."""
        return sum(row["fraction_ratio"] for row in self.believed.effects if row["name"] == "micro_reaction")

    def motion(self, axis: str) -> Motion:
        """Motion of one body."""
        motion = self.macro if axis == "macro" else self.end
        if motion is None:
            raise KeyError(axis)
        return motion

    def position_m(self, axis: str) -> np.ndarray:
        """Measured position of one body."""
        position = self.log.macro_position_m if axis == "macro" else self.log.end_position_m
        if position is None:
            raise KeyError(axis)
        return position

    def belief(self, axis: str) -> BelievedAxis:
        """What is believed of one body and its motor."""
        if axis == "macro" or self.believed.micro is None:
            return self.believed.macro
        return self.believed.micro

    def mass_kg(self, axis: str) -> float:
        """Believed mass of one body with what it carries."""
        payload_kg = self.log.macro_payload_kg if axis == "macro" else self.log.end_payload_kg
        return self.belief(axis).mass_kg + payload_kg

    def force_constant_n_per_a(self, axis: str) -> float:
        """Believed force constant of one motor."""
        return self.belief(axis).force_constant_n_per_a

    def held_command_n(self, axis: str) -> np.ndarray:
        """Commanded force as the drive holds it, before its current loop, shape (n, parts)."""
        command_n = self.log.macro_command_n if axis == "macro" else self.log.micro_command_n
        if command_n is None:
            return np.zeros_like(self.macro.position_m)
        return delayed(command_n, self.belief(axis).latch_s / self.log.period_s)


def recording_of(log: Log, believed: Believed) -> Recording:
    """Prepare a log: motion, commands on parts of intervals, contact geometry."""
    rough = _recording(log, believed, motion_of(log.macro_position_m, log.period_s, believed.macro.noise_m), None)
    return foretold_under(rough, known_forces(rough))


def foretold_under(recording: Recording, forces: Forces) -> Recording:
    """Return a recording with the motion that follows from its past and from the forces that are thought to act."""
    log, believed = recording.log, recording.believed
    motions: list[Motion | None] = [None, None]
    for k, (axis, force_n) in enumerate(zip(AXES, (forces.macro_n, forces.end_n), strict=True)):
        if axis in recording.axes and force_n is not None:
            motions[k] = motion_under(
                recording.motion(axis), recording.position_m(axis), log.valid, force_n, recording.mass_kg(axis),
                log.period_s, recording.belief(axis).noise_m,
            )  # fmt: skip
    return _recording(log, believed, motions[0] or recording.macro, motions[1])


def _recording(log: Log, believed: Believed, macro: Motion, end: Motion | None) -> Recording:
    """Put together what is known along a motion; without one of the end, its own is made of the positions alone."""
    h = log.period_s
    macro_n, macro_at_n = driven(log.macro_command_n, believed.macro.latch_s, believed.macro.current_loop_s, h)
    at_samples_n = {"macro": macro_at_n}
    micro_n = depth = depth_rate = side = None
    if log.end_position_m is not None and log.micro_command_n is not None and believed.micro is not None:
        end = end or motion_of(log.end_position_m, h, believed.micro.noise_m)
        micro_n, at_samples_n["end"] = driven(
            log.micro_command_n, believed.micro.latch_s, believed.micro.current_loop_s, h
        )
        if believed.joint is not None:
            x_b, x_b_rate = _relative(macro, end)
            contact = contact_at(believed, believed.joint, x_b, x_b_rate)
            side, depth, depth_rate = contact.side, contact.depth_m, contact.depth_rate_m_per_s
    else:
        end = None
    recording = Recording(log, believed, macro, end, macro_n, micro_n, depth, depth_rate, side, {}, {}, {}, {})
    for axis, reported_a in (("macro", log.macro_current_a), ("end", log.micro_current_a)):
        if axis in recording.axes and reported_a is not None and recording.belief(axis).current_noise_a is not None:
            believed_a = at_samples_n[axis] / recording.belief(axis).force_constant_n_per_a
            recording.reported_a[axis] = reported_a - believed_a
    return recording


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
        recording.filters[axis] = (level, gain, variance)
        judged = log.valid & ~np.concatenate([[False], loose[:-1]])
        judged[: round(_SETTLE_S / log.period_s)] = False
        judged[max(log.samples_count - round(_ENDING_S / log.period_s), 0) :] = False
        recording.judged[axis] = judged


def whitened(recording: Recording, axis: str, force_n: np.ndarray | None, position_m: np.ndarray | None) -> np.ndarray:
    """Return innovations of one body under forces and from positions, at judged samples, shape (m,)."""
    log = recording.log
    level, gain, variance = recording.filters[axis]
    n = log.samples_count
    if force_n is None:
        mean_n = early_n = np.zeros(n)
    else:
        mean_n, early_n = innovations.moments(force_n)
    x = np.zeros(n) if position_m is None else position_m
    start_m = float(x[0]) if position_m is not None else 0.0
    out = innovations.innovations(
        x, mean_n, early_n, gain, variance, recording.mass_kg(axis), log.period_s, level.corner_rad_per_s, start_m
    )
    return out[recording.judged[axis]]


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
    return parts + [_scaled(recording, axis, reported_a) for axis, reported_a in recording.reported_a.items()]


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
            moved = force_n is not None and bool(np.any(force_n)), sensor_m is not None and bool(np.any(sensor_m))
            if any(moved):
                parts.append(whitened(recording, axis, None if force_n is None else -force_n, sensor_m))
            else:
                parts.append(None)
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


def known_forces(recording: Recording) -> Forces:
    """Sum what is believed to act: motors, joint, effects of the profile."""
    macro_n = recording.macro_command_n.copy()
    end_n = None if recording.micro_command_n is None else recording.micro_command_n.copy()
    joint = recording.believed.joint
    if end_n is not None and joint is not None:
        joint_n = joint_force_n(recording)
        macro_n -= joint_n
        end_n += joint_n
    total = Forces(macro_n, end_n)
    for row in recording.believed.effects:
        effect = CATALOGUE[row["name"]]
        add(total, effect_forces(recording, effect, row["acts_on"], [row[name] for name in effect.parameters]))
    return total


def joint_force_n(recording: Recording) -> np.ndarray:
    """Force of spring, damping and contact on the end, shape (n, parts); damping of the contact is an effect."""
    joint, end = recording.believed.joint, recording.end
    if joint is None or end is None:
        raise KeyError("joint")
    x_b, x_b_rate = _relative(recording.macro, end)
    contact_n = _contact_of(recording).push_n(joint, 0.0)
    return contact_n + joint.spring_n_per_m * x_b + joint.damping_n_s_per_m * x_b_rate


def _contact_of(recording: Recording) -> Contact:
    side, depth_m, rate = recording.side, recording.penetration_m, recording.penetration_velocity_m_per_s
    if side is None or depth_m is None or rate is None:
        raise KeyError("joint")
    return Contact(side, depth_m, rate)


def _relative(macro: Motion, end: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return x_b = macro minus end on parts of intervals, and its rate."""
    return macro.position_m - end.position_m, macro.velocity_m_per_s - end.velocity_m_per_s


def add(total: Forces, more: Forces) -> None:
    """Add forces to forces, in place."""
    for name in ("macro_n", "end_n", "macro_sensor_m", "end_sensor_m", "macro_current_a", "end_current_a"):
        extra = getattr(more, name)
        if extra is not None:
            held = getattr(total, name)
            setattr(total, name, extra if held is None else held + extra)


def sum_of(forces: Forces, more: Forces) -> Forces:
    """Return forces and forces together."""
    return scaled(more, 1.0, forces)


def scaled(forces: Forces, factor: float, more: Forces) -> Forces:
    """Return `factor` times some forces, added to others."""
    total = replace(more)
    add(total, Forces(*(None if value is None else factor * value for value in _values_of(forces))))
    return total


def _values_of(forces: Forces) -> tuple[np.ndarray | None, ...]:
    """Return the fields in their order, without copies."""
    return tuple(getattr(forces, one.name) for one in fields(forces))


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
    relative = recording.end if recording.end is not None else recording.macro
    relative_m = relative.position_m - recording.macro.position_m
    relative_m_per_s = relative.velocity_m_per_s - recording.macro.velocity_m_per_s
    motor_n = recording.macro_command_n if axis == "macro" else recording.micro_command_n
    motor_n = 0.0 * whole if motor_n is None else motor_n
    known = {
        "position_m": relative_m if kind == "joint" else motion.position_m,
        "velocity_m_per_s": relative_m_per_s if kind == "joint" else motion.velocity_m_per_s,
        "acceleration_m_per_s2": motion.acceleration_m_per_s2,
        "relative_position_m": relative_m,
        "relative_velocity_m_per_s": relative_m_per_s,
        "motor_force_n": motor_n,
        "current_a": motor_n / recording.force_constant_n_per_a(axis),
        "command_a": recording.held_command_n(axis) / recording.force_constant_n_per_a(axis),
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
        known |= {
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


_CORRECTIONS = 2


def operating_point(recording: Recording, moved: Sequence[Moved]) -> Recording:
    """Return a recording with sensor errors taken out of its positions and edges where effects have put them.

    moved: effects that move the joint's geometry, with their places and parameters. What a sensor adds is taken along
    the readings at first, then along the motion that is left without it.
    """
    raw, believed = recording.log, recording.believed
    there = recording
    for effect, place, values in moved:
        if not place.endswith("_sensor") and believed.joint is not None:
            known = quantities(recording, "end", place)
            out_m = {}
            for side in (-1.0, 1.0):
                sided = known | {"contact_side_ratio": np.full_like(known["contact_side_ratio"], side)}
                out_m[side] = float(
                    np.mean(
                        along_motion(effect, [sided[name] for name in effect.quantities], _in_order(effect, values))
                    )
                )
            believed = _edges_out(believed, out_m[-1.0], out_m[1.0])
    for number in range(_CORRECTIONS if any(place.endswith("_sensor") for _, place, _ in moved) else 1):
        log = raw
        for effect, place, values in moved:
            parameters = _in_order(effect, values)
            if place == "macro_sensor":
                true_m = _true_m(there, log.macro_position_m, effect, place, parameters, number == 0)
                log = replace(log, macro_position_m=true_m)
            elif place == "end_sensor" and log.end_position_m is not None:
                true_m = _true_m(there, log.end_position_m, effect, place, parameters, number == 0)
                log = replace(log, end_position_m=true_m)
        there = recording_of(log, believed)
    return there


def _true_m(
    recording: Recording, read_m: np.ndarray, effect: Effect, place: str, parameters: list[float], first: bool
) -> np.ndarray:
    """Return readings without what a sensor effect adds; those of other instants are read where they are taken."""
    error_m = reading_error_m(recording, effect, place, parameters, first)[:, 0]
    if Trait.TIME_SHIFT not in effect.traits:
        return read_m - error_m
    times_s = recording.log.times_s
    known = quantities(recording, "macro" if place.startswith("macro") else "end", place)
    taken_s = _other_instants_s(recording, effect, parameters, known, backwards=True)
    inside = (taken_s >= times_s[0]) & (taken_s <= times_s[-1])
    return np.where(inside, CubicSpline(times_s, read_m)(np.where(inside, taken_s, times_s)), read_m - error_m)


def _in_order(effect: Effect, values: dict[str, float]) -> list[float]:
    return [values[name] for name in effect.parameters]


def with_joint_changed(recording: Recording, left_out_m: float, right_out_m: float, damping_ratio: float) -> Recording:
    """Return a recording whose joint has its edges further out, and a contact damping that is larger by a ratio."""
    believed = _edges_out(recording.believed, left_out_m, right_out_m)
    effects = tuple(
        {**row, "damping_n_s_per_m": row["damping_n_s_per_m"] * (1.0 + damping_ratio)}
        if row["name"] == CONTACT_DAMPING
        else row
        for row in believed.effects
    )
    return recording_of(recording.log, replace(believed, effects=effects))


def _edges_out(believed: Believed, left_m: float, right_m: float) -> Believed:
    joint = believed.joint
    if joint is None:
        return believed
    return replace(believed, joint=replace(joint, left_m=joint.left_m + left_m, right_m=joint.right_m + right_m))


def _at_samples(fine: np.ndarray) -> np.ndarray:
    """Bring values at middles of parts back to the instants that begin the intervals, shape (n, 1)."""
    ends = np.concatenate([fine[:1, 0], 0.5 * (fine[1:, 0] + fine[:-1, -1])])
    return ends[:, None]


def effect_forces(
    recording: Recording, effect: Effect, place: str, parameters: list[float], *, whole: bool = False
) -> Forces:
    """Evaluate one effect along the measured motion, and put it where it acts.

    What moves the joint's geometry, a sensor's error or an edge, is taken to first order, as a column of a regression
    needs it; `whole` takes it at its size: an error of 30 um puts the stage on the other side of an edge.
    """
    axis = "macro" if place.startswith("macro") else "end"
    known = quantities(recording, axis, place)
    if place.endswith("_sensor"):
        return misread(recording, axis, reading_error_m(recording, effect, place, parameters, whole), whole)
    if place.endswith("_command"):
        return _commanded(recording, axis, effect, parameters)
    value = along_motion(effect, [known[name] for name in effect.quantities], parameters)
    if place == "contact":
        value = _contact_changed(recording, value, whole)
    if place in ("contact", "joint"):
        return Forces(macro_n=-value, end_n=value)
    if place == "contact_edge":
        return _edges_moved(recording, effect, parameters, value, whole)
    if place.endswith("_actuator"):
        return motor_forces(recording, axis, value, None)
    return Forces(macro_n=value) if axis == "macro" else Forces(end_n=value)


def _contact_changed(recording: Recording, pressing_n: np.ndarray, whole: bool) -> np.ndarray:
    """Return what an effect of the contact adds to the force on the end; `whole`: a contact that would pull lets go.

    A knee of 25 um beside a damping of 90 N s/m lets go twice as deep as the believed contact, and left 16 % of itself
    at those instants.
    """
    joint = recording.believed.joint
    if joint is None or recording.side is None:
        return 0.0 * pressing_n
    if whole:
        damping = contact_damping_n_s_per_m(recording.believed)
        there_n = recording.side * _contact_of(recording).push_n(joint, damping)
        pressing_n = np.maximum(pressing_n, -there_n)
    return recording.side * pressing_n


def _commanded(recording: Recording, axis: str, effect: Effect, parameters: list[float]) -> Forces:
    """Return what an effect of the command path changes of one motor's force and reported current."""
    command_n = recording.log.macro_command_n if axis == "macro" else recording.log.micro_command_n
    if command_n is None:
        return Forces()
    belief = recording.belief(axis)
    command_a = command_n / belief.force_constant_n_per_a
    added_a, at_a = changed_by(
        effect, parameters, command_a, belief.latch_s, belief.current_loop_s, recording.log.period_s
    )
    return motor_forces(recording, axis, added_a * belief.force_constant_n_per_a, at_a)


def reading_error_m(
    recording: Recording, effect: Effect, place: str, parameters: list[float], whole: bool
) -> np.ndarray:
    """Return what a sensor effect adds to the readings, shape (n, 1); `whole`: along the motion without the error.

    A delay T taken along the delayed motion is off by a T^2, which is what tells it from a lag.
    """
    axis = "macro" if place.startswith("macro") else "end"
    known = quantities(recording, axis, place)
    if Trait.TIME_SHIFT in effect.traits:
        return _shifted_m(recording, effect, parameters, known, whole)
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


def _shifted_m(
    recording: Recording, effect: Effect, parameters: list[float], known: dict[str, np.ndarray], whole: bool
) -> np.ndarray:
    """Return what readings of other instants are off by: the way between those instants and the samples' own.

    A clock that is 27 ppm off is 3.8 ms late after 140 s, where two terms of a Taylor series miss by 0.3 um. The way is
    that of the foretold velocity: between readings themselves an interpolation has less noise than they have, and any
    delay of half a sample would gain by that.
    """
    times_s = recording.log.times_s
    way = CubicSpline(times_s, known["velocity_m_per_s"][:, 0]).antiderivative()
    other_s = _other_instants_s(recording, effect, parameters, known, backwards=whole)
    inside = (other_s >= times_s[0]) & (other_s <= times_s[-1])
    further_m = way(np.where(inside, other_s, times_s)) - way(times_s)
    series_m = along_motion(effect, [known[name] for name in effect.quantities], parameters)[:, 0]
    return np.where(inside, -further_m if whole else further_m, series_m)[:, None]


def _other_instants_s(
    recording: Recording, effect: Effect, parameters: list[float], known: dict[str, np.ndarray], *, backwards: bool
) -> np.ndarray:
    """Return the instants that samples are of; `backwards`: the instants of samples that are of their own ones.

    What a law adds at a velocity of one and no acceleration is by how much later its reading is of.
    """
    still = {name: np.zeros_like(known[name]) for name in ("position_m", "acceleration_m_per_s2")}
    moving = known | still | {"velocity_m_per_s": np.ones_like(known["velocity_m_per_s"])}
    later_s = along_motion(effect, [moving[name] for name in effect.quantities], parameters)[:, 0]
    times_s = recording.log.times_s
    return times_s - np.interp(times_s - later_s, times_s, later_s) if backwards else times_s + later_s


def moved_m(recording: Recording, effect: Effect, place: str, values: dict[str, float]) -> float:
    """Return by how much an effect moves a reading or an edge at most, m."""
    known = quantities(recording, "macro" if place.startswith("macro") else "end", place)
    moved = along_motion(effect, [known[name] for name in effect.quantities], [values[n] for n in effect.parameters])
    return float(np.max(np.abs(moved)))


def motor_forces(recording: Recording, axis: str, force_n: np.ndarray, current_a: np.ndarray | None) -> Forces:
    """Put a change of one motor's force where it acts: the micro's pushes the macro back as well."""
    if axis == "macro":
        return Forces(macro_n=force_n, macro_current_a=current_a)
    reaction = recording.reaction_ratio
    return Forces(macro_n=-reaction * force_n if reaction else None, end_n=force_n, end_current_a=current_a)


def _edges_moved(
    recording: Recording, effect: Effect, parameters: list[float], value: np.ndarray, whole: bool
) -> Forces:
    """Return what edges further out change: a joint that overlaps less."""
    joint, end = recording.believed.joint, recording.end
    if joint is None or end is None or recording.side is None:
        return Forces()
    if not whole:
        stiffness = quantities(recording, "end", "contact_edge")["contact_stiffness_n_per_m"]
        push_n = -recording.side * value * stiffness
        return Forces(macro_n=-push_n, end_n=push_n)
    out_m = {}
    for side in (-1.0, 1.0):
        known = quantities(recording, "end", "contact_edge") | {"contact_side_ratio": np.full_like(value, side)}
        out_m[side] = along_motion(effect, [known[name] for name in effect.quantities], parameters)
    push_n = _more_contact_n(recording, joint, 0.0, 0.0, out_m[-1.0], out_m[1.0])
    return Forces(macro_n=-push_n, end_n=push_n)


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
        forces.end_n = spring_n + _more_contact_n(recording, joint, fine_m, slope)
    else:
        left = np.where(recording.side < 0.0, joint.left_stiffness_n_per_m, 0.0)
        right = np.where(recording.side > 0.0, joint.right_stiffness_n_per_m, 0.0)
        forces.end_n = (joint.spring_n_per_m + left + right) * _between_samples(away_m[:, 0], PARTS_COUNT)
    forces.macro_n = -forces.end_n
    return forces


def _between_samples(values: np.ndarray, parts: int) -> np.ndarray:
    """Put values at samples on the middles of parts of the intervals that they begin, on straight lines."""
    share = (np.arange(parts) + 0.5) / parts
    following = np.concatenate([values[1:], values[-1:]])
    return values[:, None] + share[None, :] * (following - values)[:, None]


def _more_contact_n(
    recording: Recording,
    joint: BelievedJoint,
    apart_m: np.ndarray | float,
    apart_m_per_s: np.ndarray | float,
    left_out_m: np.ndarray | float = 0.0,
    right_out_m: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return by how much the contact pushes the end more with x_b larger by `apart_m`, and edges moved outward."""
    if recording.end is None:
        raise KeyError("end")
    x_b, x_b_rate = _relative(recording.macro, recording.end)
    damping = contact_damping_n_s_per_m(recording.believed)
    there = contact_at(recording.believed, joint, x_b + apart_m, x_b_rate + apart_m_per_s, left_out_m, right_out_m)
    return there.push_n(joint, damping) - _contact_of(recording).push_n(joint, damping)


def along_motion(effect: Effect, arguments: list[np.ndarray], parameters: list[float]) -> np.ndarray:
    """Run a law in time order over arrays of its quantities, all of shape (n, parts); shape kept."""
    columns = np.column_stack([np.ascontiguousarray(values).ravel() for values in arguments])
    memory = np.zeros(max(effect.memory, 1))
    out = compose.along(effect)(columns, np.array([*parameters, 0.0]), memory)
    return np.asarray(out).reshape(arguments[0].shape)
