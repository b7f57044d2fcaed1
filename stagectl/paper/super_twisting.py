"""The super-twisting observer of one axis, (12)-(19), with the printed low-pass behind it.

    x1^' = x2^ + eta |x1~|^1/2 sgn x1~,   x2^' = (F - F_i(x^)) / m + iota sgn x1~,   x1~ = x1 - x1^
    chi = LPF{iota sgn x1~},   F_b = -m1 chi (macro), +m2 chi (micro)

Readings: (12) holds for x1~ = x1 - x1^ alone. (16) is an identity when its derivative is measured; in sliding the
derivative is nought on average and chi is what the low-pass leaves of iota sgn x1~. C in (13) is an acceleration:
the printed second derivative of x2, a velocity, would be a jerk. Explicit Euler at the sample time, as a paper with
one sample time implies. Pure.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.compiled import compiled
from stagectl.paper.printed_values import LOW_PASS_5_2, ObserverGains
from stagectl.signals import Record

OBSERVER = np.dtype(
    [
        ("eta", "f8"),
        ("iota_m_per_s2", "f8"),
        ("mass_kg", "f8"),
        ("spring_n_per_m", "f8"),
        ("damping_n_s_per_m", "f8"),
        ("numerator_0", "f8"),
        ("numerator_1", "f8"),
        ("pole", "f8"),
        ("position_m", "f8"),
        ("velocity_m_per_s", "f8"),
        ("switched_m_per_s2", "f8"),  # iota sgn x1~ of the sample before
        ("chi_m_per_s2", "f8"),
    ]
)


@dataclass(frozen=True, slots=True)
class Observed:
    """What the observer makes of samples, shapes (n,)."""

    position_m: np.ndarray
    velocity_m_per_s: np.ndarray
    chi_m_per_s2: np.ndarray


def init(
    gains: ObserverGains,
    mass_kg: float,
    spring_n_per_m: float,
    damping_n_s_per_m: float,
    position_m: float = 0.0,
    velocity_m_per_s: float = 0.0,
) -> np.ndarray:
    """Make OBSERVER of one axis with F_i = spring x + damping x'."""
    o = np.zeros(1, OBSERVER)
    o["eta"], o["iota_m_per_s2"] = gains.eta, gains.iota_m_per_s2
    o["mass_kg"], o["spring_n_per_m"], o["damping_n_s_per_m"] = mass_kg, spring_n_per_m, damping_n_s_per_m
    o["numerator_0"], o["numerator_1"], o["pole"] = LOW_PASS_5_2
    o["position_m"], o["velocity_m_per_s"] = position_m, velocity_m_per_s
    return o


@compiled
def step(o: Record, position_m: float, input_n: float, dt_s: float) -> None:
    """Filter chi of (16), m/s^2, by the low-pass of 5.2 and advance (12) by one sample; (14), (15) are what it obeys.

    Position in m, known force in N; errors x1~ = x1 - x1^ of 0 switch nothing.
    """
    error = position_m - o.position_m
    sign = 1.0 if error > 0.0 else (-1.0 if error < 0.0 else 0.0)
    switched = o.iota_m_per_s2 * sign
    o.chi_m_per_s2 = o.pole * o.chi_m_per_s2 + o.numerator_0 * switched + o.numerator_1 * o.switched_m_per_s2
    o.switched_m_per_s2 = switched
    force = input_n - o.spring_n_per_m * o.position_m - o.damping_n_s_per_m * o.velocity_m_per_s
    rate = o.velocity_m_per_s + o.eta * np.sqrt(abs(error)) * sign
    o.velocity_m_per_s += dt_s * (force / o.mass_kg + switched)
    o.position_m += dt_s * rate


@compiled
def _along(observer: np.ndarray, position_m: np.ndarray, input_n: np.ndarray, dt_s: float, out: np.ndarray) -> None:
    o = observer[0]
    for k in range(position_m.size):
        out[k, 0], out[k, 1] = o.position_m, o.velocity_m_per_s
        step(o, position_m[k], input_n[k], dt_s)
        out[k, 2] = o.chi_m_per_s2


def along(observer: np.ndarray, position_m: np.ndarray, input_n: np.ndarray, dt_s: float) -> Observed:
    """Run (12)-(16) over samples of position, m, and known force, N, shapes (n,); states are those before each."""
    out = np.empty((position_m.size, 3))
    _along(observer, position_m, input_n, dt_s, out)
    return Observed(out[:, 0], out[:, 1], out[:, 2])


def is_enough(gains: ObserverGains, bound_m_per_s2: float) -> bool:
    """Tell whether gains keep (13): iota > C, eta > 2 sqrt(C (iota + C) / (iota - C))."""
    iota, c = gains.iota_m_per_s2, bound_m_per_s2
    return iota > c and gains.eta > 2.0 * np.sqrt(c * (iota + c) / (iota - c))


def gains_for(bound_m_per_s2: float, iota_ratio: float = 2.0, margin_ratio: float = 1.05) -> ObserverGains:
    """Return gains that keep (13) for accelerations up to C, m/s^2, with iota = `iota_ratio` C."""
    iota = iota_ratio * bound_m_per_s2
    least = 2.0 * np.sqrt(bound_m_per_s2 * (iota + bound_m_per_s2) / (iota - bound_m_per_s2))
    return ObserverGains(margin_ratio * float(least), iota)


def largest_bound_m_per_s2(gains: ObserverGains) -> float:
    """Return the largest C, m/s^2, for which gains keep (13): the root of 4 C (iota + C) = eta^2 (iota - C)."""
    iota, square = gains.iota_m_per_s2, gains.eta**2
    half = iota + 0.25 * square
    return 0.5 * (-half + float(np.sqrt(half * half + square * iota)))


def time_bound_s(gains: ObserverGains, bound_m_per_s2: float, cycles_s: np.ndarray) -> float | None:
    """Return the bound (18), (19), s, from the durations of the error's oscillations, s, shape (n,).

    None where iota <= C: no bound.

    Its fraction is placed by dimensions: sum of 2 (iota + C)^2 / (2 (iota + C) + eta^2) t_j, over iota - C.
    """
    iota, c = gains.iota_m_per_s2, bound_m_per_s2
    if not iota > c:
        return None
    share = 2.0 * (iota + c) ** 2 / (2.0 * (iota + c) + gains.eta**2)
    return float(np.sum(cycles_s)) * share / (iota - c)


def cycles_s(error: np.ndarray, dt_s: float) -> np.ndarray:
    """Return the durations t_j of (18), (19), s: of whole oscillations, between every second change of an error's sign.

    The first begins with the first sample, where the error begins to oscillate.
    """
    changes = np.flatnonzero(np.diff(np.sign(error)) != 0.0) + 1
    ends = np.concatenate([[0], changes[1::2]])
    return np.diff(ends) * dt_s


def settled_s(error: np.ndarray, band: float, dt_s: float) -> float | None:
    """Return when an error came into its band for good; None where it did not."""
    outside = np.flatnonzero(~(np.abs(error) <= band))
    if outside.size and outside[-1] == error.size - 1:
        return None
    return float(outside[-1] + 1) * dt_s if outside.size else 0.0
