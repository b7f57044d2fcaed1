"""Tables in a terminal of any width: no number is cropped, none is left out."""

import io
import re

import pytest
from rich.console import Console

from stagectl.commands.tables import terminal
from stagectl.report import Quantity, Table

GAINS = Table(
    "Gains",
    ("key", "was", "tuned"),
    [
        ["control.micro_drift_n_per_sqrt_s", "0.048", "0.0681"],
        ["control.adaptive_gain_ceiling_ratio", "0.05", "0.0575"],
    ],
)
MARGINS = Table(
    "Margins",
    ("loop", "Ms", "margin", "crossover", "hold", "0.1 N step"),
    [
        ["was: right contact", Quantity(1.94, "1"), Quantity(2e-3, "s", prefix="m"), Quantity(52.2, "Hz"), "", ""],
        ["tuned: gap", "unstable", Quantity(1.88e-3, "s", prefix="m"), Quantity(54.1, "Hz"), "3.39 nm", "58.9 nm"],
    ],
    "What the columns are.",
)


def shown(table: Table, columns: int) -> str:
    out = io.StringIO()
    Console(file=out, width=columns).print(terminal(table))
    return out.getvalue()


@pytest.mark.parametrize("columns", [40, 60, 80])
@pytest.mark.parametrize("table", [GAINS, MARGINS], ids=["gains", "margins"])
def test_every_cell_is_whole(table, columns):
    text = shown(table, columns)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= columns
    for row in table.rows:
        for cell in filter(None, map(str, row)):
            assert re.search(rf"(?<!\S){re.escape(cell)}(?!\S)", text)
    for name in table.columns[1:]:
        assert name in text


def test_where_there_is_room_a_row_is_a_line():
    assert re.search(r"tuned: gap +unstable +1\.88 ms +54\.1 Hz +3\.39 nm +58\.9 nm", shown(MARGINS, 80))
    assert re.search(r"control\.micro_drift_n_per_sqrt_s +0\.048 +0\.0681", shown(GAINS, 60))


def test_where_there_is_none_each_number_stands_behind_its_name():
    lines = [line.strip() for line in shown(MARGINS, 40).splitlines()]
    first = lines.index("tuned: gap")
    assert [re.split(r"  +", line) for line in lines[first + 1 : first + 6]] == [
        ["Ms", "unstable"],
        ["margin", "1.88 ms"],
        ["crossover", "54.1 Hz"],
        ["hold", "3.39 nm"],
        ["0.1 N step", "58.9 nm"],
    ]
    assert lines[lines.index("was: right contact") + 4] == "tuned: gap"  # an empty cell has no line
