"""A real disk of a few megabytes, to be filled up in tests; mounting needs root."""

import contextlib
import ctypes
import os

import pytest


@contextlib.contextmanager
def small_disk(place, size_bytes=4 << 20):
    """Mount a tmpfs of `size_bytes` on the new folder `place`; skips the test where that is not allowed."""
    library = ctypes.CDLL(None, use_errno=True)
    place.mkdir()
    if library.mount(b"tmpfs", os.fsencode(place), b"tmpfs", 0, b"size=%d" % size_bytes) != 0:
        pytest.skip(f"mounting a small disk needs root: {os.strerror(ctypes.get_errno())}")
    try:
        yield place
    finally:
        library.umount2(os.fsencode(place), 2)  # 2 = MNT_DETACH: files that a failed test left open don't hold it
