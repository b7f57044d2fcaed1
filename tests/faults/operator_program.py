"""An operator's program, a process of its own: it renews its lease, and holds the key of a jog while it is told to.

It is told by lines: `lease TOKEN`, `jog SPEED`, `let go`. Where they end it asks once more, and ends with whether it
was obeyed.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

from stagectl.client import Client
from stagectl.errors import JogOver, LinkError, StagectlError

JOG_HOLD_S = 0.5
_RENEW_S = 0.1
_ENDS_S = 30.0
_OBEYED = 7  # no code that Python ends with by itself
_ROOT = Path(__file__).resolve().parents[2]


class Operator:
    """The process, and what is told to it."""

    def __init__(self, socket: Path) -> None:
        """Start it, and wait until it is there: a lease is shorter than what a busy host needs for that."""
        command = [sys.executable, "-m", "tests.faults.operator_program", str(socket)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=_ROOT)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._lines, self._said = self._process.stdin, self._process.stdout
        if not self._said.readline():
            raise RuntimeError(f"the operator's program ended with {self._process.wait()}")

    def hold(self, token: str) -> None:
        """Have it renew that lease."""
        self._tell(f"lease {token}")

    def jog(self, velocity_m_per_s: float) -> None:
        """Have it hold a key."""
        self._tell(f"jog {velocity_m_per_s!r}")

    def let_go(self) -> None:
        """Have it hold none."""
        self._tell("let go")

    def _tell(self, line: str) -> None:
        self._lines.write(f"{line}\n".encode())
        self._lines.flush()

    def kill(self) -> None:
        """End it with SIGKILL, in the middle of whatever it does."""
        self._process.kill()
        self._process.wait()
        with contextlib.suppress(BrokenPipeError):
            self._lines.close()
        self._said.close()

    def hang(self) -> None:
        """Stop it with SIGSTOP: its socket stays open, and it knows of nothing."""
        self._process.send_signal(signal.SIGSTOP)

    def goes_on(self) -> bool:
        """Let one that hung go on where it was, and end; return whether it was obeyed once more."""
        self._lines.close()
        self._process.send_signal(signal.SIGCONT)
        try:
            return self._process.wait(_ENDS_S) == _OBEYED
        finally:
            self.kill()


def _work(client: Client) -> bool:
    """Ask again and again; return whether the last time was obeyed."""
    jog, velocity_m_per_s, rest, over, obeyed = "", 0.0, b"", False, False
    while not over:
        if select.select([0], [], [], _RENEW_S)[0]:
            piece = os.read(0, 4096)
            over = not piece
            *lines, rest = (rest + piece).split(b"\n")
            for line in lines:
                what, _, value = line.decode().partition(" ")
                if what == "lease":
                    client.lease_token, jog = value, ""
                else:
                    velocity_m_per_s = float(value) if what == "jog" else 0.0
        obeyed = False  # what was answered before it hung says nothing
        if not client.lease_token:
            continue
        try:
            client.renew_lease()
            obeyed = True
            if velocity_m_per_s != 0.0:
                jog = jog or client.begin_jog(JOG_HOLD_S).key
                client.jog_at(jog, velocity_m_per_s, JOG_HOLD_S)
        except JogOver:
            jog = ""
        except LinkError:
            continue
        except StagectlError:
            if not over:
                client.lease_token = ""
    return obeyed


if __name__ == "__main__":
    with Client(Path(sys.argv[1])) as one:
        print("here", flush=True)
        sys.exit(_OBEYED if _work(one) else 0)
