"""One line of the comparison: the paper's number, ours as printed, ours corrected. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from stagectl.report import Figure

Value = float | str | None
"""A number in the row's unit (infinite: never reached), words where there is none ("diverges"), or None where the
column does not apply."""


@dataclass(frozen=True, slots=True)
class Row:
    """What one part of the paper says, and what it gives; all numbers in `unit`."""

    equation: str  # numbers of the paper: (12), Fig. 11
    quantity: str
    unit: str
    paper: Value
    printed: Value
    corrected: Value
    remark: str = ""


def pair(equation: str, quantity: str, unit: str, paper: Value, both: Sequence[Value], remark: str = "") -> Row:
    """Make a row of (as printed, corrected)."""
    printed, corrected = both
    return Row(equation, quantity, unit, paper, printed, corrected, remark)


@dataclass(frozen=True, slots=True)
class Chapter:
    """One section of the paper, worked through."""

    name: str  # as typed: `stagectl reproduce observer`
    section: str  # as in the paper
    title: str
    rows: Sequence[Row]
    figures: Sequence[Figure] = field(default=())
    readings: Sequence[str] = field(default=())  # what is assumed where the paper is silent or contradicts itself
