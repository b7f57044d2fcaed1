"""The command line: what it prints, what its exit codes mean, that one run goes from command to report and replay."""

import html
import itertools
import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from sim_backend.faults import Fault
from sim_backend.machine import load_machine
from stagectl import cli, demo, run_folder
from stagectl.backend import BatchBackend
from stagectl.commands.answer import EXIT_CODES, Answer, deliver, jsonable
from stagectl.commands.interruption import Interruption
from stagectl.errors import DriveError, LinkError, ProfileError, RecordError, RequestError, StagectlError, TimingError
from stagectl.profile import PROFILES_FOLDER, load_profile
from stagectl.record import read_manifest, read_run
from stagectl.requests import Phase
from stagectl.run_page import page, scores_of
from stagectl.run_scores import read_truth, score_backlash, segments
from stagectl.runs import new_run_folder
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from stagectl.trajectory import trapezoid
from tests.toml_text import changed

pytestmark = pytest.mark.real_time

COMMANDS = [
    [],
    ["demo"],
    ["run"],
    ["identify"],
    ["jog"],
    ["home"],
    ["replay"],
    ["reproduce"],
    ["profile"],
    ["profile", "check"],
    ["profile", "show"],
    ["profile", "list"],
    ["runs"],
    ["runs", "list"],
    ["runs", "show"],
    ["runs", "export"],
    ["runs", "import"],
    ["runs", "plot"],
    ["serve"],
    ["status"],
    ["watch"],
    ["move"],
    ["stop"],
    ["fault"],
    ["lease"],
    ["backend"],
    ["record"],
    ["log"],
    ["gap"],
    ["gap", "search"],
    ["gap", "apply"],
]


def call(capsys, *arguments):
    """Run a command in this process: (exit code, stdout, stderr)."""
    capsys.readouterr()
    code = cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, err


def call_json(capsys, *arguments):
    """Run a command with --json: (exit code, the object, stderr)."""
    code, out, err = call(capsys, *arguments, "--json")
    return code, json.loads(out), err


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


# ---- help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_help_has_an_example_and_the_exit_codes(capsys, command):
    code, out, _ = call(capsys, *command, "--help")
    assert code == 0
    assert "Example: stagectl" in out
    assert "Exit codes: 0" in " ".join(out.split())


@pytest.mark.parametrize(
    "command", [one for one in COMMANDS if one not in ([], ["profile"], ["runs"], ["gap"])], ids=" ".join
)
def test_every_command_speaks_json(capsys, command):
    assert "--json" in call(capsys, *command, "--help")[1]


def test_what_is_no_command_of_gap_is_a_search(capsys):
    for words in (
        ["gap", "nobody", "run-1"],
        ["gap", "--seed", "3", "nobody", "run-1"],
        ["gap", "search", "nobody", "x"],
    ):
        code, answer, _ = call_json(capsys, *words)
        assert (code, answer["command"]) == (2, "gap")
        assert "profile 'nobody' is not in" in answer["error"]["message"]
    code, out, _ = call(capsys, "gap", "--help")
    assert code == 0
    assert all(word in out for word in ("apply", "--holdout", "PROFILE", "RUN..."))


def test_help_loads_nothing_heavy():
    heavy = (
        "numba, numpy, matplotlib, pyarrow, scipy, can, canopen, pydantic, ruckig, structlog, httpx, fastapi, uvicorn"
    )
    code = (
        f"import sys; from stagectl import cli; cli.main(['--help']); print({heavy!r}.split(', ') & sys.modules.keys())"
    )
    code = code.replace("split(', ') &", "split(', ')) &").replace("print(", "print(set(")
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    assert process.stdout.rstrip().endswith("set()")


# ---- wrong usage and errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [["fly"], ["jog"], ["jog", "--distance-m", "far"], ["demo", "--colour", "red"], ["runs", "show"]],
    ids=" ".join,
)
def test_wrong_usage_is_2(capsys, arguments):
    code, out, err = call(capsys, *arguments)
    assert (code, out) == (2, "")
    assert err
    code, answer, _ = call_json(capsys, *arguments)
    assert code == answer["exit_code"] == 2
    assert answer["error"]["kind"] == "UsageError"
    command = (
        ""
        if arguments[0] == "fly"
        else " ".join(word for word in arguments[:2] if word in ("jog", "demo", "runs", "show"))
    )
    assert (answer["command"], answer["run"]) == (command, None)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "--backend", "plan"], "did you mean plant"),
        (["run", "--law", "bangbang"], "one of dsmc, pid"),
        (["run", "--trajectory", "trapez"], "did you mean trapezoid"),
        (["run", "--trajectory", "sine", "--stroke-m", "0.1"], "--stroke-m belongs to trapezoid"),
        (["run", "--trajectory", "move"], "needs --target-m"),
        (["run", "--trajectory", "move", "--target-m", "0.5"], "--target-m is 0.5, the travel of oled-printer is"),
        (["run", "--trajectory", "move", "--target-m", "nan"], "--target-m is nan"),
        (["run", "--velocity-m-per-s", "-0.1", "--backend", "plant"], "--velocity-m-per-s is -0.1"),
        (["run", "--stroke-m", "nan", "--backend", "plant"], "--stroke-m is nan"),
        (["run", "--trajectory", "sine", "--frequency-hz", "-1", "--backend", "plant"], "--frequency-hz is -1"),
        (
            ["run", "--trajectory", "sine", "--frequency-hz", "1e6"],
            "--frequency-hz is 1e+06: setpoints come at 1000 Hz",
        ),
        (["run", "--trajectory", "sine", "--frequency-hz", "50.1"], "up to 50 Hz"),
        (["run", "--trajectory", "sine", "--frequency-hz", "1e-300"], "--frequency-hz is 1e-300: three periods take"),
        (["run", "--trajectory", "sine", "--amplitude-m", "inf"], "--amplitude-m is inf: the travel of oled-printer"),
        (["run", "--trajectory", "sine", "--amplitude-m", "1e308"], "--amplitude-m is 1e+308: the travel"),
        (["run", "--trajectory", "sine", "--amplitude-m", "1e-300"], "--amplitude-m is 1e-300: at 0.2 m/s"),
        (["run", "--trajectory", "sine", "--duration-s", "nan"], "--duration-s is nan: give a time above 0"),
        (["run", "--trajectory", "sine", "--duration-s", "1e308"], "--duration-s is 1e+308: give a time above 0"),
        (["run", "--trajectory", "sine", "--duration-s", "0.5"], "--duration-s is 0.5: the ramps at both ends"),
        (["run", "--trajectory", "sine", "--start-m", "-inf"], "--start-m is -inf: the travel"),
        (["run", "--velocity-m-per-s", "1e308"], "--velocity-m-per-s is 1e+308: the limit of oled-printer"),
        (["run", "--velocity-m-per-s", "1e-300"], "--velocity-m-per-s is 1e-300: 0.8 m take"),
        (["run", "--dwell-s", "1e308"], "--dwell-s is 1e+308: give 0 or more"),
        (["run", "--trajectory", "absent.csv", "--backend", "plant"], "absent.csv"),
        (["home", "--backend", "plant"], "take --backend rig"),
        (["identify", "--profile", "single-axis", "--backend", "plant"], "no backlash to identify"),
        (["replay", "nowhere"], "no run 'nowhere'"),
        (["runs", "plot", "latest"], "holds no run yet"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_request_that_can_not_be_is_2_and_says_why(capsys, tmp_path, arguments, says):
    code, answer, err = call_json(capsys, *arguments, "--runs", tmp_path)
    assert code == answer["exit_code"] == 2
    assert answer["error"]["kind"] == "RequestError"
    assert says in answer["error"]["message"]
    assert says in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_a_trajectory_beyond_the_travel_is_refused_before_it_moves(capsys, tmp_path):
    code, answer, _ = call_json(
        capsys, "run", "--trajectory", "trapezoid", "--stroke-m", "2", "--backend", "batch", "--runs", tmp_path
    )
    assert code == 2
    assert "travel" in answer["error"]["message"]
    assert list(tmp_path.iterdir()) == []


def test_a_bad_profile_is_2_and_says_all_that_is_wrong(capsys, tmp_path):
    text = Path(load_profile("oled-printer").source_path).read_text(encoding="utf-8")
    bad = tmp_path / "bad.toml"
    bad.write_text(text.replace("rate_hz = 1000.0\nphase_s", "rate_hz = nan\nphase_s") + "\n[extra]\nkey = 1\n")
    code, answer, err = call_json(capsys, "profile", "check", bad)
    assert code == 2
    assert answer["error"]["kind"] == "ProfileError"
    for part in ("bad.toml", "cycle.rate_hz", "extra"):
        assert part in answer["error"]["message"]
    assert "ProfileError" in err


@pytest.mark.parametrize(
    ("error", "code"),
    [(ProfileError, 2), (RequestError, 2), (LinkError, 3), (DriveError, 3), (TimingError, 4), (RecordError, 5)],
)
def test_each_kind_of_error_has_its_code(capsys, error, code):
    def work(voice):
        raise error("motor on fire: 900 degC, limit 80 degC; wait")

    with pytest.raises(cli.typer.Exit) as end:
        deliver("test", True, work)
    out, err = capsys.readouterr()
    assert end.value.exit_code == code
    assert json.loads(out)["error"] == {
        "kind": error.__name__,
        "message": "motor on fire: 900 degC, limit 80 degC; wait",
    }
    assert "motor on fire" in err
    assert set(EXIT_CODES) == set(StagectlError.__subclasses__())


def test_hardware_that_is_not_there_is_3(capsys, tmp_path):
    code, answer, _ = call_json(capsys, "home", "--backend", "hardware", "--runs", tmp_path)
    assert code == 3
    assert answer["error"]["kind"] == "LinkError"


def test_a_rig_that_is_killed_ends_a_jog_with_3(tmp_path):
    command = [sys.executable, "-m", "stagectl.cli", "jog", "--distance-m", "0.1", "--backend", "rig", "--json"]
    process = subprocess.Popen(
        [*command, "--runs", str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    said = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("homing the macro"):  # its first motion
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            (rig,) = [pid for pid in children if b"sim_backend" in Path(f"/proc/{pid}/cmdline").read_bytes()]
            os.kill(int(rig), signal.SIGKILL)
            break
    out, err = process.communicate(timeout=60)
    said = "".join(said) + err
    assert "Traceback" not in said
    assert process.returncode == 3, said
    answer = json.loads(out)
    assert (answer["exit_code"], answer["stop"]) == (3, "LINK_LOST")
    assert not read_run(Path(answer["run"])).truncated


def test_markup_in_a_message_stays_text(capsys):
    def work(voice):
        raise RequestError("key [red]limits[/red] of [macro]")

    with pytest.raises(cli.typer.Exit):
        deliver("test", False, work)
    assert "key [red]limits[/red] of [macro]" in capsys.readouterr().err


def test_json_has_no_nan():
    values = {"a": float("nan"), "b": np.float64("inf"), "c": (np.int64(3), Path("x")), "d": np.array([1.0, np.nan])}
    assert jsonable(values) == {"a": None, "b": None, "c": [3, "x"], "d": [1.0, None]}


def test_an_answer_carries_its_exit_code(capsys):
    with pytest.raises(cli.typer.Exit) as end:
        deliver("test", True, lambda voice: Answer({"found": 3}, exit_code=1))
    assert end.value.exit_code == 1
    assert json.loads(capsys.readouterr().out) == {"command": "test", "exit_code": 1, "found": 3}


# ---- the demo -----------------------------------------------------------------------------------------------------


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


# ---- the value seam, and a table from elsewhere ---------------------------------------------------------------------


def test_the_value_seam_follows_and_is_recorded(capsys, tmp_path):
    arguments = ["run", "-t", "trapezoid", "--stroke-m", "0.2", "--backend", "plant", "--runs", tmp_path]
    code, answer, _ = call_json(capsys, *arguments)
    assert code == 0
    assert answer["stop"] == "FINISHED"
    (motion,) = answer["motions"]
    assert 10e-9 < motion["true"]["max_m"] < 150e-9
    assert answer["cycle"] is None  # no servo, nothing to be late
    again = call_json(capsys, *arguments)[1]
    assert again["motions"] == answer["motions"]
    code, refused, _ = call_json(capsys, "replay", answer["run"])
    assert code == 5
    assert "nothing to replay" in refused["error"]["message"]
    code, plotted, _ = call_json(capsys, "runs", "plot", answer["run"])
    assert code == 0
    assert Path(plotted["files"][0]).read_text(encoding="utf-8").count("<svg") == 2


def test_a_stop_behind_the_value_seam_is_said_with_its_numbers(capsys, tmp_path):
    source = Path(load_profile("oled-printer").source_path)
    hot = source.read_text(encoding="utf-8")
    for line, tight in (("thermal_force_n = 700.0", 30.0), ("thermal_time_constant_s = 60.0", 0.5)):
        assert hot.count(line) == 1
        hot = hot.replace(line, f"{line.partition(' = ')[0]} = {tight}")
    (tmp_path / source.name).write_text(hot)
    for eds in source.parent.glob("*.eds"):
        (tmp_path / eds.name).write_bytes(eds.read_bytes())
    arguments = ["run", "--stroke-m", "0.1", "--profile", tmp_path / source.name, "--backend", "plant"]
    code, answer, _ = call_json(capsys, *arguments, "--runs", tmp_path / "runs")
    assert (code, answer["stop"]) == (1, "THERMAL")
    assert re.search(r"macro at 30\.\d N rms, limit 30 N; let it cool", answer["text"])
    assert answer["ended_early"] == [answer["text"]]
    assert answer["text"].endswith(call_json(capsys, "runs", "show", answer["run"])[1]["text"])


def test_the_value_seam_identifies(capsys, tmp_path):
    code, answer, _ = call_json(capsys, "identify", "--backend", "plant", "--duration-s", "8", "--runs", tmp_path)
    assert code == 0
    found = answer["backlash"]
    for side in ("left", "right"):
        assert abs(found[f"{side}_edge_m"] - found[f"{side}_edge_true_m"]) < 0.5e-6
        assert found[f"{side}_stiffness_n_per_m"] == pytest.approx(found[f"{side}_stiffness_true_n_per_m"], rel=0.02)


def test_a_stage_of_one_axis_runs_behind_the_value_seam(capsys, tmp_path):
    code, answer, _ = call_json(
        capsys, "run", "-t", "sine", "--profile", "single-axis", "--backend", "plant", "--runs", tmp_path
    )
    assert code == 0
    assert answer["backlash"] is None
    assert answer["motions"][0]["law"] == "pid"


def test_a_file_of_positions_is_followed(capsys, tmp_path):
    file = tmp_path / "there-and-back.csv"
    file.write_text("t_s,position_m\n0,0\n1,0.01\n2,0.02\n3,0.01\n4,0\n")
    code, answer, _ = call_json(capsys, "run", "-t", file, "--backend", "plant", "--runs", tmp_path / "runs")
    assert code == 0
    assert answer["motions"][0]["trajectory"] == "there-and-back"


def test_a_jog_over_the_wire_ends_where_it_should(capsys, tmp_path):
    code, answer, _ = call_json(capsys, "jog", "--distance-m", "0.002", "--backend", "batch", "--runs", tmp_path)
    assert code == 0
    run = read_run(Path(answer["run"]))
    moves = [one for one in segments(run) if one.name.startswith("moving to")]
    assert len(moves) == 1
    last = run.rows[moves[0].first_row + moves[0].rows_count - 1]
    first = run.rows[moves[0].first_row]
    assert last["end_position_m"] - first["setpoint_position_m"] == pytest.approx(0.002, abs=1e-6)


def test_a_table_from_elsewhere_becomes_a_run(capsys, tmp_path):
    table = tmp_path / "bench.csv"
    table.write_text("time,laser\n" + "".join(f"{k * 0.001:.3f},{k * 0.01:.2f}\n" for k in range(50)))
    arguments = ["runs", "import", table, "--column", "t_ns=time:s", "--column", "end_position_m=laser:mm"]
    code, answer, _ = call_json(capsys, *arguments, "--runs", tmp_path / "runs")
    assert code == 0
    assert answer["rows_count"] == 50
    rows = read_run(Path(answer["folder"])).rows
    assert rows["end_position_m"][49] == pytest.approx(0.49e-3)
    code, refused, _ = call_json(capsys, "runs", "plot", answer["folder"])
    assert code == 2
    assert "no motions" in refused["error"]["message"]
    code, _, _ = call_json(capsys, "runs", "import", table, "--runs", tmp_path / "runs")
    assert code == 2


def test_profiles_are_listed_checked_and_shown(capsys):
    code, answer, _ = call_json(capsys, "profile", "list")
    assert code == 0
    assert {"oled-printer", "kang-2023", "single-axis"} <= {one["name"] for one in answer["profiles"]}
    code, answer, _ = call_json(capsys, "profile", "check", "oled-printer")
    assert code == 0
    assert re.fullmatch("[0-9a-f]{64}", answer["sha256"])
    assert answer["limp_deceleration_m_per_s2"] == pytest.approx(0.097, abs=1e-3)
    assert "brakes at 2 m/s^2, and a limp micro keeps off its stops up to 0.097 m/s^2" in " ".join(
        call(capsys, "profile", "check", "oled-printer")[1].split()
    )
    code, answer, _ = call_json(capsys, "profile", "show", "oled-printer")
    assert code == 0
    assert answer["profile"]["control"]["pid_bandwidth_hz"] == 50.0  # a default, filled in
    assert "pid_bandwidth_hz = 50" in call(capsys, "profile", "show", "oled-printer")[1]


# ---- an environment that lacks something ---------------------------------------------------------------------------


def run_in(environment, *arguments):
    """Run a command in a process of its own with these variables."""
    return subprocess.run(
        [sys.executable, "-m", "stagectl.cli", *map(str, arguments)],
        capture_output=True,
        timeout=100,
        env={**os.environ, **environment},
    )


def test_json_for_an_output_without_utf_8_is_ascii(tmp_path):
    root = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    (root / "µ").mkdir(parents=True)
    for encoding in ("ascii", "latin-1", "utf-8"):
        found = run_in({"PYTHONIOENCODING": encoding}, "runs", "list", "--runs", root, "--json")
        assert found.returncode == 0, found.stderr
        assert json.loads(found.stdout.decode("ascii"))["runs"][0]["folder"] == str(root / "µ")
    shown = run_in({"PYTHONIOENCODING": "ascii"}, "runs", "list", "--runs", root)
    assert shown.returncode == 0, shown.stderr
    assert b"\\xb5" in shown.stdout


@pytest.mark.parametrize("variables", [{"HOME": "/proc"}, {"XDG_CACHE_HOME": "/proc/x"}, {"STAGECTL_CACHE": "FILE"}])
def test_without_a_cache_folder_compiled_code_goes_to_a_folder_of_one_s_own(tmp_path, variables):
    (tmp_path / "file").write_text("")
    variables = {name: value.replace("FILE", str(tmp_path / "file")) for name, value in variables.items()}
    environment = {"XDG_CACHE_HOME": "", "STAGECTL_CACHE": "", "TMPDIR": str(tmp_path), **variables}
    found = run_in(environment, "profile", "list", "--json")
    assert found.returncode == 0, found.stderr
    json.loads(found.stdout)
    own = tmp_path / f"stagectl-cache-{os.getuid()}"
    assert found.stderr.decode().count(f"it goes to {own};") == 1
    assert own.stat().st_mode & 0o777 == 0o700
    own.chmod(0o777)  # where others may write, others may have put code
    other = run_in(environment, "profile", "list").stderr.decode()
    assert f"it goes to {own};" not in other  # another's name may begin as ours does
    assert "it goes to" in other


EDS_FILES = {
    "noise": (bytes(range(256)), "EDS of node 1 can't be read"),
    "text": (b"hello\n", "EDS of node 1 can't be read"),
    "nothing": (b"", "lacks what arming needs, as integers: 0x1000:00, 0x1005:00"),
    "the other drive's": ((PROFILES_FOLDER / "stagectl-voice-coil.eds").read_bytes(), "ProductNumber is 0x10002"),
    "one without homing": (
        (PROFILES_FOLDER / "stagectl-linear-motor.eds").read_bytes().replace(b"[6098]", b"[2098]"),
        "lacks what arming needs, as integers: 0x6098:00;",
    ),
}


@pytest.mark.parametrize(("content", "says"), EDS_FILES.values(), ids=EDS_FILES)
def test_an_eds_file_that_arming_could_not_use_is_refused(capsys, tmp_path, content, says):
    (tmp_path / "bench.toml").write_text(changed(PROFILES_FOLDER / "oled-printer.toml", {"macro.eds": "odd.eds"}))
    (tmp_path / "odd.eds").write_bytes(content)
    code, answer, _ = call_json(capsys, "profile", "check", tmp_path / "bench.toml")
    assert (code, answer["error"]["kind"]) == (2, "ProfileError")
    (line,) = answer["error"]["message"].splitlines()
    assert line.startswith(f'{tmp_path / "bench.toml"}: macro.eds = "odd.eds": {tmp_path / "odd.eds"}: ')
    assert says in line


def test_an_effect_that_stands_twice_is_remarked(capsys, tmp_path):
    text = (PROFILES_FOLDER / "oled-printer.toml").read_text()
    effects = text[text.index("[[effects]]") :]
    first = "[[effects]]" + effects.split("[[effects]]")[1]
    (tmp_path / "bench.toml").write_text(f"{text}\n{first}")
    code, answer, _ = call_json(capsys, "profile", "check", tmp_path / "bench.toml")
    assert code == 0
    (remark,) = answer["remarks"]
    assert re.match(r"effects\[3\] is viscous_friction on \w+, as effects\[0\] is: both act", remark)
    assert call_json(capsys, "profile", "check", "oled-printer")[1]["remarks"] == []


# ---- Ctrl-C -------------------------------------------------------------------------------------------------------


def test_an_interrupt_brings_the_stage_to_rest_and_closes_the_run(tmp_path):
    command = [sys.executable, "-m", "stagectl.cli", "run", "--backend", "batch", "--runs", str(tmp_path), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    said = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("moving to"):
            time.sleep(0.3)  # virtual time passes in the other process: it is on its way by now
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGINT)  # impatience changes nothing
            break
    out, err = process.communicate(timeout=60)
    said = "".join(said) + err
    assert process.returncode == 130, said
    answer = json.loads(out)
    assert (answer["exit_code"], answer["error"]["kind"]) == (130, "Interrupted")
    assert answer["run"] in said
    run = read_run(Path(answer["run"]))
    assert not run.truncated
    speed = np.abs(run.rows["setpoint_velocity_m_per_s"])
    assert np.max(speed) > 0.02
    powered = run.rows[run.rows["run_phase"] == int(Phase.STOPPING)]
    assert powered.size
    assert powered["setpoint_velocity_m_per_s"][-1] == 0.0
    truth = read_truth(run.folder)
    at_rest = truth["sequence"] == powered["cycle"][-1]
    assert abs(truth["macro_velocity_m_per_s"][at_rest][0]) < 1e-3


def test_a_closed_terminal_brings_the_stage_to_rest_and_closes_the_run(tmp_path):
    """stdin, stdout and stderr end with the terminal; what would be said there must not end the way to rest."""
    command = [sys.executable, "-m", "stagectl.cli", "run", "--backend", "batch", "--runs", str(tmp_path)]
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, command)
    said = b""
    while b"moving to" not in said:
        said += os.read(terminal, 4096)
    time.sleep(0.3)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 130
    (folder,) = tmp_path.iterdir()
    run = read_run(folder)
    assert not run.truncated
    assert (run.manifest["end"]["stop"], run.manifest["record"]["state"]) == ("OPERATOR", "closed")
    powered = run.rows[run.rows["run_phase"] == int(Phase.STOPPING)]
    assert powered.size
    assert powered["setpoint_velocity_m_per_s"][-1] == 0.0


def test_a_hangup_that_was_to_be_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
    try:
        with Interruption() as interruption:
            os.kill(os.getpid(), signal.SIGHUP)
            interruption.check()
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_commands_of_one_second_get_a_folder_each(tmp_path, monkeypatch):
    """As two commands race: both have looked, and neither has made its folder."""
    both_looked, looks = threading.Barrier(2), itertools.count()

    def look(root, name):
        folder = new_run_folder(root, name, datetime(2026, 11, 20, tzinfo=UTC))
        if next(looks) < 2:
            both_looked.wait(60.0)
        return folder

    monkeypatch.setattr(run_folder, "new_run_folder", look)
    with ThreadPoolExecutor(2) as pool:
        folders = sorted(pool.map(lambda _: run_folder.reserve(tmp_path, "home"), range(2)))
    assert folders == sorted(tmp_path.iterdir())
    assert [folder.name for folder in folders] == ["2026-11-20T00-00-00-home", "2026-11-20T00-00-00-home-2"]
    (folders[0] / "manifest.json").write_text("{}")
    for folder in folders:
        run_folder.give_back(folder)
    assert list(tmp_path.iterdir()) == [folders[0]]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_is_heard_where_nothing_is_half_done(capsys, tmp_path, number):
    done = []

    def work(voice):
        voice.run_folder = tmp_path
        os.kill(os.getpid(), number)
        done.append("what was under way")
        voice.progress("next", 0.0)
        done.append("what comes after")

    before = signal.getsignal(number)
    with pytest.raises(cli.typer.Exit) as end:
        deliver("test", True, work)
    assert end.value.exit_code == 130
    assert done == ["what was under way"]
    assert json.loads(capsys.readouterr().out)["run"] == str(tmp_path)
    assert signal.getsignal(number) is before


def test_an_interrupt_says_what_is_whole(capsys, tmp_path):
    """Findings that were written stay, also where the page beside them was not drawn."""
    kept = tmp_path / "findings.json"

    def work(voice):
        kept.write_text("{}")
        voice.whole_file = kept
        os.kill(os.getpid(), signal.SIGINT)
        voice.progress("drawing the page", 0.0)

    with pytest.raises(cli.typer.Exit):
        deliver("test", True, work)
    said = capsys.readouterr()
    assert json.loads(said.out)["error"]["message"] == f"{kept} is whole, what was to follow is not there"
    assert "nothing was recorded" not in said.err


def test_nothing_interrupts_the_way_to_rest(capsys):
    def work(voice):
        voice.hush()
        os.kill(os.getpid(), signal.SIGINT)
        voice.progress("stopping", 0.0)
        return Answer({"stopped": True})

    with pytest.raises(cli.typer.Exit) as end:
        deliver("test", True, work)
    assert end.value.exit_code == 0
    assert json.loads(capsys.readouterr().out)["stopped"]


def test_runs_that_can_not_be_are_refused_before_anything_opens(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    for runs in (tmp_path / "file", tmp_path / "file" / "below"):
        code, answer, _ = call_json(capsys, "home", "--backend", "batch", "--runs", runs)
        assert (code, answer["error"]["kind"]) == (2, "RequestError")
        assert f"{tmp_path / 'file'} is a file" in answer["error"]["message"]
    code, answer, _ = call_json(capsys, "runs", "show", tmp_path / "file")
    assert code == 2
    assert f"give the run's folder, that is {tmp_path}" in answer["error"]["message"]


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


@pytest.mark.parametrize("distance", ["nan", "inf", "5"])
def test_a_jog_that_can_not_be_is_refused_before_anything_opens(capsys, tmp_path, distance):
    runs = tmp_path / "runs"
    code, _, err = call(capsys, "jog", "--distance-m", distance, "--backend", "batch", "--runs", str(runs))
    assert code == 2
    assert "--distance-m" in err
    assert not runs.exists()  # no run was begun: the stage did not even home
