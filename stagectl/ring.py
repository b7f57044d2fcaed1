"""Memory shared between the servo and the supervisor: a ring of rows one way, a block of requests the other.

Both are plain files (in /dev/shm), so that they outlive every process and no resource tracker removes them; path
None is anonymous memory, for both ends in one process. One writer each. A lock on the file, which the kernel drops
when its holder dies however it dies, tells whether the writer is alive. Knows no clock.
"""

import errno
import fcntl
import mmap
import os
import stat
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numba import types
from numba.extending import intrinsic

from stagectl.compiled import compiled
from stagectl.errors import RecordError
from stagectl.row import ROW, layout_hash
from stagectl.whole_file import is_held

RING_ROWS_COUNT = 16_384
"""16.4 s at 1 kHz, 20 MB: the supervisor may be away for 10 s."""

SHARED_MEMORY = Path("/dev/shm")

_RING_MAGIC = b"sctlring"
_REQUEST_MAGIC = b"sctlrqst"
_HEADER = np.dtype(
    [
        ("magic", "S8"),
        ("layout", "S64"),
        ("itemsize", "i8"),
        ("slots_count", "i8"),
        ("writer_pid", "i8"),
        ("run_folder", "S1024"),
    ]
)
_COUNTER_OFFSET = 2048  # on a cache line of its own
_SLOTS_OFFSET = 4096
_READ_TRIES_COUNT = 16  # a publication takes about 1 us: a reader that meets this many was stopped in between


@intrinsic
def _fence(typing_context):  # pyright: ignore[reportUnusedParameter]
    """Let no store or load move across this point, in the compiler or in the processor (x86 and ARM)."""

    def generate(context, builder, signature, arguments):  # pyright: ignore[reportUnusedParameter]
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


@compiled
def _barrier():
    """Stand between two accesses of shared memory, from Python or in compiled code."""
    _fence()  # pyright: ignore[reportCallIssue]


@compiled
def _write_slot(counter, slots, row):
    """Copy the row into the next slot, then count it: killed in between, the row does not exist."""
    written_count = counter[0]
    slots[written_count % slots.shape[0]] = row[0]
    _barrier()
    counter[0] = written_count + 1


@compiled
def _publish(counter, slots, value):
    """Write under a sequence lock: the counter is odd while the value is in change."""
    sequence = counter[0]
    counter[0] = sequence + 1
    _barrier()
    slots[0] = value[0]
    _barrier()
    counter[0] = sequence + 2


@compiled
def _read_published(counter, slots, scratch, kept, tries_count):
    """Copy the newest whole value into `kept` and return its number; -1 when every try met a publication."""
    for _ in range(tries_count):
        before = counter[0]
        if before & 1:
            continue
        _barrier()
        scratch[0] = slots[0]
        _barrier()
        if counter[0] == before:
            kept[0] = scratch[0]
            return before // 2
    return -1


class _Memory:
    """A mapped header, counter and slots. Errors: RecordError."""

    def __init__(
        self, path: Path | None, mapping: mmap.mmap, dtype: np.dtype, slots_count: int, descriptor: int | None
    ):
        self.path = path
        self.mapping = mapping
        self.descriptor = descriptor
        self.header = np.ndarray(1, _HEADER, mapping)
        self.counter = np.ndarray(1, np.int64, mapping, _COUNTER_OFFSET)
        self.slots = np.ndarray(slots_count, dtype, mapping, _SLOTS_OFFSET)

    def close(self) -> None:
        """Give up the writer's lock; the file stays, and the mapping ends with the last array on it."""
        if self.descriptor is not None:
            fcntl.flock(self.descriptor, fcntl.LOCK_UN)
            os.close(self.descriptor)
            self.descriptor = None


def _size_bytes(dtype: np.dtype, slots_count: int) -> int:
    return _SLOTS_OFFSET + dtype.itemsize * slots_count


def _fill_header(memory: _Memory, magic: bytes, dtype: np.dtype, slots_count: int, run_folder: str) -> None:
    text = os.fsencode(run_folder)
    if len(text) > 1024:
        raise RecordError(f"{run_folder}: the path has {len(text)} bytes, the limit is 1024; use a shorter folder")
    memory.header["layout"] = layout_hash(dtype).encode()
    memory.header["itemsize"] = dtype.itemsize
    memory.header["slots_count"] = slots_count
    memory.header["writer_pid"] = os.getpid()
    memory.header["run_folder"] = text
    memory.header["magic"] = magic


def _check_dtype(dtype: np.dtype) -> None:
    if dtype.names is None or dtype.hasobject or dtype.itemsize % 8:
        raise RecordError(f"a shared layout is a structured dtype of whole eight-byte words, not {dtype}")


def _create(path: Path | None, magic: bytes, dtype: np.dtype, slots_count: int, run_folder: str) -> _Memory:
    """Make the memory, all of it reserved now: a full /dev/shm must fail here, not as SIGBUS in the loop."""
    _check_dtype(dtype)
    size_bytes = _size_bytes(dtype, slots_count)
    if path is None:
        memory = _Memory(None, mmap.mmap(-1, size_bytes), dtype, slots_count, None)
        _fill_header(memory, magic, dtype, slots_count, run_folder)
        return memory
    unborn = path.with_name(f".{path.name}.{os.getpid()}")
    descriptor = -1
    try:
        descriptor = os.open(unborn, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        os.posix_fallocate(descriptor, 0, size_bytes)
        mapping = mmap.mmap(descriptor, size_bytes, mmap.MAP_SHARED | mmap.MAP_POPULATE)
        memory = _Memory(path, mapping, dtype, slots_count, descriptor)
        _fill_header(memory, magic, dtype, slots_count, run_folder)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if magic == _RING_MAGIC:
            os.link(unborn, path)  # whole or not at all, and never over rows that nobody has saved
            unborn.unlink()
        else:
            if writer_alive(path):
                raise RecordError(f"{path}: another process writes requests here; stop it, or give another path")
            os.replace(unborn, path)
    except (OSError, RecordError) as error:
        if descriptor >= 0:
            os.close(descriptor)
        unborn.unlink(missing_ok=True)
        if isinstance(error, RecordError):
            raise
        raise _creation_error(path, size_bytes, error) from error
    return memory


def _creation_error(path: Path, size_bytes: int, error: OSError) -> RecordError:
    if error.errno == errno.EEXIST:
        if writer_alive(path):
            return RecordError(f"{path}: a living servo (pid {_pid_of(path)}) writes this ring; stop it first")
        return RecordError(f"{path}: holds the rows of a dead servo; recover them into their run first")
    if error.errno == errno.ENOSPC:
        return RecordError(
            f"{path}: no room for {size_bytes / 1e6:.1f} MB of shared memory; free space there or make it larger"
        )
    return RecordError(f"{path}: can't make shared memory: {error.strerror}; check folder and permissions")


def _pid_of(path: Path) -> int:
    try:
        with open(path, "rb") as file:
            content = file.read(_HEADER.itemsize)
    except OSError:
        return -1
    return int(np.frombuffer(content, _HEADER)["writer_pid"][0]) if len(content) == _HEADER.itemsize else -1


def _attach(path: Path, magic: bytes, dtype: np.dtype, kind: str) -> _Memory:
    """Map the memory at `path` to read it; refuses another kind, layout or size."""
    _check_dtype(dtype)
    try:
        with open(path, "rb") as file:
            size_bytes = os.fstat(file.fileno()).st_size
            if size_bytes < _SLOTS_OFFSET:
                raise RecordError(
                    f"{path}: {size_bytes} bytes are too few for a {kind}; the file is damaged: remove it"
                )
            mapping = mmap.mmap(file.fileno(), size_bytes, access=mmap.ACCESS_READ)
    except OSError as error:
        raise RecordError(f"{path}: can't open the {kind}: {error.strerror}; is its writer started?") from error
    header = np.ndarray(1, _HEADER, mapping)[0]
    if header["magic"] != magic:
        raise RecordError(f"{path}: not a {kind} (it begins with {bytes(header['magic'])!r}, not {magic!r})")
    found = bytes(header["layout"]).decode(errors="replace")
    expected = layout_hash(dtype)
    if found != expected or header["itemsize"] != dtype.itemsize:
        raise RecordError(
            f"{path}: the {kind} has layout {found[:12]}, {header['itemsize']} bytes a row, and this program reads "
            f"{expected[:12]}, {dtype.itemsize} bytes; start both ends from the same version"
        )
    slots_count = int(header["slots_count"])
    if not slots_count >= 1 or size_bytes != _size_bytes(dtype, slots_count):
        raise RecordError(f"{path}: {size_bytes} bytes don't hold {slots_count} rows; the file is damaged: remove it")
    return _Memory(path, mapping, dtype, slots_count, None)


def writer_alive(path: Path) -> bool:
    """Tell whether a process still writes the ring or request block at `path`; False where there is no file."""
    return is_held(path)


def own_rings(folder: Path = SHARED_MEMORY) -> list[Path]:
    """Return the rings of this user: everybody may put files into shared memory, and what others put there is theirs.

    A named pipe would be waited for, another's ring can't be opened, and rows of a stranger's would go into our run.
    """
    found = []
    for path in sorted(folder.glob("stagectl-*.ring")):
        try:
            status = path.lstat()
        except FileNotFoundError:
            continue
        if stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid():
            found.append(path)
    return found


class RingWriter:
    """The servo's end of the ring.

    `run_folder` lets a later start find the run that the rows belong to. Refuses to take the place of a ring that
    exists, since it may hold the last rows of a dead servo. Errors: RecordError.
    """

    def __init__(
        self,
        path: Path | None,
        slots_count: int = RING_ROWS_COUNT,
        dtype: np.dtype = ROW,
        run_folder: str | Path = "",
    ):
        if not slots_count >= 2:
            raise RecordError(f"a ring of {slots_count} rows can't be read while it is written; give it 2 or more")
        self.memory = _create(path, _RING_MAGIC, dtype, slots_count, str(run_folder))
        # Compile now, beside the ring, and not in the first cycle.
        _write_slot(np.zeros(1, np.int64), np.zeros(2, dtype), np.zeros(1, dtype))

    @property
    def written_count(self) -> int:
        """Rows written since the ring was made."""
        return int(self.memory.counter[0])

    def write(self, row: np.ndarray) -> None:
        """Copy a one-element row into the ring, then count it. Allocates nothing, waits for nobody (about 1 us)."""
        _write_slot(self.memory.counter, self.memory.slots, row)

    def reader(self) -> "RingReader":
        """Make a reader on the same memory, in this process."""
        return RingReader(self)

    def close(self) -> None:
        """End writing; file and rows stay for whoever saves them."""
        self.memory.close()


class RingReader:
    """The supervisor's end: takes what is new, counts what was overwritten before it came.

    Starts at the oldest row that the ring still holds. Errors: RecordError (missing, damaged, wrong layout).
    """

    def __init__(self, source: Path | RingWriter, dtype: np.dtype = ROW):
        self.memory = source.memory if isinstance(source, RingWriter) else _attach(source, _RING_MAGIC, dtype, "ring")
        self.lost_count = 0
        self._next = 0

    @classmethod
    def attach(cls, path: Path, dtype: np.dtype = ROW) -> "RingReader":
        """Open the ring at `path`; refuses a wrong layout."""
        return cls(path, dtype)

    @property
    def written_count(self) -> int:
        """Rows that the writer has counted since the ring was made."""
        return int(self.memory.counter[0])

    @property
    def writer_pid(self) -> int:
        """Process that made the ring."""
        return int(self.memory.header["writer_pid"][0])

    @property
    def run_folder(self) -> Path | None:
        """Run that the rows belong to, None where the writer named none."""
        text = os.fsdecode(bytes(self.memory.header["run_folder"][0]))
        return Path(text) if text else None

    def read_new(self) -> np.ndarray:
        """Return a copy of the rows since the last call, oldest first, shape (n,); `lost_count` grows by the rest."""
        written_count = self.written_count
        _barrier()
        first = self._first_whole(self._next, written_count)
        rows = self._copy(first, written_count)
        first_whole = self._whole_after_copy(first, written_count)
        self.lost_count += first_whole - self._next
        self._next = written_count
        return rows[first_whole - first :]

    def read_last(self, rows_count: int) -> np.ndarray:
        """Return a copy of the newest rows, at most `rows_count`, oldest first; `read_new` is not affected."""
        written_count = self.written_count
        _barrier()
        first = self._first_whole(max(0, written_count - rows_count), written_count)
        rows = self._copy(first, written_count)
        return rows[self._whole_after_copy(first, written_count) - first :]

    def _first_whole(self, wanted: int, written_count: int) -> int:
        # The slot of row `written - slots` is the one that the writer may be writing right now.
        return max(wanted, written_count - self.memory.slots.shape[0] + 1)

    def _whole_after_copy(self, first: int, end: int) -> int:
        """Return the first row of a copy [first, end) that the writer can't have touched meanwhile."""
        _barrier()
        return min(end, self._first_whole(first, self.written_count))

    def _copy(self, first: int, end: int) -> np.ndarray:
        slots = self.memory.slots
        size = slots.shape[0]
        start, count = first % size, end - first
        until_end = min(count, size - start)
        if until_end == count:
            return slots[start : start + count].copy()
        return np.concatenate([slots[start:], slots[: count - until_end]])


class RequestWriter:
    """The supervisor's end of a request block: the newest value of one structured dtype.

    Errors: RecordError (another living writer, no memory, unknown field).
    """

    def __init__(self, path: Path | None, dtype: np.dtype):
        self.memory = _create(path, _REQUEST_MAGIC, dtype, 1, "")
        self.value = np.zeros(1, dtype)
        self._bytes = self.value.view(np.uint8)  # numpy copies field by field otherwise: 6 us
        self._source, self._source_bytes = self.value, self._bytes
        _publish(np.zeros(1, np.int64), np.zeros(1, dtype), self.value)

    def publish(self, values: np.ndarray | Mapping[str, object]) -> int:
        """Publish a one-element array, or the last value with the given fields changed; return its number (from 1)."""
        if isinstance(values, Mapping):
            for name, value in values.items():
                if name not in (self.value.dtype.names or ()):
                    raise RecordError(
                        f"request block: no field {name!r}; it has {', '.join(self.value.dtype.names or ())}"
                    )
                self.value[name] = value
        else:
            if values.dtype != self.value.dtype or values.shape != (1,):
                raise RecordError(f"request block: {values.dtype} of shape {values.shape} is not one of its values")
            if values is not self._source:
                self._source, self._source_bytes = values, values.view(np.uint8)
            self._bytes[:] = self._source_bytes
        _publish(self.memory.counter, self.memory.slots, self.value)
        return int(self.memory.counter[0]) // 2

    def reader(self) -> "RequestReader":
        """Make a reader on the same memory, in this process."""
        return RequestReader(self, self.value.dtype)

    def close(self) -> None:
        """End publishing; the file stays."""
        self.memory.close()


class RequestReader:
    """The servo's end of a request block. Errors: RecordError (missing, damaged, wrong layout)."""

    def __init__(self, source: Path | RequestWriter, dtype: np.dtype):
        self.memory = (
            source.memory
            if isinstance(source, RequestWriter)
            else _attach(source, _REQUEST_MAGIC, dtype, "request block")
        )
        self.torn_count = 0
        self._sequence = 0
        self._scratch = np.zeros(1, dtype)
        self._kept = np.zeros(1, dtype)
        self.read()

    @classmethod
    def attach(cls, path: Path, dtype: np.dtype) -> "RequestReader":
        """Open the request block at `path`; refuses a wrong layout."""
        return cls(path, dtype)

    def read(self) -> tuple[int, np.ndarray]:
        """Return (number of the newest publication, its value); 0 and zeros before the first.

        Never waits: when all tries meet a writer in the act (or one that died in it), the last whole value stays and
        `torn_count` grows. The array is the reader's own copy, one element, valid until the next read.
        """
        sequence = _read_published(self.memory.counter, self.memory.slots, self._scratch, self._kept, _READ_TRIES_COUNT)
        if sequence < 0:
            self.torn_count += 1
        else:
            self._sequence = sequence
        return self._sequence, self._kept
