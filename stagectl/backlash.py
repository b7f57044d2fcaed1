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

import math
from typing import TYPE_CHECKING

import numpy as np

from stagectl import edges, regression
from stagectl.compiled import compiled
from stagectl.regression import COMMON_COUNT, LEFT, POSITION_SCALE_M, RIGHT, SIDE_COUNT, VELOCITY_SCALE_M_PER_S, Doubts
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

_SIDES = ("left", "right")

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
        ("switched", "f8", (2, SIDE_COUNT, 3)),  # regressors that are nil off their side's contact
        ("gap_margin_m", "f8"),  # from a believed edge, within which the joint is taken to be free; inf = belief unused
        ("looks_for_hysteresis", "f8"),
        ("looks_for_knee", "f8"),
        ("left_seen", "f8"),  # samples in contact since the regressors are switched where they are
        ("right_seen", "f8"),
        ("starting", "f8"),  # cycles until the filters have forgotten where they were switched before
        ("turned", "f8"),  # cycles until a turn in contact is forgotten
        ("left_long", "f8"),  # 1 where no hold counts but a longer one
        ("right_long", "f8"),
        ("began", "f8"),  # 1 once the sides were started with every sample
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
        ("held_peak_n", "f8"),
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
        ("left_loss_ratio", "f8"),  # of the stiffness, more when pressed and less when let go
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
        ("right_loss_ratio", "f8"),  # of the stiffness, more when pressed and less when let go
        ("mass_kg", "f8"),  # found beyond the believed one, for a force constant that is taken to be right
        ("mass_sd_kg", "f8"),
        ("residual_ratio", "f8"),  # mean square innovation over what noise explains
        ("residual_samples", "f8"),
        *regression.dtype_fields(),
    ]
)

FILTER_S = 0.015
"""Least time constant of the identification's filter at 1 kHz."""

FORCE_NOISE_N = 5e-3
"""Of the micro's motor, rms, held for a period, where the profile states none."""

HOLD_RATIO = 7.0
"""How long the joint is pressed before a sample of its side counts, in that time constant."""

_MATCHED_RATIO = 0.7  # of sqrt(m n / f): 20 ms at 100 nm; 30 ms gives stiffnesses away, 15 ms what the mass has
_FREE = 2.0  # a side that is none
_BOTH = -1
_MOVED_M = 0.3e-6  # of a line off its switch, beyond which the area of a knee is no longer what the pulse has
_SEEN_SAMPLES = 300.0  # of each side, before a line is taken to be in its place
_TURN_M_PER_S = 3e-4  # below it a hysteresis may be turning round
_PLACED_N = 0.04  # by which edges may be off, as a force, for regressors to be switched there: 3 um at 13 N/mm
_BLOW_RATIO = 0.27  # peak of the filter's answer to a blow, in w0
_SURE_M = 0.1e-6  # of an edge, below which a fresh start replaces what the first touches said
_LESS_SURE_RATIO = 1.5
_MISFIT_RATIO = 3.0  # of mean square residual to what noise explains
_LEAVING_RATIO = 0.4  # of a hold's peak, below which the joint may have let go
_SURE_SDS = 5.0  # that a force is beyond what the doubts explain by
_RATIO_SHARE = 5e-4
_SMALL_FORCE_N = 0.01  # an offset doubted by no more can wait for the gap until both edges are known: 1 um at 10 N/mm


def believed_doubts(profile: "Profile") -> Doubts:
    """Return what a profile leaves open: the micro's mass, or the force constant by as much, scaling every force.

    And where the spring between the stages stands at its middle: zeros are laid by the edges, and 4 um beside it are
    2 mN of offset, which went into both edges (0.2 um). Of two edges that are off on their own, the middle is off by
    half of what the width is.
    """
    if profile.micro is None:
        return Doubts()
    micro = profile.micro
    ratio = micro.mass_sd_kg / micro.mass_kg
    force_n = 0.0
    if profile.backlash is not None:
        force_n = min(micro.spring_n_per_m * 0.5 * profile.backlash.width_sd_m, _SMALL_FORCE_N)
    return Doubts(micro.mass_sd_kg, ratio * micro.spring_n_per_m, ratio * micro.damping_n_s_per_m, force_n=force_n)


def filter_time_s(profile: "Profile") -> float:
    """Return the time constant of the identification's filter, s: the profile's own, else one for its sensors' noise.

    sqrt(m n / f) is where the force that position noise n feigns, m n / tau^2, is the motor's own noise f. In closed
    loop the sensors' noise moves the stage as well, and what moves it is no longer independent of the residual: at
    100 nm 10 ms found a mass 2 % low, 15 ms one 1.2 standard deviations high, 20 ms 0.4, all with the same intervals.
    """
    if profile.backlash is not None and profile.backlash.filter_s is not None:
        return profile.backlash.filter_s
    if profile.micro is None:
        return FILTER_S
    matched_s = math.sqrt(profile.micro.mass_kg * profile.interferometer.noise_m / _force_noise_n(profile))
    return max(FILTER_S, _MATCHED_RATIO * matched_s)


def _force_noise_n(profile: "Profile") -> float:
    return (profile.micro.force_noise_n if profile.micro is not None else 0.0) or FORCE_NOISE_N


def init(
    profile: "Profile",
    filter_s: float | None = None,
    doubts: Doubts | None = None,
    force_noise_n: float | None = None,
    edge_drift_m_per_sqrt_s: float | None = None,
) -> np.ndarray:
    """Make BACKLASH: nothing known of edges and stiffness, whatever the profile believes.

    Without a drift of the edges the profile's wear table says how they may wander; without `filter_s` it is
    `filter_time_s`.
    """
    b = np.zeros(1, BACKLASH)
    if filter_s is None:
        filter_s = filter_time_s(profile)
    h = 1.0 / profile.cycle.rate_hz
    w = 1.0 / filter_s
    b["period_s"] = h
    b["corner_rad_per_s"] = w
    b["hold_cycles"] = np.ceil(HOLD_RATIO * filter_s / h)
    b["settle_cycles"] = np.ceil(16.0 * filter_s / h)
    b["least_force_n"] = 0.3
    b["force_share_ratio"] = 0.1
    b["margin_m"] = 10e-6
    drift = profile.wear.edge_drift_m_per_sqrt_s if edge_drift_m_per_sqrt_s is None else edge_drift_m_per_sqrt_s
    b["edge_drift_m_per_sqrt_s"] = drift
    b["position_noise_m"] = profile.interferometer.noise_m
    b["force_noise_n"] = _force_noise_n(profile) if force_noise_n is None else force_noise_n
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
        doubts = believed_doubts(profile)
    regression.prepare(b, doubts.variances)
    b["gap_margin_m"] = np.inf
    # A large offset and an edge differ in the gap alone.
    if doubts.force_n > _SMALL_FORCE_N and profile.backlash is not None:
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
def _start(b: Record, cycle: int, x_b: float, end_position_m: float, mean_force_n: float) -> None:
    """Start the filters as if all had stood here for ever."""
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


@compiled
def _take(b: Record, y: float, side: int, q: Record, right_share: float, left_share: float) -> None:
    """Let a sample teach of a side, or of both; shares say how far the sensors' noise passes each contact."""
    theta = b.theta
    w = b.corner_rad_per_s
    mass = w * w * (q.micro_mass_kg + theta[0])
    spring = q.spring_n_per_m + theta[1]
    damping = q.damping_n_s_per_m + theta[2]
    # What is wild at first would make its own noise look wild.
    if right_share > 0.0 and b.right_sd_m < np.inf:
        spring += right_share * theta[RIGHT] / POSITION_SCALE_M
        damping += right_share * theta[RIGHT + 2] / VELOCITY_SCALE_M_PER_S
    if left_share > 0.0 and b.left_sd_m < np.inf:
        spring += left_share * theta[LEFT] / POSITION_SCALE_M
        damping += left_share * theta[LEFT + 2] / VELOCITY_SCALE_M_PER_S
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
    # Noise that regressors and residual share: the mass would come out 0.02 % low at 100 nm. Of a side it is nothing.
    v = b.noise_work
    n = b.common_noise
    joint = v[7] - v[3]
    joint_rate = w * (v[6] - v[2] - joint)
    n[0] = -w * w * (v[1] - 2.0 * v[2] + v[3])
    n[1] = joint
    n[2] = joint_rate
    n[3] = -v[3]
    n[4] = -w * (v[2] - v[3])
    square = regression.update(b, y, variance)
    b.residual_samples += 1.0
    b.residual_ratio += max(1.0 / b.residual_samples, _RATIO_SHARE) * (square / variance - b.residual_ratio)
    b.mass_kg = theta[0]
    b.mass_sd_kg = np.sqrt(max(b.residual_ratio, 1.0) * b.covariance[0, 0])
    if side == _BOTH:
        with_knee = b.looks_for_knee != 0.0  # what was published without one may be half a knee off, however sure
        least_m = b.margin_m if with_knee else _SURE_M
        edges.publish(b, 0, with_knee, min(max(least_m, _LESS_SURE_RATIO * b.left_sd_m), b.margin_m))
        edges.publish(b, 1, with_knee, min(max(least_m, _LESS_SURE_RATIO * b.right_sd_m), b.margin_m))
    elif side != _FREE:
        edges.publish(b, side, False, np.inf)


@compiled
def _off_n(b: Record, side: int) -> float:
    """Return the force, N, that an edge off by its standard deviation makes: of the spring, and the damper's blow."""
    blow_per_s = _BLOW_RATIO * b.corner_rad_per_s
    if side == 1:
        return b.right_sd_m * (b.right_stiffness_n_per_m + blow_per_s * b.right_damping_n_s_per_m)
    return b.left_sd_m * (b.left_stiffness_n_per_m + blow_per_s * b.left_damping_n_s_per_m)


@compiled
def _smooth_rate(b: Record) -> float:
    """Return x_b', m/s, extrapolated: no lag behind a steady acceleration."""
    return b.corner_rad_per_s * (2.0 * (b.joint_in - b.joint_1) - (b.joint_1 - b.joint_2))


@compiled
def _filter_sides(b: Record, joint_before: float, joint: float) -> None:
    """Advance the switched regressors; both edges are known."""
    # A knee is found from samples that were all switched at one place, hardly off the line's.
    moved_m = max(abs(b.left_line_m - b.left_switch_m), abs(b.right_line_m - b.right_switch_m))
    moved = moved_m > _MOVED_M and min(b.left_seen, b.right_seen) > _SEEN_SAMPLES
    if b.began == 0.0 or b.looks_for_knee == 0.0 or moved:
        b.left_switch_m = b.left_line_m
        b.right_switch_m = b.right_line_m
        if moved and b.looks_for_knee != 0.0:
            b.left_seen = b.right_seen = 0.0
            b.starting = b.settle_cycles
    smooth_rate = _smooth_rate(b)
    edges.filter_switched(b, 0, joint_before, joint, smooth_rate)
    edges.filter_switched(b, 1, joint_before, joint, smooth_rate)
    # How a hysteresis turns round isn't known: samples whose filters remember a turn in contact don't count.
    b.turned = max(b.turned - 1.0, 0.0)
    in_gap = -b.left_line_m < joint + b.origin_m < b.right_line_m
    if b.looks_for_hysteresis != 0.0 and abs(smooth_rate) < _TURN_M_PER_S and not in_gap:
        b.turned = b.hold_cycles
    b.warm += 1.0


@compiled
def _learn_everywhere(b: Record, y: float, q: Record) -> None:
    """Take a sample that may lie anywhere, through the switched regressors."""
    if b.warm == b.settle_cycles + 1.0:
        regression.forget_noise(b)
        if b.began == 0.0:  # what the gate let through at the first touches was not yet free of their onset
            b.began = b.starting = 1.0
    regression.carry_noise(b)
    if b.starting > 0.0:
        b.starting -= 1.0
        if b.starting == 0.0:
            regression.start_side_again(b, LEFT)
            regression.start_side_again(b, RIGHT)
            regression.forget_noise(b)
            b.residual_samples = b.residual_ratio = 0.0
            b.left_seen = b.right_seen = 0.0
        return
    if b.turned > 0.0:
        return
    h = b.regressors
    z = b.switched
    for k in range(SIDE_COUNT):
        h[LEFT + k] = z[0, k, 2]
        h[RIGHT + k] = z[1, k, 2]
    left_share, right_share = z[0, 1, 2], z[1, 1, 2]
    if left_share > 0.5:
        b.left_samples += 1.0
        b.left_seen += 1.0
    if right_share > 0.5:
        b.right_samples += 1.0
        b.right_seen += 1.0
    _take(b, y, _BOTH, q, right_share, left_share)


@compiled
def _pressed_side(b: Record, x_b: float, contact_n: float, doubt_n: float, q: Record) -> float:
    """Return the side that is surely pressed, 1 right, -1 left, _FREE surely none, 0 unclear."""
    least_n = b.least_force_n + doubt_n
    if abs(contact_n) > least_n:
        b.greatest_force_n = max(b.greatest_force_n, abs(contact_n))
    right_known = b.right_sd_m < b.margin_m
    left_known = b.left_sd_m < b.margin_m
    # A damped joint lets go while it still overlaps, and the filtered force lags: what pushes now is foretold.
    rate = _smooth_rate(b)
    if right_known and x_b > b.right_m + b.margin_m and contact_n > least_n:
        now_n = b.right_stiffness_n_per_m * (x_b - b.right_m) + b.right_damping_n_s_per_m * rate
        return 1.0 if now_n > least_n else 0.0
    if left_known and x_b < -b.left_m - b.margin_m and contact_n < -least_n:
        now_n = b.left_stiffness_n_per_m * (x_b + b.left_m) + b.left_damping_n_s_per_m * rate
        return -1.0 if now_n < -least_n else 0.0
    if abs(contact_n) > max(b.force_share_ratio * b.greatest_force_n, least_n):
        side = 1.0 if contact_n > 0.0 else -1.0
        if (side > 0.0 and right_known) or (side < 0.0 and left_known):
            return 0.0  # an edge that is known is gated by geometry alone
        if side != b.side:
            b.held_from_m = x_b
            b.held_peak_n = 0.0
        b.held_peak_n = max(b.held_peak_n, abs(contact_n))
        # On its way out the filtered force lags behind, and a damped joint lets go deep inside.
        if side * (x_b - b.held_from_m) < 0.0 or abs(contact_n) < _LEAVING_RATIO * b.held_peak_n:
            return 0.0
        return side
    if -q.left_m + b.gap_margin_m < x_b < q.right_m - b.gap_margin_m:
        return _FREE
    return 0.0


@compiled
def _learn_where_pressed(b: Record, y: float, side: float, joint_rate: float, q: Record) -> None:
    """Take a sample that the gate has held for as long as the filters remember."""
    if b.held == b.hold_cycles:
        regression.forget_noise(b)
    regression.carry_noise(b)
    h = b.regressors
    for k in range(2 * SIDE_COUNT):
        h[LEFT + k] = 0.0
    if side == _FREE:
        _take(b, y, 2, q, 0.0, 0.0)
        return
    at = RIGHT if side > 0.0 else LEFT
    long_held = b.right_long if side > 0.0 else b.left_long
    if long_held != 0.0 and b.held < b.settle_cycles:
        return
    if b.held == b.settle_cycles and long_held == 0.0 and b.residual_ratio > _MISFIT_RATIO:
        # The first samples still held some of the onset: 0.1 N of a damper's blow of 4 N, where it strikes that hard.
        regression.start_side_again(b, at)
        b.residual_samples = b.residual_ratio = 0.0
        if side > 0.0:
            b.right_long = 1.0
        else:
            b.left_long = 1.0
    h[at + 1] = 1.0
    h[at + 2] = joint_rate / VELOCITY_SCALE_M_PER_S
    if side > 0.0:
        if b.right_samples == 0.0:
            b.right_origin_m = b.joint_in
        b.right_samples += 1.0
        h[at] = (b.joint_3 - b.right_origin_m) / POSITION_SCALE_M
        _take(b, y, 1, q, 1.0, 0.0)
    else:
        if b.left_samples == 0.0:
            b.left_origin_m = b.joint_in
        b.left_samples += 1.0
        h[at] = (b.joint_3 - b.left_origin_m) / POSITION_SCALE_M
        _take(b, y, 0, q, 0.0, 1.0)


@compiled
def step(b: Record, cycle: int, macro_position_m: float, end_position_m: float, mean_force_n: float, q: Record) -> None:
    """Take a sample and the mean force (motor and effects) on the micro since the last; a missed cycle restarts."""
    x_b = macro_position_m - end_position_m
    if b.started == 0.0 or cycle != b.cycle + 1:
        _start(b, cycle, x_b, end_position_m, mean_force_n)
        return
    b.cycle = cycle
    b.end_1, b.end_2, b.end_3 = edges.filtered(b, b.end_1, b.end_2, b.end_3, b.end_in, end_position_m)
    b.end_in = end_position_m
    joint = x_b - b.origin_m
    joint_before = b.joint_in
    b.joint_1, b.joint_2, b.joint_3 = edges.filtered(b, b.joint_1, b.joint_2, b.joint_3, joint_before, joint)
    b.joint_in = joint
    b.force_1, b.force_2, b.force_3 = edges.filtered(b, b.force_1, b.force_2, b.force_3, mean_force_n, mean_force_n)
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
    for i in range(COMMON_COUNT):
        contact_n -= h[i] * b.theta[i]
        for j in range(COMMON_COUNT):
            doubt_n2 += h[i] * b.covariance[i, j] * h[j]
    b.contact_force_n = contact_n
    if b.edge_drift_m_per_sqrt_s > 0.0:
        walk = b.edge_drift_m_per_sqrt_s * np.sqrt(b.period_s)
        if b.right_sd_m < np.inf:
            regression.drift(b, RIGHT + 1, walk * b.right_stiffness_n_per_m)
        if b.left_sd_m < np.inf:
            regression.drift(b, LEFT + 1, walk * b.left_stiffness_n_per_m)
    if b.began != 0.0 or (_off_n(b, 0) < _PLACED_N and _off_n(b, 1) < _PLACED_N):  # nan: not found yet
        _filter_sides(b, joint_before, joint)
    elif b.warm > 0.0:
        b.switched[:, :, :] = 0.0
        b.warm = 0.0
    if b.unsettled > 0.0:  # filters that start in motion show a step of speed: 13 N at 3 mm/s, 0.01 N after 16 tau
        b.unsettled -= 1.0
        return
    if b.warm > b.settle_cycles:
        _learn_everywhere(b, y, q)
        return
    if b.began != 0.0:  # after a pause: every sample counts again in a moment
        return
    side = _pressed_side(b, x_b, contact_n, _SURE_SDS * np.sqrt(doubt_n2), q)
    b.held = b.held + 1.0 if side == b.side and side != 0.0 else 0.0
    b.side = side
    if b.held >= b.hold_cycles:
        _learn_where_pressed(b, y, side, joint_rate, q)


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
