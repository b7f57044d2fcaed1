"""The CAN transports: frame and filter bytes against a hub of a few lines, `virtual`, and SocketCAN where it exists.

Golden bytes follow linux/can.h: struct can_frame is id with flag bits (u32, host order, here little endian),
length (u8), three bytes of padding, eight bytes of data.
"""

import socket
import subprocess
import sys

import can
import pytest

from drivers import hub_socket
from drivers.can_bus import open_cyclic, open_network
from drivers.can_frame import ERROR_FLAG, FILTER
from drivers.hub_bus import HubBus
from stagectl.errors import LinkError

pytestmark = pytest.mark.skipif(sys.byteorder != "little", reason="the golden frames are written in little endian")


class Peer:
    """The hub's end of one connection."""

    def __init__(self, path):
        self.path = str(path)
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.listener.bind(self.path)
        self.listener.listen(4)
        self.listener.settimeout(5.0)
        self.connections = []

    def accept(self):
        connection, _ = self.listener.accept()
        connection.settimeout(5.0)
        self.connections.append(connection)
        return connection

    def close(self):
        for connection in self.connections:
            connection.close()
        self.listener.close()


@pytest.fixture
def peer(tmp_path):
    opened = Peer(tmp_path / "hub")
    yield opened
    opened.close()


@pytest.fixture
def cyclic(peer):
    """A cyclic bus that wants ids 0x181 and 0x081, and the hub's end of it, its filter packet still unread."""
    bus = open_cyclic("hub", peer.path, [0x181, 0x081])
    yield bus, peer.accept()
    bus.close()


def test_filter_packet(cyclic):
    # "FILT" 46 49 4C 54; id 0x181, mask 0x7FF | extended 0x80000000 | remote 0x40000000 | error 0x20000000
    # = 0xE00007FF; id 0x081 with the same mask; and error frames: id 0x20000000, mask 0x20000000.
    _, hub = cyclic
    assert hub.recv(256) == bytes.fromhex(
        "46494C54 81010000 FF0700E0 81000000 FF0700E0 00000020 00000020".replace(" ", "")
    )


def test_no_ids_means_only_error_frames(peer):
    bus = open_cyclic("hub", peer.path, [])
    hub = peer.accept()
    assert hub.recv(256) == bytes.fromhex("46494C54 00000020 00000020")
    bus.close()


def test_sent_frame(cyclic):
    # RPDO1 of node 1: id 0x201, 4 bytes 0F 00 85 FF, padded with zeros to 8.
    bus, hub = cyclic
    hub.recv(256)
    assert bus.send(0x201, bytes.fromhex("0F0085FF")) is True
    assert hub.recv(256) == bytes.fromhex("01020000 04 000000 0F0085FF 00000000")


def test_sync_frame_is_empty(cyclic):
    bus, hub = cyclic
    hub.recv(256)
    bus.send(0x080, b"")
    assert hub.recv(256) == bytes.fromhex("80000000 00 000000 0000000000000000")


def test_received_frame_is_cut_to_its_length(cyclic):
    bus, hub = cyclic
    hub.send(bytes.fromhex("81010000 08 000000 371615CD5B079CFF"))
    hub.send(bytes.fromhex("81010000 03 000000 371615CD5B079CFF"))
    assert bus.receive() == (0x181, bytes.fromhex("371615CD5B079CFF"))
    assert bus.receive() == (0x181, bytes.fromhex("371615"))
    assert bus.receive() is None


def test_error_frame_keeps_its_flag(cyclic):
    # linux/can/error.h: CAN_ERR_BUSOFF is class 0x40.
    bus, hub = cyclic
    hub.send(bytes.fromhex("40000020 08 000000 0000000000000000"))
    assert bus.receive() == (ERROR_FLAG | 0x40, bytes(8))


def test_full_queue_is_counted_and_never_waits(cyclic):
    bus, _ = cyclic
    accepted = 0
    while bus.send(0x201, bytes(4)):
        accepted += 1
        assert accepted < 100_000
    assert bus.lost_count == 1
    assert bus.send(0x201, bytes(4)) is False
    assert bus.lost_count == 2


def test_queue_takes_frames_again_after_a_loss(cyclic):
    bus, hub = cyclic
    while bus.send(0x201, b"\x01"):
        pass
    hub.recv(256)
    hub.recv(256)
    assert bus.send(0x201, b"\x02") is True
    assert bus.lost_count == 1


def test_closed_hub_is_an_error(cyclic):
    bus, hub = cyclic
    hub.close()
    with pytest.raises(LinkError, match=r"CAN hub .*arm again"):
        bus.receive()
    with pytest.raises(LinkError, match=r"CAN hub .*cable"):
        bus.send(0x201, b"")


def test_packet_of_another_size_is_an_error(cyclic):
    bus, hub = cyclic
    hub.send(b"STAT" + bytes(16))
    with pytest.raises(LinkError, match="packet of 20 bytes, a CAN frame has 16"):
        bus.receive()


def test_payload_longer_than_a_frame_is_an_error(cyclic):
    bus, _ = cyclic
    with pytest.raises(LinkError, match="payload of 9 bytes"):
        bus.send(0x201, bytes(9))


def test_descriptor_can_be_waited_on(cyclic):
    import select

    bus, hub = cyclic
    assert select.select([bus.fileno()], [], [], 0)[0] == []
    hub.send(bytes.fromhex("81010000 00 000000 0000000000000000"))
    assert select.select([bus.fileno()], [], [], 5)[0] == [bus.fileno()]


def test_no_hub_names_place_and_remedy(tmp_path):
    path = str(tmp_path / "absent")
    for opener in (lambda: open_cyclic("hub", path, []), lambda: open_network("hub", path)):
        with pytest.raises(LinkError, match=r"absent: No such file.*start the rig"):
            opener()


def test_hub_statistics(peer):
    # "STAT" + u64 frames relayed 1000 = 0x3E8, u64 lost 2.
    asking = hub_socket.connect_hub(peer.path)
    hub = peer.accept()
    hub.send(bytes.fromhex("53544154 E803000000000000 0200000000000000"))
    assert hub_socket.hub_statistics(asking) == (1000, 2)
    assert hub.recv(64) == b"STAT"
    asking.close()


def test_network_filters_keep_process_data_and_sync_out(peer):
    bus = open_network("hub", peer.path)
    packet = peer.accept().recv(512)
    assert packet[:4] == b"FILT"
    filters = [FILTER.unpack_from(packet, place) for place in range(4, len(packet), 8)]

    def passes(can_id):
        return any(can_id & mask == wanted & mask for wanted, mask in filters)

    wanted = [0x000, *range(0x081, 0x100), *range(0x580, 0x600), *range(0x700, 0x780)]
    assert [can_id for can_id in range(0x800) if passes(can_id)] == wanted
    assert passes(ERROR_FLAG | 0x40)
    assert not passes(0x8000_0581)
    bus.shutdown()


def test_hub_bus_speaks_the_same_frames(peer):
    bus = HubBus(peer.path)
    hub = peer.accept()
    bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("40001000 00000000"), is_extended_id=False))
    assert hub.recv(256) == bytes.fromhex("01060000 08 000000 4000100000000000")
    hub.send(bytes.fromhex("81050000 08 000000 4300100092010200"))
    message = bus.recv(5.0)
    assert (message.arbitration_id, bytes(message.data)) == (0x581, bytes.fromhex("4300100092010200"))
    assert [message.is_extended_id, message.is_remote_frame, message.is_error_frame] == [False, False, False]
    assert bus.recv(0) is None
    bus.shutdown()


def test_hub_bus_flags(peer):
    bus = HubBus(peer.path)
    hub = peer.accept()
    hub.send(bytes.fromhex("04000020 08 000000 0000000000000000"))
    message = bus.recv(5.0)
    assert message.is_error_frame
    assert message.arbitration_id == 0x04
    bus.send(can.Message(arbitration_id=0x701, is_remote_frame=True, is_extended_id=False))
    assert hub.recv(256)[:4] == bytes.fromhex("01070040")
    bus.shutdown()


def test_hub_bus_filters_change_and_go(peer):
    bus = HubBus(peer.path, can_filters=[{"can_id": 0x581, "can_mask": 0x7FF, "extended": False}])
    hub = peer.accept()
    assert hub.recv(256) == bytes.fromhex("46494C54 00000020 00000020 81050000 FF0700A0")
    hub.send(bytes.fromhex("82050000 00 000000 0000000000000000"))  # under way before the hub heard of the filter
    hub.send(bytes.fromhex("81050000 00 000000 0000000000000000"))
    assert bus.recv(5.0).arbitration_id == 0x581
    bus.set_filters(None)
    assert hub.recv(256) == bytes.fromhex("46494C54 00000000 00000000")
    bus.shutdown()


def test_hub_bus_full_queue_and_end(peer):
    bus = HubBus(peer.path)
    hub = peer.accept()
    message = can.Message(arbitration_id=0x601, data=bytes(8), is_extended_id=False)

    def fill():
        for _ in range(100_000):
            bus.send(message)

    with pytest.raises(can.CanOperationError, match="full"):
        fill()
    hub.close()
    with pytest.raises(can.CanOperationError, match="hub"):
        bus.recv(1.0)
    bus.shutdown()


def test_virtual_passes_only_the_ids():
    cyclic_bus = open_cyclic("virtual", "test-ids", [0x181])
    other = can.Bus(interface="virtual", channel="test-ids", ignore_config=True)
    for can_id, flags in [
        (0x182, {}),
        (0x181, {"is_extended_id": True}),
        (0x181, {}),
        (0x40, {"is_error_frame": True}),
    ]:
        other.send(can.Message(arbitration_id=can_id, data=b"\x07", **{"is_extended_id": False, **flags}))
    assert cyclic_bus.receive() == (0x181, b"\x07")
    assert cyclic_bus.receive() == (ERROR_FLAG | 0x40, b"\x07")
    assert cyclic_bus.receive() is None
    assert cyclic_bus.send(0x201, b"\x01\x02") is True
    message = other.recv(0)
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x201, b"\x01\x02", False)
    with pytest.raises(LinkError, match="no descriptor"):
        cyclic_bus.fileno()
    cyclic_bus.close()
    other.shutdown()


def test_virtual_without_ids_passes_nothing():
    cyclic_bus = open_cyclic("virtual", "test-none", [])
    other = can.Bus(interface="virtual", channel="test-none", ignore_config=True)
    other.send(can.Message(arbitration_id=0x181, is_extended_id=False))
    assert cyclic_bus.receive() is None
    cyclic_bus.close()
    other.shutdown()


def test_virtual_full_queue_is_counted():
    cyclic_bus = open_cyclic("virtual", "test-full", [])
    other = can.Bus(interface="virtual", channel="test-full", rx_queue_size=2, ignore_config=True)
    assert [cyclic_bus.send(0x201, b"") for _ in range(4)] == [True, True, False, False]
    assert cyclic_bus.lost_count == 2
    cyclic_bus.close()
    other.shutdown()


@pytest.mark.parametrize("opener", [lambda name: open_cyclic(name, "x", []), lambda name: open_network(name, "x")])
def test_unknown_interface_names_the_known(opener):
    with pytest.raises(LinkError, match=r"can.interface = 'pcan' is not one of socketcan, hub"):
        opener("pcan")


def test_a_user_s_can_configuration_changes_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    bus = open_network("virtual", "test-config")
    bus.send(can.Message(arbitration_id=0x581, is_extended_id=False))
    assert bus.recv(0) is None
    bus.shutdown()


def test_servo_s_imports_stay_without_python_can():
    code = "import sys, drivers.can_bus, drivers.pdo, drivers.cia402, drivers.arming; print('can' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def _has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def _has_vcan() -> bool:
    try:
        socket.if_nametoindex("vcan0")
    except OSError:
        return False
    return _has_can()


def test_socketcan_absent_names_place_and_remedy():
    remedy = "ip link" if _has_can() else "no SocketCAN.*can_raw"
    for opener in (lambda: open_cyclic("socketcan", "can77", [0x181]), lambda: open_network("socketcan", "can77")):
        with pytest.raises(LinkError, match=f"CAN interface can77: .*{remedy}"):
            opener()


@pytest.mark.skipif(not _has_vcan(), reason="this kernel has no SocketCAN or no vcan0")
def test_socketcan_filters_and_frames():
    servo = open_cyclic("socketcan", "vcan0", [0x181])
    drive = open_cyclic("socketcan", "vcan0", [0x201, 0x080])
    drive.send(0x182, b"\x01")
    drive.send(0x181, b"\x02\x03")
    assert servo.receive() == (0x181, b"\x02\x03")
    assert servo.receive() is None
    servo.send(0x201, bytes.fromhex("0F0085FF"))
    servo.send(0x080, b"")
    assert drive.receive() == (0x201, bytes.fromhex("0F0085FF"))
    assert drive.receive() == (0x080, b"")
    servo.close()
    drive.close()
