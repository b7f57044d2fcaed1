"""Progress on stderr: a bar for the step under way, a line for each step that is done."""

import contextlib
import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

_SHORT_S = 0.5
"""Steps shorter than this leave no line of their own."""


class LiveProgress:
    """Called with what is being done and its share; without a terminal every step is a plain line."""

    def __init__(self, console: Console, check: Callable[[], None]):
        """`check` is called with every report: the place where an interrupt may come out."""
        self._console, self.check = console, check
        self._what = ""
        self._began_s = 0.0
        self._task: TaskID | None = None
        self._bars = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=28, complete_style="cyan", finished_style="green", pulse_style="cyan"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            refresh_per_second=8,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> "LiveProgress":
        self._bars.start()
        return self

    def __exit__(self, kind, error, trace) -> None:
        if error is None:
            self.done()
        self._bars.stop()

    def __call__(self, what: str, share: float) -> None:
        """Report that `what` is under way; share 0 where nobody knows how far."""
        self.check()
        with contextlib.suppress(OSError):  # a terminal that is just being closed must not end what moves
            self._show(what, share)

    def _show(self, what: str, share: float) -> None:
        if what != self._what:
            self.done()
            self._what, self._began_s = what, time.monotonic()
            if self._console.is_terminal:
                self._task = self._bars.add_task(what, total=None)
            else:
                self._console.print(f"{what} ...", highlight=False, markup=False, soft_wrap=True)
        if self._task is not None and share > 0.0:
            self._bars.update(self._task, total=1.0, completed=min(share, 1.0))

    def done(self) -> None:
        """End the step under way."""
        if self._task is not None:
            self._bars.remove_task(self._task)
            self._task = None
            took_s = time.monotonic() - self._began_s
            if took_s >= _SHORT_S:
                self._console.print(f"[green]✓[/] {self._what} [dim]{took_s:.1f} s[/]", highlight=False)
        self._what = ""
