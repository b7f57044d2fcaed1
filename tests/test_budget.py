"""The error budget: its sum is what was measured, each source is what the machine shows, a run is predicted too."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from bench.limits import over_as_stiff
from stagectl import batch, trajectory
from stagectl.budget import budget, measured, shares
from stagectl.budget.disturbances import COGGING, CONTACT, DELAY, FORCE, MODEL, SENSOR, STEP, forces_missing, noises_of
from stagectl.budget.measured import Stretch
from stagectl.budget.page import report
from stagectl.errors import RequestError
from stagectl.linear_loop import machine_body
from stagectl.signals import SETPOINT
from tests.command import call
from tests.stage import followed, simulated, true_error_m, with_values


@pytest.fixture(scope="module")
def held(oled_profile, oled_machine):
    """The budget of the stage that the project ships."""
    return budget.of_machine(oled_profile, "dsmc", oled_machine, seed=1)


def test_without_a_loop_as_stiff_nothing_is_held_against_it(held):
    assert over_as_stiff(held).holds
    alone = over_as_stiff(replace(held, bounds=replace(held.bounds, as_stiff=None)))
    assert alone.holds is False
    assert alone.as_json()["value"] is None
    assert "no loop with Ms 2.0" in alone.reason


def test_the_sum_of_the_sources_is_what_was_measured(held):
    (part,) = held.parts
    assert part.agrees
    assert part.ratio == pytest.approx(1.0, abs=0.05)
    assert sum(share.predicted_m2 for share in part.shares) == pytest.approx(part.spectra.rms_m**2)
    assert np.sum(part.measured_cells_m2) == pytest.approx(part.stretch.rms_m**2, rel=1e-6)


def test_so_do_the_cumulative_spectra_on_their_way(held):
    """Not only the end: at 5, 20 and 60 Hz as much has come together as was measured."""
    (part,) = held.parts
    predicted, seen = np.cumsum(part.spectra.total), np.cumsum(part.measured_cells_m2)
    for hertz in (5.0, 20.0, 60.0):
        cell = int(np.searchsorted(part.spectra.edge_hz, hertz)) - 1
        assert math.sqrt(predicted[cell]) == pytest.approx(math.sqrt(seen[cell]), rel=0.15)


def test_a_source_that_is_switched_off_takes_its_share(held):
    found = {share.source: share for share in held.parts[0].shares}
    for source in (STEP, DELAY):
        assert found[source].measured_m2 == pytest.approx(found[source].predicted_m2, rel=0.3)
    assert found[FORCE].measured_m2 > 0.5 * found[FORCE].predicted_m2
    # with the noise goes part of what delay and rounding add to it
    assert found[SENSOR].predicted_m2 < found[SENSOR].measured_m2 < 0.99 * held.parts[0].stretch.rms_m ** 2
    assert found[COGGING].predicted_m2 == found[CONTACT].predicted_m2 == 0.0


@pytest.mark.parametrize(
    ("law", "values"),
    [("pid", {}), ("dsmc", {"micro__rated_force_n": 180.0}), ("dsmc", {"interferometer__noise_m": 20e-9})],
)
def test_other_laws_and_noises_are_predicted_as_well(oled_profile, oled_machine, law, values):
    profile = with_values(oled_profile, **values)
    machine = oled_machine
    if "interferometer__noise_m" in values:
        machine = with_values(machine, **values)
    if "micro__rated_force_n" in values:  # three times the step: the drive's rating, in both files
        profile = with_values(profile, micro__rated_current_a=6.0)
        machine = with_values(machine, micro__rated_current_a=6.0)
    held = measured.hold(profile, machine, law, seed=2)
    said = shares.total_rms_m(profile, law, noises_of(profile, machine), machine_body(machine))
    assert said == pytest.approx(held.rms_m, rel=0.15)


def test_cogging_at_an_even_speed_is_predicted(oled_profile, oled_machine):
    """The profile knows none; the machine's is made great, and its noise and torque steps small."""
    great = {"name": "cogging", "acts_on": "macro_force", "amplitude_n": 30.0, "pitch_m": 0.01, "phase_rad": 0.4}
    fine = {"micro__rated_force_n": 0.6, "micro__rated_current_a": 0.02}
    profile = with_values(oled_profile, **fine)
    oled_machine = with_values(oled_machine, **fine, micro__force_noise_n=1e-4, interferometer__noise_m=0.2e-9)
    rows = tuple(great if row["name"] == "cogging" else row for row in oled_machine.effects)
    machine = oled_machine.model_copy(update={"effects": rows})
    planned = trajectory.trapezoid(0.8, 0.2, dwell_s=0.1, start_m=-0.4, lead_s=0.2).setpoints
    recording = followed(profile, machine, "dsmc", planned)
    even = np.flatnonzero(np.abs(planned["acceleration_m_per_s2"]) < 1e-9)
    even = even[planned["velocity_m_per_s"][even] > 0.19]
    part = slice(int(even[0]) + 500, int(even[-1]))
    seen = shares.binned(true_error_m(recording)[part], 1e-3, shares.edges_hz(1e-3))
    forces = forces_missing(profile, machine, planned[part], None)
    noises = noises_of(profile, machine)
    said = shares.spectra(profile, "dsmc", noises, body=machine_body(machine), forces=forces)
    assert said.power_m2(COGGING) > 3.0 * (said.rms_m**2 - said.power_m2(COGGING))
    assert math.sqrt(np.sum(seen)) == pytest.approx(said.rms_m, rel=0.15)


def test_forces_that_the_profile_lacks_stand_where_they_belong(oled_profile, oled_machine):
    setpoints = np.zeros(4, SETPOINT)
    setpoints["position_m"] = [0.0, 0.1, 0.2, 0.3]
    edge_m = oled_machine.backlash.right_m
    stiff = oled_machine.backlash.right_stiffness_n_per_m
    x_b_m = np.array([0.0, edge_m, edge_m + 100e-6, edge_m + 200e-6])
    found = forces_missing(oled_profile, oled_machine, setpoints, x_b_m)
    cable = next(row for row in oled_machine.effects if row["name"] == "cable_spring")
    slope = np.diff(found.rows(MODEL)["macro"]) / 0.1
    assert slope == pytest.approx(-cable["stiffness_n_per_m"])
    assert np.max(np.abs(found.rows(COGGING)["macro"])) == pytest.approx(3.0, rel=0.3)
    believed = oled_profile.backlash
    known_n = believed.right_stiffness_n_per_m * (edge_m + 200e-6 - believed.right_m)
    assert found.rows(CONTACT)["micro"][-1] == pytest.approx(stiff * 200e-6 - known_n)
    assert found.rows(CONTACT)["macro"] == pytest.approx(-found.rows(CONTACT)["micro"])


def test_a_real_stage_states_no_force_noise_and_its_run_shows_it(oled_profile, oled_machine):
    """With one density of the observer: 30 mN where 5 are stated keep an adaptive one stiffer than a hold's."""
    noisy = with_values(oled_machine, micro__force_noise_n=0.03)
    profile = with_values(oled_profile, control__rest_drift_ratio=1.0)
    recording = batch.run(simulated(profile, noisy, "dsmc"), np.zeros(20_000, SETPOINT))
    error_m = recording.measurements["end_position_m"][2000:]
    stretch = Stretch("hold", error_m, 1e-3, is_true=False)
    found = budget.of_stretches(profile, "dsmc", None, [stretch])
    assert found.is_force_noise_fitted
    assert found.noises.force_n["micro"] == pytest.approx(0.03, rel=0.15)
    assert found.parts[0].ratio == pytest.approx(1.0, abs=0.1)
    assert "fitted" in report("x", found).html()


def test_the_bound_is_below_every_law_and_its_advice_saves_what_it_says(held, oled_profile, oled_machine):
    bounds = held.bounds
    assert bounds.hold.true_rms_m <= bounds.robust.true_rms_m <= bounds.stiff.true_rms_m
    assert bounds.hold.true_rms_m < held.hold_m
    assert bounds.robust.true_rms_m < bounds.as_stiff.true_rms_m < bounds.stiff.true_rms_m
    assert held.hold_m == pytest.approx(bounds.as_stiff.true_rms_m, rel=0.1)  # nothing is given away
    assert bounds.around.delay_s == pytest.approx(575e-6 + 150e-6)
    savings = [lever.saved_m for lever in held.levers]
    assert savings == sorted(savings, reverse=True)
    halved = next(lever for lever in held.levers if lever.what.startswith("halve the sensor's noise"))
    quiet = with_values(oled_machine, interferometer__noise_m=2.5e-9)
    assert measured.hold(oled_profile, quiet, "dsmc", seed=3).rms_m == pytest.approx(halved.hold_m, rel=0.1)


def test_an_unstable_loop_has_no_budget(oled_profile, oled_machine):
    wild = with_values(oled_profile, control__micro_bandwidth_hz=400.0)
    with pytest.raises(RequestError, match=r"loop is unstable .* lower control\.micro_bandwidth_hz"):
        shares.total_rms_m(wild, "dsmc", noises_of(wild, oled_machine), machine_body(oled_machine))


def test_the_command_on_a_run(capsys, tmp_path):
    plain = ("--trajectory", "trapezoid", "--stroke-m", 0.5, "--start-m", -0.25, "--dwell-s", 2, "--backend", "plant")
    assert call(capsys, "run", *plain, "--runs", tmp_path)[0] == 0
    code, out, _ = call(capsys, "budget", "oled-printer", "latest", "--runs", tmp_path, "--out", tmp_path, "--json")
    assert code == 0
    answer = json.loads(out)
    assert [part["name"] for part in answer["parts"]] == ["hold", "200 mm/s"]
    assert all(part["agrees"] and part["is_true_position"] for part in answer["parts"])
    assert answer["parts"][1]["sources"][4]["predicted_m2"] > 0.0  # cogging, which a hold does not show
    assert answer["over_bound_ratio"] > 1.0
    page = (tmp_path / "budget.html").read_text()
    assert page.count("<svg") == 5
    code, _, err = call(capsys, "budget", "kang-2023", "latest", "--runs", tmp_path, "--out", tmp_path)
    assert code == 2
    assert "is of profile oled-printer, not of kang-2023" in err


def test_the_command_refuses_a_profile_that_nothing_plays(capsys, tmp_path, oled_profile):
    text = oled_profile.source_path.read_text().replace('name = "oled-printer"', 'name = "nobody"', 1)
    (tmp_path / "nobody.toml").write_text(text)
    for eds in oled_profile.source_path.parent.glob("*.eds"):
        (tmp_path / eds.name).write_text(eds.read_text())
    code, _, err = call(capsys, "budget", tmp_path / "nobody.toml", "--out", tmp_path)
    assert code == 2
    assert "no machine of that name to measure on; give a RUN" in err
