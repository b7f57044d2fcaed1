"""What effects, the joint and the motors do to the bodies along the measured motion. Pure."""

import numpy as np

from stagectl.effects import CATALOGUE, Effect, Trait
from stagectl.gap import late_readings
from stagectl.gap.forces import Forces, add_forces, scaled_forces, sum_of_forces
from stagectl.gap.jumps import jumps_at, with_jumps
from stagectl.gap.late_readings import Row, makes_late
from stagectl.gap.quantities import along_motion, arguments_of, quantities
from stagectl.gap.reading_errors import SMALL_M, misread, more_contact_n, reading_error_m
from stagectl.gap.recording import REACTION, Recording, contact_push_n, driven_by, relative_motion, with_late


def known_forces(recording: Recording, but: Trait | None = None) -> Forces:
    """Sum what is believed to act: motors, joint, effects of the profile; without those of a trait."""
    total = Forces(recording.felt_n["macro"].copy(), recording.felt_n["end"].copy() if recording.end else None)
    if total.end_n is not None and recording.believed.joint is not None:
        add_forces(total, between(recording, joint_force_n(recording)))
    for row in (*recording.believed.effects, *recording.at_size):
        effect = CATALOGUE[row["name"]]
        if but in effect.traits or row["acts_on"].endswith("_command"):  # motors feel these already
            continue
        add_forces(total, effect_forces(recording, effect, row["acts_on"], [row[name] for name in effect.parameters]))
    return total


def between(recording: Recording, force_n: np.ndarray) -> Forces:
    """Put a force between the bodies, as it acts on the end, on both, each on the clock of its readings."""
    felt_n = {axis: late_readings.felt_n(recording.late, axis, recording.log, force_n) for axis in recording.axes}
    return Forces(macro_n=-felt_n["macro"], end_n=felt_n["end"])


def _later(recording: Recording, effect: Effect, place: str, parameters: list[float]) -> Forces:
    """Return what readings of earlier instants change: motors, the joint, and a micro that pushes the macro back.

    What is known of the same sensor is left out of both: at the size that it has an effect is nothing more.
    """
    row = {"name": effect.name, "acts_on": place, **dict(zip(effect.parameters, parameters, strict=True))}
    others = tuple(one for one in recording.late if (one["name"], one["acts_on"]) != (effect.name, place))
    key = f"{effect.name}@{place}"
    if key not in recording.exchanged:
        recording.exchanged[key] = scaled_forces(_exchanged(with_late(recording, others)), -1.0, Forces())
    return sum_of_forces(_exchanged(with_late(recording, (*others, row))), recording.exchanged[key])


def spread_out(recording: Recording, row: Row) -> Forces:
    """Return what changes where readings come as late in the mean, but all at once where they lagged, or else lag."""
    key = row["name"], row["acts_on"]
    (late_s,) = (row[name] for name in CATALOGUE[row["name"]].parameters)
    others = tuple(one for one in recording.late if (one["name"], one["acts_on"]) != key)
    other = CATALOGUE[SPREADS[row["name"]]]
    instead = {"name": other.name, "acts_on": row["acts_on"], other.parameters[0]: late_s}
    return sum_of_forces(
        _exchanged(with_late(recording, (*others, instead))), scaled_forces(_exchanged(recording), -1.0, Forces())
    )


def _exchanged(recording: Recording) -> Forces:
    """Sum what bodies feel of motors and of each other."""
    total = Forces(recording.felt_n["macro"], recording.felt_n.get("end"))
    if recording.end is None:
        return total
    if recording.believed.joint is not None:
        add_forces(total, between(recording, joint_force_n(recording)))
    for row in (*recording.believed.effects, *recording.at_size):
        effect = CATALOGUE[row["name"]]
        if row["acts_on"] in ("contact", "joint") or "micro_motor_force_n" in effect.quantities:
            values = [row[name] for name in effect.parameters]
            add_forces(total, effect_forces(recording, effect, row["acts_on"], values))
    if recording.found_reaction_ratio:
        found = [recording.found_reaction_ratio]
        add_forces(total, effect_forces(recording, CATALOGUE[REACTION], "macro_force", found))
    return total


def joint_force_n(recording: Recording) -> np.ndarray:
    """Force of spring, damping and contact on the end, shape (n, parts); damping of the contact is an effect."""
    joint, end = recording.believed.joint, recording.end
    if joint is None or end is None:
        raise KeyError("joint")
    x_b, x_b_rate = relative_motion(recording)
    return contact_push_n(recording, 0.0) + joint.spring_n_per_m * x_b + joint.damping_n_s_per_m * x_b_rate


def effect_forces(
    recording: Recording, effect: Effect, place: str, parameters: list[float], *, whole: bool = False
) -> Forces:
    """Evaluate one effect along the measured motion, and put it where it acts.

    What moves the joint's geometry, a sensor's error or an edge, is taken to first order, as a column of a regression
    needs it; `whole` takes it at its size: an error of 30 um puts the stage on the other side of an edge.
    """
    axis = "macro" if place.startswith("macro") else "end"
    if makes_late(effect):
        return _later(recording, effect, place, parameters)
    if place.endswith("_sensor"):
        return misread(recording, axis, reading_error_m(recording, effect, place, parameters, whole), whole)
    if place.endswith("_command"):
        return _commanded(recording, axis, effect, parameters)
    if Trait.SWINGS in effect.traits:
        value = _swung_n(recording, axis, effect, parameters)
    else:
        arguments = arguments_of(recording, axis, place, effect)
        value = along_motion(effect, arguments, parameters)
        if jumps_at(effect, place):
            acceleration = recording.motion(axis).acceleration_m_per_s2
            value = with_jumps(effect, arguments, acceleration, parameters, value, recording.log.period_s)
    if place == "contact":
        value = _contact_changed(recording, value, whole)
    if place in ("contact", "joint"):
        return between(recording, value)
    if place == "contact_edge":
        return _edges_moved(recording, effect, parameters, whole)
    if place.endswith("_actuator"):
        return motor_forces(recording, axis, value, None)
    if axis == "macro" and "micro_motor_force_n" in effect.quantities:
        value = late_readings.felt_n(recording.late, axis, recording.log, value)
    return Forces(macro_n=value) if axis == "macro" else Forces(end_n=value)


_TINY = 1e-9

SPREADS = {"sensor_delay": "sensor_lag", "sensor_lag": "sensor_delay"}
"""What comes late all at once, or spread out over time: laws of the same lateness, each the other one of the other."""


def _swung_n(recording: Recording, axis: str, effect: Effect, parameters: list[float]) -> np.ndarray:
    """Return what a share of the mass on a spring does, driven by all other forces that are known, shape (n, parts).

    The acceleration that the past foretells rings already: the share would be driven by itself, by as much of it as a
    filter has seen so far. A mode of 17.5 Hz and 12 % came out as 17.3 Hz and 10 %, 3700 squares below the noise.
    In (1 - mu) q'' + 2 zeta w q' + w^2 q = -a_0 the others' a_0 is known. That is the law itself for no share at all,
    with a_0 / (1 - mu) and with frequency and damping over the root of 1 - mu.
    """
    others_n = _others_n(recording, axis)
    share, frequency_hz, damping = parameters
    free = np.sqrt(1.0 - share)
    known = quantities(recording, axis, f"{axis}_force")
    driven = known | {"acceleration_m_per_s2": others_n / (recording.mass_kg(axis) * (1.0 - share))}
    arguments = [driven[name] for name in effect.quantities]
    return share / _TINY * along_motion(effect, arguments, [_TINY, frequency_hz / free, damping / free])


def _others_n(recording: Recording, axis: str) -> np.ndarray:
    """Return what acts on a body besides shares of its mass that swing, shape (n, parts)."""
    if axis not in recording.others_n:
        total = known_forces(recording, but=Trait.SWINGS)
        add_forces(total, recording.found)
        others_n = total.macro_n if axis == "macro" else total.end_n
        if others_n is None:
            raise KeyError(axis)
        recording.others_n[axis] = others_n
    return recording.others_n[axis]


def _contact_changed(recording: Recording, pressing_n: np.ndarray, whole: bool) -> np.ndarray:
    """Return what an effect of the contact adds to the force on the end; `whole`: a contact that would pull lets go.

    A knee of 25 um beside a damping of 90 N s/m lets go twice as deep as the believed contact, and left 16 % of itself
    at those instants.
    """
    joint = recording.believed.joint
    if joint is None or recording.side is None:
        return 0.0 * pressing_n
    if whole:
        there_n = recording.side * contact_push_n(recording, recording.contact_damping_n_s_per_m)
        pressing_n = np.maximum(pressing_n, -there_n)
    return recording.side * pressing_n


def _commanded(recording: Recording, axis: str, effect: Effect, parameters: list[float]) -> Forces:
    """Return what an effect of the command path changes of one motor's force and reported current."""
    if axis not in recording.axes:
        return Forces()
    drive = recording.belief(axis)
    if axis not in recording.driven_n:
        recording.driven_n[axis] = driven_by(recording, axis, [], drive)
    now, then = recording.driven_n[axis], driven_by(recording, axis, [(effect, parameters)], drive)
    motor_n, at_n = (after - before for before, after in zip(now, then, strict=True))
    return motor_forces(recording, axis, motor_n, at_n / drive.force_constant_n_per_a)


def motor_forces(recording: Recording, axis: str, force_n: np.ndarray, current_a: np.ndarray | None) -> Forces:
    """Put a change of one motor's force where it acts: the micro's pushes the macro back as well."""
    if axis == "macro":
        return Forces(macro_n=force_n, macro_current_a=current_a)
    reaction = recording.reaction_ratio
    return Forces(macro_n=-reaction * force_n if reaction else None, end_n=force_n, end_current_a=current_a)


def _edges_moved(recording: Recording, effect: Effect, parameters: list[float], whole: bool) -> Forces:
    """Return what edges further out change, where there are any."""
    joint, end = recording.believed.joint, recording.end
    if joint is None or end is None or recording.side is None:
        return Forces()
    return edges_moved(recording, *edges_out_m(recording, effect, parameters), whole)


def edges_moved(recording: Recording, left_m: np.ndarray, right_m: np.ndarray, whole: bool) -> Forces:
    """Return what edges so far out change: a joint that overlaps less. As a slope at where they are, or whole."""
    share = 1.0 if whole else SMALL_M / max(float(np.max(np.abs([left_m, right_m]))), SMALL_M)
    more_n = more_contact_n(recording, 0.0, 0.0, share * left_m, share * right_m)
    return between(recording, more_n / share)


def edges_out_m(recording: Recording, effect: Effect, parameters: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much an effect moves the left and the right edge outward, on parts of intervals."""
    known = quantities(recording, "end", "contact_edge")
    out_m = []
    for side in (-1.0, 1.0):
        sided = known | {"contact_side_ratio": np.full_like(known["contact_side_ratio"], side)}
        out_m.append(along_motion(effect, [sided[name] for name in effect.quantities], parameters))
    return out_m[0], out_m[1]
