"""The service's stream, heard once and passed on to every page as it came; the last half minute for who comes late."""

import asyncio
import contextlib
import json
from collections import deque
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import websockets

RATE_HZ = 10.0
KEPT_COUNT = 3000
"""Half a minute of the service's samples."""

_AGAIN_S = 1.0
_BEHIND_MOST = 100
_MESSAGE_MOST_BYTES = 4 * 1024 * 1024
_LOST = json.dumps({"lost": "the service doesn't answer; is `stagectl serve` running?"})


class Feed:
    """One connection to the service, however many pages listen; a page that doesn't read is let go of."""

    def __init__(self, socket_path: Path):
        """Connect to nothing before `work`."""
        self._path = socket_path
        self._rows: deque[list[float | None]] = deque(maxlen=KEPT_COUNT)
        self._newest: dict[str, Any] | None = None
        self._pages: set[asyncio.Queue[str | None]] = set()

    @property
    def pages_count(self) -> int:
        """How many pages listen."""
        return len(self._pages)

    async def work(self) -> None:
        """Hear the service until cancelled; connects again and again where it is not there."""
        uri = f"ws://stagectl/v1/stream?rate_hz={RATE_HZ:g}"
        while True:
            with contextlib.suppress(OSError, TimeoutError, websockets.WebSocketException):
                async with websockets.unix_connect(str(self._path), uri, max_size=_MESSAGE_MOST_BYTES) as stream:
                    async for message in stream:
                        self._take(message if isinstance(message, str) else message.decode())
            self._newest = None
            self._pass_on(_LOST)
            await asyncio.sleep(_AGAIN_S)

    def _take(self, text: str) -> None:
        newest = self._newest = json.loads(text)
        rows = newest["samples"]["rows"]
        if rows and self._rows and rows[0][0] <= self._rows[-1][0]:
            self._rows.clear()  # another servo, with a clock of its own
        self._rows.extend(rows)
        self._pass_on(text)

    def _pass_on(self, text: str) -> None:
        for page in list(self._pages):
            if page.qsize() >= _BEHIND_MOST:
                self._pages.discard(page)
                page.put_nowait(None)
            else:
                page.put_nowait(text)

    async def listen(self) -> AsyncIterator[str]:
        """Say what was, then what comes; ends for a page that falls behind."""
        page: asyncio.Queue[str | None] = asyncio.Queue()
        page.put_nowait(self._story())
        self._pages.add(page)
        try:
            while (text := await page.get()) is not None:
                yield text
        finally:
            self._pages.discard(page)

    def _story(self) -> str:
        if self._newest is None:
            return _LOST
        samples = {**self._newest["samples"], "rows": list(self._rows)}
        return json.dumps({**self._newest, "samples": samples})
