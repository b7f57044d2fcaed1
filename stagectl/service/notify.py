"""What systemd hears (sd_notify(3)): ready, what is going on, and that the watchdog may rest.

Without NOTIFY_SOCKET, outside systemd, everything here does nothing.
"""

import contextlib
import os
import socket
import time
from collections.abc import Callable


class Notifier:
    """Sends datagrams to $NOTIFY_SOCKET; feeds the watchdog of $WATCHDOG_USEC, and only for news."""

    def __init__(self, environment: os._Environ | dict = os.environ, clock_s: Callable[[], float] = time.monotonic):
        """Read the environment."""
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self.watchdog_us = int(environment.get("WATCHDOG_USEC", "0") or 0)
        self._clock_s, self._fed_s, self._fed_at = clock_s, -1e9, -1

    def say(self, **fields: object) -> None:
        """Send fields such as READY=1 or STATUS=text; a manager that does not listen is no reason to fail."""
        if self._address:
            text = "\n".join(f"{name}={str(value).replace(chr(10), ' ')}" for name, value in fields.items())
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as telling:
                telling.setblocking(False)
                telling.sendto(text.encode(), self._address)

    def feed(self, cycles_count: int) -> None:
        """Feed the watchdog, four times as often as needed; not while the count of cycles stands still."""
        if self.watchdog_us == 0 or cycles_count == self._fed_at:
            return
        now_s = self._clock_s()
        if now_s - self._fed_s >= 0.25e-6 * self.watchdog_us:
            self._fed_s, self._fed_at = now_s, cycles_count
            self.say(WATCHDOG=1)

    def allow(self, duration_s: float) -> None:
        """Give the watchdog patience for something that takes long, such as compiling; 0 takes it back."""
        if self.watchdog_us:
            self.say(WATCHDOG=1, WATCHDOG_USEC=max(round(duration_s * 1e6), self.watchdog_us))
