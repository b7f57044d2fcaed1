"""Run folders: written as it happens, whole after every kind of end."""

import contextlib
import gc
import json
import os
import resource
import signal
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from stagectl.errors import RecordError
from stagectl.left_runs import finish_left_runs
from stagectl.record import (
    RESERVE_BYTES,
    Recorder,
    Recovery,
    read_manifest,
    read_run,
    recover,
    recover_orphans,
)
from stagectl.ring import RingReader, RingWriter
from stagectl.row import ROW, new_rows
from stagectl.samples_file import END_MARKER, extent, scan, schema_of
from stagectl.signals import Stop
from tests.small_disk import small_disk

RECORDING_SUPERVISOR = """
import sys
from pathlib import Path
from stagectl.record import Recorder
from stagectl.ring import RingReader
recorder = Recorder(Path(sys.argv[2]), {"name": "killed"})
recorder.event("begun", 0)
reader = RingReader(Path(sys.argv[1]))
while True:
    recorder.append(reader.read_new())
"""


def noisy_rows(count, seed=1, first=0):
    """Rows in which every bit of every field matters: random floats with nan and -0.0, integers, bytes."""
    random = np.random.default_rng(seed)
    rows = np.zeros(count, ROW)
    for name in ROW.names:
        if ROW[name].shape:
            rows[name] = random.integers(0, 256, (count, *ROW[name].shape), np.uint8)
        elif ROW[name] == np.float64:
            rows[name] = random.normal(size=count)
            rows[name][::7] = np.nan
            rows[name][1::7] = -0.0
        else:
            rows[name] = random.integers(-(2**62), 2**62, count)
    rows["cycle"] = first + np.arange(count)
    rows["t_ns"] = 5_000_000_000 + rows["cycle"] * 1_000_000
    return rows


@pytest.fixture
def ring_path():
    path = Path(f"/dev/shm/stagectl-test-{os.getpid()}-{time.monotonic_ns()}.ring")
    yield path
    path.unlink(missing_ok=True)


@pytest.fixture
def full_disk(tmp_path):
    with small_disk(tmp_path / "disk") as place:
        yield place


@pytest.fixture
def file_size_limit():
    """Limit the size of files that this process writes: a full disk for everybody who is not root."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size_bytes: resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_every_bit_comes_back(tmp_path):
    rows = noisy_rows(1234)
    with Recorder(tmp_path / "run", {"profile": {"name": "oled-printer"}, "seed": np.int64(3)}) as recorder:
        recorder.append(rows[:1])
        recorder.append(rows[1:900])
        recorder.append(rows[900:900])
        recorder.append(rows[900:])
    run = read_run(tmp_path / "run")
    assert run.rows.tobytes() == rows.tobytes()
    assert not run.truncated
    assert run.missing_fields == run.unknown_fields == ()
    assert run.manifest["profile"]["name"] == "oled-printer"
    assert run.manifest["seed"] == 3
    assert run.manifest["record"]["state"] == "closed"
    assert run.manifest["record"]["rows_count"] == 1234
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "events.jsonl",
        "manifest.json",
        "samples.arrow",
    ]


def test_other_arrow_readers_see_an_ordinary_stream_with_units(tmp_path):
    rows = noisy_rows(300)
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(rows)
    table = pa.ipc.open_stream(tmp_path / "run" / "samples.arrow").read_all()
    assert table.schema.field("macro_tpdo").type == pa.binary(8)
    assert table.schema.field("sensor_bytes").type == pa.binary(512)
    assert table.schema.field("end_velocity_estimate_m_per_s").metadata == {b"unit": b"m/s"}
    assert table["cycle"].to_pylist() == list(range(300))
    assert table["macro_rpdo"][17].as_py() == rows["macro_rpdo"][17].tobytes()


def test_rows_are_in_the_file_within_a_quarter_of_a_second(tmp_path):
    recorder = Recorder(tmp_path / "run", {})
    rows = noisy_rows(2000)
    for begin in range(0, 2000, 50):
        recorder.append(rows[begin : begin + 50])
        on_disk = sum(len(piece.batch) for piece in scan(tmp_path / "run" / "samples.arrow") if piece.batch is not None)
        assert on_disk >= begin + 50 - 250
    batches = [piece.batch for piece in scan(tmp_path / "run" / "samples.arrow") if piece.batch is not None]
    spans_s = [np.ptp(batch.column("t_ns").to_numpy()) * 1e-9 for batch in batches]
    assert max(spans_s) < 0.25
    recorder.close()


def test_a_clock_that_stands_or_jumps_loses_no_row(tmp_path):
    rows = noisy_rows(5000)
    rows["t_ns"][1000:4000] = 7
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(rows)
    assert read_run(tmp_path / "run").rows.tobytes() == rows.tobytes()


def test_the_caller_may_use_its_rows_again(tmp_path):
    row = new_rows()
    with Recorder(tmp_path / "run", {}) as recorder:
        for number in range(10):
            row["cycle"] = number
            recorder.append(row)
    assert read_run(tmp_path / "run").rows["cycle"].tolist() == list(range(10))


def test_events_keep_order_place_and_values(tmp_path):
    state = np.zeros(1, np.dtype([("gain_n", "f8"), ("count", "i8")]))
    state["gain_n"] = 0.1
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.event("law", 10, law="dsmc", parameters=state, stop=Stop.LEASE)
        recorder.append(noisy_rows(5))
        recorder.event("target", 20, position_m=np.float64(0.1) + 0.2, raw=b"\x01\xff", folder=tmp_path)
        recorder.event("lease", 30, row=2, left_ns=np.int64(5))
    first, second, third = read_run(tmp_path / "run").events
    assert first == {"event": "law", "t_ns": 10, "row": 0, "law": "dsmc", "stop": 12, "parameters": {
        "gain_n": 0.1, "count": 0}}  # fmt: skip
    assert second["row"] == 5
    assert second["position_m"] == 0.30000000000000004
    assert second["raw"] == "01ff"
    assert (third["row"], third["left_ns"]) == (2, 5)
    line = (tmp_path / "run" / "events.jsonl").read_text().splitlines()[1]
    assert line.startswith('{"event": "target", "t_ns": 20, "row": 5, ')


def test_snapshot_is_bit_for_bit(tmp_path):
    state = noisy_rows(1)
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.save_snapshot({"law": state, "framer": np.frombuffer(b"half a li", np.uint8)})
        with pytest.raises(RecordError, match="'guard' holds Python objects"):
            recorder.save_snapshot({"guard": np.array([object()])})
    snapshot = read_run(tmp_path / "run").snapshot
    assert snapshot["law"].dtype == ROW
    assert snapshot["law"].tobytes() == state.tobytes()
    assert snapshot["framer"].tobytes() == b"half a li"


def test_damaged_snapshot_says_so(tmp_path):
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.save_snapshot({"law": np.zeros(3)})
    path = tmp_path / "run" / "snapshot.npz"
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(RecordError, match="can be looked at, not replayed"):
        read_run(tmp_path / "run")


def test_the_manifest_is_there_before_the_first_row(tmp_path):
    recorder = Recorder(tmp_path / "run", {"name": "early"})
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["name"] == "early"
    assert manifest["record"]["state"] == "recording"
    assert manifest["record"]["pid"] == os.getpid()
    recorder.close({"stop": Stop.FINISHED})
    assert read_manifest(tmp_path / "run")["end"] == {"stop": 1}


def test_an_exception_ends_the_run_readable(tmp_path):
    def interrupted():
        with Recorder(tmp_path / "run", {}) as recorder:
            recorder.append(noisy_rows(33))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    run = read_run(tmp_path / "run")
    assert len(run.rows) == 33
    assert not run.truncated
    assert run.manifest["end"] == {"error": "KeyboardInterrupt: "}


def test_a_run_is_never_written_over(tmp_path):
    Recorder(tmp_path / "run", {}).close()
    with pytest.raises(RecordError, match="already holds a run"):
        Recorder(tmp_path / "run", {})


def test_rows_of_another_layout_and_rows_after_the_end_are_refused(tmp_path):
    recorder = Recorder(tmp_path / "run", {})
    with pytest.raises(RecordError, match="another layout"):
        recorder.append(np.zeros(3, [("t_ns", "i8")]))
    recorder.close()
    recorder.close()
    with pytest.raises(RecordError, match="after the run was closed"):
        recorder.append(new_rows())


@pytest.mark.parametrize(("fields", "step"), [(None, 7), (["t_ns", "cycle", "end_position_m", "macro_tpdo"], 1)])
def test_cut_at_every_byte_of_the_last_batch_all_whole_batches_are_read(tmp_path, fields, step):
    """At every seventh where the batch has all columns: the kinds of bytes are the same, and there are 9 000."""
    rows = noisy_rows(6)
    rows["t_ns"] = rows["cycle"] * 100_000_000  # two rows a batch: the file is short and the test too
    with Recorder(tmp_path / "run", {}, fields) as recorder:
        recorder.append(rows)
    path = tmp_path / "run" / "samples.arrow"
    content = path.read_bytes()
    pieces = list(scan(path))
    assert [len(piece.batch) for piece in pieces[1:]] == [2, 2, 2]
    whole_end_bytes, end_bytes = pieces[2].end_bytes, pieces[3].end_bytes
    assert content[end_bytes:] == END_MARKER
    for size_bytes in range(len(content) - 1, whole_end_bytes - 1, -step):
        os.truncate(path, size_bytes)
        counts = [len(piece.batch) for piece in scan(path) if piece.batch is not None]
        assert counts == ([2, 2, 2] if size_bytes >= end_bytes else [2, 2]), size_bytes
    for size_bytes in (end_bytes, end_bytes - 1, whole_end_bytes + 1, whole_end_bytes):
        path.write_bytes(content[:size_bytes])
        run = read_run(tmp_path / "run")
        assert run.truncated
        count = 6 if size_bytes == end_bytes else 4
        for name in schema_of(fields).names:
            assert run.rows[name].tobytes() == rows[name][:count].tobytes()


def counted(path):
    """Return (rows, end, time of the last row) by reading every batch."""
    pieces = [piece for piece in scan(path)]
    full = [piece.batch for piece in pieces if piece.batch is not None and len(piece.batch)]
    last_t_ns = full[-1].column("t_ns")[-1].as_py() if full else None
    return sum(map(len, full)), pieces[-1].end_bytes if pieces else 0, last_t_ns


def test_the_extent_of_a_file_is_what_reading_all_of_it_gives(tmp_path):
    """Of 400 batches, most of them not read; whole, cut in a batch, a heading, the schema, damaged, empty."""
    rows = new_rows(800)
    rows["cycle"] = np.arange(1, 801)
    rows["t_ns"] = rows["cycle"] * 100_000_000
    with Recorder(tmp_path / "run", {}, ["t_ns", "cycle"]) as recorder:
        recorder.append(rows)
    path = tmp_path / "run" / "samples.arrow"
    content = path.read_bytes()
    ends = [piece.end_bytes for piece in scan(path)]
    assert len(ends) == 401
    random = np.random.default_rng(3)
    cuts = [len(content), ends[0], ends[0] - 1, 3, 0, ends[7] + 3, ends[300], *random.integers(0, len(content), 40)]
    for size_bytes in cuts:
        path.write_bytes(content[:size_bytes])
        found = extent(path)
        last_t_ns = None if found.last is None else found.last.column("t_ns")[-1].as_py()
        assert (found.rows_count, found.end_bytes, last_t_ns) == counted(path), size_bytes
    for at in (ends[-2] + 8, ends[-3] + 20, ends[-40] + 4, ends[-5] + 300):
        path.write_bytes(content[:at] + b"\xff" * 8 + content[at + 8 :])
        found = extent(path)
        assert (found.rows_count, found.end_bytes) == counted(path)[:2], at
    path.write_bytes(content[:-40] + bytes(4000))
    assert (extent(path).rows_count, extent(path).end_bytes) == counted(path)[:2]


@pytest.mark.parametrize("tail", [bytes(5000), b"\xff" * 64, b"garbage of a dying disk" * 100])
def test_whatever_follows_the_last_batch_is_seen_as_a_cut(tmp_path, tail):
    rows = noisy_rows(400)
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(rows)
    path = tmp_path / "run" / "samples.arrow"
    path.write_bytes(path.read_bytes().removesuffix(END_MARKER) + tail)
    run = read_run(tmp_path / "run")
    assert run.truncated
    assert run.rows.tobytes() == rows.tobytes()


def test_cut_before_the_first_batch_and_missing_files(tmp_path):
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(noisy_rows(3))
    path = tmp_path / "run" / "samples.arrow"
    for size_bytes in (0, 3, 100):
        os.truncate(path, size_bytes)
        run = read_run(tmp_path / "run")
        assert run.truncated
        assert len(run.rows) == 0
    path.unlink()
    assert read_run(tmp_path / "run").truncated
    with pytest.raises(RecordError, match="not a run folder"):
        read_run(tmp_path)


def test_half_an_event_is_left_out(tmp_path):
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.event("one", 1)
        recorder.event("two", 2)
    path = tmp_path / "run" / "events.jsonl"
    path.write_bytes(path.read_bytes()[:-4])
    run = read_run(tmp_path / "run")
    assert [event["event"] for event in run.events] == ["one"]
    assert run.truncated


@pytest.mark.parametrize("line", [b"1", b"[]", b"null", b'"text"', b"{}", b'{"event": []}', b"[" * 100_000])
def test_a_line_that_is_no_event_ends_the_events(tmp_path, line):
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.event("one", 1)
    path = tmp_path / "run" / "events.jsonl"
    path.write_bytes(path.read_bytes() + line + b"\n" + path.read_bytes())
    run = read_run(tmp_path / "run")
    assert [event["event"] for event in run.events] == ["one"]
    assert run.truncated


@pytest.mark.parametrize(
    ("name", "value"),
    [("record", None), ("record", []), ("end", None), ("end", -1), ("mappings", None), ("profile", {"cycle": None})],
)
def test_a_manifest_that_no_recorder_writes_is_refused(tmp_path, name, value):
    with Recorder(tmp_path / "run", {}):
        pass
    path = tmp_path / "run" / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    with pytest.raises(RecordError, match=rf"manifest\.json: {name}.* is .*; the file is damaged"):
        read_manifest(tmp_path / "run")


@pytest.mark.parametrize("name", ["rows_count", "first_t_ns", "last_t_ns", "state", "format"])
def test_a_record_with_a_value_of_another_kind_is_refused(tmp_path, name):
    with Recorder(tmp_path / "run", {}):
        pass
    path = tmp_path / "run" / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["record"][name] = ["odd"]
    path.write_text(json.dumps(manifest))
    with pytest.raises(RecordError, match=r"manifest\.json"):
        read_manifest(tmp_path / "run")


def test_a_folder_whose_name_is_no_utf_8_holds_a_run(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    rows = noisy_rows(700)
    with Recorder(folder, {"profile_path": str(folder)}) as recorder:
        recorder.event("imported", 1, source=folder)
        recorder.append(rows)
    run = read_run(folder)
    assert run.rows.tobytes() == rows.tobytes()
    assert not run.truncated
    assert run.manifest["profile_path"] == run.events[0]["source"] == str(folder)


def test_rows_that_the_file_lost_are_counted(tmp_path):
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(noisy_rows(700))
    assert read_run(tmp_path / "run").rows_missing_count == 0
    path = tmp_path / "run" / "samples.arrow"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    run = read_run(tmp_path / "run")
    assert run.rows_missing_count == 700 - len(run.rows) > 0
    path.unlink()
    assert read_run(tmp_path / "run").rows_missing_count == 700


def test_a_run_of_another_version_is_read_by_name(tmp_path):
    rows = noisy_rows(10)
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(rows)
    path = tmp_path / "run" / "samples.arrow"
    table = pa.ipc.open_stream(path).read_all()
    short = pa.array([value.as_py()[:100] for value in table["sensor_bytes"]], pa.binary(100))
    older = (
        table.drop_columns(["homing_id", "contact_force_estimate_n", "macro_tpdo_count", "sensor_bytes"])
        .append_column("sensor_bytes", short)
        .append_column("coil_resistance_ohm", pa.array(np.ones(10)))
    )
    with pa.ipc.new_stream(path, older.schema) as writer:
        writer.write_table(older)
    run = read_run(tmp_path / "run")
    assert run.missing_fields == ("macro_tpdo_count", "contact_force_estimate_n", "homing_id")
    assert run.unknown_fields == ("coil_resistance_ohm",)
    assert np.array_equal(run.rows["end_position_m"], rows["end_position_m"], equal_nan=True)
    assert np.all(run.rows["macro_tpdo_count"] == -1)
    assert np.all(np.isnan(run.rows["contact_force_estimate_n"]))
    assert np.all(run.rows["homing_id"] == 0)
    assert np.array_equal(run.rows["sensor_bytes"][:, :100], rows["sensor_bytes"][:, :100])
    assert not run.rows["sensor_bytes"][:, 100:].any()


def test_a_field_with_another_meaning_is_refused(tmp_path):
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(noisy_rows(2))
    table = pa.table({"t_ns": pa.array([1.0, 2.0])})
    with pa.ipc.new_stream(tmp_path / "run" / "samples.arrow", table.schema) as writer:
        writer.write_table(table)
    with pytest.raises(RecordError, match="t_ns is double and int64 is expected"):
        read_run(tmp_path / "run")


def fill_up(path):
    with open(path, "wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(65536))
    assert os.statvfs(path.parent).f_bavail == 0


def test_full_disk_loses_nothing(full_disk):
    recorder = Recorder(full_disk / "run", {"name": "full"})
    recorder.event("begun", 0)
    rows = noisy_rows(6000)
    handed_over = 0

    def record_on():
        nonlocal handed_over
        while handed_over < len(rows):
            handed_over += 50
            recorder.append(rows[handed_over - 50 : handed_over])

    with pytest.raises(RecordError) as caught:
        record_on()
    text = str(caught.value)
    assert str(full_disk / "run") in text
    assert "No space left on device" in text
    assert "are safe" in text
    assert "free space" in text
    # The reserve took what did not fit: all rows so far are on the full disk, and those of the stop too.
    assert "; 0 rows and 0 events are held" in text
    assert not (full_disk / "run" / ".reserve").exists()
    assert f"{handed_over} rows, to cycle {handed_over - 1}, are safe" in text
    recorder.append(rows[handed_over : handed_over + 100])
    recorder.event("stopped", 99)
    recorder.close({"stop": 2})
    handed_over += 100
    run = read_run(full_disk / "run")
    assert run.rows.tobytes() == rows[:handed_over].tobytes()
    assert [event["event"] for event in run.events] == ["begun", "stopped"]
    assert not run.truncated
    assert run.manifest["end"] == {"stop": 2}


def test_a_disk_full_beyond_the_reserve_keeps_rows_until_there_is_room(full_disk):
    recorder = Recorder(full_disk / "run", {})
    rows = noisy_rows(2000)
    recorder.append(rows[:400])
    recorder.flush()
    (full_disk / "run" / ".reserve").unlink()
    filler = full_disk / "filler"
    fill_up(filler)
    begin = 400
    while begin < 1500:
        with pytest.raises(RecordError, match="400 rows, to cycle 399, are safe; ") as caught:
            recorder.append(rows[begin : begin + 300])
        begin += 300
        assert f"{begin - 400} rows and 0 events are held in memory" in str(caught.value)
    with pytest.raises(RecordError, match="1 events are held"):
        recorder.event("no room", 5)
    with pytest.raises(RecordError, match="are held in memory"):
        recorder.close()
    cut_short = read_run(full_disk / "run")
    assert cut_short.truncated
    assert cut_short.rows.tobytes() == rows[:400].tobytes()
    filler.unlink()
    recorder.close()
    run = read_run(full_disk / "run")
    assert run.rows.tobytes() == rows[:begin].tobytes()
    assert [event["event"] for event in run.events] == ["no room"]
    assert not run.truncated


def test_no_room_for_the_reserve_refuses_before_the_stage_moves(full_disk):
    with open(full_disk / "filler", "wb") as file:
        file.write(bytes(4 * 1024 * 1024 - RESERVE_BYTES))
    with pytest.raises(RecordError, match="nothing was recorded"):
        Recorder(full_disk / "run", {})


def test_a_write_that_fails_in_the_middle_leaves_no_half_batch(tmp_path, file_size_limit):
    recorder = Recorder(tmp_path / "run", {})
    rows = noisy_rows(1000)
    recorder.append(rows[:200])
    recorder.flush()
    size_bytes = (tmp_path / "run" / "samples.arrow").stat().st_size
    file_size_limit(size_bytes + 1000)
    recorder.append(rows[200:399])
    with pytest.raises(RecordError, match="File too large"):
        recorder.append(rows[399:800])
    assert (tmp_path / "run" / "samples.arrow").stat().st_size == size_bytes
    file_size_limit(resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    recorder.append(rows[800:])
    recorder.close()
    assert read_run(tmp_path / "run").rows.tobytes() == rows.tobytes()


def test_folder_that_can_not_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match="can't begin a run"):
        Recorder(tmp_path / "file" / "run", {})


def write_rows(ring, rows):
    for number in range(len(rows)):
        ring.write(rows[number : number + 1])


def test_recover_appends_what_only_the_ring_has(tmp_path, ring_path):
    rows = noisy_rows(1000)
    ring = RingWriter(ring_path, slots_count=2048, run_folder=tmp_path / "run")
    write_rows(ring, rows)
    recorder = Recorder(tmp_path / "run", {})
    recorder.event("begun", 1)
    recorder.append(rows[:700])
    recorder.append(rows[700:750])  # not flushed when it dies
    recorder.abandon()
    path = tmp_path / "run" / "samples.arrow"
    os.truncate(path, path.stat().st_size - 3)  # cuts the batch of rows 600 .. 699
    with open(tmp_path / "run" / "events.jsonl", "ab") as file:
        file.write(b'{"event": "hal')
    ring.close()
    recovery = recover(ring_path, tmp_path / "run")
    run = read_run(tmp_path / "run")
    assert run.rows.tobytes() == rows.tobytes()
    assert recovery == Recovery(rows_count=400, rows_lost_count=0)
    assert not run.truncated
    assert [event["event"] for event in run.events] == ["begun", "recovered"]
    assert run.manifest["record"]["state"] == "recovered"
    assert run.manifest["record"]["rows_count"] == 1000
    assert not ring_path.exists()
    assert not (tmp_path / "run" / ".reserve").exists()


def test_recover_twice_adds_nothing(tmp_path, ring_path):
    rows = noisy_rows(300)
    ring = RingWriter(ring_path, slots_count=512)
    write_rows(ring, rows)
    ring.close()
    Recorder(tmp_path / "run", {}).abandon()
    assert recover(ring_path, tmp_path / "run", keep_ring=True).rows_count == 300
    assert recover(ring_path, tmp_path / "run").rows_count == 0
    assert read_run(tmp_path / "run").rows.tobytes() == rows.tobytes()


def test_rows_overwritten_before_recovery_are_said(tmp_path, ring_path):
    rows = noisy_rows(300)
    ring = RingWriter(ring_path, slots_count=64)
    write_rows(ring, rows)
    ring.close()
    recorder = Recorder(tmp_path / "run", {})
    recorder.append(rows[:100])
    recorder.flush()
    recorder.abandon()
    assert recover(ring_path, tmp_path / "run") == Recovery(rows_count=63, rows_lost_count=137)
    run = read_run(tmp_path / "run")
    assert run.rows["cycle"].tolist() == [*range(100), *range(237, 300)]
    assert run.manifest["record"]["rows_lost_count"] == 137
    assert run.events[-1]["rows_lost_count"] == 137


def test_recover_leaves_the_living_alone(tmp_path, ring_path):
    ring = RingWriter(ring_path, slots_count=64, run_folder=tmp_path / "run")
    write_rows(ring, noisy_rows(10))
    recorder = Recorder(tmp_path / "run", {})
    with pytest.raises(RecordError, match="still records this run"):
        recover(ring_path, tmp_path / "run")
    recorder.abandon()
    Recorder(tmp_path / "other", {}).abandon()
    with pytest.raises(RecordError, match="recover them there"):
        recover(ring_path, tmp_path / "other")
    # A servo whose supervisor died drains its own ring.
    assert recover(ring_path, tmp_path / "run").rows_count == 10


def test_recover_on_a_full_disk_keeps_the_ring(tmp_path, ring_path, file_size_limit):
    rows = noisy_rows(400)
    ring = RingWriter(ring_path, slots_count=512)
    write_rows(ring, rows)
    ring.close()
    Recorder(tmp_path / "run", {}).abandon()
    file_size_limit(100_000)
    with pytest.raises(RecordError, match="keeps them until the host restarts"):
        recover(ring_path, tmp_path / "run")
    file_size_limit(resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    recover(ring_path, tmp_path / "run")
    assert read_run(tmp_path / "run").rows.tobytes() == rows.tobytes()


def test_orphans_are_found_and_one_bad_ring_stops_no_other(tmp_path):
    shared = tmp_path / "shm"
    shared.mkdir()
    rows = noisy_rows(20)
    for name, folder in (("a", ""), ("b", tmp_path / "run"), ("c", tmp_path / "gone")):
        ring = RingWriter(shared / f"stagectl-{name}.ring", slots_count=64, run_folder=folder)
        write_rows(ring, rows)
        ring.close()
    living = RingWriter(shared / "stagectl-d.ring", slots_count=64, run_folder=tmp_path / "run")
    Recorder(tmp_path / "run", {}).abandon()
    outcomes = {path.name: outcome for path, outcome in recover_orphans(shared)}
    assert outcomes["stagectl-b.ring"] == Recovery(20, 0)
    assert "names no run" in str(outcomes["stagectl-a.ring"])
    assert "not a run folder" in str(outcomes["stagectl-c.ring"])
    assert set(outcomes) == {"stagectl-a.ring", "stagectl-b.ring", "stagectl-c.ring"}
    assert sorted(path.name for path in shared.iterdir()) == ["stagectl-a.ring", "stagectl-c.ring", "stagectl-d.ring"]
    living.close()


def test_orphans_of_one_folder_are_recovered_and_others_wait_for_theirs(tmp_path):
    shared = tmp_path / "shm"
    shared.mkdir()
    folders = {"a": "", "b": tmp_path / "one" / "run", "c": tmp_path / "two" / "run"}
    for name, folder in folders.items():
        ring = RingWriter(shared / f"stagectl-{name}.ring", slots_count=64, run_folder=folder)
        write_rows(ring, noisy_rows(20))
        ring.close()
        if folder:
            Recorder(folder, {}).abandon()
    (shared / "stagectl-d.ring").write_bytes(b"of another version")
    outcomes = {path.name: outcome for path, outcome in recover_orphans(shared, tmp_path / "one")}
    assert outcomes == {"stagectl-b.ring": Recovery(20, 0)}
    assert sorted(path.name for path in shared.iterdir()) == [f"stagectl-{name}.ring" for name in "acd"]


@pytest.mark.parametrize("whose", ["a pipe", "a link", "another's"])
def test_what_others_put_into_shared_memory_is_left_alone(tmp_path, monkeypatch, whose):
    shared = tmp_path / "shm"
    shared.mkdir()
    path = shared / "stagectl-1-a.ring"
    if whose == "a pipe":
        os.mkfifo(path)
    else:
        ring = RingWriter(tmp_path / "ring", slots_count=64, run_folder=tmp_path / "run")
        write_rows(ring, noisy_rows(20))
        ring.close()
        if whose == "a link":
            path.symlink_to(tmp_path / "ring")
        else:
            (tmp_path / "ring").rename(path)
            own = os.geteuid()
            monkeypatch.setattr(os, "geteuid", lambda: own + 1)
    Recorder(tmp_path / "run", {}).abandon()
    assert recover_orphans(shared) == []
    assert finish_left_runs(tmp_path, shared) == []
    assert len(read_run(tmp_path / "run").rows) == 0
    assert path in shared.iterdir()


def started(*arguments):
    return subprocess.Popen([sys.executable, "-c", *map(str, arguments)], cwd=Path(__file__).parent.parent)


def wait_until(condition):
    deadline_s = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline_s
        os.sched_yield()


@pytest.mark.parametrize("killed_first", ["supervisor", "servo"])
def test_kill_9_of_both_processes_keeps_every_cycle(tmp_path, ring_path, killed_first):
    """A servo at full speed and a supervisor that records it are killed; the run has every cycle up to the kill."""
    servo_text = """
import mmap, sys
import numpy as np
from pathlib import Path
from stagectl.ring import RingWriter
from stagectl.row import new_rows
with open(sys.argv[3], "r+b") as file:
    progress = np.ndarray(2, np.int64, mmap.mmap(file.fileno(), 16))
ring = RingWriter(Path(sys.argv[1]), run_folder=sys.argv[2])
row = new_rows()
while True:
    number = progress[0]
    if number >= progress[1]:
        continue
    row["cycle"] = number
    row["t_ns"] = number * 1_000_000
    row["extra_1"] = number
    ring.write(row)
    progress[0] = number + 1
"""
    progress_path = tmp_path / "progress"
    progress_path.write_bytes(bytes(16))
    progress = np.memmap(progress_path, np.int64, "r+")
    folder = tmp_path / "run"
    processes = {"servo": started(servo_text, ring_path, folder, progress_path)}
    try:
        wait_until(ring_path.exists)
        processes["supervisor"] = started(RECORDING_SUPERVISOR, ring_path, folder)
        progress[1] = 5000
        wait_until(lambda: (folder / "samples.arrow").exists() and len(list(scan(folder / "samples.arrow"))) > 3)
        progress[1] = 10_000  # the servo runs free: the kills meet it, and the supervisor, in the middle of writing
        wait_until(lambda: progress[0] > 5500)
        order = [killed_first, *(name for name in processes if name != killed_first)]
        for name in order:
            processes[name].send_signal(signal.SIGKILL)
            processes[name].wait()
    finally:
        for process in processes.values():
            process.kill()
            process.wait()
    written_count = RingReader(ring_path).written_count
    assert written_count - progress[0] in (0, 1)
    before = read_run(folder)
    assert before.truncated
    assert read_manifest(folder)["record"]["state"] == "recording"
    recovery = recover(ring_path, folder)
    run = read_run(folder)
    assert run.rows["cycle"].tolist() == list(range(written_count))
    assert np.array_equal(run.rows["extra_1"], run.rows["cycle"])
    assert recovery.rows_lost_count == 0
    assert len(before.rows) + recovery.rows_count == written_count


def test_recorders_that_are_done_keep_no_memory(tmp_path):
    """Each kept 2.6 MB until all garbage was collected: 36 MB behind 45 faults, in a service that runs for months."""
    rows = new_rows(50)
    rows["t_ns"] = np.arange(50) * 1_000_000

    def record(number: int) -> None:
        recorder = Recorder(tmp_path / str(number), {}, durable=number % 2 == 0)
        recorder.append(rows)
        recorder.close() if number % 3 else recorder.abandon()

    record(0)
    gc.disable()
    tracemalloc.start()
    try:
        for number in range(1, 13):
            record(number)
        assert tracemalloc.get_traced_memory()[0] < 500_000
    finally:
        tracemalloc.stop()
        gc.enable()


def test_a_recorder_takes_no_more_memory_as_it_goes_on(tmp_path):
    """A run may go on for months, and the first pile of rows behind a hiccup of the host may come after hours."""
    with Recorder(tmp_path / "run", {}) as recorder:

        def record(rows_count: int, first: int) -> int:
            rows = new_rows(rows_count)
            rows["t_ns"] = (first + np.arange(rows_count)) * 1_000_000
            recorder.append(rows)
            return first + rows_count

        next_row = record(50, 0)
        tracemalloc.start()
        try:
            for _ in range(5):
                next_row = record(300, next_row)
            before, _ = tracemalloc.get_traced_memory()
            next_row = record(5000, next_row)
            for _ in range(300):
                next_row = record(300, next_row)
            assert tracemalloc.get_traced_memory()[0] - before < 10_000
        finally:
            tracemalloc.stop()
    read = read_run(tmp_path / "run")
    np.testing.assert_array_equal(read.rows["t_ns"], np.arange(next_row) * 1_000_000)
