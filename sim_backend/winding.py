"""The winding of a motor: how warm its current makes it, and how it cools.

First order, ambient at rest, copper's resistance as at the rated current throughout:

    T' = ((i / i_rated)^2 * rise_rated - T) / tau,    reading = ambient + T

Exact for a current that is constant over a step. Pure; knows no drive and no clock.
"""

from typing import Any

import numpy as np

from stagectl.compiled import compiled

WINDING_PARAMETERS = np.dtype(
    [
        ("ambient_degc", "f8"),
        ("rise_per_a2_k", "f8"),  # K at rest for 1 A^2
        ("time_constant_s", "f8"),
    ]
)

WINDING_STATE = np.dtype([("rise_k", "f8")])


def parameters(axis: Any, ambient_degc: float) -> np.ndarray:
    """Make WINDING_PARAMETERS from an axis of a machine; one without a `winding` stays at ambient temperature."""
    p = np.zeros(1, WINDING_PARAMETERS)
    p["ambient_degc"] = ambient_degc
    p["time_constant_s"] = 1.0
    winding = getattr(axis, "winding", None)
    if winding is not None:
        p["rise_per_a2_k"] = winding.rise_at_rated_current_k / axis.rated_current_a**2
        p["time_constant_s"] = winding.time_constant_s
    return p


def init() -> np.ndarray:
    """Make WINDING_STATE of a motor that stood without current for long."""
    return np.zeros(1, WINDING_STATE)


@compiled
def step(state, parameters, current_a, dt_s):
    """Let `current_a` flow for `dt_s`."""
    s = state[0]
    p = parameters[0]
    s.rise_k -= (current_a * current_a * p.rise_per_a2_k - s.rise_k) * np.expm1(-dt_s / p.time_constant_s)


def temperature_degc(state: np.ndarray, parameters: np.ndarray) -> float:
    """Return the winding's temperature now."""
    return float(parameters["ambient_degc"][0] + state["rise_k"][0])
