"""The filter of the axis that carries the end: scipy's gains at both ends, stiff under a force, soft in noise."""

import numpy as np
import pytest
import scipy.linalg

from stagectl import adaptive_filter as one

PERIOD_S, MASS_KG, NOISE_M, DRIFT, HELD_N = 1e-3, 40.0, 5e-9, 0.05, 5e-3
RECORD = np.dtype([*one.FIELDS])


def made(rest_drift_ratio: float = 0.12, force_noise_n: float = HELD_N, jitter_s: float = 0.0) -> np.ndarray:
    record = np.zeros(1, RECORD)
    one.init(record, PERIOD_S, MASS_KG, NOISE_M, DRIFT, rest_drift_ratio, force_noise_n, jitter_s)
    return record


def gains(record) -> np.ndarray:
    names = ("precise_position_gain_ratio", "precise_velocity_gain_per_s", "precise_force_gain_n_per_m")
    return np.array([float(record[name][0]) for name in names])


def by_scipy(drift_n_per_sqrt_s: float, force_noise_n: float, noise_m: float = NOISE_M) -> np.ndarray:
    """Solve the filter in SI: the walk by expm (van Loan), the held force by its step."""
    h, m = PERIOD_S, MASS_KG
    rate = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0 / m], [0.0, 0.0, 0.0]])
    walk = np.diag([0.0, 0.0, drift_n_per_sqrt_s**2])
    both = scipy.linalg.expm(np.block([[-rate, walk], [np.zeros((3, 3)), rate.T]]) * h)
    step = both[3:, 3:].T
    held = np.array([h * h / (2 * m), h / m, 0.0]) * force_noise_n
    noise = step @ both[:3, 3:] + np.outer(held, held)
    seen = np.array([[1.0], [0.0], [0.0]])
    p = scipy.linalg.solve_discrete_are(step.T, seen, 0.5 * (noise + noise.T), np.array([[noise_m**2]]))
    return p[:, 0] / (p[0, 0] + noise_m**2)


@pytest.mark.parametrize(("state", "ratio"), [(one.at_rest, 0.12), (one.in_motion, 1.0)])
def test_both_ends_are_kalman_filters_and_stay_where_they_are(state, ratio):
    record = made()
    np.testing.assert_allclose(gains(record), by_scipy(0.12 * DRIFT, HELD_N), rtol=1e-4)  # it begins at rest
    state(record)
    np.testing.assert_allclose(gains(record), by_scipy(ratio * DRIFT, HELD_N), rtol=1e-4)
    for _ in range(50):
        one.step(record[0], 0.0, 0.0, 0.0)
    np.testing.assert_allclose(gains(record), by_scipy(ratio * DRIFT, HELD_N), rtol=1e-4)


def test_without_a_ratio_it_is_one_filter_whatever_it_is_shown():
    record = made(rest_drift_ratio=1.0)
    before = gains(record)
    for innovation_m in (0.0, 1e-6, -1e-3, 0.0):
        one.step(record[0], innovation_m, 0.0, 0.0)
        np.testing.assert_allclose(gains(record), before, rtol=1e-9)
        assert record["unrest_ratio"] == 1.0


def test_without_a_ratio_only_the_noise_of_its_speed_makes_it_softer():
    record = made(rest_drift_ratio=1.0, jitter_s=1e-6)
    for _ in range(2000):
        one.step(record[0], 0.0, 0.2, 0.0)
    np.testing.assert_allclose(gains(record), by_scipy(DRIFT, HELD_N, np.hypot(NOISE_M, 0.2e-6)), rtol=1e-3)


def test_a_force_stiffens_it_within_thirty_samples_and_noise_does_not():
    record = made()
    one.in_motion(stiff := made())
    noise = np.random.default_rng(5).standard_normal(20000) * NOISE_M * 1.1
    unrest = []
    for innovation_m in noise:
        one.step(record[0], innovation_m, 0.0, 0.0)
        unrest.append(float(record["unrest_ratio"][0]))
    assert np.mean(unrest) < 0.05
    for innovation_m in noise[:30] + 3.0 * NOISE_M:
        one.step(record[0], innovation_m, 0.0, 0.0)
    assert record["unrest_ratio"] == 1.0
    np.testing.assert_allclose(gains(record), gains(stiff), rtol=0.02)
    one.at_rest(soft := made())
    for _ in range(300):
        one.step(record[0], 0.0, 0.0, 0.0)
    np.testing.assert_allclose(gains(record), gains(soft), rtol=0.02)


def test_what_strikes_at_rest_is_on_its_way_from_soft_to_stiff():
    ends = []
    for state in (one.at_rest, one.in_motion):
        state(record := made())
        ends.append(gains(record)[2])
    on_the_way = []
    for samples in (2, 6, 12, 40):
        one.stiffening(samples)(record := made())
        on_the_way.append(gains(record)[2])
    assert ends[0] < on_the_way[0] < on_the_way[1] < on_the_way[2] < on_the_way[3]
    assert on_the_way[3] == pytest.approx(ends[1], rel=1e-2)


def test_nan_is_no_rest():
    record = made()
    one.step(record[0], float("nan"), 0.0, 0.0)
    assert record["unrest_ratio"] == 1.0
    assert np.all(np.isfinite(gains(record)))


@pytest.mark.parametrize("velocity_m_per_s", [0.2, -0.2, 0.02])
def test_jitter_is_noise_at_a_speed_and_no_force(velocity_m_per_s):
    jitter_s = 1e-6
    noise_m = np.hypot(NOISE_M, velocity_m_per_s * jitter_s)
    record = made(jitter_s=jitter_s)
    np.testing.assert_allclose(gains(record), by_scipy(0.12 * DRIFT, HELD_N), rtol=1e-4)  # none at standstill
    unrest = []
    for innovation_m in np.random.default_rng(6).standard_normal(5000) * noise_m * 1.1:
        one.step(record[0], innovation_m, velocity_m_per_s, 0.0)
        unrest.append(float(record["unrest_ratio"][0]))
    assert np.mean(unrest) < 0.05
    for _ in range(4000):
        one.step(record[0], 0.0, velocity_m_per_s, 0.0)
    drift = 0.12 * DRIFT / np.sqrt(noise_m / NOISE_M)  # the louder, the softer
    np.testing.assert_allclose(gains(record), by_scipy(drift, HELD_N, noise_m), rtol=1e-3)
    one.at_speed(velocity_m_per_s)(settled := made(jitter_s=jitter_s))
    one.step(settled[0], 0.0, 0.0, 0.0)  # and stays so where nothing moves: a loop is linearised at rest
    np.testing.assert_allclose(gains(settled), by_scipy(drift, HELD_N, noise_m), rtol=1e-4)


def unrest(velocity_m_per_s: float, seed: int) -> np.ndarray:
    """What white noise as loud as a speed makes it makes of u, 50 000 samples."""
    record = made(jitter_s=1e-6)
    noise_m = np.hypot(NOISE_M, velocity_m_per_s * 1e-6) * 1.1
    found = []
    for innovation_m in np.random.default_rng(seed).standard_normal(50_000) * noise_m:
        one.step(record[0], innovation_m, velocity_m_per_s, 0.0)
        found.append(float(record["unrest_ratio"][0]))
    return np.array(found)


def test_noise_makes_no_more_unrest_at_a_speed_than_at_rest_and_longer_of_it():
    still, fast = unrest(0.0, 7), unrest(0.2, 8)
    assert np.mean(fast) == pytest.approx(np.mean(still), rel=0.3)
    begun_still, begun_fast = (np.count_nonzero(np.diff(one_u > 0.1)) for one_u in (still, fast))
    assert begun_fast < 0.75 * begun_still  # a mean 3.4 times as long crosses a level about half as often


def test_a_force_stiffens_it_at_a_speed_too():
    record = made(jitter_s=1e-6)
    for _ in range(60):
        one.step(record[0], 3.0 * 200e-9, 0.2, 0.0)
    assert record["unrest_ratio"] == 1.0


def test_forces_that_hang_on_the_place_drift_with_the_way_and_never_beyond_the_stiffest():
    record = np.zeros(1, RECORD)
    one.init(record, PERIOD_S, MASS_KG, NOISE_M, DRIFT, 0.12, HELD_N, travel_drift_n_per_sqrt_m=0.02)
    for velocity_m_per_s in (0.0, 0.2, -0.2, 100.0):
        for _ in range(4000):
            one.step(record[0], 0.0, velocity_m_per_s, 0.0)
        drift = min(np.sqrt((0.12 * DRIFT) ** 2 + 0.02**2 * abs(velocity_m_per_s)), DRIFT)
        np.testing.assert_allclose(gains(record), by_scipy(drift, HELD_N), rtol=1e-3)
    one.at_speed(0.2)(record)
    one.step(record[0], 0.0, 0.0, 0.0)
    np.testing.assert_allclose(gains(record), by_scipy(np.hypot(0.12 * DRIFT, 0.02 * np.sqrt(0.2)), HELD_N), rtol=1e-3)
