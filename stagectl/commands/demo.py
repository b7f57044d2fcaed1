"""`stagectl demo`."""

from pathlib import Path

from stagectl import demo
from stagectl.commands.answer import ENDED_EARLY, Answer, Voice
from stagectl.commands.opening import opened, place
from stagectl.commands.scores_json import scores_json
from stagectl.commands.tables import terminal
from stagectl.errors import RequestError
from stagectl.record import read_run
from stagectl.run_page import page, scores_of, tables
from stagectl.run_scores import read_truth
from stagectl.signals import Stop

REPORT = "report.html"


def show(voice: Voice, profile: str, backend: str, runs_root: Path, seed: int) -> Answer:
    """Drive the demo, score it, write its report."""
    where = place(profile, backend, runs_root, seed)
    if where.is_value_seam:
        raise RequestError(
            "demo shows the whole way over the wire; take --backend rig, or `stagectl run --backend plant`"
        )
    trajectory = demo.planned(where.profile)
    with opened(where, "demo", voice) as stage:
        driven = demo.drive(stage, trajectory, say=voice.warn)
        folder = stage.folder
    voice.progress("scoring and drawing", 0.0)
    run = read_run(folder)
    scores = scores_of(run, read_truth(folder))
    report = folder / REPORT
    page(run, scores, f"{where.profile.name}: {' against '.join(law.upper() for law in demo.LAWS)}").write(report)
    voice.progress.done()
    shown: list = [terminal(table) for table in tables(scores)]
    finished = driven.stop is Stop.FINISHED
    text = f"{driven.outcomes[-1].name}: {driven.outcomes[-1].text}"
    shown += [f"[yellow]repeated once:[/] {trip.text}" for trip in driven.trips]
    if not finished:
        shown.append(f"[red]the demo ended early:[/] {text}")
    shown += [f"run     {folder}", f"report  {report}", f"[dim]next: stagectl replay {folder}[/]"]
    data = {
        "run": folder,
        "report": report,
        "stop": driven.stop.name,
        "finished": finished,
        "text": text,
        "repeated": [{"motion": trip.motion, "stop": trip.stop.name, "text": trip.text} for trip in driven.trips],
        **scores_json(scores),
    }
    return Answer(data, shown, 0 if finished else ENDED_EARLY)
