"""What the commands do, behind their arguments; a module is imported when one of its commands runs.

Importing all of them takes seconds; `stagectl --help` needs none.
"""

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stagectl.commands import (
        budget,
        demo,
        gap,
        gap_demo,
        gap_next,
        jog_keys,
        motion,
        page,
        planned_motion,
        planning,
        profiles,
        recording,
        remote,
        reproduce,
        runs,
        serve,
        tune,
        watching,
    )

__all__ = [
    "budget",
    "demo",
    "gap",
    "gap_demo",
    "gap_next",
    "jog_keys",
    "motion",
    "page",
    "planned_motion",
    "planning",
    "profiles",
    "recording",
    "remote",
    "reproduce",
    "runs",
    "serve",
    "tune",
    "watching",
]


def __getattr__(name: str) -> ModuleType:
    """Import a module of commands where it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.{name}")
