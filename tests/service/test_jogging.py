"""Jogging in virtual time: the reference never jumps, whatever is wanted when, and every plan ends at rest."""

import numpy as np
import pytest

from stagectl import jogging
from stagectl import trajectory as trajectories
from stagectl.backend import BatchBackend
from stagectl.errors import RequestError
from stagectl.motion import check, planned_limits
from stagectl.profile import load_profile
from stagectl.record import read_run
from stagectl.replay import replay
from stagectl.requests import Phase
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from tests.struck_stage import home_by_truth

DT_S = 1e-3
LIMITS = trajectories.Limits(0.4, 0.9, 9.0)
TRAVEL_M = (-0.45, 0.45)


@pytest.fixture(scope="module")
def jogged(oled_profile, oled_machine, tmp_path_factory):
    """One jog there and back with changes of mind, then a stop in the middle of another: (outcomes, run)."""
    folder = tmp_path_factory.mktemp("jog") / "run"
    backend = BatchBackend(oled_machine, seed=5)
    with Supervisor(oled_profile, backend, folder) as stage:
        home_by_truth(stage, backend.rig.plant_state())
        assert stage.enable() is Stop.NONE
        begun_t_ns = stage.link.now_t_ns()

        def hand() -> float | None:
            t_s = (stage.link.now_t_ns() - begun_t_ns) * 1e-9 - 1.2
            for until_s, wanted in ((0.5, 0.05), (0.6, 0.1), (0.65, -0.1), (1.0, -0.08), (1.2, 0.0), (1.5, 0.02)):
                if t_s < until_s:
                    return wanted
            return None

        first = stage.jog(hand)
        held = stage.status()["phase"] == Phase.TRACKING
        left = []

        def until_stopped() -> float | None:
            left.append(None)
            if len(left) == 30:
                stage.ask_to_stop()
            return 0.05

        second = stage.jog(until_stopped)
        refused = stage.enable()
        stage.disarm()
        stage.allow_motion()
    return first, held, second, refused, read_run(folder), replay(folder)


def test_a_jog_ends_where_it_was_let_go_and_holds(jogged):
    first, held, *_ = jogged
    assert first.stop is Stop.FINISHED
    assert held


def test_the_reference_never_jumps(jogged, oled_profile):
    rows = jogged[4].rows
    moving = rows[rows["run_phase"] == Phase.TRACKING]
    velocity = moving["setpoint_velocity_m_per_s"]
    assert velocity.max() > 0.09
    assert velocity.min() < -0.07
    step_s = np.diff(moving["cycle"]) * DT_S
    limit = oled_profile.macro.acceleration_limit_m_per_s2
    assert np.all(np.abs(np.diff(velocity)) <= limit * step_s + 1e-9)
    moved_m = np.diff(moving["setpoint_position_m"])
    fastest = np.maximum(np.abs(velocity[1:]), np.abs(velocity[:-1]))
    assert np.all(np.abs(moved_m) <= (fastest + limit * DT_S) * step_s + 1e-9)


def test_a_stop_ends_a_jog_and_nothing_is_enabled_after_it(jogged):
    _, _, second, refused, _, _ = jogged
    assert second.stop is Stop.OPERATOR
    assert refused is Stop.OPERATOR


def test_a_jog_replays_bit_for_bit(jogged):
    assert jogged[5].exact


@pytest.mark.parametrize("velocity", [0.3, -0.3, 0.0, 1e-4])
def test_a_way_ends_at_rest_within_the_travel(velocity):
    for position_m, speed in ((0.0, 0.0), (0.3, 0.2), (-0.3, -0.2), (0.42, 0.1)):
        start = trajectories.MotionState(position_m, speed)
        planned = jogging.way(start, velocity, LIMITS, TRAVEL_M, DT_S)
        trajectories.check(planned, TRAVEL_M, 0.5, 1.0, stop_deceleration_m_per_s2=2.0)
        rows = planned.setpoints
        assert rows["position_m"][0] == pytest.approx(position_m)
        assert rows["velocity_m_per_s"][0] == pytest.approx(speed)
        assert rows["velocity_m_per_s"][-1] == 0.0


def test_a_splice_goes_on_where_the_old_way_is_then():
    under_way = jogging.way(trajectories.MotionState(0.0), 0.2, LIMITS, TRAVEL_M, DT_S).setpoints
    spliced = jogging.splice(under_way, 400, -0.1, LIMITS, TRAVEL_M, DT_S)
    assert spliced is not None
    (at_row, rows), _ = spliced
    assert at_row == 400 + round(jogging.AHEAD_S / DT_S)
    last = under_way[at_row - 1]
    assert rows["position_m"][0] - last["position_m"] == pytest.approx(last["velocity_m_per_s"] * DT_S, abs=1e-6)
    assert jogging.splice(under_way, under_way.size - 10, -0.1, LIMITS, TRAVEL_M, DT_S) is None


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("wanted", [0.0, 0.05, -0.17])  # let go, slower, the other way
@pytest.mark.parametrize("name", ["oled-printer", "single-axis"])
def test_a_mind_that_changes_shortly_before_the_end_of_travel_leaves_it_not(name, wanted, end):
    """The way to rest from a row of one that ends at the limit ended 1e-17 m beyond it, and the jog was refused."""
    profile = load_profile(name)
    limits, travel_m = planned_limits(profile), profile.macro.travel_m
    towards = 1.0 if end else -1.0
    start = trajectories.MotionState(travel_m[end] - 0.1 * towards)
    under_way = jogging.way(start, 0.17 * towards, limits, travel_m, DT_S).setpoints
    taken_count = 0
    for done_rows in range(under_way.size):
        spliced = jogging.splice(under_way, done_rows, wanted * towards, limits, travel_m, DT_S)
        if spliced is not None:
            check(spliced[1], profile)
            taken_count += 1
    assert taken_count > 0.2 * under_way.size  # far from the end it is taken at once


@pytest.mark.parametrize("velocity", [0.41, -0.41, float("nan"), float("inf")])
def test_a_jog_is_no_faster_than_it_may(velocity):
    with pytest.raises(RequestError, match=r"a jog may do 0.4 m/s"):
        jogging.wanted_speed(velocity, LIMITS)


@pytest.fixture
def standing(oled_profile, oled_machine, tmp_path):
    """A stage that holds."""
    backend = BatchBackend(oled_machine, seed=5)
    with Supervisor(oled_profile, backend, tmp_path / "run") as stage:
        home_by_truth(stage, backend.rig.plant_state())
        assert stage.enable() is Stop.NONE
        yield stage


def test_a_splice_that_comes_too_late_is_not_taken(standing):
    stage = standing
    start = trajectories.MotionState(float(stage.status()["setpoint_position_m"]))
    under_way = jogging.way(start, 0.02, LIMITS, TRAVEL_M, DT_S).setpoints
    number = stage._begin_segment(under_way, "test")
    stage.pump(0.4)
    late = jogging.splice(under_way, 0, -0.02, LIMITS, TRAVEL_M, DT_S)[0]
    stage._begin_segment(late.setpoints, "late", at_row=late.at_row)
    status = stage.pump(0.1)
    assert status["segment_number"] == number
    done_rows = under_way.size - int(status["segment_left_rows"])
    assert status["setpoint_position_m"] == under_way["position_m"][done_rows - 1]
    spliced = jogging.splice(under_way, done_rows, -0.02, LIMITS, TRAVEL_M, DT_S)[0]
    taken = stage._begin_segment(spliced.setpoints, "in time", at_row=spliced.at_row)
    stage.pump(0.1)
    assert stage.status()["segment_number"] == number
    assert stage.pump(0.1)["segment_number"] == taken


def test_a_segment_that_was_asked_for_before_a_stop_is_never_begun_after_it(standing):
    stage = standing
    stage.disarm()
    start = trajectories.MotionState(float(stage.status()["setpoint_position_m"]))
    stage._begin_segment(jogging.way(start, 0.02, LIMITS, TRAVEL_M, DT_S).setpoints, "too late")
    stage.pump(0.1)
    assert stage.enable() is Stop.NONE
    held_m = float(stage.status()["setpoint_position_m"])
    for _ in range(10):
        assert stage.pump()["setpoint_position_m"] == held_m
