"""The believed contact of the joint: where its parts overlap along a motion, and how they push each other. Pure."""

from dataclasses import dataclass

import numpy as np

from stagectl.gap.believed import Believed, BelievedJoint

CONTACT_DAMPING = "contact_damping"
"""The effect of the library that decides about where a contact lets go."""


@dataclass(slots=True)
class Contact:
    """The believed joint's overlap, means over parts of intervals: side (+1 right, -1 left, 0 free), depth, its rate.

    Depth and rate are zero while the joint is free, so that forces that are linear in them are means as well.
    """

    side: np.ndarray
    depth_m: np.ndarray
    depth_rate_m_per_s: np.ndarray

    def push_n(self, joint: BelievedJoint, damping_n_s_per_m: float) -> np.ndarray:
        """Force on the end."""
        stiff_n = side_stiffness_n_per_m(joint, self.side) * self.depth_m
        return self.side * (stiff_n + damping_n_s_per_m * self.depth_rate_m_per_s)


def contact_at(
    believed: Believed,
    joint: BelievedJoint,
    x_b: np.ndarray,
    x_b_rate: np.ndarray,
    left_out_m: np.ndarray | float = 0.0,
    right_out_m: np.ndarray | float = 0.0,
) -> Contact:
    """Return the overlap at x_b = macro minus end with edges moved outward, shapes as x_b.

    A contact whose damping would pull has let go. An edge is met, and let go of, at its own instant within a part: by
    whole parts the jump of a damping stayed where it was while edges and delays moved, and what it weighs (5 N over
    0.25 ms) made the delay of one sensor seem known to 0.15 us where it was 220 us off.
    """
    damping = contact_damping_n_s_per_m(believed)
    part_s = believed.period_s / x_b.shape[-1]
    right = _overlap(x_b - joint.right_m - right_out_m, x_b_rate, joint.right_stiffness_n_per_m, damping, part_s)
    left = _overlap(-joint.left_m - left_out_m - x_b, -x_b_rate, joint.left_stiffness_n_per_m, damping, part_s)
    is_right, is_left = right[0] > 0.0, left[0] > 0.0
    side = np.where(is_right, 1.0, np.where(is_left, -1.0, 0.0))
    share, depth_m, rate = (
        np.where(is_right, one, np.where(is_left, other, 0.0)) for one, other in zip(right, left, strict=True)
    )
    return Contact(side, depth_m, share * rate)


def _overlap(
    depth_m: np.ndarray, rate: np.ndarray, stiffness_n_per_m: float, damping_n_s_per_m: float, part_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (share of a part in which one side pushes, mean depth of that, rate) on straight lines within parts."""
    from_m = np.maximum(-damping_n_s_per_m / stiffness_n_per_m * rate, 0.0)  # pulling, it has let go
    half_m = np.maximum(0.5 * part_s * np.abs(rate), _LEAST_M)
    top_m = depth_m + half_m
    share = np.clip(0.5 * (top_m - from_m) / half_m, 0.0, 1.0)
    return share, 0.5 * share * (top_m + np.maximum(depth_m - half_m, from_m)), rate


_LEAST_M = 1e-12


def contact_damping_n_s_per_m(believed: Believed) -> float:
    """Return the damping that the joint is believed to have in contact only."""
    return sum(row["damping_n_s_per_m"] for row in believed.effects if row["name"] == CONTACT_DAMPING)


def side_stiffness_n_per_m(joint: BelievedJoint, side: np.ndarray) -> np.ndarray:
    """Return the stiffness of the side that touches; left where none does."""
    return np.where(side > 0.0, joint.right_stiffness_n_per_m, joint.left_stiffness_n_per_m)
