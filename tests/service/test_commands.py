"""The command line through a service: the same words, one stage, and who holds the lease."""

import io
import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
import tty

import pytest

from stagectl import cli
from stagectl.commands.jog_keys import FIRST_HOLD_S, NEXT_HOLD_S, Hand, let_go_meanwhile
from tests.service.daemon import servo_pid

pytestmark = pytest.mark.real_time

_MOTIONS = ("move", "jog", "scan", "follow", "stream")
RIGHT, LEFT, UP = b"\x1b[C", b"\x1b[D", b"\x1b[A"


@pytest.fixture
def call(idle, capsys, monkeypatch):
    """Run a command with --json against the daemon: (exit code, the object); after a hiccup of the host once more."""
    monkeypatch.setenv("STAGECTL_SOCKET", str(idle.socket))

    def once(*arguments):
        capsys.readouterr()
        code = cli.main([*map(str, arguments), "--json"])
        return code, json.loads(capsys.readouterr().out)

    def run(*arguments):
        found = once(*arguments)
        if arguments[0] not in _MOTIONS or found[0] == 0 or not idle.recovers():
            return found
        if arguments[0] == "stream":
            sys.stdin.seek(0)
        return once(*arguments)

    return run


def test_commands_move_the_service_s_stage_and_leave_it_without_power(idle, call):
    code, answer = call("move", "--target-m", 0.03)
    assert (code, answer["finished"], answer["stop"]) == (0, True, "FINISHED")
    assert answer["banner"].startswith("SOFTWARE RIG")
    assert answer["end_position_m"] == pytest.approx(0.03, abs=1e-4)
    code, answer = call("jog", "--distance-m", -0.01)
    assert code == 0
    assert answer["end_position_m"] == pytest.approx(0.02, abs=1e-3)  # it was without power in between
    idle.state_is("idle")
    code, answer = call("status")
    assert (code, answer["state"], answer["homed"], answer["fault"]) == (0, "idle", True, None)
    assert answer["limits"]["travel_m"] == [-0.15, 0.15]


def test_what_can_t_be_is_refused_with_its_place_and_remedy(call):
    code, answer = call("move", "--target-m", 3.0)
    assert code == 2
    assert "target_m is 3: the travel of" in answer["error"]["message"]
    code, answer = call("move", "--target-m", "nan")
    assert code == 2
    assert "--target-m is nan" in answer["error"]["message"]
    code, answer = call("jog", "--distance-m", 0.01, "--profile", "kang-2023")
    assert code == 2
    assert "the service has" in answer["error"]["message"]
    code, answer = call("home", "--backend", "hardware")
    assert code == 2
    assert "change that with `stagectl backend`" in answer["error"]["message"]
    code, answer = call("jog", "--keys")
    assert code == 2
    assert "needs a terminal" in answer["error"]["message"]


def test_scans_tables_and_streams_go_through_the_service(call, tmp_path, monkeypatch):
    program = tmp_path / "raster.toml"
    program.write_text(
        "repeat_count = 2\nstart_m = 0\n[[segments]]\ntarget_m = 0.002\n[[segments]]\ntarget_m = 0.001\n"
    )
    code, answer = call("scan", program)
    assert (code, answer["stop"]) == (0, "FINISHED")
    assert answer["end_position_m"] == pytest.approx(0.001, abs=3e-4)
    table = tmp_path / "motion.csv"
    table.write_text("t_s,position_m\n0,0.001\n0.5,0.0015\n1,0.002\n")
    code, answer = call("follow", table)
    assert (code, answer["stop"]) == (0, "FINISHED")
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join("0.002" for _ in range(50))))
    code, answer = call("stream", "--period-s", 0.02)
    assert (code, answer["stop"]) == (0, "FINISHED")


def test_what_is_no_program_is_refused_with_its_place(call, tmp_path, monkeypatch):
    file = tmp_path / "wrong"
    for command, text, said in (
        ("scan", "repeat_count = 1", "segments"),
        ("scan", "[[segments]]\ntarget_mm = 3", "segments.0.target_m"),
        ("scan", "[[segments", "give a readable TOML file"),
        ("scan", "[[segments]]\ntarget_m = 3.0", "segments.0.target_m is 3: the travel of"),
        ("follow", "t,x\n0,1", "it must be 't_s,position_m'"),
        ("follow", "t_s,position_m\n0,0\n1,100", "are these millimetres?"),
    ):
        file.write_text(text)
        code, answer = call(command, file)
        assert (code, said in answer["error"]["message"]) == (2, True), answer
    monkeypatch.setattr("sys.stdin", io.StringIO("x"))
    code, answer = call("stream")
    assert (code, "line 1 is 'x'" in answer["error"]["message"]) == (2, True)


def test_a_lease_that_somebody_holds_is_worked_under_or_respected(idle, call):
    with idle.client.lease("anna") as taken:
        code, answer = call("lease")
        assert (code, answer["lease"]["holder"]) == (0, "anna")
        code, answer = call("move", "--target-m", 0.0)
        assert code == 2
        assert "anna holds the lease" in answer["error"]["message"]
        code, answer = call("move", "--target-m", 0.0, "--lease", taken.token)
        assert (code, answer["state"]) == (0, "armed")
        code, answer = call("stop")
        assert (code, answer["state"]) == (0, "idle")


def test_the_rest_says_what_it_found(call):
    code, answer = call("fault")
    assert (code, answer["fault"]) == (0, None)
    code, answer = call("backend")
    assert (code, answer["backend"]) == (0, "rig")
    code, answer = call("backend", "rig")
    assert (code, answer["backend"]) == (0, "rig")
    code, answer = call("log", "--lines", 5)
    assert code == 0
    assert len(answer["entries"]) == 5


@pytest.mark.parametrize("command", ["status", "stop", "fault", "lease", "backend", "log", "record", "trigger"])
def test_every_command_says_which_world_it_is(idle, capsys, monkeypatch, command):
    monkeypatch.setenv("STAGECTL_SOCKET", str(idle.socket))
    assert cli.main([command]) == 0
    said = capsys.readouterr()
    assert "SOFTWARE RIG: nothing real moves" in said.out + said.err


def test_a_run_and_an_event_are_recorded_by_command(call):
    code, answer = call("record", "--name", "warm-up")
    assert (code, answer["recording"]["trigger"]) == (0, "request")
    assert "warm-up" in answer["recording"]["run"]
    code, answer = call("record", "--end")
    assert (code, answer["recording"]["run"]) == (0, "")
    for _ in range(2):  # the second time nothing changes
        code, answer = call("trigger", "--reversal", "--count", 2)
        assert (code, answer["waits_for"]) == (0, "reversal, 2 times")
    code, answer = call("trigger", "--end")
    assert (code, answer["waits_for"]) == (0, "")


def test_without_a_service_there_is_nothing_to_ask(call, monkeypatch, tmp_path):
    monkeypatch.setenv("STAGECTL_SOCKET", str(tmp_path / "none"))
    for command in (["status"], ["stop"], ["fault"], ["lease"], ["backend"], ["log"], ["watch"]):
        code, answer = call(*command)
        assert code == 3
        assert "is `stagectl serve` running?" in answer["error"]["message"]


@pytest.mark.parametrize("named", [["--socket", "none"], ["--lease", "abc"]])
@pytest.mark.parametrize(
    "command", [["move", "--target-m", "0.01"], ["jog", "--distance-m", "0.01"], ["home"], ["identify"]]
)
def test_what_was_meant_for_a_service_that_is_gone_moves_nothing_else(named, command, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("STAGECTL_SOCKET", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert cli.main([*command, *named, "--runs", str(tmp_path / "runs"), "--json"]) == 3
    assert "no service answers at" in capsys.readouterr().out
    assert not (tmp_path / "runs").exists()


def keys_jog(idle, *more):
    """Start `jog --keys` at a terminal of its own: (the terminal's other end, the process)."""
    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "stagectl.cli", "jog", "--keys", "--velocity-m-per-s", "0.02", *more]
    jogging = subprocess.Popen(
        [*command, "--socket", str(idle.socket)], stdin=follower, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    os.close(follower)
    return leader, jogging


def end(leader, jogging):
    jogging.kill()
    jogging.communicate()
    os.close(leader)


def armed_keys_jog(idle):
    """Start it, and wait for the stage to hold; after a hiccup of the host once more."""
    leader, jogging = keys_jog(idle)
    if idle.state_is("armed", "fault") and idle.recovers():
        end(leader, jogging)
        leader, jogging = keys_jog(idle)
    try:
        idle.state_is("armed")
    except AssertionError:
        end(leader, jogging)
        raise
    return leader, jogging


def test_keys_jog_while_they_are_held(idle):
    before_m = idle.plant["macro_position_m"]
    leader, jogging = armed_keys_jog(idle)
    try:
        until_s = time.monotonic() + 1.5
        while time.monotonic() < until_s:
            os.write(leader, LEFT)
            time.sleep(0.05)
        idle.state_is("armed")  # let go of: the jog is over, and the stage holds
        moved_m = idle.plant["macro_position_m"] - before_m
        os.write(leader, b"q")
        assert jogging.wait(30.0) == 0, jogging.stderr.read()
    finally:
        end(leader, jogging)
    assert -0.06 < moved_m < -0.01


def test_keys_end_with_the_fault_that_takes_the_stage_away(idle):
    """No key is held: by keys alone nobody would hear of it, and q was a success."""
    leader, jogging = armed_keys_jog(idle)
    try:
        os.kill(servo_pid(idle), signal.SIGKILL)
        assert jogging.wait(30.0) == 3
    finally:
        end(leader, jogging)
    idle.state_is("fault")
    idle.recovers()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--profile", "kang-2023"], "--profile kang-2023: the service has"),
        (["--profile", "oled-printer"], "--profile oled-printer: the service has"),
        (["--backend", "hardware"], "--backend hardware: the service has rig"),
        (["--velocity-m-per-s", "nan"], "Invalid value for '--velocity-m-per-s'"),
        (["--in-place"], "not --in-place or --law"),
        (["--law", "pid"], "not --in-place or --law"),
    ],
)
def test_keys_of_another_stage_give_this_one_no_power(idle, more, said):
    before = [entry.event for entry in idle.client.log(limit=1000)]
    leader, jogging = keys_jog(idle, *more)
    try:
        assert jogging.wait(30.0) == 2
        assert said in " ".join(jogging.stderr.read().decode().split())
    finally:
        end(leader, jogging)
    after = [entry.event for entry in idle.client.log(limit=1000)]
    assert [event for event in after if not event.startswith("lease")] == [
        event for event in before if not event.startswith("lease")
    ]


def test_keys_end_where_somebody_stops_the_stage(idle):
    leader, jogging = armed_keys_jog(idle)
    try:
        stopped, until_s = False, time.monotonic() + 30.0
        while jogging.poll() is None and time.monotonic() < until_s:
            os.write(leader, LEFT)
            time.sleep(0.05)
            if not stopped and idle.client.status().state == "moving":
                idle.client.stop()
                stopped = True
        assert (stopped, jogging.poll()) == (True, 1)
        assert "RequestError" not in jogging.stderr.read().decode()
    finally:
        end(leader, jogging)
    idle.state_is("idle")


def test_a_held_key_ends_with_the_fault_that_takes_the_stage_away(idle):
    leader, jogging = armed_keys_jog(idle)
    try:
        until_s = time.monotonic() + 30.0
        killed = False
        while jogging.poll() is None and time.monotonic() < until_s:
            os.write(leader, LEFT)
            time.sleep(0.05)
            if not killed and idle.client.status().state == "moving":
                os.kill(servo_pid(idle), signal.SIGKILL)
                killed = True
        assert (killed, jogging.poll()) == (True, 3), jogging.stderr.read()
    finally:
        end(leader, jogging)
    idle.state_is("fault")
    idle.recovers()


def test_what_was_typed_while_a_request_was_under_way_is_held_no_more():
    """Taken for keys held now, repeats of a key let go of 0.5 s before set the stage off for another 0.6 s."""
    hand = Hand(0.01, 0.03)
    leader, follower = pty.openpty()
    try:
        tty.setcbreak(follower)
        os.write(leader, RIGHT * 30 + UP + RIGHT)
        let_go_meanwhile(hand, follower)
        assert not select.select([follower], [], [], 0.0)[0]
        assert hand.wanted_m_per_s(time.monotonic()) == 0.0
        assert (hand.speed_m_per_s, hand.leaves) == (0.02, False)
        os.write(leader, RIGHT + b"q")
        let_go_meanwhile(hand, follower)
        assert hand.leaves
    finally:
        os.close(leader)
        os.close(follower)


def test_a_hand_holds_goes_on_turns_and_lets_go():
    hand = Hand(0.01, 0.03)
    assert hand.wanted_m_per_s(0.0) == 0.0
    hand.press(RIGHT, 0.0)
    assert hand.wanted_m_per_s(FIRST_HOLD_S - 1e-6) == 0.01
    assert hand.wanted_m_per_s(FIRST_HOLD_S) == 0.0
    hand.press(RIGHT, 0.5)
    hand.press(RIGHT, 0.55)
    assert hand.wanted_m_per_s(0.55 + NEXT_HOLD_S - 1e-6) == 0.01
    assert hand.wanted_m_per_s(0.55 + NEXT_HOLD_S) == 0.0
    hand.press(LEFT, 0.6)
    assert hand.wanted_m_per_s(0.6) == -0.01
    hand.press(UP, 0.6)
    assert hand.wanted_m_per_s(0.6) == -0.02
    hand.press(UP + UP, 0.6)
    assert hand.wanted_m_per_s(0.6) == -0.03
    hand.press(b" ", 0.6)
    assert hand.wanted_m_per_s(0.6) == 0.0
    assert not hand.leaves
    hand.press(RIGHT + b"q", 0.7)
    assert hand.leaves
    assert hand.wanted_m_per_s(0.7) == 0.0
