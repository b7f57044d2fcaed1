"""The stage's thread on the rig in virtual time: faults, what leads out of them, refusals, worlds that are missing."""

import os
import socket
import threading
import time

import pytest

from drivers import cia402
from sim_backend.faults import Fault
from stagectl.errors import JogOver, RequestError
from stagectl.outcome import BacklashEstimate
from stagectl.profile import PROFILES_FOLDER
from stagectl.requests import Mode, Phase
from stagectl.row import new_rows
from stagectl.service import messages
from stagectl.service.desk import Busy, Desk, Ending, Order, Unfit
from stagectl.service.exposition import Figures
from stagectl.service.lease import LeaseRefused
from stagectl.service.notify import Notifier
from stagectl.service.remembered import Memory, Remembered, recall
from stagectl.service.service_log import ServiceLog
from stagectl.service.stage_loop import StageLoop
from stagectl.service.stage_state import Settings
from stagectl.signals import Stop
from tests.struck_stage import home_by_truth
from tests.toml_text import changed

pytestmark = pytest.mark.real_time

PATIENCE_S = 60.0


def joint(backend):
    """What a joint was identified as in a world."""
    return messages.Backlash(
        width_m=2e-4, centre_m=0.0, left_m=1e-4, right_m=1e-4, left_stiffness_n_per_m=1e4,
        right_stiffness_n_per_m=1e4, width_sd_m=1e-7, at="2026-01-01T00:00:00.000+00:00", run="r",
        profile_name="oled-printer", backend=backend,
    )  # fmt: skip


class Bench:
    """A loop in virtual time, driven step by step, and one operator."""

    def __init__(self, folder, profile="single-axis", backend="batch", remembered=None):
        self.log = ServiceLog(None)
        self.now_s = 0.0
        self.desk = Desk(self.log, lambda: self.now_s)
        self.figures = Figures()
        self.settings = Settings(profile, backend, folder / "runs", folder / "state")
        remembered = remembered or Remembered()
        self.loop = StageLoop(self.settings, self.desk, self.log, remembered, Notifier({}), self.figures)
        self.token = ""
        self.keys = 0

    @property
    def status(self):
        return self.desk.status()

    def until(self, done):
        """Step until `done`."""
        give_up_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < give_up_s, self.status
            self.loop.step()

    def take(self):
        self.token = self.desk.take_lease(messages.TakeLease(holder="anna", duration_s=30.0)).token

    def begin(self, name, body):
        self.keys += 1
        return self.desk.submit(name, body, f"k{self.keys}", self.token).key

    def do(self, name, body):
        """Submit and carry out; returns the finished command."""
        key = self.begin(name, body)
        self.until(lambda: self.desk.command(key).state in ("done", "failed"))
        return self.desk.command(key)

    def hold_as_homed_by_truth(self):
        """Connect, take the lease and arm, with the zeros that the rig knows: a homing of 10 s less."""
        self.loop.show()
        self.until(lambda: self.status.state == "idle")
        home_by_truth(self.loop._stage, self.loop._stage.backend.rig.plant_state())
        self.loop._homed = True
        self.take()
        assert self.do("arm", messages.Arm()).stop == "FINISHED"

    def inject(self, *faults):
        backend = self.loop._stage.backend
        for fault in faults:
            backend.rig.inject(fault, backend.wire.t_ns)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    made = Bench(tmp_path_factory.mktemp("service"))
    made.loop.show()
    made.until(lambda: made.status.state == "idle")
    yield made
    made.loop.leave()
    made.loop.run()
    assert made.status.state in ("off", "fault")


@pytest.fixture
def armed(bench):
    """The bench with a lease, homed and armed; at the end without."""
    bench.take()
    if not bench.status.homed:
        assert bench.do("home", messages.Home()).stop == "FINISHED"
    if bench.status.state == "idle":
        assert bench.do("arm", messages.Arm()).stop == "FINISHED"
    assert bench.status.state == "armed"
    yield bench
    bench.now_s += 100.0
    bench.until(lambda: not bench.desk.powered)
    bench.loop.step()
    if (fault := bench.status.fault) is not None:
        bench.take()
        assert bench.do("acknowledge", messages.Acknowledge(number=fault.number)).state == "done"
    bench.now_s += 100.0
    bench.until(lambda: bench.status.state == "idle")


def test_nothing_moves_without_a_lease(bench):
    for name, body in (
        ("arm", messages.Arm()),
        ("home", messages.Home()),
        ("move", messages.Move(target_m=0.0)),
        ("backend", messages.SwapBackend(backend="rig")),
    ):
        with pytest.raises(LeaseRefused, match="nobody holds the lease"):
            bench.desk.submit(name, body, "k", "")
        with pytest.raises(LeaseRefused):
            bench.desk.submit(name, body, "k", "guessed")
    with pytest.raises(LeaseRefused):
        bench.desk.begin_jog(messages.BeginJog(), "k", "guessed")
    with pytest.raises(LeaseRefused):
        bench.desk.jog_at("k", messages.JogAt(velocity_m_per_s=0.1), "guessed")
    bench.loop.step()
    assert bench.status.state == "idle"


def test_moves_hold_and_are_refused_where_they_must(armed):
    assert armed.do("move", messages.Move(target_m=0.01)).stop == "FINISHED"
    assert armed.status.positions.end_position_m == pytest.approx(0.01, abs=1e-4)
    assert armed.do("jog", messages.JogBy(distance_m=-0.02)).stop == "FINISHED"
    assert armed.status.positions.end_position_m == pytest.approx(-0.01, abs=1e-4)
    with pytest.raises(Unfit, match=r"target_m is 50: the travel of single-axis is .* give a position within it"):
        armed.begin("move", messages.Move(target_m=50.0))
    with pytest.raises(Unfit, match="no micro"):
        armed.begin("identify", messages.Identify())
    with pytest.raises(RequestError, match="arm is not possible in state armed: possible are"):
        armed.begin("arm", messages.Arm())
    with pytest.raises(
        Unfit, match=r"distance_m is 0.27: from -0.01 m that leads to 0.26 m, the travel of single-axis"
    ):
        armed.begin("jog", messages.JogBy(distance_m=0.27))
    failed = armed.do("reread", messages.Home())
    assert failed.state == "failed"
    assert "without power only; the state is armed" in failed.error.message
    assert armed.status.state == "armed"


def test_whoever_hears_of_an_end_sees_the_state_that_it_left(armed, monkeypatch):
    seen = []

    def heard(order, change=Order._change, **changes):
        change(order, **changes)
        if order.over:
            seen.append((order.name, armed.status.state, armed.loop._state.value))

    monkeypatch.setattr(Order, "_change", heard)
    armed.do("move", messages.Move(target_m=0.004))
    armed.do("reread", messages.Home())
    armed.desk.ask_to_stop("enough")
    armed.until(lambda: armed.status.state == "idle")
    armed.do("arm", messages.Arm())
    armed.do("acknowledge", messages.Acknowledge(number=1))
    armed.inject(Fault("emergency", node_id=1, code=ENCODER_FAULT))
    armed.do("move", messages.Move(target_m=-0.004))
    left = [(name, "armed", "armed") for name in ("move", "reread", "arm", "acknowledge")]
    assert seen == [*left, ("move", "fault", "fault")]


def test_the_same_key_is_the_same_command(armed):
    body = messages.JogBy(distance_m=0.001)
    begun = armed.desk.submit("jog", body, "once", armed.token)
    assert armed.desk.submit("jog", body, "once", armed.token).key == begun.key
    with pytest.raises(Busy, match="jog is under way; wait for its end, or stop it"):
        armed.desk.submit("jog", body, "twice", armed.token)
    armed.until(lambda: armed.desk.command("once").state == "done")
    armed.loop.step()
    at_m = armed.status.positions.setpoint_position_m
    assert armed.desk.submit("jog", body, "once", armed.token).state == "done"
    for _ in range(5):
        armed.loop.step()
    assert armed.status.positions.setpoint_position_m == at_m
    with pytest.raises(Unfit, match="key 'once' was used for another jog"):
        armed.desk.submit("jog", messages.JogBy(distance_m=0.002), "once", armed.token)


def test_a_stop_ends_what_is_under_way_and_what_waits(armed):
    key = armed.begin("move", messages.Move(target_m=0.05))
    armed.desk.ask_to_stop("test")
    assert armed.desk.command(key).state == "failed"
    armed.loop.step()
    assert armed.status.state == "stopping" or not armed.desk.powered
    armed.loop.step()
    assert armed.status.state == "idle"
    assert armed.do("arm", messages.Arm()).stop == "FINISHED"
    key = armed.begin("move", messages.Move(target_m=0.05))
    before = armed.loop._progress

    def then_stop(what, share):
        if share > 0.3:
            armed.desk.ask_to_stop("in the middle")
        before(what, share)

    armed.loop._stage._progress = then_stop
    armed.until(lambda: armed.desk.command(key).state == "done")
    armed.loop._stage._progress = before
    assert armed.desk.command(key).stop == "OPERATOR"
    armed.loop.step()
    armed.loop.step()
    assert armed.status.state == "idle"
    assert 0.0 < abs(armed.status.positions.end_position_m) < 0.05


def test_a_lease_that_runs_out_stops_the_stage_and_is_a_fault(armed):
    armed.now_s += 31.0
    with pytest.raises(LeaseRefused, match="still coming to rest"):
        armed.take()
    armed.until(lambda: armed.status.state == "fault")
    fault = armed.status.fault
    assert (fault.kind, fault.state) == (Stop.LEASE.name, "armed")
    assert "the lease on motion ran out" in fault.what
    assert "ms ago" in fault.values
    assert fault.remedy
    armed.take()
    with pytest.raises(RequestError, match="not possible in state fault: look at the fault"):
        armed.begin("arm", messages.Arm())
    refused = armed.do("acknowledge", messages.Acknowledge(number=fault.number + 1))
    assert "is not the newest" in refused.error.message
    assert armed.do("acknowledge", messages.Acknowledge(number=fault.number)).state == "done"
    assert (armed.status.state, armed.status.fault) == ("idle", None)
    assert not armed.desk.powered
    assert armed.do("arm", messages.Arm()).stop == "FINISHED"


def test_an_order_whose_lease_ended_before_it_began_is_refused_and_changes_nothing(armed):
    key = armed.begin("move", messages.Move(target_m=0.1))
    held, armed.desk._lease = armed.desk._lease, None
    armed.loop.step()
    armed.desk._lease = held
    armed.loop.step()
    refused = armed.desk.command(key)
    assert (refused.state, refused.error.kind) == ("failed", "LeaseRefused")
    assert armed.do("jog", messages.JogBy(distance_m=0.001)).stop == "FINISHED"


def drive_state(bench):
    return cia402.state_of(int(bench.loop._stage.status()["macro_statusword"]))


def test_nobody_takes_the_lease_of_an_order_that_waits(bench):
    bench.take()
    key = bench.begin("home", messages.Home())
    bench.now_s += 100.0
    with pytest.raises(LeaseRefused, match="still coming to rest after the last lease"):
        bench.desk.take_lease(messages.TakeLease(holder="bert", duration_s=1.0))
    bench.loop.step()
    assert bench.desk.command(key).error.kind == "LeaseRefused"
    assert bench.desk.take_lease(messages.TakeLease(holder="bert", duration_s=1.0)).holder == "bert"
    bench.now_s += 100.0


@pytest.mark.parametrize(("name", "body"), [("arm", messages.Arm()), ("home", messages.Home())])
def test_a_stop_while_drives_are_read_gives_them_no_power(bench, monkeypatch, name, body):
    bench.until(lambda: bench.status.state == "idle")
    bench.take()
    if not bench.status.homed:
        assert bench.do("home", messages.Home()).stop == "FINISHED"
    stage, asked = bench.loop._stage, []
    request = stage._request
    monkeypatch.setattr(stage, "_demand_agreed", lambda: bench.desk.ask_to_stop("meanwhile"))
    monkeypatch.setattr(stage, "_request", lambda **fields: (asked.append(fields.get("mode")), request(**fields)))
    assert bench.do(name, body).stop == "OPERATOR"
    assert not {int(Mode.TRACK), int(Mode.HOME_DRIVE)} & set(asked)
    assert drive_state(bench) is cia402.State.SWITCH_ON_DISABLED
    bench.now_s += 100.0
    bench.until(lambda: bench.status.state == "idle")


def test_a_stop_takes_the_power_from_a_stage_with_a_fault_and_acknowledges_nothing(armed):
    armed.inject(Fault(kind="beam_loss", axis="macro", duration_s=0.2))
    armed.until(lambda: armed.status.state == "fault")
    armed.until(lambda: drive_state(armed) is cia402.State.QUICK_STOP_ACTIVE)
    number = armed.status.fault.number
    armed.desk.ask_to_stop("hands in the machine")
    armed.until(lambda: drive_state(armed) is cia402.State.SWITCH_ON_DISABLED)
    assert (armed.status.state, armed.status.fault.number) == ("fault", number)


ENCODER_FAULT = 0x7305


@pytest.mark.parametrize("after_s", [0.05, 0.25, 0.31, 0.33])
def test_a_drive_that_breaks_on_the_way_to_a_rest_that_was_asked_for_is_a_fault(armed, after_s):
    """The stage comes to rest within 0.3 s; who asked for it has to hear of the drive, and nobody else resets that."""
    backend = armed.loop._stage.backend
    backend.rig.inject(Fault("emergency", node_id=1, code=ENCODER_FAULT), backend.wire.t_ns + round(after_s * 1e9))
    armed.desk.ask_to_stop("by hand")
    armed.until(lambda: armed.status.state in ("fault", "idle"))
    if armed.status.state == "idle":  # it broke behind the look at the drives: the next arming says so
        assert armed.do("arm", messages.Arm()).stop == "EMERGENCY"
    assert armed.status.state == "fault"
    assert armed.status.fault.kind in ("EMERGENCY", "DRIVE_FAULT")
    assert "0x7305" in armed.status.fault.values or "fault as the stage came to rest" in armed.status.fault.values


def test_a_stage_that_stops_by_itself_is_shown_as_stopping_and_its_fault_says_where_from(armed):
    backend = armed.loop._stage.backend
    backend.rig.inject(Fault("emergency", node_id=1, code=ENCODER_FAULT), backend.wire.t_ns)
    armed.until(lambda: armed.status.fault is not None)
    states = [entry.fields["state"] for entry in armed.log.last(20) if entry.event == "state"]
    assert states[-2:] == ["stopping", "fault"]
    assert armed.status.fault.state == "armed"


def test_so_is_one_that_stops_in_a_motion_while_it_does(armed):
    """The frames of the macro's drive are lost: it is not seen to stand, and the fault is told seconds later."""
    backend = armed.loop._stage.backend
    silence = Fault("drop_frame", can_id=0x181, at_s=0.0, duration_s=1.0)
    backend.rig.inject(silence, backend.wire.t_ns + 300_000_000)
    assert armed.do("move", messages.Move(target_m=0.06)).stop == "LINK_SILENT"
    states = [entry.fields["state"] for entry in armed.log.last(40) if entry.event == "state"]
    assert states[-3:] == ["moving", "stopping", "fault"]
    assert armed.status.fault.state == "moving"


def test_what_is_said_to_a_jog_that_was_let_go_of_moves_nothing(armed):
    desk, token = armed.desk, armed.token
    velocity = messages.JogAt(velocity_m_per_s=0.05)
    first = desk.begin_jog(messages.BeginJog(), "first", token).key
    desk.jog_at(first, velocity, token)
    from_m, refused = float(armed.loop._stage.status()["setpoint_position_m"]), []
    before = armed.loop._stage._progress

    def late_requests(what, share):
        before(what, share)
        if refused or armed.loop._stage.status()["setpoint_position_m"] > from_m + 2e-3:
            armed.now_s += 0.0 if refused else 0.31  # the hold is over: it brakes
            with pytest.raises(JogOver, match="the jog first is over") as caught:
                desk.jog_at(first, velocity, token)
            refused.append(caught)

    armed.loop._stage._progress = late_requests
    armed.until(lambda: desk.command(first).state == "done")
    armed.loop._stage._progress = before
    assert len(refused) > 2
    armed.loop.step()
    at_m = armed.loop._stage.status()["setpoint_position_m"]
    with pytest.raises(JogOver):
        desk.jog_at(first, velocity, token)
    assert desk.begin_jog(messages.BeginJog(), "first", token).state == "done"  # said twice, carried out once
    second = desk.begin_jog(messages.BeginJog(), "second", token).key  # a late one: begins at rest, and nothing follows
    with pytest.raises(JogOver, match="the jog first is over"):
        desk.jog_at(first, velocity, token)
    armed.now_s += 0.31
    armed.until(lambda: desk.command(second).state == "done")
    assert armed.loop._stage.status()["setpoint_position_m"] == at_m


def test_a_stop_in_the_last_moment_of_a_jog_is_a_stop(armed):
    key = armed.desk.begin_jog(messages.BeginJog(), "last", armed.token).key
    armed.desk.jog_at(key, messages.JogAt(velocity_m_per_s=0.01), armed.token)
    order = armed.desk._current
    before = order.wanted_m_per_s

    def then_stop():
        wanted = before()
        if armed.now_s > 0.0 and wanted is None and armed.loop._stage.status()["segment_left_rows"] <= 0:
            armed.desk.ask_to_stop("in the last moment")
            armed.loop._progress("jogging", 0.0)
        return wanted

    order.wanted_m_per_s = then_stop
    progress = armed.loop._stage._progress

    def pass_time(what, share):
        armed.now_s += 0.02
        progress(what, share)

    armed.loop._stage._progress = pass_time
    armed.until(lambda: armed.desk.command(key).state == "done")
    armed.loop._stage._progress = progress
    armed.until(lambda: not armed.desk.powered and not armed.desk.stop_asked)
    armed.loop.step()
    assert (armed.status.state, armed.status.fault) == ("idle", None)


def test_a_client_that_vanishes_in_mid_motion_stops_it(armed):
    before = armed.loop._progress

    def then_vanish(what, share):
        if share > 0.3:
            armed.now_s += 31.0
        before(what, share)

    armed.loop._stage._progress = then_vanish
    key = armed.begin("move", messages.Move(target_m=0.1))
    armed.until(lambda: armed.desk.command(key).state == "done")
    armed.loop._stage._progress = before
    armed.loop.step()
    assert armed.desk.command(key).stop == Stop.LEASE.name
    assert (armed.status.fault.kind, armed.status.fault.state) == (Stop.LEASE.name, "moving")
    assert armed.status.positions.end_position_m < 0.09


def test_a_lost_beam_is_a_fault_and_voids_the_homing(armed):
    armed.inject(Fault("beam_loss", duration_s=0.3, axis="both"))
    armed.until(lambda: armed.status.state == "fault")
    fault = armed.status.fault
    assert fault.kind in (Stop.SENSOR_AGE.name, Stop.REFERENCE_LOST.name)
    number = fault.number
    assert armed.do("acknowledge", messages.Acknowledge(number=number)).state == "done"
    assert not armed.status.homed
    refused = armed.do("arm", messages.Arm())
    assert "not homed since it was connected; home it first" in refused.error.message
    assert armed.status.state == "idle"
    assert armed.do("home", messages.Home()).stop == "FINISHED"
    assert armed.status.homed
    assert recall(armed.settings.state_folder)[0].faults_count >= number


def test_a_link_that_is_gone_voids_the_homing_at_once(armed):
    """Its status said *homed* until the fault was acknowledged."""
    armed.inject(Fault("unplug", duration_s=0.3))
    armed.until(lambda: armed.status.state == "fault")
    armed.loop.step()
    armed.loop.show()
    assert armed.status.fault.kind == Stop.LINK_LOST.name
    assert not armed.status.homed
    assert armed.do("acknowledge", messages.Acknowledge(number=armed.status.fault.number)).state == "done"
    armed.until(lambda: armed.status.state == "idle")


def restarted(folder, remembered):
    """Return the bench of a service that begins with what the last one kept."""
    bench = Bench(folder, remembered=remembered)
    bench.loop.recall_fault()
    bench.loop.step()
    return bench


def test_a_service_that_ended_with_power_on_says_so_at_its_next_start(armed, tmp_path):
    kept, _ = recall(armed.settings.state_folder)
    bench = restarted(tmp_path, kept)
    fault = bench.status.fault
    assert (bench.status.state, fault.kind, fault.number) == ("fault", "SERVICE_LOST", kept.faults_count + 1)
    assert fault.values == f"in power since {kept.powered_since}, backend batch"
    again = restarted(tmp_path, recall(tmp_path / "state")[0])
    assert again.status.fault == fault
    again.take()
    assert again.do("acknowledge", messages.Acknowledge(number=fault.number)).state == "done"
    again.until(lambda: again.status.state == "idle")
    again.loop.leave()
    again.loop.run()
    ended, _ = recall(tmp_path / "state")
    assert (ended.fault, ended.powered_since) == (None, "")


def test_a_fault_is_there_until_it_is_acknowledged_whatever_restarts(armed, tmp_path):
    armed.inject(Fault("beam_loss", duration_s=0.3, axis="both"))
    armed.until(lambda: armed.status.state == "fault")
    bench = restarted(tmp_path, recall(armed.settings.state_folder)[0])
    assert (bench.status.state, bench.status.fault) == ("fault", armed.status.fault)


def test_what_clients_see_is_counted(armed):
    text = armed.figures.exposition(armed.status).decode()
    assert 'stagectl_state{state="armed"} 1.0' in text
    assert f"stagectl_cycles_total {float(armed.figures._cycles)}" in text
    assert f'stagectl_cycle_lateness_seconds_bucket{{le="+Inf"}} {float(armed.figures._cycles)}' in text
    assert 'stagectl_backend{backend="batch"} 1.0' in text
    samples = armed.desk.scope.after(0)
    assert len(samples.rows) > 10
    assert samples.rows[-1][1] == pytest.approx(armed.status.positions.end_position_m, abs=1e-3)
    assert armed.desk.scope.after(samples.last).rows == []


def test_hardware_that_is_not_there_is_waited_for(tmp_path):
    bench = Bench(tmp_path, backend="hardware")
    bench.loop.step()
    status = bench.status
    assert (status.state, status.backend) == ("off", "hardware")
    assert "not there; plug it in" in status.waiting_for
    assert status.banner.startswith("HARDWARE")
    bench.take()
    with pytest.raises(RequestError, match="not possible in state off"):
        bench.begin("home", messages.Home())
    key = bench.begin("backend", messages.SwapBackend(backend="rig"))
    bench.loop.step()
    assert bench.desk.command(key).text.startswith("SOFTWARE RIG")
    bench.loop._tick()
    assert bench.status.banner.startswith("SOFTWARE RIG")
    bench.desk.close()
    with pytest.raises(Ending):
        bench.begin("home", messages.Home())
    kept, _ = recall(bench.settings.state_folder)
    assert (kept.backend, kept.swapped_from) == ("rig", "hardware")


@pytest.mark.parametrize(
    ("asked", "swapped_from", "profile", "begun"),
    [
        ("hardware", "hardware", "single-axis", "batch"),
        ("hardware", "rig", "single-axis", "hardware"),  # started in another way since
        ("hardware", "hardware", "oled-printer", "hardware"),
        ("hardware", "", "single-axis", "hardware"),
    ],
)
def test_the_world_that_a_client_swapped_to_is_there_after_a_restart(tmp_path, asked, swapped_from, profile, begun):
    path = str(PROFILES_FOLDER / f"{profile}.toml")
    kept = Remembered(profile=path, backend="batch", swapped_from=swapped_from)
    bench = Bench(tmp_path, backend=asked, remembered=kept)
    bench.loop.step()
    assert bench.status.backend == begun
    assert bench.status.banner.startswith("SOFTWARE" if begun == "batch" else "HARDWARE")
    bench.loop.leave()
    bench.loop.run()


@pytest.mark.parametrize("kind", ["sensor_silence", "beam_loss"])
def test_a_position_that_is_old_is_not_known(bench, kind):
    bench.until(lambda: bench.status.positions.end_position_m is not None)
    assert bench.status.positions.sample_age_s < 0.01
    where = {"axis": "both"} if kind == "beam_loss" else {}
    bench.inject(Fault(kind, duration_s=0.5, **where))
    bench.until(lambda: bench.status.positions.end_position_m is None)
    at = bench.status.positions
    assert (at.macro_position_m, at.relative_position_m, at.error_m) == (None, None, None)
    assert at.sample_age_s > 0.1
    assert at.macro_encoder_m is not None
    bench.until(lambda: bench.status.positions.end_position_m is not None)


def test_the_joint_of_one_world_is_not_shown_in_another_and_keeps_the_date_it_was_seen_at(tmp_path):
    rigs = joint("rig")
    bench = Bench(tmp_path, profile="oled-printer", remembered=Remembered(joints={"rig oled-printer": rigs}))
    bench.loop.step()
    bench.until(lambda: bench.status.state == "idle")
    assert (bench.status.backlash, bench.status.wear) == (None, None)
    bench.take()
    assert bench.do("home", messages.Home()).stop == "FINISHED"
    seen = set()
    for value_m in (1e-4, None):
        if bench.status.state == "idle":  # homing leaves it armed
            assert bench.do("arm", messages.Arm()).stop == "FINISHED"
        if value_m is not None:
            sides = {f"{side}_{what}": 1e-7 for side in ("left", "right") for what in ("sd_m", "stiffness_sd_n_per_m")}
            values = {"left_m": value_m, "right_m": value_m} | sides
            stiff = {"left_stiffness_n_per_m": 1e4, "right_stiffness_n_per_m": 1e4}
            rows = new_rows(2)
            rows["run_phase"], rows["contact_force_estimate_n"] = int(Phase.TRACKING), (3.0, -3.0)
            wear = bench.loop._wear
            later_s = wear._now_s() + 60.0
            wear._now_s = lambda later_s=later_s: later_s  # after the homing's touches
            wear.observe(rows)
            wear.look(BacklashEstimate(**values, **stiff))
            seen_at = wear.seen_at
        time.sleep(0.002)  # dates are in milliseconds
        bench.desk.ask_to_stop("enough")
        bench.until(lambda: bench.status.state == "idle")
        seen.add((bench.status.backlash.at, bench.status.backlash.backend))
    assert seen == {(seen_at, "batch")}
    kept, _ = recall(bench.settings.state_folder)
    assert kept.joints["rig oled-printer"] == rigs
    bench.loop.leave()
    bench.loop.run()
    bench.loop.show()
    assert bench.status.wear is None


def test_where_auto_once_found_hardware_late_hardware_is_waited_for(tmp_path):
    path = str(PROFILES_FOLDER / "single-axis.toml")
    bench = Bench(tmp_path, backend="auto", remembered=Remembered(profile=path, backend="hardware"))
    bench.loop.step()
    assert (bench.status.state, bench.status.backend) == ("off", "hardware")


def test_auto_that_saw_half_of_the_hardware_takes_no_rig_when_that_is_gone_for_a_moment(tmp_path):
    """A USB adapter is counted anew while somebody plugs the other one in."""
    path, can, port = tmp_path / "mine.toml", tmp_path / "can", tmp_path / "port"
    there = {"can.interface": "hub", "can.channel": str(can), "interferometer.port": str(port)}
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", there))
    port.touch()
    bench = Bench(tmp_path, profile=str(path), backend="auto")
    bench.loop.step()
    assert (bench.status.state, bench.status.backend) == ("off", "")
    port.unlink()
    bench.loop._retry_at_s = 0.0
    bench.loop.step()
    assert (bench.status.state, bench.status.backend) == ("off", "")
    assert "a part of the hardware was there and is gone; plug all of it in" in bench.status.waiting_for


def test_what_a_request_can_not_have_costs_no_world(tmp_path):
    """A swap to `auto` with half of the hardware, and a profile with a slip, are refused: no fault, still homed."""
    path, port = tmp_path / "mine.toml", tmp_path / "port"
    there = {"can.interface": "hub", "can.channel": str(tmp_path / "can"), "interferometer.port": str(port)}
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", there))
    port.touch()
    bench = Bench(tmp_path, profile=str(path))
    bench.loop.show()
    bench.until(lambda: bench.status.state == "idle")
    bench.take()
    stage, bench.loop._homed = bench.loop._stage, True
    swapped = bench.do("backend", messages.SwapBackend(backend="auto"))
    path.write_text("name = 3\n")
    reread = bench.do("reread", messages.Home())
    assert "plug it in" in swapped.error.message
    assert "kept as it was" in reread.error.message
    assert {swapped.error.kind, reread.error.kind} == {"RequestError"}
    assert (bench.status.state, bench.status.fault, bench.status.homed) == ("idle", None, True)
    assert bench.loop._stage is stage
    bench.loop.leave()
    bench.loop.run()


def test_what_the_joint_is_found_to_be_waits_for_no_disk(tmp_path, monkeypatch):
    """An identification ends with power on: half a second without a word of the supervisor stops the stage."""
    goes_on, said = threading.Event(), []
    fsync = os.fsync

    def slowly(descriptor):
        assert goes_on.wait(20.0), "the stage's thread waits for the disk"
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", slowly)
    memory = Memory(tmp_path, Remembered(), said.append)
    found = joint("batch")
    memory.keep_joint(found)
    assert memory.joint("batch", "oled-printer") == found
    assert recall(tmp_path)[0].joints == {}
    goes_on.set()
    memory.keep(powered_since="")
    assert recall(tmp_path)[0].joints == {"batch oled-printer": found}
    assert said == []


def test_a_profile_edited_to_nonsense_changes_nothing(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {}))
    bench = Bench(tmp_path, profile=str(path))
    bench.until(lambda: bench.loop._state == "idle")
    stage = bench.loop._stage
    path.write_text("name = 3\n")
    bench.loop.reread()
    bench.loop.step()
    bench.loop.step()
    assert bench.loop._stage is stage
    assert "kept as it was" in bench.log.last(1)[0].text
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"macro.velocity_limit_m_per_s": 0.05}))
    bench.loop.reread()
    bench.until(lambda: bench.loop._state == "idle" and bench.loop._stage is not stage)
    assert bench.desk.profile.macro.velocity_limit_m_per_s == 0.05
    bench.loop.leave()
    bench.loop.run()


class Manager:
    """systemd's end of a bench whose watchdog may be fed at each step."""

    def __init__(self, bench, folder, monkeypatch):
        self._bench, self._now_s = bench, 0.0
        self._heard = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._heard.bind(str(folder / "notify"))
        environment = {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "1000000"}
        monkeypatch.setattr(bench.loop, "_notifier", Notifier(environment, lambda: self._now_s))

    def fed_count(self, steps_count):
        """Have the loop go on, a second a step, and return how often it fed the watchdog."""
        for _ in range(steps_count):
            self._now_s += 1.0
            self._bench.loop.step()
        said = []
        while True:
            try:
                said.append(self._heard.recv(4096).decode())
            except BlockingIOError:
                return said.count("WATCHDOG=1")

    def close(self):
        self._heard.close()


def test_the_watchdog_is_fed_while_the_servo_of_an_open_stage_does_cycles_and_only_then(bench, tmp_path, monkeypatch):
    """A service whose own loop goes on beside a servo that hangs is to be started again."""
    manager = Manager(bench, tmp_path, monkeypatch)
    assert manager.fed_count(5) == 5
    with monkeypatch.context() as frozen:
        frozen.setattr(bench.loop._stage.link, "pass_time", lambda duration_s: None)
        bench.loop.step()
        cycles_count = bench.status.health.cycles_count
        manager.fed_count(1)  # of the last cycles
        assert manager.fed_count(20) == 0
        assert (bench.status.state, bench.status.health.cycles_count) == ("idle", cycles_count)
    manager.fed_count(1)
    assert manager.fed_count(5) == 5
    manager.close()


def test_the_watchdog_is_fed_by_the_loop_itself_while_it_waits_for_hardware(tmp_path, monkeypatch):
    waiting = Bench(tmp_path, backend="hardware")
    manager = Manager(waiting, tmp_path, monkeypatch)
    assert manager.fed_count(3) >= 3
    assert (waiting.status.state, waiting.status.health.cycles_count) == ("off", 0)
    manager.close()
