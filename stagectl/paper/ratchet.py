"""How far the sensors' noise alone carries the adaptive bound of (40) up while the stage stands still.

The right side of (40) is a square: noise of position makes s, and s^2 has a mean. As printed nothing takes it back, so
the bound climbs for as long as the drive is on, by alpha k / r times the mean of s^2. Pure.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.paper import cases, closed_loop, plant_as_printed
from stagectl.paper.cases import SAMPLE_S, Setting
from stagectl.paper.printed_values import CONTROL_5_3
from stagectl.paper.references import Reference

NOISE_M = 5e-9

_HOUR_S = 3600.0
_NORMAL_95 = 1.96
_PART_S = 10.0
_SETTLED_PARTS = 1
_SUBSTEPS = 2  # nothing moves: 4 and 20 give the same to seven digits
_SEED = 1


@dataclass(frozen=True, slots=True)
class Climb:
    """What a hold of some minutes did to the bound."""

    rate_n_per_h: float
    half_width_n_per_h: float  # of the rate's 95 % interval
    last_bound_n: float

    @property
    def doubled_h(self) -> float:
        """Hours until k + (k / r) Omega is twice k: the bound is r."""
        return (CONTROL_5_3.r - CONTROL_5_3.first_bound_n) / self.rate_n_per_h


def at_rest(law: np.ndarray, duration_s: float, noise_m: float = NOISE_M) -> Climb:
    """Hold still under a law; both sensors have white noise of `noise_m` rms, velocities are differences of samples."""
    plant, loop, decoupler = cases.prepared(Setting(decoupling=closed_loop.DECOUPLING_DYNAMIC))
    loop["substeps"] = _SUBSTEPS
    state = plant_as_printed.init()
    noise = np.random.default_rng(_SEED)
    count = round(_PART_S / SAMPLE_S)
    still = np.zeros(count)
    reference = Reference("rest", SAMPLE_S, still, still, still)
    bounds_n = []
    for _ in range(round(duration_s / _PART_S) + _SETTLED_PARTS):
        noises_m = noise_m * noise.standard_normal((count, 2))
        closed_loop.run(plant, loop, reference, law=law, decoupler=decoupler, state=state, noise_m=noises_m)
        bounds_n.append(float(law["bound_n"][0]))
    climbs_n = np.diff(bounds_n[_SETTLED_PARTS - 1 :]) * _HOUR_S / _PART_S
    half_width = _NORMAL_95 * float(np.std(climbs_n, ddof=1)) / np.sqrt(climbs_n.size)
    return Climb(float(np.mean(climbs_n)), half_width, bounds_n[-1])
