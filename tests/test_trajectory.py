"""Trajectories: derivatives that belong together, ends at rest, and every refusal before the first cycle."""

import json
import math

import numpy as np
import pytest

from stagectl import trajectory as trajectories
from stagectl.errors import RequestError
from stagectl.signals import SETPOINT
from stagectl.trajectory import Limits, Load, MotionState, Trajectory, check

_ORDERS = ("position_m", "velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3")
_LIMITS = Limits(velocity_m_per_s=0.2, acceleration_m_per_s2=1.0, jerk_m_per_s3=20.0)


def _table():
    t_s = np.arange(0.0, 2.0001, 0.02)
    u = t_s / 2.0
    return trajectories.from_table(t_s, 0.1 * u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3))


_ALL = {
    "sine": lambda: trajectories.sine(0.1, 1.5, 20.0, start_m=0.05),
    "sweep": lambda: trajectories.sweep(250e-6, 1.0, 6.0, centre_m=0.02),
    "chirp": lambda: trajectories.sweep(250e-6, 0.5, 8.0, end_frequency_hz=1.5),
    "trapezoid": lambda: trajectories.trapezoid(0.8, 0.2, dwell_s=0.5, start_m=-0.4),
    "backward": lambda: trajectories.trapezoid(-0.3, 0.1, (0.6, 0.3, 0.15), dwell_s=0.2),
    "move": lambda: trajectories.move(0.1, -0.2, _LIMITS),
    "replan": lambda: trajectories.move(MotionState(0.1, 0.15, -0.4), -0.2, _LIMITS),
    "table": _table,
}


@pytest.mark.parametrize("kind", _ALL)
@pytest.mark.parametrize("order", [0, 1, 2])
def test_each_column_is_the_derivative_of_the_one_before(kind, order):
    made = _ALL[kind]()
    low, high = made.setpoints[_ORDERS[order]], made.setpoints[_ORDERS[order + 1]]
    # Central difference of sixth order: error dt^6 f^(7) / 140 where the function is that smooth.
    weights = np.array([1.0, -9.0, 45.0, 0.0, -45.0, 9.0, -1.0]) / (60.0 * made.dt_s)
    difference = np.convolve(low, weights, "same")
    error = np.abs(difference - high)[4:-4]
    scale = np.max(np.abs(high))
    rounding = 4e-16 * np.max(np.abs(low)) / made.dt_s
    # Within a phase both agree; on the few rows beside a kink of `high` they differ by less than its steepest step.
    assert np.quantile(error, 0.95) < 1e-7 * scale + rounding
    assert np.max(error) < 0.6 * np.max(np.abs(np.diff(high))) + rounding


@pytest.mark.parametrize("kind", _ALL)
def test_columns_integrate_to_the_position(kind):
    """No drift between the columns: the trapezoidal integral of each meets the one before it everywhere."""
    made = _ALL[kind]()
    rows = made.setpoints
    v, a, p = rows["velocity_m_per_s"], rows["acceleration_m_per_s2"], rows["position_m"]
    # With the end correction dt^2 / 12 (a_i - a_i+1) the rule is of fourth order.
    step = made.dt_s * (v[1:] + v[:-1]) / 2.0 + made.dt_s**2 * (a[:-1] - a[1:]) / 12.0
    integral = p[0] + np.concatenate([[0.0], np.cumsum(step)])
    assert np.max(np.abs(integral - p)) < 2e-9


@pytest.mark.parametrize("kind", _ALL)
def test_ends_at_rest_and_shape(kind):
    made = _ALL[kind]()
    last = made.setpoints[-1]
    assert made.setpoints.dtype == SETPOINT
    assert last["velocity_m_per_s"] == 0.0
    assert last["acceleration_m_per_s2"] == 0.0
    if kind != "replan":
        assert made.setpoints[0]["velocity_m_per_s"] == 0.0
        assert made.setpoints[0]["acceleration_m_per_s2"] == 0.0
    assert made.duration_s == pytest.approx(made.t_s[-1])
    assert json.loads(json.dumps(made.parameters, allow_nan=False)) == made.parameters


def test_sine_keeps_amplitude_phase_and_bounds():
    made = trajectories.sine(0.1, 1.5, 20.0, start_m=0.05)
    ramp_s = made.parameters["ramp_s"]
    steady = (made.t_s > ramp_s) & (made.t_s < 20.0 - ramp_s)
    expected = 0.05 + 0.1 * np.sin(1.5 * made.t_s[steady])
    assert np.max(np.abs(made.setpoints["position_m"][steady] - expected)) < 1e-15
    assert made.setpoints["position_m"][-1] == 0.05
    assert np.max(np.abs(made.setpoints["velocity_m_per_s"])) <= 0.1 * 1.5 * 1.0001
    assert np.max(np.abs(made.setpoints["acceleration_m_per_s2"])) <= 0.1 * 1.5**2 * 1.16
    assert np.max(np.abs(made.setpoints["jerk_m_per_s3"])) <= 0.1 * 1.5**3 * 1.6
    # No jump of the jerk larger than the snap allows: the swing begins softly.
    assert np.max(np.abs(np.diff(made.setpoints["jerk_m_per_s3"]))) < 6.0 * 0.1 * 1.5**4 * made.dt_s


def test_sweep_moves_the_micro_only():
    made = trajectories.sweep(250e-6, 1.0, 6.0, centre_m=0.02)
    rows = made.setpoints
    macro_m = rows["position_m"] - rows["relative_position_m"]
    assert np.max(np.abs(macro_m - 0.02)) < 1e-16
    assert np.max(rows["relative_position_m"]) == pytest.approx(250e-6, rel=1e-3)
    assert np.min(rows["relative_position_m"]) == pytest.approx(-250e-6, rel=1e-3)
    np.testing.assert_array_equal(rows["relative_velocity_m_per_s"], rows["velocity_m_per_s"])
    np.testing.assert_array_equal(rows["relative_acceleration_m_per_s2"], rows["acceleration_m_per_s2"])
    assert not np.any(trajectories.sine(0.1, 1.5, 20.0).setpoints["relative_position_m"])


def test_trapezoid_reference_figures():
    """0.2 m/s over 0.8 m, corners 0.2 + 0.1 + 0.05 s: 1 m/s^2, 10 m/s^3, 4.35 s a way (by hand)."""
    made = trajectories.trapezoid(start_m=-0.4)
    rows, t_s = made.setpoints, made.t_s
    assert made.duration_s == pytest.approx(1.0 + 4.35 + 4.0 + 4.35 + 4.0)
    assert np.max(np.abs(rows["velocity_m_per_s"])) == pytest.approx(0.2, rel=1e-12)
    assert np.max(np.abs(rows["acceleration_m_per_s2"])) == pytest.approx(1.0, rel=1e-9)
    assert np.max(np.abs(rows["jerk_m_per_s3"])) == pytest.approx(10.0, rel=1e-9)
    # The averages delay by half their widths: the middle of the way is reached at 1 + 2 + 0.175 s.
    assert rows["position_m"][np.searchsorted(t_s, 3.175 - 1e-9)] == pytest.approx(0.0, abs=1e-14)
    rest = (t_s < 1.0) | ((t_s > 5.35) & (t_s < 9.35)) | (t_s > 13.7)
    for column in _ORDERS[1:]:
        assert not np.any(rows[column][rest])
    assert np.all(rows["position_m"][(t_s > 5.35) & (t_s < 9.35)] == pytest.approx(0.4, abs=1e-15))
    assert rows["position_m"][-1] == pytest.approx(-0.4, abs=1e-15)


def test_trapezoid_is_three_moving_averages():
    """Against the definition: sampled moving averages of the sharp ramp, which converge with the grid."""
    dt_s = 1e-4
    made = trajectories.trapezoid(0.1, 0.2, (0.2, 0.1, 0.05), dwell_s=0.3, dt_s=dt_s, lead_s=0.4)
    sharp = np.interp(made.t_s, [0.4, 0.9, 0.9 + 0.35 + 0.3, 1.4 + 0.35 + 0.3], [0.0, 0.1, 0.1, 0.0])
    for width_s in (0.2, 0.1, 0.05):
        count = round(width_s / dt_s)
        # A box of whole steps with half weights at its ends is the trapezoidal rule.
        box = np.ones(count + 1)
        box[[0, -1]] = 0.5
        sharp = np.convolve(np.concatenate([np.full(count, sharp[0]), sharp]), box / count, "valid")
    assert np.max(np.abs(sharp - made.setpoints["position_m"])) < 2e-8


def test_move_keeps_its_limits_and_reaches_its_target():
    made = trajectories.move(MotionState(0.1, 0.15, -0.4), -0.2, _LIMITS)
    rows = made.setpoints
    assert rows["position_m"][0] == 0.1
    assert rows["velocity_m_per_s"][0] == 0.15
    assert rows["acceleration_m_per_s2"][0] == -0.4
    assert rows["position_m"][-1] == -0.2
    assert np.max(np.abs(rows["velocity_m_per_s"])) <= 0.2 * (1 + 1e-9)
    assert np.max(np.abs(rows["acceleration_m_per_s2"])) <= 1.0 * (1 + 1e-9)
    assert np.max(np.abs(rows["jerk_m_per_s3"])) <= 20.0 * (1 + 1e-9)


def test_move_brakes_first_when_it_starts_too_fast():
    made = trajectories.move(MotionState(0.0, 0.5, 0.0), 0.3, _LIMITS)
    assert made.setpoints["velocity_m_per_s"][0] == 0.5
    assert made.setpoints["position_m"][-1] == 0.3
    assert np.max(np.abs(np.diff(made.setpoints["position_m"]))) <= 0.5 * made.dt_s * (1 + 1e-9)


def test_move_to_where_it_stands_is_a_rest():
    made = trajectories.move(0.1, 0.1, _LIMITS)
    assert np.all(made.setpoints["position_m"] == 0.1)
    assert len(made.setpoints) >= 2


def test_table_passes_through_its_rows():
    t_s = np.array([0.0, 0.3, 0.5, 0.9, 1.2, 1.5])
    position_m = np.array([0.0, 0.001, 0.004, 0.010, 0.012, 0.012])
    made = trajectories.from_table(t_s, position_m, dt_s=0.1)
    assert made.setpoints["position_m"][[0, 3, 5, 9, 12, 15]] == pytest.approx(position_m, abs=1e-15)


def test_table_snap_is_continuous():
    """A septic step sampled at 20 ms comes back to 1e-9 of its stroke: the spline is of sixth order."""
    made = _table()
    u = made.t_s / 2.0
    exact = 0.1 * u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3)
    assert np.max(np.abs(made.setpoints["position_m"] - exact)) < 1e-10
    jerk = 0.1 * 840.0 * u * (1.0 - u) * (1.0 - 5.0 * u + 5.0 * u**2) / 8.0
    assert np.max(np.abs(made.setpoints["jerk_m_per_s3"] - jerk)) < 2e-3


def test_file_round(tmp_path):
    file = tmp_path / "wave.csv"
    file.write_text("t_s,position_m\n0,0\n0.5,0.001\n1.0,0.002\n1.5,0.002\n")
    made = trajectories.from_file(file)
    assert made.name == "wave"
    assert made.setpoints["position_m"][500] == pytest.approx(0.001, abs=1e-15)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,position\n0,0\n1,1\n", "line 1"),
        ("", "nothing"),
        ("t_s,position_m\n0,0\n1,abc\n", "row 2"),
        ("t_s,position_m\n0,0\n1\n2,2\n", "row 2"),
        ("t_s,position_m\n0,0\n", "2 rows"),
        ("t_s,position_m\n0,0\n1,nan\n", "row 1"),
        ("t_s,position_m\n0,0\n1,1\n1,2\n", "time must rise"),
    ],
)
def test_bad_files_are_refused_by_place(tmp_path, text, words):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(RequestError, match=words):
        trajectories.from_file(file)


def test_missing_file_is_a_request_error(tmp_path):
    with pytest.raises(RequestError, match="absent"):
        trajectories.from_file(tmp_path / "absent.csv")


@pytest.mark.parametrize(
    "call",
    [
        lambda: trajectories.sine(math.nan, 1.5, 20.0),
        lambda: trajectories.sine(0.1, math.nan, 20.0),
        lambda: trajectories.sine(0.1, 1.5, math.nan),
        lambda: trajectories.sine(0.1, 1.5, 20.0, start_m=math.inf),
        lambda: trajectories.sine(0.1, 1.5, 20.0, dt_s=math.nan),
        lambda: trajectories.sine(0.1, 1.5, 2.0),
        lambda: trajectories.sine(0.1, 1.5, 1e9),
        lambda: trajectories.sweep(1e-4, 0.0, 5.0),
        lambda: trajectories.sweep(1e-4, 1.0, 5.0, end_frequency_hz=math.nan),
        lambda: trajectories.trapezoid(0.0),
        lambda: trajectories.trapezoid(math.nan),
        lambda: trajectories.trapezoid(0.8, -0.2),
        lambda: trajectories.trapezoid(0.8, 0.2, (0.2,)),
        lambda: trajectories.trapezoid(0.8, 0.2, (0.2, math.nan)),
        lambda: trajectories.trapezoid(dwell_s=math.nan),
        lambda: trajectories.move(0.0, math.nan, _LIMITS),
        lambda: trajectories.move(MotionState(0.0, math.nan), 0.1, _LIMITS),
        lambda: trajectories.move(0.0, 0.1, Limits(0.2, math.nan, 20.0)),
        lambda: trajectories.move(0.0, 0.1, Limits(0.2, 1.0, 0.0)),
    ],
)
def test_numbers_out_of_range_are_refused(call):
    with pytest.raises(RequestError):
        call()


def _standard(**changes):
    arguments = {
        "travel_m": (-0.45, 0.45),
        "velocity_limit_m_per_s": 0.5,
        "acceleration_limit_m_per_s2": 4.0,
        "jerk_limit_m_per_s3": 100.0,
        "loads": (Load("macro", 110.0, 2000.0, 5.0), Load("micro", 40.0, 180.0)),
        "stop_deceleration_m_per_s2": 2.0,
        "stroke_m": (-1e-3, 1e-3),
    }
    return arguments | changes


def test_check_lets_good_trajectories_pass():
    check(trajectories.trapezoid(0.8, 0.2, start_m=-0.4), start_m=-0.4, **_standard())
    check(trajectories.sweep(250e-6, 1.0, 6.0), **_standard())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"travel_m": (-0.45, 0.3)}, r"at \d+\.\d+ s: position_m is 0\.3.*\[-0\.45, 0\.3\] m: shorten"),
        ({"velocity_limit_m_per_s": 0.1}, r"velocity_m_per_s is 0\.1.*0\.1 m/s: ask"),
        ({"acceleration_limit_m_per_s2": 0.9}, r"acceleration_m_per_s2 is 0\.9.*0\.9 m/s\^2: take"),
        ({"jerk_limit_m_per_s3": 9.0}, "jerk_m_per_s3"),
        ({"loads": (Load("micro", 40.0, 30.0),)}, "the micro drive's limit of 30 N"),
        ({"stop_deceleration_m_per_s2": 0.05}, "stopping distance_m"),
        ({"start_m": 0.0}, "move there first"),
        ({"start_m": math.nan}, "move there first"),
        ({"travel_m": (math.nan, 0.45)}, "position_m"),
        ({"velocity_limit_m_per_s": math.nan}, "velocity_m_per_s"),
        ({"acceleration_limit_m_per_s2": math.nan}, "acceleration_m_per_s2"),
        ({"jerk_limit_m_per_s3": math.nan}, "jerk_m_per_s3"),
        ({"loads": (Load("micro", 40.0, math.nan),)}, "force_n"),
        ({"stop_deceleration_m_per_s2": math.nan}, "stopping distance_m"),
        ({"stroke_m": (math.nan, 1e-3)}, "relative_position_m"),
    ],
)
def test_check_names_instant_value_limit_and_remedy(changes, words):
    with pytest.raises(RequestError, match=words):
        check(trajectories.trapezoid(0.8, 0.2, start_m=-0.4), **_standard(**changes))


def test_check_names_the_first_instant():
    """The sharp ramp leaves 0.1 m at 0.5 s; the averages delay it by 0.175 s, the lead by 1 s."""
    with pytest.raises(RequestError, match=r"at 1\.67[56]0 s"):
        check(trajectories.trapezoid(0.8, 0.2), **_standard(travel_m=(-0.1, 0.1)))


def test_check_refuses_a_sweep_beyond_the_stroke():
    with pytest.raises(RequestError, match="the micro's stroke"):
        check(trajectories.sweep(1.2e-3, 1.0, 6.0), **_standard())


@pytest.mark.parametrize("column", SETPOINT.names)
def test_check_refuses_nan_in_any_column(column):
    made = trajectories.trapezoid(0.8, 0.2, start_m=-0.4)
    made.setpoints[column][1234] = math.nan
    with pytest.raises(RequestError, match=rf"1\.2340 s: {column} is nan"):
        check(made, **_standard())


def test_check_refuses_an_end_in_motion():
    whole = trajectories.trapezoid(0.8, 0.2, start_m=-0.4)
    cut = Trajectory("cut", {}, whole.dt_s, whole.setpoints[:3000])
    with pytest.raises(RequestError, match="must end at rest"):
        check(cut, **_standard())
