"""The command line: help, JSON, wrong usage, errors, what interrupts, an environment that lacks something."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from stagectl import cli, run_folder
from stagectl.commands.answer import EXIT_CODES, Answer, deliver, jsonable
from stagectl.commands.interruption import Interruption
from stagectl.errors import DriveError, LinkError, ProfileError, RecordError, RequestError, StagectlError, TimingError
from stagectl.profile import PROFILES_FOLDER, load_profile
from stagectl.runs import new_run_folder
from tests.command import call, call_json
from tests.toml_text import changed

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


def test_what_a_command_records_is_in_memory_of_libc():
    code = "from stagectl import cli; import pyarrow; print(pyarrow.default_memory_pool().backend_name)"
    environment = {name: value for name, value in os.environ.items() if name != "ARROW_DEFAULT_MEMORY_POOL"}
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert process.stdout == "system\n", process.stderr


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


@pytest.mark.parametrize("while_hushed", [True, False])
def test_an_interrupt_is_heard_again_where_more_follows(capsys, while_hushed):
    def work(voice):
        voice.hush()
        if while_hushed:
            os.kill(os.getpid(), signal.SIGINT)
        voice.progress("stopping", 0.0)
        voice.listen()
        if not while_hushed:
            os.kill(os.getpid(), signal.SIGINT)
        voice.progress("the next one", 0.0)
        return Answer({})

    with pytest.raises(cli.typer.Exit) as end:
        deliver("test", True, work)
    assert end.value.exit_code == 130


def test_runs_that_can_not_be_are_refused_before_anything_opens(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    for runs in (tmp_path / "file", tmp_path / "file" / "below"):
        code, answer, _ = call_json(capsys, "home", "--backend", "batch", "--runs", runs)
        assert (code, answer["error"]["kind"]) == (2, "RequestError")
        assert f"{tmp_path / 'file'} is a file" in answer["error"]["message"]
    code, answer, _ = call_json(capsys, "runs", "show", tmp_path / "file")
    assert code == 2
    assert f"give the run's folder, that is {tmp_path}" in answer["error"]["message"]


@pytest.mark.parametrize("distance", ["nan", "inf", "5"])
def test_a_jog_that_can_not_be_is_refused_before_anything_opens(capsys, tmp_path, distance):
    runs = tmp_path / "runs"
    code, _, err = call(capsys, "jog", "--distance-m", distance, "--backend", "batch", "--runs", str(runs))
    assert code == 2
    assert "--distance-m" in err
    assert not runs.exists()  # no run was begun: the stage did not even home


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_an_answer_that_no_disk_takes_is_told_as_that(more):
    command = [sys.executable, "-m", "stagectl.cli", "profile", "list", *more]
    with open("/dev/full", "w") as full:
        process = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert process.returncode == 5
    assert (
        process.stderr
        == "RecordError\nstdout: can't be written: No space left on device; what was to be said there is lost\n"
    )


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_an_answer_to_a_closed_output_is_told_as_that(more):
    command = f'exec "{sys.executable}" -m stagectl.cli profile list {" ".join(more)} >&-'
    process = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, text=True, timeout=60)
    assert process.returncode == 5
    assert process.stderr == "RecordError\nstdout: is closed; what was to be said there is lost\n"
