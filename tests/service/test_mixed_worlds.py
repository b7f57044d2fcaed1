"""Mixed worlds: the rig plays one part of the stage, another process the hardware. What may move, what never does."""

import pytest

from stagectl import stage as stages
from stagectl.backend import RIG_DRIVES, RIG_SENSOR, BatchBackend, RigBackend
from stagectl.errors import RequestError
from stagectl.profile import PROFILES_FOLDER, load_profile
from stagectl.requests import Mode
from stagectl.service import messages
from stagectl.service.world import missing
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from tests.service.daemon import PATIENT
from tests.service.test_stage_loop import Bench
from tests.toml_text import changed


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


@pytest.mark.real_time
def test_the_rig_plays_one_part_and_hardware_the_other(tmp_path):
    text = changed(PROFILES_FOLDER / "single-axis.toml", PATIENT)
    (tmp_path / "patient.toml").write_text(text)
    played = RigBackend(load_profile(tmp_path / "patient.toml"), "single-axis", seed=3)  # as if it were hardware
    try:
        real = {"can.interface": "hub", "can.channel": played.channel, "interferometer.port": played._port}
        real["macro.identity.vendor_id"] = played.vendor_id
        (tmp_path / "real.toml").write_text(changed(tmp_path / "patient.toml", real))
        profile = load_profile(tmp_path / "real.toml")
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
                drives = played.request({"state": True})["drives"]
            assert set(drives.values()) == {"SWITCH_ON_DISABLED"}
    finally:
        played.close()
