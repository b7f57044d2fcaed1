"""`stagectl serve`: the daemon in the foreground."""

from pathlib import Path

from stagectl.commands.answer import Answer, Voice
from stagectl.commands.opening import refuse_no_folder
from stagectl.errors import RequestError
from stagectl.profile import load_profile
from stagectl.service.daemon import serve as serve_stage
from stagectl.service.places import default_socket
from stagectl.service.remembered import state_folder
from stagectl.service.stage_state import Settings
from stagectl.stage import BACKENDS
from stagectl.suggestion import closest


def serve(
    voice: Voice,
    profile: str | None,
    backend: str,
    runs_root: Path,
    seed: int,
    socket: Path | None,
    tcp: int | None,
    state: Path | None,
) -> Answer:
    """Check what can be checked, then serve until SIGTERM."""
    if backend not in BACKENDS:
        raise RequestError(f"--backend {backend!r}: there is no such backend{closest(backend, BACKENDS)}")
    refuse_no_folder(runs_root)
    if profile is not None:
        load_profile(profile)

    def take_over() -> None:  # signals are the service's from here on; one that came before ends the command
        voice.check()
        voice.hush()

    settings = Settings(profile or "", backend, runs_root, state or state_folder(), seed)
    try:
        serve_stage(settings, socket or default_socket(), tcp, take_over)
    except KeyboardInterrupt:
        return Answer({}, ["ended before it began"])
    return Answer({}, [])
