"""A notch on what feedback asks for: a flexible mode that turns the phase round is kept from being driven.

    H(s) = (s^2 + 2 zeta_z w s + w^2) / (s^2 + 2 zeta_p w s + w^2), zeta_z / zeta_p deep in the middle, 1 far off it

by Tustin's rule, the middle kept (Franklin, Powell, Workman, Digital Control of Dynamic Systems, section 6.1). Only
what comes back from the sensor passes: a reference that is known beforehand would be late by it. Pure.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl.compiled import compiled
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

FIELDS = (
    ("notch_new", "f8", (3,)),  # on the input now, a cycle ago, two ago
    ("notch_old", "f8", (2,)),  # on the output a cycle ago, two ago
    ("has_notch", "f8"),
    ("notch_first_n", "f8"),  # what the next output and the one after are owed
    ("notch_second_n", "f8"),
)
"""What a law's record holds of it."""

LINEAR_STATES = ("notch_first_n", "notch_second_n")
"""What a cycle leaves to the next."""


def init(law: np.ndarray, profile: "Profile") -> None:
    """Write a profile's notch into a law's record, at rest; none where notch_frequency_hz is 0."""
    control = profile.control
    law["has_notch"] = float(control.notch_frequency_hz > 0.0)
    if control.notch_frequency_hz > 0.0:
        w = 2.0 * np.pi * control.notch_frequency_hz
        c = w / np.tan(0.5 * w / profile.cycle.rate_hz)
        pole = 2.0 * control.notch_damping_ratio * w * c
        zero = control.notch_depth_ratio * pole
        first = c * c + pole + w * w
        law["notch_new"] = np.array([c * c + zero + w * w, 2.0 * (w * w - c * c), c * c - zero + w * w]) / first
        law["notch_old"] = np.array([2.0 * (w * w - c * c), c * c - pole + w * w]) / first


@compiled
def passed(law: Record, asked_n: float) -> float:
    """Return what the notch lets through of what is asked, and remember it."""
    if law.has_notch == 0.0:
        law.notch_first_n = 0.0  # a state that stayed what it is would be a pole on the unit circle
        law.notch_second_n = 0.0
        return asked_n
    out_n = law.notch_new[0] * asked_n + law.notch_first_n
    law.notch_first_n = law.notch_new[1] * asked_n - law.notch_old[0] * out_n + law.notch_second_n
    law.notch_second_n = law.notch_new[2] * asked_n - law.notch_old[1] * out_n
    return out_n


@compiled
def settle(law: Record, asked_n: float) -> None:
    """Take it that this was asked for ever."""
    law.notch_second_n = (law.notch_new[2] - law.notch_old[1]) * asked_n
    law.notch_first_n = (law.notch_new[1] - law.notch_old[0]) * asked_n + law.notch_second_n
