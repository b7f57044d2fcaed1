"""Run folders as a user meets them: named, listed, shown, exported. Importing a table stands in `table_import`.

Reads no clock but the one that names a new folder.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import ValidationError

from stagectl.errors import RecordError, RequestError
from stagectl.profile import Profile
from stagectl.record import (
    MANIFEST,
    SAMPLES,
    Run,
    free_text,
    read_batches,
    read_manifest,
    read_run,
    recorded_extent,
    recorded_fields,
)
from stagectl.row import ROW
from stagectl.samples_file import END_MARKER, schema_of, to_batch
from stagectl.signals import Stop, stop_sentence
from stagectl.suggestion import closest
from stagectl.table_import import Imported, import_table
from stagectl.whole_file import is_held

__all__ = [
    "Imported",
    "RunSummary",
    "ending",
    "export",
    "import_table",
    "list_runs",
    "new_run_folder",
    "profile_of",
    "run_folders",
    "show",
    "summary",
]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_MAT_VARIABLE_LIMIT_BYTES = 2**31 - 1  # MATLAB 5 format: the size of a variable is a 32-bit number

FORMATS = ("csv", "parquet", "mat")


def new_run_folder(root: Path, name: str, begun: datetime | None = None) -> Path:
    """Return a path like runs/2026-11-20T09-14-03-NAME that no run has yet; UTC; the folder is not made."""
    if not _NAME.fullmatch(name):
        raise RequestError(
            f"run name {name!r}: use letters, digits, dots, dashes and underscores, a letter or digit first"
        )
    moment = (begun or datetime.now(UTC)).astimezone(UTC)
    folder = Path(root) / f"{moment:%Y-%m-%dT%H-%M-%S}-{name}"
    number = 2
    while folder.exists():
        folder = Path(root) / f"{moment:%Y-%m-%dT%H-%M-%S}-{name}-{number}"
        number += 1
    return folder


@dataclass(frozen=True)
class RunSummary:
    """One line of `runs list`."""

    folder: Path
    state: str
    """closed | recovered | recording | crashed (its recorder died) | damaged (`note` says how) | session (of a service
    that runs: it holds events, and rows only where a servo died)."""
    rows_count: int
    duration_s: float
    profile: str
    stop: str
    """Name of the Stop that ended it; empty where none is recorded."""
    text: str
    """The same as a sentence with its numbers; empty where nothing is known."""
    note: str = ""


def list_runs(root: Path) -> list[RunSummary]:
    """Summarise every run folder under `root`, oldest first; a damaged run is listed and raises nothing.

    Errors: RequestError where `root` is a file.
    """
    return [summary(folder) for folder in run_folders(root)]


def run_folders(root: Path) -> list[Path]:
    """Return every folder under `root` that may be a run, oldest first. Errors: RequestError where `root` is a file."""
    root = Path(root)
    if root.is_file():
        raise RequestError(f"{root}: is a file, and runs lie in a folder; give that folder")
    if not root.is_dir():
        return []
    return sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))


def summary(folder: Path, count_under_way: bool = True) -> RunSummary:
    """Summarise one run; rows of one under way are counted, without `count_under_way` they are 0."""
    try:
        manifest = read_manifest(folder)
        record = manifest.get("record", {})
        state = record.get("state", "")
        count, first_t_ns, last_t_ns = record.get("rows_count", 0), record.get("first_t_ns"), record.get("last_t_ns")
        stop, text = ending(manifest)
        note = ""
        if state == "recording":
            under_way = "session" if manifest.get("trigger") == "session" else "recording"
            state = under_way if is_held(folder / SAMPLES) else "crashed"
            count = 0
            if (count_under_way or state == "crashed") and (folder / SAMPLES).exists():
                count, first_t_ns, last_t_ns = recorded_extent(folder)
        elif count and not _has_end(folder / SAMPLES):
            found = recorded_extent(folder)[0] if (folder / SAMPLES).exists() else 0
            if found < count:
                state, note, count = "damaged", missing_text(count - found, count), found
    except RecordError as error:
        return RunSummary(folder, "damaged", 0, 0.0, "", "", "", str(error))
    duration_s = 0.0 if first_t_ns is None or last_t_ns is None else (last_t_ns - first_t_ns) * 1e-9
    return RunSummary(folder, state, count, duration_s, _profile_name(manifest), stop, text, note)


def _has_end(path: Path) -> bool:
    """Tell whether a samples file ends as a closed one does, without reading its rows."""
    try:
        with open(path, "rb") as file:
            file.seek(-len(END_MARKER), os.SEEK_END)
            return file.read() == END_MARKER
    except OSError:  # missing, or shorter than that
        return False


def missing_text(missing_count: int, rows_count: int) -> str:
    """Say how many rows of a run its file has lost."""
    return f"{missing_count} of {rows_count} rows are missing: {SAMPLES} was cut, damaged or deleted"


def _profile_name(manifest: dict) -> str:
    profile = manifest.get("profile", "")
    return str(profile.get("name", "")) if isinstance(profile, dict) else str(profile)


def ending(manifest: dict) -> tuple[str, str]:
    """Return how a run ended: the Stop's name, and the sentence with its numbers; empty where it doesn't say.

    The manifest's `end` has `stop` (a Stop's name or number) with its `detail`, or the `error` that ended it.
    """
    end = manifest.get("end", {})
    stop, error = end.get("stop", ""), str(end.get("error", ""))
    if isinstance(stop, int) and 0 <= stop < len(Stop):
        stop = Stop(stop).name
    known = Stop.__members__.get(str(stop))
    if known is None or (known is Stop.NONE and error):
        return str(stop), error
    return known.name, stop_sentence(known, str(end.get("detail", "")))


def profile_of(run: Run) -> Profile:
    """Return the profile that a run was made with. Errors: RecordError where this version can't read it."""
    try:
        return Profile.model_validate(run.manifest["profile"])
    except (KeyError, ValidationError) as error:
        first = str(error).splitlines()[0]
        made_by = f"stagectl {run.manifest.get('version', 'of that time')}"
        raise RecordError(
            f"{run.folder / MANIFEST}: the profile in it can't be read by this version: {first}; use {made_by}"
        ) from error


def show(folder: Path) -> dict[str, Any]:
    """Describe one run for people and for --json: what, how long, how it ended, health of its cycles, events."""
    run = read_run(folder)
    rows = run.rows
    summarised = summary(run.folder)
    missing_count, note = run.rows_missing_count, summarised.note
    if missing_count:
        note = missing_text(missing_count, missing_count + len(rows))
    description: dict[str, Any] = {
        "folder": str(run.folder),
        "state": "damaged" if missing_count else summarised.state,
        "note": note,
        "profile": summarised.profile,
        "stop": summarised.stop,
        "text": summarised.text,
        "rows_count": len(rows),
        "rows_missing_count": missing_count,
        "duration_s": float((rows["t_ns"][-1] - rows["t_ns"][0]) * 1e-9) if len(rows) else 0.0,
        "truncated": run.truncated,
        "missing_fields": list(run.missing_fields),
        "unknown_fields": list(run.unknown_fields),
        "snapshot": sorted(run.snapshot),
        "events": dict(Counter(event.get("event", "") for event in run.events)),
        "health": _health(run),
        "manifest": run.manifest,
    }
    return description


def _health(run: Run) -> dict[str, Any]:
    """Return counts and percentiles of the fields that the run has."""
    rows, health = run.rows, {}
    if not len(rows):
        return health
    for name in ("samples_lost", "cycles_missed"):
        if name not in run.missing_fields:
            health[name] = int(rows[name][-1])
    for name in ("lateness_ns", "tick_ns"):
        if name not in run.missing_fields:
            p50, p99, largest = np.percentile(rows[name], [50, 99, 100])
            health[name] = {"p50": float(p50), "p99": float(p99), "max": float(largest)}
    if "command_lost" not in run.missing_fields:
        health["commands_lost"] = int(np.count_nonzero(rows["command_lost"]))
    return health


def export(folder: Path, format: str, columns: Sequence[str] | None = None, out: Path | None = None) -> Path:
    """Write a run as csv, parquet or mat (default: samples.FORMAT in its folder) and return the file.

    Nothing is rounded: CSV numbers read back to the same bits, raw bytes are hex there, and unsigned bytes (n, width)
    in mat. `columns` are ROW fields (default: all that the run has).
    Errors: RequestError (format, column, `out` is no file), RecordError (no run, full disk).
    """
    if format not in FORMATS:
        raise RequestError(f"export format {format!r}: choose one of {', '.join(FORMATS)}")
    folder = Path(folder)
    read_manifest(folder)
    present = [name for name in recorded_fields(folder) if name in (ROW.names or ())]
    names = list(present if columns is None else columns)
    if not names:
        raise RecordError(f"{folder}: has no samples to export; `stagectl runs show` says how it ended")
    for name in names:
        if name not in present:
            raise RequestError(f"{folder}: no column {name!r} in this run{closest(name, present)}")
    if len(set(names)) != len(names):
        raise RequestError(f"{folder}: a column is asked for twice in {', '.join(names)}; name each once")
    target = Path(out) if out is not None else folder / f"samples.{format}"
    if os.path.exists(target) and not os.path.isfile(target):  # replacing a device or a pipe would remove it
        what = "a folder" if target.is_dir() else "a device, a pipe or a socket"
        raise RequestError(f"--out {str(out)!r}: {target} is {what}; give the path of a file, new or to be replaced")
    writers = {"csv": _write_csv, "parquet": _write_parquet, "mat": _write_mat}
    with _whole_target(target) as unborn:
        writers[format](folder, names, unborn)
    return target


@contextmanager
def _whole_target(target: Path) -> Iterator[Path]:
    """Give a path to write to that becomes `target` when all went well, and nothing otherwise."""
    unborn = target.with_name(f".{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield unborn
        unborn.replace(target)
    except OSError as error:
        raise RecordError(
            f"{target}: can't be written: {error} ({free_text(target.parent)}); the run itself is not affected; "
            "free space or give another path"
        ) from error
    finally:
        with suppress(OSError):  # its folder may not even exist
            unborn.unlink()


def _write_csv(folder: Path, names: list[str], target: Path) -> None:
    # Imported here: only exports need it. Its shortest decimal of a double reads back to the same bits.
    import pyarrow.csv as arrow_csv

    options = arrow_csv.WriteOptions(include_header=False, quoting_style="none")
    with open(target, "wb") as file:
        file.write((",".join(names) + "\n").encode())
        for rows in read_batches(folder):
            table = pa.table({name: _csv_column(rows[name]) for name in names})
            arrow_csv.write_csv(table, file, options)


def _csv_column(values: np.ndarray) -> pa.Array:
    if values.ndim == 2:
        return pa.array([row.tobytes().hex() for row in values])
    return pa.array(values, from_pandas=False)


def _write_parquet(folder: Path, names: list[str], target: Path) -> None:
    import pyarrow.parquet as parquet

    schema = schema_of(names)
    group_rows_count = 16_384  # row groups of 16 s: batches of 0.2 s would make a file of mostly footers
    with open(target, "wb") as file, parquet.ParquetWriter(file, schema) as writer:  # Arrow's paths are UTF-8
        waiting: list[pa.RecordBatch] = []
        for rows in read_batches(folder):
            waiting.append(to_batch(rows, schema))
            if sum(len(batch) for batch in waiting) >= group_rows_count:
                writer.write_table(pa.Table.from_batches(waiting, schema))
                waiting = []
        if waiting:
            writer.write_table(pa.Table.from_batches(waiting, schema))


def _write_mat(folder: Path, names: list[str], target: Path) -> None:
    from scipy.io import savemat

    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for rows in read_batches(folder):
        for name in names:
            parts[name].append(np.ascontiguousarray(rows[name]))
    content = {}
    for name in names:
        column = np.concatenate(parts[name]) if parts[name] else np.zeros((0, *ROW[name].shape), ROW[name].base)
        if column.nbytes > _MAT_VARIABLE_LIMIT_BYTES:
            raise RequestError(
                f"{folder}: {name} has {column.nbytes / 1e9:.1f} GB and a MAT variable ends at 2.1 GB; "
                "leave that column out or export to parquet"
            )
        content[name] = column
    savemat(target, content, appendmat=False, long_field_names=True, oned_as="column", do_compression=True)
