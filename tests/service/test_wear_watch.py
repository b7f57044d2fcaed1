"""Wear in the service: what rows and estimates make of what clients see, and what it does to a stage that holds."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from stagectl.errors import RequestError
from stagectl.outcome import BacklashEstimate
from stagectl.profile import Wear
from stagectl.record import read_run
from stagectl.replay import replay_run
from stagectl.requests import Phase
from stagectl.row import new_rows
from stagectl.service import messages
from stagectl.service.service_log import ServiceLog
from stagectl.service.view import backlash_message
from stagectl.service.wear_watch import WearWatch
from stagectl.signals import SETPOINT
from stagectl.wear import IDENTIFIED, LOOKS_COUNT, PRODUCTION
from tests.struck_stage import Stage

JOINT = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")


def joint(profile, **changes):
    """The profile's own joint as a sure estimate, with changes."""
    b = profile.backlash
    values = {
        name: getattr(b, name) for name in ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")
    }
    sds = dict(left_sd_m=1e-7, right_sd_m=1e-7, left_stiffness_sd_n_per_m=20.0, right_stiffness_sd_n_per_m=20.0)
    return BacklashEstimate(**{**values, **sds, **changes})


class Watched:
    """A watch on a clock that is set by hand."""

    def __init__(self, profile, **wear):
        self.profile = profile.model_copy(update={"wear": Wear(**wear)})
        self.now_s = 1000.0
        self.log = ServiceLog(None)
        self.watch = WearWatch(self.profile, self.log, lambda: self.now_s)

    def work(self, estimate, *forces_n, phase=Phase.TRACKING):
        """A second of production motion that presses with these forces."""
        self.now_s += 1.0
        rows = new_rows(4)
        rows["run_phase"] = int(phase)
        for row, force_n in enumerate(forces_n):
            rows["contact_force_estimate_n"][row] = force_n
        self.watch.observe(rows)
        self.watch.look(estimate)
        return self.watch.message()


def test_what_production_showed_is_still_that_after_a_restart(oled_profile):
    one, after = Watched(oled_profile), Watched(oled_profile)
    seen = one.work(joint(oled_profile), 3.0, -3.0)
    found = one.watch.newest_of_production()
    after.watch.recall(backlash_message(found, "r", "oled-printer", "rig", one.watch.seen_at, PRODUCTION))
    again = after.watch.message()
    assert (again.source, again.observable) == (PRODUCTION, False)
    assert again.left_stiffness_sd_n_per_m == pytest.approx(seen.left_stiffness_sd_n_per_m, rel=1e-3)


def test_contact_on_both_sides_makes_it_observable_and_its_absence_is_said(oled_profile):
    one = Watched(oled_profile)
    found = joint(oled_profile)
    assert one.work(found, 3.0) is None
    assert one.work(found, 3.0, -3.0, phase=Phase.QUICK_STOP) is None
    assert one.work(found, 0.2, -0.2) is None
    seen = one.work(found, 3.0, -3.0)
    assert (seen.source, seen.observable, seen.text, seen.alarm) == ("production", True, "", "")
    assert seen.width_m == pytest.approx(found.width_m)
    assert seen.width_sd_m == pytest.approx(math.hypot(1e-7, 1e-7))
    for _ in range(3):
        one.now_s += 3600.0
        before, seen = seen, one.work(replace(found, left_m=1.0))
        assert not seen.observable
        assert seen.text.startswith("not observable: both edges were not touched lately; the value is ")
        assert seen.width_m == pytest.approx(found.width_m)
        assert seen.width_sd_m > before.width_sd_m
        assert seen.left_stiffness_sd_n_per_m > before.left_stiffness_sd_n_per_m
    assert seen.age_s == pytest.approx(3.0 * 3601.0)


def test_an_alarm_is_said_once_and_taken_back(oled_profile):
    one = Watched(oled_profile, width_change_limit_m=5e-6)
    worn = joint(oled_profile, left_m=oled_profile.backlash.left_m + 6e-6)
    for _ in range(3):
        seen = one.work(worn, 3.0, -3.0)
    assert "the limit is 5 um" in seen.alarm
    one.work(joint(oled_profile), 3.0, -3.0)
    assert [entry.event for entry in one.log.last(10)] == ["wear_alarm", "wear"]


def test_a_remembered_joint_is_the_last_value_after_a_restart(oled_profile):
    one = Watched(oled_profile)
    kept = {"centre_m": 0.0, "width_m": 1e-3, "width_sd_m": 1e-6, "run": "r", "profile_name": "p", "backend": "rig"}
    kept |= {"left_m": 5e-4, "right_m": 5e-4, "left_stiffness_n_per_m": 1e4, "right_stiffness_n_per_m": 1e4}
    one.watch.recall(messages.Backlash(**kept, at="2026-01-01T00:00:00.000+00:00"))
    seen = one.watch.message()
    assert (seen.source, seen.observable, seen.at[:10]) == (IDENTIFIED, False, "2026-01-01")
    assert seen.age_s > 86400.0
    assert seen.width_sd_m > 1e-6
    other = Watched(oled_profile)
    other.watch.recall(None)
    assert other.watch.message() is None


def test_only_a_permitted_sure_and_new_value_is_a_replacement(oled_profile):
    believed = {
        name: getattr(joint(oled_profile), name)
        for name in ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")
    }
    worn = joint(oled_profile, left_m=oled_profile.backlash.left_m + 4e-6)
    for wear, estimate, is_due in (
        ({"compensate": True}, worn, True),
        ({}, worn, False),
        ({"compensate": True}, joint(oled_profile), False),
        ({"compensate": True, "width_change_limit_m": 3e-6}, worn, False),
        ({"compensate": True}, replace(worn, left_sd_m=1e-6), False),
    ):
        one = Watched(oled_profile, **wear)
        for _ in range(LOOKS_COUNT):
            assert one.watch.replacement(believed) is None
            one.work(estimate, 3.0, -3.0)
        found = one.watch.replacement(believed)
        assert (found is not None) == is_due
    one = Watched(oled_profile, compensate=True)
    for _ in range(LOOKS_COUNT):
        one.work(worn, 3.0, -3.0)
    one.watch.replaced(worn)
    assert one.watch.replacement(believed) is None
    assert one.watch.message().believed_since


@pytest.mark.parametrize(
    ("is_believed", "sd_m", "is_due"), [(False, 1e-7, True), (True, 1e-7, False), (False, 1e-6, False)]
)
def test_what_was_measured_is_a_replacement_by_itself_unless_it_is_believed_already(
    oled_profile, is_believed, sd_m, is_due
):
    one = Watched(oled_profile, compensate=True)
    believed = {name: getattr(joint(oled_profile), name) for name in JOINT}
    found = joint(oled_profile, left_m=oled_profile.backlash.left_m + 4e-6, left_sd_m=sd_m)
    one.watch.found(found, IDENTIFIED, is_believed=is_believed)
    for _ in range(3):
        one.work(found)  # nothing is pressed
    assert one.watch.replacement(believed) == (found if is_due else None)
    assert one.watch.message().width_m == found.width_m


def test_a_probe_is_due_where_it_is_permitted_and_nothing_else_told_of_the_joint(oled_profile):
    assert not Watched(oled_profile).watch.probe_due()
    one = Watched(oled_profile, probe_every_s=60.0)
    assert one.watch.probe_due()
    assert one.watch.probe_due()  # until one begins, whatever becomes of that
    one.watch.probe_begun()
    assert not one.watch.probe_due()
    one.now_s += 61.0
    one.work(joint(oled_profile), 3.0, -3.0)
    assert not one.watch.probe_due()
    one.now_s += 61.0
    assert one.watch.probe_due()
    one.work(joint(oled_profile, left_sd_m=2e-7), 3.0, -3.0)  # less sure than what stands, and as sure as is trusted
    assert not one.watch.probe_due()
    assert one.watch.message().age_s == pytest.approx(62.0)


def test_a_stage_that_holds_takes_a_new_belief_without_moving_and_replays(oled_profile, oled_machine, tmp_path):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        stage = one.stage
        one.arm()
        with pytest.raises(RequestError, match=r"permits no touch probe; give wear.probe_every_s"):
            stage.probe()
        stage.pump(0.3)
        before, held_m = stage.status(), one.plant["end_position_m"]
        worn = joint(oled_profile, left_m=oled_profile.backlash.left_m + 4e-6)
        stage.replace_backlash(worn)
        stage.pump(0.3)
        after = stage.status()
        assert abs(one.plant["end_position_m"] - held_m) < 0.3e-6
        assert after["setpoint_position_m"] == pytest.approx(before["setpoint_position_m"], abs=1e-9)
        assert stage.believed_backlash()["left_m"] == worn.left_m
        assert not stage.backlash(after).identifiable
        moved = stage.move(float(after["setpoint_position_m"]) + 1e-3)
        assert moved.finished
        still = np.zeros(500, SETPOINT)
        still["position_m"] = stage.status()["setpoint_position_m"]
        stage._begin_segment(still, "busy")
        stage.pump(0.05)
        with pytest.raises(RequestError, match="between moves only"):
            stage.replace_backlash(worn)
    run = read_run(tmp_path / "run")
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    (replaced,) = [event for event in events if event["event"] == "backlash_replaced"]
    assert replaced["after"]["left_m"] - replaced["before"]["left_m"] == pytest.approx(4e-6)
    assert replay_run(run).first_difference == ""
