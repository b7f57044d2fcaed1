"""`stagectl gap next`: which move would settle what is open, what it will show, and whether it did."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rich.markup import escape
from rich.table import Table

from stagectl import motion
from stagectl.commands.answer import ENDED_EARLY, Answer, Voice
from stagectl.commands.opening import home_and_arm, opened, place
from stagectl.commands.runs import folder_of
from stagectl.errors import ProfileError, RequestError
from stagectl.gap import moves, next_move, prediction
from stagectl.gap.believed import Believed, load_believed
from stagectl.gap.findings import Findings, title_of
from stagectl.gap.findings_file import FINDINGS, read_findings, write_findings
from stagectl.gap.log import Log, log_of_rows, read_log
from stagectl.gap.moves import Move
from stagectl.gap.next_move import Proposal
from stagectl.gap.prediction import Evidence, Expected, Outcome, with_outcomes
from stagectl.gap.prediction_file import OUTCOME, PREDICTION, write_outcome, write_prediction
from stagectl.profile import Profile, load_profile
from stagectl.record import read_manifest, read_run
from stagectl.supervisor import Supervisor

Stage = Callable[[], AbstractContextManager[Supervisor]]
"""Opens a connected stage for one motion."""


def show(
    voice: Voice, findings: Path, profile: str | None, runs_root: Path, run: bool, backend: str, seed: int
) -> Answer:
    """Propose the next move and write down what it will show; with `run`, move, and judge."""
    file = findings / FINDINGS if findings.is_dir() else findings
    found = read_findings(file)
    name = profile if profile is not None else _profile_of(found, runs_root)
    believed = load_believed(name)
    if found.profile_sha256 and believed.sha256 != found.profile_sha256:
        raise RequestError(
            f"{believed.path} has changed since the findings were made (sha256 {believed.sha256[:12]}, then "
            f"{found.profile_sha256[:12]}): give the file of that time with --profile, or run `stagectl gap` again"
        )
    voice.note("reading the recordings of the findings")
    logs = [read_log(folder_of(run, runs_root), believed.period_s, believed) for run in (*found.runs, *found.holdout)]
    candidates = _library(name, believed, logs)
    shown: list = [_excited_table(next_move.excitations(believed, found, candidates))] if found.not_excited else []
    if not found.named and (found.unknown is not None or not found.parameter_errors):
        return Answer({"proposals": []}, [*shown, "No effect is named: there is nothing to confirm."])
    seen = prediction.evidence(believed, logs, found)
    proposals = next_move.proposals(seen, candidates)
    shown += _proposed(proposals)
    if not proposals:
        return Answer({"proposals": []}, [*shown, "Everything is confirmed, and nothing else explains it as well."])
    chosen = next((one for one in proposals if one.decides), proposals[0])
    write_prediction(chosen, str(file), _now(), file.parent / PREDICTION)
    shown.append(f"Prediction, written before the run: {file.parent / PREDICTION}")
    data = {"proposals": [_plain(one) for one in proposals], "prediction": str(file.parent / PREDICTION)}
    if not run:
        return Answer(data, [*shown, "[dim]`--run` does it on the stage, and judges[/]"])
    if not chosen.decides:
        raise RequestError(
            f"{chosen.move.name}, the best move for {title_of(chosen.name, chosen.acts_on)}, shows it with "
            f"d' {chosen.d_prime:.1f}, {prediction.DETECTED:g} is needed; record longer, with other payloads or gains"
        )
    where = place(name, backend, runs_root, seed)
    if where.is_value_seam:
        raise RequestError("gap next --run needs drives and a sensor; take --backend rig, or a stage")
    outcomes, folder, problem = perform(seen, chosen, where.profile, lambda: opened(where, "gap-next", voice))
    if problem:
        return Answer({**data, "run": str(folder)}, [*shown, f"[red]ended early[/]: {escape(problem)}"], ENDED_EARLY)
    write_outcome(outcomes, str(folder), file.parent / PREDICTION, _now(), file.parent / OUTCOME)
    write_findings(with_outcomes(found, outcomes), file)
    shown += [judged_table(outcomes, chosen.expected), *(_verdict(one) for one in outcomes), f"run     {folder}"]
    judged = [{"name": one.name, "acts_on": one.acts_on, "confirmed": one.confirmed} for one in outcomes]
    return Answer({**data, "run": str(folder), "judged": judged}, shown)


def perform(seen: Evidence, chosen: Proposal, profile: Profile, stage: Stage) -> tuple[list[Outcome], Path, str]:
    """Do the move that was chosen and judge what was predicted of it; a text where it did not come to its end."""
    with stage() as connected:
        folder = connected.folder
        armed = home_and_arm(connected)
        if not armed.finished:
            return [], folder, armed.text
        moved = connected.run(chosen.move.trajectory, profile.control.law)
        if not moved.finished:
            return [], folder, moved.text
    rows = read_run(folder).rows[moved.first_row : moved.first_row + moved.rows]
    log = log_of_rows(
        rows, str(folder), seen.believed.period_s, f"{folder.name}:next", imported=False, believed=seen.believed
    )
    return prediction.judged(seen, log, chosen.expected), folder, ""


def _profile_of(found: Findings, runs_root: Path) -> str:
    """Return where the profile of the findings is: its file, its name, or the file that the first run was made with."""
    if found.profile_path and Path(found.profile_path).exists():
        return found.profile_path
    try:
        load_believed(found.profile)
    except ProfileError:
        manifest = read_manifest(folder_of(found.runs[0], runs_root))
        path = manifest.get("profile_path")
        if not path or not Path(path).exists():
            raise RequestError(
                f"the findings are of profile {found.profile}, which is not here; give it with --profile"
            ) from None
        return str(path)
    return found.profile


def _library(name: str, believed: Believed, logs: Sequence[Log]) -> list[Move]:
    """Return the moves that the machine can do: as its profile allows, or as it has moved before."""
    try:
        profile = load_profile(name)
    except ProfileError:
        return moves.library(moves.room_of_motion([log.macro_position_m for log in logs], believed.period_s))
    return moves.library(moves.room_of(profile), lambda planned: motion.check(planned, profile))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _plain(one: Proposal) -> dict:
    return {
        "effect": one.name,
        "acts_on": one.acts_on,
        "move": one.move.name,
        "duration_s": one.move.trajectory.duration_s,
        "d_prime": one.d_prime,
        "against": [list(key) for key in one.against],
        "never_apart": [list(key) for key in one.never_apart],
        "decides": one.decides,
    }


def _proposed(proposals: Sequence[Proposal]) -> list:
    table = Table(
        "effect", "next move", "takes", "to tell it from", "d'", "gap before", "after", "fall, 95 %", box=None
    )
    remarks = []
    for one in proposals:
        mine = next(e for e in one.expected if (e.name, e.acts_on) == (one.name, one.acts_on))
        low, high = mine.fall_interval
        table.add_row(
            title_of(one.name, one.acts_on),
            one.move.name,
            f"{one.move.trajectory.duration_s:.0f} s",
            ", ".join(f"{name} on {where}" for name, where in one.against) or "nothing at all",
            f"{one.d_prime:.1f}",
            _size(mine.gap_before, mine.unit),
            _size(mine.gap_after, mine.unit),
            f"{_size(low, mine.unit)} .. {_size(high, mine.unit)}",
        )
        if one.never_apart:
            names = ", ".join(f"{name} on {where}" for name, where in one.never_apart)
            remarks.append(f"{one.name}: no move of the library tells it from {names}")
    return [table, *remarks]


def judged_table(outcomes: Sequence[Outcome], expected: Sequence[Expected]) -> Table:
    """Show what was expected beside what came."""
    table = Table("effect", "gap before", "after", "fall", "expected, 95 %", "", box=None, header_style="bold")
    by_key = {(one.name, one.acts_on): one for one in expected}
    for one in outcomes:
        mine = by_key[one.name, one.acts_on]
        low, high = mine.fall_interval
        table.add_row(
            title_of(one.name, one.acts_on),
            _size(one.gap_before, one.unit),
            _size(one.gap_after, one.unit),
            _size(one.fall, one.unit),
            f"{_size(low, one.unit)} .. {_size(high, one.unit)}",
            "confirmed" if one.confirmed else "candidate",
        )
    return table


def _verdict(one: Outcome) -> str:
    title = title_of(one.name, one.acts_on)
    if one.confirmed:
        gone = ", ".join(name for name, _, _ in one.out)
        return f"{title}: confirmed: the prediction held" + (f"; ruled out: {gone}" if gone else "")
    if one.better:
        name, where, margin = min(one.better, key=lambda row: row[2])
        return f"{title}: stays a candidate: {name} on {where} does better by {-margin:.0f}"
    return f"{title}: stays a candidate: the run shows {one.share:.3g} times of what was found"


def _size(value: float, unit: str) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:.3g} N" if unit == "N" else f"{value * 1e6:.3g} um"


def _excited_table(rows: Sequence[tuple[str, str]]) -> Table:
    table = Table("not excited yet", "move that shows it most", box=None, header_style="bold")
    for name, move in rows:
        table.add_row(name, move)
    return table
