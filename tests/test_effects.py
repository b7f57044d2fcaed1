"""Every force law: one number worked by hand, the same law in its three homes, its sign, its declaration."""

import math

import numpy as np
import pytest

from stagectl.effects import CATALOGUE, CONTACT_QUANTITIES, PLACES, QUANTITIES, effect
from stagectl.units import unit_of

# Arguments and force by hand: an independent copy of each law, the only one allowed.
WORKED = {
    "viscous_friction": [((0.2, 5.0), -1.0), ((-0.1, 20.0), 2.0)],
    # tanh(1) = (e^2 - 1) / (e^2 + 1) = 0.76159415595576488812; far beyond the smoothing it is the level
    "coulomb_friction": [((1e-3, 4.0, 1e-3), -3.0463766238230596), ((-0.1, 4.0, 1e-3), 4.0)],
    # a quarter of the pitch from phase 0 is the crest; phase pi/6 at 0 is half of it
    "cogging": [((0.006, 3.0, 0.024, 0.0), 3.0), ((0.0, 3.0, 0.024, math.pi / 6.0), 1.5)],
    "cable_spring": [((0.3, 2.0, 0.05), -0.5), ((-0.2, 2.0, 0.05), 0.5)],
    "offset": [((12.0, 0.4), 0.4), ((0.0, -1.5), -1.5)],
    "contact_damping": [((0.01, 75.0), 0.75), ((-0.002, 300.0), -0.6)],
    "micro_reaction": [((12.0, 1.0), -12.0), ((-8.0, 0.25), 2.0)],
    "force_constant_error": [((40.0, -0.01), -0.4), ((-5.0, 0.2), -1.0)],
}
PARAMETERS = {  # some plausible values, in the order of the declaration
    "viscous_friction": (5.0,),
    "coulomb_friction": (4.1, 1e-3),
    "cogging": (3.0, 0.024, 0.4),
    "cable_spring": (2.0, 0.05),
    "offset": (0.4,),
    "contact_damping": (75.0,),
    "micro_reaction": (1.0,),
    "force_constant_error": (-0.01,),
}


def test_the_catalogue_holds_what_the_machines_need():
    assert set(CATALOGUE) == set(WORKED)


@pytest.mark.parametrize(
    ("name", "arguments", "force_n"), [(n, *case) for n, cases in WORKED.items() for case in cases]
)
def test_worked_number(name, arguments, force_n):
    assert CATALOGUE[name].law(*arguments) == pytest.approx(force_n, rel=1e-14, abs=1e-15)
    assert CATALOGUE[name].compiled_law(*arguments) == pytest.approx(force_n, rel=1e-14, abs=1e-15)


@pytest.mark.parametrize("name", CATALOGUE)
def test_scalar_equals_array_equals_compiled(name):
    known = CATALOGUE[name]
    values = np.random.default_rng(3).uniform(-0.4, 0.4, 500)
    columns = [values * (1.0 + 0.1 * k) for k in range(len(known.quantities))]
    as_array = known.law(*columns, *PARAMETERS[name])
    one_by_one = np.array([known.law(*map(float, row), *PARAMETERS[name]) for row in zip(*columns, strict=True)])
    compiled = np.array([known.compiled_law(*row, *PARAMETERS[name]) for row in zip(*columns, strict=True)])
    np.testing.assert_array_equal(as_array, one_by_one)
    # numpy and the compiler each bring their own sin and tanh: equal to the last bits
    largest = np.max(np.abs(as_array))
    np.testing.assert_allclose(compiled, as_array, rtol=4e-16, atol=4e-16 * largest)


@pytest.mark.parametrize("name", ["viscous_friction", "coulomb_friction"])
def test_friction_opposes_motion_and_takes_power(name):
    velocity = np.array([-0.3, -1e-3, -1e-6, 1e-6, 1e-3, 0.3])
    force = CATALOGUE[name].law(velocity, *PARAMETERS[name])
    assert np.all(force * velocity < 0.0)
    np.testing.assert_array_equal(force, -force[::-1])
    assert CATALOGUE[name].law(0.0, *PARAMETERS[name]) == 0.0


def test_dry_friction_never_exceeds_its_level():
    force = CATALOGUE["coulomb_friction"].law(np.linspace(-1.0, 1.0, 2001), 4.1, 1e-3)
    assert np.max(np.abs(force)) <= 4.1
    assert np.abs(force[0]) == pytest.approx(4.1, rel=1e-12)


def test_a_cable_pulls_towards_its_anchor():
    position = np.array([-0.4, 0.04, 0.06, 0.4])
    assert np.all(CATALOGUE["cable_spring"].law(position, 2.0, 0.05) * (position - 0.05) < 0.0)


def test_cogging_does_no_work_over_a_pitch():
    position = np.linspace(0.1, 0.124, 1000, endpoint=False)
    force = CATALOGUE["cogging"].law(position, 3.0, 0.024, 0.4)
    assert abs(np.mean(force)) < 1e-12
    assert math.isclose(np.sqrt(np.mean(force**2)), 3.0 / math.sqrt(2.0), rel_tol=1e-12)


def test_contact_damping_resists_the_approach():
    law = CATALOGUE["contact_damping"].law
    assert law(0.01, 75.0) > 0.0 > law(-0.01, 75.0)  # the push that drives the parts apart


def test_the_reaction_is_against_the_voice_coil():
    force = np.array([-10.0, 10.0])
    assert np.all(CATALOGUE["micro_reaction"].law(force, 1.0) == -force)


@pytest.mark.parametrize("known", CATALOGUE.values(), ids=CATALOGUE)
def test_every_declaration_is_complete(known):
    assert known.places
    assert set(known.places) <= set(PLACES)
    assert set(known.quantities) <= set(CONTACT_QUANTITIES if known.places == ("contact",) else QUANTITIES)
    assert set(known.bounds) == set(known.parameters)
    for low, high in known.bounds.values():
        assert -math.inf < low < high < math.inf
    assert all(unit_of(name) for name in (*known.quantities, *known.parameters))
    assert known.summary.endswith(".")
    assert known.symptom
    assert known.reference
    for value, (low, high) in zip(PARAMETERS[known.name], known.bounds.values(), strict=True):
        assert low <= value <= high


@pytest.fixture
def catalogue():
    """Leave the catalogue as it was found."""
    kept = dict(CATALOGUE)
    yield CATALOGUE
    CATALOGUE.clear()
    CATALOGUE.update(kept)


def refused(law, places=("macro_force",), **bounds) -> str:
    """Declare `law`, and return why that raises; nothing may be left in the catalogue."""
    before = set(CATALOGUE)
    with pytest.raises(TypeError) as caught:
        effect(places=places, symptom="a mark", reference="a book", **bounds)(law)
    assert set(CATALOGUE) == before
    return str(caught.value)


def test_a_new_law_is_one_function(catalogue):
    @effect(places=("micro_force",), symptom="odd", reference="this test", drag_n=(0.0, 10.0))
    def drag(velocity_m_per_s, t_s, drag_n):
        """Drag that grows: F = -d v t."""
        return -drag_n * velocity_m_per_s * t_s

    assert drag(2.0, 3.0, 0.5) == -3.0  # still a plain function
    known = catalogue["drag"]
    assert (known.quantities, known.parameters) == (("velocity_m_per_s", "t_s"), ("drag_n",))
    assert known.summary == "Drag that grows: F = -d v t."
    assert known.compiled_law(2.0, 3.0, 0.5) == -3.0


def test_declared_twice():
    def offset(t_s, force_n):
        """A second one."""
        return force_n

    assert "offset is declared twice" in refused(offset, force_n=(0.0, 1.0))


def test_parameter_before_quantity():
    def wrong(level_n, velocity_m_per_s):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert "quantities come before parameters" in refused(wrong, level_n=(0.0, 1.0))


def test_unknown_place():
    def wrong(velocity_m_per_s):
        """Wrong."""
        return velocity_m_per_s

    assert "unknown place base" in refused(wrong, places=("macro_force", "base"))


@pytest.mark.parametrize("bounds", [{}, {"level_n": (0.0, 1.0), "other_n": (0.0, 1.0)}, {"other_n": (0.0, 1.0)}])
def test_bounds_and_parameters_differ(bounds):
    def wrong(velocity_m_per_s, level_n):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert "do not match parameters ['level_n']" in refused(wrong, **bounds)


@pytest.mark.parametrize("bounds", [(1.0, 0.0), (0.0, math.nan), (0.0, math.inf), (-math.inf, 0.0), (1.0, 1.0)])
def test_bounds_that_are_no_range(bounds):
    def wrong(velocity_m_per_s, level_n):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert "bounds of level_n are no range" in refused(wrong, level_n=bounds)


def test_argument_without_a_unit():
    def wrong(velocity_m_per_s, level):
        """Wrong."""
        return level * velocity_m_per_s

    assert "argument level states no unit" in refused(wrong, level=(0.0, 1.0))


def test_acceleration_is_no_quantity():
    def wrong(acceleration_m_per_s2, mass_kg):
        """A force that needs the acceleration it causes is a loop in disguise."""
        return mass_kg * acceleration_m_per_s2

    assert "do not match parameters ['acceleration_m_per_s2', 'mass_kg']" in refused(wrong, mass_kg=(0.0, 1.0))


def test_a_contact_law_knows_the_joint_only():
    def wrong(position_m, stiffness_n_per_m):
        """Wrong."""
        return position_m * stiffness_n_per_m

    assert "do not match" in refused(wrong, places=("contact",), stiffness_n_per_m=(0.0, 1.0))
    assert "contact alone" in refused(wrong, places=("contact", "macro_force"), stiffness_n_per_m=(0.0, 1.0))


def test_a_law_without_a_summary():
    def wrong(velocity_m_per_s, level_n):
        return level_n * velocity_m_per_s

    assert "no docstring" in refused(wrong, level_n=(0.0, 1.0))
