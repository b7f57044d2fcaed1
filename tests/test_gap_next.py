"""The next move: chosen by what it would show, predicted before the run, judged by a run that nobody had seen."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stagectl import cli
from stagectl.commands.opening import home_and_arm
from stagectl.errors import RequestError
from stagectl.gap import moves, next_move, prediction
from stagectl.gap.balance import recording_of, set_noise
from stagectl.gap.believed import load_believed
from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.gap.findings_file import FINDINGS, read_findings, write_findings
from stagectl.gap.log import log_of_rows, read_log
from stagectl.gap.noise import slow_noise
from stagectl.gap.planned import planned_log
from stagectl.gap.predicted_columns import observed
from stagectl.motion import check
from stagectl.profile import load_profile
from stagectl.record import read_run
from stagectl.stage import open_stage

FORCE_RATIO = 39.6 / 40.0
"""Of what the rig's motor makes to what the profile takes it for: forces and masses below are what the profile sees."""

KNOWN = f"""
[[effects]]
name = "viscous_friction"
acts_on = "macro_force"
damping_n_s_per_m = {18.5 / FORCE_RATIO:.5g}

[[effects]]
name = "cogging"
acts_on = "macro_force"
amplitude_n = {2.0 / FORCE_RATIO:.5g}
pitch_m = 0.032
phase_rad = 1.1

[[effects]]
name = "offset"
acts_on = "macro_force"
force_n = {0.4 / FORCE_RATIO:.5g}
"""
"""What sim_backend/machines/single-axis.toml has, but for its Coulomb friction."""

LEVEL_N = 6.4 / FORCE_RATIO
COULOMB = Named(
    "coulomb_friction", "macro_force", {"level_n": LEVEL_N, "smoothing_m_per_s": 1e-3}, {"level_n": 0.05}, 1e4, 1e3, ()
)
TRAINING = ("middle stroke", "slow stroke")


def findings_of(named: tuple[Named, ...], runs: tuple[str, ...]) -> Findings:
    return Findings(
        "single-axis", runs, (), "found", named, (), {}, ("thermal_drift on macro_sensor",), None,
        (1e4, 1e3), (0.0, 0.0), (20.0, 12.0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """Profile file, its moves by name, and runs of the rig, all over the wire in virtual time."""
    folder = tmp_path_factory.mktemp("next")
    file = folder / "single-axis.toml"
    text = Path("profiles/single-axis.toml").read_text().split("[[effects]]")[0]
    file.write_text(text.replace("mass_kg = 12.0\n", f"mass_kg = {12.12 / FORCE_RATIO:.5g}\n") + KNOWN)
    profile = load_profile(file)
    library = {m.name: m for m in moves.library(moves.room_of(profile), lambda planned: check(planned, profile))}

    def record(name: str, seed: int = 3):
        with open_stage(
            profile, "batch", runs_root=folder / "runs", name=name.replace(" ", "-"), seed=seed
        ) as connected:
            assert home_and_arm(connected).finished
            done = connected.run(library[name].trajectory, profile.control.law)
            assert done.finished, done.text
        return connected.folder, done

    return file, library, record, tuple(str(record(name)[0]) for name in TRAINING)


@pytest.fixture(scope="module")
def settled(stage):
    """Evidence of the true finding, and a run of slow reversals that it did not see."""
    file, _, record, runs = stage
    believed = load_believed(file)
    logs = [read_log(Path(run), believed.period_s, believed) for run in runs]
    folder, done = record("slow reversals", seed=9)
    rows = read_run(folder).rows[done.first_row : done.first_row + done.rows]
    unseen = log_of_rows(rows, "unseen", believed.period_s, "unseen", imported=False, believed=believed)
    return believed, logs, runs, unseen


def judged(settled, library, named: Named) -> tuple[prediction.Expected, prediction.Outcome]:
    believed, logs, runs, unseen = settled
    seen = prediction.evidence(believed, logs, findings_of((named,), runs))
    expected = prediction.expected(seen, planned_log(library["slow reversals"].trajectory, believed))
    return expected[0], prediction.judged(seen, unseen, expected)[0]


def test_a_true_finding_holds(stage, settled):
    expected, outcome = judged(settled, stage[1], COULOMB)
    assert expected.decides
    assert outcome.confirmed
    assert expected.fall_interval[0] < outcome.fall < expected.fall_interval[1]
    assert outcome.gap_after < 0.05 * outcome.gap_before
    assert outcome.gap_before == pytest.approx(expected.gap_before, rel=0.1)


@pytest.mark.parametrize("level_n", [3.2, 9.6])
def test_a_finding_of_another_size_does_not(stage, settled, level_n):
    wrong = replace(COULOMB, parameters={**COULOMB.parameters, "level_n": level_n})
    _, outcome = judged(settled, stage[1], wrong)
    assert not outcome.confirmed
    assert outcome.share == pytest.approx(LEVEL_N / level_n, rel=0.1)


def test_a_wrong_name_loses_against_its_alias(stage, settled):
    """Dry friction taken for a drag: the slow move shows a tiny part of it, and the alias explains the run."""
    wrong = Named(
        "quadratic_drag", "macro_force", {"drag_n_s2_per_m2": 600.0}, {"drag_n_s2_per_m2": 10.0}, 1e4, 1e3,
        (("coulomb_friction", "macro_force", 2.0),),
    )  # fmt: skip
    _, outcome = judged(settled, stage[1], wrong)
    assert not outcome.confirmed
    assert [row[0] for row in outcome.better] == ["coulomb_friction"]


def test_an_alias_is_ruled_out_by_a_run_on_which_they_differ(stage, settled):
    named = replace(COULOMB, aliases=(("quadratic_drag", "macro_force", 3.0),))
    expected, outcome = judged(settled, stage[1], named)
    assert expected.separations[0][2] > prediction.DETECTED
    assert [row[0] for row in outcome.out] == ["quadratic_drag"]
    after = prediction.with_outcomes(findings_of((named,), ()), [outcome]).named[0]
    assert after.confirmed
    assert after.aliases == ()


def test_low_speed_friction_asks_for_low_speed(stage, settled):
    believed, logs, runs, _ = settled
    seen = prediction.evidence(believed, logs, findings_of((COULOMB,), runs))
    (proposal,) = next_move.proposals(seen, list(stage[1].values()))
    assert proposal.move.name in ("slow reversals", "creep")
    assert proposal.decides


def test_every_move_keeps_to_travel_and_limits(stage):
    profile = load_profile(stage[0])
    low_m, high_m = profile.macro.travel_m
    assert len(stage[1]) >= 9
    for move in stage[1].values():
        rows = move.trajectory.setpoints
        assert low_m < rows["position_m"].min()
        assert rows["position_m"].max() < high_m
        assert np.max(np.abs(rows["velocity_m_per_s"])) <= profile.macro.velocity_limit_m_per_s
        assert np.max(np.abs(rows["acceleration_m_per_s2"])) <= profile.macro.acceleration_limit_m_per_s2


def test_planned_commands_leave_no_gap(stage, settled):
    """Under the commands that were planned for it a believed machine moves as planned, to within the noise."""
    believed = settled[0]
    recording = recording_of(planned_log(stage[1]["middle stroke"].trajectory, believed), believed)
    set_noise(recording, slow_noise(believed, recording))
    z = observed(recording)
    assert np.sqrt(np.mean(z * z)) < 1.0


@pytest.fixture(scope="module")
def unseen_sine(stage):
    """Rows of an accelerated move that no fit saw."""
    folder, done = stage[2]("sine 1 Hz", seed=8)
    return read_run(folder).rows[done.first_row : done.first_row + done.rows]


def test_a_wrong_parameter_is_predicted_and_judged_like_an_effect(stage, settled, unseen_sine):
    """The mass is believed too small: a run that nobody saw shows the error as found, and neither twice nor minus it.

    To first order, as findings state it, 15 % more mass make the same forces 1 - 1 / 1.15 less of an acceleration. An
    error of 5 % would decide nothing: on one axis a force constant that is 1 % uncertain hides a fifth of it.
    """
    believed, logs, runs, _ = settled
    light = replace(believed, macro=replace(believed.macro, mass_kg=believed.macro.mass_kg / 1.15))
    true = 1.0 - 1.0 / 1.15
    friction = replace(
        COULOMB, parameters={**COULOMB.parameters, "level_n": LEVEL_N * (1.0 - true)}
    )  # fitted beside it
    sine = stage[1]["sine 1 Hz"]
    unseen = log_of_rows(unseen_sine, "unseen", believed.period_s, "unseen", imported=False, believed=light)
    for error, held in ((true, True), (2.0 * true, False), (-true, False)):
        wrong = ParameterError("macro_mass_kg", error, 1e-3, 0.01)
        findings = replace(findings_of((friction,), runs), parameter_errors=(wrong,), refitted={"macro_mass_kg": error})
        seen = prediction.evidence(light, logs, findings)
        expected = prediction.expected(seen, planned_log(sine.trajectory, light))
        assert [(one.name, one.acts_on) for one in expected][1:] == [("macro_mass_kg", "parameter")]
        assert expected[1].decides or not held
        outcome = prediction.judged(seen, unseen, expected)[1]
        assert outcome.confirmed is held, outcome
        after = prediction.with_outcomes(findings, [outcome])
        assert after.parameter_errors[0].confirmed is held
        assert not after.named[0].confirmed  # of which this outcome says nothing


def test_parameters_alone_are_something_to_confirm(stage, settled):
    believed, logs, runs, _ = settled
    wrong = ParameterError("macro_mass_kg", 0.05, 1e-3, 0.01)
    light = replace(believed, macro=replace(believed.macro, mass_kg=believed.macro.mass_kg / 1.05))
    alone = replace(findings_of((), runs), parameter_errors=(wrong,), refitted={"macro_mass_kg": 0.05})
    seen = prediction.evidence(light, logs, alone)
    (proposal,) = next_move.proposals(seen, [stage[1][name] for name in ("creep", "sine 3 Hz")])
    assert (proposal.name, proposal.move.name) == ("macro_mass_kg", "sine 3 Hz")
    with pytest.raises(RequestError, match="name no effect"):
        prediction.evidence(light, logs, replace(alone, unknown={"over": "t_s"}))


def test_nothing_named_is_nothing_to_predict(settled):
    believed, logs, runs, _ = settled
    with pytest.raises(RequestError, match="name no effect"):
        prediction.evidence(believed, logs, findings_of((), runs))


def test_the_command_predicts_moves_and_confirms(stage, tmp_path):
    file, _, _, runs = stage
    write_findings(findings_of((COULOMB,), runs), tmp_path / FINDINGS)
    asked = ["gap", "next", str(tmp_path), "--profile", str(file), "--runs", str(tmp_path / "runs"), "--json"]
    answer = CliRunner().invoke(cli.app, [*asked, "--run", "--backend", "batch", "--seed", "5"])
    assert answer.exit_code == 0, answer.stderr
    data = json.loads(answer.stdout)
    assert data["judged"] == [{"name": "coulomb_friction", "acts_on": "macro_force", "confirmed": True}]
    assert read_findings(tmp_path / FINDINGS).named[0].confirmed
    written = json.loads((tmp_path / "prediction.json").read_text())
    judged = json.loads((tmp_path / "outcome.json").read_text())
    assert written["expected"][0]["fall_interval"][0] <= judged["judged"][0]["fall"]
    assert judged["judged"][0]["fall"] <= written["expected"][0]["fall_interval"][1]
