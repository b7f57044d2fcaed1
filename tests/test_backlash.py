"""Identification of the backlash: exact filters, the bars in closed loop, and silence about what was not touched."""

import itertools
import math

import numpy as np
import pytest
import scipy.signal

from stagectl import backlash, batch, edges, estimator, touch_sweep, trajectory
from tests.stage import exact, followed, simulated, with_values
from tests.stage_loop import Loop

SIDES = ("left", "right")
VALUES = tuple(f"{side}_{what}" for side in SIDES for what in ("m", "stiffness_n_per_m"))
SDS = tuple(f"{side}_{what}" for side in SIDES for what in ("sd_m", "stiffness_sd_n_per_m"))


def errors(simulation, machine) -> dict[str, float]:
    """Return relative errors of stiffness and width, and errors of the edges in metres."""
    b, truth = simulation.controller.backlash[0], machine.backlash
    width_m = truth.left_m + truth.right_m
    return {
        "left_stiffness": float(b["left_stiffness_n_per_m"]) / truth.left_stiffness_n_per_m - 1.0,
        "right_stiffness": float(b["right_stiffness_n_per_m"]) / truth.right_stiffness_n_per_m - 1.0,
        "width": float(b["left_m"] + b["right_m"]) / width_m - 1.0,
        "left_m": float(b["left_m"]) - truth.left_m,
        "right_m": float(b["right_m"]) - truth.right_m,
    }


def identified(profile, machine, frequency_hz: float, *, seed: int = 1, duration_s: float = 20.0):
    """Sweep the micro over both contacts in closed loop at 100 nm noise; return the simulation."""
    machine = with_values(machine, interferometer__noise_m=100e-9)
    profile = with_values(profile, interferometer__noise_m=100e-9)
    simulation = simulated(profile, machine, "dsmc", seed=seed)
    recording = batch.run(simulation, trajectory.sweep(350e-6, frequency_hz, duration_s).setpoints)
    assert recording.commands["stop"][-1] == 0
    return simulation


# ---- bars -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frequency_hz", [0.5, 1.0, 1.5])
def test_with_true_masses_every_number_is_within_its_bar(oled_profile, oled_machine, frequency_hz):
    machine = exact(oled_machine, oled_profile)
    simulation = identified(oled_profile, machine, frequency_hz)
    found = errors(simulation, machine)
    b = simulation.controller.backlash[0]
    for side in SIDES:
        assert abs(found[f"{side}_stiffness"]) < 0.01
        assert abs(found[f"{side}_m"]) < 0.5e-6
        # what it says of its own error: neither boasting nor useless
        assert 10e-9 < b[f"{side}_sd_m"] < 0.5e-6
        assert abs(found[f"{side}_m"]) < 3.0 * b[f"{side}_sd_m"]
        assert b[f"{side}_damping_n_s_per_m"] == pytest.approx(75.0, rel=0.02)
    assert abs(found["width"]) < 0.01


@pytest.mark.parametrize("frequency_hz", [0.5, 1.0, 1.5])
def test_masses_and_force_constants_one_per_cent_wrong(oled_profile, oled_machine, frequency_hz):
    found = errors(identified(oled_profile, oled_machine, frequency_hz), oled_machine)
    assert abs(found["width"]) < 0.015
    for side in SIDES:
        # a force constant 1 % low reads as a stiffness 1 % low: an answer without that error would be luck
        assert 0.002 < abs(found[f"{side}_stiffness"]) < 0.02


def test_its_error_bars_hold_over_seeds(oled_profile, oled_machine):
    machine = exact(oled_machine, oled_profile)
    pulls = []
    for seed in range(2, 14):
        simulation = identified(oled_profile, machine, 1.0, seed=seed)
        b, found = simulation.controller.backlash[0], errors(simulation, machine)
        pulls += [found[f"{side}_m"] / b[f"{side}_sd_m"] for side in SIDES]
    assert max(np.abs(pulls)) < 3.0
    assert 0.1 < np.sqrt(np.mean(np.square(pulls))) < 1.5


def test_the_instant_of_every_sync_counts(oled_profile, oled_machine):
    """SYNCs that end 10 us rms beside where they are expected: as well explained as those that don't."""
    machine = with_values(exact(oled_machine, oled_profile), interferometer__noise_m=100e-9)
    profile = with_values(oled_profile, interferometer__noise_m=100e-9)
    simulation = simulated(profile, machine, "dsmc")
    setpoints = trajectory.sweep(350e-6, 1.0, 20.0).setpoints
    instants_s = batch.instants(simulation, setpoints.size)
    instants_s[:, 1] += np.random.default_rng(7).standard_normal(setpoints.size + 1) * 10e-6
    batch.run(simulation, setpoints, instants_s=instants_s)
    b, found = simulation.controller.backlash[0], errors(simulation, machine)
    assert 0.9 < b["residual_ratio"] < 1.15
    for side in SIDES:
        assert abs(found[f"{side}_m"]) < 3.0 * b[f"{side}_sd_m"]


def test_it_is_ready_soon_after_both_contacts(oled_profile, oled_machine):
    """Both edges to a micrometre within the first swings: a sweep of 20 s is for the last digits."""
    machine = exact(oled_machine, oled_profile)
    found = errors(identified(oled_profile, machine, 1.0, duration_s=4.0), machine)
    assert max(abs(found["left_m"]), abs(found["right_m"])) < 2e-6


def test_missed_cycles_do_not_spoil_it(oled_profile, oled_machine):
    """A pause of 30 cycles restarts the filters in full motion; what they say before they settle counts nowhere."""
    machine = with_values(exact(oled_machine, oled_profile), interferometer__noise_m=100e-9)
    profile = with_values(oled_profile, interferometer__noise_m=100e-9)
    loop = Loop(simulated(profile, machine, "dsmc"))
    for k, setpoint in enumerate(trajectory.sweep(350e-6, 1.0, 10.0).setpoints):
        # first on the way to the first contact at full speed, when nothing is known that could tell it from one
        if k >= 1250 and (k - 1250) % 1370 < 30:
            loop.skip()
        else:
            loop.cycle(setpoint)
        assert loop.stop == 0
    found = errors(loop.simulation, machine)
    assert abs(found["width"]) < 0.01
    assert max(abs(found["left_m"]), abs(found["right_m"])) < 0.5e-6
    assert max(abs(found["left_stiffness"]), abs(found["right_stiffness"])) < 0.01


def test_a_pause_at_full_speed_is_no_blow_of_the_joint(oled_profile, oled_machine):
    """Filters that start at 0.2 m/s see 800 N for a moment; were that believed, no real contact would count."""
    loop = Loop(simulated(oled_profile, oled_machine, "dsmc"))
    move = trajectory.trapezoid(0.1, 0.2, dwell_s=0.5, lead_s=0.5).setpoints
    sweep = trajectory.sweep(350e-6, 1.0, 4.0).setpoints
    for k, setpoint in enumerate(np.concatenate([move, sweep])):
        if 900 <= k < 930:
            loop.skip()
        else:
            loop.cycle(setpoint)
        assert loop.stop == 0
    b = loop.simulation.controller.backlash[0]
    assert 2.0 < b["greatest_force_n"] < 4.0
    found = errors(loop.simulation, oled_machine)
    assert max(abs(found["left_m"]), abs(found["right_m"])) < 2e-6


# ---- silence --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("touched", "other", "shift_m"), [("right", "left", -60e-6), ("left", "right", 60e-6)])
def test_a_side_that_was_not_touched_has_no_number(oled_profile, oled_machine, touched, other, shift_m):
    setpoints = trajectory.sweep(150e-6, 1.0, 20.0).setpoints
    setpoints["relative_position_m"] += shift_m
    simulation = simulated(oled_profile, oled_machine, "dsmc", relative_m=shift_m)
    force_n = batch.run(simulation, setpoints).truth["contact_force_n"]
    assert np.all(force_n >= 0.0) if touched == "right" else np.all(force_n <= 0.0)
    assert np.max(np.abs(force_n)) > 1.0
    b = simulation.controller.backlash[0]
    assert b[f"{touched}_m"] == pytest.approx(getattr(oled_machine.backlash, f"{touched}_m"), abs=0.5e-6)
    assert b[f"{touched}_sd_m"] < 0.5e-6
    assert math.isnan(b[f"{other}_m"])
    assert math.isnan(b[f"{other}_stiffness_n_per_m"])
    assert b[f"{other}_sd_m"] == b[f"{other}_stiffness_sd_n_per_m"] == math.inf


@pytest.mark.parametrize("law", ["dsmc", "pid"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_move_without_contact_says_nothing(oled_profile, oled_machine, law, seed):
    """A mass and a force constant 1 % wrong push like a contact for as long as the stage accelerates."""
    setpoints = trajectory.trapezoid(0.8, 0.2, start_m=-0.4).setpoints
    simulation = simulated(oled_profile, oled_machine, law, at_m=-0.4, seed=seed)
    assert not np.any(batch.run(simulation, setpoints).truth["contact_force_n"])
    b = simulation.controller.backlash[0]
    assert all(math.isnan(b[name]) for name in VALUES)
    assert all(b[name] == math.inf for name in SDS)
    assert b["left_samples"] == b["right_samples"] == 0.0  # nor does it spoil what a later contact says


def test_a_force_that_is_no_contact_says_nothing(oled_profile, oled_machine):
    """A push of 2 N on the micro passes the gate of force; it does not grow with the joint, so it is no edge."""
    profile = with_values(oled_profile, micro__mass_sd_kg=0.0)
    simulation = simulated(profile, oled_machine, "dsmc")
    b = simulation.controller.backlash
    q = simulation.controller.belief
    noise = np.random.default_rng(4)
    for k in range(5000):
        macro_m, end_m = noise.standard_normal(2) * 5e-9
        backlash.step(b[0], k, macro_m, end_m, -2.0, q[0])  # what balances the push
    assert b["right_samples"][0] > 4000
    assert all(math.isnan(b[name][0]) for name in VALUES)
    assert all(b[name][0] == math.inf for name in SDS)


def test_nothing_is_known_at_first(oled_profile):
    b = backlash.init(oled_profile)[0]
    assert all(math.isnan(b[name]) for name in VALUES)
    assert all(b[name] == math.inf for name in SDS)


# ---- parts ----------------------------------------------------------------------------------------------------


def test_filters_are_exact_for_inputs_of_straight_pieces(oled_profile):
    """w0^3 / (s + w0)^3 with w0 = 100 rad/s, against scipy's own simulation of it."""
    b = backlash.init(oled_profile, filter_s=0.01)
    values = np.cumsum(np.random.default_rng(2).standard_normal(400)) * 1e-5
    values[0] = 0.0
    z = (0.0, 0.0, 0.0)
    ours = [0.0]
    for old, new in itertools.pairwise(values):
        z = edges.filtered(b[0], *z, old, new)
        ours.append(z[2])
    _, expected, _ = scipy.signal.lsim(([1e6], [1.0, 300.0, 3e4, 1e6]), values, np.arange(400) * 1e-3)
    np.testing.assert_allclose(ours, expected, atol=1e-12 * np.max(np.abs(values)) + 1e-17)


def test_mean_force_is_that_of_the_current_loop(oled_profile):
    """Two words in a period, each followed with 0.15 ms, against a fine sum of the same exponentials."""
    b, q = backlash.init(oled_profile), estimator.belief(oled_profile)
    force_n, fine_s = 0.0, 1e-7
    for before, word in ((0.0, 100.0), (100.0, -50.0), (-50.0, -50.0)):
        mean_n = backlash.motor_mean_force(b[0], q[0], before, word, 2e-3, 575e-6)
        total = 0.0
        for k in range(10_000):
            goal_n = 0.06 * (before if k < 5750 else word)  # 30 N/A x 2 mA a word
            next_n = goal_n + (force_n - goal_n) * math.exp(-fine_s / 0.15e-3)
            total += 0.5 * (force_n + next_n)
            force_n = next_n
        assert mean_n == pytest.approx(total / 10_000, rel=1e-6)
        assert b["motor_force_n"][0] == pytest.approx(force_n, rel=1e-9)


@pytest.mark.parametrize("origin_m", [0.0, 1e-3, -2.5e-3])
def test_edges_are_in_the_runs_own_zero(oled_profile, oled_machine, origin_m):
    """Shift both zeros: every number but the edges stays, and they move by the shift."""
    simulation = simulated(oled_profile, oled_machine, "dsmc")
    recording = batch.run(simulation, trajectory.sweep(350e-6, 1.0, 6.0).setpoints)
    plain, shifted = backlash.init(oled_profile), backlash.init(oled_profile)
    q = simulation.controller.belief.copy()
    q["spring_n_per_m"] = 0.0  # its rest point is where the stage is, not where the zero is
    m = recording.measurements
    for k in range(m.size):
        force_n = float(recording.commands["micro_force_n"][k - 1]) if k else 0.0
        cycle, macro_m, end_m = int(m["cycle"][k]), float(m["macro_position_m"][k]), float(m["end_position_m"][k])
        backlash.step(plain[0], cycle, macro_m, end_m, force_n, q[0])
        backlash.step(shifted[0], cycle, macro_m + origin_m, end_m, force_n, q[0])
    assert shifted["right_m"][0] - origin_m == pytest.approx(plain["right_m"][0], abs=1e-10)
    assert shifted["left_m"][0] + origin_m == pytest.approx(plain["left_m"][0], abs=1e-10)
    assert shifted["left_stiffness_n_per_m"][0] == pytest.approx(plain["left_stiffness_n_per_m"][0], rel=1e-6)


def test_a_joint_that_wears_is_followed_where_drift_is_allowed_for(oled_profile, oled_machine):
    """An edge that moves by 10 um between two sweeps is found where it is, not between there and where it was."""
    machine = exact(oled_machine, oled_profile)
    found = {}
    for drift_m_per_sqrt_s in (0.0, 1e-7):
        simulation = simulated(oled_profile, machine, "dsmc")
        simulation.controller.backlash["edge_drift_m_per_sqrt_s"] = drift_m_per_sqrt_s
        sweep = trajectory.sweep(350e-6, 1.0, 20.0).setpoints
        batch.run(simulation, sweep)
        simulation.parameters["right_m"] += 10e-6
        batch.run(simulation, sweep)
        found[drift_m_per_sqrt_s] = float(simulation.controller.backlash["right_m"][0]) - 181.3e-6
    assert abs(found[1e-7]) < 0.2e-6
    assert -8e-6 < found[0.0] < -3e-6  # half of all it remembers is from before


def test_followed_by_hand_is_followed_by_the_tick(oled_profile, oled_machine):
    """The estimate that a recording shows a cycle is the one that the controller holds at its end."""
    recording = followed(oled_profile, oled_machine, "dsmc", trajectory.sweep(350e-6, 1.0, 4.0).setpoints)
    assert recording.backlash.shape == (recording.commands.size, 4)
    assert math.isnan(recording.backlash[0, 0])
    assert recording.backlash[-1, 0] == pytest.approx(27.9e-6, abs=1e-6)
    assert recording.backlash[-1, 1] == pytest.approx(171.3e-6, abs=1e-6)


def test_what_lines_bring_a_cycle_late_is_identified_with(oled_profile, oled_machine):
    """Three lines in ten are late, as they are behind a slow adapter: 0.4 nm, and 6.5 nm of what was predicted."""
    setpoints = touch_sweep.planned(oled_profile, 0.8, 1.0, 8.0, 1.0).setpoints
    edges_m = []
    for ratio in (0.0, 0.3):
        simulation = simulated(oled_profile, exact(oled_machine, oled_profile), "dsmc", seed=3)
        batch.run(simulation, setpoints, np.random.default_rng(7).random(setpoints.size) < ratio)
        edges_m.append(simulation.controller.backlash[["left_m", "right_m"]][0])
        assert simulation.controller.backlash["left_sd_m"][0] < 100e-9
    for name in ("left_m", "right_m"):
        assert edges_m[1][name] == pytest.approx(edges_m[0][name], abs=2e-9)
