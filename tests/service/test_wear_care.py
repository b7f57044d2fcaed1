"""What the service does for the joint between two moves: what the profile permits, and never from what is unsure."""

import json
import math
import os

import numpy as np
import pytest

from sim_backend.machine import MACHINES_FOLDER
from stagectl.errors import RequestError
from stagectl.profile import PROFILES_FOLDER, Wear
from stagectl.requests import Phase
from stagectl.row import new_rows
from stagectl.service import messages
from stagectl.service.wear_watch import WearWatch
from stagectl.signals import SETPOINT
from stagectl.wear import LOOKS_COUNT, PRODUCTION
from tests.service.test_stage_loop import Bench
from tests.service.test_touch_probe import LIMIT_N, WIDTH_M, WORN
from tests.service.test_wear_watch import JOINT, joint
from tests.struck_stage import home_by_truth
from tests.toml_text import changed

FOREVER_S = 1e6
NEWS_M = 4e-6  # of an edge: more than is trusted, less than alarms
BEYOND_M = 60e-6


class Cared(Bench):
    """A bench on a joint that has worn; the joint's watch goes by a clock that is set by hand."""

    def __init__(self, folder):
        profile, machine = folder / "cared.toml", folder / "worn.toml"
        profile.write_text(changed(PROFILES_FOLDER / "oled-printer.toml", {"wear": {"probe_every_s": FOREVER_S}}))
        machine.write_text(changed(MACHINES_FOLDER / "oled-printer.toml", WORN))
        super().__init__(folder, str(profile))
        self.settings = self.loop.settings = type(self.settings)(
            **{name: getattr(self.settings, name) for name in ("profile", "backend", "runs_root", "state_folder")},
            machine=str(machine),
        )
        self.wear_s = 1000.0
        self.until(lambda: self.loop._state == "idle")
        self.permit()
        self.loop.step()
        home_by_truth(self.stage, self.rig.plant_state())
        self.loop._homed = True

    @property
    def stage(self):
        return self.loop._stage

    @property
    def rig(self):
        return self.stage.backend.rig

    @property
    def profile(self):
        return self.stage.profile

    def permit(self, **wear):
        """Begin to watch the joint anew, as a profile with this table would have it."""
        self.loop._wear = WearWatch(
            self.profile.model_copy(update={"wear": Wear(**wear)}), self.log, lambda: self.wear_s
        )

    def see(self, estimate, count=LOOKS_COUNT):
        """Have production motion show this for so many seconds, pressing both edges."""
        rows = new_rows(2)
        rows["run_phase"], rows["contact_force_estimate_n"] = int(Phase.TRACKING), (3.0, -3.0)
        for _ in range(count):
            self.wear_s += 1.0
            self.loop._wear.observe(rows)
            self.loop._wear.look(estimate)

    def steps(self, count=5):
        for _ in range(count):
            self.loop.step()

    def said(self, event):
        """What the log has of an event since the test began."""
        return [one for one in self.log.after(self.begun, 2000) if one.event == event]

    def probes(self):
        """The probes that were begun since the test began."""
        return [one.fields["key"] for one in self.said("command") if one.text == "probe"]

    def replacements(self):
        """What the newest run's events say of replacements."""
        folder = max(self.settings.runs_root.glob("*-service-arm"), key=os.path.getmtime)
        events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
        return [one for one in events if one["event"] == "backlash_replaced"]

    def rests(self):
        """Leave it idle, without a lease or a fault."""
        self.now_s += 100.0
        self.permit()
        self.until(lambda: not self.desk.powered)
        self.loop.step()
        if (fault := self.status.fault) is not None:
            self.take()
            assert self.do("acknowledge", messages.Acknowledge(number=fault.number)).state == "done"
            self.now_s += 100.0
        self.until(lambda: self.status.state == "idle" and not self.desk.stop_asked)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    bench = Cared(tmp_path_factory.mktemp("cared"))
    yield bench
    bench.loop.leave()
    bench.loop.run()


@pytest.fixture
def armed(made):
    """The bench with a lease, homed and armed; it believes the profile's joint, and is permitted nothing."""
    made.loop._homed = True
    made.take()
    assert made.do("arm", messages.Arm()).stop == "FINISHED"
    made.stage.replace_backlash(joint(made.profile))
    made.begun = made.log.last(1)[0].number
    yield made
    made.rests()


def worn(bench, by_m=NEWS_M):
    return joint(bench.profile, left_m=bench.profile.backlash.left_m + by_m)


def believes(bench):
    return bench.stage.believed_backlash()


# ---- what is believed ------------------------------------------------------------------------------------------------


def test_what_wear_made_of_the_joint_is_believed_as_soon_as_the_stage_holds_and_recorded(armed):
    armed.permit(compensate=True)
    before, found = believes(armed), worn(armed)
    in_motion = []
    progress = armed.loop._progress

    def shown(what, share):
        if share > 0.5 and not in_motion:
            armed.see(found)
            armed.loop._care_for_joint()
        if share > 0.5:
            in_motion.append((believes(armed), len(armed.said("backlash_replaced"))))
        progress(what, share)

    armed.stage._progress = shown
    assert armed.do("move", messages.Move(target_m=0.004)).stop == "FINISHED"
    armed.stage._progress = progress
    assert in_motion
    assert all(seen == (before, 0) for seen in in_motion)
    at_m = float(armed.stage.status()["setpoint_position_m"])
    armed.steps(20)
    assert believes(armed) == {name: getattr(found, name) for name in JOINT}
    assert armed.stage.status()["setpoint_position_m"] == pytest.approx(at_m, abs=1e-9)
    (said,) = armed.said("backlash_replaced")  # once: what is believed is no news
    assert said.text == f"the compensation believes {found.width_m * 1e6:.2f} um from now on"
    assert armed.status.wear.believed_since[:16] == said.at[:16]
    assert armed.status.wear.width_m == pytest.approx(found.width_m)
    (event,) = armed.replacements()[1:]  # the first is the fixture's
    assert (event["before"], event["after"]) == (before, believes(armed))
    armed.see(found)
    armed.steps()
    assert len(armed.replacements()) == 2


def not_homed(bench):
    bench.loop._homed = False


def no_power(bench):
    bench.desk.ask_to_stop("enough")
    bench.until(lambda: bench.status.state == "idle" and not bench.desk.stop_asked)


def a_fault(bench):
    bench.now_s += 100.0
    bench.until(lambda: bench.status.state == "fault")


def still_moving(bench):
    still = np.zeros(2000, SETPOINT)
    still["position_m"] = bench.stage.status()["setpoint_position_m"]
    bench.stage._begin_segment(still, "busy")


@pytest.mark.parametrize("state", [not_homed, no_power, a_fault, still_moving])
def test_nothing_is_believed_or_touched_but_by_a_homed_stage_that_holds(armed, state):
    state(armed)
    before = believes(armed)
    armed.permit(compensate=True, probe_every_s=10.0)
    armed.steps()
    assert armed.probes() == []
    armed.see(worn(armed))
    armed.steps()
    assert believes(armed) == before
    assert armed.said("backlash_replaced") == []
    assert armed.said("command") == []


@pytest.mark.parametrize(
    "change",
    [
        {"left_m": math.nan},
        {"right_m": math.inf},
        {"left_sd_m": math.nan},
        {"right_sd_m": math.inf},
        {"left_stiffness_n_per_m": math.nan},
        {"right_stiffness_n_per_m": math.inf},
        {"right_stiffness_n_per_m": -math.inf},
        {"left_stiffness_sd_n_per_m": math.inf},
        {"left_m": -1e-3},
    ],
    ids=str,
)
def test_what_is_no_number_is_neither_believed_nor_published(armed, change):
    armed.permit(compensate=True)
    before = believes(armed)
    armed.see(worn(armed, 0.0), LOOKS_COUNT - 1)
    published = armed.loop._wear.message().at
    armed.see(joint(armed.profile, **{"left_m": armed.profile.backlash.left_m + NEWS_M, **change}), LOOKS_COUNT + 2)
    armed.steps()
    assert believes(armed) == before
    assert armed.said("backlash_replaced") == []
    wear = armed.status.wear
    assert (wear.width_m, wear.alarm, wear.at) == (pytest.approx(joint(armed.profile).width_m), "", published)
    assert (armed.status.state, armed.status.fault) == ("armed", None)


@pytest.mark.parametrize(
    "change",
    [{"left_m": math.nan}, {"right_m": math.inf}, {"left_m": -1e-3}, {"left_stiffness_n_per_m": math.nan}],
    ids=str,
)
def test_the_compensation_itself_refuses_what_is_no_joint(armed, change):
    before, events = believes(armed), len(armed.replacements())
    with pytest.raises(RequestError, match="every value must be finite, width and stiffness above 0"):
        armed.stage.replace_backlash(joint(armed.profile, **change))
    armed.steps()
    assert believes(armed) == before
    assert len(armed.replacements()) == events


@pytest.mark.parametrize("left_m", [0.0, -1e-6])
def test_the_compensation_itself_refuses_an_edge_at_or_beyond_zero(armed, left_m):
    before, events = believes(armed), len(armed.replacements())
    with pytest.raises(RequestError, match="zero must be between its edges; the end's zero has moved: look at"):
        armed.stage.replace_backlash(joint(armed.profile, left_m=left_m))
    armed.steps()
    assert believes(armed) == before
    assert len(armed.replacements()) == events


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"left_m": BEYOND_M}, "the limit is 50 um"),
        ({"right_m": -BEYOND_M}, "the limit is 50 um"),
        ({"left_m": 26e-6, "right_m": -26e-6}, "look at the end's interferometer, then home"),
        ({"left_stiffness_n_per_m": 5e3}, "the left contact has"),
        ({"right_stiffness_n_per_m": -5e3}, "the right contact has"),
    ],
    ids=str,
)
def test_what_is_beyond_its_bounds_is_an_alarm_once_and_never_believed(armed, change, said):
    armed.permit(compensate=True)
    before = believes(armed)
    beyond = {name: getattr(armed.profile.backlash, name) + by for name, by in change.items()}
    for _ in range(2):
        armed.see(joint(armed.profile, **beyond))
        armed.steps()
    assert believes(armed) == before
    assert armed.said("backlash_replaced") == []
    (alarm,) = armed.said("wear_alarm")
    assert said in alarm.text
    assert armed.status.wear.alarm == alarm.text
    assert "stagectl_backlash_wear_alarm 1.0" in armed.figures.exposition(armed.status).decode()
    assert armed.status.state == "armed"  # an alarm stops nothing
    armed.see(worn(armed, 0.0))
    armed.steps()
    assert [one.text for one in armed.said("wear")] == ["within its limits again"]
    assert armed.status.wear.alarm == ""


@pytest.mark.parametrize("wear", [{}, {"probe_every_s": FOREVER_S}], ids=["nothing", "a probe only"])
def test_what_the_profile_does_not_permit_is_published_only(armed, wear):
    armed.permit(**wear)
    before = believes(armed)
    armed.see(worn(armed))
    armed.steps()
    assert believes(armed) == before
    assert armed.said("command") == armed.said("backlash_replaced") == []
    assert armed.status.wear.width_m == pytest.approx(worn(armed).width_m)
    assert armed.status.wear.believed_since == ""


# ---- age -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("drift", "walks"), [(0.0, 1e-9), (3e-8, 3e-8)])
def test_what_nothing_confirms_grows_old_and_less_sure_and_says_so(armed, drift, walks):
    armed.permit(edge_drift_m_per_sqrt_s=drift)
    armed.steps()
    assert armed.status.wear is None
    armed.see(worn(armed))
    armed.steps()
    fresh = armed.status.wear
    assert (fresh.observable, fresh.text, fresh.age_s, fresh.source) == (True, "", 0.0, PRODUCTION)
    for age_s, text in ((11.0, "11 s old"), (7200.0, "2.0 h old"), (30 * 86400.0, "30.0 days old")):
        armed.wear_s += age_s - armed.status.wear.age_s
        armed.steps()
        wear = armed.status.wear
        assert (wear.age_s, wear.observable) == (pytest.approx(age_s), False)
        assert wear.text.startswith("not observable: ")
        assert wear.text.endswith(text)
        assert wear.width_sd_m == pytest.approx(math.hypot(fresh.width_sd_m, walks * math.sqrt(2.0 * age_s)))
        assert (wear.width_m, wear.at, wear.source) == (fresh.width_m, fresh.at, fresh.source)
    armed.see(worn(armed), 1)
    armed.steps()
    assert armed.status.wear.width_sd_m == fresh.width_sd_m
    assert armed.status.wear.observable


# ---- the service's own probe -----------------------------------------------------------------------------------------


def test_a_probe_waits_for_the_end_of_a_move_and_goes_by_the_clock(armed):
    armed.permit(probe_every_s=600.0, compensate=True)
    armed.see(worn(armed), 1)
    armed.steps()
    assert armed.probes() == []  # production told of the joint
    progress = armed.loop._progress

    def grow_old(what, share):
        if share > 0.5 and not armed.loop._wear.probe_due():
            armed.wear_s += 601.0
            armed.loop._care_for_joint()
            assert armed.probes() == []
        progress(what, share)

    armed.stage._progress = grow_old
    assert armed.do("move", messages.Move(target_m=-0.004)).stop == "FINISHED"
    armed.stage._progress = progress
    assert armed.loop._wear.probe_due()
    assert armed.probes() == []
    armed.until(armed.probes)
    (key,) = armed.probes()
    assert armed.desk.command(key).stop == "FINISHED"
    armed.steps()
    found = armed.status.wear
    assert found.width_m == pytest.approx(WIDTH_M, abs=1e-6)
    assert believes(armed) == {name: getattr(found, name) for name in JOINT}  # the probe's, by itself
    assert len(armed.said("backlash_replaced")) == 1
    armed.wear_s += 590.0
    armed.steps()
    assert armed.probes() == [key]
    armed.wear_s += 20.0
    assert armed.loop._wear.probe_due()


def probe_begins(bench):
    """Step until a probe begins, which is stopped at once."""
    progress = bench.loop._progress

    def enough(what, share):
        bench.desk.ask_to_stop("seen")
        progress(what, share)

    bench.stage._progress = enough
    bench.until(bench.probes)
    bench.stage._progress = progress


@pytest.mark.parametrize("lease", ["none", "over"])
def test_without_a_lease_nothing_is_touched(armed, lease):
    armed.permit(probe_every_s=10.0)
    held, began_s = armed.desk._lease, armed.now_s
    if lease == "none":
        armed.desk._lease = None
    else:
        armed.now_s += 100.0
    armed.loop._care_for_joint()
    assert armed.desk.next_order() is None
    armed.desk._lease, armed.now_s = held, began_s
    probe_begins(armed)


def test_a_probe_that_another_command_came_before_is_due_again_at_once(armed):
    armed.permit(probe_every_s=FOREVER_S)
    armed.loop.step()  # the probe waits
    assert armed.desk._current.name == "probe"
    assert armed.do("move", messages.Move(target_m=0.004)).stop == "FINISHED"
    assert armed.probes() == []
    probe_begins(armed)


def give_back(bench):
    bench.desk.give_lease_back(bench.token)


def run_out(bench):
    bench.now_s += 100.0


def stop(bench):
    bench.desk.ask_to_stop("hands in the machine")


@pytest.mark.parametrize(
    ("ends", "how", "then"), [(stop, "OPERATOR", "idle"), (give_back, "OPERATOR", "idle"), (run_out, "LEASE", "fault")]
)
def test_what_ends_the_service_s_own_probe_ends_it_at_once_and_says_nothing_of_the_joint(armed, ends, how, then):
    armed.permit(compensate=True, probe_every_s=FOREVER_S)
    before, progress, begun_t_ns = believes(armed), armed.loop._progress, []

    def in_contact(what, share):
        plant = armed.rig.plant_state()
        gap_m = plant["macro_position_m"] - plant["end_position_m"]
        if not begun_t_ns and not -WORN["backlash.left_m"] < gap_m < WORN["backlash.right_m"]:
            begun_t_ns.append(armed.stage.link.now_t_ns())
            ends(armed)
        progress(what, share)

    armed.stage._progress = in_contact
    armed.until(armed.probes)
    armed.stage._progress = progress
    (key,) = armed.probes()
    armed.until(lambda: armed.status.state == then)
    assert armed.desk.command(key).stop == how
    assert armed.stage.link.now_t_ns() - begun_t_ns[0] < 1.5e9  # it would have gone on for seconds
    assert armed.desk.command(key).backlash is None
    assert armed.status.wear is None
    assert believes(armed) == before
    assert np.max(np.abs(armed.stage.backend.truth()["contact_force_n"])) < LIMIT_N
    armed.rests()
    armed.permit(compensate=True, probe_every_s=FOREVER_S)
    armed.take()
    armed.loop._wear.probe_begun()
    assert armed.do("arm", messages.Arm()).stop == "FINISHED"
    armed.steps()
    assert armed.probes() == [key]


# ---- what is no production -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "body"), [("home", messages.Home()), ("identify", messages.Identify()), ("probe", messages.Probe())]
)
def test_a_sweep_that_is_stopped_near_its_end_says_nothing_of_production(armed, name, body):
    """Looks into homing's, in zeros not yet laid, were kept as production's in the place of what was identified."""
    identified = armed.loop._memory.joint("batch", armed.profile.name)
    armed.loop._wear = WearWatch(armed.profile, armed.log, lambda: armed.stage.link.now_t_ns() * 1e-9)
    progress, near_the_end = armed.loop._progress, []

    def then_stop(what, share):
        if share > 0.95 and what in ("touching both edges", "identifying the backlash") and not near_the_end:
            near_the_end.append(armed.stage.backlash(armed.stage.status()).identifiable)
            armed.desk.ask_to_stop("seen enough")
        progress(what, share)

    armed.stage._progress = then_stop
    done = armed.do(name, body)
    armed.stage._progress = progress
    assert (done.stop, near_the_end) == ("OPERATOR", [True])
    armed.until(lambda: armed.status.state == "idle" and not armed.desk.stop_asked)
    armed.steps()
    assert armed.status.wear is None
    assert armed.loop._memory.joint("batch", armed.profile.name) == identified
    if name == "home":
        assert not armed.status.homed
        home_by_truth(armed.stage, armed.rig.plant_state())
