"""A run as a folder: manifest.json, samples.arrow, events.jsonl, snapshot.npz; written as it happens, read afterwards.

Reads no clock: times come with the rows and events.
"""

import contextlib
import io
import json
import os
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import structlog

from stagectl.errors import RecordError
from stagectl.onto_disk import OntoDisk
from stagectl.ring import SHARED_MEMORY, RingReader, own_rings, writer_alive
from stagectl.row import ROW, layout_hash
from stagectl.samples_file import (
    BATCH_NS,
    BATCH_ROWS_COUNT,
    END_MARKER,
    batch_ends,
    empty_rows,
    encode_batch,
    encode_schema,
    extent,
    fill_rows,
    is_closed,
    scan,
    schema_of,
    to_batch,
)
from stagectl.whole_file import WholeFile, replace_whole

MANIFEST = "manifest.json"
SAMPLES = "samples.arrow"
EVENTS = "events.jsonl"
SNAPSHOT = "snapshot.npz"

FORMAT = 1
"""Version of the folder's shape, in the manifest as record.format."""

RESERVE_BYTES = 2 << 20
"""Kept free for the end of a run: about 1 s of rows (1.2 MB at 1 kHz) and the manifest still fit on a full disk."""

DURABLE_BATCH_NS = 100_000_000
"""Rows of a durable run wait so long for their batch; the disk has the rest of 0.25 s."""

_RESERVE = ".reserve"


def plain(value: Any) -> Any:
    """Turn what JSON does not know into what it does; structured arrays become name: value."""
    if isinstance(value, np.ndarray | np.void) and value.dtype.names:
        if value.shape not in ((), (1,)):
            return [plain(item) for item in value]
        return {name: plain(value[name].reshape(-1)[0]) for name in value.dtype.names}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, bytes):
        return value.hex()
    raise TypeError(f"{value!r} of type {type(value).__name__} can't stand in a run's JSON")


def _to_json(value: Any, indent: int | None = None) -> str:
    return json.dumps(value, default=plain, indent=indent, ensure_ascii=False)


def _encoded(text: str) -> bytes:
    r"""Encode JSON; bytes of a path that are no UTF-8 become JSON's \udcff."""
    return text.encode(errors="backslashreplace")


def _event_first(logger, method: str, event_dict):  # pyright: ignore[reportUnusedParameter]
    return {"event": event_dict.pop("event"), **event_dict}


class _LineSink:
    """What structlog's WriteLogger calls: one text per event, then flush."""

    def __init__(self, put: Callable[[bytes], None]):
        self._put = put

    def write(self, text: str) -> None:
        self._put(_encoded(text))

    def flush(self) -> None:
        """Do nothing: `write` has put the line into the file."""


def _structured_log(put: Callable[[bytes], None]):
    return structlog.wrap_logger(
        structlog.WriteLogger(_LineSink(put)),  # pyright: ignore[reportArgumentType]
        processors=[_event_first, structlog.processors.JSONRenderer(default=plain, ensure_ascii=False)],
        wrapper_class=structlog.make_filtering_bound_logger(0),
        cache_logger_on_first_use=True,
    )


class Recorder:
    """Writes one run folder. A row or event that was handed over is never dropped.

    On a full disk every method raises RecordError; what did not fit stays held, goes out with the next call that
    finds room, and must not be handed over again. The first such error frees a reserve on the disk, so that the
    rows until the stage stands, and the manifest, still fit.
    """

    def __init__(self, folder: Path, manifest: dict, fields: Sequence[str] | None = None, *, durable: bool = False):
        """Make the folder and write the manifest; `fields` limits the recorded ROW fields (imported tables).

        `durable`: when the power goes, the disk has all but the last 0.25 s.
        """
        self.folder = Path(folder)
        self.manifest = dict(manifest)
        self.rows_count = 0
        self._schema = schema_of(fields)
        self._pending = np.empty(BATCH_ROWS_COUNT, ROW)
        self._pending.view(np.uint8).fill(0)  # all of its memory is taken now, not at the first pile of rows
        self._pending_count = 0
        self._first_t_ns: int | None = None
        self._last_t_ns: int | None = None
        self._marks: deque[tuple[int, int | None]] = deque([(0, None)])  # (rows, cycle) at the end of each piece
        self._closed = False
        self._onto_disk: OntoDisk | None = None
        self._batch_ns = DURABLE_BATCH_NS if durable else BATCH_NS
        for name in (MANIFEST, SAMPLES, EVENTS):
            if (self.folder / name).exists():
                raise RecordError(f"{self.folder}: already holds a run ({name}); give the run another folder")
        self.manifest["record"] = {
            "format": FORMAT,
            "layout": layout_hash(ROW),
            "fields": self._schema.names,
            "state": "recording",
            "pid": os.getpid(),
        }
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._write_manifest()
            _reserve(self.folder / _RESERVE)
            self._samples = WholeFile(self.folder / SAMPLES)
            self._samples.put(encode_schema(self._schema))
            self._events = WholeFile(self.folder / EVENTS)
        except OSError as error:
            self._leave_nothing()
            raise RecordError(
                f"{self.folder}: can't begin a run: {error.strerror} ({free_text(self.folder)}); nothing was recorded; "
                "free space, check permissions, or give another folder"
            ) from error
        self._log = _structured_log(self._put_event)
        if durable:
            self._onto_disk = OntoDisk((self._samples, self._events))

    def _leave_nothing(self) -> None:
        """Remove what there is of a run that could not be begun: it would count as one that crashed."""
        for file in (vars(self).get("_samples"), vars(self).get("_events")):
            if file is not None:
                with contextlib.suppress(OSError):
                    file.close()
        for name in (MANIFEST, SAMPLES, EVENTS, _RESERVE):
            with contextlib.suppress(OSError):
                (self.folder / name).unlink()

    @property
    def recovery_folder(self) -> Path:
        """Where rows go that a dead servo left: the run itself."""
        return self.folder

    def append(self, rows: np.ndarray) -> None:
        """Take over rows, shape (n,) of ROW; they are in the file within 0.25 s of their time. Errors: RecordError."""
        if rows.dtype != ROW:
            raise RecordError(f"{self.folder}: rows of another layout ({rows.dtype.itemsize} bytes); record ROW only")
        count = len(rows)
        if count == 0:
            return
        if self._closed:
            raise RecordError(f"{self.folder}: {count} rows came after the run was closed; start a new run")
        if self._first_t_ns is None:
            self._first_t_ns = int(rows["t_ns"][0])
        self._last_t_ns = int(rows["t_ns"][-1])
        trouble: RecordError | None = None
        while len(rows):
            begin = self._pending_count
            piece = rows[: BATCH_ROWS_COUNT - begin]
            end = begin + len(piece)
            # As bytes: numpy copies structured rows field by field, 2 us each.
            self._pending[begin:end].view(np.uint8)[:] = np.ascontiguousarray(piece).view(np.uint8)
            self._pending_count = end
            self.rows_count += len(piece)
            rows = rows[len(piece) :]
            span_ns = int(self._pending["t_ns"][end - 1]) - int(self._pending["t_ns"][0])
            if not 0 <= span_ns < self._batch_ns or end >= BATCH_ROWS_COUNT:
                try:
                    self.flush()
                except RecordError as error:  # what did not fit is held; the other rows are taken over all the same
                    trouble = error
        if trouble is not None:
            raise trouble

    def flush(self) -> None:
        """Write every row and event taken over so far. Errors: RecordError (disk full)."""
        start, encoded = 0, []
        rows = self._pending[: self._pending_count]
        before = self.rows_count - self._pending_count
        for end in batch_ends(rows["t_ns"]):
            encoded.append(encode_batch(to_batch(rows[start:end], self._schema)))
            self._marks.append((before + end, int(rows["cycle"][end - 1])))
            start = end
        self._pending_count = 0
        self._samples.hold(encoded)
        self._write(self._write_held)
        self._forget_marks()

    def event(self, name: str, t_ns: int, row: int | None = None, **fields: Any) -> None:
        """Write one line to events.jsonl; `row` is the row that it precedes (the next one by default)."""
        self._log.info(name, t_ns=int(t_ns), row=self.rows_count if row is None else int(row), **fields)

    def save_snapshot(self, states: Mapping[str, np.ndarray]) -> None:
        """Write the states that the first row begins from, bit for bit. Errors: RecordError."""
        for name, state in states.items():
            if np.asarray(state).dtype.hasobject:
                raise RecordError(f"{self.folder}: state {name!r} holds Python objects; give arrays of numbers")
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **{name: np.asarray(state) for name, state in states.items()})
        self._write(lambda: replace_whole(self.folder / SNAPSHOT, content.getvalue()))

    def close(self, end: Mapping[str, Any] | None = None) -> None:
        """Write all, mark the stream as ended, put `end` (how the run ended) into the manifest. Errors: RecordError.

        After an error the recorder is still open: make room and close again, or `abandon` it.
        """
        if self._closed:
            return
        (self.folder / _RESERVE).unlink(missing_ok=True)  # this is the end that it was kept for
        self.flush()
        state = {
            "state": "closed",
            "rows_count": self.rows_count,
            "first_t_ns": self._first_t_ns,
            "last_t_ns": self._last_t_ns,
        }
        self.manifest["record"] = {**self.manifest["record"], **state}
        self.manifest["end"] = dict(end or {})
        self._write(self._write_manifest)
        self._write(lambda: self._samples.put(END_MARKER))
        self._closed = True
        self.abandon()

    def abandon(self) -> None:
        """Let go of the files as they are: whole up to the last batch, and not marked as ended."""
        self._closed = True
        # The recorder and its log hold each other: 2.6 MB a run would stay until all garbage is collected.
        self._pending, self._pending_count = self._pending[:0].copy(), 0
        if self._onto_disk is not None:
            self._onto_disk.close()
        try:
            self._samples.close()
        finally:
            self._events.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.close(None if error is None else {"error": f"{type(error).__name__}: {error}"})

    def _put_event(self, line: bytes) -> None:
        self._events.hold([line])
        self._write(self._write_events)

    def _write_events(self) -> None:
        self._events.write_held()
        if self._onto_disk is not None:
            self._onto_disk.hurry()

    def _write_held(self) -> None:
        self._samples.write_held()
        self._write_events()

    def _write_manifest(self) -> None:
        replace_whole(self.folder / MANIFEST, _encoded(_to_json(self.manifest, indent=2)))

    def _write(self, action: Callable[[], None]) -> None:
        try:
            action()
        except OSError as error:
            with contextlib.suppress(OSError):  # what still does not fit stays held, and the text below says so
                (self.folder / _RESERVE).unlink(missing_ok=True)
                self._write_held()
            raise RecordError(self._loss_text(error)) from error

    def _forget_marks(self) -> None:
        """Keep the ends of pieces that are held, and the one before: a run may go on for months."""
        while len(self._marks) > self._samples.held_count + 1:
            self._marks.popleft()

    def _loss_text(self, error: OSError) -> str:
        self._forget_marks()
        rows_count, cycle = self._marks[0]
        safe = f"{rows_count} rows, to cycle {cycle}, are safe" if rows_count else "no row is on the disk yet"
        return (
            f"{self.folder}: can't write the run: {error.strerror} ({free_text(self.folder)}); {safe}; "
            f"{self.rows_count - rows_count} rows and {self._events.held_count} events are held in memory; "
            "end the run, free space on that disk and close it again: they are written then"
        )


def _reserve(path: Path) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        os.posix_fallocate(descriptor, 0, RESERVE_BYTES)
    finally:
        os.close(descriptor)


def free_text(folder: Path) -> str:
    """Say how much room the disk of `folder` has."""
    try:
        room = os.statvfs(folder)
    except OSError:
        return "room unknown"
    return f"{room.f_bavail * room.f_frsize / 1e6:.1f} MB free"


@dataclass(frozen=True, eq=False)
class Run:
    """A run folder as it was read."""

    folder: Path
    manifest: dict
    rows: np.ndarray
    """Shape (n,) of ROW; fields that the file lacks hold `row.absent_value`."""
    events: list[dict]
    snapshot: dict[str, np.ndarray]
    """Empty where the run has none."""
    truncated: bool
    """True where the files have no proper end: cut, damaged, or still being written."""
    missing_fields: tuple[str, ...]
    """ROW fields that the file does not have."""
    unknown_fields: tuple[str, ...]
    """Fields of the file that this version does not know; their values are not in `rows`."""

    @property
    def rows_missing_count(self) -> int:
        """Rows that the manifest counts and the file no longer has."""
        return max(0, self.manifest.get("record", {}).get("rows_count", 0) - len(self.rows))


def read_manifest(folder: Path) -> dict:
    """Return a run's manifest. Errors: RecordError."""
    path = Path(folder) / MANIFEST
    try:
        manifest = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise RecordError(f"{folder}: not a run folder (no {MANIFEST}); `stagectl runs list` shows the runs") from error
    except (OSError, ValueError, RecursionError) as error:
        raise RecordError(f"{path}: can't be read: {error}; the other files of the run are not affected") from error
    if not isinstance(manifest, dict):
        raise RecordError(f"{path}: holds a {type(manifest).__name__} and not a table; it is not ours")
    record = manifest.get("record")
    found = record.get("format", FORMAT) if isinstance(record, dict) else FORMAT
    if found != FORMAT:
        raise RecordError(f"{path}: run format {found}, this version reads {FORMAT}; use the version that made it")
    _check_manifest(manifest, path)
    return manifest


def _check_manifest(manifest: dict, path: Path) -> None:
    """Refuse what a recorder never writes, so that readers need not doubt what they find. Errors: RecordError."""
    tables: list[tuple[str, dict, str, type]] = [(name, manifest, name, dict) for name in ("record", "end", "mappings")]
    record, profile = manifest.get("record"), manifest.get("profile")
    if isinstance(record, dict):
        tables += [(f"record.{name}", record, name, int) for name in ("rows_count", "first_t_ns", "last_t_ns")]
        tables.append(("record.state", record, "state", str))
    if isinstance(profile, dict):
        tables.append(("profile.cycle", profile, "cycle", dict))
    for place, table, name, kind in tables:
        if name not in table or type(table[name]) is kind:
            continue
        if table[name] is None and name in ("first_t_ns", "last_t_ns"):  # of a run without rows
            continue
        shown = json.dumps(table[name])
        raise RecordError(
            f"{path}: {place} is {shown if len(shown) < 40 else f'{shown[:40]}...'}, and a recorder writes "
            f"{_KINDS[kind]} there; the file is damaged: take it from a copy of the run"
        )


_KINDS = {dict: "a table", int: "a whole number", str: "a text"}


def read_batches(folder: Path) -> Iterator[np.ndarray]:
    """Yield the rows of a run batch by batch, shape (n,) of ROW, to its end or to where it is cut."""
    path = Path(folder) / SAMPLES
    for piece in scan(path):
        if piece.batch is not None and len(piece.batch):
            yield _rows_of(piece.batch, piece.schema, path)


def _rows_of(batch: pa.RecordBatch, schema: pa.Schema, path: Path) -> np.ndarray:
    rows = empty_rows(len(batch), schema)
    fill_rows(rows, batch, str(path))
    return rows


def recorded_fields(folder: Path) -> tuple[str, ...]:
    """Return the names of the fields that a run's samples file has; none where it has no schema yet."""
    for piece in scan(Path(folder) / SAMPLES):
        return tuple(piece.schema.names)
    return ()


def recorded_extent(folder: Path) -> tuple[int, int | None, int | None]:
    """Return how many rows a run's samples file has, and the times of the first and the last one; reads hardly any."""
    path = Path(folder) / SAMPLES
    found = extent(path)
    before = [_rows_of(batch, found.schema, path) for batch in (found.first, found.last) if batch is not None]
    if not before:
        return found.rows_count, None, None
    return found.rows_count, int(before[0]["t_ns"][0]), int(before[-1]["t_ns"][-1])


def read_run(folder: Path) -> Run:
    """Read a run, whole or cut short. Errors: RecordError where there is no run or no sense in it."""
    folder = Path(folder)
    manifest = read_manifest(folder)
    path = folder / SAMPLES
    parts, names, end_bytes = [np.zeros(0, ROW)], (), 0
    if path.exists():
        for piece in scan(path):
            names, end_bytes = tuple(piece.schema.names), piece.end_bytes
            if piece.batch is not None and len(piece.batch):
                parts.append(_rows_of(piece.batch, piece.schema, path))
    events, events_cut = _read_events(folder / EVENTS)
    return Run(
        folder=folder,
        manifest=manifest,
        rows=np.concatenate(parts),
        events=events,
        snapshot=_read_snapshot(folder / SNAPSHOT),
        truncated=events_cut or not path.exists() or not is_closed(path, end_bytes),
        missing_fields=tuple(name for name in ROW.names or () if name not in names),
        unknown_fields=tuple(name for name in names if name not in (ROW.names or ())),
    )


def _read_events(path: Path) -> tuple[list[dict], bool]:
    """Return the whole events, and whether something follows them that is none."""
    if not path.exists():
        return [], True
    events = []
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordError(f"{path}: can't be read: {error.strerror}; check permissions and disk") from error
    lines = content.split(b"\n")
    for line in lines[:-1]:
        try:
            event = json.loads(line)
        except (ValueError, RecursionError):
            return events, True
        if not isinstance(event, dict) or not isinstance(event.get("event"), str):
            return events, True
        events.append(event)
    return events, lines[-1] != b""


def _read_snapshot(path: Path) -> dict[str, np.ndarray]:
    if not path.exists():
        return {}
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise RecordError(
            f"{path}: can't be read: {error}; the run can be looked at, not replayed: move it away"
        ) from error


@dataclass(frozen=True)
class Recovery:
    """What `recover` saved."""

    rows_count: int
    """Rows that the ring had and the file had not."""
    rows_lost_count: int | None
    """Rows that the ring had already overwritten when it was drained; None where the ring itself is gone."""


def recover(ring_path: Path, folder: Path, keep_ring: bool = False) -> Recovery:
    """Write what the ring of a dead servo holds, and its run does not, behind the run's last whole batch.

    Rows are told apart by their time. Removes the ring when all is on the disk. A servo may drain its own ring.
    Errors: RecordError; run and ring are as they were then, and the call can be repeated.
    """
    ring_path, folder = Path(ring_path), Path(folder)
    manifest = read_manifest(folder)
    reader = RingReader(ring_path)
    if writer_alive(ring_path) and reader.writer_pid != os.getpid():
        raise RecordError(f"{ring_path}: its servo (pid {reader.writer_pid}) is alive; stop it before recovering")
    if reader.run_folder is not None and reader.run_folder.resolve() != folder.resolve():
        raise RecordError(f"{ring_path}: holds rows of {reader.run_folder}, not of {folder}; recover them there")
    recovery = _save(
        folder,
        manifest,
        reader.read_new(),
        reader.lost_count,
        f"the ring {ring_path} keeps them until the host restarts",
    )
    if not keep_ring:
        ring_path.unlink(missing_ok=True)
    return recovery


def finish_left(folder: Path, rows_lost_count: int | None) -> Recovery:
    """Mark a run that its recorder left, and of which no ring holds anything, as recovered up to its last whole batch.

    Errors: RecordError; the run is as it was then, and the call can be repeated.
    """
    folder = Path(folder)
    return _save(folder, read_manifest(folder), np.zeros(0, ROW), rows_lost_count, "the run is as it was")


def _save(
    folder: Path, manifest: dict, held_rows: np.ndarray, overwritten_count: int | None, otherwise: str
) -> Recovery:
    """Join rows to a run and mark it as recovered; `otherwise` says what becomes of them where the disk is full."""
    try:
        samples = WholeFile(folder / SAMPLES, resume=True)
    except BlockingIOError as error:
        raise RecordError(f"{folder}: a process still records this run; end it before recovering") from error
    except OSError as error:
        raise RecordError(f"{folder}: can't go on with {SAMPLES}: {error.strerror}; check permissions") from error
    try:
        recovery, whole = _join(samples, folder, manifest, held_rows, overwritten_count)
        samples.put(END_MARKER)
        _finish_recovered(folder, manifest, recovery, whole)
    except OSError as error:
        raise RecordError(
            f"{folder}: can't write recovered rows: {error.strerror} ({free_text(folder)}); {otherwise}; "
            "free space on that disk and recover again"
        ) from error
    finally:
        samples.close()
    return recovery


def _join(
    samples: WholeFile, folder: Path, manifest: dict, held_rows: np.ndarray, overwritten_count: int | None
) -> tuple[Recovery, dict[str, int | None]]:
    """Cut the samples at their last whole batch and append the rows that are newer. Errors: RecordError, OSError.

    Returns what was saved, and how many rows of which times the run has now.
    """
    found = extent(folder / SAMPLES)
    schema = found.schema
    before = [_rows_of(batch, schema, folder / SAMPLES) for batch in (found.first, found.last) if batch is not None]
    last = before[-1][-1] if before else None
    if len(held_rows) and schema is not None and not schema.equals(schema_of()):
        raise RecordError(
            f"{folder}: {SAMPLES} has another layout than the ring; recover with the version that made it"
        )
    start_t_ns = _start_t_ns(folder, manifest) if last is None else int(last["t_ns"]) + 1
    rows = held_rows[held_rows["t_ns"] >= start_t_ns]
    lost_count = overwritten_count
    if overwritten_count and last is not None:  # the file may have them
        apart = len(rows) == len(held_rows) and len(rows) > 0
        lost_count = max(0, int(rows["cycle"][0]) - int(last["cycle"]) - 1) if apart else 0
    samples.cut(found.end_bytes)
    if schema is None:
        samples.put(encode_schema(schema_of()))
    start = 0
    for end in batch_ends(rows["t_ns"]):
        samples.put(encode_batch(to_batch(rows[start:end], schema_of())))
        start = end
    times_ns = [int(part["t_ns"][at]) for part in (*before, rows) if len(part) for at in (0, -1)]
    whole = {
        "rows_count": found.rows_count + len(rows),
        "first_t_ns": times_ns[0] if times_ns else None,
        "last_t_ns": times_ns[-1] if times_ns else None,
    }
    return Recovery(rows_count=len(rows), rows_lost_count=lost_count), whole


def _start_t_ns(folder: Path, manifest: dict) -> int:
    """Return from when on rows belong to a run that has none yet; the run that it continues has those before."""
    if isinstance(continued := manifest.get("continues"), str):
        path = folder.resolve().parent / continued / SAMPLES  # a session's link may lead here
        with contextlib.suppress(RecordError, OSError):  # removed meanwhile
            found = extent(path)
            newest = found.first if found.last is None else found.last
            if newest is not None:
                return int(_rows_of(newest, found.schema, path)["t_ns"][-1]) + 1
    return manifest.get("start_t_ns", np.iinfo(np.int64).min)


def _finish_recovered(folder: Path, manifest: dict, recovery: Recovery, whole: dict[str, int | None]) -> None:
    """Say in events and manifest what was recovered, and of what run. Errors: OSError."""
    state = {
        "state": "recovered",
        **whole,
        "rows_recovered_count": recovery.rows_count,
        "rows_lost_count": recovery.rows_lost_count,
    }
    path = folder / EVENTS
    events = WholeFile(path, resume=True)
    try:
        content = path.read_bytes()
        events.cut(content.rfind(b"\n") + 1)
        _structured_log(events.put).info(
            "recovered",
            t_ns=whole["last_t_ns"] or 0,
            row=whole["rows_count"],
            rows_recovered_count=recovery.rows_count,
            rows_lost_count=recovery.rows_lost_count,
        )
    finally:
        events.close()
    manifest["record"] = {**manifest.get("record", {}), **state}
    replace_whole(folder / MANIFEST, _encoded(_to_json(manifest, indent=2)))
    (folder / _RESERVE).unlink(missing_ok=True)


def recover_orphans(
    ring_folder: Path = SHARED_MEMORY, runs_root: Path | None = None
) -> list[tuple[Path, Recovery | RecordError]]:
    """Recover each ring of this user whose servo is dead into the run that it names; one bad ring stops no other.

    `runs_root`: only rings of runs below that folder. Returns (ring, what was saved or why not) for each.
    """
    outcomes: list[tuple[Path, Recovery | RecordError]] = []
    for ring_path in own_rings(Path(ring_folder)):
        if writer_alive(ring_path):
            continue
        try:
            folder = RingReader(ring_path).run_folder
        except RecordError as error:
            if runs_root is None:  # else nobody knows whose it is
                outcomes.append((ring_path, error))
            continue
        if runs_root is not None and (folder is None or runs_root.resolve() not in folder.resolve().parents):
            continue
        try:
            if folder is None:
                raise RecordError(f"{ring_path}: names no run; recover it into its run, or remove the file")
            outcomes.append((ring_path, recover(ring_path, folder)))
        except RecordError as error:
            outcomes.append((ring_path, error))
    return outcomes
