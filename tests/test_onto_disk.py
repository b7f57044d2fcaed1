"""A durable run: the disk has it while it is written, and what the disk refuses is told."""

import errno
import os
import threading
import time

import numpy as np
import pytest

from stagectl.errors import RecordError
from stagectl.record import SAMPLES, Recorder, read_run
from stagectl.row import new_rows

PATIENCE_S = 20.0


def rows_of(count: int, start_s: float):
    rows = new_rows(count)
    rows["t_ns"] = (1e9 * start_s + 1e6 * np.arange(count)).astype(np.int64)
    rows["cycle"] = np.arange(count)
    return rows


def until(done) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < give_up_s
        time.sleep(0.005)


@pytest.fixture
def synced(monkeypatch):
    """Sizes of files when the disk had taken them, by name."""
    sizes: dict[str, int] = {}
    really = os.fdatasync

    def fdatasync(descriptor: int) -> None:
        size = os.fstat(descriptor).st_size
        really(descriptor)
        sizes[os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}"))] = size

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    return sizes


def test_the_disk_has_a_durable_run_a_tenth_of_a_second_behind(tmp_path, synced):
    with Recorder(tmp_path / "run", {}, durable=True) as recorder:
        for k in range(5):
            recorder.append(rows_of(100, 1.0 + 0.1 * k))
        recorder.append(rows_of(1, 1.5))  # the batch of the fifth is full only now
        written = (tmp_path / "run" / SAMPLES).stat().st_size
        until(lambda: synced.get(SAMPLES, 0) == written)
        assert read_run(tmp_path / "run").rows.size >= 400
    assert not [thread for thread in threading.enumerate() if thread.name == "onto-disk"]


def test_a_run_that_need_not_be_durable_waits_for_nobody(tmp_path, synced):
    with Recorder(tmp_path / "run", {}) as recorder:
        recorder.append(rows_of(1000, 1.0))
    assert synced == {}


def test_what_the_disk_refuses_is_told_with_the_next_rows(tmp_path, monkeypatch):
    def refuse(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    recorder = Recorder(tmp_path / "run", {}, durable=True)
    monkeypatch.setattr(os, "fdatasync", refuse)
    recorder.append(rows_of(200, 1.0))
    until(lambda: recorder._onto_disk._trouble is not None)
    with pytest.raises(RecordError, match=r"can't write the run: Input/output error"):
        recorder.append(rows_of(200, 1.2))
    recorder.abandon()
