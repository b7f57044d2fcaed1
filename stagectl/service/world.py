"""Whether the world that was asked for can be opened now."""

from pathlib import Path

from stagectl.errors import RecordError
from stagectl.profile import Profile
from stagectl.ring import RingReader, own_rings, writer_alive
from stagectl.stage import present


def missing(profile: Profile, backend: str, runs_root: Path) -> str:
    """Say what hardware is not there, or who still has it; empty where all is ready."""
    absent = [name for name, there in present(profile, backend).items() if not there]
    if absent:
        return f"{', '.join(absent)}: not there; plug it in, or ask for another backend"
    if not present(profile, backend):
        return ""
    for ring in own_rings():
        try:
            reader = RingReader(ring)
        except RecordError:
            continue  # gone meanwhile, or another version's
        folder = reader.run_folder
        if folder is not None and runs_root.resolve() in folder.resolve().parents and writer_alive(ring):
            return f"servo {reader.writer_pid} of the last service still brings the stage to rest"
    return ""
