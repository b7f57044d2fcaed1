"""Gains from design rules: their margins are there, in the gap and in contact; what can't be kept is refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from stagectl import trajectory
from stagectl.errors import ProfileError, RequestError
from stagectl.linear_loop import GAP, LEFT, ON_THE_WAY, RIGHT, believed_body, linearise
from stagectl.margins import grid_hz, margins
from stagectl.profile import load_profile
from stagectl.signals import Stop
from stagectl.tuning.page import verdict
from stagectl.tuning.patch import patched
from stagectl.tuning.rules import MOVING, STIFFENING, Asked, assessed, tuned
from stagectl.tuning.triangular import sensitivities
from tests.command import call
from tests.stage import followed, rms, true_error_m, with_values

GUEST = Path(__file__).parent / "guest"
MOVE = trajectory.trapezoid(0.2, 0.2, dwell_s=1.0, lead_s=0.2).setpoints


@pytest.fixture
def slack(tmp_path, oled_profile):
    """A copy of the shipped profile whose law is slow; returns the file."""
    text = oled_profile.source_path.read_text()
    changed = text.replace("micro_bandwidth_hz = 50.0", "micro_bandwidth_hz = 15.0  # by hand")
    assert changed != text
    path = tmp_path / "slack.toml"
    path.write_text(changed)
    return path


def test_the_command_writes_a_profile_whose_loops_keep_the_margins(capsys, tmp_path, slack, oled_machine):
    new = tmp_path / "tuned.toml"
    old = slack.read_text()
    code, out, _ = call(capsys, "tune", slack, "--page", tmp_path, "-o", new, "--json")
    assert code == 0
    answer = json.loads(out)
    found = load_profile(new)
    ceiling = found.control.adaptive_gain_ceiling_ratio
    loops = [(GAP, 0.0), (LEFT, 0.0), (RIGHT, 0.0), (GAP, ceiling)]
    for place, adaptive in loops:
        one = margins(linearise(found, "dsmc", believed_body(found), place, adaptive))
        assert one.is_stable
        assert one.sensitivity_peak_ratio <= 2.01
        assert one.delay_margin_s >= 0.8e-3
    way = [margins(linearise(found, "dsmc", believed_body(found), GAP, 0.0, observer)) for observer in ON_THE_WAY]
    worst = max(one.sensitivity_peak_ratio for one in way)
    assert worst <= 2.01
    assert answer["after"]["places"][STIFFENING]["sensitivity_peak_ratio"] == pytest.approx(worst, rel=1e-3)
    assert answer["after"]["worst_sensitivity_ratio"] > 1.9  # nothing is given away
    assert answer["after"]["stable_with_other_mass"]
    assert (tmp_path / "tune.html").read_text().count("<svg") == 2
    assert slack.read_text() == old
    lines = new.read_text().splitlines()
    (line,) = [line for line in lines if line.startswith("micro_bandwidth_hz")]
    assert "# by hand; tune " in line
    assert line.endswith("; was 15")
    touched = {change["key"].removeprefix("control.") for change in answer["changes"]}
    assert {one for one in old.splitlines() if one.partition(" ")[0] not in touched} <= set(lines)

    # and the machine, which the controller knows 1 % wrong, follows better with them
    before, after = (followed(one, oled_machine, "dsmc", MOVE) for one in (load_profile(slack), found))
    assert after.commands["stop"][-1] == Stop.NONE
    assert rms(true_error_m(after)) < 0.7 * rms(true_error_m(before))

    code, _, err = call(capsys, "tune", slack, "--page", tmp_path, "-o", new)
    assert code == 2
    assert "is there already" in err
    code, _, err = call(capsys, "tune", new, "--page", tmp_path, "-o", new)
    assert code == 2
    assert "is the profile itself, which is never changed" in err


@pytest.mark.parametrize("place", [GAP, RIGHT])
def test_the_quick_way_to_the_worst_loop_sees_the_same_sensitivities(oled_profile, place):
    """300 solutions against one triangular form: 1e-9 apart where the sensitivity matters; unbalanced, 30 %."""
    frequency_hz = grid_hz(oled_profile.cycle.period_s)[::5]
    for observer in ON_THE_WAY[::6]:
        one = linearise(oled_profile, "dsmc", believed_body(oled_profile), place, 0.0, observer)
        exact = 1.0 / np.abs(1.0 + one.loop_gain(frequency_hz))
        assert np.max(exact) > 1.2
        np.testing.assert_allclose(sensitivities(one, frequency_hz), exact, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", ["tuned", "tuned.tml", "tuned.toml.bak"])
def test_a_name_that_no_command_could_find_is_refused(capsys, tmp_path, slack, name):
    code, _, err = call(capsys, "tune", slack, "--page", tmp_path, "-o", tmp_path / name)
    assert code == 2
    assert f"-o {tmp_path / name}: ends in " in err
    assert "'.toml' only" in err
    assert f"give {tmp_path / name}.toml" in err
    assert not (tmp_path / name).exists()
    assert not (tmp_path / "tune.html").exists()


def test_a_bandwidth_is_met_and_one_that_has_no_margin_refused(oled_profile):
    slow = tuned(oled_profile, "dsmc", Asked(bandwidth_hz=50.0))
    assert slow.after.crossover_hz == pytest.approx(50.0, rel=0.03)
    assert slow.after.worst_sensitivity < 2.0
    with pytest.raises(
        RequestError, match=r"bandwidth of 120 Hz .* can't be kept: greatest sensitivity 3\.\d+ \(on the way\).*less"
    ):
        tuned(oled_profile, "dsmc", Asked(bandwidth_hz=120.0))


def test_more_margin_costs_stiffness(oled_profile):
    firm, gentle = (tuned(oled_profile, "dsmc", Asked(max_sensitivity=ms)).after for ms in (2.0, 1.7))
    assert gentle.worst_sensitivity <= 1.71 < firm.worst_sensitivity
    assert gentle.step_peak_m > 1.3 * firm.step_peak_m
    assert gentle.least_delay_margin_s > firm.least_delay_margin_s


def test_pid_has_its_own_number(oled_profile):
    found = tuned(oled_profile, "pid", Asked(max_sensitivity=1.8))
    assert set(found.values) == {"pid_bandwidth_hz"}
    assert 1.7 < found.after.worst_sensitivity <= 1.81


def test_what_is_unstable_whatever_the_gain_is_refused_with_a_remedy(oled_profile):
    """A spring that pushes away: 250 Hz of it are faster than any loop with this delay."""
    wild = with_values(oled_profile, micro__spring_n_per_m=-1e8)
    with pytest.raises(RequestError, match=r"unstable under dsmc with every control\.micro_bandwidth_hz .* check "):
        tuned(wild, "dsmc", Asked())


def test_gains_that_are_unstable_as_they_are_are_said_so_and_mended(oled_profile):
    wild = with_values(oled_profile, control__micro_bandwidth_hz=300.0)
    found = tuned(wild, "dsmc", Asked())
    assert math.isinf(found.before.worst_sensitivity)
    assert math.isnan(found.before.hold_m)
    assert found.after.worst_sensitivity <= 2.01
    assert found.after.worst_sensitivity > 1.85
    said = f"The gains as they were are unstable. Greatest sensitivity {found.after.worst_sensitivity:.2f}, delay"
    assert verdict(found).startswith(said)


def test_a_bandwidth_that_no_gain_has_is_refused(oled_profile):
    with pytest.raises(RequestError, match=r"no control\.micro_bandwidth_hz keeps a bandwidth of 0\.2 Hz"):
        tuned(oled_profile, "dsmc", Asked(bandwidth_hz=0.2))


def test_a_patch_keeps_comments_and_leaves_equal_values_alone():
    text = 'name = "a"\n\n[control]  # the law\nlaw = "dsmc"\neta_ratio = 1.0   # mine\ngamma_ratio = 0.02\n'
    new, changes = patched(text, {"eta_ratio": 2.0, "gamma_ratio": 0.02, "phi_m": 1e-5}, date="today", reason="Ms 2")
    assert [change.key for change in changes] == ["control.eta_ratio", "control.phi_m"]
    assert "eta_ratio = 2.0   # mine; tune today: Ms 2; was 1" in new
    assert "gamma_ratio = 0.02\n" in new
    assert "[control]  # the law" in new
    assert "phi_m = 1e-05  # tune today: Ms 2\n" in new
    with pytest.raises(ProfileError, match=r"no table \[control\]"):
        patched('name = "a"\n', {"eta_ratio": 2.0}, date="today", reason="x")
    with pytest.raises(ProfileError, match="not TOML"):
        patched("name = ", {"eta_ratio": 2.0}, date="today", reason="x")


def test_dry_friction_is_no_damping_to_live_on(single_profile):
    """At rest 6 N within 1 mm/s hide a loop's margins: with the gains that look best there the moving stage rings."""
    found = tuned(single_profile, "pid", Asked())
    places = {one.place: one.margins for one in found.after.loops}
    assert set(places) == {"gap", MOVING}
    assert found.after.worst_sensitivity == pytest.approx(places[MOVING].sensitivity_peak_ratio)
    assert 1.85 < found.after.worst_sensitivity <= 2.01
    assert places["gap"].sensitivity_peak_ratio < 1.7
    smooth = with_values(single_profile, effects=[single_profile.effects[0]])
    alone = margins(linearise(with_values(smooth, **_control(found.values)), "pid", believed_body(smooth)))
    assert alone.sensitivity_peak_ratio == pytest.approx(found.after.worst_sensitivity, rel=0.01)


def _control(values: dict[str, float]) -> dict[str, float]:
    return {f"control__{name}": value for name, value in values.items()}


@pytest.mark.parametrize("name", ["oled-printer", "oled-printer-umd2", "kang-2023", "single-axis"])
def test_shipped_gains_keep_the_margins_of_the_rules(name):
    profile = load_profile(name)
    found = assessed(profile, profile.control.law)
    assert found.worst_sensitivity <= 2.0
    assert found.least_delay_margin_s >= 0.8e-3
    assert found.stable_with_other_mass


@pytest.mark.parametrize("began_with_hz", [None, 50.0])
def test_the_gain_of_the_stage_at_100_hz_is_what_tune_finds_at_that_rate(began_with_hz):
    """Wherever the search begins; it ends within 0.6 % of the greatest bandwidth that keeps the margins."""
    profile = load_profile(GUEST / "stage-100hz.toml")
    assert (profile.cycle.rate_hz, profile.control.law) == (100.0, "pid")
    shipped_hz = profile.control.pid_bandwidth_hz
    if began_with_hz is not None:
        profile = with_values(profile, control__pid_bandwidth_hz=began_with_hz)
    found = tuned(profile, "pid", Asked())
    assert set(found.values) == {"pid_bandwidth_hz"}
    assert found.values["pid_bandwidth_hz"] == pytest.approx(shipped_hz, rel=0.007)
