"""A processor that the host took away is no fault of the service: a real-time test that failed meanwhile is run again.

A real-time test judges processes at their real rate, mostly without a real-time priority, on hosts that are shared. A
listener on each processor, asleep all but a few microseconds in 5 ms, writes down when it was woken too late. Twenty
cycles without a SYNC are 20 ms at 1 kHz: then a drive stops by its own right, whatever the service does. A test that
failed on a host which kept time has failed.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict

import pytest

from tests import host_listener

RERUN_COUNT = 2


class HostPauses:
    """Hears of each pause while tests run, and says what it excused."""

    def __init__(self) -> None:
        self._report = tempfile.TemporaryFile("ab+")  # noqa: SIM115
        self._listeners = [
            subprocess.Popen(
                [sys.executable, "-IS", host_listener.__file__, str(cpu)], stdin=subprocess.PIPE, stdout=self._report
            )
            for cpu in sorted(os.sched_getaffinity(0))
        ]
        self._began_s = 0.0
        self._test = ""
        self._excused: dict[str, list[str]] = defaultdict(list)

    def excuse(self, error: BaseException | None) -> bool:
        """Whether a processor was away since an attempt at a test began that failed with `error`; None: it passed."""
        if error is None:
            return False
        time.sleep(2.0 * (host_listener.SLEEP_S + host_listener.PAUSE_S))  # a pause that has not ended yet
        self._report.seek(0)
        pauses_s = [woke_s - slept_s for slept_s, woke_s in map(json.loads, self._report) if woke_s > self._began_s]
        if pauses_s:
            longest_ms = max(pauses_s) * 1e3
            self._excused[self._test].append(f"{len(pauses_s)} pauses of up to {longest_ms:.0f} ms")
        return bool(pauses_s)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """An attempt begins."""
        self._test, self._began_s = item.nodeid, time.monotonic()

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say which failures did not count."""
        for test, attempts in self._excused.items():
            terminalreporter.write_line(f"failed while the host was away: {test}: {'; '.join(attempts)}")

    def pytest_unconfigure(self) -> None:
        """Dismiss the listeners; each ends with its standard input."""
        for listener in self._listeners:
            listener.communicate()
        self._report.close()
