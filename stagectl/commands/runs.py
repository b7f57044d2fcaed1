"""`stagectl runs list`, `show`, `export`, `import`, `plot`, and `stagectl replay`."""

from dataclasses import asdict
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from stagectl import runs
from stagectl.commands.answer import ENDED_EARLY, Answer, Voice
from stagectl.errors import RecordError, RequestError
from stagectl.left_memory import remove_left_blocks
from stagectl.record import MANIFEST, read_run, recover_orphans
from stagectl.run_folder import reserved
from stagectl.signals import Stop, stop_sentence
from stagectl.suggestion import closest

LATEST = "latest"
_STATE_STYLE = {"closed": "green", "recovered": "yellow", "recording": "cyan", "session": "cyan"}


def folder_of(run: str, runs_root: Path) -> Path:
    """Find a run by path, by name under the runs folder, or `latest`. Errors: RequestError."""
    if run == LATEST:
        found = [one.folder for one in runs.list_runs(runs_root) if (one.folder / MANIFEST).exists()]
        if not found:
            raise RequestError(f"{runs_root}: holds no run yet; `stagectl demo` makes one")
        return found[-1]
    for folder in (Path(run), runs_root / run):
        if folder.is_dir():
            return folder
    if Path(run).is_file():
        raise RequestError(f"run {run!r} is a file; give the run's folder, that is {Path(run).parent}, or its name")
    known = [one.folder.name for one in runs.list_runs(runs_root)]
    hint = closest(run, known) if known else f"; {runs_root} holds no runs"
    raise RequestError(f"no run {run!r}, neither as a path nor in {runs_root}{hint}")


def names(voice: Voice, runs_root: Path) -> Answer:
    """Recover what dead servos left, then list every run."""
    recovered = []
    for ring, outcome in recover_orphans():
        if isinstance(outcome, RecordError):
            voice.warn(f"{outcome}; or remove {ring} where its rows are not wanted")
            recovered.append({"ring": ring, "error": str(outcome)})
        else:
            if outcome.rows_count or outcome.rows_lost_count:
                counts = f"{outcome.rows_count} rows of a dead servo recovered, {outcome.rows_lost_count} lost"
                voice.note(f"{ring}: {counts}")
            recovered.append({"ring": ring, **asdict(outcome)})
    remove_left_blocks()
    found = runs.list_runs(runs_root)
    table = Table("run", "state", "rows", "time", "profile", box=None, pad_edge=False, header_style="bold")
    for column in table.columns:
        column.no_wrap = True
    for column in (2, 3):
        table.columns[column].justify = "right"
    endings = []
    for one in found:
        style = _STATE_STYLE.get(one.state, "red")
        state, duration = f"[{style}]{one.state}[/]", f"{one.duration_s:.1f} s"
        table.add_row(escape(one.folder.name), state, str(one.rows_count), duration, escape(one.profile))
        why = one.note or ("" if one.text == stop_sentence(Stop.NONE, "") else one.text)
        if why:
            endings.append(escape(f"{one.folder.name}: {why}"))
    shown = [table] if found else [f"{runs_root} holds no runs yet; `stagectl demo` makes one"]
    shown += ["", "[bold]what ended them[/]", *endings] if endings else []
    return Answer({"runs": [asdict(one) for one in found], "recovered": recovered}, shown)


def show(voice: Voice, run: str, runs_root: Path) -> Answer:
    """Describe one run."""
    from stagectl.commands.scores_json import scores_json
    from stagectl.commands.tables import terminal
    from stagectl.run_page import tables

    folder = folder_of(run, runs_root)
    found = runs.show(folder)
    facts = Table.grid(padding=(0, 2))
    for name, text in (
        ("folder", found["folder"]),
        ("state", found["state"]),
        ("ended", found["text"]),
        *((("missing", found["note"]),) if found["note"] else ()),
        ("profile", found["profile"]),
        ("world", found["manifest"].get("backend_description", "")),
        ("rows", str(found["rows_count"])),
        ("time", f"{found['duration_s']:.3f} s"),
    ):
        facts.add_row(f"[dim]{name}[/]", escape(str(text)))
    facts.add_row("[dim]events[/]", ", ".join(f"{count} {name}" for name, count in found["events"].items()))
    if found["truncated"]:
        facts.add_row("[dim]end[/]", "[yellow]the files have no proper end: what is whole was read[/]")
    scores = _scores(folder)
    shown: list = [facts]
    if scores is not None:
        shown += [terminal(table) for table in tables(scores)]
        shown += [f"[red]ended early[/]: {escape(text)}" for text in scores.ended_early]
    return Answer({**found, "scores": None if scores is None else scores_json(scores)}, shown)


def _scores(folder: Path):
    """Score a run of ours; None for a table from elsewhere, which has no motions."""
    from stagectl.run_page import scores_of
    from stagectl.run_scores import read_truth

    run = read_run(folder)
    if "cycle" not in _profile_table(run.manifest):
        return None
    return scores_of(run, read_truth(folder))


def _profile_table(manifest: dict) -> dict:
    profile = manifest.get("profile")
    return profile if isinstance(profile, dict) else {}


def export(voice: Voice, run: str, runs_root: Path, file_format: str, columns: str | None, out: Path | None) -> Answer:
    """Write a run as csv, parquet or mat."""
    names_wanted = [name.strip() for name in columns.split(",")] if columns is not None else None
    path = runs.export(folder_of(run, runs_root), file_format, names_wanted, out)
    return Answer({"file": path, "size_bytes": path.stat().st_size}, [f"{path}  {path.stat().st_size / 1e6:.1f} MB"])


def bring_in(voice: Voice, table: Path, runs_root: Path, columns: list[str], column_map: Path | None) -> Answer:
    """Make a run of a measured table."""
    if bool(columns) == (column_map is not None):
        raise RequestError("say what the columns are: --map FILE.toml, or --column t_ns=time:s once for each; not both")
    name = "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in table.stem).lstrip("._-")
    with reserved(runs_root, name or "table") as folder:
        made = runs.import_table(table, column_map if column_map is not None else columns, folder)
    shown = [*made.conversions, *(f"[yellow]{remark}[/]" for remark in made.remarks)]
    shown.append(f"{made.rows_count} rows in {made.folder}")
    return Answer(asdict(made), shown)


def plot(voice: Voice, run: str, runs_root: Path, out: Path | None) -> Answer:
    """Draw a run: a page, or a folder of PNG files."""
    from stagectl.run_page import page, pictures, scores_of
    from stagectl.run_scores import read_truth

    folder = folder_of(run, runs_root)
    target = out if out is not None else folder / "report.html"
    if target.suffix not in (".html", ""):
        raise RequestError(f"--out {target}: give a page (.html), or a folder for PNG files")
    voice.progress("reading and scoring", 0.0)
    found = read_run(folder)
    if "cycle" not in _profile_table(found.manifest):
        raise RequestError(f"{folder}: a table from elsewhere has no motions to plot; export it and plot its columns")
    scores = scores_of(found, read_truth(folder))
    voice.progress("drawing", 0.0)
    drawn = pictures(found, scores)
    if not drawn:
        raise RequestError(f"{folder}: no motion in it came to its end, and no cycle had power: nothing to plot")
    if target.suffix == ".html":
        page(found, scores, _title(found)).write(target)
        files = [target]
    else:
        files = _write_pictures(drawn, target)
    voice.progress.done()
    return Answer({"run": folder, "files": files}, [str(file) for file in files])


def _title(run) -> str:
    """Name a run's page."""
    return f"{_profile_table(run.manifest).get('name', '')}: {run.folder.name}"


def _write_pictures(drawn, target: Path) -> list[Path]:
    files = []
    try:
        target.mkdir(parents=True, exist_ok=True)
        for picture in drawn:
            file = target / f"{picture.name}.png"
            file.write_bytes(picture.draw("png"))
            files.append(file)
    except OSError as error:
        raise RecordError(f"{target}: {error.strerror}; free some space or choose another folder") from error
    return files


def replay(voice: Voice, run: str, runs_root: Path) -> Answer:
    """Replay a run from its raw bytes and compare bit for bit."""
    from stagectl.replay import replay as again

    folder = folder_of(run, runs_root)
    voice.progress("replaying", 0.0)
    comparison = again(folder)
    voice.progress.done()
    data = {"run": folder, "exact": comparison.exact, **asdict(comparison)}
    counted = f"{comparison.rows} rows, {comparison.ticks} ticks"
    if comparison.exact:
        return Answer(data, [f"[green]✓[/] {counted}: every value the same, bit for bit"])
    shown = [
        f"[red]✗[/] {counted}: {comparison.differing_rows} rows differ; first: {comparison.first_difference}",
        f"  greatest difference in force {comparison.greatest_force_difference_n:.3g} N",
        "  [dim]bit for bit holds on the same versions and CPU family; the manifest says which made the run[/]",
    ]
    return Answer(data, shown, ENDED_EARLY)
