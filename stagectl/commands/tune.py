"""`stagectl tune`: gains from design rules, with the bandwidth and the margin that are asked for."""

from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any

from rich.markup import escape

from stagectl import toml_file
from stagectl.commands.answer import Answer, Voice
from stagectl.commands.new_profile import refuse_place, text_of, write_checked
from stagectl.commands.opening import law_name
from stagectl.commands.tables import terminal
from stagectl.errors import RequestError
from stagectl.profile import load_profile, search_folders
from stagectl.tuning import page
from stagectl.tuning.patch import Change, patched
from stagectl.tuning.rules import Asked, Assessment, tuned

PAGE = "tune.html"


def show(
    voice: Voice, profile: str, law: str | None, asked: Asked, new: Path | None, force: bool, folder: Path
) -> Answer:
    """Find gains, draw them, and with `new` write a profile; the old one is never touched."""
    believed = load_profile(profile)
    name = law_name(law, believed)
    path = toml_file.find(profile, search_folders(), "profile")
    if new is not None:
        refuse_place(path, new, force)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"--page {folder}: can't be made: {error.strerror}; give another folder") from error
    found = tuned(believed, name, asked, voice.progress)
    voice.progress("drawing the page", 0.9)
    page.report(f"Gains of {believed.name} under {name}", found, asked).write(folder / PAGE)
    voice.progress.done()
    changes: list[Change] = []
    if new is not None:
        reason = f"Ms {found.after.worst_sensitivity:.2f}, delay margin {found.after.least_delay_margin_s * 1e3:.2f} ms"
        text, changes = patched(text_of(path), found.values, date=date.today().isoformat(), reason=reason)
        write_checked(text, new, "gains")
    shown: list[Any] = [terminal(page.values_table(found)), terminal(page.margins_table(found)), ""]
    shown += [page.verdict(found), f"page: {escape(str(folder / PAGE))}"]
    shown.append(f"profile: {escape(str(new))}" if new is not None else "write a profile with them: -o NEW_PROFILE")
    data = {
        "profile": believed.name,
        "law": name,
        "asked": asdict(asked),
        "values": found.values,
        "old_values": found.old_values,
        "before": _data(found.before),
        "after": _data(found.after),
        "page": folder / PAGE,
        "new_profile": new,
        "changes": [asdict(change) for change in changes],
        "verdict": page.verdict(found),
    }
    return Answer(data, shown)


def _data(one: Assessment) -> dict[str, Any]:
    return {
        "places": {loop.place: asdict(loop.margins) for loop in one.loops},
        "hold_m": one.hold_m,
        "step_peak_m": one.step_peak_m,
        "stable_with_other_mass": one.stable_with_other_mass,
        "worst_sensitivity_ratio": one.worst_sensitivity,
        "least_delay_margin_s": one.least_delay_margin_s,
    }
