"""What the unit waits for after its supervisor is gone, with real processes in place of a control group's list."""

import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.real_time

SCRIPT = Path(__file__).resolve().parents[2] / "deploy" / "await_servo.sh"


def ran(limit_s: int, procs: Path) -> subprocess.CompletedProcess:
    return subprocess.run([SCRIPT, str(limit_s), str(procs)], capture_output=True, text=True)


def test_a_servo_that_ends_by_itself_is_waited_for(tmp_path):
    procs = tmp_path / "cgroup.procs"
    with subprocess.Popen(["sleep", "1.0"]) as servo:
        procs.write_text(f"{servo.pid}\n")
        waiting = subprocess.Popen([SCRIPT, "20", str(procs)], stderr=subprocess.PIPE)
        assert servo.wait() == 0  # by itself; a zombie would still be there for kill -0
        assert waiting.wait(15.0) == 0
        assert waiting.communicate()[1] == b""


def test_a_servo_that_hangs_is_killed(tmp_path):
    procs = tmp_path / "cgroup.procs"
    with subprocess.Popen(["sleep", "60"]) as servo:
        procs.write_text(f"{servo.pid}\n")
        done = ran(1, procs)
        assert servo.wait() == -9
    assert done.returncode == 0
    assert f"killed: {servo.pid}" in done.stderr


def test_nobody_is_waited_for_where_nobody_is_left(tmp_path):
    procs = tmp_path / "cgroup.procs"
    procs.write_text("")
    done = ran(20, procs)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_list_that_can_not_be_read_is_said_and_no_reason_to_fail(tmp_path):
    done = ran(20, tmp_path / "absent")
    assert done.returncode == 0
    assert "can't be read" in done.stderr
