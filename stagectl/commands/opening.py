"""Open a stage for a command: progress and interrupts reach it, and whatever happens it comes to rest and is closed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from stagectl.commands.answer import Voice
from stagectl.errors import RequestError, StagectlError
from stagectl.outcome import Outcome
from stagectl.profile import Profile, load_profile
from stagectl.run_folder import give_back
from stagectl.run_scores import VALUE_SEAM, write_truth
from stagectl.stage import BACKENDS, open_stage
from stagectl.suggestion import closest
from stagectl.supervisor import Supervisor
from stagectl.tracker import LAW_NAMES


@dataclass(frozen=True, slots=True)
class Place:
    """Where and with what a command works, as its options say."""

    profile: Profile
    backend: str
    runs_root: Path
    seed: int

    @property
    def is_value_seam(self) -> bool:
        """Whether the machine stands straight behind the law."""
        return self.backend == VALUE_SEAM


def place(profile: str, backend: str, runs_root: Path, seed: int) -> Place:
    """Check the options that every moving command has. Errors: ProfileError, RequestError."""
    known = (*BACKENDS, VALUE_SEAM)
    if backend not in known:
        raise RequestError(f"--backend {backend!r}: there is no such backend{closest(backend, known)}")
    refuse_no_folder(runs_root)
    return Place(load_profile(profile), backend, runs_root, seed)


def refuse_no_folder(runs_root: Path) -> None:
    """Refuse a folder of runs that is a file, or lies below one, before anything moves. Errors: RequestError."""
    standing = next(path for path in (runs_root, *runs_root.absolute().parents) if path.exists())
    if not standing.is_dir():
        raise RequestError(f"--runs {runs_root}: {standing} is a file; give a folder")
    if not os.access(standing, os.W_OK | os.X_OK):
        raise RequestError(f"--runs {runs_root}: {standing} can't be written; give another folder or its permissions")


def law_name(asked: str | None, profile: Profile) -> str:
    """Return the law asked for, the profile's where none was. Errors: RequestError."""
    law = profile.control.law if asked is None else asked
    if law not in LAW_NAMES:
        raise RequestError(f"--law {law!r}: there is no such law; one of {', '.join(LAW_NAMES)} is needed")
    return law


@contextmanager
def opened(where: Place, name: str, voice: Voice) -> Iterator[Supervisor]:
    """Yield a connected supervisor; leaving brings the stage to rest, keeps the truth where known, closes the run."""
    stage = open_stage(
        where.profile,
        where.backend,
        runs_root=where.runs_root,
        name=name,
        seed=where.seed,
        progress=voice.progress,
    )
    voice.run_folder = stage.folder
    try:
        voice.note(f"{where.profile.name} on {stage.backend.description}")
        if where.backend == "auto" and stage.backend.name != "hardware":
            voice.note("auto: neither the profile's CAN interface nor its serial port is here, so the rig plays it")
        with stage:
            try:
                yield stage
            except BaseException:
                voice.hush()
                with suppress(StagectlError):  # what is under way already says more than what follows from it
                    _keep_truth(stage)
                raise
            voice.hush()
            _keep_truth(stage)
    finally:
        give_back(stage.folder)


def _keep_truth(stage: Supervisor) -> None:
    """Bring the stage to rest and keep what was true, while there is somebody who knows."""
    stage.disarm()
    truth = stage.backend.truth()
    if truth is not None:
        from sim_backend.machine import load_machine  # scoring, and only that, may read what the rig is

        write_truth(stage.folder, truth, load_machine(stage.profile.name).backlash)


def home_and_arm(stage: Supervisor, law: str | None = None) -> Outcome:
    """Home, then hold under a law; an Outcome that is not finished says why not."""
    homed = stage.home()
    return stage.armed(law) if homed.finished else homed
