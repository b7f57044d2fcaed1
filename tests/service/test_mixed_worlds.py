"""Mixed worlds: the rig plays one part of the stage, another process the hardware. What may move, what never does."""

from pathlib import Path

import pytest

from sim_backend.machine import MACHINES_FOLDER
from stagectl import stage as stages
from stagectl.backend import RIG_DRIVES, RIG_SENSOR, BatchBackend, RigBackend
from stagectl.errors import RequestError
from stagectl.profile import PROFILES_FOLDER, load_profile
from stagectl.requests import Mode
from stagectl.service import messages
from stagectl.service.desk import Order
from stagectl.service.motions import MOTIONS
from stagectl.service.states import Event, State
from stagectl.service.world import missing
from stagectl.session import WATCHED_ONLY
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from tests.service.daemon import PATIENT, REST_M_PER_S
from tests.service.test_stage_loop import Bench
from tests.toml_text import changed

MOVE_M = 0.01
STANDS_AT_M = 0.0114233  # without power: 2 N sin(2 pi x / 32 mm + 1.1) + 0.4 N = 0, where a push brings it back
TRIES_COUNT = 5


class Watched(BatchBackend):
    """The rig in virtual time, as a world in which the drives are real and what is measured is not."""

    may_move = False


def test_a_world_that_is_watched_only_gives_no_drive_power(single_profile, single_machine, tmp_path):
    backend = Watched(single_machine, seed=1)
    with Supervisor(single_profile, backend, tmp_path / "run") as stage:
        for asked in (stage.enable, stage.armed, stage.home, lambda: stage._request(mode=int(Mode.TRACK))):
            with pytest.raises(RequestError, match="may only be watched: what moves is not what is measured; connect"):
                asked()
        stage.pump(0.1)
        assert {node.drive.state.name for node in backend.rig.nodes} == {"SWITCH_ON_DISABLED"}
        assert stage.status()["sensor_ready"]


def test_the_service_refuses_every_motion_of_such_a_world(tmp_path):
    bench = Bench(tmp_path)
    bench.until(lambda: bench.loop._state == "idle")
    bench.loop.step()
    bench.loop._stage.backend.may_move = False
    bench.loop._homed = True
    bench.take()
    for name, body in (("arm", messages.Arm()), ("home", messages.Home())):
        done = bench.do(name, body)
        assert (done.state, done.error.kind) == ("failed", "RequestError")
        assert "may only be watched" in done.error.message
        assert bench.status.state == "idle"
    assert {node.drive.state.name for node in bench.loop._stage.backend.rig.nodes} == {"SWITCH_ON_DISABLED"}
    bench.loop.leave()
    bench.loop.run()


def test_a_mixed_world_waits_for_its_real_part_only(single_profile, tmp_path):
    can, port = f"CAN {single_profile.can.interface}", f"interferometer {single_profile.interferometer.port}"
    assert missing(single_profile, "rig", tmp_path) == ""
    assert missing(single_profile, RIG_DRIVES, tmp_path).startswith(port)
    assert missing(single_profile, RIG_SENSOR, tmp_path).startswith(can)
    both = missing(single_profile, "hardware", tmp_path)
    assert can in both
    assert port in both
    assert stages.choose(single_profile, "auto") == "rig"  # never a mixed one by itself


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A rig as if it were hardware, and the file of a profile that leads to it."""
    folder = tmp_path_factory.mktemp("hardware")
    (folder / "patient.toml").write_text(changed(PROFILES_FOLDER / "single-axis.toml", PATIENT))
    # From elsewhere it creeps there with 0.3 mm/s, which a homing by its interferometer notices.
    stands = changed(MACHINES_FOLDER / "single-axis.toml", {"start.macro_position_m": STANDS_AT_M})
    (folder / "stands.toml").write_text(stands)
    rig = RigBackend(load_profile(folder / "patient.toml"), folder / "stands.toml", seed=3)
    try:
        real = {"can.interface": "hub", "can.channel": rig.channel, "interferometer.port": rig._port}
        real["macro.identity.vendor_id"] = rig.vendor_id
        (folder / "real.toml").write_text(changed(folder / "patient.toml", real))
        yield rig, folder / "real.toml"
    finally:
        rig.close()


@pytest.mark.real_time
def test_the_rig_plays_one_part_and_hardware_the_other(played, tmp_path):
    rig, path = played
    profile = load_profile(path)
    for plays in (RIG_SENSOR, RIG_DRIVES):
        assert missing(profile, plays, tmp_path) == ""
        backend = RigBackend(profile, "single-axis", seed=4, plays=plays)
        with Supervisor(profile, backend, tmp_path / plays) as stage:
            if plays == RIG_SENSOR:
                with pytest.raises(RequestError, match="may only be watched"):
                    stage.enable()
            else:
                assert stage.enable() is Stop.NONE
                stage.disarm()
            assert backend.truth() is None
            drives = rig.request({"state": True})["drives"]
        assert set(drives.values()) == {"SWITCH_ON_DISABLED"}


def home_arm_and_move(stage, backend):
    """Return the first outcome that is no success, the move's where all is well; and where the stage was before it.

    A host that starves the servo for more than 20 cycles has the rig's drives say so: that gets another try.
    """
    for _ in range(TRIES_COUNT):
        for ask in (stage.home, stage.armed, lambda: stage.move(stage.status()["setpoint_position_m"] + MOVE_M)):
            began = backend.request({"state": True})["plant"]
            outcome = ask()
            if not outcome.finished:
                break
        if outcome.stop is not Stop.EMERGENCY:
            break
        stage.acknowledge()
    return outcome, began


@pytest.mark.real_time
def test_simulated_drives_home_and_move_by_a_real_interferometer_that_sees_what_they_move(played, tmp_path):
    """Its port is a link that is laid to the sensor of the machine that these drives move, once that is there."""
    port = tmp_path / "interferometer"
    (tmp_path / "real.toml").write_text(changed(played[1], {"interferometer.port": str(port)}))
    profile = load_profile(tmp_path / "real.toml")
    assert missing(profile, RIG_DRIVES, tmp_path).startswith(f"interferometer {port}")
    backend = RigBackend(profile, "single-axis", seed=4, plays=RIG_DRIVES)
    port.symlink_to(Path(backend.channel).with_name("interferometer"))
    assert missing(profile, RIG_DRIVES, tmp_path) == ""
    with Supervisor(profile, backend, tmp_path / "run") as stage:
        assert f"real interferometer {port}" in backend.description
        outcome, began = home_arm_and_move(stage, backend)
        assert outcome.stop is Stop.FINISHED, outcome
        moved_m = backend.request({"state": True})["plant"]["end_position_m"] - began["end_position_m"]
        assert moved_m == pytest.approx(MOVE_M, abs=1e-4)
        status = stage.status()
        assert status["end_position_m"] == pytest.approx(status["setpoint_position_m"], abs=1e-4)
        stage.disarm()


@pytest.mark.real_time
def test_simulated_drives_are_stopped_where_the_real_interferometer_does_not_see_them_move(played, tmp_path):
    """It is another stage's, that stands: what the drives believe and what is measured part, and the guard ends it."""
    profile = load_profile(played[1])
    backend = RigBackend(profile, "single-axis", seed=4, plays=RIG_DRIVES)
    with Supervisor(profile, backend, tmp_path / "run") as stage:
        outcome, began = home_arm_and_move(stage, backend)  # homing is by the drive's own encoder
        # Held by what does not see it, the axis creeps as soon as it has power: on a slow host too far already.
        assert outcome.name == "enable" or outcome.name.startswith("moving to"), outcome
        assert outcome.stop is Stop.REFERENCE_LOST, outcome
        assert "macro laser and the drive's encoder differ" in outcome.detail
        plant = backend.request({"state": True})["plant"]
        assert abs(plant["macro_velocity_m_per_s"]) < REST_M_PER_S
        assert abs(plant["macro_position_m"] - began["macro_position_m"]) < 0.1 * MOVE_M


BODIES = {
    "arm": messages.Arm(),
    "home": messages.Home(),
    "move": messages.Move(target_m=0.0),
    "jog": messages.JogBy(distance_m=0.001),
    "jogging": messages.BeginJog(),
    "scan": messages.Scan(segments=[messages.Segment(target_m=0.01)]),
    "follow": messages.Follow(text="t_s,position_m\n0,0\n1,0.001\n"),
    "setpoints": messages.Setpoints(first_number=0, period_s=0.01, position_m=[0.0] * 50),
    "probe": messages.Probe(),
    "identify": messages.Identify(),
}
"""A request for each motion that there is."""


def ask_for(bench, name, body):
    """Ask for a motion as the API does, and return why it was refused."""
    try:
        if name in ("scan", "follow"):
            bench.desk.submit_planned(name, body, f"p-{name}", bench.token)
        elif name == "setpoints":
            bench.desk.take_setpoints(body, bench.token)
        elif name == "jogging":
            bench.desk.begin_jog(body, "p-jogging", bench.token)
        else:
            return bench.do(name, body).error.message
    except RequestError as error:
        return str(error)
    raise AssertionError(f"{name} was taken over")


@pytest.mark.real_time
@pytest.mark.parametrize("begun", [RIG_SENSOR, "swapped"])
def test_real_drives_on_a_simulated_interferometer_do_no_motion_that_a_client_asks_the_service_for(
    played, tmp_path, begun
):
    rig, path = played
    bench = Bench(tmp_path, str(path), RIG_SENSOR if begun == RIG_SENSOR else "batch")
    try:
        if begun == "swapped":
            bench.hold_as_homed_by_truth()
            bench.desk.ask_to_stop("the world is changed")
            bench.until(lambda: bench.status.state == "idle")
            assert bench.do("backend", messages.SwapBackend(backend=RIG_SENSOR)).state == "done"
        else:
            bench.take()
        bench.until(lambda: bench.loop._state == "idle")
        bench.loop.step()
        assert (bench.status.backend, bench.status.homed) == (RIG_SENSOR, False)
        assert "watched only" in bench.status.backend_description
        assert set(BODIES) == set(MOTIONS)
        for name, body in BODIES.items():
            said = ask_for(bench, name, body)
            if MOTIONS[name].event in (Event.ARM, Event.HOME):
                assert f"{name}: {WATCHED_ONLY}" == said
            assert bench.status.state == "idle"
            assert set(rig.request({"state": True})["drives"].values()) == {"SWITCH_ON_DISABLED"}
        for name, body in BODIES.items():  # and if the stage's state should ever let a motion through
            motion = MOTIONS[name]
            bench.loop._state = State.IDLE if motion.event in (Event.ARM, Event.HOME) else State.ARMED
            with pytest.raises(RequestError, match=f"{name}: .* may only be watched"):
                bench.loop._move(Order(name, name, body, bench.token, lambda: 0.0))
        bench.loop._state = State.IDLE
        bench.loop.step()
        assert set(rig.request({"state": True})["drives"].values()) == {"SWITCH_ON_DISABLED"}
    finally:
        bench.loop._state = State.IDLE
        bench.loop.leave()
        bench.loop.run()
