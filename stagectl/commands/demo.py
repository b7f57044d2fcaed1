"""`stagectl demo`."""

import math
from dataclasses import replace
from pathlib import Path

from stagectl import demo
from stagectl.backend import RIG
from stagectl.commands.answer import ENDED_EARLY, Answer, Voice
from stagectl.commands.opening import Place, opened, place
from stagectl.commands.scores_json import scores_json
from stagectl.commands.tables import terminal
from stagectl.errors import RequestError
from stagectl.record import read_run
from stagectl.run_page import page, scores_of, tables
from stagectl.run_scores import read_truth
from stagectl.signals import Stop
from stagectl.trajectory import Trajectory

REPORT = "report.html"

_BEARS_MISSED_RATIO = 1e-3
"""A stage PC misses none. At 1.2 % and more, on a shared machine, homing failed in two of four plays."""


def show(voice: Voice, profile: str, backend: str | None, runs_root: Path, seed: int) -> Answer:
    """Drive the demo, score it, write its report.

    Where no backend was asked for, the rig plays in real time, and in virtual time where this host can't keep it.
    """
    where = place(profile, backend or RIG, runs_root, seed)
    if where.is_value_seam:
        raise RequestError(
            "demo shows the whole way over the wire; take --backend rig, or `stagectl run --backend plant`"
        )
    trajectory = demo.planned(where.profile)
    driven, folder = _driven(voice, where, trajectory, math.inf if backend else _BEARS_MISSED_RATIO)
    real_time = {"given_up": driven.given_up, "missed_ratio": driven.host.missed_ratio, "run": folder}
    remark = ""
    if driven.given_up:
        remark = _given_up_text(driven.host, folder)
        voice.warn(remark)
        voice.listen()
        driven, folder = _driven(voice, replace(where, backend="batch"), trajectory)
    voice.progress("scoring and drawing", 0.0)
    run = read_run(folder)
    scores = scores_of(run, read_truth(folder))
    report = folder / REPORT
    page(run, scores, f"{where.profile.name}: {' against '.join(law.upper() for law in demo.LAWS)}").write(report)
    voice.progress.done()
    shown: list = [terminal(table) for table in tables(scores)]
    shown += [f"[yellow]virtual time:[/] {remark}"] if remark else []
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
        "real_time": real_time,
        "repeated": [{"motion": trip.motion, "stop": trip.stop.name, "text": trip.text} for trip in driven.trips],
        **scores_json(scores),
    }
    return Answer(data, shown, 0 if finished else ENDED_EARLY)


def _driven(
    voice: Voice, where: Place, trajectory: Trajectory, bears_missed_ratio: float = math.inf
) -> tuple[demo.Driven, Path]:
    """Drive the demo there; return what was driven, and its run's folder."""
    with opened(where, "demo", voice) as stage:
        driven = demo.drive(stage, trajectory, say=voice.warn, bears_missed_ratio=bears_missed_ratio)
        return driven, stage.folder


def _given_up_text(host: demo.Host, folder: Path) -> str:
    missed_percent, borne_percent = 100.0 * host.missed_ratio, 100.0 * host.bears_ratio
    return (
        f"this host missed {host.missed_cycles_count} of {host.cycles_count} cycles ({missed_percent:.2g} %, limit "
        f"{borne_percent:.2g} %), and no law helps a stage whose commands come late; the demo plays in virtual time, "
        f"over the same bytes (in real time whatever happens: --backend rig; its run: {folder})"
    )
