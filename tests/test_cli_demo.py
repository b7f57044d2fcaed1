"""The demo as a command: its run from command to report and replay, and a motion in it that the guard ends."""

import html
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim_backend.faults import Fault
from sim_backend.machine import load_machine
from stagectl import demo
from stagectl.backend import BatchBackend
from stagectl.errors import DriveError
from stagectl.profile import load_profile
from stagectl.record import read_manifest, read_run
from stagectl.run_page import page, scores_of
from stagectl.run_scores import read_truth, score_backlash, segments
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from stagectl.trajectory import trapezoid
from tests.command import call, call_json
from tests.stage import with_values


@pytest.fixture(scope="module")
def demo_run(tmp_path_factory):
    """The whole demo over the wire in virtual time, once for all tests that look at its run."""
    runs = tmp_path_factory.mktemp("runs")
    process = subprocess.run(
        [sys.executable, "-m", "stagectl.cli", "demo", "--backend", "batch", "--runs", str(runs), "--json"],
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout), process.stderr


def test_the_demo_finishes_and_names_run_and_report(demo_run):
    answer, err = demo_run
    assert (answer["stop"], answer["finished"]) == ("FINISHED", True)
    assert answer["text"] == "trapezoid under dsmc: the reference came to its end"
    assert answer["repeated"] == []
    page = Path(answer["report"]).read_text(encoding="utf-8")
    for title in ("Tracking error", "Holding still", "The joint, identified", "Identification", "Timing"):
        assert f". {title}" in page
    assert page.count("<svg") == 5
    assert "identifying the backlash" in err


def test_the_demo_scores_both_laws_by_the_true_position(demo_run):
    pid, dsmc = demo_run[0]["motions"]
    assert (pid["law"], dsmc["law"]) == ("pid", "dsmc")
    # Two-sided: better than this would mean that something is not measured any more.
    assert 10e-9 < dsmc["true"]["max_m"] < 100e-9
    assert 100e-9 < pid["true"]["max_m"] < 1e-6
    for motion in (pid, dsmc):
        assert 2e-9 < motion["true"]["settled_rms_m"] < 12e-9
        # The interferometer adds its own 5 nm.
        added = motion["measured"]["settled_rms_m"] ** 2 - motion["true"]["settled_rms_m"] ** 2
        assert 3e-9**2 < added < 8e-9**2
        assert motion["settling"]["time_s"] < 0.2


def test_the_demo_sets_identified_against_true(demo_run):
    found = demo_run[0]["backlash"]
    for side in ("left", "right"):
        assert abs(found[f"{side}_edge_m"] - found[f"{side}_edge_true_m"]) < 0.5e-6
        assert found[f"{side}_stiffness_n_per_m"] == pytest.approx(found[f"{side}_stiffness_true_n_per_m"], rel=0.02)
        assert 0.0 < found[f"{side}_edge_sd_m"] < 0.2e-6
    joint = load_machine("oled-printer").backlash
    assert found["width_true_m"] == pytest.approx(joint.left_m + joint.right_m, rel=1e-9)
    # In the run's own zero the edges are elsewhere than in the machine's frame.
    assert abs(found["left_edge_true_m"] - joint.left_m) > 0.5e-6


def test_the_demo_times_sample_to_sync(demo_run):
    cycle = demo_run[0]["cycle"]
    assert cycle["is_virtual"]
    assert cycle["missed_count"] == 0
    assert 0.4e6 < cycle["sample_to_sync_ns"]["p50"] < 0.6e6
    assert cycle["sync_jitter_rms_s"] < 20e-6


def test_what_the_demo_recorded_replays_bit_for_bit(capsys, demo_run):
    code, answer, _ = call_json(capsys, "replay", demo_run[0]["run"])
    assert code == 0
    assert answer["exact"]
    assert answer["ticks"] > 30_000


def test_a_replay_that_differs_is_1(capsys, demo_run, tmp_path):
    source, copy = Path(demo_run[0]["run"]), tmp_path / "changed"
    copy.mkdir()
    for name in ("manifest.json", "events.jsonl", "snapshot.npz", "samples.arrow"):
        (copy / name).write_bytes((source / name).read_bytes())
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["profile"]["control"]["micro_bandwidth_hz"] += 1.0
    (copy / "manifest.json").write_text(json.dumps(manifest))
    code, answer, _ = call_json(capsys, "replay", copy)
    assert code == answer["exit_code"] == 1
    assert not answer["exact"]
    assert answer["first_difference"]


def test_runs_are_listed_shown_exported_and_plotted(capsys, demo_run, tmp_path):
    run = Path(demo_run[0]["run"])
    code, answer, _ = call_json(capsys, "runs", "list", "--runs", run.parent)
    assert code == 0
    assert [one["folder"] for one in answer["runs"]] == [str(run)]
    assert answer["runs"][0]["state"] == "closed"
    code, shown, _ = call_json(capsys, "runs", "show", "latest", "--runs", run.parent)
    assert code == 0
    assert shown["scores"]["motions"] == demo_run[0]["motions"]
    file = tmp_path / "part.csv"
    code, _, _ = call_json(
        capsys, "runs", "export", run.name, "--runs", run.parent, "--columns", "t_ns,end_position_m", "--out", file
    )
    assert code == 0
    assert file.read_text().partition("\n")[0] == "t_ns,end_position_m"
    code, answer, _ = call_json(capsys, "runs", "plot", run, "--out", tmp_path / "figures")
    assert code == 0
    assert len(answer["files"]) == 5
    assert all(Path(one).read_bytes().startswith(b"\x89PNG") for one in answer["files"])


def test_people_get_tables(capsys, demo_run):
    code, out, _ = call(capsys, "runs", "show", demo_run[0]["run"])
    assert code == 0
    for text in ("Tracking: trapezoid", "PID", "DSMC", "true, max", "left stiffness", "sensor sample to end of SYNC"):
        assert text in out
    assert "…" not in out  # nothing cut off at 80 columns


def test_without_the_truth_only_the_measured_is_scored(demo_run):
    run = read_run(Path(demo_run[0]["run"]))
    scores = scores_of(run, None)
    assert all(motion.true is None and motion.measured.max_m > 0.0 for motion in scores.motions)
    backlash = score_backlash(run, None)
    assert backlash is not None
    assert all(edge.true is None for edge in backlash.edges)


def test_the_contact_forces_in_the_figure_lie_on_the_true_law(demo_run):
    from stagectl.run_page import _contact_points

    run = read_run(Path(demo_run[0]["run"]))
    score = score_backlash(run, read_truth(run.folder))
    offset_m, force_n = _contact_points(run, score)
    left_m, right_m = (score.edge(f"{side} edge").true for side in ("left", "right"))
    free = (offset_m > -left_m + 20e-6) & (offset_m < right_m - 20e-6)
    assert np.sqrt(np.mean(force_n[free] ** 2)) < 0.03
    pressed = offset_m > right_m + 100e-6
    stiffness = score.edge("right stiffness").true
    mean_n = np.mean(stiffness * (offset_m[pressed] - right_m))
    assert np.mean(force_n[pressed]) == pytest.approx(mean_n, rel=0.03)  # masses are 1 % off


# ---- a motion that the guard ends ---------------------------------------------------------------------------------


def driven_with(faults, folder, **options):
    """Drive a short demo in virtual time; returns what was driven, what was said, and the run."""
    profile = load_profile("oled-printer")
    said = []
    with Supervisor(profile, BatchBackend(load_machine("oled-printer"), seed=1, faults=faults), folder) as stage:
        plan = trapezoid(0.05, 0.1, dwell_s=0.3, start_m=0.0, lead_s=0.3)
        driven = demo.drive(stage, plan, ("dsmc",), identify_s=4.0, say=said.append, **options)
    return driven, said, read_run(folder)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """The short demo without a fault; tells when its trapezoid runs."""
    return driven_with((), tmp_path_factory.mktemp("clean") / "run")


def seconds_into(run, name):
    """Virtual time in the middle of a motion."""
    segment = next(one for one in segments(run) if one.name == name)
    return float(run.rows["t_ns"][segment.first_row + segment.rows_count // 2]) * 1e-9


def test_a_motion_that_the_guard_ended_is_said_and_repeated_once(clean, tmp_path):
    driven, said, run = clean
    assert driven.stop is Stop.FINISHED
    assert (driven.trips, said) == ((), [])
    at_s = seconds_into(run, "trapezoid under dsmc")
    fault = Fault("sensor_silence", at_s=at_s, duration_s=0.03)
    driven, said, run = driven_with((fault,), tmp_path / "run")
    assert [trip.stop for trip in driven.trips] == [Stop.SENSOR_AGE]
    assert len(said) == 1
    assert "no valid interferometer sample" in said[0]
    assert driven.stop is Stop.FINISHED
    ends = [one.stop for one in segments(run) if one.name == "trapezoid under dsmc"]
    assert ends == [Stop.SENSOR_AGE, Stop.FINISHED]
    scores = scores_of(run, None)
    assert len(scores.motions) == 1  # the repetition
    (early,) = scores.ended_early
    assert early == driven.trips[0].text
    assert re.search(r"newest sample \d+ is \d+\.\d ms old, limit \d+ ms; check beams", early)


def test_what_fails_twice_ends_the_demo_and_is_read_back_with_its_numbers(capsys, clean, tmp_path):
    at_s = seconds_into(clean[2], "trapezoid under dsmc")
    fault = Fault("sensor_silence", at_s=at_s)  # for good
    driven, said, run = driven_with((fault,), tmp_path / "run")
    assert driven.stop is not Stop.FINISHED
    assert len(said) == 1
    assert read_manifest(run.folder)["record"]["state"] == "closed"
    numbers = driven.outcomes[-1].text
    assert re.search(r"no valid sample came within \d s; check beams", numbers)
    for command in (["runs", "list", "--runs", tmp_path], ["runs", "show", run.folder]):
        assert numbers in " ".join(call(capsys, *command)[1].split())
    assert driven.trips[0].text in call(capsys, "runs", "show", run.folder)[1]
    assert call_json(capsys, "runs", "list", "--runs", tmp_path)[1]["runs"][0]["text"] == numbers
    text = page(run, scores_of(run, None), "").html()
    assert html.escape(driven.trips[0].text) in text
    assert html.escape(numbers) in text


def test_a_stop_between_two_motions_is_the_end_of_the_second(tmp_path):
    profile = load_profile("single-axis")
    with Supervisor(profile, BatchBackend(load_machine("single-axis"), seed=1), tmp_path / "run") as stage:
        assert stage.home().finished
        assert stage.armed().finished
        low_m, high_m = stage.profile.macro.travel_m
        stage._distress(Stop.LEASE, "for a test")
        stage.pump(1.0)
        ended = stage.move(0.5 * (low_m + high_m) + 0.01)
    assert (ended.stop, ended.rows) == (Stop.LEASE, 0)
    assert ended.text == "the lease on motion ran out: for a test"


def driven_on_a_late_host(folder, **options):
    """Drive the short demo where every tick takes 1.02 ms of a cycle's 1 ms, so that every other cycle is missed."""
    profile = load_profile("oled-printer")
    with Supervisor(profile, BatchBackend(load_machine("oled-printer"), seed=1, tick_s=1.02e-3), folder) as stage:
        plan = trapezoid(0.05, 0.1, dwell_s=0.3, start_m=0.0, lead_s=0.3)
        return demo.drive(stage, plan, ("dsmc",), identify_s=4.0, **options)


def test_a_host_that_misses_more_than_is_borne_ends_the_demo(tmp_path):
    driven = driven_on_a_late_host(tmp_path / "given-up", bears_missed_ratio=1e-3)
    assert driven.given_up
    assert [one.name for one in driven.outcomes] == ["home"]
    assert driven.host.missed_ratio == pytest.approx(0.5, abs=0.01)
    assert driven.host.cycles_count == pytest.approx(2 * driven.outcomes[0].rows, rel=0.05)
    borne = driven_on_a_late_host(tmp_path / "borne")
    assert not borne.given_up
    assert borne.host.missed_ratio > 1e-3


@pytest.mark.parametrize("held_up_s", [0.0, 0.015])
def test_what_a_late_host_makes_of_a_motion_is_no_error_of_the_drives(tmp_path, held_up_s):
    """A homing that ends with an error, and not with a stop: the joint's edges are out of reach."""
    machine = with_values(load_machine("oled-printer"), backlash__left_m=0.7e-3, backlash__right_m=0.7e-3)
    backend = BatchBackend(machine, seed=1)
    with Supervisor(load_profile("oled-printer"), backend, tmp_path / "run") as stage:
        backend.wire.advance_to(backend.wire.t_ns + round(1e9 * held_up_s))
        plan = trapezoid(0.05, 0.1, dwell_s=0.3, start_m=0.0, lead_s=0.3)
        if held_up_s:
            driven = demo.drive(stage, plan, bears_missed_ratio=1e-4)
            assert driven.given_up
            assert driven.outcomes == ()
        else:
            with pytest.raises(DriveError, match="not both edges of the joint were touched"):
                demo.drive(stage, plan, bears_missed_ratio=1e-4)


def test_what_a_late_host_makes_of_a_homing_is_no_error_of_the_wires(tmp_path, single_profile, single_machine):
    """A drive that was not heard of as it let go of the stage: the bus may be whole, and the host away."""
    backend = BatchBackend(single_machine, seed=1)
    struck = False

    def strike(rows):
        nonlocal struck
        if not struck and rows["homing_id"].any():
            struck = True
            backend.rig.inject(Fault("power_loss", node_id=1, duration_s=1e3), backend.wire.t_ns)

    with Supervisor(single_profile, backend, tmp_path / "run", observe=strike) as stage:
        backend.wire.advance_to(backend.wire.t_ns + 15_000_000)
        driven = demo.drive(stage, trapezoid(0.05, 0.1, dwell_s=0.3, start_m=0.0), ("pid",), bears_missed_ratio=1e-4)
    assert driven.given_up
    assert driven.outcomes == ()


@pytest.mark.real_time
def test_the_demo_comes_to_its_end_on_any_host(tmp_path):
    """In real time where this host can, else in virtual time; never silently."""
    command = [sys.executable, "-m", "stagectl.cli", "demo", "--runs", str(tmp_path), "--json"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert process.returncode == 0, process.stderr
    answer = json.loads(process.stdout)
    real_time = answer["real_time"]
    assert answer["cycle"]["is_virtual"] == real_time["given_up"]
    assert real_time["missed_ratio"] > 1e-3 or not real_time["given_up"]
    assert (real_time["run"] == answer["run"]) != real_time["given_up"]
    assert ("the demo plays in virtual time" in process.stderr) == real_time["given_up"]
    assert read_manifest(Path(real_time["run"]))["backend"] == "rig"


# ---- what else is done with its run ----


def test_a_run_that_this_version_can_not_judge_is_5(capsys, demo_run, tmp_path):
    source = Path(demo_run[0]["run"])
    for name in ("later", "empty"):
        (tmp_path / name).mkdir()
        for file in ("manifest.json", "events.jsonl", "snapshot.npz", "samples.arrow"):
            (tmp_path / name / file).write_bytes((source / file).read_bytes())
    events = tmp_path / "later" / "events.jsonl"
    events.write_text(events.read_text().replace('"stop": "FINISHED"', '"stop": "LATER"'))
    code, answer, _ = call_json(capsys, "runs", "show", tmp_path / "later")
    assert code == 5
    assert "'LATER'" in answer["error"]["message"]
    (tmp_path / "empty" / "samples.arrow").write_bytes(b"")
    code, answer, _ = call_json(capsys, "replay", tmp_path / "empty")
    assert code == 5
    assert "nothing to replay" in answer["error"]["message"]
    (tmp_path / "later" / "snapshot.npz").unlink()
    assert call_json(capsys, "replay", tmp_path / "later")[0] == 5


def test_wrong_places_and_columns_are_refused_before_any_work(capsys, demo_run, tmp_path):
    code, _, err = call_json(capsys, "runs", "plot", demo_run[0]["run"], "--out", tmp_path / "x.pdf")
    assert code == 2
    assert "scoring" not in err
    assert call_json(capsys, "runs", "export", demo_run[0]["run"], "--columns", "")[0] == 2
