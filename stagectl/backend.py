"""The one place that opens a world: the rig in batch, the rig as a process, or hardware.

Everything above sees a master's bus, an identity to demand, and a servo that runs when time passes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import can
import numpy as np

from drivers.arming import DriveMapping
from drivers.wire import Inbox, WireDecoder, WireEncoder, frame_names
from sim_backend.batch import BatchWire
from sim_backend.rig import Rig
from stagectl.profile import Profile
from stagectl.requests import REQUEST, STATUS
from stagectl.ring import RequestReader, RequestWriter, RingReader, RingWriter
from stagectl.servo import Servo
from stagectl.signals import SETPOINT
from stagectl.tracker import Tracker

SEGMENT_ROWS = 300_000
"""Setpoints that the segment table holds: 5 minutes at 1 kHz."""



@dataclass(slots=True)
class ServoLink:
    """What the supervisor holds of a servo: both blocks, the ring, the segment table, and a way to let time pass."""

    requests: RequestWriter
    status: RequestReader
    rows: RingReader
    segments: np.ndarray
    tracker_belief: np.ndarray
    snapshot: dict[str, np.ndarray]
    pass_time: Callable[[float], None]
    now_t_ns: Callable[[], int]
    close: Callable[[], None]


class Backend(Protocol):
    """A world that a supervisor can work in."""

    name: str
    vendor_id: int | None  # that every node must show; None = the profile's
    description: str

    def network_bus(self) -> can.BusABC:
        """Return the bus of the master."""
        ...

    synchronous: bool

    def clock_s(self) -> float:
        """Return the clock of heartbeat ages."""
        ...

    def start_servo(self, profile: Profile, mappings: Mapping[str, DriveMapping], run_folder: Path) -> ServoLink:
        """Start the servo."""
        ...

    def truth(self) -> dict[str, np.ndarray] | None:
        """Return what was true, for scoring; None where nobody knows."""
        ...

    def close(self) -> None:
        """Let go of the world."""
        ...


RIG_VENDOR_ID = 0x5254
"""Identity of the rig's drives; hardware never shows it."""


class BatchTransport:
    """The servo's world in virtual time; a tick takes the time that was measured for it."""

    def __init__(self, wire: BatchWire, names: dict[int, str], tick_ns: int):
        """Take over a batch wire."""
        self._wire, self._names, self._tick_ns = wire, names, tick_ns
        wire.cyclic.set_ids(names)

    @property
    def lost_count(self) -> int:
        """Frames that the bus did not take."""
        return self._wire.cyclic.lost_count

    def now_t_ns(self) -> int:
        """Return virtual time."""
        return self._wire.t_ns

    def receive(self, deadline_t_ns: int, inbox: Inbox) -> int:
        """Let everything happen until the deadline, line by line, so that each has its own arrival."""
        wire = self._wire
        while (line_t_ns := wire.next_line_t_ns()) <= deadline_t_ns and len(inbox.sensor_bytes) < 256:
            wire.advance_to(line_t_ns)
            data = wire.serial.read()
            if not data:
                break
            inbox.sensor_bytes += data
            inbox.sensor_arrival_t_ns = wire.serial.arrival_t_ns
        wire.advance_to(deadline_t_ns)
        while (frame := wire.cyclic.receive()) is not None:
            name = self._names.get(frame[0])
            if name is not None:
                setattr(inbox, name, frame[1])
        return wire.t_ns

    def send(self, frames: list[tuple[int, bytes]]) -> tuple[bool, int]:
        """Queue frames after the tick's time; the bus's arbitration does the rest."""
        wire = self._wire
        wire.advance_to(wire.t_ns + self._tick_ns)
        sent = True
        for can_id, payload in frames:
            sent &= wire.cyclic.send(can_id, payload)
        return sent, wire.last_sync_t_ns


class BatchBackend:
    """Rig, wire and servo in one process and in virtual time: deterministic for a seed."""

    name = "batch"
    vendor_id = RIG_VENDOR_ID
    synchronous = True

    def __init__(self, machine, *, seed: int = 0, tick_s: float = 60e-6, faults=(), rig: Rig | None = None):
        """Make the rig of a machine."""
        self.rig = Rig(machine, seed=seed, faults=faults) if rig is None else rig
        self.wire = BatchWire(self.rig)
        self.description = f"software rig {machine.name}, virtual time, seed {seed}"
        self.seed = seed
        self._tick_ns = round(tick_s * 1e9)
        self.servo: Servo | None = None

    def network_bus(self) -> can.BusABC:
        """Return the bus of the master."""
        return self.wire.network_bus

    def clock_s(self) -> float:
        """Return virtual time."""
        return self.wire.t_ns * 1e-9

    def start_servo(self, profile: Profile, mappings: Mapping[str, DriveMapping], run_folder: Path) -> ServoLink:
        """Make the servo in this process; it runs when time passes."""
        decoder = WireDecoder(profile, mappings)
        encoder = WireEncoder(profile, mappings)
        tracker = Tracker(profile, has_drives=True)
        snapshot = {**decoder.snapshot(), "belief": tracker.new_belief()}
        segments = np.zeros(SEGMENT_ROWS, SETPOINT)
        requests = RequestWriter(None, REQUEST)
        status = RequestWriter(None, STATUS)
        ring = RingWriter(None, run_folder=run_folder)
        transport = BatchTransport(self.wire, frame_names(mappings), self._tick_ns)
        servo = Servo(
            profile, decoder, encoder, tracker, transport, segments, requests.reader(), status, ring, lambda: 0
        )
        self.servo = servo

        def pass_time(duration_s: float) -> None:
            until_t_ns = self.wire.t_ns + round(duration_s * 1e9)
            while self.wire.t_ns < until_t_ns:
                servo.cycle()

        return ServoLink(
            requests=requests,
            status=status.reader(),
            rows=ring.reader(),
            segments=segments,
            tracker_belief=tracker.new_belief(),
            snapshot=snapshot,
            pass_time=pass_time,
            now_t_ns=lambda: self.wire.t_ns,
            close=lambda: None,
        )

    def truth(self) -> dict[str, np.ndarray]:
        """Return the rig's log."""
        return self.rig.truth.arrays()

    def close(self) -> None:
        """Nothing outside this process."""
