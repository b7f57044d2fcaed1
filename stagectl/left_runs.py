"""Runs of a service that is gone: what no recorder, no servo and no ring has any more is marked as recovered.

A session's own folder is such a run after each death of its service; the motion that it died in has the rows.
"""

from pathlib import Path

from stagectl.errors import RecordError
from stagectl.record import SAMPLES, Recovery, finish_left, read_manifest
from stagectl.ring import SHARED_MEMORY, RingReader, own_rings
from stagectl.whole_file import is_held


def finish_left_runs(runs_root: Path, ring_folder: Path = SHARED_MEMORY) -> list[tuple[Path, Recovery | RecordError]]:
    """Mark the service's runs that nobody records any more; a run that a ring still has rows of waits for them.

    To be called before a session begins. Returns (folder, what came of it) for each; how many rows the loss of power
    took is not known.
    """
    outcomes: list[tuple[Path, Recovery | RecordError]] = []
    if not runs_root.is_dir():
        return outcomes
    awaited = _awaited(ring_folder)
    for folder in sorted(path for path in runs_root.iterdir() if path.is_dir() and not path.is_symlink()):
        try:
            manifest = read_manifest(folder)
            left = manifest.get("kept_by") == "service" and manifest.get("record", {}).get("state") == "recording"
            if not left or folder.resolve() in awaited or is_held(folder / SAMPLES):
                continue
        except (RecordError, OSError):  # damaged, or another's: listed as what it is
            continue
        is_session = manifest.get("trigger") == "session"  # which holds no rows but those that a ring had
        try:
            outcomes.append((folder, finish_left(folder, 0 if is_session else None)))
        except RecordError as error:
            outcomes.append((folder, error))
    return outcomes


def _awaited(ring_folder: Path) -> set[Path]:
    """Return the folders that rings lead to, through a session's link where there is one."""
    folders: set[Path] = set()
    for ring_path in own_rings(ring_folder):
        try:
            folder = RingReader(ring_path).run_folder
        except RecordError:  # just gone, or none of this version
            continue
        if folder is not None:
            folders.add(folder.resolve())
    return folders
