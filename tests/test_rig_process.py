"""The rig as a process of its own: ready line, SDO over the hub, lines on the pty, faults on request, its end."""

import contextlib
import errno
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

from sim_backend.machine import load_machine

pytestmark = pytest.mark.real_time

START_LIMIT_S = 120.0  # compiles on the first run of these sources


class Process:
    """A started rig; every wait has a limit."""

    def __init__(self, folder, *options: str) -> None:
        self.socket_path = folder / "bus"
        self.pty_link = folder / "interferometer"
        command = [sys.executable, "-m", "sim_backend", "oled-printer", "--socket", str(self.socket_path)]
        self.child = subprocess.Popen(
            [*command, "--pty-link", str(self.pty_link), "--seed", "3", *options], stdout=subprocess.PIPE, text=True
        )
        assert self.child.stdout is not None
        readable, _, _ = select.select([self.child.stdout], [], [], START_LIMIT_S)
        assert readable, "the rig did not get ready"
        self.ready = json.loads(self.child.stdout.readline())

    def connect(self) -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link.connect(str(self.socket_path))
        link.settimeout(5.0)
        return link

    def ask(self, request: dict) -> dict:
        with self.connect() as link:
            link.send(b"FILT")  # no frames, answers only
            link.send(b"RIG " + json.dumps(request).encode())
            answer = link.recv(65536)
        assert answer.startswith(b"RIG ")
        return json.loads(answer[4:])

    def end(self) -> None:
        if self.child.poll() is None:
            self.child.kill()
        self.child.wait(10.0)
        if self.child.stdout is not None:
            self.child.stdout.close()


@pytest.fixture
def start(tmp_path):
    processes: list[Process] = []

    def make(*options: str) -> Process:
        processes.append(Process(tmp_path, *options))
        return processes[-1]

    yield make
    for process in processes:
        process.end()


def read_some(path, count: int, limit_s: float = 5.0) -> bytes:
    """Read `count` bytes of the port."""
    data = b""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        while len(data) < count:
            readable, _, _ = select.select([descriptor], [], [], limit_s)
            assert readable, "no line came"
            data += os.read(descriptor, 4096)
    finally:
        os.close(descriptor)
    return data


def test_it_serves_answers_and_ends(start, tmp_path):
    truth_path = tmp_path / "truth.npz"
    rig = start("--truth", str(truth_path))
    assert rig.ready["ready"] is True
    assert rig.ready["vendor_id"] == 0x5254
    assert rig.ready["pty"] == str(rig.pty_link)

    with rig.connect() as link:  # SDO: vendor id of node 1
        link.send(b"FILT" + struct.pack("=II", 0x581, 0x7FF))
        link.send(struct.pack("=IB3x8s", 0x601, 8, bytes.fromhex("4018100100000000")))
        assert link.recv(64) == struct.pack("=IB3x8s", 0x581, 8, bytes.fromhex("4318100154520000"))

    with rig.connect() as link:  # NMT start, then SYNC: event-driven and synchronous process data
        link.send(b"FILT" + struct.pack("=II", 0x181, 0x7FF))
        link.send(struct.pack("=IB3x8s", 0x000, 2, b"\x01\x00"))
        assert struct.unpack("=IB3x8s", link.recv(64))[:2] == (0x181, 2)

    data = read_some(rig.pty_link, 500)
    begin = data.index(b"\xa5\x5a")
    first, second = data[begin : begin + 25], data[begin + 25 : begin + 50]
    assert second[:2] == b"\xa5\x5a"
    assert int.from_bytes(second[2:6], "little") == int.from_bytes(first[2:6], "little") + 1

    state = rig.ask({"state": True})
    assert abs(state["plant"]["macro_position_m"]) < 0.1
    assert state["drives"] == {"1": "SWITCH_ON_DISABLED", "2": "SWITCH_ON_DISABLED"}
    assert "choose from" in rig.ask({"fault": {"kind": "earthquake"}})["error"]

    rig.child.send_signal(signal.SIGINT)  # Ctrl-C is for the controller
    assert rig.ask({"truth": str(tmp_path / "now.npz")})["rows_count"] > 0
    rig.child.send_signal(signal.SIGTERM)
    assert rig.child.wait(10.0) == 0
    assert not rig.socket_path.exists()
    assert not rig.pty_link.is_symlink()
    with np.load(truth_path) as truth:
        assert np.all(np.diff(truth["t_ns"]) > 0)
        assert abs(np.diff(truth["t_ns"]).mean() - 999_980.0) < 1.0
        assert len(truth["end_mean_position_m"]) == len(truth["t_ns"]) > 20


def test_the_drivers_open_it(start):
    from drivers import can_bus, canopen_master

    rig = start()
    machine = load_machine("oled-printer")
    master = canopen_master.Master(can_bus.open_network("hub", str(rig.socket_path)))
    try:
        master.add_node(1, machine.eds_path("macro"))
        assert master.identity(1) == (0x5254, 0x10001, 0x10000, 1)
        master.write(1, 0x1017, 0, 20)
        limit_s = time.monotonic() + 5.0
        while master.heartbeat_age_s(1) > 0.1:
            assert time.monotonic() < limit_s
    finally:
        master.close()


def hangs_up(descriptor: int) -> bool:
    """Read once; tell whether the other end is gone (I/O error or end of file, by kernel)."""
    select.select([descriptor], [], [], 1.0)
    try:
        return not os.read(descriptor, 4096)
    except BlockingIOError:
        return False
    except OSError as error:
        return error.errno == errno.EIO


def test_an_unplugged_port_is_an_error_for_its_reader_and_comes_back(start):
    rig = start()
    descriptor = os.open(rig.pty_link, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    assert "error" not in rig.ask({"fault": {"kind": "unplug", "duration_s": 0.3}})
    limit_s = time.monotonic() + 5.0
    while not hangs_up(descriptor):
        assert time.monotonic() < limit_s
    os.close(descriptor)
    while not rig.pty_link.exists():
        assert time.monotonic() < limit_s
    assert len(read_some(rig.pty_link, 50)) >= 50


def test_it_ends_with_its_parent(tmp_path):
    code = (
        "import subprocess, sys; p = subprocess.Popen([sys.executable, '-m', 'sim_backend', 'oled-printer', "
        f"'--socket', {str(tmp_path / 'bus')!r}], stdout=subprocess.PIPE); "
        "p.stdout.readline(); print(p.pid, flush=True)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=START_LIMIT_S, check=True
    )
    pid = int(done.stdout)
    limit_s = time.monotonic() + 10.0
    while True:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            break
        with contextlib.suppress(FileNotFoundError), open(f"/proc/{pid}/stat", encoding="ascii") as file:
            if file.read().split()[2] == "Z":
                break
        assert time.monotonic() < limit_s, "the rig outlived its parent"


def test_it_removes_the_folder_of_a_parent_that_is_gone_before_it_is_ready(tmp_path):
    folder = tmp_path / "own"
    folder.mkdir()
    command = [sys.executable, "-m", "sim_backend", "oled-printer", "--socket", str(folder / "bus")]
    process = subprocess.Popen([*command, "--own-folder", str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()  # as by the end of the parent
    assert process.wait(START_LIMIT_S) == 0, process.stderr.read()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert not folder.exists()


def test_a_wrong_machine_is_said_in_the_ready_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "sim_backend", "no-such-machine", "--socket", str(tmp_path / "bus")],
        capture_output=True,
        text=True,
        timeout=START_LIMIT_S,
        check=False,
    )
    answer = json.loads(done.stdout)
    assert done.returncode == 2
    assert answer["ready"] is False
    assert "no-such-machine" in answer["error"]
