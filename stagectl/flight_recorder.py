"""A recorder for a session without an end: keeps the last seconds always, and records runs when there is a reason.

Has the same face as `stagectl.record.Recorder`, so that the supervisor can't tell. The session's own folder holds all
events, and the rows that a recovery finds where no run was under way. Reads no clock: names of folders come from
`reserve`.
"""

import contextlib
import math
import os
import shutil
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from stagectl.errors import RecordError
from stagectl.record import Recorder, finish_left, free_text
from stagectl.row import ROW
from stagectl.run_folder import give_back

RECOVERY_LINK = "current"
"""In the session's folder: leads to the folder that rows of a dead servo belong to."""

_EVENTS_KEPT_COUNT = 1000
_BLOCK_ROWS_COUNT = 1000


class FlightRecorder:
    """Rows and events of one session. Errors: RecordError, where the policy for a full disk is "stop"."""

    def __init__(
        self,
        folder: Path,
        manifest: dict[str, Any],
        reserve: Callable[[str], Path],
        rows_kept_count: int,
        on_full_disk: Literal["stop", "go_on"],
        say: Callable[..., object] = lambda event, text, **fields: None,
        run_rows_limit_count: float = math.inf,
        before_end: Callable[[], object] = lambda: None,
    ):
        """Begin a session in `folder`; `reserve` makes folders for runs, `say` tells at once what becomes of them.

        A run that has `run_rows_limit_count` rows goes on in another folder, without a row lost or doubled.
        `before_end` is called when the session's last rows are there, and can still save some of them.
        """
        self.folder = folder
        self.trouble = ""
        """What the disk refused; empty where all is well."""
        self.trigger = ""
        """What the run under way was begun by."""
        self._manifest = {**manifest, "session": folder.name, "kept_by": "service"}
        self._reserve, self._on_full_disk, self._say = reserve, on_full_disk, say
        self._base: Recorder | None = None
        self._run: Recorder | None = None
        self._run_name = ""
        self._run_rows_limit_count = self._goes_on_at_count = run_rows_limit_count
        self._before_end = before_end
        self._disk = ThreadPoolExecutor(1, "runs")  # what waits for the disk while the stage moves
        self._next: _Next | None = None
        self._last = _LastRows(rows_kept_count)
        self._events: deque[tuple[str, int, int, dict[str, Any]]] = deque(maxlen=_EVENTS_KEPT_COUNT)
        with self._policy():
            self._begin_session()

    def _begin_session(self) -> Recorder:
        """Begin the session's own folder, where a full disk has not taken it yet. Errors: RecordError."""
        if self._base is None:
            base = Recorder(self.folder, {**self._manifest, "trigger": "session"})
            try:
                self._lead_to(self.folder)
            except RecordError:
                base.abandon()
                raise
            self._base = base
        return self._base

    @property
    def rows_count(self) -> int:
        """Rows of the session."""
        return self._last.end_row

    @property
    def recovery_folder(self) -> Path:
        """Where rows go that a dead servo left: the run under way, else the session's own folder."""
        return self.folder / RECOVERY_LINK

    @property
    def run_folder(self) -> Path | None:
        """The run under way; None where only the last seconds are kept."""
        return None if self._run is None else self._run.folder

    @property
    def trigger_soon(self) -> str:
        """What the run was begun by that rows go to soon: the next one's where one is being made, else `trigger`."""
        return self.trigger if self._next is None else self._next.trigger

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
        self._last.take(rows)
        while self._events and self._events[0][2] < self._last.first_row:
            self._events.popleft()  # of rows that are gone
        with self._policy():
            if self._run is not None and self._next is None and self._run.rows_count >= self._goes_on_at_count:
                self.go_on_as(self._run_name, self.trigger)
            try:
                self._take_next()
            finally:  # they have left the ring: where there is no other run, this one takes them
                if self._run is not None:
                    self._run.append(rows)

    def event(self, name: str, t_ns: int, row: int | None = None, **fields: Any) -> None:
        """Keep an event with the session, and with the run under way."""
        self._events.append((name, int(t_ns), self.rows_count, fields))
        with self._policy():
            try:
                if self._base is not None:
                    self._base.event(name, t_ns, row, **fields)
            finally:
                if self._run is not None:
                    self._run.event(name, t_ns, **fields)

    def save_snapshot(self, states: Mapping[str, np.ndarray]) -> None:
        """Keep the states that the session began from, and a run that began with it."""
        with self._policy():
            for recorder in (self._base, self._run):
                if recorder is not None:
                    recorder.save_snapshot(states)

    def flush(self) -> None:
        """Write what the run under way has."""
        if self._run is not None:
            with self._policy():
                self._run.flush()

    def close(self, end: Mapping[str, Any] | None = None) -> None:
        """End the run under way and the session."""
        self._before_end()
        self.end_run(end)
        self._disk.shutdown()
        if self._base is not None:
            self._base.close(end)

    def abandon(self) -> None:
        """Let go of all files as they are."""
        self._forget_next()
        self._disk.shutdown()
        for recorder in (self._run, self._base):
            if recorder is not None:
                recorder.abandon()

    @contextlib.contextmanager
    def _policy(self):
        """A full disk ends the recording, and the motion with it where the profile wants that."""
        try:
            yield
        except RecordError as error:
            self._tell(error)
            if self._on_full_disk == "stop":
                raise
            self._forget_next()
            run, self._run, self.trigger = self._run, None, ""
            if run is not None:
                self._give_up(run)

    def _give_up(self, run: Recorder) -> None:
        """Let go of a run that the disk takes no more of; letting go waits for the disk, and the stage moves on."""
        try:
            self._lead_to(self.folder)
        except RecordError:  # a dead servo's rows would go into the run: it is finished at the next opening
            self._disk.submit(_let_go, run)
        else:
            self._disk.submit(_finish, run)

    def _tell(self, error: RecordError) -> None:
        if not self.trouble:
            self._say("record_lost", str(error))
        self.trouble = str(error)

    # ---- runs ------------------------------------------------------------------------------------------------

    def begin_run(self, name: str, trigger: str, t_ns: int | None) -> None:
        """Record from now on; the run under way goes on where there is one. Errors: RecordError.

        `t_ns` is None before the servo's first cycle: all that it leaves is the run's.
        """
        with self._policy():
            if self._run is None and self._next is not None:  # asked for, and about to be there
                wait([self._next.made])
                self._take_next()
            if self._run is not None:
                return
            self._begin_session()
            begun = {**self._manifest, "trigger": trigger, **({} if t_ns is None else {"start_t_ns": t_ns})}
            run = self._made(name, begun)
            try:
                run.event("begin", t_ns or 0, trigger=trigger)
                self._lead_to(run.folder)
            except RecordError:
                run.abandon()  # else it would record on without anybody to end it
                raise
            self._take(run, name, trigger)

    def _take(self, run: Recorder, name: str, trigger: str) -> None:
        """Have rows go to this run from now on."""
        self._run, self._run_name, self.trigger, self.trouble = run, name, trigger, ""
        self._goes_on_at_count = self._run_rows_limit_count

    def go_on_as(self, name: str, trigger: str, end: Mapping[str, Any] | None = None) -> None:
        """Record into another folder from soon on, without a row lost or doubled; the run under way ends with `end`.

        Making a folder and closing one wait for the disk, and the stage moves meanwhile: a thread does both.
        """
        if self._next is not None and self._next.trigger == trigger:
            return
        self._forget_next()
        begun = {**self._manifest, "trigger": trigger}
        if self._run is not None:
            begun["continues"] = self._run.folder.name
        self._next = _Next(self._disk.submit(self._made, name, begun), name, trigger, dict(end or {}))

    def _take_next(self) -> None:
        """Go on in the next folder, where it is there; else in the one before. Errors: RecordError, policy "stop"."""
        if self._next is None or not self._next.made.done():
            return
        following, self._next, before = self._next, None, self._run
        try:
            new = self._led_to_next(following, before)
        except RecordError as error:
            if before is None:  # it was asked for, and nothing depends on it
                self._tell(error)
                return
            # The run before stands in for it, and is as long again before the next try: each may leave the disk fuller.
            self._run_name, self.trigger = following.name, following.trigger
            self._goes_on_at_count = before.rows_count + self._run_rows_limit_count
            stays = RecordError(
                f"{before.folder.name} can't go on in another folder, it takes all rows itself: {error}"
            )
            if self._on_full_disk == "go_on":
                self._tell(stays)
                return
            raise stays from error
        self._take(new, following.name, following.trigger)
        if before is None:
            self._say("run", "begun", run=new.folder.name, trigger=following.trigger)
            return
        self._say("run", f"goes on behind {before.folder.name}", run=new.folder.name, trigger=following.trigger)
        self._disk.submit(self._close_continued, before, {**following.end, "continued_by": new.folder.name})

    def _led_to_next(self, following: "_Next", before: Recorder | None) -> Recorder:
        """Return the next run when all of the one before is in its file. Errors: RecordError; then there is no next."""
        new = following.made.result()
        try:
            if before is not None:
                before.flush()  # a recovery goes on behind the last row there
            self._lead_to(new.folder)
        except RecordError:
            self._disk.submit(_remove, new)
            raise
        return new

    def _made(self, name: str, manifest: dict[str, Any], durable: bool = True) -> Recorder:
        folder = self._reserve(name)
        try:
            return Recorder(folder, manifest, durable=durable)
        except RecordError:
            give_back(folder)
            raise

    def _close_continued(self, run: Recorder, end: Mapping[str, Any]) -> None:
        try:
            run.close(end)
        except (RecordError, OSError) as error:
            _finish(run)  # its rows are in the file
            self._say("record_lost", str(error))

    def _forget_next(self) -> None:
        """Remove the folder that a run was to go on in, as soon as it is made."""
        following, self._next = self._next, None
        if following is not None:
            self._disk.submit(_remove_made, following.made)

    def end_run(self, end: Mapping[str, Any] | None = None) -> Path | None:
        """Close the run under way and return its folder; None where there was none. Errors: RecordError."""
        self._forget_next()
        run = self._run
        if run is None:
            return None
        with self._policy():
            run.close(end)
            self._run, self.trigger = None, ""
            self._lead_to(self.folder)
        return run.folder

    def save_last(self, name: str, trigger: str, text: str) -> None:
        """Write the last seconds as a run of their own, beside one under way."""
        self.save_window(name, trigger, text, self.rows_count - self._last.count, self.rows_count)

    def save_window(self, name: str, trigger: str, text: str, first_row: int, end_row: int) -> None:
        """Write the session's rows from `first_row` to before `end_row` as a run, as far as they are kept.

        A thread does it, half a minute at 1 kHz is 38 MB; `text` is said once the run is there.
        """
        first_row, end_row = max(first_row, self._last.first_row), min(end_row, self.rows_count)
        if end_row <= first_row:
            return
        pieces = self._last.pieces(first_row, end_row)
        events = [
            (event, t_ns, row - first_row, fields)
            for event, t_ns, row, fields in self._events
            if first_row <= row < end_row or row == end_row == self.rows_count
        ]
        self._last.lend(self._disk.submit(self._save, name, trigger, text, pieces, events))

    def _save(self, name: str, trigger: str, text: str, pieces: list[np.ndarray], events: list[tuple]) -> None:
        try:
            start = {"start_t_ns": int(pieces[0]["t_ns"][0])}
            saved = self._made(name, {**self._manifest, "trigger": trigger, **start}, durable=False)
            try:
                for event, t_ns, row, fields in events:
                    saved.event(event, t_ns, row, **fields)
                for rows in pieces:
                    saved.append(rows)
                saved.close({"trigger": trigger})
            except RecordError:
                saved.abandon()
                raise
        except RecordError as error:
            self._tell(error)
        else:
            self._say("run", text, run=saved.folder.name, trigger=trigger)


class _LastRows:
    """The last rows of a session, in blocks of one size: one that fell out is written to again.

    Made anew each second, they left the supervisor's memory one block larger at times, where another took its place.
    """

    def __init__(self, count: int):
        """Keep `count` rows; those that share a block with the first stay in memory with it."""
        self.count = count
        self.end_row = 0
        """Rows since the session began."""
        self._blocks: deque[np.ndarray] = deque()
        self._blocks_from_row = 0
        self._free: list[np.ndarray] = []
        self._readers: list[Future[None]] = []

    @property
    def first_row(self) -> int:
        """Of what is kept, counted since the session began."""
        return max(self.end_row - self.count, 0)

    def take(self, rows: np.ndarray) -> None:
        """Keep rows, shape (n,) of ROW."""
        while len(rows):
            used = self.end_row % _BLOCK_ROWS_COUNT
            if used == 0:
                self._blocks.append(self._free.pop() if self._free else np.empty(_BLOCK_ROWS_COUNT, ROW))
            piece = rows[: _BLOCK_ROWS_COUNT - used]
            # As bytes: numpy copies structured rows field by field, 2 us each.
            place = self._blocks[-1][used : used + len(piece)]
            place.view(np.uint8)[:] = np.ascontiguousarray(piece).view(np.uint8)
            self.end_row += len(piece)
            rows = rows[len(piece) :]
        while self._blocks_from_row + _BLOCK_ROWS_COUNT <= self.first_row:
            fallen_out = self._blocks.popleft()
            self._blocks_from_row += _BLOCK_ROWS_COUNT
            self._readers = [reader for reader in self._readers if not reader.done()]
            if not self._readers:
                self._free.append(fallen_out)

    def lend(self, reader: Future[None]) -> None:
        """Write to none of the blocks again that are here now, or fall out, before `reader` is done."""
        self._readers.append(reader)

    def pieces(self, first_row: int, end_row: int) -> list[np.ndarray]:
        """Return rows that are kept, not copied: who reads them in a thread has them lent."""
        found: list[np.ndarray] = []
        block_row = self._blocks_from_row
        for block in self._blocks:
            found.append(block[max(first_row - block_row, 0) : max(end_row - block_row, 0)])
            block_row += _BLOCK_ROWS_COUNT
        return [rows for rows in found if len(rows)]


class _Next(NamedTuple):
    """The run that rows go to as soon as its folder is there."""

    made: Future[Recorder]
    name: str
    trigger: str
    end: dict[str, Any]
    """How the run before it ends."""


def _let_go(run: Recorder) -> None:
    """Let go of a run's files as they are."""
    with contextlib.suppress(OSError):
        run.abandon()


def _finish(run: Recorder) -> None:
    """Let go of a run that can't be closed, and mark what is in its files as all of it: else it could never be removed.

    Where the disk has no room even for that, the next opening does it.
    """
    _let_go(run)
    with contextlib.suppress(RecordError, OSError):
        finish_left(run.folder, None)


def _remove_made(made: Future[Recorder]) -> None:
    """Remove a run that was just made; one that could not be made has left nothing."""
    if made.exception() is None:
        _remove(made.result())


def _remove(run: Recorder) -> None:
    """Remove a run that never got a row."""
    _let_go(run)
    shutil.rmtree(run.folder, ignore_errors=True)
