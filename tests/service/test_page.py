"""The page's door without a browser: links, cookie, Host, Origin, roles; and what it passes on to the service."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
import websockets

from stagectl.page.admission import ENTRY, KEY_HEADER, Sessions
from stagectl.record import MANIFEST
from stagectl.service import messages
from stagectl.service.access import Role
from stagectl.service.admission import CONNECTIONS_LIMIT
from stagectl.whole_file import replace_whole
from tests.service.pages import PageServer
from tests.service.test_stage_loop import Bench

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def page(daemon):
    server = PageServer(daemon.socket, daemon.runs)
    yield server
    server.end()


def heard(page, cookie, origin, host=None, count=1):
    """Listen to the stream as a browser would, and return the first messages."""
    headers = {"Cookie": cookie} if cookie else {}
    if host:
        headers["Host"] = host

    async def listen():
        uri = f"ws://127.0.0.1:{page.port}/v1/stream"
        async with websockets.connect(uri, origin=origin, additional_headers=headers) as stream:
            return [json.loads(await asyncio.wait_for(stream.recv(), 10.0)) for _ in range(count)]

    return asyncio.run(listen())


def cookie_of(client):
    return "; ".join(f"{name}={value}" for name, value in client.cookies.items())


def test_a_link_works_once_and_becomes_a_cookie_that_no_script_and_no_other_site_has(page):
    link = page.link(Role.OPERATE)
    with httpx.Client(trust_env=False) as browser:
        assert browser.head(link).status_code == 401  # a look at the link doesn't use it up
        first = browser.get(link)
        assert first.status_code == 200
        said = first.headers["set-cookie"]
        assert all(part in said for part in ("HttpOnly", "SameSite=Strict", "Path=/"))
        assert "Domain" not in said
        assert browser.get(page.address).status_code == 200
        assert browser.get(f"{page.address}/session").json() == {"role": "operate"}
    with httpx.Client(trust_env=False) as thief:
        assert thief.get(link).status_code == 401
        assert thief.get(page.address).status_code == 401
    assert page.link(Role.OPERATE) != link


@pytest.mark.parametrize("place", ["/", "/session", "/v1/status", "/v1/runs", "/assets/page.js", "/runs/x/report"])
def test_a_stranger_sees_nothing(page, place):
    for cookie in ("", f"stagectl-page-{page.port}=", f"stagectl-page-{page.port}=guess", "=;;=", "a" * 4000):
        answer = httpx.get(page.address + place, headers={"Cookie": cookie}, trust_env=False)
        assert answer.status_code == 401
        assert "works once" in answer.json()["message"]


def test_no_cookie_of_another_server_here_keeps_a_stop_out(page, idle):
    """A browser sends what any port of 127.0.0.1 gave it, in any form, under any name and from any path."""
    with page.browser(Role.OPERATE) as browser, page.browser(Role.OBSERVE) as watcher:
        ours, watching = cookie_of(browser), cookie_of(watcher)
        said = [("Origin", page.address), (KEY_HEADER, browser.headers[KEY_HEADER])]
    name = ours.partition("=")[0]
    for cookies in (
        [ours],
        [f'prefs={{"theme":"dark"}}; {ours}'],
        [f"flag; {ours}"],
        [f"{ours}; {name}=x"],
        [f"{name}=x; {ours}"],
        [f"{name}=; =;;=; {ours} ;"],
        [f"{name}=x", "flag", ours],
        [f"{watching}; {ours}"],
        [f"{ours}; {watching}"],
    ):
        headers = [*said, *(("Cookie", one) for one in cookies)]
        answer = httpx.post(f"{page.address}/v1/stop", headers=headers, trust_env=False)
        assert answer.status_code == 202, cookies
    for cookies, code in ((f"{name}x={ours.partition('=')[2]}", 401), (f"x={ours}", 401), (watching, 403)):
        headers = [*said, ("Cookie", cookies)]
        assert httpx.post(f"{page.address}/v1/stop", headers=headers, trust_env=False).status_code == code


def test_a_wrong_host_or_origin_is_refused_whatever_the_cookie(page):
    with page.browser(Role.OPERATE) as browser:
        own = page.address
        for host in (
            "evil.example",
            f"evil.example:{page.port}",
            "127.0.0.1",
            "127.0.0.1:1",
            f"127.0.0.1.:{page.port}",
        ):
            assert browser.get("/v1/status", headers={"Host": host}).status_code == 403
            assert browser.get(page.link(Role.OPERATE), headers={"Host": host}).status_code == 403
        for origin in ("http://evil.example", "null", "http://127.0.0.1", f"https://127.0.0.1:{page.port}", own + "0"):
            assert browser.post("/v1/stop", headers={"Origin": origin}).status_code == 403
            assert browser.get("/v1/status", headers={"Origin": origin}).status_code == 403
        assert browser.get("/v1/status", headers={"Sec-Fetch-Site": "same-site"}).status_code == 403
        local = f"localhost:{page.port}"
        assert browser.get("/v1/status", headers={"Host": local, "Origin": f"http://{local}"}).status_code == 200
        assert browser.get("/v1/status", headers={"Host": local}).status_code == 403  # the other of our two names
    with page.browser(Role.OPERATE) as browser:
        del browser.headers["Origin"]
        assert browser.get("/v1/status").status_code == 200
        assert browser.post("/v1/stop").status_code == 403


def test_the_stream_is_for_our_own_page_alone(page):
    with page.browser(Role.OBSERVE) as browser:
        cookie = cookie_of(browser)
    story = heard(page, cookie, page.address)[0]
    assert story["status"]["banner"].startswith("SOFTWARE RIG")
    assert len(story["samples"]["columns"]) == 10
    for wrong in (("", page.address), (cookie, None), (cookie, "http://evil.example"), (cookie, "null")):
        with pytest.raises(websockets.InvalidStatus):
            heard(page, *wrong)


def test_an_observer_commands_nothing(page, daemon):
    with page.browser(Role.OBSERVE) as browser:
        assert browser.get("/v1/status").status_code == 200
        bodies = {
            "lease": {"holder": "x"},
            "move": {"target_m": 0.0},
            "home": {},
            "arm": {},
            "stop": None,
            "record": {},
        }
        for name, body in bodies.items():
            answer = browser.post(f"/v1/{name}", json=body)
            assert answer.status_code == 403
            assert "may only watch" in answer.json()["message"]
        assert browser.put("/v1/jogging/jog-1", json={"velocity_m_per_s": 0.01}).status_code == 403
        assert browser.delete("/v1/record").status_code == 403
        assert browser.request("PATCH", "/v1/status").status_code == 403
    assert daemon.client.lease_state() is None


def test_no_crowd_keeps_an_operator_s_page_out(page, idle):
    with page.browser(Role.OPERATE) as browser, page.browser(Role.OBSERVE) as watcher, contextlib.ExitStack() as crowd:
        for _ in range(CONNECTIONS_LIMIT + 10):
            crowd.enter_context(socket.create_connection(("127.0.0.1", page.port)))
        taken = browser.post("/v1/lease", json={"holder": "page test", "duration_s": 10.0})
        assert taken.status_code == 200
        headers = {"Stagectl-Lease": taken.json()["token"]}
        assert browser.put("/v1/lease", headers=headers).status_code == 200
        assert browser.put("/v1/lease", headers=headers | {KEY_HEADER: "guessed"}).status_code == 503
        assert watcher.get("/v1/status").status_code == 503
        assert browser.delete("/v1/lease", headers=headers).status_code == 204


def test_an_operator_s_requests_are_passed_on_with_lease_and_key(page, idle):
    with page.browser(Role.OPERATE) as browser:
        refused = browser.post("/v1/home", json={})
        assert refused.status_code == 423
        taken = browser.post("/v1/lease", json={"holder": "page test", "duration_s": 5.0}).json()
        assert idle.client.lease_state().holder == "page test"
        headers = {"Stagectl-Lease": taken["token"]}
        first = browser.post("/v1/reread", json={}, headers=headers | {"Idempotency-Key": "page-1"})
        assert (first.status_code, first.json()["key"]) == (202, "page-1")
        assert browser.get("/v1/commands/page-1?wait_s=2").json()["state"] == "done"
        assert browser.delete("/v1/lease", headers=headers).status_code == 204
        assert browser.post("/v1/move", content="{", headers={"Content-Type": "application/json"}).status_code == 422
        assert browser.post("/v1/move", content="x" * 70_000).status_code == 413
        for nowhere in ("/v1/../openapi.json", "/v1/lease/a/b", "/v1/%2e%2e/metrics", "/openapi.json"):
            assert browser.get(nowhere).status_code == 404


def test_pages_carry_a_policy_and_reports_come_from_the_runs_folder_only(page, daemon):
    with page.browser(Role.OBSERVE) as browser:
        answer = browser.get("/")
        policy = answer.headers["content-security-policy"]
        assert "script-src 'self'" in policy
        assert "unsafe" not in policy
        assert answer.headers["x-frame-options"] == "DENY"
        assert "http://" not in answer.text
        assert "https://" not in answer.text  # a stage PC has no internet
        made = daemon.runs / "drawn-before"
        made.mkdir(parents=True)
        (made / "report.html").write_text("<b>drawn</b>")
        report = browser.get("/runs/drawn-before/report")
        assert report.text == "<b>drawn</b>"
        assert report.headers["content-security-policy"].endswith("sandbox")
        for nowhere in ("no-such-run", "..", "%2e%2e", "..%2fstate", "."):
            assert browser.get(f"/runs/{nowhere}/report").status_code == 404
        (made / "report.html").unlink()
        broken = browser.get("/runs/drawn-before/report")
        assert broken.status_code == 404
        assert "no report" in broken.text
        made.rmdir()


class ReportOf:
    """The report of one recorded run, asked for as the run list does."""

    def __init__(self, page, name):
        self._page, self._name = page, name
        self.kept = page.drawn / f"{name}.html"

    def get(self):
        with self._page.browser(Role.OBSERVE) as browser:
            return browser.get(f"/runs/{self._name}/report")

    def stamp(self):
        """What is another where it was written again."""
        found = self.kept.stat()
        return found.st_ino, found.st_mtime_ns


def drawing_pid():
    """The process that draws for this one, where there is one that has begun to."""
    for thread in Path("/proc/self/task").iterdir():
        for child in (thread / "children").read_text().split():
            with contextlib.suppress(OSError):
                words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
                if words[0] == sys.executable.encode() and b"plot" in words:
                    return int(child)
    return None


def until_drawing():
    give_up_s = time.monotonic() + 60.0
    while (pid := drawing_pid()) is None:
        assert time.monotonic() < give_up_s, "nothing is drawn"
        time.sleep(0.001)
    return pid


@pytest.fixture
def recorded(tmp_path):
    """The folder of a run that the service recorded in virtual time: armed, moved, stopped."""
    bench = Bench(tmp_path)
    bench.hold_as_homed_by_truth()
    moved = bench.do("move", messages.Move(target_m=0.01))
    assert moved.stop == "FINISHED"
    bench.loop.leave()
    bench.loop.run()
    return Path(moved.run)


@pytest.fixture
def reports(daemon, recorded):
    server = PageServer(daemon.socket, recorded.parent)
    yield ReportOf(server, recorded.name)
    server.end()


def newer_manifest(run, content, description):
    """Give a run a newer manifest than `content`, as its end does, or what saves it."""
    replace_whole(run / MANIFEST, json.dumps(json.loads(content) | {"backend_description": description}).encode())


def pipe_to_reader(path):
    """Wait until somebody reads a named pipe, and return the file to write to."""
    descriptor, give_up_s = None, time.monotonic() + 60.0
    while descriptor is None:
        assert time.monotonic() < give_up_s, "nobody reads it"
        with contextlib.suppress(OSError):  # ENXIO until then
            descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        time.sleep(0.001)
    os.set_blocking(descriptor, True)
    return open(descriptor, "wb")


def test_a_recorded_run_s_report_is_drawn_when_it_is_asked_for_kept_and_drawn_anew_for_a_newer_manifest(
    reports, recorded
):
    with ThreadPoolExecutor() as asking:
        answer = asking.submit(reports.get)
        assert os.getpriority(os.PRIO_PROCESS, until_drawing()) == 19
        drawn = answer.result(120.0)
    assert drawn.status_code == 200, drawn.text
    assert drawn.headers["content-security-policy"].endswith("sandbox")
    assert recorded.name in drawn.text
    assert "<svg" in drawn.text
    assert "Timing" in drawn.text
    assert not (recorded / "report.html").exists()  # a page need not be let write there
    stamp = reports.stamp()
    assert reports.get().text == drawn.text
    assert reports.stamp() == stamp
    newer_manifest(recorded, (recorded / MANIFEST).read_bytes(), "a world of another name")
    anew = reports.get()
    assert "a world of another name" in anew.text
    assert "a world of another name" not in drawn.text
    assert reports.stamp() != stamp
    stamp = reports.stamp()
    assert reports.get().text == anew.text
    assert reports.stamp() == stamp


def test_a_run_that_closes_while_its_report_is_drawn_is_drawn_anew_when_it_is_asked_for_again(reports, recorded):
    """Drawing takes seconds on a busy host; what was read before them is not what the run says since."""
    content = (recorded / MANIFEST).read_bytes()
    (recorded / MANIFEST).unlink()
    os.mkfifo(recorded / MANIFEST)
    with ThreadPoolExecutor() as asking:
        answer = asking.submit(reports.get)
        with pipe_to_reader(recorded / MANIFEST) as read_now:
            newer_manifest(recorded, content, "a world that was closed since")
            read_now.write(content)
        before = answer.result(120.0)
    assert before.status_code == 200, before.text
    assert "a world that was closed since" not in before.text
    assert "a world that was closed since" in reports.get().text


def test_ten_pages_are_one_client_of_the_service(page):
    """All get the very same messages of one stream; two streams would differ in their uptime at least."""
    with page.browser(Role.OBSERVE) as browser:
        cookie = cookie_of(browser)

    async def ten():
        uri = f"ws://127.0.0.1:{page.port}/v1/stream"
        headers = {"Cookie": cookie}
        streams = [await websockets.connect(uri, origin=page.address, additional_headers=headers) for _ in range(10)]
        try:
            stories = [json.loads(await stream.recv()) for stream in streams]
            texts = [{await stream.recv() for _ in range(5)} for stream in streams]
        finally:
            for stream in streams:
                await stream.close()
        return stories, texts

    stories, texts = asyncio.run(ten())
    assert all(story["status"]["state"] for story in stories)
    assert len(set.union(*texts)) < 15  # the same messages for all of them: about five, not fifty


def test_without_a_service_the_page_says_so(tmp_path):
    server = PageServer(tmp_path / "none", tmp_path)
    try:
        with server.browser(Role.OPERATE) as browser:
            assert browser.get("/").status_code == 200
            answer = browser.post("/v1/stop")
            assert answer.status_code == 502
            assert "is `stagectl serve` running?" in answer.json()["message"]
            assert "doesn't answer" in heard(server, cookie_of(browser), server.address)[0]["lost"]
    finally:
        server.end()


def test_the_oldest_of_too_many_browsers_goes_and_one_that_was_silent_for_half_a_day():
    now_s = [0.0]
    sessions = Sessions(clock_s=lambda: now_s[0])
    values = [sessions.enter(sessions.link_token(Role.OBSERVE))[0] for _ in range(65)]
    assert sessions.session(values[0]) is None
    assert [sessions.session(value).role for value in values[1:]] == [Role.OBSERVE] * 64
    assert sessions.enter(values[1]) is None  # a cookie is no link
    now_s[0] += 11 * 3600.0
    assert sessions.session(values[1]) is not None
    now_s[0] += 2 * 3600.0
    assert sessions.session(values[1]) is not None  # it was heard of two hours ago
    assert sessions.session(values[2]) is None


def test_a_stolen_cookie_commands_nothing(page, idle):
    """A browser sends its cookies to every port of 127.0.0.1; the page's key goes nowhere else."""
    with page.browser(Role.OPERATE) as browser, page.browser(Role.OPERATE) as other:
        own = browser.headers[KEY_HEADER]
        for key in ("", "guess", other.headers[KEY_HEADER], own[:-1]):
            browser.headers[KEY_HEADER] = key
            for method, place in (("POST", "lease"), ("POST", "stop"), ("PUT", "jogging/jog-1"), ("DELETE", "record")):
                answer = browser.request(method, f"/v1/{place}", json={"holder": "thief"})
                assert answer.status_code == 403
                assert "key" in answer.json()["message"]
    assert idle.client.lease_state() is None


def test_the_command_shows_links_and_the_next_one_when_one_was_used(daemon):
    command = [sys.executable, "-m", "stagectl.cli", "page", "--json", "--port", "0", "--socket", str(daemon.socket)]
    showing = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        shown = [json.loads(showing.stdout.readline()) for _ in range(2)]
        assert [one["role"] for one in shown] == ["operate", "observe"]
        assert all(one["url"].startswith("http://127.0.0.1:") and ENTRY in one["url"] for one in shown)
        assert httpx.get(shown[1]["url"], trust_env=False).status_code == 200
        following = json.loads(showing.stdout.readline())
        assert following["role"] == "observe"
        assert following["url"] != shown[1]["url"]
        showing.send_signal(signal.SIGINT)
        assert showing.wait(20.0) == 130
    finally:
        showing.kill()
        showing.communicate()


@pytest.mark.parametrize(
    ("role", "code", "given_back"),
    [(Role.OPERATE, 1001, True), (Role.OPERATE, 1000, False), (Role.OBSERVE, 1001, False)],
)
def test_the_lease_that_a_page_said_is_given_back_when_its_browser_says_that_it_is_gone(
    page, daemon, role, code, given_back
):
    with page.browser(role) as browser:
        headers = {"Cookie": cookie_of(browser)}

    async def say_and_go(token):
        uri = f"ws://127.0.0.1:{page.port}/v1/stream"
        stream = await websockets.connect(uri, origin=page.address, additional_headers=headers)
        for said in ("x" * 3000, token):
            await stream.send(said)
        await stream.close(code)

    with daemon.client.lease("a page", duration_s=5.0) as lease:
        asyncio.run(say_and_go(lease.token))
        if given_back:
            daemon.until(lambda: daemon.client.lease_state() is None, "a free lease")
        else:
            time.sleep(0.5)
            assert daemon.client.lease_state() is not None


HOSTILE_FRAMES = [
    "",
    "[" * 90,
    "NaN",
    '{"mode": 2}',
    "x\r\nHost: evil.example",
    "\u00e9\u0000\u202e",
    "x" * 1_000_000,
    b"\xff\x00" * 40,
    b"\x00" * 1_000_000,
]


def test_nothing_else_that_an_operator_s_page_says_gives_a_lease_back_or_breaks_the_stream(page, daemon, caplog):
    with page.browser(Role.OPERATE) as browser:
        headers = {"Cookie": cookie_of(browser)}

    async def say_and_go(frame):
        uri = f"ws://127.0.0.1:{page.port}/v1/stream"
        stream = await websockets.connect(uri, origin=page.address, additional_headers=headers, max_size=None)
        with contextlib.suppress(websockets.ConnectionClosed):
            await stream.send(frame)
            for _ in range(2):
                assert json.loads(await asyncio.wait_for(stream.recv(), 10.0))["status"]["state"]
        await stream.close(1001)
        await stream.wait_closed()
        return stream.close_code

    async def say_all():
        return [await say_and_go(frame) for frame in HOSTILE_FRAMES]

    with daemon.client.lease("a page", duration_s=5.0) as lease:
        codes = asyncio.run(say_all())
        assert codes == [1009 if len(frame) > 100_000 else 1001 for frame in HOSTILE_FRAMES]
        assert heard(page, headers["Cookie"], page.address)[0]["status"]["lease"]["holder"] == "a page"
        assert daemon.client.renew_lease().token == lease.token
    assert [record.message for record in caplog.records if record.levelname == "ERROR"] == []
