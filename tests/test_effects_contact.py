"""The contact beside its stiffness: it resists, loses energy, sets in gently."""

import numpy as np

from stagectl.effects import CATALOGUE

K = 1e4


def whole(name: str, penetration_m, rate, *parameters):
    """Return the contact's force, stiffness and effect together."""
    known = CATALOGUE[name]
    given = {"penetration_m": penetration_m, "penetration_velocity_m_per_s": rate, "contact_stiffness_n_per_m": K}
    return K * penetration_m + known.law(*[given[key] for key in known.quantities], *parameters)


def test_contact_damping_resists_the_approach():
    law = CATALOGUE["contact_damping"].law
    assert law(0.01, 75.0) > 0.0 > law(-0.01, 75.0)  # the push that drives the parts apart


def test_a_soft_contact_has_a_knee_and_then_the_full_stiffness():
    p = np.linspace(0.0, 50e-6, 501)
    force = whole("soft_contact", p, 0.0, 10e-6)
    slope = np.gradient(force, p)
    assert force[0] == 0.0
    assert slope[1] < 0.03 * K
    np.testing.assert_allclose(slope[102:], K, rtol=1e-9)
    assert np.all(np.diff(slope) > -1e-6 * K)
    np.testing.assert_allclose(force[100:], K * (p[100:] - 5e-6), rtol=1e-12)


def test_a_loop_of_the_contact_loses_its_area():
    """Pressed to P and let go: 2 h (K P^2 / 2); 0.1 x 1e4 x (30 um)^2 = 0.9 uJ."""
    p = np.concatenate([np.linspace(0.0, 30e-6, 2001), np.linspace(30e-6, 0.0, 2001)])
    rate = np.concatenate([np.full(2001, 0.01), np.full(2001, -0.01)])
    work = np.trapezoid(whole("contact_hysteresis", p, rate, 0.1, 1e-4), p)
    assert 0.899e-6 < work < 0.901e-6
    assert np.all(whole("contact_hysteresis", p, rate, 0.9, 1e-4) >= 0.0)


def test_each_side_has_its_own_error():
    law = CATALOGUE["contact_stiffness_error"].law
    assert law(1e-5, K, -1.0, 0.1, 0.0) == 0.01
    assert law(1e-5, K, 1.0, 0.1, 0.0) == 0.0


def test_width_and_centre_move_edges_apart_and_together():
    width, centre = CATALOGUE["backlash_width_change"].law, CATALOGUE["backlash_centre_shift"].law
    assert width(1.0, 4e-6) + width(-1.0, 4e-6) == 4e-6
    assert centre(1.0, 3e-6) + centre(-1.0, 3e-6) == 0.0
    assert centre(1.0, 3e-6) == 3e-6
