"""`python -m bench NAME`: measure what the project promises, and hold it against the bars.

Exit 0: every bar holds (or could not be measured here, with the reason); 1: one does not; 2: wrong usage.
"""

import argparse
import importlib
import json
import os
import sys
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from types import ModuleType

from bench.figure import Figure
from bench.seeds import seeds_of, text_of

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does; before numpy is loaded

NAMES = ("gap", "main_job", "paper", "service")


def _arguments(argv: list[str] | None) -> tuple[argparse.Namespace, ModuleType]:
    """Return what is asked for, and the set of figures that it is asked of; exits with 2 where that has none such."""
    parser = argparse.ArgumentParser(prog="python -m bench", description="Measure the project's figures.")
    parser.add_argument("name", choices=NAMES, help="which set of figures")
    parser.add_argument("--json", action="store_true", help="print one JSON object a figure")
    parser.add_argument("--full", action="store_true", help="more seeds and longer runs")
    parser.add_argument("--out", type=Path, help="write what is printed to this file as well")
    parser.add_argument("--markdown", type=Path, help="write the table with date and host load to this file")
    parser.add_argument(
        "--seeds", type=seeds_of, help="service: play these runs, such as 7 or 13000-13099, of batch or processes"
    )
    parser.add_argument("--part", help="service, paper: do only this part")
    given = parser.parse_args(argv)
    module = importlib.import_module(f"bench.{given.name}")
    parts = getattr(module, "PARTS", {})
    if given.part is not None and given.part not in parts:
        parser.error(f"--part {given.part}: {given.name} has {', '.join(parts) or 'no parts'}")
    if given.seeds is not None and given.name != "service":
        parser.error(f"--seeds: {given.name} has no runs to be played one by one; service has")
    if given.seeds is not None and given.part not in (None, *module.SEEDED):
        parser.error(f"--seeds with --part {given.part}: choose from {', '.join(module.SEEDED)}")
    return given, module


def _value(figure: Figure) -> str:
    return "-" if figure.value is None else f"{figure.value:.3g} {figure.unit}"


def _verdict(figure: Figure) -> str:
    return {True: "holds", False: "MISSED", None: "-"}[figure.holds]


def table(figures: Iterable[Figure]) -> str:
    """Lay figures out as a Markdown table, aligned for a terminal too."""
    rows = [("figure", "value", "bar", "verdict", "seeds", "remark")]
    rows += [(f.figure, _value(f), f.bar, _verdict(f), text_of(f.seeds), f.reason) for f in figures]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def _page(name: str, about: str, figures: list[Figure], load: str, took_s: float, full: bool) -> str:
    day = time.strftime("%Y-%m-%d")
    by = f"python -m bench {name} --full" if full else "make bench"
    return (
        f"# Figures: {name}\n\n"
        f"Written by `{by}` on {day}; {took_s:.0f} s on {os.cpu_count()} CPUs. {load}\n"
        f"{about}\n\n"
        f"{table(figures)}\n"
    )


def _load() -> str:
    one, five, fifteen = os.getloadavg()
    return f"{one:.2f} / {five:.2f} / {fifteen:.2f}"


def _write(text: str, out: Path | None) -> None:
    """Print, and append to a file."""
    print(text, flush=True)
    if out is not None:
        with out.open("a") as file:
            file.write(text + "\n")


def main(argv: list[str] | None = None) -> int:
    """Measure, print, judge."""
    begin_s, load = time.monotonic(), _load()
    arguments, module = _arguments(argv)
    chosen = {name: value for name in ("seeds", "part") if (value := getattr(arguments, name)) is not None}
    say = partial(print, file=sys.stderr, flush=True)
    if arguments.out is not None:
        arguments.out.write_text("")
    figures = []
    for figure in module.figures(full=arguments.full, say=say, **chosen):  # said at once: a crash takes none along
        figures.append(figure)
        if arguments.json:
            _write(json.dumps(figure.as_json()), arguments.out)
        else:
            say(f"{figure.figure}: {_value(figure)} {_verdict(figure)}")
    load = f"Load average of the host (1 / 5 / 15 min): {load} before, {_load()} after."
    if not arguments.json:
        _write(f"{table(figures)}\n{load}", arguments.out)
    if arguments.markdown is not None:
        arguments.markdown.parent.mkdir(parents=True, exist_ok=True)
        took_s = time.monotonic() - begin_s
        page = _page(arguments.name, module.ABOUT, figures, load, took_s, arguments.full)
        arguments.markdown.write_text(page)
    return 1 if any(figure.holds is False for figure in figures) else 0


if __name__ == "__main__":
    sys.exit(main())
