"""Ten pages open against none: does the servo miss more cycles? Real processes, windows in turn.

A pair of windows lies close together in time, and which comes first changes, so that what else the host does meets both
alike. Servo and rig have a processor of their own, as a stage PC gives the servo one: a browser beside them on the same
processor is a load like any other program. The verdict is Wilcoxon's on the pairs: no bell curve is assumed, a burst
of misses counts as one pair.
"""

import asyncio
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import httpx
import websockets

from bench.figure import Bar, Figure, absent, judged
from stagectl.errors import StagectlError
from tests.service.daemon import Daemon

INCREASE = Bar(
    "missed cycles with ten pages (one Chromium, nine WebSocket clients) against none: increase, lower end of 95 %",
    "1/min",
    0.0,
)
WITH_PAGES = Bar("missed cycles with ten pages", "1/min")
WITHOUT_PAGES = Bar("missed cycles without", "1/min")

PAIRS, PAIRS_FULL = 8, 30
WINDOW_S, WINDOW_FULL_S = 10.0, 20.0
SETTLE_S = 2.0
LEVEL = 0.05
CLIENTS_COUNT = 9
_PATIENCE_S = 60.0
_COMPILE_S = 300.0  # a cold cache on a slow host
_TRIES_COUNT = 3


class Window(NamedTuple):
    """What one window counted."""

    missed_count: int
    cycles_count: int
    duration_s: float
    held: bool
    """Whether the stage held with power throughout."""

    @property
    def missed_per_min(self) -> float:
        """Missed cycles a minute."""
        return 60.0 * self.missed_count / self.duration_s


def chromium_path() -> str | None:
    """Find a Chromium; None where there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def figures(*, full: bool, say: Callable[[str], None]) -> Iterator[Figure]:
    """Measure the rows of the page."""
    lacking = _lacking()
    if lacking:
        yield absent(INCREASE, lacking)
        return
    count, window_s = (PAIRS_FULL, WINDOW_FULL_S) if full else (PAIRS, WINDOW_S)
    with tempfile.TemporaryDirectory(prefix="stagectl-bench-") as name, contextlib.closing(_Stage(Path(name))) as stage:
        pairs: list[tuple[Window, Window]] = []
        for number in range(count):
            say(f"ten pages against none: pair {number + 1} of {count}")
            pairs.append(_pair(stage, window_s, pages_first=number % 2 == 1))
    yield from figures_of(pairs)


def figures_of(pairs: Sequence[tuple[Window, Window]]) -> Iterator[Figure]:
    """Judge pairs of windows, without pages and with ten."""
    apart = [ten.missed_per_min - none.missed_per_min for none, ten in pairs]
    cycles_count = sum(one.cycles_count for pair in pairs for one in pair)
    held = sum(none.held and ten.held for none, ten in pairs)
    upper_per_min = -lower_limit([-one for one in apart])
    remark = (
        f"{len(pairs)} pairs of windows of {pairs[0][0].duration_s:.0f} s; "
        f"median increase {median_increase(apart):+.2f}, upper end {upper_per_min:+.2f}; "
        f"{cycles_count} cycles; power on in {held} pairs"
    )
    yield judged(INCREASE, lower_limit(apart), reason=remark)
    for bar, place in ((WITHOUT_PAGES, 0), (WITH_PAGES, 1)):
        rates = [pair[place].missed_per_min for pair in pairs]
        reason = f"mean; windows from {min(rates):.1f} to {max(rates):.1f}"
        yield judged(bar, sum(rates) / len(rates), reason=reason)


def lower_limit(differences: Sequence[float]) -> float:
    """Return the lower end of Wilcoxon's one-sided 95 % interval of the middle of paired differences.

    0 or below: the signed-rank test finds no increase. Five pairs or more; ValueError below.
    """
    count = len(differences)
    if 0.5**count > LEVEL:
        raise ValueError(f"{count} pairs can't show anything at {LEVEL:.0%}; five or more can")
    return sorted(_walsh_averages(differences))[_greatest_rare_sum(count)]


def median_increase(differences: Sequence[float]) -> float:
    """Return the Hodges-Lehmann estimate: the median of all averages of two."""
    averages = sorted(_walsh_averages(differences))
    half = len(averages) // 2
    return averages[half] if len(averages) % 2 else 0.5 * (averages[half - 1] + averages[half])


def _walsh_averages(values: Sequence[float]) -> list[float]:
    return [0.5 * (values[i] + values[j]) for i in range(len(values)) for j in range(i + 1)]


def _greatest_rare_sum(count: int) -> int:
    """Return the greatest rank sum that chance stays at or below no more often than the level allows; exact."""
    ways = [1]
    for rank in range(1, count + 1):
        more = [0] * rank + ways
        ways = [(ways[k] if k < len(ways) else 0) + more[k] for k in range(len(more))]
    below, found = ways[0], -1
    while below <= LEVEL * 2**count:
        found += 1
        below += ways[found + 1]
    return found


def _lacking() -> str:
    if len(os.sched_getaffinity(0)) < 2:
        return "one processor only: a browser would take the servo's"
    if chromium_path() is None:
        return "no Chromium here: apt install chromium"
    try:
        import playwright  # noqa: F401
    except ImportError:
        return "no playwright here: pip install -e '.[dev]'"
    return ""


# ---- the stage, and windows on it ------------------------------------------------------------------------------------


class _Stage:
    """A service on the rig, whose stage holds with power wherever that can be had."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.daemon = Daemon(folder)
        _await(self._is_idle, "a stage that is connected", _COMPILE_S)
        self._processors = os.sched_getaffinity(0)
        for pid in _children(self.daemon.process.pid):
            for task in Path(f"/proc/{pid}/task").iterdir():
                os.sched_setaffinity(int(task.name), {max(self._processors)})
        os.sched_setaffinity(0, self._processors - {max(self._processors)})  # and what is started from here on
        self._lease = contextlib.ExitStack()
        self.hold()

    def _is_idle(self) -> bool:
        with contextlib.suppress(StagectlError):
            return self.daemon.client.status().state == "idle"
        return False

    def close(self) -> None:
        """End the service."""
        os.sched_setaffinity(0, self._processors)
        self._lease.close()
        self.daemon.end()

    def hold(self) -> bool:
        """Have the stage hold; a busy host may trip it, so it is tried a few times."""
        client = self.daemon.client
        for _ in range(_TRIES_COUNT):
            with contextlib.suppress(StagectlError):
                status = client.status()
                if status.state == "armed":
                    return True
                if status.lease is None:
                    self._lease.close()
                    self._lease.enter_context(client.lease("ten pages", 10.0))
                if status.fault is not None:
                    client.acknowledge(status.fault.number)
                if not client.status().homed:
                    client.home()
                if client.status().state == "idle":
                    client.arm()
        return client.status().state == "armed"

    def window(self, duration_s: float) -> Window:
        """Count for a while."""
        held = self.hold()
        time.sleep(SETTLE_S)
        before, begin_s = self.daemon.client.status(), time.monotonic()
        time.sleep(duration_s)
        after, end_s = self.daemon.client.status(), time.monotonic()
        return Window(
            after.health.missed_cycles_count - before.health.missed_cycles_count,
            after.health.cycles_count - before.health.cycles_count,
            end_s - begin_s,
            held and before.state == after.state == "armed",
        )


def _children(pid: int) -> list[int]:
    """Return the processes that one started: servo and rig."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _pair(stage: _Stage, window_s: float, pages_first: bool) -> tuple[Window, Window]:
    none = None if pages_first else stage.window(window_s)
    with _ten_pages(stage):
        ten = stage.window(window_s)
    return (none or stage.window(window_s)), ten


# ---- ten pages -------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _ten_pages(stage: _Stage) -> Iterator[None]:
    """Have `stagectl page` serve one Chromium and nine WebSocket clients that read everything."""
    command = [sys.executable, "-m", "stagectl.cli", "page", "--json", "--port", "0"]
    command += ["--socket", str(stage.daemon.socket), "--runs", str(stage.daemon.runs)]
    serving = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        lines = iter(serving.stdout or ())
        urls = {(one := json.loads(next(lines)))["role"]: one["url"] for _ in range(2)}
        with contextlib.closing(_Listeners(urls["observe"])), _browser(urls["operate"]):
            yield
    finally:
        serving.terminate()
        serving.communicate()


class _Listeners:
    """Clients of the page's stream, in a thread; each reads what comes."""

    def __init__(self, url: str):
        self.heard = [0] * CLIENTS_COUNT
        self._over = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._work(url)), daemon=True)
        self._thread.start()
        _await(lambda: all(self.heard), "nine clients that hear the stage")

    def close(self) -> None:
        """Hear no more."""
        before = list(self.heard)
        _await(lambda: all(now > then for now, then in zip(self.heard, before, strict=True)), "clients still hear it")
        self._over.set()
        self._thread.join(_PATIENCE_S)

    async def _work(self, url: str) -> None:
        address = url.split("/enter")[0]
        async with httpx.AsyncClient(trust_env=False) as client:
            cookie = "; ".join((await client.get(url)).headers.get_list("set-cookie")).split(";")[0]
        listening = [asyncio.create_task(self._hear(place, address, cookie)) for place in range(CLIENTS_COUNT)]
        while not self._over.is_set():
            await asyncio.sleep(0.1)
        for task in listening:
            task.cancel()
        await asyncio.gather(*listening, return_exceptions=True)

    async def _hear(self, place: int, address: str, cookie: str) -> None:
        uri = f"{address.replace('http', 'ws')}/v1/stream"
        async with websockets.connect(
            uri,
            origin=address,  # pyright: ignore[reportArgumentType]
            additional_headers={"Cookie": cookie},
            max_size=None,
        ) as stream:
            async for message in stream:
                json.loads(message)
                self.heard[place] += 1


@contextlib.contextmanager
def _browser(url: str) -> Iterator[None]:
    """Have a Chromium show the page, and check that it does, before and after."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=arguments)
        try:
            page = browser.new_page(viewport={"width": 1400, "height": 1000})
            page.goto(url)

            def shown_count() -> int:
                return int(
                    page.locator("#cycles").inner_text(timeout=1e3 * _PATIENCE_S).replace(",", "").strip("–") or 0
                )

            _await(lambda: shown_count() > 0, "a Chromium that shows the stage")
            before = shown_count()
            yield
            _await(lambda: shown_count() > before, "a Chromium that still shows it")
        finally:
            browser.close()


def _await(done: Callable[[], bool], what: str, patience_s: float = _PATIENCE_S) -> None:
    give_up_s = time.monotonic() + patience_s
    while not done():
        if time.monotonic() > give_up_s:
            raise TimeoutError(f"{what}: not within {patience_s:g} s")
        time.sleep(0.05)
