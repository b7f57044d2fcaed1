"""A serial port that only reads: exclusive, non-blocking, low latency where the adapter can.

Knows no protocol. pyserial configures, os.read reads (0.6 us empty, against 1.6 us of Serial.read).
"""

import contextlib
import errno
import fcntl
import os
import termios
from pathlib import Path

import serial

from stagectl.errors import LinkError

READ_BYTES = 512
"""Most bytes of one read: 16 lines of a burst fit, and one read stays short."""

_PSEUDO_TERMINALS = "/dev/pts/"

_REMEDIES = {
    errno.ENOENT: "there is no such port: plug the sensor in, or correct interferometer.port (see /dev/serial/by-id)",
    errno.EACCES: "no permission: add the user to the group dialout, or give the port to your user by a udev rule",
    errno.EAGAIN: "another program holds it: stop that program (fuser shows it); two readers would share the bytes",
    errno.EBUSY: "another program holds it: stop that program (fuser shows it); two readers would share the bytes",
    errno.ENOTTY: "this is no serial port: correct interferometer.port",
    errno.EINVAL: "the adapter or the C library refuses this baud rate: choose one of the usual rates",
}


class SerialPort:
    """An open port; `warnings` says what it could not be given."""

    def __init__(self, path: str, baud_bit_per_s: float) -> None:
        """Open with 8N1, no handshake, DTR and RTS on; LinkError with a remedy where that fails."""
        self.path = str(path)
        self.warnings: list[str] = []
        try:
            self._serial = serial.Serial(self.path, int(baud_bit_per_s), timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError, termios.error is not
            raise LinkError(self._text("can't be opened", error)) from error
        self._fd = self._serial.fileno()
        try:
            # flock binds only those who ask for it; TIOCEXCL refuses every further open (but root's).
            fcntl.ioctl(self._fd, termios.TIOCEXCL)
            # With VMIN 0, as pyserial leaves it, "no byte yet" and "unplugged" both read as empty.
            attributes = termios.tcgetattr(self._fd)
            attributes[6][termios.VMIN] = 1
            termios.tcsetattr(self._fd, termios.TCSANOW, attributes)
        except (OSError, termios.error) as error:
            self._serial.close()
            raise LinkError(self._text("can't be configured", error)) from error
        if os.path.realpath(self.path).startswith(_PSEUDO_TERMINALS):
            return  # the rig's: no adapter, and nothing to collect bytes
        try:
            self._serial.set_low_latency_mode(True)
        except (OSError, ValueError) as error:
            self.warnings.append(f"{self.path}: no low-latency mode ({error}); bursts of the adapter stay")
        self._check_latency_timer()

    def _check_latency_timer(self) -> None:
        """FTDI adapters collect bytes for latency_timer ms, 16 unless told otherwise."""
        name = os.path.basename(os.path.realpath(self.path))
        timer = Path("/sys/bus/usb-serial/devices") / name / "latency_timer"
        try:
            milliseconds = int(timer.read_text())
        except (OSError, ValueError):
            return  # not an FTDI adapter
        if milliseconds > 1:
            self.warnings.append(
                f"{self.path}: latency timer is {milliseconds} ms, so samples come in bursts that late; "
                f"write 1 to {timer}"
            )

    def _text(self, what: str, error: BaseException) -> str:
        number = getattr(error, "errno", None)
        if number is None and error.args and isinstance(error.args[0], int):
            number = error.args[0]
        remedy = _REMEDIES.get(number or 0, "check cable, adapter and interferometer.baud_bit_per_s")
        return f"serial port {self.path} {what} ({error}); {remedy}"

    def read(self) -> bytes:
        """What is there, at most READ_BYTES; empty when nothing is. LinkError when the port is gone."""
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkError(self._gone(str(error))) from error
        if not data:
            raise LinkError(self._gone("end of file"))
        return data

    def _gone(self, detail: str) -> str:
        return (
            f"serial port {self.path} is gone ({detail}): unplugged, or the adapter reset; "
            "check plug and cable, then arm and home again"
        )

    def fileno(self) -> int:
        """Descriptor for select, poll or epoll."""
        return self._fd

    def close(self) -> None:
        """Give the port back; harmless when it is gone or closed already."""
        if self._fd < 0:
            return
        self._fd = -1
        with contextlib.suppress(OSError):  # an unplugged port has nothing to give back
            fcntl.ioctl(self._serial.fileno(), termios.TIOCNXCL)
        self._serial.close()
