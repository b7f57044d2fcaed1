"""The stage PC as the checks see it: commands, the unit, /proc, the service's API over its socket, and the rig's truth.

Python's own library only: it runs before anything is installed, and again after everything is gone.
"""

import http.client
import json
import os
import secrets
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SOCKET = "/run/stagectl/stagectl.socket"
RIG_FOLDER = Path("/run/rig")
HUB = RIG_FOLDER / "can.socket"
UART = "/dev/virtio-ports/interferometer"
UNIT = "stagectl.service"
PORT = "/dev/stagectl/LASER001-if00"
PATIENCE_S = 600.0  # a start of service and servo, emulated on a host that is busy
_LEASE_S = 20.0
_ANSWER_S = 60.0
_REST_S = 30.0
POWERED = {"OPERATION_ENABLED", "QUICK_STOP_ACTIVE", "FAULT_REACTION_ACTIVE"}  # states of a drive
# Compiled for every x86-64.
GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}


class Failed(Exception):
    """Something that a check rests on did not happen; says what."""


class Report:
    """Prints a line for each check, and remembers what failed."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self.count = 0
        self._began_s = time.monotonic()

    def say(self, text: str) -> None:
        """Print a line with the time since the beginning."""
        print(f"{time.monotonic() - self._began_s:6.1f} s  {text}", flush=True)

    def check(self, what: str, holds: object, found: object = "") -> bool:
        """Print what was looked at and what was found."""
        self.count += 1
        self.say(f"{'ok    ' if holds else 'FAILED'}  {what}{f': {found}' if found not in ('', [], None) else ''}")
        if not holds:
            self.failed.append(what)
        return bool(holds)


def shell(*command: str, **options: Any) -> str:
    """Run a command; its output, or Failed with it."""
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, **options)
    if done.returncode != 0:
        raise Failed(f"{' '.join(command)}: exit code {done.returncode}: {done.stdout}{done.stderr}")
    return done.stdout


def until(what: str, holds: Callable[[], Any], patience_s: float = PATIENCE_S, period_s: float = 0.3) -> Any:
    """Wait until something is true and return it; Failed after a time. Asking costs the guest's CPU: not too often."""
    give_up_s = time.monotonic() + patience_s
    seen = None
    while time.monotonic() < give_up_s:
        try:
            seen = holds()
        except (OSError, Failed) as error:
            seen = error
        else:
            if seen:
                return seen
        time.sleep(period_s)
    raise Failed(f"{what}: not within {patience_s:g} s; at last {seen}")


def unit(name: str) -> str:
    """Return one property of the unit."""
    return shell("systemctl", "show", "-P", name, UNIT).strip()


def pids(part: str) -> list[int]:
    """Return the processes of the service's user whose command line holds this."""
    found = subprocess.run(["pgrep", "-u", "stagectl", "-f", part], capture_output=True, text=True)
    return [int(line) for line in found.stdout.split()]


def servo_pid() -> int:
    """Return the servo's process; Failed where there is none."""
    found = pids("stagectl.servo_process")
    if len(found) != 1:
        raise Failed(f"{len(found)} servo processes")
    return found[0]


# ---- the service's API -----------------------------------------------------------------------------------------


class _UnixConnection(http.client.HTTPConnection):
    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(SOCKET)


class Stage:
    """The stage through its API."""

    def __init__(self) -> None:
        self._token = ""

    def ask(self, method: str, path: str, body: dict | None = None, **headers: str) -> Any:
        """Send one request; its answer, or Failed with what the service refused."""
        connection = _UnixConnection("stagectl", timeout=_ANSWER_S)
        if self._token:
            headers["Stagectl-Lease"] = self._token
        try:
            text = None if body is None else json.dumps(body)
            connection.request(method, path, text, {"Content-Type": "application/json", **headers})
            answer = connection.getresponse()
            content = answer.read().decode()
        finally:
            connection.close()
        if answer.status >= 300:
            raise Failed(f"{method} {path}: {answer.status}: {content}")
        return json.loads(content) if content.startswith(("{", "[")) else content

    @property
    def token(self) -> str:
        """The lease's that is held, empty without one: for a command that works under it."""
        return self._token

    def status(self) -> dict[str, Any]:
        """Return where things stand."""
        return self.ask("GET", "/v1/status")

    def await_state(self, *wanted: str, patience_s: float = PATIENCE_S) -> dict[str, Any]:
        """Wait for one of some states; Failed with what it is instead."""
        seen: dict[str, Any] = {}

        def reached() -> dict[str, Any] | None:
            seen.update(self.status())
            return seen if seen["state"] in wanted else None

        try:
            return until(f"state {' or '.join(wanted)}", reached, patience_s, 1.0)
        except Failed as error:
            shown = {name: seen.get(name) for name in ("state", "waiting_for", "fault", "remarks")}
            raise Failed(f"{error}; the status says {shown}") from error

    @contextmanager
    def lease(self) -> Iterator[None]:
        """Hold the lease, renewed by a thread; given back at the end, which brings the stage to rest."""
        wanted = {"holder": "guest-test", "duration_s": _LEASE_S}
        # One that was given back is free a second later.
        self._token = until("the lease", lambda: self.ask("POST", "/v1/lease", wanted))["token"]
        over = threading.Event()
        renewing = threading.Thread(target=self._renew, args=(over,), daemon=True)
        renewing.start()
        try:
            yield
        finally:
            over.set()
            renewing.join()
            with suppress(OSError, Failed):  # over with the service that was killed
                self.ask("DELETE", "/v1/lease")
            self._token = ""

    def _renew(self, over: threading.Event) -> None:
        while not over.wait(_LEASE_S / 5):
            try:
                self.ask("PUT", "/v1/lease")
            except (OSError, Failed):
                continue

    def begin(self, name: str, **body: Any) -> str:
        """Send a command and don't wait for its end; returns its key. A stage that comes to rest is waited for."""
        keys: list[str] = []

        def taken() -> Any:
            keys.append(f"guest-{secrets.token_hex(8)}")
            return self.ask("POST", f"/v1/{name}", body, **{"Idempotency-Key": keys[-1]})

        until(f"{name} is taken", taken, _REST_S)
        return keys[-1]

    def do(self, name: str, patience_s: float = PATIENCE_S, **body: Any) -> dict[str, Any]:
        """Send a command and wait for its end; Failed where it failed or was stopped."""
        return self.finish(name, self.begin(name, **body), patience_s)

    def finish(self, name: str, key: str, patience_s: float = PATIENCE_S) -> dict[str, Any]:
        """Wait for the end of a command that was begun; Failed where it failed or was stopped."""
        done = until(f"end of {name}", lambda: self._ended(key), patience_s)
        if done["state"] == "failed" or done["stop"] not in ("", "FINISHED"):
            raise Failed(f"{name}: {done['stop'] or done['error']}: {done['text']}: {self.status()['fault']}")
        return done

    def _ended(self, key: str) -> dict[str, Any] | None:
        found = self.ask("GET", f"/v1/commands/{key}?wait_s=5")
        return found if found["state"] in ("done", "failed") else None

    def acknowledge(self) -> dict[str, Any]:
        """Take note of the fault; returns it. Failed where there is none."""
        fault = self.status()["fault"]
        if fault is None:
            raise Failed("there is no fault to acknowledge")
        with self.lease():
            self.do("acknowledge", number=fault["number"])
        return fault


# ---- the rig ---------------------------------------------------------------------------------------------------


class Rig:
    """The stage's hardware: the rig's drives on vcan0 as soon as that is there, its interferometer on the adapter."""

    def __init__(self) -> None:
        self._log = RIG_FOLDER / "log"
        self._process: subprocess.Popen | None = None

    def start(self, release: Path) -> None:
        """Start the rig of a release, in the background."""
        RIG_FOLDER.mkdir()
        cache = RIG_FOLDER / "cache"
        bring_cache(cache)
        environment = {**os.environ, **GENERIC, "STAGECTL_CACHE": str(cache), "OPENBLAS_NUM_THREADS": "1"}
        # On the servo's CPU, the last, below its priority: the other one has the service to start.
        command = [
            "taskset",
            "-c",
            str((os.cpu_count() or 1) - 1),
            str(release / "venv/bin/python"),
            "-m",
            "sim_backend",
        ]
        command += [str(HERE / "machine.toml"), "--seed", "1", "--socket", str(HUB), "--can", "vcan0", "--uart", UART]
        with self._log.open("a") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, cwd=release)

    def connect(self) -> None:
        """Bring vcan0 up, with the drives on it."""
        until("the rig", HUB.exists)
        shell("ip", "link", "add", "vcan0", "type", "vcan")
        shell("ip", "link", "set", "vcan0", "up")

    def stop(self) -> None:
        """End it, and take vcan0 away."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
        if os.path.exists("/sys/class/net/vcan0"):
            shell("ip", "link", "delete", "vcan0")

    def said(self) -> str:
        """Return the end of what its processes wrote."""
        return self._log.read_text()[-3000:] if self._log.exists() else ""

    def state(self) -> dict[str, Any]:
        """Return the truth: state of the plant, states of the drives."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as asked:
            asked.settimeout(_ANSWER_S)
            asked.connect(str(HUB))
            asked.send(b"FILT")
            asked.send(b'RIG {"state": true}')
            while not (answer := asked.recv(1 << 16)).startswith(b"RIG "):
                if not answer:
                    raise Failed("the rig has ended")
        return json.loads(answer.removeprefix(b"RIG "))

    def speed_m_per_s(self) -> float:
        """Return how fast the macro really is."""
        return abs(self.state()["plant"]["macro_velocity_m_per_s"])

    def end_m(self) -> float:
        """Return where the end really is."""
        return self.state()["plant"]["end_position_m"]


def bring_cache(folder: Path) -> None:
    """Unpack the code that was compiled with the image; without it everything is compiled anew, emulated."""
    folder.mkdir(exist_ok=True)
    shell("tar", "-xf", "/srv/cache.tar", "-C", str(folder))


report = Report()
check = report.check
stage = Stage()
rig = Rig()
