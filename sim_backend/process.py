"""The rig as a process in real time: one thread that waits for hub packets and for its own next instant.

Time is CLOCK_MONOTONIC_RAW, as on the host of a machine. SIGTERM ends it; so does the end of its parent.
"""

import argparse
import contextlib
import ctypes
import gc
import heapq
import json
import os
import select
import shutil
import signal
import sys
import time
import tomllib
from pathlib import Path

from sim_backend.faults import BUS_KINDS, Fault, fault_of
from sim_backend.hub import ERROR_FLAG, Hub
from sim_backend.machine import Machine, load_machine
from sim_backend.object_dictionary import RIG_VENDOR_ID
from sim_backend.pty_port import PtyPort
from sim_backend.real_wires import UartPort, can_link
from sim_backend.rig import Rig, warm
from stagectl.errors import ProfileError, RecordError, StagectlError

_BUS_OFF_ERROR_ID = ERROR_FLAG | 0x40
_PARENT_PERIOD_NS = 250_000_000
_TRUTH_LIMIT_S = 900.0
_PR_SET_TIMERSLACK = 29
_IDLE_NS = 100_000_000
_HELD_UP_NS = 1_000_000
_PRIORITY = 50  # below a servo's 60 on the same host


def _now_t_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


class RigProcess:
    """Rig, hub and serial port on one real clock."""

    def __init__(
        self,
        machine: Machine,
        socket_path: Path,
        port: PtyPort | UartPort,
        can: str | None,
        seed: int,
        faults: list[Fault],
    ) -> None:
        self.hub = Hub(socket_path, self._answer)
        self.port = port
        self.machine = machine
        self._can = can
        self.rig = Rig(machine, seed, _now_t_ns(), faults, truth_limit_s=_TRUTH_LIMIT_S)
        self._delayed: list[tuple[int, int, int, bytes, int]] = []  # instant, number, id, payload, sender
        self._delayed_count = 0
        self._bus_was_off = False
        self._held_up_ns = 0  # by the host, altogether: by so much the drives noticed silence later
        self.rig.take_frames()  # boot-up: nobody is on the bus yet

    # -- loop ---------------------------------------------------------------------------------------------------------

    def run(self, stop_fileno: int, parent_pid: int, linger_s: float) -> None:
        """Serve until `stop_fileno` is readable, or the parent has been gone for `linger_s`."""
        parent_t_ns = _now_t_ns() + _PARENT_PERIOD_NS
        end_t_ns: int | None = None
        served_t_ns = _now_t_ns()
        while True:
            now_t_ns = _now_t_ns()
            if now_t_ns >= parent_t_ns:
                parent_t_ns = now_t_ns + _PARENT_PERIOD_NS
                self._join_bus()
                if end_t_ns is None and os.getppid() != parent_pid:
                    end_t_ns = now_t_ns + round(1e9 * linger_s)
            if end_t_ns is not None and now_t_ns >= end_t_ns:
                return
            wait_ns = max(0, min(self._next_t_ns(), parent_t_ns, now_t_ns + _IDLE_NS) - now_t_ns)
            ready, _, _ = select.select([stop_fileno, *self.hub.filenos()], [], [], 1e-9 * wait_ns)
            if stop_fileno in ready:
                return
            woken_t_ns = _now_t_ns()
            late_ns = woken_t_ns - served_t_ns - wait_ns  # held up by the host, or by a request such as a truth file
            served_t_ns = woken_t_ns
            if late_ns > _HELD_UP_NS:  # a real drive is not held up by the host: this is no silence of its master
                self.rig.postpone_watches(late_ns)
                self._held_up_ns += late_ns
            for fileno in ready:
                for sender, can_id, payload in self.hub.read(fileno):
                    self._pass(can_id, payload, sender)
            self._serve_time(_now_t_ns())

    def _join_bus(self) -> None:
        """Put the drives on the CAN interface as soon as there is one, and again when it comes back."""
        if self._can is not None and not self.hub.is_on_bus:
            link = can_link(self._can)
            if link is not None:
                self.hub.join(link)

    def _next_t_ns(self) -> int:
        due = self.rig.next_wake_t_ns
        return min(due, self._delayed[0][0]) if self._delayed else due

    def _serve_time(self, now_t_ns: int) -> None:
        """Do what is due: timers of the drives, lines of the sensor, frames that a fault held back."""
        rig = self.rig
        if rig.next_wake_t_ns <= now_t_ns:
            rig.advance(now_t_ns)
            self._send_own_frames()
            lines = rig.sensor_lines_due(now_t_ns)
            if rig.is_unplugged:
                self.port.unplug()
            else:
                self.port.plug()
            for _, line in lines:
                self.port.write(line)
        while self._delayed and self._delayed[0][0] <= now_t_ns:
            _, _, can_id, payload, sender = heapq.heappop(self._delayed)
            self._arrive(can_id, payload, sender)

    # -- bus ----------------------------------------------------------------------------------------------------------

    def _pass(self, can_id: int, payload: bytes, sender: int) -> None:
        """Let a frame through the faults of the wire."""
        faults = self.rig.wire_faults
        if faults.is_clean:
            self._bus_was_off = False
            self._arrive(can_id, payload, sender)
            return
        if faults.is_bus_off and not self._bus_was_off:
            self.hub.relay(_BUS_OFF_ERROR_ID, bytes(8))
        self._bus_was_off = faults.is_bus_off
        for delay_ns, data in faults.passed(can_id, payload):
            if delay_ns == 0:
                self._arrive(can_id, data, sender)
            else:
                self._delayed_count += 1
                delayed = (_now_t_ns() + delay_ns, self._delayed_count, can_id, data, sender)
                heapq.heappush(self._delayed, delayed)

    def _arrive(self, can_id: int, payload: bytes, sender: int) -> None:
        """A frame is on the bus: everybody hears it; the drives answer."""
        if sender < 0:
            self.hub.relay(can_id, payload)
            return
        if can_id <= 0x7FF:  # data frames with 11-bit ids; drives know no others
            answers = self.rig.on_frame(can_id, payload, _now_t_ns())
            for answer_id, data in answers:
                self._pass(answer_id, data, -1)
            self._send_own_frames()
        self.hub.relay(can_id, payload, sender)

    def _send_own_frames(self) -> None:
        for _, can_id, payload in self.rig.take_frames():
            self._pass(can_id, payload, -1)

    # -- requests -----------------------------------------------------------------------------------------------------

    def _answer(self, request: bytes) -> bytes:
        """Obey a JSON request of a client: {"fault": {...}}, {"truth": path} or {"state": true}."""
        try:
            return json.dumps(self._obey(json.loads(request))).encode()
        except (ValueError, TypeError, ProfileError, RecordError) as error:
            return json.dumps({"error": str(error)}).encode()

    def _obey(self, request: dict) -> dict:
        rig = self.rig
        now_t_ns = _now_t_ns()
        if "fault" in request:
            fault = fault_of(request["fault"])
            rig.inject(fault, now_t_ns)
            if fault.kind in BUS_KINDS:
                self._bus_was_off = False
            return {"t_ns": now_t_ns}
        rig.advance(now_t_ns)
        self._send_own_frames()
        if "truth" in request:
            rig.truth.write(request["truth"])
            return {"rows_count": len(rig.truth)}
        return {
            "t_ns": rig.t_ns,
            "plant": rig.plant_state(),
            "drives": {str(node.node_id): node.drive.state.name for node in rig.nodes},
            "lines_lost_count": self.port.lines_lost_count,
            "held_up_ns": self._held_up_ns,
            "syncs_count": rig.syncs_count,
        }

    def close(self) -> None:
        """Remove socket and port."""
        self.hub.close()
        self.port.close()


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m sim_backend",
        description="The software rig: two CiA 402 drives on a CAN hub, interferometer on a pty.",
    )
    parser.add_argument("machine", help="machine file, or the name of one in sim_backend/machines")
    parser.add_argument("--socket", type=Path, required=True, help="path of the CAN hub's socket")
    parser.add_argument("--can", help="SocketCAN interface to put the drives on, too, once it is there")
    line = parser.add_mutually_exclusive_group()
    line.add_argument("--pty-link", type=Path, help="link to make to the interferometer's pseudo-terminal")
    line.add_argument("--uart", type=Path, help="serial port that the interferometer writes to, in place of one")
    parser.add_argument("--seed", type=int, default=0, help="seed of all noise (default 0)")
    parser.add_argument("--faults", type=Path, help="TOML file with [[faults]] tables, instants from the start")
    parser.add_argument("--truth", type=Path, help="write what really happened to this .npz file at the end")
    parser.add_argument("--own-folder", type=Path, help="folder to remove at the end, where the parent is gone by then")
    parser.add_argument(
        "--linger-s", type=float, default=0.0, help="go on this long after the parent's end (default 0)"
    )
    return parser.parse_args(argv)


def _port_of(arguments: argparse.Namespace, machine: Machine) -> PtyPort | UartPort:
    if arguments.uart is None:
        return PtyPort(arguments.pty_link)
    return UartPort(arguments.uart, machine.interferometer.baud_bit_per_s)


def _faults_from(path: Path | None) -> list[Fault]:
    if path is None:
        return []
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8")).get("faults", [])
    except (OSError, ValueError) as error:
        raise ProfileError(f"{path}: the faults can't be read: {error}; correct the file") from error
    return [fault_of(table) for table in tables]


def main(argv: list[str] | None = None) -> int:
    """Run the rig process; print one JSON line when it serves."""
    parent_pid = os.getppid()
    arguments = _arguments(argv)
    stop_fileno, wakeup_fileno = os.pipe()
    os.set_blocking(wakeup_fileno, False)
    signal.set_wakeup_fd(wakeup_fileno, warn_on_full_buffer=False)
    signal.signal(signal.SIGTERM, lambda number, frame: None)  # the wake-up descriptor tells the loop
    for number in (signal.SIGINT, signal.SIGHUP):  # for the controller: it stops the stage, then the rig
        signal.signal(number, signal.SIG_IGN)
    try:
        machine = load_machine(arguments.machine)
        faults = _faults_from(arguments.faults)
        warm(machine)
        port = _port_of(arguments, machine)
        try:
            served = RigProcess(machine, arguments.socket, port, arguments.can, arguments.seed, faults)
        except StagectlError:
            port.close()
            raise
    except StagectlError as error:
        print(json.dumps({"ready": False, "error": str(error)}), flush=True)
        return 2
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # best effort: 50 us of slack less
    with contextlib.suppress(OSError):  # hardware is never held up by the host's other work; needs a privilege
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    gc.collect()
    gc.freeze()
    is_orphan = False
    try:
        print(json.dumps(_ready(served, arguments.seed)), flush=True)
        served.run(stop_fileno, parent_pid, arguments.linger_s)
    except BrokenPipeError:  # who began it was killed before it was ready
        is_orphan = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        served.close()
        if arguments.truth is not None:
            served.rig.truth.write(arguments.truth)
        if arguments.own_folder is not None and (is_orphan or os.getppid() != parent_pid):
            shutil.rmtree(arguments.own_folder, ignore_errors=True)
    return 0


def _ready(served: RigProcess, seed: int) -> dict:
    return {
        "ready": True,
        "pid": os.getpid(),
        "machine": served.machine.name,
        "socket": str(served.hub.path),
        "pty": served.port.path,
        "vendor_id": RIG_VENDOR_ID,
        "seed": seed,
        "start_t_ns": served.rig.start_t_ns,
    }


if __name__ == "__main__":
    sys.exit(main())
