"""How long the service's runs are kept: the oldest go, by age and by size; never one that is held, marked or another's.

A run is marked by a file `keep` in its folder. The time of day is an argument.
"""

import contextlib
import json
import shutil
from pathlib import Path
from typing import NamedTuple

from stagectl.record import MANIFEST, SAMPLES
from stagectl.whole_file import is_held

KEEP = "keep"


class Removed(NamedTuple):
    """A run that is gone, and why."""

    folder: Path
    because: str


class _Kept(NamedTuple):
    folder: Path
    size_bytes: int
    at_s: float


def prune(runs_root: Path, size_limit_bytes: float, age_limit_s: float, now_s: float) -> list[Removed]:
    """Remove what is too old, then the oldest until the rest fits; what can't be removed stays and counts."""
    kept = sorted(_candidates(runs_root), key=lambda one: one.folder.name)
    total_bytes = sum(one.size_bytes for one in kept)
    removed: list[Removed] = []
    for one in kept:
        age_s = now_s - one.at_s
        if age_s > age_limit_s:
            because = f"{age_s / 86400.0:.1f} days old, limit {age_limit_s / 86400.0:g}"
        elif total_bytes > size_limit_bytes:
            because = f"all runs of the service take {total_bytes / 1e9:.3f} GB, limit {size_limit_bytes / 1e9:g}"
        else:
            continue
        with contextlib.suppress(OSError):
            (one.folder / MANIFEST).unlink()  # first: what is half removed is no run any more
        shutil.rmtree(one.folder, ignore_errors=True)
        if not one.folder.exists():
            total_bytes -= one.size_bytes
            removed.append(Removed(one.folder, because))
    return removed


def _candidates(runs_root: Path) -> list[_Kept]:
    found: list[_Kept] = []
    if not runs_root.is_dir():
        return found
    for folder in runs_root.iterdir():
        try:
            if folder.is_symlink() or (folder / KEEP).exists() or is_held(folder / SAMPLES):
                continue
            manifest = json.loads((folder / MANIFEST).read_bytes())
            state = manifest.get("record", {}).get("state")
            if manifest.get("kept_by") != "service" or state not in ("closed", "recovered"):
                continue
            at_s = (folder / MANIFEST).stat().st_mtime
            size_bytes = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
        except (OSError, ValueError, AttributeError):  # damaged, or just going: not ours to judge
            continue
        found.append(_Kept(folder, size_bytes, at_s))
    return found
