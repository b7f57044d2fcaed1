"""Arrays of a search take over the memory of those before them."""

import subprocess
import sys

import pytest

_PAGES_COUNT = 40  # of a column of 20 s at 1 kHz
_COLUMNS_COUNT = 500
_TABLE_COUNT = 50  # held at once
_FAULTS = f"""
import resource, sys
import numpy as np
if sys.argv[1] == "kept":
    from stagectl.gap.heap import keep_freed
    keep_freed()
column = np.ones(20_000)
[column + 1.0 for _ in range({_TABLE_COUNT})]
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({_COLUMNS_COUNT} // {_TABLE_COUNT}):
    [column + 1.0 for _ in range({_TABLE_COUNT})]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults_count(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", _FAULTS, how], capture_output=True, text=True, check=True, timeout=60)
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="only the C library of Linux is told")
def test_a_column_that_is_freed_is_not_asked_of_the_kernel_again():
    assert faults_count("kept") < _COLUMNS_COUNT
    assert faults_count("as it is") > _COLUMNS_COUNT * _PAGES_COUNT / 2, "the C library does it by itself now"


_HELD = """
import gc, sys
import numpy as np
from stagectl.gap.heap import give_back, keep_freed

def resident_bytes():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

gc.disable()
keep_freed()
before = resident_bytes()
circle = [[np.ones(20_000) for _ in range(2_000)]]
circle.append(circle)
del circle
give_back()
print(resident_bytes() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only the C library of Linux is told")
def test_what_searches_held_in_circles_goes_back_to_the_kernel():
    done = subprocess.run([sys.executable, "-c", _HELD], capture_output=True, text=True, check=True, timeout=60)
    assert int(done.stdout) < 32e6, "of 320 MB"
