"""The fast inside of a drive, called every substep: motor encoder, observer, position loop, ramps, current command.

Position loop, on the encoder's estimate (x, v) and a reference (r, r', r''):

    i = m / K * (r'' + w^2 (r - x) + 2 z w (r' - v) + I) + i_offset,   I' = w^3 / 10 (r - x)

The drive logic (`sim_backend.drive`) sets mode, targets and ramps between substeps. Pure; knows no bus and no clock.
"""

import numpy as np

from stagectl.compiled import compiled

OFF = 0
SHORTED = 1
TORQUE = 2
POSITION = 3  # follow the interpolated target
STOPPING = 4  # bring the reference to rest with the ramp, then hold it there
HOMING = 5

HOMING_SEARCH = 0
HOMING_SLOWING = 1
HOMING_DONE = 2
HOMING_FAILED = 3

_DAMPING = 0.8
_REST_M_PER_S = 1e-3  # slower than this is standstill for the drive

SERVO_PARAMETERS = np.dtype(
    [
        ("has_encoder", "i8"),
        ("encoder_step_m", "f8"),
        ("encoder_offset_m", "f8"),  # encoder reading minus position
        ("index_m", "f8"),  # encoder reading at the index mark
        ("index_pitch_m", "f8"),  # distance of further marks; 0 = one mark only
        ("bandwidth_rad_per_s", "f8"),
        ("observer_rad_per_s", "f8"),
        ("mass_per_constant", "f8"),  # kg A / N, own and carried: current for an acceleration of 1 m/s^2
        ("homing_error_limit_m", "f8"),
    ]
)

SERVO_STATE = np.dtype(
    [
        ("mode", "i8"),
        ("bridge", "i8"),  # output: 0 off, 1 current control, 2 winding shorted (stagectl.plant)
        ("current_command_a", "f8"),  # output
        ("current_limit_a", "f8"),
        ("torque_target_a", "f8"),
        ("torque_offset_a", "f8"),
        ("encoder_count", "i8"),
        ("position_m", "f8"),  # estimates, encoder frame
        ("velocity_m_per_s", "f8"),
        ("disturbance_m_per_s2", "f8"),  # acceleration that the drive's own current does not explain
        ("reference_m", "f8"),
        ("reference_velocity_m_per_s", "f8"),
        ("reference_goal_m", "f8"),  # of the interpolation under way
        ("interpolation_left_s", "f8"),
        ("integral_m_per_s2", "f8"),
        ("ramp_m_per_s2", "f8"),
        ("at_rest", "i8"),
        ("homing_phase", "i8"),
        ("homing_velocity_m_per_s", "f8"),  # signed search speed
        ("index_count", "i8"),  # encoder count latched at the mark
        ("limited", "i8"),  # 1 while the current command is cut by its limit
    ]
)


def parameters(axis, bandwidth_hz: float = 20.0) -> np.ndarray:
    """Make SERVO_PARAMETERS from an axis of a machine; without `encoder_step_m` there is no encoder."""
    p = np.zeros(1, SERVO_PARAMETERS)
    step_m = getattr(axis, "encoder_step_m", None) or 0.0
    p["has_encoder"] = 1 if step_m > 0.0 else 0
    p["encoder_step_m"] = step_m if step_m > 0.0 else 1.0
    p["encoder_offset_m"] = getattr(axis, "encoder_offset_m", None) or 0.0
    p["index_m"] = (getattr(axis, "index_position_m", None) or 0.0) + float(p["encoder_offset_m"][0])
    p["index_pitch_m"] = getattr(axis, "index_pitch_m", None) or 0.0
    p["bandwidth_rad_per_s"] = 2.0 * np.pi * bandwidth_hz
    p["observer_rad_per_s"] = 2.0 * np.pi * 150.0
    moved_kg = axis.mass_kg + (getattr(axis, "commissioned_load_kg", None) or 0.0)
    p["mass_per_constant"] = moved_kg / axis.force_constant_n_per_a
    p["homing_error_limit_m"] = 5e-3
    return p


def init(p: np.ndarray, position_m: float) -> np.ndarray:
    """Make SERVO_STATE of an unpowered drive whose motor stands at `position_m`."""
    s = np.zeros(1, SERVO_STATE)
    reading_m = position_m + float(p["encoder_offset_m"][0])
    s["encoder_count"] = int(np.floor(reading_m / float(p["encoder_step_m"][0]) + 0.5)) if p["has_encoder"][0] else 0
    s["position_m"] = s["encoder_count"] * p["encoder_step_m"]
    s["at_rest"] = 1
    return s


@compiled
def enter(state, mode):
    """Switch the mode without a bump: references start from the estimates."""
    s = state[0]
    s.mode = mode
    s.reference_m = s.position_m
    s.reference_goal_m = s.position_m
    s.reference_velocity_m_per_s = s.velocity_m_per_s if mode == STOPPING else 0.0
    s.interpolation_left_s = 0.0
    s.integral_m_per_s2 = 0.0
    s.at_rest = 0
    s.homing_phase = HOMING_SEARCH
    if mode != TORQUE:
        s.torque_target_a = 0.0
        s.torque_offset_a = 0.0


@compiled
def set_target(state, target_m, period_s):
    """Give the position loop its next target, to be reached in `period_s` (0x60C2)."""
    s = state[0]
    s.reference_goal_m = target_m
    s.interpolation_left_s = period_s
    s.reference_velocity_m_per_s = (target_m - s.reference_m) / period_s


@compiled
def _marks_below(count, p):
    """Number the stretch between index marks that an encoder count lies in."""
    index_count = np.floor(p.index_m / p.encoder_step_m + 0.5)
    if p.index_pitch_m > 0.0:
        return np.floor((count - index_count) * p.encoder_step_m / p.index_pitch_m)
    return 0.0 if count >= index_count else -1.0


@compiled
def _look_for_index(s, p, old_count):
    """Latch the encoder count of a mark that was passed in the search direction."""
    before = _marks_below(old_count, p)
    after = _marks_below(s.encoder_count, p)
    forward = s.homing_velocity_m_per_s > 0.0
    if (forward and after > before) or (not forward and after < before):
        index_count = np.floor(p.index_m / p.encoder_step_m + 0.5)
        mark = after if forward else before
        s.index_count = np.int64(index_count + np.floor(mark * p.index_pitch_m / p.encoder_step_m + 0.5))
        s.homing_phase = HOMING_SLOWING


@compiled
def _ramp(s, goal_m_per_s, dt_s):
    """Move the reference's velocity towards a goal at the ramp, its position along; return its acceleration."""
    change = goal_m_per_s - s.reference_velocity_m_per_s
    largest = s.ramp_m_per_s2 * dt_s
    change = min(max(change, -largest), largest)
    s.reference_m += (s.reference_velocity_m_per_s + 0.5 * change) * dt_s
    s.reference_velocity_m_per_s += change
    return change / dt_s


@compiled
def _reference(s, p, dt_s):
    """Advance the reference of the present mode; return its acceleration."""
    if s.mode == POSITION:
        if s.interpolation_left_s > 0.5 * dt_s:
            s.reference_m += s.reference_velocity_m_per_s * dt_s
            s.interpolation_left_s -= dt_s
        else:
            s.reference_m = s.reference_goal_m
            s.reference_velocity_m_per_s = 0.0
        return 0.0
    if s.mode == STOPPING:
        acceleration = _ramp(s, 0.0, dt_s)
        s.at_rest = 1 if s.reference_velocity_m_per_s == 0.0 and abs(s.velocity_m_per_s) < _REST_M_PER_S else 0
        return acceleration
    goal = s.homing_velocity_m_per_s if s.homing_phase == HOMING_SEARCH else 0.0
    acceleration = _ramp(s, goal, dt_s)
    if not abs(s.reference_m - s.position_m) <= p.homing_error_limit_m:
        s.homing_phase = HOMING_FAILED
    elif s.homing_phase == HOMING_SLOWING:
        stands = s.reference_velocity_m_per_s == 0.0 and abs(s.velocity_m_per_s) < _REST_M_PER_S
        s.homing_phase = HOMING_DONE if stands else HOMING_SLOWING
    return acceleration


@compiled
def step(state, parameters, position_m, dt_s):
    """Read the encoder at `position_m` and set `current_command_a` and `bridge` for the next `dt_s`."""
    s = state[0]
    p = parameters[0]
    if p.has_encoder != 0:
        old_count = s.encoder_count
        s.encoder_count = np.int64(np.floor((position_m + p.encoder_offset_m) / p.encoder_step_m + 0.5))
        s.position_m += s.velocity_m_per_s * dt_s
        innovation = s.encoder_count * p.encoder_step_m - s.position_m
        w = p.observer_rad_per_s
        s.position_m += 3.0 * w * dt_s * innovation
        s.velocity_m_per_s += 3.0 * w * w * dt_s * innovation
        s.disturbance_m_per_s2 += w * w * w * dt_s * innovation
        if s.mode == HOMING and s.homing_phase == HOMING_SEARCH and s.encoder_count != old_count:
            _look_for_index(s, p, old_count)
    if s.mode == OFF or s.mode == SHORTED:
        s.current_command_a = 0.0
        s.bridge = 0 if s.mode == OFF else 2
        s.limited = 0
        s.velocity_m_per_s += s.disturbance_m_per_s2 * dt_s
        return
    if s.mode == TORQUE:
        wanted = s.torque_target_a + s.torque_offset_a
    else:
        w = p.bandwidth_rad_per_s
        feed = _reference(s, p, dt_s)
        error = s.reference_m - s.position_m
        rate = s.reference_velocity_m_per_s - s.velocity_m_per_s
        wanted = p.mass_per_constant * (feed + w * w * error + 2.0 * _DAMPING * w * rate + s.integral_m_per_s2)
        wanted += s.torque_offset_a
        if s.limited == 0:
            s.integral_m_per_s2 += 0.1 * w * w * w * error * dt_s
    limit = s.current_limit_a
    s.limited = 1 if wanted > limit or wanted < -limit else 0
    s.current_command_a = min(max(wanted, -limit), limit)
    s.bridge = 1
    s.velocity_m_per_s += (s.current_command_a / p.mass_per_constant + s.disturbance_m_per_s2) * dt_s
