"""`stagectl record` and `trigger`: runs that are asked for, and events that are waited for."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.markup import escape

from stagectl.client import Client
from stagectl.commands.answer import Answer, Voice
from stagectl.commands.remote import checked, connected
from stagectl.errors import RecordError, RequestError
from stagectl.service import messages

_MOTION, _REQUEST = "arm", "request"  # what a run was begun by
_HEED_S, _LOOK_S = 3.0, 0.05


def record(voice: Voice, socket: Path | None, name: str | None, end: bool) -> Answer:
    """Show what is recorded, begin a run, or end the one that was asked for."""
    if end and name is not None:
        raise RequestError(f"--name {name} and --end are both given; give one of them")
    with connected(socket) as stage:
        status = stage.status()
        if end:
            stage.end_record()
            status = _once_heeded(stage, lambda found: not (_is_on_request(found) or _is_to_come(found)))
        elif name is not None:
            before = status.recording
            stage.record(checked(messages.StartRecord, name=name).name)
            status = _once_heeded(
                stage,
                lambda found: _is_on_request(found) or _is_behind_motion(found) or _is_newly_refused(found, before),
            )
            if _is_behind_motion(status.recording):
                voice.note(f"{name} begins when the motion's run ends")
            elif not _is_on_request(status.recording):
                trouble = "the stage is not connected" if status.recording is None else status.recording.trouble
                raise RecordError(f"no run was begun: {trouble or f'not within {_HEED_S:g} s; see `stagectl log`'}")
    voice.note(status.banner)
    found = status.recording
    text = "nothing: the stage is not connected"
    if found is not None:
        text = f"{found.run}, begun by {found.trigger}" if found.run else "the last seconds only, in memory"
        text += f"; then {found.next_name}" if found.next_name else ""
    shown = [escape(text), *([f"[red]{escape(found.trouble)}[/]"] if found is not None and found.trouble else [])]
    return Answer({"recording": None if found is None else found.model_dump()}, shown)


def _is_on_request(found: messages.Recording | None) -> bool:
    return found is not None and found.run != "" and found.trigger == _REQUEST


def _is_to_come(found: messages.Recording | None) -> bool:
    return found is not None and found.next_name != ""


def _is_behind_motion(found: messages.Recording | None) -> bool:
    return found is not None and found.trigger == _MOTION and _is_to_come(found)


def _is_newly_refused(found: messages.Recording | None, before: messages.Recording | None) -> bool:
    """Tell whether the disk refuses something else than before."""
    return found is not None and found.trouble not in ("", "" if before is None else before.trouble)


def _once_heeded(stage: Client, heeded: Callable[[messages.Recording | None], bool]) -> messages.Status:
    """Return the status that shows what was asked of the recording, or the newest where that takes too long."""
    give_up_s = time.monotonic() + _HEED_S
    while not heeded((found := stage.status()).recording) and time.monotonic() < give_up_s:
        time.sleep(_LOOK_S)
    return found


def _once_heard(stage: Client) -> messages.Status:
    """Return a status that knows what was asked before: the second new one, as the first may be in the making.

    By what it waits for that can't be seen: it may have waited for the same before.
    """
    found, newer_count, give_up_s = stage.status(), 0, time.monotonic() + _HEED_S
    while newer_count < 2 and time.monotonic() < give_up_s:
        time.sleep(_LOOK_S)
        before, found = found, stage.status()
        newer_count += found.uptime_s != before.uptime_s
    if newer_count < 2:
        raise RecordError(f"the service did not say within {_HEED_S:g} s what became of it; see `stagectl trigger`")
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
        elif reversal or level:
            stage.set_trigger(checked(messages.SetTrigger, **asked))
        if end or reversal or level:
            status = _once_heard(stage)
    voice.note(status.banner)
    found = status.recording
    waits_for = "" if found is None else found.waits_for
    return Answer({"waits_for": waits_for}, [f"waits for {waits_for}" if waits_for else "waits for no event"])
