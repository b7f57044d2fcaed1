"""The page of the comparison: chapter for chapter the paper's numbers beside ours, the readings, the figures."""

import math
from collections.abc import Sequence

from stagectl.paper.rows import Chapter, Row, Value
from stagectl.report import Figure, Quantity, Report, Section, Table

TITLE = "Kang et al. 2023, reproduced"
_BANNER = (
    "Everything here is simulated, the paper's rig included: no recording of it is published. As printed: the paper's "
    "equations and numbers, in the reading that is stated where it contradicts itself. Corrected: what the project "
    "takes in its place. A dash means that the column does not apply or that the paper has no number."
)
COLUMNS = ("paper", "what", "paper's", "as printed", "corrected", "remark")


def page(chapters: Sequence[Chapter], beyond: Sequence[str]) -> Report:
    """Make the page; `beyond` says where it goes on."""
    parts: list[Table | Figure | Section] = []
    for chapter in chapters:
        parts.append(Table(f"{chapter.section}. {chapter.title}", COLUMNS, [cells(row) for row in chapter.rows]))
        parts.append(Section("Readings", chapter.readings))
        parts += chapter.figures
    if beyond:
        parts.append(Section("Beyond the paper", beyond))
    paper = "Kang et al., Machines 11(12):1044, 2023, doi 10.3390/machines11121044"
    return Report(TITLE, _BANNER, parts=parts, facts=[("Paper", paper)])


def cells(row: Row) -> list[str | Quantity]:
    """Lay a row out under COLUMNS."""
    values = [shown(value, row.unit) for value in (row.paper, row.printed, row.corrected)]
    return [row.equation, row.quantity, *values, row.remark]


def shown(value: Value, unit: str) -> str | Quantity:
    """Give a number its unit; words stay words, and what has no end is one."""
    if value == math.inf:
        return "\u221e"
    return value if isinstance(value, str) else Quantity(value, unit)
