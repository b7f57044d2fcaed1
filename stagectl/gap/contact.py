"""The believed contact of the joint: where its parts overlap along a motion, and how they push each other. Pure."""

from dataclasses import dataclass

import numpy as np

from stagectl.gap.believed import Believed, BelievedJoint

CONTACT_DAMPING = "contact_damping"
"""The effect of the library that decides about where a contact lets go."""


@dataclass(slots=True)
class Contact:
    """The believed joint's overlap on parts of intervals: side (+1 right, -1 left, 0 free), depth, its rate."""

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

    A contact whose damping would pull has let go.
    """
    right_m, left_m = x_b - joint.right_m - right_out_m, -joint.left_m - left_out_m - x_b
    side = np.where(right_m > 0.0, 1.0, np.where(left_m > 0.0, -1.0, 0.0))
    depth = np.where(side > 0.0, right_m, np.where(side < 0.0, left_m, 0.0))
    overlap = Contact(side, depth, side * x_b_rate)
    touches = side * overlap.push_n(joint, contact_damping_n_s_per_m(believed)) > 0.0
    return Contact(side * touches, depth * touches, overlap.depth_rate_m_per_s * touches)


def contact_damping_n_s_per_m(believed: Believed) -> float:
    """Return the damping that the joint is believed to have in contact only."""
    return sum(row["damping_n_s_per_m"] for row in believed.effects if row["name"] == CONTACT_DAMPING)


def side_stiffness_n_per_m(joint: BelievedJoint, side: np.ndarray) -> np.ndarray:
    """Return the stiffness of the side that touches; left where none does."""
    return np.where(side > 0.0, joint.right_stiffness_n_per_m, joint.left_stiffness_n_per_m)
