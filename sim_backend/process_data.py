"""PDOs of a rig drive, as mapped by SDO: communication and mapping objects read into a codec.

Written from CiA 301 for the drive's side; shares nothing with the controller's codec. Pure; knows no bus.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from operator import itemgetter

import canopen
from canopen.objectdictionary import ODVariable

from sim_backend.object_dictionary import SIGNED_TYPES, key

ABORT_NOT_MAPPABLE = 0x06040041
ABORT_TOO_LONG = 0x06040042
ABORT_STATE = 0x08000022

_DISABLED_BIT = 0x8000_0000
_LETTERS = {8: "b", 16: "h", 32: "i", 64: "q"}


def _variable(dictionary: canopen.ObjectDictionary, index: int, subindex: int) -> ODVariable | None:
    """Return an object, None where there is none."""
    if index not in dictionary:
        return None
    entry = dictionary[index]
    if isinstance(entry, ODVariable):
        return entry if subindex == 0 else None
    return entry.get(subindex)


def mapping_error(
    dictionary: canopen.ObjectDictionary, objects: Mapping[int, int], index: int, subindex: int, value: int
) -> int:
    """Return the SDO abort code that forbids this write to a mapping object 0x1600/0x1A00, 0 = allowed."""
    if subindex == 0:
        if not objects[key(index - 0x200, 1)] & _DISABLED_BIT:
            return ABORT_STATE  # the PDO must not exist while its mapping changes
        bits = sum(objects[key(index, k)] & 0xFF for k in range(1, value + 1))
        return ABORT_TOO_LONG if bits > 64 else 0
    if objects[key(index, 0)] != 0:
        return ABORT_STATE
    if value == 0:
        return 0
    variable = _variable(dictionary, value >> 16, value >> 8 & 0xFF)
    if variable is None or not variable.pdo_mappable or len(variable) != value & 0xFF:
        return ABORT_NOT_MAPPABLE
    return 0


@dataclass(slots=True)
class ProcessData:
    """One PDO of a node, ready to pack or unpack."""

    cob_id: int
    exists: bool
    transmission_type: int
    inhibit_ns: int
    event_ns: int
    keys: tuple[int, ...]
    codec: struct.Struct
    values_of: Callable[[Mapping[int, int]], tuple[int, ...]]  # the values of `keys`
    pending: tuple[int, ...] | None = field(default=None)  # RPDO: received, waits for its SYNC
    last_payload: bytes = b""  # TPDO: what was sent last
    last_sent_t_ns: int = -(1 << 62)
    due_t_ns: int | None = None  # TPDO: held back by the inhibit time until then

    @property
    def synchronous(self) -> bool:
        """Tell whether SYNC triggers it."""
        return self.transmission_type <= 240

    def payload(self, objects: Mapping[int, int]) -> bytes:
        """Pack the present values."""
        return self.codec.pack(*self.values_of(objects))


def _getter(keys: list[int]) -> Callable[[Mapping[int, int]], tuple[int, ...]]:
    """Return the quickest way from objects to the tuple of their values."""
    if len(keys) > 1:
        return itemgetter(*keys)
    return lambda objects: tuple([objects[k] for k in keys])


def read(
    dictionary: canopen.ObjectDictionary, objects: Mapping[int, int], communication: int, mapping: int
) -> ProcessData:
    """Build a PDO from its objects (0x1400 with 0x1600, 0x1800 with 0x1A00)."""
    keys: list[int] = []
    letters = "<"
    for k in range(1, objects[key(mapping, 0)] + 1):
        entry = objects[key(mapping, k)]
        variable = _variable(dictionary, entry >> 16, entry >> 8 & 0xFF)
        if variable is None:
            continue
        letter = _LETTERS[entry & 0xFF]
        letters += letter if variable.data_type in SIGNED_TYPES else letter.upper()
        keys.append(entry >> 8)
    cob_id = objects[key(communication, 1)]
    return ProcessData(
        cob_id=cob_id & 0x7FF,
        exists=not cob_id & _DISABLED_BIT,
        transmission_type=objects[key(communication, 2)],
        inhibit_ns=100_000 * objects.get(key(communication, 3), 0),  # CiA 301: multiples of 100 us
        event_ns=1_000_000 * objects.get(key(communication, 5), 0),
        keys=tuple(keys),
        codec=struct.Struct(letters),
        values_of=_getter(keys),
    )
