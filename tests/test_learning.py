"""Iterative learning: what repeats goes, what does not is left alone, and nothing gets worse for long."""

from dataclasses import replace

import numpy as np
import pytest

from bench import learning as bench_learning
from stagectl import learning, trajectory
from stagectl.errors import RequestError
from stagectl.followed import controller_of, scan, true_error_m
from stagectl.learning import Limits
from tests.stage import with_values

DT_S = 1e-3
MOVE = trajectory.trapezoid(0.2, 0.2, dwell_s=0.4, lead_s=0.4).setpoints
ROWS = 2000


def bump(size_m: float, at: int = 1000, width: int = 40) -> np.ndarray:
    """A smooth error in the middle of a scan."""
    return size_m * np.exp(-(((np.arange(ROWS) - at) / width) ** 2))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_scans_of_the_machine_get_better_down_to_the_noise(oled_profile, oled_machine):
    profile = with_values(oled_profile, micro__mass_sd_kg=0.0)  # or the observer finds the mass in the first scan
    state = learning.init(MOVE.size, DT_S)
    errors = []
    for number in range(6):
        reference = learning.corrected(MOVE, state)
        recording = scan(controller_of(profile, "dsmc"), profile, oled_machine, reference, seed=number)
        errors.append(true_error_m(recording, MOVE))
        state = learning.step(state, recording.measurements["end_position_m"] - MOVE["position_m"])
    moving = MOVE["velocity_m_per_s"] != 0.0
    assert rms(errors[-1][moving]) < 0.6 * rms(errors[0][moving])
    assert rms(errors[-1][moving]) < 1.3 * rms(errors[-1][~moving])  # a scan is as quiet as a hold
    assert np.max(np.abs(errors[-1])) < 0.7 * np.max(np.abs(errors[0]))
    assert state.rejections_count == 0
    assert not state.stopped


def test_noise_alone_teaches_next_to_nothing():
    rng = np.random.default_rng(4)
    state = learning.init(ROWS, DT_S)
    for _ in range(30):
        state = learning.step(state, state.correction_m + 5e-9 * rng.standard_normal(ROWS))
    assert rms(state.correction_m) < 0.3 * 5e-9


def test_a_corrected_reference_has_the_derivatives_of_its_correction():
    state = learning.step(learning.init(ROWS, DT_S), bump(50e-9))
    still = np.zeros(ROWS, MOVE.dtype)
    rows = learning.corrected(still, state)
    for lower, upper in (
        ("position_m", "velocity_m_per_s"),
        ("velocity_m_per_s", "acceleration_m_per_s2"),
        ("acceleration_m_per_s2", "jerk_m_per_s3"),
    ):
        slope = np.gradient(rows[lower], DT_S)
        assert slope[50:-50] == pytest.approx(rows[upper][50:-50], abs=0.02 * np.max(np.abs(rows[upper])))
    assert np.min(rows["position_m"]) == pytest.approx(-25e-9, rel=0.15)  # half of it, and a little is smoothed away
    assert np.max(np.abs(rows["position_m"][[0, -1]])) < 1e-12
    assert not np.any(still["position_m"])


def test_a_correction_keeps_to_its_size_and_acceleration():
    limits = Limits()
    wide = learning.step(learning.init(ROWS, DT_S), bump(5e-6, width=200))
    assert wide.bounded
    assert np.max(np.abs(wide.correction_m)) == pytest.approx(limits.correction_m, rel=1e-6)
    sharp = learning.step(learning.init(ROWS, DT_S, Limits(bandwidth_hz=100.0)), bump(400e-9, width=8))
    assert sharp.bounded
    push = learning.corrected(np.zeros(ROWS, MOVE.dtype), sharp)["acceleration_m_per_s2"]
    assert np.max(np.abs(push)) == pytest.approx(limits.correction_m_per_s2, rel=1e-6)
    assert not learning.step(learning.init(ROWS, DT_S), bump(20e-9)).bounded


def test_a_lesson_that_made_it_worse_is_thrown_away_and_learning_ends():
    """A machine that does the opposite of what it is told: without the guard 1.5 times worse with every scan."""
    state = learning.init(ROWS, DT_S)
    seen = []
    for _ in range(12):
        seen.append(rms(bump(40e-9) - state.correction_m))
        state = learning.step(state, bump(40e-9) - state.correction_m)
    assert max(seen) < 1.6 * seen[0]
    assert seen[-1] == seen[0]
    assert state.stopped.startswith("3 scans went worse")
    assert not np.any(state.correction_m)
    assert state.gain_ratio < 0.1
    assert learning.step(state, bump(1e-6)).correction_m is state.correction_m  # nothing more is learnt


def test_the_best_scan_stands_where_a_later_one_is_disturbed():
    state = learning.init(ROWS, DT_S)
    for _ in range(6):
        state = learning.step(state, bump(40e-9) + state.correction_m)
    learnt = state.best_m
    disturbed = learning.step(state, 0.5 * bump(40e-9, at=600))
    assert disturbed.rejections_count == 1
    assert disturbed.correction_m is learnt
    assert disturbed.gain_ratio == 0.5 * state.gain_ratio


def test_what_was_learnt_of_another_machine_is_forgotten_and_learnt_anew():
    state = learning.init(ROWS, DT_S)
    for _ in range(6):
        state = learning.step(state, bump(40e-9) + state.correction_m)
    state = learning.step(state, bump(-40e-9) + state.correction_m)  # twice as bad as with nothing learnt
    assert not np.any(state.correction_m)
    for _ in range(10):
        state = learning.step(state, bump(-40e-9) + state.correction_m)
    assert rms(bump(-40e-9) + state.correction_m) < 0.25 * rms(bump(40e-9))


def test_rows_without_a_reading_are_bridged_and_a_scan_without_many_is_no_lesson():
    whole = learning.step(learning.init(ROWS, DT_S), bump(40e-9))
    gappy = bump(40e-9)
    gappy[::25] = np.nan
    assert learning.step(learning.init(ROWS, DT_S), gappy).correction_m == pytest.approx(whole.correction_m, abs=1e-10)
    gappy[:500] = np.nan
    assert learning.step(whole, gappy).rejections_count == 1


def test_limits_and_lengths_that_make_no_sense_are_refused():
    for limits, said in (
        (Limits(gain_ratio=1.5), "gain_ratio is 1.5; a number above 0 and up to 1"),
        (Limits(bandwidth_hz=0.0), "bandwidth_hz is 0; a number above 0 and up to 250"),
    ):
        with pytest.raises(RequestError, match=said):
            learning.init(ROWS, DT_S, limits)
    with pytest.raises(RequestError, match=r"lasts 0\.3 s; 0\.4 s at least"):
        learning.init(300, DT_S)
    state = learning.init(ROWS, DT_S)
    with pytest.raises(RequestError, match="has 100 rows, the ones before had 2000"):
        learning.step(state, np.zeros(100))
    with pytest.raises(RequestError, match="of another motion"):
        learning.corrected(MOVE[:100], state)


def test_the_bench_has_rows_of_its_own(oled_profile, oled_machine):
    errors, state = bench_learning.repeated(oled_profile, oled_machine, 3, seed=1)
    assert np.max(np.abs(errors[2])) < 0.75 * np.max(np.abs(errors[0]))
    other = bench_learning.heavier(oled_machine, 1.05)
    changed, after = bench_learning.repeated(oled_profile, other, 2, seed=2, begun=replace(state, gain_ratio=0.4))
    assert len(changed) == 2
    assert after.scans_count == 5
