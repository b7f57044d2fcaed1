"""The cyclic CAN socket of the servo, and the second socket on the same bus that the supervisor's master uses.

Raw frames in Linux `struct can_frame` layout over SocketCAN or over the AF_UNIX hub; python-can only for
`virtual`, and loaded only then: the servo's process must not carry its threads and locks.
"""

import errno
import socket
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Protocol

from drivers.can_frame import ERROR_FLAG, EXTENDED_FLAG, FILTER, FRAME, REMOTE_FLAG, STANDARD_MASK
from drivers.hub_socket import connect_hub, filter_packet
from stagectl.errors import LinkError

if TYPE_CHECKING:
    import can

# In a filter's mask these flags let standard data frames pass and nothing else. The error flag is
# missing on purpose: the kernel keeps error frames in a list of their own, and reads the flag in a
# mask as "this filter is for error frames".
DATA_FRAME_MASK = STANDARD_MASK | EXTENDED_FLAG | REMOTE_FLAG

ERROR_CLASSES_ALL = 0x1FFFFFFF
_CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h; Python's socket module lacks it
_PACKET_LIMIT_BYTES = 64  # longer than a frame: a read of exactly 16 would pass the head of anything as a frame
SEND_BUFFER_BYTES = 4096  # about ten frames after the kernel's doubling: a queued torque command is a stale one

INTERFACES = ("socketcan", "hub", "stagectl-hub", "virtual")

# Ids 0x081 .. 0x0FF (EMCY) as masks that leave out 0x080: SYNC would wake the supervisor every cycle.
_EMERGENCY_FILTERS = tuple((0x080 | 1 << bit, STANDARD_MASK & ~((1 << bit) - 1)) for bit in range(7))

NETWORK_FILTERS = (
    (0x000, 0x7FF),  # NMT commands of others
    *_EMERGENCY_FILTERS,
    (0x580, 0x780),  # SDO answers
    (0x700, 0x780),  # heartbeats and boot-up
)
"""(id, mask) of what a CANopen master needs; process data never wake it."""


class CyclicBus(Protocol):
    """Frames of chosen ids, without waiting and without a thread."""

    lost_count: int
    """Frames that could not be queued; each is a missed command, never sent again."""

    def receive(self) -> tuple[int, bytes] | None:
        """Return (id, payload) of the next frame, None when there is none; an error frame has ERROR_FLAG in its id."""
        ...

    def send(self, can_id: int, payload: bytes) -> bool:
        """Queue a frame; False, and counted, when the queue is full."""
        ...

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        ...

    def close(self) -> None:
        """Close the socket; closing twice is harmless."""
        ...


class SocketCyclicBus:
    """A `CyclicBus` over a connected or bound socket that carries whole 16-byte frames."""

    __slots__ = ("_socket", "lost_count", "place")

    def __init__(self, opened: socket.socket, place: str):
        """Take over `opened`; `place` names it in errors."""
        self._socket = opened
        self.place = place
        self.lost_count = 0
        opened.setblocking(False)

    def receive(self) -> tuple[int, bytes] | None:
        """See `CyclicBus.receive`; LinkError where the bus is gone or speaks another layout."""
        try:
            packet = self._socket.recv(_PACKET_LIMIT_BYTES)
        except BlockingIOError:
            return None
        except OSError as error:
            raise LinkError(_lost_text(self.place, error)) from error
        if len(packet) != FRAME.size:
            raise LinkError(_packet_text(self.place, packet))
        can_id, length, data = FRAME.unpack(packet)
        return can_id, data[:length]

    def send(self, can_id: int, payload: bytes) -> bool:
        """See `CyclicBus.send`; LinkError where the bus is gone."""
        length = len(payload)
        if length > 8:  # struct would cut it without a word
            raise LinkError(
                f"{self.place}: payload of {length} bytes, a classic CAN frame carries 8; map fewer objects"
            )
        try:
            self._socket.send(FRAME.pack(can_id, length, payload))
        except OSError as error:
            # EAGAIN: the socket's own buffer is full; ENOBUFS: the interface's queue is.
            if error.errno not in (errno.EAGAIN, errno.ENOBUFS):
                raise LinkError(_lost_text(self.place, error)) from error
            self.lost_count += 1
            return False
        return True

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class PythonCanCyclicBus:
    """A `CyclicBus` over python-can's in-process `virtual` interface, for tests."""

    def __init__(self, bus: "can.BusABC", ids: Iterable[int]):
        """Take over `bus`; frames outside `ids` are dropped here (an empty python-can filter passes everything)."""
        self._bus = bus
        self._ids = frozenset(ids)
        self.lost_count = 0

    def receive(self) -> tuple[int, bytes] | None:
        """See `CyclicBus.receive`."""
        while (message := self._bus.recv(0)) is not None:
            if message.is_error_frame:
                return message.arbitration_id | ERROR_FLAG, bytes(message.data)
            standard_data = not (message.is_extended_id or message.is_remote_frame)
            if standard_data and message.arbitration_id in self._ids:
                return message.arbitration_id, bytes(message.data)
        return None

    def send(self, can_id: int, payload: bytes) -> bool:
        """See `CyclicBus.send`."""
        import can

        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=payload, is_extended_id=False), timeout=0)
        except can.CanError:
            self.lost_count += 1
            return False
        return True

    def fileno(self) -> int:
        """Refuse: the interface is a queue in this process."""
        raise LinkError("the `virtual` interface has no descriptor to wait on; poll receive(), or use the hub")

    def close(self) -> None:
        """Shut the python-can bus down."""
        self._bus.shutdown()


def open_cyclic(interface: str, channel: str, ids: Iterable[int]) -> CyclicBus:
    """Open the servo's socket: it receives the standard data frames of `ids`, and error frames; LinkError."""
    wanted = [(can_id, DATA_FRAME_MASK) for can_id in ids]
    match interface:
        case "socketcan":
            return SocketCyclicBus(_open_socketcan(channel, wanted), f"CAN interface {channel}")
        case "hub" | "stagectl-hub":
            opened = connect_hub(channel)
            # Unlike the kernel, the hub keeps one list: the error flag in a mask keeps error frames from
            # passing as data, and one filter asks for them.
            filters = [(can_id, mask | ERROR_FLAG) for can_id, mask in wanted] + [(ERROR_FLAG, ERROR_FLAG)]
            opened.send(filter_packet(filters))
            return SocketCyclicBus(opened, f"CAN hub {channel}")
        case "virtual":
            return PythonCanCyclicBus(_open_python_can("virtual", channel, None), ids)
    raise LinkError(_interface_text(interface))


def open_network(interface: str, channel: str) -> "can.BusABC":
    """Open the master's bus (SDO, NMT, heartbeat, EMCY only) as a python-can bus; LinkError."""
    filters = [{"can_id": can_id, "can_mask": mask, "extended": False} for can_id, mask in NETWORK_FILTERS]
    match interface:
        case "socketcan":
            _check_socketcan(channel)
            return _open_python_can("socketcan", channel, filters)
        case "hub" | "stagectl-hub":
            from drivers.hub_bus import HubBus

            return HubBus(channel, can_filters=filters)
        case "virtual":
            return _open_python_can("virtual", channel, filters)
    raise LinkError(_interface_text(interface))


def _open_socketcan(channel: str, filters: list[tuple[int, int]]) -> socket.socket:
    """Open a raw CAN socket with kernel filters, error frames and a short send buffer; LinkError."""
    _check_socketcan(channel)
    opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        packed = b"".join(FILTER.pack(can_id, mask) for can_id, mask in filters)
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
        opened.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, ERROR_CLASSES_ALL)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        opened.bind((channel,))
    except OSError as error:
        opened.close()
        raise LinkError(_socketcan_text(channel, error)) from error
    return opened


def _check_socketcan(channel: str) -> None:
    """Raise LinkError where this kernel has no SocketCAN or no such interface."""
    if not hasattr(socket, "AF_CAN"):
        raise LinkError(f"CAN interface {channel}: this Python has no SocketCAN; run on Linux, or use the rig's hub")
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        socket.if_nametoindex(channel)
    except OSError as error:
        raise LinkError(_socketcan_text(channel, error)) from error


def _open_python_can(interface: str, channel: str, filters: Any) -> "can.BusABC":
    """Open a python-can bus from these arguments alone; LinkError."""
    import can

    try:
        # Without ignore_config a ~/.canrc may change a bus that is addressed in full.
        return can.Bus(interface=interface, channel=channel, ignore_config=True, can_filters=filters)
    except (can.CanError, OSError) as error:
        raise LinkError(f"CAN interface {interface} {channel}: {error}; check can.interface and can.channel") from error


def _interface_text(interface: str) -> str:
    return f"can.interface = {interface!r} is not one of {', '.join(INTERFACES)}; correct the profile"


def _socketcan_text(channel: str, error: OSError) -> str:
    if error.errno == errno.EAFNOSUPPORT:
        return f"CAN interface {channel}: this kernel has no SocketCAN; load the module can_raw, or use the rig's hub"
    return (
        f"CAN interface {channel}: {error.strerror or error}; check `ip link show {channel}`, "
        f"then `ip link set {channel} up type can bitrate 1000000`"
    )


def _lost_text(place: str, error: OSError) -> str:
    return f"{place}: {error.strerror or error}; check the adapter and its cable, then arm again"


def _packet_text(place: str, packet: bytes) -> str:
    if not packet:
        return f"{place}: the other end closed; start it again, then arm again"
    return f"{place}: packet of {len(packet)} bytes, a CAN frame has {FRAME.size}; something else speaks there"
