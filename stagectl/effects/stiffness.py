"""Forces that depend on where the stage is: springs, cables, tilt, and friction that changes along the way."""

import numpy as np

from stagectl.effects.declaration import Trait, effect
from stagectl.effects.elementary import power_of_rest

_AXES = ("macro_force", "micro_force")
_GRAVITY_M_PER_S2 = 9.80665  # standard gravity, ISO 80000-3


@effect(
    places=_AXES,
    force_n=(-1e3, 1e3),
    linear=("force_n",),
    shown_by="holds",
    symptom="constant",
    reference="Newton; tilt, amplifier offset and preload look alike",
)
def offset(t_s, force_n):
    """Constant force."""
    return force_n + 0.0 * t_s


@effect(
    places=_AXES,
    grade_ratio=(-0.2, 0.2),
    linear=("grade_ratio",),
    traits=(Trait.BASE,),
    shown_by="holds",
    symptom="constant, and on both axes in the ratio of their masses",
    reference="Newton; weight along a plane of sine g",
)
def gravity_tilt(mass_kg, grade_ratio):
    """Weight along a tilted way: F = -m g sin(tilt); `grade_ratio` is the sine, positive where the way climbs."""
    return -mass_kg * _GRAVITY_M_PER_S2 * grade_ratio


@effect(
    places=_AXES,
    stiffness_n_per_m=(0.0, 1e4),
    anchor_m=(-10.0, 10.0),
    linear=("stiffness_n_per_m",),
    session=("anchor_m",),
    searched=("anchor_m",),
    traits=(Trait.PLACED,),
    shown_by="holds",
    symptom="linear in position",
    reference="Hooke; cable carriers of linear stages",
)
def cable_spring(position_m, stiffness_n_per_m, anchor_m):
    """Pull of a cable towards its anchor: F = -k (x - x_0)."""
    return -stiffness_n_per_m * (position_m - anchor_m)


@effect(
    places=_AXES,
    memory=1,
    level_n=(0.0, 1e3),
    slip_m=(1e-5, 0.5),
    exponent_ratio=(0.0, 0.999),
    linear=("level_n",),
    searched=("slip_m",),
    shown_by="holds",
    symptom="a spring over the first millimetres after each reversal, then a constant drag",
    reference="Dahl, A Solid Friction Model, Aerospace Corp. TOR-0158, 1968; with p = 0 one Maxwell-slip element",
)
def cable_hysteresis(velocity_m_per_s, dt_s, level_n, slip_m, exponent_ratio, memory):
    """Hysteresis of a cable, a spring that gives way: F = -F_s z, dz/dx = (1 - z sgn v)^p / delta, |z| <= 1.

    p = 0 slips all at once, p near 1 rounds the loop off as Dahl's. memory: z. Its step is exact for constant v, but
    for the part of a substep in which it begins to slip.
    """
    z = memory[0]
    side = 1.0 if velocity_m_per_s >= 0.0 else -1.0
    power = 1.0 - exponent_ratio
    left = power_of_rest(1.0 - side * z, power) - power * abs(velocity_m_per_s) * dt_s / slip_m
    memory[0] = side * (1.0 - power_of_rest(left, 1.0 / power))
    return -0.5 * level_n * (z + memory[0])


@effect(
    places=(*_AXES, "joint"),
    stiffness_n_per_m=(-1e6, 1e6),
    linear=("stiffness_n_per_m",),
    shown_by="holds",
    symptom="linear in position, zero at zero; on the joint in the relative position, opposite on both axes",
    reference="Hooke; Kang et al. 2023, (1) and (2), K1 and K2",
)
def linear_stiffness(position_m, stiffness_n_per_m):
    """Spring about zero: F = -k x. On the joint x is end minus macro, and k is what its spring is stiffer."""
    return -stiffness_n_per_m * position_m


@effect(
    places=(*_AXES, "joint"),
    stiffness_n_per_m3=(-1e13, 1e13),
    linear=("stiffness_n_per_m3",),
    symptom="with the cube of the position; on the joint in the relative position, opposite on both axes",
    reference="Duffing 1918; Awtar, Slocum, Sevincer, J. Mech. Design 129(6), 2007: flexures stiffen with the square",
)
def cubic_stiffness(position_m, stiffness_n_per_m3):
    """Spring that stiffens: F = -k x^3. On the joint x is end minus macro: a flexure guide."""
    return -stiffness_n_per_m3 * position_m * position_m * position_m


@effect(
    places=_AXES,
    level_n=(0.0, 1e3),
    slope_n_per_m=(-1e4, 1e4),
    ends_m=(-10.0, 10.0),
    smoothing_m_per_s=(1e-7, 1e-1),
    linear=("level_n", "slope_n_per_m"),
    searched=("ends_m",),
    shown_by="strokes",
    symptom="a step at each reversal that grows along the way",
    reference="Armstrong-Helouvry, Control of Machines with Friction, 1991, chapter 4: friction along the way",
)
def position_dependent_friction(position_m, velocity_m_per_s, level_n, slope_n_per_m, ends_m, smoothing_m_per_s):
    """Dry friction that changes along the way: F = -(F_c + k x) tanh(v / v_s).

    Farther from zero than `ends_m`, on its side, it stays as it is there: dry friction that has ended never drives.
    """
    side = np.copysign(1.0, ends_m)
    along_m = side * np.minimum(side * position_m, side * ends_m)
    return -(level_n + slope_n_per_m * along_m) * np.tanh(velocity_m_per_s / smoothing_m_per_s)
