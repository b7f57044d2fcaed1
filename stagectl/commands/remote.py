"""Commands that go through the service: status, watch, move, jog, home, identify, stop, fault, lease, backend, log."""

import getpass
import os
import secrets
import socket as sockets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from rich.console import Console, RenderableType
from rich.markup import escape
from rich.table import Table

from stagectl.client import Client, error_of
from stagectl.commands.answer import ENDED_EARLY, EXIT_CODES, Answer, Voice, onto_stdout, say_line
from stagectl.errors import LinkError, RecordError, RequestError
from stagectl.service import messages
from stagectl.service.places import default_socket, is_served

ModelT = TypeVar("ModelT", bound=BaseModel)
CHECKED = ("move", "jog", "identify", "scan", "follow")
"""Motions that the service is asked about before the stage is homed and armed for them."""
_LEASE_S = 3.0
_POLL_S, _LOOK_S, _HEED_S = 0.2, 0.05, 3.0
_FINISHED = "FINISHED"
_MOTION = "arm"  # what a motion's run was begun by


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
    profile: str,
    usual_profile: str,
    backend: str,
    name: str,
    body: BaseModel,
) -> Answer:
    """Home where it is needed, arm, move; with a lease of our own the stage comes to rest without power."""
    with connected(socket) as stage:
        status = stage.status()
        _refuse_other(status, profile, usual_profile, backend)
        if name in CHECKED:
            stage.check(name, body)
        voice.note(f"{status.profile} through the service: {status.banner}")
        with leased(voice, stage, token):
            command = prepared(voice, stage, status, name)
            if command is None:
                command = follow(voice, stage, name, body)
        at_rest = stage.status()
    return answered(command, at_rest)


def _refuse_other(status: messages.Status, profile: str, usual_profile: str, backend: str) -> None:
    """Refuse options that mean another stage than the service has."""
    path = Path(profile)
    is_its_file = path.exists() and path.resolve() == Path(status.profile_path).resolve()
    if not is_its_file and profile not in (usual_profile, status.profile):
        raise RequestError(
            f"--profile {profile}: the service has {status.profile} ({status.profile_path}); leave the option out, "
            "or add --in-place for a stage of its own"
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


# ---- watching -----------------------------------------------------------------------------------------------------


def status(voice: Voice, socket: Path | None) -> Answer:
    """Show where things stand."""
    with connected(socket) as stage:
        found = stage.status()
    return Answer(found.model_dump(), [status_table(found)])


def watch(voice: Voice, socket: Path | None, as_json: bool, looks_count: int | None) -> Answer:
    """Show where things stand, again and again, until Ctrl-C or so many looks."""
    from rich.live import Live

    voice.left_behind = "the service goes on"
    with connected(socket) as stage:
        found = stage.status()
        if as_json:
            _look_again(voice, stage, looks_count, lambda seen: say_line(seen.model_dump_json()))
            return Answer({"looks_count": looks_count}, [])
        out = Console()

        def add(seen: messages.Status) -> None:  # into a pipe or a file: each look behind the last
            with onto_stdout():
                out.print(status_table(seen), "")

        if not out.is_terminal:
            _look_again(voice, stage, looks_count, add)
            return Answer({}, [])
        with Live(status_table(found), console=out, auto_refresh=False) as live:
            _look_again(voice, stage, looks_count, lambda seen: live.update(status_table(seen), refresh=True))
    return Answer({}, [])


def _look_again(voice: Voice, stage: Client, looks_count: int | None, show: Callable[[messages.Status], None]) -> None:
    looks = 0
    while looks_count is None or looks < looks_count:
        show(stage.status())
        looks += 1
        voice.check()
        time.sleep(_POLL_S)


def status_table(found: messages.Status) -> Table:
    """Lay a status out for a terminal."""
    table = Table.grid(padding=(0, 2))
    style = {"fault": "bold red", "off": "yellow", "idle": "cyan"}.get(found.state, "green")
    table.add_row("[dim]world[/]", f"[bold]{escape(found.banner)}[/]")
    table.add_row("[dim]state[/]", f"[{style}]{found.state}[/], {'homed' if found.homed else 'not homed'}")
    table.add_row("[dim]profile[/]", escape(f"{found.profile} ({found.profile_path})"))
    if found.waiting_for:
        table.add_row("[dim]waiting for[/]", f"[yellow]{escape(found.waiting_for)}[/]")
    if found.fault is not None:
        fault = found.fault
        table.add_row(f"[red]fault {fault.number}[/]", escape(f"{fault.at}, while {fault.state}: {fault.what}"))
        table.add_row("", escape(fault.values))
        table.add_row("[dim]what to do[/]", escape(fault.remedy))
    at = found.positions
    if at.sample_age_s is not None and at.end_position_m is None:
        text = f"the interferometer's newest sample is {at.sample_age_s:.1f} s old"
        table.add_row("[dim]end[/]", f"[yellow]not known: {text}[/]")
    if at.end_position_m is not None and at.error_m is not None:
        table.add_row("[dim]end[/]", f"{at.end_position_m * 1e3:.6f} mm, error {at.error_m * 1e6:.3f} um")
    if at.macro_position_m is not None and at.relative_position_m is not None:
        relative_um = at.relative_position_m * 1e6
        table.add_row("[dim]macro[/]", f"{at.macro_position_m * 1e3:.6f} mm, end minus macro {relative_um:.2f} um")
    if found.command is not None:
        table.add_row(
            "[dim]command[/]", escape(f"{found.command.text or found.command.name}  {found.command.share:.0%}")
        )
    lease = found.lease
    table.add_row("[dim]lease[/]", "free" if lease is None else escape(f"{lease.holder}, {lease.left_s:.1f} s"))
    for title, text in _joint_rows(found):
        table.add_row(title, text)
    health = found.health
    late = "" if health.lateness_p99_s is None else f", 99 % within {health.lateness_p99_s * 1e6:.0f} us"
    table.add_row("[dim]cycles[/]", f"{health.cycles_count}, {health.missed_cycles_count} missed{late}")
    if found.temperatures:
        table.add_row("[dim]drives[/]", ", ".join(_temperature(axis, one) for axis, one in found.temperatures.items()))
    if found.recording is not None:
        run = found.recording.run or "flight recorder only"
        table.add_row("[dim]recording[/]", escape(f"{run} {found.recording.trouble}".strip()))
    for remark in found.remarks:
        table.add_row("[dim]remark[/]", f"[yellow]{escape(remark)}[/]")
    return table


def _joint_rows(found: messages.Status) -> Iterator[tuple[str, str]]:
    """Say what is known of the joint now, and what of its wear passes a limit."""
    joint = found.wear or found.backlash
    if joint is None:
        return
    sd = "" if joint.width_sd_m is None else f" +- {joint.width_sd_m * 1e6:.2f} um"
    width = f"{joint.width_m * 1e6:.2f} um{sd}"
    if found.wear is None:
        yield "[dim]backlash[/]", escape(f"{width}, identified {joint.at}")
        return
    yield "[dim]backlash[/]", escape(f"{width}, {found.wear.source} at {joint.at}")
    if not found.wear.observable:
        yield "", f"[yellow]{escape(found.wear.text)}[/]"
    if found.wear.believed_since:
        yield "", escape(f"the compensation believes what it learned at {found.wear.believed_since}")
    if found.wear.alarm:
        yield "[red]wear[/]", f"[red]{escape(found.wear.alarm)}[/]"


def _temperature(axis: str, one: messages.Temperature) -> str:
    text = f"{axis} {one.degc:.1f} degC"
    return f"[yellow]{text}, warning[/]" if one.warning else text


def log(voice: Voice, socket: Path | None, lines_count: int) -> Answer:
    """Show what the service did last."""
    with connected(socket) as stage:
        voice.note(stage.status().banner)
        entries = stage.log(limit=lines_count)
    shown = [escape(f"{entry.at}  {entry.event:<15} {entry.text}") for entry in entries]
    return Answer({"entries": [entry.model_dump() for entry in entries]}, shown)


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
            _look_again(voice, stage, None, lambda seen: _still_ours(seen, taken.holder))
    return Answer({}, [])


def _still_ours(seen: messages.Status, holder: str) -> None:
    if seen.lease is None or seen.lease.holder != holder:
        raise RequestError("the lease was lost: it was not renewed in time; the stage was stopped")


def record(voice: Voice, socket: Path | None, name: str | None, end: bool) -> Answer:
    """Show what is recorded, begin a run, or end the one that was asked for."""
    if end and name is not None:
        raise RequestError(f"--name {name} and --end are both given; give one of them")
    with connected(socket) as stage:
        status = stage.status()
        if end:
            stage.end_record()
            status = _once_heeded(stage, lambda found: found is None or found.trigger != "request")
        elif name is not None:
            body = checked(messages.StartRecord, name=name)
            before = status.recording
            stage.record(body.name)
            status = _once_heeded(stage, lambda found: _is_begun(found, before))
            if status.recording is None or not status.recording.run:
                trouble = "the stage is not connected" if status.recording is None else status.recording.trouble
                raise RecordError(f"no run was begun: {trouble or f'not within {_HEED_S:g} s; see `stagectl log`'}")
            if status.recording.trigger == _MOTION:
                voice.note(f"{name} begins when the motion's run ends")
    voice.note(status.banner)
    found = status.recording
    text = "nothing: the stage is not connected"
    if found is not None:
        text = f"{found.run}, begun by {found.trigger}" if found.run else "the last seconds only, in memory"
    shown = [escape(text), *([f"[red]{escape(found.trouble)}[/]"] if found is not None and found.trouble else [])]
    return Answer({"recording": None if found is None else found.model_dump()}, shown)


def _is_begun(found: messages.Recording | None, before: messages.Recording | None) -> bool:
    """Tell whether a run is under way, or what is wrong is another thing than before."""
    return found is not None and bool(
        found.run or (found.trouble and (before is None or found.trouble != before.trouble))
    )


def _once_heeded(stage: Client, heeded: Callable[[messages.Recording | None], bool]) -> messages.Status:
    """Return the status that shows what was asked of the recording, or the newest where that takes too long."""
    give_up_s = time.monotonic() + _HEED_S
    while not heeded((found := stage.status()).recording) and time.monotonic() < give_up_s:
        time.sleep(_LOOK_S)
    return found


def trigger(voice: Voice, socket: Path | None, asked: dict[str, Any], reversal: bool, end: bool) -> Answer:
    """Show which event is waited for, set one, or end that."""
    level = "error_m" in asked or "contact_force_n" in asked
    if reversal and level:
        raise RequestError("--reversal and a level are both given; give one of them")
    if end and (reversal or asked):
        raise RequestError("--end and an event are both given; give one of them")
    if asked and not (reversal or level):
        option = "--" + next(iter(asked)).replace("_", "-")
        raise RequestError(f"{option} is of an event that is not given; add --error-m, --contact-force-n or --reversal")
    with connected(socket) as stage:
        status = stage.status()
        if end:
            stage.end_trigger()
            status = _once_heeded(stage, lambda found: found is None or not found.waits_for)
        elif reversal or level:
            stage.set_trigger(checked(messages.SetTrigger, **asked))
            status = _once_heeded(stage, lambda found: found is not None and bool(found.waits_for))
    voice.note(status.banner)
    found = status.recording
    waits_for = "" if found is None else found.waits_for
    return Answer({"waits_for": waits_for}, [f"waits for {waits_for}" if waits_for else "waits for no event"])


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
