"""What was found, as effects of a model: for the simulation that judges, and for the profile that a person reads.

Pure.
"""

from typing import Any

from stagectl.effects import CATALOGUE
from stagectl.gap.believed import Believed
from stagectl.gap.workflow import Findings, Named


def effects_with(
    believed: Believed, findings: Findings, named: tuple[Named, ...], session: str
) -> list[dict[str, Any]]:
    """Return the belief's effects as refitted, and those of `named`, with the phases of one session."""
    found: list[dict[str, Any]] = []
    for row in believed.effects:
        error = findings.refitted.get(f"{row['name']} on {row['acts_on']}", 0.0)
        scaled = {name: row[name] * (1.0 + error) for name in CATALOGUE[row["name"]].linear}
        found.append({**row, **scaled})
    return found + [table_of(effect, session) for effect in named]


def table_of(effect: Named, session: str) -> dict[str, Any]:
    """Return one found effect as an `[[effects]]` table, with the phases of one session."""
    own = {
        name.split(" of ")[0]: value
        for name, value in effect.parameters.items()
        if " of " not in name or name.endswith(f" of session {session}")
    }
    known = CATALOGUE[effect.name].parameters
    return {"name": effect.name, "acts_on": effect.acts_on} | {name: own.get(name, 0.0) for name in known}
