"""What the service did, numbered: lines of JSON for the journal, and the last of them for clients.

What is kept is kept as text in memory of one size: as objects the last 2000 took 3 MB, an hour after the start.
"""

import json
import sys
import threading
from datetime import UTC, datetime
from typing import Any, TextIO

import numpy as np

from stagectl.service.messages import LogEntry

KEPT_COUNT = 2000
_ENTRY_BYTES = 1 << 16  # beyond it an entry is cut for clients; the journal has it whole
_CUT_COUNT = 4000
KEPT_BYTES = 1 << 20
"""Of all texts together: 500 bytes for each, four times what a command takes."""


def now_text() -> str:
    """Return the time of day, UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class ServiceLog:
    """Takes entries from any thread; never grows."""

    def __init__(self, sink: TextIO | None = sys.stderr):
        """Write lines to `sink` (None: nowhere)."""
        self._sink = sink
        self._text = bytearray(b" " * KEPT_BYTES)
        self._next_byte = 0  # of all that were ever written; the place in `_text` is its remainder
        self._places = np.zeros((KEPT_COUNT, 2), np.int64)  # first byte and length of an entry
        self._count = 0
        self._lock = threading.Lock()

    def say(self, event: str, text: str = "", **fields: Any) -> LogEntry:
        """Keep an entry and write its line."""
        with self._lock:
            self._count += 1
            entry = LogEntry(number=self._count, at=now_text(), event=event, text=text, fields=fields)
            self._keep(entry)
        if self._sink is not None:
            line = {"event": event, "at": entry.at, "text": text, **fields}
            try:
                self._sink.write(json.dumps(line, default=str, ensure_ascii=False) + "\n")
                self._sink.flush()
            except (OSError, ValueError):  # a journal that is gone must not stop what moves
                self._sink = None
        return entry

    def after(self, number: int, limit: int) -> list[LogEntry]:
        """Return the oldest entries behind `number`, `limit` at most."""
        with self._lock:
            oldest = self._count - self._kept_count() + 1
            return [self._entry(k) for k in range(max(number + 1, oldest), self._count + 1)[:limit]]

    def last(self, limit: int) -> list[LogEntry]:
        """Return the newest entries, oldest first."""
        with self._lock:
            count = min(limit, self._kept_count())
            return [self._entry(k) for k in range(self._count - count + 1, self._count + 1)]

    def _keep(self, entry: LogEntry) -> None:
        content = json.dumps([entry.at, entry.event, entry.text, entry.fields], default=str).encode()
        if len(content) > _ENTRY_BYTES:
            content = json.dumps([entry.at, entry.event, entry.text[:_CUT_COUNT], {}]).encode()
        if self._next_byte % KEPT_BYTES + len(content) > KEPT_BYTES:  # an entry lies in one piece
            self._next_byte += KEPT_BYTES - self._next_byte % KEPT_BYTES
        place = self._next_byte % KEPT_BYTES
        self._text[place : place + len(content)] = content
        self._places[entry.number % KEPT_COUNT] = self._next_byte, len(content)
        self._next_byte += len(content)

    def _kept_count(self) -> int:
        """Return how many of the newest entries were not written over."""
        first_bytes, lengths = self._places.T
        return int(np.count_nonzero((lengths > 0) & (first_bytes >= self._next_byte - KEPT_BYTES)))

    def _entry(self, number: int) -> LogEntry:
        first_byte, length = self._places[number % KEPT_COUNT].tolist()
        place = first_byte % KEPT_BYTES
        at, event, text, fields = json.loads(self._text[place : place + length])
        return LogEntry(number=number, at=at, event=event, text=text, fields=fields)
