"""The machine: two masses, a joint with backlash, two motors with current loops (Kang et al. 2023, (1)-(5)).

Corrected reading: absolute acceleration in (2), x_b = d1 - d in (5), the spring K2 centred in the gap,
the voice coil's reaction on the macro (an effect). With x = macro, d = end:

    m1 x'' = F1 + effects - K1 x + K2 (d - x) + b2 (d' - x') - F_b + stop
    m2 d'' = F2 + effects        - K2 (d - x) - b2 (d' - x') + F_b - stop

Time advances by substeps: positions drift half a step, forces are taken there once (velocities
extrapolated with the last acceleration), then velocities kick and positions drift again; second order,
one evaluation of the forces a substep. The calls of the effects stand in a generated module
(`stagectl.compose`), between `half_step` and `full_step`. Pure; knows no bus and no clock.
"""

from typing import Any

import numpy as np

from stagectl.compiled import compiled, inlined
from stagectl.signals import Record

BRIDGE_OFF = 0
BRIDGE_CURRENT = 1
BRIDGE_SHORTED = 2

MEMORY_COUNT = 64
"""Floats that the effects of one machine may remember, all together."""

_SAME_DT_RATIO = 1e-8  # spans of equal length differ by what rounding of their ends leaves
_NOISE_SLOT_S = 1e-3  # force noise is held for a millisecond, whatever the substeps, so that both seams feel the same

PLANT_STATE = np.dtype(
    [
        ("t_s", "f8"),
        ("macro_position_m", "f8"),
        ("macro_velocity_m_per_s", "f8"),
        ("macro_acceleration_m_per_s2", "f8"),
        ("end_position_m", "f8"),
        ("end_velocity_m_per_s", "f8"),
        ("end_acceleration_m_per_s2", "f8"),
        ("macro_current_a", "f8"),
        ("micro_current_a", "f8"),
        ("macro_force_n", "f8"),  # motor forces with actuator effects, mean over the last substep
        ("micro_force_n", "f8"),
        ("contact_force_n", "f8"),  # F_b of (5) with contact effects: retards the macro, drives the end
        ("macro_position_integral_m_s", "f8"),
        ("end_position_integral_m_s", "f8"),
        ("noise_from_s", "f8"),  # slot of time that the force noise below is held for
        ("noise_until_s", "f8"),
        ("macro_disturbance_n", "f8"),  # a machine's force noise, or what an observer takes for it
        ("micro_disturbance_n", "f8"),
        ("decay_dt_s", "f8"),  # the substep that the decays below belong to
        ("macro_decay_ratio", "f8"),
        ("micro_decay_ratio", "f8"),
        ("macro_mean_ratio", "f8"),  # mean of the decay over the substep
        ("micro_mean_ratio", "f8"),
        ("other_decay_dt_s", "f8"),  # the same of the other substep: a cycle has one before and one behind SYNC
        ("other_macro_decay_ratio", "f8"),
        ("other_micro_decay_ratio", "f8"),
        ("other_macro_mean_ratio", "f8"),
        ("other_micro_mean_ratio", "f8"),
        ("middle_macro_position_m", "f8"),  # of the substep under way
        ("middle_macro_velocity_m_per_s", "f8"),
        ("middle_end_position_m", "f8"),
        ("middle_end_velocity_m_per_s", "f8"),
        ("penetration_m", "f8"),
        ("penetration_velocity_m_per_s", "f8"),
        ("contact_side", "f8"),  # +1 right (x_b > b_r), -1 left, 0 in the gap
        ("left_edge_shift_m", "f8"),  # by which effects move an edge of the gap outward
        ("right_edge_shift_m", "f8"),
        ("memory", "f8", (MEMORY_COUNT,)),  # of effects, each its slice (`stagectl.compose`); stands last
    ]
)

PLANT_PARAMETERS = np.dtype(
    [
        ("macro_mass_kg", "f8"),
        ("micro_mass_kg", "f8"),
        ("base_spring_n_per_m", "f8"),
        ("spring_n_per_m", "f8"),
        ("damping_n_s_per_m", "f8"),
        ("left_m", "f8"),
        ("right_m", "f8"),
        ("left_stiffness_n_per_m", "f8"),
        ("right_stiffness_n_per_m", "f8"),
        ("stroke_low_m", "f8"),
        ("stroke_high_m", "f8"),
        ("stroke_stiffness_n_per_m", "f8"),
        ("stroke_damping_n_s_per_m", "f8"),
        ("travel_low_m", "f8"),
        ("travel_high_m", "f8"),
        ("travel_stiffness_n_per_m", "f8"),
        ("travel_damping_n_s_per_m", "f8"),
        ("macro_force_constant_n_per_a", "f8"),
        ("macro_back_emf_v_s_per_m", "f8"),
        ("macro_resistance_ohm", "f8"),
        ("macro_inductance_h", "f8"),
        ("macro_supply_v", "f8"),
        ("macro_current_limit_a", "f8"),
        ("macro_current_loop_s", "f8"),
        ("micro_force_constant_n_per_a", "f8"),
        ("micro_back_emf_v_s_per_m", "f8"),
        ("micro_resistance_ohm", "f8"),
        ("micro_inductance_h", "f8"),
        ("micro_supply_v", "f8"),
        ("micro_current_limit_a", "f8"),
        ("micro_current_loop_s", "f8"),
        ("macro_noise_n", "f8"),
        ("micro_noise_n", "f8"),
        ("seed", "f8"),
        ("draws_noise", "f8"),  # 1 for a machine, 0 for a belief: an observer sets the disturbances itself
        ("has_micro", "f8"),
    ]
)

_MOTOR_FIELDS = (
    ("force_constant_n_per_a", "force_constant_n_per_a"),
    ("back_emf_v_s_per_m", "back_emf_v_s_per_m"),
    ("resistance_ohm", "resistance_ohm"),
    ("inductance_h", "inductance_h"),
    ("supply_v", "supply_v"),
    ("current_limit_a", "current_limit_a"),
    ("current_loop_s", "current_loop_s"),
)


def parameters(machine: Any, seed: int = 0) -> np.ndarray:
    """Make PLANT_PARAMETERS from a machine (attributes named as in a machine file)."""
    q = np.zeros(1, PLANT_PARAMETERS)
    macro, micro, backlash = machine.macro, machine.micro, machine.backlash
    q["seed"] = seed
    q["draws_noise"] = 1.0
    q["macro_mass_kg"] = macro.mass_kg
    q["base_spring_n_per_m"] = macro.base_spring_n_per_m
    q["travel_low_m"], q["travel_high_m"] = macro.travel_m
    q["travel_stiffness_n_per_m"] = macro.stop_stiffness_n_per_m
    q["travel_damping_n_s_per_m"] = macro.stop_damping_n_s_per_m
    q["macro_noise_n"] = macro.force_noise_n
    for ours, theirs in _MOTOR_FIELDS:
        q[f"macro_{ours}"] = getattr(macro, theirs)
        q[f"micro_{ours}"] = getattr(micro if micro is not None else macro, theirs)
    q["micro_mass_kg"] = 1.0
    if micro is not None:
        q["has_micro"] = 1.0
        q["micro_mass_kg"] = micro.mass_kg
        q["spring_n_per_m"] = micro.spring_n_per_m
        q["damping_n_s_per_m"] = micro.damping_n_s_per_m
        q["stroke_low_m"], q["stroke_high_m"] = micro.stroke_m
        q["stroke_stiffness_n_per_m"] = micro.stop_stiffness_n_per_m
        q["stroke_damping_n_s_per_m"] = micro.stop_damping_n_s_per_m
        q["micro_noise_n"] = micro.force_noise_n
        q["left_m"] = backlash.left_m
        q["right_m"] = backlash.right_m
        q["left_stiffness_n_per_m"] = backlash.left_stiffness_n_per_m
        q["right_stiffness_n_per_m"] = backlash.right_stiffness_n_per_m
    return q


def init(machine: Any) -> np.ndarray:
    """Make PLANT_STATE at rest where the machine starts."""
    s = np.zeros(1, PLANT_STATE)
    s["macro_position_m"] = machine.start.macro_position_m
    s["end_position_m"] = machine.start.macro_position_m
    if machine.micro is not None:
        s["end_position_m"] += machine.start.relative_position_m
    return s


@compiled
def _mixed(value: np.uint64) -> np.uint64:
    """Spread the bits of a 64-bit counter (splitmix64, Steele, Lea, Flood 2014)."""
    z = value + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled
def _gaussian(counter: np.uint64) -> float:
    """Return a standard normal number for a counter (Box-Muller on two mixed counters)."""
    a = _mixed(np.uint64(2) * counter)
    b = _mixed(np.uint64(2) * counter + np.uint64(1))
    u = (float(a >> np.uint64(11)) + 0.5) / 9007199254740992.0
    w = float(b >> np.uint64(11)) / 9007199254740992.0
    return np.sqrt(-2.0 * np.log(u)) * np.cos(2.0 * np.pi * w)


@compiled
def _draw_noise(s: Record, q: Record) -> None:
    """Renew the held force noise when a new slot of time begins; depends on time and seed only."""
    t_s = s.t_s + 1e-9
    if t_s < s.noise_from_s or t_s >= s.noise_until_s:
        slot = np.floor(t_s / _NOISE_SLOT_S)
        s.noise_from_s = slot * _NOISE_SLOT_S
        s.noise_until_s = (slot + 1.0) * _NOISE_SLOT_S
        counter = np.uint64(slot) * np.uint64(2) + np.uint64(q.seed) * np.uint64(0x100000000)
        s.macro_disturbance_n = q.macro_noise_n * _gaussian(counter)
        s.micro_disturbance_n = q.micro_noise_n * _gaussian(counter + np.uint64(1))


@compiled
def _take_decays(s: Record, q: Record, dt_s: float) -> None:
    """Bring the current loops' decays for this substep to the front; two are kept, exponentials are dear."""
    s.decay_dt_s, s.other_decay_dt_s = s.other_decay_dt_s, s.decay_dt_s
    s.macro_decay_ratio, s.other_macro_decay_ratio = s.other_macro_decay_ratio, s.macro_decay_ratio
    s.micro_decay_ratio, s.other_micro_decay_ratio = s.other_micro_decay_ratio, s.micro_decay_ratio
    s.macro_mean_ratio, s.other_macro_mean_ratio = s.other_macro_mean_ratio, s.macro_mean_ratio
    s.micro_mean_ratio, s.other_micro_mean_ratio = s.other_micro_mean_ratio, s.micro_mean_ratio
    if not abs(dt_s - s.decay_dt_s) <= _SAME_DT_RATIO * dt_s:
        s.decay_dt_s = dt_s
        s.macro_decay_ratio = np.exp(-dt_s / q.macro_current_loop_s)
        s.micro_decay_ratio = np.exp(-dt_s / q.micro_current_loop_s)
        s.macro_mean_ratio = (1.0 - s.macro_decay_ratio) * q.macro_current_loop_s / dt_s
        s.micro_mean_ratio = (1.0 - s.micro_decay_ratio) * q.micro_current_loop_s / dt_s


@inlined
def _current_step(
    i: float,
    command: float,
    bridge: int,
    v: float,
    dt_s: float,
    loop_decay: float,
    loop_mean: float,
    limit: float,
    loop_s: float,
    r: float,
    ind: float,
    ke: float,
    supply: float,
) -> tuple[float, float]:
    """Return (current after, mean current over) `dt_s`: L di/dt = u - R i - Ke v, (3).

    An ideal PI loop holds u such that the current follows its command with time constant `loop_s`
    until the supply voltage is reached.
    """
    if bridge == BRIDGE_CURRENT:
        goal = min(max(command, -limit), limit)
        u_s = ind * (goal - i) + (r * i + ke * v) * loop_s  # voltage times `loop_s`: no division
        if u_s > supply * loop_s or u_s < -supply * loop_s:
            u = supply if u_s > 0.0 else -supply
            slope = (u - r * i - ke * v) / ind
            return i + slope * dt_s, i + 0.5 * slope * dt_s
        return goal + (i - goal) * loop_decay, goal + (i - goal) * loop_mean
    if bridge == BRIDGE_SHORTED:
        goal = -ke * v / r
        tau = ind / r
        decay = np.exp(-dt_s / tau)
        return goal + (i - goal) * decay, goal + (i - goal) * (1.0 - decay) * tau / dt_s
    return 0.0, 0.0


@inlined
def half_step(
    s: Record,
    q: Record,
    dt_s: float,
    macro_command_a: float,
    micro_command_a: float,
    macro_bridge: int,
    micro_bridge: int,
) -> None:
    """Drift to the middle of the substep and take motor forces and contact geometry there."""
    if q.draws_noise != 0.0:
        _draw_noise(s, q)
    if not abs(dt_s - s.decay_dt_s) <= _SAME_DT_RATIO * dt_s:
        _take_decays(s, q, dt_s)
    half = 0.5 * dt_s
    s.middle_macro_position_m = s.macro_position_m + half * s.macro_velocity_m_per_s
    s.middle_macro_velocity_m_per_s = s.macro_velocity_m_per_s + half * s.macro_acceleration_m_per_s2
    i, mean = _current_step(
        s.macro_current_a,
        macro_command_a,
        macro_bridge,
        s.macro_velocity_m_per_s,
        dt_s,
        s.macro_decay_ratio,
        s.macro_mean_ratio,
        q.macro_current_limit_a,
        q.macro_current_loop_s,
        q.macro_resistance_ohm,
        q.macro_inductance_h,
        q.macro_back_emf_v_s_per_m,
        q.macro_supply_v,
    )
    s.macro_current_a = i
    s.macro_force_n = q.macro_force_constant_n_per_a * mean
    if q.has_micro == 0.0:
        return
    s.middle_end_position_m = s.end_position_m + half * s.end_velocity_m_per_s
    s.middle_end_velocity_m_per_s = s.end_velocity_m_per_s + half * s.end_acceleration_m_per_s2
    i, mean = _current_step(
        s.micro_current_a,
        micro_command_a,
        micro_bridge,
        s.end_velocity_m_per_s - s.macro_velocity_m_per_s,
        dt_s,
        s.micro_decay_ratio,
        s.micro_mean_ratio,
        q.micro_current_limit_a,
        q.micro_current_loop_s,
        q.micro_resistance_ohm,
        q.micro_inductance_h,
        q.micro_back_emf_v_s_per_m,
        q.micro_supply_v,
    )
    s.micro_current_a = i
    s.micro_force_n = q.micro_force_constant_n_per_a * mean
    x_b = s.middle_macro_position_m - s.middle_end_position_m
    rate = s.middle_macro_velocity_m_per_s - s.middle_end_velocity_m_per_s
    right_m = q.right_m + s.right_edge_shift_m
    left_m = q.left_m + s.left_edge_shift_m
    if x_b > right_m:
        s.contact_side = 1.0
        s.penetration_m = x_b - right_m
        s.penetration_velocity_m_per_s = rate
    elif x_b < -left_m:
        s.contact_side = -1.0
        s.penetration_m = -left_m - x_b
        s.penetration_velocity_m_per_s = -rate
    else:
        s.contact_side = 0.0
        s.penetration_m = 0.0
        s.penetration_velocity_m_per_s = 0.0


@inlined
def _stop_force(x: float, v: float, low: float, high: float, stiffness: float, damping: float) -> float:
    """Push of a hard stop on a body at x: zero between `low` and `high`, never pulling."""
    if x > high:
        return -max(stiffness * (x - high) + damping * v, 0.0)
    if x < low:
        return max(stiffness * (low - x) - damping * v, 0.0)
    return 0.0


@inlined
def contact_stiffness(s: Record, q: Record) -> float:
    """Return the stiffness of the side that touches."""
    return q.right_stiffness_n_per_m if s.contact_side > 0.0 else q.left_stiffness_n_per_m


@inlined
def joint_force(s: Record, q: Record, contact_effects_n: float) -> float:
    """Return the force of spring, damping, contact and stroke stops on the end at the middle, opposite on the macro."""
    relative_m = s.middle_end_position_m - s.middle_macro_position_m
    relative_m_per_s = s.middle_end_velocity_m_per_s - s.middle_macro_velocity_m_per_s
    force_n = -q.spring_n_per_m * relative_m - q.damping_n_s_per_m * relative_m_per_s
    force_n += _stop_force(
        relative_m,
        relative_m_per_s,
        q.stroke_low_m,
        q.stroke_high_m,
        q.stroke_stiffness_n_per_m,
        q.stroke_damping_n_s_per_m,
    )
    s.contact_force_n = 0.0
    if s.contact_side != 0.0:
        s.contact_force_n = s.contact_side * max(contact_stiffness(s, q) * s.penetration_m + contact_effects_n, 0.0)
    return force_n + s.contact_force_n


@inlined
def base_force(s: Record, q: Record) -> float:
    """Return the force of the base on the macro at the middle motion: K1 and the travel's stops."""
    stop_n = _stop_force(
        s.middle_macro_position_m,
        s.middle_macro_velocity_m_per_s,
        q.travel_low_m,
        q.travel_high_m,
        q.travel_stiffness_n_per_m,
        q.travel_damping_n_s_per_m,
    )
    return stop_n - q.base_spring_n_per_m * s.middle_macro_position_m


@inlined
def full_step(
    s: Record, q: Record, dt_s: float, macro_effects_n: float, micro_effects_n: float, contact_effects_n: float
) -> None:
    """Kick with all forces of the middle, then drift to the end of the substep."""
    macro_n = s.macro_force_n + s.macro_disturbance_n + macro_effects_n + base_force(s, q)
    old_macro_m = s.macro_position_m
    old_end_m = s.end_position_m
    half = 0.5 * dt_s
    if q.has_micro != 0.0:
        joint_n = joint_force(s, q, contact_effects_n)
        macro_n -= joint_n
        micro_n = s.micro_force_n + s.micro_disturbance_n + micro_effects_n + joint_n
        s.end_acceleration_m_per_s2 = micro_n / q.micro_mass_kg
        s.end_velocity_m_per_s += s.end_acceleration_m_per_s2 * dt_s
        s.end_position_m = s.middle_end_position_m + half * s.end_velocity_m_per_s
    s.macro_acceleration_m_per_s2 = macro_n / q.macro_mass_kg
    s.macro_velocity_m_per_s += s.macro_acceleration_m_per_s2 * dt_s
    s.macro_position_m = s.middle_macro_position_m + half * s.macro_velocity_m_per_s
    if q.has_micro == 0.0:
        s.end_position_m = s.macro_position_m
        s.end_velocity_m_per_s = s.macro_velocity_m_per_s
    s.macro_position_integral_m_s += half * (old_macro_m + s.macro_position_m)
    s.end_position_integral_m_s += half * (old_end_m + s.end_position_m)
    s.t_s += dt_s
