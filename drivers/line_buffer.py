"""Cuts a byte stream into lines with bounded memory.

Pure; knows no protocol.
"""

from typing import Any

from drivers.reading import FramerCounters

CAPACITY_BYTES = 4096
"""More bytes than this without a delimiter are junk."""


class LineBuffer:
    """Keeps the unfinished line between two reads."""

    def __init__(self, delimiter: bytes, counters: FramerCounters) -> None:
        self._delimiter = delimiter
        self._counters = counters
        self._rest = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """Give the lines that `data` completes, without their delimiter; overlong ones are counted and dropped."""
        text = self._rest + data
        lines = text.split(self._delimiter)
        self._rest = lines.pop()
        if len(text) <= CAPACITY_BYTES and not self._overlong:
            return lines
        if self._overlong and lines:
            self._counters.bytes_discarded += len(lines.pop(0)) + len(self._delimiter)
            self._overlong = False
        if any(len(line) > CAPACITY_BYTES for line in lines):
            for line in lines:
                if len(line) > CAPACITY_BYTES:
                    self._counters.bytes_discarded += len(line) + len(self._delimiter)
            lines = [line for line in lines if len(line) <= CAPACITY_BYTES]
        if len(self._rest) > CAPACITY_BYTES or self._overlong:
            # The last bytes may be the first ones of a delimiter: they stay.
            keep = len(self._delimiter) - 1
            cut = max(len(self._rest) - keep, 0)
            self._counters.bytes_discarded += cut
            self._rest = self._rest[cut:]
            self._overlong = True
        return lines

    def snapshot(self) -> list[Any]:
        """Plain values that `restore` takes."""
        return [self._rest.hex(), self._overlong]

    def restore(self, values: list[Any]) -> None:
        """Go on from where `snapshot` was taken."""
        self._rest = bytes.fromhex(values[0])
        self._overlong = bool(values[1])
