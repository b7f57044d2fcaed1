"""A motion to the end of travel ends there, whatever asks for it; what is beyond is refused before it moves."""

import pytest

from sim_backend.machine import load_machine
from stagectl.backend import BatchBackend
from stagectl.errors import RequestError
from stagectl.motion import planned_limits, travel_from
from stagectl.profile import load_profile
from stagectl.scan import plan
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from stagectl.trajectory import Waypoint


@pytest.fixture(scope="module", params=["oled-printer", "single-axis"])
def stage(request, tmp_path_factory):
    backend = BatchBackend(load_machine(request.param), seed=1)
    with Supervisor(load_profile(request.param), backend, tmp_path_factory.mktemp(request.param) / "run") as one:
        assert one.home().finished
        assert one.armed().finished
        yield one


def at_rest_m(stage) -> float:
    return float(stage.status()["setpoint_position_m"])


@pytest.mark.parametrize("end", [0, 1])
def test_a_move_to_the_end_ends_there_and_comes_back_after_power_was_off(stage, end):
    end_m = stage.profile.macro.travel_m[end]
    assert stage.move(end_m).stop is Stop.FINISHED
    assert at_rest_m(stage) == end_m
    stage.disarm()
    assert stage.armed().finished
    assert stage.move(0.9 * end_m).stop is Stop.FINISHED


def test_a_jog_runs_to_the_end_and_holds(stage):
    end_m = stage.profile.macro.travel_m[1]
    assert stage.move(end_m - 0.01).finished
    asked = iter([0.05] * 60)
    assert stage.jog(lambda: next(asked, None)).stop is Stop.FINISHED
    assert at_rest_m(stage) == pytest.approx(end_m, abs=1e-6)


def test_a_scan_turns_at_the_end(stage):
    low_m = stage.profile.macro.travel_m[0]
    assert stage.move(low_m + 0.02).finished
    turns = [Waypoint(low_m, 0.05), Waypoint(low_m + 0.02, 0.05)]
    program = plan(low_m + 0.02, turns, 2, planned_limits(stage.profile), stage.profile.cycle.period_s)
    assert stage.scan(program).stop is Stop.FINISHED


def test_a_micrometre_beyond_is_refused(stage):
    rows = stage.recorder.rows_count
    with pytest.raises(RequestError, match=r"the travel \["):
        stage.move(stage.profile.macro.travel_m[1] + 1e-6)
    assert stage.recorder.rows_count == rows


def test_only_a_stage_that_stands_beyond_may_be_there(stage):
    low_m, high_m = stage.profile.macro.travel_m
    stray_m = stage.profile.control.error_limit_m
    assert travel_from(0.0, stage.profile) == (low_m, high_m)
    assert travel_from(high_m + 30e-9, stage.profile) == (low_m, high_m + 30e-9)
    assert travel_from(low_m - 1.0, stage.profile) == (low_m - stray_m, high_m)
