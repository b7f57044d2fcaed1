"""A recorder for a session without an end: keeps the last seconds always, and records runs when there is a reason.

Has the same face as `stagectl.record.Recorder`, so that the supervisor can't tell. The session's own folder holds all
events, and the rows that a recovery finds where no run was under way. Reads no clock: names of folders come from
`reserve`.
"""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stagectl.errors import RecordError
from stagectl.record import Recorder, free_text

RECOVERY_LINK = "current"
"""In the session's folder: leads to the folder that rows of a dead servo belong to."""

_EVENTS_KEPT_COUNT = 1000


class FlightRecorder:
    """Rows and events of one session. Errors: RecordError, where the policy for a full disk is "stop"."""

    def __init__(
        self,
        folder: Path,
        manifest: dict[str, Any],
        reserve: Callable[[str], Path],
        rows_kept_count: int,
        on_full_disk: Literal["stop", "go_on"],
        say: Callable[[str, str], None] = lambda event, text: None,
    ):
        """Begin a session in `folder`; `reserve` makes folders for runs, `say` tells at once what the disk refuses."""
        self.folder = folder
        self.rows_count = 0
        self.trouble = ""
        """What the disk refused; empty where all is well."""
        self.trigger = ""
        """What the run under way was begun by."""
        self._manifest = {**manifest, "session": folder.name, "kept_by": "service"}
        self._reserve, self._kept_count, self._on_full_disk, self._say = reserve, rows_kept_count, on_full_disk, say
        self._base = Recorder(folder, {**self._manifest, "trigger": "session"})
        self._run: Recorder | None = None
        self._run_first_row = 0
        self._rows: deque[np.ndarray] = deque()
        self._rows_held_count = 0
        self._events: deque[tuple[str, int, int, dict[str, Any]]] = deque(maxlen=_EVENTS_KEPT_COUNT)
        self._lead_to(folder)

    @property
    def recovery_folder(self) -> Path:
        """Where rows go that a dead servo left: the run under way, else the session's own folder."""
        return self.folder / RECOVERY_LINK

    @property
    def run_folder(self) -> Path | None:
        """The run under way; None where only the last seconds are kept."""
        return None if self._run is None else self._run.folder

    @property
    def run_rows_count(self) -> int:
        """Rows of the run under way."""
        return 0 if self._run is None else self._run.rows_count

    def _lead_to(self, folder: Path) -> None:
        unborn = self.folder / f".{RECOVERY_LINK}"
        try:
            unborn.unlink(missing_ok=True)
            unborn.symlink_to(os.path.relpath(folder, self.folder))
            unborn.replace(self.recovery_folder)
        except OSError as error:
            raise RecordError(
                f"{self.recovery_folder}: can't be led to {folder.name}: {error.strerror} ({free_text(self.folder)}); "
                "free space there"
            ) from error

    # ---- what the supervisor asks ----------------------------------------------------------------------------

    def append(self, rows: np.ndarray) -> None:
        """Take over rows: into memory, and into the run under way."""
        if len(rows) == 0:
            return
        self.rows_count += len(rows)
        self._rows.append(rows)
        self._rows_held_count += len(rows)
        while self._rows_held_count - len(self._rows[0]) >= self._kept_count:
            self._rows_held_count -= len(self._rows.popleft())
        while self._events and self._events[0][2] < self.rows_count - self._rows_held_count:
            self._events.popleft()  # of rows that are gone
        if self._run is not None:
            with self._policy():
                self._run.append(rows)

    def event(self, name: str, t_ns: int, row: int | None = None, **fields: Any) -> None:
        """Keep an event with the session, and with the run under way."""
        self._events.append((name, int(t_ns), self.rows_count, fields))
        with self._policy():
            self._base.event(name, t_ns, row, **fields)
            if self._run is not None:
                self._run.event(name, t_ns, **fields)

    def save_snapshot(self, states: Mapping[str, np.ndarray]) -> None:
        """Keep the states that the session began from."""
        with self._policy():
            self._base.save_snapshot(states)

    def flush(self) -> None:
        """Write what the run under way has."""
        if self._run is not None:
            with self._policy():
                self._run.flush()

    def close(self, end: Mapping[str, Any] | None = None) -> None:
        """End the run under way and the session."""
        self.end_run(end)
        self._base.close(end)

    def abandon(self) -> None:
        """Let go of all files as they are."""
        if self._run is not None:
            self._run.abandon()
        self._base.abandon()

    @contextlib.contextmanager
    def _policy(self):
        """A full disk ends the recording, and the motion with it where the profile wants that."""
        try:
            yield
        except RecordError as error:
            self._tell(error)
            if self._on_full_disk == "stop":
                raise
            run, self._run, self.trigger = self._run, None, ""
            if run is not None:
                with contextlib.suppress(RecordError, OSError):
                    run.abandon()

    def _tell(self, error: RecordError) -> None:
        if not self.trouble:
            self._say("record_lost", str(error))
        self.trouble = str(error)

    # ---- runs ------------------------------------------------------------------------------------------------

    def begin_run(self, name: str, trigger: str, t_ns: int) -> None:
        """Record from now on; the run under way goes on where there is one. Errors: RecordError."""
        if self._run is not None:
            return
        with self._policy():
            folder = self._reserve(name)
            begun = {**self._manifest, "trigger": trigger, "start_t_ns": t_ns}
            run = Recorder(folder, begun, durable=True)
            try:
                run.event("begin", t_ns, trigger=trigger)
                self._lead_to(folder)
            except RecordError:
                run.abandon()  # else it would record on without anybody to end it
                raise
            self._run, self.trigger, self.trouble = run, trigger, ""

    def end_run(self, end: Mapping[str, Any] | None = None) -> Path | None:
        """Close the run under way and return its folder; None where there was none. Errors: RecordError."""
        run = self._run
        if run is None:
            return None
        with self._policy():
            run.close(end)
            self._run, self.trigger = None, ""
            self._lead_to(self.folder)
        return run.folder

    def save_last(self, name: str, trigger: str) -> Path | None:
        """Write the last seconds as a run of their own, beside one under way; None where there are no rows."""
        return self.save_window(name, trigger, self.rows_count - self._kept_count, self.rows_count)

    def save_window(self, name: str, trigger: str, first_row: int, end_row: int) -> Path | None:
        """Write the rows of the session from `first_row` to before `end_row` as a run, as far as they are kept."""
        kept_from = self.rows_count - self._rows_held_count
        first_row, end_row = max(first_row, kept_from), min(end_row, self.rows_count)
        if end_row <= first_row:
            return None
        with self._policy():
            rows = np.concatenate(list(self._rows))[first_row - kept_from : end_row - kept_from]
            folder = self._reserve(name)
            saved = Recorder(folder, {**self._manifest, "trigger": trigger, "start_t_ns": int(rows["t_ns"][0])})
            for event, t_ns, row, fields in self._events:
                if first_row <= row < end_row or row == end_row == self.rows_count:
                    saved.event(event, t_ns, row - first_row, **fields)
            saved.append(rows)
            saved.close({"trigger": trigger})
            return folder
        return None
