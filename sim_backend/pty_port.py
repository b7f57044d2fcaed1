"""The sensor's serial port as a pseudo-terminal behind a stable link; never waits for its reader."""

import contextlib
import errno
import os
import termios
import tty
from pathlib import Path

from stagectl.errors import LinkError


class PtyPort:
    """Writes whole lines; `unplug` takes the port away under the reader, `plug` brings another one."""

    def __init__(self, link: str | Path | None) -> None:
        self.lines_lost_count = 0  # thrown away because nobody read
        self._link = Path(link) if link is not None else None
        self._master = -1
        self._slave = -1
        self.plug()

    @property
    def path(self) -> str:
        """Where a reader opens the port."""
        return str(self._link) if self._link is not None else os.ttyname(self._slave)

    def plug(self) -> None:
        """Make a new pseudo-terminal and let the link point to it."""
        if self._master >= 0:
            return
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._link is None:
            return
        partial = self._link.with_name(f"{self._link.name}.{os.getpid()}.part")
        try:
            with contextlib.suppress(FileNotFoundError):
                partial.unlink()
            partial.symlink_to(os.ttyname(self._slave))
            partial.replace(self._link)
        except OSError as error:
            self.unplug()
            raise LinkError(
                f"{self._link}: the rig's serial port can't be linked there: {error}; choose another --pty-link"
            ) from error

    def unplug(self) -> None:
        """Take the port away: a reader gets an I/O error."""
        if self._master < 0:
            return
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        if self._link is not None:
            with contextlib.suppress(FileNotFoundError):
                self._link.unlink()

    def write(self, line: bytes) -> None:
        """Write a line; when the kernel's buffer is full (nobody reads) its stale content is thrown away first."""
        if self._master < 0:
            return
        try:
            written = os.write(self._master, line)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise LinkError(
                    f"{self.path}: writing to the rig's serial port failed: {error}; restart the rig"
                ) from error
            written = 0
        if written < len(line):
            self.lines_lost_count += 1
            termios.tcflush(self._slave, termios.TCIFLUSH)

    def close(self) -> None:
        """Remove port and link."""
        self.unplug()
