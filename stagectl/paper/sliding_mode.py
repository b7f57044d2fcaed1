"""The adaptive integral sliding mode law of the micro, (30)-(45), as printed and corrected.

    e = d - d_r,  s = e' + eta e + gamma int y(e) dt                                                       (31), (32)
    F = m2 d_r'' + K2 (d - d1) + b2 (d' - d1') - F_b - m2 eta e' - m2 gamma y - (k/r) Omega s - k s           (39)
    u = R_w / K_mw F + K_emfw (d' - d1'),   Omega' = (alpha k / r) s^2                                        (40)

Readings: m2 d1'' is dropped from (39), for (2) with the relative acceleration contradicts Newton; the spring rests in
the middle of the gap. y as printed, 2 e^2 / phi - e, is certain from (45), and wrong: y e < 0 for |e| < phi / 2, so
that e = 0 is a saddle and e = +-phi / 2 attracts. Corrected: y = 2 e - e |e| / phi (`stagectl.laws.dsmc`), eta >=
2 sqrt(gamma), and Omega' = (alpha k / r) s^2 - sigma (Omega - Omega_0), at rest while the voltage saturates. Pure.
"""

import math

import numpy as np

from stagectl.compiled import compiled, inlined
from stagectl.laws.dsmc import integrand
from stagectl.paper.printed_values import CONTROL_5_3, SlidingModeValues
from stagectl.signals import Record

LAW = np.dtype(
    [
        ("eta_per_s", "f8"),
        ("gamma_per_s2", "f8"),
        ("phi_m", "f8"),
        ("k", "f8"),
        ("r", "f8"),
        ("alpha", "f8"),
        ("first_bound_n", "f8"),
        ("leak_per_s", "f8"),  # sigma; 0 as printed
        ("corrected_y", "f8"),
        ("freezes", "f8"),  # 1: integral and bound stand still while the voltage saturates
        ("bound_n", "f8"),  # Omega
        ("integral_m_s", "f8"),
        ("error_m", "f8"),
        ("error_rate_m_per_s", "f8"),
        ("sliding_variable_m_per_s", "f8"),
    ]
)


def init(values: SlidingModeValues = CONTROL_5_3) -> np.ndarray:
    """Make LAW as printed."""
    law = np.zeros(1, LAW)
    for name in ("eta_per_s", "gamma_per_s2", "phi_m", "k", "r", "alpha", "first_bound_n"):
        law[name] = getattr(values, name)
    law["bound_n"] = values.first_bound_n
    return law


def corrected(values: SlidingModeValues = CONTROL_5_3, leak_per_s: float = 2.0) -> np.ndarray:
    """Make LAW in the corrected reading; gamma, phi, k, r and alpha stay as printed."""
    law = init(values)
    law["eta_per_s"] = 2.0 * math.sqrt(values.gamma_per_s2)
    law["corrected_y"] = 1.0
    law["leak_per_s"] = leak_per_s
    law["freezes"] = 1.0
    return law


@inlined
def printed_integrand(e: float, phi: float) -> float:
    """Return y(e) of (33) as printed, m, of e and phi in m."""
    if e >= phi:
        return phi
    if e <= -phi:
        return -phi
    return 2.0 * e * abs(e) / phi - e


@inlined
def wanted_force(
    law: Record,
    x1: float,
    v1: float,
    x: float,
    v: float,
    position_m: float,
    velocity_m_per_s: float,
    acceleration_m_per_s2: float,
    contact_n: float,
    q: Record,
) -> float:
    """Return the force that (39) asks of the voice coil, N, and leave e, e' and s of (31), (32) in `law`.

    Of the plant as (27) has it, without m2 d1'', in which (30) puts the coil's current (28), (29): the voltage of (39),
    R_w / K_mw F + K_emfw (d' - d1'), is made of this force where a drive takes volts. x1, v1: macro, m, m/s; x, v: end.
    """
    e = x - position_m
    rate = v - velocity_m_per_s
    y = integrand(e, law.phi_m) if law.corrected_y != 0.0 else printed_integrand(e, law.phi_m)
    s = rate + law.eta_per_s * e + law.gamma_per_s2 * law.integral_m_s
    law.error_m, law.error_rate_m_per_s, law.sliding_variable_m_per_s = e, rate, s
    m = q.micro_mass_kg
    known_n = q.spring_n_per_m * (x - x1) + q.damping_n_s_per_m * (v - v1) - contact_n
    surface_n = m * (acceleration_m_per_s2 - law.eta_per_s * rate - law.gamma_per_s2 * y)
    return surface_n + known_n - (law.k / law.r * law.bound_n + law.k) * s


@inlined
def adapt(law: Record, saturated: bool, dt_s: float) -> None:
    """Advance the integral of (32), m s, and the bound Omega of (40), N, by one period; neither where it freezes."""
    if saturated and law.freezes != 0.0:
        return
    y = integrand(law.error_m, law.phi_m) if law.corrected_y != 0.0 else printed_integrand(law.error_m, law.phi_m)
    s = law.sliding_variable_m_per_s
    law.integral_m_s += y * dt_s
    growth = law.alpha * law.k / law.r * s * s - law.leak_per_s * (law.bound_n - law.first_bound_n)
    law.bound_n += growth * dt_s


def error_bound_m(values: SlidingModeValues = CONTROL_5_3) -> float | None:
    """Return bound (45) on |e|, m; None where its root is imaginary.

    Its proof integrates y over e in the place of time, so it bounds nothing.
    """
    phi = values.phi_m
    square = 9.0 / 64.0 * phi * phi - 1.5 * values.eta_per_s * phi / values.gamma_per_s2
    return None if square < 0.0 else 3.0 / 8.0 * phi + math.sqrt(square)


def reaching_band_m_per_s(values: SlidingModeValues = CONTROL_5_3) -> float:
    """Return r / k, outside of which (42) promises that V2 falls, m/s."""
    return values.r / values.k


def sliding_energy(sliding_m_per_s: np.ndarray, mass_kg: float) -> np.ndarray:
    """Return V1 = m2 s^2 / 2 of (34), J, shape (n,)."""
    return 0.5 * mass_kg * sliding_m_per_s**2


def adaptive_energy(
    sliding_m_per_s: np.ndarray, doubt_n: np.ndarray, mass_kg: float, values: SlidingModeValues = CONTROL_5_3
) -> np.ndarray:
    """Return V2 = V1 + doubt^2 / (2 alpha) of (37), J, shape (n,); doubt (36), N: estimated less true bound."""
    return sliding_energy(sliding_m_per_s, mass_kg) + doubt_n**2 / (2.0 * values.alpha)


def error_energy_m2(error_m: np.ndarray) -> np.ndarray:
    """Return V3 = e^2 / 2 of (43), m^2, shape (n,)."""
    return 0.5 * error_m**2


@compiled
def _surface(law: np.ndarray, e: float, rate: float, dt_s: float, out: np.ndarray) -> None:
    """Follow e'' + eta e' + gamma y(e) = 0, the motion on s' = 0 (semi-implicit Euler keeps its energy)."""
    q = law[0]
    for k in range(out.size):
        out[k] = e
        y = integrand(e, q.phi_m) if q.corrected_y != 0.0 else printed_integrand(e, q.phi_m)
        rate += dt_s * (-q.eta_per_s * rate - q.gamma_per_s2 * y)
        e += dt_s * rate


def on_surface(law: np.ndarray, error_m: float, duration_s: float, dt_s: float = 1e-4) -> np.ndarray:
    """Return the error on the sliding surface from rest at `error_m`, sampled, m: what the law has in the limit."""
    out = np.empty(round(duration_s / dt_s))
    _surface(law, error_m, 0.0, dt_s, out)
    return out
