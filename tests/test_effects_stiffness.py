"""Springs, cables, tilt and what repeats with position."""

import math

import numpy as np

from stagectl.effects import CATALOGUE
from tests.effect_numbers import PARAMETERS, motion
from tests.test_effects import along


def test_a_cable_pulls_towards_its_anchor():
    position = np.array([-0.4, 0.04, 0.06, 0.4])
    assert np.all(CATALOGUE["cable_spring"].law(position, 2.0, 0.05) * (position - 0.05) < 0.0)


def test_springs_do_no_work_over_a_closed_cycle():
    quantities = motion()
    for name in ("cable_spring", "linear_stiffness", "cubic_stiffness", "cogging", "harmonic_cogging"):
        power = along(name, PARAMETERS[name]) * quantities["velocity_m_per_s"]
        assert abs(np.sum(power)) < 1e-6 * np.sum(np.abs(power))


def test_a_cable_that_slips_takes_four_times_its_force_times_the_way_less_a_slip():
    """A lap of +-A under one Maxwell element: 4 F_s (A - delta); +-20 mm, 3 N, 4 mm: 192 mJ."""
    rows = 8000
    angle = 2.0 * math.pi * (np.arange(2 * rows) + 0.5) / rows
    velocity = 0.02 * 2.0 * math.pi * np.cos(angle)  # one lap a second
    quantities = {"velocity_m_per_s": velocity, "dt_s": np.full(2 * rows, 1.0 / rows)}
    power = along("cable_hysteresis", (3.0, 4e-3, 0.0), quantities) * velocity
    assert math.isclose(np.sum(power[rows:]) / rows, -0.192, rel_tol=1e-4)


def test_cogging_does_no_work_over_a_pitch():
    position = np.linspace(0.1, 0.124, 1000, endpoint=False)
    force = CATALOGUE["cogging"].law(position, 3.0, 0.024, 0.4)
    assert abs(np.mean(force)) < 1e-12
    assert math.isclose(np.sqrt(np.mean(force**2)), 3.0 / math.sqrt(2.0), rel_tol=1e-12)


def test_harmonics_of_cogging_are_cogging_of_half_the_pitch():
    position = np.linspace(-0.1, 0.1, 500)
    both = CATALOGUE["harmonic_cogging"].law(position, 3.0, 1.5, 0.024, 0.4, -0.7)
    apart = CATALOGUE["cogging"].law(position, 3.0, 0.024, 0.4) + CATALOGUE["cogging"].law(position, 1.5, 0.012, -0.7)
    np.testing.assert_allclose(both, apart, atol=1e-12)


def test_friction_that_changes_along_the_way_adds_to_a_coulomb_friction():
    position, velocity = np.array([0.3, 0.3, -0.3, -0.3]), np.array([0.1, -0.1, 0.1, -0.1])
    whole = CATALOGUE["position_dependent_friction"].law(position, velocity, 1.0, 2.0, 10.0, 1e-3)
    whole = whole + CATALOGUE["coulomb_friction"].law(velocity, 3.0, 1e-3)
    np.testing.assert_allclose(whole, [-4.6, 4.6, -3.4, 3.4], rtol=1e-12)


def test_the_reaction_is_against_the_voice_coil():
    force = np.array([-10.0, 10.0])
    assert np.all(CATALOGUE["micro_reaction"].law(force, 1.0) == -force)
