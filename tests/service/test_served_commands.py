"""The command line through a service on the rig in virtual time: exit codes, what is said, and what is left behind."""

import contextlib
import io
import json
import math
import os
import re
import signal
import threading

import pytest

from stagectl import cli
from stagectl.client import Client
from stagectl.commands import remote
from stagectl.commands.answer import INTERRUPTED
from stagectl.errors import LinkError, RequestError, StagectlError
from stagectl.record import read_manifest
from stagectl.service import messages
from tests.service.served import PATIENCE_S, Served

BANNER = "SOFTWARE RIG in virtual time: nothing real moves"


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    made = Served(tmp_path_factory.mktemp("commands"), "oled-printer")
    yield made
    made.close()


@pytest.fixture
def idle(served, monkeypatch):
    served.recovers()
    monkeypatch.setenv("STAGECTL_SOCKET", str(served.socket))
    monkeypatch.delenv("STAGECTL_LEASE", raising=False)
    yield served
    served.recovers()


@pytest.fixture
def call(idle, capsys):
    """Run a command: (exit code, stdout, stderr)."""

    def run(*arguments):
        capsys.readouterr()
        code = cli.main([str(one) for one in arguments])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


@pytest.fixture
def ask(call):
    """Run a command with --json: (exit code, the object, stderr)."""

    def run(*arguments):
        code, out, err = call(*arguments, "--json")
        return code, json.loads(out), err

    return run


@contextlib.contextmanager
def meanwhile(served, due, act):
    """Act in a thread as soon as `due` while a command works; what goes wrong there fails the test."""
    trouble, over = [], threading.Event()

    def work():
        try:
            served.until(lambda: over.is_set() or due())
            act(over)
        except (StagectlError, AssertionError) as error:
            trouble.append(error)
            interrupt(over)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(PATIENCE_S)
        assert not trouble, trouble
        assert not thread.is_alive()


def interrupt(over):
    """Press Ctrl-C, while there is a command to hear it."""
    if not over.is_set():
        os.kill(os.getpid(), signal.SIGINT)


def interrupted(served, due):
    return meanwhile(served, due, interrupt)


# ---- identify --------------------------------------------------------------------------------------------------------


def test_identify_finds_the_joint_and_leaves_no_power(idle, ask):
    code, answer, err = ask("identify", "--duration-s", 4)
    assert (code, answer["finished"], answer["stop"], answer["state"]) == (0, True, "FINISHED", "idle")
    assert BANNER in err
    joint = idle.stage.backend.rig.machine.backlash
    found = answer["backlash"]
    assert found["width_m"] == pytest.approx(joint.left_m + joint.right_m, abs=4.0 * found["width_sd_m"])
    assert 0.0 < found["width_sd_m"] < 0.2e-6
    assert read_manifest(idle.bench.settings.runs_root / found["run"])["record"]["state"] == "closed"
    assert idle.client.lease_state() is None


def test_identify_tells_a_person_the_width_and_the_run(idle, call):
    code, out, _ = call("identify", "--duration-s", 3)
    assert code == 0
    assert "identify: the reference came to its end" in out
    assert re.search(r"^backlash 199\.[0-9]{2} um \+- 0\.[0-9]{2} um$", out, re.MULTILINE)
    assert "-service-arm" in out


def test_identify_is_refused_where_it_can_t_be(idle, ask):
    with idle.client.lease("anna", 30.0):
        code, answer, _ = ask("identify")
        assert code == 2
        assert "anna holds the lease" in answer["error"]["message"]
    assert ask("identify", "--profile", "single-axis")[0] == 2
    assert ask("identify", "--duration-s", 1)[0] == 2


def test_a_service_that_has_not_read_its_profile_refuses_for_its_own_reason(idle):
    """A restart into a fault: the profile is known by name only, and asked for by that is no other stage."""
    status = idle.desk.status().model_copy(update={"profile": "", "profile_path": "my-stage"})
    for profile in (None, "my-stage"):
        remote.refuse_other(status, profile, "auto")
    with pytest.raises(RequestError, match=r"--profile other: the service has not read its own \(my-stage\)"):
        remote.refuse_other(status, "other", "auto")


def test_an_identification_that_somebody_stops_ended_early(idle, ask, call):
    with meanwhile(idle, lambda: idle.desk.status().state == "identifying", lambda over: idle.client.stop()):
        code, answer, _ = ask("identify")
    assert (code, answer["finished"], answer["stop"], answer["state"]) == (1, False, "OPERATOR", "idle")
    assert answer["backlash"] is None
    with meanwhile(idle, lambda: idle.desk.status().state == "identifying", lambda over: idle.client.stop()):
        code, out, _ = call("identify")
    assert code == 1
    assert "ended early" in out


@pytest.mark.parametrize("by", ["its own lease", "another's"])
def test_ctrl_c_brings_an_identification_to_rest(idle, ask, by):
    """Under another's lease too, which goes on: nobody waits for the motion any more."""
    lease = ()
    if by == "another's":
        lease = ("--lease", idle.client.take_lease("anna", 30.0).token)
    with interrupted(idle, lambda: idle.desk.status().state == "identifying"):
        code, answer, err = ask("identify", "--duration-s", 60, *lease)
    assert code == INTERRUPTED
    assert idle.desk.status().state == "idle"
    assert "the stage was brought to rest" in answer["error"]["message"]
    assert "the stage was brought to rest; what it did is in the service's run" in err
    assert (idle.client.lease_state() is None) is (by == "its own lease")


# ---- watch -----------------------------------------------------------------------------------------------------------


def test_watch_looks_as_often_as_it_is_told(call):
    code, out, _ = call("watch", "--json", "--count", 3)
    assert code == 0
    looks, end = out.splitlines()[:3], out.splitlines()[3:]
    for look in looks:
        assert messages.Status.model_validate_json(look).banner == BANNER
    assert json.loads("\n".join(end)) == {"command": "watch", "exit_code": 0, "looks_count": 3}
    code, out, _ = call("watch", "--count", 2)  # into a pipe: each look, and when it is had
    assert (code, out.count(BANNER)) == (0, 2)


def test_ctrl_c_ends_the_watching_and_nothing_else(idle, call):
    looked = threading.Event()
    asked = idle.desk.status

    def status():
        looked.set()
        return asked()

    idle.desk.status = status
    try:
        with interrupted(idle, looked.is_set):
            code, out, err = call("watch", "--json")
    finally:
        del idle.desk.status
    assert code == INTERRUPTED
    assert json.loads(out.splitlines()[0])["state"] == "idle"
    assert "interrupted: the service goes on" in err
    assert idle.client.status().state == "idle"


# ---- fault -----------------------------------------------------------------------------------------------------------


def trip(served):
    """Let the lease of an armed stage run out."""
    with Client(served.socket) as client:
        client.take_lease("anna", 30.0)
        client.arm()
    served.bench.now_s += 31.0
    served.state_is("fault")


def test_a_fault_is_said_acknowledged_and_gone(idle, call, ask):
    assert ask("fault")[:2] == (0, {"command": "fault", "exit_code": 0, "fault": None, "acknowledged": False})
    assert call("fault", "--acknowledge")[:2] == (0, "no fault\n")
    trip(idle)
    code, answer, err = ask("fault")
    assert (code, answer["acknowledged"]) == (1, False)
    assert (answer["fault"]["kind"], answer["fault"]["state"]) == ("LEASE", "armed")
    assert BANNER in err
    code, out, _ = call("fault")
    assert code == 1
    assert f"fault {answer['fault']['number']} " in out
    assert "while armed" in out
    assert "what to do: " in out
    with Client(idle.socket) as other:
        other.take_lease("bert", 30.0)
        code, answer, _ = ask("fault", "--acknowledge")
        assert code == 2
        assert "bert holds the lease" in answer["error"]["message"]
        assert idle.desk.status().fault is not None
        code, answer, _ = ask("fault", "--acknowledge", "--lease", other.lease_token)
        assert (code, answer["acknowledged"], answer["fault"]["kind"]) == (0, True, "LEASE")
        assert other.lease_state().holder == "bert"
        other.give_lease_back()
    assert idle.client.fault() is None
    assert idle.client.status().state == "idle"  # nothing was enabled
    assert ask("fault")[0] == 0


def test_a_fault_is_acknowledged_under_a_lease_of_the_command_s_own(idle, call):
    trip(idle)
    code, out, _ = call("fault", "--acknowledge")
    assert code == 0
    assert "acknowledged; nothing was enabled" in out
    assert idle.client.lease_state() is None
    code, out, err = call("move", "--target-m", 0.001)
    assert (code, idle.client.status().state) == (0, "idle"), out + err


# ---- lease -----------------------------------------------------------------------------------------------------------


def test_lease_says_who_holds_it(idle, call, ask):
    assert ask("lease")[:2] == (0, {"command": "lease", "exit_code": 0, "lease": None})
    assert call("lease")[:2] == (0, "free\n")
    with idle.client.lease("anna", 30.0):
        code, answer, _ = ask("lease")
        assert (code, answer["lease"]) == (0, {"holder": "anna", "left_s": 30.0, "duration_s": 30.0})
        assert call("lease")[:2] == (0, "anna, 30.0 s left\n")
        code, answer, _ = ask("lease", "--hold")
        assert code == 2
        assert "anna holds the lease for 30.0 s more" in answer["error"]["message"]


@pytest.mark.parametrize("as_json", [False, True])
def test_a_lease_is_held_for_other_commands_until_ctrl_c(idle, call, as_json):
    armed = []

    def then_arm(over):
        with Client(idle.socket) as other:
            other.lease_token = idle.desk._lease.token
            other.arm()
            armed.append(other.status().state)
        interrupt(over)

    with meanwhile(idle, lambda: idle.desk.lease_state() is not None, then_arm):
        code, out, err = call("lease", "--hold", *(["--json"] if as_json else []))
    assert (code, armed) == (INTERRUPTED, ["armed"])
    first = out.splitlines()[0]
    if as_json:
        assert messages.TakenLease.model_validate_json(first).holder
        assert json.loads(out[len(first) :])["exit_code"] == INTERRUPTED
    else:
        assert first.startswith("export STAGECTL_LEASE=")
    assert "interrupted: the lease was given back; the stage is without power" in err
    assert idle.desk.lease_state() is None
    assert idle.desk.status().state == "idle"


def test_what_the_shell_is_told_is_a_lease_to_work_under(idle, call, monkeypatch):
    token = idle.client.take_lease("anna", 30.0).token
    monkeypatch.setenv("STAGECTL_LEASE", token)
    assert call("move", "--target-m", 0.002)[0] == 0
    assert idle.desk.status().state == "armed"
    assert call("stop")[:2] == (0, "stopped; the state is idle\n")
    assert idle.client.lease_state().holder == "anna"


def test_a_lease_that_is_lost_ends_the_holding(idle, call):
    def then_lose(over):
        idle.bench.now_s += 100.0

    with meanwhile(idle, lambda: idle.desk.lease_state() is not None, then_lose):
        code, _, err = call("lease", "--hold")
    assert code == 2
    assert "the lease was lost: it was not renewed in time; the stage was stopped" in err


# ---- what is refused before anything has power ---------------------------------------------------------------------


def test_what_lies_beyond_the_travel_gives_nothing_power(idle, call, ask, tmp_path, monkeypatch):
    """Told by the service after it had armed, it had homed a stage for a target that it can't go to."""
    program = tmp_path / "far.toml"
    program.write_text("start_m = 0\n[[segments]]\ntarget_m = 0.01\n[[segments]]\ntarget_m = 3.0\n")
    table = tmp_path / "far.csv"
    table.write_text("t_s,position_m\n0,0\n5,0.2\n10,0.6\n")
    assert call("move", "--target-m", 0.05)[0] == 0
    before = doings(idle)
    for arguments, lines, said in (
        (("follow", table), "", "s: position_m is 0.4"),
        (("jog", "--distance-m", 0.42), "", "m that leads to 0.47"),
        (("move", "--target-m", 5), "", "target_m is 5: the travel of oled-printer is [-0.45, 0.45] m"),
        (("jog", "--distance-m", 5), "", "distance_m is 5: the travel"),
        (("scan", program), "", "segments.1.target_m is 3: the travel"),
        (("stream",), "1.0\n", "position_m.0 is 1: the travel"),
        (("stream", "--period-s", 0.0105), "0.0\n", "period_s is 0.0105: set-points come a whole number of cycles"),
        (("identify", "--frequency-hz", 0.05, "--duration-s", 2), "", "take 40 s; give a longer duration_s"),
        (("stream",), "nan\n", "line 1 is 'nan'; give one position"),
        (("stream",), "1e999\n", "line 1 is '1e999'; give one position"),
    ):
        monkeypatch.setattr("sys.stdin", io.StringIO(lines))
        code, answer, _ = ask(*arguments)
        assert (code, said in answer["error"]["message"]) == (2, True), answer
    assert doings(idle) == before
    idle.bench.loop._homed = False
    try:
        idle.until(lambda: not idle.desk.status().homed)
        code, answer, _ = ask("jog", "--distance-m", 0.5)
        assert (code, "from 0 m that leads to 0.5 m" in answer["error"]["message"]) == (2, True), answer
        assert doings(idle) == before
    finally:
        idle.bench.loop._homed = True


def doings(served):
    """What the service has done that is more than giving a lease."""
    return sum(not entry.event.startswith("lease") for entry in served.log.last(2000))


def test_a_value_that_no_request_can_have_is_refused(idle):
    with pytest.raises(RequestError, match="target_m is nan"):
        idle.client.move(math.nan)
    with pytest.raises(RequestError, match=r"position_m\.1 is inf"):
        idle.client.send_setpoints(0, 0.01, [0.0, math.inf])


@pytest.mark.parametrize(
    "strange", ["\x1b[31m", "\x9b31m", "\x9d0;title\x9c", "\u202ereversed", "two\u2028lines", "\x85", "\u200b"]
)
def test_no_holder_s_name_does_anything_to_a_terminal(idle, strange):
    for holder in (f"anna {strange}", " ", f" {strange}"):
        with pytest.raises(RequestError, match="holder is"):
            idle.client.take_lease(holder)
    assert idle.desk.lease_state() is None


def test_a_holder_s_name_may_have_any_letters(idle):
    with idle.client.lease("Anna Müller – 李@stage (pid 3)"):
        assert idle.desk.lease_state().holder == "Anna Müller – 李@stage (pid 3)"


@pytest.mark.parametrize("lease", ["é", "a\nb"])
def test_a_lease_that_is_no_token_is_refused_and_stops_all_the_same(ask, lease):
    code, answer, _ = ask("move", "--target-m", 0.0, "--lease", lease)
    assert (code, "which is no token" in answer["error"]["message"]) == (2, True)
    assert ask("stop")[0] == 0


@pytest.mark.parametrize("forbidden", ["socket", "folder"])
def test_a_socket_that_is_not_for_this_user_is_told_as_that(idle, tmp_path, forbidden):
    folder = tmp_path / "closed"
    folder.mkdir()
    (folder / "stage.socket").symlink_to(idle.socket)
    place, me = {"socket": idle.socket, "folder": folder}[forbidden], os.geteuid()
    mode = place.stat().st_mode
    place.chmod(0)
    if me == 0:
        os.seteuid(65534)  # root is refused nothing
    try:
        with Client(folder / "stage.socket") as client, pytest.raises(LinkError, match="is not for this user; join"):
            client.status()
    finally:
        os.seteuid(me)
        place.chmod(mode)


def test_a_stop_needs_no_token(idle):
    with Client(idle.socket) as client:
        client.lease_token = "é"
        assert client.stop().state == "idle"


# ---- record, trigger, log --------------------------------------------------------------------------------------------


def test_a_run_is_begun_shown_and_ended(idle, call, ask):
    code, answer, err = ask("record")
    assert (code, answer["recording"]["run"], answer["recording"]["trouble"]) == (0, "", "")
    assert BANNER in err
    assert call("record")[:2] == (0, "the last seconds only, in memory\n")
    code, answer, _ = ask("record", "--name", "warm-up")
    assert (code, answer["recording"]["trigger"]) == (0, "request")
    run = answer["recording"]["run"]
    assert run.endswith("-service-warm-up")
    assert call("record")[1] == f"{run}, begun by request\n"
    code, answer, _ = ask("record", "--name", "another")  # one at a time
    assert (code, f"name another: {run} is under way, begun by request; end it" in answer["error"]["message"]) == (
        2,
        True,
    )
    code, answer, _ = ask("record", "--end")
    assert (code, answer["recording"]["run"]) == (0, "")
    manifest = read_manifest(idle.bench.settings.runs_root / run)
    assert (manifest["record"]["state"], manifest["end"]["stop"]) == ("closed", "OPERATOR")
    assert manifest["record"]["rows_count"] > 0
    assert call("record", "--end")[0] == 0


def test_a_run_asked_for_under_a_motion_s_begins_behind_it(idle, ask):
    with idle.client.lease("anna", 30.0):
        idle.client.arm()
        idle.until(lambda: idle.desk.status().recording.trigger == "arm")
        code, answer, err = ask("record", "--name", "later")
        assert (code, answer["recording"]["trigger"], answer["recording"]["next_name"]) == (0, "arm", "later")
        assert "later begins when the motion's run ends" in err
        code, answer, _ = ask("record", "--name", "second")
        assert (code, "name second: later was asked for before" in answer["error"]["message"]) == (2, True), answer
    idle.until(lambda: idle.desk.status().recording.trigger == "request")
    assert idle.desk.status().recording.run.endswith("-service-later")
    assert idle.desk.status().recording.next_name == ""
    assert ask("record", "--end")[0] == 0


def test_a_run_that_the_disk_refuses_is_no_success(idle, ask):
    """Nor is the next one, of which the status says the same as of the first."""
    runs = idle.bench.settings.runs_root
    aside = runs.rename(runs.with_name("aside"))
    runs.write_text("no folder")
    try:
        for name in ("one", "two"):
            code, answer, _ = ask("record", "--name", name)
            assert (code, "no run was begun: " in answer["error"]["message"]) == (5, True), answer
    finally:
        runs.unlink()
        aside.rename(runs)
    assert ask("record", "--name", "three")[0] == 0
    assert ask("record", "--end")[0] == 0


def test_what_can_t_be_recorded_is_refused_with_its_option(ask):
    for arguments, said in (
        (("record", "--name", "../etc"), "--name is '../etc'"),
        (("record", "--name", "a", "--end"), "--name a and --end are both given"),
        (("trigger", "--reversal", "--end"), "--end and an event are both given"),
        (("trigger", "--reversal", "--error-m", 1e-6), "--reversal and a level are both given"),
        (("trigger", "--error-m", 1e-6, "--contact-force-n", 1), "error_m and contact_force_n are both given"),
        (("trigger", "--error-m", "nan"), "--error-m is nan"),
        (("trigger", "--error-m", -1), "--error-m is -1"),
        (("trigger", "--reversal", "--before-s", -1), "--before-s is -1"),
        (("trigger", "--count", 3), "--count is of an event that is not given"),
        (("trigger", "--after-s", 3), "--after-s is of an event that is not given"),
        (("trigger", "--end", "--count", 3), "--end and an event are both given"),
        (("trigger", "--reversal", "--before-s", 500), "record.flight_s keeps 30 s; ask for less, or raise it"),
    ):
        code, answer, _ = ask(*arguments)
        assert (code, said in answer["error"]["message"]) == (2, True), answer


def test_an_event_is_waited_for_recorded_and_forgotten(idle, call, ask):
    assert ask("trigger")[:2] == (0, {"command": "trigger", "exit_code": 0, "waits_for": ""})
    code, answer, err = ask("trigger", "--reversal", "--before-s", 0.05, "--after-s", 0.05)
    assert (code, answer["waits_for"]) == (0, "reversal, 1 times")
    assert BANNER in err
    assert call("trigger")[1] == "waits for reversal, 1 times\n"
    assert call("jog", "--distance-m", 1e-3)[0] == 0
    assert call("jog", "--distance-m", -1e-3)[0] == 0
    idle.until(lambda: idle.desk.status().recording.waits_for == "")
    (run,) = idle.until(lambda: list(idle.bench.settings.runs_root.glob("*-service-trigger")))
    idle.until(lambda: read_manifest(run)["record"]["state"] == "closed")
    assert call("trigger", "--error-m", 1e-3, "--count", 3)[1] == "waits for error above 0.001 m, 3 times\n"
    assert call("trigger", "--contact-force-n", 40)[1] == "waits for contact above 40 N, 1 times\n"
    assert call("trigger", "--end")[:2] == (0, "waits for no event\n")


def test_the_log_says_what_was_done_last(idle, call, ask):
    assert call("stop")[0] == 0
    idle.state_is("idle")
    code, answer, err = ask("log", "--lines", 2)
    assert code == 0
    assert BANNER in err
    first, last = answer["entries"]
    assert last["number"] == first["number"] + 1
    code, out, _ = call("log", "--lines", 50)
    assert code == 0
    assert len(out.splitlines()) == 50
    assert "stop            a client asked to stop" in out
    assert ask("log", "--lines", 0)[0] == 2
