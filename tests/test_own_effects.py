"""A user's own effect, in a file that the profile names: it works wherever the library's do, and in the record."""

import dataclasses
import json
import re
import select
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench import replaying
from sim_backend.machine import MACHINES_FOLDER, load_machine
from stagectl import cli, compose, plant, trajectory
from stagectl.effect_text import declare
from stagectl.effects import CATALOGUE
from stagectl.errors import ProfileError
from stagectl.gap import balance, grids
from stagectl.gap.application import applied
from stagectl.gap.believed import load_believed
from stagectl.gap.workflow import find
from stagectl.profile import PROFILES_FOLDER, load_profile
from stagectl.record import read_manifest
from tests.hill_in_the_guide import HILL, HILL_AXIS, hill_log
from tests.stage import followed, rms, true_error_m, with_values

DOCUMENT = Path(__file__).parent.parent / "docs" / "own-effects.md"
AXIS = (PROFILES_FOLDER / "single-axis.toml").read_text()
MACHINE = (MACHINES_FOLDER / "single-axis.toml").read_text()
MOVE = trajectory.trapezoid(0.02, 0.1, dwell_s=0.2, lead_s=0.2).setpoints


@pytest.fixture(autouse=True, scope="module")
def _catalogue():
    """Leave the catalogue to other files as it was found."""
    kept = dict(CATALOGUE)
    yield
    CATALOGUE.clear()
    CATALOGUE.update(kept)


def _example(language: str) -> str:
    return re.findall(rf"```{language}\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)[0]


def _law(name: str, body: str = "-damping_n_s_per_m * velocity_m_per_s", **more: str) -> str:
    """The text of one effect, viscous friction unless said."""
    declared = {
        "places": '("macro_force",)',
        "damping_n_s_per_m": "(0.0, 1e5)",
        "linear": '("damping_n_s_per_m",)',
    } | more
    keywords = ", ".join(f"{key}={value}" for key, value in declared.items() if value)
    parameters = [
        key for key, value in declared.items() if value and key not in ("places", "linear", "memory", "session", "run")
    ]
    arguments = ", ".join(["velocity_m_per_s", *parameters])
    return (
        "import numpy as np\nfrom stagectl.effects import effect\n\n\n"
        f'@effect({keywords}, symptom="a mark", reference="this test")\n'
        f'def {name}({arguments}):\n    """Friction: F = -b v."""\n    return {body}\n'
    )


def _profile(folder: Path, law: str, table: str, base: str = AXIS, name: str = "axis.toml") -> Path:
    (folder / "law.py").write_text(law)
    path = folder / name
    path.write_text(f'effect_files = ["law.py"]\n{base}\n{table}')
    return path


def _effects(name: str, **values: float) -> str:
    lines = "".join(f"{key} = {value}\n" for key, value in values.items())
    return f'[[effects]]\nname = "{name}"\nacts_on = "macro_force"\n{lines}'


def test_the_example_of_the_document_passes_the_check_and_gives_its_numbers(capsys, tmp_path):
    text, table = _example("python"), _example("toml")
    (tmp_path / "my_friction.py").write_text(text)
    head, _, effects = table.partition("\n")
    (tmp_path / "mine.toml").write_text(f"{head}\n{AXIS}\n{effects}")
    assert len([line for line in text.splitlines() if line.strip()]) <= 15
    assert cli.main(["profile", "check", str(tmp_path / "mine.toml")]) == 0
    assert cli.main(["profile", "show", str(tmp_path / "mine.toml")]) == 0
    assert "seal_friction" in capsys.readouterr().out
    known = CATALOGUE["seal_friction"]
    assert known.summary.startswith("Friction of a seal")
    assert known.compiled_law(0.02, 2.0, 0.02) == -1.0
    assert known.compiled_law(-0.06, 2.0, 0.02) == 1.5


def test_the_same_law_under_a_name_of_one_s_own_is_the_same_plant_bit_for_bit():
    declare(_law("own_viscous_friction"), "law.py")
    ended = []
    for name in ("viscous_friction", "own_viscous_friction"):
        table = [{"name": name, "acts_on": "macro_force", "damping_n_s_per_m": 20.0}]
        machine = load_machine("single-axis")
        state, parameters = plant.init(machine), plant.parameters(machine)
        module = compose.plant_module(table)
        module.advance(state, parameters, compose.effect_parameters(table), 0.5, 50e-6, 0.4, 0.0, 1, 1)
        ended.append(state)
    assert ended[0].tobytes() == ended[1].tobytes()
    assert ended[1]["macro_velocity_m_per_s"][0] > 0.1


DRAG = _law(
    "seal_drag", "-level_n * velocity_m_per_s / (np.abs(velocity_m_per_s) + 0.02)",
    damping_n_s_per_m="", level_n="(0.0, 100.0)", linear='("level_n",)',
)  # fmt: skip


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """A profile and a machine of one axis with a law of the user's own, and the folder of its file."""
    folder = tmp_path_factory.mktemp("own")
    drag = _effects("seal_drag", level_n=20.0)
    profile = load_profile(_profile(folder, DRAG, drag))
    return profile, load_machine(_profile(folder, DRAG, drag, MACHINE, "machine.toml")), folder


def test_a_law_that_the_profile_knows_is_fed_forward(stage):
    known, machine, _ = stage
    unknown = with_values(known, effects=known.effects[:-1])
    errors = [rms(true_error_m(followed(profile, machine, "pid", MOVE))) for profile in (unknown, known)]
    assert errors[1] < 0.3 * errors[0]


def test_servo_and_replay_have_the_law_without_its_file(stage, tmp_path):
    """The servo is told it in its first line; a new process replays a run of it when the file is gone."""
    profile, machine, folder = stage
    run = replaying.record_of(profile, machine, 3, tmp_path / "run")
    assert np.sum(run.rows["setpoint_velocity_m_per_s"] != 0.0) > 300
    assert read_manifest(tmp_path / "run")["profile"]["effect_files"] == [{"file": "law.py", "text": DRAG}]
    (folder / "law.py").unlink()
    replay = subprocess.run(
        [sys.executable, "-m", "stagectl.cli", "replay", str(tmp_path / "run"), "--json"],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert replay.returncode == 0, replay.stderr
    command = [sys.executable, "-m", "stagectl.servo_process"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as servo:
        assert servo.stdin is not None
        assert servo.stdout is not None
        try:
            servo.stdin.write(json.dumps(profile.effective()) + "\n")
            servo.stdin.flush()
            assert select.select([servo.stdout], [], [], 120.0)[0]
            assert json.loads(servo.stdout.readline()) == {"warm": True}
            servo.stdin.close()
            assert servo.wait(20.0) == 0
        finally:
            servo.kill()


# ---- gap ----------------------------------------------------------------------------------------------------------


def test_the_gap_workflow_finds_it_and_writes_it_into_the_profile(tmp_path):
    (tmp_path / "hill.py").write_text(HILL)
    (tmp_path / "axis.toml").write_text(HILL_AXIS)
    believed = load_believed(tmp_path / "axis.toml")
    assert believed.own_effects == ("scratch_in_the_guide",)
    findings = find(believed, [hill_log("run 1", 1)], [hill_log("run 2", 2)], nulls_count=20)
    (named,) = findings.named
    assert (named.name, named.parameters["force_n"]) == ("scratch_in_the_guide", pytest.approx(3.0, rel=0.1))
    assert named.parameters["width_m"] == pytest.approx(5e-3, rel=0.1)
    text = applied(HILL_AXIS, findings, candidates=True, date="2026-11-20")
    (tmp_path / "axis.toml").write_text(text)
    assert load_believed(tmp_path / "axis.toml").effects[1]["name"] == "scratch_in_the_guide"


def test_a_search_tries_the_own_effects_of_its_own_profile_only(tmp_path):
    (tmp_path / "hill.py").write_text(HILL)
    (tmp_path / "axis.toml").write_text(HILL_AXIS)
    mine = load_believed(tmp_path / "axis.toml")
    log = hill_log("run 1", 1)
    assert len(grids.grids_for([balance.recording_of(log, mine)])["scratch_in_the_guide"]) == 12
    others = dataclasses.replace(mine, own_effects=())
    assert grids.grids_for([balance.recording_of(log, others)])["scratch_in_the_guide"] == []


# ---- what is refused ----------------------------------------------------------------------------------------------

GOOD = _law("refused_law")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "declares no effect"),
        ("def f(:", "is not Python"),
        (GOOD.replace("numpy as np", "os"), "line 1: imports os"),
        (GOOD.replace("import effect", "import effect, CATALOGUE"), "takes CATALOGUE from stagectl.effects"),
        (GOOD + "\nopen('x')\n", "line 10: open is not allowed"),
        (_law("refused_law", "__import__('os')"), "__import__ is not allowed"),
        (_law("refused_law", "np.load('x')"), "np.load is not allowed"),
        (_law("refused_law", "np.sin.__self__"), "asks for .__self__"),
        (_law("refused_law", "(lambda: 0.0)()"), "Lambda is not allowed"),
        (_law("refused_law", "f'{velocity_m_per_s}'"), "JoinedStr is not allowed"),
        (_law("refused_law", "getattr(np, 'load')"), "getattr is not allowed"),
        (GOOD.replace("    return", "    import os\n    return"), "imports os"),
        (GOOD.replace("    return", "    import math\n    return"), "inside of something else"),
        (GOOD + "\nfor k in range(3):\n    pass\n", "For outside a function"),
        (GOOD + "\ndef other(x_m):\n    return x_m\n", "other needs the decorator"),
        (GOOD + "\nclass Other:\n    pass\n", "ClassDef is not allowed"),
        (_law("coulomb_friction"), "coulomb_friction is the name of an effect already, stagectl's own"),
        (_law("refused_law", damping_n_s_per_m="(1.0, 0.0)"), "bounds of damping_n_s_per_m are no range"),
        (_law("refused_law", speed="(0.0, 1.0)"), "argument speed states no unit"),
        (_law("refused_law", "nothing_known * 1.0"), "numba can't compile it"),
        (_law("refused_law", "np.sqrt(-1.0 - damping_n_s_per_m)"), "gives nan with every quantity zero"),
        (_law("refused_law", "damping_n_s_per_m / velocity_m_per_s"), "gives .* with every quantity zero"),
        (_law("refused_law", "damping_n_s_per_m * damping_n_s_per_m * velocity_m_per_s"), "is not linear in damping"),
        (_law("refused_law", "velocity_m_per_s > 0.0"), "returns bool"),
        (_law("refused_law", pitch_m="(1e-3, 1.0)", width_m="(1e-3, 1.0)"), "call it period_m"),
    ],
)
def test_a_text_that_is_no_good_effect_is_refused_and_leaves_nothing(text, said):
    before = set(CATALOGUE)
    for _ in range(2):  # the second time as the first: no half of it was kept
        with pytest.raises(ProfileError, match=said):
            declare(text, "law.py")
        assert set(CATALOGUE) == before


def test_a_memory_moves_with_time_only():
    body = "np.abs(velocity_m_per_s)\n"
    text = _law("counting_law", body, memory="1").replace("velocity_m_per_s, d", "velocity_m_per_s, dt_s, d", 1)
    text = text.replace("damping_n_s_per_m):", "damping_n_s_per_m, memory):").replace(
        f"    return {body}", "    memory[0] = memory[0] + 1.0\n    return -damping_n_s_per_m * velocity_m_per_s\n"
    )
    with pytest.raises(ProfileError, match="changes its memory with dt_s = 0"):
        declare(text, "law.py")
    declare(text.replace("+ 1.0", "+ dt_s"), "law.py")
    assert CATALOGUE["counting_law"].memory == 1


def test_one_name_is_one_law():
    declare(_law("named_twice"), "law.py")
    law = CATALOGUE["named_twice"]
    declare(_law("named_twice"), "law.py")
    assert CATALOGUE["named_twice"] is law
    with pytest.raises(ProfileError, match="one of another text in this process"):
        declare(_law("named_twice", "-2.0 * damping_n_s_per_m * velocity_m_per_s"), "law.py")


def test_another_text_is_another_module():
    """Compiled code is kept from process to process: it must not outlive the text that it was made of."""
    table = [{"name": "edited_law", "acts_on": "macro_force", "damping_n_s_per_m": 20.0}]
    names = []
    for factor in ("1.0", "2.0"):
        declare(_law("edited_law", f"-{factor} * damping_n_s_per_m * velocity_m_per_s"), "law.py")
        along = compose.along(CATALOGUE["edited_law"])
        assert along(np.array([[1.0]]), np.array([20.0, 0.0]), np.zeros(1))[0] == -20.0 * float(factor)
        names.append(compose.plant_module(table).__name__)
        del CATALOGUE["edited_law"]
    assert names[0] != names[1]


def test_a_file_that_is_not_there_or_not_one_s_own_is_refused(capsys, tmp_path):
    path = _profile(tmp_path, _law("file_law"), "")
    assert load_profile(path).effect_files[0].names == ("file_law",)
    (tmp_path / "law.py").chmod(0o666)
    with pytest.raises(ProfileError, match=r"axis.toml: effect_files\[0\].*anybody may write it"):
        load_profile(path)
    (tmp_path / "law.py").chmod(0o600)
    (tmp_path / "law.py").write_bytes(b"\xff")
    with pytest.raises(ProfileError, match="not UTF-8"):
        load_profile(path)
    (tmp_path / "law.py").unlink()
    with pytest.raises(ProfileError, match="can't be read"):
        load_profile(path)
    (tmp_path / "law.py").mkdir()
    assert cli.main(["profile", "check", str(path)]) == 2
    assert "is no file of at most" in capsys.readouterr().err
    path.write_text(AXIS.replace('name = "single-axis"', 'name = "single-axis"\neffect_files = ["law.txt", 3]', 1))
    with pytest.raises(ProfileError, match="effect_files"):
        load_profile(path)
