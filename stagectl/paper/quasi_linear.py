"""The backlash, piecewise (5) and quasi-linear (6)-(9). x_b is positive where the right side touches. Pure.

Reading: the condition of the left side in (7) is x_b + b_l; the printed x_b - b_l (its sign is lost) is kept
beside it as `printed_condition` and contradicts (5).
"""

import numpy as np

from stagectl.compiled import compiled, inlined


@compiled
def piecewise(x_b: float, left_m: float, right_m: float, left_n_per_m: float, right_n_per_m: float) -> float:
    """Return F_b of (5), N: a spring beyond each edge, nothing between; x_b and edges in m."""
    if x_b > right_m:
        return right_n_per_m * (x_b - right_m)
    if x_b < -left_m:
        return left_n_per_m * (x_b + left_m)
    return 0.0


@inlined
def damped(force_n: float, rate_m_per_s: float, damping_n_s_per_m: float) -> float:
    """Add the joint's damping to a contact's spring force; a contact never pulls. The paper's joint has none."""
    whole_n = force_n + damping_n_s_per_m * rate_m_per_s
    return whole_n if whole_n * force_n > 0.0 else 0.0


@compiled
def state_factor(condition: float) -> float:
    """Return delta_b of (6): 0 in the gap (condition, m, > 0), 1 in contact."""
    return 0.0 if condition > 0.0 else 1.0


@compiled
def marker(x_b: float, left_m: float, right_m: float) -> tuple[float, float, float, float]:
    """Return h_b of (9), shape (4,), m or 1, with the factors of (7): [x_b d_l, d_l, x_b d_r, -d_r], the minus in h."""
    left = state_factor(x_b + left_m)
    right = state_factor(right_m - x_b)
    return x_b * left, left, x_b * right, -right


@compiled
def quasi_linear(x_b: float, left_m: float, right_m: float, left_n_per_m: float, right_n_per_m: float) -> float:
    """Return F_b of (8) and (9): h_b^T theta_b with theta_b = [K_l, K_l b_l, K_r, K_r b_r], N."""
    h = marker(x_b, left_m, right_m)
    return h[0] * left_n_per_m + h[1] * left_n_per_m * left_m + h[2] * right_n_per_m + h[3] * right_n_per_m * right_m


@compiled
def printed_condition(x_b: float, left_m: float, right_m: float, left_n_per_m: float, right_n_per_m: float) -> float:
    """Return F_b of (8) with the left condition x_b - b_l as (7) shows it, N."""
    left = state_factor(x_b - left_m)
    right = state_factor(right_m - x_b)
    return left_n_per_m * (x_b + left_m) * left + right_n_per_m * (x_b - right_m) * right


@compiled
def _forces(x_b: np.ndarray, left_m: float, right_m: float, left: float, right: float, out: np.ndarray) -> None:
    for k in range(x_b.size):
        out[k, 0] = piecewise(x_b[k], left_m, right_m, left, right)
        out[k, 1] = quasi_linear(x_b[k], left_m, right_m, left, right)
        out[k, 2] = printed_condition(x_b[k], left_m, right_m, left, right)


def forces(x_b: np.ndarray, left_m: float, right_m: float, left_n_per_m: float, right_n_per_m: float) -> np.ndarray:
    """Return piecewise, quasi-linear and printed-condition force at each x_b, N, shape (n, 3)."""
    out = np.empty((x_b.size, 3))
    _forces(x_b, left_m, right_m, left_n_per_m, right_n_per_m, out)
    return out
