"""The paper's observer and recursion, and the project's estimator on the same samples."""

import numpy as np
import pytest

from stagectl.paper import (
    gated,
    identification_chapter,
    identification_test,
    observer_chapter,
    recursive_least_squares,
    rig_chapter,
    super_twisting,
)
from stagectl.paper.printed_values import MACRO_OBSERVER_5_2, MICRO_OBSERVER_5_2, TABLE_2, ObserverGains
from stagectl.paper.quasi_linear import forces

JOINT = (TABLE_2.left_m, TABLE_2.right_m, TABLE_2.left_stiffness_n_per_m, TABLE_2.right_stiffness_n_per_m)


@pytest.fixture(scope="module")
def platform():
    return identification_test.platform()


@pytest.fixture(scope="module")
def samples(platform):
    return identification_test.run(platform, 60.0)


# ---- the observer ---------------------------------------------------------------------------------------------


def test_gains_from_13_keep_it_and_the_printed_ones_dont():
    gains = super_twisting.gains_for(0.5)
    assert super_twisting.is_enough(gains, 0.5)
    assert not super_twisting.is_enough(ObserverGains(0.9 * gains.eta, gains.iota_m_per_s2), 0.5)
    largest = super_twisting.largest_bound_m_per_s2(MACRO_OBSERVER_5_2)
    assert largest == pytest.approx(0.286, abs=1e-3)
    assert super_twisting.is_enough(MACRO_OBSERVER_5_2, 0.999 * largest)
    assert not super_twisting.is_enough(MACRO_OBSERVER_5_2, 1.001 * largest)
    assert super_twisting.largest_bound_m_per_s2(MICRO_OBSERVER_5_2) == pytest.approx(8.5e-4, rel=0.01)


def test_the_observer_finds_a_velocity_it_was_not_given():
    dt_s = 1e-4
    t_s = np.arange(20_000) * dt_s
    position_m = 0.05 * np.sin(2.0 * t_s)
    observer = super_twisting.init(super_twisting.gains_for(0.4), 1.0, 0.0, 0.0)
    seen = super_twisting.along(observer, position_m, np.zeros_like(t_s), dt_s)
    error = np.abs(seen.velocity_m_per_s - 0.1 * np.cos(2.0 * t_s))
    assert error[0] == pytest.approx(0.1)
    assert np.max(error[5000:]) < 1e-3
    # what it can't know, the acceleration, comes out of its low-pass
    left = (seen.chi_m_per_s2 + 0.2 * np.sin(2.0 * t_s))[5000:]
    assert np.sqrt(np.mean(left**2)) < 0.04
    assert abs(np.mean(left)) < 0.005


def test_the_low_pass_has_a_gain_of_one():
    observer = super_twisting.init(ObserverGains(0.0, 2.0), 1.0, 0.0, 0.0)
    seen = super_twisting.along(observer, np.full(400, 1e9), np.zeros(400), 1e-3)
    assert seen.chi_m_per_s2[-1] == pytest.approx(2.0, rel=1e-6)
    assert seen.chi_m_per_s2[20] == pytest.approx(2.0 * (1.0 - np.exp(-1.0)), rel=0.03)  # 20 ms


def test_the_macros_observer_works_with_the_printed_gains_and_the_micros_is_lost(platform, samples):
    macro, micro = observer_chapter.axes_of(platform, samples)
    seen = macro.observed(MACRO_OBSERVER_5_2)
    assert 0.5 < observer_chapter._percent(seen.velocity_m_per_s, macro.velocity_m_per_s) < 3.0
    assert np.sqrt(np.mean((macro.force_n(seen) - samples.contact_force_n) ** 2)) < 2.0
    lost = micro.observed(MICRO_OBSERVER_5_2)
    assert observer_chapter._percent(lost.position_m, micro.position_m) > 50.0
    assert np.max(np.abs(micro.force_n(lost))) <= 1.2 + 1e-9
    kept = micro.observed(super_twisting.gains_for(micro.bound_m_per_s2))
    assert observer_chapter._percent(kept.position_m, micro.position_m) < 0.01


def test_cycles_and_times_of_an_oscillation():
    t_s = np.arange(3000) * 1e-3
    swing = np.exp(-3.0 * t_s) * np.cos(2.0 * np.pi * 5.0 * t_s)
    assert super_twisting.cycles_s(swing, 1e-3)[1:] == pytest.approx(np.full(14, 0.2), abs=2e-3)
    assert super_twisting.settled_s(swing, 0.05, 1e-3) == pytest.approx(1.0, abs=0.15)
    assert super_twisting.settled_s(np.ones(10), 0.5, 1e-3) is None
    assert super_twisting.settled_s(np.zeros(10), 0.5, 1e-3) == 0.0


def test_there_is_no_time_bound_where_iota_is_too_small():
    cycles = np.array([0.1, 0.05])
    assert super_twisting.time_bound_s(ObserverGains(1.0, 0.5), 0.5, cycles) is None
    # 2 (0.7 + 0.3)^2 / ((2 (0.7 + 0.3) + 2) (0.7 - 0.3)) = 1.25
    assert super_twisting.time_bound_s(ObserverGains(2.0**0.5, 0.7), 0.3, cycles) == pytest.approx(1.25 * 0.15)


# ---- the recursion --------------------------------------------------------------------------------------------


def test_the_recursion_finds_a_joint_whose_samples_are_marked_right():
    x_b = np.random.default_rng(1).uniform(-0.2, 0.2, 4000)
    recursion = recursive_least_squares.init(1e6, stiffness_n_per_m=500.0)
    found = recursive_least_squares.along(recursion, x_b, forces(x_b, *JOINT)[:, 0], TABLE_2, knows_edges=True)
    assert max(abs(error) for error in found.errors_percent(TABLE_2).values()) < 1e-3
    assert found.falsely_marked_ratio == 0.0


@pytest.mark.parametrize("covariance", [0.3, 1.0, 100.0])
def test_marking_the_gap_as_contact_is_what_makes_the_printed_recursion_low(samples, covariance):
    """The true force, no observer and no noise: all four low all the same, until the marking is right."""
    printed, marked = (
        recursive_least_squares.along(
            recursive_least_squares.init(covariance), samples.x_b_m, samples.contact_force_n, TABLE_2, knows
        )
        for knows in (False, True)
    )
    errors = printed.errors_percent(TABLE_2)
    assert all(error < -3.0 for error in errors.values())
    assert printed.falsely_marked_ratio > 0.05
    assert all(abs(error) < 0.3 for error in marked.errors_percent(TABLE_2).values())


def test_forgetting_takes_most_of_the_bias_away(samples):
    def worst(forgetting_ratio: float) -> float:
        recursion = recursive_least_squares.init(1.0, forgetting_ratio)
        found = recursive_least_squares.along(recursion, samples.x_b_m, samples.contact_force_n, TABLE_2)
        return max(abs(error) for error in found.errors_percent(TABLE_2).values())

    assert worst(0.9999) < 0.25 * worst(1.0)


# ---- the gated estimator --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
def test_the_gated_estimator_is_within_a_thousandth_of_a_percent_on_the_papers_test(samples, seed):
    noise_m = np.random.default_rng(seed).standard_normal((2, samples.t_s.size)) * 100e-9
    found = gated.along(samples.macro_position_m + noise_m[0], samples.end_position_m + noise_m[1], 400.0, 100.0)
    errors = recursive_least_squares.errors_percent(found.last, TABLE_2)
    assert max(abs(error) for error in errors.values()) < 1e-3


def test_the_gated_estimator_says_nothing_of_a_side_that_is_never_touched(samples):
    """The first five seconds touch the right side alone."""
    few = slice(0, 5000)
    found = gated.along(samples.macro_position_m[few], samples.end_position_m[few], 400.0, 100.0)
    assert found.last.right_m == pytest.approx(TABLE_2.right_m, rel=1e-3)
    assert np.isnan(found.last.left_m)


def test_on_the_rigs_joint_the_gated_estimator_holds_what_the_printed_one_loses():
    platform, samples = rig_chapter.recording()
    found = [rig_chapter.identified(samples, 100e-9, seed) for seed in (1, 2)]
    assert max(rig_chapter.worst(found, name) for name in ("b_l", "b_r", "K_l", "K_r")) < 0.1
    assert abs(rig_chapter._as_printed(platform, samples)["K_r"]) > 50.0


def test_the_chapter_says_when_all_four_came_within_a_percent(platform, samples):
    row = identification_chapter._time_rows(samples, identification_chapter._gated(platform, samples))[0]
    assert isinstance(row.corrected, float)
    assert 0.05 < row.corrected < 0.5
