"""What a reading has of its own, against motions whose readings are known."""

import math

import numpy as np
import pytest

from stagectl.effects import CATALOGUE
from tests.test_effects import along

W = 2.0 * math.pi * 3.0
T_S = 1e-3 * np.arange(2000)
SWING = {  # 5 mm at 3 Hz
    "position_m": 5e-3 * np.sin(W * T_S),
    "velocity_m_per_s": 5e-3 * W * np.cos(W * T_S),
    "acceleration_m_per_s2": -5e-3 * W * W * np.sin(W * T_S),
    "t_s": T_S,
    "dt_s": np.concatenate([[0.0], np.full(1999, 1e-3)]),
}


def test_a_delayed_swing():
    """Taylor's rest is jerk T^3 / 6: 33 m/s^3 x (0.5 ms)^3 / 6 = 0.7 nm."""
    found = SWING["position_m"] + along("sensor_delay", (0.5e-3,), SWING)
    wanted = 5e-3 * np.sin(W * (T_S - 0.5e-3))
    assert 0.3e-9 < np.max(np.abs(found - wanted)) < 0.8e-9


def test_a_lagging_swing():
    """1 / (1 + s tau) at 3 Hz with 2 ms: 0.99929 of the amplitude, 2.159 degrees behind."""
    found = (SWING["position_m"] + along("sensor_lag", (2e-3,), SWING))[1000:]
    wanted = 5e-3 / math.hypot(1.0, W * 2e-3) * np.sin(W * T_S[1000:] - math.atan(W * 2e-3))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=40e-9)  # of a jerk over a step: 33 m/s^3 (1 ms)^2 tau / 2


def test_at_rest_neither_delay_nor_lag_shows():
    still = {key: np.full(10, 0.3 if key == "position_m" else 0.0) for key in SWING} | {"dt_s": np.full(10, 1e-3)}
    for name, value in (("sensor_delay", 1e-3), ("sensor_lag", 1e-3), ("clock_skew", 20.0)):
        assert np.all(along(name, (value,), still) == 0.0)


def test_a_cyclic_error_repeats_with_half_the_wavelength():
    law = CATALOGUE["cyclic_error"].law
    position = np.linspace(0.0, 1e-6, 200)
    parameters = (5e-9, 2e-9, 633e-9, 0.3, -0.2)
    np.testing.assert_allclose(law(position + 316.5e-9, *parameters), law(position, *parameters), atol=1e-20)
    assert np.max(np.abs(law(position, *parameters))) <= 7e-9


@pytest.mark.parametrize("t_s", [0.0, 60.0, 1e4])
def test_a_drift_levels_off(t_s):
    found = CATALOGUE["thermal_drift"].law(t_s, 300e-9, 600.0)
    assert found == pytest.approx(300e-9 * (1.0 - math.exp(-t_s / 600.0)), rel=1e-12)
