"""The serial port on pseudo-terminals: reading, exclusive use, a port that goes away."""

import os
import select
import termios
import tty

import pytest

from drivers.serial_port import READ_BYTES, SerialPort
from stagectl.errors import LinkError


@pytest.fixture
def pair():
    """Master descriptor and path of a raw pty."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.close(slave)
    ends = [master]
    yield ends, path
    for end in ends:
        os.close(end)


def wait_readable(port, timeout_s=5.0):
    ready, _, _ = select.select([port], [], [], timeout_s)
    assert ready, "nothing arrived"


def test_reads_what_is_there_and_nothing_else(pair):
    (master,), path = pair
    port = SerialPort(path, 921_600.0)
    assert port.read() == b""
    assert port.read() == b""
    os.write(master, b"\xa5\x5a\r\n\x00\x11\x13\xff")  # raw: no translation, no flow control
    wait_readable(port)
    assert port.read() == b"\xa5\x5a\r\n\x00\x11\x13\xff"
    assert port.read() == b""
    port.close()


def test_one_read_is_bounded(pair):
    (master,), path = pair
    port = SerialPort(path, 115_200.0)
    os.write(master, bytes(range(256)) * 5)
    wait_readable(port)
    parts = []
    while part := port.read():
        parts.append(part)
    assert b"".join(parts) == bytes(range(256)) * 5
    assert max(map(len, parts)) <= READ_BYTES
    port.close()


def test_a_pseudo_terminal_has_no_adapter_to_warn_of(pair, tmp_path):
    _, path = pair
    (tmp_path / "interferometer").symlink_to(path)  # as the rig gives its port
    port = SerialPort(tmp_path / "interferometer", 921_600.0)
    assert port.warnings == []
    port.close()


def test_missing_port_is_named():
    with pytest.raises(LinkError, match=r"/dev/serial/by-id/none.*there is no such port.*plug the sensor in"):
        SerialPort("/dev/serial/by-id/none", 921_600.0)


def test_file_that_is_no_port(tmp_path):
    path = tmp_path / "plain"
    path.write_bytes(b"")
    with pytest.raises(LinkError, match=r"plain can't be opened"):
        SerialPort(str(path), 921_600.0)


def test_taken_port_is_named(pair):
    _, path = pair
    first = SerialPort(path, 921_600.0)
    with pytest.raises(LinkError, match=rf"{path}.*another program holds it"):
        SerialPort(path, 921_600.0)
    first.close()
    second = SerialPort(path, 921_600.0)  # and it is free again
    second.close()


def test_unplugged_mid_run(pair):
    ends, path = pair
    port = SerialPort(path, 921_600.0)
    os.write(ends[0], b"last words")
    wait_readable(port)
    assert port.read() == b"last words"
    os.close(ends.pop())
    with pytest.raises(LinkError, match=rf"{path} is gone.*unplugged.*home again"):
        port.read()
    port.close()
    port.close()


def test_unplugged_ends_a_wait(pair):
    """A poll on the descriptor must return when the port goes, or the loop would wait for its timeout."""
    ends, path = pair
    port = SerialPort(path, 921_600.0)
    os.close(ends.pop())
    wait_readable(port)
    with pytest.raises(LinkError, match="is gone"):
        port.read()
    port.close()


def test_c_library_that_refuses_the_rate(pair, monkeypatch):
    """pyserial 3.5 on glibc 2.42 raises termios.error for rates outside the table; it is no OSError."""
    _, path = pair

    def refuse(*_, **__):
        raise termios.error(22, "Invalid argument")

    monkeypatch.setattr("serial.serialposix.Serial._reconfigure_port", refuse)
    with pytest.raises(LinkError, match="choose one of the usual rates"):
        SerialPort(path, 691_200.0)
