"""`stagectl reproduce`: the paper run as printed and as corrected, beside its own numbers."""

from dataclasses import asdict
from pathlib import Path

from rich import box
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from stagectl.commands.answer import Answer, Voice
from stagectl.commands.tables import Lines, WideOrLines
from stagectl.errors import RequestError
from stagectl.paper.chapters import BEYOND, asked, work_through
from stagectl.paper.page import COLUMNS, cells, page
from stagectl.paper.rows import Chapter
from stagectl.profile import load_profile

PAGE = "paper.html"
_STAGE = "oled-printer"

_NUMBERS = COLUMNS[2:5]
_LEAST_WIDTH = 72  # of a table: in less its labels have no room
_LABEL_WIDTH = 12
_NUMBER_WIDTH = 12  # words may be longer, and wrap


def show(voice: Voice, section: str | None, out: Path) -> Answer:
    """Work sections through, write the page, and lay the numbers side by side."""
    names = asked(section)
    _make_folder(out)
    chapters = work_through(names, voice.progress)
    rivals = _rivals(voice) if section is None else ()
    voice.progress("drawing the page", 0.0)
    page(chapters, (*BEYOND, *rivals) if section is None else ()).write(out / PAGE)
    voice.progress.done()
    data = {
        "sections": [
            {
                "name": chapter.name,
                "section": chapter.section,
                "title": chapter.title,
                "rows": [asdict(row) for row in chapter.rows],
                "readings": list(chapter.readings),
            }
            for chapter in chapters
        ],
        "rivals": list(rivals),
        "page": str(out / PAGE),
    }
    shown = [
        part for chapter in chapters for part in (f"\n[bold]{chapter.section}. {chapter.title}[/]", _table(chapter))
    ]
    if rivals:
        shown += ["\n[bold]Beyond the paper: linear rivals[/]", *map(escape, rivals)]
    return Answer(data, [*shown, f"page: {escape(str(out / PAGE))}"])


def _rivals(voice: Voice) -> tuple[str, ...]:
    """Say where linear rivals are better than the law, on the stage that the project ships."""
    from sim_backend.machine import load_machine
    from stagectl.paper.rivals import said

    voice.progress("beyond the paper: linear rivals", 0.0)
    return said(load_profile(_STAGE), load_machine(_STAGE))


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"--out {out}: can't be made: {error.strerror}; give another folder") from error


def _table(chapter: Chapter) -> WideOrLines:
    """Lay rows out with every number whole; remarks stand under what they are of."""
    rows = [[str(cell) for cell in cells(row)] for row in chapter.rows]
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold cyan")
    table.add_column("paper", max_width=_LABEL_WIDTH, overflow="fold")
    table.add_column("what", ratio=1, overflow="fold")
    for place, name in enumerate(_NUMBERS, start=2):
        longest = max((len(cells_of_row[place]) for cells_of_row in rows), default=0)
        width = min(max(longest, len(name)), _NUMBER_WIDTH)
        table.add_column(name, justify="right", width=width, overflow="fold")
    lines = []
    for equation, what, *numbers, remark in rows:
        text = Text(what)
        if remark:
            text.append(f"\n{remark}", style="dim")
        table.add_row(equation, text, *numbers)
        lines.append(Lines(f"{equation} {what}", list(zip(_NUMBERS, numbers, strict=True)), remark))
    return WideOrLines(table, lines, _LEAST_WIDTH)
