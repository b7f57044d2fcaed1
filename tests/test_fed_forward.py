"""Doubts of what is fed forward: they stiffen the observer, and the mass is found without a change of the loop."""

import numpy as np
import pytest

from bench import control_limit
from bench.following import peak
from stagectl import adaptive_filter, batch, fed_forward, margins, tick
from stagectl.compiled import compiled
from stagectl.laws.reference import gap_centre
from stagectl.linear_loop import GAP, RIGHT, linearise, machine_body
from stagectl.signals import SETPOINT
from stagectl.tracker import Tracker

PERIOD_S, MASS_KG, NOISE_M, MASS_SD_KG = 1e-3, 40.0, 5e-9, 0.4
# Doubts first: numba warns where a record that it has compiled for begins another, as a bare filter would this one.
RECORD = np.dtype([*fed_forward.FIELDS, *adaptive_filter.FIELDS])


def made(mass_sd_kg: float = MASS_SD_KG, contact_doubt_ratio: float = 0.1) -> np.ndarray:
    record = np.zeros(1, RECORD)
    adaptive_filter.init(record, PERIOD_S, MASS_KG, NOISE_M, 0.05, 0.1)
    fed_forward.init(record, PERIOD_S, mass_sd_kg, contact_doubt_ratio)
    return record


def sampled(record: np.ndarray, acceleration_m_per_s2: float, contact_n: float = 0.0) -> float:
    """Take a sample where the reference accelerates and the joint pushes so; returns the unrest."""
    fed_forward.carry(record[0], acceleration_m_per_s2)
    adaptive_filter.step(record[0], 0.0, 0.0, fed_forward.foretell(record[0], contact_n))
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


def corner(acceleration_m_per_s2: float = 1.0, jerk_s: float = 0.1, lasting_s: float = 0.3) -> np.ndarray:
    """Return accelerations of a reference that goes off with a finite jerk, at the instants of samples."""
    up = np.linspace(0.0, acceleration_m_per_s2, round(jerk_s / PERIOD_S) + 1)
    return np.concatenate([np.zeros(300), up, np.full(round(lasting_s / PERIOD_S), acceleration_m_per_s2)])


def followed(
    record: np.ndarray,
    accelerations: np.ndarray,
    *,
    standing_n: float = 0.0,
    cable_n_per_m: float = 0.0,
    viscous_n_s_per_m: float = 0.0,
    lacking_kg: float = 0.0,
    noise_m: float = 0.0,
    parts: int = 10,
) -> np.ndarray:
    """Let a body of MASS_KG be observed that an unknown force pushes besides; returns the innovations, m.

    The reference is what the body does but for what is unknown, which a loop would make small: x, v and a are its own.
    """
    noise = np.random.default_rng(1).standard_normal(accelerations.size) * noise_m
    unknown = np.array([standing_n, cable_n_per_m, viscous_n_s_per_m, lacking_kg])
    return _followed(record, accelerations, unknown, noise, parts)


@compiled  # 0.4 million samples: one by one from Python they took a minute
def _followed(record, accelerations, unknown, noise, parts):
    e = record[0]
    x = v = seen_x = seen_v = seen_d = 0.0  # of the body beside its reference, and what the observer makes of it
    at_x = at_v = before = 0.0
    innovations = np.zeros(accelerations.size)
    h = PERIOD_S / parts
    for k in range(accelerations.size):
        a = accelerations[k]
        for part in range(parts):  # the body's own time
            now = before + (part + 0.5) / parts * (a - before)
            push = unknown[0] - unknown[1] * at_x - unknown[2] * at_v + unknown[3] * now
            x += v * h + 0.5 * push / MASS_KG * h * h
            v += push / MASS_KG * h
            at_x += at_v * h + 0.5 * now * h * h
            at_v += now * h
        before = a
        seen_d += fed_forward.carry(e, 0.5 * (e.carried_acceleration_m_per_s2 + a))
        seen_x += seen_v * PERIOD_S + 0.5 * seen_d / MASS_KG * PERIOD_S**2
        seen_v += seen_d / MASS_KG * PERIOD_S
        seen_d += fed_forward.carry(e, a)
        innovation = x + noise[k] - seen_x
        adaptive_filter.step(e, innovation, at_v, fed_forward.foretell(e, 0.0))
        seen_x += e.precise_position_gain_ratio * innovation
        seen_v += e.precise_velocity_gain_per_s * innovation
        seen_d += e.precise_force_gain_n_per_m * innovation
        fed_forward.learn(e, innovation, adaptive_filter.innovation_variance_m2(e))
        innovations[k] = innovation
    return innovations


def test_what_a_mass_shows_is_what_the_observer_misses():
    """Innovations of a body that lacks 0.01 kg, by an integrator of its own, against the recursion."""
    lacking_kg, accelerations = 0.01, corner()
    record, shown = made(mass_sd_kg=0.0), []
    innovations = followed(record, accelerations, lacking_kg=lacking_kg)
    again = made(mass_sd_kg=0.0)
    for a, innovation in zip(accelerations, innovations, strict=True):
        fed_forward.carry(again[0], a)
        adaptive_filter.step(again[0], innovation, 0.0, fed_forward.foretell(again[0], 0.0))
        shown.append(float(again["mass_shown"][0, 0]))
        fed_forward.learn(again[0], innovation, adaptive_filter.innovation_variance_m2(again[0]))
    np.testing.assert_allclose(innovations, lacking_kg * np.array(shown), atol=2e-3 * np.max(np.abs(innovations)))


@pytest.mark.parametrize("lacking_kg", [0.4, -0.4])
def test_a_mass_is_found_where_it_accelerates_and_nowhere_else(lacking_kg):
    record = made()
    followed(record, np.zeros(1000), lacking_kg=lacking_kg, noise_m=NOISE_M)
    assert record["mass_error_kg"] == 0.0
    assert record["mass_variance_kg2"] == pytest.approx(MASS_SD_KG**2)
    followed(record, corner(), lacking_kg=lacking_kg, noise_m=NOISE_M)
    assert record["mass_error_kg"] == pytest.approx(lacking_kg, rel=0.05)
    assert record["mass_variance_kg2"] < 0.06**2
    followed(record, np.zeros(400_000), noise_m=NOISE_M, parts=1)
    assert record["mass_variance_kg2"] == pytest.approx(MASS_SD_KG**2, rel=0.02)  # found long ago


UNKNOWN = {  # and what of it is taken for mass at most, kg
    "a force that stands": ({"standing_n": 0.3}, 0.05),
    "a cable": ({"cable_n_per_m": 2.0}, 0.05),
    "friction": ({"viscous_n_s_per_m": 1.0}, 0.1),  # which grows by the acceleration while the observer is behind
}


@pytest.mark.parametrize("name", UNKNOWN)
@pytest.mark.parametrize("lacking_kg", [0.0, 0.4])
def test_other_forces_are_no_mass(name, lacking_kg):
    """Fitted to the unknown force instead of to what innovations show, 0.3 N that stand were 0.3 kg."""
    force, most_kg = UNKNOWN[name]
    record = made()
    followed(record, corner(), **force, lacking_kg=lacking_kg, noise_m=NOISE_M)
    assert record["mass_error_kg"] == pytest.approx(lacking_kg, abs=most_kg)


def test_what_is_no_mass_is_no_more_than_three_deviations():
    record = made()
    followed(record, corner(), lacking_kg=-10.0)
    assert record["mass_error_kg"] == pytest.approx(-3.0 * MASS_SD_KG)


def test_a_sample_that_is_none_teaches_nothing():
    record = made()
    followed(record, corner(), lacking_kg=0.3)
    before = record.copy()
    fed_forward.learn(record[0], np.nan, 1e-16)
    assert record["mass_error_kg"] == before["mass_error_kg"]
    assert record["mass_variance_kg2"] == pytest.approx(before["mass_variance_kg2"][0], abs=1e-5)  # forgetting


def test_in_contact_a_sample_weighs_as_little_as_the_joint_is_doubted():
    """Mass and joint push at once: what is left of the variance is what the weights of all samples leave."""
    left = []
    for contact_n in (0.0, 8.0):
        record, weight = made(), 1.0 / MASS_SD_KG**2
        record["forgetting_samples"] = np.inf
        fed_forward.carry(record[0], 0.1)
        fed_forward.foretell(record[0], contact_n)  # no sample came in the period in which they began
        for _ in range(30):
            fed_forward.carry(record[0], 0.1)
            adaptive_filter.step(record[0], 0.0, 0.0, fed_forward.foretell(record[0], contact_n))
            variance_m2 = adaptive_filter.innovation_variance_m2(record[0])
            doubted_m = 0.1 * float(record["contact_shown"][0, 0])
            weight += float(record["mass_shown"][0, 0]) ** 2 / (16.0 * (variance_m2 + doubted_m**2))
            fed_forward.learn(record[0], 0.0, variance_m2)
        assert record["mass_variance_kg2"] == pytest.approx(1.0 / weight, rel=1e-9)
        left.append(float(record["mass_variance_kg2"][0]))
    assert left[0] < 0.9 * MASS_SD_KG**2 < left[1]


def test_the_force_is_carried_on_by_the_mass_that_was_found():
    record = made()
    record["mass_error_kg"] = -0.25
    assert fed_forward.carry(record[0], 0.8) == pytest.approx(-0.2)
    assert fed_forward.carry(record[0], 0.8) == 0.0
    assert fed_forward.carry(record[0], 0.0) == pytest.approx(0.2)


@pytest.mark.parametrize("place", [GAP, RIGHT])
@pytest.mark.parametrize("jerk_m_per_s3", [2.0, 10.0, 50.0])
@pytest.mark.parametrize("samples", [5, 11, 20, 60])
def test_learning_leaves_the_margins(place, jerk_m_per_s3, samples):
    """In the midst of a jerk that began at once, the mass and what is fed of it among the states."""
    profile = control_limit.stage()
    body = machine_body(control_limit.machine(profile))
    observer = fed_forward.along(jerk_m_per_s3 * PERIOD_S * np.arange(1, samples + 1))
    loop = linearise(profile, "dsmc", body, place, 0.0, observer, jerk_m_per_s3)
    assert {"mass_error_kg", "fed_n"} <= set(loop.tick_states)
    found = margins.margins(loop)
    assert found.is_stable
    assert found.sensitivity_peak_ratio <= 2.0  # 12 where what the mass feeds has no bound
    assert found.delay_margin_s >= 0.8e-3


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


def test_a_force_that_stands_on_the_end_costs_nothing():
    profile, rows = control_limit.stage(), control_limit.trapezoid()
    one = control_limit.machine(profile)
    pushed = control_limit.felt(one, {"name": "offset", "force_n": 0.3})
    peaks = [peak(control_limit.run(profile, body, rows, 31).error_m) for body in (one, pushed)]
    assert peaks[1] == pytest.approx(peaks[0], abs=3e-9)  # 71 nm where 0.3 N that stand are 0.3 kg


def test_a_new_belief_is_believed(oled_profile):
    tracker = Tracker(oled_profile, has_drives=False)
    e = tracker.active.estimator
    e["mass_error_kg"], e["mass_variance_kg2"] = 0.3, 1e-4
    tracker.update(tracker.new_belief(), 0.0, 0.0)
    assert e["mass_error_kg"] == 0.0
    assert e["mass_variance_kg2"] == e["mass_prior_kg2"] > 0.0
