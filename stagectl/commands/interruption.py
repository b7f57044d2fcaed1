"""Ctrl-C, SIGTERM and a closed terminal: heard at the next point where nothing is half done, and only once."""

import os
import signal
from types import FrameType

_PATIENCE_S = 1.0


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, SIGTERM or SIGHUP, heard.

    Not KeyboardInterrupt itself: where that passes through an import in C, CPython ends the process by SIGINT at last,
    whatever exit code it was given (unhandled_keyboard_interrupt in its runtime).
    """


class Interruption:
    """A context in which the first signal becomes a KeyboardInterrupt from `check`, and later ones are ignored.

    Where nobody calls `check` for a second (a drive that answers slowly), the interrupt is raised right there.
    After `hush` nothing interrupts until `listen`: coming to rest and closing the run go on undisturbed.
    A terminal that is gone (SIGHUP) takes no word: what would be said there goes nowhere, instead of failing.
    """

    def __init__(self) -> None:
        """Hear nothing yet."""
        self._asked = False
        self._raised = False
        self._before: dict[int, object] = {}
        self._terminals: list[int] = []

    def __enter__(self) -> "Interruption":
        self._terminals = [fileno for fileno in (0, 1, 2) if os.isatty(fileno)]
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # nohup: the command shall outlive its terminal
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

    def listen(self) -> None:
        """Hear signals again, one that came meanwhile too: what had to go on undisturbed is done, and more follows."""
        self._raised = False

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            self._leave_terminal()
        if not self._asked:
            self._asked = True
        if not self._raised:
            signal.setitimer(signal.ITIMER_REAL, _PATIENCE_S)

    def _leave_terminal(self) -> None:
        """Point what was the terminal to nowhere; one that still answers (`kill -HUP`) stays."""
        for fileno in self._terminals:
            if not os.isatty(fileno):
                nowhere = os.open(os.devnull, os.O_RDWR)
                os.dup2(nowhere, fileno)
                os.close(nowhere)

    def _lose_patience(self, number: int, frame: FrameType | None) -> None:
        self.check()
