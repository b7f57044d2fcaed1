"""The paper's control: (21), (26), (33), (40), (45), and the cases of section 5.3."""

import numpy as np
import pytest
from scipy import signal

from stagectl.laws.dsmc import integrand
from stagectl.paper import (
    cases,
    closed_loop,
    compensation,
    plant_as_printed,
    ratchet,
    sliding_mode,
    sliding_mode_chapter,
)
from stagectl.paper.cases import Setting, macro_peak_m, stable_range_m
from stagectl.paper.printed_values import CONTROL_5_3, SlidingModeValues

PHI = CONTROL_5_3.phi_m


def corrected_with(setting: Setting) -> closed_loop.Run:
    return cases.sliding("sine", sliding_mode.corrected(), setting)


# ---- compensation and decoupling ------------------------------------------------------------------------------


def test_a_sampled_transfer_follows_the_continuous_one():
    q = plant_as_printed.parameters(cases.backlash())[0]
    for transfer in (compensation.printed_decoupler(q), compensation.corrected_decoupler(q)):
        f = transfer.sampled(1e-4)
        t_s = np.arange(30_000) * 1e-4
        value = np.array([compensation.filtered(f[0], float(np.sin(2.0 * np.pi * 5.0 * t))) for t in t_s])
        late = t_s >= 2.0
        wave = 2.0 * np.mean(value[late] * np.exp(-2j * np.pi * 5.0 * t_s[late])) * 1j
        assert abs(wave - transfer.at(5.0)) < 0.01 * abs(transfer.at(5.0))


def test_the_printed_decoupler_is_26():
    q = plant_as_printed.parameters(cases.backlash())[0]
    s = 2j * np.pi * 3.0
    over = 9.37e-3 * 70.0 * s**3 + (9.37e-3 * 2.2e-4 + 2.75 * 70.0) * s**2
    km, ke = (float(q[name]) for name in ("macro_force_constant_n_per_a", "macro_back_emf_v_s_per_m"))
    over += (2.75 * 2.2e-4 + km * ke) * s
    kw, kew = (float(q[name]) for name in ("micro_force_constant_n_per_a", "micro_back_emf_v_s_per_m"))
    a, b = 2.52e-3 * 40.0, 2.52e-3 * 7.61e-5 + 0.76 * 40.0
    c, e = 2.52e-3 * 500.0 + 0.76 * 7.61e-5 + kw * kew, 0.76 * 500.0
    below = a * s**3 + b * s**2 + c * s + e
    assert compensation.printed_decoupler(q).at(3.0) == pytest.approx(-kw / km * over / below, rel=1e-9)


def test_the_corrected_decoupler_is_both_windings():
    q = plant_as_printed.parameters(cases.backlash())[0]
    s = 2j * np.pi * 100.0
    ratio = float(q["micro_force_constant_n_per_a"] / q["macro_force_constant_n_per_a"])
    wanted = ratio * (9.37e-3 * s + 2.75) / (2.52e-3 * s + 0.76)
    assert compensation.corrected_decoupler(q).at(100.0) == pytest.approx(wanted, rel=1e-9)


def test_static_decoupling_knows_the_spring_as_well():
    """The end begins 3 mm off: 1.5 N of K2 on the macro, 8 um of its servo, unless it is made up for."""
    setting = Setting(
        drive=plant_as_printed.DRIVE_CURRENT, decoupling=closed_loop.DECOUPLING_STATIC, start_offset_m=3e-3
    )
    run = cases.sliding("trapezoid", sliding_mode.corrected(), setting)
    assert np.max(np.abs(run.macro_error_m)) < 2e-6


def test_24_is_the_end_beside_a_macro_that_stands():
    """The denominator is that of voltage to relative position of the platform itself, macro held by its mass."""
    q = plant_as_printed.parameters(cases.backlash())
    q["macro_mass_kg"] = 1e9
    s = plant_as_printed.init()
    position_m = []
    for _ in range(3000):
        position_m.append(float(s["end_position_m"][0] - s["macro_position_m"][0]))
        plant_as_printed.advance(s[0], q[0], 0.0, 0.05, 1e-4, 10)
    found = signal.lti([float(q["micro_force_constant_n_per_a"][0])], compensation.end_denominator(q[0]))
    _, step = signal.step(found, T=np.arange(3000) * 1e-3)
    assert np.max(np.abs(np.array(position_m) - 0.05 * step)) < 1e-3 * 0.05 * np.max(step)
    assert np.max(position_m) < 7.5e-3  # no contact


def test_21_as_printed_leaves_the_macro_to_the_gap():
    assert macro_peak_m(corrected_with(Setting())) < 100e-6
    printed = corrected_with(Setting(macro_feedback=compensation.FEEDBACK_PRINTED))
    assert 7.5e-3 < macro_peak_m(printed) < 12e-3


def test_decoupling_takes_the_voice_coils_reaction_from_the_macro():
    limit = cases.LIMIT_S
    without = macro_peak_m(corrected_with(Setting(limit)))
    dynamic = macro_peak_m(corrected_with(Setting(limit, decoupling=closed_loop.DECOUPLING_DYNAMIC)))
    # the reaction, 40 kg at 0.28 m/s^2, on a servo of 70 kg at 8 Hz
    assert without == pytest.approx(40.0 * 0.5 * 0.75**2 / (70.0 * (16.0 * np.pi) ** 2), rel=0.05)
    assert dynamic < 0.03 * without
    current = plant_as_printed.DRIVE_CURRENT
    static = Setting(drive=current, decoupling=closed_loop.DECOUPLING_STATIC)
    assert macro_peak_m(corrected_with(static)) < 0.003 * without
    printed = macro_peak_m(corrected_with(Setting(decoupling=closed_loop.DECOUPLING_PRINTED)))
    assert printed > 10.0 * without


# ---- the sliding mode -----------------------------------------------------------------------------------------


def test_the_printed_y_points_away_from_zero_below_half_phi():
    inside = np.linspace(0.01, 0.49, 25) * PHI
    assert all(sliding_mode.printed_integrand(e, PHI) < 0.0 < integrand(e, PHI) for e in inside)
    for e in (0.2 * PHI, 0.7 * PHI, PHI, 3.0 * PHI):
        assert sliding_mode.printed_integrand(-e, PHI) == -sliding_mode.printed_integrand(e, PHI)
        assert abs(sliding_mode.printed_integrand(e, PHI)) <= abs(integrand(e, PHI))
    assert sliding_mode.printed_integrand(0.5 * PHI, PHI) == pytest.approx(0.0, abs=1e-20)


def test_the_printed_surface_orbits_at_three_quarters_phi():
    error = sliding_mode.on_surface(sliding_mode.init(), 1e-9, 60.0)
    assert np.max(error) == pytest.approx(0.75 * PHI, rel=1e-3)
    corrected = sliding_mode.on_surface(sliding_mode.corrected(), 1e-6, 2.0)
    assert abs(corrected[-1]) < 1e-9


def test_bound_45_is_the_papers_22_um_and_imaginary_as_set():
    bound = sliding_mode.error_bound_m()
    assert bound == pytest.approx(22.04e-6, abs=0.01e-6)
    assert sliding_mode.error_bound_m(SlidingModeValues(1.8e4, 697.5, PHI, 310.2, 20.0, 800.0, 0.05)) is None
    assert sliding_mode.reaching_band_m_per_s() == pytest.approx(0.0645, rel=1e-3)


def test_the_printed_law_ends_at_the_artefact_and_the_corrected_one_does_not():
    least, greatest = stable_range_m(cases.printed_sliding("trapezoid", ideal=True))
    assert -27e-6 < least < -18e-6
    assert 18e-6 < greatest < 27e-6
    least, greatest = stable_range_m(cases.corrected_sliding("trapezoid"))
    assert 0.5e-6 < greatest < 4e-6
    assert -4e-6 < least < -0.5e-6
    damped = sliding_mode.init()
    damped["eta_per_s"] = 2.0 * np.sqrt(CONTROL_5_3.gamma_per_s2)
    rest = cases.sliding("sine", damped, Setting())
    assert np.mean(rest.error_m[rest.after(8.0)]) == pytest.approx(0.5 * PHI, rel=0.02)


def test_noise_alone_carries_the_printed_bound_up_by_the_mean_square_of_s():
    once, tenfold = (ratchet.at_rest(sliding_mode_chapter._ratcheting(), 30.0, noise_m) for noise_m in (5e-9, 50e-9))
    c = CONTROL_5_3
    differences = 2.0 * (5e-9 / 1e-3) ** 2  # of white samples, m^2/s^2
    white_n_per_h = 3600.0 * c.alpha * c.k / c.r * differences
    assert white_n_per_h < once.rate_n_per_h < 1.1 * white_n_per_h  # the stage moves a little as well
    assert abs(tenfold.rate_n_per_h / once.rate_n_per_h - 100.0) < 1.0
    assert once.half_width_n_per_h < 0.05 * once.rate_n_per_h
    leaking = ratchet.at_rest(sliding_mode.corrected(), 30.0)
    assert abs(leaking.rate_n_per_h) < 2.0 * leaking.half_width_n_per_h < 0.02 * once.rate_n_per_h
    assert 0.0 < leaking.last_bound_n - c.first_bound_n < 1e-6


def test_the_printed_adaptive_law_is_a_ratchet():
    printed = cases.sliding("trapezoid", sliding_mode_chapter._ratcheting(), Setting(start_offset_m=80e-3))
    assert np.all(np.diff(printed.bound_n) >= 0.0)
    leaking = cases.sliding("trapezoid", sliding_mode.corrected(), Setting(start_offset_m=80e-3))
    assert leaking.bound_n[-1] < 0.1 < 100.0 < np.max(leaking.bound_n) < printed.bound_n[-1]
    stuck, free = (np.max(np.abs(run.error_m[run.after(15.0)])) for run in (printed, leaking))
    assert stuck > 5e-6
    assert free < 0.1e-6


def test_v2_falls_wherever_the_theorem_says_so_for_the_corrected_law():
    proof = sliding_mode_chapter._proof(sliding_mode.corrected())
    assert proof.outside_percent > 0.1
    assert proof.rises_outside_percent == 0.0
    assert proof.rises_inside_percent > 10.0
    printed = sliding_mode_chapter._proof(sliding_mode.init())
    assert printed.rises_above_percent is not None
    assert printed.rises_above_percent > 10.0


def test_case_a_is_dragged_and_a_fair_pid_is_not():
    least, greatest = stable_range_m(cases.printed_pid("sine"))
    assert -15e-3 < least < -10e-3
    assert 10e-3 < greatest < 15e-3
    assert max(np.abs(stable_range_m(cases.fair_pid("sine")))) < 5e-6


def test_a_literal_inertia_costs_the_corrected_law_a_thousandfold():
    literal, newton = (
        max(np.abs(stable_range_m(corrected_with(setting)))) for setting in (Setting(relative_inertia=1.0), Setting())
    )
    assert literal > 500.0 * newton
