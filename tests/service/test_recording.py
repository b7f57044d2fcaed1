"""What a session leaves: runs of powered motion, the last seconds before a fault, and no more than it may."""

import asyncio
import contextlib
import json
import math
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from stagectl.errors import LinkError, RecordError
from stagectl.flight_recorder import FlightRecorder
from stagectl.left_runs import finish_left_runs
from stagectl.profile import PROFILES_FOLDER
from stagectl.record import MANIFEST, Recorder, Recovery, read_run, recover, recover_orphans
from stagectl.requests import Phase
from stagectl.retention import AGES, KEEP, prune
from stagectl.ring import SHARED_MEMORY, RingWriter
from stagectl.row import new_rows
from stagectl.run_folder import reserve
from stagectl.runs import list_runs, run_folders
from stagectl.service import messages
from stagectl.service.desk import Busy, Unfit
from stagectl.service.run_list import RunList
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


def bytes_read() -> int:
    return int(Path("/proc/self/io").read_text().split()[1])  # rchar: asked of the kernel, from the disk or not


def flight(root: Path, kept_count: int = 100, policy="stop", said=None, limit_count=math.inf) -> FlightRecorder:
    def say(event: str, text: str, **fields) -> None:
        if said is not None:
            said.append((event, text))

    return FlightRecorder(
        reserve(root, "session"),
        {"kept_by": "service"},
        lambda name: reserve(root, name),
        kept_count,
        policy,
        say,
        limit_count,
    )


def record_until_it_goes_on(session: FlightRecorder, first: int) -> int:
    """Hand over rows until the run under way is another one; return the first row that was not."""
    folder = session.run_folder
    while session.run_folder == folder:
        session.append(rows_from(first, 20))
        first += 20
        time.sleep(0.001)
    return first


def test_a_long_run_goes_on_in_another_folder_without_a_row_lost(tmp_path):
    said = []
    session = flight(tmp_path, said=said, limit_count=500)
    session.begin_run("motion", "arm", 0)
    folders, end = [session.run_folder], 0
    for _ in range(3):
        end = record_until_it_goes_on(session, end)
        folders.append(session.run_folder)
        assert session.recovery_folder.resolve() == session.run_folder
        assert session.trigger == "arm"
    assert session.end_run({"stop": "FINISHED"}) == folders[-1]
    session.close()
    runs = [read_run(folder) for folder in folders]
    assert np.concatenate([run.rows for run in runs])["cycle"].tolist() == list(range(end))
    assert [run.manifest["record"]["state"] for run in runs] == ["closed"] * 4
    assert all(len(run.rows) >= 500 for run in runs[:3])
    assert [run.manifest.get("continues") for run in runs] == [None, *(folder.name for folder in folders[:3])]
    assert [run.manifest["end"].get("continued_by") for run in runs] == [*(folder.name for folder in folders[1:]), None]
    assert {path for path in tmp_path.iterdir() if path.is_dir()} == {session.folder, *folders}
    assert len(said) == 3


class FullWhileAsked:
    """Makes the folders of a session, or says that the disk is full; counts how often it was asked then."""

    def __init__(self, root: Path):
        self.root, self.full, self.refused_count = root, False, 0

    def __call__(self, name: str) -> Path:
        if self.full:
            self.refused_count += 1
            raise RecordError("no space for a folder")
        return reserve(self.root, name)


def record_past_a_refused_folder(session: FlightRecorder, folders: FullWhileAsked) -> int:
    """Hand over 400 rows of a run that should go on at 100; returns how often that was an error."""
    session.begin_run("motion", "arm", 0)
    folders.full = True
    errors_count = 0
    for first in range(0, 400, 20):
        try:
            session.append(rows_from(first, 20))
        except RecordError:
            errors_count += 1
        session._disk.submit(int).result()  # the thread has tried what it was asked for
    return errors_count


@pytest.mark.parametrize("policy", ["stop", "go_on"])
def test_a_run_that_can_not_go_on_in_another_folder_keeps_all_its_rows(tmp_path, policy):
    """240 of 400 were left, with holes of 20, and each second block made another try."""
    folders, said = FullWhileAsked(tmp_path), []
    session = FlightRecorder(
        reserve(tmp_path, "session"), {}, folders, 100, policy, lambda event, text, **fields: said.append(text), 100
    )
    errors_count = record_past_a_refused_folder(session, folders)
    first = session.run_folder
    assert first is not None
    assert folders.refused_count == 3  # at 100, 200 and 300 rows
    assert errors_count == (3 if policy == "stop" else 0)
    assert "can't go on in another folder, it takes all rows itself: no space for a folder" in session.trouble
    assert len(said) == 1
    folders.full = False
    end = record_until_it_goes_on(session, 400)
    assert session.trouble == ""
    second = session.end_run()
    session.close()
    assert first != second
    rows = np.concatenate([read_run(folder).rows for folder in (first, second)])
    assert rows["cycle"].tolist() == list(range(end))


def test_a_run_that_another_was_to_follow_stands_in_for_it(tmp_path):
    """The client ended its run in mid motion, and there is no room for the motion's own."""
    folders = FullWhileAsked(tmp_path)
    session = FlightRecorder(reserve(tmp_path, "session"), {}, folders, 100, "go_on")
    session.begin_run("asked", "request", 0)
    folders.full = True
    session.go_on_as("arm", "arm", {"stop": "OPERATOR"})
    session._disk.submit(int).result()
    session.append(rows_from(0, 50))
    assert (session.trigger, session.trigger_soon) == ("arm", "arm")
    run = session.end_run({"stop": "FINISHED"})
    session.close()
    assert read_run(run).rows["cycle"].tolist() == list(range(50))


def test_a_folder_that_no_run_could_be_begun_in_goes_again(tmp_path):
    with small_disk(tmp_path / "disk") as disk:
        session = flight(disk, policy="go_on")
        (disk / "others").write_bytes(bytes(1 << 20))  # what is left is less than a run keeps free
        session.begin_run("motion", "arm", 0)
        session.go_on_as("asked", "request")
        session._disk.submit(int).result()
        assert "can't begin a run" in session.trouble
        session.close()
        assert [path for path in disk.iterdir() if path.is_dir()] == [session.folder]


def test_an_event_that_the_session_has_no_room_for_is_in_the_run(tmp_path):
    with small_disk(tmp_path / "disk", 12 << 20) as disk:
        session = flight(disk)
        session.begin_run("motion", "arm", 0)
        room = os.statvfs(disk)
        (disk / "others").write_bytes(bytes(room.f_bavail * room.f_frsize))
        last = 0
        with contextlib.suppress(RecordError):
            while last < 1000:
                last += 1
                session.event("news", 0, number=last)
        assert "can't write the run" in session.trouble
        run = session.run_folder
        session.abandon()
        assert read_run(session.folder).events[-1]["number"] == last
        assert read_run(run).events[-1]["number"] == last


def test_a_service_that_dies_as_a_run_goes_on_loses_and_doubles_no_row(tmp_path):
    session = flight(tmp_path, limit_count=500)
    session.begin_run("motion", "arm", 0)
    first = session.run_folder
    ring_path = tmp_path / "stagectl-test.ring"
    ring = RingWriter(ring_path, 8192, run_folder=session.recovery_folder.absolute())
    end = record_until_it_goes_on(session, 0)  # the new run has its first rows in memory only
    for row in rows_from(0, end + 30):
        ring.write(row.reshape(1))
    second = session.run_folder
    session.abandon()
    ring.close()
    recover(ring_path, session.recovery_folder)
    finish_left_runs(tmp_path, tmp_path)
    rows = np.concatenate([read_run(folder).rows for folder in (first, second)])
    assert rows["cycle"].tolist() == list(range(end + 30))


def test_a_run_that_ends_before_it_goes_on_leaves_no_empty_one(tmp_path):
    session = flight(tmp_path, limit_count=500)
    session.begin_run("motion", "arm", 0)
    folder = session.run_folder
    session.append(rows_from(0, 500))
    session.append(rows_from(500, 10))  # asks for the next
    session.end_run({"stop": "FINISHED"})
    session.close()
    assert {path for path in tmp_path.iterdir() if path.is_dir()} >= {session.folder, folder}
    with_rows = [read_run(path).rows for path in sorted(tmp_path.glob("*-motion*"))]
    assert all(len(rows) for rows in with_rows)
    assert np.concatenate(with_rows)["cycle"].tolist() == list(range(510))


def test_only_the_last_rows_are_kept_and_written_when_there_is_a_reason(tmp_path):
    session = flight(tmp_path)
    for first in range(0, 1000, 20):
        session.append(rows_from(first, 20))
    session.event("emergency", 950 * MS_NS, code=3)
    session.append(rows_from(1000, 5))
    session.save_last("fault", "LEASE", "the last")
    session.close()
    run = read_run(*tmp_path.glob("*-fault"))
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
    assert (states[motions[living.folder]][0], states[living.folder][0]) == ("recording", "session")
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


@pytest.mark.parametrize(
    ("record", "made", "gone", "because"),
    [
        (
            {"size_limit_bytes": 2_000_000},
            {"2026-01-01-oldest": (50.0, 900_000), "2026-01-01-old": (40.0, 900_000), "2026-01-01-new": (1.0, 900_000)},
            "2026-01-01-oldest",
            "all runs of the service take 0.003 GB, limit 0.002",
        ),
        (
            {"age_limit_s": DAY_S},
            {"2026-01-01-old": (2.0 * DAY_S, 1000), "2026-01-01-new": (0.5 * DAY_S, 1000)},
            "2026-01-01-old",
            "2.0 days old, limit 1",
        ),
    ],
    ids=["size", "age"],
)
def test_the_service_keeps_its_runs_within_the_profile_s_limits_and_says_what_it_removes(
    tmp_path, record, made, gone, because
):
    path = tmp_path / "mine.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"record": record}))
    bench = Bench(tmp_path, profile=str(path))
    root = bench.settings.runs_root
    for name, (age_s, size_bytes) in made.items():
        made_run(root, name, age_s, size_bytes)
    bench.until(lambda: bench.loop._state == "idle")
    assert {folder.name for folder in root.glob("2026-01-01-*")} == set(made)
    working = threading.Thread(target=bench.loop.run)
    working.start()

    def said():
        return [entry for entry in bench.log.last(1000) if entry.event == "run_removed"]

    try:
        give_up_s = time.monotonic() + 20.0
        while not said() and time.monotonic() < give_up_s:
            time.sleep(0.01)
    finally:
        bench.loop.leave()
        working.join(60.0)
    assert [(entry.text, entry.fields) for entry in said()] == [(because, {"run": gone})]
    assert {folder.name for folder in root.glob("2026-01-01-*")} == set(made) - {gone}


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


@pytest.mark.parametrize("when", ["armed", "always"])
@pytest.mark.parametrize("full", ["of bytes", "of folders"])
def test_on_a_disk_that_is_full_already_motion_goes_on_where_the_profile_says_so(tmp_path, when, full):
    record = {"when": when, "on_full_disk": "go_on"}
    path = tmp_path / "mine.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"record": record}))
    with small_disk(tmp_path / "runs") as disk:
        (disk / "others").write_bytes(bytes(4 << 20))
        place = tmp_path
        if full == "of folders":  # none can be made in what is a file
            place = tmp_path / "bench"
            place.mkdir()
            (place / "runs").symlink_to(disk / "others")
        made = Bench(place, profile=str(path))
        made.until(lambda: made.loop._state == "idle")
        made.loop.step()
        assert "can't begin a run" in made.status.recording.trouble
        made.take()
        assert made.do("home", messages.Home()).stop == "FINISHED"
        assert made.do("arm", messages.Arm()).stop == "FINISHED"
        assert made.do("move", messages.Move(target_m=0.01)).stop == "FINISHED"
        assert [path.name for path in disk.iterdir() if path.is_file()] == ["others"]
        made.loop.leave()
        made.loop.run()


@pytest.mark.parametrize("when", ["armed", "always"])
def test_on_a_disk_that_is_full_already_nothing_opens_where_the_profile_says_stop(tmp_path, when):
    path = tmp_path / "mine.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"record": {"when": when}}))
    with small_disk(tmp_path / "runs") as disk:
        (disk / "others").write_bytes(bytes(4 << 20))
        made = Bench(tmp_path, profile=str(path))
        made.until(lambda: made.loop._state == "fault")
        made.loop.step()
        assert "can't begin a run" in made.status.fault.values
        made.loop.leave()
        made.loop.run()


def test_a_session_that_is_recorded_always_is_one_run_and_stops_or_goes_on_as_the_profile_says(tmp_path):
    path = tmp_path / "mine.toml"
    record = {"when": "always", "on_full_disk": "go_on"}
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"record": record}))
    with small_disk(tmp_path / "runs", 24 << 20) as disk:
        made = Bench(tmp_path, profile=str(path))
        made.until(lambda: made.loop._state == "idle")
        made.loop.step()
        (folder,) = disk.glob("*-service-always")
        assert (made.status.recording.trigger, made.status.recording.run) == ("always", folder.name)
        with pytest.raises(Busy, match=f"name mine: {folder.name} is under way, begun by always; it has the rows"):
            made.desk.ask_to_record("mine")
        made.take()
        assert made.do("home", messages.Home()).stop == "FINISHED"
        room = os.statvfs(disk)
        (disk / "others").write_bytes(bytes(room.f_bavail * room.f_frsize))
        assert made.do("arm", messages.Arm()).stop == "FINISHED"
        made.until(lambda: made.status.recording.trouble)
        assert made.do("move", messages.Move(target_m=0.01)).stop == "FINISHED"
        made.loop.leave()
        made.loop.run()
        run = read_run(folder)
        assert run.snapshot  # and so it can be replayed
        assert np.all(np.diff(run.rows["cycle"]) == 1)


def test_a_run_asked_for_that_the_session_s_end_comes_before_is_said(tmp_path):
    """Its client was told that it begins behind the motion's."""
    made = Bench(tmp_path)
    made.hold_as_homed_by_truth()
    made.desk.ask_to_record("later")
    made.loop.step()
    made.loop.step()
    assert (made.status.recording.trigger, made.status.recording.next_name) == ("arm", "later")
    made.loop.leave()
    made.loop.run()
    lost = ["later: asked for, and the session ended before it began"]
    said = [entry.text for entry in made.log.last(100) if entry.event == "record_lost"]
    assert said == (lost if runs_of(made, "later") == [] else [])


def test_a_run_asked_for_behind_a_motion_whose_session_breaks_is_said(tmp_path):
    made = Bench(tmp_path)
    made.hold_as_homed_by_truth()
    made.desk.ask_to_record("later")
    made.loop.step()
    made.loop._close_stage()
    said = [entry.text for entry in made.log.last(100) if entry.event == "record_lost"]
    assert said == ["later: asked for, and the session ended before it began"]


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
    bench.until(lambda: bench.status.recording.run != "")  # a thread makes its folder
    for _ in range(20):
        bench.loop.step()
    bench.desk.ask_to_record("")
    bench.until(lambda: bench.status.recording.run == "")
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
    quickly = RunList(tmp_path)
    counted = {run.folder.name.split("-")[-1]: run for run in list_runs(tmp_path)}
    assert (counted["motion"].state, counted["motion"].rows_count) == ("recording", 5000)
    quick = {run.folder.name.split("-")[-1]: run for run in asyncio.run(quickly.summaries())}
    assert (quick["motion"].state, quick["motion"].rows_count) == ("recording", 0)
    session.close()
    closed = {run.folder.name.split("-")[-1]: run for run in asyncio.run(quickly.summaries())}
    assert (closed["motion"].state, closed["motion"].rows_count) == ("closed", 5000)


def test_however_many_ask_for_the_runs_each_is_read_once(tmp_path):
    for number in range(80):
        made_run(tmp_path, f"2026-01-{number:03d}", 0.0, about="x" * 50_000)
    quickly = RunList(tmp_path)

    async def ask(count: int):
        return await asyncio.gather(*(quickly.summaries() for _ in range(count)))

    before = bytes_read()
    asked = asyncio.run(ask(8))
    assert bytes_read() - before < 2 * sum(path.stat().st_size for path in tmp_path.glob("*/manifest.json"))
    assert all(len(one) == 80 for one in asked)
    ((before, *_),) = asyncio.run(ask(1))
    manifest = json.loads((before.folder / MANIFEST).read_text())
    manifest["end"] = {"stop": "LEASE"}
    (before.folder / MANIFEST).write_text(json.dumps(manifest))
    ((after, *_),) = asyncio.run(ask(1))
    assert (before.stop, after.stop) == ("", "LEASE")


def test_a_run_that_its_recorder_left_is_counted_once_and_listed_as_crashed(tmp_path):
    quickly = RunList(tmp_path)
    session = flight(tmp_path)
    session.begin_run("motion", "arm", 0)
    session.append(rows_from(0, 5000))
    session.flush()
    assert [run.state for run in asyncio.run(quickly.summaries())] == ["recording", "session"]
    session.abandon()
    crashed = {run.folder.name.split("-")[-1]: run for run in asyncio.run(quickly.summaries())}
    assert (crashed["motion"].state, crashed["motion"].rows_count) == ("crashed", 5000)
    before = bytes_read()
    assert len(asyncio.run(quickly.summaries())) == 2
    assert bytes_read() - before < 1000


def test_a_window_of_the_session_is_a_run_of_its_own(tmp_path):
    said = []
    session = flight(tmp_path, said=said)
    for first in range(0, 300, 20):
        session.append(rows_from(first, 20))
    session.event("emergency", 250 * MS_NS, code=3)
    session.save_window("event", "reversal", "around", 230, 270)
    session.save_window("early", "reversal", "around", -50, 210)
    session.save_window("gone", "reversal", "around", 0, 100)  # not kept any more
    session.close()
    cycles = {folder.name.split("-")[-1]: read_run(folder).rows["cycle"].tolist() for folder in run_folders(tmp_path)}
    assert cycles == {"session": [], "event": list(range(230, 270)), "early": list(range(200, 210))}
    assert said == [("run", "around")] * 2


def test_rows_of_a_window_are_not_written_to_before_they_are_saved(tmp_path):
    """Here the disk takes none before the session has gone on for several times what is kept."""
    session, disk_works = flight(tmp_path, kept_count=3000), threading.Event()
    session.append(rows_from(0, 3500))
    session._disk.submit(disk_works.wait)
    session.save_window("event", "reversal", "around", 600, 3400)
    for first in range(3500, 20_000, 50):
        session.append(rows_from(first, 50))
    disk_works.set()
    session.close()
    (folder,) = tmp_path.glob("*-event")
    assert read_run(folder).rows["cycle"].tolist() == list(range(600, 3400))


def test_the_last_rows_are_kept_in_the_same_memory_all_the_time(tmp_path):
    session, blocks = flight(tmp_path, kept_count=3000), {}
    for first in range(0, 30_000, 50):
        session.append(rows_from(first, 50))
        blocks |= {id(block): block for block in session._last._blocks}  # held: another would have another place
        if first == 5000:
            session.save_last("asked", "request", "the last")
            session._disk.submit(int).result()
    assert len(blocks) <= 5
    session.close()


def test_nothing_waits_for_the_disk_while_the_stage_moves(tmp_path, monkeypatch):
    """Windows, runs on request and their ends: the stage's thread has a lease to renew meanwhile."""
    slow, moves = threading.Event(), threading.Event()
    fsync = os.fsync

    def slowly(descriptor):
        slow.set()
        assert moves.wait(20.0), "the stage's thread waits for the disk"
        fsync(descriptor)

    session = flight(tmp_path)
    session.append(rows_from(0, 100))
    monkeypatch.setattr(os, "fsync", slowly)
    session.save_last("fault", "LEASE", "the last")
    assert slow.wait(20.0)
    session.go_on_as("asked", "request")
    session.append(rows_from(100, 50))
    assert session.run_folder is None  # its folder is not there yet
    moves.set()
    first = record_until_it_goes_on(session, 150)
    assert session.trigger == "request"
    moves.clear()
    session.go_on_as("arm", "arm", {"stop": "OPERATOR"})
    session.append(rows_from(first, 50))
    moves.set()
    end = record_until_it_goes_on(session, first + 50)
    assert session.trigger == "arm"
    session.close()
    (last,), (asked,), (armed,) = (tmp_path.glob(f"*-{name}") for name in ("fault", "asked", "arm"))
    assert read_run(last).rows["cycle"].tolist() == list(range(100))
    cycles = np.concatenate([read_run(asked).rows, read_run(armed).rows])["cycle"].tolist()
    assert cycles == list(range(cycles[0], end))
    assert read_run(asked).manifest["end"] == {"stop": "OPERATOR", "continued_by": armed.name}


def test_a_disk_that_is_full_and_slow_holds_up_no_motion_that_goes_on(tmp_path, monkeypatch):
    """Letting go of a run syncs its files twice: the servo stopped with SUPERVISOR_SILENT meanwhile."""
    moves = threading.Event()
    fsync, fdatasync = os.fsync, os.fdatasync

    def slowly(really):
        def sync(descriptor):
            assert moves.wait(5.0), "the stage's thread waits for the disk"
            really(descriptor)

        return sync

    with small_disk(tmp_path / "disk", 12 << 20) as disk:
        session = flight(disk, policy="go_on")
        session.begin_run("motion", "arm", 0)
        folder = session.run_folder
        (disk / "others").write_bytes(bytes(5 << 20))
        monkeypatch.setattr(os, "fsync", slowly(fsync))
        monkeypatch.setattr(os, "fdatasync", slowly(fdatasync))
        session.go_on_as("asked", "request")  # not made when the disk is full, and to be removed
        noise, first = np.random.default_rng(1), 0
        began_s = time.monotonic()
        while session.run_folder is not None:
            rows = rows_from(first, 250)
            rows["sensor_bytes"] = noise.integers(0, 256, rows["sensor_bytes"].shape)
            session.append(rows)
            first += 250
        assert "can't write the run" in session.trouble
        assert time.monotonic() - began_s < 2.0
        moves.set()
        session.close()
        assert read_run(folder).rows.size > 1000
        assert {path for path in disk.iterdir() if path.is_dir()} == {session.folder, folder}


def test_a_run_that_is_not_wanted_any_more_is_removed_without_a_wait(tmp_path, monkeypatch):
    moves = threading.Event()
    fsync = os.fsync

    def slowly(descriptor):
        assert moves.wait(5.0), "the stage's thread waits for the disk"
        fsync(descriptor)

    session = flight(tmp_path)
    session.go_on_as("asked", "request")
    session._disk.submit(int).result()  # it is there, and has no rows yet
    monkeypatch.setattr(os, "fsync", slowly)
    began_s = time.monotonic()
    session.go_on_as("arm", "arm")
    assert time.monotonic() - began_s < 2.0
    moves.set()
    session.close()
    assert run_folders(tmp_path) == [session.folder]


def test_a_run_that_filled_the_disk_can_be_removed_while_its_session_lasts(tmp_path):
    with small_disk(tmp_path / "disk", 12 << 20) as disk:
        session = flight(disk, policy="go_on")
        session.begin_run("motion", "arm", 0)
        folder, first = session.run_folder, 0
        while session.run_folder is not None:
            session.append(rows_from(first, 250))
            first += 250
            if first == 2000:
                room = os.statvfs(disk)
                (disk / "others").write_bytes(bytes(room.f_bavail * room.f_frsize))
        session._disk.submit(int).result()
        assert read_run(folder).manifest["record"]["state"] == "recovered"
        assert session.recovery_folder.resolve() == session.folder  # a dead servo's rows go into no run that may go
        assert [gone.folder for gone in prune(disk, 0.0, 1e9, 0.0)] == [folder]
        (disk / "others").unlink()
        session.begin_run("motion", "arm", 0)
        assert session.trouble == ""
        session.close()


def test_what_a_full_disk_left_is_saved_when_the_stage_is_opened_again(bench):
    """Not only when the service starts again, which may be in months."""
    root = bench.settings.runs_root
    left, unheld, living = (flight(root) for _ in range(3))
    rings = [SHARED_MEMORY / f"stagectl-{os.getpid()}-{time.monotonic_ns()}-{name}.ring" for name in ("left", "living")]
    writers = []
    for session, path in zip((left, living), rings, strict=True):
        session.begin_run("motion", "arm", 0)
        writers.append(RingWriter(path, 1024, run_folder=session.recovery_folder.absolute()))
        for row in rows_from(0, 300):
            writers[-1].write(row.reshape(1))
    unheld.begin_run("motion", "arm", 0)
    gone = SHARED_MEMORY / f"stagectl-{os.getpid()}-{time.monotonic_ns()}-gone.ring"
    RingWriter(gone, 16, run_folder=root.absolute() / "removed").close()
    runs = [session.run_folder for session in (left, unheld, living)]
    try:
        for session in (left, unheld):
            session.abandon()
        writers[0].close()
        bench.loop.reread()
        bench.loop.step()
        bench.until(lambda: bench.loop._state == "idle")
        bench.loop.reread()
        bench.loop.step()
        bench.until(lambda: bench.loop._state == "idle")
        assert read_run(runs[0]).rows["cycle"].tolist() == list(range(300))
        assert [read_run(run).manifest["record"]["state"] for run in runs] == ["recovered", "recovered", "recording"]
        assert [path.exists() for path in rings] == [False, True]
        entries = bench.log.last(1000)
        assert [entry.fields["place"] for entry in entries if entry.event == "not_recovered"] == [str(gone)]  # once
    finally:
        for path in (*rings, gone):
            path.unlink(missing_ok=True)
    living.abandon()
    writers[1].close()


def test_a_service_that_ends_while_it_saves_what_was_left_opens_nothing(tmp_path, monkeypatch):
    made = Bench(tmp_path)
    monkeypatch.setattr(made.loop._recording, "save_left", made.loop.leave)  # as a SIGTERM meanwhile
    made.loop.run()
    assert not made.settings.runs_root.exists()


def test_a_run_is_not_asked_for_where_there_is_no_session(bench):
    bench.loop._break(RecordError("test"))
    assert bench.status.state == "fault"
    for name in ("watch", ""):
        with pytest.raises(Busy, match="nothing to record: the stage is not connected"):
            bench.desk.ask_to_record(name)


@pytest.mark.parametrize("end", ["service", "session", "servo"])
def test_an_event_whose_window_the_end_of_the_session_cuts_is_saved_as_far_as_it_goes(bench, end):
    bench.desk.set_trigger(messages.SetTrigger(error_m=1e-3, before_s=0.05, after_s=1.5, count=2, name="late"))
    bench.loop.step()
    observe = bench.loop._observe
    first = []

    def late(rows):
        rows = rows.copy()
        first.extend(rows["cycle"][:1] if not first else ())
        rows["run_phase"] = int(Phase.TRACKING)
        rows["setpoint_position_m"] = 0.0
        rows["end_position_m"] = np.where(rows["cycle"] >= first[0] + 10, 2e-3, 0.0)
        observe(rows)

    stage = bench.loop._stage
    link = stage.link
    stage._observe = late
    bench.loop.step()
    bench.loop.step()
    assert runs_of(bench, "late") == []
    if end == "service":
        bench.loop.leave()
        bench.loop.run()
    elif end == "session":
        bench.loop.reread()
        bench.loop.step()
    else:
        bench.loop._break(LinkError("test: as a servo that is gone"))
    (folder,) = runs_of(bench, "late")
    run = read_run(folder)
    assert run.manifest["record"]["state"] == "closed"
    assert run.rows["cycle"][50] == first[0] + 10
    assert run.rows["t_ns"][-1] == link.rows.read_last(1)["t_ns"][0]
    assert bench.loop._recording._left_count == 1


def test_a_run_that_was_asked_for_ends_also_before_it_is_there(tmp_path):
    session = flight(tmp_path)
    session.go_on_as("asked", "request")
    session.end_run()
    for first in range(0, 100, 10):
        session.append(rows_from(first, 10))
    session.close()
    assert [folder.name for folder in run_folders(tmp_path)] == [session.folder.name]


def test_a_run_that_was_ended_does_not_go_on_because_it_is_long(tmp_path):
    session = flight(tmp_path, limit_count=500)
    session.go_on_as("asked", "request")
    first = record_until_it_goes_on(session, 0)
    session.append(rows_from(first, 500))
    session.go_on_as("arm", "arm", {"stop": "OPERATOR"})
    end = record_until_it_goes_on(session, first + 500)
    assert session.trigger == "arm"
    session.close()
    assert read_run(*tmp_path.glob("*-arm")).rows["cycle"][-1] == end - 1


def slow_folders(bench, monkeypatch) -> threading.Event:
    """Have the thread that makes folders wait until what is returned is set."""
    made = threading.Event()
    reserve_now = bench.loop._recording._recorder._reserve

    def slowly(name):
        assert made.wait(20.0), "the stage's thread waits for the disk"
        return reserve_now(name)

    monkeypatch.setattr(bench.loop._recording._recorder, "_reserve", slowly)
    return made


def disarm(bench) -> None:
    bench.desk.ask_to_stop("test")
    bench.until(lambda: bench.desk.stop_asked is False)
    bench.loop.step()
    assert bench.status.state == "idle"


def test_a_run_that_is_ended_as_the_motion_ends_does_not_go_on_at_rest(bench, monkeypatch):
    bench.take()
    bench.do("home", messages.Home())
    bench.desk.ask_to_record("watch")
    bench.until(lambda: bench.status.recording.run != "")
    bench.do("arm", messages.Arm())
    made = slow_folders(bench, monkeypatch)
    bench.desk.ask_to_record("")
    bench.loop.step()
    disarm(bench)
    made.set()
    for _ in range(50):
        bench.loop.step()
        time.sleep(0.001)
    assert (bench.status.recording.run, bench.status.recording.trigger) == ("", "")
    (asked,) = runs_of(bench, "watch")
    assert read_run(asked).manifest["record"]["state"] == "closed"
    assert runs_of(bench, "arm") == []


@pytest.mark.parametrize("ended_before", [False, True])
def test_a_run_that_is_asked_for_in_a_motion_begins_behind_it(bench, ended_before):
    bench.take()
    bench.do("home", messages.Home())
    bench.do("arm", messages.Arm())
    bench.desk.ask_to_record("watch")
    bench.loop.step()
    assert bench.status.recording.trigger == "arm"
    if ended_before:
        bench.desk.ask_to_record("")
        bench.loop.step()
    disarm(bench)
    if ended_before:
        assert bench.status.recording.run == ""
        assert runs_of(bench, "watch") == []
        return
    bench.until(lambda: bench.status.recording.trigger == "request")
    bench.loop.step()
    bench.desk.ask_to_record("")
    bench.until(lambda: bench.status.recording.run == "")
    (asked,), (motion,) = runs_of(bench, "watch"), runs_of(bench, "arm")
    cycles = np.concatenate([read_run(motion).rows, read_run(asked).rows])["cycle"]
    assert np.all(np.diff(cycles) == 1)
    assert read_run(motion).manifest["end"]["stop"] == "OPERATOR"


def test_an_arming_finds_the_run_that_was_asked_for(tmp_path):
    session = flight(tmp_path)
    session.go_on_as("asked", "request")
    session.begin_run("arm", "arm", 0)
    session.append(rows_from(0, 10))
    assert session.trigger == "request"
    session.close()
    (asked,) = tmp_path.glob("*-asked")
    assert read_run(asked).rows["cycle"].tolist() == list(range(10))


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
