"""Commands that go through the service: move, jog, home, identify, stop, fault, lease, backend."""

import getpass
import os
import secrets
import socket as sockets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from rich.console import RenderableType
from rich.markup import escape

from stagectl.client import Client, error_of
from stagectl.commands.answer import ENDED_EARLY, EXIT_CODES, Answer, Voice, say_line
from stagectl.errors import LinkError, RequestError
from stagectl.service import messages
from stagectl.service.places import default_socket, is_served

ModelT = TypeVar("ModelT", bound=BaseModel)
_LEASE_S = 3.0
_POLL_S, _LOOK_S = 0.2, 0.05
_FINISHED = "FINISHED"


def served(socket: Path | None, lease: str | None, in_place: bool) -> bool:
    """Tell whether a command goes through a service: one answers, and nobody asked for another way.

    LinkError where a socket or a lease was named and nobody answers: another stage, in place, is not what was meant.
    """
    if in_place:
        return False
    path = socket or default_socket()
    if is_served(path):
        return True
    if socket is not None or lease:
        named = f"socket {socket}" if socket is not None else "a lease"
        raise LinkError(
            f"{named} was named, and no service answers at {path}; start it (stagectl serve), or ask for a stage of "
            "this command's own with --in-place"
        )
    return False


def checked(kind: type[ModelT], /, **values: Any) -> ModelT:
    """Make a request of the API; RequestError where the value of an option can't be in it."""
    try:
        return kind(**values)
    except ValidationError as error:
        problem = error.errors()[0]
        option = "--" + ".".join(str(part) for part in problem["loc"]).replace("_", "-")
        raise RequestError(messages.sentence({**problem, "loc": (option,)})) from error


def connected(socket: Path | None) -> Client:
    """Return a client; LinkError comes with its first request where nobody serves."""
    return Client(socket)


def _holder() -> str:
    return f"{getpass.getuser()}@{sockets.gethostname()} (pid {os.getpid()})"


@contextmanager
def leased(voice: Voice, stage: Client, token: str | None) -> Iterator[None]:
    """Work under a lease that somebody holds (`token`), or under one of our own that ends with the command.

    An interrupt leaves the stage at rest either way: a lease that goes on would have its motion go on too.
    """
    voice.left_behind = "the stage was brought to rest; what it did is in the service's run"
    if not token:
        with stage.lease(_holder(), _LEASE_S):
            yield
        return
    stage.lease_token = token
    try:
        yield
    except KeyboardInterrupt:
        _brought_to_rest(voice, stage)
        raise


def _brought_to_rest(voice: Voice, stage: Client) -> messages.Status:
    found = stage.stop()
    while found.state in ("arming", "armed", "moving", "identifying", "stopping"):
        voice.progress("coming to rest", 0.0)
        time.sleep(_LOOK_S)
        found = stage.status()
    voice.progress.done()
    return found


# ---- motion -------------------------------------------------------------------------------------------------------


def motion(
    voice: Voice,
    socket: Path | None,
    token: str | None,
    profile: str | None,
    backend: str,
    name: str,
    body: BaseModel,
) -> Answer:
    """Home where it is needed, arm, move; with a lease of our own the stage comes to rest without power."""
    with connected(socket) as stage:
        status = stage.status()
        refuse_other(status, profile, backend)
        voice.note(f"{status.profile} through the service: {status.banner}")
        with leased(voice, stage, token):
            if name != "home":  # which is what the others may begin with
                stage.check(name, body)
            command = prepared(voice, stage, status, name)
            if command is None:
                command = follow(voice, stage, name, body)
        at_rest = stage.status()
    return answered(command, at_rest)


def refuse_other(status: messages.Status, profile: str | None, backend: str) -> None:
    """Refuse options that mean another stage than the service has."""
    if profile not in (None, status.profile, status.profile_path):
        path = Path(profile)
        if not (path.exists() and path.resolve() == Path(status.profile_path).resolve()):
            its_name = status.profile or "not read its own"
            raise RequestError(
                f"--profile {profile}: the service has {its_name} ({status.profile_path}); leave the option (or "
                "STAGECTL_PROFILE) out, or add --in-place for a stage of its own"
            )
    if backend not in ("auto", status.backend):
        raise RequestError(
            f"--backend {backend}: the service has {status.backend or 'none yet'}; change that with "
            "`stagectl backend`, or add --in-place for a stage of its own"
        )


def prepared(voice: Voice, stage: Client, status: messages.Status, name: str) -> messages.Command | None:
    """Home and arm; returns what went wrong, None where the stage holds."""
    if name == "home":
        return None
    if not status.homed:
        homed = follow(voice, stage, "home", messages.Home())
        if homed.stop != _FINISHED:
            return homed
    if stage.status().state == "idle":
        armed = follow(voice, stage, "arm", messages.Arm())
        if armed.stop != _FINISHED:
            return armed
    return None


def follow(voice: Voice, stage: Client, name: str, body: BaseModel) -> messages.Command:
    """Send a command and show how far it is until it ends. Errors: what the service says."""
    found = stage.begin(name, body, f"cli-{secrets.token_hex(12)}")
    while found.state not in ("done", "failed"):
        voice.progress(found.text or name, found.share)
        found = stage.command(found.key, _POLL_S)
    voice.progress.done()
    if found.error is not None:
        raise error_of(found.error)
    return found


def answered(command: messages.Command, status: messages.Status) -> Answer:
    finished = command.stop in ("", _FINISHED)
    text = f"{command.name}: {command.text}"
    shown: list[RenderableType] = [escape(text) if finished else f"[red]ended early[/]: {escape(text)}"]
    joint = command.backlash
    if joint is not None:
        sd = "" if joint.width_sd_m is None else f" +- {joint.width_sd_m * 1e6:.2f} um"
        shown.append(f"backlash {joint.width_m * 1e6:.2f} um{sd}")
    shown.append(f"run     {escape(command.run)}")
    data = {
        "stop": command.stop,
        "finished": finished,
        "text": text,
        "run": command.run,
        "backlash": None if joint is None else joint.model_dump(),
        "end_position_m": status.positions.end_position_m,
        "state": status.state,
        "banner": status.banner,
        "remarks": status.remarks,
    }
    ended_early = EXIT_CODES[LinkError] if command.stop == "LINK_LOST" else ENDED_EARLY
    return Answer(data, shown, 0 if finished else ended_early)


# ---- the rest -----------------------------------------------------------------------------------------------------


def stop(voice: Voice, socket: Path | None) -> Answer:
    """Bring the stage to rest, and wait until it has no power."""
    with connected(socket) as stage:
        found = _brought_to_rest(voice, stage)
    voice.note(found.banner)
    return Answer({"state": found.state}, [f"stopped; the state is {found.state}"])


def fault(voice: Voice, socket: Path | None, token: str | None, acknowledge: bool) -> Answer:
    """Show the fault, or take note of it."""
    with connected(socket) as stage:
        voice.note(stage.status().banner)
        found = stage.fault()
        if found is None:
            return Answer({"fault": None, "acknowledged": False}, ["no fault"])
        shown = [
            f"[red]fault {found.number}[/] {escape(found.at)}, while {found.state}",
            escape(f"{found.what}: {found.values}"),
            escape(f"what to do: {found.remedy}"),
        ]
        if acknowledge:
            with leased(voice, stage, token):
                follow(voice, stage, "acknowledge", messages.Acknowledge(number=found.number))
            shown.append("acknowledged; nothing was enabled")
    data = {"fault": found.model_dump(), "acknowledged": acknowledge}
    return Answer(data, shown, 0 if acknowledge else ENDED_EARLY)


def lease(voice: Voice, socket: Path | None, hold: bool, as_json: bool) -> Answer:
    """Show who holds the lease, or hold it until Ctrl-C."""
    with connected(socket) as stage:
        voice.note(stage.status().banner)
        if not hold:
            held = stage.lease_state()
            text = "free" if held is None else f"{held.holder}, {held.left_s:.1f} s left"
            return Answer({"lease": None if held is None else held.model_dump()}, [escape(text)])
        with stage.lease(_holder(), _LEASE_S) as taken:
            voice.left_behind = "the lease was given back; the stage is without power"
            say_line(taken.model_dump_json() if as_json else f"export STAGECTL_LEASE={taken.token}")
            voice.note("held until Ctrl-C; then the stage comes to rest without power")
            while True:
                _refuse_lost(stage.status(), taken.holder)
                voice.check()
                time.sleep(_POLL_S)


def _refuse_lost(seen: messages.Status, holder: str) -> None:
    if seen.lease is None or seen.lease.holder != holder:
        raise RequestError("the lease was lost: it was not renewed in time; the stage was stopped")


def backend(voice: Voice, socket: Path | None, token: str | None, name: str | None) -> Answer:
    """Show which world it is, or change it."""
    with connected(socket) as stage:
        if name is not None:
            asked = checked(messages.SwapBackend, backend=name)
            with leased(voice, stage, token):
                follow(voice, stage, "backend", asked)
        found = stage.status()
    shown = [found.banner, *([f"waiting for {escape(found.waiting_for)}"] if found.waiting_for else [])]
    data = {"backend": found.backend, "banner": found.banner, "waiting_for": found.waiting_for, "state": found.state}
    return Answer(data, shown)
