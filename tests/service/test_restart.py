"""What survives a restart of the service, what never does, and what it does at its beginning and at its end."""

import json
import os
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from sim_backend.faults import Fault
from sim_backend.machine import load_machine
from stagectl import cli
from stagectl import stage as stages
from stagectl.backend import RIG_VENDOR_ID, BatchBackend
from stagectl.client import Client
from stagectl.profile import PROFILES_FOLDER, Wear
from stagectl.record import read_manifest, read_run
from stagectl.service import messages
from stagectl.service.daemon import hear_signals
from stagectl.service.remembered import FILE, recall
from stagectl.service.stage_world import ENDING
from stagectl.service.wear_watch import WearWatch
from stagectl.signals import Stop
from stagectl.wear import IDENTIFIED
from tests.service.test_stage_loop import Bench
from tests.toml_text import changed

SINGLE = PROFILES_FOLDER / "single-axis.toml"
LIMIT_M_PER_S = 0.5  # of the shipped profile
EDITED_M_PER_S = 0.05
REST_M_PER_S = 1e-3
HARDEST_M_PER_S2 = 5.0  # `macro.stop_deceleration_m_per_s2`: what the drive itself would do
PATIENCE_S = 60.0


def begun(folder, profile=SINGLE, backend="batch"):
    """A service that begins with what the last one in this folder kept, as `serve` does."""
    remembered, remark = recall(folder / "state")
    assert remark == ""
    bench = Bench(folder, str(profile), backend, remembered)
    bench.loop.recall_fault()
    bench.loop.show()
    return bench


def connected(folder, profile=SINGLE, backend="batch"):
    """A service that has opened its stage, and an operator."""
    bench = begun(folder, profile, backend)
    bench.until(lambda: bench.status.state == "idle")
    bench.loop.step()
    bench.take()
    return bench


def end(bench):
    """End a service as SIGTERM does."""
    bench.loop.leave()
    bench.loop.run()


def homes(bench):
    """Home it; returns the manifest of that run."""
    homed = bench.do("home", messages.Home())
    assert homed.stop == "FINISHED"
    return read_manifest(Path(homed.run))


@pytest.fixture
def mine(tmp_path):
    """A profile that a user may edit."""
    path = tmp_path / "mine.toml"
    path.write_text(SINGLE.read_text())
    return path


@pytest.fixture
def own_signals():
    """Give this process its own signals back afterwards."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


# ---- SIGHUP ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("goes_by", ["a stop", "a fault"])
def test_an_edited_profile_waits_until_the_stage_has_no_power(tmp_path, mine, own_signals, goes_by):
    bench = connected(tmp_path, mine)
    hear_signals(bench.loop)
    assert bench.do("home", messages.Home()).stop == "FINISHED"
    assert bench.do("arm", messages.Arm()).stop == "FINISHED"
    stage = bench.loop._stage
    mine.write_text(changed(mine, {"macro.velocity_limit_m_per_s": EDITED_M_PER_S}))
    os.kill(os.getpid(), signal.SIGHUP)
    for _ in range(3):
        bench.loop.step()
    moved = bench.do("move", messages.Move(target_m=0.004))
    assert moved.stop == "FINISHED"
    assert (bench.status.state, bench.status.homed) == ("armed", True)
    assert bench.status.limits.velocity_m_per_s == LIMIT_M_PER_S
    if goes_by == "a stop":
        bench.desk.ask_to_stop("for the new profile")
    else:
        bench.now_s += 100.0  # the lease runs out
        bench.until(lambda: bench.status.state == "fault")
        bench.loop.step()
        assert bench.loop._stage is stage
        bench.take()
        assert bench.do("acknowledge", messages.Acknowledge(number=bench.status.fault.number)).state == "done"
    bench.until(lambda: bench.loop._stage is not stage and bench.status.state == "idle")
    bench.loop.step()
    assert bench.status.limits.velocity_m_per_s == EDITED_M_PER_S
    assert bench.desk.profile.macro.velocity_limit_m_per_s == EDITED_M_PER_S
    assert not bench.status.homed
    assert read_manifest(Path(moved.run))["profile"]["macro"]["velocity_limit_m_per_s"] == LIMIT_M_PER_S
    assert homes(bench)["profile"]["macro"]["velocity_limit_m_per_s"] == EDITED_M_PER_S
    again = [entry for entry in bench.log.last(200) if entry.event == "profile"]
    assert [(entry.text, entry.fields["profile"]) for entry in again] == [("read again", str(mine))]
    end(bench)


def test_a_command_that_comes_before_the_profile_is_read_again_hears_what_it_waits_for(tmp_path, mine):
    bench = connected(tmp_path, mine)
    bench.loop.reread()
    key = bench.begin("home", messages.Home())
    bench.loop.step()
    assert (bench.status.state, bench.status.waiting_for) == ("off", "opening the stage")
    bench.until(lambda: bench.desk.command(key).state == "failed")
    assert "the stage is not connected; waiting for: opening the stage" in bench.desk.command(key).text
    bench.until(lambda: bench.status.state == "idle")
    end(bench)


def said_of_profile(bench):
    """What the log has of reading the profile again."""
    return [entry.text for entry in bench.log.last(200) if entry.event == "profile"]


def is_opened_as_edited(bench):
    """Wait for the stage, which must have the limit that was written into its profile."""
    bench.until(lambda: bench.status.state == "idle")
    bench.loop.step()
    assert bench.status.limits.velocity_m_per_s == EDITED_M_PER_S


def loses_its_port(bench):
    """Have the interferometer unplugged for a moment; the stage that it is opened anew from is returned."""
    stage = bench.loop._stage
    bench.inject(Fault("unplug", duration_s=0.2))
    bench.until(lambda: bench.status.state == "fault")
    assert bench.status.fault.kind == "LINK_LOST"
    return stage


def acknowledges(bench):
    """Acknowledge the newest fault."""
    if bench.desk.lease_left_s() == 0.0:
        bench.take()
    done = bench.do("acknowledge", messages.Acknowledge(number=bench.status.fault.number))
    assert done.state == "done", done.text


@pytest.mark.parametrize("left", ["half edited", "nonsense"])
def test_a_file_that_nobody_said_to_read_again_is_not_read_after_a_fault(tmp_path, mine, left):
    bench = connected(tmp_path, mine)
    sound = mine.read_text()
    mine.write_text(
        changed(mine, {"macro.velocity_limit_m_per_s": EDITED_M_PER_S}) if left != "nonsense" else "name = 3"
    )
    stage = loses_its_port(bench)
    acknowledges(bench)
    bench.until(lambda: bench.loop._stage not in (stage, None) and bench.status.state == "idle")
    bench.loop.step()
    assert bench.status.limits.velocity_m_per_s == LIMIT_M_PER_S
    assert said_of_profile(bench) == []

    mine.write_text(sound)
    mine.write_text(changed(mine, {"macro.velocity_limit_m_per_s": EDITED_M_PER_S}))
    again = bench.do("reread", messages.Home())
    assert again.text == "the profile was read again"
    is_opened_as_edited(bench)
    loses_its_port(bench)
    acknowledges(bench)
    is_opened_as_edited(bench)
    assert said_of_profile(bench) == ["read again"]
    end(bench)


def test_a_profile_read_again_while_a_fault_stands_is_the_one_that_is_opened(tmp_path, mine):
    bench = connected(tmp_path, mine)
    loses_its_port(bench)
    mine.write_text(changed(mine, {"macro.velocity_limit_m_per_s": EDITED_M_PER_S}))
    bench.loop.reread()
    acknowledges(bench)
    is_opened_as_edited(bench)
    assert said_of_profile(bench) == ["read again"]
    end(bench)


def test_a_profile_that_is_wrong_at_the_start_is_waited_for(tmp_path, mine):
    sound = mine.read_text()
    mine.write_text("name = 3\n")
    bench = begun(tmp_path, mine)
    bench.loop.step()
    assert (bench.status.state, bench.status.fault) == ("off", None)
    assert f"{mine}" in bench.status.waiting_for
    assert "name" in bench.status.waiting_for
    mine.write_text(sound)
    bench.loop._retry_at_s = 0.0
    bench.until(lambda: bench.status.state == "idle")
    end(bench)


def test_a_profile_that_opens_no_stage_is_corrected_and_then_acknowledged(tmp_path, mine):
    sound = mine.read_text()
    mine.write_text(changed(mine, {"name": "nobody-knows"}))  # the rig has no machine of that name
    bench = begun(tmp_path, mine)
    bench.until(lambda: bench.status.state == "fault")
    assert (bench.status.fault.kind, bench.status.profile) == ("ProfileError", "nobody-knows")
    assert bench.status.fault.remedy == "correct the profile, then acknowledge"
    mine.write_text(sound)
    acknowledges(bench)
    bench.until(lambda: bench.status.state == "idle")
    bench.loop.step()
    assert bench.status.profile == "single-axis"
    mine.write_text("name = 3\n")  # read once it was wrong, and not for ever after
    loses_its_port(bench)
    acknowledges(bench)
    bench.until(lambda: bench.status.state == "idle")
    end(bench)


# ---- what is served --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("left", [None, "{"], ids=["nothing", "a damaged file"])
def test_serve_without_a_profile_refuses_where_none_is_remembered(tmp_path, capsys, left):
    state, socket = tmp_path / "state", tmp_path / "stage.socket"
    if left is not None:
        state.mkdir()
        (state / FILE).write_text(left)
    places = ["--state", str(state), "--socket", str(socket), "--runs", str(tmp_path / "runs")]
    code = cli.main(["serve", "--backend", "batch", *places])
    said = capsys.readouterr().err
    assert code == 2  # which systemd does not try again
    assert "which profile? none was served before; give one: stagectl serve PROFILE" in said
    assert not socket.exists()


def test_serve_without_a_profile_takes_the_last_one_and_says_what_it_waits_for(tmp_path, mine):
    mine.write_text(changed(mine, {"interferometer.port": str(tmp_path / "unplugged")}))
    end(connected(tmp_path, mine))
    socket = tmp_path / "stage.socket"
    places = ["--state", str(tmp_path / "state"), "--socket", str(socket), "--runs", str(tmp_path / "runs")]
    with open(tmp_path / "err", "w+") as err:
        service = subprocess.Popen([sys.executable, "-m", "stagectl.cli", "serve", *places], stderr=err, cwd=tmp_path)
        try:
            give_up_s = time.monotonic() + PATIENCE_S
            while not (tmp_path / "err").read_text().count('"waiting"'):
                assert time.monotonic() < give_up_s
                assert service.poll() is None, (tmp_path / "err").read_text()
                time.sleep(0.05)
            with Client(socket) as client:
                status = client.status()
            service.terminate()
            assert service.wait(PATIENCE_S) == 0
        finally:
            service.kill()
            service.wait()
    assert (status.profile_path, status.profile, status.state) == (str(mine), "single-axis", "off")
    assert (status.backend, status.banner) == ("hardware", "HARDWARE: what moves here is real")
    assert f"interferometer {tmp_path / 'unplugged'}: not there; plug it in" in status.waiting_for
    events = [json.loads(line)["event"] for line in (tmp_path / "err").read_text().splitlines()]
    assert events[-1] == "ended"
    assert not socket.exists()


# ---- what survives ---------------------------------------------------------------------------------------------------


def test_the_joint_survives_with_its_date_and_run_and_homing_does_not(tmp_path):
    before_at = datetime.now(UTC)
    bench = connected(tmp_path, "oled-printer")
    assert (bench.status.homed, bench.status.backlash) == (False, None)
    permitting = bench.loop._stage.profile.model_copy(update={"wear": Wear(compensate=True)})
    bench.loop._wear = WearWatch(permitting, bench.log, time.monotonic)
    homed = bench.do("home", messages.Home())
    assert homed.stop == "FINISHED"
    believed = bench.loop._stage.believed_backlash()
    # Believing it moved the end's zero: what is published of it has edges and middle in the zeros that hold since. This
    # asserted the opposite, as long as edges were published that lay nowhere any more.
    assert {name: getattr(homed.backlash, name) for name in believed} == believed
    plant, seen = bench.loop._stage.backend.rig.plant_state(), bench.loop._stage.status()
    measured_m = float(seen["macro_position_m"]) - float(seen["end_position_m"])
    off_m = measured_m - (plant["macro_position_m"] - plant["end_position_m"])
    true = load_machine("oled-printer").backlash
    assert homed.backlash.left_m == pytest.approx(true.left_m - off_m, abs=0.5e-6)
    assert homed.backlash.right_m == pytest.approx(true.right_m + off_m, abs=0.5e-6)
    for _ in range(5):
        bench.loop.step()
    assert bench.loop._stage.believed_backlash() == believed
    (run,) = bench.settings.runs_root.glob("*-service-home")
    bench.loop.step()
    assert (bench.status.homed, bench.status.backlash) == (True, homed.backlash)
    assert {name: getattr(bench.status.wear, name) for name in believed} == believed
    bench.now_s += 100.0
    bench.until(lambda: bench.status.state == "fault")
    bench.take()
    assert bench.do("acknowledge", messages.Acknowledge(number=bench.status.fault.number)).state == "done"
    assert bench.status.homed  # power came and went: it was watched all the time
    end(bench)

    bench = connected(tmp_path, "oled-printer")
    status = bench.status
    assert not status.homed
    refused = bench.do("arm", messages.Arm())
    assert "not homed since it was connected; home it first" in refused.error.message
    found = status.backlash
    assert found == homed.backlash
    assert (found.run, found.profile_name, found.backend) == (run.name, "oled-printer", "batch")
    assert before_at <= datetime.fromisoformat(found.at) <= datetime.now(UTC)
    wear = status.wear
    assert (wear.width_m, wear.at, wear.source, wear.observable) == (found.width_m, found.at, IDENTIFIED, False)
    assert wear.text.startswith("not observable: both edges were not touched lately")
    end(bench)


class RigInVirtualTime(BatchBackend):
    """The rig in this process, where `auto` would begin one of its own."""

    name = "rig"


@pytest.fixture
def rig_here(monkeypatch):
    """Have the rig in virtual time where the rig is asked for."""

    def rig(profile, machine_path, *, seed, plays):
        assert plays == "rig"
        return RigInVirtualTime(load_machine(machine_path), seed=seed)

    monkeypatch.setattr(stages, "RigBackend", rig)


def asked_and_chosen(bench):
    """What the status and the manifests of a motion say of the world: asked for, chosen, banner."""
    found = homes(bench)
    session = read_manifest(bench.settings.runs_root / found["session"])
    facts = [(one["backend_asked"], one["backend"], one["banner"]) for one in (found, session)]
    assert facts[0] == facts[1]
    assert (bench.status.backend, bench.status.banner) == facts[0][1:]
    bench.desk.ask_to_stop("enough")
    bench.until(lambda: bench.status.state == "idle" and not bench.desk.stop_asked)
    return facts[0]


RIG = "SOFTWARE RIG: nothing real moves"
BATCH = "SOFTWARE RIG in virtual time: nothing real moves"


def swap(bench, backend):
    """Have a client change the world."""
    assert bench.do("backend", messages.SwapBackend(backend=backend)).state == "done"
    assert (bench.status.state, bench.status.homed) == ("off", False)


def test_manifests_say_which_world_was_asked_for_and_which_was_chosen(tmp_path, rig_here):
    for _ in range(2):  # a restart chooses anew
        bench = connected(tmp_path, backend="auto")
        assert asked_and_chosen(bench) == ("auto", "rig", RIG)
        end(bench)


@pytest.mark.parametrize("asked", ["rig", "auto"])
def test_manifests_say_what_a_client_asked_for_after_a_restart_too(tmp_path, rig_here, asked):
    bench = connected(tmp_path, backend="batch")
    assert asked_and_chosen(bench) == ("batch", "batch", BATCH)
    swap(bench, asked)
    bench.until(lambda: bench.status.state == "idle")
    assert asked_and_chosen(bench) == (asked, "rig", RIG)
    end(bench)

    bench = connected(tmp_path, backend="batch")
    assert asked_and_chosen(bench) == (asked, "rig", RIG)
    (said,) = [entry for entry in bench.log.last(200) if entry.event == "backend"]
    assert said.text == RIG
    assert said.fields == {"backend": "rig", "asked": asked, "because": "a client before the restart"}
    end(bench)


@pytest.fixture
def plugs(tmp_path, mine):
    """Files that stand for the bus and the serial port of a profile: there once they are touched."""
    can, port = tmp_path / "can", tmp_path / "port"
    hardware = {"can.interface": "hub", "can.channel": str(can), "interferometer.port": str(port)}
    mine.write_text(changed(mine, hardware))
    return can, port


def test_a_service_that_was_swapped_back_chooses_at_its_next_start_as_if_it_never_had_been(
    tmp_path, rig_here, mine, plugs
):
    bench = connected(tmp_path, mine, "auto")
    swap(bench, "hardware")
    bench.until(lambda: "not there; plug it in" in bench.status.waiting_for)
    assert bench.status.banner == "HARDWARE: what moves here is real"
    swap(bench, "auto")
    bench.until(lambda: bench.status.state == "idle")
    assert bench.status.banner == RIG
    end(bench)
    for plug in plugs:
        plug.touch()
    bench = begun(tmp_path, mine, "auto")
    bench.loop.step()
    assert bench.status.banner == "HARDWARE: what moves here is real"
    end(bench)


def test_a_swap_opens_the_profile_that_it_was_chosen_with(tmp_path, rig_here, mine):
    bench = connected(tmp_path, mine)
    mine.write_text("name = 3\n")
    swap(bench, "rig")
    bench.until(lambda: bench.status.state == "idle")
    bench.loop.step()
    assert bench.status.banner == RIG
    end(bench)


class OtherMachine(BatchBackend):
    """Drives in virtual time that are not those of the profile: 0x1018 says so, as of a machine's own."""

    name = "hardware"
    vendor_id = None


def refused_by_its_drives(folder, profile, monkeypatch, plugs):
    """A service that was started with the rig and swapped to hardware, whose drives are others: not opened."""
    monkeypatch.setattr(stages, "HardwareBackend", lambda profile: OtherMachine(load_machine("single-axis")))
    for plug in plugs:
        plug.touch()
    bench = connected(folder, profile, "rig")
    swap(bench, "hardware")
    bench.until(lambda: bench.status.state == "fault")
    assert (bench.status.fault.kind, bench.loop._stage) == ("DriveError", None)
    assert "vendor id" in bench.status.fault.values
    return bench


@pytest.mark.parametrize("restarted", ["never", "before the swap", "behind the swap"])
def test_a_world_that_can_not_be_opened_can_be_left(tmp_path, rig_here, mine, plugs, monkeypatch, restarted):
    bench = refused_by_its_drives(tmp_path, mine, monkeypatch, plugs)
    fault = bench.status.fault
    if restarted == "before the swap":
        end(bench)
        bench = begun(tmp_path, mine, "rig")
        bench.take()
    swapped = bench.do("backend", messages.SwapBackend(backend="rig"))
    assert (swapped.state, swapped.text) == ("done", RIG)
    for _ in range(3):
        bench.loop.step()
    assert (bench.status.state, bench.status.fault, bench.loop._stage) == ("fault", fault, None)
    assert (bench.status.banner, bench.status.waiting_for) == (RIG, "an acknowledgement of the fault")
    kept = recall(tmp_path / "state")[0]
    assert (kept.backend, kept.swapped_from, kept.fault) == ("rig", "", fault)
    if restarted == "behind the swap":
        end(bench)
        bench = begun(tmp_path, mine, "rig")
        assert bench.status.fault == fault
    acknowledges(bench)
    assert (bench.status.state, bench.status.waiting_for) == ("off", "opening the stage")
    bench.until(lambda: bench.status.state in ("idle", "fault"))
    bench.loop.step()
    assert (bench.status.state, bench.status.fault, bench.status.banner) == ("idle", None, RIG)
    end(bench)


def test_a_profile_that_names_other_drives_is_corrected_and_read_again_before_it_is_acknowledged(
    tmp_path, rig_here, mine, plugs, monkeypatch
):
    bench = refused_by_its_drives(tmp_path, mine, monkeypatch, plugs)
    fault = bench.status.fault
    mine.write_text(changed(mine, {"macro.identity.vendor_id": RIG_VENDOR_ID}))
    assert bench.do("reread", messages.Home()).state == "done"
    assert (bench.status.state, bench.status.fault) == ("fault", fault)
    acknowledges(bench)
    bench.until(lambda: bench.status.state in ("idle", "fault"))
    bench.loop.step()
    assert (bench.status.state, bench.status.banner) == ("idle", "HARDWARE: what moves here is real")
    end(bench)


def test_the_world_of_a_stage_that_stopped_is_not_changed_before_its_fault_is_acknowledged(tmp_path, rig_here):
    bench = connected(tmp_path)
    stage = loses_its_port(bench)
    for name, body in (("backend", messages.SwapBackend(backend="rig")), ("reread", messages.Home())):
        refused = bench.do(name, body)
        assert refused.error.kind == "RequestError"
        assert "the state is fault: acknowledge that first" in refused.text
    assert (bench.status.state, bench.status.backend) == ("fault", "batch")
    assert bench.loop._stage is stage
    end(bench)


def test_a_world_that_the_rig_has_no_machine_for_is_refused_and_the_stage_waits_as_before(tmp_path):
    profile = tmp_path / "of-our-own.toml"
    profile.write_text(changed(SINGLE, {"name": "of-our-own"}))
    bench = begun(tmp_path, profile, "hardware")
    bench.take()
    bench.loop.step()
    before = bench.status
    refused = bench.do("backend", messages.SwapBackend(backend="rig"))
    assert (refused.state, refused.error.kind) == ("failed", "RequestError")
    assert "profile of-our-own: the rig has no machine of that name to play it" in refused.text
    bench.loop.step()
    assert bench.status.waiting_for.endswith("ask for another backend")
    assert (bench.status.state, bench.status.backend, bench.status.fault) == ("off", "hardware", None)
    assert bench.status.waiting_for == before.waiting_for
    end(bench)


def test_a_world_that_auto_chose_and_a_client_asked_for_stays_after_a_restart(tmp_path, rig_here, mine, plugs):
    bench = connected(tmp_path, mine, "auto")
    assert bench.status.banner == RIG
    stage, bench.loop._homed = bench.loop._stage, True
    assert bench.do("backend", messages.SwapBackend(backend="rig")).text == RIG
    bench.loop.step()
    assert (bench.status.state, bench.status.homed) == ("idle", True)
    assert bench.loop._stage is stage  # there was nothing to open anew
    end(bench)
    for plug in plugs:
        plug.touch()
    bench = connected(tmp_path, mine, "auto")
    assert bench.status.banner == RIG
    (said,) = [entry for entry in bench.log.last(200) if entry.event == "backend"]
    assert said.fields == {"backend": "rig", "asked": "rig", "because": "a client before the restart"}

    for plug in plugs:
        plug.unlink()
    stage = bench.loop._stage
    assert bench.do("backend", messages.SwapBackend(backend="auto")).text == RIG
    assert bench.loop._stage is stage
    end(bench)
    for plug in plugs:
        plug.touch()
    bench = begun(tmp_path, mine, "auto")
    bench.loop.step()
    assert bench.status.banner == "HARDWARE: what moves here is real"  # asked for no longer
    end(bench)


def test_auto_chooses_once_and_never_half_of_the_hardware(tmp_path, rig_here, mine, plugs):
    can, port = plugs
    bench = connected(tmp_path, mine, "auto")
    assert bench.status.banner == RIG
    can.touch()
    port.touch()
    stage = bench.loop._stage
    bench.loop.reread()
    bench.until(lambda: bench.loop._stage is not stage and bench.status.state == "idle")
    assert bench.status.banner == RIG  # as at its start, though hardware is there now
    end(bench)

    can.unlink()
    bench = begun(tmp_path, mine, "auto")
    bench.loop.step()
    status = bench.status
    assert (status.state, status.backend, status.banner) == ("off", "", "NO WORLD is open")
    assert f"interferometer {port} is there, CAN hub {can} is not; plug it in, or ask for" in status.waiting_for
    port.unlink()
    can.touch()
    bench.loop._retry_at_s = 0.0
    bench.loop.step()
    assert f"CAN hub {can} is there, interferometer {port} is not" in bench.status.waiting_for
    end(bench)
    assert recall(tmp_path / "state")[0].backend == "rig"


# ---- SIGTERM ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["holds", "moves"])
def test_sigterm_brings_the_stage_to_rest_takes_the_power_and_closes_the_run(tmp_path, own_signals, what):
    bench = connected(tmp_path)
    assert bench.do("home", messages.Home()).stop == "FINISHED"
    assert bench.do("arm", messages.Arm()).stop == "FINISHED"
    hear_signals(bench.loop)
    backend, before = bench.loop._stage.backend, bench.loop._progress
    struck = []

    def then_terminate(text, share):
        if share > 0.5 and not struck:
            struck.append(backend.rig.plant_state()["macro_velocity_m_per_s"])
            os.kill(os.getpid(), signal.SIGTERM)
        before(text, share)

    if what == "moves":
        key = bench.begin("move", messages.Move(target_m=0.1))
        bench.loop._stage._progress = then_terminate
    else:
        key = ""
        os.kill(os.getpid(), signal.SIGTERM)
    bench.loop.run()

    truth = backend.truth()
    velocity_m_per_s = np.diff(truth["macro_position_m"]) / (np.diff(truth["t_ns"]) * 1e-9)
    assert abs(backend.rig.plant_state()["macro_velocity_m_per_s"]) < REST_M_PER_S
    if what == "moves":
        assert abs(struck[0]) > 0.1
        assert truth["macro_position_m"][-1] - truth["macro_position_m"][0] < 0.099
        deceleration = np.diff(velocity_m_per_s[::10]) / (np.diff(truth["t_ns"][:-1:10]) * 1e-9)
        assert np.max(np.abs(deceleration)) < HARDEST_M_PER_S2
        command = bench.desk.command(key)
        assert (command.state, command.stop) == ("done", Stop.OPERATOR.name)
    assert {node.drive.state.name for node in backend.rig.nodes} == {"SWITCH_ON_DISABLED"}
    (folder,) = bench.settings.runs_root.glob("*-service-arm")
    run = read_run(folder)
    assert (run.manifest["record"]["state"], run.manifest["end"]["stop"]) == ("closed", Stop.OPERATOR.name)
    (stopping,) = [entry for entry in bench.log.last(200) if entry.fields.get("state") == "stopping"]
    assert stopping.text == ENDING
    kept, _ = recall(tmp_path / "state")
    assert (kept.powered_since, kept.fault) == ("", None)
    after = begun(tmp_path)
    assert (after.status.state, after.status.fault) == ("off", None)


def test_sigterm_while_a_world_is_opened_leaves_nothing_of_it(tmp_path, own_signals):
    bench = begun(tmp_path)
    hear_signals(bench.loop)
    opened = []

    def then_terminate(text, share):
        opened.append(text)
        if text == "configuring the drives":
            os.kill(os.getpid(), signal.SIGTERM)

    bench.loop._progress = then_terminate
    bench.loop.run()
    assert "configuring the drives" in opened
    assert (bench.status.state, bench.loop._stage) == ("off", None)
    assert list(bench.settings.runs_root.glob("*-service*")) == []
    assert recall(tmp_path / "state")[0].powered_since == ""
