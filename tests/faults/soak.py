"""Hours in short: a stage that jogs to and fro, clients that look on, and the memory of servo and supervisor."""

import time
from dataclasses import dataclass
from pathlib import Path

from stagectl.errors import StagectlError
from tests.faults.house import House
from tests.service.daemon import servo_pid

PAGE_BYTES = 4096
_LOOK_S = 1.0


@dataclass(frozen=True)
class Growth:
    """What the processes took more after the warm-up, and what the service said meanwhile."""

    servo_bytes: int
    supervisor_bytes: int
    cycles_count: int
    missed_count: int
    faults: tuple[str, ...]


def own_bytes(pid: int) -> int:
    """Return the memory that a process has written to for itself: RssAnon of /proc."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/{pid}/status has no RssAnon")


def soak(folder: Path, duration_s: float, warm_up_s: float, say=lambda text: None) -> Growth:
    """Jog to and fro for `duration_s` behind a warm-up; a fault of the host is acknowledged, counted, and goes on."""
    house = House(folder)
    faults: list[str] = []
    try:
        house.daemon.state_is("idle")
        house.find_rig()
        if trouble := house.ready():
            raise RuntimeError(f"the scene could not be set: {trouble}")
        servo, supervisor = servo_pid(house.daemon), house.daemon.process.pid
        _work(house, warm_up_s, faults)
        before = own_bytes(servo), own_bytes(supervisor)
        cycles = _health(house)
        say(f"warm: servo {before[0]} bytes, supervisor {before[1]} bytes")
        _work(house, duration_s, faults)
        if servo_pid(house.daemon) != servo:
            raise RuntimeError(f"the servo was made anew meanwhile: {faults}")
        after = own_bytes(servo), own_bytes(supervisor)
        done = _health(house)
        return Growth(
            after[0] - before[0], after[1] - before[1], done[0] - cycles[0], done[1] - cycles[1], tuple(faults)
        )
    finally:
        house.close()


def _health(house: House) -> tuple[int, int]:
    health = house.daemon.client.status().health
    return health.cycles_count, health.missed_cycles_count


def _work(house: House, duration_s: float, faults: list[str]) -> None:
    """Jog to and fro, look at status and metrics, until the time is over."""
    until_s = time.monotonic() + duration_s
    while time.monotonic() < until_s:
        try:
            fault = house.daemon.client.fault()
            if fault is not None:
                faults.append(f"{fault.kind}: {fault.values}")
            house.let_go()
            time.sleep(0.6)
            if house.ready() == "":
                house.set_off()
            house.daemon.client.metrics()
            time.sleep(_LOOK_S)
        except StagectlError as error:
            faults.append(str(error))
    house.let_go()
