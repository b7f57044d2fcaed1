"""A fault as the operator meets it: what happened, when, the values, and what to do. Pure."""

from stagectl.errors import DriveError, LinkError, ProfileError, RecordError, StagectlError, TimingError
from stagectl.service.messages import Fault
from stagectl.service.states import State
from stagectl.signals import STOP_TEXT, Stop

_REMEDY = {
    Stop.TRAVEL: "acknowledge, then home",
    Stop.VELOCITY: "acknowledge; ask for a slower motion, or one that ends earlier",
    Stop.FORCE: "acknowledge; ask for less acceleration",
    Stop.FOLLOWING_ERROR: "look for what holds the stage, then acknowledge",
    Stop.MICRO_STROKE: "look for a force between the axes, acknowledge, then home",
    Stop.SENSOR_AGE: "check beams, interferometer and cable, acknowledge, then home",
    Stop.REFERENCE_LOST: "free the beams, acknowledge, then home",
    Stop.OVERRUN: "free the host of other work, then acknowledge",
    Stop.THERMAL: "let it cool, then acknowledge",
    Stop.LEASE: "look whether the client that held the lease still runs; acknowledge",
    Stop.COMMAND_NOT_FINITE: "keep the run for whoever maintains the law; acknowledge",
    Stop.DRIVE_FAULT: "read the drive, clear its cause, then acknowledge",
    Stop.DIGITAL_INPUT: "clear the switch or the interlock, then acknowledge",
    Stop.EMERGENCY: "read the drive, clear its cause, then acknowledge",
    Stop.LINK_SILENT: "check the drive's power and the CAN cable, then acknowledge",
    Stop.SUPERVISOR_SILENT: "free the host of other work, then acknowledge",
    Stop.COMMAND_LOST: "look for what else loads the bus, then acknowledge",
    Stop.MEASUREMENT_NOT_FINITE: "acknowledge, then home",
    Stop.LINK_LOST: "check the cable, then acknowledge: the stage is opened anew",
    Stop.HEARTBEAT_LOST: "check the drive's power and firmware, then acknowledge",
    Stop.RECORD_LOST: "free space on the disk of the runs, then acknowledge",
    Stop.HOMING_GIVEN_UP: "check index, limit switches and macro.homing, acknowledge, then home",
    Stop.ENCODER_LOST: "check the encoder, its cable and the drive, acknowledge, then home",
    Stop.DRIVE_MODE: "see who else on the bus writes to the drive, then acknowledge: the stage is opened anew",
    Stop.FORCE_UNHEEDED: "look for what delays frames on the bus, and what limits the drive, then acknowledge",
    Stop.SAMPLE_AHEAD: "check interferometer.rate_hz and the host's clock, then acknowledge",
}

_ERROR_REMEDY: dict[type[StagectlError], str] = {
    ProfileError: "correct the profile, then acknowledge",
    LinkError: "check cables and power, then acknowledge: the stage is opened anew",
    DriveError: "read the drive, clear its cause, then acknowledge; a profile that was corrected is read before that "
    "where the service is reloaded",
    TimingError: "free the host of other work, then acknowledge",
    RecordError: "free space or mend the permissions of the runs' folder, then acknowledge",
}

NEEDS_NEW_SERVO = (Stop.LINK_LOST, Stop.DRIVE_MODE)
"""A servo that has given its bus or port up doesn't open it again; a drive gets its mode back as it is configured."""


def of_stop(stop: Stop, detail: str, state: State, at: str, number: int) -> Fault:
    """Describe a stop that the servo made."""
    remedy = _REMEDY.get(stop, "acknowledge")
    return Fault(
        number=number, kind=stop.name, what=STOP_TEXT[stop], values=detail, remedy=remedy, at=at, state=state.value
    )


def of_lost_service(since: str, backend: str, state: State, at: str, number: int) -> Fault:
    """Describe the end of a service that brought its stage to no rest: killed, or the host went off."""
    return Fault(
        number=number,
        kind="SERVICE_LOST",
        what="the service ended while the stage had power",
        values=f"in power since {since}, backend {backend}",
        remedy="see that the stage stands, look into the journal for why it ended, acknowledge, then home",
        at=at,
        state=state.value,
    )


def of_error(error: StagectlError, state: State, at: str, number: int) -> Fault:
    """Describe what broke on this side."""
    remedy = _ERROR_REMEDY.get(type(error), "acknowledge")
    what = "the stage can't be worked with"
    return Fault(
        number=number,
        kind=type(error).__name__,
        what=what,
        values=str(error),
        remedy=remedy,
        at=at,
        state=state.value,
    )
