"""The self-excited oscillation of section 5.1: predicted by the describing function of the gap, and met.

The macro is servoed on the *end's* position with integral action, and drags the undriven micro through the gap, as
"the macro mechanism drags the micro mechanism". With C the servo, D the macro with its own damping, x_b = -G F_b:

    D(s) = m1 s^2 + m1 c s,   C(s) = m1 (w^2 + w_i^3 / s),   G(s) = 1 / D + (1 + C / D) / (m2 s^2 + b_2 s)
    N(A) = K (1 - 2/pi (asin(a / A) + a / A sqrt(1 - (a / A)^2))),   a = b / 2,   1 + N(A) G(j w) = 0

(Gelb, Vander Velde, Multiple-Input Describing Functions, 1968, section 2.3 and appendix B.) Reading: the paper gives
no servo for Fig. 10; this one shows what "also called the limit-cycle phenomenon" can mean.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import root_scalar

from stagectl.compiled import compiled
from stagectl.paper import plant_as_printed

DT_S = 2e-4
"""Period of the servo and of the samples."""


@dataclass(frozen=True, slots=True)
class Servo:
    """The macro's servo on the end, and the micro's damping against the base."""

    stiffness_per_s2: float  # w^2
    integral_per_s3: float  # w_i^3
    damping_per_s: float  # c


@dataclass(frozen=True, slots=True)
class Cycle:
    """An oscillation of x_b about the middle of the gap."""

    amplitude_m: float
    frequency_hz: float


def describing_function(amplitude_m: float, half_gap_m: float, stiffness_n_per_m: float) -> float:
    """Return N(A) of a gap of +-a between two springs, N/m."""
    if amplitude_m <= half_gap_m:
        return 0.0
    share = half_gap_m / amplitude_m
    return stiffness_n_per_m * (1.0 - 2.0 / np.pi * (np.arcsin(share) + share * np.sqrt(1.0 - share * share)))


def _compliance(rate_rad_per_s: float, servo: Servo, macro_kg: float, micro_kg: float) -> complex:
    s = 1j * rate_rad_per_s
    macro = macro_kg * (s * s + servo.damping_per_s * s)
    control = macro_kg * (servo.stiffness_per_s2 + servo.integral_per_s3 / s)
    return complex(1.0 / macro + (1.0 + control / macro) / (micro_kg * s * s))


def predicted(
    servo: Servo, half_gap_m: float, stiffness_n_per_m: float, macro_kg: float, micro_kg: float
) -> Cycle | None:
    """Return the oscillation of harmonic balance; None where there is none."""

    def imaginary(rate: float) -> float:
        return _compliance(rate, servo, macro_kg, micro_kg).imag

    rates = np.geomspace(0.05, 300.0, 4000)
    values = np.array([imaginary(float(rate)) for rate in rates])
    for k in np.flatnonzero(np.diff(np.sign(values)) != 0.0):
        rate = float(root_scalar(imaginary, bracket=(rates[k], rates[k + 1])).root)
        wanted = -1.0 / _compliance(rate, servo, macro_kg, micro_kg).real
        if 0.0 < wanted < stiffness_n_per_m:
            amplitude = root_scalar(
                lambda a, n=wanted: describing_function(a, half_gap_m, stiffness_n_per_m) - n,
                bracket=(half_gap_m, half_gap_m * 1e6),
            ).root
            return Cycle(float(amplitude), rate / (2.0 * np.pi))
    return None


@compiled
def _run(state: np.ndarray, plant: np.ndarray, w2: float, wi3: float, c: float, dt_s: float, out: np.ndarray) -> None:
    s, q = state[0], plant[0]
    integral = 0.0
    for k in range(out.size):
        out[k] = s.macro_position_m - s.end_position_m
        force = -q.macro_mass_kg * (w2 * s.end_position_m + wi3 * integral + c * s.macro_velocity_m_per_s)
        integral += dt_s * s.end_position_m
        plant_as_printed.advance(s, q, force / q.macro_force_constant_n_per_a, 0.0, dt_s, 1)


def swing(servo: Servo, plant: np.ndarray, start_m: float, duration_s: float, dt_s: float = DT_S) -> np.ndarray:
    """Return x_b on the platform under the servo, from an end that is `start_m` off, sampled every `dt_s`, m."""
    out = np.empty(round(duration_s / dt_s))
    state = plant_as_printed.init(start_m)
    _run(state, plant, servo.stiffness_per_s2, servo.integral_per_s3, servo.damping_per_s, dt_s, out)
    return out


def met(x_b_m: np.ndarray, dt_s: float = DT_S) -> Cycle:
    """Measure the oscillation in the last quarter of a swing."""
    late = x_b_m[3 * x_b_m.size // 4 :]
    middle = 0.5 * (late.max() + late.min())
    rising = np.flatnonzero((late[:-1] < middle) & (late[1:] >= middle))
    frequency = (rising.size - 1) / ((rising[-1] - rising[0]) * dt_s) if rising.size > 1 else 0.0
    return Cycle(0.5 * float(np.ptp(late)), float(frequency))
