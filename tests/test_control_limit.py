"""Control at the limit: the bars hold for a seed that the bench does not use, and the rows can tell a worse law."""

import math

import numpy as np
import pytest

from bench import control_limit
from bench.control_disturbed import worst_with_mode
from bench.control_limit import machine, run, scan_nm, settling_ms, stage, surge, trapezoid, weak
from bench.figure import Figure
from stagectl.linear_loop import GAP, linearise, machine_body
from stagectl.margins import margins
from stagectl.signals import SETPOINT, Stop
from stagectl.tuning.mode import Mode, worst_sensitivity

SEED = 401


def failed(figures: list[Figure]) -> list[str]:
    return [f"{one.figure}: {one.value}" for one in figures if one.holds is False]


def test_margins_hold():
    figures = list(control_limit._margins())
    assert sum(one.holds is not None for one in figures) == 3
    assert failed(figures) == []


def test_figures_of_dsmc_hold():
    profile = stage()
    figures = [*control_limit._rows(profile, [SEED], ""), *control_limit._robustness(profile, [SEED])]
    assert sum(one.holds is not None for one in figures) == 10
    assert failed(figures) == []
    assert all(math.isfinite(one.value) for one in figures if one.value is not None)


def test_the_gains_of_before_miss_the_margin():
    """30 Hz, eta = k/m = w: the crossover is lower, and the sensitivity peak beyond 3."""
    before = stage(
        micro_bandwidth_hz=30.0, eta_ratio=1.0, gamma_ratio=0.1, sliding_ratio=1.0, micro_drift_n_per_sqrt_s=0.2
    )
    found = margins(linearise(before, "dsmc", machine_body(machine(before)), GAP))
    assert found.sensitivity_peak_ratio > 3.0


def test_a_mode_is_judged_wherever_the_loop_may_be():
    """In the gap, stiff and with its gain at the ceiling a loop without a notch looks better than it is."""
    profile, mode = stage(), Mode(275.0)
    ceiling = profile.control.adaptive_gain_ceiling_ratio
    alone = worst_sensitivity(linearise(profile, "dsmc", machine_body(machine(profile)), GAP, ceiling), mode)
    worst, loop, where = worst_with_mode(profile, mode)
    assert worst > 1.03 * alone
    assert worst == worst_sensitivity(loop, mode)
    assert "in the gap, gain at its floor, observer on the way" in where


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_a_weak_macro_touches_and_a_strong_one_does_not(law):
    profile = stage(law=law)
    assert not np.any(run(profile, machine(profile), trapezoid(), SEED).touched)
    assert 0.05 < np.mean(run(weak(profile), machine(profile), trapezoid(), SEED).touched) < 0.5


def test_a_wrong_gap_shows_where_contact_is_predicted():
    profile = stage()
    peaks_m = [
        np.max(np.abs(run(weak(profile), machine(profile, 1.0, damping), trapezoid(), SEED).error_m))
        for damping in (1.0, 2.0)
    ]
    assert peaks_m[1] > 2.0 * peaks_m[0]


def test_the_surge_saturates_the_micro():
    """The error passes 50 um before 180 N have caught up: the start is the one that the row says."""
    profile = stage()
    one = run(profile, machine(profile, 1.01, 1.2, 10.0), surge(), SEED)
    assert np.max(np.abs(one.error_m)) > 50e-6
    assert one.stop is Stop.NONE


def made(error_m: np.ndarray, speed_m_per_s: np.ndarray) -> control_limit.Run:
    setpoints = np.zeros(error_m.size, SETPOINT)
    setpoints["velocity_m_per_s"] = speed_m_per_s
    return control_limit.Run(setpoints, error_m, error_m, np.zeros(error_m.size, bool), Stop.NONE)


def test_settling_counts_from_where_the_reference_stops():
    error_m, speed = np.zeros(1000), np.zeros(1000)
    speed[100:200] = speed[500:600] = 0.4
    error_m[100:207] = 60e-9
    error_m[600:603] = 60e-9
    assert settling_ms(made(error_m, speed)) == 7.0
    assert settling_ms(made(np.zeros(1000), speed)) == 0.0


def test_a_scan_counts_windows_at_constant_speed_only():
    error_m, speed = np.full(1000, 1e-6), np.zeros(1000)
    speed[300:700] = 0.2
    error_m[300:700] = 5e-9
    error_m[400:420] += 3e-9 * (-1.0) ** np.arange(20)
    average_nm, deviation_nm = scan_nm(made(error_m, speed), 1000.0)
    assert average_nm == pytest.approx(5.3, abs=0.31)
    assert deviation_nm == pytest.approx(3.0, rel=1e-6)


def test_jitter_is_felt_whole_and_a_loop_that_was_told_is_quieter():
    jitter_s, quiet = 1e-6, {}
    for told_s in (0.0, jitter_s):
        profile = control_limit.with_tables(stage(), interferometer={"jitter_s": told_s})
        one = run(profile, machine(profile), trapezoid(), SEED, jitter_s=jitter_s)
        steady = np.abs(one.setpoints["velocity_m_per_s"]) > 0.2 - 1e-9
        noise_m = (one.measured_m - one.error_m)[steady]  # v j, and 5 nm
        assert np.std(noise_m) == pytest.approx(0.2 * jitter_s, rel=0.05)
        assert abs(np.corrcoef(noise_m, one.error_m[steady])[0, 1]) < 0.05  # no sample is moved by what it sees itself
        quiet[told_s] = float(np.std(one.error_m[steady]))
    assert quiet[jitter_s] < 0.5 * quiet[0.0]
