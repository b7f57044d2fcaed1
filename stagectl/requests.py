"""What supervisor and servo say to each other: two fixed-size blocks, each with one writer.

Pure; knows no memory and no clock.
"""

from enum import IntEnum

import numpy as np

from stagectl.plant import PLANT_PARAMETERS


class Mode(IntEnum):
    """What the supervisor asks of the servo."""

    IDLE = 0  # drives without power
    HOME_DRIVE = 1  # the macro's drive runs its own homing; the micro stays without power
    TRACK = 2  # enable, then follow segments under a law
    STOP = 3  # bring the stage to rest under the law, then take the power away
    RESET = 4  # acknowledge a fault; enables nothing
    EXIT = 5  # end the servo; a moving stage is brought to rest first
    RELEASE = 6  # take the power away from a stage that stopped by itself; acknowledges nothing


class Phase(IntEnum):
    """What the servo is doing; the `run_phase` of a row."""

    IDLE = 0
    ENABLING = 1
    HOMING_DRIVE = 2
    HOMED_DRIVE = 3  # the macro's drive holds where it found its index, until something else than HOME_DRIVE is asked
    TRACKING = 4
    STOPPING = 5  # under the law, towards rest
    QUICK_STOP = 6  # by the drives
    STOPPED = 7  # a run ended by itself: `stop` says why; left when acknowledged
    GUIDED_STOP = 8  # the macro by its drive, the micro still under its law so that it keeps off its stops


TICKING = (Phase.TRACKING, Phase.STOPPING, Phase.GUIDED_STOP)
"""Phases in which the law runs every cycle."""

RESTING = (Phase.IDLE, Phase.HOMED_DRIVE, Phase.STOPPED)
"""Phases in which nothing is asked to move."""

TEXT_BYTES_COUNT = 256

REQUEST = np.dtype(
    [
        ("counter", "i8"),  # alive: changes all the time
        ("mode", "i8"),  # Mode
        ("stop", "i8"),  # with Mode.STOP, the Stop that the supervisor has a reason for; NONE = the operator
        ("law_number", "i8"),  # place in stagectl.tick.LAWS
        ("segment_number", "i8"),  # a change starts the segment
        ("segment_start", "i8"),  # its first row in the segment table
        ("segment_rows", "i8"),
        ("segment_at_row", "i8"),  # it goes on within the segment under way, behind that many rows; 0 = at once
        ("lease_until_t_ns", "i8"),
        ("acknowledge_number", "i8"),
        ("update_number", "i8"),  # a change takes over zeros and belief
        ("homing_id", "i8"),
        ("macro_zero_counts", "f8"),
        ("end_zero_counts", "f8"),
        *((f"belief_{name}", "f8") for name in PLANT_PARAMETERS.names or ()),
    ]
)
"""Supervisor to servo."""

STATUS = np.dtype(
    [
        ("rows", "i8"),  # cycles done
        ("t_ns", "i8"),
        ("sample_t_ns", "i8"),  # of the newest sample of the interferometer, 0 before the first one
        ("phase", "i8"),
        ("stop", "i8"),  # Stop
        ("segment_number", "i8"),  # the segment under way or done
        ("segment_left_rows", "i8"),
        ("update_number", "i8"),
        ("sensor_ready", "i8"),  # sample clock locked, both axes valid
        ("reference_lost", "i8"),
        ("macro_statusword", "i8"),
        ("micro_statusword", "i8"),
        ("macro_counts", "f8"),
        ("end_counts", "f8"),
        ("air_index_ratio", "f8"),  # in use
        ("macro_position_m", "f8"),
        ("end_position_m", "f8"),
        ("macro_encoder_m", "f8"),
        ("setpoint_position_m", "f8"),
        ("setpoint_relative_position_m", "f8"),
        ("error_m", "f8"),  # of the newest cycle whose own line was there
        ("left_m", "f8"),
        ("right_m", "f8"),
        ("left_stiffness_n_per_m", "f8"),
        ("right_stiffness_n_per_m", "f8"),
        ("left_sd_m", "f8"),
        ("right_sd_m", "f8"),
        ("left_stiffness_sd_n_per_m", "f8"),
        ("right_stiffness_sd_n_per_m", "f8"),
        ("emergency", "i8"),
        ("inputs", "i8"),
        ("missed_cycles", "i8"),
        ("lost_samples", "i8"),
        ("discarded_bytes", "i8"),  # sensor bytes that belong to no frame
        ("text", "u1", (TEXT_BYTES_COUNT,)),  # what a stop without numbers has to say, UTF-8
    ]
)
"""Servo to supervisor, newest state only; the ring holds every cycle."""
