"""What is fed forward is believed, not known: its doubts stiffen the observer, and the mass is found on the way.

    d = walk + M a_r,   M ~ (0, s_M),   what the joint makes is off by s_c of it

a_r is the reference's acceleration, s_M the profile's `mass_sd_kg`, s_c its `force_sd_ratio`. Both forces change when
reference and joint do, before an innovation has seen it: the changes of a period, (s_M da_r)^2 + (s_c dF_b)^2, count
as noise of d (`stagectl.adaptive_filter`, in units of what the stiffest filter reckons with, and never beyond it).
What the observer finds is fitted by M a_r, least squares of a constant with a prior (Kalman 1960, one state):

    M += g (d - M a_r),  g = P a_r / (R + a_r^2 P),  P -= g a_r P,  R = 160 (P_dd + (s_c F_b)^2)

and d is carried on by M a_r from instant to instant. M takes its share *out of* d: at a constant a_r the force that is
fed forward stays what it was, so that the loop has the gains, Ms and delay margin of the observer without M. At rest
and at constant speed a_r is 0 and nothing of this acts. Pure.
"""

import numpy as np

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
    ("sampled_contact_n", "f8"),
)
"""What a record that has such doubts holds of them."""

_ERRORS_SAMPLES = 160.0  # errors of d last for tens of samples, and it is late where a_r changes
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


@compiled
def carry(e: Record, acceleration_m_per_s2: float) -> float:
    """Return by how much the unknown force changes, N, from where it was carried to, to where a_r is this."""
    change_n = e.mass_error_kg * (acceleration_m_per_s2 - e.carried_acceleration_m_per_s2)
    e.carried_acceleration_m_per_s2 = acceleration_m_per_s2
    return change_n


@compiled
def doubted_n2(e: Record, contact_n: float) -> float:
    """Return the variance, N^2, of what the fed-forward forces have changed by since the last sample."""
    acceleration = e.carried_acceleration_m_per_s2 - e.sampled_acceleration_m_per_s2
    contact = e.contact_doubt_ratio * (contact_n - e.sampled_contact_n)
    e.sampled_acceleration_m_per_s2 = e.carried_acceleration_m_per_s2
    e.sampled_contact_n = contact_n
    return e.mass_variance_kg2 * acceleration * acceleration + contact * contact


@compiled
def learn(e: Record, force_n: float, variance_n2: float) -> None:
    """Fit M to the unknown force of a sample, and its variance; the force stays what it is."""
    a = e.sampled_acceleration_m_per_s2
    contact = e.contact_doubt_ratio * e.sampled_contact_n
    regained = e.mass_prior_kg2 / e.forgetting_samples
    e.mass_variance_kg2 = min(e.mass_variance_kg2 + regained, e.mass_prior_kg2)
    noise_n2 = _ERRORS_SAMPLES * (variance_n2 + contact * contact)
    gain = e.mass_variance_kg2 * a / (noise_n2 + a * a * e.mass_variance_kg2)
    most_kg = _LIMIT_SDS * np.sqrt(e.mass_prior_kg2)
    e.mass_error_kg = min(max(e.mass_error_kg + gain * (force_n - e.mass_error_kg * a), -most_kg), most_kg)
    e.mass_variance_kg2 -= gain * a * e.mass_variance_kg2
