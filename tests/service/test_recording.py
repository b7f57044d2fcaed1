"""What a session leaves: runs of powered motion, the last seconds before a fault, and no more than it may."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from stagectl.errors import RecordError
from stagectl.flight_recorder import FlightRecorder
from stagectl.left_runs import finish_left_runs
from stagectl.profile import PROFILES_FOLDER
from stagectl.record import MANIFEST, Recorder, Recovery, read_run, recover, recover_orphans
from stagectl.requests import Phase
from stagectl.retention import AGES, KEEP, prune
from stagectl.ring import RingWriter
from stagectl.row import new_rows
from stagectl.run_folder import reserve
from stagectl.runs import list_runs
from stagectl.service import messages
from stagectl.service.desk import Unfit
from tests.service.test_stage_loop import Bench
from tests.small_disk import small_disk
from tests.toml_text import changed

MS_NS = 1_000_000
DAY_S = 86400.0


def rows_from(first: int, count: int) -> np.ndarray:
    rows = new_rows(count)
    rows["cycle"] = np.arange(first, first + count)
    rows["t_ns"] = rows["cycle"] * MS_NS
    return rows


def flight(root: Path, kept_count: int = 100, policy="stop", said=None) -> FlightRecorder:
    def say(event: str, text: str) -> None:
        if said is not None:
            said.append((event, text))

    return FlightRecorder(reserve(root, "session"), {}, lambda name: reserve(root, name), kept_count, policy, say)


def test_only_the_last_rows_are_kept_and_written_when_there_is_a_reason(tmp_path):
    session = flight(tmp_path)
    for first in range(0, 1000, 20):
        session.append(rows_from(first, 20))
    session.event("emergency", 950 * MS_NS, code=3)
    session.append(rows_from(1000, 5))
    saved = session.save_last("fault", "LEASE")
    session.close()
    run = read_run(saved)
    assert run.rows["cycle"].tolist() == list(range(905, 1005))
    assert run.manifest["trigger"] == "LEASE"
    assert [(event["event"], event["row"]) for event in run.events] == [("emergency", 95)]
    assert session.rows_count == 1005
    assert read_run(session.folder).rows.size == 0


def test_a_run_has_what_came_between_its_begin_and_its_end(tmp_path):
    session = flight(tmp_path)
    session.append(rows_from(0, 50))
    session.begin_run("motion", "arm", 50 * MS_NS)
    session.begin_run("another", "request", 50 * MS_NS)  # one is under way already
    session.append(rows_from(50, 300))
    session.event("segment", 350 * MS_NS)
    folder = session.end_run({"stop": "FINISHED"})
    session.append(rows_from(350, 50))
    session.close()
    run = read_run(folder)
    assert run.rows["cycle"].tolist() == list(range(50, 350))
    assert run.manifest["record"]["state"] == "closed"
    assert run.manifest["session"] == session.folder.name
    assert run.events[-1]["row"] == 300
    assert sorted(path.name.split("-")[-1] for path in tmp_path.iterdir()) == ["motion", "session"]


@pytest.mark.parametrize("under_way", [True, False])
def test_what_a_dead_recorder_left_in_the_ring_goes_where_it_belongs(tmp_path, under_way):
    session = flight(tmp_path)
    if under_way:
        session.begin_run("motion", "arm", 0)
    ring_path = tmp_path / "stagectl-test.ring"
    ring = RingWriter(ring_path, 1024, run_folder=session.recovery_folder.absolute())
    for row in rows_from(0, 500):
        ring.write(row.reshape(1))
    session.append(rows_from(0, 300))
    target = session.run_folder if under_way else session.folder
    session.abandon()  # as kill -9 does: what was not flushed is gone
    ring.close()
    recovery = recover(ring_path, session.recovery_folder)
    rows = read_run(target).rows
    assert rows["cycle"].tolist() == list(range(500))
    assert recovery.rows_lost_count == 0


def test_what_a_dead_service_left_is_marked_and_goes_with_the_others(tmp_path):
    """Its session's own folder has no ring; the power takes the ring of a motion; another's run is not touched."""
    root, shared = tmp_path / "runs", tmp_path / "shm"
    shared.mkdir()
    dead, powerless, living, awaited = (flight(root) for _ in range(4))
    for session in (powerless, living, awaited):
        session.begin_run("motion", "arm", 0)
        session.append(rows_from(0, 200))
        session.append(rows_from(200, 50))  # no batch yet
    own = Recorder(root / "own", {})
    ring = RingWriter(shared / "stagectl-a.ring", 1024, run_folder=awaited.recovery_folder.absolute())
    ring.write(rows_from(250, 1))
    ring.close()
    motions = {session.folder: session.run_folder for session in (powerless, living, awaited)}
    for session in (dead, powerless, awaited):
        session.abandon()
    own.abandon()
    outcomes = dict(finish_left_runs(root, shared))
    assert set(outcomes) == {dead.folder, powerless.folder, awaited.folder, motions[powerless.folder]}
    assert finish_left_runs(root, shared) == []
    states = {one.folder: (one.state, one.rows_count) for one in list_runs(root)}
    assert states[dead.folder] == states[powerless.folder] == states[awaited.folder] == ("recovered", 0)
    assert states[motions[powerless.folder]] == ("recovered", 200)
    assert states[motions[living.folder]][0] == states[living.folder][0] == "recording"
    assert states[motions[awaited.folder]][0] == states[own.folder][0] == "crashed"
    run = read_run(motions[powerless.folder])
    assert not run.truncated
    assert run.manifest["record"]["rows_lost_count"] is None
    assert read_run(dead.folder).manifest["record"]["rows_lost_count"] == 0
    ((_, recovery),) = recover_orphans(shared)
    assert recovery == Recovery(1, 0)
    living.close()
    gone = prune(root, 0.0, 1e9, 0.0)
    assert {one.folder for one in gone} == {*states} - {own.folder}


def test_a_run_that_could_not_be_begun_whole_is_none(tmp_path, monkeypatch):
    session = flight(tmp_path)

    def full(folder):
        raise RecordError("no space")

    with monkeypatch.context() as patched:
        patched.setattr(session, "_lead_to", full)
        with pytest.raises(RecordError, match="no space"):
            session.begin_run("motion", "arm", 0)
    assert (session.run_folder, session.trigger) == (None, "")
    session.begin_run("motion", "arm", 0)
    assert session.run_folder is not None
    session.abandon()


@pytest.mark.parametrize("policy", ["stop", "go_on"])
def test_a_full_disk_is_said_at_once_and_does_what_the_profile_says(tmp_path, policy):
    said = []
    with small_disk(tmp_path / "disk", 12 << 20) as disk:
        session = flight(disk, policy=policy, said=said)
        session.begin_run("motion", "arm", 0)

        def fill():
            noise = np.random.default_rng(1)
            for first in range(0, 20_000, 250):
                rows = rows_from(first, 250)
                rows["sensor_bytes"] = noise.integers(0, 256, rows["sensor_bytes"].shape)
                session.append(rows)

        if policy == "stop":
            with pytest.raises(RecordError, match="can't write the run"):
                fill()
            assert session.run_folder is not None
        else:
            fill()
            assert session.run_folder is None
            assert session.rows_count == 20_000
        assert [event for event, _ in said] == ["record_lost"]
        assert "can't write the run" in session.trouble
        session.abandon()
        (folder,) = disk.glob("*-motion")
        assert read_run(folder).rows.size > 1000


def made_run(root: Path, name: str, age_s: float, size_bytes: int = 1000, **manifest) -> Path:
    folder = root / name
    with Recorder(folder, {"kept_by": "service", **manifest}):
        pass
    (folder / "truth.npz").write_bytes(b"x" * size_bytes)
    known = json.loads((root / AGES).read_text()) if (root / AGES).exists() else {}
    (root / AGES).write_text(json.dumps(known | {name: age_s}))
    return folder


def test_the_oldest_go_and_what_must_stay_stays(tmp_path):
    old = made_run(tmp_path, "2026-01-01-a", 40 * DAY_S)
    marked = made_run(tmp_path, "2026-01-01-b", 40 * DAY_S)
    (marked / KEEP).touch()
    others = made_run(tmp_path, "2026-01-01-c", 40 * DAY_S, kept_by="somebody")
    crashed = made_run(tmp_path, "2026-01-01-d", 40 * DAY_S)
    manifest = json.loads((crashed / MANIFEST).read_text())
    manifest["record"]["state"] = "recording"
    (crashed / MANIFEST).write_text(json.dumps(manifest))
    large = [made_run(tmp_path, f"2026-02-0{day}", (10 - day) * DAY_S, 1_000_000) for day in range(1, 5)]
    under_way = Recorder(tmp_path / "2026-01-00-now", {"kept_by": "service"})
    (tmp_path / "notes.txt").write_text("not a run")
    removed = prune(tmp_path, 2.5e6, 30 * DAY_S, 0.0)
    assert [gone.folder for gone in removed] == [old, large[0], large[1]]
    assert "40.0 days old, limit 30" in removed[0].because
    assert "GB, limit" in removed[1].because
    for kept in (marked, others, crashed, *large[2:], under_way.folder, tmp_path / "notes.txt"):
        assert kept.exists()
    under_way.close()
    assert prune(tmp_path / "none", 1.0, 1.0, 1e9) == []


def test_a_run_is_as_old_as_services_were_there_whatever_the_clock_says(tmp_path):
    """Recorded in 1970 on a PC whose battery is empty, then the clock is set."""
    run = made_run(tmp_path, "1970-01-01-a", 0.0)
    os.utime(run / MANIFEST, (0, 0))
    (tmp_path / AGES).unlink()
    assert prune(tmp_path, 1e9, 30 * DAY_S, 1e9) == []  # new to this service, however long that ran before
    assert prune(tmp_path, 1e9, 30 * DAY_S, 20 * DAY_S) == []
    later = made_run(tmp_path, "2026-01-01-b", 0.0)
    (gone,) = prune(tmp_path, 1e9, 30 * DAY_S, 11 * DAY_S)
    assert gone.folder == run
    assert "31.0 days old, limit 30" in gone.because
    (tmp_path / AGES).write_text('{"2026-01-01-b": "of no sense"}')
    assert prune(tmp_path, 1e9, 30 * DAY_S, 40 * DAY_S) == []
    assert later.exists()


@pytest.fixture
def bench(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"record": {"flight_s": 2.0}}))
    made = Bench(tmp_path, profile=str(path))
    made.until(lambda: made.loop._state == "idle")
    made.loop.step()
    yield made
    made.loop.leave()
    made.loop.run()


def runs_of(bench, name: str) -> list[Path]:
    return sorted(bench.settings.runs_root.glob(f"*-service-{name}"))


def test_powered_motion_is_recorded_and_a_fault_while_idle_has_its_last_seconds(bench):
    bench.take()
    assert bench.status.recording.run == ""
    homed = bench.do("home", messages.Home())
    (home,) = runs_of(bench, "home")
    assert Path(homed.run) == home
    armed = bench.do("arm", messages.Arm())
    assert armed.stop == "FINISHED"
    moved = bench.do("move", messages.Move(target_m=0.01))
    assert (bench.status.recording.trigger, Path(moved.run).name) == ("arm", bench.status.recording.run)
    bench.desk.ask_to_stop("test")
    bench.until(lambda: bench.desk.stop_asked is False)
    bench.loop.step()
    assert bench.status.recording.run == ""
    (motion,) = runs_of(bench, "arm")
    run = read_run(motion)
    assert run.manifest["record"]["state"] == "closed"
    assert run.manifest["end"]["stop"] == "OPERATOR"
    assert read_run(home).manifest["end"]["stop"] == "FINISHED"
    assert Phase.TRACKING in run.rows["run_phase"]
    assert "segment" in [event["event"] for event in run.events]
    assert np.all(np.diff(run.rows["cycle"]) == 1)
    bench.desk.ask_to_record("watch")
    for _ in range(20):
        bench.loop.step()
    bench.desk.ask_to_record("")
    bench.loop.step()
    (asked,) = runs_of(bench, "watch")
    assert 100 < read_run(asked).rows.size < 2000


def test_a_lease_that_ran_out_leaves_a_run_that_says_so(bench):
    bench.take()
    bench.do("home", messages.Home())
    bench.do("arm", messages.Arm())
    bench.now_s += 100.0
    bench.until(lambda: bench.status.state == "fault")
    (folder,) = runs_of(bench, "arm")
    end = read_run(folder).manifest["end"]
    assert end["stop"] == "LEASE"
    assert "the lease on motion ran out" in end["text"]


def test_a_servo_that_dies_leaves_all_its_rows_in_the_run(bench):
    bench.take()
    bench.do("home", messages.Home())
    bench.do("arm", messages.Arm())
    link = bench.loop._stage.link
    before = link.pass_time

    def die(duration_s):
        before(duration_s)
        raise RecordError("test: as a servo that is gone")

    link.pass_time = die
    bench.until(lambda: bench.status.state == "fault")
    written = link.rows.written_count
    (folder,) = runs_of(bench, "arm")
    run = read_run(folder)
    assert run.rows["t_ns"][-1] == link.rows.read_last(1)["t_ns"][0]
    assert written > run.rows.size
    assert bench.status.fault.kind == "RecordError"


def test_a_list_of_runs_need_not_read_what_is_just_recorded(tmp_path):
    session = flight(tmp_path)
    session.begin_run("motion", "arm", 0)
    session.append(rows_from(0, 5000))
    session.flush()
    counted = {run.folder.name.split("-")[-1]: run for run in list_runs(tmp_path)}
    assert (counted["motion"].state, counted["motion"].rows_count) == ("recording", 5000)
    quick = {run.folder.name.split("-")[-1]: run for run in list_runs(tmp_path, count_under_way=False)}
    assert (quick["motion"].state, quick["motion"].rows_count) == ("recording", 0)
    session.close()
    closed = {run.folder.name.split("-")[-1]: run for run in list_runs(tmp_path, count_under_way=False)}
    assert (closed["motion"].state, closed["motion"].rows_count) == ("closed", 5000)


def test_a_window_of_the_session_is_a_run_of_its_own(tmp_path):
    session = flight(tmp_path)
    for first in range(0, 300, 20):
        session.append(rows_from(first, 20))
    session.event("emergency", 250 * MS_NS, code=3)
    saved = session.save_window("event", "reversal", 230, 270)
    assert read_run(saved).rows["cycle"].tolist() == list(range(230, 270))
    early = session.save_window("event", "reversal", -50, 210)
    assert read_run(early).rows["cycle"].tolist() == list(range(200, 210))
    assert session.save_window("event", "reversal", 0, 100) is None  # not kept any more
    session.close()


def test_what_is_around_an_event_is_recorded_as_often_as_asked(tmp_path):
    bench = Bench(tmp_path)
    bench.until(lambda: bench.loop._state == "idle")
    bench.loop.step()
    for body, said in (
        (messages.SetTrigger(error_m=1e-3, contact_force_n=1.0), "both given"),
        (messages.SetTrigger(before_s=500.0), r"are 501 s, record.flight_s keeps 30 s"),
    ):
        with pytest.raises(Unfit, match=said):
            bench.desk.set_trigger(body)
    bench.desk.set_trigger(messages.SetTrigger(error_m=1e-3, before_s=0.05, after_s=0.1, count=2, name="late"))
    bench.loop.step()
    assert bench.status.recording.waits_for == "error above 0.001 m, 2 times"
    observe = bench.loop._observe

    def late(rows):
        rows = rows.copy()
        rows["run_phase"] = int(Phase.TRACKING)
        rows["setpoint_position_m"] = 0.0
        rows["end_position_m"] = np.where(rows["cycle"] // 100 % 3 == 1, 2e-3, 0.0)
        observe(rows)

    bench.loop._stage._observe = late
    for _ in range(60):
        bench.loop.step()
    assert bench.status.recording.waits_for == ""
    runs = sorted((tmp_path / "runs").glob("*-service-late*"))
    assert len(runs) == 2
    for folder in runs:
        run = read_run(folder)
        assert run.rows.size == 151
        assert run.rows["cycle"][50] % 300 == 100
        assert run.manifest["trigger"] == "error above 0.001 m"
    bench.loop.leave()
    bench.loop.run()
