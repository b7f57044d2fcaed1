"""The paper's platform: its quasi-linear joint, its printed terms against Newton's, its limit cycle."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stagectl import compose, plant
from stagectl.paper import closed_loop, identification_test, limit_cycle, model_chapter, plant_as_printed, quasi_linear
from stagectl.paper.printed_values import TABLE_2, Backlash
from stagectl.paper.references import macro_sine_5_1, trapezoid_5_3

EPSILON = 2.0**-52

edges_m = st.floats(1e-6, 0.1)
stiffnesses_n_per_m = st.floats(1.0, 1e7)


@given(st.floats(-1.0, 1.0), edges_m, edges_m, stiffnesses_n_per_m, stiffnesses_n_per_m)
def test_the_quasi_linear_model_is_the_piecewise_one_to_rounding(x_b, left_m, right_m, left, right):
    numbers = (x_b, left_m, right_m, left, right)
    largest = max(left * (abs(x_b) + left_m), right * (abs(x_b) + right_m))
    assert abs(quasi_linear.quasi_linear(*numbers) - quasi_linear.piecewise(*numbers)) <= 4.0 * EPSILON * largest


@given(edges_m, edges_m, stiffnesses_n_per_m, stiffnesses_n_per_m)
def test_the_quasi_linear_model_holds_at_the_very_edges(left_m, right_m, left, right):
    for x_b in (-left_m, right_m, math.nextafter(-left_m, -1.0), math.nextafter(right_m, 1.0)):
        force = quasi_linear.quasi_linear(x_b, left_m, right_m, left, right)
        assert abs(force) <= 4.0 * EPSILON * 2.0 * max(left * left_m, right * right_m)


def test_the_printed_left_condition_presses_inside_the_gap():
    forces = quasi_linear.forces(np.array([-0.04, 0.0, 0.06]), 0.05, 0.05, 1e3, 1e3)
    assert forces[:, 0] == pytest.approx([0.0, 0.0, 10.0])
    assert forces[:, 2] == pytest.approx([10.0, 50.0, 10.0])


def test_marker_and_force_are_the_papers_numbers_for_the_rig():
    """9.87 (x - 0.176) and 13.2 (x + 0.0254) in N and mm, section 6.1."""
    x_mm = np.array([-0.2, 0.0, 0.4])
    forces = quasi_linear.forces(x_mm * 1e-3, 0.0254e-3, 0.176e-3, 13.2e3, 9.87e3)
    assert forces[:, 1] == pytest.approx([13.2 * (-0.2 + 0.0254), 0.0, 9.87 * (0.4 - 0.176)], abs=1e-12)


# ---- the platform ---------------------------------------------------------------------------------------------


def project_plant(q) -> tuple[np.ndarray, np.ndarray, object, np.ndarray]:
    """Return parameters, state, module and effects of the project's plant that should be the corrected platform."""
    effects = [{"name": "micro_reaction", "acts_on": "macro_force", "fraction_ratio": 1.0}]
    p = np.zeros(1, plant.PLANT_PARAMETERS)
    for name in ("macro_mass_kg", "micro_mass_kg", "spring_n_per_m", "damping_n_s_per_m", "left_m", "right_m"):
        p[name] = q[name]
    for name in ("left_stiffness_n_per_m", "right_stiffness_n_per_m"):
        p[name] = q[name]
    for axis in ("macro", "micro"):
        p[f"{axis}_force_constant_n_per_a"] = q[f"{axis}_force_constant_n_per_a"]
        p[f"{axis}_current_limit_a"] = 1e9
        p[f"{axis}_supply_v"] = 1e18
        p[f"{axis}_current_loop_s"] = 1e-9
        p[f"{axis}_resistance_ohm"] = p[f"{axis}_inductance_h"] = 1.0
    p["stroke_low_m"] = p["travel_low_m"] = -np.inf
    p["stroke_high_m"] = p["travel_high_m"] = np.inf
    p["has_micro"] = 1.0
    return p, np.zeros(1, plant.PLANT_STATE), compose.plant_module(effects), compose.effect_parameters(effects)


def test_the_corrected_reading_is_the_projects_own_plant():
    q = plant_as_printed.parameters(Backlash(3e-3, 5e-3, 8e3, 6e3), 0.0)
    q["drive"] = plant_as_printed.DRIVE_CURRENT
    q["base_damping_n_s_per_m"] = 0.0
    p, s, module, effects = project_plant(q)
    mine = plant_as_printed.init()
    for name in ("macro_velocity_m_per_s", "end_velocity_m_per_s"):
        mine[name] = s[name] = 0.1 if name == "macro_velocity_m_per_s" else -0.05
    contacts = 0
    for k in range(2000):
        macro_a, micro_a = 0.3 * np.sin(0.01 * k), -2.0 * np.cos(0.013 * k)
        plant_as_printed.advance(mine[0], q[0], macro_a, micro_a, 2e-5, 50)
        module.advance(s, p, effects, (k + 1) * 1e-3, 2e-5, macro_a, micro_a, 1, 1)
        contacts += mine["contact_force_n"][0] != 0.0
    assert contacts > 200
    assert mine["macro_position_m"][0] == pytest.approx(s["macro_position_m"][0], abs=2e-7)
    assert mine["end_position_m"][0] == pytest.approx(s["end_position_m"][0], abs=2e-7)
    assert abs(s["end_position_m"][0]) > 1e-3


def test_without_forces_from_outside_momentum_is_kept_by_newton_alone():
    def momentum_after(relative_inertia: float) -> float:
        q = plant_as_printed.parameters(TABLE_2, 0.0)
        q["drive"] = plant_as_printed.DRIVE_CURRENT
        q["base_damping_n_s_per_m"] = 0.0
        q["relative_inertia"] = relative_inertia
        s = plant_as_printed.init()
        s["macro_velocity_m_per_s"] = 0.2
        plant_as_printed.advance(s[0], q[0], 0.0, 3.0, 1e-4, 10_000)
        return float(
            q["macro_mass_kg"][0] * s["macro_velocity_m_per_s"][0]
            + q["micro_mass_kg"][0] * s["end_velocity_m_per_s"][0]
        )

    assert momentum_after(0.0) == pytest.approx(70.0 * 0.2, rel=1e-9)
    assert abs(momentum_after(1.0) - 70.0 * 0.2) > 1.0


def test_a_voltage_driven_motor_comes_to_its_no_load_speed():
    q = plant_as_printed.parameters(TABLE_2)
    s = plant_as_printed.init()
    plant_as_printed.advance(s[0], q[0], 50.0, 0.0, 5e-5, 200_000)
    speed = 50.0 / q["macro_back_emf_v_s_per_m"][0]
    assert s["macro_velocity_m_per_s"][0] == pytest.approx(speed, rel=0.02)


def test_the_printed_sign_of_the_coupling_drives_the_joint_apart():
    right = identification_test.run(identification_test.platform(), 20.0)
    wrong = identification_test.run(identification_test.platform(coupling_sign=-1.0), 20.0)
    assert right.t_s.size == 20_000
    assert 0.07 < np.max(np.abs(right.x_b_m)) < 0.09
    assert np.max(np.abs(right.contact_force_n)) == pytest.approx(29.9, abs=0.1)
    assert 3.2 < wrong.t_s[-1] < 3.5  # by then it is a kilometre apart
    assert np.max(np.abs(wrong.x_b_m)) > 100.0


def test_the_relative_inertia_of_2_carries_the_micro_for_nothing():
    row = next(row for row in model_chapter.chapter().rows if row.quantity.startswith("voice coil's force"))
    assert row.printed == pytest.approx(0.0, abs=0.5)
    assert row.corrected == pytest.approx(40.0 * 0.4 * (0.5 * np.pi) ** 2, rel=0.03)


# ---- references and limit cycle -------------------------------------------------------------------------------


def test_references_keep_what_is_printed():
    sine = macro_sine_5_1(1e-3)
    assert sine.position_m.max() == pytest.approx(0.4)
    assert sine.velocity_m_per_s[0] == pytest.approx(0.4 * 0.5 * np.pi)
    trapezoid = trapezoid_5_3(1e-3)
    assert trapezoid.position_m.max() == pytest.approx(0.8, rel=1e-6)
    assert trapezoid.position_m[-1] == pytest.approx(0.0, abs=1e-9)
    assert trapezoid.velocity_m_per_s.max() == pytest.approx(0.2)
    assert trapezoid.acceleration_m_per_s2.max() == pytest.approx(0.2 / 0.6, rel=0.01)


def test_the_describing_function_is_the_first_harmonic():
    amplitude_m, half_gap_m, stiffness = 0.031, 0.02, 1e3
    angle = (np.arange(20_000) + 0.5) / 20_000 * 2.0 * np.pi
    force = quasi_linear.forces(amplitude_m * np.sin(angle), half_gap_m, half_gap_m, stiffness, stiffness)[:, 0]
    harmonic = 2.0 * np.mean(force * np.sin(angle)) / amplitude_m
    assert limit_cycle.describing_function(amplitude_m, half_gap_m, stiffness) == pytest.approx(harmonic, rel=1e-6)
    assert limit_cycle.describing_function(0.019, half_gap_m, stiffness) == 0.0


def test_the_predicted_limit_cycle_is_met_from_both_sides():
    servo, q = model_chapter._dragging()
    predicted = limit_cycle.predicted(servo, 0.02, 1e3, 70.0, 40.0)
    assert predicted is not None
    for start_m in (0.03, 0.3):
        met = limit_cycle.met(limit_cycle.swing(servo, q.copy(), start_m, 300.0))
        assert met.amplitude_m == pytest.approx(predicted.amplitude_m, rel=0.03)
        assert met.frequency_hz == pytest.approx(predicted.frequency_hz, rel=0.03)


def test_a_run_that_diverges_ends_with_its_last_good_row():
    q = plant_as_printed.parameters(Backlash(1e-3, 1e-3, 1e6, 1e6), 0.0)
    q["coupling_sign"] = -1.0
    reference = macro_sine_5_1(1e-3)
    run = closed_loop.run(q, model_chapter._loop(), reference)
    assert not run.is_whole
    assert run.error_m.size == run.t_s.size < reference.t_s.size
    assert np.all(np.isfinite(run.end_m))
