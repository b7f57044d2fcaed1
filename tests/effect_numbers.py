"""Every law's numbers by hand: an independent copy of each law, the only one allowed; and plausible parameters."""

import math
from dataclasses import dataclass

import numpy as np

from stagectl.effects import CATALOGUE

# tanh(1) = (e^2 - 1) / (e^2 + 1); 1 - 1/e
TANH_1 = 0.76159415595576488812
GONE = 0.63212055882855767840
SQUARES = tuple(float(k * k) for k in range(12))


@dataclass(frozen=True, slots=True)
class Case:
    """Arguments in the order of the declaration, the memory before, the output, the memory after."""

    arguments: tuple[float, ...]
    output: float
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()


WORKED: dict[str, list[Case]] = {
    # ---- friction ----
    "viscous_friction": [Case((0.2, 5.0), -1.0), Case((-0.1, 20.0), 2.0)],
    "asymmetric_viscous_friction": [Case((0.1, 166.7, 240.2), -16.67), Case((-0.1, 166.7, 240.2), 24.02)],
    # tanh(1) at the smoothing speed; far beyond it is the level
    "coulomb_friction": [Case((1e-3, 4.0, 1e-3), -4.0 * TANH_1), Case((-0.1, 4.0, 1e-3), 4.0)],
    "asymmetric_coulomb_friction": [
        Case((0.1, 17.24, 23.58, 1e-3), -17.24),
        Case((-0.1, 17.24, 23.58, 1e-3), 23.58),
        Case((1e-3, 4.0, 2.0, 1e-3), -4.0 * TANH_1),
    ],
    # at the Stribeck speed 1/e of the excess is left, at thirty times it nothing
    "stribeck_friction": [
        Case((5e-3, 2.0, 5e-3, 1e-5), -0.73575888234288464319),
        Case((0.15, 2.0, 5e-3, 1e-5), 0.0),
    ],
    # 20 N at 0.1 m/s; the linear start takes 2e-11 of it: (1 + 1e-10)^(-0.185)
    "sublinear_viscous_friction": [Case((0.1, 20.0, 0.63), -19.99999999963), Case((0.0, 20.0, 0.63), 0.0)],
    "quadratic_drag": [Case((0.2, 5.0), -0.2), Case((-0.4, 5.0), 0.8)],
    "load_dependent_friction": [Case((0.1, -40.0, 0.02, 1e-3), -0.8), Case((-0.1, 40.0, 0.02, 1e-3), 0.8)],
    # a way of one slip length from rest leaves 1/e to go; back from full deflection, 2/e
    "dahl_friction": [
        Case((1e-3, 1e-3, 4.0, 1e-6), -2.0 * GONE, (0.0,), (GONE,)),
        Case((-1e-3, 1e-3, 4.0, 1e-6), -1.4715177646857693, (1.0,), (-0.26424111765711535681,)),
    ],
    # at the Stribeck speed g = 1 + 1/e: from rest g (1 - exp(-1/g)); at g it stays there
    "lugre_friction": [
        Case((1e-3, 1e-3, 4.0, 2.0, 1e-3, 1e-6, 0.0), -1.41876695989130917, (0.0,), (0.70938347994565458,)),
        Case(
            (1e-3, 1e-3, 4.0, 2.0, 1e-3, 1e-6, 1e-3),
            -5.47151776468576929,
            (1.36787944117144232,),
            (1.36787944117144232,),
        ),
        # half a millisecond of damping beside half the way: as much again
        Case((1e-3, 1e-3, 4.0, 2.0, 1e-3, 1e-6, 5e-4), -2.83753391978261834, (0.0,), (0.70938347994565458,)),
    ],
    # ---- stiffness ----
    "offset": [Case((12.0, 0.4), 0.4), Case((0.0, -1.5), -1.5)],
    "gravity_tilt": [Case((70.0, 1e-3), -0.6864655), Case((40.0, -0.01), 3.92266)],
    "cable_spring": [Case((0.3, 2.0, 0.05), -0.5), Case((-0.2, 2.0, 0.05), 0.5)],
    # 1 mm of 4 mm: from nothing to a quarter; from 0.9 it slips at 1
    "cable_hysteresis": [
        Case((0.1, 1e-2, 8.0, 4e-3, 0.0), -1.0, (0.0,), (0.25,)),
        Case((0.1, 1e-2, 8.0, 4e-3, 0.0), -7.6, (0.9,), (1.0,)),
        # p = 1/2: the square of 1 - 1/8 is left
        Case((0.1, 1e-2, 8.0, 4e-3, 0.5), -0.9375, (0.0,), (0.234375,)),
    ],
    "linear_stiffness": [Case((2e-3, 500.0), -1.0), Case((-1e-3, -500.0), -0.5)],
    "cubic_stiffness": [Case((1e-3, 1e9), -1.0), Case((-2e-3, 1e9), 8.0)],
    "position_dependent_friction": [
        Case((0.3, 0.1, 1.0, 2.0, 1.0, 1e-3), -1.6),
        Case((0.3, -0.1, 1.0, 2.0, 1.0, 1e-3), 1.6),
        Case((-0.3, 0.1, 0.4, 2.0, -0.2, 1e-3), 0.0),  # it has ended at -200 mm
        Case((0.3, 0.1, 0.4, 2.0, -0.2, 1e-3), -1.0),
    ],
    # ---- periodic: a quarter of the pitch from phase 0 is the crest; phase pi/6 at 0 is half of it ----
    "cogging": [Case((0.006, 3.0, 0.024, 0.0), 3.0), Case((0.0, 3.0, 0.024, math.pi / 6.0), 1.5)],
    # 3 sin(pi/2) + 2 sin(pi + pi/6)
    "harmonic_cogging": [Case((0.006, 3.0, 2.0, 0.024, 0.0, math.pi / 6.0), 2.0)],
    "current_ripple": [
        Case((0.006, 100.0, 0.01, 0.024, 0.0), 1.0),
        Case((0.018, 100.0, 0.01, 0.024, 0.0), -1.0),
    ],
    # ---- inertia ----
    "micro_reaction": [Case((12.0, 1.0), -12.0), Case((-8.0, 0.25), 2.0)],
    "mass_error": [Case((0.5, 70.0, 0.02), -0.7), Case((-2.0, 40.0, -0.01), -0.8)],
    # w = 100 rad/s, mu = 0.36. Asked only: 0.6 - 0.1 + 2 x 0.1 x 100 x 2e-3 + 1e4 x 1e-5 = 0.64; F = 0.36 / 0.64 of it
    # x 70 kg. From rest under 1 m/s^2 with damping 0.48, that is 0.6 at 125 rad/s, a quarter of the damped period
    # (100 rad/s): shrink = exp(-3 pi / 8) = 0.30786397132849900, q = -1e-4 + 0.75e-4 shrink, q' = -shrink / 64,
    # F / m = -0.36 q' / (pi / 200)
    "flexible_mode": [
        Case((0.6, 70.0, 0.0, 0.36, 50.0 / math.pi, 0.1), 25.2, (1e-5, 2e-3, 0.1), (1e-5, 2e-3, 0.1)),
        Case(
            (1.0, 70.0, math.pi / 200.0, 0.36, 50.0 / math.pi, 0.48),
            7.71719647180106445,
            (0.0, 0.0, 0.0),
            (-7.69102021503625752e-5, -0.00481037455200779684, 0.110245663882872349),
        ),
    ],
    # a quarter of the period of 0.1 s
    "base_vibration": [Case((70.0, 0.025, 0.01, 10.0, 0.0), -0.7), Case((40.0, 0.0, 0.05, 10.0, math.pi / 6.0), -1.0)],
    # ---- contact ----
    "contact_damping": [Case((0.01, 75.0), 0.75), Case((-0.002, 300.0), -0.6)],
    "contact_stiffness_error": [
        Case((1e-5, 1e4, 1.0, 0.1, -0.2), -0.02),
        Case((1e-5, 1e4, -1.0, 0.1, -0.2), 0.01),
    ],
    # in all 1e4 x 25e-12 / 20e-6 = 12.5 mN where the linear law has 50 mN; beyond the knee always K delta / 2 less
    "soft_contact": [Case((5e-6, 1e4, 10e-6), -0.0375), Case((30e-6, 1e4, 10e-6), -0.05)],
    # pressed on; let go by as much as it turns over: 1 / e of it on average; touched anew
    "contact_hysteresis": [
        Case((1e-5, 0.01, 1e4, 1e-3, 0.1, 1e-5), 0.01, (0.0,), (0.0,)),
        Case((1e-5, -0.01, 1e4, 1e-3, 0.1, 1e-5), 0.01 / math.e, (0.0,), (2.0 - 2.0 / math.e,)),
        Case((0.0, 0.0, 1e4, 1e-3, 0.1, 1e-5), 0.0, (1.5,), (0.0,)),
    ],
    "backlash_width_change": [Case((1.0, 4e-6), 2e-6), Case((-1.0, 4e-6), 2e-6)],
    "backlash_centre_shift": [Case((1.0, 3e-6), 3e-6), Case((-1.0, 3e-6), -3e-6)],
    "backlash_wear": [Case((100.0, 2e-8), 1e-6), Case((0.0, 2e-8), 0.0)],
    # ---- drive ----
    "force_constant_error": [Case((40.0, -0.01), -0.4), Case((-5.0, 0.2), -1.0)],
    "force_constant_saturation": [
        Case((90.0, 100.0), -24.3),
        Case((-90.0, 100.0), 24.3),
        Case((200.0, 50.0), -500.0 / 3.0),
    ],
    "amplifier_dead_band": [Case((0.05, 0.02), -0.02), Case((0.01, 0.02), -0.01), Case((-1.0, 0.02), 0.02)],
    # a step seen for one time constant: 1 - 1/e is reached, on average as much is missing
    "current_loop_lag": [
        Case((1.0, 0.0, 1e-3, 1e-3), -GONE, (0.0,), (GONE,)),
        Case((1.0, 0.0, 0.0, 1e-3), -0.75, (0.25,), (0.25,)),
        # of a loop of 0.25 ms that has 0.75 ms more: the whole fades with 1 ms, and 3/4 of it is what is added
        Case((1.0, 0.25e-3, 1e-3, 0.75e-3), -0.75 * GONE, (0.0,), (GONE,)),
    ],
    # at t = 0.2 ms, 0.25 ms behind a step of 2 A at t = 0: half of the next 0.1 ms is still without it
    "command_delay": [
        Case(
            (2.0, 0.2e-3, 0.1e-3, 0.25e-3),
            -1.0,
            (0.0, 1.0, 0.0, 2.0) + 14 * (0.0,),
            (2.0, 0.0, 0.0, 2.0) + 14 * (0.0,),
        ),
        Case((2.0, 0.0, 0.1e-3, 0.25e-3), -2.0, 18 * (0.0,), (0.0, 1.0, 0.0, 2.0) + 14 * (0.0,)),
    ],
    # ---- sensor ----
    # 0.2 m/s x 0.5 ms = 100 um, less 4 m/s^2 x (0.5 ms)^2 / 2 = 0.5 um
    "sensor_delay": [Case((0.2, 4.0, 5e-4), -99.5e-6), Case((0.2, 4.0, -5e-4), 100.5e-6)],
    # a ramp for one time constant: v tau (1 - 1/e) behind; a parabola: y - x = a tau^2 (1 - 1/e) - v tau, v = a tau
    "sensor_lag": [
        Case((0.1, 0.0, 1e-3, 1e-3), -1e-4 * GONE, (0.0,), (-1e-4 * GONE,)),
        Case((4e-3, 4.0, 1e-3, 1e-3), 4e-6 * GONE - 4e-6, (0.0,), (4e-6 * GONE - 4e-6,)),
    ],
    "scale_error": [Case((0.3, 2.0), 6e-7), Case((-0.1, 50.0), -5e-6)],
    # an eighth of the wavelength: 2 nm sin(pi/2) + 2 nm sin(pi + pi/6)
    "cyclic_error": [Case((632.8e-9 / 8.0, 2e-9, 2e-9, 632.8e-9, 0.0, math.pi / 6.0), 1e-9)],
    "thermal_drift": [Case((600.0, 1e-6, 600.0), 1e-6 * GONE), Case((0.0, 1e-6, 600.0), 0.0)],
    "abbe_error": [Case((0.3, 1e-5, 0.1), 4e-7), Case((-0.1, 1e-5, 0.1), 4e-7)],
    # 20 ppm over 100 s are 2 ms, at 0.2 m/s
    "clock_skew": [
        Case((0.2, 0.0, 100.0, 20.0), 4e-4),
        Case((-0.2, 5.0, 100.0, 20.0), -3.9e-4),
        Case((-0.2, 5.0, 0.0, 20.0), 0.0),
    ],
    # ---- table ----
    # squares at 0, 1, ... 11 steps: half-way from 9 to 16 is 12.5; beyond the ends the outer value holds
    "force_over_position": [
        Case((0.135, 0.1, 0.01, *SQUARES), 12.5),
        Case((-9.0, 0.1, 0.01, *SQUARES), 0.0),
        Case((9.0, 0.1, 0.01, *SQUARES), 121.0),
    ],
    "force_over_velocity": [
        Case((-0.0625, -0.1875, 0.0625, *SQUARES), 4.0),
        Case((0.5, -0.1875, 0.0625, *SQUARES), 121.0),
    ],
    "force_over_relative_position": [Case((1.5e-5, 0.0, 1e-5, *SQUARES), 2.5), Case((-1e-5, 0.0, 1e-5, *SQUARES), 0.0)],
}

PARAMETERS: dict[str, tuple[float, ...]] = {  # some plausible values, in the order of the declaration
    "viscous_friction": (5.0,),
    "asymmetric_viscous_friction": (5.0, 8.0),
    "coulomb_friction": (4.1, 1e-3),
    "asymmetric_coulomb_friction": (4.1, 3.0, 1e-3),
    "stribeck_friction": (2.0, 5e-3, 1e-3),
    "sublinear_viscous_friction": (4.0, 0.6),
    "quadratic_drag": (5.0,),
    "load_dependent_friction": (0.02, 1e-3),
    "dahl_friction": (4.0, 5e-6),
    "lugre_friction": (4.0, 1.4, 5e-3, 5e-6, 3e-4),
    "offset": (0.4,),
    "gravity_tilt": (1e-3,),
    "cable_spring": (2.0, 0.05),
    "cable_hysteresis": (3.0, 4e-3, 0.0),
    "linear_stiffness": (40.0,),
    "cubic_stiffness": (1e9,),
    "position_dependent_friction": (1.0, 5.0, 0.1, 1e-3),
    "cogging": (3.0, 0.024, 0.4),
    "harmonic_cogging": (3.0, 1.0, 0.024, 0.4, -1.0),
    "current_ripple": (0.01, 0.024, 0.4),
    "micro_reaction": (1.0,),
    "mass_error": (0.02,),
    "flexible_mode": (0.1, 60.0, 0.02),
    "base_vibration": (0.02, 12.0, 0.5),
    "contact_damping": (75.0,),
    "contact_stiffness_error": (0.1, -0.05),
    "soft_contact": (10e-6,),
    "contact_hysteresis": (0.1, 5e-6),
    "backlash_width_change": (10e-6,),
    "backlash_centre_shift": (-5e-6,),
    "backlash_wear": (1e-7,),
    "force_constant_error": (-0.01,),
    "force_constant_saturation": (100.0,),
    "amplifier_dead_band": (0.02,),
    "current_loop_lag": (0.4e-3,),
    "command_delay": (0.7e-3,),
    "sensor_delay": (0.5e-3,),
    "sensor_lag": (0.4e-3,),
    "scale_error": (2.0,),
    "cyclic_error": (5e-9, 2e-9, 632.991e-9, 0.3, -0.2),
    "thermal_drift": (300e-9, 600.0),
    "abbe_error": (1e-5, 0.05),
    "clock_skew": (5.0,),
    "force_over_position": (-0.022, 0.004, *(0.3 * (-1.0) ** k * k for k in range(12))),
    "force_over_velocity": (-0.1, 0.02, *(0.3 * (-1.0) ** k * k for k in range(12))),
    "force_over_relative_position": (-2e-4, 4e-5, *(0.3 * (-1.0) ** k * k for k in range(12))),
}


def table(name: str, place: str | None = None, **values: float) -> dict:
    """Return a profile's table of an effect with plausible values, at its first place unless another is named."""
    known = CATALOGUE[name]
    plausible = dict(zip(known.parameters, PARAMETERS[name], strict=True))
    return {"name": name, "acts_on": place or known.places[0]} | plausible | values


def motion(rows: int = 3000, dt_s: float = 1e-3) -> dict[str, np.ndarray]:
    """Return every quantity along a closed motion of two lines: reversals, several speeds, contact on both sides."""
    t_s = dt_s * np.arange(rows)
    w = 2.0 * np.pi / (rows * dt_s)
    position_m = 0.02 * np.sin(w * t_s) + 0.004 * np.sin(5.0 * w * t_s)
    velocity = w * (0.02 * np.cos(w * t_s) + 0.02 * np.cos(5.0 * w * t_s))
    acceleration = -w * w * (0.02 * np.sin(w * t_s) + 0.1 * np.sin(5.0 * w * t_s))
    side = np.where(np.sin(3.0 * w * t_s) >= 0.0, 1.0, -1.0)
    return {
        "position_m": position_m,
        "velocity_m_per_s": velocity,
        "acceleration_m_per_s2": acceleration,
        "mass_kg": np.full(rows, 40.0),
        "relative_position_m": 1e-2 * position_m,
        "relative_velocity_m_per_s": 1e-2 * velocity,
        "current_a": 1.5 * np.cos(7.0 * w * t_s),
        "motor_force_n": 45.0 * np.cos(7.0 * w * t_s),
        "micro_motor_force_n": 30.0 * np.cos(4.0 * w * t_s),
        "penetration_m": 20e-6 * np.abs(np.sin(3.0 * w * t_s)),
        "penetration_velocity_m_per_s": side * 60e-6 * w * np.cos(3.0 * w * t_s),
        "contact_stiffness_n_per_m": np.where(side > 0.0, 9.87e3, 13.2e3),
        "contact_side_ratio": side,
        "command_a": np.round(20.0 * np.cos(7.0 * w * t_s)) / 20.0,
        "current_loop_s": np.full(rows, 0.15e-3),
        "t_s": t_s,
        "dt_s": np.full(rows, dt_s),
    }


def columns(name: str, quantities: dict[str, np.ndarray]) -> np.ndarray:
    """Return the quantities of an effect side by side, in the order of its declaration."""
    return np.ascontiguousarray(np.column_stack([quantities[key] for key in CATALOGUE[name].quantities]))


def everything_that_remembers() -> list[dict]:
    """Return a table of every law with memory, of sizes that a stage works with, and one for every other new place."""
    return [
        table("dahl_friction", "macro_force", level_n=1.0),
        table("lugre_friction", "micro_force", level_n=0.1),
        table("cable_hysteresis", "macro_force", level_n=2.0),
        table("flexible_mode", "macro_force", share_ratio=0.05, frequency_hz=90.0),
        table("current_loop_lag", "macro_command", time_constant_s=0.1e-3),
        table("command_delay", "micro_command", delay_s=0.1e-3),
        table("sensor_lag", "end_sensor", time_constant_s=0.1e-3),
        table("cyclic_error", "macro_sensor"),
        table("cubic_stiffness", "joint"),
        table("backlash_width_change", change_m=2e-6),
    ]
