"""The AF_UNIX hub as a python-can interface (entry point `stagectl-hub`, channel = socket path).

For the CANopen master; the servo speaks to the hub by `drivers.can_bus` without python-can.
"""

import select
import time
from typing import Any

import can

from drivers.can_frame import ERROR_FLAG, EXTENDED_FLAG, FRAME, REMOTE_FLAG
from drivers.hub_socket import connect_hub, filter_packet

_ID_MASK = 0x1FFFFFFF


class HubBus(can.BusABC):
    """One client of the hub; never hears its own frames."""

    def __init__(self, channel: str, can_filters: Any = None, **kwargs: Any):
        """Connect to the socket at path `channel`; LinkError where nothing listens there."""
        self.channel_info = f"stagectl hub {channel}"
        self._socket = connect_hub(channel)
        self._socket.setblocking(False)
        self._filters_sent = False
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; a full queue raises CanOperationError after `timeout` s (None: at once)."""
        if not self._await(timeout or 0.0, write=True):
            raise can.CanOperationError("transmit queue of the hub is full")
        can_id = msg.arbitration_id
        can_id |= EXTENDED_FLAG if msg.is_extended_id else 0
        can_id |= REMOTE_FLAG if msg.is_remote_frame else 0
        can_id |= ERROR_FLAG if msg.is_error_frame else 0
        try:
            self._socket.send(FRAME.pack(can_id, msg.dlc, bytes(msg.data)))
        except OSError as error:
            raise can.CanOperationError(f"hub: {error.strerror}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._await(timeout, write=False):
            return None, False
        try:
            packet = self._socket.recv(64)
        except BlockingIOError:
            return None, False
        except OSError as error:
            raise can.CanOperationError(f"hub: {error.strerror}", error.errno) from error
        if not packet:
            raise can.CanOperationError("hub: the other end closed")
        if len(packet) != FRAME.size:
            return None, False  # an answer to a question about statistics
        can_id, length, data = FRAME.unpack(packet)
        message = can.Message(
            timestamp=time.monotonic(),
            arbitration_id=can_id & _ID_MASK,
            is_extended_id=bool(can_id & EXTENDED_FLAG),
            is_remote_frame=bool(can_id & REMOTE_FLAG),
            is_error_frame=bool(can_id & ERROR_FLAG),
            dlc=length,
            data=data[:length],
            channel=self.channel_info,
        )
        # Frames that were under way before the hub heard of the filters are filtered again by python-can;
        # an error frame's id is no id, so those pass.
        return message, message.is_error_frame

    def _apply_filters(self, filters: Any) -> None:
        if not filters:
            if self._filters_sent:
                self._socket.send(filter_packet([(0, 0)]))
            return
        pairs = [(ERROR_FLAG, ERROR_FLAG)]
        for wanted in filters:
            can_id, mask = wanted["can_id"], wanted["can_mask"] | ERROR_FLAG
            if "extended" in wanted:
                mask |= EXTENDED_FLAG
                can_id |= EXTENDED_FLAG if wanted["extended"] else 0
            pairs.append((can_id, mask))
        self._socket.send(filter_packet(pairs))
        self._filters_sent = True

    def _await(self, timeout_s: float | None, write: bool) -> bool:
        """Wait until the socket can be read or written; poll, because select ends at descriptor 1023."""
        poller = select.poll()
        try:
            poller.register(self._socket, select.POLLOUT if write else select.POLLIN)
            return bool(poller.poll(None if timeout_s is None else timeout_s * 1000.0))
        except (OSError, ValueError) as error:
            raise can.CanOperationError(f"hub: {error}") from error

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Stop periodic tasks and close the socket."""
        super().shutdown()
        self._socket.close()
