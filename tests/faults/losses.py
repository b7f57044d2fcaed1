"""What a recording loses: rows against the SYNCs that the rig heard, after a kill and after a power cut, of a seed.

Stage, phase of its work, speed and instant are drawn from the seed, and whether the supervisor looks on while its servo
dies. The profile says nothing of recording: a run goes from arming to disarming, and its rows are held against the
SYNCs from the phase's begin on, pair by pair as the campaign does, until the drives stand or the power is cut.

A power cut is ext4's own shutdown without a flush (EXT4_IOC_SHUTDOWN, as xfstests cuts the power): from one instant
on the file system takes nothing more, and what the kernel held in memory, data and journal, never reaches the disk.
The disk is then mounted again, its journal played back, and the runs are read. What a disk's own cache would lose of
blocks that it has taken is not in it: fsync asks for that to be flushed, and a disk that lies about it can't be
helped.
"""

import contextlib
import fcntl
import itertools
import os
import signal
import struct
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stagectl.errors import StagectlError
from stagectl.profile import load_profile
from stagectl.record import read_run
from stagectl.ring import RingReader
from tests.faults import real
from tests.faults.house import House
from tests.faults.judge import REST_M_PER_S, Record
from tests.faults.kinds import CYCLE_S
from tests.faults.witness import ENABLED, STOPPING
from tests.service.daemon import servo_pid

SHIPPED_HEARTBEAT_S = load_profile("single-axis").trip.heartbeat_s

_DISK_BYTES = 192 << 20
_PATIENCE_S = 30.0
_STANDS_S = 0.8  # heartbeat time and ramp, and as much again
_RECORDED = ("jogging", "moving", "homing", "identifying", "at rest", "stopping")  # phases of which there is a run
_APART = 1000  # draws between two seeds: more than one ever needs
_SHARED_MEMORY = Path("/dev/shm")
_EXT4_IOC_SHUTDOWN, _NO_FLUSH = 0x8004_587D, 2  # linux/ext4.h


class NotHere(Exception):
    """This host lacks what the measurement needs."""


@dataclass(frozen=True)
class Loss:
    """Cycles on the bus, rows in the files, cycles that have none, and what could not be read."""

    syncs_count: int
    rows_count: int
    cycles_lost: int
    unreadable: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stopped:
    """What the drives did by themselves after `kill -9` of the servo, by the rig's own log; seconds."""

    begun_s: float  # until the macro's drive followed no command any more
    rest_s: float  # from then on, until the macro stood


@dataclass(frozen=True)
class Strike:
    """Where a kill or a cut meets the stage, as a seed says."""

    seed: int
    scene: real.Scenario  # its fault is not used
    supervisor_looks_away: bool  # while its servo is killed

    @property
    def text(self) -> str:
        """The strike in words."""
        scene, looks = self.scene, ", supervisor stopped first" if self.supervisor_looks_away else ""
        return f"seed {self.seed}: {scene.profile}, {scene.phase}, after {scene.wait_s * 1e3:.0f} ms{looks}"


def drawn(seed: int) -> Strike:
    """Draw stage, phase, speed and instant as the runs with real processes do; phases without a run are passed over."""
    scenes = map(real.drawn, itertools.count(_APART * seed))
    scene = next(one for one in scenes if one.phase in _RECORDED)
    return Strike(seed, scene, bool(np.random.default_rng([seed, 8]).random() < 0.5))


def loss_of(runs: Path, seen: dict[str, np.ndarray], begun_t_ns: int, until_t_ns: int) -> Loss:
    """Hold the rows of all runs against the SYNCs between two instants, in which an axis had power, each by itself."""
    folders = [folder for folder in sorted(runs.iterdir()) if (folder / "samples.arrow").exists()]
    # A file that the disk got no byte of (a session's, which has no rows) is read by the product's reader only.
    record, bad = Record([folder for folder in folders if (folder / "samples.arrow").stat().st_size]), []
    for folder in folders:
        try:
            read_run(folder)
        except (StagectlError, OSError) as error:
            bad.append(f"{folder.name}: {error}")
    syncs, t_ns = seen["sync_t_ns"], record.columns["t_ns"]
    at = np.searchsorted(seen["t_ns"], syncs).clip(max=seen["t_ns"].size - 1)
    powered = np.isin(seen["states"][at], (ENABLED, *STOPPING)).any(axis=1)
    owed = powered & (syncs >= begun_t_ns) & (syncs <= until_t_ns)
    rows_count = int(((t_ns >= begun_t_ns) & (t_ns <= until_t_ns)).sum())
    lost = int((unmatched(t_ns, syncs) & owed).sum())
    return Loss(int(owed.sum()), rows_count, lost, (*record.unreadable, *bad))


def unmatched(rows_t_ns: np.ndarray, syncs_t_ns: np.ndarray) -> np.ndarray:
    """Return which SYNCs have no row of their own: one begun before them, not long ago, and not taken.

    A host that holds the rig up has it hear many SYNCs at once, up to as late as the silence before them. A row without
    a SYNC hides a missing row no longer than `HICCUP_S`, and that silence.
    """
    free: list[int] = []
    alone, k = np.zeros(syncs_t_ns.size, bool), 0
    spans_ns = np.diff(syncs_t_ns, prepend=syncs_t_ns[:1], append=syncs_t_ns[-1:]).tolist()
    dense_ns, silence_ns = 0.5e9 * CYCLE_S, 0
    rows = rows_t_ns.tolist()
    for number, sync in enumerate(syncs_t_ns.tolist()):
        while k < len(rows) and rows[k] <= sync:
            free.append(rows[k])
            k += 1
        if spans_ns[number] >= dense_ns:
            silence_ns = spans_ns[number] if spans_ns[number + 1] < dense_ns else 0
        if free and sync - free[-1] <= silence_ns + round(1e9 * real.HICCUP_S):
            free.pop()
        else:
            alone[number] = True
    return alone


def counted_until(seen: dict[str, np.ndarray], killed_t_ns: int) -> int:
    """Return until when a killed servo owes a row: its last SYNC, or before it where it may have died behind that.

    It sends, then records; the time between is less than a cycle.
    """
    last_t_ns = int(seen["sync_t_ns"][-1])
    return last_t_ns - 1 if last_t_ns > killed_t_ns - round(1e9 * CYCLE_S) else last_t_ns


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


def _under_way(house: House, scene: real.Scenario) -> int:
    """Return an instant of the arming of a stage that is in its phase now. RuntimeError where it can't be had."""
    begun_t_ns, trouble = real.under_way(house, scene)
    if trouble:
        raise RuntimeError(f"the scene could not be set: {trouble}")
    return begun_t_ns


def after_servo_kill(folder: Path, strike: Strike) -> tuple[Loss, Stopped | None]:
    """Kill the servo, under the shipped heartbeat time; count what is kept when all has ended.

    How the drives stopped is told where the macro followed commands, and the supervisor looked away: it takes the rig
    along.
    """
    scene = strike.scene
    house = House(folder, profile=scene.profile, changes={"trip.heartbeat_s": SHIPPED_HEARTBEAT_S})
    try:
        begun_t_ns = _under_way(house, scene)
        supervisor, servo = house.daemon.process.pid, servo_pid(house.daemon)
        if strike.supervisor_looks_away:
            os.kill(supervisor, signal.SIGSTOP)
        seen, killed_t_ns = house.look_back(), house.t_ns()
        os.kill(servo, signal.SIGKILL)
        house.let_go()
        if strike.supervisor_looks_away:
            time.sleep(_STANDS_S)
            seen = house.look_back()
            os.kill(supervisor, signal.SIGCONT)
        else:
            with contextlib.suppress(StagectlError, OSError):  # then what was seen just before the kill has to do
                seen = house.look_back()
        house.daemon.state_is("fault", "idle")
        _until_closed(house.daemon.runs)
        loss = loss_of(house.daemon.runs, seen, begun_t_ns, counted_until(seen, killed_t_ns))
        at = min(int(np.searchsorted(seen["t_ns"], killed_t_ns)), seen["t_ns"].size - 1)
        follows = strike.supervisor_looks_away and seen["states"][at, 0] == ENABLED
        return loss, stopped(seen, killed_t_ns) if follows else None
    finally:
        house.close()


def after_supervisor_kill(folder: Path, strike: Strike) -> Loss:
    """Kill the supervisor; the servo stops the stage, then saves the rows."""
    house = House(folder, profile=strike.scene.profile)
    try:
        begun_t_ns = _under_way(house, strike.scene)
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


def after_both_killed(folder: Path, strike: Strike) -> Loss:
    """Kill servo and supervisor; the next service writes what their shared memory holds."""
    house = House(folder, profile=strike.scene.profile)
    try:
        begun_t_ns = _under_way(house, strike.scene)
        servo, killed_t_ns = servo_pid(house.daemon), house.t_ns()
        os.kill(servo, signal.SIGKILL)
        house.daemon.process.kill()
        house.daemon.process.wait()
        seen = house.look_back()
        house.daemon.start()
        house.daemon.client.lease_token = ""
        house.daemon.state_is("idle", "fault")
        _until_closed(house.daemon.runs)
        return loss_of(house.daemon.runs, seen, begun_t_ns, counted_until(seen, killed_t_ns))
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


def after_power_cut(folder: Path, strike: Strike) -> Loss:
    """Take the disk away under a stage that works, forget its memory, and count what is left on the disk.

    Raises NotHere where no disk can be mounted.
    """
    folder.mkdir(parents=True)
    _make_disk(folder / "image")
    with _disk(folder / "image", folder / "disk") as disk:
        house = House(folder / "house", disk / "runs", strike.scene.profile)
        try:
            begun_t_ns = _under_way(house, strike.scene)
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
