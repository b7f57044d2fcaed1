"""Compensation of the backlash (21) and decoupling of the macro, (22)-(26).

    D21 = -(K_c / K_mh) (L_h m1 s^3 + (L_h b1 + R_h m1) s^2 + (R_h b1 + K_mh K_emfh) s) / (A s^3 + B s^2 + C s + E)

Readings: (25) follows from (1), (3), (4) for K1 = 0 alone. A, B, C, E, K_c are "from experiment"; from (2)-(4) they
are L_w m2, L_w b2 + R_w m2, L_w K2 + R_w b2 + K_mw K_emfw, R_w K2 and K_mw. That is the way of the end under U2
beside a macro that stands; with the relative acceleration of (2) it would hold on a moving one as well. What U2 does
to a macro that carries the micro along is the voice coil's reaction, -K_mw i_w + K2 (d - d1). The decoupler that holds:

    U1 += (K_mw / K_mh) (L_h s + R_h) / (L_w s + R_w) (U2 - K_emfw (d' - d1')) - (R_h / K_mh) K2 (d - d1)

and with current drives a number: i_h += (K_mw i_w - K2 (d - d1)) / K_mh. Pure.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import bilinear

from stagectl.compiled import compiled, inlined
from stagectl.signals import Record

FEEDBACK_OWN = 0
FEEDBACK_PRINTED = 1  # (21) added to the feedback

FILTER = np.dtype([("numerator", "f8", (4,)), ("denominator", "f8", (4,)), ("state", "f8", (3,))])
"""A discrete transfer function of third order, direct form II transposed."""


@dataclass(frozen=True, slots=True)
class Transfer:
    """A continuous transfer function of third order at most, highest power first; as many powers above as below."""

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def at(self, frequency_hz: float) -> complex:
        """Return its value at a frequency."""
        s = 2j * np.pi * frequency_hz
        return complex(np.polyval(self.numerator, s) / np.polyval(self.denominator, s))

    def sampled(self, dt_s: float) -> np.ndarray:
        """Make FILTER of it for a control period (Tustin)."""
        found = np.zeros(1, FILTER)
        above, below = bilinear(self.numerator, self.denominator, fs=1.0 / dt_s)
        found["numerator"][0, : above.size], found["denominator"][0, : below.size] = above, below
        return found


def end_denominator(q: Record) -> tuple[float, float, float, float]:
    """Return A, B, C, E of (24), the way of the end under U2, from (2)-(4); SI, highest power of s first."""
    return (
        float(q["micro_inductance_h"] * q["micro_mass_kg"]),
        float(q["micro_inductance_h"] * q["damping_n_s_per_m"] + q["micro_resistance_ohm"] * q["micro_mass_kg"]),
        float(
            q["micro_inductance_h"] * q["spring_n_per_m"]
            + q["micro_resistance_ohm"] * q["damping_n_s_per_m"]
            + q["micro_force_constant_n_per_a"] * q["micro_back_emf_v_s_per_m"]
        ),
        float(q["micro_resistance_ohm"] * q["spring_n_per_m"]),
    )


def printed_decoupler(q: Record, coupling_ratio: float = 1.0) -> Transfer:
    """Return D21 of (26), V/V, with K_c = `coupling_ratio` K_mw.

    It is what (22) and (23) make of (24) and (25): minus the end's way under U2 over the macro's under U1.
    """
    ratio = -coupling_ratio * float(q["micro_force_constant_n_per_a"] / q["macro_force_constant_n_per_a"])
    mass, b1 = float(q["macro_mass_kg"]), float(q["base_damping_n_s_per_m"])
    inductance, resistance = float(q["macro_inductance_h"]), float(q["macro_resistance_ohm"])
    emf = float(q["macro_force_constant_n_per_a"] * q["macro_back_emf_v_s_per_m"])
    powers = (inductance * mass, inductance * b1 + resistance * mass, resistance * b1 + emf, 0.0)
    return Transfer(tuple(ratio * power for power in powers), end_denominator(q))


def corrected_decoupler(q: Record) -> Transfer:
    """Return what undoes the coil's reaction in place of (26), V/V: voltage drives, of U2 less the coil's back-EMF."""
    ratio = float(q["micro_force_constant_n_per_a"] / q["macro_force_constant_n_per_a"])
    return Transfer(
        (ratio * float(q["macro_inductance_h"]), ratio * float(q["macro_resistance_ohm"])),
        (float(q["micro_inductance_h"]), float(q["micro_resistance_ohm"])),
    )


@compiled
def filtered(f: Record, value: float) -> float:
    """Advance the filter of (26) by one sample; V to V."""
    b, a, z = f.numerator, f.denominator, f.state
    out = b[0] * value + z[0]
    z[0] = b[1] * value - a[1] * out + z[1]
    z[1] = b[2] * value - a[2] * out + z[2]
    z[2] = b[3] * value - a[3] * out
    return out


@inlined
def compensation(macro_m: float, end_m: float, in_gap: bool) -> float:
    """d_1b of (21): the relative position in the gap, 0 in contact, m.

    Added to the feedback it makes d of d1: the macro's own position is then controlled by nobody in the gap.
    """
    return end_m - macro_m if in_gap else 0.0
