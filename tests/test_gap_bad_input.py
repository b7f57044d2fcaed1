"""Recordings that `stagectl gap` must not learn from: an error that says what to look at, or a stated exclusion."""

import dataclasses
import json

import numpy as np
import pytest

from bench.blind_sets import load_set
from stagectl import cli
from stagectl.backend import BatchBackend
from stagectl.errors import RecordError, RequestError
from stagectl.gap import plausibility
from stagectl.gap.balance import recording_of
from stagectl.gap.believed import load_believed
from stagectl.gap.log import read_log
from stagectl.record import read_run
from stagectl.requests import TICKING
from stagectl.supervisor import Supervisor
from stagectl.table_import import import_table
from tests.blind import generate
from tests.gap_tables import AXIS_MAP, STAGE_MAP, axis_table, profile_file, stage_table, write_csv

WOBBLE_M = 12e-6
COUNT = 4000
"""Samples of most tables here: what makes them bad shows within four seconds."""


@pytest.fixture(scope="module")
def axis_tables():
    return [axis_table(seed, COUNT) for seed in (1, 2)]


@pytest.fixture(scope="module")
def stage_tables():
    return [stage_table(seed, COUNT) for seed in (1, 2)]


def brought_in(table: dict, name: str, folder, column_map: dict):
    return import_table(write_csv(table, folder / f"{name}.csv"), column_map, folder / name).folder


def refused(capsys, profile, training, held, folder) -> tuple[int, str]:
    """Run `stagectl gap` on recordings it must refuse: (exit code, message); no findings may be left behind."""
    out = folder / "out"
    holdout = [part for run in held for part in ("--holdout", str(run))]
    capsys.readouterr()
    code = cli.main(["gap", str(profile), *map(str, training), *holdout, "--out", str(out), "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert not (out / "findings.json").exists()
    assert "findings" not in answer
    return code, answer["error"]["message"]


def with_columns(table: dict, **columns) -> dict:
    return {**table, **columns}


def test_recordings_that_fit_their_profile_pass(axis_tables, stage_tables, tmp_path):
    for profile, tables, column_map in (
        (profile_file(tmp_path), axis_tables, AXIS_MAP),
        ("oled-printer", stage_tables, STAGE_MAP),
    ):
        believed = load_believed(profile)
        runs = [brought_in(table, f"{believed.name}-{k}", tmp_path, column_map) for k, table in enumerate(tables)]
        logs = [read_log(run, believed.period_s, believed) for run in runs]
        assert plausibility.check(believed, logs[:1], logs[1:]) == ()


def test_noise_in_the_first_sample_does_not_ring():
    """30 nm of noise are 10 N in one second difference of 80 kg: good recordings were refused for what that left."""
    values = np.zeros(COUNT)
    values[0] = 10.0
    assert np.max(np.abs(plausibility.in_band(values, 1e-3))) < 0.2


def test_a_sensor_of_the_heavier_body_that_wobbles_is_no_exchanged_column(tmp_path):
    """As forces of a lighter body the same wobble is a few times less: a drifting sensor was refused for that."""
    light = load_believed("oled-printer")
    light = dataclasses.replace(light, micro=dataclasses.replace(light.micro, mass_kg=15.0))
    tables = [stage_table(seed, COUNT, end_kg=15.0) for seed in (1, 2)]
    wobble_m = WOBBLE_M * np.sin(2.0 * np.pi * 12.0 * tables[0]["t_s"])
    tables[0] = with_columns(tables[0], macro=tables[0]["macro"] + wobble_m)
    runs = [brought_in(table, f"run-{k}", tmp_path, STAGE_MAP) for k, table in enumerate(tables)]
    logs = [read_log(run, light.period_s, light) for run in runs]
    assert plausibility.check(light, logs[:1], logs[1:]) == ()


def held_between(first: int, behind: int) -> np.ndarray:
    samples = np.arange(COUNT)
    return (samples >= first) & (samples < behind)


AXIS_CASES = {
    "command and position swapped": (
        lambda t: with_columns(t, position=t["command"], command=t["position"]),
        "another column|times as much|explain",
    ),
    "setpoint and position swapped": (
        lambda t: with_columns(t, position=t["reference"], reference=t["position"]),
        "are the two swapped",
    ),
    "sign of the command": (lambda t: with_columns(t, command=-t["command"]), "the sign of macro_force_n turned"),
    "position in mm": (lambda t: with_columns(t, position=t["position"] * 1e3), "millimetres"),
    "force in mN": (
        lambda t: with_columns(t, command=t["command"] * 1e3),
        "the profile limits it to 100 N; check the column's unit",
    ),
    "force in kN": (lambda t: with_columns(t, command=t["command"] * 1e-3), "or forces in kN"),
    "constant command": (lambda t: with_columns(t, command=np.full_like(t["command"], 3.0)), "constant"),
    "time that jumps": (lambda t: with_columns(t, t_s=t["t_s"] + 0.05 * (t["t_s"] > 2.0)), "time jumps by 51 ms"),
    "irregular time": (
        lambda t: with_columns(t, t_s=t["t_s"] + 3e-4 * np.random.default_rng(5).random(t["t_s"].size)),
        "scatter",
    ),
    "time in ms": (lambda t: with_columns(t, t_s=t["t_s"] * 2.0), "every 2 ms, the profile says 1 ms"),
    "too short": (lambda t: {name: values[:700] for name, values in t.items()}, "at least 1000"),
    "a sensor that sticks": (
        lambda t: with_columns(t, position=np.where(held_between(1500, 1550), t["position"][1500], t["position"])),
        "stays the same for 50 samples",
    ),
    "a sensor at half the rate": (
        lambda t: with_columns(t, position=np.repeat(t["position"][::2], 2)),
        "the sensor is slower than the table",
    ),
    "always at its limit": (
        lambda t: with_columns(t, command=np.where(np.arange(COUNT) % 900 < 60, 100.0, t["command"])),
        "stand at their limit",
    ),
}


@pytest.mark.parametrize("case", AXIS_CASES)
def test_bad_recordings_of_one_axis_are_refused(case, axis_tables, tmp_path, capsys):
    spoil, said = AXIS_CASES[case]
    runs = [brought_in(spoil(table), f"run-{k}", tmp_path, AXIS_MAP) for k, table in enumerate(axis_tables)]
    code, message = refused(capsys, profile_file(tmp_path), runs[:1], runs[1:], tmp_path)
    assert code in (2, 5)
    assert any(part in message for part in said.split("|")), message


def test_the_one_recording_in_mm_is_named_by_its_factor(tmp_path, capsys):
    tables = [axis_table(seed, amplitude_m=2e-4) for seed in (1, 2)]
    tables[1] = with_columns(tables[1], position=tables[1]["position"] * 1e3)
    runs = [brought_in(table, f"run-{k}", tmp_path, AXIS_MAP) for k, table in enumerate(tables)]
    code, message = refused(capsys, profile_file(tmp_path), runs[:1], runs[1:], tmp_path)
    assert code == 2
    assert "run-1: the macro accelerates" in message
    assert "positions in mm" in message


STAGE_CASES = {
    "macro and end swapped": (
        lambda t: with_columns(t, macro=t["end"], end=t["macro"]),
        "are macro_position_m and end_position_m swapped",
    ),
    "commands swapped": (
        lambda t: with_columns(t, macro_force=t["micro_force"], micro_force=t["macro_force"]),
        "macro_force_n and micro_force_n exchanged",
    ),
    "constant micro command": (
        lambda t: with_columns(t, micro_force=np.zeros_like(t["t_s"])),
        "micro_force_n never changes",
    ),
}


@pytest.mark.parametrize("case", STAGE_CASES)
def test_bad_recordings_of_two_axes_are_refused(case, stage_tables, tmp_path, capsys):
    spoil, said = STAGE_CASES[case]
    runs = [brought_in(spoil(table), f"run-{k}", tmp_path, STAGE_MAP) for k, table in enumerate(stage_tables)]
    code, message = refused(capsys, "oled-printer", runs[:1], runs[1:], tmp_path)
    assert code == 2
    assert said in message


@pytest.mark.parametrize("lacking", ["end_position_m", "micro_force_n", "macro_force_n", "macro_position_m"])
def test_a_column_that_the_profile_needs_is_missed(lacking, stage_tables, tmp_path, capsys):
    column_map = {name: column for name, column in STAGE_MAP.items() if name != lacking}
    run = brought_in(stage_tables[0], "run", tmp_path, column_map)
    code, message = refused(capsys, "oled-printer", [run], [], tmp_path)
    assert code == 5
    assert f"no column {lacking}, which profile oled-printer needs" in message


def test_nan_in_a_table_is_refused(axis_tables, tmp_path):
    position = axis_tables[0]["position"].copy()
    position[1500] = np.nan
    with pytest.raises(RecordError, match="1 of 4000 values are empty, nan or infinite"):
        brought_in(with_columns(axis_tables[0], position=position), "run", tmp_path, AXIS_MAP)


def test_a_stage_that_stands_still_is_refused(tmp_path, capsys):
    runs = [brought_in(axis_table(seed, COUNT, amplitude_m=2e-6), f"run-{seed}", tmp_path, AXIS_MAP) for seed in (1, 2)]
    code, message = refused(capsys, profile_file(tmp_path), runs, [], tmp_path)
    assert code == 2
    assert "the training recordings move by" in message


def test_the_same_samples_under_another_name_confirm_nothing(axis_tables, tmp_path, capsys):
    first = brought_in(axis_tables[0], "first", tmp_path, AXIS_MAP)
    cut = {name: values[500:] for name, values in axis_tables[0].items()}
    second = brought_in(cut, "second", tmp_path, AXIS_MAP)
    for training, held, side in (([first], [second], "training and holdout"), ([first, second], [], "one side")):
        code, message = refused(capsys, profile_file(tmp_path), training, held, tmp_path)
        assert code == 2
        assert "hold the same samples" in message
        assert side in message


def test_the_profile_of_another_machine_is_refused(tmp_path, capsys):
    runs = [brought_in(axis_table(seed), f"run-{seed}", tmp_path, AXIS_MAP) for seed in (1, 2)]
    code, message = refused(capsys, profile_file(tmp_path, 60.0), runs[:1], runs[1:], tmp_path)
    assert code == 2
    assert "moves as if it had 40" in message
    assert "another machine" in message


def test_a_mass_that_is_only_wrong_passes(axis_tables, tmp_path):
    """5 % is a parameter error, for the search to find: five stated standard deviations."""
    believed = load_believed(profile_file(tmp_path, 42.0))
    runs = [brought_in(table, f"run-{k}", tmp_path, AXIS_MAP) for k, table in enumerate(axis_tables)]
    logs = [read_log(run, believed.period_s, believed) for run in runs]
    assert plausibility.check(believed, logs, []) == ()


def test_dropped_samples_are_predicted_over_and_said(axis_tables, tmp_path):
    kept = np.ones(COUNT, bool)
    kept[[1000, 1001, 1002, 2500]] = False
    run = brought_in({name: values[kept] for name, values in axis_tables[0].items()}, "run", tmp_path, AXIS_MAP)
    believed = load_believed(profile_file(tmp_path))
    log = read_log(run, believed.period_s, believed)
    assert np.flatnonzero(~log.valid).tolist() == [1000, 1001, 1002, 2500]
    assert "0.10% of the samples are missing" in log.remarks[0]
    assert np.max(np.abs(log.macro_position_m - axis_tables[0]["position"])) < 1e-7


def test_saturated_stretches_are_left_out_and_said(axis_tables, tmp_path):
    command = axis_tables[0]["command"].copy()
    command[1000:1100] = 100.0  # the limit of the loop in the profile
    command[3000:3005] = -100.0  # too short to count
    run = brought_in(with_columns(axis_tables[0], command=command), "run", tmp_path, AXIS_MAP)
    believed = load_believed(profile_file(tmp_path))
    log = read_log(run, believed.period_s, believed)
    assert log.samples_count == 2900
    assert log.start_s == pytest.approx(1.1)  # a drift goes on meanwhile
    assert log.macro_position_m[0] == pytest.approx(axis_tables[0]["position"][1100], abs=1e-12)
    assert "0.1 s (saturated)" in log.remarks[0]


def test_a_loop_that_swings_from_limit_to_limit_is_left_out_and_said(axis_tables, tmp_path):
    command = axis_tables[0]["command"].copy()
    swing = 100.0 * np.sign(np.sin(2.0 * np.pi * 80.0 * np.arange(500) / 1000.0 + 0.1))
    swing[::7] *= 0.5  # passing through
    command[2500:3000] = swing  # an unstable loop, for half a second
    command[700:760] = swing[:60]  # a move that is commanded briskly
    command[1000:1200:40] = 100.0  # peaks
    run = brought_in(with_columns(axis_tables[0], command=command), "run", tmp_path, AXIS_MAP)
    believed = load_believed(profile_file(tmp_path))
    log = read_log(run, believed.period_s, believed)
    assert log.start_s == 0.0
    assert 2499 <= log.samples_count <= 2503
    assert "0.499 s (saturated)" in log.remarks[0]


def test_an_end_position_that_the_profile_has_no_axis_for_is_said(axis_tables, tmp_path):
    table = with_columns(axis_tables[0], end=axis_tables[0]["position"][::-1])
    run = brought_in(table, "run", tmp_path, {**AXIS_MAP, "end_position_m": "end:m"})
    believed = load_believed(profile_file(tmp_path))
    remarks = plausibility.check(believed, [read_log(run, believed.period_s, believed)], [])
    assert "end_position_m is not used" in remarks[0]


# ---- runs of ours -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def homed_run(oled_profile, oled_machine, tmp_path_factory):
    """Home and move over the wire: homing moves the end's zero twice, and lines come late."""
    folder = tmp_path_factory.mktemp("homed") / "run"
    with Supervisor(oled_profile, BatchBackend(oled_machine, seed=3), folder) as stage:
        assert stage.home().finished
        stage.enable("dsmc")
        assert stage.move(0.05, "dsmc").finished
    return folder


def test_what_homing_does_is_no_recording(homed_run):
    """Both edges are pressed there in a zero that is wrong by up to half the gap."""
    believed = load_believed("oled-printer")
    rows = read_run(homed_run).rows
    rows = rows[np.isin(rows["run_phase"], [int(phase) for phase in TICKING])]
    assert np.abs(np.diff(rows["end_position_m"])).max() > 10e-6  # a zero that moved
    log = read_log(homed_run, believed.period_s, believed)
    assert 1000 < log.samples_count < rows.size - 1000
    assert log.end_position_m[-1] == pytest.approx(rows["end_position_m"][-1], abs=1e-9)
    relative_m = log.macro_position_m - log.end_position_m
    assert np.abs(np.diff(relative_m)).max() < 5e-6
    assert believed.joint is not None
    assert -believed.joint.left_m < relative_m.min() < relative_m.max() < believed.joint.right_m


def test_late_lines_are_missing_samples_and_not_old_positions(homed_run):
    believed = load_believed("oled-printer")
    log = read_log(homed_run, believed.period_s, believed)
    assert 0.02 < 1.0 - log.valid.mean() < 0.15
    steps_m = np.diff(log.macro_position_m, 3)
    assert np.abs(steps_m).max() < 0.2e-6  # an old position in a row of its own would be a step and back


def test_reported_forces_become_currents(homed_run):
    believed = load_believed("oled-printer")
    log = read_log(homed_run, believed.period_s, believed)
    assert log.macro_current_a is not None
    settled_n = 100.0 * log.macro_current_a[1:-1]  # the word of the sample before, which acts since the last SYNC
    assert np.max(np.abs(settled_n - log.macro_command_n[:-2])) <= 0.5  # one count of the word
    assert np.ptp(settled_n) > 20.0
    assert read_log(homed_run, believed.period_s).macro_current_a is None


def test_a_run_at_another_rate_is_of_another_machine(homed_run):
    with pytest.raises(RecordError, match="recorded at 1000 Hz, the profile says 2000 Hz"):
        read_log(homed_run, 0.5e-3)


def test_a_micro_that_pushes_the_macro_back_is_a_missing_effect_and_no_other_machine(stage_tables, tmp_path):
    """The macro seems to weigh as much as both where the micro's drive stands on it and nobody says so."""
    believed = load_believed("oled-printer")
    log = read_log(brought_in(stage_tables[0], "run", tmp_path, STAGE_MAP), believed.period_s, believed)
    silent = tuple(row for row in believed.effects if row["name"] != "micro_reaction")
    assert len(silent) < len(believed.effects)
    unsaid = dataclasses.replace(believed, effects=silent)
    plausibility.check_recordings(unsaid, [recording_of(log, unsaid)])
    heavier = dataclasses.replace(log, macro_command_n=2.0 * log.macro_command_n)
    for one in (believed, unsaid):
        with pytest.raises(RequestError, match=r"profile of another machine|is this machine.s profile"):
            plausibility.check_recordings(one, [recording_of(heavier, one)])


def test_beside_a_cogging_a_push_of_the_micro_is_still_no_other_machine(tmp_path):
    """A mass of 42 % more made up for some of the cogging, too, and left half of what the push that there was did."""
    generate.write(generate.draw(2939, "multi", 8.0), tmp_path)
    blind = load_set(tmp_path)
    plausibility.check_recordings(blind.believed, [recording_of(log, blind.believed) for log in blind.logs])
    heavier = [dataclasses.replace(log, macro_command_n=2.0 * log.macro_command_n) for log in blind.logs]
    with pytest.raises(RequestError, match=r"profile of another machine|is this machine.s profile"):
        plausibility.check_recordings(blind.believed, [recording_of(log, blind.believed) for log in heavier])
