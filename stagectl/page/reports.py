"""Reports of recorded runs, drawn when somebody asks, by a command in a process of its own that yields to the servo."""

import asyncio
import os
import re
import sys
from pathlib import Path

from stagectl.errors import RecordError, RequestError, TimingError

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,200}")
_PATIENCE_S = 180.0
_SAID_LETTERS = 500


class Reports:
    """Finds a run's report, or has it drawn; one at a time."""

    def __init__(self, runs_root: Path, folder: Path):
        """Runs are read below `runs_root`; what is drawn is kept in `folder`, a run needs no write permission."""
        self._root, self._folder = runs_root, folder
        self._lock = asyncio.Lock()

    async def report(self, name: str) -> Path:
        """Return the page of a run. Errors: RequestError (no such run), RecordError, TimingError (can't be drawn)."""
        run = self._root / name
        if not _NAME.fullmatch(name) or not run.is_dir():
            raise RequestError(f"run {name[:80]!r}: there is none below {self._root}; give its folder with --runs")
        made = run / "report.html"
        if made.is_file():
            return made
        kept = self._folder / f"{name}.html"
        async with self._lock:
            # A run that closes gets a new manifest, and its folder a new time; it may close while it is drawn.
            run_ns = run.stat().st_mtime_ns
            if not kept.is_file() or kept.stat().st_mtime_ns != run_ns:
                await self._draw(run, kept)
                os.utime(kept, ns=(run_ns, run_ns))
        return kept

    async def _draw(self, run: Path, target: Path) -> None:
        command = [sys.executable, "-m", "stagectl.cli", "runs", "plot", str(run.resolve()), "--out", str(target)]
        drawing = await asyncio.create_subprocess_exec(
            *("nice", "-n", "19", *command),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "COLUMNS": "200"},
        )
        try:
            _, said = await asyncio.wait_for(drawing.communicate(), _PATIENCE_S)
        except TimeoutError as error:
            raise TimingError(f"{run.name}: not drawn within {_PATIENCE_S:g} s; try `stagectl runs plot`") from error
        finally:
            if drawing.returncode is None:
                drawing.kill()
        if drawing.returncode:
            text = said.decode(errors="replace").strip()[-_SAID_LETTERS:]
            raise RecordError(f"{run.name}: no report: {text}")
