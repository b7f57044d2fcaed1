"""The report of a run: one HTML page that needs nothing beside it. What is drawn on it stands in `figures`.

Takes plain numbers and pictures; knows no run folder. Readable on a phone, on paper, in light and dark schemes.
"""

import base64
import html
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from stagectl.errors import RecordError, RequestError

INK, MUTED, GRID = "#1b1f24", "#5b6570", "#dde2e8"
SERIES = ("#d55e00", "#0072b2", "#009e73", "#aa4499")
"""Okabe and Ito's colours, told apart by every kind of colour vision; the first is the rival, the second ours."""

_PAGE_COLOURS = {  # colour in the drawing: (name on the page, the same in the dark scheme)
    INK: ("ink", "#e8ebef"),
    MUTED: ("muted", "#a3adb8"),
    GRID: ("grid", "#343b44"),
    SERIES[0]: ("series-1", "#ff9248"),
    SERIES[1]: ("series-2", "#5ab4ee"),
    SERIES[2]: ("series-3", "#35c9a0"),
    SERIES[3]: ("series-4", "#e38fd0"),
}

_PREFIXES = {9: "G", 6: "M", 3: "k", 0: "", -3: "m", -6: "µ", -9: "n", -12: "p"}
_PREFIXED_UNITS = ("m", "s", "N", "Hz", "N/m", "A", "V", "m/s", "m/s²")


@dataclass(frozen=True, slots=True)
class Quantity:
    """A number with its unit, shown with an SI prefix; `prefix` fixes it, so that a column reads in one unit."""

    value: float | None
    unit: str
    digits: int = 3
    prefix: str | None = None

    def __str__(self) -> str:
        if self.value is None or not math.isfinite(self.value):
            return "–" if self.value is None or math.isnan(self.value) else f"{self.value} {self.unit}"
        scalable = self.unit in _PREFIXED_UNITS
        power = 0
        if self.prefix is not None:
            powers = [power for power, prefix in _PREFIXES.items() if prefix == self.prefix]
            if not powers:
                raise RequestError(f"prefix is {self.prefix!r}; one of {list(_PREFIXES.values())} is needed")
            power = powers[0]
        elif scalable and self.value != 0.0:
            # Rounded first: 999.6 nm is 1.00 µm, not 1000 nm.
            shown = float(f"{self.value:.{self.digits - 1}e}")
            power = min(max(3 * math.floor(math.log10(abs(shown)) / 3.0), -12), 9)
        number = rounded(self.value / 10.0**power, self.digits)
        return number if self.unit == "1" else f"{number} {_PREFIXES[power]}{self.unit}"


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text and quantities under a row of headings; a bare number has no unit and is refused."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str | Quantity]]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture (SVG or PNG bytes) with what it shows, in words; `alternative` is read aloud in its place."""

    title: str
    image: bytes
    caption: str = ""
    alternative: str = ""


@dataclass(frozen=True, slots=True)
class Section:
    """Sentences under a heading, each an item of a list; a text in `backticks` is what one types."""

    title: str
    items: Sequence[str]


@dataclass(frozen=True, slots=True)
class Report:
    """A page: title, banner (what to know before reading any number), facts, links, tables, figures, sections.

    links: (file beside the page, what it is). The page is whole without them.
    parts: what comes before the tables, in the order given, for a page that goes from chapter to chapter.
    """

    title: str
    banner: str
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    facts: Sequence[tuple[str, str]] = field(default=())
    sections: Sequence[Section] = ()
    links: Sequence[tuple[str, str]] = ()
    parts: Sequence[Table | Figure | Section] = ()

    def html(self) -> str:
        """Render the page."""
        parts = [f"<h1>{html.escape(self.title)}</h1>"]
        if self.banner:
            parts.append(f'<p class="banner">{html.escape(self.banner)}</p>')
        if self.facts:
            pairs = "".join(f"<div><dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd></div>" for k, v in self.facts)
            parts.append(f"<dl>{pairs}</dl>")
        parts += [
            f'<p class="link"><a href="{html.escape(quote(file))}">{html.escape(said)}</a></p>'
            for file, said in self.links
        ]
        figures_count = 0
        for part in (*self.parts, *self.tables, *self.figures, *self.sections):
            if isinstance(part, Table):
                parts.append(_table_html(part))
            elif isinstance(part, Section):
                parts.append(_section_html(part))
            else:
                figures_count += 1
                parts.append(_figure_html(part, figures_count))
        return _PAGE.format(title=html.escape(self.title), style=_page_style(), body="\n".join(parts))

    def write(self, path: str | Path) -> None:
        """Write the page; a reader sees the old one or the new one, never half. RecordError when the disk refuses."""
        file = Path(path)
        page = self.html()
        part = file.with_name(file.name + ".part")
        try:
            part.write_text(page, encoding="utf-8")
            os.replace(part, file)
        except OSError as error:
            raise RecordError(f"report {file}: {error}; free some space or choose another folder") from error


def rounded(value: float, digits: int) -> str:
    """Round to significant digits without an exponent."""
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    near = float(f"{value:.{digits - 1}e}")
    decimals = max(digits - 1 - math.floor(math.log10(abs(near))), 0)
    if decimals > 9:
        return f"{near:.{digits - 1}e}"
    return f"{near:.{decimals}f}".replace("-", "\u2212")


def _table_html(table: Table) -> str:
    for row in table.rows:
        if len(row) != len(table.columns):
            raise RequestError(f"table '{table.title}': {len(row)} cells under {len(table.columns)} headings")
    numeric = [_is_numeric([row[i] for row in table.rows if row[i] != ""]) for i in range(len(table.columns))]
    marks = [' class="n"' if right else "" for right in numeric]
    head = "".join(f"<th{mark}>{html.escape(name)}</th>" for name, mark in zip(table.columns, marks, strict=True))
    body = "\n".join(
        "<tr>" + "".join(_cell(table, cell, mark) for cell, mark in zip(row, marks, strict=True)) + "</tr>"
        for row in table.rows
    )
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    return (
        f'<section><h2>{html.escape(table.title)}</h2><div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>\n{body}\n</tbody></table></div>{note}</section>"
    )


def _is_numeric(cells: Sequence[str | Quantity]) -> bool:
    """Tell a column of quantities, in which a word may stand here and there ("diverges")."""
    return 2 * sum(isinstance(cell, Quantity) for cell in cells) > len(cells)


def _cell(table: Table, cell: str | Quantity, mark: str) -> str:
    if not isinstance(cell, str | Quantity):
        raise RequestError(f"table '{table.title}': {cell!r} has no unit; give a Quantity or text")
    if mark and isinstance(cell, str):
        mark = ' class="n words"'  # which may wrap; a number never does
    return f"<td{mark}>{html.escape(str(cell))}</td>"


def _section_html(section: Section) -> str:
    items = "".join(f"<li>{_with_code(item)}</li>" for item in section.items)
    return f"<section><h2>{html.escape(section.title)}</h2><ul>{items}</ul></section>"


def _with_code(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


def _figure_html(figure: Figure, number: int) -> str:
    title = html.escape(figure.title)
    alternative = html.escape(figure.alternative or figure.title)
    if figure.image.startswith(b"\x89PNG"):
        data = base64.b64encode(figure.image).decode("ascii")
        picture = f'<img class="paper" alt="{alternative}" src="data:image/png;base64,{data}">'
    else:
        picture = _inline_svg(figure.image, figure.title, alternative, number)
    caption = f"<p>{html.escape(figure.caption)}</p>" if figure.caption else ""
    return (
        f"<figure><figcaption><h2>Figure {number}. {title}</h2>{caption}</figcaption>"
        f'<div class="scroll">{picture}</div></figure>'
    )


def _inline_svg(image: bytes, title: str, alternative: str, number: int) -> str:
    """Make a drawing part of the page: its ids its own, its colours the scheme's."""
    text = image.decode("utf-8")
    start = text.find("<svg")
    if start < 0:
        raise RequestError(f"figure '{title}': neither SVG nor PNG")
    text = re.sub(r"<metadata>.*?</metadata>", "", text[start:], flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="f{number}-', text)
    text = re.sub(r"url\(#", f"url(#f{number}-", text)
    text = re.sub(r'href="#', f'href="#f{number}-', text)
    for colour, (name, _) in _PAGE_COLOURS.items():
        text = text.replace(colour, f"var(--{name})")
    head_end = text.index(">")
    head = re.sub(r'\s(?:width|height)="[^"]*"', "", text[:head_end])
    return f'{head} role="img" aria-label="{alternative}"{text[head_end:]}'


def _page_style() -> str:
    light = "".join(f"--{name}:{colour};" for colour, (name, _) in _PAGE_COLOURS.items())
    dark = "".join(f"--{name}:{colour};" for name, colour in _PAGE_COLOURS.values())
    return _CSS.replace("LIGHT", light).replace("DARK", dark)


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""

_CSS = """
:root{color-scheme:light dark;LIGHT--page:#fff;--band:#f3f5f8}
@media screen and (prefers-color-scheme:dark){:root{DARK--page:#14171b;--band:#1e232a}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);
 font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
main{max-width:52rem;margin:0 auto;padding:1.5rem 1rem 4rem}
h1{font-size:1.6rem;line-height:1.2;margin:.5rem 0 1rem}
h2{font-size:1.05rem;line-height:1.3;margin:0 0 .5rem}
section,figure{margin:2.25rem 0 0}
.banner{margin:0 0 1rem;padding:.75rem 1rem;background:var(--band);border-left:4px solid var(--series-1)}
dl{display:grid;grid-template-columns:repeat(auto-fit,minmax(11rem,1fr));gap:.5rem 1.5rem;margin:0}
dt{font-size:.8rem;color:var(--muted)}
dd{margin:0;overflow-wrap:anywhere}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:.92rem;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:.35rem .9rem .35rem 0;border-bottom:1px solid var(--grid);vertical-align:top}
th{color:var(--muted);font-weight:600;border-bottom:1.5px solid var(--muted)}
th.n,td.n{text-align:right;white-space:nowrap}
td.words{white-space:normal}
th:last-child,td:last-child{padding-right:0}
.link{margin:1rem 0 0}a{color:var(--series-2)}
ul{margin:0;padding-left:1.2rem}
code{background:var(--band);padding:.05rem .3rem;overflow-wrap:anywhere}
.note,figcaption p{font-size:.88rem;color:var(--muted);margin:.4rem 0 .6rem}
figure svg,figure img{display:block;width:100%;min-width:27rem;height:auto}
figure img.paper{background:#fff}
figure svg text{font-family:system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif!important}
@media print{main{max-width:none;padding:0}body{font-size:10.5pt}section,figure,tr{break-inside:avoid}
 figure svg,figure img{min-width:0}.scroll{overflow:visible}}
"""
