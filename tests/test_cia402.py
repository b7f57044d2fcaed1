"""The CiA 402 table: statuswords and controlwords are literals of the standard's tables."""

import pytest

from drivers import cia402
from drivers.cia402 import Homing, State, controlword, state_of
from stagectl.errors import LinkError, RequestError
from stagectl.signals import MODES

# CiA 402-2, statusword coding: x = any bit. Both fillings of the free bits of every pattern.
STATUSWORDS = [
    ("xxxx xxxx x0xx 0000", 0x0000, 0xFFB0, State.NOT_READY),
    ("xxxx xxxx x1xx 0000", 0x0040, 0xFFF0, State.SWITCH_ON_DISABLED),
    ("xxxx xxxx x01x 0001", 0x0021, 0xFFB1, State.READY_TO_SWITCH_ON),
    ("xxxx xxxx x01x 0011", 0x0023, 0xFFB3, State.SWITCHED_ON),
    ("xxxx xxxx x01x 0111", 0x0027, 0xFFB7, State.OPERATION_ENABLED),
    ("xxxx xxxx x00x 0111", 0x0007, 0xFF97, State.QUICK_STOP_ACTIVE),
    ("xxxx xxxx x0xx 1111", 0x000F, 0xFFBF, State.FAULT_REACTION_ACTIVE),
    ("xxxx xxxx x0xx 1000", 0x0008, 0xFFB8, State.FAULT),
]


@pytest.mark.parametrize(("pattern", "all_zero", "all_one", "state"), STATUSWORDS)
def test_statusword_pattern_names_its_state(pattern, all_zero, all_one, state):
    bits = pattern.replace(" ", "")
    assert int(bits.replace("x", "0"), 2) == all_zero
    assert int(bits.replace("x", "1"), 2) == all_one
    assert state_of(all_zero) is state
    assert state_of(all_one) is state


@pytest.mark.parametrize("statusword", [0x0001, 0x0002, 0x0047, 0x0025, 0x006F, 0x0009])
def test_undefined_pattern_is_never_a_state_that_may_move(statusword):
    assert state_of(statusword) is State.NOT_READY


def test_real_drive_statuswords():
    # As drives show them: remote (bit 9), voltage enabled (bit 4), target reached (bit 10), follows command (bit 12).
    assert state_of(0x0250) is State.SWITCH_ON_DISABLED
    assert state_of(0x0231) is State.READY_TO_SWITCH_ON
    assert state_of(0x0233) is State.SWITCHED_ON
    assert state_of(0x1637) is State.OPERATION_ENABLED
    assert state_of(0x0617) is State.QUICK_STOP_ACTIVE
    assert state_of(0x0218) is State.FAULT


# CiA 402-2, commands: Shutdown 0xxx x110, Switch on 0xxx 0111, Enable operation 0xxx 1111,
# Disable voltage 0xxx xx0x, Quick stop 0xxx x01x, Fault reset: rising edge of bit 7.
ORDER = [
    State.NOT_READY,
    State.SWITCH_ON_DISABLED,
    State.READY_TO_SWITCH_ON,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
    State.QUICK_STOP_ACTIVE,
    State.FAULT_REACTION_ACTIVE,
    State.FAULT,
]


@pytest.mark.parametrize(
    ("target", "words"),
    [
        (State.OPERATION_ENABLED, [0x00, 0x06, 0x07, 0x0F, 0x0F, 0x02, 0x00, 0x00]),
        (State.QUICK_STOP_ACTIVE, [0x02, 0x02, 0x02, 0x02, 0x02, 0x02, 0x02, 0x02]),
        (State.SWITCH_ON_DISABLED, [0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00]),
    ],
)
def test_controlword_table(target, words):
    assert [controlword(state, target) for state in ORDER] == words


@pytest.mark.parametrize("target", [State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED])
@pytest.mark.parametrize("state", list(State))
def test_a_stop_never_walks_up(state, target):
    """No command that raises the state: Shutdown x110, Switch on x111, Enable operation 1111 all have bit 2 high."""
    word = controlword(state, target)
    assert word & 0x04 == 0
    assert word & cia402.FAULT_RESET == 0


@pytest.mark.parametrize("state", list(State))
def test_fault_reset_is_never_part_of_a_walk(state):
    assert controlword(state, State.OPERATION_ENABLED) & 0x80 == 0
    assert cia402.FAULT_RESET == 0x80


@pytest.mark.parametrize("target", [State.SWITCHED_ON, State.FAULT, State.NOT_READY])
def test_other_targets_are_refused(target):
    with pytest.raises(RequestError, match="can't be a target"):
        controlword(State.SWITCHED_ON, target)


def test_enable_walk_of_a_drive_that_follows():
    """The walk against the drive's own transitions 2, 3, 4 of CiA 402-2."""
    drive = {0x06: 0x0231, 0x07: 0x0233, 0x0F: 0x0237}
    statusword, sent = 0x0250, []
    while state_of(statusword) is not State.OPERATION_ENABLED:
        sent.append(controlword(state_of(statusword), State.OPERATION_ENABLED))
        statusword = drive[sent[-1]]
    assert sent == [0x06, 0x07, 0x0F]


# CiA 402-2, homing mode: bit 13 error, bit 12 attained, bit 10 target reached.
@pytest.mark.parametrize(
    ("statusword", "homing"),
    [
        (0x0237, Homing.RUNNING),
        (0x0637, Homing.NOT_STARTED),
        (0x1237, Homing.ATTAINED_MOVING),
        (0x1637, Homing.ATTAINED),
        (0x2237, Homing.ERROR_MOVING),
        (0x2637, Homing.ERROR),
    ],
)
def test_homing_bits(statusword, homing):
    assert cia402.homing_of(statusword) is homing


def test_modes_and_objects():
    assert (cia402.MODE_HOMING, MODES["position"], MODES["torque"]) == (6, 8, 10)
    assert cia402.ENABLE_OPERATION | cia402.HOMING_START == 0x1F
    assert (cia402.CONTROLWORD, cia402.STATUSWORD, cia402.TARGET_TORQUE) == (0x6040, 0x6041, 0x6071)


def test_emergency_heartbeat_lost():
    # CiA 301: code 0x8130 little endian, register bit 4 (communication) = 0x10, five vendor bytes.
    payload = bytes.fromhex("30 81 10 01 02 03 04 05")
    assert cia402.decode_emergency(payload) == (0x8130, 0x10, b"\x01\x02\x03\x04\x05")
    assert cia402.emergency_text(0x8130) == "heartbeat or life guard lost"


def test_short_emergency_keeps_its_code():
    assert cia402.decode_emergency(bytes.fromhex("20 23")) == (0x2320, 0, b"")
    assert cia402.decode_emergency(bytes.fromhex("20 23 02")) == (0x2320, 2, b"")
    with pytest.raises(LinkError, match="1 bytes"):
        cia402.decode_emergency(b"\x20")


def test_emergency_text_falls_back_to_its_class():
    assert cia402.emergency_text(0x8250) == "RPDO deadline missed"
    assert cia402.emergency_text(0x2399) == "current"
    assert cia402.emergency_text(0x0000) == "error reset, no error"
    assert cia402.emergency_text(0xB001) == "reserved by CiA 301"
