"""A two-stage test rig of its own making, to judge an identification by: joints that wear, give way and lose energy.

    m1 d1'' + K1 d1 + b1 d1' + F_b = A sin(2 pi f t),   m2 d'' + K2 d + b2 d' = F_b,   x_b = d1 - d

It shares no code with the estimator nor with the paper's plant; integrated by the explicit midpoint rule, fine enough
that a kink of the force costs less than the estimator can see. Pure.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.compiled import compiled


@dataclass(frozen=True, slots=True)
class Joint:
    """What is true of the joint; lengths in m, edges as distances from x_b = 0."""

    left_m: float = 25.4e-6
    right_m: float = 176e-6
    left_n_per_m: float = 13.2e3
    right_n_per_m: float = 9.87e3
    damping_n_s_per_m: float = 0.0
    left_knee_m: float = 0.0
    right_knee_m: float = 0.0
    hysteresis_ratio: float = 0.0
    turn_m_per_s: float = 20e-6
    left_wear_m_per_s: float = 0.0
    right_wear_m_per_s: float = 0.0

    @property
    def width_m(self) -> float:
        """Distance of the onsets at t = 0."""
        return self.left_m + self.right_m


@dataclass(frozen=True, slots=True)
class Rig:
    """What moves the joint: the rig's test of section 6.1 as assumed, both stages on springs to the base."""

    macro_kg: float = 70.0
    micro_kg: float = 40.0
    macro_spring_n_per_m: float = 5000.0
    macro_damping_n_s_per_m: float = 600.0
    end_spring_n_per_m: float = 8780.0
    end_damping_n_s_per_m: float = 50.0
    amplitude_n: float = 6.0
    frequency_hz: float = 0.5
    offset_n: float = 0.0


_SUBSTEPS_COUNT = 200


@compiled
def _side(p: float, rate: float, k: float, knee: float, loss: float, turn: float, damping: float) -> float:
    """Push of one side at penetration p: a parabola up to the knee, a line beyond."""
    if p <= 0.0:
        return 0.0
    force = k * (p - 0.5 * knee) if p > knee else 0.5 * k * p * p / knee
    force = force * (1.0 + loss * np.tanh(rate / turn)) + damping * rate
    return max(force, 0.0)


@compiled
def _push(t: float, x_b: float, rate: float, j: np.ndarray) -> float:
    right = _side(x_b - j[1] - j[10] * t, rate, j[3], j[6], j[7], j[8], j[4])
    left = _side(-x_b - j[0] - j[9] * t, -rate, j[2], j[5], j[7], j[8], j[4])
    return right - left


@compiled
def _run(j: np.ndarray, r: np.ndarray, dt_s: float, substeps: int, out: np.ndarray) -> None:
    x1, v1, x, v, t = 0.0, 0.0, 0.0, 0.0, 0.0
    h = dt_s / substeps
    for k in range(out.shape[0]):
        force = r[8] + r[6] * np.sin(2.0 * np.pi * r[7] * k * dt_s)
        out[k, 0], out[k, 1] = x1, x
        out[k, 2] = _push(t, x1 - x, v1 - v, j)
        for _ in range(substeps):
            push = _push(t, x1 - x, v1 - v, j)
            half1 = v1 + 0.5 * h * (force - r[2] * x1 - r[3] * v1 - push) / r[0]
            half = v + 0.5 * h * (push - r[4] * x - r[5] * v) / r[1]
            mid1, mid = x1 + 0.5 * h * v1, x + 0.5 * h * v
            push = _push(t + 0.5 * h, mid1 - mid, half1 - half, j)
            v1 += h * (force - r[2] * mid1 - r[3] * half1 - push) / r[0]
            v += h * (push - r[4] * mid - r[5] * half) / r[1]
            x1 += h * half1
            x += h * half
            t += h


@dataclass(frozen=True, slots=True)
class Motion:
    """What the rig did, one element a millisecond, and the edges that were true then."""

    joint: Joint
    rig: Rig
    macro_m: np.ndarray
    end_m: np.ndarray
    contact_n: np.ndarray

    @property
    def t_s(self) -> np.ndarray:
        """Times of the samples."""
        return np.arange(self.macro_m.size) * 1e-3

    @property
    def left_m(self) -> np.ndarray:
        """Where the left contact sets in, at each sample."""
        return self.joint.left_m + self.joint.left_wear_m_per_s * self.t_s

    @property
    def right_m(self) -> np.ndarray:
        """Where the right contact sets in, at each sample."""
        return self.joint.right_m + self.joint.right_wear_m_per_s * self.t_s


def motion(joint: Joint, rig: Rig, duration_s: float) -> Motion:
    """Move the joint from rest; forces are held for a millisecond."""
    j = np.array([getattr(joint, name) for name in _JOINT])
    r = np.array([getattr(rig, name) for name in _RIG])
    out = np.zeros((round(1000 * duration_s), 3))
    _run(j, r, 1e-3, _SUBSTEPS_COUNT, out)
    return Motion(joint, rig, out[:, 0].copy(), out[:, 1].copy(), out[:, 2].copy())


_JOINT = (
    *("left_m", "right_m", "left_n_per_m", "right_n_per_m", "damping_n_s_per_m", "left_knee_m", "right_knee_m"),
    *("hysteresis_ratio", "turn_m_per_s", "left_wear_m_per_s", "right_wear_m_per_s"),
)
_RIG = (
    *("macro_kg", "micro_kg", "macro_spring_n_per_m", "macro_damping_n_s_per_m", "end_spring_n_per_m"),
    *("end_damping_n_s_per_m", "amplitude_n", "frequency_hz", "offset_n"),
)
