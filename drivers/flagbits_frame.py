"""Blocks of values whose every byte carries its place in its top bits.

Pure. No checksum: flag bits find the block, a counter finds what was lost, a flipped payload bit stays unseen.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

from drivers import snapshot as snapshots
from drivers.field_values import FieldValues
from drivers.frame_spec import FieldSpec, choice, field_specs, integer, only, wrong
from drivers.reading import FramerCounters, Reading
from drivers.sequence import SequenceTracker


class FlagBitsFramer:
    """Framer of kind flagbits."""

    def __init__(self, table: Mapping[str, Any], *, incremental: bool) -> None:
        """`table` is the profile's [interferometer.frame]; ProfileError where it makes no block.

        `tags` are the top bits of a value's bytes in wire order; the last byte of every value but the first carries
        `more_tag` instead. `values_count` values make a block.
        """
        only(table, {"tag_bits", "tags", "more_tag", "order", "values_count", "fields"}, "frame")
        tag_bits = integer(table, "tag_bits", 2, 1, 4)
        given: Any = table.get("tags", (0, 1, 2))
        highest = (1 << tag_bits) - 1
        listed = cast(Sequence[Any], given) if isinstance(given, list | tuple) else ()
        if not listed or any(not 0 <= int(tag) <= highest for tag in listed):
            raise wrong(
                "frame.tags", table.get("tags"), f"must be a list of numbers within 0 .. {highest}", "correct it"
            )
        tags = tuple(int(tag) for tag in listed)
        more_tag = integer(table, "more_tag", highest, 0, highest)
        if tags[-1] in tags[:-1] or more_tag in tags:
            raise wrong(
                "frame.tags", tags, f"the last one and more_tag ({more_tag}) must differ from all", "correct it"
            )
        specs = field_specs(table, ("int",))
        count = integer(table, "values_count", max(spec.index for spec in specs) + 1, 1, 32)
        for spec in specs:
            if spec.index >= count:
                raise wrong(f"frame.fields ({spec.name}).index", spec.index, f"must be < {count}", "correct it")
        payload_bits = 8 - tag_bits
        self._shift = payload_bits
        self._mask = (1 << payload_bits) - 1
        places = range(len(tags))
        if choice(table, "order", "lsb_first", ("lsb_first", "msb_first")) == "msb_first":
            places = reversed(places)
        self._shifts = [payload_bits * place for place in places]
        self._block = len(tags) * count
        self._pattern = _pattern(tags, more_tag, payload_bits, count)
        self._value_ends = {tags[-1], more_tag}
        self._specs = _with_modulus(specs, payload_bits * len(tags))
        self._values = FieldValues(self._specs)
        self.counters = FramerCounters()
        self._tracker = SequenceTracker(
            self.counters,
            modulus=self._values.modulus,
            confirm=self._values.has_sequence,
            incremental=incremental,
            axes=self._values.axes,
        )
        self._buffer = b""
        self._history = 0  # bytes at the head of the buffer that are counted already
        self._junk = False

    def feed(self, data: bytes) -> list[Reading]:
        """Give the readings that `data` completes."""
        buffer = self._buffer + data
        readings: list[Reading] = []
        pos = scan = self._history
        while (match := self._pattern.search(buffer, scan)) is not None:
            start = match.start()
            # A block counts only behind the end of another value: the end of an ASCII reply cut into a value would
            # otherwise pass for the first byte of the next.
            if start > 0 and buffer[start - 1] >> self._shift not in self._value_ends:
                scan = start + 1
                continue
            self._discard(start - pos)
            pos = scan = match.end()
            if self._junk:
                self._junk = False
                self.counters.resyncs += 1
            values = self._decode(buffer, start)
            if self._values.is_frame(values):
                readings += self._tracker.admit(self._values.frame(values, self._tracker.next_raw))
            else:
                self.counters.field_count_bad += 1
        keep = max(pos, len(buffer) - self._block + 1)
        self._discard(keep - pos)
        self._history = 1 if keep > 0 else 0
        self._buffer = buffer[keep - self._history :]
        return readings

    def _decode(self, buffer: bytes, start: int) -> list[int]:
        mask, shifts = self._mask, self._shifts
        size = len(shifts)
        values: list[int] = []
        for spec in self._specs:
            value = 0
            place = start + spec.index * size
            for shift in shifts:
                value |= (buffer[place] & mask) << shift
                place += 1
            values.append(value)
        return values

    def _discard(self, count: int) -> None:
        if count:
            self.counters.bytes_discarded += count
            self._junk = True

    def snapshot(self) -> bytes:
        """State as JSON bytes."""
        return snapshots.pack(
            "flagbits",
            buffer=self._buffer.hex(),
            history=self._history,
            junk=self._junk,
            tracker=self._tracker.snapshot(),
            counters=self.counters.as_dict(),
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from where `snapshot` was taken; the framer must be made of the same profile."""
        parts = snapshots.unpack("flagbits", snapshot)
        self._buffer = bytes.fromhex(parts["buffer"])
        self._history = int(parts["history"])
        self._junk = bool(parts["junk"])
        self._tracker.restore(parts["tracker"])
        self.counters.restore(parts["counters"])


def _pattern(tags: tuple[int, ...], more_tag: int, payload_bits: int, count: int) -> re.Pattern[bytes]:
    def byte(tag: int) -> bytes:
        low, high = tag << payload_bits, (tag << payload_bits) | ((1 << payload_bits) - 1)
        return rb"[\x%02x-\x%02x]" % (low, high)

    head = b"".join(byte(tag) for tag in tags[:-1])
    return re.compile(head + byte(tags[-1]) + (head + byte(more_tag)) * (count - 1), re.DOTALL)


def _with_modulus(specs: tuple[FieldSpec, ...], bits: int) -> tuple[FieldSpec, ...]:
    """A counter wraps at the width of a value unless the profile says otherwise."""
    return tuple(
        replace(spec, modulus=1 << bits) if spec.role == "sequence" and spec.modulus == 0 else spec for spec in specs
    )
