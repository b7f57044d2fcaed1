"""Shapes that are searched: pitches, Stribeck speeds, exponents, corners; in the range that the recordings can show.

Pure.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from stagectl.effects import CATALOGUE, Effect
from stagectl.effects.table import TABLES
from stagectl.gap.recording import Recording

_SMOOTHINGS_M_PER_S = (1e-6, 1e-5, 1e-4, 1e-3)
"""Where velocities are judged their sign is known, and real friction is sharp: at 0.1 mm/s four times as much of a
Stribeck friction was left as at 0.01 mm/s. Rigs and measured machines are rounder."""

_SLIPS_M = (1e-6, 5e-6, 2e-5, 1e-4)
"""Of asperities and bristles. With 2 and 10 um only, bristles of 17 um were begun at a Stribeck speed of 10 mm/s for
1.6, and ended at 37."""

_ANCHORS = (0.0, 0.5, -0.5, 1.5, -1.5, 5.0, -5.0)
"""Of half the travel from its middle. Between two of them a cable loses 6 % of its gain at most: 15 degrees in the
plane of pull at rest and stiffness. From the middle alone one that was anchored beside the travel did not rank: 32 000
squares of 115 000, and the offset that it mostly is 105 000."""

_NOWHERE_M = 10.0
"""Farther than any travel: where dry friction ends that does not end."""

_ENDS = (0.3, -0.3, 0.7, -0.7)  # of half the travel from its middle

_LASER_M = 632.8e-9

_SLOPE_S = 1e-8
"""Delay that stands for a slope over delays: at 0.2 m/s it moves an edge by 2 nm. 10 us move it by 2 um, and beside a
lag of the other sensor, which is a slope, a delay of 249 us gained 1 square in place of 1466."""


def _recorded_travel_m(recordings: Sequence[Recording]) -> tuple[float, float]:
    """Return middle and half of the macro's travel."""
    centre_m = float(np.mean([0.5 * (r.log.macro_position_m.max() + r.log.macro_position_m.min()) for r in recordings]))
    return centre_m, 0.5 * max(float(np.ptp(r.log.macro_position_m)) for r in recordings)


def along_travel_m(recordings: Sequence[Recording]) -> tuple[float, float]:
    """Return from where to where a law may act that acts about a place: over the travel, about what was recorded.

    A cable is anchored where the stage goes. With an anchor half the travel beyond it one gained 5.4 squares of 385
    less than the offset that there was, and they were one set.
    """
    centre_m, half_m = _recorded_travel_m(recordings)
    reach_m = max(half_m, 0.5 * recordings[0].believed.travel_m)
    return centre_m - reach_m, centre_m + reach_m


def free_shapes(known: Effect) -> tuple[str, ...]:
    """Return the shape parameters of an effect that are searched beyond the grid; all, where it is the user's own."""
    return known.shape if known.origin else known.searched


Grid = dict[str, list[dict[str, float]]]


def grids_for(recordings: Sequence[Recording]) -> Grid:
    """Return, by effect, the shapes to try on these recordings."""
    centre_m, half_m = _recorded_travel_m(recordings)
    smooth = [{"smoothing_m_per_s": v} for v in _SMOOTHINGS_M_PER_S]
    library = {
        "coulomb_friction": smooth,
        "asymmetric_coulomb_friction": smooth,
        "stribeck_friction": [
            sharp | {"stribeck_m_per_s": v} for v in (5e-4, 1e-3, 3e-3, 1e-2, 3e-2, 6e-2) for sharp in smooth[::2]
        ],
        "sublinear_viscous_friction": [{"exponent_ratio": p} for p in (0.3, 0.45, 0.6, 0.75)],
        "load_dependent_friction": smooth[::2],
        "position_dependent_friction": [
            sharp | {"ends_m": end_m}
            for end_m in (_NOWHERE_M, *(centre_m + share * half_m for share in _ENDS))
            for sharp in smooth[::2]
        ],
        "dahl_friction": [{"slip_m": s} for s in _SLIPS_M],
        "lugre_friction": [
            {"static_ratio": 1.5, "stribeck_m_per_s": v, "slip_m": s, "bristle_damping_s": 3e-4}
            for v in (8e-4, 3e-3, 1e-2)
            for s in _SLIPS_M
        ],
        "cable_hysteresis": [
            {"slip_m": s, "exponent_ratio": p} for s in (2e-3, 6e-3, 2e-2, 6e-2) for p in (0.0, 0.999)
        ],
        "cable_spring": [{"anchor_m": centre_m + share * half_m} for share in _ANCHORS],
        "contact_damping": [{"damping_n_s_per_m": d} for d in (30.0, 150.0, 600.0)],
        "contact_hysteresis": [{"turn_m": t} for t in (1e-6, 5e-6, 2e-5)],
        "soft_contact": [{"knee_m": k} for k in (3e-6, 1e-5, 3e-5, 6e-5)],
        "force_constant_saturation": [{"saturation_n": s} for s in (150.0, 400.0, 1000.0, 3000.0)],
        "amplifier_dead_band": [{"half_width_a": w} for w in (1e-3, 3e-3, 1e-2, 3e-2)],
        "current_loop_lag": [{"time_constant_s": t} for t in (5e-5, 2e-4, 5e-4)],
        "command_delay": [{"delay_s": t} for t in (5e-5, 2e-4, 6e-4)],
        "flexible_mode": [
            {"share_ratio": 0.02, "frequency_hz": float(f), "damping_ratio": 0.02} for f in np.geomspace(8.0, 200.0, 34)
        ],
        "sensor_delay": [{"delay_s": t} for t in (_SLOPE_S, 3e-4)],
        "sensor_lag": [{"time_constant_s": t} for t in (_SLOPE_S, 3e-4)],
        "clock_skew": [{"skew_ppm": s} for s in (1e6 * _SLOPE_S, 10.0)],
        "cyclic_error": [
            {"wavelength_m": _LASER_M, "second_m": 0.0, "second_phase_rad": 0.0},
            {"wavelength_m": _LASER_M, "first_m": 0.0, "first_phase_rad": 0.0},
            {"wavelength_m": _LASER_M},
        ],
        "thermal_drift": [{"time_constant_s": t} for t in (20.0, 60.0, 200.0)],
        "abbe_error": [{"centre_m": 0.0}, {"centre_m": centre_m}],
    }
    mine = recordings[0].believed.own_effects
    own = [known for known in CATALOGUE.values() if known.origin]
    library |= {name: [] for name in TABLES}  # twelve forces fit anything: never a name
    return library | {known.name: _grid_of(known) if known.name in mine else [] for known in own}


_MOST_SHAPES = 60
_STEPS = (12, 7, 3)  # of one, two, more shape parameters
_WIDE = 20.0  # ratio of bounds from which steps are ratios


def _grid_of(known: Effect) -> list[dict[str, float]]:
    """Return shapes between the bounds of a user's effect; its files of others in this process have none."""
    names = known.shape
    if not names:
        return [{}]
    count = _STEPS[min(len(names), len(_STEPS)) - 1]
    values = []
    for low, high in (known.bounds[name] for name in names):
        inside = np.arange(1, count + 1) / (count + 1)
        is_wide = low > 0.0 and high > _WIDE * low
        values.append(low * (high / low) ** inside if is_wide else low + (high - low) * inside)
    shapes = [dict(zip(names, map(float, shape), strict=True)) for shape in itertools.product(*values)]
    return shapes[:: -(-len(shapes) // _MOST_SHAPES)]
