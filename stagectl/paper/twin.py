"""Section 6.2's comparison: one stage that is believed, one that has something more, under the same PID.

The plant is the project's own (`stagectl.plant`) with effects of its library: every one is there, most at strength
nought, so that one composition serves all. The PID has a triple pole on each axis and works on positions alone.
Knows no number of the paper.
"""

from dataclasses import dataclass, field

import numpy as np

from stagectl import compose, plant
from stagectl.paper.printed_values import RIG_6_1, TABLE_1
from stagectl.paper.references import Reference

DT_S = 1e-3
_LONGEST_SUBSTEP_S = 1e-4
_CONTACT_DAMPING_N_S_PER_M = 75.0

_EFFECTS = (
    {"name": "viscous_friction", "acts_on": "macro_force", "damping_n_s_per_m": 5.0},
    {"name": "micro_reaction", "acts_on": "macro_force", "fraction_ratio": 1.0},
    {"name": "coulomb_friction", "acts_on": "macro_force", "level_n": 0.0, "smoothing_m_per_s": 1e-3},
    {"name": "cogging", "acts_on": "macro_force", "amplitude_n": 0.0, "pitch_m": 0.024, "phase_rad": 0.4},
    {"name": "cable_spring", "acts_on": "micro_force", "stiffness_n_per_m": 0.0, "anchor_m": 0.0},
    {"name": "force_constant_error", "acts_on": "micro_actuator", "error_ratio": 0.0},
    {"name": "contact_damping", "acts_on": "contact", "damping_n_s_per_m": _CONTACT_DAMPING_N_S_PER_M},
)

_LOOP = '''
@compiled
def run(reference, state, parameters, effect_parameters, pid, centre_m, feed_forward_ratio, delay, lag_s, dt_s,
        longest_s, out):
    """Follow `reference` (position, velocity, acceleration); `out` gets what is seen of the end, and contact force."""
    s = state[0]
    q = parameters[0]
    errors = np.zeros(2)
    integrals = np.zeros(2)
    held = np.zeros(2)
    asked = np.zeros(2)
    seen = np.array([s.macro_position_m, s.end_position_m])
    share = 1.0 if lag_s == 0.0 else 1.0 - np.exp(-dt_s / lag_s)
    for k in range(reference.shape[0]):
        seen[0] += share * (s.macro_position_m - seen[0])
        seen[1] += share * (s.end_position_m - seen[1])
        out[k, 0], out[k, 1] = seen[1], s.contact_force_n
        for axis in range(2):
            error = reference[k, 0] - seen[axis]
            if axis == 0:
                error += centre_m
            rate = (error - errors[axis]) / dt_s if k > 0 else 0.0
            errors[axis] = error
            integrals[axis] += error * dt_s
            held[axis] = asked[axis]
            asked[axis] = pid[axis, 0] * error + pid[axis, 1] * integrals[axis] + pid[axis, 2] * rate
        asked[0] += feed_forward_ratio * q.macro_mass_kg * reference[k, 2]
        forces = held if delay else asked
        plant_module.advance(state, parameters, effect_parameters, (k + 1) * dt_s, longest_s,
                             forces[0] / q.macro_force_constant_n_per_a, forces[1] / q.micro_force_constant_n_per_a,
                             1, 1)
'''


@dataclass(frozen=True, slots=True)
class Strengths:
    """What a stage has beyond the believed one; the believed one has the defaults."""

    coulomb_n: float = 0.0
    cogging_n: float = 0.0
    cable_n_per_m: float = 0.0
    force_constant_error_ratio: float = 0.0
    contact_damping_n_s_per_m: float = _CONTACT_DAMPING_N_S_PER_M
    reaction_ratio: float = 1.0
    width_ratio: float = 1.0
    stiffness_ratio: float = 1.0
    delayed: bool = False  # commands act a cycle later
    sensor_lag_s: float = 0.0  # of both positions, inside the loop
    record_lag_s: float = 0.0  # of the recorded end alone

    def effects(self) -> list[dict]:
        """Return the effect tables with these strengths."""
        changed = {
            "micro_reaction": ("fraction_ratio", self.reaction_ratio),
            "coulomb_friction": ("level_n", self.coulomb_n),
            "cogging": ("amplitude_n", self.cogging_n),
            "cable_spring": ("stiffness_n_per_m", self.cable_n_per_m),
            "force_constant_error": ("error_ratio", self.force_constant_error_ratio),
            "contact_damping": ("damping_n_s_per_m", self.contact_damping_n_s_per_m),
        }
        tables = [dict(row) for row in _EFFECTS]
        for row in tables:
            if row["name"] in changed:
                name, value = changed[row["name"]]
                row[name] = value
        return tables


@dataclass(frozen=True, slots=True)
class Servo:
    """Bandwidths of both PIDs, and whether the macro knows its acceleration beforehand."""

    macro_hz: float
    micro_hz: float
    macro_feed_forward_ratio: float

    def gains(self) -> np.ndarray:
        """Return proportional, integral and derivative gain of macro and micro, N/m, N/(m s), N s/m, shape (2, 3)."""
        rows = []
        for hz, mass_kg in ((self.macro_hz, TABLE_1.macro_mass_kg), (self.micro_hz, TABLE_1.micro_mass_kg)):
            w = 2.0 * np.pi * hz
            rows.append((3.0 * w * w * mass_kg, w**3 * mass_kg, 3.0 * w * mass_kg))
        return np.array(rows)


@dataclass(frozen=True, slots=True)
class Followed:
    """What the sensors showed of the end, and the true contact force, one element a cycle, shapes (n,)."""

    reference: Reference
    end_m: np.ndarray
    contact_n: np.ndarray = field(repr=False)


def _parameters(strengths: Strengths) -> np.ndarray:
    p = np.zeros(1, plant.PLANT_PARAMETERS)
    p["macro_mass_kg"], p["micro_mass_kg"] = TABLE_1.macro_mass_kg, TABLE_1.micro_mass_kg
    p["spring_n_per_m"], p["damping_n_s_per_m"] = 500.0, 5.0
    p["left_m"], p["right_m"] = RIG_6_1.left_m * strengths.width_ratio, RIG_6_1.right_m * strengths.width_ratio
    p["left_stiffness_n_per_m"] = RIG_6_1.left_stiffness_n_per_m * strengths.stiffness_ratio
    p["right_stiffness_n_per_m"] = RIG_6_1.right_stiffness_n_per_m * strengths.stiffness_ratio
    p["stroke_low_m"] = p["travel_low_m"] = -np.inf
    p["stroke_high_m"] = p["travel_high_m"] = np.inf
    for axis in ("macro", "micro"):
        p[f"{axis}_force_constant_n_per_a"] = 100.0 if axis == "macro" else 30.0
        p[f"{axis}_current_loop_s"] = 0.15e-3
        p[f"{axis}_resistance_ohm"] = p[f"{axis}_inductance_h"] = 1.0
        p[f"{axis}_current_limit_a"], p[f"{axis}_supply_v"] = 1e6, 1e12
    p["has_micro"] = 1.0
    return p


def follow(reference: Reference, servo: Servo, strengths: Strengths | None = None) -> Followed:
    """Run a stage of these strengths along a reference; the believed one for None. It begins on the reference."""
    strengths = Strengths() if strengths is None else strengths
    effects = strengths.effects()
    plant_module = compose.plant_module(effects)
    source = (
        '"""Generated: one stage under a PID."""\nimport numpy as np\n\n'
        f"import {plant_module.__name__} as plant_module\nfrom stagectl.compiled import compiled\n" + _LOOP
    )
    centre_m = 0.5 * (RIG_6_1.right_m - RIG_6_1.left_m)  # the controller believes the nominal gap
    state = np.zeros(1, plant.PLANT_STATE)
    state["end_position_m"] = reference.position_m[0]
    state["macro_position_m"] = reference.position_m[0] + centre_m
    state["macro_velocity_m_per_s"] = state["end_velocity_m_per_s"] = reference.velocity_m_per_s[0]
    out = np.zeros((reference.position_m.size, 2))
    compose.generated_module("twin", source).run(
        np.ascontiguousarray(reference.columns()), state, _parameters(strengths), compose.effect_parameters(effects),
        servo.gains(), centre_m, servo.macro_feed_forward_ratio, strengths.delayed, strengths.sensor_lag_s, DT_S,
        _LONGEST_SUBSTEP_S, out,
    )  # fmt: skip
    end_m = out[:, 0]
    if strengths.record_lag_s > 0.0:
        end_m = np.interp(reference.t_s - strengths.record_lag_s, reference.t_s, end_m)
    return Followed(reference, end_m, out[:, 1])
