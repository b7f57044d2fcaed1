"""Doubts of what is fed forward: they stiffen the observer, and the mass is found without a change of the loop."""

import numpy as np
import pytest

from bench import control_limit
from stagectl import adaptive_filter, batch, fed_forward, margins, tick
from stagectl.adaptive_filter import at_rest, in_motion, stiffening
from stagectl.laws.reference import gap_centre
from stagectl.linear_loop import GAP, RIGHT, linearise, machine_body
from stagectl.signals import SETPOINT
from stagectl.tracker import Tracker

PERIOD_S, MASS_SD_KG = 1e-3, 0.4
# Doubts first: numba warns where one record that it has compiled for is the beginning of another, as a bare filter's is.
RECORD = np.dtype([*fed_forward.FIELDS, *adaptive_filter.FIELDS])


def made(mass_sd_kg: float = MASS_SD_KG, contact_doubt_ratio: float = 0.1) -> np.ndarray:
    record = np.zeros(1, RECORD)
    adaptive_filter.init(record, PERIOD_S, 40.0, 5e-9, 0.05, 0.1)
    fed_forward.init(record, PERIOD_S, mass_sd_kg, contact_doubt_ratio)
    return record


def sampled(record: np.ndarray, acceleration_m_per_s2: float, contact_n: float = 0.0) -> float:
    """Take a sample where the reference accelerates and the joint pushes so; returns the unrest."""
    fed_forward.carry(record[0], acceleration_m_per_s2)
    adaptive_filter.step(record[0], 0.0, 0.0, fed_forward.doubted_n2(record[0], contact_n))
    return float(record["unrest_ratio"][0])


def test_doubted_changes_stiffen_and_what_stands_still_does_not():
    unit_n = 0.05 * np.sqrt(PERIOD_S)  # what the stiffest filter reckons with in a period
    record = made()
    assert sampled(record, 0.0) == 0.0
    assert sampled(record, 0.5 * unit_n / MASS_SD_KG) == pytest.approx(0.25)
    assert sampled(record, 0.5 * unit_n / MASS_SD_KG) == 0.0
    assert sampled(record, 0.5) == 1.0
    assert sampled(record, 0.5, 0.5 * unit_n / 0.1) == pytest.approx(0.25)
    assert sampled(record, 0.5, 0.5 * unit_n / 0.1) == 0.0
    assert sampled(record, 0.5, -3.0) == 1.0
    sure = made(mass_sd_kg=0.0, contact_doubt_ratio=0.0)
    assert sampled(sure, 1.0, 10.0) == 0.0


def learnt(record: np.ndarray, mass_kg: float, accelerations: np.ndarray, noise_n: float = 0.0, seed: int = 1) -> None:
    """Show the record forces of a mass that is more by `mass_kg` than believed."""
    noise = np.random.default_rng(seed).standard_normal(accelerations.size) * noise_n
    for a, more_n in zip(accelerations, noise, strict=True):
        sampled(record, a)
        fed_forward.learn(record[0], mass_kg * a + more_n, 1e-4)


def test_a_mass_is_found_where_it_accelerates_and_nowhere_else():
    record = made()
    learnt(record, 0.3, np.zeros(1000), noise_n=0.05)
    assert record["mass_error_kg"] == 0.0
    assert record["mass_variance_kg2"] == pytest.approx(MASS_SD_KG**2)
    learnt(record, 0.3, np.full(2000, -1.0), noise_n=0.02)
    assert record["mass_error_kg"] == pytest.approx(0.3, abs=0.01)
    assert record["mass_variance_kg2"] < 0.05**2
    learnt(record, 0.3, np.zeros(100_000))
    assert record["mass_error_kg"] == pytest.approx(0.3, abs=0.01)
    assert record["mass_variance_kg2"] == pytest.approx(MASS_SD_KG**2, rel=0.02)  # found long ago


def test_what_is_no_mass_is_no_more_than_three_deviations():
    record = made()
    learnt(record, -40.0, np.ones(5000))
    assert record["mass_error_kg"] == pytest.approx(-3.0 * MASS_SD_KG)


def test_in_contact_a_sample_weighs_as_little_as_the_joint_is_doubted():
    free, pressed = made(), made()
    for record, contact_n in ((free, 0.0), (pressed, 8.0)):
        for _ in range(300):
            fed_forward.carry(record[0], 1.0)
            fed_forward.doubted_n2(record[0], contact_n)
            fed_forward.learn(record[0], 0.2, 1e-4)
    assert float(free["mass_error_kg"][0]) == pytest.approx(0.2, rel=0.01)
    samples = MASS_SD_KG**2 * 300 / (160.0 * 0.8**2)  # what they weigh beside the prior
    assert float(pressed["mass_error_kg"][0]) == pytest.approx(0.2 * samples / (1.0 + samples), rel=0.01)


def test_the_force_is_carried_on_by_the_mass_that_was_found():
    record = made()
    record["mass_error_kg"] = -0.25
    assert fed_forward.carry(record[0], 0.8) == pytest.approx(-0.2)
    assert fed_forward.carry(record[0], 0.8) == 0.0
    assert fed_forward.carry(record[0], 0.0) == pytest.approx(0.2)


@pytest.mark.parametrize("place", [GAP, RIGHT])
@pytest.mark.parametrize("observer", [at_rest, in_motion, stiffening(11)])
def test_learning_changes_neither_margins_nor_stability(place, observer):
    """At a constant acceleration the mass takes its share out of the unknown force, and their sum stays."""
    profile = control_limit.stage()
    body = machine_body(control_limit.machine(profile))
    still = margins.margins(linearise(profile, "dsmc", body, place, 0.0, observer))
    for acceleration in (0.05, 1.0, -1.0):
        loop = linearise(profile, "dsmc", body, place, 0.0, observer, acceleration)
        assert "mass_error_kg" in loop.tick_states
        moving = margins.margins(loop)
        assert moving.sensitivity_peak_ratio == pytest.approx(still.sensitivity_peak_ratio, rel=1e-4)
        assert moving.delay_margin_s == pytest.approx(still.delay_margin_s, abs=5e-6)
        assert loop.closed().is_stable()


def accelerated(ratio: float) -> tuple[float, float]:
    """Follow the first acceleration of the trapezoid; returns the mass found, and the next one's peak error, m."""
    profile, rows = control_limit.stage(), control_limit.trapezoid()
    one = control_limit.machine(profile, ratio)
    made_for = tick.controller(profile, "dsmc", has_drives=False)
    simulation = batch.simulation(made_for, one, latch_delay_s=profile.cycle.actuation_delay_s, seed=31)
    at_m = float(rows["position_m"][0])
    simulation.state["end_position_m"] = at_m
    simulation.state["macro_position_m"] = at_m + float(gap_centre(made_for.belief[0]))
    rest = np.zeros(500, SETPOINT)
    rest["position_m"] = at_m
    batch.run(simulation, rest)
    batch.run(simulation, rows[:600])
    found_kg = float(made_for.estimator["mass_error_kg"][0])
    later = batch.run(simulation, rows[600:5000])
    return found_kg, float(np.max(np.abs(later.truth["end_position_m"] - later.setpoints["position_m"])[3500:]))


@pytest.mark.parametrize("ratio", [1.01, 0.99])
def test_a_wrong_mass_is_found_in_the_first_acceleration_of_a_trapezoid(ratio):
    found_kg, next_peak_m = accelerated(ratio)
    assert found_kg == pytest.approx(-40.0 * (ratio - 1.0), abs=0.04)
    assert next_peak_m < 20e-9  # 33 nm where nothing is found


def test_a_new_belief_is_believed(oled_profile):
    tracker = Tracker(oled_profile, has_drives=False)
    e = tracker.active.estimator
    e["mass_error_kg"], e["mass_variance_kg2"] = 0.3, 1e-4
    tracker.update(tracker.new_belief(), 0.0, 0.0)
    assert e["mass_error_kg"] == 0.0
    assert e["mass_variance_kg2"] == e["mass_prior_kg2"] > 0.0
