"""The servo's world in real time: cyclic bus, serial port and the host's clock, waited on together.

The kernel hands a port's bytes over in work of its own: a kworker of ordinary priority. select and read on a port
without bytes wait for that work to end, uninterruptible, and a browser on the kworker's CPU makes that 3 ms: in 97 of
100 cycles the servo waited so, and beside ten pages it missed 1500 cycles a minute. epoll is told when bytes are there,
and waits for nobody. But who spins and waits for nobody keeps that work off the own CPU: where the kernel may put it
there, the last stretch is awaited by select.

Times are CLOCK_MONOTONIC_RAW: not slewed by NTP, so a line's arrival and a cycle's start are on one straight clock.
"""

import select
import time

from drivers.can_bus import CyclicBus
from drivers.can_frame import ERROR_FLAG
from drivers.serial_port import READ_BYTES, SerialPort
from drivers.wire import Inbox
from stagectl.errors import LinkError

CHUNK_LIMIT_BYTES = 512
"""Sensor bytes of one cycle, what one row can hold; the rest comes with the next cycle."""

_BUS_OFF = 0x40  # linux/can/error.h
_SPIN_NS = 200_000
"""The last stretch before a cycle is awaited awake: the line comes in it, and waking up takes 60 us (p50) to 110 us
(p90) on an ordinary kernel. From the instant due to SYNC written it is 116 us with 80 us of it, 67 us with 150 us; the
other 50 us are for the rehearsal."""


def error_frame_text(can_id: int) -> str:
    """Say what an error frame means for good, empty where the bus goes on; `can_id` carries ERROR_FLAG."""
    if can_id & _BUS_OFF:
        return "CAN controller is bus-off: check cable, termination and bit rate, then arm again"
    return ""


def now_t_ns() -> int:
    """Return the host clock of stamps and deadlines, ns."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


class RealtimeTransport:
    """Waits for the next cycle and stamps what arrives meanwhile.

    A port or bus that is gone does not end the cycles: `failure` says so, and the servo stops the stage.
    """

    def __init__(self, bus: CyclicBus, port: SerialPort, names: dict[int, str], *, shares_cpu: bool = True):
        """Take over bus and port; `names` gives the inbox slot of each CAN id.

        `shares_cpu`: the kernel's own work may run on this CPU.
        """
        self._bus, self._port, self._names = bus, port, names
        self._arrivals = select.epoll(1)
        self._arrivals.register(port.fileno(), select.EPOLLIN | select.EPOLLET)
        self._told = [self._arrivals.fileno()]  # empty once the port is gone, and so is the next
        self._looked_at = [port.fileno()] if shares_cpu else []
        self._more = False  # the port may hold bytes that nothing will tell of
        self._kept = b""  # read already, but beyond what one row holds
        self._polled = False  # port and bus were looked at in this cycle's last stretch
        self.failure = ""
        self.error_frames_count = 0

    @property
    def lost_count(self) -> int:
        """Frames that the bus did not take."""
        return self._bus.lost_count

    def now_t_ns(self) -> int:
        """Return the host clock."""
        return now_t_ns()

    def sleep(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Sleep until the last stretch; bytes that come meanwhile are stamped and in the inbox."""
        if self._kept and not inbox.sensor_bytes:
            inbox.add_sensor_bytes(self._kept, inbox.sensor_arrival_t_ns)
            self._kept = b""
        while (left_ns := deadline_t_ns - now_t_ns()) > _SPIN_NS:
            wait_s = (left_ns - _SPIN_NS) * 1e-9
            if self._kept or not self._told:  # what is kept already fills the next row
                time.sleep(wait_s)
            elif self._line_within(wait_s):
                self._read(inbox)
        return left_ns > 0

    def await_bytes(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Wait until the deadline, or until the cycle's first sensor bytes are stamped and in the inbox."""
        while not inbox.sensor_bytes and self._wait(deadline_t_ns, inbox):
            pass
        return bool(inbox.sensor_bytes)

    def receive(self, deadline_t_ns: int, inbox: Inbox) -> int:
        """Wait until the deadline, stamping sensor bytes as they become readable, and take the bus's frames."""
        self.await_bytes(deadline_t_ns, inbox)
        while self._wait(deadline_t_ns, inbox):
            pass
        if not self._polled:  # woken too late to look at port and bus before the deadline
            self._look(inbox)
        self._polled = False
        return now_t_ns()

    def _wait(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Look for sensor bytes once, at the first time for frames too; False when the deadline is there."""
        if deadline_t_ns <= now_t_ns():
            return False
        if not self._polled:
            self._look(inbox)
            self._polled = True
        elif not self._kept and self._line_within(0.0):
            self._read(inbox)
        return True

    def _look(self, inbox: Inbox) -> None:
        """Take what port and bus have now."""
        while not self._kept and self._line_within(0.0):
            self._read(inbox)
        try:
            while (frame := self._bus.receive()) is not None:
                self._take(frame, inbox)
        except LinkError as error:
            self.failure = str(error)

    def _line_within(self, wait_s: float) -> bool:
        """Wait for sensor bytes; select, because poll and epoll count in whole milliseconds.

        Sleeping through the line's arrival and stamping it at the deadline locks the sample clock to the loop's own
        phase: the recovered instants were 90 to 430 us off (measured).
        """
        if self._more or not self._told:
            return self._more
        if wait_s > 0.0:
            if not select.select(self._told, (), (), wait_s)[0]:
                return False
        elif self._looked_at:
            return bool(select.select(self._looked_at, (), (), 0.0)[0])
        return bool(self._arrivals.poll(0, 1))

    def _take(self, frame: tuple[int, bytes], inbox: Inbox) -> None:
        can_id, payload = frame
        if can_id & ERROR_FLAG:
            self.error_frames_count += 1
            self.failure = error_frame_text(can_id) or self.failure
            return
        name = self._names.get(can_id)
        if name is not None:  # a filter takes effect a moment after the bus is open
            inbox.take(name, payload)

    def _read(self, inbox: Inbox) -> None:
        arrival_t_ns = now_t_ns()
        try:
            data = self._port.read()
        except LinkError as error:
            self.failure = str(error)
            self._more = False
            self._told.clear()
            return
        self._more = len(data) == READ_BYTES  # an arrival is told once
        if not data:
            return
        room = CHUNK_LIMIT_BYTES - len(inbox.sensor_bytes)
        inbox.add_sensor_bytes(data[:room], arrival_t_ns)
        self._kept = data[room:]

    def send(self, frames: list[tuple[int, bytes]]) -> tuple[bool, int]:
        """Queue frames in this order; a full queue is a missed command, never sent again."""
        sent = True
        try:
            for can_id, payload in frames:
                sent &= self._bus.send(can_id, payload)
        except LinkError as error:
            self.failure = str(error)
            sent = False
        return sent, now_t_ns()

    def close(self) -> None:
        """Close both."""
        self._arrivals.close()
        self._bus.close()
        self._port.close()
