"""Process data: payload bytes to and from named slots, generated from the mapping read back from a drive.

Pure; knows no bus and no clock. Layout: CiA 301, little endian, first mapped object in the lowest bytes.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from drivers import cia402
from stagectl.errors import LinkError, RequestError

# Slot name and signedness of the objects that CiA 402 lets us map.
_SLOTS = {
    (cia402.CONTROLWORD, 0): ("controlword", False),
    (cia402.STATUSWORD, 0): ("statusword", False),
    (cia402.MODES_OF_OPERATION, 0): ("mode", True),
    (cia402.MODES_OF_OPERATION_DISPLAY, 0): ("mode_display", True),
    (cia402.POSITION_ACTUAL_VALUE, 0): ("position", True),
    (cia402.TARGET_TORQUE, 0): ("target_torque", True),
    (cia402.TORQUE_ACTUAL_VALUE, 0): ("torque", True),
    (cia402.TARGET_POSITION, 0): ("target_position", True),
    (cia402.TORQUE_OFFSET, 0): ("torque_offset", True),
    (cia402.DIGITAL_INPUTS, 0): ("digital_inputs", False),
}

_FORMATS = {
    **{(8, False): "B", (8, True): "b", (16, False): "H", (16, True): "h"},
    **{(32, False): "I", (32, True): "i", (64, False): "Q", (64, True): "q"},
}

PAYLOAD_LIMIT_BYTES = 8


@dataclass(frozen=True, slots=True)
class Entry:
    """One mapped object."""

    index: int
    subindex: int
    bits: int
    signed: bool

    @property
    def word(self) -> int:
        """The entry as a PDO mapping parameter holds it: index << 16 | sub-index << 8 | length in bits."""
        return self.index << 16 | self.subindex << 8 | self.bits

    @property
    def name(self) -> str:
        """The slot's name."""
        known = _SLOTS.get((self.index, self.subindex))
        return known[0] if known else f"object_{self.index:04x}_{self.subindex:02x}"


def entry_of(mapping_word: int) -> Entry:
    """Return the entry that a mapping word describes; objects outside CiA 402's table are taken as unsigned."""
    index, subindex, bits = mapping_word >> 16, mapping_word >> 8 & 0xFF, mapping_word & 0xFF
    known = _SLOTS.get((index, subindex))
    return Entry(index, subindex, bits, known[1] if known else False)


class Codec:
    """Packs and unpacks one PDO; picklable, so that it can cross to another process."""

    __slots__ = ("_pack", "_unpack_from", "entries", "length_bytes", "names")

    def __init__(self, entries: Iterable[Entry]):
        """Compile the layout; LinkError where an entry is not 8, 16, 32 or 64 bits or the sum passes 8 bytes."""
        self.entries = tuple(entries)
        self.names = tuple(entry.name for entry in self.entries)
        layout = "<"
        for entry in self.entries:
            letter = _FORMATS.get((entry.bits, entry.signed))
            if letter is None:
                raise LinkError(
                    f"PDO mapping of 0x{entry.index:04X}:{entry.subindex:02X} has {entry.bits} bits, "
                    "8, 16, 32 or 64 are allowed; map whole bytes only"
                )
            layout += letter
        compiled_layout = struct.Struct(layout)
        self.length_bytes = compiled_layout.size
        if self.length_bytes > PAYLOAD_LIMIT_BYTES:
            raise LinkError(
                f"PDO mapping {self.names} needs {self.length_bytes} bytes, a classic CAN frame carries "
                f"{PAYLOAD_LIMIT_BYTES}; map fewer objects"
            )
        self._pack = compiled_layout.pack
        self._unpack_from = compiled_layout.unpack_from

    @classmethod
    def from_mapping(cls, mapping_words: Iterable[int]) -> "Codec":
        """Build the codec from mapping words as read from 0x1600 / 0x1A00."""
        return cls(entry_of(word) for word in mapping_words)

    def __reduce__(self):
        """Pickle as the entries alone: a compiled layout can't be pickled."""
        return Codec, (self.entries,)

    def __eq__(self, other: object) -> bool:
        """Two codecs are equal when their layouts are."""
        return isinstance(other, Codec) and self.entries == other.entries

    def __hash__(self) -> int:
        return hash(self.entries)

    def __repr__(self) -> str:
        return f"Codec({', '.join(f'{e.name}:{e.bits}' for e in self.entries)})"

    def slot(self, name: str) -> int:
        """Return the place of a slot in the tuple; LinkError where the mapping lacks it."""
        if name not in self.names:
            raise LinkError(f"the PDO carries {self.names}, not {name!r}; map the object that gives it")
        return self.names.index(name)

    def decode(self, payload: bytes) -> tuple[int, ...]:
        """Return all slots; a payload shorter than the mapping raises LinkError before any value is touched.

        Bytes beyond the mapping are ignored, as CiA 301 allows (some drives always send 8).
        """
        try:
            return self._unpack_from(payload)
        except struct.error:
            raise LinkError(
                f"PDO of {len(payload)} bytes, its mapping {self.names} needs {self.length_bytes}; "
                "the drive's mapping changed: arm again"
            ) from None

    def encode(self, *values: int) -> bytes:
        """Return the payload; a missing, fractional or out-of-range value raises RequestError."""
        try:
            return self._pack(*values)
        except struct.error:
            raise RequestError(self._complaint(values)) from None

    def _complaint(self, values: tuple[int, ...]) -> str:
        """Say which value doesn't fit its slot."""
        if len(values) != len(self.entries):
            return f"PDO needs {len(self.entries)} values {self.names}, {len(values)} were given"
        for entry, value in zip(self.entries, values, strict=True):
            low = -(1 << entry.bits - 1) if entry.signed else 0
            high = (1 << entry.bits - entry.signed) - 1
            if not hasattr(value, "__index__"):
                return f"{entry.name} = {value!r} is not a whole number; round it before it is encoded"
            if not low <= value <= high:
                return f"{entry.name} = {value} is outside {low} .. {high}; limit it before it is encoded"
        return f"values {values} don't fit {self!r}"
