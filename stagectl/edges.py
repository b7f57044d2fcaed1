"""Edges, stiffness and knee of the joint, as the regression has them; and the regressors that switch at an edge.

A side at penetration p beyond its line, with hysteresis h, damping c and a knee of length delta:

    F = (K +- h) p + c p' + (K +- h) delta^2 / 24 pulse(p),   + when pressed, - when let go

A contact F = K p^2 / (2 delta) up to delta, K (p - delta / 2) beyond, is the line of K that begins delta / 2 behind
the onset, and an excess of area K delta^2 / 24 around there. It passes in milliseconds and the filter remembers tens
of them, so any pulse of that area does. Pure.
"""

import numpy as np

from stagectl.compiled import compiled
from stagectl.regression import (
    KNEE_SCALE_N_M,
    LEFT,
    POSITION_SCALE_M,
    RIGHT,
    SIDE_COUNT,
    VELOCITY_SCALE_M_PER_S,
)
from stagectl.signals import Record

_PULSE_M = 5.5e-6  # as wide, in standard deviation, as what a knee of 10 um has in excess
_KNEE_POINTS_COUNT = 32
_KNEE_MODEL_RATIO = 0.01  # what a pulse of one width gives away of knees of 5 to 15 um
_MODEL_M = 1e-9  # what a straight line between samples gives away at an edge
_SURE_SDS = 5.0  # that a stiffness is above zero by before an edge is published


@compiled
def filtered(b: Record, z1: float, z2: float, z3: float, old: float, new: float) -> tuple[float, float, float]:
    """Advance one chain by a period with its input going from `old` to `new` in a line."""
    n1 = b.decay_0 * z1 + b.old_1 * old + b.new_1 * new
    n2 = b.decay_1 * z1 + b.decay_0 * z2 + b.old_2 * old + b.new_2 * new
    n3 = b.decay_2 * z1 + b.decay_1 * z2 + b.decay_0 * z3 + b.old_3 * old + b.new_3 * new
    return n1, n2, n3


@compiled
def _pulse(low_m: float, high_m: float) -> float:
    """Return the mean, 1/m, of a pulse of area 1 about 0 over a way from `low_m` to `high_m`."""
    half_m = 0.5 * _PULSE_M
    if high_m - low_m < 1e-12:
        return 1.0 / _PULSE_M if abs(low_m) < half_m else 0.0
    inside_m = min(high_m, half_m) - max(low_m, -half_m)
    return max(inside_m, 0.0) / (high_m - low_m) / _PULSE_M


@compiled
def filter_switched(b: Record, side: int, from_m: float, to_m: float, smooth_rate: float) -> None:
    """Advance a side's switched regressors while the joint goes from one place to another in a line.

    In contact from the edge on; a damped joint lets go while it still overlaps: K p + c p' < 0, a contact never pulls.
    The rate of a single interval is mostly noise: where it lets go follows the smooth one.
    """
    sign = 1.0 if side == 1 else -1.0
    switch_m = b.right_switch_m if side == 1 else b.left_switch_m
    origin_m = b.origin_m + (b.right_origin_m if side == 1 else b.left_origin_m)
    stiffness = b.right_stiffness_n_per_m if side == 1 else b.left_stiffness_n_per_m
    damping = b.right_damping_n_s_per_m if side == 1 else b.left_damping_n_s_per_m
    loss = b.right_loss_ratio if side == 1 else b.left_loss_ratio
    from_p = sign * (from_m + b.origin_m) - switch_m
    to_p = sign * (to_m + b.origin_m) - switch_m
    low, high = min(from_p, to_p), max(from_p, to_p)
    rate = (to_m - from_m) / b.period_s
    least_p = max(0.0, -damping * sign * smooth_rate / stiffness)
    share, mean_p = 0.0, 0.0
    if low >= least_p:
        share, mean_p = 1.0, 0.5 * (low + high)
    elif high > least_p:
        share = (high - least_p) / (high - low)
        mean_p = share * 0.5 * (high + least_p)
    for k in range(SIDE_COUNT):
        if k == 0:
            new = (sign * (mean_p + switch_m * share) - origin_m * share) / POSITION_SCALE_M
        elif k == 1:
            new = share
        elif k == 2:
            new = share * rate / VELOCITY_SCALE_M_PER_S
        elif k == 3:
            new = sign * _pulse(low, high) * KNEE_SCALE_N_M * (1.0 + loss if sign * smooth_rate > 0.0 else 1.0 - loss)
        else:
            new = (mean_p if smooth_rate > 0.0 else -mean_p) / POSITION_SCALE_M
        z = b.switched[side, k]
        z[0], z[1], z[2] = filtered(b, z[0], z[1], z[2], new, new)


@compiled
def _knee(area: float, area_sd: float, stiffness: float) -> tuple[float, float]:
    """Return mean and standard deviation of delta, K delta^2 / 24 = area, m; every delta as likely beforehand."""
    longest_m = np.sqrt(24.0 * max(area + 4.0 * area_sd, area_sd) / stiffness)
    total, first, second = 0.0, 0.0, 0.0
    for k in range(_KNEE_POINTS_COUNT):
        delta_m = longest_m * (k + 0.5) / _KNEE_POINTS_COUNT
        off = (stiffness * delta_m * delta_m / 24.0 - area) / area_sd
        weight = np.exp(-0.5 * min(off * off, 600.0))
        total += weight
        first += weight * delta_m
        second += weight * delta_m * delta_m
    mean_m = first / total
    step_m = longest_m / _KNEE_POINTS_COUNT
    return mean_m, np.sqrt(max(second / total - mean_m * mean_m, step_m * step_m / 12.0))


@compiled
def found(b: Record, side: int, with_knee: bool) -> tuple[float, float, float, float, float, float]:
    """Return (edge, its sd, stiffness, its sd, line, knee) of a side; nan and inf where it is not identifiable.

    A force that is no contact (a cable, a wrong offset) may be held long enough to pass the gate: it doesn't grow
    with x_b.
    """
    at = RIGHT if side == 1 else LEFT
    sign = 1.0 if side == 1 else -1.0
    origin_m = b.origin_m + (b.right_origin_m if side == 1 else b.left_origin_m)
    theta = b.theta
    c = b.covariance
    slope = theta[at]
    ratio = max(b.residual_ratio, 1.0)
    stiffness = slope / POSITION_SCALE_M
    stiffness_sd = np.sqrt(ratio * c[at, at]) / POSITION_SCALE_M
    if not stiffness > _SURE_SDS * stiffness_sd:
        return np.nan, np.inf, np.nan, np.inf, np.nan, 0.0
    line = -theta[at + 1] / slope
    variance = (c[at + 1, at + 1] + 2.0 * line * c[at, at + 1] + line * line * c[at, at]) / (slope * slope)
    line_m = sign * (line * POSITION_SCALE_M + origin_m)
    sd_m = np.sqrt(ratio * variance * POSITION_SCALE_M * POSITION_SCALE_M + _MODEL_M * _MODEL_M)
    if not with_knee:
        return line_m, sd_m, stiffness, stiffness_sd, line_m, 0.0
    # The pulse's area belongs to where the regressors are switched: a line that begins elsewhere has one too.
    off_m = line_m - (b.right_switch_m if side == 1 else b.left_switch_m)
    area = theta[at + 3] * KNEE_SCALE_N_M - 0.5 * stiffness * off_m * off_m
    area_sd = np.sqrt(ratio * c[at + 3, at + 3]) * KNEE_SCALE_N_M
    knee_m, knee_sd_m = _knee(area, area_sd, stiffness)
    knee_sd_m += _KNEE_MODEL_RATIO * knee_m
    sd_m = np.sqrt(sd_m * sd_m + 0.25 * knee_sd_m * knee_sd_m)
    return line_m - 0.5 * knee_m, sd_m, stiffness, stiffness_sd, line_m, knee_m


@compiled
def publish(b: Record, side: int, with_knee: bool, largest_sd_m: float) -> None:
    """Write what is found of a side, where it is surer than `largest_sd_m`; else what was known before stands."""
    edge_m, sd_m, stiffness, stiffness_sd, line_m, knee_m = found(b, side, with_knee)
    if sd_m > largest_sd_m:
        return
    if side == 1:
        b.right_m, b.right_sd_m, b.right_line_m, b.right_knee_m = edge_m, sd_m, line_m, knee_m
        b.right_stiffness_n_per_m, b.right_stiffness_sd_n_per_m = stiffness, stiffness_sd
        b.right_damping_n_s_per_m = b.theta[RIGHT + 2] / VELOCITY_SCALE_M_PER_S
        b.right_loss_ratio = b.theta[RIGHT + 4] / b.theta[RIGHT]
    else:
        b.left_m, b.left_sd_m, b.left_line_m, b.left_knee_m = edge_m, sd_m, line_m, knee_m
        b.left_stiffness_n_per_m, b.left_stiffness_sd_n_per_m = stiffness, stiffness_sd
        b.left_damping_n_s_per_m = b.theta[LEFT + 2] / VELOCITY_SCALE_M_PER_S
        b.left_loss_ratio = b.theta[LEFT + 4] / b.theta[LEFT]
