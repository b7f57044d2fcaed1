"""The AF_UNIX socket to the software rig's CAN hub: connecting, filters, statistics.

Packets of 16 bytes are frames (`drivers.can_frame`); what begins with FILT or STAT is for the hub itself.
"""

import socket
from collections.abc import Iterable

from drivers.can_frame import FILTER, STATISTICS
from stagectl.errors import LinkError

_PACKET_LIMIT_BYTES = 64
_STATISTICS_TIMEOUT_S = 1.0


def connect_hub(path: str) -> socket.socket:
    """Connect to the hub's socket; LinkError where nothing listens there."""
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        opened.connect(path)
    except OSError as error:
        opened.close()
        raise LinkError(
            f"CAN hub {path}: {error.strerror or error}; start the rig (python -m sim_backend ... --socket {path}) "
            "or correct can.channel"
        ) from error
    return opened


def filter_packet(filters: Iterable[tuple[int, int]]) -> bytes:
    """Return the packet that asks the hub for frames with `id & mask` equal to one of `filters`; none = nothing."""
    return b"FILT" + b"".join(FILTER.pack(can_id & mask, mask) for can_id, mask in filters)


def hub_statistics(opened: socket.socket) -> tuple[int, int]:
    """Ask the hub for (frames relayed, frames lost for this client); frames that arrive meanwhile are dropped.

    For a socket of its own, without traffic; LinkError where no answer comes within a second.
    """
    opened.settimeout(_STATISTICS_TIMEOUT_S)
    try:
        opened.send(b"STAT")
        while packet := opened.recv(_PACKET_LIMIT_BYTES):
            if packet.startswith(b"STAT"):
                relayed_count, lost_count = STATISTICS.unpack(packet[4:])
                return relayed_count, lost_count
    except OSError as error:
        raise LinkError(f"CAN hub: {error.strerror or error}; is the rig still running?") from error
    raise LinkError("CAN hub: the other end closed; start the rig again, then arm again")
