"""What survives a restart of the service: profile, world, the backlash that was identified last, with its date, and the
fault that nobody has acknowledged yet.

Homing does not: a stage that nobody watched may be anywhere.
"""

import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from stagectl.errors import RecordError
from stagectl.service.messages import Backlash, Fault
from stagectl.whole_file import replace_whole

FILE = "service.json"


class Remembered(BaseModel):
    """The content of the file."""

    model_config = ConfigDict(extra="forbid")

    profile: str = ""
    """Path or name that the profile was read from."""
    profile_name: str = ""
    backend: str = ""
    """World that was open last, or was asked for since."""
    backend_asked: str = ""
    """What was asked for when that world was chosen: `auto`, or the world itself."""
    swapped_from: str = ""
    """What the service was started with when a client chose that world; empty where none did."""
    joints: dict[str, Backlash] = {}
    """By world and profile: what the rig's joint is says nothing of the machine's."""
    faults_count: int = 0
    fault: Fault | None = None
    """Not acknowledged yet."""
    powered_since: str = ""
    """Empty while no stage has power."""


def state_folder() -> Path:
    """Return where the file lies: $STATE_DIRECTORY (systemd), else below the user's state."""
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "stagectl"


def recall(folder: Path) -> tuple[Remembered, str]:
    """Return what was kept, and a remark where that can't be read: the service starts without it then."""
    path = folder / FILE
    try:
        return Remembered.model_validate(json.loads(path.read_bytes())), ""
    except FileNotFoundError:
        return Remembered(), ""
    except (OSError, ValueError, ValidationError) as error:
        return Remembered(), f"{path}: can't be read ({type(error).__name__}); begun anew, identify the backlash again"


def keep(folder: Path, remembered: Remembered) -> None:
    """Write the file, whole or not at all. Errors: RecordError."""
    path = folder / FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_whole(path, remembered.model_dump_json(indent=2).encode())
    except OSError as error:
        raise RecordError(
            f"{path}: can't be kept: {error.strerror}; free space, or give another folder with --state"
        ) from error


class Memory:
    """What is remembered now, kept on the disk with every change; a disk that refuses is said and stops nothing."""

    def __init__(self, folder: Path, remembered: Remembered, refused: Callable[[str], None]):
        """Go on from what was recalled; `refused` hears what the disk says."""
        self._folder, self.now, self._refused = folder, remembered, refused
        self._writes = threading.Lock()

    def keep(self, **changes: Any) -> None:
        """Change some of it, and wait for the disk: for a stage that nobody moves."""
        self.now = self.now.model_copy(update=changes)
        self._write()

    def _write(self) -> None:
        with self._writes:
            try:
                keep(self._folder, self.now)
            except RecordError as error:
                self._refused(str(error))

    def joint(self, backend: str, profile_name: str) -> Backlash | None:
        """Return what a joint was when it was identified last; None where nobody did."""
        return self.now.joints.get(f"{backend} {profile_name}")

    def keep_joint(self, found: Backlash) -> None:
        """Keep what a joint was identified as, beside those of other worlds; the disk is not waited for.

        The stage may have power: a disk that took half a second longer than usual would stop it, SUPERVISOR_SILENT.
        """
        self.now = self.now.model_copy(
            update={"joints": {**self.now.joints, f"{found.backend} {found.profile_name}": found}}
        )
        threading.Thread(target=self._write, name="memory", daemon=True).start()

    @property
    def next_fault_number(self) -> int:
        """Number of the next fault; numbers go on over restarts."""
        return self.now.faults_count + 1
