"""Friction: forces against the motion. tanh(v / v_s) stands for the sign of the velocity, so that it can be fitted."""

import numpy as np

from stagectl.effects.declaration import effect
from stagectl.effects.elementary import fading

_AXES = ("macro_force", "micro_force")
_SMOOTHING = (1e-7, 1e-1)  # m/s
_NAMED_SPEED_M_PER_S = 0.1  # at which the sub-linear law's force is named
_LEAST_SPEED_M_PER_S = 1e-6
"""Below it the sub-linear law is linear: its slope at rest would be infinite. From 0.1 mm/s on, what a stage feels in
reversals of a few micrometres is another law, of which a Stribeck friction at 0.11 mm/s was found to be missing."""


@effect(
    places=_AXES,
    damping_n_s_per_m=(0.0, 1e5),
    linear=("damping_n_s_per_m",),
    shown_by="strokes",
    symptom="odd in velocity and proportional to it",
    reference="Kang et al. 2023, (1) and (2), b1 and b2",
)
def viscous_friction(velocity_m_per_s, damping_n_s_per_m):
    """Viscous friction: F = -b v."""
    return -damping_n_s_per_m * velocity_m_per_s


@effect(
    places=_AXES,
    forward_n_s_per_m=(0.0, 1e5),
    backward_n_s_per_m=(0.0, 1e5),
    linear=("forward_n_s_per_m", "backward_n_s_per_m"),
    shown_by="strokes",
    symptom="proportional to velocity, with another slope in each direction",
    reference="Janot, Young, Gautier, Int. J. Control 90(3), 2017: the EMPS axis, 167 and 240 N s/m",
)
def asymmetric_viscous_friction(velocity_m_per_s, forward_n_s_per_m, backward_n_s_per_m):
    """Viscous friction with a slope for each direction: F = -b+ v for v > 0, -b- v for v < 0."""
    forward = np.maximum(velocity_m_per_s, 0.0)
    return -forward_n_s_per_m * forward - backward_n_s_per_m * (velocity_m_per_s - forward)


@effect(
    places=_AXES,
    level_n=(0.0, 1e3),
    smoothing_m_per_s=_SMOOTHING,
    linear=("level_n",),
    shown_by="low speed",
    symptom="odd in velocity; a step at each reversal",
    reference="Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994",
)
def coulomb_friction(velocity_m_per_s, level_n, smoothing_m_per_s):
    """Dry friction of constant size against the motion: F = -F_c tanh(v / v_s)."""
    return -level_n * np.tanh(velocity_m_per_s / smoothing_m_per_s)


@effect(
    places=_AXES,
    forward_n=(0.0, 1e3),
    backward_n=(0.0, 1e3),
    smoothing_m_per_s=_SMOOTHING,
    linear=("forward_n", "backward_n"),
    shown_by="low speed",
    symptom="a step at each reversal, of another size in each direction; an offset looks like the difference",
    reference="Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994, section 2",
)
def asymmetric_coulomb_friction(velocity_m_per_s, forward_n, backward_n, smoothing_m_per_s):
    """Dry friction with a level for each direction: F = -F+ tanh(v / v_s) for v > 0, -F- tanh(v / v_s) for v < 0."""
    sign = np.tanh(velocity_m_per_s / smoothing_m_per_s)
    forward = np.maximum(sign, 0.0)
    return -forward_n * forward - backward_n * (sign - forward)


@effect(
    places=_AXES,
    excess_n=(0.0, 1e3),
    stribeck_m_per_s=(1e-6, 1.0),
    smoothing_m_per_s=_SMOOTHING,
    linear=("excess_n",),
    searched=("stribeck_m_per_s",),
    shown_by="low speed",
    symptom="odd in velocity; friction rises towards standstill, over a few mm/s",
    reference="Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994, (7) with exponent 2",
)
def stribeck_friction(velocity_m_per_s, excess_n, stribeck_m_per_s, smoothing_m_per_s):
    """Stribeck friction, what is above the Coulomb level: F = -dF exp(-(v / v_S)^2) tanh(v / v_s)."""
    ratio = velocity_m_per_s / stribeck_m_per_s
    return -excess_n * np.exp(-ratio * ratio) * np.tanh(velocity_m_per_s / smoothing_m_per_s)


@effect(
    places=_AXES,
    level_n=(0.0, 1e3),
    exponent_ratio=(0.1, 0.95),
    linear=("level_n",),
    searched=("exponent_ratio",),
    shown_by="low speed",
    symptom="odd in velocity; grows fast at low speed and slowly at high speed",
    reference="Waiboer, Aarts, Jonker, ASME DETC 2005: asperity and viscous part of joint friction, power below one",
)
def sublinear_viscous_friction(velocity_m_per_s, level_n, exponent_ratio):
    """Viscous friction with a power p < 1: F = -F_1 |v / v_1|^p sgn v, v_1 = 0.1 m/s, linear below 1 um/s."""
    speed = np.sqrt(velocity_m_per_s * velocity_m_per_s + _LEAST_SPEED_M_PER_S * _LEAST_SPEED_M_PER_S)
    return -level_n * np.power(speed / _NAMED_SPEED_M_PER_S, exponent_ratio) * (velocity_m_per_s / speed)


@effect(
    places=_AXES,
    drag_n_s2_per_m2=(0.0, 1e5),
    linear=("drag_n_s2_per_m2",),
    shown_by="strokes",
    symptom="odd in velocity, with its square",
    reference="Batchelor, An Introduction to Fluid Dynamics, section 5.11: drag at high Reynolds number",
)
def quadratic_drag(velocity_m_per_s, drag_n_s2_per_m2):
    """Drag of the air: F = -c v |v|."""
    return -drag_n_s2_per_m2 * velocity_m_per_s * np.abs(velocity_m_per_s)


@effect(
    places=_AXES,
    coefficient_ratio=(0.0, 1.0),
    smoothing_m_per_s=_SMOOTHING,
    linear=("coefficient_ratio",),
    shown_by="acceleration",
    symptom="odd in velocity, and larger where the motor pushes harder",
    reference="Linderoth, Stolt, Robertsson, Johansson, ICRA 2013: friction of a joint under load",
)
def load_dependent_friction(velocity_m_per_s, motor_force_n, coefficient_ratio, smoothing_m_per_s):
    """Dry friction in proportion to the force that is passed on: F = -mu |F_motor| tanh(v / v_s)."""
    return -coefficient_ratio * np.abs(motor_force_n) * np.tanh(velocity_m_per_s / smoothing_m_per_s)


@effect(
    places=_AXES,
    memory=1,
    level_n=(0.0, 1e3),
    slip_m=(1e-8, 1e-3),
    linear=("level_n",),
    searched=("slip_m",),
    shown_by="low speed",
    symptom="a spring over the first micrometres after each reversal, then Coulomb friction",
    reference="Dahl, A Solid Friction Model, Aerospace Corp. TOR-0158, 1968, exponent 1",
)
def dahl_friction(velocity_m_per_s, dt_s, level_n, slip_m, memory):
    """Pre-sliding friction of Dahl: F = -F_c z, dz/dt = (v - |v| z) / delta; `slip_m` is delta = F_c / sigma_0.

    memory: z, the deflection of the asperities as a share of the greatest. Its step is exact for constant v.
    """
    z = memory[0]
    side = 1.0 if velocity_m_per_s >= 0.0 else -1.0
    memory[0] = side + (z - side) * fading(abs(velocity_m_per_s) * dt_s / slip_m)
    return -0.5 * level_n * (z + memory[0])


@effect(
    places=_AXES,
    memory=1,
    level_n=(0.0, 1e3),
    static_ratio=(1.0, 5.0),
    stribeck_m_per_s=(1e-6, 1.0),
    slip_m=(1e-8, 1e-3),
    bristle_damping_s=(0.0, 1e-2),
    linear=("level_n",),
    searched=("slip_m", "static_ratio", "stribeck_m_per_s", "bristle_damping_s"),
    shown_by="low speed",
    symptom="a spring over the first micrometres after each reversal, a peak at break-away, then Coulomb friction",
    reference="Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE Trans. Automatic Control 40(3), 1995, (1)-(3)",
)
def lugre_friction(velocity_m_per_s, dt_s, level_n, static_ratio, stribeck_m_per_s, slip_m, bristle_damping_s, memory):
    """Friction of bristles: F = -F_c (z + T dz/dt), dz/dt = (v - |v| z / g) / delta, g = 1 + (r - 1) exp(-(v / v_S)^2).

    LuGre with z in units of F_c / sigma_0 = delta (`slip_m`), r = F_s / F_c and T = sigma_1 / sigma_0; sigma_2 is
    `viscous_friction`. memory: z. Its step is exact for constant v, so it can't diverge as Euler's.
    """
    z = memory[0]
    ratio = velocity_m_per_s / stribeck_m_per_s
    g = 1.0 + (static_ratio - 1.0) * fading(ratio * ratio)
    goal = g if velocity_m_per_s >= 0.0 else -g
    memory[0] = goal + (z - goal) * fading(abs(velocity_m_per_s) * dt_s / (slip_m * g))
    rate_per_s = (velocity_m_per_s - abs(velocity_m_per_s) * z / g) / slip_m if dt_s <= 0.0 else (memory[0] - z) / dt_s
    return -level_n * (0.5 * (z + memory[0]) + bristle_damping_s * rate_per_s)
