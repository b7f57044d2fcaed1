"""The stage PC as the checks see it: commands, the unit, and the service's API over its socket.

Python's own library only: it runs before anything is installed, and again after everything is gone.
"""

import http.client
import json
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SOCKET = "/run/stagectl/stagectl.socket"
UNIT = "stagectl.service"
PATIENCE_S = 180.0  # a start of the service, emulated
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


# ---- the service's API -----------------------------------------------------------------------------------------


class _UnixConnection(http.client.HTTPConnection):
    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(SOCKET)


class Stage:
    """The stage through its API."""

    def ask(self, method: str, path: str, body: dict | None = None, **headers: str) -> Any:
        """Send one request; its answer, or Failed with what the service refused."""
        connection = _UnixConnection("stagectl", timeout=_ANSWER_S)
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
