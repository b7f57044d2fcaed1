"""TOML files for tests: a shipped file with some values changed, and where its numbers are."""

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

ABSENT = object()
"""Give this as a new value to take a key out."""

Location = tuple[str | int, ...]


def toml_of(value: Any) -> str:
    """Write a value as one line of TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml_of(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(toml_of(inner) for inner in value) + "]"
    return repr(value)


def location_of(dotted: str) -> Location:
    """Turn `effects[0].name` into ("effects", 0, "name")."""
    steps = dotted.replace("[", ".").replace("]", "").split(".")
    return tuple(int(step) if step.isdigit() else step for step in steps)


def dotted(location: Location) -> str:
    """Turn ("effects", 0, "name") into `effects[0].name`."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in location).removeprefix(".")


def changed(source: Path, changes: dict[str, Any]) -> str:
    """Return the text of `source` with the values at dotted keys replaced, added, or taken out."""
    data = copy.deepcopy(tomllib.loads(source.read_text()))
    for key, value in changes.items():
        *way, last = location_of(key)
        table: Any = data
        for step in way:
            table = table[step]
        if value is ABSENT:
            del table[last]
        else:
            table[last] = copy.deepcopy(value)
    return "\n".join(f"{key} = {toml_of(value)}" for key, value in data.items()) + "\n"


def numbers_in(value: Any, location: Location = ()) -> list[Location]:
    """Return the locations of all numbers below `value`."""
    if isinstance(value, dict):
        return [found for key, inner in value.items() for found in numbers_in(inner, (*location, key))]
    if isinstance(value, list):
        return [found for index, inner in enumerate(value) for found in numbers_in(inner, (*location, index))]
    return [location] if isinstance(value, int | float) and not isinstance(value, bool) else []
