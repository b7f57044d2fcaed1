"""Frames of fixed length that begin with a sync pattern and end with a checksum.

Pure; without a checksum a frame is believed when the next sync follows it, one sample late.
"""

import struct
from collections.abc import Mapping
from typing import Any

from drivers import snapshot as snapshots
from drivers.checksums import CHECKSUMS
from drivers.field_values import FieldValues
from drivers.frame_spec import FieldSpec, choice, field_specs, integer, only, wrong
from drivers.reading import FramerCounters, Reading
from drivers.sequence import SequenceTracker

_FORMATS = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "i64": "q", "f32": "f", "f64": "d"}  # fmt: skip  # noqa: E501


class SyncFixedFramer:
    """Framer of kind syncfixed."""

    def __init__(self, table: Mapping[str, Any], *, incremental: bool) -> None:
        """`table` is the profile's [interferometer.frame]; ProfileError where it makes no frame."""
        only(table, {"sync", "length", "endian", "checksum", "fields"}, "frame")
        self._sync = _sync(table)
        self._length = integer(table, "length", 0, len(self._sync) + 1, 4096)
        if self._length == 0:
            raise wrong("frame.length", None, "is missing", "give the frame's length in bytes, sync and checksum in it")
        order = "<" if choice(table, "endian", "little", ("little", "big")) == "little" else ">"
        name = choice(table, "checksum", "none", ("none", *CHECKSUMS))
        checksum_bytes, self._checksum = CHECKSUMS.get(name, (0, None))
        self._body = self._length - checksum_bytes
        self._checksum_struct = struct.Struct(order + "xBH"[checksum_bytes])
        # Without a checksum only the next frame's sync tells whether a byte was lost inside this one.
        self._needed = self._length if self._checksum else self._length + len(self._sync)
        specs = tuple(sorted(field_specs(table, tuple(_FORMATS)), key=lambda spec: spec.offset))
        self._struct = _layout(order, specs, len(self._sync), self._body)
        self._values = FieldValues(specs)
        self.counters = FramerCounters()
        self._tracker = SequenceTracker(
            self.counters,
            modulus=self._values.modulus,
            confirm=self._values.has_sequence and self._checksum is None,
            incremental=incremental,
            axes=self._values.axes,
        )
        self._buffer = b""
        self._junk = False

    def feed(self, data: bytes) -> list[Reading]:
        """Give the readings that `data` completes."""
        buffer = self._buffer + data if self._buffer else bytes(data)
        readings: list[Reading] = []
        sync, end, pos = self._sync, len(buffer), 0
        while True:
            start = buffer.find(sync, pos)
            if start < 0:
                start = end - _prefix_at_end(buffer, pos, sync)
                self._discard(start - pos)
                pos = start
                break
            self._discard(start - pos)
            pos = start
            if end - pos < self._needed:
                break
            if self._take(buffer, pos, readings):
                pos += self._length
            else:
                self._discard(1)
                pos += 1
        self._buffer = buffer[pos:]
        return readings

    def _take(self, buffer: bytes, pos: int, readings: list[Reading]) -> bool:
        if self._checksum is None:
            if not buffer.startswith(self._sync, pos + self._length):
                return False
        else:
            body_end = pos + self._body
            (sent,) = self._checksum_struct.unpack_from(buffer, body_end)
            if self._checksum(buffer[pos:body_end]) != sent:
                self.counters.checksum_bad += 1
                return False
        values = self._struct.unpack_from(buffer, pos)
        if not self._values.is_frame(values):
            return False
        if self._junk:
            self._junk = False
            self.counters.resyncs += 1
        readings += self._tracker.admit(self._values.frame(values, self._tracker.next_raw))
        return True

    def _discard(self, count: int) -> None:
        if count:
            self.counters.bytes_discarded += count
            self._junk = True

    def snapshot(self) -> bytes:
        """State as JSON bytes."""
        return snapshots.pack(
            "syncfixed",
            buffer=self._buffer.hex(),
            junk=self._junk,
            tracker=self._tracker.snapshot(),
            counters=self.counters.as_dict(),
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from where `snapshot` was taken; the framer must be made of the same profile."""
        parts = snapshots.unpack("syncfixed", snapshot)
        self._buffer = bytes.fromhex(parts["buffer"])
        self._junk = bool(parts["junk"])
        self._tracker.restore(parts["tracker"])
        self.counters.restore(parts["counters"])


def _sync(table: Mapping[str, Any]) -> bytes:
    text = table.get("sync")
    try:
        sync = bytes.fromhex(text) if isinstance(text, str) else b""
    except ValueError:
        sync = b""
    if not 1 <= len(sync) <= 64:
        raise wrong("frame.sync", text, "must be 1 .. 64 bytes in hexadecimal", 'write for example "a55a"')
    return sync


def _layout(order: str, specs: tuple[FieldSpec, ...], begin: int, end: int) -> struct.Struct:
    """One struct for the whole frame, padding where no field lies."""
    text, place = order, 0
    for spec in specs:
        size = struct.calcsize(order + _FORMATS[spec.type])
        if not max(place, begin) <= spec.offset <= end - size:
            limit = f"must lie within bytes {max(place, begin)} .. {end - 1}, behind the sync and the field before it"
            raise wrong(f"frame.fields ({spec.name}).offset", spec.offset, limit, "correct offset, type or length")
        text += f"{spec.offset - place}x{_FORMATS[spec.type]}"
        place = spec.offset + size
    return struct.Struct(text)


def _prefix_at_end(buffer: bytes, pos: int, sync: bytes) -> int:
    """Length of the longest end of `buffer` (from `pos`) that may be the beginning of a sync."""
    for length in range(min(len(sync) - 1, len(buffer) - pos), 0, -1):
        if buffer.endswith(sync[:length]):
            return length
    return 0
