"""The platform of (1)-(5) with voltage-driven motors; what the paper prints and what holds differ by named fields.

    m1 d1'' + K1 d1 + b1 d1' + F_b [+ F_2 - K2 x_w - b2 x_w'] = F_1
    m2 a + K2 x_w + b2 x_w' - F_b = F_2,   a = d'' - d1'' as printed, d'' corrected
    u = L i' + R i + K_emf x',  F = K_m i

Readings: (2) multiplies m2 by the relative acceleration (`relative_inertia`; Newton needs the absolute one); (1) lacks
the voice coil's reaction in brackets (`reaction`); x_w = d - d1 + b puts the rest point of K2 a whole gap behind the
macro (`spring_offset_m`); with the printed x_b = d - d1 in (5) the joint is a negative spring (`coupling_sign` -1,
corrected +1: x_b = d1 - d). The corrected reading is that of `stagectl.plant`; a test holds the two together.
Pure; knows no law.
"""

import numpy as np

from stagectl.compiled import compiled, inlined
from stagectl.paper.printed_values import (
    CONTACT_DAMPING_N_S_PER_M,
    MACRO_CONSTANT_RATIO,
    MACRO_SUPPLY_V,
    MICRO_CONSTANT_RATIO,
    MICRO_SUPPLY_V,
    SPRING_N_PER_M,
    TABLE_1,
    TABLE_1_MACRO,
    TABLE_1_MICRO,
    Backlash,
)
from stagectl.paper.quasi_linear import damped, piecewise
from stagectl.signals import Record

DRIVE_VOLTAGE = 0
DRIVE_WITHOUT_INDUCTANCE = 1  # (29)
DRIVE_CURRENT = 2

STATE = np.dtype(
    [
        ("t_s", "f8"),
        ("macro_position_m", "f8"),
        ("macro_velocity_m_per_s", "f8"),
        ("end_position_m", "f8"),
        ("end_velocity_m_per_s", "f8"),
        ("macro_current_a", "f8"),
        ("micro_current_a", "f8"),
        ("contact_force_n", "f8"),
    ]
)

PARAMETERS = np.dtype(
    [
        ("macro_mass_kg", "f8"),
        ("micro_mass_kg", "f8"),
        ("base_spring_n_per_m", "f8"),
        ("base_damping_n_s_per_m", "f8"),
        ("spring_n_per_m", "f8"),
        ("damping_n_s_per_m", "f8"),
        ("left_m", "f8"),
        ("right_m", "f8"),
        ("left_stiffness_n_per_m", "f8"),
        ("right_stiffness_n_per_m", "f8"),
        ("contact_damping_n_s_per_m", "f8"),
        ("macro_resistance_ohm", "f8"),
        ("macro_inductance_h", "f8"),
        ("macro_back_emf_v_s_per_m", "f8"),
        ("macro_force_constant_n_per_a", "f8"),
        ("macro_supply_v", "f8"),
        ("micro_resistance_ohm", "f8"),
        ("micro_inductance_h", "f8"),
        ("micro_back_emf_v_s_per_m", "f8"),
        ("micro_force_constant_n_per_a", "f8"),
        ("micro_supply_v", "f8"),
        ("drive", "f8"),
        ("relative_inertia", "f8"),  # 1 as printed
        ("reaction", "f8"),  # 0 as printed
        ("coupling_sign", "f8"),  # -1 as printed
        ("spring_offset_m", "f8"),  # b as printed
        ("disturbance_n", "f8"),  # amplitude of F_ex of (27), against the micro
        ("disturbance_rad_per_s", "f8"),
    ]
)


def parameters(backlash: Backlash, contact_damping_n_s_per_m: float = CONTACT_DAMPING_N_S_PER_M) -> np.ndarray:
    """Make PARAMETERS of Table 1 in the corrected reading: linear motors, K1 = 0, K2 = 500 N/m between the stages."""
    q = np.zeros(1, PARAMETERS)
    q["macro_mass_kg"], q["micro_mass_kg"] = TABLE_1.macro_mass_kg, TABLE_1.micro_mass_kg
    q["base_damping_n_s_per_m"] = TABLE_1.base_damping_n_s_per_m
    q["spring_n_per_m"] = SPRING_N_PER_M
    q["damping_n_s_per_m"] = TABLE_1.damping_n_s_per_m
    for name in ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m"):
        q[name] = getattr(backlash, name)
    q["contact_damping_n_s_per_m"] = contact_damping_n_s_per_m
    motors = (
        ("macro", TABLE_1_MACRO, MACRO_CONSTANT_RATIO, MACRO_SUPPLY_V),
        ("micro", TABLE_1_MICRO, MICRO_CONSTANT_RATIO, MICRO_SUPPLY_V),
    )
    for name, motor, ratio, supply_v in motors:
        q[f"{name}_resistance_ohm"] = motor.resistance_ohm
        q[f"{name}_inductance_h"] = motor.inductance_h
        q[f"{name}_back_emf_v_s_per_m"] = ratio * motor.back_emf_v_s_per_rad
        q[f"{name}_force_constant_n_per_a"] = ratio * motor.force_constant_n_per_a
        q[f"{name}_supply_v"] = supply_v
    q["drive"] = DRIVE_VOLTAGE
    q["reaction"] = 1.0
    q["coupling_sign"] = 1.0
    return q


def init(position_m: float = 0.0, velocity_m_per_s: float = 0.0) -> np.ndarray:
    """Make STATE with both stages at one position and speed."""
    s = np.zeros(1, STATE)
    s["macro_position_m"] = s["end_position_m"] = position_m
    s["macro_velocity_m_per_s"] = s["end_velocity_m_per_s"] = velocity_m_per_s
    return s


@inlined
def contact_force(x1: float, v1: float, x: float, v: float, q: Record) -> float:
    """Return F_b of (5) with the joint's damping, which never pulls, N."""
    x_b = q.coupling_sign * (x1 - x)
    force = piecewise(x_b, q.left_m, q.right_m, q.left_stiffness_n_per_m, q.right_stiffness_n_per_m)
    return damped(force, q.coupling_sign * (v1 - v), q.contact_damping_n_s_per_m)


@inlined
def accelerations(
    x1: float, v1: float, x: float, v: float, macro_n: float, micro_n: float, external_n: float, q: Record
) -> tuple[float, float]:
    """Return d1'' and d'' of (1) and (2) for given motor forces, m/s^2."""
    contact_n = contact_force(x1, v1, x, v, q)
    joint_n = q.spring_n_per_m * (x - x1 + q.spring_offset_m) + q.damping_n_s_per_m * (v - v1)
    on_micro_n = micro_n - joint_n + contact_n - external_n
    on_macro_n = macro_n - q.base_spring_n_per_m * x1 - q.base_damping_n_s_per_m * v1 - contact_n
    if q.reaction != 0.0:
        on_macro_n += joint_n - micro_n
    macro = on_macro_n / q.macro_mass_kg
    end = on_micro_n / q.micro_mass_kg
    if q.relative_inertia != 0.0:
        end += macro
    return macro, end


@inlined
def currents(v1: float, v: float, i1: float, i2: float, u1: float, u2: float, q: Record) -> tuple[float, float]:
    """Return the motors' currents, A, for inputs u: states of (3), (4), or what (29) and a current drive make of u."""
    if q.drive == DRIVE_VOLTAGE:
        return i1, i2
    if q.drive == DRIVE_CURRENT:
        return u1, u2
    return (
        (u1 - q.macro_back_emf_v_s_per_m * v1) / q.macro_resistance_ohm,
        (u2 - q.micro_back_emf_v_s_per_m * (v - v1)) / q.micro_resistance_ohm,
    )


@inlined
def _rates(
    x1: float, v1: float, x: float, v: float, i1: float, i2: float, u1: float, u2: float, external_n: float, q: Record
) -> tuple[float, float, float, float]:
    """Return d1'', d'', m/s^2, of (1), (2) and di_h/dt, di_w/dt, A/s, of (3), (4)."""
    now1, now2 = currents(v1, v, i1, i2, u1, u2, q)
    macro, end = accelerations(
        x1, v1, x, v, q.macro_force_constant_n_per_a * now1, q.micro_force_constant_n_per_a * now2, external_n, q
    )
    slope1 = (u1 - q.macro_resistance_ohm * i1 - q.macro_back_emf_v_s_per_m * v1) / q.macro_inductance_h
    slope2 = (u2 - q.micro_resistance_ohm * i2 - q.micro_back_emf_v_s_per_m * (v - v1)) / q.micro_inductance_h
    return macro, end, slope1, slope2


@compiled
def advance(s: Record, q: Record, u1: float, u2: float, dt_s: float, count: int) -> None:
    """Advance (1)-(5) by `count` Runge-Kutta steps of `dt_s`, inputs held (V, or A with a current drive)."""
    x1, v1 = s.macro_position_m, s.macro_velocity_m_per_s
    x, v = s.end_position_m, s.end_velocity_m_per_s
    i1, i2 = s.macro_current_a, s.micro_current_a
    half = 0.5 * dt_s
    for _ in range(count):
        external_n = q.disturbance_n * np.sin(q.disturbance_rad_per_s * s.t_s)  # held for the step
        s.t_s += dt_s
        a1, a, b1, b2 = _rates(x1, v1, x, v, i1, i2, u1, u2, external_n, q)
        v1_2, v_2 = v1 + half * a1, v + half * a
        a1_2, a_2, b1_2, b2_2 = _rates(
            x1 + half * v1, v1_2, x + half * v, v_2, i1 + half * b1, i2 + half * b2, u1, u2, external_n, q
        )
        v1_3, v_3 = v1 + half * a1_2, v + half * a_2
        a1_3, a_3, b1_3, b2_3 = _rates(
            x1 + half * v1_2, v1_3, x + half * v_2, v_3, i1 + half * b1_2, i2 + half * b2_2, u1, u2, external_n, q
        )
        v1_4, v_4 = v1 + dt_s * a1_3, v + dt_s * a_3
        a1_4, a_4, b1_4, b2_4 = _rates(
            x1 + dt_s * v1_3, v1_4, x + dt_s * v_3, v_4, i1 + dt_s * b1_3, i2 + dt_s * b2_3, u1, u2, external_n, q
        )
        sixth = dt_s / 6.0
        x1 += sixth * (v1 + 2.0 * v1_2 + 2.0 * v1_3 + v1_4)
        x += sixth * (v + 2.0 * v_2 + 2.0 * v_3 + v_4)
        v1 += sixth * (a1 + 2.0 * a1_2 + 2.0 * a1_3 + a1_4)
        v += sixth * (a + 2.0 * a_2 + 2.0 * a_3 + a_4)
        i1 += sixth * (b1 + 2.0 * b1_2 + 2.0 * b1_3 + b1_4)
        i2 += sixth * (b2 + 2.0 * b2_2 + 2.0 * b2_3 + b2_4)
    s.macro_position_m, s.macro_velocity_m_per_s = x1, v1
    s.end_position_m, s.end_velocity_m_per_s = x, v
    s.macro_current_a, s.micro_current_a = currents(v1, v, i1, i2, u1, u2, q)
    s.contact_force_n = contact_force(x1, v1, x, v, q)
