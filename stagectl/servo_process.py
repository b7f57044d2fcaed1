"""The servo as a process: `python -m stagectl.servo_process`, started and fed by the supervisor over stdin.

First line in: the profile; the process compiles or loads every tick, and answers `{"warm": true}`. Second line: the
profile as the drives allow it, bus, port, mappings and shared memory; it opens them, makes itself as real-time as the
host allows, and runs until asked to exit. When its supervisor is gone it first brings the stage to rest and takes the
power away, and only then, no longer cyclic, saves what the ring still holds.
"""

import ctypes
import gc
import json
import os
import select
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np

from drivers import sample_clock
from drivers.can_bus import open_cyclic
from drivers.serial_port import SerialPort
from drivers.transport import RealtimeTransport, now_t_ns
from drivers.wire import Inbox, WireDecoder, WireEncoder, frame_names
from stagectl.errors import StagectlError
from stagectl.profile import Profile, profile_from_effective
from stagectl.record import recover
from stagectl.replay import mapping_of
from stagectl.requests import REQUEST, RESTING, STATUS, Mode
from stagectl.ring import RequestReader, RequestWriter, RingWriter
from stagectl.row import new_rows
from stagectl.row_fill import fill_row, fill_status
from stagectl.servo import RELEASE_CYCLES, Servo
from stagectl.signals import SETPOINT
from stagectl.tracker import Tracker

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT = 1
_ORPHAN_S = 2.0
"""Silence of the supervisor, after the stage stands, that counts as its death."""

_PRIORITY = 60
_WARM_CYCLES = 50
_KERNEL_WORK = Path("/sys/devices/virtual/workqueue/cpumask")


def shares_cpu(cpu: int | None, mask: Path = _KERNEL_WORK) -> bool:
    """Tell whether the kernel's own unbound work may run on this CPU; it hands over what a serial port received."""
    try:
        return cpu is None or bool(int(mask.read_text().replace(",", ""), 16) >> cpu & 1)
    except (OSError, ValueError):
        return True


def make_real_time(cpu: int | None) -> list[str]:
    """Ask for FIFO scheduling, locked memory, one CPU and no timer slack; returns what the host refused."""
    refused = []
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if libc.mlockall(_MCL_CURRENT) != 0:
        refused.append(f"locked memory ({os.strerror(ctypes.get_errno())})")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError as error:
        refused.append(f"SCHED_FIFO ({error.strerror})")
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError as error:
            refused.append(f"CPU {cpu} ({error.strerror})")
    gc.collect()
    gc.freeze()
    gc.disable()
    return refused


class _Nowhere:
    """A transport without a world, to run every line of a cycle once before the real one starts."""

    lost_count = 0
    failure = ""

    def __init__(self) -> None:
        self._t_ns = now_t_ns()

    def now_t_ns(self) -> int:
        """Return a time that only cycles move."""
        return self._t_ns

    def sleep(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Let the cycle be rehearsed, at once."""
        return True

    def await_bytes(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Nothing comes."""
        return False

    def receive(self, deadline_t_ns: int, inbox: Inbox) -> int:
        """Receive nothing, at once."""
        self._t_ns = deadline_t_ns
        return deadline_t_ns

    def send(self, frames: list[tuple[int, bytes]]) -> tuple[bool, int]:
        """Take the frames nowhere."""
        return True, self._t_ns


def _say(message: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def _warm(profile: Profile) -> None:
    """Load all compiled code that a cycle can reach."""
    tracker = Tracker(profile, has_drives=True)
    tracker.warm()
    row, status = new_rows(1), np.zeros(1, STATUS)
    one = tracker.active
    for law in range(2):
        tracker.switch(law)
        one = tracker.active
        fill_row(
            row, one.measurement, tracker.setpoint, one.command, one.estimator, one.model, one.law, one.backlash,
            0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 1.0,
        )  # fmt: skip
    fill_status(
        status, one.measurement, tracker.setpoint, tracker.hold, one.backlash,
        0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 1.0,
    )  # fmt: skip
    tracker.begin(0)
    tracker.guide()
    tracker.update(tracker.new_belief(), 0.0, 0.0)
    clock = sample_clock.init(1e6, 0.0)
    for sequence in range(3):
        sample_clock.step(clock, sequence, sequence * 1_000_000)
    sample_clock.sample_t_ns(clock, 3)
    sample_clock.sample_at(clock, 3, 3_000_000)
    RingWriter(None, slots_count=2)


def _run_nowhere(profile: Profile, mappings: dict, segments: np.ndarray) -> None:
    """Run a servo on nothing for some cycles: first calls of anything cost milliseconds."""
    requests, status = RequestWriter(None, REQUEST), RequestWriter(None, STATUS)
    servo = Servo(
        profile,
        WireDecoder(profile, mappings),
        WireEncoder(profile, mappings),
        Tracker(profile, has_drives=True),
        _Nowhere(),
        segments,
        requests.reader(),
        status,
        RingWriter(None, slots_count=16),
    )
    for _ in range(_WARM_CYCLES):
        servo.cycle()


def _serve(config: dict[str, Any]) -> int:
    """Open bus, port and memory, and run the loop."""
    profile = profile_from_effective(config["profile"], "the supervisor's profile")  # a drive may have been capped
    mappings = {axis: mapping_of(table) for axis, table in config["mappings"].items()}
    segments = np.memmap(config["segments"], dtype=SETPOINT, mode="r")
    _run_nowhere(profile, mappings, segments)  # before the port is open: its buffer would fill with old lines
    names = frame_names(mappings)
    bus = open_cyclic(config["interface"], config["channel"], list(names))
    port = SerialPort(config["port"], config["baud_bit_per_s"])
    ring_path = Path(config["ring"])
    ring = RingWriter(ring_path, run_folder=config["run_folder"])
    requests = RequestReader.attach(Path(config["requests"]), REQUEST)
    status = RequestWriter(Path(config["status"]), STATUS)
    shared = shares_cpu(config.get("cpu"))
    transport = RealtimeTransport(bus, port, names, shares_cpu=shared)
    servo = Servo(
        profile,
        WireDecoder(profile, mappings),
        WireEncoder(profile, mappings),
        Tracker(profile, has_drives=True),
        transport,
        segments,
        requests,
        status,
        ring,
    )
    refused = make_real_time(config.get("cpu"))
    if shared and config.get("cpu") is not None:  # of one processor there is nothing to ask for
        refused.append(f"a CPU without the kernel's own work ({_KERNEL_WORK})")
    _say({"running": True, "refused": refused, "warnings": port.warnings})
    while port.read():  # lines that waited are old: their arrival says nothing
        pass
    orphaned = _run(servo, config["supervisor_pid"])
    transport.close()
    ring.close()
    status.close()
    if orphaned:
        for key in ("requests", "status", "segments"):
            Path(config[key]).unlink(missing_ok=True)
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        recover(ring_path, Path(config["run_folder"]))
    return 0


def _run(servo: Servo, supervisor_pid: int) -> bool:
    """Cycle until asked to exit, or until the supervisor has been gone for good; True for the latter."""
    orphaned, leaving = False, 0
    while True:
        servo.cycle()
        if servo.phase not in RESTING:
            continue
        if servo.mode is Mode.EXIT:
            leaving += 1
            if leaving > 1 and (servo.released or leaving > RELEASE_CYCLES):
                return orphaned
        elif servo.supervisor_silence_s > _ORPHAN_S and os.getppid() != supervisor_pid:
            orphaned = True
            servo.leave()


def main() -> int:
    """Read the two lines of configuration and serve; errors come out as one JSON line."""
    for number in (
        signal.SIGINT,
        signal.SIGHUP,
    ):  # Ctrl-C and a closed terminal are the supervisor's: it asks for a stop
        signal.signal(number, signal.SIG_IGN)
    try:
        profile = profile_from_effective(json.loads(sys.stdin.readline()), "the supervisor's profile")
        _warm(profile)
        _say({"warm": True})
        select.select([sys.stdin], [], [])
        line = sys.stdin.readline()
        if not line:
            return 0
        return _serve(json.loads(line))
    except StagectlError as error:
        _say({"error": str(error), "kind": type(error).__name__})
        return 3


if __name__ == "__main__":
    sys.exit(main())
