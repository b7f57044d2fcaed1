"""What a recording loses: rows against the SYNCs that the rig heard, after a kill and after a power cut.

A power cut is ext4's own shutdown without a flush (EXT4_IOC_SHUTDOWN, as xfstests cuts the power): from one instant
on the file system takes nothing more, and what the kernel held in memory, data and journal, never reaches the disk.
The disk is then mounted again, its journal played back, and the runs are read. What a disk's own cache would lose of
blocks that it has taken is not in it: fsync asks for that to be flushed, and a disk that lies about it can't be
helped.
"""

import contextlib
import fcntl
import os
import signal
import struct
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from stagectl.errors import StagectlError
from stagectl.record import read_run
from stagectl.ring import RingReader
from tests.faults.house import House
from tests.service.daemon import servo_pid

_DISK_BYTES = 192 << 20
_PATIENCE_S = 30.0
_SHARED_MEMORY = Path("/dev/shm")
_EXT4_IOC_SHUTDOWN, _NO_FLUSH = 0x8004_587D, 2  # linux/ext4.h


class NotHere(Exception):
    """This host lacks what the measurement needs."""


@dataclass(frozen=True)
class Loss:
    """Cycles that were on the bus, those of them that the files hold, and what could not be read."""

    syncs_count: int
    rows_count: int
    unreadable: tuple[str, ...] = ()

    @property
    def cycles_lost(self) -> int:
        """Cycles without a row; the one under way at the kill had its SYNC and not yet its row."""
        return max(0, self.syncs_count - 1 - self.rows_count)


def _rows(runs: Path) -> tuple[int, tuple[str, ...]]:
    count, bad = 0, []
    for folder in sorted(runs.iterdir()):
        if not (folder / "samples.arrow").exists():
            continue
        try:
            read_run(folder)
            with pa.OSFile(str(folder / "samples.arrow")) as file:
                reader = pa.ipc.open_stream(file)
                with contextlib.suppress(StopIteration, pa.ArrowInvalid):
                    while True:
                        count += reader.read_next_batch().num_rows
        except (StagectlError, pa.ArrowException, OSError) as error:
            bad.append(f"{folder.name}: {error}")
    return count, tuple(bad)


def after_kill(folder: Path, which: str) -> Loss:
    """Kill the servo or the supervisor of a stage that jogs, and count what is kept when all has come to its end."""
    house = House(folder)
    try:
        house.daemon.state_is("idle")
        house.find_rig()
        if trouble := house.ready():
            raise RuntimeError(f"the scene could not be set: {trouble}")
        house.set_off()
        if which == "servo":
            os.kill(servo_pid(house.daemon), signal.SIGKILL)
            house.let_go()
            state = house.state()
            house.daemon.state_is("fault")
            _until_closed(house.daemon.runs)
        else:
            servo = servo_pid(house.daemon)
            house.daemon.process.kill()
            house.daemon.process.wait()
            state = house.state()
            give_up_s = time.monotonic() + _PATIENCE_S
            while _works(servo) and time.monotonic() < give_up_s:  # it stops the stage, then saves the rows
                with contextlib.suppress(StagectlError):
                    state = house.state()
                time.sleep(0.02)
        return Loss(state["syncs_count"], *_rows(house.daemon.runs))
    finally:
        house.close()


def _works(pid: int) -> bool:
    """Tell whether a process is there and no zombie that nobody has looked after."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _until_closed(runs: Path) -> None:
    give_up_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < give_up_s:
        if all('"state": "recording"' not in path.read_text() for path in runs.glob("*/manifest.json")):
            return
        time.sleep(0.1)


def after_power_cut(folder: Path, recorded_s: float = 3.0) -> Loss:
    """Take the disk away under a stage that records, forget its memory, and count what is left on the disk.

    Raises NotHere where no disk can be mounted.
    """
    folder.mkdir(parents=True)
    _make_disk(folder / "image")
    with _disk(folder / "image", folder / "disk") as disk:
        house = House(folder / "house", runs=disk / "runs")
        try:
            house.daemon.state_is("idle")
            house.find_rig()
            time.sleep(recorded_s)
            servo = servo_pid(house.daemon)
            syncs_count = house.state()["syncs_count"]
            _cut(disk)
            house.daemon.process.kill()
            os.kill(servo, signal.SIGKILL)
            _forget_rings(disk)
        finally:
            house.close()
    with _disk(folder / "image", folder / "after") as disk:
        return Loss(syncs_count, *_rows(disk / "runs"))


def _cut(disk: Path) -> None:
    descriptor = os.open(disk, os.O_RDONLY)
    try:
        fcntl.ioctl(descriptor, _EXT4_IOC_SHUTDOWN, struct.pack("I", _NO_FLUSH))
    except OSError as error:
        raise NotHere(f"this kernel can't shut ext4 down: {error.strerror}") from error
    finally:
        os.close(descriptor)


def _forget_rings(disk: Path) -> None:
    """Remove what shared memory still holds of runs on this disk: memory forgets."""
    for ring in _SHARED_MEMORY.glob("stagectl-*.ring"):
        with contextlib.suppress(StagectlError):
            folder = RingReader(ring).run_folder
            if folder is not None and disk in folder.parents:
                ring.unlink(missing_ok=True)


def _make_disk(image: Path) -> None:
    with image.open("wb") as file:
        file.truncate(_DISK_BYTES)
    _do("mkfs.ext4", "-q", "-F", str(image))


@contextlib.contextmanager
def _disk(image: Path, place: Path) -> Iterator[Path]:
    """Mount an image as a disk of its own; after a cut its journal is played back."""
    place.mkdir()
    _do("mount", "-o", "loop", str(image), str(place))
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=False, capture_output=True)
        subprocess.run(["umount", "-l", str(place)], check=False, capture_output=True)


def _do(*command: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise NotHere(f"{command[0]} is not installed") from error
    if done.returncode:
        raise NotHere(f"{command[0]}: {done.stderr.strip()}")
