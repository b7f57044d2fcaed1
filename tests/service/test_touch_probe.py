"""A touch probe through the service, on a joint that is not where it is believed: found, and never pressed hard."""

import numpy as np
import pytest

from sim_backend.machine import MACHINES_FOLDER
from stagectl.client import Client
from stagectl.errors import RequestError
from stagectl.profile import PROFILES_FOLDER
from stagectl.record import read_manifest
from stagectl.service import messages
from stagectl.service.desk import Desk
from stagectl.service.service_log import ServiceLog
from stagectl.service.states import State
from stagectl.service.wear_watch import WearWatch
from stagectl.wear import LATELY_S, PROBE
from tests.service.served import Served
from tests.toml_text import changed

LIMIT_N = 5.0
WORN = {  # against the profile 7 um wider, and 17 and 22 % stiffer
    "backlash.left_m": 34e-6,
    "backlash.right_m": 174e-6,
    "backlash.left_stiffness_n_per_m": 15.5e3,
    "backlash.right_stiffness_n_per_m": 12.0e3,
}
WIDTH_M = WORN["backlash.left_m"] + WORN["backlash.right_m"]


class Probed(Served):
    """A service whose profile permits a touch probe, or doesn't."""

    def __init__(self, folder, wear):
        profile, machine = folder / "probed.toml", folder / "worn.toml"
        profile.write_text(changed(PROFILES_FOLDER / "oled-printer.toml", {"wear": wear}))
        machine.write_text(changed(MACHINES_FOLDER / "oled-printer.toml", WORN))
        super().__init__(folder, profile, machine)

    def now_s(self):
        """The rig's own time."""
        return self.stage.link.now_t_ns() * 1e-9


@pytest.fixture(scope="module")
def permitting(tmp_path_factory):
    made = Probed(tmp_path_factory.mktemp("permitting"), {"probe_every_s": 1e6})
    yield made
    made.close()


@pytest.fixture
def probed(permitting, monkeypatch):
    """A service at rest, that wants to touch the joint by itself as soon as it is armed."""
    permitting.recovers()
    monkeypatch.setenv("STAGECTL_SOCKET", str(permitting.socket))
    permitting.bench.loop._wear = WearWatch(permitting.stage.profile, permitting.log, permitting.now_s)
    yield permitting
    permitting.recovers()


def own_probe(served):
    """The probe that the service began by itself, under way."""
    return served.until(lambda: (found := served.desk.status().command) is not None and found.name == "probe" and found)


def ended(client, key):
    """What became of a command, at its end."""
    found = client.command(key, 20.0)
    while found.state not in ("done", "failed"):
        found = client.command(key, 20.0)
    return found


def rest(served):
    """Where the stage truly is, and what was true up to now; it holds."""
    served.until(lambda: served.desk.status().command is None)
    return served.plant, served.truth["t_ns"].size


def test_a_probe_finds_both_edges_presses_softly_and_comes_back(probed):
    client = probed.client
    client.take_lease("anna", 30.0)
    client.arm()
    first = ended(client, own_probe(probed).key)  # nothing told of the joint yet: touched unasked
    before, begun = rest(probed)
    asked = client.probe()
    after, over = rest(probed)
    for found in (first, asked):
        assert (found.state, found.stop) == ("done", "FINISHED")
        joint = found.backlash
        assert joint.width_m == pytest.approx(WIDTH_M, abs=3.0 * joint.width_sd_m)
        assert 0.0 < joint.width_sd_m < 0.2e-6
        assert joint.left_stiffness_n_per_m == pytest.approx(WORN["backlash.left_stiffness_n_per_m"], rel=0.02)
        assert joint.right_stiffness_n_per_m == pytest.approx(WORN["backlash.right_stiffness_n_per_m"], rel=0.02)
    force_n = probed.truth["contact_force_n"]
    assert np.max(np.abs(force_n)) < LIMIT_N  # from the first cycle on
    pressed_n = force_n[begun:over]
    assert pressed_n.min() < -1.0  # both sides, and they were truly pressed
    assert pressed_n.max() > 1.0
    for name in ("macro_position_m", "end_position_m"):
        assert after[name] == pytest.approx(before[name], abs=0.3e-6)
    assert client.status().state == "armed"
    wear = client.status().wear
    assert (wear.source, wear.observable) == (PROBE, True)
    assert wear.width_m == asked.backlash.width_m
    assert client.status().backlash == asked.backlash
    ended_s = probed.now_s() - wear.age_s
    for after_s, observable in ((0.3 * LATELY_S, True), (LATELY_S, False)):  # it holds, with the estimator at work
        probed.until(lambda until_s=ended_s + after_s + 1.5: probed.now_s() > until_s)
        held = client.status().wear
        assert (held.source, held.observable, held.width_m) == (PROBE, observable, wear.width_m)
    client.give_lease_back()
    probed.state_is("idle")
    assert read_manifest(probed.bench.settings.runs_root / asked.run)["record"]["state"] == "closed"


MOTIONS = {
    "move": lambda client, at_m: client.begin("move", messages.Move(target_m=at_m + 1e-3)).key,
    "stream": lambda client, at_m: client.send_setpoints(0, 0.05, [at_m + 2e-5 * k for k in range(51)], last=True).key,
}


@pytest.mark.parametrize("name", MOTIONS)
def test_a_motion_that_comes_during_the_service_s_own_probe_waits_for_its_end(probed, name):
    client = probed.client
    client.take_lease("anna", 30.0)
    at_m = client.arm() and client.status().positions.setpoint_position_m
    own = own_probe(probed)
    probed.until(lambda: client.command(own.key).share > 0.1)
    key = MOTIONS[name](client, at_m)
    assert client.command(key).state == "waiting"
    with pytest.raises(RequestError, match=f"home: {client.command(key).name} is under way"):
        client.home()  # one at a time
    done = ended(client, key)
    assert (done.state, done.stop) == ("done", "FINISHED")
    assert client.command(own.key).stop == "FINISHED"
    rest(probed)
    assert probed.desk.status().positions.setpoint_position_m == pytest.approx(at_m + 1e-3, abs=5e-6)
    assert np.max(np.abs(probed.truth["contact_force_n"])) < LIMIT_N


def test_a_stop_during_the_service_s_own_probe_ends_what_waits_too(probed):
    client = probed.client
    client.take_lease("anna", 30.0)
    client.arm()
    own = own_probe(probed).key
    key = client.begin("move", messages.Move(target_m=0.01)).key
    client.stop()
    probed.state_is("idle")
    assert client.command(own).stop == "OPERATOR"
    assert client.command(key).state == "failed"
    assert "move: stopped before it began" in client.command(key).text


def test_a_command_that_comes_before_the_service_s_own_probe_began_is_done_instead():
    desk = Desk(ServiceLog(None), lambda: 0.0)
    desk._state = State.ARMED
    token = desk.take_lease(messages.TakeLease(holder="anna")).token
    desk.submit_own("probe", messages.Probe())
    own = desk._current
    desk.submit("move", messages.Move(target_m=0.0), "first", token)
    assert desk.next_order().key == "first"
    assert desk.next_order() is None
    assert own.message().text == "probe: stopped before it began: move came first"


def test_what_the_state_forbids_is_refused_during_the_service_s_own_probe(probed):
    client = probed.client
    client.take_lease("anna", 30.0)
    client.arm()
    own_probe(probed)
    with pytest.raises(RequestError, match="arm is not possible in state armed"):
        client.arm()
    with Client(probed.socket) as other:
        other.lease_token = "guessed"
        for ask in (lambda: other.move(0.0), other.probe):
            with pytest.raises(RequestError, match="not the lease that anna holds"):
                ask()


def test_a_profile_that_permits_no_probe_says_which_key_would(tmp_path):
    made = Probed(tmp_path, {})
    try:
        client = made.client
        client.take_lease("anna", 30.0)
        client.arm()
        begun = made.truth["t_ns"].size
        with pytest.raises(
            RequestError, match=r"permits no touch probe; give wear\.probe_every_s, or identify instead"
        ):
            client.probe()
        assert (
            client._http.post("/v1/probe", json={}, headers={"Stagectl-Lease": client.lease_token}).status_code == 422
        )
        assert client.status().state == "armed"
        assert client.status().wear is None
        client.give_lease_back()
        made.state_is("idle")
        assert np.max(np.abs(made.truth["contact_force_n"][begun:])) < LIMIT_N
    finally:
        made.close()
