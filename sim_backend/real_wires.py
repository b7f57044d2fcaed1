"""The rig on wires of the operating system: a SocketCAN interface, and a serial port that it writes to."""

import contextlib
import errno
import os
import socket
import termios
import tty
from pathlib import Path

from stagectl.errors import LinkError

_BAUD_CODES = {9600.0: termios.B9600, 115_200.0: termios.B115200, 921_600.0: termios.B921600}
_ECHO_BYTES = 4096
_NOT_THERE = (errno.ENODEV, errno.ENXIO)


def can_link(interface: str) -> socket.socket | None:
    """Open a SocketCAN interface for raw frames; None while there is no such interface."""
    link = None
    try:
        link = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
        link.bind((interface,))
    except OSError as error:
        if link is not None:
            link.close()
        if error.errno in _NOT_THERE:
            return None
        raise LinkError(
            f"{interface}: the rig's drives can't be put on this CAN interface: {error}; choose another --can"
        ) from error
    return link


class UartPort:
    """Writes whole lines to a serial port, or to another device that takes bytes (the port of a virtual machine).

    What that doesn't take is lost, and nobody waits. What comes back is heard and ignored: a tty that was just opened
    echoes lines, and a virtual machine stood still for good when nobody took 200 kB of its echo.
    """

    def __init__(self, path: str | Path, baud_bit_per_s: float) -> None:
        self.lines_lost_count = 0
        self.path = str(path)
        self._is_plugged = True
        self._port = -1
        try:
            self._port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            if os.isatty(self._port):
                self._configure(baud_bit_per_s)
        except KeyError:
            self.close()
            known = ", ".join(f"{rate:g}" for rate in _BAUD_CODES)
            raise LinkError(f"{path}: {baud_bit_per_s:g} baud is none of {known}; change the machine file") from None
        except (OSError, termios.error) as error:
            self.close()
            raise LinkError(f"{path}: the rig's lines can't go there: {error}; choose another --uart") from error

    def _configure(self, baud_bit_per_s: float) -> None:
        tty.setraw(self._port)
        attributes = termios.tcgetattr(self._port)
        attributes[2] |= termios.CLOCAL
        attributes[4] = attributes[5] = _BAUD_CODES[baud_bit_per_s]
        termios.tcsetattr(self._port, termios.TCSANOW, attributes)

    def plug(self) -> None:
        """Write again."""
        self._is_plugged = True

    def unplug(self) -> None:
        """Write nothing: the port of a cable stays when the cable is pulled."""
        self._is_plugged = False

    def write(self, line: bytes) -> None:
        """Write a line, or lose it."""
        if not self._is_plugged:
            return
        try:
            self._ignore_echo()
            written = os.write(self._port, line)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise LinkError(f"{self.path}: writing the rig's lines failed: {error}; restart the rig") from error
        self.lines_lost_count += written < len(line)

    def _ignore_echo(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while os.read(self._port, _ECHO_BYTES):
                pass

    def close(self) -> None:
        """Close the port."""
        if self._port >= 0:
            os.close(self._port)
            self._port = -1
