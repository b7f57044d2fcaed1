"""Online identification of the backlash: a gated matched-filter recursive estimator.

From the micro's equation alone, with x_b = d1 - d (Kang et al. 2023, (2) and (5), corrected):

    Y = m2 d'' - F_2 - effects - K2 x_b - b2 x_b' = F_b
    F_b = K_r x_b - K_r b_r + c x_b'   right,   K_l x_b + K_l b_l + c x_b'   left,   0 in the gap

Every term, *regressors included*, passes the same w0^3 / (s + w0)^3, so the filter adds no bias (the printed
recursion filters one side only, and loses 5-12 %). A sample counts for a side when the joint has been pressed
there for as long as the filter remembers: by force first, by geometry once that edge is known. One three-parameter
recursive least-squares estimate a side. The force of the motor is the decoded integer that was sent, averaged over
the sample interval through the current loop, never the float that was asked. Pure; knows no bus and no clock.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl.compiled import compiled
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

_CHAINS = ("end", "joint", "force")
_SIDES = ("left", "right")

BACKLASH = np.dtype(
    [
        ("period_s", "f8"),
        ("corner_rad_per_s", "f8"),
        ("hold_cycles", "f8"),
        ("forgetting_ratio", "f8"),
        ("least_force_n", "f8"),
        ("doubted_mass_kg", "f8"),  # a wrong mass or force constant shows as so much inertia, never as contact
        ("settle_cycles", "f8"),
        ("force_share_ratio", "f8"),
        ("margin_m", "f8"),
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
        ("one_1", "f8"),
        ("one_2", "f8"),
        ("one_3", "f8"),
        ("current_macro_a", "f8"),
        ("started", "f8"),
        ("cycle", "f8"),
        ("origin_m", "f8"),
        ("greatest_force_n", "f8"),
        ("contact_force_n", "f8"),  # Y, the filtered contact force
        ("side", "f8"),
        ("held", "f8"),
        ("unsettled", "f8"),  # cycles until the filters have forgotten how they were started
        ("motor_force_n", "f8"),  # at the last sample, through the current loop
        ("left_stiffness_n_per_m", "f8"),
        ("left_m", "f8"),
        ("left_damping_n_s_per_m", "f8"),
        ("left_stiffness_sd_n_per_m", "f8"),
        ("left_sd_m", "f8"),
        ("left_samples", "f8"),
        ("right_stiffness_n_per_m", "f8"),
        ("right_m", "f8"),
        ("right_damping_n_s_per_m", "f8"),
        ("right_stiffness_sd_n_per_m", "f8"),
        ("right_sd_m", "f8"),
        ("right_samples", "f8"),
        ("left_residual_n2", "f8"),
        ("right_residual_n2", "f8"),
        ("theta", "f8", (2, 3)),
        ("covariance", "f8", (2, 3, 3)),
    ]
)

_POSITION_SCALE_M = 1e-4
_VELOCITY_SCALE_M_PER_S = 1e-3
_PRIOR_N2 = 1e4
_DOUBT_SDS = 5.0  # of the mass, below which a force may be inertia
_SURE_SDS = 5.0  # that a stiffness is above zero by before an edge is published
_CORRELATION_SAMPLES = 20.0  # samples that share one independent residual, from the filter's memory of 3 tau


def init(profile: "Profile", filter_s: float = 0.01, forgetting_ratio: float = 1.0) -> np.ndarray:
    """Make BACKLASH: nothing known of edges and stiffness, whatever the profile believes."""
    b = np.zeros(1, BACKLASH)
    h = 1.0 / profile.cycle.rate_hz
    w = 1.0 / filter_s
    b["period_s"] = h
    b["corner_rad_per_s"] = w
    b["hold_cycles"] = np.ceil(8.0 * filter_s / h)
    b["forgetting_ratio"] = forgetting_ratio
    b["settle_cycles"] = np.ceil(16.0 * filter_s / h)
    b["least_force_n"] = 0.3
    b["doubted_mass_kg"] = _DOUBT_SDS * profile.micro.mass_sd_kg if profile.micro is not None else 0.0
    b["force_share_ratio"] = 0.4
    b["margin_m"] = 10e-6
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
    b["covariance"][0, :] = np.eye(3) * _PRIOR_N2
    for side in _SIDES:
        b[f"{side}_sd_m"] = np.inf
        b[f"{side}_stiffness_sd_n_per_m"] = np.inf
        b[f"{side}_m"] = np.nan
        b[f"{side}_stiffness_n_per_m"] = np.nan
    return b


@compiled
def _filtered(b: Record, z1: float, z2: float, z3: float, old: float, new: float) -> tuple[float, float, float]:
    """Advance one chain by a period with its input going from `old` to `new` in a line."""
    n1 = b.decay_0 * z1 + b.old_1 * old + b.new_1 * new
    n2 = b.decay_1 * z1 + b.decay_0 * z2 + b.old_2 * old + b.new_2 * new
    n3 = b.decay_2 * z1 + b.decay_1 * z2 + b.decay_0 * z3 + b.old_3 * old + b.new_3 * new
    return n1, n2, n3


@compiled
def _update(b: Record, side: int, regressor_0: float, regressor_1: float, regressor_2: float, y: float) -> float:
    """One recursive least-squares step of a side (0 left, 1 right); (20) with h(k) (E9)."""
    theta = b.theta
    p = b.covariance
    h = (regressor_0, regressor_1, regressor_2)
    ph0 = p[side, 0, 0] * h[0] + p[side, 0, 1] * h[1] + p[side, 0, 2] * h[2]
    ph1 = p[side, 1, 0] * h[0] + p[side, 1, 1] * h[1] + p[side, 1, 2] * h[2]
    ph2 = p[side, 2, 0] * h[0] + p[side, 2, 1] * h[1] + p[side, 2, 2] * h[2]
    ph = (ph0, ph1, ph2)
    scale = b.forgetting_ratio + h[0] * ph0 + h[1] * ph1 + h[2] * ph2
    innovation = y - (theta[side, 0] * h[0] + theta[side, 1] * h[1] + theta[side, 2] * h[2])
    for i in range(3):
        theta[side, i] += ph[i] / scale * innovation
    for i in range(3):
        for j in range(i, 3):
            value = (p[side, i, j] - ph[i] * ph[j] / scale) / b.forgetting_ratio
            p[side, i, j] = value
            p[side, j, i] = value
    return innovation * innovation * b.forgetting_ratio / scale


@compiled
def _publish_edge(b: Record, side: int, residual_n2: float) -> tuple[float, float, float, float]:
    """Return (edge, its sd, stiffness, its sd) of a side in x_b; nan and inf where the force does not grow with x_b.

    A force that is no contact (a cable, a wrong offset) may be held long enough to pass the gate.
    """
    theta = b.theta
    p = b.covariance
    slope = theta[side, 0]
    intercept = theta[side, 1]
    variance = residual_n2 * _CORRELATION_SAMPLES
    stiffness = slope / _POSITION_SCALE_M
    stiffness_sd = np.sqrt(variance * p[side, 0, 0]) / _POSITION_SCALE_M
    if not stiffness > _SURE_SDS * stiffness_sd:
        return np.nan, np.inf, np.nan, np.inf
    edge = -intercept / slope
    edge_variance = (
        variance * (p[side, 1, 1] + 2.0 * edge * p[side, 0, 1] + edge * edge * p[side, 0, 0]) / (slope * slope)
    )
    return edge * _POSITION_SCALE_M + b.origin_m, np.sqrt(edge_variance) * _POSITION_SCALE_M, stiffness, stiffness_sd


@compiled
def step(b: Record, cycle: int, macro_position_m: float, end_position_m: float, mean_force_n: float, q: Record) -> None:
    """Take a sample and the mean force (motor and effects) on the micro since the last; a missed cycle restarts."""
    x_b = macro_position_m - end_position_m
    if b.started == 0.0 or cycle != b.cycle + 1:
        if b.started == 0.0:
            b.origin_m = x_b
        b.end_in = end_position_m
        b.end_1 = b.end_2 = b.end_3 = end_position_m
        b.joint_in = x_b - b.origin_m
        b.joint_1 = b.joint_2 = b.joint_3 = x_b - b.origin_m
        b.force_1 = b.force_2 = b.force_3 = mean_force_n
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
    b.joint_1, b.joint_2, b.joint_3 = _filtered(b, b.joint_1, b.joint_2, b.joint_3, b.joint_in, joint)
    b.joint_in = joint
    b.force_1, b.force_2, b.force_3 = _filtered(b, b.force_1, b.force_2, b.force_3, mean_force_n, mean_force_n)
    w = b.corner_rad_per_s
    acceleration = w * w * (b.end_1 - 2.0 * b.end_2 + b.end_3)
    joint_rate = w * (b.joint_2 - b.joint_3)
    joint_filtered = b.joint_3 + b.origin_m
    y = (
        q.micro_mass_kg * acceleration
        - b.force_3
        - q.spring_n_per_m * joint_filtered
        - q.damping_n_s_per_m * joint_rate
    )
    b.contact_force_n = y
    if b.unsettled > 0.0:  # filters that start in motion show a step of speed: 13 N at 3 mm/s, 0.01 N after 16 tau
        b.unsettled -= 1.0
        return
    least_n = b.least_force_n + b.doubted_mass_kg * abs(acceleration)
    if abs(y) > least_n:
        b.greatest_force_n = max(b.greatest_force_n, abs(y))
    side = 0.0
    # A damped joint lets go while it still overlaps: k p + c p' < 0, and a contact never pulls.
    if b.right_sd_m < b.margin_m and x_b > b.right_m + b.margin_m and y > least_n:
        side = 1.0
    elif b.left_sd_m < b.margin_m and x_b < -b.left_m - b.margin_m and y < -least_n:
        side = -1.0
    elif abs(y) > max(b.force_share_ratio * b.greatest_force_n, least_n):
        side = 1.0 if y > 0.0 else -1.0
        if (side > 0.0 and b.right_sd_m < b.margin_m) or (side < 0.0 and b.left_sd_m < b.margin_m):
            side = 0.0  # an edge that is known is gated by geometry alone
    b.held = b.held + 1.0 if side == b.side and side != 0.0 else 0.0
    b.side = side
    if b.held < b.hold_cycles:
        return
    h0 = b.joint_3 / _POSITION_SCALE_M
    h2 = joint_rate / _VELOCITY_SCALE_M_PER_S
    share = 1.0 / 2000.0
    if side > 0.0:
        square = _update(b, 1, h0, 1.0, h2, y)
        b.right_samples += 1.0
        if b.right_samples > 50.0:
            b.right_residual_n2 += max(share, 1.0 / (b.right_samples - 50.0)) * (square - b.right_residual_n2)
            edge, edge_sd, stiffness, stiffness_sd = _publish_edge(b, 1, b.right_residual_n2)
            b.right_m, b.right_sd_m = edge, edge_sd
            b.right_stiffness_n_per_m, b.right_stiffness_sd_n_per_m = stiffness, stiffness_sd
            b.right_damping_n_s_per_m = b.theta[1, 2] / _VELOCITY_SCALE_M_PER_S
    else:
        square = _update(b, 0, h0, 1.0, h2, y)
        b.left_samples += 1.0
        if b.left_samples > 50.0:
            b.left_residual_n2 += max(share, 1.0 / (b.left_samples - 50.0)) * (square - b.left_residual_n2)
            edge, edge_sd, stiffness, stiffness_sd = _publish_edge(b, 0, b.left_residual_n2)
            b.left_m, b.left_sd_m = -edge, edge_sd
            b.left_stiffness_n_per_m, b.left_stiffness_sd_n_per_m = stiffness, stiffness_sd
            b.left_damping_n_s_per_m = b.theta[0, 2] / _VELOCITY_SCALE_M_PER_S


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
