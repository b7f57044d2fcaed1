"""The rig's drives on a real CAN interface, and its interferometer on a real UART: `bridge.py HUB CAN LINE UART`.

Both directions of the bus, one of the line; knows neither drives nor lines. Survives an interface that is taken down,
and a UART that nobody reads. Ends with the rig.
"""

import contextlib
import errno
import os
import selectors
import socket
import sys
import termios
import tty

FRAME_BYTES = 16  # struct can_frame, on the hub as on SocketCAN
_MOST_BYTES = 4096


def raw_port(path: str) -> int:
    """Open a port for bytes as they are; without carrier, too."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(port)
    attributes = termios.tcgetattr(port)
    attributes[2] |= termios.CLOCAL | termios.CREAD
    attributes[4] = attributes[5] = termios.B115200
    termios.tcsetattr(port, termios.TCSANOW, attributes)
    return port


def pass_frame(source: socket.socket, sink: socket.socket) -> bool:
    """Give one frame of a bus to the other; a bus that is down loses it. False where the source has ended."""
    try:
        frame = source.recv(FRAME_BYTES)
    except OSError as error:
        return error.errno == errno.ENETDOWN
    if len(frame) == FRAME_BYTES:
        try:
            sink.send(frame)
        except OSError as error:
            return error.errno in (errno.ENETDOWN, errno.ENOBUFS, errno.EAGAIN)
    return bool(frame)


def pass_bytes(source: int, sink: int) -> bool:
    """Give what has arrived to the UART; what that doesn't take is lost. False where the source has ended."""
    try:
        data = os.read(source, _MOST_BYTES)
    except OSError:
        return False
    with contextlib.suppress(BlockingIOError):
        os.write(sink, data)
    return bool(data)


def main(hub_path: str, channel: str, line_path: str, uart_path: str) -> int:
    """Bridge until the rig ends."""
    hub = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    hub.connect(hub_path)
    wire = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    wire.bind((channel,))
    line, uart = raw_port(line_path), raw_port(uart_path)
    waiting = selectors.DefaultSelector()
    waiting.register(hub, selectors.EVENT_READ, lambda: pass_frame(hub, wire))
    waiting.register(wire, selectors.EVENT_READ, lambda: pass_frame(wire, hub))
    waiting.register(line, selectors.EVENT_READ, lambda: pass_bytes(line, uart))
    print("bridged", flush=True)
    while all(key.data() for key, _ in waiting.select()):
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
