"""The rig on wires of the operating system: lines on a serial port, a CAN interface that comes and goes."""

import os
import select
import socket
import termios
from pathlib import Path

import pytest

from sim_backend.hub import Hub
from sim_backend.real_wires import UartPort, can_link
from stagectl.errors import LinkError

SYNC = bytes.fromhex("80000000000000000000000000000000")


@pytest.fixture
def wire():
    """Both ends of a serial line: the writer's path, the reader's descriptor."""
    reader, writer = os.openpty()
    os.set_blocking(reader, False)
    yield os.ttyname(writer), reader
    os.close(reader)
    os.close(writer)


def heard(reader: int, count: int) -> bytes:
    """Return what comes, up to so many bytes; the other end of a pty hears a little later."""
    data = b""
    while len(data) < count and select.select([reader], [], [], 5.0)[0]:
        data += os.read(reader, count)
    return data


def test_lines_arrive_byte_by_byte_as_they_are(wire):
    path, reader = wire
    port = UartPort(path, 115_200.0)
    line = bytes(range(256))
    port.write(line)
    assert heard(reader, len(line)) == line
    assert termios.tcgetattr(reader)[5] == termios.B115200
    port.close()


def test_a_pulled_cable_carries_nothing(wire):
    path, reader = wire
    port = UartPort(path, 115_200.0)
    port.unplug()
    port.write(b"lost")
    port.plug()
    port.write(b"heard")
    assert heard(reader, len(b"heard")) == b"heard"
    port.close()


def test_what_nobody_takes_is_lost_and_counted(wire):
    path, _ = wire
    port = UartPort(path, 115_200.0)
    for _ in range(3000):
        port.write(bytes(25))
    assert 0 < port.lines_lost_count < 3000
    port.close()


def test_what_comes_back_never_fills_the_line(wire):
    path, reader = wire
    port = UartPort(path, 115_200.0)
    for _ in range(3000):
        assert os.write(reader, bytes(25)) == 25
        port.write(b"line\n")
        os.read(reader, 100)
    assert port.lines_lost_count == 0
    port.close()


@pytest.mark.parametrize(
    ("path", "baud_bit_per_s", "said"),
    [("/dev/none", 115_200.0, "choose another --uart"), (None, 12_345.0, "12345 baud is none of 9600")],
)
def test_a_port_that_is_none_is_refused(wire, path, baud_bit_per_s, said):
    with pytest.raises(LinkError, match=said):
        UartPort(path or wire[0], baud_bit_per_s)


def test_an_interface_that_is_not_there_is_no_error():
    if Path("/proc/net/can").exists():
        assert can_link("nothere0") is None
    else:  # a kernel without CAN will not have it later either
        with pytest.raises(LinkError, match=r"nothere0: .*choose another --can"):
            can_link("nothere0")


def test_a_joined_bus_hears_every_client_and_is_heard(tmp_path):
    hub = Hub(tmp_path / "bus")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
    assert not hub.is_on_bus
    hub.join(ours)
    assert hub.is_on_bus
    hub.relay(0x80, b"")
    assert theirs.recv(64) == SYNC
    theirs.send(SYNC)
    assert hub.read(ours.fileno()) == [(ours.fileno(), 0x80, b"")]
    theirs.close()
    hub.read(ours.fileno())
    assert not hub.is_on_bus  # gone; the rig looks for it again
    hub.close()
