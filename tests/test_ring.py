"""The shared memory between servo and supervisor: whole rows, counted losses, and a writer that is killed."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from stagectl.errors import RecordError
from stagectl.ring import RequestReader, RequestWriter, RingReader, RingWriter, writer_alive
from stagectl.row import FRAMES, ROW, absent_value, layout_hash, new_rows
from stagectl.signals import COMMAND, MEASUREMENT, SETPOINT
from tests.small_disk import small_disk

pytestmark = pytest.mark.real_time

SMALL = np.dtype([("number", "i8"), ("copies", "i8", (63,))])
LARGE_REQUEST = np.dtype([("copies", "i8", (4000,))])
REQUEST = np.dtype([("target_m", "f8"), ("copies", "i8", (200,))])

KILLED_WRITER = """
import mmap, sys
import numpy as np
from pathlib import Path
from stagectl.ring import RingWriter
from stagectl.row import new_rows
ring_path, run_folder, progress_path = sys.argv[1:4]
with open(progress_path, "r+b") as file:
    progress = np.ndarray(1, np.int64, mmap.mmap(file.fileno(), 8))
ring = RingWriter(Path(ring_path), slots_count=int(sys.argv[4]), run_folder=run_folder)
row = new_rows()
number = 0
while True:
    row["cycle"] = number
    row["t_ns"] = number * 1_000_000
    row["end_position_m"] = number
    row["sensor_bytes"] = number % 251
    row["extra_4"] = number
    ring.write(row)
    number += 1
    progress[0] = number
"""


# The second page of the slots can't be written: the kernel kills the writer in the middle of a copy, every time.
LOCK_SECOND_PAGE = """
import ctypes, sys
import numpy as np
from pathlib import Path
from stagectl.ring import RequestWriter, RingWriter
from stagectl.row import new_rows
LARGE_REQUEST = np.dtype([("copies", "i8", (4000,))])
def lock_second_page(memory):
    address = ctypes.c_void_p(memory.slots.ctypes.data + 4096)
    if ctypes.CDLL(None).mprotect(address, ctypes.c_size_t(4096), 1) != 0:
        sys.exit("mprotect refused")
"""

WRITER_KILLED_IN_A_ROW = (
    LOCK_SECOND_PAGE
    + """
ring = RingWriter(Path(sys.argv[1]), slots_count=16)
lock_second_page(ring.memory)
row = new_rows()
row["cycle"] = 1
for _ in range(4):  # 1192 bytes a row: the fourth lies on both pages
    ring.write(row)
"""
)

PUBLISHER_KILLED_IN_A_VALUE = (
    LOCK_SECOND_PAGE
    + """
writer = RequestWriter(Path(sys.argv[1]), LARGE_REQUEST)
writer.publish({"copies": 1})
sys.stdin.read()
lock_second_page(writer.memory)
writer.publish({"copies": 2})
"""
)

FAST_PUBLISHER = (
    LOCK_SECOND_PAGE
    + """
writer = RequestWriter(Path(sys.argv[1]), LARGE_REQUEST)
value = np.zeros(1, LARGE_REQUEST)
while True:
    value["copies"] += 1
    writer.publish(value)
"""
)


@contextlib.contextmanager
def started(text, path):
    """Run a Python process in the project's folder; it is dead afterwards."""
    command = [sys.executable, "-c", text, str(path)]
    with subprocess.Popen(command, cwd=Path(__file__).parent.parent, stdin=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_until(condition):
    deadline_s = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline_s
        os.sched_yield()


def small_row(number):
    row = np.zeros(1, SMALL)
    row["number"] = number
    row["copies"] = number
    return row


@pytest.fixture
def ring_path():
    path = Path(f"/dev/shm/stagectl-test-{os.getpid()}-{time.monotonic_ns()}.ring")
    yield path
    path.unlink(missing_ok=True)


@pytest.fixture
def start_writer(ring_path, tmp_path):
    """Start a process that writes rows as fast as it can; returns it and the memory where it counts finished writes."""
    processes = []

    def start(slots_count, run_folder=""):
        progress_path = tmp_path / "progress"
        progress_path.write_bytes(bytes(8))
        command = [sys.executable, "-c", KILLED_WRITER, str(ring_path), str(run_folder), str(progress_path)]
        process = subprocess.Popen([*command, str(slots_count)], cwd=Path(__file__).parent.parent)
        processes.append(process)
        progress = np.memmap(progress_path, np.int64, "r")
        deadline_s = time.monotonic() + 120.0
        while progress[0] < 50:
            assert process.poll() is None, "the writer ended by itself"
            assert time.monotonic() < deadline_s
            os.sched_yield()
        return process, progress

    yield start
    for process in processes:
        process.kill()
        process.wait()


def test_row_has_every_signal_and_no_padding():
    names = set(ROW.names)
    assert set(MEASUREMENT.names) <= names
    assert {f"setpoint_{name}" for name in SETPOINT.names} <= names
    assert set(COMMAND.names) <= names
    assert "cycle" in names
    assert len(FRAMES) == 6
    assert all(offset % 8 == 0 for _, offset in (field[:2] for field in ROW.fields.values()))
    assert sum(ROW[name].itemsize for name in ROW.names) == ROW.itemsize


def test_new_rows_know_nothing():
    row = new_rows()[0]
    assert row["macro_tpdo_count"] == -1
    assert row["micro_emcy_count"] == -1
    assert row["sensor_bytes_count"] == 0
    assert np.isnan(row["backlash_left_stiffness_sd_n_per_m"])
    assert absent_value("micro_tpdo") == 0


def test_layout_hash_tells_type_shape_and_name():
    base = layout_hash(SMALL)
    assert base == layout_hash(np.dtype([("number", "<i8"), ("copies", "<i8", (63,))]))
    assert base != layout_hash(np.dtype([("number", "f8"), ("copies", "i8", (63,))]))
    assert base != layout_hash(np.dtype([("count", "i8"), ("copies", "i8", (63,))]))
    assert base != layout_hash(np.dtype([("number", "i8"), ("copies", "u8", (63,))]))
    assert base != layout_hash(np.dtype([("copies", "i8", (63,)), ("number", "i8")]))


def test_rows_arrive_once_in_order_across_the_end_of_the_ring(ring_path):
    writer = RingWriter(ring_path, slots_count=8, dtype=SMALL)
    reader = RingReader.attach(ring_path, SMALL)
    taken = []
    for number in range(100):
        writer.write(small_row(number))
        if number % 5 == 4:
            taken.extend(reader.read_new()["number"].tolist())
    assert taken == list(range(100))
    assert reader.lost_count == 0
    assert len(reader.read_new()) == 0


def test_overwritten_rows_are_counted():
    writer = RingWriter(None, slots_count=8, dtype=SMALL)
    reader = writer.reader()
    for number in range(20):
        writer.write(small_row(number))
    # 8 slots: the one of row 12 may be in change, so 13..19 are sure and 0..12 are lost.
    assert reader.read_new()["number"].tolist() == [13, 14, 15, 16, 17, 18, 19]
    assert reader.lost_count == 13
    writer.write(small_row(20))
    assert reader.read_new()["number"].tolist() == [20]
    assert reader.lost_count == 13


def test_rows_overwritten_while_they_are_copied_do_not_count_as_whole():
    writer = RingWriter(None, slots_count=8, dtype=SMALL)
    reader = writer.reader()
    for number in range(6):
        writer.write(small_row(number))
    assert reader._whole_after_copy(0, 6) == 0
    for number in range(6, 10):  # as if the writer ran on during the copy
        writer.write(small_row(number))
    # The slots of rows 0 and 1 are overwritten, that of row 2 may be in change.
    assert reader._whole_after_copy(0, 6) == 3


def test_last_rows_do_not_disturb_the_new_ones():
    writer = RingWriter(None, slots_count=8, dtype=SMALL)
    reader = writer.reader()
    for number in range(5):
        writer.write(small_row(number))
    assert reader.read_last(2)["number"].tolist() == [3, 4]
    assert reader.read_last(100)["number"].tolist() == [0, 1, 2, 3, 4]
    assert reader.read_new()["number"].tolist() == [0, 1, 2, 3, 4]


def test_reader_never_sees_half_a_row_from_a_writer_at_full_speed(start_writer, ring_path):
    process, _ = start_writer(slots_count=64)
    reader = RingReader(ring_path)
    seen_count, last = 0, -1
    while seen_count < 20_000:
        rows = reader.read_new()
        if not len(rows):
            continue
        numbers = rows["cycle"]
        assert np.array_equal(rows["extra_4"], numbers)
        assert np.array_equal(rows["end_position_m"], numbers)
        assert np.all(rows["sensor_bytes"] == (numbers % 251)[:, None])
        assert np.all(np.diff(numbers) == 1)
        assert numbers[0] > last
        last = int(numbers[-1])
        seen_count += len(rows)
        assert seen_count + reader.lost_count == last + 1
    process.kill()


def test_killed_writer_leaves_every_row_whole(start_writer, ring_path):
    process, progress = start_writer(slots_count=512)
    assert writer_alive(ring_path)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not writer_alive(ring_path)
    reader = RingReader(ring_path)
    finished_count = int(progress[0])
    assert reader.written_count - finished_count in (0, 1)
    assert reader.writer_pid == process.pid
    rows = reader.read_new()
    assert rows["cycle"][-1] == reader.written_count - 1
    assert np.array_equal(rows["extra_4"], rows["cycle"])
    assert len(rows) + reader.lost_count == reader.written_count


def test_another_layout_is_refused(ring_path):
    RingWriter(ring_path, slots_count=8, dtype=SMALL).close()
    with pytest.raises(RecordError, match="same version"):
        RingReader.attach(ring_path, ROW)
    with pytest.raises(RecordError, match="not a request block"):
        RequestReader.attach(ring_path, SMALL)


def test_same_size_but_other_meaning_is_refused(ring_path):
    RingWriter(ring_path, slots_count=8, dtype=SMALL).close()
    swapped = np.dtype([("copies", "i8", (63,)), ("number", "i8")])
    assert swapped.itemsize == SMALL.itemsize
    with pytest.raises(RecordError, match="layout"):
        RingReader.attach(ring_path, swapped)


@pytest.mark.parametrize("content", [b"", b"x" * 100, bytes(8192)])
def test_a_file_that_is_no_ring_is_refused(ring_path, content):
    ring_path.write_bytes(content)
    with pytest.raises(RecordError, match="ring"):
        RingReader.attach(ring_path)


def test_cut_ring_is_refused(ring_path):
    RingWriter(ring_path, slots_count=8, dtype=SMALL).close()
    os.truncate(ring_path, 4096 + 100)
    with pytest.raises(RecordError, match="damaged"):
        RingReader.attach(ring_path, SMALL)


def test_missing_ring_says_so(ring_path):
    with pytest.raises(RecordError, match="is its writer started"):
        RingReader.attach(ring_path)


def test_a_ring_is_never_overwritten(ring_path):
    first = RingWriter(ring_path, slots_count=8, dtype=SMALL)
    first.write(small_row(7))
    with pytest.raises(RecordError, match="living servo"):
        RingWriter(ring_path, slots_count=8, dtype=SMALL)
    first.close()
    with pytest.raises(RecordError, match="recover them"):
        RingWriter(ring_path, slots_count=8, dtype=SMALL)
    assert RingReader(ring_path, SMALL).read_new()["number"].tolist() == [7]
    assert list(ring_path.parent.glob(f".{ring_path.name}*")) == []


def test_full_shared_memory_is_an_error_at_the_start(tmp_path):
    with small_disk(tmp_path / "shm") as place:
        with pytest.raises(RecordError, match=r"no room for \d+\.\d MB"):
            RingWriter(place / "ring")
        assert list(place.iterdir()) == []


def test_shared_memory_that_can_not_be_made_leaves_no_file(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    try:
        with pytest.raises(RecordError, match="can't make shared memory"):
            RingWriter(tmp_path / "ring", slots_count=64, dtype=SMALL)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_the_ring_names_its_run(ring_path):
    RingWriter(ring_path, slots_count=8, dtype=SMALL, run_folder="/data/läufe/1").close()
    assert RingReader(ring_path, SMALL).run_folder == Path("/data/läufe/1")
    assert RingWriter(None, slots_count=8, dtype=SMALL).reader().run_folder is None


def test_write_keeps_nothing():
    writer = RingWriter(None)
    row = new_rows()
    blocks_before = sys.getallocatedblocks()
    for _ in range(5000):
        writer.write(row)
    assert sys.getallocatedblocks() - blocks_before < 50


def test_requests_arrive_with_their_number(ring_path):
    writer = RequestWriter(ring_path, REQUEST)
    reader = RequestReader.attach(ring_path, REQUEST)
    sequence, value = reader.read()
    assert (sequence, value["target_m"][0]) == (0, 0.0)
    assert writer.publish({"target_m": 0.25}) == 1
    assert writer.publish({"copies": 9}) == 2
    sequence, value = reader.read()
    assert sequence == 2
    assert value["target_m"][0] == 0.25
    assert np.all(value["copies"] == 9)
    changed = value.copy()
    changed["target_m"] = -1.0
    assert writer.publish(changed) == 3
    assert reader.read()[1]["target_m"][0] == -1.0


def test_unknown_request_field_changes_nothing():
    writer = RequestWriter(None, REQUEST)
    with pytest.raises(RecordError, match="no field 'target_mm'"):
        writer.publish({"target_mm": 1.0})
    with pytest.raises(RecordError, match="is not one of its values"):
        writer.publish(np.zeros(2, REQUEST))
    assert writer.reader().read()[0] == 0


def test_a_publication_that_never_ends_leaves_the_last_value():
    writer = RequestWriter(None, REQUEST)
    reader = writer.reader()
    writer.publish({"target_m": 1.0})
    assert reader.read()[0] == 1
    writer.memory.counter[0] += 1  # killed behind the first half of a publication
    writer.memory.slots["target_m"] = 666.0
    sequence, value = reader.read()
    assert (sequence, value["target_m"][0]) == (1, 1.0)
    assert reader.torn_count == 1


def test_requests_are_never_torn_under_a_fast_writer(ring_path):
    with started(FAST_PUBLISHER, ring_path):
        wait_until(ring_path.exists)
        reader = RequestReader(ring_path, LARGE_REQUEST)
        wait_until(lambda: reader.read()[0] > 0)
        last, changes_count = 0, 0
        while changes_count < 5000:
            sequence, value = reader.read()
            assert sequence >= last
            changes_count += sequence > last
            last = sequence
            assert np.all(value["copies"] == sequence)


def test_writer_killed_in_the_middle_of_a_row_has_not_counted_it(ring_path):
    with started(WRITER_KILLED_IN_A_ROW, ring_path) as process:
        assert process.wait() == -signal.SIGSEGV
    reader = RingReader(ring_path)
    assert reader.read_new()["cycle"].tolist() == [1, 1, 1]
    assert reader.lost_count == 0


def test_publisher_killed_in_the_middle_of_a_value_leaves_the_last_one(ring_path):
    with started(PUBLISHER_KILLED_IN_A_VALUE, ring_path) as process:
        wait_until(ring_path.exists)
        reader = RequestReader(ring_path, LARGE_REQUEST)
        wait_until(lambda: reader.read()[0] == 1)
        process.stdin.close()  # it goes on, into the page that it may not write
        assert process.wait() == -signal.SIGSEGV
    sequence, value = reader.read()
    assert sequence == 1
    assert np.all(value["copies"] == 1)
    assert reader.torn_count > 0


def test_a_second_living_request_writer_is_refused_and_a_dead_one_replaced(ring_path):
    first = RequestWriter(ring_path, REQUEST)
    with pytest.raises(RecordError, match="another process"):
        RequestWriter(ring_path, REQUEST)
    first.close()
    second = RequestWriter(ring_path, REQUEST)
    second.publish({"target_m": 2.0})
    assert RequestReader(ring_path, REQUEST).read()[0] == 1
