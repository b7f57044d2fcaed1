"""How long the service's runs are kept: the oldest go, by age and by size; never one that is held, marked or another's.

A run is marked by a file `keep` in its folder. A run's age is the time that a service has been there since the run was
closed, counted in a file beside the runs: by the time of day, a clock that began in 1970 and is set makes all runs old.
"""

import contextlib
import json
import math
import shutil
from pathlib import Path
from typing import NamedTuple

from stagectl.record import MANIFEST, SAMPLES
from stagectl.whole_file import is_held, replace_whole

KEEP = "keep"
AGES = ".ages.json"


class Removed(NamedTuple):
    """A run that is gone, and why."""

    folder: Path
    because: str


class _Kept(NamedTuple):
    folder: Path
    size_bytes: int
    age_s: float


def prune(runs_root: Path, size_limit_bytes: float, age_limit_s: float, elapsed_s: float) -> list[Removed]:
    """Remove what is too old, then the oldest until the rest fits; what can't be removed stays and counts.

    elapsed_s: since the last call, or since the service began.
    """
    ages_s = _read_ages(runs_root)
    kept = [one._replace(age_s=ages_s.get(one.folder.name, -elapsed_s) + elapsed_s) for one in _candidates(runs_root)]
    kept.sort(key=lambda one: (-one.age_s, one.folder.name))
    total_bytes = sum(one.size_bytes for one in kept)
    removed: list[Removed] = []
    for one in kept:
        if one.age_s > age_limit_s:
            because = f"{one.age_s / 86400.0:.1f} days old, limit {age_limit_s / 86400.0:g}"
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
    if kept:
        with contextlib.suppress(OSError):  # a full disk: they are as old as before
            ages = {one.folder.name: one.age_s for one in kept if one.folder.exists()}
            replace_whole(runs_root / AGES, json.dumps(ages).encode())
    return removed


def _read_ages(runs_root: Path) -> dict[str, float]:
    """Return what is known; where that can't be read, every run is new again."""
    try:
        content = json.loads((runs_root / AGES).read_bytes())
        return {name: float(age_s) for name, age_s in content.items() if 0.0 <= float(age_s) < math.inf}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


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
            size_bytes = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
        except (OSError, ValueError, AttributeError):  # damaged, or just going: not ours to judge
            continue
        found.append(_Kept(folder, size_bytes, 0.0))
    return found
