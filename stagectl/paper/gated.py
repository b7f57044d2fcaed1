"""The project's own estimator (`stagectl.backlash`) on the samples of the paper's identification test.

It sees both positions and what pushes the micro besides the joint: -F_2 of (10), a spring and a damper to the base,
taken from the measured positions. No observer, no first values, no marking by an estimate.
"""

from dataclasses import dataclass

import numpy as np

from stagectl import backlash, estimator
from stagectl.compiled import compiled
from stagectl.paper.printed_values import Backlash
from stagectl.profile import load_profile
from stagectl.regression import Doubts

EXACT = Doubts()
"""Masses and F_2 are those of the test."""

_PROFILE = "kang-2023"
_FILTER_S = 0.01  # nothing is controlled here: noise moves nothing
_COLUMNS = (
    *("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m"),
    *("left_sd_m", "right_sd_m", "left_knee_m", "right_knee_m"),
)  # as `_along` fills them
_SDS = ("left_sd_m", "right_sd_m", "left_stiffness_sd_n_per_m", "right_stiffness_sd_n_per_m")  # in Backlash's order


@dataclass(frozen=True, slots=True)
class Gated:
    """Estimates over time, shapes (n,), nan before the first; `sd` are the standard deviations of the last."""

    left_m: np.ndarray
    right_m: np.ndarray
    left_stiffness_n_per_m: np.ndarray
    right_stiffness_n_per_m: np.ndarray
    left_sd_m: np.ndarray
    right_sd_m: np.ndarray
    left_knee_m: np.ndarray
    right_knee_m: np.ndarray
    sd: Backlash
    mass_kg: float
    """Found beyond the believed one."""
    mass_sd_kg: float

    @property
    def last(self) -> Backlash:
        """The last estimates."""
        return Backlash(
            float(self.left_m[-1]),
            float(self.right_m[-1]),
            float(self.left_stiffness_n_per_m[-1]),
            float(self.right_stiffness_n_per_m[-1]),
        )


@compiled
def _along(b: np.ndarray, q: np.ndarray, macro_m: np.ndarray, end_m: np.ndarray, out: np.ndarray) -> None:
    record = b[0]
    belief = q[0]
    for k in range(end_m.size):
        backlash.step(record, k, macro_m[k], end_m[k], 0.0, belief)
        out[k, 0], out[k, 1] = record.left_m, record.right_m
        out[k, 2], out[k, 3] = record.left_stiffness_n_per_m, record.right_stiffness_n_per_m
        out[k, 4], out[k, 5] = record.left_sd_m, record.right_sd_m
        out[k, 6], out[k, 7] = record.left_knee_m, record.right_knee_m


def along(
    macro_position_m: np.ndarray,
    end_position_m: np.ndarray,
    spring_n_per_m: float,
    damping_n_s_per_m: float,
    *,
    noise_m: float = 100e-9,
    mass_error_ratio: float = 0.0,
    doubts: Doubts = EXACT,
    edge_drift_m_per_sqrt_s: float = 0.0,
) -> Gated:
    """Run the estimator over samples of a millisecond; spring and damping are those of F_2.

    Its belief: sensors of that noise, the micro's mass off by the ratio, and what else is doubted.
    """
    profile = load_profile(_PROFILE)
    belief = estimator.belief(profile)
    belief["spring_n_per_m"] = belief["damping_n_s_per_m"] = 0.0  # (10) has none between the stages
    belief["micro_mass_kg"] *= 1.0 + mass_error_ratio
    b = backlash.init(
        profile, _FILTER_S, doubts=doubts, force_noise_n=0.0, edge_drift_m_per_sqrt_s=edge_drift_m_per_sqrt_s
    )
    b["position_noise_m"] = noise_m
    b["end_spring_n_per_m"] = spring_n_per_m
    b["end_damping_n_s_per_m"] = damping_n_s_per_m
    out = np.empty((end_position_m.size, len(_COLUMNS)))
    _along(b, belief, macro_position_m, end_position_m, out)
    sd = Backlash(*(float(b[name][0]) for name in _SDS))
    columns = {name: out[:, k] for k, name in enumerate(_COLUMNS)}
    return Gated(**columns, sd=sd, mass_kg=float(b["mass_kg"][0]), mass_sd_kg=float(b["mass_sd_kg"][0]))
