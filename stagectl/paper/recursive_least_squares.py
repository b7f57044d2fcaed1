"""The identification of the backlash as printed, (20): one recursion over the four numbers of (9).

    K = P h / (h^T P h + lambda),  theta += K (Y - h^T theta),  P = (P - K h^T P) / lambda

h(k) is marked with the edges that theta holds by now: b_l = theta_2 / theta_1, b_r = theta_4 / theta_3. lambda = 1 as
printed. Readings: K takes h(k), not h(k - 1); P(0) is not printed; units are kN and m, for with newtons and the
printed first values (1 and 0.001) the recursion does not converge. Pure.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.compiled import compiled
from stagectl.paper.printed_values import FIRST_EDGE_M, FIRST_STIFFNESS_N_PER_M, Backlash
from stagectl.paper.quasi_linear import marker
from stagectl.signals import Record

RECURSION = np.dtype(
    [
        ("forgetting_ratio", "f8"),
        ("theta", "f8", (4,)),  # K_l (kN/m), K_l b_l (kN), K_r, K_r b_r
        ("covariance", "f8", (4, 4)),
        ("falsely_marked", "f8"),  # samples of the gap that were counted as contact
        ("samples", "f8"),
    ]
)

_N_PER_KN = 1e3


@dataclass(frozen=True, slots=True)
class Identified:
    """Estimates over time, shapes (n,): edges in m, stiffnesses in N/m."""

    left_m: np.ndarray
    right_m: np.ndarray
    left_stiffness_n_per_m: np.ndarray
    right_stiffness_n_per_m: np.ndarray
    falsely_marked_ratio: float  # gap samples among those that were counted as contact

    def errors_percent(self, true: Backlash) -> dict[str, float]:
        """Return the last estimates' errors, with their sign."""
        return errors_percent(
            Backlash(
                *(float(x[-1]) for x in (self.left_m, self.right_m)),
                *(float(x[-1]) for x in (self.left_stiffness_n_per_m, self.right_stiffness_n_per_m)),
            ),
            true,
        )


def errors_percent(found: Backlash, true: Backlash) -> dict[str, float]:
    """Return the errors of both edges and stiffnesses, with their sign, %."""
    return {
        "b_l": 100.0 * (found.left_m / true.left_m - 1.0),
        "b_r": 100.0 * (found.right_m / true.right_m - 1.0),
        "K_l": 100.0 * (found.left_stiffness_n_per_m / true.left_stiffness_n_per_m - 1.0),
        "K_r": 100.0 * (found.right_stiffness_n_per_m / true.right_stiffness_n_per_m - 1.0),
    }


def init(
    covariance: float,
    forgetting_ratio: float = 1.0,
    stiffness_n_per_m: float = FIRST_STIFFNESS_N_PER_M,
    edge_m: float = FIRST_EDGE_M,
) -> np.ndarray:
    """Make RECURSION of (20) with P(0) = covariance I, in units of kN and m; first values as printed."""
    r = np.zeros(1, RECURSION)
    first = stiffness_n_per_m / _N_PER_KN
    r["theta"] = (first, first * edge_m, first, first * edge_m)
    r["covariance"] = np.eye(4) * covariance
    r["forgetting_ratio"] = forgetting_ratio
    return r


@compiled
def step(r: Record, x_b_m: float, force_kn: float, left_m: float, right_m: float) -> None:
    """Take one sample into theta and P, (20): x_b in m, F_b in kN, marked by (6), (7), (9) with the given edges in m.

    Shapes: theta and h (4,), P (4, 4); a sample in the gap (h = 0) changes nothing.
    """
    h = marker(x_b_m, left_m, right_m)
    if h[1] == 0.0 and h[3] == 0.0:
        return
    p = r.covariance
    theta = r.theta
    ph = np.zeros(4)
    for i in range(4):
        for j in range(4):
            ph[i] += p[i, j] * h[j]
    scale = r.forgetting_ratio
    innovation = force_kn
    for i in range(4):
        scale += h[i] * ph[i]
        innovation -= h[i] * theta[i]
    for i in range(4):
        theta[i] += ph[i] / scale * innovation
    for i in range(4):
        for j in range(i, 4):
            value = (p[i, j] - ph[i] * ph[j] / scale) / r.forgetting_ratio
            p[i, j] = value
            p[j, i] = value


@compiled
def _along(
    recursion: np.ndarray, x_b: np.ndarray, force_kn: np.ndarray, true_m: np.ndarray, knows_edges: bool, out: np.ndarray
) -> None:
    r = recursion[0]
    theta = r.theta
    for k in range(x_b.size):
        left_m, right_m = theta[1] / theta[0], theta[3] / theta[2]
        if knows_edges:
            left_m, right_m = true_m[0], true_m[1]
        inside = -true_m[0] < x_b[k] < true_m[1]
        if not (-left_m < x_b[k] < right_m):
            r.samples += 1.0
            r.falsely_marked += 1.0 if inside else 0.0
        step(r, x_b[k], force_kn[k], left_m, right_m)
        out[k, 0], out[k, 1] = theta[1] / theta[0], theta[3] / theta[2]
        out[k, 2], out[k, 3] = theta[0], theta[2]


def along(
    recursion: np.ndarray, x_b_m: np.ndarray, force_n: np.ndarray, true: Backlash, knows_edges: bool = False
) -> Identified:
    """Run (20) over samples, shapes (n,); `knows_edges` marks them with the true edges, to show what that costs."""
    out = np.empty((x_b_m.size, 4))
    edges = np.array([true.left_m, true.right_m])
    _along(recursion, x_b_m, force_n / _N_PER_KN, edges, knows_edges, out)
    counted = float(recursion["samples"][0])
    false_ratio = float(recursion["falsely_marked"][0]) / counted if counted else float("nan")
    return Identified(out[:, 0], out[:, 1], out[:, 2] * _N_PER_KN, out[:, 3] * _N_PER_KN, false_ratio)
