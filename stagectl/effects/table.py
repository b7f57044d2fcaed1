"""Forces that nobody has a law for: twelve values at even steps of one quantity, straight lines between them.

What repeats and has no name is written so, by a search that found only its curve. Beyond both ends the outer value
holds.
"""

from typing import Any

import numpy as np

from stagectl.compiled import compiled
from stagectl.effects.declaration import effect

KNOTS_COUNT = 12

TABLES = {
    "force_over_position": "position_m",
    "force_over_velocity": "velocity_m_per_s",
    "force_over_relative_position": "relative_position_m",
}
"""Every table and what it is over; a table never counts as a name."""

_AXES = ("macro_force", "micro_force")
_FORCES: dict[str, Any] = {f"force_{k}_n": (-1e4, 1e4) for k in range(1, KNOTS_COUNT + 1)}
_REFERENCE = "de Boor, A Practical Guide to Splines, chapter III: linear interpolation"


# fmt: off
@compiled
def _between(
    u,
    force_1_n, force_2_n, force_3_n, force_4_n, force_5_n, force_6_n,
    force_7_n, force_8_n, force_9_n, force_10_n, force_11_n, force_12_n,
):
    """Return the force at `u` steps from the first knot."""
    total = force_1_n
    total = total + (force_2_n - force_1_n) * np.minimum(np.maximum(u - 0.0, 0.0), 1.0)
    total = total + (force_3_n - force_2_n) * np.minimum(np.maximum(u - 1.0, 0.0), 1.0)
    total = total + (force_4_n - force_3_n) * np.minimum(np.maximum(u - 2.0, 0.0), 1.0)
    total = total + (force_5_n - force_4_n) * np.minimum(np.maximum(u - 3.0, 0.0), 1.0)
    total = total + (force_6_n - force_5_n) * np.minimum(np.maximum(u - 4.0, 0.0), 1.0)
    total = total + (force_7_n - force_6_n) * np.minimum(np.maximum(u - 5.0, 0.0), 1.0)
    total = total + (force_8_n - force_7_n) * np.minimum(np.maximum(u - 6.0, 0.0), 1.0)
    total = total + (force_9_n - force_8_n) * np.minimum(np.maximum(u - 7.0, 0.0), 1.0)
    total = total + (force_10_n - force_9_n) * np.minimum(np.maximum(u - 8.0, 0.0), 1.0)
    total = total + (force_11_n - force_10_n) * np.minimum(np.maximum(u - 9.0, 0.0), 1.0)
    total = total + (force_12_n - force_11_n) * np.minimum(np.maximum(u - 10.0, 0.0), 1.0)
    return total


@effect(
    places=_AXES,
    first_m=(-10.0, 10.0),
    step_m=(1e-9, 10.0),
    **_FORCES,
    linear=tuple(_FORCES),
    symptom="repeats over the position, in the shape of no law of the library",
    reference=_REFERENCE,
)
def force_over_position(
    position_m, first_m, step_m,
    force_1_n, force_2_n, force_3_n, force_4_n, force_5_n, force_6_n,
    force_7_n, force_8_n, force_9_n, force_10_n, force_11_n, force_12_n,
):
    """Table over position: F_k at the first knot + (k - 1) steps, linear between."""
    return _between(
        (position_m - first_m) / step_m,
        force_1_n, force_2_n, force_3_n, force_4_n, force_5_n, force_6_n,
        force_7_n, force_8_n, force_9_n, force_10_n, force_11_n, force_12_n,
    )


@effect(
    places=_AXES,
    first_m_per_s=(-20.0, 20.0),
    step_m_per_s=(1e-9, 20.0),
    **_FORCES,
    linear=tuple(_FORCES),
    symptom="repeats over the velocity, in the shape of no law of the library",
    reference=_REFERENCE,
)
def force_over_velocity(
    velocity_m_per_s, first_m_per_s, step_m_per_s,
    force_1_n, force_2_n, force_3_n, force_4_n, force_5_n, force_6_n,
    force_7_n, force_8_n, force_9_n, force_10_n, force_11_n, force_12_n,
):
    """Table over velocity: F_k at the first knot + (k - 1) steps, linear between."""
    return _between(
        (velocity_m_per_s - first_m_per_s) / step_m_per_s,
        force_1_n, force_2_n, force_3_n, force_4_n, force_5_n, force_6_n,
        force_7_n, force_8_n, force_9_n, force_10_n, force_11_n, force_12_n,
    )


@effect(
    places=_AXES,
    first_m=(-1.0, 1.0),
    step_m=(1e-9, 1.0),
    **_FORCES,
    linear=tuple(_FORCES),
    symptom="repeats over the relative position, end minus macro, in the shape of no law of the library",
    reference=_REFERENCE,
)
def force_over_relative_position(
    relative_position_m, first_m, step_m,
    force_1_n, force_2_n, force_3_n, force_4_n, force_5_n, force_6_n,
    force_7_n, force_8_n, force_9_n, force_10_n, force_11_n, force_12_n,
):
    """Table over relative position, end minus macro: F_k at the first knot + (k - 1) steps, linear between."""
    return _between(
        (relative_position_m - first_m) / step_m,
        force_1_n, force_2_n, force_3_n, force_4_n, force_5_n, force_6_n,
        force_7_n, force_8_n, force_9_n, force_10_n, force_11_n, force_12_n,
    )
# fmt: on
