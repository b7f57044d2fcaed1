"""New gains written into the text of a profile: text in, text out, comments and order kept. Pure."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Item

from stagectl.errors import ProfileError

_TABLE = "control"


@dataclass(frozen=True, slots=True)
class Change:
    """One value that was written; `before` is None where the profile did not state it."""

    key: str
    value: float
    before: float | None


def patched(document_text: str, values: Mapping[str, float], *, date: str, reason: str) -> tuple[str, list[Change]]:
    """Write values into [control], each with a comment that says when and what it was; equal values stay untouched.

    Errors: ProfileError where the text is no TOML or has no such table.
    """
    try:
        tomllib.loads(document_text)
        document = tomlkit.parse(document_text)
    except (ValueError, TOMLKitError) as error:
        raise ProfileError(f"the profile is not TOML: {error}; correct that line") from error
    if not isinstance(document.get(_TABLE), Mapping):
        raise ProfileError(f"the profile has no table [{_TABLE}]; see `stagectl profile check`")
    table: Any = document[_TABLE]
    changes = []
    for key, value in values.items():
        item = table.get(key)
        before = float(item) if item is not None else None
        if before == value:
            continue
        changes.append(Change(f"{_TABLE}.{key}", value, before))
        old, space = "", "  "
        if isinstance(item, Item) and item.trivia.comment:
            old, space = item.trivia.comment.lstrip("# ").rstrip(), item.trivia.comment_ws
        table[key] = tomlkit.float_(value)
        if isinstance(table, InlineTable):
            continue  # one line has no room for comments
        said = f"tune {date}: {reason}" + (f"; was {before:g}" if before is not None else "")
        table[key].comment(f"{old}; {said}" if old else said)
        table[key].trivia.comment_ws = space
    return tomlkit.dumps(document), changes
