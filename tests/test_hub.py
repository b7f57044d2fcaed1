"""The hub over real sockets: bytes of its packets, filters, full readers, leaving clients."""

import contextlib
import socket
import struct
import threading

import pytest

from sim_backend.hub import Hub
from stagectl.errors import LinkError

pytestmark = pytest.mark.real_time


class _Client:
    """A bare client: it knows the packets from the protocol's text, not from our classes."""

    def __init__(self, path) -> None:
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.link.connect(str(path))
        self.link.settimeout(2.0)

    def frame(self, text: str) -> None:
        self.link.send(bytes.fromhex(text))

    def has_none(self) -> bool:
        self.link.setblocking(False)
        try:
            self.link.recv(64)
        except BlockingIOError:
            return True
        finally:
            self.link.settimeout(2.0)
        return False


@pytest.fixture
def hub(tmp_path):
    served = Hub(tmp_path / "bus", answer=lambda request: b"heard " + request)
    yield served
    served.close()


@pytest.fixture
def connect(hub):
    clients = []

    def make() -> _Client:
        client = _Client(hub.path)
        clients.append(client)
        _serve(hub)
        return client

    yield make
    for client in clients:
        client.link.close()


def _serve(hub: Hub) -> None:
    """One turn of the owner's loop: read everybody, relay."""
    for fileno in hub.filenos():
        for sender, can_id, payload in hub.read(fileno):
            hub.relay(can_id, payload, sender)


# id 0x201, 4 bytes 0f 00 d2 04, as Linux lays out struct can_frame on a little-endian machine
RPDO = "01 02 00 00 04 00 00 00 0f 00 d2 04 00 00 00 00"
SYNC = "80 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00"


def test_a_frame_reaches_everybody_but_its_sender(hub, connect):
    first, second, third = connect(), connect(), connect()
    first.frame(RPDO)
    _serve(hub)
    assert second.link.recv(64) == bytes.fromhex(RPDO)
    assert third.link.recv(64) == bytes.fromhex(RPDO)
    assert first.has_none()


def test_filters_choose_by_id_and_mask(hub, connect):
    sender, servo, deaf = connect(), connect(), connect()
    servo.link.send(b"FILT" + struct.pack("=II", 0x080, 0x7FF))
    deaf.link.send(b"FILT")
    _serve(hub)
    sender.frame(RPDO)
    sender.frame(SYNC)
    _serve(hub)
    assert servo.link.recv(64) == bytes.fromhex(SYNC)
    assert servo.has_none()
    assert deaf.has_none()


def test_error_frames_pass_only_filters_that_name_them(hub, connect):
    with_errors, without = connect(), connect()
    with_errors.link.send(b"FILT" + struct.pack("=II", 0x20000000, 0x20000000))
    without.link.send(b"FILT" + struct.pack("=II", 0x040, 0x7FF))  # the low bits of bus-off
    _serve(hub)
    hub.relay(0x2000_0040, bytes(8))
    assert with_errors.link.recv(64)[:5] == bytes.fromhex("4000002008")
    assert without.has_none()


def test_a_full_reader_loses_frames_and_the_sender_never_waits(hub, connect):
    sleeper, awake = connect(), connect()
    for _ in range(3000):
        hub.relay(0x181, bytes(8))
        awake.link.recv(64)
    sleeper.link.settimeout(2.0)
    kept = 0
    while True:
        sleeper.link.setblocking(False)
        try:
            sleeper.link.recv(64)
        except BlockingIOError:
            break
        kept += 1
    sleeper.link.settimeout(2.0)
    sleeper.link.send(b"STAT")
    _serve(hub)
    kind, relayed, lost = struct.unpack("=4sQQ", sleeper.link.recv(64))
    assert kind == b"STAT"
    assert (relayed, relayed + lost) == (kept, 3000)
    assert lost > 0
    awake.link.send(b"STAT")
    _serve(hub)
    assert struct.unpack("=4sQQ", awake.link.recv(64)) == (b"STAT", 3000, 0)


def test_requests_to_the_owner_are_answered(hub, connect):
    client = connect()
    client.link.send(b"RIG {}")
    _serve(hub)
    assert client.link.recv(64) == b"RIG heard {}"


def test_nonsense_is_ignored(hub, connect):
    sender, reader = connect(), connect()
    sender.link.send(b"FILT\x01")
    sender.link.send(b"?" * 300)
    sender.frame(SYNC)
    _serve(hub)
    assert reader.link.recv(64) == bytes.fromhex(SYNC)


def test_a_client_that_leaves_is_forgotten(hub, connect):
    stays, leaves = connect(), connect()
    leaves.link.close()
    _serve(hub)
    assert hub.clients_count == 1
    hub.relay(0x080, b"")
    assert stays.link.recv(64) == bytes.fromhex(SYNC)


def test_a_live_hub_keeps_its_socket_and_a_dead_ones_is_taken_over(tmp_path):
    first = Hub(tmp_path / "bus")
    with pytest.raises(LinkError, match="--socket"):
        Hub(tmp_path / "bus")
    first._server.close()  # as after kill -9: the file stays
    second = Hub(tmp_path / "bus")
    second.close()
    assert not (tmp_path / "bus").exists()


def test_only_the_owner_may_open_the_socket(hub):
    assert hub.path.stat().st_mode & 0o777 == 0o600


def test_the_drivers_client_speaks_the_same_packets(hub):
    from drivers import can_bus

    done = threading.Event()
    thread = threading.Thread(target=_serve_until, args=(hub, done))
    thread.start()
    with contextlib.ExitStack() as stack:
        stack.callback(thread.join)
        stack.callback(done.set)
        bus = can_bus.open_cyclic("hub", str(hub.path), [0x181])
        stack.callback(bus.close)
        other = _Client(hub.path)
        stack.callback(other.link.close)
        other.link.send(b"STAT")
        assert other.link.recv(64)[:4] == b"STAT"  # the hub has it now: a frame sent before would have passed it by
        assert bus.send(0x201, bytes.fromhex("0f00d204"))
        assert other.link.recv(64) == bytes.fromhex(RPDO)
        other.frame(RPDO)  # filtered out
        other.frame("81 01 00 00 08 00 00 00 37 12 b9 7c 02 00 01 00")
        found = None
        while found is None:
            found = bus.receive()
        assert found == (0x181, bytes.fromhex("3712b97c02000100"))


def _serve_until(hub: Hub, done: threading.Event) -> None:
    while not done.is_set():
        _serve(hub)
