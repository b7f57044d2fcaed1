"""Tables of a report, in the terminal."""

from rich import box
from rich.console import Group
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from stagectl.report import Quantity, Table


def terminal(table: Table) -> Group:
    """Show a report's table with its title above and its note below; the first column is what the numbers are."""
    shown = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold cyan")
    for number, name in enumerate(table.columns):
        shown.add_column(name, justify="left" if number == 0 else "right", no_wrap=True)
    for row in table.rows:
        shown.add_row(*(str(cell) if isinstance(cell, Quantity) else cell for cell in row))
    parts = [Text(""), Text(table.title, style="bold"), Padding(shown, (0, 0, 0, 2))]
    if table.note:
        parts.append(Padding(Text(table.note, style="dim"), (0, 0, 0, 2)))
    return Group(*parts)
