"""Open a stage: choose the world once, at the start, and hand out the supervisor that works in it."""

import socket
from importlib import metadata
from pathlib import Path
from typing import Any

from sim_backend.machine import load_machine, machine_path_for
from stagectl.backend import RIG, RIG_DRIVES, RIG_SENSOR, BatchBackend, HardwareBackend, RigBackend
from stagectl.errors import LinkError, RecordError, RequestError
from stagectl.profile import Profile
from stagectl.run_folder import reserve
from stagectl.runs import new_run_folder
from stagectl.session import Progress
from stagectl.supervisor import Supervisor

BACKENDS = ("auto", "hardware", RIG, RIG_DRIVES, RIG_SENSOR, "batch")


def present(profile: Profile, backend: str = "hardware") -> dict[str, bool]:
    """Say which parts of the profile's hardware this host has, of those that a world needs."""
    found = {"CAN": _bus(profile), "interferometer": _port(profile)}
    needed = {"hardware": ("CAN", "interferometer"), RIG_DRIVES: ("interferometer",), RIG_SENSOR: ("CAN",)}
    return dict(found[part] for part in needed.get(backend, ()))


def _port(profile: Profile) -> tuple[str, bool]:
    return f"interferometer {profile.interferometer.port}", Path(profile.interferometer.port).exists()


def _bus(profile: Profile) -> tuple[str, bool]:
    if profile.can.interface == "socketcan":
        try:
            socket.if_nametoindex(profile.can.channel)
            has_bus = True
        except OSError:
            has_bus = False
    else:
        has_bus = Path(profile.can.channel).exists()
    return f"CAN {profile.can.interface} {profile.can.channel}", has_bus


def choose(profile: Profile, backend: str) -> str:
    """Resolve `auto`: the rig only where nothing of the hardware exists; half of it is a LinkError."""
    if backend not in BACKENDS:
        raise RequestError(f"backend {backend!r} is none of {', '.join(BACKENDS)}")
    if backend != "auto":
        return backend
    parts = present(profile)
    if not any(parts.values()):
        return "rig"
    if all(parts.values()):
        return "hardware"
    missing = ", ".join(name for name, there in parts.items() if not there)
    found = ", ".join(name for name, there in parts.items() if there)
    raise LinkError(
        f"profile {profile.name}: {found} is there, {missing} is not; plug it in, or ask for --backend rig by name"
    )


def machine_of(profile: Profile, backend: str, machine: str | Path | None = None) -> str | Path | None:
    """Return the machine that a simulated world plays, None where nothing is simulated.

    The one named, else the profile's; ProfileError where it has none.
    """
    if backend == "hardware":
        return None
    return machine if machine is not None else machine_path_for(profile.name)


def _folder_of(profile: Profile, runs_root: Path, name: str, kept_by_service: bool) -> Path:
    """Reserve a run's folder; the service may go on without, where the disk is full and the profile wants it so."""
    try:
        return reserve(runs_root, name)
    except RecordError:
        if not kept_by_service or profile.record.on_full_disk == "stop":
            raise
        return new_run_folder(runs_root, name)


def open_stage(
    profile: Profile,
    backend: str = "auto",
    *,
    runs_root: Path,
    name: str,
    seed: int = 0,
    machine: str | Path | None = None,
    progress: Progress = lambda what, share: None,
    manifest: dict[str, Any] | None = None,
    **watching: Any,
) -> Supervisor:
    """Open the world and return its supervisor; entering that configures the drives and starts the servo.

    `watching` goes to the supervisor: `lease_left_s`, `observe`, `record`.
    Makes the run's folder: whoever leaves it empty gives it back (`run_folder.give_back`).
    """
    chosen = choose(profile, backend)
    truth_of = machine_of(profile, chosen, machine)
    progress(f"opening {chosen}", 0.0)
    if truth_of is None:
        world = HardwareBackend(profile)
    else:
        world = (
            BatchBackend(load_machine(truth_of), seed=seed)
            if chosen == "batch"
            else RigBackend(profile, truth_of, seed=seed, plays=chosen)
        )
    facts = {
        "backend_asked": backend,
        **(manifest or {}),  # a caller that resolved `auto` itself says so there
        "name": name,
        "host": socket.gethostname(),
        "version": metadata.version("stagectl"),
        "seeds": [seed],
    }
    try:
        folder = _folder_of(profile, runs_root, name, kept_by_service="record" in watching)
    except BaseException:
        world.close()
        raise
    return Supervisor(profile, world, folder, progress, facts, **watching)
