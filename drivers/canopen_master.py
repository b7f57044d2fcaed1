"""The one file that speaks to the `canopen` library: SDO, NMT, heartbeat and EMCY of the drives.

Runs in the supervisor, never in the servo: every SDO waits for its answer. Process data and the
CiA 402 state machine stay out (`drivers.pdo`, `drivers.cia402`): canopen's own have defects that a
stage can't afford (a quick stop that enables the drive first, frames lost while waiting).
"""

import configparser
import logging
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import can
import canopen
from canopen.objectdictionary import ObjectDictionary, datatypes, import_od
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers import cia402
from stagectl.errors import DriveError, LinkError, ProfileError

NMT_START = 0x01
NMT_STOP = 0x02
NMT_PRE_OPERATIONAL = 0x80
NMT_RESET_NODE = 0x81
NMT_RESET_COMMUNICATION = 0x82

_NMT_NAMES = {
    "start": NMT_START,
    "stop": NMT_STOP,
    "pre-operational": NMT_PRE_OPERATIONAL,
    "reset-node": NMT_RESET_NODE,
    "reset-communication": NMT_RESET_COMMUNICATION,
}

EMERGENCY_LOG_LENGTH = 256
_ANSWER_S = 1.0  # of an SDO; canopen's 0.3 s is too short for a host that does something else
_LACKING_SHOWN = 8  # of the objects that an EDS file lacks: more would bury the sentence
_NAMES_ITS_OBJECT = (0x40, 0x60, 0x80)  # answers to an upload's and a download's begin, abort (CiA 301, 7.2.4.3)
RECEIVER_PERIOD_S = 0.1  # the receiver thread notices a close after this

# Its aborts and timeouts come back as our exceptions; the same text on stderr would be noise.
logging.getLogger("canopen.sdo.client").setLevel(logging.CRITICAL)
logging.getLogger("canopen.objectdictionary.eds").setLevel(logging.CRITICAL)


@dataclass(frozen=True, slots=True)
class Emergency:
    """One EMCY message as received; `t_s` is the master's clock."""

    node_id: int
    code: int
    register: int
    vendor: bytes
    t_s: float

    def __str__(self) -> str:
        text = cia402.emergency_text(self.code)
        return (
            f"node {self.node_id}: EMCY 0x{self.code:04X} {text}, register 0x{self.register:02X}, {self.vendor.hex()}"
        )


class Master:
    """A CANopen master on `bus`; closes it in `close`.

    synchronous: no receiver thread; whoever owns the bus delivers frames by calling `notify`
    (a bus with an `attach(notify)` method is given it), before or while `send` returns.
    clock_s: the clock of heartbeat ages and emergencies, in s; pause: lets that many seconds pass on it.
    """

    def __init__(
        self,
        bus: can.BusABC,
        synchronous: bool = False,
        clock_s: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ):
        self._bus = bus
        self._synchronous = synchronous
        self._clock_s = clock_s
        self.pause = pause
        self._sdo_lock = threading.Lock()  # canopen's SDO client has none
        self._asked: tuple[int, bytes] | None = None  # the object of the SDO under way: node id, index and subindex
        self._given_up: set[tuple[int, bytes]] = set()  # objects whose answer was not waited for to the end
        self._subscribers_lock = threading.Lock()  # nor has its table of subscribers
        self._heartbeat_t_s: dict[int, float] = {}
        self._nmt_state: dict[int, int] = {}
        self._emergencies: deque[Emergency] = deque(maxlen=EMERGENCY_LOG_LENGTH)
        self._nodes: dict[int, canopen.RemoteNode] = {}
        self.error_frames_count = 0
        self.network = canopen.Network(bus)
        self._receiver: threading.Thread | None = None
        self._receiver_error: Exception | None = None
        self._closing = threading.Event()
        if synchronous:
            attach = getattr(bus, "attach", None)
            if attach is not None:
                attach(self.notify)
        else:
            # Not python-can's Notifier: it dies of its first error with no more than a trace on stderr.
            self._receiver = threading.Thread(target=self._receive, name="CANopen receiver", daemon=True)
            self._receiver.start()

    def notify(self, can_id: int, data: bytes, t_s: float = 0.0) -> None:
        """Hand over a received frame (synchronous use)."""
        self.network.notify(can_id, bytearray(data), t_s)

    def add_node(self, node_id: int, eds_path: str | Path) -> None:
        """Make a drive known by its EDS file; ProfileError where the file can't be read. Adding again is harmless."""
        if node_id in self._nodes:
            return
        node = canopen.RemoteNode(node_id, _dictionary(node_id, eds_path))
        # A reply that isn't there when `send` returns never comes: nobody else moves virtual time.
        node.sdo.RESPONSE_TIMEOUT = 0.0 if self._synchronous else _ANSWER_S
        self._nodes[node_id] = node
        with self._subscribers_lock:
            self.network.add_node(node)
            # canopen's consumers keep every emergency for good, and raise on frames of an unexpected length.
            self.network.unsubscribe(0x080 + node_id, node.emcy.on_emcy)
            self.network.unsubscribe(0x700 + node_id, node.nmt.on_heartbeat)
            self.network.unsubscribe(0x000, node.nmt.on_command)
            self.network.unsubscribe(0x580 + node_id, node.sdo.on_response)
            self.network.subscribe(0x580 + node_id, self._on_answer)
            self.network.subscribe(0x080 + node_id, self._on_emergency)
            self.network.subscribe(0x700 + node_id, self._on_heartbeat)

    def nmt(self, node_id: int, command: int | str) -> None:
        """Send an NMT command, a code or a name ("start", "stop", "pre-operational", "reset-node",
        "reset-communication"), to a node, 0 = all. What heartbeats said before it is forgotten."""
        code = _NMT_NAMES[command] if isinstance(command, str) else command
        for known in [node_id] if node_id else list(self._nmt_state):
            self._nmt_state.pop(known, None)
        self._guarded_send(0x000, bytes((code, node_id)))

    def has(self, node_id: int, index: int, subindex: int = 0) -> bool:
        """Return True where the node's EDS file has the object."""
        return _has(self._node(node_id).object_dictionary, index, subindex)

    def indices(self, node_id: int) -> list[int]:
        """Return the indices of all objects in the node's EDS file."""
        return list(self._node(node_id).object_dictionary)

    def read(self, node_id: int, index: int, subindex: int = 0, *, answer_s: float | None = None) -> int:
        """Read an integer object; DriveError with the abort's text, LinkError where nobody answers.

        `answer_s`: wait no longer for another SDO's end and no longer for the answer (in virtual time neither waits).
        """
        signed, _ = self._integer_type(node_id, index, subindex)
        data = self._transfer(node_id, index, subindex, None, answer_s)
        if not data:
            raise DriveError(f"{_place(node_id, index, subindex)}: the drive answered without a value; check its EDS")
        return int.from_bytes(data, "little", signed=signed)

    def write(self, node_id: int, index: int, subindex: int, value: int) -> None:
        """Write an integer object; DriveError with the abort's text, LinkError where nobody answers."""
        signed, length_bytes = self._integer_type(node_id, index, subindex)
        try:
            data = int(value).to_bytes(length_bytes, "little", signed=signed)
        except OverflowError as error:
            raise DriveError(
                f"{_place(node_id, index, subindex)}: {value} doesn't fit its {8 * length_bytes} bits "
                f"({'signed' if signed else 'unsigned'}); correct the profile's value"
            ) from error
        self._transfer(node_id, index, subindex, data)

    def identity(self, node_id: int) -> tuple[int | None, int | None, int | None, int | None]:
        """Return (vendor, product, revision, serial) of 0x1018; None where the drive or its EDS has no such entry."""
        highest = self.read(node_id, cia402.IDENTITY, 0)
        vendor, product, revision, serial = (
            self.read(node_id, cia402.IDENTITY, subindex)
            if subindex <= highest and self.has(node_id, cia402.IDENTITY, subindex)
            else None
            for subindex in (1, 2, 3, 4)
        )
        return vendor, product, revision, serial

    def heartbeat_age_s(self, node_id: int) -> float:
        """Return the time since the last heartbeat or boot-up, inf before the first; LinkError without receiver."""
        self._check_receiver()
        return self._clock_s() - self._heartbeat_t_s.get(node_id, float("-inf"))

    def nmt_state(self, node_id: int) -> int | None:
        """Return the NMT state of the last heartbeat (0 boot-up, 4 stopped, 5 operational, 127 pre-operational)."""
        return self._nmt_state.get(node_id)

    def emergencies(self) -> list[Emergency]:
        """Return the emergency messages since the last call, oldest first (the newest 256 are kept)."""
        taken = []
        while self._emergencies:
            taken.append(self._emergencies.popleft())
        return taken

    def close(self) -> None:
        """Stop the receiver and shut the bus down."""
        self._closing.set()
        if self._receiver is not None:
            self._receiver.join(10.0 * RECEIVER_PERIOD_S)
        self.network.disconnect()

    def _node(self, node_id: int) -> canopen.RemoteNode:
        node = self._nodes.get(node_id)
        if node is None:
            raise DriveError(f"node {node_id} is unknown to the master; add it with its EDS file first")
        return node

    def _integer_type(self, node_id: int, index: int, subindex: int) -> tuple[bool, int]:
        """Return (signed, length in bytes) of an object by its EDS file; DriveError where it isn't an integer there."""
        dictionary = self._node(node_id).object_dictionary
        variable = dictionary.get_variable(index, subindex)
        if variable is None or not _has(dictionary, index, subindex):
            raise DriveError(
                f"{_place(node_id, index, subindex)}: not in the drive's EDS file; "
                "use the EDS of this firmware, or a drive that has the object"
            )
        if variable.data_type not in datatypes.INTEGER_TYPES:
            raise DriveError(
                f"{_place(node_id, index, subindex)}: data type 0x{variable.data_type or 0:X} in the EDS file is no "
                "integer; use the EDS of this firmware"
            )
        return variable.data_type in datatypes.SIGNED_TYPES, len(variable) // 8

    def _transfer(
        self, node_id: int, index: int, subindex: int, data: bytes | None, answer_s: float | None = None
    ) -> bytes:
        """Upload (data None) or download; one at a time."""
        client = self._node(node_id).sdo
        place = _place(node_id, index, subindex)
        self._check_receiver()
        if not self._sdo_lock.acquire(timeout=-1 if answer_s is None else answer_s):
            raise LinkError(f"{place}: another SDO is under way for more than {answer_s:g} s; check the drives")
        asked = self._asked = (node_id, index.to_bytes(2, "little") + bytes((subindex,)))
        patience_s = client.RESPONSE_TIMEOUT
        try:
            if answer_s is not None and not self._synchronous:
                client.RESPONSE_TIMEOUT = answer_s
            if data is None:
                return client.upload(index, subindex)
            client.download(index, subindex, data)
        except SdoAbortedError as error:
            verb = "read" if data is None else f"write of {data.hex(' ')}"
            raise DriveError(f"{place}: the drive refused the {verb}: {error}") from error
        except SdoCommunicationError as error:
            if answer_s is not None:
                self._given_up.add(asked)
            raise LinkError(
                f"{place}: {error}; check the drive's power, node id and bit rate, and the cable's termination"
            ) from error
        except (can.CanError, OSError) as error:
            raise LinkError(f"{place}: {error}; check the adapter and its cable") from error
        finally:
            client.RESPONSE_TIMEOUT = patience_s
            self._sdo_lock.release()
        return b""

    def _on_answer(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Hand an SDO answer on, but for one that comes after it was given up: the next SDO would take it for its own.

        canopen's client takes whatever comes first, and fails where that names another object.
        """
        node_id = can_id - 0x580
        of = (node_id, bytes(data[1:4]))
        if of in self._given_up and of != self._asked and data[0] & 0xE0 in _NAMES_ITS_OBJECT:
            return  # `of` has an index: the frame is not empty
        self._nodes[node_id].sdo.on_response(can_id, data, timestamp)

    def _guarded_send(self, can_id: int, payload: bytes) -> None:
        try:
            self.network.send_message(can_id, payload)
        except (can.CanError, OSError) as error:
            raise LinkError(f"CAN frame 0x{can_id:03X} could not be sent: {error}; check the adapter") from error

    def _check_receiver(self) -> None:
        """Raise LinkError where the receiver thread ended: every answer and heartbeat would be missed for good."""
        if self._receiver is not None and not self._receiver.is_alive():
            cause = self._receiver_error or "the master is closed"
            raise LinkError(f"CAN receiver stopped: {cause}; check the adapter and its cable, then arm again")

    def _receive(self) -> None:
        """Deliver frames until the master closes or the bus fails (thread)."""
        while not self._closing.is_set():
            try:
                message = self._bus.recv(RECEIVER_PERIOD_S)
            except (can.CanError, OSError) as error:
                self._receiver_error = error
                return
            if message is None or message.is_remote_frame:
                continue
            if message.is_error_frame:
                self.error_frames_count += 1
                continue
            with self._subscribers_lock:
                self.network.notify(message.arbitration_id, bytearray(message.data), message.timestamp)

    def _on_heartbeat(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        node_id = can_id - 0x700
        self._heartbeat_t_s[node_id] = self._clock_s()
        if data:
            self._nmt_state[node_id] = data[0] & 0x7F

    def _on_emergency(self, can_id: int, data: bytearray, _timestamp: float) -> None:
        # A payload without even a code is still an emergency: "generic error".
        code, register, vendor = cia402.decode_emergency(bytes(data)) if len(data) >= 2 else (0x1000, 0, b"")
        self._emergencies.append(Emergency(can_id - 0x080, code, register, vendor, self._clock_s()))


def eds_problem(
    eds_path: str | Path, node_id: int, identity: tuple[int, int], objects: Iterable[tuple[int, int]]
) -> str:
    """Say why an EDS file is of no use for a drive, before there is one; empty where nothing is wrong.

    `identity` is (vendor id, product code); a file may leave them out, or 0. `objects` are the (index, subindex) that
    arming reads and writes, all integers. CiA 306: VendorNumber and ProductNumber are 0x1018:01 and :02.
    """
    try:
        dictionary = _dictionary(node_id, eds_path)
    except ProfileError as error:
        return str(error)
    device = dictionary.device_information
    stated = (("VendorNumber", device.vendor_number), ("ProductNumber", device.product_number))
    for wanted, (name, found) in zip(identity, stated, strict=True):
        if found and found != wanted:
            return (
                f"{eds_path}: is of another drive: {name} is 0x{found:X}, the profile's identity says 0x{wanted:X}; "
                "take this drive's EDS, or correct identity"
            )
    lacking = [
        f"0x{index:04X}:{subindex:02X}"
        for index, subindex in objects
        if not _has(dictionary, index, subindex)
        or getattr(dictionary.get_variable(index, subindex), "data_type", None) not in datatypes.INTEGER_TYPES
    ]
    if not lacking:
        return ""
    more = f" and {len(lacking) - _LACKING_SHOWN} more" if len(lacking) > _LACKING_SHOWN else ""
    shown = ", ".join(lacking[:_LACKING_SHOWN]) + more
    return f"{eds_path}: lacks what arming needs, as integers: {shown}; take the EDS of this drive and firmware"


def _dictionary(node_id: int, eds_path: str | Path) -> ObjectDictionary:
    """Read an EDS file. Errors: ProfileError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # how it says that [DeviceInfo] is absent
            return import_od(str(eds_path), node_id)
    except (OSError, ValueError, LookupError, AttributeError, TypeError, configparser.Error) as error:
        reason = str(error).replace("\n", " ")
        raise ProfileError(f"{eds_path}: EDS of node {node_id} can't be read: {reason}; correct the eds key") from error


def _has(dictionary: ObjectDictionary, index: int, subindex: int) -> bool:
    """Return whether the file lists it. Asked directly: canopen's arrays invent members that their file doesn't."""
    entry = dictionary.get(index)
    return entry is not None and subindex in getattr(entry, "subindices", (0,))


def _place(node_id: int, index: int, subindex: int) -> str:
    return f"node {node_id}: 0x{index:04X}:{subindex:02X}"
