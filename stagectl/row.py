"""ROW: everything that one cycle knew, decided and sent, as one fixed-size record.

Every field starts on an eight-byte boundary, so a row has no padding and compiles alike everywhere.
Pure; knows no file and no clock.
"""

import hashlib
from typing import Any

import numpy as np

from stagectl.signals import COMMAND, MEASUREMENT, SETPOINT

SENSOR_BYTES_COUNT = 512
"""Serial bytes that one row can hold: 512 at 921 600 bit/s is 5.5 ms of line."""

FRAME_BYTES_COUNT = 8
"""Payload of a classic CAN frame."""

FRAMES = (
    "macro_tpdo",
    "micro_tpdo",
    "macro_inputs_tpdo",
    "micro_inputs_tpdo",
    "macro_emcy",
    "micro_emcy",
)
"""Frames that a cycle may have taken from the bus; `<name>_count` is their length, -1 = none this cycle."""

EXTRA_CHANNELS = ("extra_1", "extra_2", "extra_3", "extra_4")
"""Spare f8 channels; the manifest's `extra_channels` says what a run put there. nan = nothing."""

ESTIMATES = (
    "macro_position_estimate_m",
    "macro_velocity_estimate_m_per_s",
    "end_position_estimate_m",
    "end_velocity_estimate_m_per_s",
    "macro_disturbance_n",
    "micro_disturbance_n",
    "contact_force_estimate_n",
    "sliding_variable_m_per_s",
    "adaptive_gain_ratio",
    "unrest_ratio",
    "backlash_left_m",
    "backlash_right_m",
    "backlash_left_stiffness_n_per_m",
    "backlash_right_stiffness_n_per_m",
    "backlash_left_sd_m",
    "backlash_right_sd_m",
    "backlash_left_stiffness_sd_n_per_m",
    "backlash_right_stiffness_sd_n_per_m",
)
"""What estimators and law believe; nan where nothing estimates it."""


def _scalars(dtype: np.dtype, prefix: str = "") -> list[tuple[Any, ...]]:
    return [(prefix + name, dtype[name]) for name in dtype.names or ()]


def _frame(name: str) -> list[tuple[Any, ...]]:
    return [(name, "u1", (FRAME_BYTES_COUNT,)), (f"{name}_count", "i8")]


ROW = np.dtype(
    [
        ("run_phase", "i8"),  # what the servo was doing
        *_scalars(MEASUREMENT),  # with t_ns, which names a row, and the number of its cycle
        *_scalars(SETPOINT, "setpoint_"),
        *_scalars(COMMAND),
        ("lateness_ns", "i8"),  # wake-up behind its grid point
        ("tick_ns", "i8"),  # estimate + law + guard
        ("sync_end_t_ns", "i8"),  # end of the SYNC frame that latches this cycle's command
        ("first_arrival_t_ns", "i8"),  # when the cycle's first sensor bytes could be read ...
        ("first_bytes_count", "i8"),  # ... and how many they were
        ("sensor_arrival_t_ns", "i8"),  # when the newest could
        ("sensor_bytes_count", "i8"),
        ("sensor_bytes", "u1", (SENSOR_BYTES_COUNT,)),  # raw, as read in this cycle: replay starts here
        *(field for name in FRAMES for field in _frame(name)),
        ("macro_controlword", "i8"),
        ("micro_controlword", "i8"),
        ("macro_rpdo", "u1", (FRAME_BYTES_COUNT,)),  # as sent; the mapping in the manifest says how many bytes count
        ("micro_rpdo", "u1", (FRAME_BYTES_COUNT,)),
        ("macro_counts", "f8"),  # raw sensor counts, before air index and zero
        ("end_counts", "f8"),
        ("air_index_ratio", "f8"),
        *((name, "f8") for name in ESTIMATES),
        ("law_number", "i8"),  # place in stagectl.tick.LAWS
        ("segment_number", "i8"),  # the segment that the setpoint comes from
        ("update_number", "i8"),  # the newest change of zeros and belief; the event of that number holds the values
        ("homing_id", "i8"),  # the homing that positions refer to; 0 = not homed
        ("samples_lost", "i8"),  # sensor samples lost since the run began
        ("cycles_missed", "i8"),  # grid points skipped since the run began
        *((name, "f8") for name in EXTRA_CHANNELS),
    ]
)
"""One cycle."""


def absent_value(name: str) -> float | int:
    """Return what a ROW field holds where nothing was known: nan, -1 for the length of a frame, else 0."""
    if name.removesuffix("_count") in FRAMES:
        return -1 if name.endswith("_count") else 0
    return float("nan") if ROW[name] == np.float64 else 0


def new_rows(count: int = 1) -> np.ndarray:
    """Make `count` rows in which nothing is known yet (`absent_value`), shape (count,)."""
    rows = np.zeros(count, ROW)
    for name in ROW.names or ():
        value = absent_value(name)
        if value != 0:
            rows[name] = value
    return rows


def layout_hash(dtype: np.dtype) -> str:
    """Hash names, types, order and offsets of a structured dtype: 64 hex digits."""
    fields = [(name, str(field[0]), field[1]) for name, field in (dtype.fields or {}).items()]
    return hashlib.sha256(repr((fields, dtype.itemsize)).encode()).hexdigest()
