"""What the service did, numbered: lines of JSON for the journal, and the last of them for clients."""

import json
import sys
import threading
from collections import deque
from datetime import UTC, datetime
from typing import Any, TextIO

from stagectl.service.messages import LogEntry

KEPT_COUNT = 2000


def now_text() -> str:
    """Return the time of day, UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class ServiceLog:
    """Takes entries from any thread; never grows."""

    def __init__(self, sink: TextIO | None = sys.stderr):
        """Write lines to `sink` (None: nowhere)."""
        self._sink = sink
        self._entries: deque[LogEntry] = deque(maxlen=KEPT_COUNT)
        self._count = 0
        self._lock = threading.Lock()

    def say(self, event: str, text: str = "", **fields: Any) -> LogEntry:
        """Keep an entry and write its line."""
        with self._lock:
            self._count += 1
            entry = LogEntry(number=self._count, at=now_text(), event=event, text=text, fields=fields)
            self._entries.append(entry)
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
            return [entry for entry in self._entries if entry.number > number][:limit]

    def last(self, limit: int) -> list[LogEntry]:
        """Return the newest entries, oldest first."""
        with self._lock:
            return list(self._entries)[-limit:]
