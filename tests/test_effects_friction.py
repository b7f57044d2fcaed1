"""Friction: against the motion, never a source of work, and over the first micrometres a spring."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stagectl.effects import CATALOGUE, friction
from tests.effect_numbers import PARAMETERS, columns, motion
from tests.test_effects import along

FRICTION = [name for name, known in CATALOGUE.items() if known.law.__module__ == friction.__name__]
SYMMETRIC = [name for name in FRICTION if not name.startswith("asymmetric") and not CATALOGUE[name].memory]


def test_a_family_is_a_file():
    assert len(FRICTION) == 10
    assert {"coulomb_friction", "lugre_friction"} <= set(FRICTION)


@pytest.mark.parametrize("name", SYMMETRIC)
def test_opposes_motion_whatever_its_sign(name):
    velocity = np.array([-0.3, -1e-3, -1e-6, 1e-6, 1e-3, 0.3])
    quantities = {"velocity_m_per_s": velocity, "motor_force_n": np.full(6, 30.0)}
    force = CATALOGUE[name].law(*columns(name, quantities).T, *PARAMETERS[name])
    assert np.all(force * velocity <= 0.0)
    assert np.all(force[1:-1] * velocity[1:-1] < 0.0)
    np.testing.assert_array_equal(force, -force[::-1])
    still = {"velocity_m_per_s": np.zeros(1), "motor_force_n": np.full(1, 30.0)}
    assert CATALOGUE[name].law(*columns(name, still).T, *PARAMETERS[name])[0] == 0.0


def test_each_direction_has_its_own_law():
    for name, plain in (
        ("asymmetric_viscous_friction", "viscous_friction"),
        ("asymmetric_coulomb_friction", "coulomb_friction"),
    ):
        rest = PARAMETERS[plain][1:]
        for velocity in (-0.2, 3e-4, 0.1):
            wanted = CATALOGUE[plain].law(velocity, 7.0 if velocity > 0.0 else 3.0, *rest)
            assert CATALOGUE[name].law(velocity, 7.0, 3.0, *rest) == pytest.approx(wanted, rel=1e-15)


def test_dry_friction_never_exceeds_its_level():
    force = CATALOGUE["coulomb_friction"].law(np.linspace(-1.0, 1.0, 2001), 4.1, 1e-3)
    assert np.max(np.abs(force)) <= 4.1
    assert np.abs(force[0]) == pytest.approx(4.1, rel=1e-12)


def test_the_sub_linear_law_is_smooth_at_rest():
    """Its slope there is F_1 / v_0 (v_0 / v_1)^p = 20 / 1e-6 x (1e-5)^0.63 = 14159 N s/m, not infinite."""
    law = CATALOGUE["sublinear_viscous_friction"].law
    assert law(1e-11, 20.0, 0.63) == pytest.approx(-14158.9157e-11, rel=1e-6)
    assert law(0.2, 20.0, 0.5) / law(0.05, 20.0, 0.5) == pytest.approx(2.0, rel=1e-5)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.floats(1e-6, 3e-3), st.integers(1, 9), st.floats(0.0, 6.3)), min_size=1, max_size=4),
    st.sampled_from(FRICTION),
)
def test_a_closed_cycle_costs_work(terms, name):
    """Any periodic motion: from its second lap on, what friction gives back it took before."""
    rows, dt_s = 4000, 0.5e-3
    t_s = dt_s * (np.arange(2 * rows) + 0.5)
    w = 2.0 * math.pi / (rows * dt_s)
    velocity = np.sum([a * k * w * np.cos(k * w * t_s + phase) for a, k, phase in terms], axis=0)
    quantities = {"velocity_m_per_s": velocity, "motor_force_n": np.sin(3.0 * w * t_s) * 40.0}
    force = along(name, PARAMETERS[name], quantities | {"dt_s": np.full(2 * rows, dt_s)})
    power = (force * velocity)[rows:]
    assert np.sum(power) * dt_s <= 1e-12
    assert np.sum(power) < -1e-3 * np.sum(np.abs(power))


@pytest.mark.parametrize("name", ["dahl_friction", "lugre_friction"])
def test_a_spring_over_the_first_micrometres(name):
    """sigma_0 = F_c / delta: 4 N over 5 um are 0.8 N/um; after a hundredth of it 1 % is lost to the curve."""
    level, *rest = PARAMETERS[name]
    if name == "lugre_friction":
        rest[-1] = 0.0  # the damping of its bristles is not of the spring
    memory = np.zeros(1)
    force = 0.0
    for _ in range(100):  # 50 nm
        force = CATALOGUE[name].compiled_law(5e-7, 1e-3, level, *rest, memory)
    assert force == pytest.approx(-0.8e6 * 50e-9, rel=1.5e-2)
    for _ in range(200):  # and back as far on the other side
        force = CATALOGUE[name].compiled_law(-5e-7, 1e-3, level, *rest, memory)
    assert force == pytest.approx(0.8e6 * 50e-9, rel=3e-2)


def test_lugre_settles_on_the_stribeck_curve():
    level, ratio, stribeck, *bristles = PARAMETERS["lugre_friction"]
    for velocity in (-0.1, -5e-3, 2e-3, 0.05):
        memory = np.zeros(1)
        for _ in range(400):
            force = CATALOGUE["lugre_friction"].compiled_law(velocity, 1e-2, level, ratio, stribeck, *bristles, memory)
        curve = level * (1.0 + (ratio - 1.0) * math.exp(-((velocity / stribeck) ** 2)))
        assert force == pytest.approx(-math.copysign(curve, velocity), rel=1e-9)


def test_what_remembers_is_coulomb_friction_far_from_reversals():
    quantities = motion()
    fast = np.abs(quantities["velocity_m_per_s"]) > 0.03  # 30 um a row, six slip lengths
    settled = fast & np.roll(fast, 1) & np.roll(fast, 2)
    settled[:2] = False  # the start is a reversal too
    wanted = along("coulomb_friction", (4.0, 1e-6))
    np.testing.assert_allclose(along("dahl_friction", (4.0, 5e-6))[settled], wanted[settled], rtol=1e-4)
