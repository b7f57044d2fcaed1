"""Figures of merit against numbers that follow from their definitions."""

import math

import numpy as np
import pytest

from stagectl import metrics, run_scores, trajectory
from stagectl.errors import RequestError

_DT_S = 1e-3


def _staircase():
    """A trapezoid whose error is 1 um while accelerating, 2 um at speed, 3 um for 0.1 s of rest, 4 nm after."""
    made = trajectory.trapezoid(0.8, 0.2, dwell_s=1.0, start_m=-0.4)
    t_s, rows = made.t_s, made.setpoints
    accelerates, moves = np.abs(rows["acceleration_m_per_s2"]) > 1e-9, np.abs(rows["velocity_m_per_s"]) > 1e-9
    error_m = np.where(accelerates, 1e-6, np.where(moves, -2e-6, 4e-9))
    for end_s in (5.35, 10.7):
        error_m[(t_s >= end_s) & (t_s < end_s + 0.0995)] = 3e-6
    return t_s, error_m, rows


def test_error_by_phase():
    got = metrics.error_statistics(*_staircase(), settle_s=0.1)
    assert got.max_m == 3e-6
    assert got.acceleration.max_m == pytest.approx(1e-6)
    assert got.acceleration.rms_m == pytest.approx(1e-6)
    assert got.constant_speed.max_m == pytest.approx(2e-6)
    assert got.constant_speed.rms_m == pytest.approx(2e-6)
    assert got.settled.max_m == pytest.approx(4e-9)
    assert got.settled.rms_m == pytest.approx(4e-9)
    # By hand: four corners of 0.35 s; two runs of 4 - 0.35 s; 1 s before, 0.9 s after each move.
    assert got.acceleration.duration_s == pytest.approx(1.4, abs=0.01)
    assert got.constant_speed.duration_s == pytest.approx(7.3, abs=0.01)
    assert got.settled.duration_s == pytest.approx(2.8, abs=0.01)
    expected = math.sqrt((1.4 * 1e-12 + 7.3 * 4e-12 + 0.2 * 9e-12) / 11.7)
    assert got.rms_m == pytest.approx(expected, rel=2e-3)


def test_settling_wait_belongs_to_no_phase():
    got = metrics.error_statistics(*_staircase(), settle_s=0.05)
    assert got.settled.max_m == 3e-6


def test_sine_has_no_constant_speed():
    made = trajectory.sine(0.1, 1.5, 20.0)
    got = metrics.error_statistics(made.t_s, np.full(len(made.t_s), 1e-9), made.setpoints)
    assert math.isnan(got.constant_speed.max_m)
    assert got.constant_speed.duration_s == 0.0
    assert got.rms_m == pytest.approx(1e-9)
    assert got.mean_m == pytest.approx(1e-9)


def test_a_hold_is_settled_all_along():
    made = trajectory.move(0.1, 0.1, trajectory.Limits(0.2, 1.0, 20.0), dt_s=_DT_S)
    got = metrics.error_statistics(made.t_s, np.full(len(made.t_s), 2e-9), made.setpoints)
    assert got.settled.rms_m == pytest.approx(2e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_no_statistics_of_what_is_no_number(bad):
    t_s, error_m, rows = _staircase()
    error_m[777] = bad
    with pytest.raises(RequestError, match="error_m, row 777"):
        metrics.error_statistics(t_s, error_m, rows)
    with pytest.raises(RequestError, match="row 777"):
        metrics.cumulative_rms(error_m, _DT_S)
    with pytest.raises(RequestError, match="row 777"):
        metrics.moving_average_and_deviation(error_m, _DT_S, 0.02)
    with pytest.raises(RequestError, match="row 777"):
        metrics.settling_time_s(t_s, error_m, 1e-8, 10.7, 0.1)


def test_unequal_lengths_and_time_backwards_are_refused():
    t_s, error_m, rows = _staircase()
    with pytest.raises(RequestError, match="same rows"):
        metrics.error_statistics(t_s[:-1], error_m, rows)
    with pytest.raises(RequestError, match="same rows"):
        metrics.error_statistics(t_s, error_m, rows[:-1])
    t_s[10] = t_s[9]
    with pytest.raises(RequestError, match="row 10"):
        metrics.error_statistics(t_s, error_m, rows)


def _ringing():
    """Reference ends at 1 s; the error enters its 50 nm window at 1.1, leaves at 1.2 and is back after 1.25 s."""
    t_s = np.arange(3001) * _DT_S
    error_m = np.where(t_s < 1.0995, 1e-6, 10e-9)
    error_m[(t_s > 1.1995) & (t_s < 1.2505)] = -80e-9
    return t_s, error_m


def test_settling_counts_from_the_last_violation():
    t_s, error_m = _ringing()
    assert metrics.settling_time_s(t_s, error_m, 50e-9, 1.0, 0.1) == pytest.approx(0.250, abs=1e-9)
    assert metrics.settling_time_s(t_s, error_m, 100e-9, 1.0, 0.1) == pytest.approx(0.099, abs=1e-9)


def test_an_error_that_never_left_settles_at_once():
    t_s, _ = _ringing()
    assert metrics.settling_time_s(t_s, np.full(t_s.size, 5e-9), 50e-9, 1.0, 0.1) == 0.0


def test_not_settled_where_the_last_violation_is_within_the_dwell():
    t_s, error_m = _ringing()
    error_m[-50] = 60e-9
    assert metrics.settling_time_s(t_s, error_m, 50e-9, 1.0, 0.1) is None
    got = metrics.settling(t_s, error_m, 50e-9, 1.0, 0.04)
    assert got.time_s == pytest.approx(3.0 - 0.049 - 1.0)
    assert got.observed_s == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("window_m", "end_s", "dwell_s"),
    [(math.nan, 1.0, 0.1), (5e-8, math.nan, 0.1), (5e-8, 1.0, math.nan), (5e-8, 2.95, 0.1)],
)
def test_settling_refuses_what_it_cannot_judge(window_m, end_s, dwell_s):
    with pytest.raises(RequestError):
        metrics.settling_time_s(*_ringing(), window_m, end_s, dwell_s)


@pytest.mark.parametrize(
    ("frequency_hz", "average_m", "deviation_m"),
    [(10.0, 93.549e-9, 34.869e-9), (100.0, 0.0, 70.711e-9), (37.0, 31.357e-9, 77.932e-9)],
)
def test_moving_average_and_deviation_of_a_sine(frequency_hz, average_m, deviation_m):
    """100 nm sine, T = 20 ms at 10 kHz; max |MA| = A |sinc(f T)|."""
    t_s = np.arange(10_000) * 1e-4
    got = metrics.moving_average_and_deviation(100e-9 * np.sin(2.0 * np.pi * frequency_hz * t_s), 1e-4, 0.02)
    assert got.window_samples_count == 200
    assert got.max_average_m == pytest.approx(average_m, abs=5e-12)
    assert got.max_deviation_m == pytest.approx(deviation_m, abs=5e-12)
    assert got.warning is None


def test_moving_deviation_survives_a_large_transient():
    """A millimetre at the start takes nothing from the nanometres at the end (running sums would)."""
    rng = np.random.default_rng(1)
    error_m = 5e-9 * rng.standard_normal(5000)
    quiet = metrics.moving_average_and_deviation(error_m[1000:], _DT_S, 0.02)
    error_m[:500] += 1e-3
    got = metrics.moving_average_and_deviation(error_m, _DT_S, 0.02)
    np.testing.assert_array_equal(got.deviation_m[1000:], quiet.deviation_m)


def test_short_windows_come_with_a_warning():
    error_m = np.sin(np.arange(100.0))
    assert "9 samples" in str(metrics.moving_average_and_deviation(error_m, _DT_S, 0.009).warning)
    assert metrics.moving_average_and_deviation(error_m, _DT_S, 0.010).warning is None


@pytest.mark.parametrize("window_s", [math.nan, 0.0, 1e-5, 10.0])
def test_windows_outside_the_run_are_refused(window_s):
    with pytest.raises(RequestError):
        metrics.moving_average_and_deviation(np.zeros(100), _DT_S, window_s)


def test_timing_by_nearest_rank():
    times = np.random.default_rng(2).permutation(np.arange(1, 10_001)) * 1000
    got = metrics.timing_statistics(times, deadline_ns=9_990_000)
    assert (got.p50_ns, got.p99_ns, got.p999_ns, got.max_ns) == (5_000_000, 9_900_000, 9_990_000, 10_000_000)
    assert got.missed_count == 10
    assert got.cycles_count == 10_000
    assert metrics.timing_statistics(np.array([7])).p999_ns == 7


@pytest.mark.parametrize("values", [np.array([], dtype=int), np.array([1.5, math.nan]), np.zeros((2, 2), dtype=int)])
def test_timing_refuses_what_is_no_column_of_nanoseconds(values):
    with pytest.raises(RequestError):
        metrics.timing_statistics(values)


@pytest.mark.parametrize("count", [1000, 1001])
def test_cumulative_rms_of_two_sines(count):
    t_s = np.arange(count) * _DT_S
    span_s = count * _DT_S
    low_hz, high_hz = round(10.0 * span_s) / span_s, round(100.0 * span_s) / span_s
    error_m = 7e-9 + 3e-9 * np.sin(2 * np.pi * low_hz * t_s) + 4e-9 * np.sin(2 * np.pi * high_hz * t_s)
    got = metrics.cumulative_rms(error_m, _DT_S)
    between = got.cumulative_rms_m[(got.frequency_hz > 11.0) & (got.frequency_hz < 99.0)]
    assert between == pytest.approx(3e-9 / math.sqrt(2.0))
    assert got.cumulative_rms_m[-1] == pytest.approx(5e-9 / math.sqrt(2.0))


@pytest.mark.parametrize("count", [512, 513])
def test_cumulative_rms_ends_at_the_deviation(count):
    error_m = np.random.default_rng(3).standard_normal(count)
    assert metrics.cumulative_rms(error_m, _DT_S).cumulative_rms_m[-1] == pytest.approx(np.std(error_m), rel=1e-12)


def test_rows_of_one_cycle_share_its_period():
    """A host that held the servo up lets it run twice within a period; scores need times that rise."""
    found = run_scores.times_s(np.array([7, 8, 8, 9, 11]), 1000.0)
    np.testing.assert_allclose(found, [0.0, 1e-3, 1.5e-3, 2e-3, 4e-3], atol=1e-15)
