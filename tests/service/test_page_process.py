"""The process of the live page, killed and stopped in mid jog: the service brings the stage to rest and goes on."""

import contextlib
import json
import re
import signal
import subprocess
import sys
import threading
import time

import httpx
import pytest

from stagectl.client import Client
from stagectl.errors import RequestError
from stagectl.page.admission import KEY_HEADER
from tests.service.daemon import Daemon, at_rest

pytestmark = pytest.mark.real_time

LEASE_S = 3.0  # as the page takes it
HOLD_S = 0.3  # of the page: what its last word to a jog is good for
AGAIN_S = 0.09  # how often the page says it
SPEED_M_PER_S = 0.02
LATE_S = 1.0  # braking, and what a busy host and a look at the status take


@pytest.fixture(scope="module")
def homed(tmp_path_factory):
    """A stage in virtual time, which no busy host can starve; holds and leases run out by the clock on the wall."""
    made = Daemon(tmp_path_factory.mktemp("stage"), {}, in_virtual_time=True)
    try:
        made.state_is("idle")
        with made.client.lease("the first of all"):
            made.client.home()
        yield made
    finally:
        made.end()


@pytest.fixture
def idle(homed):
    """That stage without power."""
    yield from at_rest(homed)


@contextlib.contextmanager
def page_process(daemon):
    """`stagectl page` in front of the service, and a browser that may operate: (process, browser)."""
    command = [sys.executable, "-m", "stagectl.cli", "page", "--json", "--port", "0"]
    command += ["--socket", str(daemon.socket), "--runs", str(daemon.runs)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        link = httpx.URL(json.loads(process.stdout.readline())["url"])
        address = f"http://127.0.0.1:{link.port}"
        with httpx.Client(base_url=address, timeout=60.0, trust_env=False, headers={"Origin": address}) as browser:
            found = re.search(r"url=/#([\w-]+)", browser.get(link).text)
            assert found is not None
            browser.headers[KEY_HEADER] = found[1]
            yield process, browser
    finally:
        process.kill()
        process.communicate()


def arm_from_the_page(daemon, browser):
    """Take the lease and arm, as the page does."""
    taken = browser.post("/v1/lease", json={"holder": "the live page", "duration_s": LEASE_S})
    browser.headers["Stagectl-Lease"] = taken.json()["token"]
    assert browser.post("/v1/arm", json={}).status_code == 202
    daemon.state_is("armed")


def at_m(daemon):
    return daemon.client.status().positions.end_position_m


def holds_at_m(daemon):
    """Where it holds, exactly."""
    return daemon.client.status().positions.setpoint_position_m


class HeldJog:
    """A jog from the page, to the middle, whose button is held until nobody answers any more, or `let_go`."""

    def __init__(self, daemon, browser):
        self._browser, self._over = browser, threading.Event()
        from_m = at_m(daemon)
        self._velocity_m_per_s = -SPEED_M_PER_S if from_m > 0.0 else SPEED_M_PER_S
        self.codes = []
        """What was answered."""
        self._working = threading.Thread(target=self._hold, daemon=True)
        self._working.start()
        daemon.until(lambda: abs(at_m(daemon) - from_m) > 1e-3, "motion")
        assert daemon.client.status().state == "moving"

    def _ask(self, method, path, body):
        answer = self._browser.request(method, path, json=body)
        self.codes.append(answer.status_code)
        return answer

    def _hold(self):
        """As the page does: where the hold ran out, it begins another one."""
        key = ""
        with contextlib.suppress(httpx.HTTPError):
            while not self._over.is_set():
                if not key:
                    begun = self._ask("POST", "/v1/jogging", {"hold_s": HOLD_S})
                    if begun.status_code != 202:
                        return
                    key = begun.json()["key"]
                said = {"velocity_m_per_s": self._velocity_m_per_s, "hold_s": HOLD_S}
                if self._ask("PUT", f"/v1/jogging/{key}", said).status_code == 409:
                    key = ""
                self._ask("PUT", "/v1/lease", None)
                time.sleep(AGAIN_S)

    def let_go(self):
        self._over.set()
        self._working.join(30.0)
        assert not self._working.is_alive()


def stops_by_its_deadmen(daemon, signalled_s):
    """At rest within the jog's hold; without power when the lease is over, and it says so."""
    while daemon.client.status().state == "moving":
        assert time.monotonic() < signalled_s + HOLD_S + LATE_S, "it still moves"
    status = daemon.client.status()
    assert (status.state, status.lease.holder) == ("armed", "the live page")  # the jog's deadman; the lease lasts
    assert holds_at_m(daemon) == status.positions.setpoint_position_m
    with Client(daemon.socket) as other, pytest.raises(RequestError, match="the live page holds the lease"):
        other.take_lease("another operator")
    daemon.state_is("fault")
    assert time.monotonic() < signalled_s + LEASE_S + LATE_S
    fault = daemon.client.fault()
    assert (fault.kind, fault.state) == ("LEASE", "armed")
    assert "the lease on motion ran out" in fault.what
    return fault


def another_operator_goes_on(daemon, fault):
    other = daemon.client
    other.acknowledge(fault.number)
    other.arm()
    before_m = at_m(daemon)
    way_m = -1e-3 if before_m > 0.0 else 1e-3
    assert other.jog(way_m).stop == "FINISHED"
    assert at_m(daemon) == pytest.approx(before_m + way_m, abs=1e-4)


def test_a_page_process_that_is_killed_in_mid_jog_leaves_a_stage_at_rest_that_another_takes_over(idle):
    with page_process(idle) as (process, browser):
        arm_from_the_page(idle, browser)
        jog = HeldJog(idle, browser)
        process.send_signal(signal.SIGKILL)
        fault = stops_by_its_deadmen(idle, time.monotonic())
        jog.let_go()
        with idle.client.lease("another operator"):
            another_operator_goes_on(idle, fault)


def test_one_that_is_stopped_moves_nothing_when_it_goes_on_with_what_it_was_asked(idle):
    with page_process(idle) as (process, browser):
        arm_from_the_page(idle, browser)
        jog = HeldJog(idle, browser)
        process.send_signal(signal.SIGSTOP)
        try:
            fault = stops_by_its_deadmen(idle, time.monotonic())
            with idle.client.lease("another operator"):
                another_operator_goes_on(idle, fault)
                holds_m = holds_at_m(idle)
                process.send_signal(signal.SIGCONT)
                idle.until(lambda: 423 in jog.codes, "a refusal of what came late")
                jog.let_go()
                assert browser.put("/v1/lease").status_code == 423
                assert idle.client.status().state == "armed"
                assert holds_at_m(idle) == holds_m
        finally:
            process.send_signal(signal.SIGCONT)
            jog.let_go()
        assert browser.get("/v1/status").status_code == 200
