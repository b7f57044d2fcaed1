"""Recursive least squares on filtered samples whose noise is coloured by the filter, with its true covariance.

A residual is r = c' z, z the filters' answer to white noise of the sensors and of the force. Neighbours share that
noise, so the textbook covariance r^2 P is wrong (it was 20 times too wide, or too narrow by as much). With e the error
of theta, the recursion e <- (I - k h') e + k r is linear: its covariance C = E[e e'] and N = E[e z'] follow exactly,
whatever the gain k is, and whatever else (a drifting edge, a prior) enters e. Gain from P, error bars from C. Pure.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.compiled import compiled
from stagectl.signals import Record

COMMON = ("mass", "spring", "damping", "end_spring", "end_damping", "force")
"""What is wrong with the believed micro: kg, N/m, N s/m between the stages and to the base, N."""

SIDE = ("stiffness", "intercept", "damping", "knee", "hysteresis")
"""Of a side of the joint, in the scales below; regressors are divided by them."""

POSITION_SCALE_M = 1e-4
VELOCITY_SCALE_M_PER_S = 1e-3
KNEE_SCALE_N_M = 1e-6

COMMON_COUNT = len(COMMON)
SIDE_COUNT = len(SIDE)
LEFT, RIGHT = COMMON_COUNT, COMMON_COUNT + SIDE_COUNT
COUNT = COMMON_COUNT + 2 * SIDE_COUNT
NOISE_COUNT = 11
"""Two position chains of input and three lags, and the force's three lags."""

_WEIGHT_N2 = 1e-5
_NOTHING_KNOWN = 1e2


@dataclass(frozen=True, slots=True)
class Doubts:
    """Standard deviations of what is believed; 0 = exact, not looked for."""

    mass_kg: float = 0.0
    spring_n_per_m: float = 0.0
    damping_n_s_per_m: float = 0.0
    end_spring_n_per_m: float = 0.0
    """To the base: a cable on the end."""
    end_damping_n_s_per_m: float = 0.0
    force_n: float = 0.0
    knee_n_m: float = 0.0
    """Of K delta^2 / 24, the excess area over p of a contact that sets in along a parabola of length delta."""
    hysteresis_n_per_m: float = 0.0
    """Of the stiffness that a side has more when pressed, and less when let go."""

    @property
    def variances(self) -> np.ndarray:
        """Those of theta, shape (COUNT,); infinite = nothing known."""
        common = (
            *(self.mass_kg, self.spring_n_per_m, self.damping_n_s_per_m),
            *(self.end_spring_n_per_m, self.end_damping_n_s_per_m, self.force_n),
        )
        soft = (self.knee_n_m / KNEE_SCALE_N_M, self.hysteresis_n_per_m * POSITION_SCALE_M)
        side = (np.inf, np.inf, np.inf, *(one * one for one in soft))
        return np.array([*(one * one for one in common), *side, *side])


def dtype_fields() -> list[tuple[str, str] | tuple[str, str, tuple[int, ...]]]:
    """Return the fields that the recursion keeps in the record that it is given."""
    return [
        ("theta", "f8", (COUNT,)),
        ("spread", "f8", (COUNT, COUNT)),  # P: of the gain
        ("covariance", "f8", (COUNT, COUNT)),  # C = E[e e']
        ("shared", "f8", (COUNT, NOISE_COUNT)),  # N = E[e z']
        ("regressors", "f8", (COUNT,)),
        ("noise_gain", "f8", (NOISE_COUNT,)),  # c of r = c' z
        ("position_variance", "f8", (4, 4)),  # of a chain under white noise of 1 m
        ("force_variance", "f8", (3, 3)),
        ("first_variance", "f8", (COUNT,)),
        ("sought", "i8", (COUNT,)),  # elements of theta that are looked for, `sought_count` of them
        ("sought_count", "i8"),
        ("common_noise", "f8", (COMMON_COUNT,)),  # E[h r] of the common regressors
        ("gain", "f8", (COUNT,)),
        ("work", "f8", (COUNT,)),
        ("noise_work", "f8", (NOISE_COUNT,)),
        ("position_noise_m", "f8"),
        ("force_noise_n", "f8"),
    ]


def prepare(b: np.ndarray, variances: np.ndarray) -> None:
    """Start from theta = 0 with these variances of its elements, shape (COUNT,); infinite = nothing known."""
    b["theta"] = 0.0
    b["shared"] = 0.0
    sought = np.flatnonzero(variances)
    b["sought"][0, : sought.size] = sought
    b["sought_count"] = sought.size
    b["first_variance"] = np.minimum(variances, _NOTHING_KNOWN)
    b["spread"][0] = np.diag(np.where(np.isinf(variances), _NOTHING_KNOWN, variances))
    b["covariance"][0] = b["spread"][0]
    one = b[0]
    chain = np.zeros((4, 4))
    chain[1:, 1:] = _chain_decay(one)
    chain[1:, 0] = [one["old_1"], one["old_2"], one["old_3"]]
    b["position_variance"][0] = _stationary(chain, np.array([1.0, one["new_1"], one["new_2"], one["new_3"]]))
    held = np.array([one[f"old_{k}"] + one[f"new_{k}"] for k in (1, 2, 3)])
    b["force_variance"][0] = _stationary(_chain_decay(one), held)


def _chain_decay(one: np.void) -> np.ndarray:
    d0, d1, d2 = one["decay_0"], one["decay_1"], one["decay_2"]
    return np.array([[d0, 0.0, 0.0], [d1, d0, 0.0], [d2, d1, d0]])


def _stationary(a: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return X = a X a' + g g' by doubling."""
    x = np.outer(g, g)
    for _ in range(40):
        x = x + a @ x @ a.T
        a = a @ a
    return x


@compiled
def start_side_again(b: Record, at: int) -> None:
    """Forget what is known of the side whose elements of theta begin there."""
    for i in range(at, at + SIDE_COUNT):
        b.theta[i] = 0.0
        for j in range(NOISE_COUNT):
            b.shared[i, j] = 0.0
        for j in range(COUNT):
            b.spread[i, j] = b.spread[j, i] = 0.0
            b.covariance[i, j] = b.covariance[j, i] = 0.0
        b.spread[i, i] = b.first_variance[i]
        b.covariance[i, i] = b.first_variance[i]


@compiled
def drift(b: Record, at: int, walk: float) -> None:
    """Allow an element of theta a random walk of this standard deviation a period."""
    b.spread[at, at] += walk * walk
    b.covariance[at, at] += walk * walk


@compiled
def forget_noise(b: Record) -> None:
    """The filters' noise is new: nothing of it is in theta."""
    b.shared[:, :] = 0.0


@compiled
def carry_noise(b: Record) -> None:
    """Let the filters' noise grow older by a period: N <- N A'."""
    n = b.shared
    d0, d1, d2 = b.decay_0, b.decay_1, b.decay_2
    o1, o2, o3 = b.old_1, b.old_2, b.old_3
    for a in range(b.sought_count):
        i = b.sought[a]
        for at in (0, 4):
            before, z1, z2, z3 = n[i, at], n[i, at + 1], n[i, at + 2], n[i, at + 3]
            n[i, at] = 0.0
            n[i, at + 1] = d0 * z1 + o1 * before
            n[i, at + 2] = d1 * z1 + d0 * z2 + o2 * before
            n[i, at + 3] = d2 * z1 + d1 * z2 + d0 * z3 + o3 * before
        z1, z2, z3 = n[i, 8], n[i, 9], n[i, 10]
        n[i, 8] = d0 * z1
        n[i, 9] = d1 * z1 + d0 * z2
        n[i, 10] = d2 * z1 + d1 * z2 + d0 * z3


@compiled
def residual_variance(b: Record) -> float:
    """Fill noise_work with Z c; return c' Z c, N^2."""
    c = b.noise_gain
    x = b.position_variance
    f = b.force_variance
    v = b.noise_work
    position = b.position_noise_m * b.position_noise_m
    force = b.force_noise_n * b.force_noise_n
    total = 0.0
    for at in (0, 4):
        for i in range(4):
            s = 0.0
            for j in range(4):
                s += x[i, j] * c[at + j]
            v[at + i] = position * s
            total += v[at + i] * c[at + i]
    for i in range(3):
        s = 0.0
        for j in range(3):
            s += f[i, j] * c[8 + j]
        v[8 + i] = force * s
        total += v[8 + i] * c[8 + i]
    return total


@compiled
def update(b: Record, y: float, variance: float) -> float:
    """Take y = regressors' theta + residual, N, the residual being noise_gain' z of this variance.

    Returns residual times innovation, N^2, whose mean is the variance where model and noise are right.
    """
    h = b.regressors
    p = b.spread
    cov = b.covariance
    n = b.shared
    theta = b.theta
    k = b.gain
    w = b.work
    sought = b.sought
    count = b.sought_count
    predicted = 0.0
    scale = _WEIGHT_N2
    for a in range(count):
        i = sought[a]
        s = 0.0
        for o in range(count):
            j = sought[o]
            s += p[i, j] * h[j]
        k[i] = s
        scale += h[i] * s
        predicted += h[i] * theta[i]
    innovation = y - predicted
    # C <- Phi C Phi' + Phi N c k' + k c' N' Phi' + k (c' Z c) k', Phi = I - k h', as C + k g' + g k' + s k k'
    s = variance
    for a in range(count):
        i = sought[a]
        t = 0.0
        for o in range(count):
            j = sought[o]
            t += cov[i, j] * h[j]
        u = 0.0
        for j in range(NOISE_COUNT):
            u += n[i, j] * b.noise_gain[j]
        s += h[i] * (t - 2.0 * u)
        w[i] = u - t
    for a in range(count):
        i = sought[a]
        for o in range(a, count):
            j = sought[o]
            value = p[i, j] - k[i] * k[j] / scale
            p[i, j] = value
            p[j, i] = value
    for a in range(count):
        i = sought[a]
        k[i] /= scale
        theta[i] += k[i] * innovation
    for a in range(count):
        i = sought[a]
        for o in range(a, count):
            j = sought[o]
            value = cov[i, j] + k[i] * w[j] + w[i] * k[j] + s * k[i] * k[j]
            cov[i, j] = value
            cov[j, i] = value
    # What regressor and residual share of the noise pulls theta: its mean is taken out.
    for a in range(count):
        i = sought[a]
        t = 0.0
        for j in range(COMMON_COUNT):
            t += p[i, j] * b.common_noise[j]
        theta[i] -= t / _WEIGHT_N2
    for j in range(NOISE_COUNT):
        t = b.noise_work[j]
        for a in range(count):
            t -= h[sought[a]] * n[sought[a], j]
        for a in range(count):
            n[sought[a], j] += k[sought[a]] * t
    return innovation * innovation * _WEIGHT_N2 / scale
