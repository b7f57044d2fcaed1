"""The memory that arrays of a search live in: what is freed stays with the process for the next one."""

import ctypes
import gc
import sys

_M_TRIM_THRESHOLD = -1  # mallopt(3)
_M_MMAP_THRESHOLD = -3
_NEVER_BYTES = 2**31 - 1
_LARGEST_OF_HEAP_BYTES = 32 * 1024 * 1024  # the C library takes no more


def keep_freed() -> None:
    """Let the C library keep what arrays free, until the process ends; elsewhere than on Linux it stays as it is.

    A column of 20 s at 1 kHz is 160 kB, and where a table of them is freed its memory goes back to the kernel: an
    addition took 85 us in place of 25, a search with several effects 140 s in place of 109. Alone the first limit makes
    it worse: it ends the C library's own raising of the second.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_M_MMAP_THRESHOLD, _LARGEST_OF_HEAP_BYTES)
            mallopt(_M_TRIM_THRESHOLD, _NEVER_BYTES)


def give_back() -> None:
    """Give the kernel back what has been freed until now: others are to work beside this process from here on.

    Searches that are over hold each other in circles, which the interpreter looks for by the count of objects and not
    by their size: after twenty of them a process held 11 GB; one of 2.4 GB kept 1.9 without a look for them, 0.4 with.
    """
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
