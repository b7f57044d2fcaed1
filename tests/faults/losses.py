"""What a recording loses: rows against the SYNCs that the rig heard, after a kill and after a power cut, in a jog.

The profile says nothing of recording: a run goes from arming to disarming, and its rows are held against the SYNCs
from its first row on, until the drives stand or the power is cut.

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

import numpy as np
import pyarrow as pa

from stagectl.errors import StagectlError
from stagectl.profile import load_profile
from stagectl.record import read_run
from stagectl.ring import RingReader
from tests.faults.house import JOG_M_PER_S, House
from tests.faults.judge import REST_M_PER_S
from tests.faults.witness import ENABLED
from tests.service.daemon import servo_pid

SHIPPED_HEARTBEAT_S = load_profile("single-axis").trip.heartbeat_s

_DISK_BYTES = 192 << 20
_PATIENCE_S = 30.0
_STANDS_S = 0.8  # heartbeat time and ramp, and as much again
_TRIES = 3
_SLOW_M_PER_S = 0.04  # 3 s in one direction
_SHARED_MEMORY = Path("/dev/shm")
_EXT4_IOC_SHUTDOWN, _NO_FLUSH = 0x8004_587D, 2  # linux/ext4.h


class NotHere(Exception):
    """This host lacks what the measurement needs."""


@dataclass(frozen=True)
class Loss:
    """Cycles of the last run that were on the bus, those of them that the files hold, and what could not be read."""

    syncs_count: int
    rows_count: int
    unreadable: tuple[str, ...] = ()

    @property
    def cycles_lost(self) -> int:
        """Cycles without a row; the one under way at the kill had its SYNC and not yet its row."""
        return max(0, self.syncs_count - 1 - self.rows_count)


@dataclass(frozen=True)
class Stopped:
    """What the drives did by themselves after `kill -9` of the servo, by the rig's own log; seconds."""

    begun_s: float  # until the macro's drive followed no command any more
    rest_s: float  # from then on, until the macro stood


def loss_of(runs: Path, seen: dict[str, np.ndarray], begun_t_ns: int, until_t_ns: int) -> Loss:
    """Count SYNCs and rows of the newest run, from its first row until an instant; without a row from `begun_t_ns`."""
    rows, bad = np.zeros(0, np.int64), []
    for folder in sorted(runs.iterdir()):
        if not (folder / "samples.arrow").exists():
            continue
        try:
            read_run(folder)
            t_ns = _t_ns_of(folder / "samples.arrow")
        except (StagectlError, pa.ArrowException, OSError) as error:
            bad.append(f"{folder.name}: {error}")
            continue
        if t_ns.size and t_ns[0] >= begun_t_ns and (not rows.size or t_ns[0] > rows[0]):
            rows = t_ns
    rows = rows[rows <= until_t_ns]
    first_t_ns = int(rows[0]) if rows.size else begun_t_ns
    syncs = seen["sync_t_ns"]
    return Loss(int(((syncs >= first_t_ns) & (syncs <= until_t_ns)).sum()), np.unique(rows).size, tuple(bad))


def _t_ns_of(path: Path) -> np.ndarray:
    """Return the instants of the batches of a run that are whole."""
    found = [np.zeros(0, np.int64)]
    with pa.OSFile(str(path)) as file:
        reader = pa.ipc.open_stream(file)
        with contextlib.suppress(StopIteration, pa.ArrowInvalid):
            while True:
                found.append(reader.read_next_batch().column("t_ns").to_numpy())
    return np.concatenate(found)


def stopped(seen: dict[str, np.ndarray], killed_t_ns: int) -> Stopped:
    """Return how soon the macro's drive stopped by itself."""
    after = seen["t_ns"] >= killed_t_ns
    t_ns, states = seen["t_ns"][after], seen["states"][after, 0]
    slow = np.abs(seen["macro_velocity_m_per_s"][after]) < REST_M_PER_S
    left = np.flatnonzero(states != ENABLED)
    begun_t_ns = t_ns[left[0]] if left.size else np.inf
    stands = np.flatnonzero(slow & (t_ns >= begun_t_ns))
    rest_t_ns = t_ns[stands[0]] if stands.size else np.inf
    return Stopped(1e-9 * float(begun_t_ns - killed_t_ns), 1e-9 * float(rest_t_ns - begun_t_ns))


def _jogging(house: House, speed_m_per_s: float = JOG_M_PER_S) -> int:
    """Have the stage jog; return an instant before its arming. A hiccup of the host gets it another try."""
    house.daemon.state_is("idle")
    trouble = ""
    for _ in range(_TRIES):
        house.find_rig()
        begun_t_ns = house.t_ns()
        trouble = house.ready()
        house.find_rig()
        if not trouble and house.set_off(speed_m_per_s):
            return begun_t_ns
        house.let_go()
    raise RuntimeError(f"the scene could not be set: {trouble or 'it does not move'}")


def after_servo_kill(folder: Path) -> tuple[Loss, Stopped]:
    """Kill the servo of a stage that jogs, under the shipped heartbeat time; count what is kept when all has ended."""
    house = House(folder, changes={"trip.heartbeat_s": SHIPPED_HEARTBEAT_S})
    try:
        begun_t_ns = _jogging(house)
        supervisor, servo = house.daemon.process.pid, servo_pid(house.daemon)
        os.kill(supervisor, signal.SIGSTOP)  # with it the rig would go, before the drives have stopped the stage
        killed_t_ns = house.t_ns()
        os.kill(servo, signal.SIGKILL)
        house.let_go()
        time.sleep(_STANDS_S)
        seen = house.look_back()
        os.kill(supervisor, signal.SIGCONT)
        house.daemon.state_is("fault")
        _until_closed(house.daemon.runs)
        return loss_of(house.daemon.runs, seen, begun_t_ns, int(seen["t_ns"][-1])), stopped(seen, killed_t_ns)
    finally:
        house.close()


def after_supervisor_kill(folder: Path) -> Loss:
    """Kill the supervisor of a stage that jogs; the servo stops it, then saves the rows."""
    house = House(folder)
    try:
        begun_t_ns = _jogging(house)
        servo = servo_pid(house.daemon)
        house.daemon.process.kill()
        house.daemon.process.wait()
        give_up_s = time.monotonic() + _PATIENCE_S
        while _works(servo) and time.monotonic() < give_up_s:
            with contextlib.suppress(StagectlError):
                house.look_back()
            time.sleep(0.1)
        with contextlib.suppress(StagectlError):  # the rig stays for five seconds
            house.look_back()
        return loss_of(house.daemon.runs, house.seen, begun_t_ns, int(house.seen["t_ns"][-1]))
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


def after_power_cut(folder: Path, jogged_s: float = 0.3) -> Loss:
    """Take the disk away under a stage that jogs, forget its memory, and count what is left on the disk.

    Raises NotHere where no disk can be mounted.
    """
    folder.mkdir(parents=True)
    _make_disk(folder / "image")
    with _disk(folder / "image", folder / "disk") as disk:
        house = House(folder / "house", runs=disk / "runs")
        try:
            begun_t_ns = _jogging(house, _SLOW_M_PER_S)
            time.sleep(jogged_s)
            servo = servo_pid(house.daemon)
            cut_t_ns = house.t_ns()
            _cut(disk)
            house.daemon.process.kill()
            os.kill(servo, signal.SIGKILL)
            seen = house.look_back()
            _forget_rings(disk)
        finally:
            house.close()
    with _disk(folder / "image", folder / "after") as disk:
        return loss_of(disk / "runs", seen, begun_t_ns, cut_t_ns)


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
