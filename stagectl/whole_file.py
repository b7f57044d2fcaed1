"""A file that grows by whole pieces only: a piece that did not fit leaves nothing behind, and is kept for later.

Knows neither rows nor runs.
"""

import fcntl
import os
from collections import deque
from collections.abc import Iterable
from pathlib import Path


class WholeFile:
    """Append-only file under an exclusive lock, which ends with its process. Errors: OSError (full disk, lock held)."""

    def __init__(self, path: Path, resume: bool = False):
        """Make a new file, or go on at the end of an existing one."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (0 if resume else os.O_EXCL)
        self._descriptor = os.open(path, flags, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.size_bytes = os.fstat(self._descriptor).st_size
        except OSError:
            os.close(self._descriptor)
            raise
        self._held: deque[bytes] = deque()

    def cut(self, size_bytes: int) -> None:
        """Forget what stands behind the first `size_bytes` bytes. Errors: OSError."""
        os.ftruncate(self._descriptor, size_bytes)
        self.size_bytes = size_bytes

    @property
    def held_count(self) -> int:
        """Pieces that are not in the file yet."""
        return len(self._held)

    def hold(self, pieces: Iterable[bytes]) -> None:
        """Take over pieces for the next write."""
        self._held.extend(pieces)

    def put(self, piece: bytes) -> None:
        """Take over a piece and write everything held; on OSError the file is whole and the rest stays held."""
        self._held.append(piece)
        self.write_held()

    def write_held(self) -> None:
        """Write what is held. Errors: OSError."""
        while self._held:
            self._write_piece(self._held[0])
            self._held.popleft()

    def _write_piece(self, piece: bytes) -> None:
        written = 0
        try:
            while written < len(piece):
                written += os.pwrite(self._descriptor, memoryview(piece)[written:], self.size_bytes + written)
        except OSError:
            os.ftruncate(self._descriptor, self.size_bytes)
            raise
        self.size_bytes += written

    def put_onto_disk(self) -> None:
        """Wait until the disk itself has what was written. Errors: OSError."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Put the file on the disk itself and let go of it, whatever is still held."""
        if self._descriptor < 0:
            return
        try:
            os.ftruncate(self._descriptor, self.size_bytes)  # an interrupt may have left half a piece
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)
            self._descriptor = -1


def is_held(path: Path) -> bool:
    """Tell whether a living process has the file open as a WholeFile."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def replace_whole(path: Path, content: bytes) -> None:
    """Write `content` to `path` so that a reader, or a crash, meets the old file or the new one. Errors: OSError."""
    unborn = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(unborn, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unborn, path)
    except OSError:
        unborn.unlink(missing_ok=True)
        raise
