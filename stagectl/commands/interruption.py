"""Ctrl-C and SIGTERM: heard at the next point where nothing is half done, and only once."""

import signal
from types import FrameType

_PATIENCE_S = 1.0


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM, heard.

    Not KeyboardInterrupt itself: where that passes through an import in C, CPython ends the process by SIGINT at last,
    whatever exit code it was given (unhandled_keyboard_interrupt in its runtime).
    """


class Interruption:
    """A context in which the first signal becomes a KeyboardInterrupt from `check`, and later ones are ignored.

    Where nobody calls `check` for a second (a drive that answers slowly), the interrupt is raised right there.
    After `hush` nothing interrupts any more: coming to rest and closing the run go on undisturbed.
    """

    def __init__(self) -> None:
        """Hear nothing yet."""
        self._asked = False
        self._raised = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> "Interruption":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._hear)
        self._before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._lose_patience)
        return self

    def __exit__(self, kind, error, trace) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in self._before.items():
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]

    def check(self) -> None:
        """Raise KeyboardInterrupt where one was asked for and none was raised yet."""
        if self._asked and not self._raised:
            self._raised = True
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            raise Interrupted

    def hush(self) -> None:
        """Raise nothing from here on."""
        self._raised = True
        signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if not self._asked:
            self._asked = True
        if not self._raised:
            signal.setitimer(signal.ITIMER_REAL, _PATIENCE_S)

    def _lose_patience(self, number: int, frame: FrameType | None) -> None:
        self.check()
