"""The bus between processes without a kernel module: an AF_UNIX hub that relays CAN frames.

Packets: a frame is exactly 16 bytes, Linux `struct can_frame` ("=IB3x8s"); "FILT" + n ("=II") sets the filters
of a client as in SocketCAN; "STAT" is answered with "STAT" + "=QQ" (frames relayed to, frames lost for this
client); "RIG " + JSON goes to the owner. A full reader loses frames, which are counted; nobody waits.
"""

import contextlib
import errno
import os
import socket
import stat
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from stagectl.errors import LinkError

ERROR_FLAG = 0x2000_0000
FRAME = struct.Struct("=IB3x8s")

_FILTER = struct.Struct("=II")
_STATISTICS = struct.Struct("=4sQQ")
_PACKET_LIMIT_BYTES = 65536
_BACKLOG = 16
_BUS_LOSES = (errno.ENETDOWN, errno.ENOBUFS)

Received = tuple[int, int, bytes]
"""A frame from a client: (the client's descriptor, id with flags, payload)."""

Answer = Callable[[bytes], bytes]


@dataclass(slots=True)
class _Client:
    link: socket.socket
    filters: list[tuple[int, int]] | None = None  # None = everything passes
    relayed_count: int = 0
    lost_count: int = 0
    is_bus: bool = False  # an interface that others share, no process: it may be down, and up again
    passes: dict[int, bool] = field(default_factory=dict)  # id -> does it match; filled as ids come by

    def wants(self, can_id: int) -> bool:
        """Apply the filters to an id."""
        if self.filters is None:
            return True
        known = self.passes.get(can_id)
        if known is None:
            known = any(_matches(can_id, wanted, mask) for wanted, mask in self.filters)
            self.passes[can_id] = known
        return known


def _matches(can_id: int, wanted: int, mask: int) -> bool:
    """SocketCAN's rule; error frames pass filters that name the error flag only."""
    if can_id & ERROR_FLAG and not mask & ERROR_FLAG:
        return False
    return (can_id & mask) == (wanted & mask)


class Hub:
    """The server; its owner waits on `filenos` and calls `read` for those that are ready."""

    def __init__(self, path: str | Path, answer: Answer | None = None) -> None:
        self.path = Path(path)
        self._answer = answer
        self._clients: dict[int, _Client] = {}
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            self._bind()
        except OSError as error:
            self._server.close()
            raise LinkError(f"{path}: the CAN hub can't listen there: {error}; choose another --socket path") from error

    def _bind(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISSOCK(self.path.stat().st_mode) and not self._is_served():
                self.path.unlink()  # left behind by a hub that was killed
        self._server.bind(str(self.path))
        os.chmod(self.path, 0o600)
        self._server.listen(_BACKLOG)

    def _is_served(self) -> bool:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) as probe:
            return probe.connect_ex(str(self.path)) not in (errno.ECONNREFUSED, errno.ENOENT)

    def filenos(self) -> list[int]:
        """Return the descriptors to wait on."""
        return [self._server.fileno(), *self._clients]

    @property
    def clients_count(self) -> int:
        """How many clients are connected."""
        return len(self._clients)

    @property
    def is_on_bus(self) -> bool:
        """Whether a CAN interface is joined."""
        return any(client.is_bus for client in self._clients.values())

    def join(self, bus: socket.socket) -> None:
        """Relay to and from a non-blocking raw socket of a CAN interface, too, until the interface is gone."""
        self._clients[bus.fileno()] = _Client(bus, is_bus=True)

    def read(self, fileno: int) -> list[Received]:
        """Serve a readable descriptor until it is empty; return the frames that its client sent."""
        if fileno == self._server.fileno():
            self._accept()
            return []
        client = self._clients.get(fileno)
        frames: list[Received] = []
        while client is not None:
            try:
                packet = client.link.recv(_PACKET_LIMIT_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if client.is_bus and error.errno == errno.ENETDOWN:
                    break
                packet = b""
            if not packet:
                self._drop(fileno)
                break
            if len(packet) == FRAME.size:
                can_id, length, data = FRAME.unpack(packet)
                frames.append((fileno, can_id, data[: min(length, 8)]))
            else:
                self._command(client, packet)
        return frames

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                link, _ = self._server.accept()
                link.setblocking(False)
                self._clients[link.fileno()] = _Client(link)

    def _command(self, client: _Client, packet: bytes) -> None:
        """Obey a packet that is no frame; an unknown one is ignored."""
        kind, rest = packet[:4], packet[4:]
        if kind == b"FILT" and len(rest) % _FILTER.size == 0:
            client.filters = list(_FILTER.iter_unpack(rest))
            client.passes.clear()
        elif kind == b"STAT":
            self._put(client, _STATISTICS.pack(b"STAT", client.relayed_count, client.lost_count))
        elif kind == b"RIG " and self._answer is not None:
            self._put(client, b"RIG " + self._answer(rest))

    def relay(self, can_id: int, payload: bytes, sender: int = -1) -> None:
        """Send a frame to every client that wants it, its sender excepted."""
        packet = FRAME.pack(can_id, len(payload), payload)
        for fileno, client in list(self._clients.items()):
            if fileno != sender and client.wants(can_id):
                if self._put(client, packet):
                    client.relayed_count += 1
                else:
                    client.lost_count += 1

    def _put(self, client: _Client, packet: bytes) -> bool:
        """Send without waiting; False when the reader is full or gone."""
        try:
            client.link.send(packet)
        except BlockingIOError:
            return False
        except OSError as error:
            if not (client.is_bus and error.errno in _BUS_LOSES):
                self._drop(client.link.fileno())
            return False
        return True

    def _drop(self, fileno: int) -> None:
        client = self._clients.pop(fileno, None)
        if client is not None:
            client.link.close()

    def close(self) -> None:
        """Disconnect everybody and remove the socket."""
        for fileno in list(self._clients):
            self._drop(fileno)
        self._server.close()
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()
