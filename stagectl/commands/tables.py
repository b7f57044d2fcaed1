"""Tables of a report, in the terminal; where it is too narrow for one, row by row, so that no number is cropped."""

from collections.abc import Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from stagectl.report import Quantity, Table

_UNBOUNDED = 10_000  # columns


@dataclass(frozen=True, slots=True)
class Lines:
    """A row as lines: what it is of, each of its cells behind the name of its column, and a remark."""

    title: str
    cells: Sequence[tuple[str, str]]
    remark: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Fold what is too long, and leave nothing out."""
        yield Text(self.title, style="bold", overflow="fold")
        grid = RichTable.grid(padding=(0, 2))
        grid.add_column(no_wrap=True)
        grid.add_column(overflow="fold")
        for name, cell in self.cells:
            grid.add_row(Text(name, style="cyan"), Text(cell))
        yield Padding(grid, (0, 0, 0, 2))
        if self.remark:
            yield Padding(Text(self.remark, style="dim", overflow="fold"), (0, 0, 0, 2))


@dataclass(frozen=True, slots=True)
class WideOrLines:
    """A table where the terminal has room for it, else its rows as lines; `least_width` None: room for every cell."""

    wide: RichTable
    lines: Sequence[Lines]
    least_width: int | None = None

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Choose by the width that is there."""
        needed = self.least_width
        if needed is None:
            needed = console.measure(self.wide, options=options.update(max_width=_UNBOUNDED)).maximum
        if needed <= options.max_width:
            yield self.wide
        else:
            yield from self.lines


def terminal(table: Table) -> Group:
    """Show a report's table with its title above and its note below; the first column is what the numbers are."""
    wide = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold cyan")
    for number, name in enumerate(table.columns):
        wide.add_column(name, justify="left" if number == 0 else "right", no_wrap=True)
    lines = []
    for row in table.rows:
        cells = [str(cell) if isinstance(cell, Quantity) else cell for cell in row]
        wide.add_row(*cells)
        named = [pair for pair in zip(table.columns[1:], cells[1:], strict=True) if pair[1]]
        lines.append(Lines(cells[0], named))
    parts = [Text(""), Text(table.title, style="bold"), Padding(WideOrLines(wide, lines), (0, 0, 0, 2))]
    if table.note:
        parts.append(Padding(Text(table.note, style="dim"), (0, 0, 0, 2)))
    return Group(*parts)
