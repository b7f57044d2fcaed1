"""What was found, as effects of a model: for the simulation that judges, and for the profile that a person reads.

Pure.
"""

import re
from collections.abc import Mapping
from typing import Any

from stagectl.effects import CATALOGUE
from stagectl.gap.believed import Believed
from stagectl.gap.findings import Findings, Named

_OF_A_PLACE = re.compile(r"(\w+) of (session|run) (.*)", re.DOTALL)


def effects_with(
    believed: Believed, findings: Findings, named: tuple[Named, ...], session: str
) -> list[dict[str, Any]]:
    """Return the belief's effects as refitted, and those of `named`, with the phases of one session."""
    found = [{**row, **refitted(row, findings.refitted.get(key_of(row), 0.0))} for row in believed.effects]
    return found + [table_of(effect, session) for effect in named]


def key_of(row: Mapping[str, Any]) -> str:
    """Return the name that findings give to an effect of the profile."""
    return f"{row['name']} on {row['acts_on']}"


def refitted(row: Mapping[str, Any], error_ratio: float) -> dict[str, float]:
    """Return the parameters that change where an effect of the profile is wrong by a ratio: its amplitudes."""
    return {name: row[name] * (1.0 + error_ratio) for name in CATALOGUE[row["name"]].linear}


def table_of(effect: Named, session: str) -> dict[str, Any]:
    """Return one found effect as an `[[effects]]` table, with the phases of one session."""
    own: dict[str, float] = {}
    for name, value in effect.parameters.items():
        parameter, place = parted(name)
        if place in ("", f"session {session}"):
            own[parameter] = value
    known = CATALOGUE[effect.name].parameters
    return {"name": effect.name, "acts_on": effect.acts_on} | {name: own.get(name, 0.0) for name in known}


def parted(name: str) -> tuple[str, str]:
    """Part the name of a found value into the parameter, and the session or run that it is of; "" for the machine."""
    match = _OF_A_PLACE.fullmatch(name)
    return (match[1], f"{match[2]} {match[3]}") if match else (name, "")
