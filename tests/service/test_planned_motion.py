"""Scans, tables and streams through the service, in virtual time: refused before the first cycle, or followed."""

import contextlib
import math
import threading
import time

import numpy as np
import pytest

from stagectl.backend import BatchBackend
from stagectl.outcome import BacklashEstimate
from stagectl.record import read_run
from stagectl.replay import replay
from stagectl.requests import Phase
from stagectl.service import messages, plans
from stagectl.service.desk import Busy, Unfit
from stagectl.service.lease import LeaseRefused
from stagectl.service.service_log import now_text
from stagectl.service.view import backlash_message
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from stagectl.wear import IDENTIFIED
from tests.service.test_stage_loop import Bench
from tests.struck_stage import home_by_truth

PERIOD_S = 0.01
GO = messages.Segment


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    made = Bench(tmp_path_factory.mktemp("planned"))
    made.until(lambda: made.loop._state == "idle")
    made.loop.step()
    made.take()
    assert made.do("home", messages.Home()).stop == "FINISHED"
    yield made
    made.loop.leave()
    made.loop.run()


@pytest.fixture
def armed(bench):
    """The bench, which holds at 0 under a lease; rows that its motions leave in `rows`."""
    if bench.desk.lease_state() is None:
        bench.take()
    if bench.status.state == "idle":
        assert bench.do("arm", messages.Arm()).stop == "FINISHED"
    assert bench.do("move", messages.Move(target_m=0.0)).stop == "FINISHED"
    bench.rows = []
    scope, stage = bench.loop._observe, bench.loop._stage

    def keep(rows):
        bench.rows.append(rows.copy())
        scope(rows)

    stage._observe = keep
    yield bench
    stage._observe = scope


def planned(bench, name, body):
    """Submit a scan or a table and carry it out."""
    bench.keys += 1
    key = bench.desk.submit_planned(name, body, f"p{bench.keys}", bench.token).key
    bench.until(lambda: bench.desk.command(key).state in ("done", "failed"))
    bench.loop.step()
    return bench.desk.command(key)


def reference(bench):
    """Setpoints of the cycles since the test began, which never jump."""
    rows = np.concatenate(bench.rows)
    rows = rows[rows["run_phase"] == Phase.TRACKING]
    velocity, dt_s = rows["setpoint_velocity_m_per_s"], np.diff(rows["cycle"]) * 1e-3
    limit = bench.desk.profile.macro.acceleration_limit_m_per_s2
    assert np.all(np.abs(np.diff(velocity)) <= limit * dt_s + 1e-9)
    middle = 0.5 * (velocity[1:] + velocity[:-1])
    assert np.all(np.abs(np.diff(rows["setpoint_position_m"]) - middle * dt_s) <= limit * dt_s**2 + 1e-9)
    return rows


def test_a_scan_repeats_passes_and_dwells(armed):
    there = [GO(target_m=0.02, pass_velocity_m_per_s=0.05), GO(target_m=0.03, velocity_m_per_s=0.05, dwell_s=0.1)]
    done = planned(armed, "scan", messages.Scan(segments=[*there, GO(target_m=0.0)], repeat_count=4, start_m=-0.01))
    assert (done.state, done.stop) == ("done", "FINISHED")
    rows = reference(armed)
    assert np.count_nonzero(np.abs(rows["setpoint_position_m"] - 0.03) < 1e-9) == pytest.approx(400, abs=12)
    at_rest = (rows["setpoint_velocity_m_per_s"] == 0.0) & (rows["setpoint_position_m"] == 0.0)
    moving = rows[
        np.flatnonzero(rows["setpoint_position_m"] > 1e-6)[0] : np.flatnonzero(rows["setpoint_position_m"] > 1e-6)[-1]
    ]
    assert np.count_nonzero(at_rest[: moving.size]) < 60  # no pause of 20 ms between repetitions
    assert armed.status.state == "armed"
    assert armed.status.positions.end_position_m == pytest.approx(0.0, abs=1e-4)


def test_a_scan_that_is_none_is_refused_before_anything_moves(armed):
    for body, text in (
        (messages.Scan(segments=[GO(target_m=0.1), GO(target_m=0.5)]), r"segments\.1\.target_m is 0\.5: the travel"),
        (
            messages.Scan(segments=[GO(target_m=0.149, pass_velocity_m_per_s=0.2), GO(target_m=0.1)]),
            r"'scan' at .* s: position_m is .*travel",
        ),
        (messages.Scan(segments=[GO(target_m=0.1, velocity_m_per_s=19.0)]), r"segments\[0\].velocity_m_per_s is 19"),
        (
            messages.Scan(segments=[GO(target_m=0.1, dwell_s=3600.0)]),
            "one repetition takes 36.* s, 97.9.* s is the limit",
        ),
    ):
        with pytest.raises(Unfit, match=text):
            armed.desk.submit_planned("scan", body, "refused", armed.token)
    with pytest.raises(LeaseRefused):
        armed.desk.submit_planned("scan", messages.Scan(segments=[GO(target_m=0.1)]), "refused", "guessed")
    armed.loop.step()
    assert np.all(reference(armed)["setpoint_position_m"] == 0.0)


def test_a_question_begins_nothing(armed):
    """Whoever must home and arm first asks before; a refusal behind that has moved the stage for nothing."""
    for name, body, text in (
        ("move", messages.Move(target_m=0.16), r"target_m is 0.16: the travel of .* is \[-0.15, 0.15\] m; give"),
        ("jog", messages.JogBy(distance_m=0.16), r"distance_m is 0.16: from 0 m that leads to 0.16 m, the travel"),
        ("jog", messages.JogBy(distance_m=-0.31), r"distance_m is -0.31: the travel of"),
        ("scan", messages.Scan(segments=[GO(target_m=0.1)], start_m=0.5), "start_m is 0.5: the travel"),
        ("scan", messages.Scan(segments=[GO(target_m=0.1, velocity_m_per_s=19.0)]), r"velocity_m_per_s is 19"),
        ("follow", messages.Follow(text=table(0.5)), "beyond the travel|position_m is"),
        ("follow", messages.Follow(text="t,x"), "it must be 't_s,position_m'"),
        ("setpoints", messages.Setpoints(first_number=0, period_s=0.0105, position_m=[0.0]), "period_s is 0.0105"),
        ("setpoints", messages.Setpoints(first_number=0, period_s=0.01, position_m=[0.2]), "position_m.0 is 0.2: the"),
    ):
        with pytest.raises(Unfit, match=text):
            armed.desk.check(name, body, armed.token)
    for name, body in (
        ("move", messages.Move(target_m=0.15)),
        ("jog", messages.JogBy(distance_m=-0.15)),
        ("scan", messages.Scan(segments=[GO(target_m=0.1)], start_m=0.05)),
        ("follow", messages.Follow(text=table(0.02))),
        ("setpoints", messages.Setpoints(first_number=0, period_s=PERIOD_S, position_m=[0.1])),
    ):
        armed.desk.check(name, body, armed.token)
        with pytest.raises(LeaseRefused):
            armed.desk.check(name, body, "guessed")
    armed.loop.step()
    assert np.all(reference(armed)["setpoint_position_m"] == 0.0)
    assert armed.status.state == "armed"


def test_a_sweep_is_asked_about_with_the_joint_that_it_would_meet(tmp_path):
    """The wider the gap, the slower: at 0.3 Hz kang-2023's 15 mm are met too hard, 3 mm are not."""
    bench = Bench(tmp_path, "kang-2023")
    sweep = messages.Identify(frequency_hz=0.3)
    narrow = BacklashEstimate(1.5e-3, 1.5e-3, 1e-6, 1e-6, 1000.0, 1000.0, 1.0, 1.0)
    loop = bench.loop
    try:
        bench.until(lambda: loop._state == "idle")
        loop.step()
        bench.take()
        with pytest.raises(Unfit, match=r"with a gap of 15 mm .* at most 0.208 Hz"):
            bench.desk.check("identify", sweep, bench.token)
        kept = backlash_message(narrow, "run", "kang-2023", loop._backend, now_text(), IDENTIFIED)
        loop._memory.keep_joint(kept)  # as it was before a restart: what homing will find again
        loop.step()
        bench.desk.check("identify", sweep, bench.token)
        loop._memory.keep_joint(kept.model_copy(update={"left_m": 0.01}))
        loop.step()
        with pytest.raises(Unfit, match=r"with a gap of 11.5 mm .*found last: `stagectl home` finds it anew"):
            bench.desk.check("identify", sweep, bench.token)
        with pytest.raises(Unfit, match=r"duration_s = 3: .* or a higher frequency_hz$"):  # no matter of the joint
            bench.desk.check("identify", messages.Identify(frequency_hz=0.1, duration_s=3.0), bench.token)
        for name, value in (("left_stiffness_n_per_m", 0.0), ("left_m", -0.002), ("right_m", math.nan)):
            loop._memory.keep_joint(kept.model_copy(update={name: value}))  # edited: no joint that could be
            loop.step()
            with pytest.raises(Unfit, match="with a gap of 15 mm"):
                bench.desk.check("identify", sweep, bench.token)

        stage = loop._stage
        home_by_truth(stage, stage.backend.rig.plant_state())
        loop._homed = True
        loop.step()
        with pytest.raises(Unfit, match="with a gap of 15 mm"):  # homing believed that, whatever was kept
            bench.desk.check("identify", sweep, bench.token)
        stage.take_backlash(narrow)
        loop.step()
        bench.desk.check("identify", sweep, bench.token)
    finally:
        loop.leave()
        loop.run()


@contextlib.contextmanager
def planned_together(bench, key):
    """Ask three times for a scan, with the same key, while another motion is being planned; what comes of them."""
    body, found = messages.Scan(segments=[GO(target_m=0.005), GO(target_m=0.0)]), []

    def submit():
        try:
            found.append(bench.desk.submit_planned("scan", body, key, bench.token).key)
        except Busy as error:
            found.append(str(error))

    threads = [threading.Thread(target=submit) for _ in range(3)]
    with bench.desk._plans:
        for thread in threads:
            thread.start()
        time.sleep(0.1)
        assert (found, bench.desk.command(key)) == ([], None)
        yield found
    for thread in threads:
        thread.join(60.0)


def test_motions_are_planned_one_at_a_time_and_a_key_once(armed):
    """Many at once took the processor from the supervisor until its sign of life was missed."""
    with planned_together(armed, "together") as found:
        pass
    assert found == ["together"] * 3
    armed.until(lambda: armed.desk.command("together").state == "done")


def test_what_is_being_planned_when_a_stop_comes_is_not_begun_behind_it(armed):
    """It began as soon as the stage was armed again."""
    with planned_together(armed, "stopped") as found:
        armed.desk.ask_to_stop("a person")
        armed.until(lambda: not armed.desk.stop_asked)
        armed.until(lambda: armed.status.state == "idle")
        assert armed.do("arm", messages.Arm()).stop == "FINISHED"
    assert found == ["scan: stopped before it began: a person"] * 3
    assert armed.desk.command("stopped") is None


def test_the_same_key_is_the_same_scan(armed):
    body = messages.Scan(segments=[GO(target_m=0.005)])
    first = armed.desk.submit_planned("scan", body, "once", armed.token)
    assert armed.desk.submit_planned("scan", body, "once", armed.token).key == first.key
    with pytest.raises(Unfit, match="was used for another scan"):
        armed.desk.submit_planned("scan", messages.Scan(segments=[GO(target_m=0.006)]), "once", armed.token)
    armed.until(lambda: armed.desk.command("once").state == "done")
    armed.loop.step()
    assert np.max(reference(armed)["setpoint_position_m"]) == 0.005


def table(scale_m, scale_s=1.0):
    rows = [(t / 20.0, 0.5 * (1.0 - math.cos(math.pi * t / 10.0))) for t in range(21)]
    return "\n".join(["t_s,position_m", *(f"{t * scale_s},{x * scale_m}" for t, x in rows)])


def test_a_table_is_followed(armed):
    done = planned(armed, "follow", messages.Follow(text=table(0.02), name="hump"))
    assert (done.state, done.stop, done.error) == ("done", "FINISHED", None)
    assert "hump" not in done.text
    assert np.max(reference(armed)["setpoint_position_m"]) == pytest.approx(0.02, abs=1e-5)


def test_a_table_that_seems_to_have_milliseconds_is_followed_and_said(oled_profile):
    plan = plans.followed(messages.Follow(text=table(1e-3, 130.0)), oled_profile)
    assert plan.remark.startswith("the motion takes 130 s at")
    assert plan.remark.endswith("are the times milliseconds? Divide by 1000")
    assert plans.followed(messages.Follow(text=table(0.02)), oled_profile).remark == ""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            table(20.0),
            r"position_m is .*, outside the travel .*position_m goes from .* to 20.*millimetres\? Divide by 1000",
        ),
        (table(2e4), r"are these micrometres\?"),
        (table(0.02, 0.01), r"at .* s: velocity_m_per_s is .*, outside the limit"),
        ("t_ms,position_mm\n0,0\n1,1", r"line 1: .* it says ms, mm: convert times to seconds, positions to metres"),
        ("t_s,position_m\n0,0\n1,nan", r"row 1: position_m is nan"),
        ("t_s,position_m\n0,0\n1,x", r"row 2: '1,x'; two numbers are needed"),
        (table(0.02, 1e4), r"takes 10000 s, 299.999 s is the limit; .* Are the times milliseconds\?"),
    ],
)
def test_a_table_that_can_t_be_is_refused_with_the_units_it_seems_to_have(armed, text, said):
    with pytest.raises(Unfit, match=said):
        armed.desk.submit_planned("follow", messages.Follow(text=text), "refused", armed.token)


def wave(count, amplitude_m=0.01):
    t = np.arange(count) / (count - 1)
    return [float(x) for x in amplitude_m * (1.0 - np.cos(2.0 * np.pi * t)) * np.sin(np.pi * t) ** 2]


def send(bench, first, positions, last=False):
    body = messages.Setpoints(first_number=first, period_s=PERIOD_S, position_m=positions, last=last)
    return bench.desk.take_setpoints(body, bench.token)


def streaming(bench, positions, until=None, block=20):
    """Send a stream as the stage takes it, up to number `until`; returns the command when it is over."""
    state = send(bench, 0, positions[:60])
    sent = 60
    before = bench.loop._stage._progress

    def go_on(what, share):
        nonlocal sent
        before(what, share)
        stands = bench.desk.stream_state()
        if stands is not None and stands.ahead_s < 0.6 and sent < (until or len(positions)):
            last = sent + block >= len(positions)
            send(bench, sent, positions[sent : sent + block], last)
            sent += block

    bench.loop._stage._progress = go_on
    bench.until(lambda: bench.desk.command(state.key).state in ("done", "failed"))
    bench.loop._stage._progress = before
    bench.loop.step()
    return bench.desk.command(state.key)


def test_a_stream_is_followed_to_its_end(armed):
    positions = wave(300)
    done = streaming(armed, positions)
    assert (done.state, done.stop) == ("done", "FINISHED")
    rows = reference(armed)
    assert np.max(rows["setpoint_position_m"]) == pytest.approx(0.02, abs=1e-5)
    begin = np.flatnonzero(rows["setpoint_position_m"] != 0.0)[0]
    followed = rows["setpoint_position_m"][begin:][: 290 * 10][8::10]
    short = min(followed.size, 285)
    shift = min(range(-12, 12), key=lambda k: abs(rows["setpoint_position_m"][begin + 8 + k + 1000] - positions[101]))
    np.testing.assert_allclose(
        rows["setpoint_position_m"][begin + 8 + shift :: 10][: short - 5], positions[1 : short - 4], atol=2e-6
    )
    assert armed.status.state == "armed"
    with pytest.raises(Unfit, match="set-point 300 comes too late: no stream is under way"):
        send(armed, 300, [0.0])


def test_a_stream_that_starves_brakes_and_holds(armed):
    done = streaming(armed, wave(300), until=140)
    assert (done.state, done.stop) == ("done", Stop.STARVED.name)
    assert "set-points did not come in time" in done.text
    assert "ahead or more" in done.text
    rows = reference(armed)
    assert rows["setpoint_velocity_m_per_s"][-1] == 0.0
    assert np.max(np.abs(rows["setpoint_velocity_m_per_s"])) > 0.005
    assert (armed.status.state, armed.status.fault) == ("armed", None)
    with pytest.raises(Unfit, match="comes too late"):
        send(armed, 140, [0.0])
    assert armed.do("move", messages.Move(target_m=0.0)).stop == "FINISHED"


def test_bad_blocks_are_refused_and_the_stream_goes_on(armed):
    positions = wave(200)
    state = send(armed, 0, positions[:100])
    for first, block, said in (
        (150, [0.0], "set-point 150 is out of order: 100 must come next"),
        (100, [0.1] * 3, r"set-point 99: on the way there .* beyond .*"),
    ):
        with pytest.raises(Unfit, match=said):
            send(armed, first, block)
    with pytest.raises(Unfit, match=r"period_s is 0.02, the stream began with 0.01"):
        armed.desk.take_setpoints(messages.Setpoints(first_number=100, period_s=0.02, position_m=[0.0]), armed.token)
    with pytest.raises(LeaseRefused):
        armed.desk.take_setpoints(messages.Setpoints(first_number=100, period_s=PERIOD_S, position_m=[0.0]), "guessed")
    assert send(armed, 100, positions[100:], last=True).next_number == 200
    armed.until(lambda: armed.desk.command(state.key).state == "done")
    armed.loop.step()
    assert armed.desk.command(state.key).stop == "FINISHED"


def test_a_stream_ends_with_its_client_and_with_a_stop(armed):
    state = send(armed, 0, wave(400)[:300])
    progress = armed.loop._stage._progress
    looks = []

    def then_stop(what, share):
        looks.append(what)
        if len(looks) == 40:
            armed.desk.ask_to_stop("anna")
        progress(what, share)

    armed.loop._stage._progress = then_stop
    armed.until(lambda: armed.desk.command(state.key).state == "done")
    armed.loop._stage._progress = progress
    armed.until(lambda: armed.status.state == "idle")
    armed.loop.step()
    assert armed.desk.command(state.key).stop == Stop.OPERATOR.name


def test_what_was_followed_replays_bit_for_bit(oled_profile, oled_machine, tmp_path):
    backend = BatchBackend(oled_machine, seed=5)
    with Supervisor(oled_profile, backend, tmp_path / "run") as stage:
        home_by_truth(stage, backend.rig.plant_state())
        assert stage.enable() is Stop.NONE
        holds_m = float(stage.status()["setpoint_position_m"])
        body = messages.Scan(segments=[GO(target_m=holds_m + 1e-3), GO(target_m=holds_m)], repeat_count=2)
        assert stage.scan(plans.scanned(body, stage.profile, holds_m).motion).finished
        ahead = [holds_m + x for x in wave(60, 1e-3)]
        first = messages.Setpoints(first_number=0, period_s=PERIOD_S, position_m=ahead, last=True)
        assert stage.follow_stream(plans.streamed(first, stage.profile, holds_m).motion).stop is Stop.FINISHED
    assert replay(tmp_path / "run").exact
    assert read_run(tmp_path / "run").rows.size > 1000
