"""The contact beside its stiffness: it resists, loses energy, sets in gently."""

import numpy as np
import pytest

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


def loop_n(p, turn_m, speed_m_per_s, loss_ratio=0.1):
    """Return the contact's force along penetrations that are run through at a speed."""
    law, memory = CATALOGUE["contact_hysteresis"].law, np.zeros(1)
    steps = np.diff(p, prepend=0.0)
    dt_s = np.abs(steps) / speed_m_per_s
    moves = zip(p, np.sign(steps) * speed_m_per_s, dt_s, strict=True)
    return K * p + np.array([law(x, rate, K, dt, loss_ratio, turn_m, memory) for x, rate, dt in moves])


def test_a_loop_of_the_contact_loses_its_area():
    """Pressed to P and let go: 2 h (K P^2 / 2); 0.1 x 1e4 x (30 um)^2 = 0.9 uJ, and the same at any speed."""
    p = np.concatenate([np.linspace(0.0, 30e-6, 2001), np.linspace(30e-6, 0.0, 2001)])
    for speed_m_per_s in (1e-4, 0.1):
        work = np.trapezoid(loop_n(p, 1e-8, speed_m_per_s), p)
        assert 0.897e-6 < work < 0.903e-6
    assert np.all(loop_n(p, 1e-8, 0.01, 0.9) >= 0.0)


def test_a_loop_of_the_contact_turns_over_a_way():
    """Let go by its turn it has lost 2 (1 - 1 / e) of what it pressed more: at a speed it would have jumped."""
    p = np.concatenate([np.linspace(0.0, 30e-6, 3001), np.linspace(30e-6, 25e-6, 501)[1:]])
    more_n = loop_n(p, 5e-6, 0.01) - K * p
    assert more_n[3000] == pytest.approx(0.03, rel=1e-3)
    assert more_n[-1] == pytest.approx(0.025 * (2.0 / np.e - 1.0), abs=2e-5)


def test_each_side_has_its_own_error():
    law = CATALOGUE["contact_stiffness_error"].law
    assert law(1e-5, K, -1.0, 0.1, 0.0) == 0.01
    assert law(1e-5, K, 1.0, 0.1, 0.0) == 0.0


def test_width_and_centre_move_edges_apart_and_together():
    width, centre = CATALOGUE["backlash_width_change"].law, CATALOGUE["backlash_centre_shift"].law
    assert width(1.0, 4e-6) + width(-1.0, 4e-6) == 4e-6
    assert centre(1.0, 3e-6) + centre(-1.0, 3e-6) == 0.0
    assert centre(1.0, 3e-6) == 3e-6
