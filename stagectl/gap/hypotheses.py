"""Everything that could be missing and has a name: effects at grids of their shape parameters, known parameters.

Each is a group of whitened columns whose amplitudes are solved for; shapes (a pitch, a Stribeck speed) are searched.
Pure.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stagectl.effects import CATALOGUE, Effect, Trait
from stagectl.gap.effect_forces import between, effect_forces, known_forces, motor_forces
from stagectl.gap.forces import Forces, add_forces, scaled_forces
from stagectl.gap.reading_errors import SMALL_M, more_contact_n
from stagectl.gap.recording import Recording, acting_on, driven_by, relative_motion


@dataclass(frozen=True, slots=True)
class Term:
    """One hypothesis: the columns of one effect with its shape fixed."""

    name: str
    acts_on: str
    shape: dict[str, float]
    amplitudes: tuple[str, ...]
    forces: Callable[[Recording], list[Forces]]
    scope: str = "structural"
    bounds: tuple[tuple[float, float], ...] = ()
    linear: bool = True
    is_slope: bool = False  # of what moves readings or edges, beside another one: neither is known at its size yet

    @property
    def key(self) -> tuple[str, str]:
        """What it is called and where it acts."""
        return self.name, self.acts_on


def widest_amplitudes(term: Term) -> tuple[float, ...]:
    """Return how large each amplitude can be at all: the far end of what its effect is declared for."""
    if not term.bounds:
        return (np.inf,) * len(term.amplitudes)
    return tuple(max(abs(low), abs(high)) for low, high in term.bounds)


def parameter_terms(recording: Recording) -> list[tuple[Term, float]]:
    """Errors of what is believed, as terms with the standard deviation of their amplitude (a ratio, or metres)."""
    believed = recording.believed
    joint = believed.joint
    found: list[tuple[Term, float]] = []

    def known(name: str, sd: float, forces: Callable[[Recording], list[Forces]], unit: str = _RATIO) -> None:
        found.append((Term(name, "parameter", {}, (unit,), forces), sd))

    known("macro_mass_kg", believed.macro.mass_sd_kg / believed.macro.mass_kg, partial(_inertia, "macro"))
    known("macro_force_constant", believed.macro.force_constant_sd_ratio, partial(_motor, "macro"))
    if believed.micro is not None and recording.end is not None:
        known("micro_mass_kg", believed.micro.mass_sd_kg / believed.micro.mass_kg, partial(_inertia, "end"))
        known("micro_force_constant", believed.micro.force_constant_sd_ratio, partial(_motor, "end"))
    if joint is not None and recording.end is not None:
        known("spring_n_per_m", joint.stiffness_sd_ratio, partial(_spring, joint.spring_n_per_m))
        known("damping_n_s_per_m", joint.damping_sd_ratio, partial(_damping, joint.damping_n_s_per_m))
        for side, sign in (("left", -1.0), ("right", 1.0)):
            stiffness = getattr(joint, f"{side}_stiffness_n_per_m")
            sd = getattr(joint, f"{side}_stiffness_sd_ratio")
            known(f"{side}_stiffness_n_per_m", sd, partial(_push, sign, stiffness))
            known(f"{side}_m", joint.width_sd_m, partial(_edge, sign), "error_m")
    for axis, side in (("macro", "macro"), ("end", "micro")):
        if axis in recording.axes:
            belief = recording.belief(axis)
            known(f"{side}_latch_s", belief.latch_sd_s, partial(_timing, axis, 0.0), "error_s")
            if belief.current_loop_s > 0.0:
                lag = partial(_timing, axis, belief.current_loop_s)
                known(f"{side}_current_loop_s", belief.current_loop_sd_s, lag, "error_s")
    for row in believed.effects:
        name = f"{row['name']} on {row['acts_on']}"
        values = [row[parameter] for parameter in CATALOGUE[row["name"]].parameters]
        sd = believed.effect_sd_ratios.get(name, believed.effect_sd_ratio)
        known(name, sd, partial(_existing, row["name"], row["acts_on"], values))
    return found


# What terms are made of: functions with a name, not closures, so that a term can go to another process.


def _inertia(axis: str, r: Recording) -> list[Forces]:
    """Return what a mass is off by: a = f / m, so a ratio scales what is known to act; a payload is known.

    Taken as m times the measured acceleration it would, together with the force constant, shrink every rest that
    nobody explains: a fit that collapses.
    """
    known = known_forces(r)
    share = r.belief(axis).mass_kg / r.mass_kg(axis)
    if axis == "macro":
        return [Forces(macro_n=None if known.macro_n is None else -share * known.macro_n)]
    return [Forces(end_n=None if known.end_n is None else -share * known.end_n)]


def _motor(axis: str, r: Recording) -> list[Forces]:
    """Return what a force constant is off by: a ratio scales all that the motor does, its effects included.

    Without a dead band that is part of the operating point, it and the masses together seemed to say how large all
    forces are: known to 0.15 % where 0.4 % is stated, and 0.85 % off, with an offset that was 0.9 % off beside them.
    """
    if axis not in r.felt_n:
        return [Forces()]
    total = motor_forces(r, axis, r.felt_n[axis], None)
    place = "macro_actuator" if axis == "macro" else "micro_actuator"
    for row in r.believed.effects:
        if row["acts_on"] == place:
            effect = CATALOGUE[row["name"]]
            values = [row[name] for name in effect.parameters]
            add_forces(total, effect_forces(r, effect, row["acts_on"], values))
    return [Forces(total.macro_n, total.end_n)]  # a current is what was commanded, whatever it makes


def _spring(stiffness_n_per_m: float, r: Recording) -> list[Forces]:
    return _joint(r, -stiffness_n_per_m * _relative_m(r))


def _damping(damping_n_s_per_m: float, r: Recording) -> list[Forces]:
    return _joint(r, -damping_n_s_per_m * _rate(r))


def _push(sign: float, stiffness_n_per_m: float, r: Recording) -> list[Forces]:
    depth_m = 0.0 if r.penetration_m is None else r.penetration_m
    return _joint(r, np.where(r.side == sign, sign * stiffness_n_per_m * depth_m, 0.0))


def _edge(sign: float, r: Recording) -> list[Forces]:
    left_m, right_m = (SMALL_M, 0.0) if sign < 0.0 else (0.0, SMALL_M)
    return _joint(r, more_contact_n(r, 0.0, 0.0, left_m, right_m) / SMALL_M)


def _existing(name: str, place: str, values: list[float], r: Recording) -> list[Forces]:
    return [effect_forces(r, CATALOGUE[name], place, values)]


_RATIO = "error_ratio"

_WRONG_RATIO = 0.3
_WRONG_DAMPING_RATIO = 1.0
_WRONG_M = 100e-6
"""How far a known parameter may be off that competes with the effects, beyond what is stated."""


def wrong_parameter_terms(recording: Recording) -> Iterator[Term]:
    """Yield known parameters as hypotheses of their own: what is further off than its stated uncertainty allows.

    Both stiffnesses of the contact alike, and both edges alike (a gap of another width), are one hypothesis each. Times
    and single edges are none: a command delay, a sensor delay, a shifted centre are effects.
    """
    terms = {term.name: term for term, _ in parameter_terms(recording)}

    def free(name: str, forces: Callable[[Recording], list[Forces]], limit: float) -> Term:
        return Term(name, "parameter", {}, (terms_unit(name),), forces, "structural", ((-limit, limit),))

    for name, term in terms.items():
        if term.amplitudes == (_RATIO,):
            yield free(name, term.forces, _WRONG_DAMPING_RATIO if _damps(name) else _WRONG_RATIO)
    for name, parts in _BOTH_SIDES.items():
        if all(part in terms for part in parts):
            together = partial(_together, tuple(terms[part].forces for part in parts))
            yield free(name, together, _WRONG_RATIO if terms_unit(name) == _RATIO else _WRONG_M)


def _damps(parameter: str) -> bool:
    return parameter.startswith(("damping_", "contact_damping", "viscous_"))


def _together(parts: tuple[Callable[[Recording], list[Forces]], ...], r: Recording) -> list[Forces]:
    """Return the first forces of each part, added."""
    total = Forces()
    for part in parts:
        add_forces(total, part(r)[0])
    return [total]


_BOTH_SIDES = {
    "contact_stiffness_n_per_m": ("left_stiffness_n_per_m", "right_stiffness_n_per_m"),
    "backlash_width_m": ("left_m", "right_m"),
}
"""Known parameters that are wrong alike on both sides of the joint, as one hypothesis."""


def parts_of(parameter: str) -> tuple[str, ...]:
    """Return the known parameters that an error is of: itself, or both sides of the joint."""
    return _BOTH_SIDES.get(parameter, (parameter,))


def terms_unit(name: str) -> str:
    """Return what the amplitude of a wrong parameter is called: metres of an edge, else a ratio."""
    return "error_m" if name.endswith("width_m") else _RATIO


_TIMING_STEP_S = 5e-6
_TIMING_STEP_SDS = 0.5


def _timing(axis: str, lag_s: float, r: Recording) -> list[Forces]:
    """Return the error of a delay (`lag_s` = 0) or of a lag, in seconds, by a difference over what it may well be.

    What a step moves within its interval goes with the square of how early it comes: by its slope at nothing a latch
    that is stated to half a millisecond, and 270 us late, was 210 us early, behind a loop of 525 us (EMPS).
    Effects of the command path that are known come later with it: beside a delay of 350 us that was left out here, a
    latch of 6 us was known to 1 us, and the delay to 5 us where it was 13 us off.
    """
    if axis not in r.axes:
        return [Forces()]
    drive, acting = r.belief(axis), acting_on(axis, r.believed, r.at_size)
    sd_s = drive.current_loop_sd_s if lag_s else drive.latch_sd_s
    step_s = max(_TIMING_STEP_S, _TIMING_STEP_SDS * sd_s)
    changed = replace(drive, current_loop_s=lag_s + step_s) if lag_s else replace(drive, latch_s=drive.latch_s + step_s)
    now, later = (driven_by(r, axis, acting, one) for one in (drive, changed))
    slope, slope_at = ((after - before) / step_s for before, after in zip(now, later, strict=True))
    return [motor_forces(r, axis, slope, slope_at / drive.force_constant_n_per_a)]


def _joint(r: Recording, force_on_end_n: np.ndarray) -> list[Forces]:
    return [between(r, force_on_end_n)]


def _relative_m(r: Recording) -> np.ndarray:
    return -relative_motion(r)[0]


def _rate(r: Recording) -> np.ndarray:
    return -relative_motion(r)[1]


def effect_terms(recordings: Sequence[Recording], grids: dict[str, list[dict[str, float]]]) -> Iterator[Term]:
    """Yield every effect of the catalogue at every place and shape of its grid."""
    has_micro = all(r.end is not None for r in recordings)
    believed = recordings[0].believed
    present = {(row["name"], row["acts_on"]) for row in believed.effects}
    sprung = believed.joint is not None and believed.joint.spring_n_per_m > 0.0
    for effect in CATALOGUE.values():
        if effect.period:
            continue  # searched by what stands out: `periodic_terms`
        if Trait.KNOWN_PARAMETER in effect.traits and effect.places != ("contact_edge",):
            continue  # `parameter_terms` has them; an edge that is far off has to be taken at its size
        for place in effect.places:
            if place == "micro_force" and Trait.BASE in effect.traits:
                continue
            if not has_micro and (not place.startswith("macro") or _needs_micro(effect)):
                continue
            if place.startswith("contact") and recordings[0].side is None:
                continue
            if (effect.name, place) in present or (effect.name == "linear_stiffness" and place == "joint" and sprung):
                continue  # known: `wrong_parameter_terms` has it
            for shape in grids.get(effect.name, [{}]):
                yield term_of(effect, place, shape)


def periodic_terms(
    recordings: Sequence[Recording],
    axis: str,
    pitches_m: list[float],
    driven_pitches_m: list[float],
    frequencies_hz: list[float],
) -> Iterator[Term]:
    """Yield the effects that have a pitch or a frequency, at those that stand out.

    driven_pitches_m: what stands out in step with the motor's force, of which some laws are a share.
    """
    side = "macro" if axis == "macro" else "micro"
    for effect in CATALOGUE.values():
        if effect.origin and effect.name not in recordings[0].believed.own_effects:
            continue  # of another profile in this process
        pitches = driven_pitches_m if "motor_force_n" in effect.quantities else pitches_m
        found = {"pitch_m": pitches, "frequency_hz": frequencies_hz, "": []}
        for place in effect.places:
            if not place.startswith(side) or (place == "micro_force" and Trait.BASE in effect.traits):
                continue
            yield from (term_of(effect, place, {effect.period: value}) for value in found[effect.period])


def _needs_micro(effect: Effect) -> bool:
    return any(name.startswith(("micro_", "relative_", "penetration", "contact_")) for name in effect.quantities)


def term_of(effect: Effect, place: str, shape: dict[str, float]) -> Term:
    """Make the term of one effect with its shape fixed.

    Parameters that the output is linear in become columns, an amplitude with a phase a pair of them. An effect that is
    linear in nothing (a delay, a knee) is one column at its shape; its amplitude should come out as one.
    """
    linear = [name for name in effect.linear if name not in shape]
    settings: list[dict[str, float]] = []
    amplitudes: list[str] = []
    for name in linear:
        phase = phase_of(effect, name)
        for angle in (0.0, 0.5 * np.pi) if phase else (None,):
            others = {p: 0.0 for p in effect.parameters if p.endswith("phase_rad")}
            values = others | dict.fromkeys(linear, 0.0) | {name: 1.0} | shape
            if phase and angle is not None:
                values[phase] = angle
            settings.append(values)
            amplitudes.append(f"{name}*" if phase else name)
    if not linear:
        settings, amplitudes = [dict(shape)], ["share_of_shape_ratio"]

    forces = partial(_at_settings, effect.name, place, [[row[name] for name in effect.parameters] for row in settings])
    scope = _scope(effect, [name for name in linear] or [effect.parameters[0]])
    bounds = (
        tuple((-high, high) for high in (effect.bounds[name.removesuffix("*")][1] for name in amplitudes))
        if any(name.endswith("*") for name in amplitudes)
        else tuple(effect.bounds[name] for name in linear) or (_share_bounds(effect, shape),)
    )
    return Term(effect.name, place, dict(shape), tuple(amplitudes), forces, scope, bounds, bool(linear))


def term_at_size(effect: Effect, place: str, parameters: dict[str, float]) -> Term:
    """Make the term of one effect with all its parameters given; its one amplitude should come out as one."""
    values = [parameters[name] for name in effect.parameters]
    forces = partial(_at_settings, effect.name, place, [values], whole=True)
    shape = {name: parameters[name] for name in effect.parameters}
    scope = _scope(effect, [effect.parameters[0]])
    return Term(effect.name, place, shape, ("share_of_shape_ratio",), forces, scope, (_SHARE_BOUNDS,), linear=False)


def _at_settings(
    name: str, place: str, settings: list[list[float]], r: Recording, *, whole: bool = False
) -> list[Forces]:
    return [_everywhere(r, CATALOGUE[name], place, values, whole=whole) for values in settings]


def _scope(effect: Effect, amplitudes: list[str]) -> str:
    """Return how long amplitudes last, with the phases that are solved for as part of them."""
    tags = {effect.tags[name] for name in amplitudes}
    tags |= {effect.tags[phase] for phase in (phase_of(effect, name) for name in amplitudes) if phase}
    return "run" if "run" in tags else "session" if "session" in tags else "structural"


_STEP_RATIO = 1e-5
"""Share of an effect that its slope is taken over. Over 2 % of a lag of 0.5 ms an edge that is passed at 0.2 m/s moves
by 2 um: two sensors that are late by as much seemed to disagree, and each known to 0.2 us."""

DEVIATION_SD = 0.5
"""Standard deviation of a deviation term: of the size of an effect that is part of the operating point, a ratio."""


def deviation_term(effect: Effect, place: str, parameters: dict[str, float]) -> Term:
    """Make the term of a change of an effect's first parameter, a ratio, where the effect is taken out already."""
    now = [parameters[name] for name in effect.parameters]
    later = [now[0] * (1.0 + _STEP_RATIO), *now[1:]]

    forces = partial(_slope, effect.name, place, now, later)
    return Term(effect.name, place, dict(parameters), _DEVIATION, forces, "structural", ((-0.9, 2.0),), linear=False)


_DEVIATION = ("deviation_ratio",)


def is_deviation(term: Term) -> bool:
    """Tell whether a term is the slope of an effect that is part of the operating point, over its size."""
    return term.amplitudes == _DEVIATION


def _slope(name: str, place: str, now: list[float], later: list[float], r: Recording) -> list[Forces]:
    here, there = (effect_forces(r, CATALOGUE[name], place, values) for values in (now, later))
    return [scaled_forces(there, 1.0 / _STEP_RATIO, scaled_forces(here, -1.0 / _STEP_RATIO, Forces()))]


_SHARE_BOUNDS = (0.0, 3.0)


def _everywhere(r: Recording, effect: Effect, place: str, values: list[float], *, whole: bool = False) -> Forces:
    """Evaluate an effect at its place; one of the base on both bodies."""
    forces = effect_forces(r, effect, place, values, whole=whole)
    if Trait.BASE in effect.traits and r.end is not None:
        add_forces(forces, effect_forces(r, effect, "micro_force", values))
    return forces


def _share_bounds(effect: Effect, shape: dict[str, float]) -> tuple[float, float]:
    """Return what the amplitude of an effect that is linear in nothing may be: its parameter's range over its shape."""
    name = effect.parameters[0]
    low, high = effect.bounds[name]
    return (0.0 if low > 0.0 else low / shape[name]), high / shape[name]


def phase_of(effect: Effect, amplitude: str) -> str | None:
    """Return the parameter that is the phase of an amplitude."""
    for name in (f"{amplitude.split('_')[0]}_phase_rad", "phase_rad"):
        if name in effect.parameters:
            return name
    return None
