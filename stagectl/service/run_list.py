"""The list of runs that clients ask for: one at a time, and nothing is read twice that did not change.

The stage's thread shares its processor with whoever asks, and the servo stops the stage where it is held up.
"""

import asyncio
from pathlib import Path

from starlette.concurrency import run_in_threadpool

from stagectl.record import MANIFEST, SAMPLES
from stagectl.runs import RunSummary, run_folders, summary
from stagectl.whole_file import is_held

_Looks = tuple[object, ...]


class RunList:
    """Summaries of the runs below a folder, with what their files looked like when they were made."""

    def __init__(self, runs_root: Path):
        """Nothing is known yet."""
        self._runs_root = runs_root
        self._one_at_a_time = asyncio.Lock()
        self._known: dict[Path, tuple[_Looks, RunSummary]] = {}

    async def summaries(self) -> list[RunSummary]:
        """Return all runs, oldest first; rows of one under way are not counted. Errors: RequestError."""
        async with self._one_at_a_time:
            return await run_in_threadpool(self._look)

    def _look(self) -> list[RunSummary]:
        known: dict[Path, tuple[_Looks, RunSummary]] = {}
        for folder in run_folders(self._runs_root):
            looks = _looks(folder)
            before = self._known.get(folder)
            if before is None or before[0] != looks:
                before = looks, summary(folder, count_under_way=False)
            known[folder] = before
        self._known = known
        return [one for _, one in known.values()]


def _looks(folder: Path) -> _Looks:
    """Return what changes when a run goes on, is closed, recovered or left by its recorder."""
    looks: list[object] = []
    for name in (MANIFEST, SAMPLES):
        try:
            facts = (folder / name).stat()
        except OSError:  # it has none, or is going
            looks.append(None)
        else:
            looks.append((facts.st_mtime_ns, facts.st_size, facts.st_ino))
    try:
        looks.append(is_held(folder / SAMPLES))
    except OSError:
        looks.append(None)
    return tuple(looks)
