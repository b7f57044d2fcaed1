"""What a stage PC has to show: installed, upgraded, opened, read back; hurt while a drive homes; moved, and hurt then.

Runs as root in the guest. One line a check; exit code 1 where one failed. The file `machine` beside this one says which
of the three; names of groups in the file `only` (from $GUEST_CHECKS) leave out the others.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from breakage import (
    can_down,
    clock_stepped,
    homed,
    recorded,
    recovered,
    serial_unplugged,
    servo_killed,
    servo_out_of_memory,
    supervisor_hung,
    supervisor_killed,
    supervisor_out_of_memory,
)
from installation import confined, everything, installed, ready, reloaded, removed, upgraded
from motions import moved
from opening import opened, real_time
from stage_pc import HERE, UNIT, Failed, check, report, rig, shell
from worlds import swapped

CLOCK = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
Group = Callable[[], None]
# For each machine of run.sh: what all else rests on, then what can be left out.
GROUPS: dict[str, tuple[tuple[Group, ...], tuple[Group, ...]]] = {
    "installation": ((installed, upgraded, opened), (confined, real_time, reloaded)),
    "homing": (
        (ready, opened),
        # Those that strike the drive's own homing come before it moves elsewhere: its index is far off.
        (
            *(supervisor_hung, servo_out_of_memory, supervisor_out_of_memory, supervisor_killed),
            *(homed, swapped, recorded, recovered),
        ),
    ),
    "motion": (
        (ready, opened),
        # Once everything was in use: a machine that has just started is busy, and its interferometer's lines are late.
        (servo_killed, can_down, moved, clock_stepped, serial_unplugged, recorded),  # those behind `moved` still homed
    ),
}


def tried(what: Callable[[], None]) -> bool:
    """Do a group of checks; what breaks it is a failed check."""
    report.say(f"----    {(what.func if isinstance(what, partial) else what).__doc__}")
    try:
        what()
    except (Failed, OSError, LookupError, TypeError, ValueError) as error:
        check("these checks came to their end", False, f"{type(error).__name__}: {error}")
        return False
    return True


def main() -> int:
    """Do it all; 1 where a check failed."""
    names = (HERE / "only").read_text().split()
    before = everything()
    report.say(f"        its clock is {CLOCK.read_text().strip()}")
    foundation, groups = GROUPS[(HERE / "machine").read_text().strip()]
    if all(tried(what) for what in foundation):
        for what in groups:
            if not names or what.__name__ in names:
                tried(what)
    tried(partial(removed, before))
    if report.failed:
        print(rig.said())
        print(shell("journalctl", "-u", UNIT, "--no-pager", "-o", "short-monotonic")[-12000:])
    print(f"{report.count} checks, {len(report.failed)} failed", *report.failed, sep="; ")
    return 1 if report.failed else 0


if __name__ == "__main__":
    sys.exit(main())
