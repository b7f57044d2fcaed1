"""Opened on CAN and serial line, and as real-time as it is granted."""

import os
import shutil
from pathlib import Path

from stage_pc import UNIT, bring_cache, check, rig, servo_pid, shell, stage

CACHE = Path("/var/cache/stagectl")


def opened() -> None:
    """Drives and interferometer appear: the stage is opened."""
    bring_cache(CACHE)
    for place, folders, files in os.walk(CACHE):
        for name in [*folders, *files]:
            shutil.chown(os.path.join(place, name), "stagectl", "stagectl")
    rig.connect()
    shell("systemctl", "start", UNIT)  # where it doesn't run and wait already
    status = stage.await_state("idle", "fault")
    check("it opens the stage once the hardware is there", status["state"] == "idle", status["fault"])
    check("it is the hardware's", "vcan0" in status["backend_description"], status["backend_description"])
    check("the host refused the servo nothing", not status["remarks"], status["remarks"])


def real_time() -> None:
    """What the servo was granted, read back from /proc."""
    pid = servo_pid()
    policy, priority = os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority
    check("the servo is SCHED_FIFO 60", (policy, priority) == (os.SCHED_FIFO, 60), (policy, priority))
    last = (os.cpu_count() or 1) - 1
    check("the servo is on the last CPU alone", os.sched_getaffinity(pid) == {last}, os.sched_getaffinity(pid))
    facts = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    locked_kb, resident_kb = int(facts["VmLck"].split()[0]), int(facts["VmRSS"].split()[0])
    check("the servo's memory is locked", locked_kb > 0.5 * resident_kb, f"{locked_kb} of {resident_kb} kB")
