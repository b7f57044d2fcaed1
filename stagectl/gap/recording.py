"""One log with all that does not depend on a hypothesis: motion, motor forces, where the joint touches. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.gap import late_readings
from stagectl.gap.believed import Believed, BelievedAxis
from stagectl.gap.command_path import Acting, made_by
from stagectl.gap.contact import Contact, contact_at, contact_damping_n_s_per_m
from stagectl.gap.forces import Forces
from stagectl.gap.innovations import Noise
from stagectl.gap.late_readings import Row
from stagectl.gap.log import Log
from stagectl.gap.motion import Motion, motion_of

REACTION = "micro_reaction"

AXES = ("macro", "end")
"""Bodies; the second one is the micro's, its position the end's."""

EdgesOut = tuple[np.ndarray | float, np.ndarray | float]
"""By how much effects have moved the left and the right edge outward, on parts of intervals, m: wear goes on."""


@dataclass(slots=True)
class Recording:
    """One log with all that does not depend on a hypothesis."""

    log: Log
    believed: Believed
    macro: Motion
    end: Motion | None
    macro_motor_n: np.ndarray  # what a drive makes of its commands, with what is known of its command path
    micro_motor_n: np.ndarray | None
    penetration_m: np.ndarray | None
    penetration_velocity_m_per_s: np.ndarray | None
    side: np.ndarray | None
    filters: dict[str, tuple[Noise, np.ndarray]]  # what whitens a body, by axis, and its steps
    judged: dict[str, np.ndarray]
    known: dict[tuple[str, str], dict[str, np.ndarray]]  # quantities by axis and kind of place, once asked for
    reported_a: dict[str, np.ndarray]  # reported minus believed current at the samples, by axis, where it is known
    felt_n: dict[str, np.ndarray]  # motor forces on the clock of each body's readings, which may be late
    now: dict[str, Motion]  # motion at the samples' own instants
    at_size: tuple[Row, ...] = ()  # effects of the command path and the contact that were found, as rows of a profile
    late: tuple[Row, ...] = ()  # effects that make readings those of earlier instants
    edges_out_m: EdgesOut = (0.0, 0.0)
    found: Forces = field(default_factory=Forces)  # of effects that were found, of which none is part of the above
    found_reaction_ratio: float = 0.0  # share of the micro's motor force that was found to push the macro back
    exchanged: dict[str, Forces] = field(default_factory=dict)  # without what is late of one sensor, once asked for
    others_n: dict[str, np.ndarray] = field(default_factory=dict)  # on a body, without what swings, once asked for
    pushed_n: dict[float, np.ndarray] = field(default_factory=dict)  # by the contact, by damping, once asked for
    driven_n: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # by motors alone, once asked for
    apart: tuple[np.ndarray, np.ndarray] | None = None  # macro minus end at one instant, and its rate

    @property
    def axes(self) -> tuple[str, ...]:
        """Bodies that this log has."""
        return AXES if self.end is not None else AXES[:1]

    @property
    def reaction_ratio(self) -> float:
        """Share of the micro's motor force that pushes the macro back, as believed and as found."""
        believed = sum(row["fraction_ratio"] for row in self.believed.effects if row["name"] == REACTION)
        return believed + self.found_reaction_ratio

    @property
    def contact_damping_n_s_per_m(self) -> float:
        """Damping of the joint in contact only, as believed and as found."""
        return contact_damping_n_s_per_m((*self.believed.effects, *self.at_size))

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


def put_together(
    log: Log,
    believed: Believed,
    macro: Motion,
    end: Motion | None,
    at_size: tuple[Row, ...] = (),
    late: tuple[Row, ...] = (),
    edges_out_m: EdgesOut = (0.0, 0.0),
) -> Recording:
    """Put together what is known along a motion; without one of the end, its own is made of the positions alone."""
    made_n = {"macro": _driven(log, (), "macro", acting_on("macro", believed, at_size), believed.macro)}
    if log.end_position_m is not None and log.micro_command_n is not None and believed.micro is not None:
        end = end or motion_of(log.end_position_m, log.period_s, believed.micro.noise_m)
        made_n["end"] = _driven(log, (), "end", acting_on("end", believed, at_size), believed.micro)
    else:
        end = None
    micro_n = made_n["end"][0] if end is not None else None
    recording = Recording(
        log, believed, macro, end, made_n["macro"][0], micro_n, None, None, None, {}, {}, {}, {}, {}, {}, at_size, late,
        edges_out_m,
    )  # fmt: skip
    _read(recording)
    for axis, reported_a in (("macro", log.macro_current_a), ("end", log.micro_current_a)):
        if axis in recording.axes and reported_a is not None and recording.belief(axis).current_noise_a is not None:
            believed_a = made_n[axis][1] / recording.belief(axis).force_constant_n_per_a
            recording.reported_a[axis] = reported_a - believed_a
    return recording


def with_late(recording: Recording, late: tuple[Row, ...]) -> Recording:
    """Return it with other effects that make readings late; motions and what the motors do stay."""
    there = replace(
        recording, late=late, known={}, exchanged={}, felt_n={}, now={}, others_n={}, pushed_n={}, driven_n={}
    )
    _read(there)
    return there


def _read(recording: Recording) -> None:
    """Write down what follows from how late readings are: motors as each body feels them, motion now, contact."""
    log, believed, late = recording.log, recording.believed, recording.late
    for axis in recording.axes:
        felt_n = recording.macro_motor_n if axis == "macro" else recording.micro_motor_n
        if felt_n is None or _is_late(late, axis):
            acting = acting_on(axis, believed, recording.at_size)
            felt_n, _ = driven_by(recording, axis, acting, recording.belief(axis))
        recording.felt_n[axis] = felt_n
        recording.now[axis] = late_readings.motion_now(late, axis, log, recording.motion(axis))
    if recording.end is not None:
        macro, end = recording.now["macro"], recording.now["end"]
        recording.apart = macro.position_m - end.position_m, macro.velocity_m_per_s - end.velocity_m_per_s
    if recording.end is not None and believed.joint is not None:
        part_s = log.period_s / recording.now["end"].position_m.shape[1]
        contact = contact_at(
            believed.joint, recording.contact_damping_n_s_per_m, *relative_motion(recording), part_s,
            *recording.edges_out_m,
        )  # fmt: skip
        recording.side, recording.penetration_m = contact.side, contact.depth_m
        recording.penetration_velocity_m_per_s = contact.depth_rate_m_per_s


def contact_of(recording: Recording) -> Contact:
    side, depth_m, rate = recording.side, recording.penetration_m, recording.penetration_velocity_m_per_s
    if side is None or depth_m is None or rate is None:
        raise KeyError("joint")
    return Contact(side, depth_m, rate)


def contact_push_n(recording: Recording, damping_n_s_per_m: float) -> np.ndarray:
    """Return the force of the believed contact on the end with a damping of its own, shape (n, parts)."""
    joint = recording.believed.joint
    if joint is None:
        raise KeyError("joint")
    if damping_n_s_per_m not in recording.pushed_n:
        recording.pushed_n[damping_n_s_per_m] = contact_of(recording).push_n(joint, damping_n_s_per_m)
    return recording.pushed_n[damping_n_s_per_m]


def acting_on(axis: str, believed: Believed, at_size: Sequence[Row]) -> list[Acting]:
    """Return the effects of the command path of a body's drive that are believed or found."""
    place = "macro_command" if axis == "macro" else "micro_command"
    rows = [row for row in (*believed.effects, *at_size) if row["acts_on"] == place]
    effects = [(CATALOGUE[row["name"]], row) for row in rows]
    return [(effect, [row[name] for name in effect.parameters]) for effect, row in effects]


def driven_by(
    recording: Recording, axis: str, acting: Sequence[Acting], drive: BelievedAxis
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a drive with such effects of its command path makes of the commands, N.

    Means over parts of intervals on the clock of its body's readings (n, parts), values at samples (n,).
    """
    return _driven(recording.log, recording.late, axis, acting, drive)


def _driven(
    log: Log, late: tuple[Row, ...], axis: str, acting: Sequence[Acting], drive: BelievedAxis
) -> tuple[np.ndarray, np.ndarray]:
    command_n = log.macro_command_n if axis == "macro" else log.micro_command_n
    if command_n is None:
        raise KeyError(axis)
    constant = drive.force_constant_n_per_a
    means_n, at_samples_n = made_by(acting, command_n, constant, drive.latch_s, drive.current_loop_s, log.period_s)
    if _is_late(late, axis):
        means_n = late_readings.motor_n(late, axis, log, acting, command_n, drive)
    return means_n, at_samples_n


def _is_late(late: tuple[Row, ...], axis: str) -> bool:
    return any(row["acts_on"] == f"{axis}_sensor" for row in late)


def relative_motion(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return x_b = macro minus end at one instant, on parts of intervals, and its rate."""
    if recording.apart is None:
        raise KeyError("end")
    return recording.apart
