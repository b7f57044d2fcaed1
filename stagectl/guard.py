"""The last word before the wire: limits, written so that nan fails. Knows no law and shares no code with one.

Pure; knows no bus and no clock.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl.compiled import compiled
from stagectl.signals import MODES, Record, Stop

if TYPE_CHECKING:
    from stagectl.profile import Profile

ASKED_CYCLES = 3
"""A force is reported with the SYNC behind the one that asked for it, and read a cycle later; one more for a frame that
is late by a cycle. In undisturbed motions of the rig the force is that of one of them but for 1 N of 180."""

UNHEEDED_CYCLES, _HEEDED_SHARE = 6.0, 0.1
"""A loop whose commands come 3 to 5 ms late rings: every other half wave is as it was asked for. It is told 45 to 65 ms
behind the first late frame, and has not begun to shake the stage then; its end left its reference 20 to 45 ms later."""

GUARD = np.dtype(
    [
        ("travel_low_m", "f8"),
        ("travel_high_m", "f8"),
        ("velocity_limit_m_per_s", "f8"),
        ("stop_deceleration_m_per_s2", "f8"),
        ("macro_force_limit_n", "f8"),
        ("micro_force_limit_n", "f8"),
        ("following_error_m", "f8"),
        ("stroke_low_m", "f8"),
        ("stroke_high_m", "f8"),
        ("sensor_age_ns", "f8"),
        ("sensor_ahead_ns", "f8"),  # a sample further ahead of its cycle is a clock fault, not a young sample
        ("late_limit", "f8"),
        ("overrun_ns", "f8"),
        ("silent_cycles", "f8"),
        ("lost_commands", "f8"),
        ("macro_thermal_n", "f8"),
        ("macro_thermal_share", "f8"),  # period / time constant
        ("micro_thermal_n", "f8"),
        ("micro_thermal_share", "f8"),
        ("input_trip_mask", "f8"),
        ("macro_mode", "f8"),  # 0x6061 that a drive shows whose law commands it
        ("micro_mode", "f8"),
        ("velocity_share", "f8"),
        ("has_micro", "f8"),
        ("braking", "f8"),  # 1 in a guided stop: the macro is brought to rest by its drive, only the micro is trusted
        ("has_drives", "f8"),  # 0 behind the value seam: no statusword, inputs, TPDOs
        ("period_s", "f8"),
        ("started", "f8"),
        ("cycle", "f8"),
        ("macro_position_m", "f8"),
        ("macro_velocity_m_per_s", "f8"),
        ("macro_heat_n2", "f8"),
        ("micro_heat_n2", "f8"),
        ("macro_silence", "f8"),
        ("micro_silence", "f8"),
        ("macro_n_per_word", "f8"),  # what one of the integers on the wire asks of a drive
        ("micro_n_per_word", "f8"),
        ("macro_off_n", "f8"),  # by which a drive may report another force than it was asked for
        ("micro_off_n", "f8"),
        ("macro_asked_n", "f8", (ASKED_CYCLES,)),  # of it lately
        ("micro_asked_n", "f8", (ASKED_CYCLES,)),
        ("macro_unheeded", "f8"),  # cycles with another force, less a tenth of those without
        ("micro_unheeded", "f8"),
        ("commands_lost", "f8"),
        ("late_cycles", "f8"),  # in a row, each more than `_LATE_CYCLES` ahead of its newest sample
    ]
)

STROKE_SHARE = 0.95
"""Of the stroke, that the micro may use: the hard stops are beyond."""

_LATE_CYCLES, _LATE_AGES = 1, 5.0  # later than that for so many times the sensor's greatest age is late for good
_VELOCITY_SHARE = 0.2  # of a new difference in the guard's own velocity: 5 ms, 5 nm noise gives 2 um/s

NEGATIVE_LIMIT, POSITIVE_LIMIT, SAFE_TORQUE_OFF = 1 << 0, 1 << 1, 1 << 3  # 0x60FD, CiA 402 (bit 3: interlock)
PRESSURE_LOW = 1 << 16  # the first manufacturer's bit, as in the EDS
_OPERATION_ENABLED, _STATE_MASK = 0x27, 0x6F

# numba folds plain integers; enumeration members cost a lookup
_NONE = int(Stop.NONE)
_TRAVEL = int(Stop.TRAVEL)
_VELOCITY = int(Stop.VELOCITY)
_FORCE = int(Stop.FORCE)
_FOLLOWING_ERROR = int(Stop.FOLLOWING_ERROR)
_MICRO_STROKE = int(Stop.MICRO_STROKE)
_SENSOR_AGE = int(Stop.SENSOR_AGE)
_SAMPLE_AHEAD = int(Stop.SAMPLE_AHEAD)
_REFERENCE_LOST = int(Stop.REFERENCE_LOST)
_OVERRUN = int(Stop.OVERRUN)
_THERMAL = int(Stop.THERMAL)
_LEASE = int(Stop.LEASE)
_COMMAND_NOT_FINITE = int(Stop.COMMAND_NOT_FINITE)
_MEASUREMENT_NOT_FINITE = int(Stop.MEASUREMENT_NOT_FINITE)
_DRIVE_FAULT = int(Stop.DRIVE_FAULT)
_DRIVE_MODE = int(Stop.DRIVE_MODE)
_DIGITAL_INPUT = int(Stop.DIGITAL_INPUT)
_EMERGENCY = int(Stop.EMERGENCY)
_LINK_SILENT = int(Stop.LINK_SILENT)
_FORCE_UNHEEDED = int(Stop.FORCE_UNHEEDED)
_COMMAND_LOST = int(Stop.COMMAND_LOST)


def init(profile: "Profile", *, has_drives: bool) -> np.ndarray:
    """Make GUARD from the profile's limits."""
    g = np.zeros(1, GUARD)
    macro, micro, trip = profile.macro, profile.micro, profile.trip
    period_s = 1.0 / profile.cycle.rate_hz
    g["period_s"] = period_s
    g["has_drives"] = float(has_drives)
    # Where the reference may go; the macro strays from it, at most as far as the end may from its own.
    g["travel_low_m"] = macro.travel_m[0] - profile.control.error_limit_m
    g["travel_high_m"] = macro.travel_m[1] + profile.control.error_limit_m
    g["velocity_limit_m_per_s"] = macro.velocity_limit_m_per_s
    g["stop_deceleration_m_per_s2"] = macro.stop_deceleration_m_per_s2
    g["macro_force_limit_n"] = macro.force_limit_n
    g["following_error_m"] = profile.control.error_limit_m
    g["sensor_age_ns"] = trip.sensor_age_s * 1e9
    g["sensor_ahead_ns"] = np.round(1e9 * period_s)
    g["late_limit"] = _LATE_AGES * max(3.0, trip.sensor_age_s / period_s)
    g["overrun_ns"] = trip.overrun_s * 1e9
    g["silent_cycles"] = max(3.0, trip.sensor_age_s / period_s)
    g["lost_commands"] = max(3.0, trip.sensor_age_s / period_s)
    g["input_trip_mask"] = NEGATIVE_LIMIT | POSITIVE_LIMIT | SAFE_TORQUE_OFF | PRESSURE_LOW
    g["macro_mode"] = MODES[macro.mode]
    g["macro_n_per_word"] = macro.torque_step_n
    g["macro_off_n"] = trip.force_error_ratio * macro.force_limit_n if macro.mode == "torque" else np.inf
    g["velocity_share"] = _VELOCITY_SHARE
    g["macro_thermal_n"] = macro.thermal_force_n
    g["macro_thermal_share"] = period_s / macro.thermal_time_constant_s
    if micro is not None:
        g["has_micro"] = 1.0
        g["micro_mode"] = MODES["torque"]
        g["micro_n_per_word"] = micro.torque_step_n
        g["micro_off_n"] = trip.force_error_ratio * micro.force_limit_n
        g["micro_force_limit_n"] = micro.force_limit_n
        g["stroke_low_m"] = micro.stroke_m[0] * STROKE_SHARE
        g["stroke_high_m"] = micro.stroke_m[1] * STROKE_SHARE
        g["micro_thermal_n"] = micro.thermal_force_n
        g["micro_thermal_share"] = period_s / micro.thermal_time_constant_s
    return g


@compiled
def hear_drives(g: Record, m: Record) -> None:
    """Count the cycles since each drive sent its process data last."""
    if m.command_lost == 0:  # a SYNC that did not go out has no answer
        g.macro_silence = 0.0 if m.tpdos_new & 1 else g.macro_silence + 1.0
        g.micro_silence = 0.0 if m.tpdos_new & 2 or g.has_micro == 0.0 else g.micro_silence + 1.0


@compiled
def ask(g: Record, macro_word: int, micro_word: int) -> None:
    """Note what is sent to the drives in this cycle."""
    for k in range(ASKED_CYCLES - 1, 0, -1):
        g.macro_asked_n[k] = g.macro_asked_n[k - 1]
        g.micro_asked_n[k] = g.micro_asked_n[k - 1]
    g.macro_asked_n[0] = macro_word * g.macro_n_per_word
    g.micro_asked_n[0] = micro_word * g.micro_n_per_word


@compiled
def _unheeded(before: float, reported_n: float, asked_n: np.ndarray, off_n: float) -> float:
    """Return the count of cycles in which a drive reported another force than it was asked for lately; nan by nan."""
    low_n, high_n = asked_n.min(), asked_n.max()
    beside_n = abs(reported_n - 0.5 * (low_n + high_n)) - 0.5 * (high_n - low_n)
    if beside_n <= off_n:
        return max(before - _HEEDED_SHARE, 0.0)
    return before + 1.0 if beside_n > off_n else np.nan


@compiled
def _drives_stop(g: Record, m: Record) -> int:
    """Return why the drives' own words end the run."""
    trip = int(g.input_trip_mask)
    if g.braking != 0.0:  # why it brakes is known, and the macro's drive no longer takes part
        if m.micro_digital_inputs & trip != 0:
            return _DIGITAL_INPUT
    else:
        if (m.macro_digital_inputs | m.micro_digital_inputs) & trip != 0:
            return _DIGITAL_INPUT
        # Before an emergency: what the drive answers to a target of another mode follows from it.
        if m.modes_told & 1 and m.macro_mode_display != g.macro_mode:
            return _DRIVE_MODE
        if m.emergency != 0:
            return _EMERGENCY
    if m.modes_told & 2 and m.micro_mode_display != g.micro_mode:  # none tells where there is none
        return _DRIVE_MODE
    g.commands_lost = g.commands_lost + 1.0 if m.command_lost != 0 else 0.0
    if not g.commands_lost <= g.lost_commands:
        return _COMMAND_LOST
    hear_drives(g, m)
    if not g.micro_silence <= g.silent_cycles:
        return _LINK_SILENT
    if g.has_micro != 0.0 and m.micro_statusword & _STATE_MASK != _OPERATION_ENABLED:
        return _DRIVE_FAULT
    if g.has_micro != 0.0 and m.command_lost == 0 and m.tpdos_new & 2:
        g.micro_unheeded = _unheeded(g.micro_unheeded, m.micro_reported_force_n, g.micro_asked_n, g.micro_off_n)
    if not g.micro_unheeded <= UNHEEDED_CYCLES:
        return _FORCE_UNHEEDED
    if g.braking != 0.0:
        return _NONE
    if not g.macro_silence <= g.silent_cycles:
        return _LINK_SILENT
    if m.macro_statusword & _STATE_MASK != _OPERATION_ENABLED:
        return _DRIVE_FAULT
    if m.command_lost == 0 and m.tpdos_new & 1:
        g.macro_unheeded = _unheeded(g.macro_unheeded, m.macro_reported_force_n, g.macro_asked_n, g.macro_off_n)
    if not g.macro_unheeded <= UNHEEDED_CYCLES:
        return _FORCE_UNHEEDED
    return _NONE


@compiled
def _motion_stop(g: Record, m: Record, now: Record) -> int:
    """Return why position, speed or stroke end the run."""
    if g.started == 0.0:
        g.started = 1.0
        g.macro_position_m = m.macro_position_m
        g.macro_velocity_m_per_s = now.velocity_m_per_s
        g.cycle = m.cycle
    elapsed = m.sequence - g.cycle
    if elapsed > 0 and m.samples_new > 0:  # a late line too: its own number says over which time the way went
        rate = (m.macro_position_m - g.macro_position_m) / (elapsed * g.period_s)
        g.macro_velocity_m_per_s += g.velocity_share * (rate - g.macro_velocity_m_per_s)
        g.macro_position_m = m.macro_position_m
        g.cycle = m.sequence
    if g.has_micro != 0.0 and not g.stroke_low_m <= m.end_position_m - m.macro_position_m <= g.stroke_high_m:
        return _MICRO_STROKE
    # Lines that are late for good are younger than the greatest age, and hide a sensor's clock that goes wrong: one
    # that was 0.7 % too slow took a jog 8.5 mm from its reference. The estimator takes a line of the cycle before, and
    # none of an older one: with lines 2 to 3 cycles late it ran open loop for a second, a guided stop too.
    lag = m.cycle - m.sequence
    g.late_cycles = 0.0 if lag <= _LATE_CYCLES else g.late_cycles + 1.0
    if not g.late_cycles <= g.late_limit:
        return _SENSOR_AGE
    if g.braking != 0.0:
        return _NONE
    v = g.macro_velocity_m_per_s
    if not g.travel_low_m <= m.macro_position_m <= g.travel_high_m:
        return _TRAVEL
    if not abs(v) <= g.velocity_limit_m_per_s:
        return _VELOCITY
    rest_m = m.macro_position_m + 0.5 * v * abs(v) / g.stop_deceleration_m_per_s2
    if not g.travel_low_m <= rest_m <= g.travel_high_m:
        return _VELOCITY
    # A late line is judged at its own instant; without one there is nothing new to judge.
    lag_s = lag * g.period_s
    due_m = now.position_m - lag_s * (now.velocity_m_per_s - 0.5 * lag_s * now.acceleration_m_per_s2)
    judged = m.samples_new > 0 or not np.isfinite(due_m)
    if judged and not abs(m.end_position_m - due_m) <= g.following_error_m:
        return _FOLLOWING_ERROR
    return _NONE


@compiled
def step(g: Record, m: Record, now: Record, macro_n: float, micro_n: float) -> int:
    """Return the Stop code for this cycle, NONE to go on; forces are what the law asked for."""
    if not (np.isfinite(m.macro_position_m) and np.isfinite(m.end_position_m)):
        return _MEASUREMENT_NOT_FINITE
    if not (np.isfinite(macro_n) and np.isfinite(micro_n)):
        return _COMMAND_NOT_FINITE
    if g.braking == 0.0 and not abs(macro_n) <= g.macro_force_limit_n:
        return _FORCE
    if g.has_micro != 0.0 and not abs(micro_n) <= g.micro_force_limit_n:
        return _FORCE
    if m.reference_lost != 0:
        return _REFERENCE_LOST
    if not m.t_ns - m.sample_t_ns <= g.sensor_age_ns:
        return _SENSOR_AGE
    if not m.sample_t_ns - m.t_ns <= g.sensor_ahead_ns:
        return _SAMPLE_AHEAD
    if g.braking == 0.0:
        if not m.overrun_ns <= g.overrun_ns:
            return _OVERRUN
        if not m.lease_left_ns > 0:
            return _LEASE
    if g.has_drives != 0.0:
        stop = _drives_stop(g, m)
        if stop != _NONE:
            return stop
    stop = _motion_stop(g, m, now)
    if stop != _NONE:
        return stop
    if g.braking != 0.0:
        return _NONE
    g.macro_heat_n2 += g.macro_thermal_share * (macro_n * macro_n - g.macro_heat_n2)
    if not g.macro_heat_n2 <= g.macro_thermal_n * g.macro_thermal_n:
        return _THERMAL
    if g.has_micro != 0.0:
        g.micro_heat_n2 += g.micro_thermal_share * (micro_n * micro_n - g.micro_heat_n2)
        if not g.micro_heat_n2 <= g.micro_thermal_n * g.micro_thermal_n:
            return _THERMAL
    return _NONE
