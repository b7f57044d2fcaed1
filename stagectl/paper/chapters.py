"""The sections of the paper that are worked through, in its order. A section is imported when it is asked for."""

from collections.abc import Callable, Sequence
from importlib import import_module

from stagectl.errors import RequestError
from stagectl.paper.rows import Chapter

CHAPTERS = {
    "model": ("2, 5.1", "platform with coupling and backlash"),
    "quasi-linear": ("3.1", "quasi-linear backlash model"),
    "observer": ("3.2 A, 5.2", "super-twisting observer"),
    "identification": ("3.2 B, 5.2", "recursive least squares"),
    "decoupling": ("4.1", "backlash compensation and decoupling"),
    "sliding-mode": ("4.2", "adaptive integral sliding mode, Theorem 1"),
    "control": ("5.3", "cases A and B"),
    "rig": ("6.1", "identification on the rig's joint"),
    "comparison": ("6.2", "model against rig under one PID"),
}
"""Name as typed: (section of the paper, what it is about)."""

BEYOND = (
    "Identification while an ordinary motion runs, of wear, of soft contacts and at the limit of the sensors; control "
    "at the limit, with margins, flexible modes and a computed bound: `python -m bench paper` measures them, bar by "
    "bar. Figures of one commit are in docs/figures-paper.md.",
    "What an error of a stage of one's own is made of, and how far it is from the bound: `stagectl budget PROFILE`.",
)
"""What the paper has no equation, table, figure or claim of, and where it is measured; `rivals` says where they win."""


def asked(section: str | None) -> tuple[str, ...]:
    """Return the names of the chapters that a name or a section's number means; all for None. RequestError else."""
    if section is None:
        return tuple(CHAPTERS)
    wanted = section.strip().lower()
    found = tuple(name for name, (number, _) in CHAPTERS.items() if wanted in (name, *number.lower().split(", ")))
    if found:
        return found
    known = ", ".join(f"{name} ({number})" for name, (number, _) in CHAPTERS.items())
    raise RequestError(f"SECTION {section!r} is no section that is worked through; choose from {known}")


def work_through(names: Sequence[str], say: Callable[[str, float], None]) -> list[Chapter]:
    """Run chapters; `say` hears what is under way and which share is done."""
    done = []
    for number, name in enumerate(names):
        section, about = CHAPTERS[name]
        say(f"{section} {about}", number / len(names))
        done.append(import_module(f"stagectl.paper.{name.replace('-', '_')}_chapter").chapter())
    return done
