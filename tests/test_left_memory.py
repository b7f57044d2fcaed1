"""Shared memory that nobody needs any more: gone at the next start, and never under a stage that lives."""

import os
import subprocess
import sys

import pytest

from stagectl.left_memory import remove_left_blocks

BLOCKS = ("requests", "segments", "status")


@pytest.fixture
def dead_pid():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def make(folder, pid, *names):
    for name in names:
        (folder / f"stagectl-{pid}-0123abcd.{name}").write_bytes(b"x")


def test_blocks_of_a_dead_supervisor_go(tmp_path, dead_pid):
    make(tmp_path, dead_pid, *BLOCKS)
    assert [path.suffix[1:] for path in remove_left_blocks(tmp_path)] == list(BLOCKS)
    assert list(tmp_path.iterdir()) == []


def test_a_ring_that_is_not_recovered_keeps_them(tmp_path, dead_pid):
    make(tmp_path, dead_pid, *BLOCKS, "ring")
    assert remove_left_blocks(tmp_path) == []
    assert len(list(tmp_path.iterdir())) == 4


def test_a_living_supervisor_and_what_is_not_ours_keep_theirs(tmp_path, dead_pid):
    make(tmp_path, os.getpid(), *BLOCKS)
    others = ("stagectl-x.status", f"stagectl-{dead_pid}-0123abcd.other", f"other-{dead_pid}-0123abcd.status")
    for name in others:
        (tmp_path / name).write_bytes(b"x")
    assert remove_left_blocks(tmp_path) == []
    assert len(list(tmp_path.iterdir())) == len(BLOCKS) + len(others)
