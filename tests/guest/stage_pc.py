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
PYTHON = "/opt/stagectl/current/venv/bin/python"
SOCKET = "/run/stagectl/stagectl.socket"
RIG_FOLDER = Path("/run/rig")
HUB = RIG_FOLDER / "can.socket"
UNIT = "stagectl.service"
PATIENCE_S = 180.0  # a start of the servo, emulated
_LEASE_S = 20.0
_ANSWER_S = 20.0
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


def until(what: str, holds: Callable[[], Any], patience_s: float = PATIENCE_S) -> Any:
    """Wait until something is true and return it; Failed after a time."""
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
        time.sleep(0.3)
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
            return until(f"state {' or '.join(wanted)}", reached, patience_s)
        except Failed as error:
            shown = {name: seen.get(name) for name in ("state", "waiting_for", "fault", "remarks")}
            raise Failed(f"{error}; the status says {shown}") from error

    @contextmanager
    def lease(self) -> Iterator[None]:
        """Hold the lease, renewed by a thread; given back at the end, which brings the stage to rest."""
        self._token = self.ask("POST", "/v1/lease", {"holder": "guest-test", "duration_s": _LEASE_S})["token"]
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
        """Send a command and don't wait; returns its key."""
        key = f"guest-{secrets.token_hex(8)}"
        self.ask("POST", f"/v1/{name}", body, **{"Idempotency-Key": key})
        return key

    def do(self, name: str, patience_s: float = PATIENCE_S, **body: Any) -> dict[str, Any]:
        """Send a command and wait for its end; Failed where it failed or was stopped."""
        key = self.begin(name, **body)
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
        self.do("acknowledge", number=fault["number"])
        return fault


# ---- the rig ---------------------------------------------------------------------------------------------------


def start_rig() -> list[subprocess.Popen]:
    """Bring vcan0 up, put the rig's drives on it and its interferometer on the line."""
    shell("ip", "link", "add", "vcan0", "type", "vcan")
    shell("ip", "link", "set", "vcan0", "up")
    RIG_FOLDER.mkdir(exist_ok=True)
    environment = {**os.environ, **GENERIC, "STAGECTL_CACHE": "/var/cache/stagectl", "OPENBLAS_NUM_THREADS": "1"}
    line = RIG_FOLDER / "line"
    rig = [PYTHON, "-m", "sim_backend", str(HERE / "machine.toml"), "--socket", str(HUB), "--pty-link", str(line)]
    log = (RIG_FOLDER / "log").open("w")
    started = [
        subprocess.Popen([*rig, "--seed", "1"], env=environment, stdout=log, stderr=log, cwd="/opt/stagectl/current")
    ]
    until("the rig", lambda: line.exists() and HUB.exists())
    bridge = ["python3", str(HERE / "bridge.py"), str(HUB), "vcan0", str(line), "/dev/ttyS1"]
    started.append(subprocess.Popen(bridge, stdout=log, stderr=log))
    return started


def rig() -> dict[str, Any]:
    """Return the rig's truth: state of the plant, states of the drives."""
    asked = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    asked.settimeout(_ANSWER_S)
    with asked:
        asked.connect(str(HUB))
        asked.send(b"FILT")
        asked.send(b'RIG {"state": true}')
        while not (answer := asked.recv(1 << 16)).startswith(b"RIG "):
            if not answer:
                raise Failed("the rig has ended")
    return json.loads(answer.removeprefix(b"RIG "))
