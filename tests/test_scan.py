"""Scan programs: what is planned goes through every target in one smooth motion, and what can't be is refused."""

import numpy as np
import pytest

from stagectl import scan
from stagectl import trajectory as trajectories
from stagectl.errors import RequestError
from stagectl.trajectory import Limits, Waypoint

DT_S = 1e-3
LIMITS = Limits(0.45, 1.0, 10.0)


def joined(program):
    return np.concatenate([program.first.setpoints, *[program.again.setpoints] * program.again_count])


def is_smooth(rows):
    """The exact derivatives are those of the rows: nothing jumps between parts or repetitions."""
    for field, slope, bound in (
        ("position_m", "velocity_m_per_s", LIMITS.acceleration_m_per_s2 * DT_S**2),
        ("velocity_m_per_s", "acceleration_m_per_s2", LIMITS.jerk_m_per_s3 * DT_S**2),
    ):
        middle = 0.5 * (rows[slope][1:] + rows[slope][:-1])
        assert np.max(np.abs(np.diff(rows[field]) - middle * DT_S)) < bound
    assert np.max(np.abs(np.diff(rows["acceleration_m_per_s2"]))) < 1.01 * LIMITS.jerk_m_per_s3 * DT_S


@pytest.mark.parametrize("repeat_count", [1, 2, 7, 40])
def test_every_repetition_is_there_once(repeat_count):
    program = scan.plan(0.0, [Waypoint(0.01, 0.3), Waypoint(0.0, 0.3, dwell_s=0.05)], repeat_count, LIMITS, DT_S)
    rows = joined(program)
    tops = np.flatnonzero((rows["position_m"][1:-1] > 0.01 - 1e-7) & (np.diff(rows["velocity_m_per_s"][:-1]) < 0.0))
    separate = 1 + np.count_nonzero(np.diff(tops) > 50)
    assert separate == repeat_count
    assert rows.size == 1 + repeat_count * (
        scan.plan(0.0, [Waypoint(0.01, 0.3), Waypoint(0.0, 0.3, dwell_s=0.05)], 1, LIMITS).first.setpoints.size - 1
    )
    is_smooth(rows)
    assert rows["velocity_m_per_s"][-1] == 0.0
    assert program.duration_s == pytest.approx((rows.size - 1) * DT_S)


def test_a_line_is_scanned_at_constant_speed_and_passed_without_a_stop():
    parts = [
        Waypoint(0.05, 0.4, pass_velocity_m_per_s=0.1),
        Waypoint(0.15, 0.1, pass_velocity_m_per_s=0.1),
        Waypoint(0.2, 0.4),
    ]
    rows = joined(scan.plan(0.0, parts, 1, LIMITS, DT_S))
    line = (rows["position_m"] > 0.0501) & (rows["position_m"] < 0.1499)
    assert np.count_nonzero(line) == pytest.approx(998, abs=2)
    np.testing.assert_allclose(rows["velocity_m_per_s"][line], 0.1, atol=1e-9)
    is_smooth(rows)


def test_a_dwell_lasts_as_long_as_it_says_and_the_second_repetition_begins_where_the_first_ends():
    program = scan.plan(0.0, [Waypoint(0.1, 0.4, dwell_s=0.5)], 3, LIMITS, DT_S)
    rows = joined(program)
    assert np.count_nonzero(rows["position_m"] == 0.1) == pytest.approx(1500, abs=3)
    is_smooth(rows)
    assert program.again.setpoints["position_m"][0] == 0.1


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ([Waypoint(0.1, 0.5)], r"segments\[0\].velocity_m_per_s is 0.5, a scan may do 0.45 m/s; give"),
        ([Waypoint(0.1, float("nan"))], r"velocity_m_per_s is nan"),
        ([Waypoint(0.1, 0.4, 0.1)], r"segments\[0\].pass_velocity_m_per_s is 0.1; the last segment must end at rest"),
        ([Waypoint(0.1, 0.4, 0.1, 1.0), Waypoint(0.0, 0.4)], r"segments\[0\] dwells for 1 s and passes with 0.1"),
        ([Waypoint(0.1, 0.4, 0.3), Waypoint(0.2, 0.2)], r"segments\[1\] is entered with 0.3 m/s"),
        ([Waypoint(0.1, 0.1, 0.3), Waypoint(0.2, 0.4)], r"pass_velocity_m_per_s is 0.3, above the segment's velocity"),
        ([Waypoint(float("nan"), 0.4)], r"segments\[0\].target_m is nan"),
        ([], "there is none"),
    ],
)
def test_what_no_stage_can_do_is_refused_with_its_segment(parts, text):
    with pytest.raises(RequestError, match=text):
        scan.plan(0.0, parts, 1, LIMITS, DT_S)


def test_the_check_sees_what_a_scan_overshoots():
    program = scan.plan(0.0, [Waypoint(0.1, 0.4, 0.4), Waypoint(0.12, 0.4)], 1, LIMITS, DT_S)
    assert program.first.setpoints["position_m"].max() > 0.13
    with pytest.raises(RequestError, match=r"position_m is .*outside the travel \[-0.2, 0.13\] m"):
        trajectories.check(program.first, (-0.2, 0.13), 0.5, 2.0)
