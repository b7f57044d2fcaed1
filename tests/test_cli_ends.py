"""A process of the command line that is ended: its rig killed, Ctrl-C, a terminal that closes."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from stagectl.record import read_run
from stagectl.requests import Phase
from stagectl.run_scores import read_truth

pytestmark = pytest.mark.real_time


def test_a_rig_that_is_killed_ends_a_jog_with_3(tmp_path):
    command = [sys.executable, "-m", "stagectl.cli", "jog", "--distance-m", "0.1", "--backend", "rig", "--json"]
    process = subprocess.Popen(
        [*command, "--runs", str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    said = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("homing the macro"):  # its first motion
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            (rig,) = [pid for pid in children if b"sim_backend" in Path(f"/proc/{pid}/cmdline").read_bytes()]
            os.kill(int(rig), signal.SIGKILL)
            break
    out, err = process.communicate(timeout=60)
    said = "".join(said) + err
    assert "Traceback" not in said
    assert process.returncode == 3, said
    answer = json.loads(out)
    assert (answer["exit_code"], answer["stop"]) == (3, "LINK_LOST")
    assert not read_run(Path(answer["run"])).truncated


def test_a_rig_whose_command_is_killed_leaves_nothing(tmp_path):
    command = [sys.executable, "-m", "stagectl.cli", "jog", "--distance-m", "0.1", "--backend", "rig"]
    process = subprocess.Popen(
        [*command, "--runs", str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    for line in process.stderr:
        if line.startswith("homing the macro"):
            break
    assert list(tmp_path.glob("stagectl-rig-*/can.socket"))
    process.kill()
    process.communicate()
    give_up_s = time.monotonic() + 60.0
    while list(tmp_path.glob("stagectl-rig-*")) and time.monotonic() < give_up_s:
        time.sleep(0.1)
    assert list(tmp_path.glob("stagectl-rig-*")) == []


def test_an_interrupt_brings_the_stage_to_rest_and_closes_the_run(tmp_path):
    command = [sys.executable, "-m", "stagectl.cli", "run", "--backend", "batch", "--runs", str(tmp_path), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    said = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("moving to"):
            time.sleep(0.3)  # virtual time passes in the other process: it is on its way by now
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGINT)  # impatience changes nothing
            break
    out, err = process.communicate(timeout=60)
    said = "".join(said) + err
    assert process.returncode == 130, said
    answer = json.loads(out)
    assert (answer["exit_code"], answer["error"]["kind"]) == (130, "Interrupted")
    assert answer["run"] in said
    run = read_run(Path(answer["run"]))
    assert not run.truncated
    speed = np.abs(run.rows["setpoint_velocity_m_per_s"])
    assert np.max(speed) > 0.02
    powered = run.rows[run.rows["run_phase"] == int(Phase.STOPPING)]
    assert powered.size
    assert powered["setpoint_velocity_m_per_s"][-1] == 0.0
    truth = read_truth(run.folder)
    at_rest = truth["sequence"] == powered["cycle"][-1]
    assert abs(truth["macro_velocity_m_per_s"][at_rest][0]) < 1e-3


def test_a_closed_terminal_brings_the_stage_to_rest_and_closes_the_run(tmp_path):
    """stdin, stdout and stderr end with the terminal; what would be said there must not end the way to rest."""
    command = [sys.executable, "-m", "stagectl.cli", "run", "--backend", "batch", "--runs", str(tmp_path)]
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, command)
    said = b""
    while b"moving to" not in said:
        said += os.read(terminal, 4096)
    time.sleep(0.3)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 130
    (folder,) = tmp_path.iterdir()
    run = read_run(folder)
    assert not run.truncated
    assert (run.manifest["end"]["stop"], run.manifest["record"]["state"]) == ("OPERATOR", "closed")
    powered = run.rows[run.rows["run_phase"] == int(Phase.STOPPING)]
    assert powered.size
    assert powered["setpoint_velocity_m_per_s"][-1] == 0.0
