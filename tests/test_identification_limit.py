"""Identification at the limit: what is doubted is found, what was not touched has no number, intervals hold."""

import numpy as np
import pytest

from bench import identification_limit as limit
from bench.joint_truth import Joint, Rig, motion
from stagectl.paper import gated

DAMPED = Joint(damping_n_s_per_m=100.0)
SEEDS = range(201, 204)


@pytest.fixture(scope="module")
def damped():
    return motion(DAMPED, Rig(), 20.0)


def pulls(one: gated.Gated, joint: Joint) -> np.ndarray:
    """Errors of edges and stiffnesses over their standard deviations."""
    sds = (one.sd.left_m, one.sd.right_m, one.sd.left_stiffness_n_per_m, one.sd.right_stiffness_n_per_m)
    return np.array(limit.errors(one, joint)) / np.array(sds)


def width_share(one: gated.Gated, joint: Joint) -> float:
    return (one.last.left_m + one.last.right_m) / joint.width_m - 1.0


def test_intervals_are_neither_boasting_nor_useless(damped):
    """The scatter over seeds is what each run says of itself."""
    found = np.array([pulls(limit.seen(damped, 100e-9, seed), DAMPED) for seed in range(201, 241)])
    assert np.all(np.mean(np.abs(found) < 1.96, axis=0) >= 0.85)  # of 40; 200 are counted in the bench
    assert np.all((np.std(found, axis=0) > 0.7) & (np.std(found, axis=0) < 1.3))


@pytest.mark.parametrize("off", [-0.01, 0.01])
def test_a_wrong_mass_is_named_and_costs_nothing(damped, off):
    for seed in SEEDS:
        one = limit.seen(damped, 100e-9, seed, mass_error_ratio=off, doubts=limit.MASS)
        assert abs(width_share(one, DAMPED)) < 0.2e-2
        assert abs(one.last.right_m - one.last.left_m - DAMPED.right_m + DAMPED.left_m) < 0.2e-6  # twice the centre
        assert one.last.left_stiffness_n_per_m == pytest.approx(DAMPED.left_n_per_m, rel=0.01)
        assert one.last.right_stiffness_n_per_m == pytest.approx(DAMPED.right_n_per_m, rel=0.01)
        assert np.all(np.abs(pulls(one, DAMPED)) < 4.0)
        assert one.mass_kg == pytest.approx(-40.0 * off, abs=4.0 * one.mass_sd_kg)
        assert one.mass_sd_kg < 0.01  # of 0.4 kg before


def test_a_wrong_mass_that_is_believed_exact_is_not_covered(damped):
    """What the calibration buys: without it the width is ten times as far off, and no interval says so."""
    calibrated = limit.seen(damped, 1e-9, 201, mass_error_ratio=0.01, doubts=limit.MASS)
    believed = limit.seen(damped, 1e-9, 201, mass_error_ratio=0.01)
    assert abs(width_share(believed, DAMPED)) > 10.0 * abs(width_share(calibrated, DAMPED))


@pytest.mark.parametrize(("touched", "other", "sign"), [("right", "left", 1.0), ("left", "right", -1.0)])
@pytest.mark.parametrize("off", [0.0, 0.01])
def test_a_side_that_is_never_touched_has_no_number(touched, other, sign, off):
    moved = motion(DAMPED, Rig(amplitude_n=3.0, offset_n=4.0 * sign), 10.0)
    assert np.all(sign * moved.contact_n >= 0.0)
    one = limit.seen(moved, 100e-9, 201, mass_error_ratio=off, doubts=limit.MASS)
    assert np.all(np.isnan(getattr(one, f"{other}_m")))
    assert np.all(np.isinf(getattr(one, f"{other}_sd_m")))
    assert getattr(one.last, f"{touched}_m") == pytest.approx(getattr(DAMPED, f"{touched}_m"), abs=0.5e-6)


def test_wear_is_followed_on_the_side_that_wears():
    rate = 0.1 * DAMPED.width_m / 60.0
    moved = motion(Joint(damping_n_s_per_m=100.0, right_wear_m_per_s=rate), Rig(), 40.0)
    one = limit.seen(moved, 10e-9, 201, edge_drift_m_per_sqrt_s=limit.EDGE_DRIFT_M_PER_SQRT_S)
    late = slice(3000, None)
    width_m = moved.left_m + moved.right_m
    assert np.max(np.abs(one.left_m + one.right_m - width_m)[late] / width_m[late]) < 0.5e-2
    assert np.max(np.abs(one.left_m - moved.left_m)[late]) < 0.2e-6
    still = limit.seen(moved, 10e-9, 201)
    assert abs(still.right_m[-1] - moved.right_m[-1]) > 3e-6  # a joint that is taken to stand still


@pytest.mark.parametrize("seed", SEEDS)
def test_onsets_of_a_soft_contact_are_found_where_a_hard_model_is_half_a_knee_off(seed):
    joint = limit.soft_joint(seed)
    moved = motion(joint, Rig(), 20.0)
    soft, hard = limit.seen(moved, 5e-9, seed, doubts=limit.SOFT), limit.seen(moved, 5e-9, seed)
    assert abs(width_share(soft, joint)) < 0.2e-2
    assert np.all(np.abs(pulls(soft, joint)[:2]) < 3.0)
    assert soft.left_knee_m[-1] == pytest.approx(joint.left_knee_m, rel=0.1)
    assert soft.right_knee_m[-1] == pytest.approx(joint.right_knee_m, rel=0.1)
    expected = 0.5 * (joint.left_knee_m + joint.right_knee_m) / joint.width_m
    assert width_share(hard, joint) == pytest.approx(expected, rel=0.2)


def test_a_hard_contact_under_doubt_has_no_knee():
    joint = Joint()
    one = limit.seen(motion(joint, Rig(), 20.0), 5e-9, 201, doubts=limit.SOFT)
    assert max(one.left_knee_m[-1], one.right_knee_m[-1]) < 2e-6
    assert abs(width_share(one, joint)) < 1e-2


def test_ordinary_motion_identifies_what_it_touches():
    b, contact_n = limit.trapezoids(201, feed_forward=False, count=1)
    assert np.min(contact_n) < -2.0
    assert np.max(contact_n) > 2.0
    assert b["left_m"] + b["right_m"] == pytest.approx(27.9e-6 + 171.3e-6, rel=0.01)
    assert (40.0 + b["mass_kg"]) / 30.0 == pytest.approx(39.6 / 30.3, rel=1e-3)  # mass to force constant
    for side in ("left", "right"):
        assert b[f"{side}_damping_n_s_per_m"] == pytest.approx(75.0, rel=0.1)


def test_ordinary_motion_says_nothing_of_edges_that_it_does_not_touch():
    b, contact_n = limit.trapezoids(201, feed_forward=True, count=1)
    assert not np.any(contact_n)
    for side in ("left", "right"):
        assert np.isnan(b[f"{side}_m"])
        assert np.isinf(b[f"{side}_sd_m"])
    assert (40.0 + b["mass_kg"]) / 30.0 == pytest.approx(39.6 / 30.3, rel=1e-3)
