"""What two positions and two commands often can't tell apart: the sets, why by formula, and what splits each.

`stagectl.gap.identifiability` asks recordings which members of a set they separate. A set lists its members at a stated
size, what is free beside them, and the remedies: a move of `stagectl.gap.moves`, a signal that nobody recorded yet, or
a change of the machine that is known. Pure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.gap.effect_forces import effect_forces, joint_force_n, motor_forces
from stagectl.gap.forces import Forces, add_forces, scaled_forces
from stagectl.gap.hypotheses import Term, parameter_terms, term_at_size, term_of
from stagectl.gap.reading_errors import misread
from stagectl.gap.recording import Recording

ACCELERATION_M_PER_S2 = 0.01
"""Size at which constant and position-dependent forces are judged: what so much acceleration of the body takes."""

SD_COUNT = 5.0
"""Size at which a known parameter is judged, in stated standard deviations."""

RATIO = 0.05
"""Size of a common scale."""

REACTION_RATIO = 0.2

DELAY_S = 200e-6
DRIFT_M = 50e-6
DRIFT_S = 60.0
RIPPLE_RATIO = 0.02
MAGNET_PITCH_M = 0.032
MODE = {"share_ratio": 0.2, "frequency_hz": 60.0, "damping_ratio": 0.02}
CABLE_SLIP_M = 0.02
SMOOTHING_M_PER_S = 1e-4

MOTORS = ("macro_force_constant", "micro_force_constant")
"""What masses are told by: both free, they are a common scale."""

CURRENTS = "reported currents"
ENCODER = "encoder of the macro's drive"
GAP_SENSOR = "gap sensor with a zero of its own"


@dataclass(frozen=True, slots=True)
class Member:
    """One hypothesis of a set: its columns, and how large each amplitude is when the set is judged."""

    name: str
    term: Term
    sizes: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Remedy:
    """What splits a set: a move of the library, a signal that has to be recorded too, a known change of the machine."""

    kind: Literal["move", "signal", "change"]
    name: str
    frees: str = ""  # the one member that it tells from the others; empty: all


@dataclass(frozen=True, slots=True)
class AliasSet:
    """Hypotheses that the wrong recordings can't tell apart."""

    name: str
    why: str
    members: tuple[Member, ...]
    remedies: tuple[Remedy, ...]
    beside: tuple[Term, ...] = ()  # free, whatever their size
    holds: tuple[str, ...] = ()  # known parameters that the set takes as they are believed


def alias_sets(recordings: Sequence[Recording]) -> list[AliasSet]:
    """Return the sets that a machine of these recordings can have."""
    r = recordings[0]
    found = [_common_scale(r), _delays(r), _constants(r), _springs(r), _cable_loop(r), _mode(r), _periodic(recordings)]
    if r.end is not None:
        found += [_reaction(r), _drift()]
        if r.believed.joint is not None:
            found.append(_zero(r))
    return found


def _known(r: Recording) -> dict[str, Member]:
    """Return the known parameters as members, by name, at a size that their stated uncertainty allows hardly ever."""
    return {term.name: Member(term.name, term, (SD_COUNT * sd,)) for term, sd in parameter_terms(r)}


def _force_n(r: Recording, axis: str = "macro") -> float:
    return ACCELERATION_M_PER_S2 * r.mass_kg(axis)


def _effect(name: str, place: str, size: float, shape: dict[str, float] | None = None) -> Member:
    term = term_of(CATALOGUE[name], place, shape or {})
    return Member(f"{name} on {place}", term, (size,) * len(term.amplitudes))


def _of(name: str, place: str, forces: Callable[[Recording], Forces], unit: str, scope: str = "structural") -> Term:
    """Make the term of something that no effect of the catalogue says."""
    return Term(name, place, {}, (unit,), lambda r: [forces(r)], scope)


def _ones(r: Recording) -> np.ndarray:
    return np.ones_like(r.macro.position_m)


def _common_scale(r: Recording) -> AliasSet:
    known = _known(r)
    names = [name for name in known if name not in ("left_m", "right_m") and not name.endswith("_s")]
    # contact stiffnesses, springs, friction and motors all make newtons that only masses turn into motion
    return AliasSet(
        "common scale of all forces and masses",
        "x'' = (K i - b v - k x) / m: e K, e b, e k over e m is the same motion; only ratios are known",
        tuple(replace(known[name], sizes=(RATIO,)) for name in names),
        (Remedy("change", "a known added mass"),),
    )


def _delays(r: Recording) -> AliasSet:
    known = _known(r)
    latches = {
        axis: known[f"{side}_latch_s"] for axis, side in (("macro", "macro"), ("end", "micro")) if axis in r.axes
    }
    motors = [latch.term for latch in latches.values()]
    members: list[Member] = []
    for axis, latch in latches.items():
        members += [_late(axis, motors), replace(latch, sizes=(DELAY_S,))]
    return AliasSet(
        "sensor delay against actuator delay",
        "m x'' = u(t - T_a) + f(x, x'), y(t) = x(t - T_s): the same as m y'' = u(t - T_a - T_s) + f(y, y')",
        tuple(members),
        (Remedy("signal", CURRENTS),),
    )


_STEP_S = 1e-5


def _late(axis: str, motors: Sequence[Term]) -> Member:
    """Return the delay T of a body's reading as what it does to the forces behind the reading.

    In y(t) = x(t - T) every force on the body acts T later: m y'' = F(t - T). Its own laws follow y and notice nothing;
    motors and the joint do. As an error -v T of the reading it would move friction too, and a reversal would seem to
    tell a late sensor from a late motor, which it can't.

    Both bodies late is the joint late, exactly. So what the end's delay does to the joint is that less the macro's: an
    edge that is met jumps by its damping, which the slope of the joint's force holds and no reading's error does, and
    ten seconds of contact seemed to tell sensors from motors by it (power 0.99).
    """
    late = _effect("sensor_delay", f"{axis}_sensor", DELAY_S / _STEP_S, {"delay_s": _STEP_S})
    macro_late = _effect("sensor_delay", "macro_sensor", DELAY_S / _STEP_S, {"delay_s": _STEP_S})

    def forces(r: Recording) -> list[Forces]:
        motor = Forces()
        for term in motors:
            add_forces(motor, scaled_forces(term.forces(r)[0], _STEP_S, Forces()))
        total = Forces(macro_n=motor.macro_n) if axis == "macro" else Forces(end_n=motor.end_n)
        between_n = _between_n(r)
        if between_n is None:
            return [total]
        joint_late_n = _STEP_S * _slope(r, between_n)
        (misread,) = macro_late.term.forces(r)
        if misread.end_n is None:
            raise KeyError("end")
        if axis == "macro":
            add_forces(total, Forces(macro_n=joint_late_n - misread.end_n, end_n=misread.end_n))
        else:
            add_forces(total, Forces(macro_n=misread.end_n - joint_late_n, end_n=-misread.end_n))
        return [total]

    return replace(late, term=replace(late.term, forces=forces))


def _between_n(r: Recording) -> np.ndarray | None:
    """Return the force between the bodies, on the end."""
    if r.end is None or r.believed.joint is None:
        return None
    total = Forces(end_n=joint_force_n(r))
    for row in r.believed.effects:
        if row["acts_on"] in ("joint", "contact"):
            effect = CATALOGUE[row["name"]]
            add_forces(total, effect_forces(r, effect, row["acts_on"], [row[n] for n in effect.parameters]))
    return total.end_n


def _slope(r: Recording, fine: np.ndarray) -> np.ndarray:
    return np.gradient(fine.ravel(), r.log.period_s / fine.shape[1]).reshape(fine.shape)


def _constants(r: Recording) -> AliasSet:
    dry = next((row for row in r.believed.effects if row["name"] == "coulomb_friction"), {})
    smooth = {"smoothing_m_per_s": dry.get("smoothing_m_per_s", SMOOTHING_M_PER_S)}
    size_n = _force_n(r)
    uneven = CATALOGUE["asymmetric_coulomb_friction"]
    uneven_name, amplifier_name = "asymmetric_coulomb_friction on macro_force", "amplifier offset on macro_command"

    def uneven_forces(r: Recording) -> Forces:
        values = smooth | {"forward_n": 1.0, "backward_n": -1.0}
        return effect_forces(r, uneven, "macro_force", [values[name] for name in uneven.parameters])

    def amplifier(r: Recording) -> Forces:
        current_a = np.full(r.log.samples_count, 1.0 / r.force_constant_n_per_a("macro"))
        return motor_forces(r, "macro", _ones(r), current_a)

    return AliasSet(
        "offset, tilt, amplifier offset, asymmetric Coulomb friction",
        "-F_+ for v > 0, F_- for v < 0 is -(F_+ + F_-) / 2 sgn v - (F_+ - F_-) / 2; m g s, K i_0 are constant too",
        (
            _effect("offset", "macro_force", size_n),
            _effect("gravity_tilt", "macro_force", ACCELERATION_M_PER_S2 / 9.80665),
            Member(
                "amplifier offset on macro_command",
                _of("amplifier_offset", "macro_command", amplifier, "force_n"),
                (size_n,),
            ),
            Member(
                "asymmetric_coulomb_friction on macro_force",
                _of("asymmetric_coulomb_friction", "macro_force", uneven_forces, "difference_n"),
                (size_n,),
            ),
        ),
        (
            Remedy("move", "slow reversals", uneven_name),
            Remedy("signal", CURRENTS, amplifier_name),
            Remedy("change", "a known added mass", "gravity_tilt on macro_force"),
        ),
        beside=(term_of(CATALOGUE["coulomb_friction"], "macro_force", smooth),),
    )


def _travel_m(r: Recording) -> float:
    return max(r.believed.travel_m, 1e-3)


def _springs(r: Recording) -> AliasSet:
    stiffness = 2.0 * _force_n(r) / _travel_m(r)
    return AliasSet(
        "cable against spring of the base",
        "-k (x - x_0) = -k x + k x_0: with a free constant force both are the same line",
        (
            _effect("cable_spring", "macro_force", stiffness, {"anchor_m": 0.0}),
            _effect("linear_stiffness", "macro_force", stiffness),
        ),
        (Remedy("change", "the cable unhooked"),),
        beside=(term_of(CATALOGUE["offset"], "macro_force", {}),),
    )


def _cable_loop(r: Recording) -> AliasSet:
    size_n = _force_n(r)
    return AliasSet(
        "cable that gives way against spring of the base",
        "a cable slips after delta: below it, F_s (x - x_r) / delta from the reversal x_r is a spring and a constant",
        (
            _effect("cable_hysteresis", "macro_force", size_n, {"slip_m": CABLE_SLIP_M, "exponent_ratio": 0.0}),
            _effect("linear_stiffness", "macro_force", size_n / CABLE_SLIP_M),
        ),
        (Remedy("move", "slow stroke"), Remedy("move", "middle stroke")),
        beside=(
            term_of(CATALOGUE["offset"], "macro_force", {}),
            term_of(CATALOGUE["coulomb_friction"], "macro_force", {"smoothing_m_per_s": SMOOTHING_M_PER_S}),
        ),
    )


def _mode(r: Recording) -> AliasSet:
    known = _known(r)
    mode = term_at_size(CATALOGUE["flexible_mode"], "macro_force", MODE)
    return AliasSet(
        "flexible mode far above the band, delay, mass",
        "mu m (w / w_m)^2 / (1 - (w / w_m)^2 + 2 i z w / w_m) a: at one w a mass error, its small odd part a delay",
        (Member("flexible_mode on macro_force", mode, (1.0,)), known["macro_mass_kg"], known["macro_latch_s"]),
        (Remedy("move", "fast stroke"),),
        holds=(*MOTORS, "micro_reaction on macro_force"),
    )


def _periodic(recordings: Sequence[Recording]) -> AliasSet:
    r = recordings[0]
    span_m = max(float(np.ptp(one.position_m("macro"))) for one in recordings)
    pitch_m = next((row["pitch_m"] for row in r.believed.effects if row["name"] == "cogging"), MAGNET_PITCH_M)
    shape = {"pitch_m": min(float(pitch_m), max(0.5 * span_m, 1e-4))}
    return AliasSet(
        "cogging against ripple of the force constant",
        "A sin(2 pi x / p) and r F sin(2 pi x / p) are the same where the motor's force F is constant",
        (
            _effect("cogging", "macro_force", _force_n(r), shape),
            _effect("current_ripple", "macro_actuator", RIPPLE_RATIO, shape),
        ),
        (Remedy("move", "sine 0.3 Hz"), Remedy("move", "fast stroke")),
    )


def _reaction(r: Recording) -> AliasSet:
    known = _known(r)
    reaction = next((m for name, m in known.items() if name.startswith("micro_reaction")), None)
    if reaction is None:
        reaction = _effect("micro_reaction", "macro_force", REACTION_RATIO)
    return AliasSet(
        "reaction of the micro's drive against mass of the macro",
        "while the bodies move together the micro's force is m_end a: a m_end a and m_macro e a are one column",
        (replace(reaction, sizes=(REACTION_RATIO,)), known["macro_mass_kg"]),
        (Remedy("move", "sweep over both edges"),),
        holds=MOTORS,
    )


def _drift() -> AliasSet:
    shape = {"time_constant_s": DRIFT_S}
    return AliasSet(
        "which of two sensors drifts",
        "only macro minus end meets a force, that of the joint: D on one sensor is -D on the other",
        tuple(_effect("thermal_drift", place, DRIFT_M, shape) for place in ("macro_sensor", "end_sensor")),
        (Remedy("signal", ENCODER),),
    )


def _zero(r: Recording) -> AliasSet:
    def shifted(r: Recording) -> Forces:
        return misread(r, "end", np.ones((r.log.samples_count, 1)), False)

    size_m = SD_COUNT * (0.0 if r.believed.joint is None else r.believed.joint.width_sd_m)
    zero = _of("relative_zero", "end_sensor", shifted, "error_m", "session")
    return AliasSet(
        "centre of the backlash against zero of the relative position",
        "the edges stand at c +- b / 2 of a reading x_r + z: c + z is all that contact shows, k z is a constant force",
        (
            _effect("backlash_centre_shift", "contact_edge", size_m),
            Member("zero of the relative position on end_sensor", zero, (size_m,)),
        ),
        (Remedy("signal", GAP_SENSOR),),
        beside=tuple(term_of(CATALOGUE["offset"], place, {}) for place in ("macro_force", "micro_force")),
    )


Reads = Callable[[Recording, Forces], np.ndarray | None]
"""What a signal shows of forces and errors, in units of its noise; None where nothing."""


def _currents(r: Recording, forces: Forces) -> np.ndarray | None:
    parts = []
    for axis, current_a in (("macro", forces.macro_current_a), ("end", forces.end_current_a)):
        if axis in r.axes:
            command_n = r.log.macro_command_n if axis == "macro" else r.log.micro_command_n
            largest_n = 0.0 if command_n is None else float(np.max(np.abs(command_n)))
            noise_a = r.belief(axis).current_noise_a or _CURRENT_NOISE_RATIO * largest_n / r.force_constant_n_per_a(
                axis
            )
            parts.append(np.zeros(r.log.samples_count) if current_a is None or not noise_a else current_a / noise_a)
    return np.concatenate(parts)


def _encoder(r: Recording, forces: Forces) -> np.ndarray | None:
    return None if forces.macro_sensor_m is None else forces.macro_sensor_m / _SENSOR_NOISE_M


def _gap_sensor(r: Recording, forces: Forces) -> np.ndarray | None:
    parts = [sign * x for sign, x in ((1.0, forces.end_sensor_m), (-1.0, forces.macro_sensor_m)) if x is not None]
    return sum(parts[1:], parts[0]) / _SENSOR_NOISE_M if parts else None


_CURRENT_NOISE_RATIO = 0.002
_SENSOR_NOISE_M = 1e-6

SIGNALS: dict[str, Reads] = {CURRENTS: _currents, ENCODER: _encoder, GAP_SENSOR: _gap_sensor}
"""Signals that may be recorded besides: currents to 0.2 % of the largest, sensors to 1 um a sample."""
