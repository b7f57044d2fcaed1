"""Lines of numbers in ASCII.

Pure. No checksum: a line is believed for its shape, its field count and its sequence number.
"""

import re
from collections.abc import Mapping
from typing import Any

from drivers import snapshot as snapshots
from drivers.field_values import FieldValues
from drivers.frame_spec import field_specs, integer, only, wrong
from drivers.line_buffer import LineBuffer
from drivers.reading import FramerCounters, Reading
from drivers.sequence import SequenceTracker

_INTEGER = rb"(-?[1-9][0-9]*|0)"
_FLOAT = rb"([+-]?[0-9]+(?:\.[0-9]+)?)"
_DIGITS_MOST = 40
"""A longer number is junk."""


class LineFramer:
    """Framer of kind line."""

    def __init__(self, table: Mapping[str, Any], *, incremental: bool) -> None:
        """`table` is the profile's [interferometer.frame]; ProfileError where it makes no line."""
        only(table, {"delimiter", "separator", "columns_count", "ignore_prefix", "fields"}, "frame")
        delimiter = _text(table, "delimiter", "\r\n")
        separator = _text(table, "separator", " ")
        ignore = table.get("ignore_prefix")
        self._ignore = _text(table, "ignore_prefix", "!") if ignore else None
        specs = field_specs(table, ("int", "float"))
        columns = integer(table, "columns_count", max(spec.index for spec in specs) + 1, 1, 256)
        patterns = [rb"([^" + re.escape(separator + delimiter) + rb"]*)"] * columns
        for spec in specs:
            if spec.index >= columns:
                raise wrong(f"frame.fields ({spec.name}).index", spec.index, f"must be < {columns}", "correct it")
            patterns[spec.index] = _INTEGER if spec.type == "int" else _FLOAT
        self._pattern = re.compile(re.escape(separator).join(patterns))
        self._readers = [(spec.index + 1, int if spec.type == "int" else float) for spec in specs]
        self._values = FieldValues(specs)
        self.counters = FramerCounters()
        self._lines = LineBuffer(delimiter, self.counters)
        self._delimiter_bytes = len(delimiter)
        self._tracker = SequenceTracker(
            self.counters,
            modulus=self._values.modulus,
            confirm=self._values.has_sequence,
            incremental=incremental,
            axes=self._values.axes,
        )
        self._junk = False

    def feed(self, data: bytes) -> list[Reading]:
        """Give the readings that `data` completes."""
        readings: list[Reading] = []
        for line in self._lines.feed(data):
            if self._ignore is not None and line.startswith(self._ignore):
                continue
            match = self._pattern.fullmatch(line)
            values = None if match is None else self._read(match)
            if values is None or not self._values.is_frame(values):
                self.counters.field_count_bad += 1
                self.counters.bytes_discarded += len(line) + self._delimiter_bytes
                self._junk = True
                continue
            if self._junk:
                self._junk = False
                self.counters.resyncs += 1
            readings += self._tracker.admit(self._values.frame(values, self._tracker.next_raw))
        return readings

    def _read(self, match: re.Match[bytes]) -> list[Any] | None:
        texts = [match.group(group) for group, _ in self._readers]
        if any(len(text) > _DIGITS_MOST for text in texts):
            return None
        return [reader(text) for text, (_, reader) in zip(texts, self._readers, strict=True)]

    def snapshot(self) -> bytes:
        """State as JSON bytes."""
        return snapshots.pack(
            "line",
            lines=self._lines.snapshot(),
            junk=self._junk,
            tracker=self._tracker.snapshot(),
            counters=self.counters.as_dict(),
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from where `snapshot` was taken; the framer must be made of the same profile."""
        parts = snapshots.unpack("line", snapshot)
        self._lines.restore(parts["lines"])
        self._junk = bool(parts["junk"])
        self._tracker.restore(parts["tracker"])
        self.counters.restore(parts["counters"])


def _text(table: Mapping[str, Any], key: str, default: str) -> bytes:
    value = table.get(key)
    if value is None:
        return default.encode()
    if not isinstance(value, str) or not value or not value.isascii():
        raise wrong(f"frame.{key}", value, "must be ASCII text of at least one character", "correct it")
    return value.encode()
