"""The Kalman filter of the axis that carries the end: as soft as its noise asks at rest, stiff while a force moves it.

    x' = v,  v' = (d + w) / m,  d' = white of density q,   y = x + n + v j at every sample

w is held for a period, j is how far a sample's instant is from the one that it is taken for. Its gains follow from the
covariance that it carries along (Kalman 1960; Anderson, Moore, Optimal Filtering, chapter 4). q lies between two
densities of the profile, by how far the innovations are from noise:

    q^2 = p + u (q_1^2 - p),  p = (q_0^2 + g^2 |v|) / l,  u = min(1, (r / (3.6 sigma_r))^4 + s^2 / (h q_1^2))

l is how much louder than at standstill noise is at a speed (decision 0029), r the running mean over 10 l^(1/3) periods
of innovations over l, sigma_r what noise makes of that mean. (A level of process noise that is adjusted: Bar-Shalom,
Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, section 11.2.) g is the drift by the way, of
forces that hang on where the end is (cables, cogging), s what the forces that are fed forward are doubted by for this
period (`stagectl.fed_forward`): decision 0034. u is 0 at rest and 1 where a force moves the end: decision 0027. q^2
never passes q_1^2. Inside, positions count in the sensor's noise, times in periods h, forces in m n / h^2. Pure.
"""

from collections.abc import Callable

import numpy as np

from stagectl.compiled import compiled
from stagectl.signals import Record

FIELDS = (
    ("filter_per_s", "f8"),  # 1 / h
    ("filter_n_per_m", "f8"),  # m / h^2
    ("filter_force_n", "f8"),  # m n / h^2
    ("filter_walk", "f8"),  # (q_1)^2
    ("filter_rest_walk", "f8"),  # (q_0)^2
    ("filter_travel_walk_s_per_m", "f8"),  # g^2
    ("filter_held", "f8"),  # w^2
    ("filter_noise", "f8"),  # n^2 of the sensor: 1
    ("filter_jitter_s_per_m", "f8"),  # rms of j over the sensor's noise
    ("filter_force_mean_m", "f8"),  # a mean of the innovations that is a force for sure: u = 1
    ("filter_covariance", "f8", (6,)),  # xx, xv, xd, vv, vd, dd behind the last sample
    ("filter_innovation", "f8"),  # variance of the last innovation, as noise and drift make it
    ("filter_mean_m", "f8"),  # r
    ("least_unrest_ratio", "f8"),  # u falls no lower
    ("unrest_ratio", "f8"),  # u
    ("precise_position_gain_ratio", "f8"),
    ("precise_velocity_gain_per_s", "f8"),
    ("precise_force_gain_n_per_m", "f8"),
)
"""What a record that has such a filter holds of it."""

_MEAN_SAMPLES = 10.0
_FORCE_DEVIATIONS = 3.6  # of a mean of noise: one in three thousand is beyond them

_SETTLING_SAMPLES = 20_000  # within them the covariance stays what it is where the force noise is below some 0.1 N


def init(
    record: np.ndarray,
    period_s: float,
    mass_kg: float,
    noise_m: float,
    drift_n_per_sqrt_s: float,
    rest_drift_ratio: float = 1.0,
    force_noise_n: float = 0.0,
    jitter_s: float = 0.0,
    travel_drift_n_per_sqrt_m: float = 0.0,
) -> None:
    """Write a filter into a record, shape (1,), settled at rest; q_0 is `rest_drift_ratio` times the drift, q_1.

    `travel_drift_n_per_sqrt_m` is g.
    """
    h = period_s
    force_n = noise_m * mass_kg / h**2
    walk = h * (drift_n_per_sqrt_s / force_n) ** 2
    record["filter_per_s"] = 1.0 / h
    record["filter_n_per_m"] = mass_kg / h**2
    record["filter_force_n"] = force_n
    record["filter_walk"] = walk
    record["filter_rest_walk"] = rest_drift_ratio**2 * walk
    record["filter_travel_walk_s_per_m"] = h * (travel_drift_n_per_sqrt_m / force_n) ** 2
    record["filter_held"] = (force_noise_n / force_n) ** 2
    record["filter_noise"] = 1.0
    record["filter_jitter_s_per_m"] = jitter_s / noise_m
    record["filter_force_mean_m"] = np.inf
    at_rest(record)
    innovation_m = noise_m / np.sqrt(1.0 - float(record["precise_position_gain_ratio"][0]))
    record["filter_force_mean_m"] = _FORCE_DEVIATIONS * innovation_m / np.sqrt(2.0 * _MEAN_SAMPLES - 1.0)


def at_rest(record: np.ndarray) -> None:
    """Settle a filter as nothing but noise leaves it, u = 0."""
    _settle(record, 0.0)


def at_speed(velocity_m_per_s: float) -> Callable[[np.ndarray], None]:
    """Return what settles a filter as nothing but noise leaves it at a speed, u = 0, and keeps that noise and drift."""

    def fast(record: np.ndarray) -> None:
        record["filter_noise"] = 1.0 + (velocity_m_per_s * record["filter_jitter_s_per_m"]) ** 2
        record["filter_rest_walk"] += abs(velocity_m_per_s) * record["filter_travel_walk_s_per_m"]
        at_rest(record)

    return fast


def in_motion(record: np.ndarray) -> None:
    """Settle a filter as a lasting force leaves it, and keep it there, u = 1: the stiffest that it gets."""
    _settle(record, 1.0)


def stiffening(samples_count: int) -> Callable[[np.ndarray], None]:
    """Return what brings a filter to where it is so many samples after a force has struck at rest, u = 1."""

    def struck(record: np.ndarray) -> None:
        at_rest(record)
        record["least_unrest_ratio"] = 1.0
        for _ in range(samples_count):
            step(record[0], 0.0, 0.0, 0.0)

    return struck


def _settle(record: np.ndarray, unrest_ratio: float) -> None:
    has_rest = record["filter_rest_walk"] < record["filter_walk"]  # a filter of one density has none
    record["least_unrest_ratio"] = np.where(has_rest, unrest_ratio, 1.0)
    record["filter_mean_m"] = 0.0
    record["filter_covariance"] = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    _stay(record[0])


@compiled
def _stay(e: Record) -> None:
    for _ in range(_SETTLING_SAMPLES):
        step(e, 0.0, 0.0, 0.0)


def steady_gains(period_s: float, mass_kg: float, noise_m: float, drift_n_per_sqrt_s: float) -> np.ndarray:
    """Return the gains on (position, velocity, unknown force) that a filter of one density has, shape (3,)."""
    one = np.zeros(1, np.dtype([*FIELDS]))
    init(one, period_s, mass_kg, noise_m, drift_n_per_sqrt_s)
    names = ("precise_position_gain_ratio", "precise_velocity_gain_per_s", "precise_force_gain_n_per_m")
    return np.array([float(one[name][0]) for name in names])


@compiled
def step(e: Record, innovation_m: float, velocity_m_per_s: float, doubted_n2: float) -> None:
    """Take an innovation into the unrest, and bring covariance and gains to the sample that it came with.

    `doubted_n2` is the variance of what fed-forward forces have changed by since the sample before, N^2.
    """
    jitter = velocity_m_per_s * e.filter_jitter_s_per_m
    noise = e.filter_noise + jitter * jitter
    loudness = np.sqrt(noise)
    samples = _MEAN_SAMPLES * np.cbrt(loudness)  # as a filter of one density slows down
    e.filter_mean_m += (innovation_m / loudness - e.filter_mean_m) / samples
    quieter = (2.0 * samples - 1.0) / (2.0 * _MEAN_SAMPLES - 1.0)  # the variance of a longer mean
    share = (e.filter_mean_m / e.filter_force_mean_m) ** 2 * quieter
    unrest = share * share + doubted_n2 / (e.filter_force_n * e.filter_force_n * e.filter_walk)
    e.unrest_ratio = max(unrest if unrest < 1.0 else 1.0, e.least_unrest_ratio)  # nan: 1
    drift = e.filter_rest_walk + abs(velocity_m_per_s) * e.filter_travel_walk_s_per_m
    # over l it adds the same share to the least error, n^(5/6) q^(1/6) to n^(3/4)
    rest_walk = min(drift / loudness, e.filter_walk)
    walk = rest_walk + e.unrest_ratio * (e.filter_walk - rest_walk)
    held = e.filter_held
    p = e.filter_covariance
    xd = p[2] + p[4] + 0.5 * p[5]  # A P A' of A = (1 1 1/2, 0 1 1, 0 0 1) ...
    xv = p[1] + p[3] + 0.5 * p[4] + xd
    xx = p[0] + p[1] + 0.5 * p[2] + xv - 0.5 * xd
    vd = p[4] + p[5]
    vv = p[3] + p[4] + vd
    xx += 0.25 * held + walk / 20.0  # ... and what w and d's walk bring (van Loan, IEEE Trans. Aut. Control 23, 1978)
    xv += 0.5 * held + walk / 8.0
    xd += walk / 6.0
    vv += held + walk / 3.0
    vd += walk / 2.0
    dd = p[5] + walk
    e.filter_innovation = xx + noise
    to_position = xx / (xx + noise)
    to_velocity = xv / (xx + noise)
    to_force = xd / (xx + noise)
    p[0] = xx - to_position * xx
    p[1] = xv - to_position * xv
    p[2] = xd - to_position * xd
    p[3] = vv - to_velocity * xv
    p[4] = vd - to_velocity * xd
    p[5] = dd - to_force * xd
    e.precise_position_gain_ratio = to_position
    e.precise_velocity_gain_per_s = to_velocity * e.filter_per_s
    e.precise_force_gain_n_per_m = to_force * e.filter_n_per_m


@compiled
def innovation_variance_m2(e: Record) -> float:
    """Return the variance of the last innovation, as noise and drift make it, m^2."""
    noise_m = e.filter_force_n / e.filter_n_per_m
    return noise_m * noise_m * e.filter_innovation
