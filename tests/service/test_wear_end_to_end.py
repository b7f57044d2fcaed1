"""A joint that wears while the stage works: seen in its motion, believed within limits, an alarm beyond them."""

import json

import numpy as np

from stagectl import trajectory
from stagectl.profile import Wear
from stagectl.record import read_run
from stagectl.replay import replay_run
from stagectl.service.service_log import ServiceLog
from stagectl.service.wear_watch import WearWatch
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from tests.struck_stage import Stage

RATE_M_PER_S = 0.06e-6  # of the gap: a month's wear in a minute
WORN_M = 1e-6  # of each edge, when the stage is switched on
LIMIT_M = 3.5e-6
DURATION_S = 44.0  # at the end beyond the limit by 1.2 um, 2.5 standard deviations


class Worn(Stage):
    """A stage whose joint is followed as the service follows it."""

    def __init__(self, folder, profile, machine):
        super().__init__(folder, profile, machine)
        self.joint = machine.backlash
        self.log = ServiceLog(None)
        self.watch = WearWatch(profile, self.log, self.now_s)
        self.stage = Supervisor(profile, self.backend, folder, self._look, observe=self.watch.observe)
        self.published, self.replaced = [], []

    def now_s(self):
        return self.stage.link.now_t_ns() * 1e-9

    @property
    def true_width_m(self):
        return self.joint.left_m + self.joint.right_m + RATE_M_PER_S * self.plant["t_s"]

    def _look(self, what, share):
        if what != "work":
            return
        before = self.watch.message()
        self.watch.look(self.stage.backlash(self.stage.status()))
        wear = self.watch.message()
        if wear is not None and (before is None or wear.width_m != before.width_m):
            self.published.append((self.true_width_m, wear))

    def work(self):
        start_m = float(self.stage.status()["setpoint_position_m"])
        move = trajectory.trapezoid(0.3, 0.2, (0.25, 0.15), dwell_s=0.1, start_m=start_m, lead_s=0.05)
        outcome = self.stage.follow(move.setpoints, "work", self.law)
        assert outcome.finished, outcome
        found = self.watch.replacement(self.stage.believed_backlash())
        if found is not None:
            self.stage.replace_backlash(found)
            self.watch.replaced(found)
            self.replaced.append((self.true_width_m, found.width_m))


def test_wear_is_followed_believed_and_said(oled_profile, oled_machine, tmp_path):
    weak = oled_profile.control.model_copy(update={"macro_bandwidth_hz": 6.0, "macro_feed_forward_ratio": 0.0})
    limits = Wear(width_change_limit_m=LIMIT_M, trusted_sd_m=0.8e-6, edge_drift_m_per_sqrt_s=0.3e-6, compensate=True)
    profile = oled_profile.model_copy(update={"wear": limits, "control": weak})
    joint = {name: getattr(profile.backlash, name) + WORN_M for name in ("left_m", "right_m")}
    wears = {"name": "backlash_wear", "acts_on": "contact_edge", "rate_m_per_s": RATE_M_PER_S}
    machine = oled_machine.model_copy(update={"backlash": oled_machine.backlash.model_copy(update=joint)})
    one = Worn(tmp_path / "run", profile, machine.model_copy(update={"effects": (*machine.effects, wears)}))
    with one:
        assert one.arm() is Stop.NONE
        while one.now_s() < DURATION_S:
            one.work()
        believed = one.stage.believed_backlash()

    assert len(one.published) >= 15
    off = np.array([(wear.width_m - true_m) / wear.width_sd_m for true_m, wear in one.published])
    assert np.all(np.abs(off) < 3.0)
    assert all(wear.observable and wear.source == "production" for _, wear in one.published)

    (alarm,) = [entry.text for entry in one.log.last(100) if entry.event == "wear_alarm"]
    assert "the limit is 3.5 um" in alarm
    first_m = next(true_m for true_m, wear in one.published if wear.alarm)
    assert abs(first_m - profile.backlash.left_m - profile.backlash.right_m - LIMIT_M) < 3.0 * limits.trusted_sd_m

    ((then_m, taken_m),) = one.replaced  # once: what it learns from then on is no news
    assert abs(taken_m - then_m) < 3.0 * limits.trusted_sd_m
    assert then_m < first_m
    assert believed["left_m"] + believed["right_m"] == taken_m
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [event["event"] for event in events].count("backlash_replaced") == 1
    assert replay_run(read_run(tmp_path / "run")).first_difference == ""
