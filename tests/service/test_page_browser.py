"""The page in a real Chromium: what an operator does, what an observer can't, and a page that vanishes mid-jog."""

import csv
import functools
import http.server
import json
import os
import re
import shutil
import signal
import threading
import time

import pytest

from stagectl.client import Client
from stagectl.requests import TICKING, Phase
from stagectl.service.access import Role
from tests.service.daemon import Daemon, at_rest
from tests.service.pages import PageServer

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
try:
    from playwright.sync_api import expect, sync_playwright
except ImportError:
    pytest.skip("no playwright here: pip install -e '.[dev]'", allow_module_level=True)
if CHROMIUM is None:
    if os.environ.get("STAGECTL_NEEDS_CHROMIUM"):
        pytest.fail("no Chromium here, and STAGECTL_NEEDS_CHROMIUM asks for one: apt install chromium", pytrace=False)
    pytest.skip("no Chromium here: apt install chromium", allow_module_level=True)

pytestmark = pytest.mark.real_time

PHONE = {"width": 390, "height": 844}
PATIENCE_MS = 60_000


@pytest.fixture(scope="module")
def stage_in_virtual_time(tmp_path_factory):
    """A stage with a joint whose profile allows next to no wear: 1 um, and the rig's gap is 2.2 um narrower.

    On a busy host a browser starves a servo that keeps real time; what it costs one is measured by the bench.
    """
    folder, limits = tmp_path_factory.mktemp("stage"), {"wear": {"width_change_limit_m": 1e-6}}
    made = Daemon(folder, limits, profile="oled-printer", in_virtual_time=True)
    try:
        made.state_is("idle")
        with made.client.lease("the first of all"):
            made.client.home()
        yield made
    finally:
        made.end()


@pytest.fixture
def idle(stage_in_virtual_time):
    """That stage without power, homed."""
    yield from at_rest(stage_in_virtual_time)


@pytest.fixture(scope="module")
def page_server(stage_in_virtual_time):
    server = PageServer(stage_in_virtual_time.socket, stage_in_virtual_time.runs)
    yield server
    server.end()


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    """A browser that leaves the servo its processor: two are all that many a test host has."""
    wrapper = tmp_path_factory.mktemp("browser") / "chromium"
    processor = min(os.sched_getaffinity(0))
    wrapper.write_text(f'#!/bin/sh\nexec nice -n 19 taskset -c {processor} {CHROMIUM} "$@"\n')
    wrapper.chmod(0o755)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(wrapper), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium, page_server):
    """Open the page for a role: a function; what a page complains of fails the test."""
    complaints, contexts = [], []

    def open_page(role, **how):
        context = chromium.new_context(**how)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda said: complaints.append(said.text) if "Content Security" in said.text else None)
        page.goto(page_server.link(role))
        page.wait_for_url("**/")
        expect(page.locator("#state")).not_to_have_attribute("data-state", "lost", timeout=PATIENCE_MS)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


def state_is(page, *states):
    expect(page.locator("#state")).to_have_attribute("data-state", re.compile("|".join(states)), timeout=PATIENCE_MS)


def take_and_arm(page):
    page.click("#take")
    page.click("#arm")
    state_is(page, "armed")


def armed_page(opened, **how):
    page = opened(Role.OPERATE, **how)
    take_and_arm(page)
    return page


def press(page, button):
    box = page.locator(button).bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()


def stands_still(daemon):
    """Tell whether it does: a jog goes 1 mm in less than 0.1 s; a carriage that lost power swings on its spring."""
    before_m = daemon.client.status().positions.macro_position_m
    time.sleep(0.1)
    return abs(daemon.client.status().positions.macro_position_m - before_m) < 1e-4


def test_the_drives_temperatures_stand_beside_the_cycles(opened, idle):
    page = opened(Role.OBSERVE)
    expect(page.locator("#temperature-tile")).to_be_visible(timeout=PATIENCE_MS)
    expect(page.locator("#temperature")).to_have_text(re.compile(r"^2\d\.\d °C$"))
    expect(page.locator("#temperatures")).to_have_text(re.compile(r"^macro 2\d\.\d.*micro 2\d\.\d$"))


def test_an_operator_homes_moves_jogs_while_held_and_stops(idle, opened):
    page = opened(Role.OPERATE)
    page.click("#take")
    page.click("#home")
    expect(page.locator("#command-text")).to_contain_text("home: done", timeout=PATIENCE_MS)
    state_is(page, "armed")
    page.fill("#target", "10")
    page.click("#move")
    expect(page.locator("#command-text")).to_have_text("move: done", timeout=PATIENCE_MS)
    state_is(page, "armed")
    assert idle.client.status().positions.end_position_m == pytest.approx(0.01, abs=1e-4)
    press(page, "#jog-right")
    state_is(page, "moving")
    idle.until(lambda: idle.client.status().positions.end_position_m > 0.0105, "motion")
    page.mouse.up()
    state_is(page, "armed")  # it holds where it was let go of
    assert stands_still(idle)
    page.click("#stop")
    state_is(page, "idle")
    page.click("#take")  # given back
    expect(page.locator("#lease")).to_have_text("nobody operates")


def test_a_run_begun_and_ended_by_its_buttons_is_in_the_list(idle, opened):
    page = opened(Role.OPERATE)
    expect(page.locator("#banner")).to_have_text("SOFTWARE RIG in virtual time: nothing real moves")
    page.click("#take")
    page.click("#record")
    expect(page.locator("#recording")).to_have_text(re.compile(r"^[\d,]+ rows$"), timeout=PATIENCE_MS)
    name = page.locator("#recording-run").text_content()
    assert (idle.runs / name).is_dir()
    page.click("#record-end")
    expect(page.locator("#recording")).to_have_text("last seconds", timeout=PATIENCE_MS)
    row = page.locator("#runs tbody tr", has_text=name)
    expect(row.locator("td").nth(1)).to_have_text("closed", timeout=PATIENCE_MS)
    page.click("#take")


TILES = {
    "end": ("end_position_m", 1e3, 4),
    "setpoint": ("setpoint_position_m", 1e3, 4),
    "macro": ("macro_position_m", 1e3, 4),
    "relative": ("relative_position_m", 1e6, 2),
}
FORCES = {
    "macro-force": ("macro_force_n", 2),
    "micro-force": ("micro_force_n", 3),
    "contact": ("contact_force_estimate_n", 3),
}
COUNTS = {"cycles": "cycles_count", "missed": "missed_cycles_count", "lost-samples": "lost_samples_count"}
TEXTS = """() => Object.fromEntries([...document.querySelectorAll('.readout b[id], .tile [id]')]
    .map((one) => [one.id, one.textContent]))"""


def rounded(value, scale, digits):
    if value is None:
        return "–"
    text = f"{value * scale:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text.replace("-", "−")


def hear_along(page):
    """Open the page anew and hear what it hears: a list of messages that grows."""
    heard = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda text: heard.append(json.loads(text))))
    page.reload()
    return heard


def tiles_of(heard):
    """What the page has to show behind each of these messages."""
    newest, found = {}, []
    missed_at_first = heard[0]["status"]["health"]["missed_cycles_count"]
    for message in heard:
        positions, health = message["status"]["positions"], message["status"]["health"]
        if rows := message["samples"]["rows"]:
            newest = dict(zip(message["samples"]["columns"], rows[-1], strict=True))
        powered = message["status"]["state"] not in ("off", "idle", "fault")
        found.append(
            {name: rounded(positions[column], scale, digits) for name, (column, scale, digits) in TILES.items()}
            | {name: rounded(newest[column], 1.0, digits) for name, (column, digits) in FORCES.items()}
            | {name: f"{health[column]:,}" for name, column in COUNTS.items()}
            | {
                "error": rounded(positions["error_m"] if powered else None, 1e6, 3),
                "rate": f"{health['rate_hz']:.0f} Hz",
                "missed-since": f"{health['missed_cycles_count'] - missed_at_first} since this page opened",
                "late": f"{rounded(health['lateness_p99_s'], 1e6, 0)} µs",
                "late-max": f"greatest {rounded(health['lateness_max_s'], 1e6, 0)} µs",
                "discarded": f"{health['discarded_bytes_count']:,} bytes discarded",
            }
        )
    return found


def test_a_joint_identified_from_the_page_stands_there_and_says_that_it_is_worn(idle, opened):
    """Meanwhile every number beside it is what the service said last, forces at both edges included."""
    page = opened(Role.OPERATE)
    heard, shown = hear_along(page), []
    take_and_arm(page)
    page.fill("#identify-duration", "6")
    page.click("#identify")
    state_is(page, "identifying")
    while page.locator("#state").get_attribute("data-state") == "identifying":
        shown.append(page.evaluate(TEXTS))
        page.wait_for_timeout(50)
    expected = tiles_of(heard)
    for one in shown:
        assert {name: one[name] for name in expected[0]} in [
            all_ for all_ in expected if all_["cycles"] == one["cycles"]
        ]
    contacts_n = [float(one["contact"].replace("−", "-")) for one in shown if one["contact"] != "–"]
    assert min(contacts_n) < -0.1
    assert max(contacts_n) > 0.1
    expect(page.locator("#command-text")).to_contain_text("identify: done: backlash 199.", timeout=PATIENCE_MS)
    expect(page.locator("#backlash")).to_have_text(re.compile(r"^199\.\d\d ± 0\.\d\d µm$"), timeout=PATIENCE_MS)
    expect(page.locator("#backlash-at")).to_have_text(re.compile("^(identified|production) 20"))
    expect(page.locator("#wear")).to_contain_text("the limit is 1 um")
    expect(page.locator("#backlash-tile")).to_have_class(re.compile("bad"))
    if picture := os.environ.get("STAGECTL_PICTURE"):
        page.screenshot(path=picture, full_page=True)
    page.click("#stop")
    state_is(page, "idle")


def signal_pages(chromium, number):
    """Send a signal to the processes that draw pages; no handler of a page runs."""
    processes = chromium.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    for process in processes:
        if process["type"] == "renderer":
            os.kill(process["id"], number)


def test_a_page_that_crashes_in_the_middle_of_a_jog_stops_the_stage_and_leaves_no_lease(idle, opened, chromium):
    page = armed_page(opened)
    press(page, "#jog-left")
    idle.state_is("moving")
    signal_pages(chromium, signal.SIGKILL)
    idle.state_is("idle")
    assert idle.client.status().fault is None
    idle.until(lambda: idle.client.lease_state() is None, "a free lease")


def test_a_page_that_hangs_in_the_middle_of_a_jog_stops_the_stage(idle, opened, chromium):
    page = armed_page(opened)
    press(page, "#jog-left")
    idle.state_is("moving")
    signal_pages(chromium, signal.SIGSTOP)
    try:
        idle.until(lambda: idle.client.status().state == "armed", "the jog's end")
        assert idle.client.status().lease is not None
        idle.state_is("fault")
        assert idle.client.status().fault.kind == "LEASE"
        assert stands_still(idle)
    finally:
        signal_pages(chromium, signal.SIGCONT)


def test_missed_cycles_and_lateness_have_their_tiles_and_count_from_when_the_page_opened(idle, opened):
    """A stage in virtual time misses no cycle: the numbers are put into what the service says."""
    page, missed_counts = opened(Role.OBSERVE), [1227]

    def pass_on(socket):
        def send(text):
            message = json.loads(text)
            changed = {"lateness_p99_s": 42.4e-6, "lateness_max_s": 1.3e-3, "missed_cycles_count": missed_counts[-1]}
            message["status"]["health"] |= changed | {"lost_samples_count": 3, "discarded_bytes_count": 12_345}
            socket.send(json.dumps(message))

        socket.connect_to_server().on_message(send)

    page.route_web_socket("**/v1/stream", pass_on)
    page.reload()
    expect(page.locator("#missed")).to_have_text("1,227")
    expect(page.locator("#missed-since")).to_have_text("0 since this page opened")
    missed_counts.append(1234)
    expect(page.locator("#missed")).to_have_text("1,234")
    expect(page.locator("#missed-since")).to_have_text("7 since this page opened")
    expect(page.locator("#late")).to_have_text("42 µs")
    expect(page.locator("#late-max")).to_have_text("greatest 1300 µs")
    expect(page.locator("#lost-samples")).to_have_text("3")
    expect(page.locator("#discarded")).to_have_text("12,345 bytes discarded")


def test_a_motion_that_no_status_shows_under_way_says_what_became_of_it(idle, opened):
    """So short is a step of 1 um, or any motion in virtual time on a fast host, beside ten statuses a second."""
    page = opened(Role.OPERATE)

    def pass_on(socket):
        def send(text):
            message = json.loads(text)
            message["status"]["command"] = None
            socket.send(json.dumps(message))

        socket.connect_to_server().on_message(send)

    page.route_web_socket("**/v1/stream", pass_on)
    page.reload()
    expect(page.locator("#state")).not_to_have_attribute("data-state", "lost", timeout=PATIENCE_MS)
    take_and_arm(page)
    expect(page.locator("#command-text")).to_have_text("arm: done", timeout=PATIENCE_MS)
    page.fill("#target", "3")
    page.click("#move")
    expect(page.locator("#command-text")).to_have_text("move: done", timeout=PATIENCE_MS)
    state_is(page, "armed")  # the move's answer may come before the status that permits a jog
    press(page, "#jog-left")
    state_is(page, "moving")  # asked of the page: its stream goes through this process, and stands while it sleeps
    page.mouse.up()
    expect(page.locator("#command-text")).to_have_text("jogging: done", timeout=PATIENCE_MS)
    page.click("#stop")
    state_is(page, "idle")


def test_a_fault_says_what_to_do_and_its_acknowledgement_enables_nothing(idle, opened):
    with Client(idle.socket) as vanishing:
        vanishing.take_lease("who vanishes", duration_s=1.0)
        vanishing.arm()
    page = opened(Role.OPERATE)
    state_is(page, "fault")
    fault = idle.client.fault()
    assert "the lease on motion ran out" in fault.what
    assert "ms ago" in fault.values
    expect(page.locator("#fault-what")).to_have_text(f"{fault.what}:")
    expect(page.locator("#fault-values")).to_have_text(fault.values)
    expect(page.locator("#fault-remedy")).to_have_text(f"What to do: {fault.remedy}.")
    expect(page.locator("#fault-at")).to_have_text(re.compile(rf"^LEASE, fault {fault.number}, .+, while armed$"))
    page.locator("#acknowledge").click(force=True)
    expect(page.locator("#refusal")).to_have_text("Acknowledge: take the lease first")
    assert idle.client.fault() == fault
    page.click("#take")
    page.click("#acknowledge")
    state_is(page, "idle")
    expect(page.locator("#fault")).to_be_hidden()
    idle.until(lambda: stands_still(idle), "rest")
    assert idle.client.fault() is None
    states = [entry.fields["state"] for entry in idle.client.log(limit=20) if entry.event == "state"]
    assert states[-2:] == ["fault", "idle"]
    page.click("#take")


def test_leaving_the_page_gives_the_lease_back(idle, opened):
    page = armed_page(opened)
    page.goto("about:blank")
    idle.state_is("idle")
    assert idle.client.status().fault is None
    idle.until(lambda: idle.client.lease_state() is None, "a free lease")


def test_stop_is_in_sight_at_phone_width_wherever_one_scrolls(idle, opened):
    page = armed_page(opened, viewport=PHONE, has_touch=True, is_mobile=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    for far in (0.0, 0.5, 1.0):
        page.evaluate("share => scrollTo(0, share * document.body.scrollHeight)", far)
        box = page.locator("#stop").bounding_box()
        assert box["y"] >= 0.0
        assert box["y"] + box["height"] <= PHONE["height"]
        assert box["height"] >= 44.0
        hit = "([x, y]) => document.elementFromPoint(x, y).id"
        assert page.evaluate(hit, [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]) == "stop"
    page.tap("#stop")
    state_is(page, "idle")


def test_a_phone_jogs_while_a_finger_holds_moves_and_reaches_scope_and_runs(idle, opened):
    page = armed_page(opened, viewport=PHONE, has_touch=True, is_mobile=True)
    fingers = page.context.new_cdp_session(page)
    jog = page.locator("#jog-right")
    jog.evaluate("one => one.scrollIntoView({ block: 'center' })")
    box = jog.bounding_box()
    finger = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    assert page.evaluate("({x, y}) => document.elementFromPoint(x, y).id", finger) == "jog-right"
    before_m = idle.client.status().positions.end_position_m
    fingers.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [finger]})
    idle.state_is("moving")
    idle.until(lambda: idle.client.status().positions.end_position_m > before_m + 1e-3, "motion")
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    expect(jog).not_to_have_class(re.compile("held"))
    expect(page.locator("#command-text")).to_have_text("jogging: done", timeout=PATIENCE_MS)
    state_is(page, "armed")
    assert stands_still(idle)
    page.fill("#target", "5")
    page.tap("#move")
    expect(page.locator("#command-text")).to_have_text("move: done", timeout=PATIENCE_MS)
    assert idle.client.status().positions.end_position_m == pytest.approx(0.005, abs=1e-4)
    for place in ("#plots", "#hold", "#save", ".scroll:has(#runs)", "#runs-refresh"):
        one = page.locator(place)
        one.scroll_into_view_if_needed()
        box = one.bounding_box()
        assert 0.0 <= box["x"] < box["x"] + box["width"] <= PHONE["width"], place
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.tap("#hold")
    expect(page.locator("#trigger-state")).to_have_text("held")
    row = page.locator("#runs tbody tr").first
    expect(row).to_be_visible()
    page.tap("#stop")
    state_is(page, "idle")


def test_an_observer_s_page_shows_and_commands_nothing(idle, opened):
    page = opened(Role.OBSERVE)
    expect(page.locator("#watching")).to_be_visible()
    expect(page.locator("#commands")).to_be_hidden()
    expect(page.locator("#stop")).to_be_disabled()
    code = page.evaluate("""async () => (await fetch('/v1/lease', {method: 'POST', body: '{"holder": "x"}',
        headers: {'Content-Type': 'application/json'}})).status""")
    assert code == 403
    assert idle.client.lease_state() is None
    expect(page.locator("#end")).not_to_have_text("–")
    assert page.locator("#plots canvas").count() >= 3


def test_hold_and_zoom_keep_the_picture_and_let_it_go(idle, opened):
    page = opened(Role.OBSERVE)
    chip = page.locator("#trigger-state")
    expect(chip).to_have_text("rolling")
    page.click("#zoom-in")
    expect(chip).to_have_text("held")
    page.click("#hold")
    expect(chip).to_have_text("rolling")
    page.select_option("#trigger", "error")
    expect(page.locator("#level")).to_be_visible()
    page.fill("#level", "1e9")
    page.locator("#level").blur()
    expect(chip).to_have_text("waits for the trigger")


def saved_samples(page):
    """Return what the scope shows, one dictionary a sample; a value that isn't known is empty."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")  # drawn
    with page.expect_download() as saved:
        page.click("#save")
    with open(saved.value.path()) as file:
        return list(csv.DictReader(file))


def ends_s(samples):
    """When the first and the last of these samples were."""
    return [float(samples[at]["t_s"]) for at in (0, -1)]


def test_zoom_keeps_the_middle_what_is_dragged_over_or_what_is_under_the_pointer(idle, opened):
    """A picture begins and ends with a sample beyond its edge, where there is one: by 10 ms each."""
    page = opened(Role.OBSERVE)
    page.select_option("#window", "2")
    page.click("#hold")
    expect(page.locator("#trigger-state")).to_have_text("held")
    whole = saved_samples(page)
    from_s, until_s = ends_s(whole)
    assert until_s - from_s == pytest.approx(2.0, abs=0.03)

    def shows(from_share, until_share):
        shown = saved_samples(page)
        assert all(one in whole for one in (shown[0], shown[-1]))
        expected_s = [from_s + share * (until_s - from_s) for share in (from_share, until_share)]
        assert ends_s(shown) == pytest.approx(expected_s, abs=0.03)

    page.click("#zoom-in")
    shows(0.25, 0.75)
    page.click("#zoom-out")
    shows(0.0, 1.0)
    plot = page.locator("#plots .u-over").first
    width = plot.bounding_box()["width"]
    plot.hover(position={"x": 0.2 * width, "y": 40})
    page.mouse.down()
    plot.hover(position={"x": 0.6 * width, "y": 40})
    page.mouse.up()
    shows(0.2, 0.6)
    plot.hover(position={"x": 0.25 * width, "y": 40})  # 0.3 of the whole
    page.mouse.wheel(0, -100)
    shows(0.3 - 0.1 * 0.8, 0.3 + 0.3 * 0.8)
    page.click("#zoom-reset")
    assert saved_samples(page) == whole


def test_a_trigger_holds_the_picture_around_the_event(idle, opened):
    page = armed_page(opened)

    def move(target_mm):
        page.fill("#target", f"{target_mm}")
        with page.expect_response("**/v1/move"):
            page.click("#move")
        expect(page.locator("#command-text")).to_have_text("move: done", timeout=PATIENCE_MS)
        state_is(page, "armed")

    move(20)
    move(10)
    page.select_option("#window", "1")
    page.select_option("#trigger", "reversal")
    page.check("#single")
    chip = page.locator("#trigger-state")
    expect(chip).to_have_text("waits for the trigger")
    move(20)
    expect(chip).to_have_text("triggered", timeout=PATIENCE_MS)
    expect(page.locator("#hold")).to_have_text("Next")
    shot = saved_samples(page)
    times_s = [float(one["t_s"]) for one in shot]
    setpoints_m = [float(one["setpoint_position_m"]) for one in shot]
    turn = next(at for at in range(1, len(shot)) if setpoints_m[at] - setpoints_m[at - 1] > 1e-8)
    assert times_s[-1] - times_s[0] == pytest.approx(1.0, abs=0.03)
    assert times_s[turn] - times_s[0] == pytest.approx(0.25, abs=0.03)
    page.click("#stop")
    state_is(page, "idle")
    assert saved_samples(page) == shot  # whatever comes
    page.click("#hold")
    expect(chip).to_have_text("waits for the trigger")


def lists_run(page, name):
    """Ask for the list of runs until it has one: for 2 s all pages get the list that one of them asked for."""
    give_up_s = time.monotonic() + PATIENCE_MS / 1e3
    while name not in (shown := page.locator("#runs").inner_text()):
        assert time.monotonic() < give_up_s, shown
        page.click("#runs-refresh")
        page.wait_for_timeout(100)


MARKUP = "<img src=x onerror='document.title=1'>"


def test_names_and_reports_from_outside_are_text_and_run_nothing(idle, opened):
    """A run's folder, its note and its report, and a lease's holder: all of it may be anybody's words."""
    folder = idle.runs / "hostile<b onclick=1>&quot;"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps({"text": MARKUP, "profile": {"name": MARKUP}}))
    reported = idle.runs / "reported"
    reported.mkdir()
    (reported / "report.html").write_text(
        "<title>as it was</title><p>drawn</p><script>document.title='run'</script>"
        "<img src=x onerror=\"document.title='run'\"><form action=/v1/stop method=post><button>go</button></form>"
    )
    try:
        page = opened(Role.OBSERVE)
        with idle.client.lease(MARKUP):
            expect(page.locator("#lease")).to_have_text(f"{MARKUP} operates", timeout=PATIENCE_MS)
            lists_run(page, folder.name)
            assert page.locator("main img, main [onclick]").count() == 0
            assert page.title() != "1"
        with page.context.expect_page() as shown:
            page.click("text=reported")
        report = shown.value
        expect(report.locator("p")).to_have_text("drawn")
        assert report.title() == "as it was"
        assert report.evaluate("origin") == "null"  # a page of nobody: neither cookie nor key
        report.click("button")
        assert report.url.endswith("/report")
    finally:
        shutil.rmtree(folder)
        shutil.rmtree(reported)


def test_another_site_in_the_same_browser_gets_nothing(idle, opened, tmp_path):
    """A page on another port of 127.0.0.1 is the same site to cookies; it is not ours for all that."""
    page = opened(Role.OPERATE)
    (tmp_path / "index.html").write_text("<title>evil</title>")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as evil:
        threading.Thread(target=evil.serve_forever, daemon=True).start()
        target = page.url.rstrip("/")
        other = page.context.new_page()
        other.goto(f"http://127.0.0.1:{evil.server_address[1]}/")
        found = other.evaluate(FROM_ELSEWHERE, target)
        evil.shutdown()
    assert found == {"read": "refused", "posted": "refused", "stream": "closed", "frame": "blocked", "key": None}
    assert idle.client.lease_state() is None
    assert all("stop" not in entry.event for entry in idle.client.log(limit=3))


FROM_ELSEWHERE = """async (target) => {
    const read = await fetch(target + '/v1/status', {credentials: 'include'}).then(() => 'read', () => 'refused');
    const posted = await fetch(target + '/v1/stop', {method: 'POST', mode: 'no-cors', credentials: 'include'})
        .then(() => 'sent', () => 'refused');
    const stream = await new Promise((resolve) => {
        const socket = new WebSocket(target.replace('http', 'ws') + '/v1/stream');
        socket.onmessage = () => resolve('heard');
        socket.onerror = () => resolve('closed');
    });
    const frame = await new Promise((resolve) => {
        const made = document.createElement('iframe');
        made.onload = () => {
            try { resolve(made.contentDocument ? 'empty' : 'blocked'); } catch { resolve('blocked'); }
        };
        made.src = target + '/';
        document.body.append(made);
    });
    return {read, posted, stream, frame, key: localStorage.getItem('stagectl-page-key')};
}"""


FIRST = """async ([rows, from, kind, level]) => {
    const { firstTrigger } = await import('/assets/trigger.js');
    return firstTrigger(rows, from, kind, level);
}"""


def rows_of(setpoints=(), errors=(), contacts=()):
    count = max(len(setpoints), len(errors), len(contacts))
    column = lambda values: list(values) or [0.0] * count  # noqa: E731
    triples = zip(column(setpoints), column(errors), column(contacts), strict=True)
    tracking = int(Phase.TRACKING)
    return [[0.01 * i, 0.0, 0.0, s, e, 0.0, 0.0, 0.0, c, tracking] for i, (s, e, c) in enumerate(triples)]


READOUT = """async ([rows, a, b]) => {
    const { readout } = await import('/assets/readout.js');
    return Object.fromEntries(readout(rows, a, b).map((line) => [line.name, [line.t_s, line.values[1]]]));
}"""


def test_cursors_say_difference_slope_and_statistics_of_what_is_between(opened):
    page = opened(Role.OBSERVE)
    rows = rows_of(errors=[9e-6, 1e-6, 2e-6, None, 3e-6, -50e-6])
    found = page.evaluate(READOUT, [rows, 0.0096, 0.043])
    assert found["A"] == [0.01, pytest.approx(1.0)]
    assert found["B"] == [0.04, pytest.approx(3.0)]
    assert found["B − A"] == [pytest.approx(0.03), pytest.approx(2.0)]
    assert found["per second"][1] == pytest.approx(2.0 / 0.03)
    assert found["mean"][1] == pytest.approx(2.0)
    assert found["rms about mean"][1] == pytest.approx((2.0 / 3.0) ** 0.5)
    assert found["peak to peak"][1] == pytest.approx(2.0)
    assert list(page.evaluate(READOUT, [rows, 0.02, None])) == ["A"]
    page.click("#cursors-on")
    plot = page.locator("#plots .u-over").first
    for x in (50, 150):
        plot.click(position={"x": x, "y": 20})
    expect(page.locator("#cursors")).to_contain_text("peak to peak")


WHY_NOT = """async ([id, situation]) => (await import('/assets/permit.js')).whyNot(id, situation)"""


def test_a_button_that_can_t_be_used_says_why(idle, opened):
    page = opened(Role.OPERATE)
    state_is(page, "idle")
    page.locator("#move").click(force=True)
    expect(page.locator("#refusal")).to_have_text("Move to: take the lease first")
    expect(page.locator("#move")).to_be_disabled()
    with idle.client.lease("somebody else"):
        expect(page.locator("#lease")).to_have_text("somebody else operates", timeout=PATIENCE_MS)
        page.locator("#take").click(force=True)
        expect(page.locator("#refusal")).to_contain_text("somebody else operates, and one does at a time")
    status = {"state": "moving", "homed": True, "lease": None, "recording": None}
    held = {"status": status, "held": True, "mayOperate": True, "jogging": False}
    assert "stop it" in page.evaluate(WHY_NOT, ["move", held])
    assert page.evaluate(WHY_NOT, ["jog-left", held | {"jogging": True}]) == ""
    assert page.evaluate(WHY_NOT, ["move", held | {"status": status | {"state": "armed"}}]) == ""
    not_homed = status | {"state": "armed", "homed": False}
    assert page.evaluate(WHY_NOT, ["move", held | {"status": not_homed}]) == "home first"
    assert "doesn't answer" in page.evaluate(WHY_NOT, ["move", held | {"status": None}])


def test_a_stop_that_nobody_hears_says_so(idle, opened):
    page = opened(Role.OPERATE)
    page.route("**/v1/stop", lambda route: route.abort())
    page.click("#stop")
    expect(page.locator("#alarm")).to_contain_text("Use the emergency stop")
    page.unroute("**/v1/stop")
    expect(page.locator("#alarm")).to_be_hidden()  # said again, and heard


def test_a_page_that_was_not_told_its_role_stops_all_the_same_and_asks_again(idle, opened):
    page = opened(Role.OPERATE)
    page.route("**/session", lambda route: route.abort())
    page.reload()
    expect(page.locator("#state")).not_to_have_attribute("data-state", "lost", timeout=PATIENCE_MS)
    with page.expect_response("**/v1/stop") as answered:
        page.click("#stop")
    assert answered.value.status == 202
    page.locator("#take").click(force=True)
    expect(page.locator("#refusal")).to_contain_text("has not said yet")
    page.unroute("**/session")
    page.locator("#take:not([aria-disabled=true])").click()
    expect(page.locator("#lease")).to_have_text("this page operates", timeout=PATIENCE_MS)
    page.click("#take")


def test_an_observer_s_escape_key_says_that_it_stops_nothing(idle, opened):
    page = opened(Role.OBSERVE)
    expect(page.locator("#stop")).to_be_disabled()
    page.keyboard.press("Escape")
    expect(page.locator("#alarm")).to_contain_text("STOP was not sent")


def test_a_step_whose_answer_got_lost_is_not_done_twice(idle, opened):
    page = armed_page(opened)
    keys = []

    def lose_the_first_answer(route):
        keys.append(route.request.headers["idempotency-key"])
        answer = route.fetch()
        if len(keys) == 1:
            route.fulfill(status=502, json={"kind": "LinkError", "message": "no answer from the service."})
        else:
            route.fulfill(response=answer)

    page.route("**/v1/jog", lose_the_first_answer)
    before_m = idle.client.status().positions.end_position_m
    step, way_m = ("#step-left", -1e-3) if before_m > 0.01 else ("#step-right", 1e-3)
    page.fill("#distance", "1")
    page.select_option("#distance-unit", label="mm")
    page.click(step)
    expect(page.locator("#refusal")).to_contain_text("pressed again, it is not done twice")
    expect(page.locator("#command-text")).to_have_text("jog: done", timeout=PATIENCE_MS)
    state_is(page, "armed")
    with page.expect_response("**/v1/jog"):
        page.click(step)
    expect(page.locator("#refusal")).to_be_hidden()
    state_is(page, "armed")
    assert idle.client.status().positions.end_position_m == pytest.approx(before_m + way_m, abs=1e-4)
    with page.expect_response("**/v1/jog"):
        page.click(step)
    idle.until(lambda: abs(idle.client.status().positions.end_position_m - before_m) > 1.5e-3, "the second step")
    assert keys[0] == keys[1] != keys[2]
    page.click("#stop")
    state_is(page, "idle")


def test_a_trigger_fires_at_the_first_rise_contact_or_reversal(opened):
    page = opened(Role.OBSERVE)

    def first(rows, kind, level=0.0, begin=0):
        return page.evaluate(FIRST, [rows, begin, kind, level])

    errors = rows_of(errors=[0.0, 4e-6, -6e-6, -7e-6, 1e-6, 5e-6])
    assert first(errors, "error", 5e-6) == 2
    assert first(errors, "error", 5e-6, begin=3) == 5
    assert first(errors, "error", 8e-6) == -1
    assert first(rows_of(errors=[None, 9e-6, 9e-6]), "error", 5e-6) == -1  # no rise was seen
    late = rows_of(errors=[0.0, None, 9e-6, None, 9e-6, 0.0, None])
    assert first(late, "error", 5e-6) == 2  # across a late line
    assert first(late, "error", 5e-6, begin=2) == 2
    assert first(late, "error", 5e-6, begin=3) == -1  # across another it goes on
    assert first(rows_of(contacts=[0.2, -0.9, -1.0, 2.0]), "contact", 1.0) == 2
    there_and_back = rows_of(setpoints=[0.0, 1e-3, 2e-3, 2e-3, 2e-3, 1e-3, 0.0])
    assert first(there_and_back, "reversal") == 5  # over the rest between
    assert first(rows_of(setpoints=[0.0, 0.0, 1e-3, 2e-3]), "reversal") == -1  # a beginning is no reversal
    assert first(rows_of(setpoints=[1e-3, 2e-3, None, 2e-3, 1e-3]), "reversal") == -1
    assert first(there_and_back, "none") == -1
    for phase in Phase:
        swings = rows_of(errors=[0.0, 9e-6], contacts=[0.0, 2.0])
        turns = rows_of(setpoints=[0.0, 1e-3, 0.0])
        for row in swings + turns:
            row[-1] = int(phase)
        fires = phase in TICKING  # without power nothing is followed
        assert first(swings, "error", 5e-6) == first(swings, "contact", 1.0) == (1 if fires else -1), phase
        assert first(turns, "reversal") == (2 if fires else -1), phase
    begins = rows_of(errors=[9e-6, 9e-6, 9e-6])
    begins[0][-1] = int(Phase.IDLE)
    assert first(begins, "error", 5e-6) == 1  # armed away from its set-point
