"""What arming agreed with a drive, read again before it gets power.

A drive that restarted has forgotten all of it, and another master's tool may have changed it: the servo would then
take its frames for something else than they are. Knows no bus: it speaks through a master.
"""

import contextlib
from typing import TYPE_CHECKING

from drivers import cia402
from drivers.arming import DriveSettings, needed_objects
from stagectl.errors import DriveError

if TYPE_CHECKING:
    from drivers.canopen_master import Master

_CHANGING = (
    cia402.DEVICE_TYPE,
    cia402.IDENTITY,
    cia402.CONTROLWORD,
    cia402.STATUSWORD,
    cia402.MODES_OF_OPERATION,  # another one while it homes
    cia402.MODES_OF_OPERATION_DISPLAY,
)
_WHERE_IT_EXISTS = (
    (cia402.RPDO_COMMUNICATION, 5),
    (cia402.COMMUNICATION_CYCLE_PERIOD, 0),
    (cia402.TPDO_MAPPING + 1, 2),
)
_NMT_OPERATIONAL = 5

Agreed = dict[tuple[int, int], int]
"""Values by (index, subindex)."""


def read_agreed(master: "Master", drive: DriveSettings) -> Agreed:
    """Read every object that a configured drive must keep. Errors: LinkError, DriveError."""
    objects = [place for place in needed_objects(drive.mode, homes=False) if place[0] not in _CHANGING]
    agreed = {place: master.read(drive.node_id, *place) for place in objects}
    for place in _WHERE_IT_EXISTS:
        if master.has(drive.node_id, *place):
            with contextlib.suppress(DriveError):  # an EDS file may promise what a drive's firmware has not
                agreed[place] = master.read(drive.node_id, *place)
    return agreed


def changed(master: "Master", node_id: int, agreed: Agreed) -> str:
    """Say what a drive no longer keeps of what was agreed; empty where it keeps all. Errors: LinkError, DriveError."""
    state = master.nmt_state(node_id)
    if state not in (None, _NMT_OPERATIONAL):
        return f"node {node_id} left NMT operational (its state is {state}): it restarted, or another master stopped it"
    for (index, subindex), value in agreed.items():
        held = master.read(node_id, index, subindex)
        if held != value:
            return (
                f"node {node_id}: 0x{index:04X}:{subindex:02X} was 0x{value & 0xFFFF_FFFF:X} when the drive was "
                f"configured, and is 0x{held & 0xFFFF_FFFF:X}: it restarted, or another master wrote it"
            )
    return ""
