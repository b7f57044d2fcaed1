"""The power state machine of CiA 402 (IEC 61800-7-201, 6.2) as the drive sees it: a pure table.

Pure; knows no bus, no clock and no motor.
"""

from enum import IntEnum


class DriveState(IntEnum):
    """States of the power drive system; the values are ours, the words on the bus come from `STATUSWORD`."""

    NOT_READY = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


STATUSWORD = {
    DriveState.NOT_READY: 0x0000,
    DriveState.SWITCH_ON_DISABLED: 0x0040,
    DriveState.READY_TO_SWITCH_ON: 0x0021,
    DriveState.SWITCHED_ON: 0x0023,
    DriveState.OPERATION_ENABLED: 0x0027,
    DriveState.QUICK_STOP_ACTIVE: 0x0007,
    DriveState.FAULT_REACTION_ACTIVE: 0x000F,
    DriveState.FAULT: 0x0008,
}
"""Bits 0-3, 5 and 6 of 0x6041 in each state."""


class Order(IntEnum):
    """What bits 0-3 of the controlword 0x6040 ask for."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    ENABLE_OPERATION = 4


FAULT_RESET_BIT = 0x80
STAYING_OPTIONS = (5, 6, 7, 8)  # quick stop option codes 0x605A that stay in QUICK_STOP_ACTIVE


def order_of(controlword: int) -> Order:
    """Return the command in a controlword (bits 0-3; bit 7 is an edge and judged elsewhere)."""
    if not controlword & 0x02:
        return Order.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Order.QUICK_STOP
    if not controlword & 0x01:
        return Order.SHUTDOWN
    return Order.ENABLE_OPERATION if controlword & 0x08 else Order.SWITCH_ON


_S = DriveState
_TRANSITIONS = {
    (_S.SWITCH_ON_DISABLED, Order.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, Order.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, Order.ENABLE_OPERATION): _S.SWITCHED_ON,  # 3, then 4 at the next evaluation
    (_S.READY_TO_SWITCH_ON, Order.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, Order.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.SWITCHED_ON, Order.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.SWITCHED_ON, Order.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.SWITCHED_ON, Order.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, Order.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, Order.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.OPERATION_ENABLED, Order.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, Order.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.OPERATION_ENABLED, Order.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, Order.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
}


def next_state(state: DriveState, controlword: int, reset_edge: bool, quick_stop_option: int) -> DriveState:
    """Return the state after a controlword; `reset_edge` = bit 7 went from 0 to 1 with it."""
    if state == DriveState.FAULT:
        return DriveState.SWITCH_ON_DISABLED if reset_edge else state  # 15
    order = order_of(controlword)
    if state == DriveState.QUICK_STOP_ACTIVE and order == Order.ENABLE_OPERATION:
        return DriveState.OPERATION_ENABLED if quick_stop_option in STAYING_OPTIONS else state  # 16
    return _TRANSITIONS.get((state, order), state)
