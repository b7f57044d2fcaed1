"""Shapes that are searched: pitches, Stribeck speeds, exponents, corners; in the range that the recordings can show.

Pure.
"""

import numpy as np

from stagectl.gap.balance import Recording

Grid = dict[str, list[dict[str, float]]]


def grids_for(recordings: list[Recording]) -> Grid:
    """Return, by effect, the shapes to try on these recordings."""
    centre_m = float(np.mean([0.5 * (r.log.macro_position_m.max() + r.log.macro_position_m.min()) for r in recordings]))
    return {
        "coulomb_friction": [{"smoothing_m_per_s": 1e-4}],
        "asymmetric_coulomb_friction": [{"smoothing_m_per_s": 1e-4}],
        "cable_spring": [{"anchor_m": centre_m}],
    }
