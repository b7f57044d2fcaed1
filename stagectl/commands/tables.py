"""Tables of a report, in the terminal."""

from rich import box
from rich.table import Table as RichTable
from rich.text import Text

from stagectl.report import Quantity, Table


def terminal(table: Table) -> RichTable:
    """Show a report's table; numbers stand right, the first column is what they are."""
    shown = RichTable(
        title=Text(table.title, style="bold"),
        title_justify="left",
        caption=Text(table.note, style="dim") if table.note else None,
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        title_style="",
        caption_style="",
    )
    for number, name in enumerate(table.columns):
        shown.add_column(name, justify="left" if number == 0 else "right", no_wrap=number > 0)
    for row in table.rows:
        shown.add_row(*(str(cell) if isinstance(cell, Quantity) else cell for cell in row))
    return shown
