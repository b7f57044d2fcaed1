"""Hours in short: a stage that jogs to and fro, clients that look on, and the memory of servo and supervisor."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stagectl.errors import StagectlError
from tests.faults.house import House
from tests.faults.kinds import MACRO
from tests.faults.mechanics import REST_M_PER_S
from tests.service.daemon import servo_pid

PAGE_BYTES = 4096
_LET_GO_S, _LOOK_S = 0.6, 1.0  # the pauses of one motion: its key is let go of, and held
_SAMPLED_S, _SAMPLES_COUNT = 30.0, 30  # at most so far apart, and at least so many


@dataclass(frozen=True)
class Soaked:
    """What the processes held since the warm-up, what was done meanwhile, and what the service said."""

    servo_bytes: tuple[int, ...]
    supervisor_bytes: tuple[int, ...]
    motions_count: int
    """Jogs that the rig saw at speed, and at rest again when their key was let go of."""
    cycles_count: int
    missed_count: int
    faults: tuple[str, ...]


def growth_bytes(samples: Sequence[int]) -> int:
    """Return the last sample less the lowest since the warm-up: a leak can't hide behind what was given back first."""
    return samples[-1] - min(samples)


def least_motions(duration_s: float) -> int:
    """Return how many motions a soak must have: half of what the pauses alone leave time for.

    The other half is for speeding up, braking and homing behind faults of the host: 0.73 came about in 150 s with one
    fault, 0.56 in 180 s with ten.
    """
    return int(0.5 * duration_s / (_LET_GO_S + _LOOK_S))


def own_bytes(pid: int) -> int:
    """Return the memory that a process has written to for itself: RssAnon of /proc."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/{pid}/status has no RssAnon")


def soak(folder: Path, duration_s: float, warm_up_s: float, say=lambda text: None) -> Soaked:
    """Jog to and fro for `duration_s` behind a warm-up; a fault of the host is acknowledged, counted, and goes on.

    RuntimeError where the stage can't be armed, or its servo is made anew.
    """
    house = House(folder)
    faults: list[str] = []
    try:
        house.daemon.state_is("idle")
        house.find_rig()
        if trouble := house.ready():
            raise RuntimeError(f"the scene could not be set: {trouble}")
        memory = _Memory(house, min(_SAMPLED_S, duration_s / _SAMPLES_COUNT))
        house.rig_fault(kind="emergency", node_id=MACRO, code=0x7305)  # what a fault's record takes once is taken
        work(house, warm_up_s, [], lambda: None)
        memory.look()
        cycles = _health(house)
        say(f"warm: servo {memory.servo_bytes[0]} bytes, supervisor {memory.supervisor_bytes[0]} bytes")
        motions_count = work(house, duration_s, faults, memory.look_when_due)
        memory.look()
        done = _health(house)
        return Soaked(
            tuple(memory.servo_bytes),
            tuple(memory.supervisor_bytes),
            motions_count,
            done[0] - cycles[0],
            done[1] - cycles[1],
            tuple(faults),
        )
    finally:
        house.close()


class _Memory:
    """The memory of servo and supervisor, looked at regularly."""

    def __init__(self, house: House, apart_s: float):
        """Remember whose memory it is."""
        self._house, self._apart_s, self._due_s = house, apart_s, 0.0
        self._servo = servo_pid(house.daemon)
        self.servo_bytes: list[int] = []
        self.supervisor_bytes: list[int] = []

    def look_when_due(self) -> None:
        """Look, if it is time."""
        if time.monotonic() >= self._due_s:
            self.look()

    def look(self) -> None:
        """Add a sample of each. RuntimeError where the servo is another one: its memory would begin anew."""
        if servo_pid(self._house.daemon) != self._servo:
            raise RuntimeError("the servo was made anew meanwhile")
        self.servo_bytes.append(own_bytes(self._servo))
        self.supervisor_bytes.append(own_bytes(self._house.daemon.process.pid))
        self._due_s = time.monotonic() + self._apart_s


def _health(house: House) -> tuple[int, int]:
    health = house.daemon.client.status().health
    return health.cycles_count, health.missed_cycles_count


def work(house: House, duration_s: float, faults: list[str], look: Callable[[], None]) -> int:
    """Jog to and fro, look at status and metrics, until the time is over; return how many motions came to their end.

    RuntimeError where the stage can't be armed.
    """
    until_s = time.monotonic() + duration_s
    motions_count, moves = 0, False
    while time.monotonic() < until_s:
        try:
            house.let_go()
            time.sleep(_LET_GO_S)
            moved, moves = moves, False
            fault = house.daemon.client.fault()
            if fault is not None:
                faults.append(f"{fault.kind}: {fault.values}")
            if trouble := house.ready():
                raise RuntimeError(f"the stage stood still: {trouble}")
            motions_count += moved and fault is None and house.speed_m_per_s < REST_M_PER_S
            moves = house.set_off()
            if not moves:
                faults.append("a jog did not set off")
            house.daemon.client.metrics()
            time.sleep(_LOOK_S)
        except StagectlError as error:
            faults.append(str(error))
        look()
    house.let_go()
    return motions_count
