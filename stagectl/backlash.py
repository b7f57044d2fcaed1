"""Online identification of the backlash: a gated matched-filter recursive estimator.

From the micro's equation alone, with x_b = d1 - d (Kang et al. 2023, (2) and (5), corrected):

    Y = m2 d'' - F_2 - effects - K2 x_b - b2 x_b' = F_b
    F_b = K_r x_b - K_r b_r + c x_b'   right,   K_l x_b + K_l b_l + c x_b'   left,   0 in the gap

Every term, *regressors included*, passes the same w0^3 / (s + w0)^3, so the filter adds no bias (the printed
recursion filters one side only, and loses 5-12 %). While an edge is unknown, a sample counts for its side when the
joint has been pressed there for as long as the filter remembers. Once both are known every sample counts: the
regressors themselves are switched at the edges, before the filter. In the gap the contact is nil, and what the belief
has wrong (mass, springs, a cable, an offset) shows there alone; it is found along with the joint, as far as it is
doubted. The force of the motor is the decoded integer that was sent, averaged over the sample interval through the
current loop, never the float that was asked. Pure; knows no bus and no clock.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stagectl import regression
from stagectl.compiled import compiled
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

_SIDES = ("left", "right")
_LEFT, _RIGHT = regression.COMMON_COUNT, regression.COMMON_COUNT + regression.SIDE_COUNT

BACKLASH = np.dtype(
    [
        ("period_s", "f8"),
        ("corner_rad_per_s", "f8"),
        ("hold_cycles", "f8"),
        ("edge_drift_m_per_sqrt_s", "f8"),  # random walk of each edge that is allowed for
        ("least_force_n", "f8"),
        ("settle_cycles", "f8"),
        ("force_share_ratio", "f8"),
        ("margin_m", "f8"),
        ("end_spring_n_per_m", "f8"),  # to the base, of the end: F_2 of (10); the stage has none
        ("end_damping_n_s_per_m", "f8"),
        # exact response of one chain of three equal lags to a first-order-hold input: powers of w0 h
        ("decay_0", "f8"),
        ("decay_1", "f8"),
        ("decay_2", "f8"),
        ("old_1", "f8"),
        ("old_2", "f8"),
        ("old_3", "f8"),
        ("new_1", "f8"),
        ("new_2", "f8"),
        ("new_3", "f8"),
        ("end_in", "f8"),
        ("end_1", "f8"),
        ("end_2", "f8"),
        ("end_3", "f8"),
        ("joint_in", "f8"),
        ("joint_1", "f8"),
        ("joint_2", "f8"),
        ("joint_3", "f8"),
        ("force_1", "f8"),
        ("force_2", "f8"),
        ("force_3", "f8"),
        ("switched", "f8", (2, regression.SIDE_COUNT, 3)),  # regressors that are nil off their side's contact
        ("gap_margin_m", "f8"),  # from a believed edge, within which the joint is taken to be free; inf = belief unused
        ("looks_for_hysteresis", "f8"),
        ("looks_for_knee", "f8"),
        ("left_seen", "f8"),  # samples in contact since the regressors are switched where they are
        ("right_seen", "f8"),
        ("starting", "f8"),  # cycles until the filters have forgotten where they were switched before
        ("turned", "f8"),  # cycles until a turn in contact is forgotten
        ("warm", "f8"),  # cycles that both edges have been known for
        ("started", "f8"),
        ("cycle", "f8"),
        ("origin_m", "f8"),
        ("end_origin_m", "f8"),
        ("greatest_force_n", "f8"),
        ("contact_force_n", "f8"),  # Y, the filtered contact force
        ("side", "f8"),
        ("held", "f8"),
        ("held_from_m", "f8"),  # x_b where the force of this hold was first seen
        ("unsettled", "f8"),  # cycles until the filters have forgotten how they were started
        ("motor_force_n", "f8"),  # at the last sample, through the current loop
        ("left_stiffness_n_per_m", "f8"),
        ("left_m", "f8"),
        ("left_damping_n_s_per_m", "f8"),
        ("left_stiffness_sd_n_per_m", "f8"),
        ("left_sd_m", "f8"),
        ("left_samples", "f8"),
        ("left_origin_m", "f8"),  # joint where the side was first pressed: the intercept is the force there
        ("left_switch_m", "f8"),  # where its regressors are switched
        ("left_line_m", "f8"),  # where the straight part of the contact meets zero
        ("left_knee_m", "f8"),
        ("right_stiffness_n_per_m", "f8"),
        ("right_m", "f8"),
        ("right_damping_n_s_per_m", "f8"),
        ("right_stiffness_sd_n_per_m", "f8"),
        ("right_sd_m", "f8"),
        ("right_samples", "f8"),
        ("right_origin_m", "f8"),
        ("right_switch_m", "f8"),  # where its regressors are switched
        ("right_line_m", "f8"),
        ("right_knee_m", "f8"),
        ("mass_kg", "f8"),  # found beyond the believed one, for a force constant that is taken to be right
        ("mass_sd_kg", "f8"),
        ("residual_ratio", "f8"),  # mean square innovation over what noise explains
        ("residual_samples", "f8"),
        *regression.dtype_fields(),
    ]
)

_POSITION_SCALE_M = 1e-4
_VELOCITY_SCALE_M_PER_S = 1e-3
_KNEE_SCALE_N_M = 1e-6
_MODEL_M = 1e-9  # what a straight line between samples gives away at an edge
_KNEE_POINTS_COUNT = 32
_KNEE_WIDTH_M = 10e-6  # of the pulse that stands for a knee
_MOVED_M = 0.3e-6
_SEEN_SAMPLES = 300.0
_TURN_M_PER_S = 3e-4  # over which a hysteresis turns round
_SIDE_VARIANCES = (np.inf, np.inf, np.inf)  # stiffness, intercept, damping: nothing known
_FREE = 2.0  # a side that is none
_SURE_SDS = 5.0  # that a force is beyond what the doubts explain by, and a stiffness above zero


@dataclass(frozen=True, slots=True)
class Doubts:
    """Standard deviations of what is believed; 0 = exact, not looked for."""

    mass_kg: float = 0.0
    spring_n_per_m: float = 0.0
    damping_n_s_per_m: float = 0.0
    end_spring_n_per_m: float = 0.0
    end_damping_n_s_per_m: float = 0.0
    force_n: float = 0.0
    knee_n_m: float = 0.0
    """Of K delta^2 / 24, by which a contact with a knee of length delta is softer than a line that starts in its middle."""
    hysteresis_n_per_m: float = 0.0
    """Of stiffness that a side has more when pressed than when let go, halved."""

    @property
    def variances(self) -> np.ndarray:
        """Those of theta, shape (regression.COUNT,)."""
        common = (
            *(self.mass_kg, self.spring_n_per_m, self.damping_n_s_per_m),
            *(self.end_spring_n_per_m, self.end_damping_n_s_per_m, self.force_n),
        )
        side = (
            *_SIDE_VARIANCES,
            (self.knee_n_m / _KNEE_SCALE_N_M) ** 2,
            (self.hysteresis_n_per_m * _POSITION_SCALE_M) ** 2,
        )
        return np.array([*(one * one for one in common), *side, *side])


def init(
    profile: "Profile",
    filter_s: float = 0.01,
    doubts: Doubts | None = None,
    force_noise_n: float = 5e-3,
    edge_drift_m_per_sqrt_s: float = 0.0,
) -> np.ndarray:
    """Make BACKLASH: nothing known of edges and stiffness, whatever the profile believes."""
    b = np.zeros(1, BACKLASH)
    h = 1.0 / profile.cycle.rate_hz
    w = 1.0 / filter_s
    b["period_s"] = h
    b["corner_rad_per_s"] = w
    b["hold_cycles"] = np.ceil(7.0 * filter_s / h)
    b["settle_cycles"] = np.ceil(16.0 * filter_s / h)
    b["least_force_n"] = 0.3
    b["force_share_ratio"] = 0.1
    b["margin_m"] = 10e-6
    b["edge_drift_m_per_sqrt_s"] = edge_drift_m_per_sqrt_s
    b["position_noise_m"] = profile.interferometer.noise_m
    b["force_noise_n"] = force_noise_n
    # Chain of three: X = expm(A h), input integrals by a Taylor series of the augmented matrix (first-order hold)
    augmented = np.zeros((5, 5))
    augmented[0, 0] = augmented[1, 1] = augmented[2, 2] = -w
    augmented[0, 3] = augmented[1, 0] = augmented[2, 1] = w
    augmented[3, 4] = 1.0 / h
    power = np.eye(5)
    total = np.eye(5)
    for k in range(1, 40):
        power = power @ (augmented * h) / k
        total = total + power
    b["decay_0"], b["decay_1"], b["decay_2"] = total[0, 0], total[1, 0], total[2, 0]
    for k in range(3):
        b[f"new_{k + 1}"] = total[k, 4]
        b[f"old_{k + 1}"] = total[k, 3] - total[k, 4]
    if doubts is None:
        doubts = Doubts(mass_kg=profile.micro.mass_sd_kg) if profile.micro is not None else Doubts()
    regression.prepare(b, doubts.variances)
    b["gap_margin_m"] = np.inf
    if doubts.force_n > 0.0 and profile.backlash is not None:  # an offset and an edge differ in the gap alone
        b["gap_margin_m"] = 3.0 * profile.backlash.width_sd_m
    b["looks_for_knee"] = float(doubts.knee_n_m > 0.0)
    b["looks_for_hysteresis"] = float(doubts.hysteresis_n_per_m > 0.0)
    for side in _SIDES:
        b[f"{side}_sd_m"] = np.inf
        b[f"{side}_stiffness_sd_n_per_m"] = np.inf
        b[f"{side}_m"] = np.nan
        b[f"{side}_line_m"] = np.nan
        b[f"{side}_stiffness_n_per_m"] = np.nan
    b["mass_sd_kg"] = doubts.mass_kg
    return b


@compiled
def _filtered(b: Record, z1: float, z2: float, z3: float, old: float, new: float) -> tuple[float, float, float]:
    """Advance one chain by a period with its input going from `old` to `new` in a line."""
    n1 = b.decay_0 * z1 + b.old_1 * old + b.new_1 * new
    n2 = b.decay_1 * z1 + b.decay_0 * z2 + b.old_2 * old + b.new_2 * new
    n3 = b.decay_2 * z1 + b.decay_1 * z2 + b.decay_0 * z3 + b.old_3 * old + b.new_3 * new
    return n1, n2, n3


@compiled
def _filter_switched(b: Record, side: int, from_m: float, to_m: float, smooth_rate: float) -> None:
    """Advance a side's switched regressors while the joint goes from one x_b to another in a line.

    In contact from the edge on; a damped joint lets go while it still overlaps: K p + c p' < 0, a contact never pulls.
    """
    sign = 1.0 if side == 1 else -1.0
    line_m = b.right_switch_m if side == 1 else b.left_switch_m
    origin_m = b.origin_m + (b.right_origin_m if side == 1 else b.left_origin_m)
    stiffness = b.right_stiffness_n_per_m if side == 1 else b.left_stiffness_n_per_m
    damping = b.right_damping_n_s_per_m if side == 1 else b.left_damping_n_s_per_m
    from_p = sign * (from_m + b.origin_m) - line_m
    to_p = sign * (to_m + b.origin_m) - line_m
    turn = 1.0 if smooth_rate > 0.0 else -1.0
    low, high = min(from_p, to_p), max(from_p, to_p)
    rate = (to_m - from_m) / b.period_s
    least_p = max(0.0, -damping * sign * smooth_rate / stiffness)
    share, mean_p, pulse = 0.0, 0.0, 0.0
    if low >= least_p:
        share, mean_p = 1.0, 0.5 * (low + high)
    elif high > least_p:
        share = (high - least_p) / (high - low)
        mean_p = share * 0.5 * (high + least_p)
    half_m = 0.5 * _KNEE_WIDTH_M
    if high > -half_m and low < half_m:
        length_m = max(high - low, 1e-12)
        middle = 0.5 * (low + high)
        inside = min(high, half_m) - max(low, -half_m)
        pulse = inside / length_m / _KNEE_WIDTH_M if inside < length_m else 1.0 / _KNEE_WIDTH_M
        if high - low < 1e-12:
            pulse = 1.0 / _KNEE_WIDTH_M if abs(middle) < half_m else 0.0
    z = b.switched
    for k in range(regression.SIDE_COUNT):
        if k == 0:
            new = (sign * (mean_p + line_m * share) - origin_m * share) / _POSITION_SCALE_M
        elif k == 1:
            new = share
        elif k == 2:
            new = share * rate / _VELOCITY_SCALE_M_PER_S
        elif k == 3:
            new = sign * pulse * _KNEE_SCALE_N_M
        else:
            new = mean_p * turn / _POSITION_SCALE_M
        z[side, k, 0], z[side, k, 1], z[side, k, 2] = _filtered(b, z[side, k, 0], z[side, k, 1], z[side, k, 2], new, new)


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
def _publish(b: Record, side: int) -> tuple[float, float, float, float, float, float]:
    """Return (edge, its sd, stiffness, its sd, line, knee) of a side; nan and inf where it is not identifiable.

    A force that is no contact (a cable, a wrong offset) may be held long enough to pass the gate: it doesn't grow
    with x_b.
    """
    at = _RIGHT if side == 1 else _LEFT
    sign = 1.0 if side == 1 else -1.0
    origin_m = b.origin_m + (b.right_origin_m if side == 1 else b.left_origin_m)
    theta = b.theta
    c = b.covariance
    slope = theta[at]
    intercept = theta[at + 1]
    ratio = max(b.residual_ratio, 1.0)
    stiffness = slope / _POSITION_SCALE_M
    stiffness_sd = np.sqrt(ratio * c[at, at]) / _POSITION_SCALE_M
    if not stiffness > _SURE_SDS * stiffness_sd:
        return np.nan, np.inf, np.nan, np.inf, np.nan, 0.0
    line = -intercept / slope
    variance = (c[at + 1, at + 1] + 2.0 * line * c[at, at + 1] + line * line * c[at, at]) / (slope * slope)
    edge_m = sign * (line * _POSITION_SCALE_M + origin_m)
    sd_m = np.sqrt(ratio * variance * _POSITION_SCALE_M * _POSITION_SCALE_M + _MODEL_M * _MODEL_M)
    line_m = edge_m
    knee_m = 0.0
    if b.looks_for_knee != 0.0 and b.warm > b.settle_cycles:
        # The pulse's area belongs to where the regressors are switched: a line that begins elsewhere has one too.
        off_m = edge_m - (b.right_switch_m if side == 1 else b.left_switch_m)
        area = theta[at + 3] * _KNEE_SCALE_N_M - 0.5 * stiffness * off_m * off_m
        area_sd = np.sqrt(ratio * c[at + 3, at + 3]) * _KNEE_SCALE_N_M
        knee_m, knee_sd_m = _knee(area, area_sd, stiffness)
        edge_m -= 0.5 * knee_m
        sd_m = np.sqrt(sd_m * sd_m + 0.25 * knee_sd_m * knee_sd_m)
    return edge_m, sd_m, stiffness, stiffness_sd, line_m, knee_m


@compiled
def _publish_known(b: Record) -> None:
    """Publish both sides once they are sure; until then what was known before stands."""
    edge, edge_sd, stiffness, stiffness_sd, line, knee = _publish(b, 0)
    if edge_sd < b.margin_m:
        b.left_m, b.left_sd_m, b.left_line_m, b.left_knee_m = edge, edge_sd, line, knee
        b.left_stiffness_n_per_m, b.left_stiffness_sd_n_per_m = stiffness, stiffness_sd
        b.left_damping_n_s_per_m = b.theta[_LEFT + 2] / _VELOCITY_SCALE_M_PER_S
    edge, edge_sd, stiffness, stiffness_sd, line, knee = _publish(b, 1)
    if edge_sd < b.margin_m:
        b.right_m, b.right_sd_m, b.right_line_m, b.right_knee_m = edge, edge_sd, line, knee
        b.right_stiffness_n_per_m, b.right_stiffness_sd_n_per_m = stiffness, stiffness_sd
        b.right_damping_n_s_per_m = b.theta[_RIGHT + 2] / _VELOCITY_SCALE_M_PER_S


@compiled
def _take(b: Record, y: float, side: int, q: Record, right_share: float, left_share: float) -> None:
    """Let a sample teach; shares say how far the sensors' noise passes the contact. `side` -1 = both."""
    theta = b.theta
    w = b.corner_rad_per_s
    mass = w * w * (q.micro_mass_kg + theta[0])
    spring = q.spring_n_per_m + theta[1]
    damping = q.damping_n_s_per_m + theta[2]
    # What is wild at first would make its own noise look wild.
    if right_share > 0.0 and b.right_sd_m < np.inf:
        spring += right_share * theta[_RIGHT] / _POSITION_SCALE_M
        damping += right_share * theta[_RIGHT + 2] / _VELOCITY_SCALE_M_PER_S
    if left_share > 0.0 and b.left_sd_m < np.inf:
        spring += left_share * theta[_LEFT] / _POSITION_SCALE_M
        damping += left_share * theta[_LEFT + 2] / _VELOCITY_SCALE_M_PER_S
    end_spring = b.end_spring_n_per_m + theta[3]
    end_damping = w * (b.end_damping_n_s_per_m + theta[4])
    c = b.noise_gain
    c[1] = mass
    c[2] = -2.0 * mass + end_damping + w * damping
    c[3] = mass + end_spring - end_damping + spring - w * damping
    c[6] = -w * damping
    c[7] = -spring + w * damping
    c[10] = -1.0
    variance = regression.residual_variance(b)
    square = regression.update(b, y, variance)
    b.residual_samples += 1.0
    share = max(1.0 / b.residual_samples, 5e-4)
    b.residual_ratio += share * (square / variance - b.residual_ratio)
    b.mass_kg = theta[0]
    b.mass_sd_kg = np.sqrt(max(b.residual_ratio, 1.0) * b.covariance[0, 0])
    if side == -1:
        _publish_known(b)
    elif side == 0:
        edge, edge_sd, stiffness, stiffness_sd, line, knee = _publish(b, 0)
        b.left_m, b.left_sd_m, b.left_line_m, b.left_knee_m = edge, edge_sd, line, knee
        b.left_stiffness_n_per_m, b.left_stiffness_sd_n_per_m = stiffness, stiffness_sd
        b.left_damping_n_s_per_m = theta[_LEFT + 2] / _VELOCITY_SCALE_M_PER_S
    elif side == 1:
        edge, edge_sd, stiffness, stiffness_sd, line, knee = _publish(b, 1)
        b.right_m, b.right_sd_m, b.right_line_m, b.right_knee_m = edge, edge_sd, line, knee
        b.right_stiffness_n_per_m, b.right_stiffness_sd_n_per_m = stiffness, stiffness_sd
        b.right_damping_n_s_per_m = theta[_RIGHT + 2] / _VELOCITY_SCALE_M_PER_S


@compiled
def step(b: Record, cycle: int, macro_position_m: float, end_position_m: float, mean_force_n: float, q: Record) -> None:
    """Take a sample and the mean force (motor and effects) on the micro since the last; a missed cycle restarts."""
    x_b = macro_position_m - end_position_m
    if b.started == 0.0 or cycle != b.cycle + 1:
        if b.started == 0.0:
            b.origin_m = x_b
            b.end_origin_m = end_position_m
        b.end_in = end_position_m
        b.end_1 = b.end_2 = b.end_3 = end_position_m
        b.joint_in = x_b - b.origin_m
        b.joint_1 = b.joint_2 = b.joint_3 = x_b - b.origin_m
        b.force_1 = b.force_2 = b.force_3 = mean_force_n
        b.switched[:, :, :] = 0.0
        b.warm = 0.0
        b.started = 1.0
        b.cycle = cycle
        b.held = 0.0
        b.side = 0.0
        b.unsettled = b.settle_cycles
        return
    b.cycle = cycle
    b.end_1, b.end_2, b.end_3 = _filtered(b, b.end_1, b.end_2, b.end_3, b.end_in, end_position_m)
    b.end_in = end_position_m
    joint = x_b - b.origin_m
    joint_before = b.joint_in
    b.joint_1, b.joint_2, b.joint_3 = _filtered(b, b.joint_1, b.joint_2, b.joint_3, joint_before, joint)
    b.joint_in = joint
    b.force_1, b.force_2, b.force_3 = _filtered(b, b.force_1, b.force_2, b.force_3, mean_force_n, mean_force_n)
    w = b.corner_rad_per_s
    acceleration = w * w * (b.end_1 - 2.0 * b.end_2 + b.end_3)
    joint_rate = w * (b.joint_2 - b.joint_3)
    end_rate = w * (b.end_2 - b.end_3)
    y = (
        q.micro_mass_kg * acceleration
        - b.force_3
        - q.spring_n_per_m * (b.joint_3 + b.origin_m)
        - q.damping_n_s_per_m * joint_rate
        + b.end_spring_n_per_m * b.end_3
        + b.end_damping_n_s_per_m * end_rate
    )
    h = b.regressors
    h[0] = -acceleration
    h[1] = b.joint_3
    h[2] = joint_rate
    h[3] = -(b.end_3 - b.end_origin_m)
    h[4] = -end_rate
    h[5] = 1.0
    doubt_n2 = 0.0
    contact_n = y
    for i in range(regression.COMMON_COUNT):
        contact_n -= h[i] * b.theta[i]
        for j in range(regression.COMMON_COUNT):
            doubt_n2 += h[i] * b.covariance[i, j] * h[j]
    b.contact_force_n = contact_n
    if b.edge_drift_m_per_sqrt_s > 0.0:
        walk = b.edge_drift_m_per_sqrt_s * np.sqrt(b.period_s)
        if b.right_sd_m < np.inf:
            regression.drift(b, _RIGHT + 1, walk * b.right_stiffness_n_per_m)
        if b.left_sd_m < np.inf:
            regression.drift(b, _LEFT + 1, walk * b.left_stiffness_n_per_m)
    right_known = b.right_sd_m < b.margin_m
    left_known = b.left_sd_m < b.margin_m
    if right_known and left_known:
        # A knee is found from samples that were all switched at one place, hardly off the line's.
        moved_m = max(abs(b.left_line_m - b.left_switch_m), abs(b.right_line_m - b.right_switch_m))
        seen = min(b.left_seen, b.right_seen)
        if b.warm == 0.0 or b.looks_for_knee == 0.0:
            b.left_switch_m = b.left_line_m
            b.right_switch_m = b.right_line_m
        elif moved_m > _MOVED_M and seen > _SEEN_SAMPLES:
            b.left_switch_m = b.left_line_m
            b.right_switch_m = b.right_line_m
            b.left_seen = b.right_seen = 0.0
            b.starting = b.settle_cycles
        smooth_rate = w * (2.0 * (joint - b.joint_1) - (b.joint_1 - b.joint_2))  # extrapolated: no lag
        for side_of in range(2):
            _filter_switched(b, side_of, joint_before, joint, smooth_rate)
        # How a hysteresis turns round isn't known: samples whose filters remember a turn in contact don't count.
        if b.looks_for_hysteresis != 0.0 and abs(smooth_rate) < _TURN_M_PER_S:
            x_b_inside = x_b < b.right_line_m and x_b > -b.left_line_m
            b.turned = b.turned if x_b_inside else b.hold_cycles
        b.turned = max(b.turned - 1.0, 0.0)
        b.warm += 1.0
    elif b.warm > 0.0:
        b.switched[:, :, :] = 0.0
        b.warm = 0.0
    if b.unsettled > 0.0:  # filters that start in motion show a step of speed: 13 N at 3 mm/s, 0.01 N after 16 tau
        b.unsettled -= 1.0
        return
    if b.warm > b.settle_cycles:
        if b.warm == b.settle_cycles + 1.0:
            regression.forget_noise(b)
            b.starting = 1.0
        regression.carry_noise(b)
        if b.starting > 0.0:
            b.starting -= 1.0
            if b.starting == 0.0:
                regression.start_sides_again(b)
                b.residual_samples = b.residual_ratio = 0.0
                b.left_seen = b.right_seen = 0.0
            return
        if b.turned > 0.0:
            return
        z = b.switched
        for k in range(regression.SIDE_COUNT):
            h[_LEFT + k] = z[0, k, 2]
            h[_RIGHT + k] = z[1, k, 2]
        if z[0, 1, 2] > 0.5:
            b.left_samples += 1.0
            b.left_seen += 1.0
        if z[1, 1, 2] > 0.5:
            b.right_samples += 1.0
            b.right_seen += 1.0
        _take(b, y, -1, q, z[1, 1, 2], z[0, 1, 2])
        return
    least_n = b.least_force_n + _SURE_SDS * np.sqrt(doubt_n2)
    if abs(contact_n) > least_n:
        b.greatest_force_n = max(b.greatest_force_n, abs(contact_n))
    side = 0.0
    # A damped joint lets go while it still overlaps: k p + c p' < 0, and a contact never pulls.
    if right_known and x_b > b.right_m + b.margin_m and contact_n > least_n:
        side = 1.0
    elif left_known and x_b < -b.left_m - b.margin_m and contact_n < -least_n:
        side = -1.0
    elif abs(contact_n) > max(b.force_share_ratio * b.greatest_force_n, least_n):
        side = 1.0 if contact_n > 0.0 else -1.0
        if side != b.side:
            b.held_from_m = x_b
        elif side * (x_b - b.held_from_m) < 0.0:
            side = 0.0  # on its way out: the filtered force lags behind
        if (side > 0.0 and right_known) or (side < 0.0 and left_known):
            side = 0.0  # an edge that is known is gated by geometry alone
    elif -q.left_m + b.gap_margin_m < x_b < q.right_m - b.gap_margin_m and abs(contact_n) < least_n:
        side = _FREE
    b.held = b.held + 1.0 if side == b.side and side != 0.0 else 0.0
    b.side = side
    if b.held < b.hold_cycles:
        return
    if b.held == b.hold_cycles:
        regression.forget_noise(b)
    regression.carry_noise(b)
    for k in range(2 * regression.SIDE_COUNT):
        h[_LEFT + k] = 0.0
    if side == _FREE:
        _take(b, y, 2, q, 0.0, 0.0)
        return
    at = _RIGHT if side > 0.0 else _LEFT
    if side > 0.0:
        if b.right_samples == 0.0:
            b.right_origin_m = joint
        h[at] = (b.joint_3 - b.right_origin_m) / _POSITION_SCALE_M
    else:
        if b.left_samples == 0.0:
            b.left_origin_m = joint
        h[at] = (b.joint_3 - b.left_origin_m) / _POSITION_SCALE_M
    h[at + 1] = 1.0
    h[at + 2] = joint_rate / _VELOCITY_SCALE_M_PER_S
    if side > 0.0:
        b.right_samples += 1.0
        _take(b, y, 1, q, 1.0, 0.0)
    else:
        b.left_samples += 1.0
        _take(b, y, 0, q, 0.0, 1.0)


@compiled
def motor_mean_force(
    b: Record, q: Record, word_before: float, word: float, amperes_per_word: float, delay_s: float
) -> float:
    """Return the micro motor's mean force over the interval that ends at the new sample, from the words sent.

    The word before holds for `delay_s`, then the new one; the current follows with the loop's time constant.
    """
    tau = q.micro_current_loop_s
    k = q.micro_force_constant_n_per_a * amperes_per_word
    first_n, second_n = k * word_before, k * word
    rest_s = b.period_s - delay_s
    decay = np.exp(-delay_s / tau)
    start_n = b.motor_force_n
    area = first_n * delay_s + (start_n - first_n) * tau * (1.0 - decay)
    start_n = first_n + (start_n - first_n) * decay
    decay = np.exp(-rest_s / tau)
    area += second_n * rest_s + (start_n - second_n) * tau * (1.0 - decay)
    b.motor_force_n = second_n + (start_n - second_n) * decay
    return area / b.period_s
