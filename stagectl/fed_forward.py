"""What is fed forward is believed, not known: its doubts stiffen the observer, and the mass is found on the way.

    d = walk + M a_r,   M ~ (0, s_M),   what the joint makes is off by s_c of it

a_r is the reference's acceleration, s_M the profile's `mass_sd_kg`, s_c its `force_sd_ratio`. Both forces change when
reference and joint do, before an innovation has seen it: the changes of a period, (s_M da_r)^2 + (s_c dF_b)^2, count
as noise of d (`stagectl.adaptive_filter`, in units of what the stiffest filter reckons with, and never beyond it).

M is fitted to innovations r, each by what a kilogram shows in it: S_M, which the observer's own error dynamics make of
the changes of a_r (the bias filter of Friedland, Treatment of bias in recursive filtering, IEEE Trans. Aut. Control 14,
1969). As a_r stays, the observer follows and S_M dies out: a force that stands, drags or pulls is no mass.

    e' = (I - K H) (A e + B da_r),  S_M = H (A e + B da_r);   S_c likewise of dF_b, Z of M da_r: what was fed
    M += g (r + Z - S_M M),  g = P S_M / (R + S_M^2 P),  P = (1 - g S_M)^2 P + g^2 R,  R = 16 (var r + (s_c S_c)^2)

d is carried on by M a_r from instant to instant. What M learns alters nothing of what has been fed: at a constant a_r
the loop has the gains, Ms and delay margin of the observer without M. While a_r changes, an innovation feeds g da_r a
period on from there; g is held to where that is a twentieth of what the innovation feeds at once. At rest and at
constant speed a_r is 0 and nothing of this acts. Pure.
"""

from collections.abc import Callable, Sequence

import numpy as np

from stagectl import adaptive_filter
from stagectl.compiled import compiled
from stagectl.signals import Record

FIELDS = (
    ("mass_prior_kg2", "f8"),  # s_M^2
    ("contact_doubt_ratio", "f8"),  # s_c
    ("forgetting_samples", "f8"),
    ("mass_variance_kg2", "f8"),  # P
    ("mass_error_kg", "f8"),  # M, what the end seems to lack of its believed mass, as a force by acceleration
    ("carried_acceleration_m_per_s2", "f8"),  # a_r that the unknown force holds now
    ("sampled_acceleration_m_per_s2", "f8"),  # a_r and F_b at the last sample
    ("sampled_change_m_per_s2", "f8"),  # da_r of the period before it
    ("sampled_contact_n", "f8"),
    ("mass_shown", "f8", (3,)),  # what a kg, unfed, makes the observer miss of position (m), velocity (m/s), force (N)
    ("mass_fed", "f8", (3,)),  # what of it feeding M has taken away
    ("contact_shown", "f8", (3,)),  # the same of the joint's whole force
)
"""What a record that has such doubts holds of them."""

_NOISE_RATIO = 16.0  # forces that the filter knows nothing of colour innovations, and the joint is off by no constant
_FED_RATIO = 0.05  # a tenth: Ms 2.2 for 8 samples where a jerk of 10 m/s^3 begins at once; unbounded: 3.5
_LIMIT_SDS = 3.0  # of M: where the end doesn't follow, what is found is no mass
_FORGETTING_S = 100.0  # until a mass that was found is doubted as the profile does: loads change


def init(record: np.ndarray, period_s: float, mass_sd_kg: float, contact_doubt_ratio: float) -> None:
    """Write the doubts of a profile into a record, shape (1,), nothing found yet."""
    record["mass_prior_kg2"] = mass_sd_kg**2
    record["contact_doubt_ratio"] = contact_doubt_ratio
    record["forgetting_samples"] = _FORGETTING_S / period_s
    forget(record[0])


@compiled
def forget(e: Record) -> None:
    """Take the profile's word again; the unknown force stays what it is."""
    e.mass_variance_kg2 = e.mass_prior_kg2
    e.mass_error_kg = 0.0
    e.mass_shown[:] = 0.0
    e.mass_fed[:] = 0.0
    e.contact_shown[:] = 0.0


def along(accelerations_m_per_s2: Sequence[float] | np.ndarray) -> Callable[[np.ndarray], None]:
    """Return what brings an observer to where it is after a reference has accelerated so, sample by sample, from rest.

    Innovations are 0 there: the mass is believed, and doubted by what they would have shown.
    """

    def followed(record: np.ndarray) -> None:
        adaptive_filter.at_rest(record)
        forget(record[0])
        for acceleration in accelerations_m_per_s2:
            carry(record[0], float(acceleration))
            adaptive_filter.step(record[0], 0.0, 0.0, foretell(record[0], 0.0))
            learn(record[0], 0.0, adaptive_filter.innovation_variance_m2(record[0]))

    return followed


@compiled
def carry(e: Record, acceleration_m_per_s2: float) -> float:
    """Return by how much the unknown force changes, N, from where it was carried to, to where a_r is this."""
    change_n = e.mass_error_kg * (acceleration_m_per_s2 - e.carried_acceleration_m_per_s2)
    e.carried_acceleration_m_per_s2 = acceleration_m_per_s2
    return change_n


@compiled
def foretell(e: Record, contact_n: float) -> float:
    """Bring what doubts make the observer miss to a sample; returns the variance of what changed before it, N^2."""
    acceleration = e.carried_acceleration_m_per_s2 - e.sampled_acceleration_m_per_s2
    contact = contact_n - e.sampled_contact_n
    e.sampled_acceleration_m_per_s2 = e.carried_acceleration_m_per_s2
    e.sampled_change_m_per_s2 = acceleration
    e.sampled_contact_n = contact_n
    _carry_on(e, e.mass_shown, acceleration)
    _carry_on(e, e.mass_fed, e.mass_error_kg * acceleration)
    _carry_on(e, e.contact_shown, contact)
    return e.mass_variance_kg2 * acceleration * acceleration + (e.contact_doubt_ratio * contact) ** 2


@compiled
def _carry_on(e: Record, missed: np.ndarray, change_n: float) -> None:
    """Move what is missed on by a period in which the force changes, half of it at once as it is carried."""
    felt = (missed[2] + 0.5 * change_n) / e.filter_n_per_m
    missed[0] += missed[1] / e.filter_per_s + 0.5 * felt
    missed[1] += felt * e.filter_per_s
    missed[2] += change_n


@compiled
def learn(e: Record, innovation_m: float, variance_m2: float) -> None:
    """Fit M to an innovation and its variance, by the gains that the sample was taken with."""
    shown = e.mass_shown[0]
    contact = e.contact_doubt_ratio * e.contact_shown[0]
    regained = e.mass_prior_kg2 / e.forgetting_samples
    e.mass_variance_kg2 = min(e.mass_variance_kg2 + regained, e.mass_prior_kg2)
    noise_m2 = _NOISE_RATIO * (variance_m2 + contact * contact)
    gain = e.mass_variance_kg2 * shown / (noise_m2 + shown * shown * e.mass_variance_kg2)
    most_fed = _FED_RATIO * e.precise_force_gain_n_per_m
    fed = abs(gain * e.sampled_change_m_per_s2)
    if fed > most_fed:
        gain *= most_fed / fed
    most_kg = _LIMIT_SDS * np.sqrt(e.mass_prior_kg2)
    found_kg = e.mass_error_kg + gain * (innovation_m + e.mass_fed[0] - shown * e.mass_error_kg)
    if np.isfinite(found_kg):
        e.mass_error_kg = min(max(found_kg, -most_kg), most_kg)
        left = 1.0 - gain * shown
        e.mass_variance_kg2 = left * left * e.mass_variance_kg2 + gain * gain * noise_m2
    _take(e, e.mass_shown)
    _take(e, e.mass_fed)
    _take(e, e.contact_shown)


@compiled
def _take(e: Record, missed: np.ndarray) -> None:
    """Take out what the observer has corrected by the sample."""
    at_sample_m = missed[0]
    missed[0] -= e.precise_position_gain_ratio * at_sample_m
    missed[1] -= e.precise_velocity_gain_per_s * at_sample_m
    missed[2] -= e.precise_force_gain_n_per_m * at_sample_m
