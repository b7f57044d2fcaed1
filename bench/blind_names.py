"""What the blind sets call an effect and its numbers, and what stagectl calls them; pure.

The two were written apart, so the names, places, units and signs of one have to be said in those of the other. A
finding is translated into the words of the truth here, by this table and by nothing else.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.gap.session_values import own_sd, pooled

Key = tuple[str, str]
"""Name and place."""

Z_95 = 1.959963984540054
_REFERENCE_M = 0.1
_REFERENCE_DEPTH_M = 1e-4
_REFERENCE_N = 100.0

_FORCES = (("macro_force", "macro_force"), ("micro_force", "micro_force"))
_MACRO_FORCE = (("macro_force", "macro_force"),)
_BOTH_AXES = (("macro_force", "macro_force"), ("macro_force", "micro_force"))
_ACTUATORS = (("macro_actuator", "macro_actuator"), ("micro_actuator", "micro_actuator"))
_ACTUATORS_AS_COMMANDS = (("macro_actuator", "macro_command"), ("micro_actuator", "micro_command"))
_COMMANDS = (("macro_command", "macro_command"), ("micro_command", "micro_command"))
_SENSORS = (("macro_sensor", "macro_sensor"), ("end_sensor", "end_sensor"))
_CONTACT = (("contact", "contact"),)
_EDGE = (("contact", "contact_edge"),)

Reading = Callable[[Mapping[str, float]], float]
"""A parameter of the truth out of ours; nan where ours don't say it."""


@dataclass(frozen=True, slots=True)
class Translation:
    """One law of the truth: our name for it, where it acts in both, and its parameters out of ours.

    `beside`: our effect that stands beside ours and is part of the truth's law, which states both as one.
    """

    truth: str
    ours: str
    places: tuple[tuple[str, str], ...]  # (truth's, ours)
    parameters: Mapping[str, Reading] = field(default_factory=dict)
    beside: str | None = None


def _same(name: str, scale: float = 1.0) -> Reading:
    return lambda ours: scale * ours.get(name, math.nan)


def _ratio(top: str, bottom: str, constant: float = 0.0, scale: float = 1.0) -> Reading:
    def reading(ours: Mapping[str, float]) -> float:
        below = ours.get(bottom, math.nan)
        return constant + scale * ours.get(top, math.nan) / below if below else math.nan

    return reading


def _mean(first: str, second: str) -> Reading:
    return lambda ours: 0.5 * (ours.get(first, math.nan) + ours.get(second, math.nan))


def _asymmetry(forward: str, backward: str) -> Reading:
    def reading(ours: Mapping[str, float]) -> float:
        one, other = ours.get(forward, math.nan), ours.get(backward, math.nan)
        return (one - other) / (one + other) if one + other else math.nan

    return reading


def _angle(ours: Mapping[str, float]) -> float:
    grade = ours.get("grade_ratio", math.nan)
    return -math.asin(grade) if abs(grade) <= 1.0 else math.nan


def _loss_at_100_n(ours: Mapping[str, float]) -> float:
    # F - F^3 / (3 F_s^2), in the truth with the loss at one force
    force_n = ours.get("saturation_n", math.nan)
    return _REFERENCE_N**2 / (3.0 * force_n**2) if force_n else math.nan


def _larger(first: str, second: str) -> Reading:
    return lambda ours: max(ours.get(first, 0.0), ours.get(second, 0.0))


def _cyclic_period_m(ours: Mapping[str, float]) -> float:
    wavelength_m = ours.get("wavelength_m", math.nan)
    return 0.5 * wavelength_m if ours.get("first_m", 0.0) >= ours.get("second_m", 0.0) else 0.25 * wavelength_m


TRANSLATIONS: tuple[Translation, ...] = (
    Translation("viscous_friction", "viscous_friction", _FORCES, {"coefficient_n_s_per_m": _same("damping_n_s_per_m")}),
    Translation(
        "asymmetric_viscous_friction",
        "asymmetric_viscous_friction",
        _FORCES,
        {
            "coefficient_n_s_per_m": _mean("forward_n_s_per_m", "backward_n_s_per_m"),
            "asymmetry": _asymmetry("forward_n_s_per_m", "backward_n_s_per_m"),
        },
    ),
    Translation("coulomb_friction", "coulomb_friction", _FORCES, {"level_n": _same("level_n")}),
    Translation(
        "asymmetric_coulomb_friction",
        "asymmetric_coulomb_friction",
        _FORCES,
        {"level_n": _mean("forward_n", "backward_n"), "asymmetry": _asymmetry("forward_n", "backward_n")},
    ),
    Translation("offset", "offset", _FORCES, {"force_n": _same("force_n")}),
    # Ours is what lies above a Coulomb friction that stands beside it, the truth's has that level inside.
    Translation(
        "stribeck_friction",
        "stribeck_friction",
        _FORCES,
        {
            "level_n": _same("level_n"),
            "breakaway_ratio": _ratio("excess_n", "level_n", constant=1.0),
            "velocity_m_per_s": _same("stribeck_m_per_s"),
        },
        beside="coulomb_friction",
    ),
    Translation(
        "sublinear_friction",
        "sublinear_viscous_friction",
        _FORCES,
        {"force_at_100_mm_per_s_n": _same("level_n"), "exponent": _same("exponent_ratio")},
    ),
    Translation(
        "dahl_friction", "dahl_friction", _FORCES, {"level_n": _same("level_n"), "distance_m": _same("slip_m")}
    ),
    Translation(
        "lugre_friction",
        "lugre_friction",
        _FORCES,
        {
            "level_n": _same("level_n"),
            "breakaway_ratio": _same("static_ratio"),
            "velocity_m_per_s": _same("stribeck_m_per_s"),
            "distance_m": _same("slip_m"),
            "bristle_damping_s": _same("bristle_damping_s"),
        },
    ),
    Translation(
        "load_dependent_friction", "load_dependent_friction", _FORCES, {"coefficient": _same("coefficient_ratio")}
    ),
    Translation("quadratic_drag", "quadratic_drag", _FORCES, {"coefficient_n_s2_per_m2": _same("drag_n_s2_per_m2")}),
    Translation("cogging", "cogging", _MACRO_FORCE, {"amplitude_n": _same("amplitude_n"), "pitch_m": _same("pitch_m")}),
    Translation(
        "cogging",
        "harmonic_cogging",
        _MACRO_FORCE,
        {
            "amplitude_n": _same("first_n"),
            "pitch_m": _same("pitch_m"),
            "second_harmonic": _ratio("second_n", "first_n"),
        },
    ),
    Translation(
        "current_ripple",
        "current_ripple",
        _ACTUATORS[:1],
        {"relative": _same("ripple_ratio"), "pitch_m": _same("pitch_m")},
    ),
    Translation(
        "force_constant_saturation", "force_constant_saturation", _ACTUATORS, {"loss_at_100_n": _loss_at_100_n}
    ),
    Translation(
        "cable_spring",
        "cable_spring",
        _MACRO_FORCE,
        {"stiffness_n_per_m": _same("stiffness_n_per_m"), "anchor_m": _same("anchor_m")},
    ),
    Translation(
        "cable_hysteresis",
        "cable_hysteresis",
        _MACRO_FORCE,
        {"level_n": _same("level_n"), "distance_m": _same("slip_m")},
    ),
    # The truth writes what both axes feel as acting on the macro.
    Translation("tilt", "gravity_tilt", _BOTH_AXES, {"angle_rad": _angle}),
    Translation(
        "linear_stiffness", "linear_stiffness", _MACRO_FORCE, {"stiffness_n_per_m": _same("stiffness_n_per_m")}
    ),
    Translation(
        "cubic_stiffness",
        "cubic_stiffness",
        _MACRO_FORCE,
        {"force_at_reference_n": _same("stiffness_n_per_m3", _REFERENCE_M**3)},
    ),
    Translation(
        "cubic_stiffness",
        "cubic_stiffness",
        (("contact", "joint"),),
        {"force_at_reference_n": _same("stiffness_n_per_m3", _REFERENCE_DEPTH_M**3)},
    ),
    Translation(
        "position_dependent_friction",
        "position_dependent_friction",
        _FORCES,
        {
            "level_n": _same("level_n"),
            "slope_per_100_mm": _ratio("slope_n_per_m", "level_n", scale=_REFERENCE_M),
        },
    ),
    # The truth's right edge is where the end is ahead, ours where the macro is.
    Translation("backlash_centre", "backlash_centre_shift", _EDGE, {"shift_m": _same("shift_m", -1.0)}),
    Translation("backlash_wear", "backlash_wear", _EDGE, {"rate_m_per_s": _same("rate_m_per_s")}),
    Translation("contact_damping", "contact_damping", _CONTACT, {"damping_n_s_per_m": _same("damping_n_s_per_m")}),
    Translation("soft_contact", "soft_contact", _CONTACT, {"knee_m": _same("knee_m")}),
    Translation("contact_hysteresis", "contact_hysteresis", _CONTACT, {"loss": _same("loss_ratio")}),
    Translation("micro_reaction", "micro_reaction", _MACRO_FORCE, {"fraction": _same("fraction_ratio")}),
    Translation(
        "flexible_mode",
        "flexible_mode",
        _FORCES,
        {
            "mass_fraction": _same("share_ratio"),
            "frequency_hz": _same("frequency_hz"),
            "damping_ratio": _same("damping_ratio"),
        },
    ),
    Translation(
        "base_vibration",
        "base_vibration",
        _BOTH_AXES,
        {"acceleration_m_per_s2": _same("amplitude_m_per_s2"), "frequency_hz": _same("frequency_hz")},
    ),
    Translation("current_loop_lag", "current_loop_lag", _ACTUATORS_AS_COMMANDS, {"lag_s": _same("time_constant_s")}),
    Translation("command_delay", "command_delay", _COMMANDS, {"delay_s": _same("delay_s")}),
    Translation(
        "amplifier_dead_band", "amplifier_dead_band", _ACTUATORS_AS_COMMANDS, {"current_a": _same("half_width_a")}
    ),
    Translation("sensor_delay", "sensor_delay", _SENSORS, {"delay_s": _same("delay_s")}),
    Translation("sensor_lag", "sensor_lag", _SENSORS, {"lag_s": _same("time_constant_s")}),
    Translation("scale_error", "scale_error", _SENSORS, {"relative": _same("error_ppm", 1e-6)}),
    Translation(
        "cyclic_error",
        "cyclic_error",
        _SENSORS,
        {"amplitude_m": _larger("first_m", "second_m"), "period_m": _cyclic_period_m},
    ),
    Translation(
        "thermal_drift",
        "thermal_drift",
        _SENSORS,
        {"total_m": _same("drift_m"), "time_constant_s": _same("time_constant_s")},
    ),
    Translation("abbe_error", "abbe_error", _SENSORS, {"error_at_100_mm_m": _same("bow_per_m", _REFERENCE_M**2)}),
    # The truth's clock reads late by its share of the time, ours early.
    Translation("clock_skew", "clock_skew", _SENSORS, {"relative": _same("skew_ppm", -1e-6)}),
)
"""Every law of the truth that stagectl's library has."""

UNMAPPED: dict[str, str] = {}
"""Library laws of the truth that stagectl has no effect for, each with the reason."""

PARAMETERS: dict[str, Key] = {
    "macro_mass_kg": ("mass_error", "macro_force"),
    "micro_mass_kg": ("mass_error", "micro_force"),
    "macro_force_constant": ("force_constant_error", "macro_actuator"),
    "micro_force_constant": ("force_constant_error", "micro_actuator"),
    "spring_n_per_m": ("spring_stiffness_error", "contact"),
    "left_stiffness_n_per_m": ("contact_stiffness_error", "contact"),
    "right_stiffness_n_per_m": ("contact_stiffness_error", "contact"),
    "contact_stiffness_n_per_m": ("contact_stiffness_error", "contact"),
    "backlash_width_m": ("backlash_width", "contact"),
    "left_m": ("backlash_width", "contact"),
    "right_m": ("backlash_width", "contact"),
}
"""Known parameters that may be wrong. Both sides of the joint are one of the truth's; others keep our name."""

_BY_OURS = {(one.ours, ours): (one, truth) for one in TRANSLATIONS for truth, ours in one.places}


def truth_key(name: str, acts_on: str) -> Key:
    """Say one of our names in the truth's words; what the truth doesn't know keeps its own."""
    if name in PARAMETERS:
        return PARAMETERS[name]
    found = _BY_OURS.get((name, acts_on))
    return (name, acts_on) if found is None else (found[0].truth, found[1])


def our_keys(name: str, acts_on: str) -> tuple[Key, ...]:
    """Say a law of the truth in our words: every name and place that answers to it."""
    return tuple(
        (one.ours, ours)
        for one in TRANSLATIONS
        if one.truth == name
        for truth, ours in one.places
        if truth == acts_on or (one.places is _BOTH_AXES and acts_on == "macro_force")
    )


def in_words_of_the_truth(findings: Findings) -> dict[str, Any]:
    """Translate findings into what `tests.blind.score` marks."""
    return {
        "verdict": findings.verdict,
        "effects": _effects(findings.named),
        "parameter_errors": _parameter_errors(findings.parameter_errors),
        "not_excited": list(findings.not_excited),
    }


def _effects(named: Sequence[Named]) -> list[dict[str, Any]]:
    """Merge what the truth states as one: a law beside its Coulomb friction, and what both axes feel."""
    left = list(named)
    found: list[dict[str, Any]] = []
    for one in named:
        if not any(one is other for other in left):
            continue
        translation, acts_on = _BY_OURS.get((one.name, one.acts_on), (None, one.acts_on))
        if translation is None:
            found.append({"name": one.name, "acts_on": acts_on, "alias_set": _aliases(one), "parameters": {}})
            continue
        sizes = _plain(one)
        aliases = _aliases(one)
        for other in left:
            if other is not one and (other.name, other.acts_on) == (translation.beside, one.acts_on):
                sizes = sizes.beside(_plain(other))
                left = [kept for kept in left if kept is not other]
                found = [kept for kept in found if (kept["name"], kept["acts_on"]) != (other.name, acts_on)]
                aliases = [alias for alias in aliases if tuple(alias) != (translation.beside, acts_on)]
        if len(translation.places) > 1 and translation.places[0][0] == translation.places[1][0]:
            left = [kept for kept in left if kept is one or kept.name != one.name]
        own = (translation.truth, acts_on)
        found.append(
            {
                "name": translation.truth,
                "acts_on": acts_on,
                "alias_set": [alias for alias in aliases if tuple(alias) != own],
                "parameters": _finite({key: read(sizes.values) for key, read in translation.parameters.items()}),
                "interval": _intervals(translation, sizes),
            }
        )
    return found


def _aliases(one: Named) -> list[list[str]]:
    keys = {truth_key(alias[0], alias[1]): None for alias in one.aliases}
    return [list(key) for key in keys if key != truth_key(one.name, one.acts_on)]


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Values, their own deviations, what they are uncertain by together, as ratios, and how own errors go together."""

    values: dict[str, float]
    sds: dict[str, float]
    shared: dict[str, float]
    correlations: dict[tuple[str, str], float]

    def beside(self, other: "_Sizes") -> "_Sizes":
        """Return these and those of another law, of which these stand where both have a name."""
        return _Sizes(
            other.values | self.values,
            other.sds | self.sds,
            other.shared | self.shared,
            {two: one for two, one in other.correlations.items() if not {*two} & {*self.values}} | self.correlations,
        )


def _plain(one: Named) -> _Sizes:
    """Pool what was fitted session by session, or run by run, into one value each: the truth has one amplitude."""
    values: dict[str, float] = {}
    sds: dict[str, float] = {}
    by_name: dict[str, list[tuple[float, float]]] = {}
    for key, value in one.parameters.items():
        name, _, place = key.partition(" of ")
        sd = one.sds.get(key)
        if sd is not None:
            by_name.setdefault(name, []).append((value, sd))
        elif not place:
            values[name] = value
    common = one.common_sd_ratio
    for name, pairs in by_name.items():
        values[name], sd = pooled([value for value, _ in pairs], [sd for _, sd in pairs], common)
        sds[name] = own_sd(values[name], sd, common)
    correlations = {}
    for first, second, correlation in one.correlations:
        if first in sds and second in sds:  # of what was fitted once for all
            own = correlation * one.sds[first] * one.sds[second] - common**2 * values[first] * values[second]
            correlations[first, second] = max(-1.0, min(1.0, own / (sds[first] * sds[second])))
    return _Sizes(values, sds, dict.fromkeys(sds, common), correlations)


def _finite(values: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _intervals(translation: Translation, sizes: _Sizes) -> dict[str, tuple[float, float]]:
    """Carry 95 % intervals over by the slopes of each reading: root of the sum of squares of its parts and of products.

    What all values are uncertain by together is one of the parts: two levels of a friction that are both as uncertain
    as the scale of forces is have a mean that is no less so, and a ratio that is not. Two that both are what a stated
    friction may be wrong by have no better mean either: 11.7 +- 5.3 was stated where 18.1 was true.
    """
    values = sizes.values
    found: dict[str, tuple[float, float]] = {}
    together = {key: values[key] * (1.0 + ratio) for key, ratio in sizes.shared.items() if key in values}
    for name, read in translation.parameters.items():
        centre = read(values)
        parts = {
            key: read({**values, key: values[key] + sd}) - centre for key, sd in sizes.sds.items() if key in values
        }
        variance = sum(part * part for part in parts.values()) + (read({**values, **together}) - centre) ** 2
        variance += 2.0 * sum(r * parts[a] * parts[b] for (a, b), r in sizes.correlations.items())
        spread = math.sqrt(max(variance, 0.0)) * Z_95
        if math.isfinite(centre) and spread > 0.0 and math.isfinite(spread):
            found[name] = (centre - spread, centre + spread)
    return found


def _parameter_errors(errors: Sequence[ParameterError]) -> list[dict[str, Any]]:
    """Translate wrong parameters; both sides of the joint are one."""
    found: dict[Key, dict[str, Any]] = {}
    for error in errors:
        key = PARAMETERS.get(error.name, (error.name, "parameter"))
        row = found.setdefault(key, {"name": key[0], "acts_on": key[1], "alias_set": []})
        for alias in getattr(error, "aliases", ()):
            other = truth_key(*alias[:2]) if not isinstance(alias, str) else truth_key(alias, "parameter")
            if other != key and list(other) not in row["alias_set"]:
                row["alias_set"].append(list(other))
    return list(found.values())
