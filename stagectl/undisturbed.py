"""A stretch of code that no Ctrl-C may split: signals wait until its end. Knows neither rows nor runs."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Put off SIGINT, SIGTERM, SIGHUP and SIGALRM; outside the main thread, which alone handles signals, do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard: list[tuple[int, FrameType | None]] = []
    before = {}
    for number in _NUMBERS:
        handler = signal.getsignal(number)
        if callable(handler):  # what the system does by itself (ignore, end the process) stays as it is
            before[number] = handler
            signal.signal(number, lambda got, frame: heard.append((got, frame)))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in heard:
            before[number](number, frame)
