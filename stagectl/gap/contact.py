"""The believed contact of the joint: where its parts overlap along a motion, and how they push each other. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from stagectl.compiled import compiled, inlined
from stagectl.gap.believed import BelievedJoint

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
        force_n = _pushes_n(
            self.side.ravel(), self.depth_m.ravel(), self.depth_rate_m_per_s.ravel(),
            joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m, damping_n_s_per_m,
        )  # fmt: skip
        return force_n.reshape(self.side.shape)


def contact_at(
    joint: BelievedJoint,
    damping_n_s_per_m: float,
    x_b: np.ndarray,
    x_b_rate: np.ndarray,
    part_s: float,
    left_out_m: np.ndarray | float = 0.0,
    right_out_m: np.ndarray | float = 0.0,
) -> Contact:
    """Return the overlap at x_b = macro minus end with edges moved outward, shapes as x_b.

    A contact whose damping would pull has let go. An edge is met, and let go of, at its own instant within a part: by
    whole parts the jump of a damping stayed where it was while edges and delays moved, and what it weighs (5 N over
    0.25 ms) made the delay of one sensor seem known to 0.15 us where it was 220 us off.
    """
    shape = x_b.shape
    left_edge_m, right_edge_m = np.atleast_1d(-joint.left_m - left_out_m), np.atleast_1d(joint.right_m + right_out_m)
    side, depth_m, rate = _overlaps(
        x_b.ravel(), x_b_rate.ravel(), left_edge_m.ravel(), right_edge_m.ravel(),
        joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m, damping_n_s_per_m, part_s,
    )  # fmt: skip
    return Contact(side.reshape(shape), depth_m.reshape(shape), rate.reshape(shape))


def more_push_n(
    joint: BelievedJoint,
    damping_n_s_per_m: float,
    x_b: np.ndarray,
    x_b_rate: np.ndarray,
    part_s: float,
    apart_m: np.ndarray | float,
    apart_m_per_s: np.ndarray | float,
    left_out_m: np.ndarray | float,
    right_out_m: np.ndarray | float,
    push_n: np.ndarray,
) -> np.ndarray:
    """Return by how much more than `push_n` the contact pushes the end with x_b and its rate larger by what is apart.

    All in one pass: a search moves edges and readings a thousand times, and tables in between were half of its time.
    """
    apart_m, apart_m_per_s = np.atleast_1d(apart_m).ravel(), np.atleast_1d(apart_m_per_s).ravel()
    left_edge_m, right_edge_m = np.atleast_1d(-joint.left_m - left_out_m), np.atleast_1d(joint.right_m + right_out_m)
    more_n = _pushes_more_n(
        x_b.ravel(), x_b_rate.ravel(), apart_m, apart_m_per_s, left_edge_m.ravel(), right_edge_m.ravel(),
        joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m, damping_n_s_per_m, part_s, push_n.ravel(),
    )  # fmt: skip
    return more_n.reshape(x_b.shape)


_LEAST_M = 1e-12


@compiled
def _overlaps(
    x_b: np.ndarray,
    x_b_rate: np.ndarray,
    left_edge_m: np.ndarray,
    right_edge_m: np.ndarray,
    left_n_per_m: float,
    right_n_per_m: float,
    damping_n_s_per_m: float,
    part_s: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return side, mean depth and mean rate, shapes (n,); an edge has one place, or one for every x_b."""
    side, depth_m, rate = np.zeros(x_b.size), np.zeros(x_b.size), np.zeros(x_b.size)
    for k in range(x_b.size):
        side[k], depth_m[k], rate[k] = _touch(
            x_b[k], x_b_rate[k], left_edge_m[k if left_edge_m.size > 1 else 0],
            right_edge_m[k if right_edge_m.size > 1 else 0], left_n_per_m, right_n_per_m, damping_n_s_per_m, part_s,
        )  # fmt: skip
    return side, depth_m, rate


@compiled
def _pushes_more_n(
    x_b: np.ndarray,
    x_b_rate: np.ndarray,
    apart_m: np.ndarray,
    apart_m_per_s: np.ndarray,
    left_edge_m: np.ndarray,
    right_edge_m: np.ndarray,
    left_n_per_m: float,
    right_n_per_m: float,
    damping_n_s_per_m: float,
    part_s: float,
    push_n: np.ndarray,
) -> np.ndarray:
    """Return what is pushed beyond `push_n`, (n,); what is apart and the edges have one value, or one for every x_b."""
    more_n = np.empty(x_b.size)
    for k in range(x_b.size):
        side, depth_m, rate = _touch(
            x_b[k] + apart_m[k if apart_m.size > 1 else 0],
            x_b_rate[k] + apart_m_per_s[k if apart_m_per_s.size > 1 else 0],
            left_edge_m[k if left_edge_m.size > 1 else 0], right_edge_m[k if right_edge_m.size > 1 else 0],
            left_n_per_m, right_n_per_m, damping_n_s_per_m, part_s,
        )  # fmt: skip
        more_n[k] = _push_n(side, depth_m, rate, left_n_per_m, right_n_per_m, damping_n_s_per_m) - push_n[k]
    return more_n


@inlined
def _touch(x_b, x_b_rate, left_edge_m, right_edge_m, left_n_per_m, right_n_per_m, damping_n_s_per_m, part_s):
    """Return (side, mean depth, mean rate) of one part."""
    share, depth_m = _overlap(x_b - right_edge_m, x_b_rate, damping_n_s_per_m / right_n_per_m, part_s)
    if share > 0.0:
        return 1.0, depth_m, share * x_b_rate
    share, depth_m = _overlap(left_edge_m - x_b, -x_b_rate, damping_n_s_per_m / left_n_per_m, part_s)
    if share > 0.0:
        return -1.0, depth_m, -share * x_b_rate
    return 0.0, 0.0, 0.0


@inlined
def _overlap(middle_m: float, rate: float, damping_s: float, part_s: float) -> tuple[float, float]:
    """Return (share of a part in which one side pushes, mean depth of that) on a straight line within the part.

    `damping_s`: damping over stiffness. What would pull has let go.
    """
    from_m = max(-damping_s * rate, 0.0)
    half_m = max(0.5 * part_s * abs(rate), _LEAST_M)
    top_m = middle_m + half_m
    if not top_m > from_m:
        return 0.0, 0.0
    share = min(max(0.5 * (top_m - from_m) / half_m, 0.0), 1.0)
    return share, 0.5 * share * (top_m + max(middle_m - half_m, from_m))


@compiled
def _pushes_n(
    side: np.ndarray,
    depth_m: np.ndarray,
    rate: np.ndarray,
    left_n_per_m: float,
    right_n_per_m: float,
    damping_n_s_per_m: float,
) -> np.ndarray:
    force_n = np.empty(side.size)
    for k in range(side.size):
        force_n[k] = _push_n(side[k], depth_m[k], rate[k], left_n_per_m, right_n_per_m, damping_n_s_per_m)
    return force_n


@inlined
def _push_n(side, depth_m, rate, left_n_per_m, right_n_per_m, damping_n_s_per_m):
    stiffness = right_n_per_m if side > 0.0 else left_n_per_m
    return side * (stiffness * depth_m + damping_n_s_per_m * rate)


def contact_damping_n_s_per_m(effects: Iterable[dict[str, Any]]) -> float:
    """Return the damping that these effects give the joint in contact only."""
    return sum(row["damping_n_s_per_m"] for row in effects if row["name"] == CONTACT_DAMPING)


def side_stiffness_n_per_m(joint: BelievedJoint, side: np.ndarray) -> np.ndarray:
    """Return the stiffness of the side that touches; left where none does."""
    return np.where(side > 0.0, joint.right_stiffness_n_per_m, joint.left_stiffness_n_per_m)
