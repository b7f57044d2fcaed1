"""Shared memory of a stage whose processes are gone: its ring is recovered, the other blocks are of no use to anybody.

A service that is killed whole, as by its watchdog, leaves 17 MB behind, each time, until the host restarts.
"""

import os
import re
from pathlib import Path

from stagectl.ring import SHARED_MEMORY

_BLOCK = re.compile(r"stagectl-(\d+)-[0-9a-f]+\.(requests|segments|status)")


def remove_left_blocks(folder: Path = SHARED_MEMORY) -> list[Path]:
    """Remove the blocks of dead supervisors beside which no ring lies any more; returns them.

    While there is a ring its servo may still bring a stage to rest by them. What is another user's stays.
    """
    removed = []
    for path in sorted(folder.glob("stagectl-*")):
        named = _BLOCK.fullmatch(path.name)
        if named is None or path.with_suffix(".ring").exists() or _lives(int(named.group(1))):
            continue
        try:
            path.unlink()
        except OSError:  # another user's, or gone meanwhile
            continue
        removed.append(path)
    return removed


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's, but it lives
        return True
    return True
