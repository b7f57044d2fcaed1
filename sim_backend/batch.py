"""The whole wire in one process and in virtual time: bus with arbitration and load, serial line, CANopen master's bus.

Whoever runs the controller moves time (`advance_to`); everything that happens on the wire until then has its exact
instant. Time stands still during the master's SDO and NMT. Deterministic for a given rig and seed.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import can

from sim_backend.bus_load import BusModel
from sim_backend.rig import Rig
from stagectl.errors import LinkError

TURNAROUND_NS = 20_000  # from the end of SYNC to a drive's TPDO in its transmit buffer
ERROR_FLAG = 0x2000_0000
BUS_OFF_ERROR_ID = ERROR_FLAG | 0x40  # Linux error class: bus-off
QUEUE_LIMIT_FRAMES = 10  # of the controller's transmit queue

_HOST = 0
_NO_WAIT_NS = 1 << 62

OnFrame = Callable[[int, bytearray, float], None]


class BatchCyclic:
    """The servo's side of the bus: frames that arrived up to the present virtual instant."""

    def __init__(self, wire: "BatchWire") -> None:
        self.lost_count = 0
        self.received: deque[tuple[int, bytes]] = deque()
        self.arrival_t_ns = 0  # end of the frame that `receive` returned last
        self._arrivals: deque[int] = deque()
        self._ids: frozenset[int] | None = None
        self._wire = wire

    def set_ids(self, ids: Iterable[int]) -> None:
        """Take frames of these ids and error frames only."""
        self._ids = frozenset(ids)

    def put(self, can_id: int, payload: bytes, t_ns: int) -> None:
        """Deliver a frame whose end was at `t_ns`."""
        if self._ids is None or can_id in self._ids or can_id & ERROR_FLAG:
            self.received.append((can_id, payload))
            self._arrivals.append(t_ns)

    def receive(self) -> tuple[int, bytes] | None:
        """Return (id, payload) of the next frame that has arrived, None when there is none."""
        if not self.received:
            return None
        self.arrival_t_ns = self._arrivals.popleft()
        return self.received.popleft()

    def send(self, can_id: int, payload: bytes) -> bool:
        """Queue a frame at the present instant; False, and counted, when the queue is full or the bus is off."""
        if self._wire.queue(can_id, payload):
            return True
        self.lost_count += 1
        return False

    def fileno(self) -> int:
        """There is no descriptor in virtual time: -1."""
        return -1

    def close(self) -> None:
        """Forget what was not read."""
        self.received.clear()
        self._arrivals.clear()


class BatchSerial:
    """The sensor's port: bytes that arrived up to the present virtual instant."""

    def __init__(self, wire: "BatchWire") -> None:
        self.arrival_t_ns = 0  # of the last byte that `read` returned
        self._wire = wire

    def read(self) -> bytes:
        """Return what has arrived, b"" when nothing has; LinkError while the port is unplugged."""
        rig = self._wire.rig
        lines = rig.sensor_lines_due(self._wire.t_ns)
        if not lines:
            if rig.is_unplugged:
                raise LinkError("the interferometer's port is gone (unplugged); plug it in, then home again")
            return b""
        self.arrival_t_ns = lines[-1][0]
        return lines[0][1] if len(lines) == 1 else b"".join([line for _, line in lines])

    def fileno(self) -> int:
        """There is no descriptor in virtual time: -1."""
        return -1

    def close(self) -> None:
        """Nothing to close."""


class BatchNetworkBus(can.BusABC):
    """The master's bus: `send` delivers to the drives at once, their answers come back before it returns."""

    def __init__(self, wire: "BatchWire") -> None:
        super().__init__(channel="batch")
        self.channel_info = "batch rig"
        self.on_frame: OnFrame | None = None
        self._wire = wire
        self._received: deque[can.Message] = deque()

    def attach(self, on_frame: OnFrame) -> None:
        """Call `on_frame(can_id, data, t_s)` for every frame of the drives, those kept for `recv` first."""
        self.on_frame = on_frame
        while self._received:
            kept = self._received.popleft()
            on_frame(kept.arbitration_id, bytearray(kept.data), kept.timestamp)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Deliver a frame to the drives now."""
        self._wire.send_now(msg.arbitration_id, bytes(msg.data))

    def put(self, can_id: int, payload: bytes, t_ns: int) -> None:
        """Take a frame of a drive."""
        if self.on_frame is not None:
            self.on_frame(can_id, bytearray(payload), 1e-9 * t_ns)
        else:
            self._received.append(
                can.Message(timestamp=1e-9 * t_ns, arbitration_id=can_id, is_extended_id=False, data=payload)
            )

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self._received.popleft(), False) if self._received else (None, False)


class BatchWire:
    """Everything between controller and rig, in virtual time."""

    def __init__(self, rig: Rig, bus_load: bool = True, bit_rate_bit_per_s: float = 1e6) -> None:
        self.rig = rig
        self.t_ns = rig.t_ns
        self.bus = BusModel(1 + len(rig.nodes), bit_rate_bit_per_s, occupied=bus_load)
        self.cyclic = BatchCyclic(self)
        self.serial = BatchSerial(self)
        self.network_bus = BatchNetworkBus(self)
        self.last_sync_t_ns = 0  # end of the last SYNC frame
        self._sync_cob_id = rig.nodes[0].sync_cob_id
        self._stations = {node.node_id: 1 + k for k, node in enumerate(rig.nodes)}
        self._was_off = False
        self._delayed: list[tuple[int, int, int, int, bytes]] = []  # frames that a fault holds back, by instant
        self._delayed_count = 0
        for t_ns, can_id, payload in rig.take_frames():  # boot-up
            self._give(t_ns, can_id, payload)

    def close(self) -> None:
        """Shut the master's bus down; closing twice is harmless."""
        self.network_bus.shutdown()

    # -- time ---------------------------------------------------------------------------------------------------------

    def advance_to(self, t_ns: int) -> None:
        """Let everything on bus, drives and sensor happen up to `t_ns`; time never goes back."""
        bus = self.bus
        rig = self.rig
        while True:
            delivery_t_ns = bus.next_delivery_t_ns()
            bus_t_ns = _NO_WAIT_NS if delivery_t_ns is None else delivery_t_ns
            event_t_ns = rig.next_event_t_ns
            if self._delayed and self._delayed[0][0] <= min(t_ns, bus_t_ns, event_t_ns):
                delayed_t_ns, _, station, can_id, payload = heapq.heappop(self._delayed)
                self._arrive(delayed_t_ns, station, can_id, payload)
            elif event_t_ns <= t_ns and event_t_ns < bus_t_ns:
                rig.advance(event_t_ns)
                self._queue_own_frames()
            elif bus_t_ns <= t_ns:
                self._deliver()
            else:
                break
        self.t_ns = max(self.t_ns, t_ns)

    def next_line_t_ns(self) -> int:
        """Return when the next line of the sensor arrives, never before the present instant."""
        return max(self.t_ns, self.rig.next_line_t_ns)

    # -- bus ----------------------------------------------------------------------------------------------------------

    def queue(self, can_id: int, payload: bytes) -> bool:
        """Queue a frame of the controller at the present instant; False when it can't be."""
        if self.bus.queued(_HOST) >= QUEUE_LIMIT_FRAMES or not self._bus_is_on():
            return False
        self.bus.submit(_HOST, self.t_ns, can_id, payload)
        return True

    def _bus_is_on(self) -> bool:
        off = not self.rig.wire_faults.is_clean and self.rig.wire_faults.is_bus_off
        if off and not self._was_off:
            self.bus.clear(_HOST)
            self.cyclic.put(BUS_OFF_ERROR_ID, bytes(8), self.t_ns)
        self._was_off = off
        return not off

    def _station(self, can_id: int) -> int:
        return self._stations.get(can_id & 0x7F, 1)

    def _queue_own_frames(self) -> None:
        """Put on the bus what the drives send on their own account."""
        for t_ns, can_id, payload in self.rig.take_frames():
            self.bus.submit(self._station(can_id), t_ns, can_id, payload)

    def _deliver(self) -> None:
        """Hand the next frame on the bus to whom it concerns, through the faults of the wire."""
        t_ns, station, can_id, payload = self.bus.deliver()
        for data in self._passed(t_ns, station, can_id, payload):
            self._arrive(t_ns, station, can_id, data)

    def _passed(self, t_ns: int, station: int, can_id: int, payload: bytes) -> list[bytes]:
        """Let a frame through the faults of the wire; returns what arrives now, and holds back what arrives later."""
        faults = self.rig.wire_faults
        if faults.is_clean:
            return [payload]
        self._bus_is_on()
        arrived = []
        for delay_ns, data in faults.passed(can_id, payload):
            if delay_ns == 0:
                arrived.append(data)
            else:
                self._delayed_count += 1
                heapq.heappush(self._delayed, (t_ns + delay_ns, self._delayed_count, station, can_id, data))
        return arrived

    def _arrive(self, t_ns: int, station: int, can_id: int, payload: bytes) -> None:
        if station == _HOST:
            answers = self.rig.on_frame(can_id, payload, t_ns)
            if can_id == self._sync_cob_id:
                self.last_sync_t_ns = t_ns
            for answer_id, data in answers:
                self.bus.submit(self._station(answer_id), t_ns + TURNAROUND_NS, answer_id, data)
            self._queue_own_frames()
            return
        if can_id < 0x580:
            self.cyclic.put(can_id, payload, t_ns)
        if can_id < 0x100 or can_id >= 0x580:  # EMCY, SDO, heartbeat: the master's
            self.network_bus.put(can_id, payload, t_ns)

    def send_now(self, can_id: int, payload: bytes) -> None:
        """Deliver a frame of the master at the present instant, answers included: no time passes, the bus is not
        loaded."""
        rig = self.rig
        for data in self._passed(self.t_ns, _HOST, can_id, payload):
            answers = rig.on_frame(can_id, data, max(self.t_ns, rig.t_ns))
            if can_id == 0x000 or can_id & 0x780 == 0x600:
                self._sync_cob_id = rig.nodes[0].sync_cob_id
            for t_ns, own_id, own in rig.take_frames():
                self._give(t_ns, own_id, own)
            for answer_id, answer in answers:
                self._give(self.t_ns, answer_id, answer)

    def _give(self, t_ns: int, can_id: int, payload: bytes) -> None:
        """Give a drive's frame to the master at once, or put it on the bus where it belongs to the servo."""
        station = self._station(can_id)
        if can_id < 0x580:
            self.bus.submit(station, max(t_ns, self.t_ns), can_id, payload)
            return
        for data in self._passed(t_ns, station, can_id, payload):
            self.network_bus.put(can_id, data, t_ns)


def attach_all(wire: BatchWire, listeners: Iterable[Any]) -> None:
    """Hand every frame of the drives to python-can listeners, at once."""
    called = list(listeners)

    def on_frame(can_id: int, data: bytearray, t_s: float) -> None:
        message = can.Message(timestamp=t_s, arbitration_id=can_id, is_extended_id=False, data=data)
        for listener in called:
            listener(message)

    wire.network_bus.attach(on_frame)
