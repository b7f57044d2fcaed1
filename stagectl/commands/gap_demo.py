"""`stagectl gap demo`: hide an effect in the rig, find it, confirm it, add it, and follow the same move better."""

from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from stagectl import toml_file
from stagectl.commands.answer import ENDED_EARLY, Answer, Voice
from stagectl.commands.gap import PAGE
from stagectl.commands.gap_next import judged_table, perform
from stagectl.commands.opening import home_and_arm
from stagectl.errors import DriveError
from stagectl.gap import demo_page, findings_page, hiding, moves, next_move, prediction, residual
from stagectl.gap.application import application
from stagectl.gap.believed import believed_of_profile
from stagectl.gap.demo_page import Closed, Followed
from stagectl.gap.findings import Findings
from stagectl.gap.findings_file import FINDINGS, write_findings
from stagectl.gap.log import Log, read_log
from stagectl.gap.moves import Move
from stagectl.gap.prediction import with_outcomes
from stagectl.gap.prediction_file import OUTCOME, PREDICTION, write_outcome, write_prediction
from stagectl.gap.residual import Residual
from stagectl.gap.workflow import find
from stagectl.motion import check
from stagectl.profile import Profile, load_profile, search_folders
from stagectl.record import read_run
from stagectl.run_folder import reserve
from stagectl.run_scores import read_truth, write_truth
from stagectl.scoring import score
from stagectl.stage import open_stage
from stagectl.supervisor import Supervisor
from stagectl.whole_file import replace_whole

TRAINING = ("middle stroke", "sine 1 Hz", "slow stroke")
FOLLOWED = "fast stroke"
"""No fit sees it; before and after it shows how well the stage follows."""

REPORT, PROFILE, MACHINE = "report.html", "found.toml", "machine.toml"

_FILES = (
    (PROFILE, "the profile with what was confirmed"),
    (MACHINE, "the machine with its secret"),
    (FINDINGS, "the findings"),
    (PREDICTION, "what the confirming move would show, written before it"),
    (OUTCOME, "what it showed"),
)


@dataclass(frozen=True, slots=True)
class _Rig:
    """The machine with its secret, under a profile."""

    profile: Profile
    machine: Path
    folder: Path
    voice: Voice
    seed: int

    @contextmanager
    def opened(self, name: str):
        """Yield a connected stage in virtual time; what was true is kept with its run."""
        from sim_backend.machine import load_machine

        stage: Supervisor = open_stage(
            self.profile,
            "batch",
            runs_root=self.folder,
            name=name,
            seed=self.seed,
            machine=self.machine,
            progress=self.voice.progress,
        )
        with stage:
            yield stage
            stage.disarm()
            truth = stage.backend.truth()
            if truth is not None:
                write_truth(stage.folder, truth, load_machine(self.machine).backlash)

    def follows(self, move: Move) -> tuple[Path, Followed]:
        """Record one move; returns its run and how the end truly followed while it lasted. Errors: DriveError."""
        with self.opened(move.name.replace(" ", "-")) as stage:
            armed = home_and_arm(stage)
            done = stage.run(move.trajectory, self.profile.control.law) if armed.finished else armed
            if not done.finished:
                raise DriveError(f"gap demo, {move.name}: {done.text}")
        run = read_run(stage.folder)
        truth = read_truth(stage.folder)
        if truth is None:
            raise DriveError(f"gap demo, {move.name}: the rig kept no truth; nothing can be scored")
        scored = score(run, truth, done.first_row, done.rows)
        t_s = scored.t_s - scored.t_s[0]
        return stage.folder, Followed(t_s, scored.rows["setpoint_position_m"], scored.true_mean_error_m)


def show(voice: Voice, profile: str, runs_root: Path, seed: int) -> Answer:
    """Do all of it over the wire in virtual time; four numbers say whether the loop closed."""
    from sim_backend.machine import machine_path_for

    path = toml_file.find(profile, search_folders(), "profile")
    believed_profile = load_profile(path)
    hidden = hiding.drawn(seed, believed_profile.micro is not None)
    folder = reserve(runs_root, "gap-demo")
    voice.run_folder = folder
    known = [(row["name"], row["acts_on"]) for row in believed_profile.effects]
    machine = folder / MACHINE
    replace_whole(
        machine, hiding.with_hidden(machine_path_for(believed_profile.name).read_text(), known, hidden).encode()
    )
    rig = _Rig(believed_profile, machine, folder, voice, seed)
    believed = believed_of_profile(believed_profile)
    room = moves.room_of(believed_profile)
    candidates = moves.library(room, lambda planned: check(planned, believed_profile))
    by_name = {move.name: move for move in candidates}
    voice.note("recording: one effect of the machine is not in the profile")
    training = [_log(rig.follows(by_name[name])[0], believed.period_s, believed) for name in TRAINING]
    held, before = rig.follows(by_name[FOLLOWED])
    apart = [_log(held, believed.period_s, believed)]
    found = find(believed, training, apart, seed=seed, say=voice.note)
    file = folder / FINDINGS
    write_findings(found, file)
    voice.whole_file = file
    names = ", ".join(f"{one.name} on {one.acts_on}" for one in found.named) or found.verdict
    voice.note(f"found: {names}")
    data = {"hidden": hidden, "found": names, "folder": str(folder)}
    residuals = residual.residuals(believed, found, training, apart)
    _search_page(found, residuals, path, file, seed)
    if not found.named:
        return Answer(data, [_secret(hidden), f"found   {names}: the demo ends here", f"files   {folder}"], ENDED_EARLY)
    seen = prediction.evidence(believed, [*training, *apart], found)
    proposals = next_move.proposals(seen, [move for move in candidates if move.name not in TRAINING])
    chosen = next((one for one in proposals if one.decides), proposals[0])
    write_prediction(chosen, str(file), date.today().isoformat(), folder / PREDICTION)
    voice.note(f"next: {chosen.move.name}")
    outcomes, run, problem = perform(seen, chosen, believed_profile, lambda: rig.opened("gap-next"))
    if problem:
        raise DriveError(f"gap demo, {chosen.move.name}: {problem}")
    write_outcome(outcomes, str(run), folder / PREDICTION, date.today().isoformat(), folder / OUTCOME)
    found = with_outcomes(found, outcomes)
    write_findings(found, file)
    _search_page(found, residuals, path, file, seed)
    first = outcomes[0]
    data |= {
        "confirmed": [one.name for one in outcomes if one.confirmed],
        "unit": first.unit,
        "gap_before": first.gap_before,
        "gap_after": first.gap_after,
        "error_before_m": before.rms_m,
    }
    shown: list = [_secret(hidden), f"found   {names}", judged_table(outcomes, chosen.expected)]
    if not any(one.confirmed for one in outcomes):
        return Answer(data, [*shown, "nothing was confirmed: the profile stays", f"files   {folder}"], ENDED_EARLY)
    done = application(path.read_bytes().decode(), found, candidates=False, date=date.today().isoformat())
    replace_whole(folder / PROFILE, done.text.encode())
    better = _Rig(load_profile(folder / PROFILE), machine, folder, voice, seed)
    after = better.follows(by_name[FOLLOWED])[1]
    data |= {"error_after_m": after.rms_m, "profile": str(folder / PROFILE), "report": str(folder / REPORT)}
    closed = Closed(_secret(hidden)[8:], found, residuals, first, chosen.move.name, FOLLOWED, before, after)
    demo_page.page(closed, PAGE, _FILES).write(folder / REPORT)
    shown += [_numbers(closed), f"files   {folder}", f"report  {folder / REPORT}"]
    is_better = first.gap_after < first.gap_before and after.rms_m < before.rms_m
    return Answer(data, shown, 0 if is_better else ENDED_EARLY)


def _search_page(found: Findings, residuals: Sequence[Residual], profile: Path, file: Path, seed: int) -> None:
    """Write the page that `stagectl gap` would write; its ladder needs a controller of an observed machine."""
    findings_page.page(found, residuals, [], profile=str(profile), file=file, seed=seed).write(file.with_name(PAGE))


def _log(folder: Path, period_s: float, believed) -> Log:
    return read_log(folder, period_s, believed)


def _secret(hidden: dict) -> str:
    values = ", ".join(f"{key} = {value:.4g}" for key, value in hidden.items() if isinstance(value, float))
    return f"hidden  {hidden['name']} on {hidden['acts_on']}: {escape(values)}"


def _numbers(closed: Closed) -> Table:
    table = Table("", "before", "after", box=None, header_style="bold")
    for name, before, after in demo_page.rows(closed):
        table.add_row(name, str(before), str(after))
    return table
