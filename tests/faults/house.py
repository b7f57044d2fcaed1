"""A service with its rig, all processes of their own, and an operator's program that holds its lease and its key."""

import contextlib
import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa

from stagectl.backend import ask_rig
from stagectl.client import Client
from stagectl.errors import JogOver, LinkError, StagectlError
from tests.service.daemon import PATIENT, Daemon

CHANGES = {**PATIENT, "record": {"when": "always"}}
LOOK_S = 0.02
JOG_M_PER_S = 0.12
_PATIENCE_S = 120.0  # a homing at 20 mm/s on a busy host is in it


@dataclass
class Seen:
    """The true motion of a run, as often as the rig was asked."""

    t_ns: list[int] = field(default_factory=list)
    position_m: list[float] = field(default_factory=list)
    velocity_m_per_s: list[float] = field(default_factory=list)
    drive: list[str] = field(default_factory=list)


class House:
    """A service of its own with its rig; made anew by `systemd` where it was killed."""

    def __init__(self, folder: Path, runs: Path | None = None):
        """Start the service below `folder`; its runs may go elsewhere."""
        self.daemon = Daemon(folder, CHANGES, runs)
        self.seen = Seen()
        self.accepted: list[str] = []
        self._jogging = threading.Event()
        self._over = threading.Event()
        self._speed_m_per_s = 0.0
        self._channel = ""

    def close(self) -> None:
        """End everything."""
        self.daemon.end()

    # ---- the rig -------------------------------------------------------------------------------------------------

    def find_rig(self) -> None:
        """Remember where the rig is, so that it can be asked when its service is gone."""
        places = sorted((self.daemon.folder / "tmp").glob("stagectl-rig-*/can.socket"), key=os.path.getmtime)
        self._channel = str(places[-1])

    def state(self) -> dict:
        """Ask the rig what is true, and note it."""
        found = ask_rig(self._channel, {"state": True})
        self.seen.t_ns.append(found["t_ns"])
        self.seen.position_m.append(found["plant"]["macro_position_m"])
        self.seen.velocity_m_per_s.append(found["plant"]["macro_velocity_m_per_s"])
        self.seen.drive.append(found["drives"]["1"])
        return found

    def rig_fault(self, **fault) -> None:
        """Let something go wrong in the rig."""
        ask_rig(self._channel, {"fault": fault})

    # ---- the operator --------------------------------------------------------------------------------------------

    def ready(self) -> str:
        """Bring the stage to armed: acknowledge, home, arm; return what stands in the way."""
        client, last = self.daemon.client, ""
        give_up_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up_s:
            try:
                status = client.status()
                last = f"{status.state} {status.waiting_for}"
                if status.state == "armed" and client.lease_token:
                    return ""
                if not client.lease_token or client.lease_state() is None:
                    client.take_lease("anna", 2.0)
                    self._keep_lease()
                if status.fault is not None:
                    client.acknowledge(status.fault.number)
                elif status.state == "idle" and not status.homed:
                    client.home()
                elif status.state == "idle":
                    client.arm()
            except StagectlError as error:
                last = str(error)
                if "lease" in last:
                    client.lease_token = ""
            time.sleep(0.1)
        return f"not armed after {_PATIENCE_S:g} s: {last}"

    def _keep_lease(self) -> None:
        self._over.set()
        self._over = threading.Event()
        threading.Thread(target=self._operate, args=(self._over,), daemon=True).start()

    def _operate(self, over: threading.Event) -> None:
        """Renew the lease, and hold the key while jogging, as an operator's program does."""
        jog = ""
        with Client(self.daemon.socket) as client:
            client.lease_token = self.daemon.client.lease_token
            while not over.wait(0.1):
                try:
                    client.renew_lease()
                    if self._jogging.is_set():
                        jog = jog or client.begin_jog(0.5).key
                        client.jog_at(jog, self._speed_m_per_s, 0.5)
                except JogOver:
                    jog = ""
                except LinkError:
                    continue
                except StagectlError:
                    return

    def set_off(self) -> bool:
        """Jog away from the nearer end until it truly moves; False where it does not get there."""
        at_m = self.state()["plant"]["macro_position_m"]
        self._speed_m_per_s = -JOG_M_PER_S if at_m > 0.0 else JOG_M_PER_S
        self._jogging.set()
        give_up_s = time.monotonic() + 10.0
        while time.monotonic() < give_up_s:
            if abs(self.state()["plant"]["macro_velocity_m_per_s"]) > 0.95 * JOG_M_PER_S:
                return True
            time.sleep(LOOK_S)
        return False

    def let_go(self) -> None:
        """Hold no key any more."""
        self._jogging.clear()

    def vanish(self) -> None:
        """The operator's program is gone."""
        self._over.set()
        self.daemon.client.lease_token = ""

    # ---- judging -------------------------------------------------------------------------------------------------

    def lateness_s(self, since_t_ns: int) -> float:
        """Return how late the servo was at worst after an instant, by the runs' rows."""
        worst = 0
        for path in self.daemon.runs.glob("*/samples.arrow"):
            with contextlib.suppress(pa.ArrowException, OSError), pa.OSFile(str(path)) as file:
                reader = pa.ipc.open_stream(file)
                for batch in reader:
                    late = batch.column("lateness_ns").to_numpy()[batch.column("t_ns").to_numpy() >= since_t_ns]
                    worst = max(worst, int(late.max(initial=0)))
        return 1e-9 * worst
