"""A notch in what the observer learns from the sensor: a flexible mode is kept from being taken for motion.

    H(s) = (s^2 + 2 zeta_z w s + w^2) / (s^2 + 2 zeta_p w s + w^2), zeta_z / zeta_p deep in the middle, 1 far off it

by Tustin's rule, the middle kept (Franklin, Powell, Workman, Digital Control of Dynamic Systems, section 6.1). It takes
the innovation: the observer's end of the loop is the slow one (decision 0017) and has phase to give. In the command it
would stand in the law's own loop, which is as fast as the cycle and unstable with it. Nothing that is foretold passes
it, so references and feed-forward are as they were. Pure.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl.compiled import compiled
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

FIELDS = (
    ("has_notch", "f8"),
    ("notch_new", "f8", (3,)),  # on the input now, a cycle ago, two ago
    ("notch_old", "f8", (2,)),  # on the output a cycle ago, two ago
    ("notch_first_m", "f8"),  # what the next output and the one after are owed
    ("notch_second_m", "f8"),
)
"""What a record that has a notch holds of it."""

LINEAR_STATES = ("notch_first_m", "notch_second_m")
"""What a cycle leaves to the next."""


def init(record: np.ndarray, profile: "Profile") -> None:
    """Write a profile's notch into a record, at rest; none where notch_frequency_hz is 0."""
    control = profile.control
    if control.notch_frequency_hz == 0.0:
        return
    w = 2.0 * np.pi * control.notch_frequency_hz
    c = w / np.tan(0.5 * w / profile.cycle.rate_hz)
    pole = 2.0 * control.notch_damping_ratio * w * c
    zero = control.notch_depth_ratio * pole
    first = c * c + pole + w * w
    record["has_notch"] = 1.0
    record["notch_new"] = np.array([c * c + zero + w * w, 2.0 * (w * w - c * c), c * c - zero + w * w]) / first
    record["notch_old"] = np.array([2.0 * (w * w - c * c), c * c - pole + w * w]) / first


@compiled
def passed(record: Record, innovation_m: float) -> float:
    """Return what the notch lets through, m, and remember it."""
    if record.has_notch == 0.0:
        record.notch_first_m = 0.0  # a state that stayed what it is would be a pole on the unit circle
        record.notch_second_m = 0.0
        return innovation_m
    out_m = record.notch_new[0] * innovation_m + record.notch_first_m
    record.notch_first_m = record.notch_new[1] * innovation_m - record.notch_old[0] * out_m + record.notch_second_m
    record.notch_second_m = record.notch_new[2] * innovation_m - record.notch_old[1] * out_m
    return out_m
