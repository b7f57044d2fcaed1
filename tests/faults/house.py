"""A service with its rig, all processes of their own, and an operator's program that holds its lease and its key.

It records as profiles do that say nothing of it: from arming to disarming.
"""

import contextlib
import os
import signal
import time
from pathlib import Path

import numpy as np
import pyarrow as pa

from stagectl.backend import ask_rig
from stagectl.errors import RequestError, StagectlError
from stagectl.service import messages
from tests.faults.nonsense import Nonsense
from tests.faults.operator_program import Operator
from tests.faults.witness import joined, seen_of
from tests.service.daemon import PATIENT, Daemon

CHANGES = {**PATIENT, "macro.homing.speed_m_per_s": 0.1, "macro.homing.acceleration_m_per_s2": 0.5}
LOOK_S = 0.02
JOG_M_PER_S = 0.12
IDENTIFY_S = 4.0
_PATIENCE_S = 120.0
_UNDER_WAY_S = 10.0
_LOG_COUNT = 1000
_HOME_FROM_M = 0.08  # 0.8 s of search


class House:
    """A service of its own with its rig; made anew by `systemd` where it was killed."""

    def __init__(
        self, folder: Path, runs: Path | None = None, profile: str = "single-axis", changes: dict | None = None
    ):
        """Start the service below `folder`, its runs elsewhere where told so, with more changes of the profile."""
        self.daemon = Daemon(folder, {**CHANGES, **(changes or {})}, runs, profile)
        self.seen: dict[str, np.ndarray] = {}
        self.accepted: list[str] = []
        self.unasked: list[tuple[int, int]] = []
        self._rests_t_ns = 0  # since when it rests and nothing was asked that gives power; 0: it was
        self._operator: Operator | None = None
        self._hung: Operator | None = None
        self.rig_place = ""

    def close(self) -> None:
        """End everything."""
        for one in (self._operator, self._hung):
            if one is not None:
                one.kill()
        self.daemon.end()

    # ---- the rig -------------------------------------------------------------------------------------------------

    def find_rig(self) -> None:
        """Remember where the rig is, so that it can be asked when its service is gone."""
        places = sorted((self.daemon.folder / "tmp").glob("stagectl-rig-*/can.socket"), key=os.path.getmtime)
        self.rig_place = str(places[-1])

    def state(self) -> dict:
        """Ask the rig what is true now."""
        return ask_rig(self.rig_place, {"state": True})

    @staticmethod
    def t_ns() -> int:
        """Return the time that rig and servo count in."""
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)

    def look_back(self) -> dict[str, np.ndarray]:
        """Ask the rig for all that it saw, and keep it, behind what an earlier one saw."""
        path = self.daemon.folder / "seen.npz"
        ask_rig(self.rig_place, {"truth": str(path)})
        with np.load(path) as stored:
            self.seen = joined(self.seen, seen_of({name: stored[name] for name in stored.files}))
        return self.seen

    @property
    def speed_m_per_s(self) -> float:
        """How fast the macro truly is."""
        return abs(self.state()["plant"]["macro_velocity_m_per_s"])

    def rig_fault(self, **fault) -> None:
        """Let something go wrong in the rig."""
        ask_rig(self.rig_place, {"fault": fault})

    # ---- the operator --------------------------------------------------------------------------------------------

    def ready(self) -> str:
        """Bring the stage to armed: acknowledge, home, arm; return what stands in the way."""
        client, last, is_beyond = self.daemon.client, "", False
        give_up_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up_s:
            try:
                status = client.status()
                last = f"{status.state} {status.waiting_for}"
                self.note_rest(status.state)
                if status.state == "armed" and client.lease_token:
                    return ""
                if not client.lease_token or client.lease_state() is None:
                    self._operator = self._operator or Operator(self.daemon.socket.absolute())
                    client.take_lease("anna", 2.0)
                    self._operator.hold(client.lease_token)
                if status.fault is not None:
                    is_beyond = status.fault.kind == "TRAVEL"
                    client.acknowledge(status.fault.number)
                elif status.state == "idle" and (is_beyond or not status.homed):  # as the fault TRAVEL says
                    self._ask_for_power()
                    client.home()
                    is_beyond = False
                elif status.state == "idle":
                    self._ask_for_power()
                    client.arm()
            except StagectlError as error:
                last = str(error)
                if "lease" in last:
                    client.lease_token = ""
            time.sleep(0.1)
        return f"not armed after {_PATIENCE_S:g} s: {last}"

    def note_rest(self, state: str) -> None:
        """Note, where the service says that the stage has come to rest, that nobody has asked for power since."""
        if state in ("idle", "fault") and not self._rests_t_ns:
            self._rests_t_ns = self.t_ns()

    def _ask_for_power(self) -> None:
        if self._rests_t_ns:
            self.unasked.append((self._rests_t_ns, self.t_ns()))
            self._rests_t_ns = 0

    def set_off(self, speed_m_per_s: float = JOG_M_PER_S) -> bool:
        """Jog away from the nearer end until it truly moves; False where it does not get there."""
        assert self._operator is not None
        self._operator.jog(-self._side() * speed_m_per_s)
        return self._until(lambda: self.speed_m_per_s > 0.95 * speed_m_per_s)

    def _side(self) -> float:
        return 1.0 if self.state()["plant"]["macro_position_m"] > 0.0 else -1.0

    def _until(self, done) -> bool:
        give_up_s = time.monotonic() + _UNDER_WAY_S
        while time.monotonic() < give_up_s:
            if done():
                return True
            time.sleep(LOOK_S)
        return False

    def begin(self, phase: str, speed_m_per_s: float, target_m: float) -> str:
        """Bring an armed stage into a phase of its work; return what stands in the way.

        Its command is under way then, not its end: where in the phase the fault strikes is for who strikes.
        """
        client = self.daemon.client
        try:
            if phase == "jogging":
                return "" if self.set_off(speed_m_per_s) else "it does not move"
            if phase == "moving":
                client.begin("move", messages.Move(target_m=-self._side() * target_m))
            elif phase == "identifying":
                client.begin("identify", messages.Identify(duration_s=IDENTIFY_S))
            elif phase == "homing":
                client.move(-self._side() * _HOME_FROM_M)
                client.begin("home", messages.Home())
            elif phase == "stopping":
                if not self.set_off(speed_m_per_s):
                    return "it does not move"
                self.let_go()
                client.stop()
            elif phase in ("idle", "arming"):
                client.stop()
                if not self._until(lambda: client.status().state in ("idle", "fault")):
                    return f"no rest: {client.status().state}"
                if phase == "arming":
                    client.begin("arm", messages.Arm())
        except RequestError as error:
            return str(error)
        return ""

    def let_go(self) -> None:
        """Hold no key any more."""
        if self._operator is not None:
            self._operator.let_go()

    def vanish(self, half_open: bool = False) -> None:
        """The operator's program is gone; `half_open`: it hangs, and its socket stays, as behind a cut cable."""
        gone, self._operator = self._operator, None
        self.daemon.client.lease_token = ""
        if gone is not None and half_open:
            gone.hang()
            self._hung = gone
        elif gone is not None:
            gone.kill()

    def go_on_where_it_hung(self) -> None:
        """Let an operator's program that hung go on: its lease is over, so it is obeyed no more."""
        hung, self._hung = self._hung, None
        if hung is not None and hung.goes_on():
            self.accepted.append("the lease of a client that had hung")

    def edit_profile(self, edited: Nonsense) -> None:
        """Spoil the profile, and ask for it to be read again."""
        edited.put(self.daemon.profile)
        self.daemon.process.send_signal(signal.SIGHUP)

    def take_power_away(self) -> None:
        """Stop an armed stage, and wait until it has no power: only then is a profile read again."""
        client = self.daemon.client
        client.stop()
        self._until(lambda: client.status().state in ("idle", "fault"))

    def said_of_profile(self) -> list[str]:
        """Return what the service said whenever it was asked to read its profile again."""
        return [entry.text for entry in self.daemon.client.log(limit=_LOG_COUNT) if entry.event == "profile"]

    # ---- judging -------------------------------------------------------------------------------------------------

    def lateness_s(self, since_t_ns: int, until_t_ns: int) -> float:
        """Return how late the servo was at worst between two instants, by the runs' rows."""
        worst = 0
        for path in self.daemon.runs.glob("*/samples.arrow"):
            with contextlib.suppress(pa.ArrowException, OSError), pa.OSFile(str(path)) as file:
                reader = pa.ipc.open_stream(file)
                for batch in reader:
                    t_ns = batch.column("t_ns").to_numpy()
                    late = batch.column("lateness_ns").to_numpy()
                    due = (t_ns >= since_t_ns) & (t_ns - late <= until_t_ns)  # a cycle that was due by then
                    worst = max(worst, int(late[due].max(initial=0)))
        return 1e-9 * worst
