"""Where the axes are and what pushes them: an observer that runs the believed machine beside the real one.

The believed machine is the same plant code as the simulator's, composed with the profile's effects. Between
two samples it feels the integers that were sent: the old command until the SYNC that latches the new one, then
the new one. A sample corrects position, velocity and an unknown force on each axis: with steady-state Kalman gains on a
macro that carries a micro (a random walk), by the adaptive filter on the axis that carries the end (one besides a mass
that is found on the way: `stagectl.fed_forward`); a notch keeps a flexible mode out of that one where the profile has
one. Prediction from the sample's instant to the instant the
next command acts, lag and dead time of the profile's command effects included, is the same code run ahead. Pure;
knows no bus and no clock.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl import adaptive_filter, compose, fed_forward, notch
from stagectl.compiled import compiled
from stagectl.plant import PLANT_PARAMETERS, PLANT_STATE
from stagectl.signals import Record

if TYPE_CHECKING:
    from stagectl.profile import Profile

ESTIMATOR = np.dtype(
    [
        ("period_s", "f8"),
        ("actuation_delay_s", "f8"),  # sample instant -> the SYNC that latches the command
        ("lead_s", "f8"),  # from there until the force of the axis that carries the end follows, lag and dead time
        ("macro_lead_s", "f8"),  # by which the macro's lag and dead time under a micro are longer than that
        ("longest_substep_s", "f8"),
        ("bridged_samples_max", "f8"),  # missing in a row that the identification's filters are carried over
        ("macro_amperes_per_word", "f8"),
        ("micro_amperes_per_word", "f8"),
        ("macro_position_gain_ratio", "f8"),  # where it carries a micro
        ("macro_velocity_gain_per_s", "f8"),
        ("macro_force_gain_n_per_m", "f8"),
        ("position_mode", "f8"),  # 1 where the macro's drive closes its own position loop (CSP with torque offset)
        ("started", "f8"),
        ("cycle", "f8"),  # of the last tick
        ("predicted_samples", "f8"),  # periods since the sample that the model was corrected with last
        ("macro_word", "f8"),  # latched by the last SYNC
        ("micro_word", "f8"),
        ("macro_carried_word", "f8"),  # part of a word that rounding has left over for the next
        ("micro_carried_word", "f8"),
        ("macro_word_before", "f8"),  # latched by the SYNC before
        ("micro_word_before", "f8"),
        ("jerk_before_m_per_s3", "f8"),  # of the reference, in the cycle before, and its change up to then
        ("jerk_change_before_m_per_s3", "f8"),
        ("macro_seen_m", "f8"),  # this cycle's positions: the sample, or its prediction where the line is late
        ("end_seen_m", "f8"),
        ("identification_waits", "f8"),  # 1 while the last sample, predicted so far, may come late
        ("waiting_force_n", "f8"),  # mean on the micro over the period before it
        ("macro_innovation_m", "f8"),
        ("end_innovation_m", "f8"),
        *adaptive_filter.FIELDS,  # of the axis that carries the end
        *fed_forward.FIELDS,
        *notch.FIELDS,
    ]
)

BRIDGED_SAMPLES = 10.0
"""Missing in a row: prediction over 10 ms is still within a few nm of the motion."""


FREE_SUPPLY_V = 1e12  # a belief's current loop never runs out of voltage


def belief(profile: "Profile") -> np.ndarray:
    """Make PLANT_PARAMETERS of what the profile believes (attributes named as in a profile)."""
    q = np.zeros(1, PLANT_PARAMETERS)
    macro, micro, backlash = profile.macro, profile.micro, profile.backlash
    q["macro_mass_kg"] = macro.mass_kg
    q["travel_low_m"], q["travel_high_m"] = -np.inf, np.inf
    q["stroke_low_m"], q["stroke_high_m"] = -np.inf, np.inf
    q["left_m"], q["right_m"] = np.inf, np.inf
    q["micro_mass_kg"] = 1.0
    for name, axis in (("macro", macro), ("micro", micro if micro is not None else macro)):
        q[f"{name}_force_constant_n_per_a"] = axis.rated_force_n / axis.rated_current_a
        q[f"{name}_current_loop_s"] = axis.current_loop_s
        q[f"{name}_current_limit_a"] = axis.force_limit_n / axis.rated_force_n * axis.rated_current_a
        q[f"{name}_resistance_ohm"] = 1.0
        q[f"{name}_inductance_h"] = 1.0
        q[f"{name}_supply_v"] = FREE_SUPPLY_V
    if micro is not None:
        q["has_micro"] = 1.0
        q["micro_mass_kg"] = micro.mass_kg
        q["spring_n_per_m"] = micro.spring_n_per_m
        q["damping_n_s_per_m"] = micro.damping_n_s_per_m
        for name in ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m"):
            q[name] = getattr(backlash, name)
    return q


def init(profile: "Profile") -> np.ndarray:
    """Make ESTIMATOR for a profile: gains from its noise and drift densities, nothing seen yet."""
    e = np.zeros(1, ESTIMATOR)
    period_s = 1.0 / profile.cycle.rate_hz
    e["period_s"] = period_s
    e["actuation_delay_s"] = profile.cycle.actuation_delay_s
    macro_lag_s = compose.command_lag_s(profile.effects, "macro_command")
    e["lead_s"] = macro_lag_s if profile.micro is None else compose.command_lag_s(profile.effects, "micro_command")
    e["macro_lead_s"] = macro_lag_s - e["lead_s"]
    e["longest_substep_s"] = 300e-6
    e["bridged_samples_max"] = BRIDGED_SAMPLES
    e["position_mode"] = float(profile.macro.mode == "position")
    noise_m = profile.interferometer.noise_m
    control = profile.control
    notch.init(e, profile)
    e["macro_amperes_per_word"] = 1e-3 * profile.macro.rated_current_a
    precise, rest_ratio = profile.axis(profile.axes[-1]), control.rest_drift_ratio
    if profile.micro is None:
        drift = control.macro_drift_n_per_sqrt_s
    else:
        drift = control.micro_drift_n_per_sqrt_s
        e["micro_amperes_per_word"] = 1e-3 * profile.micro.rated_current_a
        e["macro_position_gain_ratio"], e["macro_velocity_gain_per_s"], e["macro_force_gain_n_per_m"] = (
            adaptive_filter.steady_gains(period_s, profile.macro.mass_kg, noise_m, control.macro_drift_n_per_sqrt_s)
        )
    jitter_s = profile.interferometer.jitter_s
    adaptive_filter.init(
        *(e, period_s, precise.mass_kg, noise_m, drift, rest_ratio, precise.force_noise_n, jitter_s),
        control.travel_drift_n_per_sqrt_m,
    )
    contact_doubt_ratio = 0.0 if profile.backlash is None else profile.backlash.force_sd_ratio
    fed_forward.init(e, period_s, precise.mass_sd_kg, contact_doubt_ratio)
    return e


def init_model() -> np.ndarray:
    """Make the believed machine's PLANT_STATE; the first sample places it."""
    return np.zeros(1, PLANT_STATE)


@compiled
def start(e: Record, s: Record, m: Record) -> None:
    """Place the believed machine at rest at the first sample."""
    s.macro_position_m = m.macro_position_m
    s.end_position_m = m.end_position_m
    s.t_s = 0.0
    s.macro_velocity_m_per_s = 0.0
    s.end_velocity_m_per_s = 0.0
    s.macro_acceleration_m_per_s2 = 0.0
    s.end_acceleration_m_per_s2 = 0.0
    s.macro_disturbance_n = 0.0
    s.micro_disturbance_n = 0.0
    s.memory[:] = 0.0
    e.filter_mean_m = 0.0
    fed_forward.forget(e)
    e.identification_waits = 0.0
    e.cycle = m.cycle
    e.started = 1.0


@compiled
def carry(e: Record, s: Record, q: Record, acceleration_m_per_s2: float) -> None:
    """Carry the unknown force of the axis that carries the end on to where the reference accelerates like this."""
    change_n = fed_forward.carry(e, acceleration_m_per_s2)
    if q.has_micro != 0.0:
        s.micro_disturbance_n += change_n
    else:
        s.macro_disturbance_n += change_n


@compiled
def correct(e: Record, s: Record, q: Record, macro_position_m: float, end_position_m: float) -> None:
    """Take a fresh sample into the believed machine."""
    innovation = macro_position_m - s.macro_position_m
    e.macro_innovation_m = innovation
    if q.has_micro != 0.0:
        s.macro_position_m += e.macro_position_gain_ratio * innovation
        s.macro_velocity_m_per_s += e.macro_velocity_gain_per_s * innovation
        s.macro_disturbance_n += e.macro_force_gain_n_per_m * innovation
        innovation = end_position_m - s.end_position_m
        e.end_innovation_m = innovation
        innovation = notch.passed(e, innovation)
        doubted_n2 = fed_forward.foretell(e, s.contact_force_n)
        adaptive_filter.step(e, innovation, s.end_velocity_m_per_s, doubted_n2)
        s.end_position_m += e.precise_position_gain_ratio * innovation
        s.end_velocity_m_per_s += e.precise_velocity_gain_per_s * innovation
        s.micro_disturbance_n += e.precise_force_gain_n_per_m * innovation
        fed_forward.learn(e, innovation, adaptive_filter.innovation_variance_m2(e))
    else:
        innovation = notch.passed(e, innovation)
        adaptive_filter.step(e, innovation, s.macro_velocity_m_per_s, fed_forward.foretell(e, 0.0))
        s.macro_position_m += e.precise_position_gain_ratio * innovation
        s.macro_velocity_m_per_s += e.precise_velocity_gain_per_s * innovation
        s.macro_disturbance_n += e.precise_force_gain_n_per_m * innovation
        fed_forward.learn(e, innovation, adaptive_filter.innovation_variance_m2(e))
        s.end_position_m = s.macro_position_m
        s.end_velocity_m_per_s = s.macro_velocity_m_per_s
