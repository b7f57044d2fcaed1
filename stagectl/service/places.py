"""Where the service listens: a Unix socket for this machine's users, TCP on loopback only when asked for."""

import contextlib
import errno
import fcntl
import os
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from stagectl.errors import LinkError, RecordError, RequestError

SOCKET_NAME = "stagectl.socket"
SYSTEM_FOLDER = Path("/run/stagectl")
SOCKET_MODE = 0o660
_BACKLOG = 64
_AT_ONCE_S, _LOOK_S = 5.0, 0.02
_NOBODY = (errno.ECONNREFUSED, errno.ENOENT, errno.ENOTDIR)
"""What connecting says where no service is; a live one with a full backlog says EAGAIN."""


def default_socket() -> Path:
    """Return the socket of the service: $STAGECTL_SOCKET, the system's, else the user's own."""
    given = os.environ.get("STAGECTL_SOCKET", "")
    if given:
        return Path(given)
    if os.access(SYSTEM_FOLDER, os.W_OK) or (SYSTEM_FOLDER / SOCKET_NAME).exists():
        return SYSTEM_FOLDER / SOCKET_NAME
    folder = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(folder or f"/tmp/stagectl-{os.getuid()}") / SOCKET_NAME


def is_served(path: Path) -> bool:
    """Tell whether a socket's path is a service's, also of one that is too busy to answer, or not for us."""
    try:
        if not path.is_socket():
            return False
    except PermissionError:  # nor is its folder for us
        return True
    except OSError:  # a name too long for a file
        return False
    asked = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        asked.settimeout(1.0)
        asked.connect(str(path))
    except OSError as error:
        return error.errno not in _NOBODY
    finally:
        asked.close()
    return True


def listen_unix(path: Path) -> socket.socket:
    """Listen on a path, for its owner and group; takes the place of a dead service's. Errors: LinkError."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
        found = path.parent.stat()
        if found.st_uid not in (0, os.getuid()) or (found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX):
            raise LinkError(f"{path.parent}: others may put a socket of theirs here; give another path with --socket")
        refusal = f"{path.parent}: somebody keeps this folder locked (`lslocks`); give another path with --socket"
        with _alone(path.parent, _AT_ONCE_S, refusal):  # or two that begin now take each other's for a dead one's
            if is_served(path):
                raise LinkError(f"{path}: a service listens here already; stop it, or give another path with --socket")
            _remove_dead(path)
            before = os.umask(0o777 & ~SOCKET_MODE)
            try:
                listening.bind(str(path))
            finally:
                os.umask(before)
            listening.listen(_BACKLOG)
    except OSError as error:
        listening.close()
        raise LinkError(f"{path}: can't listen: {error.strerror or error}; give another path with --socket") from error
    except LinkError:
        listening.close()
        raise
    return listening


@contextlib.contextmanager
def one_service_of(state_folder: Path) -> Iterator[None]:
    """Keep a second service from the same state, and so from the same stage. Errors: LinkError, RecordError."""
    refusal = f"{state_folder}: another service works with this state; stop it, or give another folder with --state"
    try:
        state_folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(
            f"{state_folder}: can't be made: {error.strerror}; give another folder with --state"
        ) from error
    with _alone(state_folder, 0.0, refusal):
        yield


@contextlib.contextmanager
def _alone(folder: Path, wait_s: float, refusal: str) -> Iterator[None]:
    """Keep others that do the same out of a folder, until the end of the context."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    give_up_s = time.monotonic() + wait_s
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() >= give_up_s:
                    raise LinkError(refusal) from error
                time.sleep(_LOOK_S)
        yield
    finally:
        os.close(descriptor)


def _remove_dead(path: Path) -> None:
    """Remove a dead service's socket, and nothing else. Errors: LinkError."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        kind = "a symbolic link" if stat.S_ISLNK(mode) else "a folder" if stat.S_ISDIR(mode) else "a file"
        raise LinkError(f"{path}: {kind} is here, no socket; remove it, or give another path with --socket")
    path.unlink(missing_ok=True)


def listen_tcp(port: int, option: str = "--tcp") -> socket.socket:
    """Listen on a port of 127.0.0.1, which an option of the command line gave. Errors: LinkError, RequestError."""
    if not 0 <= port <= 65535:
        raise RequestError(f"{option} {port}: a port is a number from 0 (any that is free) to 65535")
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(("127.0.0.1", port))
        listening.listen(_BACKLOG)
    except OSError as error:
        listening.close()
        raise LinkError(f"127.0.0.1:{port}: can't listen: {error.strerror}; give another port with {option}") from error
    return listening
