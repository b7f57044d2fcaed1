"""How long classic CAN frames take on the wire, and who goes first: exact bits, arbitration by id.

Pure; knows no sockets and no clock.
"""

from collections import deque

from stagectl.compiled import compiled
from stagectl.errors import LinkError

INTERMISSION_BITS = 3
_CRC_POLYNOMIAL = 0x4599  # CRC-15 of ISO 11898-1
_NEVER_NS = 1 << 62
_TRAILER_BITS = 13  # CRC delimiter, ACK slot and delimiter, 7 of end of frame, 3 of intermission: never stuffed


@compiled
def _bits(can_id, data, length):
    """Count the bits of one frame; `data` is the payload as a big-endian integer of 64 bits, signed or not."""
    crc = 0
    run = 0
    last = -1
    count = 0
    head = 19  # SOF 1, id 11, RTR 1, IDE 1, r0 1, DLC 4
    plain = head + 8 * length
    header = (can_id << 7) | length  # SOF and the three flag bits are dominant (0)
    for k in range(plain + 15):
        if k < head:
            bit = (header >> (head - 1 - k)) & 1
        elif k < plain:
            bit = (data >> (plain - 1 - k)) & 1
        else:
            bit = (crc >> (plain + 14 - k)) & 1
        if k < plain:
            carry = ((crc >> 14) & 1) ^ bit
            crc = (crc << 1) & 0x7FFF
            if carry:
                crc ^= _CRC_POLYNOMIAL
        count += 1
        if bit == last:
            run += 1
        else:
            run = 1
            last = bit
        if run == 5:  # five equal bits: a complementary one is stuffed, and counts for the next run
            count += 1
            last = 1 - bit
            run = 1
    return count + _TRAILER_BITS


def frame_bits(can_id: int, payload: bytes) -> int:
    """Return the bits of a classic frame with an 11-bit id on the wire, stuffing and intermission included."""
    if not 0 <= can_id <= 0x7FF or len(payload) > 8:
        raise LinkError(
            f"frame 0x{can_id:X} with {len(payload)} bytes: the bus model knows ids to 0x7FF and 8 bytes; "
            "send classic base frames"
        )
    return _bits(can_id, int.from_bytes(payload, "big", signed=True), len(payload))


class BusModel:
    """One CAN bus: first-in first-out queues of the stations, arbitration between their heads, non-preemptive."""

    def __init__(self, stations_count: int, bit_rate_bit_per_s: float = 1e6, occupied: bool = True) -> None:
        self.busy_ns = 0
        self.frames_count = 0
        self._bit_ns = 1e9 / bit_rate_bit_per_s if occupied else 0.0
        self._free_t_ns = 0
        self._queues: list[deque[tuple[int, int, bytes]]] = [deque() for _ in range(stations_count)]
        self._next: tuple[int, int, int] | None = None  # delivery, free again, station; None = not worked out
        self._start_t_ns = 0  # of the frame in `_next`

    def submit(self, station: int, ready_t_ns: int, can_id: int, payload: bytes) -> None:
        """Queue a frame; it takes part in arbitration from `ready_t_ns`."""
        queue = self._queues[station]
        if not queue and ready_t_ns <= self._start_t_ns:
            self._next = None  # it may be first: a frame behind others, or after the next one's start, is not
        queue.append((ready_t_ns, can_id, payload))

    def queued(self, station: int) -> int:
        """Return how many frames wait at a station, the one on the wire included."""
        return len(self._queues[station])

    def clear(self, station: int) -> int:
        """Drop what waits at a station (bus-off), return how many frames."""
        count = len(self._queues[station])
        self._queues[station].clear()
        self._next = None
        return count

    def next_delivery_t_ns(self) -> int | None:
        """Return when the next frame is received by all (end of frame), None with empty queues."""
        if self._next is None:
            if not any(self._queues):  # asked several times a cycle, mostly of an idle bus
                return None
            self._arbitrate()
        return None if self._next is None else self._next[0]

    def deliver(self) -> tuple[int, int, int, bytes]:
        """Take the next frame off the bus: (delivery instant, station, id, payload)."""
        if self._next is None:
            self._arbitrate()
        if self._next is None:
            raise LinkError("the bus model holds no frame to deliver; ask next_delivery_t_ns first")
        delivery_t_ns, free_t_ns, station = self._next
        ready_t_ns, can_id, payload = self._queues[station].popleft()
        self.busy_ns += free_t_ns - max(self._free_t_ns, ready_t_ns)
        self.frames_count += 1
        self._free_t_ns = free_t_ns
        self._next = None
        return delivery_t_ns, station, can_id, payload

    def _arbitrate(self) -> None:
        """Find the head that wins: the lowest id of those ready when the bus is free."""
        start_t_ns = _NEVER_NS
        heads = []
        for number, queue in enumerate(self._queues):
            if queue:
                ready_t_ns, head_id, data = queue[0]
                heads.append((head_id, ready_t_ns, number, data))
                if ready_t_ns < start_t_ns:
                    start_t_ns = ready_t_ns
        if not heads:
            return
        if start_t_ns < self._free_t_ns:
            start_t_ns = self._free_t_ns
        if len(heads) > 1:
            heads = [min([head for head in heads if head[1] <= start_t_ns])]
        can_id, _, station, payload = heads[0]
        self._start_t_ns = start_t_ns
        if self._bit_ns == 0.0:
            self._next = (start_t_ns, start_t_ns, station)
            return
        bits = frame_bits(can_id, payload)
        delivery_t_ns = start_t_ns + round((bits - INTERMISSION_BITS) * self._bit_ns)
        self._next = (delivery_t_ns, start_t_ns + round(bits * self._bit_ns), station)
