"""What the status block says of a cycle."""

import math

import numpy as np

from stagectl.profile import load_profile
from stagectl.requests import STATUS
from stagectl.row_fill import fill_status
from stagectl.signals import MEASUREMENT, SETPOINT
from stagectl.tracker import Tracker


def test_a_late_line_is_no_error_of_the_stage():
    """The position is a sample old then, and the set-point is not: on the way that is no error but a way."""
    tracker = Tracker(load_profile("single-axis"), has_drives=True)
    status, seen, setpoint = np.zeros(1, STATUS), np.zeros(1, MEASUREMENT), np.zeros(1, SETPOINT)
    status["error_m"] = math.nan

    def error_m(cycle: int, sequence: int, samples_new: int, position_m: float) -> float:
        seen["cycle"], seen["sequence"], seen["samples_new"] = cycle, sequence, samples_new
        seen["end_position_m"], setpoint["position_m"] = position_m, cycle * 0.2e-3
        counts = (0,) * 10
        fill_status(status, seen, setpoint, tracker.hold, tracker.active.backlash, *counts, 0.0, 0.0, 1.0)
        assert status["end_position_m"][0] == position_m
        return float(status["error_m"][0])

    assert math.isnan(error_m(4, 3, 0, 0.6e-3))
    assert math.isclose(error_m(5, 5, 1, 1.0e-3 + 3e-9), 3e-9, rel_tol=1e-6)
    assert math.isclose(error_m(6, 5, 0, 1.0e-3), 3e-9, rel_tol=1e-6)
    assert math.isclose(error_m(7, 6, 1, 1.2e-3), 3e-9, rel_tol=1e-6)
    assert math.isclose(error_m(8, 8, 2, 1.6e-3 - 5e-9), -5e-9, rel_tol=1e-6)
