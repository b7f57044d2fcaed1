"""A service in a process of its own, on the software rig, with everything that it leaves below one folder."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from stagectl.backend import ask_rig
from stagectl.client import Client
from stagectl.errors import LinkError
from stagectl.profile import PROFILES_FOLDER
from tests.toml_text import changed

PATIENCE_S = 90.0
_HICCUPS = 3
REST_M_PER_S = 1e-3
PATIENT = {  # limits that a busy test host does not pass
    "trip.sensor_age_s": 0.3,
    "trip.overrun_s": 0.3,
    "trip.rpdo_deadline_s": 0.1,
    "trip.heartbeat_s": 2.0,
    "trip.lease_s": 3.0,
}


IN_VIRTUAL_TIME = """
import sys
from pathlib import Path
from stagectl.service.daemon import serve
from stagectl.service.stage_state import Settings

profile, socket, state, runs = sys.argv[1:]
sys.setswitchinterval(2e-4)  # its stage never waits: 5 ms are lost whenever the thread that answers wants to go on
serve(Settings(profile, "batch", Path(runs), Path(state)), Path(socket), None)
"""


class Daemon:
    """A service of its own, with everything that it leaves below one folder.

    In virtual time no host can starve its servo; it works as fast as it can.
    """

    def __init__(
        self,
        folder: Path,
        changes: dict = PATIENT,
        runs: Path | None = None,
        profile: str = "single-axis",
        in_virtual_time: bool = False,
    ):
        self.folder = folder
        self._in_virtual_time = in_virtual_time
        (folder / "tmp").mkdir(parents=True)
        self.profile = folder / "patient.toml"
        self.profile.write_text(changed(PROFILES_FOLDER / f"{profile}.toml", changes))
        self.socket = folder / "stage.socket"
        self.state = folder / "state"
        self.runs = folder / "runs" if runs is None else runs
        self.notes = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.notes.bind(str(folder / "notify"))
        self.err = open(folder / "err", "w+")  # noqa: SIM115
        self.start()
        self.client = Client(self.socket)

    def start(self):
        """Start the service, as systemd does, and does again."""
        socket, state, runs = str(self.socket), str(self.state), str(self.runs)
        if self._in_virtual_time:
            command = [sys.executable, "-c", IN_VIRTUAL_TIME, str(self.profile), socket, state, runs]
        else:
            command = [sys.executable, "-m", "stagectl.cli", "serve", str(self.profile), "--backend", "rig"]
            command += ["--tcp", "0", "--socket", socket, "--state", state, "--runs", runs]
        self.process = subprocess.Popen(
            command,
            stderr=self.err,
            stdout=subprocess.DEVNULL,
            env={
                **os.environ,
                "TMPDIR": str(self.folder / "tmp"),
                "NOTIFY_SOCKET": str(self.folder / "notify"),
                "WATCHDOG_USEC": "1000000",
            },
        )

    def until(self, done, what):
        """Ask again and again; fails after a while."""
        give_up_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < give_up_s:
            try:
                if found := done():
                    return found
            except LinkError:
                assert self.process.poll() is None, (self.folder / "err").read_text()
            time.sleep(0.05)
        raise AssertionError(f"{what}: {(self.folder / 'err').read_text()[-2000:]}")

    def state_is(self, *states):
        return self.until(lambda: self.client.status().state in states, f"state {states}")

    def recovers(self):
        """Acknowledge the fault that there is, and tell whether there was one.

        A test host that starves the servo for more than 20 cycles has the rig's drives miss SYNC and say so (EMCY
        0x8700), patient profile or not: 20 periods are theirs. What an idle drive said refuses the next arming, until
        somebody acknowledges it. That is the product's rule, and the demo's: acknowledge, arm again, repeat once.
        """
        fault = self.client.fault()
        if fault is None:
            return False
        self.until(lambda: self.client.lease_token or self.client.lease_state() is None, "a free lease")
        held = contextlib.nullcontext() if self.client.lease_token else self.client.lease("after a hiccup")
        with held:
            self.client.acknowledge(fault.number)
        self.state_is("idle")
        self.until(lambda: self.client.lease_token or self.client.lease_state() is None, "a free lease")
        return True

    def finishes(self, motion):
        """Ask for a motion until it ends as it should; a drive's emergency that a hiccup made gets it another try."""
        for _ in range(_HICCUPS):
            stop = motion().stop
            if stop == "FINISHED":
                return
            assert stop == "EMERGENCY", stop
            assert self.recovers()
        raise AssertionError(f"{_HICCUPS} emergencies in a row: {(self.folder / 'err').read_text()[-2000:]}")

    @property
    def plant(self):
        """What is true of the stage now."""
        (channel,) = (self.folder / "tmp").glob("stagectl-rig-*/can.socket")
        return ask_rig(str(channel), {"state": True})["plant"]

    @property
    def tcp_port(self):
        for line in (self.folder / "err").read_text().splitlines():
            entry = json.loads(line)
            if entry["event"] == "listening" and entry["text"].startswith("127.0.0.1:"):
                return int(entry["text"].split(":")[1].split(",")[0])
        raise AssertionError("no port")

    def heard(self):
        """Return what was said to systemd since the last call."""
        said = []
        while True:
            try:
                said.append(self.notes.recv(4096).decode())
            except BlockingIOError:
                return said

    def end(self):
        self.client.close()
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(30.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self.notes.close()
        self.err.close()


def at_rest(daemon: Daemon) -> Iterator[Daemon]:
    """Have it without power before a test, and behind it."""
    daemon.recovers()
    yield daemon
    daemon.until(lambda: daemon.client.status().state in ("idle", "fault", "off"), "rest")
    daemon.recovers()
    daemon.state_is("idle")
    daemon.until(lambda: daemon.client.lease_state() is None, "a free lease")


def servo_pid(daemon: Daemon) -> int:
    """Find the servo among the daemon's children."""
    pid = daemon.process.pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        if b"stagectl.servo_process" in Path(f"/proc/{child}/cmdline").read_bytes():
            return int(child)
    raise AssertionError("no servo")
