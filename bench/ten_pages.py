"""Ten pages open against none: does the servo miss more cycles? Real processes, windows in turn.

A pair of windows lies close together in time, and which comes first changes, so that what else the host does meets both
alike. The servo has a processor of its own, and the kernel's unbound work is kept off it, as isolcpus does on a stage
PC; supervisor, rig (above all programs, as hardware is), browser and clients share the rest. The verdict is Wilcoxon's
on the pairs: no bell curve is assumed, a burst of misses counts as one pair.

A third window beside each pair has a load and no client: the same Chromium, drawing a picture of its own that moves. It
tells what any second program costs from what a client costs, and is judged alike, without a bar.
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
from typing import Any, NamedTuple

import httpx
import numpy as np
import websockets

from bench.figure import Bar, Figure, absent, judged
from stagectl.errors import StagectlError
from stagectl.ring import RingReader
from tests.service.daemon import Daemon, servo_pid

INCREASE = Bar(
    "missed cycles with ten pages (one Chromium, nine WebSocket clients) against none: increase, lower end of 95 %",
    "1/min",
    0.0,
)
INCREASE_LOAD = Bar(
    "missed cycles with a Chromium that shows no page of ours, against none: lower end of 95 %", "1/min"
)
LATE = {
    "none": Bar("cycles whose line came late, without", "%"),
    "ten": Bar("cycles whose line came late, with ten pages", "%"),
    "load": Bar("cycles whose line came late, with a Chromium of another page, no client", "%"),
}
WITH_LOAD = Bar("missed cycles with a Chromium of another page, no client", "1/min")
WITH_PAGES = Bar("missed cycles with ten pages", "1/min")
WITHOUT_PAGES = Bar("missed cycles without", "1/min")

PAIRS, PAIRS_FULL = 6, 30
WINDOW_S, WINDOW_FULL_S = 6.0, 20.0
SETTLE_S = 2.0
LEVEL = 0.05
CLIENTS_COUNT = 9
_PATIENCE_S = 60.0
_COMPILE_S = 300.0  # a cold cache on a slow host
_TRIES_COUNT = 3
_LOOK_S = 2.0  # the ring holds more than ten seconds
_KERNEL_WORK = Path("/sys/devices/virtual/workqueue/cpumask")
_OWN_PICTURE = """data:text/html,<canvas id=c width=1300 height=900></canvas><script>
const x = c.getContext('2d'); let n = 0;
function draw() {
  x.clearRect(0, 0, 1300, 900); n++;
  for (let k = 0; k < 4; k++) {
    x.beginPath();
    for (let i = 0; i < 1300; i++) x.lineTo(i, 450 + 400 * Math.sin(i / 50 + n / 20 + k));
    x.stroke();
  }
  requestAnimationFrame(draw);
}
draw();
</script>"""


class Window(NamedTuple):
    """What one window counted."""

    missed_count: int
    cycles_count: int
    duration_s: float
    held: bool
    """Whether the stage held with power throughout."""
    late_count: int = 0
    """Cycles without a line of their own: it came with the next, or was lost."""

    @property
    def missed_per_min(self) -> float:
        """Missed cycles a minute."""
        return 60.0 * self.missed_count / self.duration_s


class Windows(NamedTuple):
    """Windows that lie close together in time."""

    none: Window
    ten: Window
    load: Window


def chromium_path() -> str | None:
    """Find a Chromium; None where there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def figures(*, full: bool, say: Callable[[str], None]) -> Iterator[Figure]:
    """Measure the rows of the page."""
    if reason := lacking():
        yield absent(INCREASE, reason)
        return
    count, window_s = (PAIRS_FULL, WINDOW_FULL_S) if full else (PAIRS, WINDOW_S)
    with tempfile.TemporaryDirectory(prefix="stagectl-bench-") as name, contextlib.closing(_Stage(Path(name))) as stage:
        found: list[Windows] = []
        for number in range(count):
            say(f"ten pages against none: pair {number + 1} of {count}")
            found.append(with_power(lambda number=number: _windows(stage, window_s, number)))
    yield from figures_of(found)


def with_power(measure: Callable[[], Windows]) -> Windows:
    """Measure again where the stage lost its power: a servo made anew counts from 0; the last try, held or not."""
    found = measure()
    for _ in range(_TRIES_COUNT - 1):
        if all(one.held for one in found):
            break
        found = measure()
    return found


def figures_of(found: Sequence[Windows]) -> Iterator[Figure]:
    """Judge windows with ten pages, and those with another load, by the ones without that lie beside them.

    Those in which the stage had no power throughout are left out on all sides; too few left are a missed bar.
    """
    measured_count = len(found)
    found = [windows for windows in found if all(one.held for one in windows)]
    if 0.5 ** len(found) > LEVEL:
        yield judged(
            INCREASE, float("nan"), reason=f"the stage kept its power in {len(found)} of {measured_count} pairs"
        )
        return
    cycles_count = sum(one.cycles_count for windows in found for one in windows)
    for bar, kind in ((INCREASE, "ten"), (INCREASE_LOAD, "load")):
        apart = [getattr(one, kind).missed_per_min - one.none.missed_per_min for one in found]
        lower_per_min, upper_per_min = lower_limit(apart), -lower_limit([-one for one in apart])
        # With this spread, a greater increase would have had its lower end above 0.
        told_per_min = median_increase(apart) - lower_per_min
        remark = (
            f"{len(found)} pairs of windows of {found[0].none.duration_s:.0f} s; "
            f"median increase {median_increase(apart):+.2f}, "
            f"95 % each way {lower_per_min:+.2f} .. {upper_per_min:+.2f}; "
            f"an increase of up to {told_per_min:.2f} could not have been told; "
            f"{cycles_count} cycles; power on in {len(found)} of {measured_count} pairs, the others left out"
        )
        yield judged(bar, lower_per_min, reason=remark)
    for bar, kind in ((WITHOUT_PAGES, "none"), (WITH_PAGES, "ten"), (WITH_LOAD, "load")):
        rates = [getattr(one, kind).missed_per_min for one in found]
        reason = f"mean; windows from {min(rates):.1f} to {max(rates):.1f}"
        yield judged(bar, sum(rates) / len(rates), reason=reason)
    for kind, bar in LATE.items():
        chosen: list[Window] = [getattr(one, kind) for one in found]
        yield judged(bar, 100.0 * sum(one.late_count for one in chosen) / sum(one.cycles_count for one in chosen))


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


def lacking() -> str:
    """Say what this host lacks for it; nothing where it can be measured."""
    if len(os.sched_getaffinity(0)) < 2:
        return "one processor only: a browser would take the servo's"
    if not os.access(_KERNEL_WORK, os.W_OK):
        return f"only root can keep the kernel's own work off the servo's processor ({_KERNEL_WORK})"
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
        self._processors = os.sched_getaffinity(0)
        self._kernel_work = _KERNEL_WORK.read_text()
        others = self._processors - {max(self._processors)}  # that one is the servo's: the service pins it there
        _KERNEL_WORK.write_text(f"{sum(1 << processor for processor in others):x}")
        try:
            self.daemon = Daemon(folder)
            _await(self._is_idle, "a stage that is connected", _COMPILE_S)
        except BaseException:
            _KERNEL_WORK.write_text(self._kernel_work)
            raise
        for pid in {self.daemon.process.pid, *_children(self.daemon.process.pid)} - {servo_pid(self.daemon)}:
            for task in Path(f"/proc/{pid}/task").iterdir():
                os.sched_setaffinity(int(task.name), others)
        os.sched_setaffinity(0, others)  # and what is started from here on
        self._lease = contextlib.ExitStack()
        self.hold()

    def _is_idle(self) -> bool:
        with contextlib.suppress(StagectlError):
            return self.daemon.client.status().state == "idle"
        return False

    def close(self) -> None:
        """End the service."""
        os.sched_setaffinity(0, self._processors)
        try:
            self._lease.close()
            self.daemon.end()
        finally:
            _KERNEL_WORK.write_text(self._kernel_work)

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

    def _rows(self) -> RingReader:
        """Attach to the servo's rows, as a second reader: they are only read."""
        (path,) = Path("/dev/shm").glob(f"stagectl-{self.daemon.process.pid}-*.ring")
        return RingReader.attach(path)

    def window(self, duration_s: float) -> Window:
        """Count for a while."""
        held = self.hold()
        time.sleep(SETTLE_S)
        rows, late_count = self._rows(), 0
        rows.read_new()
        before, begin_s = self.daemon.client.status(), time.monotonic()
        while (left_s := begin_s + duration_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, _LOOK_S))
            late_count += int(np.count_nonzero(rows.read_new()["samples_new"] == 0))
        after, end_s = self.daemon.client.status(), time.monotonic()
        return Window(
            after.health.missed_cycles_count - before.health.missed_cycles_count,
            after.health.cycles_count - before.health.cycles_count,
            end_s - begin_s,
            held and before.state == after.state == "armed",
            late_count,
        )


def _children(pid: int) -> list[int]:
    """Return the processes that one started: servo and rig."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _windows(stage: _Stage, window_s: float, number: int) -> Windows:
    """Count with each of the three, in an order that turns with `number`."""
    loads = {"none": contextlib.nullcontext, "ten": lambda: _ten_pages(stage), "load": _load}
    order = list(loads)[number % 3 :] + list(loads)[: number % 3]
    found: dict[str, Window] = {}
    for kind in order[::-1] if number % 2 else order:
        with loads[kind]():
            found[kind] = stage.window(window_s)
    return Windows(**found)


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
def _shown(url: str) -> Iterator[Any]:
    """Have a Chromium show something; yields playwright's page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=arguments)
        try:
            page = browser.new_page(viewport={"width": 1400, "height": 1000})
            page.goto(url)
            yield page
        finally:
            browser.close()


@contextlib.contextmanager
def _browser(url: str) -> Iterator[None]:
    """Have a Chromium show the page, and check that it does, before and after."""
    with _shown(url) as page:

        def shown_count() -> int:
            return int(page.locator("#cycles").inner_text(timeout=1e3 * _PATIENCE_S).replace(",", "").strip("–") or 0)

        _await(lambda: shown_count() > 0, "a Chromium that shows the stage")
        before = shown_count()
        yield
        _await(lambda: shown_count() > before, "a Chromium that still shows it")


@contextlib.contextmanager
def _load() -> Iterator[None]:
    """Have a Chromium draw a picture of its own, that moves, and know of no stage."""
    with _shown(_OWN_PICTURE) as page:
        before = page.evaluate("n")
        yield
        _await(lambda: page.evaluate("n") > before, "a Chromium that draws")


def _await(done: Callable[[], bool], what: str, patience_s: float = _PATIENCE_S) -> None:
    give_up_s = time.monotonic() + patience_s
    while not done():
        if time.monotonic() > give_up_s:
            raise TimeoutError(f"{what}: not within {patience_s:g} s")
        time.sleep(0.05)
