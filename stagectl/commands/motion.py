"""`stagectl run`, `identify`, `jog` and `home`."""

from collections.abc import Callable
from pathlib import Path

from rich.markup import escape

from stagectl import touch_sweep
from stagectl.commands.answer import ENDED_EARLY, EXIT_CODES, Answer, Voice
from stagectl.commands.opening import Place, home_and_arm, law_name, opened, place
from stagectl.commands.planning import Shape, kind_of, planned, target
from stagectl.commands.tables import terminal
from stagectl.errors import LinkError, RequestError
from stagectl.outcome import Outcome
from stagectl.record import read_run
from stagectl.run_folder import reserved
from stagectl.run_scores import read_truth
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor
from stagectl.touch_sweep import IDENTIFY_HZ, IDENTIFY_SHARE


def run(
    voice: Voice,
    profile: str,
    backend: str,
    runs_root: Path,
    seed: int,
    trajectory: str,
    shape: Shape,
    law: str | None,
) -> Answer:
    """Home, follow one trajectory under one law."""
    where = place(profile, backend, runs_root, seed)
    law = law_name(law, where.profile)
    kind = kind_of(trajectory, shape)
    if kind == "move":
        target_m = target(where.profile, shape)
        if where.is_value_seam:
            raise RequestError("a move needs a stage that stands somewhere; take --backend rig, or another trajectory")
        return _on_stage(where, voice, "move", law, lambda stage: stage.move(target_m, law))
    plan = planned(where.profile, trajectory, shape)
    if where.is_value_seam:
        return _behind_value_seam(
            where, voice, plan.name, lambda seam: seam.follow(plan.setpoints, f"{plan.name} under {law}", law)
        )
    return _on_stage(where, voice, plan.name, law, lambda stage: stage.run(plan, law))


def identify(
    voice: Voice, profile: str, backend: str, runs_root: Path, seed: int, frequency_hz: float | None, duration_s: float
) -> Answer:
    """Home, sweep the micro over both edges."""
    where = place(profile, backend, runs_root, seed)
    touch_sweep.planned(where.profile, IDENTIFY_SHARE, IDENTIFY_HZ, duration_s, frequency_hz)  # homing is motion too
    if where.is_value_seam:
        return _behind_value_seam(where, voice, "identify", lambda seam: seam.identify(frequency_hz, duration_s))
    return _on_stage(where, voice, "identify", None, lambda stage: stage.identify(frequency_hz, duration_s))


def jog(
    voice: Voice, profile: str, backend: str, runs_root: Path, seed: int, distance_m: float, law: str | None
) -> Answer:
    """Home, move by a distance."""
    where = _with_drives(place(profile, backend, runs_root, seed), "jog")
    law = law_name(law, where.profile)
    low_m, high_m = where.profile.macro.travel_m
    if not low_m <= distance_m <= high_m:  # before anything opens: homing, which ends at 0, is motion too
        raise RequestError(
            f"--distance-m is {distance_m:g}, from the homed zero; the travel of {where.profile.name} is [{low_m:g}, "
            f"{high_m:g}] m; give a distance within it"
        )

    def by_distance(stage: Supervisor) -> Outcome:
        return stage.move(float(stage.status()["setpoint_position_m"]) + distance_m, law)

    return _on_stage(where, voice, "jog", law, by_distance)


def home(voice: Voice, profile: str, backend: str, runs_root: Path, seed: int) -> Answer:
    """Home only."""
    where = _with_drives(place(profile, backend, runs_root, seed), "home")
    return _on_stage(where, voice, "home", None, None)


def _with_drives(where: Place, command: str) -> Place:
    if where.is_value_seam:
        raise RequestError(f"{command} needs drives and a sensor; the value seam has none: take --backend rig")
    return where


def _on_stage(
    where: Place, voice: Voice, name: str, law: str | None, motion: Callable[[Supervisor], Outcome] | None
) -> Answer:
    """Connect, home, move, come to rest; score what was recorded."""
    with opened(where, name, voice) as stage:
        outcome = home_and_arm(stage, law) if motion is not None else stage.home()
        if outcome.finished and motion is not None:
            outcome = motion(stage)
        position_m = float(stage.status()["end_position_m"])
        folder = stage.folder
    return _answer(voice, folder, outcome, {"end_position_m": position_m, "remarks": stage.remarks})


class _ValueSeam:
    """What a command may ask of a machine straight behind the law."""

    def __init__(self, where: Place, folder: Path, voice: Voice):
        from sim_backend.machine import load_machine

        self._where, self._folder, self._voice = where, folder, voice
        self._machine = load_machine(where.profile.name)

    def follow(self, setpoints, name: str, law: str) -> Outcome:
        from stagectl.value_seam_run import simulate

        where = self._where
        return simulate(
            where.profile, self._machine, setpoints, name, law, self._folder, where.seed, self._voice.progress
        )

    def identify(self, frequency_hz: float | None, duration_s: float) -> Outcome:
        from stagectl.value_seam_run import identify as sweep

        where = self._where
        return sweep(
            where.profile, self._machine, frequency_hz, duration_s, self._folder, where.seed, self._voice.progress
        )


def _behind_value_seam(where: Place, voice: Voice, name: str, motion: Callable[[_ValueSeam], Outcome]) -> Answer:
    """Simulate, record and score."""
    with reserved(where.runs_root, name) as folder:
        voice.run_folder = folder
        return _answer(voice, folder, motion(_ValueSeam(where, folder, voice)), {})


def _answer(voice: Voice, folder: Path, outcome: Outcome, facts: dict) -> Answer:
    """Say how it ended, with the scores of what was recorded."""
    from stagectl.commands.scores_json import scores_json  # a second more of scipy and matplotlib before any motion
    from stagectl.run_page import scores_of, tables

    voice.progress("scoring", 0.0)
    run = read_run(folder)
    scores = scores_of(run, read_truth(folder))
    voice.progress.done()
    text = f"{outcome.name}: {outcome.text}"
    shown: list = [terminal(table) for table in tables(scores)]
    shown += [f"[yellow]{escape(remark)}[/]" for remark in facts.get("remarks", ())]
    shown.append(escape(text) if outcome.finished else f"[red]ended early[/]: {escape(text)}")
    shown += [f"run     {escape(str(folder))}", f"[dim]figures: stagectl runs plot {escape(str(folder))}[/]"]
    facts = {"stop": outcome.stop.name, "finished": outcome.finished, "text": text, **facts}
    ended_early = EXIT_CODES[LinkError] if outcome.stop is Stop.LINK_LOST else ENDED_EARLY
    return Answer({"run": folder, **facts, **scores_json(scores)}, shown, 0 if outcome.finished else ended_early)
