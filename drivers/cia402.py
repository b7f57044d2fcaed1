"""CiA 402 as a pure table: drive states, controlwords, modes, homing, emergency codes.

Pure; knows no bus and no clock. Sources: CiA 402-2 (IEC 61800-7-201) tables for statusword,
controlword and transitions; error codes from CiA 402-2 and CiA 301.
"""

from enum import IntEnum

from stagectl.errors import LinkError, RequestError

# Object indices, by the name that CiA 301 / CiA 402 give them.
DEVICE_TYPE = 0x1000
COB_ID_SYNC = 0x1005
COMMUNICATION_CYCLE_PERIOD = 0x1006  # us
COB_ID_EMCY = 0x1014
CONSUMER_HEARTBEAT_TIME = 0x1016
PRODUCER_HEARTBEAT_TIME = 0x1017
IDENTITY = 0x1018
RPDO_COMMUNICATION = 0x1400
RPDO_MAPPING = 0x1600
TPDO_COMMUNICATION = 0x1800
TPDO_MAPPING = 0x1A00
ABORT_CONNECTION_OPTION_CODE = 0x6007
ERROR_CODE = 0x603F
CONTROLWORD = 0x6040
STATUSWORD = 0x6041
QUICK_STOP_OPTION_CODE = 0x605A
FAULT_REACTION_OPTION_CODE = 0x605E
MODES_OF_OPERATION = 0x6060
MODES_OF_OPERATION_DISPLAY = 0x6061
POSITION_ACTUAL_VALUE = 0x6064
TARGET_TORQUE = 0x6071
MAX_TORQUE = 0x6072
MOTOR_RATED_CURRENT = 0x6075  # mA
MOTOR_RATED_TORQUE = 0x6076  # 1e-3 N on a linear motor
TORQUE_ACTUAL_VALUE = 0x6077
TARGET_POSITION = 0x607A
HOME_OFFSET = 0x607C
QUICK_STOP_DECELERATION = 0x6085  # counts/s^2
POSITION_ENCODER_RESOLUTION = 0x608F
HOMING_METHOD = 0x6098
HOMING_SPEEDS = 0x6099  # counts/s
HOMING_ACCELERATION = 0x609A  # counts/s^2
TORQUE_OFFSET = 0x60B2
INTERPOLATION_TIME_PERIOD = 0x60C2
DIGITAL_INPUTS = 0x60FD
SUPPORTED_DRIVE_MODES = 0x6502

MODE_HOMING = 6

ABORT_CONNECTION_QUICK_STOP = 3  # 0x6007: a lost connection is answered as the quick-stop command is

QUICK_STOP_OFF = 0  # 0x605A: power off at once, the axis coasts
QUICK_STOP_RAMP_THEN_OFF = 2  # ramp 0x6085, then Switch on disabled
QUICK_STOP_RAMP_THEN_HOLD = 6  # ramp 0x6085, then Quick stop active: holds standstill

STATUS_VOLTAGE_ENABLED = 1 << 4
STATUS_WARNING = 1 << 7
STATUS_REMOTE = 1 << 9
STATUS_TARGET_REACHED = 1 << 10
STATUS_INTERNAL_LIMIT = 1 << 11
STATUS_FOLLOWS_COMMAND = 1 << 12  # CSP, CST: the drive follows the cyclic command value
STATUS_FOLLOWING_ERROR = 1 << 13  # CSP

INPUT_NEGATIVE_LIMIT = 1 << 0  # 0x60FD bits 0..3 are CiA 402's, 16 is the meaning our EDS files give it
INPUT_POSITIVE_LIMIT = 1 << 1
INPUT_HOME_SWITCH = 1 << 2
INPUT_INTERLOCK = 1 << 3  # safe torque off
INPUT_AIR_PRESSURE = 1 << 16

DISABLE_VOLTAGE = 0x0000
QUICK_STOP = 0x0002
SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE_OPERATION = 0x000F
FAULT_RESET = 0x0080  # acts on its rising edge: the controlword before must have bit 7 low
HOMING_START = 0x0010  # or-ed to ENABLE_OPERATION in homing mode; low again aborts the homing
HALT = 0x0100


class State(IntEnum):
    """States of the power drive system."""

    NOT_READY = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class Homing(IntEnum):
    """What statusword bits 13, 12 and 10 mean in homing mode."""

    RUNNING = 0
    NOT_STARTED = 1  # or interrupted
    ATTAINED_MOVING = 2  # attained, the target not yet reached
    ATTAINED = 3
    ERROR_MOVING = 4
    ERROR = 5


# mask, value, state; bit 4 (voltage enabled) takes no part in the coding.
_PATTERNS = (
    (0x4F, 0x00, State.NOT_READY),
    (0x4F, 0x40, State.SWITCH_ON_DISABLED),
    (0x6F, 0x21, State.READY_TO_SWITCH_ON),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.OPERATION_ENABLED),
    (0x6F, 0x07, State.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, State.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, State.FAULT),
)


def _state_table() -> tuple[State, ...]:
    """Spread the patterns over the seven bits that code the state, so that a look-up is one index."""
    table = [State.NOT_READY] * 128
    for bits in range(128):
        for mask, value, state in _PATTERNS:
            if bits & mask == value:
                table[bits] = state
    return tuple(table)


_STATES = _state_table()


def state_of(statusword: int) -> State:
    """Return the state that a statusword shows.

    A pattern that CiA 402 doesn't define reads as NOT_READY: nothing is ever enabled from there,
    and a watcher sees that the drive left Operation enabled.
    """
    return _STATES[statusword & 0x7F]


# One row per target, one column per state in the order of `State`.
_CONTROLWORDS = {
    State.SWITCH_ON_DISABLED: (DISABLE_VOLTAGE,) * 8,
    # Bit 1 high, bit 2 low is a quick stop from every state that can move, and walks a drive that
    # is merely switched on down to Switch on disabled; it enables nothing anywhere.
    State.QUICK_STOP_ACTIVE: (QUICK_STOP,) * 8,
    State.OPERATION_ENABLED: (
        DISABLE_VOLTAGE,  # NOT_READY: the drive leaves it by itself
        SHUTDOWN,
        SWITCH_ON,
        ENABLE_OPERATION,
        ENABLE_OPERATION,
        QUICK_STOP,  # a wish to move never ends a quick stop: ask for SWITCH_ON_DISABLED first
        DISABLE_VOLTAGE,  # FAULT_REACTION_ACTIVE: the drive leaves it by itself
        DISABLE_VOLTAGE,  # FAULT: left only by an explicit FAULT_RESET; bit 7 low makes its edge possible
    ),
}
_ROWS = tuple(_CONTROLWORDS.get(target) for target in State)  # an index costs a third of a dict look-up by enum


def controlword(state: State, target: State) -> int:
    """Return the next controlword on the way from `state` to `target`.

    Targets: SWITCH_ON_DISABLED, OPERATION_ENABLED, QUICK_STOP_ACTIVE; another raises RequestError.
    A stop never walks up. A quick stop and a fault are left only on explicit request.
    """
    row = _ROWS[target]
    if row is None:
        raise RequestError(
            f"drive state {target!r} can't be a target; "
            "ask for SWITCH_ON_DISABLED, OPERATION_ENABLED or QUICK_STOP_ACTIVE"
        )
    return row[state]


def homing_of(statusword: int) -> Homing:
    """Return the progress of homing (statusword bits 13 error, 12 attained, 10 target reached or standstill)."""
    reached = bool(statusword & STATUS_TARGET_REACHED)
    if statusword & (1 << 13):
        return Homing.ERROR if reached else Homing.ERROR_MOVING
    if statusword & (1 << 12):
        return Homing.ATTAINED if reached else Homing.ATTAINED_MOVING
    return Homing.NOT_STARTED if reached else Homing.RUNNING


def decode_emergency(payload: bytes) -> tuple[int, int, bytes]:
    """Return (error code, error register, vendor bytes) of an EMCY payload.

    CiA 301 wants 8 bytes; a drive that sends fewer still has something to say, so two are enough
    (register 0 where it is missing). Fewer raise LinkError.
    """
    if len(payload) < 2:
        raise LinkError(
            f"emergency message of {len(payload)} bytes, at least 2 carry its code; check the drive's firmware"
        )
    register = payload[2] if len(payload) > 2 else 0
    return payload[0] | payload[1] << 8, register, bytes(payload[3:8])


EMERGENCY_TEXT = {
    0x0000: "error reset, no error",
    0x1000: "generic error",
    0x2310: "continuous overcurrent at the motor output",
    0x2320: "short circuit or earth leakage at the motor output",
    0x2330: "earth leakage at the motor output",
    0x2340: "short circuit at the motor output",
    0x3110: "mains overvoltage",
    0x3120: "mains undervoltage",
    0x3130: "mains phase failure",
    0x3210: "DC link overvoltage",
    0x3220: "DC link undervoltage",
    0x4210: "drive too hot",
    0x4310: "motor too hot",
    0x5112: "24 V supply low",
    0x5530: "non-volatile memory",
    0x6010: "software reset (watchdog)",
    0x6100: "internal software",
    0x6320: "parameter error",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation",
    0x7300: "sensor",
    0x7305: "encoder 1",
    0x7306: "encoder 2",
    0x8110: "CAN overrun, messages lost",
    0x8120: "CAN in error passive mode",
    0x8130: "heartbeat or life guard lost",
    0x8140: "recovered from bus-off",
    0x8150: "COB-ID collision",
    0x8200: "protocol error",
    0x8210: "PDO too short, not processed",
    0x8220: "PDO longer than its mapping",
    0x8240: "unexpected SYNC length",
    0x8250: "RPDO deadline missed",
    0x8300: "torque control",
    0x8311: "excess torque",
    0x8400: "velocity control",
    0x8500: "position control",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "synchronisation lost",
    0x9000: "external error",
    0xF001: "deceleration",
    0xFF00: "manufacturer specific",
}
"""Text of common error codes (CiA 402-2, CiA 301)."""

_EMERGENCY_CLASS_TEXT = {
    0x0: "error reset, no error",
    0x1: "generic error",
    0x2: "current",
    0x3: "voltage",
    0x4: "temperature",
    0x5: "device hardware",
    0x6: "device software",
    0x7: "additional modules",
    0x8: "monitoring",
    0x9: "external error",
    0xF: "additional functions or manufacturer specific",
}


def emergency_text(code: int) -> str:
    """Return the text of an error code, or of its class where the code itself isn't in the table."""
    text = EMERGENCY_TEXT.get(code)
    if text is None:
        text = EMERGENCY_TEXT[0] if code < 0x100 else _EMERGENCY_CLASS_TEXT.get(code >> 12, "reserved by CiA 301")
    return text
