"""`stagectl status`, `watch` and `log`: where things stand, and what the service did."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from stagectl.client import Client
from stagectl.commands.answer import Answer, Voice, onto_stdout, say_line
from stagectl.commands.remote import connected
from stagectl.service import messages

_POLL_S = 0.2


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
