"""The values that pass between modules: one-element structured arrays with named fields.

Every field is eight bytes wide, so rows have no padding and compile alike everywhere.
`init` functions make them, `step` functions write them in place, a value is a copy.
Pure; knows no bus and no clock.
"""

from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np

Record: TypeAlias = Any
"""One element of a structured array in compiled code: its fields are attributes, which no type checker can see."""

MACRO = 0
MICRO = 1

SETPOINT = np.dtype(
    [
        ("position_m", "f8"),
        ("velocity_m_per_s", "f8"),
        ("acceleration_m_per_s2", "f8"),
        ("jerk_m_per_s3", "f8"),
        ("relative_position_m", "f8"),  # end minus macro beyond the gap's centre: 0 but in sweeps of the micro
        ("relative_velocity_m_per_s", "f8"),
        ("relative_acceleration_m_per_s2", "f8"),
    ]
)
"""Where the end should be at the instant of a sensor sample, and how far it leads the macro."""

MEASUREMENT = np.dtype(
    [
        ("t_ns", "i8"),  # start of the cycle, host clock (CLOCK_MONOTONIC_RAW or virtual)
        ("cycle", "i8"),  # number of this cycle on the sensor's own sequence: the sample it should have
        ("sequence", "i8"),  # number of the newest valid sample, unwrapped; -1 before the first
        ("sample_t_ns", "i8"),  # recovered instant of that sample, on the host clock
        ("samples_new", "i8"),  # valid samples that arrived since the last cycle
        ("reference_lost", "i8"),  # 1 after a beam loss, a restart or an impossible jump; latched until homing
        ("macro_position_m", "f8"),  # laser, in the run's own zero
        ("end_position_m", "f8"),
        ("earlier_sequence", "i8"),  # of the valid sample before the newest where both are new, else -1
        ("macro_earlier_m", "f8"),
        ("end_earlier_m", "f8"),
        ("macro_encoder_m", "f8"),  # drive's own encoder, in the drive's zero
        ("micro_encoder_m", "f8"),
        ("macro_reported_force_n", "f8"),  # torque actual value x rated force
        ("micro_reported_force_n", "f8"),
        ("macro_statusword", "i8"),
        ("micro_statusword", "i8"),
        ("macro_digital_inputs", "i8"),  # 0x60FD
        ("micro_digital_inputs", "i8"),
        ("macro_mode_display", "i8"),  # 0x6061
        ("micro_mode_display", "i8"),
        ("modes_told", "i8"),  # `MODE_TOLD` of each drive that has told its mode of operation; 0 is a mode, too
        ("tpdos_new", "i8"),  # bit 0 macro, bit 1 micro: a TPDO of the last SYNC arrived
        ("emergency", "i8"),  # last EMCY: node id << 16 | error code; 0 = none
        ("command_lost", "i8"),  # 1 when the last cycle's command could not be put on the bus
        ("latched_after_s", "f8"),  # last cycle's sample instant to the end of its SYNC, measured; 0 = not known
        ("lease_left_ns", "i8"),  # time until the motion lease ends; the guard stops at <= 0
        ("overrun_ns", "i8"),  # lateness of this cycle beyond one period, else 0
    ]
)
"""What the loop knows of the world at the start of a tick; measured, never estimated."""

MODES = {"torque": 10, "position": 8}
"""Mode of operation (CiA 402: cyclic synchronous torque, cyclic synchronous position) of a profile's `mode`."""

MODE_TOLD = {"macro": 1, "micro": 2}
"""The bits of MEASUREMENT.modes_told."""

COMMAND = np.dtype(
    [
        ("macro_force_asked_n", "f8"),  # what the law asked for
        ("micro_force_asked_n", "f8"),
        ("macro_word", "i8"),  # the integer that is put on the wire, 0.1 % of rated torque
        ("micro_word", "i8"),
        ("macro_force_n", "f8"),  # the decoded integer: what estimators and identification use
        ("micro_force_n", "f8"),
        ("macro_target_m", "f8"),  # drive position target, encoder zero (position mode only)
        ("stop", "i8"),  # Stop
    ]
)
"""What a tick decides."""


class Stop(IntEnum):
    """Why a run ended; `stop_sentence` says it to the operator."""

    NONE = 0
    FINISHED = 1
    OPERATOR = 2
    TRAVEL = 3
    VELOCITY = 4
    FORCE = 5
    FOLLOWING_ERROR = 6
    MICRO_STROKE = 7
    SENSOR_AGE = 8
    REFERENCE_LOST = 9
    OVERRUN = 10
    THERMAL = 11
    LEASE = 12
    COMMAND_NOT_FINITE = 13
    DRIVE_FAULT = 14
    DIGITAL_INPUT = 15
    EMERGENCY = 16
    LINK_SILENT = 17
    SUPERVISOR_SILENT = 18
    COMMAND_LOST = 19
    MEASUREMENT_NOT_FINITE = 20
    LINK_LOST = 21
    HEARTBEAT_LOST = 22
    RECORD_LOST = 23
    SAMPLE_AHEAD = 24
    STARVED = 25
    HOMING_GIVEN_UP = 26
    ENCODER_LOST = 27
    DRIVE_MODE = 28
    FORCE_UNHEEDED = 29


STOP_TEXT = {
    Stop.NONE: "nothing stopped it",
    Stop.FINISHED: "the reference came to its end",
    Stop.OPERATOR: "the operator asked to stop",
    Stop.TRAVEL: "the stage left its allowed travel",
    Stop.VELOCITY: "an axis is faster than its stopping method allows here",
    Stop.FORCE: "the law asked for more force than the profile allows",
    Stop.FOLLOWING_ERROR: "the end is too far from its reference",
    Stop.MICRO_STROKE: "the micro left its stroke",
    Stop.SENSOR_AGE: "no valid interferometer sample for too long",
    Stop.REFERENCE_LOST: "the interferometer lost its reference: home again",
    Stop.OVERRUN: "the host missed its deadline for too long",
    Stop.THERMAL: "a motor reached its thermal limit",
    Stop.LEASE: "the lease on motion ran out",
    Stop.COMMAND_NOT_FINITE: "the control law asked for nan or infinity",
    Stop.DRIVE_FAULT: "a drive left Operation enabled",
    Stop.DIGITAL_INPUT: "a limit switch, STO or pressure input tripped",
    Stop.EMERGENCY: "a drive sent an emergency message",
    Stop.LINK_SILENT: "a drive sent no process data for too long",
    Stop.SUPERVISOR_SILENT: "the supervisor's counter stands still",
    Stop.COMMAND_LOST: "commands could not be put on the bus",
    Stop.MEASUREMENT_NOT_FINITE: "a measured position is not a finite number",
    Stop.LINK_LOST: "a link that the stage needs is lost",
    Stop.HEARTBEAT_LOST: "a drive sends no heartbeat",
    Stop.RECORD_LOST: "the run can't be written to its disk",
    Stop.SAMPLE_AHEAD: "the newest interferometer sample lies in the future",
    Stop.STARVED: "the set-points did not come in time: the stage braked to rest and holds",
    Stop.HOMING_GIVEN_UP: "the macro's drive gave its homing up",
    Stop.ENCODER_LOST: "the encoder of the macro's drive lies",
    Stop.DRIVE_MODE: "a drive works in another mode of operation than it is commanded in",
    Stop.FORCE_UNHEEDED: "a drive gives another force than it is asked for",
}


def stop_sentence(stop: Stop, detail: str) -> str:
    """Say why a run ended, with place, value, limit and remedy where `detail` has them."""
    return f"{STOP_TEXT[stop]}: {detail}" if detail else STOP_TEXT[stop]


def new(dtype: np.dtype) -> np.ndarray:
    """Make a zeroed one-element structured array of `dtype`."""
    return np.zeros(1, dtype)
