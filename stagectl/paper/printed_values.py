"""The paper's numbers, and the readings that make a stage of them. Pure; computes nothing but units."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Motor:
    """One motor of Table 1: (3), (4). Its constants are printed in rotary units."""

    resistance_ohm: float
    inductance_h: float
    back_emf_v_s_per_rad: float
    force_constant_n_per_a: float


@dataclass(frozen=True, slots=True)
class Masses:
    """The mechanics of Table 1."""

    macro_mass_kg: float
    micro_mass_kg: float
    base_spring_n_per_m: float  # K1
    spring_n_per_m: float  # K2
    base_damping_n_s_per_m: float  # b1
    damping_n_s_per_m: float  # b2


@dataclass(frozen=True, slots=True)
class Backlash:
    """Edges and stiffnesses of (5), distances from the middle both positive."""

    left_m: float
    right_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float

    @property
    def width_m(self) -> float:
        """The whole gap, b = b_l + b_r."""
        return self.left_m + self.right_m


TABLE_1 = Masses(70.0, 40.0, 4.35e4, 8.78e3, 2.20e-4, 7.61e-5)
TABLE_1_MACRO = Motor(2.75, 9.37e-3, 0.450, 0.357)
TABLE_1_MICRO = Motor(0.760, 2.52e-3, 0.106, 0.156)
TABLE_2 = Backlash(0.05, 0.05, 1e3, 1e3)
TABLE_3 = Backlash(0.0474, 0.0463, 0.887e3, 0.876e3)
RIG_6_1 = Backlash(0.0254e-3, 0.176e-3, 13.2e3, 9.87e3)
RIG_6_1_MEASURED_WIDTH_M = 0.187e-3

# Readings. With the printed springs the printed motions need tens of kiloamperes: K1 is 0, as (25) has it, and K2 is
# 500 N/m in closed loop. The motor constants are those of linear motors: times 2 pi / 10 mm, and times 100.
SPRING_N_PER_M = 500.0
MACRO_CONSTANT_RATIO = 2.0 * np.pi / 0.010
MICRO_CONSTANT_RATIO = 100.0
MACRO_SUPPLY_V = 300.0
MICRO_SUPPLY_V = 48.0
CONTACT_DAMPING_N_S_PER_M = 300.0  # the paper's joint has none: it rings for ever


@dataclass(frozen=True, slots=True)
class ObserverGains:
    """Gains of (12) for one axis; `eta` in sqrt(m)/s."""

    eta: float
    iota_m_per_s2: float


MACRO_OBSERVER_5_2 = ObserverGains(1.65, 0.7)
MICRO_OBSERVER_5_2 = ObserverGains(0.06, 0.03)
LOW_PASS_5_2 = (0.0244, 0.0244, 0.9512)
"""(0.0244 + 0.0244 z^-1) / (1 - 0.9512 z^-1): numerator, numerator, pole."""

OBSERVATION_ERRORS_5_2_PERCENT = {
    "macro velocity": 5.67,
    "macro position": 0.283,
    "micro velocity": 0.192,
    "micro position": 0.0769,
}

FIRST_STIFFNESS_N_PER_M = 1e3  # "K_l0 = K_r0 = 1": in kN/m, else (20) does not converge
FIRST_EDGE_M = 1e-3


@dataclass(frozen=True, slots=True)
class SlidingModeValues:
    """Values of (32), (33), (39), (40) in section 5.3."""

    eta_per_s: float
    gamma_per_s2: float
    phi_m: float
    k: float
    r: float
    alpha: float
    first_bound_n: float


CONTROL_5_3 = SlidingModeValues(1.8e-4, 697.5, 3.01e-5, 310.2, 20.0, 800.0, 0.05)
"""The minus of the exponents of eta and phi is lost in print: with it bound (45) is the paper's 22 um."""

PID_5_3 = {"P_h": 1.0012, "P_w": 0.4, "I_w": 0.001, "D_w": 0.0005}
DSMC_MACRO_GAIN_RATIO = 1.0008
GAP_5_3_M = 0.015
GAP_5_1_M = 0.04
