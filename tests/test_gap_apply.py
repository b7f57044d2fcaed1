"""`stagectl gap apply`: findings become lines of a profile, and nothing else of it changes."""

import dataclasses
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from stagectl import cli, compose
from stagectl.effects import CATALOGUE
from stagectl.errors import ProfileError, RecordError, RequestError
from stagectl.gap.application import application, applied
from stagectl.gap.believed import document_of, load_believed
from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.gap.findings_file import read_findings, write_findings
from stagectl.gap.workflow import find
from stagectl.profile import PROFILES_FOLDER
from tests.test_gap_parts import _axis_log

AXIS = PROFILES_FOLDER / "single-axis.toml"
PRINTER = PROFILES_FOLDER / "oled-printer.toml"
EMPS = PROFILES_FOLDER / "observed" / "emps.toml"
DATE = "2026-11-20"

OFFSET = Named("offset", "macro_force", {"force_n": 0.75}, {"force_n": 0.01}, 90.0, 40.0, (), confirmed=True)
COGGING = Named(
    "cogging",
    "macro_force",
    {
        "pitch_m": 0.024,
        "amplitude_n of session :9": 1.0,
        "phase_rad of session :9": 0.4,
        "amplitude_n of session :10": 1.3,
        "phase_rad of session :10": -1.1,
    },
    {"amplitude_n of session :9": 0.1, "amplitude_n of session :10": 0.2},
    80.0,
    30.0,
    (("current_ripple", "macro_actuator", 3.0),),
    confirmed=True,
)

CURVE = {
    "over": "position_m",
    "acts_on": "macro_force",
    "knots": [float(f"{-0.1 + 0.03 * k / 11:.6g}") for k in range(12)],
    "unit": "N",
    "values": [0.1 * k * k for k in range(12)],
    "sds": [0.01] * 12,
    "gain": 90.0,
    "held_out_gain": 40.0,
}


def _text(path: Path) -> str:
    return path.read_bytes().decode()


def _findings(path: Path, **changes) -> Findings:
    """Findings about a shipped profile in which its own effects were refitted by nothing."""
    document = tomllib.loads(_text(path))
    refitted = {f"{row['name']} on {row['acts_on']}": 0.0 for row in document.get("effects", ())}
    refitted |= {"macro_mass_kg": 0.0, "macro_latch_s": 0.0}
    if "micro" in document:
        refitted |= {"micro_latch_s": 0.0}
    plain = Findings(
        profile=document["name"],
        runs=("runs/2026-11-19T09-14-03", "runs/2026-11-19T09-31-10"),
        holdout=("runs/2026-11-19T10-02-44",),
        verdict="found",
        named=(),
        parameter_errors=(),
        refitted=refitted,
        not_excited=(),
        unknown=None,
        reducible_before=(1.0, 1.0),
        reducible_after=(0.0, 0.0),
        threshold=10.0,
    )
    return dataclasses.replace(plain, **changes)


def _apply(path: Path, findings: Findings, candidates: bool = False) -> tuple[str, dict]:
    text = applied(_text(path), findings, candidates=candidates, date=DATE)
    document_of(text.encode(), path)  # what is written passes the check of profiles
    return text, tomllib.loads(text)


def _line(text: str, begin: str) -> str:
    (line,) = [row for row in text.splitlines() if row.startswith(begin)]
    return line


@pytest.mark.parametrize("path", [AXIS, PRINTER, EMPS], ids=lambda path: path.stem)
def test_a_confirmed_effect_is_added_and_every_old_line_stays(path):
    text, table = _apply(path, _findings(path, named=(OFFSET,)))
    rows, old = text.splitlines(), _text(path).splitlines()
    assert [row for row in rows if row in old or not row.strip()][: len(old)] == old
    assert table["effects"][-1] == {"name": "offset", "acts_on": "macro_force", "force_n": 0.75}
    assert _line(text, "force_n = 0.75") == f"force_n = 0.75  # gap {DATE}: 0.7304 .. 0.7696 (95 %)"
    assert f"# gap {DATE}: values so marked" in text
    assert "runs 2026-11-19T09-14-03, 2026-11-19T09-31-10, judged on 2026-11-19T10-02-44" in text
    assert f"[[effects]]  # gap {DATE}: confirmed" in rows


def test_phases_are_of_the_newest_session_and_amplitudes_of_all():
    text, table = _apply(AXIS, _findings(AXIS, named=(COGGING,)))
    row = table["effects"][-1]
    assert row["amplitude_n"] == pytest.approx((100.0 * 1.0 + 25.0 * 1.3) / 125.0)
    assert (row["phase_rad"], row["pitch_m"]) == (-1.1, 0.024)
    said = _line(text, "phase_rad")
    assert "per session, this is session :10, the newest" in said
    assert "session :9 had 0.4" in said
    assert f"{-1.1 - 1.96 * 0.2 / 1.3:.4g} .. " in said  # the phase is as uncertain as the amplitude, by its size
    assert "explained as well by current_ripple on macro_actuator" in text


def test_what_is_not_confirmed_is_written_on_request_only_and_marked():
    named = (OFFSET, dataclasses.replace(COGGING, confirmed=False))
    wrong = (ParameterError("macro_mass_kg", 0.04, 0.002, 0.01),)
    findings = _findings(AXIS, named=named, parameter_errors=wrong)
    text, table = _apply(AXIS, findings)
    assert [row["name"] for row in table["effects"]][2:] == ["offset"]
    assert table["macro"]["mass_kg"] == 12.0  # was fitted together with what is not confirmed
    assert "candidate" not in text
    text, table = _apply(AXIS, findings, candidates=True)
    assert [row["name"] for row in table["effects"]][2:] == ["offset", "cogging"]
    assert table["macro"]["mass_kg"] == pytest.approx(12.48)
    assert text.count("candidate, not confirmed yet") == 2


def test_every_known_parameter_has_its_key():
    ratios = {
        "macro_mass_kg": ("macro", "mass_kg"),
        "micro_mass_kg": ("micro", "mass_kg"),
        "spring_n_per_m": ("micro", "spring_n_per_m"),
        "damping_n_s_per_m": ("micro", "damping_n_s_per_m"),
        "left_stiffness_n_per_m": ("backlash", "left_stiffness_n_per_m"),
        "right_stiffness_n_per_m": ("backlash", "right_stiffness_n_per_m"),
    }
    apart = {
        "left_m": ("backlash", "left_m", 2e-6),
        "right_m": ("backlash", "right_m", -3e-6),
        "macro_current_loop_s": ("macro", "current_loop_s", 2e-5),
        "micro_current_loop_s": ("micro", "current_loop_s", 1e-5),
    }
    errors = [ParameterError(name, 0.02, 0.001, 0.005, confirmed=True) for name in ratios]
    errors += [ParameterError(name, error, 1e-7, 5e-7, confirmed=True) for name, (_, _, error) in apart.items()]
    errors += [ParameterError(f"{axis}_latch_s", 10e-6, 1e-6, 1e-6, confirmed=True) for axis in ("macro", "micro")]
    findings = _findings(PRINTER, named=(OFFSET,), parameter_errors=tuple(errors))
    text, table = _apply(PRINTER, findings)
    old = tomllib.loads(_text(PRINTER))
    for group, key in ratios.values():
        assert table[group][key] == pytest.approx(1.02 * old[group][key])
    for group, key, error in apart.values():
        assert table[group][key] == pytest.approx(old[group][key] + error)
    assert table["cycle"]["actuation_delay_s"] == pytest.approx(old["cycle"]["actuation_delay_s"] + 10e-6)
    low, high = 70.0 * (1.02 - 1.96e-3), 70.0 * (1.02 + 1.96e-3)
    assert _line(text, "mass_kg = 71.4") == f"mass_kg = 71.4  # gap {DATE}: {low:.4g} .. {high:.4g} (95 %); was 70"
    delay = _line(text, "actuation_delay_s")
    assert delay.startswith(_line(_text(PRINTER), "actuation_delay_s").partition("# ")[2], delay.index("# ") + 2)


def test_a_confirmed_effect_confirms_no_parameter():
    """Each stands for itself; what stays a candidate is said, and its alias stands beside the value."""
    wrong = (
        ParameterError("macro_mass_kg", 0.04, 0.002, 0.01, ("macro_force_constant",)),
        ParameterError("macro_current_loop_s", 1e-5, 1e-6, 1e-6, confirmed=True),
    )
    refitted = _findings(AXIS).refitted | {"viscous_friction on macro_force": -0.25}
    findings = _findings(AXIS, named=(OFFSET,), parameter_errors=wrong, refitted=refitted)
    done = application(_text(AXIS), findings, candidates=False, date=DATE)
    assert [change.key for change in done.changes] == ["effects[2].force_n", "macro.current_loop_s"]
    assert done.left == ("macro_mass_kg is off by 0.04, not confirmed: --candidates writes it",)
    text, table = _apply(AXIS, findings, candidates=True)
    assert table["effects"][0]["damping_n_s_per_m"] == 15.0
    assert "explained as well by macro_force_constant" in _line(text, "mass_kg")
    assert "candidate, not confirmed yet" in _line(text, "mass_kg")


def test_an_error_of_both_sides_is_written_on_both():
    wrong = (
        ParameterError("contact_stiffness_n_per_m", 0.1, 0.001, 0.02, confirmed=True),
        ParameterError("backlash_width_m", 4e-6, 1e-7, 1e-6, confirmed=True),
    )
    sides = {name: 0.0 for name in ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")}
    refitted = _findings(PRINTER).refitted | sides
    _, table = _apply(PRINTER, _findings(PRINTER, parameter_errors=wrong, refitted=refitted))
    old = tomllib.loads(_text(PRINTER))["backlash"]
    for side in ("left", "right"):
        stiffness = f"{side}_stiffness_n_per_m"
        assert table["backlash"][stiffness] == pytest.approx(1.1 * old[stiffness])
        assert table["backlash"][f"{side}_m"] == pytest.approx(old[f"{side}_m"] + 4e-6)


def test_a_profile_whose_values_have_changed_is_refused():
    """Errors are shares of values that the file no longer has."""
    believed = load_believed(AXIS)
    findings = _findings(AXIS, named=(OFFSET,), profile_path=believed.path, profile_sha256=believed.sha256)
    assert believed.path == str(AXIS.resolve())
    assert _apply(AXIS, findings)[1]["effects"][2]["force_n"] == 0.75
    changed = _text(AXIS).replace("mass_kg = 12.0", "mass_kg = 13.0")
    assert changed != _text(AXIS)
    with pytest.raises(RequestError, match=r"has changed since the findings were made \(sha256 "):
        applied(changed, findings, candidates=False, date=DATE)


def test_a_force_constant_is_an_effect_and_the_name_plate_stays():
    """rated_force_n is compared with the drive's 0x6076: a profile that differs could not arm."""
    wrong = (ParameterError("macro_force_constant", -0.03, 0.001, 0.01, confirmed=True),)
    text, table = _apply(AXIS, _findings(AXIS, named=(OFFSET,), parameter_errors=wrong))
    assert table["macro"]["rated_force_n"] == 80.0
    assert {"name": "force_constant_error", "acts_on": "macro_actuator", "error_ratio": -0.03} in table["effects"]
    refitted = {f"{row['name']} on {row['acts_on']}": 0.0 for row in table["effects"]}
    again = _findings(AXIS, named=(), parameter_errors=wrong, refitted=refitted, runs=("runs/later",))
    table = tomllib.loads(applied(text, again, candidates=True, date=DATE))
    assert [row["error_ratio"] for row in table["effects"] if row["name"] == "force_constant_error"] == [-0.06]


def test_effects_of_the_profile_take_their_refitted_values():
    refitted = {"viscous_friction on macro_force": -0.25, "coulomb_friction on macro_force": 1e-4}
    text, table = _apply(AXIS, _findings(AXIS, named=(OFFSET,), refitted=refitted))
    assert table["effects"][0]["damping_n_s_per_m"] == 15.0
    assert table["effects"][1]["level_n"] == 6.0
    assert "level_n = 6.0" in text.splitlines()
    assert "was 20" in _line(text, "damping_n_s_per_m")
    assert "no interval" in _line(text, "damping_n_s_per_m")  # of findings that state none
    known = _findings(AXIS, named=(OFFSET,), refitted=refitted, refitted_sds={"viscous_friction on macro_force": 0.02})
    assert f"{15.0 - 1.96 * 0.4:.4g} .. {15.0 + 1.96 * 0.4:.4g} (95 %)" in _line(
        _apply(AXIS, known)[0], "damping_n_s_per_m"
    )
    wrong = (ParameterError("viscous_friction on macro_force", -0.25, 0.01, 0.05, confirmed=True),)
    text, _ = _apply(AXIS, _findings(AXIS, named=(OFFSET,), refitted=refitted, parameter_errors=wrong))
    assert f"{15.0 - 1.96 * 0.2:.4g} .. {15.0 + 1.96 * 0.2:.4g} (95 %)" in _line(text, "damping_n_s_per_m")


def test_what_a_profile_can_not_hold_is_left_with_its_reason():
    vibration = Named(
        "base_vibration",
        "macro_force",
        {"frequency_hz": 20.0, "amplitude_m_per_s2 of run a": 0.1, "phase_rad of run a": 0.2},
        {"amplitude_m_per_s2 of run a": 0.01}, 50.0, 20.0, (), confirmed=True,
    )  # fmt: skip
    tilted = dataclasses.replace(OFFSET, parameters={"force_n": 5e3})
    errors = (
        ParameterError("micro_latch_s", 50e-6, 1e-6, 1e-5, confirmed=True),
        ParameterError("micro_current_loop_s", 1e-5, 1e-6, 1e-6, confirmed=True),
    )
    findings = _findings(PRINTER, named=(OFFSET, vibration, tilted), parameter_errors=errors)
    done = application(_text(PRINTER), findings, candidates=False, date=DATE)
    assert [change.key for change in done.changes] == ["effects[3].force_n", "micro.current_loop_s"]
    run, outside, delay = done.left
    assert "phase_rad is another one in each run" in run
    assert "force_n = 5000 is outside its limits -1000 to 1000" in outside
    assert "one delay for both" in delay
    errors = (
        ParameterError("macro_force_constant", 0.03, 1e-3, 1e-2),
        ParameterError("micro_mass_kg", 0.1, 0.01, 0.01),
    )
    done = application(
        _text(AXIS), _findings(AXIS, named=(OFFSET,), parameter_errors=errors), candidates=True, date="x"
    )
    assert done.left == ("micro_mass_kg is off by 0.1: this file has no micro.mass_kg",)


def test_an_unknown_curve_becomes_a_table_without_a_name():
    findings = _findings(AXIS, unknown=CURVE, verdict="unknown")
    text, table = _apply(AXIS, findings, candidates=True)
    row = table["effects"][-1]
    assert (row["name"], row["acts_on"], row["first_m"]) == ("force_over_position", "macro_force", -0.1)
    along = compose.along(CATALOGUE["force_over_position"])
    values = np.array([*(row[name] for name in CATALOGUE["force_over_position"].parameters), 0.0])
    knots = np.array(CURVE["knots"])
    found = along(np.concatenate([knots, 0.5 * (knots[1:] + knots[:-1])])[:, None], values, np.zeros(1))
    assert found[:12] == pytest.approx(CURVE["values"], abs=2e-3)
    assert found[12:] == pytest.approx([0.1 * (k * k + k + 0.5) for k in range(11)], abs=2e-3)
    assert "unknown, a table of its curve and no name" in text
    assert "(95 %)" in _line(text, "force_12_n")
    done = application(_text(AXIS), dataclasses.replace(findings, named=(OFFSET,)), candidates=False, date=DATE)
    assert "a table is written with --candidates" in done.left[0]
    timely = dataclasses.replace(findings, unknown=CURVE | {"over": "t_s"})
    with pytest.raises(RequestError, match="over t_s: it is of one recording"):
        applied(_text(AXIS), timely, candidates=True, date=DATE)
    uneven = {"knots": [0.02, 0.1, 5.0], "values": [0.1, 0.2, 0.1], "sds": [0.01] * 3}
    for other in (
        CURVE | {"over": "since_reversal_s"} | uneven,
        CURVE | {"over": "motor_force_ago_s", "unit": "ratio", "acts_on": "macro_actuator"} | uneven,
        CURVE | {"unit": "m", "acts_on": "macro_sensor"},
    ):
        changed = dataclasses.replace(findings, unknown=other)
        with pytest.raises(RequestError, match=f"over {other['over']}: no table of a profile goes by it"):
            applied(_text(AXIS), changed, candidates=True, date=DATE)


def test_comments_survive_where_values_stand_in_one_line():
    text = 'name = "x"\nmacro = { mass_kg = 2.0 } # one line\n'
    text += "effects = [\n  # none yet\n]\n[cycle]\nlatch_s = 1e-4 # guess\n"
    wrong = (
        ParameterError("macro_mass_kg", 0.5, 0.01, 0.01, confirmed=True),
        ParameterError("macro_latch_s", 1e-4, 1e-6, 1e-6, confirmed=True),
    )
    findings = _findings(AXIS, profile="x", named=(OFFSET,), parameter_errors=wrong, refitted={})
    done = applied(text, findings, candidates=False, date=DATE)
    table = tomllib.loads(done)
    assert (table["macro"]["mass_kg"], table["cycle"]["latch_s"], table["effects"][0]["force_n"]) == (3.0, 2e-4, 0.75)
    assert "# macro.mass_kg: gap 2026-11-20: 2.961 .. 3.039 (95 %); was 2" in done
    assert "# one line" in done
    assert "# guess; gap 2026-11-20:" in done
    inline = text.replace("# none yet", '{ name = "offset", acts_on = "macro_force", force_n = 1.0 }, # old')
    findings = dataclasses.replace(findings, refitted={"offset on macro_force": 0.1}, named=(COGGING,))
    table = tomllib.loads(applied(inline, findings, candidates=False, date=DATE))
    assert table["effects"][0]["force_n"] == pytest.approx(1.1)
    assert table["effects"][1]["pitch_m"] == 0.024
    cut = _text(AXIS).rstrip()  # no end of line at the end of the file
    assert tomllib.loads(applied(cut, _findings(AXIS, named=(OFFSET,)), candidates=False, date=DATE))["effects"][2]
    crlf = applied(_text(AXIS).replace("\n", "\r\n"), _findings(AXIS, named=(OFFSET,)), candidates=False, date=DATE)
    assert tomllib.loads(crlf) == tomllib.loads(
        applied(_text(AXIS), _findings(AXIS, named=(OFFSET,)), candidates=False, date=DATE)
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"profile": "oled-printer", "named": (OFFSET,)}, "are of profile 'oled-printer', this is 'single-axis'"),
        ({"refitted": {}, "named": (OFFSET,)}, "has changed since the findings were made"),
        ({"named": (dataclasses.replace(OFFSET, name="oofset"),)}, "damaged.*oofset is not an effect"),
        ({"named": (dataclasses.replace(OFFSET, acts_on="contact"),)}, "damaged.*can't act on contact"),
        ({"named": (dataclasses.replace(OFFSET, parameters={"level_n": 1.0}),)}, "has not its parameters: force_n, l"),
        ({"named": (dataclasses.replace(OFFSET, sds={"force_n": None}),)}, "values that are no numbers"),
        ({"named": (OFFSET,), "parameter_errors": (ParameterError("mass", 0.1, 0.1, 0.1),)}, "mass is no parameter"),
        ({}, "the findings name nothing$"),
        ({"unknown": {"over": "position_m"}}, "damaged.*the unknown curve lacks acts_on"),
        ({"unknown": CURVE | {"knots": [0.0, *CURVE["knots"][1:]]}}, "damaged.*uneven steps"),
        ({"unknown": CURVE | {"values": [1.0]}}, "damaged.*has not 12 numbers"),
        ({"unknown": CURVE | {"unit": "m", "sds": [1.0]}}, "damaged.*has not 12 numbers"),
        ({"unknown": CURVE | {"unit": "m", "knots": 7.0}}, "damaged.*has no numbers"),
        ({"unknown": CURVE | {"unit": "m", "knots": [], "values": [], "sds": []}}, "damaged.*has no numbers"),
        ({"unknown": CURVE | {"unit": ["N"], "values": [float("nan")] * 12}}, "damaged.*has no numbers"),
        ({"unknown": CURVE}, "nothing to write.*unknown curve over position_m: a table.*--candidates"),
        ({"named": (dataclasses.replace(OFFSET, confirmed=False),)}, "none of 1 findings is confirmed.*--candidates"),
    ],
)  # fmt: skip
def test_findings_that_can_not_be_applied_are_refused(changes, said):
    with pytest.raises(RequestError, match=said):
        applied(_text(AXIS), _findings(AXIS, **changes), candidates=False, date=DATE)


def test_findings_are_applied_once():
    text = applied(_text(AXIS), _findings(AXIS, named=(OFFSET,)), candidates=False, date=DATE)
    with pytest.raises(RequestError, match="stand in this profile already"):
        applied(text, _findings(AXIS, named=(OFFSET,)), candidates=False, date="2026-11-21")
    refitted = {f"{row['name']} on {row['acts_on']}": 0.0 for row in tomllib.loads(text)["effects"]}
    later = _findings(AXIS, named=(COGGING,), refitted=refitted, runs=("runs/later",))
    again = applied(text, later, candidates=False, date=DATE)
    assert f"[[effects]]  # gap {DATE} no. 2: confirmed" in again  # two of one day can be told apart


@pytest.fixture
def findings_file(tmp_path):
    """A folder of findings about the single axis."""
    write_findings(_findings(AXIS, named=(OFFSET,)), tmp_path / "findings.json")
    return tmp_path


def test_the_command_writes_a_profile_that_passes_its_check(capsys, findings_file):
    new = findings_file / "better.toml"
    assert cli.main(["gap", "apply", "single-axis", str(findings_file), "-o", str(new), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["command"] == "gap apply"
    assert [change["key"] for change in answer["changes"]] == ["effects[2].force_n"]
    assert cli.main(["profile", "check", str(new)]) == 0
    assert load_believed(new).effects[-1]["force_n"] == 0.75
    capsys.readouterr()
    assert cli.main(["gap", "apply", "single-axis", str(findings_file / "findings.json"), "-o", str(new)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert cli.main(["gap", "apply", "single-axis", str(findings_file), "-o", str(new), "--force"]) == 0


def test_the_old_profile_is_never_written(capsys, findings_file):
    old = findings_file / "own.toml"
    old.write_bytes(AXIS.read_bytes())
    same = findings_file / "link.toml"
    same.symlink_to(old)
    for place in (old, same):
        assert cli.main(["gap", "apply", str(old), str(findings_file), "-o", str(place), "--force"]) == 2
        assert "is the profile itself" in capsys.readouterr().err
    assert old.read_bytes() == AXIS.read_bytes()


def test_a_result_that_fails_its_check_is_not_written(capsys, findings_file):
    """Eleven times the mass takes more than the force limit, at the profile's acceleration."""
    heavy = (ParameterError("macro_mass_kg", 10.0, 0.1, 0.01, confirmed=True),)
    write_findings(_findings(AXIS, named=(OFFSET,), parameter_errors=heavy), findings_file / "findings.json")
    new = findings_file / "better.toml"
    assert cli.main(["gap", "apply", "single-axis", str(findings_file), "-o", str(new)]) == 2
    said = capsys.readouterr().err
    assert "fails its check" in said
    assert "moving 132 kg" in said
    assert not new.exists()


@pytest.mark.parametrize("content", [b"", b"5", b"[1]", b'{"format": 1, "named": [{"name": "offset"}]}', b"\xff"])
def test_damaged_findings_are_5(capsys, findings_file, content):
    (findings_file / "findings.json").write_bytes(content)
    with pytest.raises(RecordError):
        read_findings(findings_file / "findings.json")
    assert cli.main(["gap", "apply", "single-axis", str(findings_file), "-o", str(findings_file / "x.toml")]) == 5
    assert "findings" in capsys.readouterr().err


def test_a_text_that_is_no_toml_is_a_profile_error():
    with pytest.raises(ProfileError, match="not TOML"):
        applied("name = [", _findings(AXIS, named=(OFFSET,)), candidates=False, date=DATE)


def test_what_was_found_and_applied_is_not_found_again(tmp_path):
    """An axis with dry friction that its file lacks: found, written into the file, and nothing is missing any more."""
    file = tmp_path / "axis.toml"
    file.write_text(
        'name = "axis"  # observed\neffect_sd_ratio = 0.2\n'
        "[cycle]\nrate_hz = 1000.0\nlatch_s = 0.0\n"
        "[macro]\nmass_kg = 40.2\nmass_sd_kg = 0.4\ntravel_m = 0.1\n"
        "[sensor]\nnoise_m = 5e-9\n"
        '[[effects]]\nname = "viscous_friction"\nacts_on = "macro_force"\ndamping_n_s_per_m = 33.0\n'
    )
    logs = [_axis_log(f"run {seed}", 1.0, seed) for seed in (1, 2)]
    findings = find(load_believed(file), logs[:1], logs[1:], nulls_count=20)
    assert [effect.name for effect in findings.named] == ["coulomb_friction"]
    with pytest.raises(RequestError, match="--candidates"):
        applied(file.read_text(), findings, candidates=False, date=DATE)
    file.write_text(applied(file.read_text(), findings, candidates=True, date=DATE))
    believed = load_believed(file)
    assert believed.effects[1]["level_n"] == pytest.approx(1.0, rel=0.03)
    assert believed.effects[0]["damping_n_s_per_m"] == pytest.approx(30.0, rel=0.05)
    again = find(believed, logs[:1], logs[1:], nulls_count=20)
    assert again.named == (), again.trace
