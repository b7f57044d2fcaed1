"""The text of a profile in which values are written: comments and order kept, every value with where it is from.

Knows no findings: what is written, and why, is `application`'s. Pure.
"""

from dataclasses import dataclass
from typing import Any

import tomlkit
from tomlkit.items import AoT, InlineTable, Item

_DIGITS = 7


@dataclass(frozen=True, slots=True)
class Change:
    """One value that was written; `key` is dotted, `before` is None where the key is new."""

    key: str
    value: float
    before: float | None
    half_width: float | None  # of the 95 % interval; None where findings state none
    confirmed: bool
    remark: str = ""


class Sheet:
    """The document under way: what was written, what was left and why, and notes for the top."""

    def __init__(self, document: tomlkit.TOMLDocument, mark: str):
        self.document = document
        self.mark = mark
        self.written: list[Change] = []
        self.left: list[str] = []
        self.notes: list[str] = []  # of values whose place can't carry a comment

    @property
    def effects(self) -> list[Any]:
        return list(self.document.get("effects", ()))

    def set(self, table: Any, key: str, change: Change) -> None:
        """Write one value with its comment behind what stands there."""
        value = float(f"{change.value:.{_DIGITS}g}")
        item = tomlkit.float_(value)
        earlier = table.get(key)
        said = _said(self.mark, change)
        if isinstance(table, InlineTable):
            self.notes.append(f"{change.key}: {said}")
            table[key] = value
        else:
            old = earlier.trivia.comment.lstrip("# ").rstrip() if isinstance(earlier, Item) else ""
            table[key] = item
            table[key].comment(plain(f"{old}; {said}" if old else said))
            if not old:
                table[key].trivia.comment_ws = "  "
        self.written.append(change)

    def add_effect(self, head: str) -> tuple[str, Any]:
        """Add an empty `[[effects]]` table; returns its dotted key and the table."""
        known = self.document.get("effects")
        if known is None or (not isinstance(known, AoT) and not len(known)):
            if known is not None:
                del self.document["effects"]
            known = tomlkit.aot()
            self.document.append("effects", known)
            known = self.document["effects"]
        key = f"effects[{len(known)}]"
        if isinstance(known, AoT):
            table = tomlkit.table()
            table.comment(plain(head))
            table.trivia.comment_ws = "  "
            table.trivia.indent = "\n"  # a line between it and what stands before
            known.append(table)
        else:  # effects = [{ ... }, { ... }]
            table = tomlkit.inline_table()
            known.append(table)
            self.notes.append(f"{key}: {head}")
        return key, self.document["effects"][-1]


def mark_of(text: str, date: str) -> str:
    """Return the mark of this use of findings: its date, numbered where that day's mark is taken."""
    mark, number = f"gap {date}", 1
    while f"# {mark}:" in text:
        number += 1
        mark = f"gap {date} no. {number}"
    return mark


def below_title(text: str, lines: list[str]) -> str:
    """Put comment lines below the comment that a file begins with."""
    newline = "\r\n" if "\r\n" in text else "\n"
    rows = text.split(newline)
    first = next((k for k, row in enumerate(rows) if not row.startswith("#")), 0)
    return newline.join([*rows[:first], *lines, *rows[first:]])


def plain(text: str) -> str:
    """Return text that may stand in a comment: control characters have no place in TOML."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _said(mark: str, change: Change) -> str:
    """Return the comment of one value."""
    parts = []
    if change.half_width is not None:
        low, high = change.value - change.half_width, change.value + change.half_width
        parts.append(f"{low:.4g} .. {high:.4g} (95 %)")
    if change.remark:
        parts.append(change.remark)
    if change.before is not None:
        parts.append(f"was {change.before:.{_DIGITS}g}")
        if not change.confirmed:
            parts.append("candidate, not confirmed yet")
    return f"{mark}: {'; '.join(parts)}" if parts else mark
