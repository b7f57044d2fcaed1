"""`stagectl budget`: what the end's error is made of, how little is possible, and what to improve next."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from stagectl.budget import budget as budgets
from stagectl.budget import page
from stagectl.budget.budget import Budget
from stagectl.budget.lqg import Hold
from stagectl.budget.measured import Stretch, stretches_of
from stagectl.commands.answer import Answer, Voice
from stagectl.commands.opening import law_name
from stagectl.commands.runs import folder_of
from stagectl.commands.tables import terminal
from stagectl.errors import ProfileError, RequestError
from stagectl.profile import Profile, load_profile
from stagectl.record import Run, read_run
from stagectl.run_scores import VALUE_SEAM, last_finished, read_truth, score_motion, segments
from stagectl.runs import profile_of

if TYPE_CHECKING:
    from sim_backend.machine import Machine

PAGE = "budget.html"
_SIMULATED = ("rig", VALUE_SEAM)


def show(voice: Voice, profile: str, run: str | None, law: str | None, seed: int, runs_root: Path, out: Path) -> Answer:
    """Predict, measure, compute the bound, write the page."""
    believed = load_profile(profile)
    name = law_name(law, believed)
    made = _folder(out)
    if run is None:
        found = budgets.of_machine(believed, name, _machine(believed), seed, voice.progress)
        measured_on = f"machine {believed.name} behind the value seam, seed {seed}"
    else:
        folder = folder_of(run, runs_root)
        name, machine, stretches = _of_run(believed, read_run(folder), law)
        found = budgets.of_stretches(believed, name, machine, stretches, voice.progress)
        measured_on = f"run {folder}"
    voice.progress("drawing the page", 1.0)
    report = page.report(f"Error budget of {believed.name} under {name}", found)
    report.write(made / PAGE)
    voice.progress.done()
    shown = [terminal(page.shares_table(part)) for part in found.parts]
    shown += [terminal(page.bounds_table(found)), "", escape(page.verdict(found))]
    shown += [f"- {escape(one)}" for one in page.advice(found)]
    shown.append(f"page: {escape(str(made / PAGE))}")
    return Answer(_data(believed, found, measured_on) | {"page": made / PAGE}, shown)


def _folder(out: Path) -> Path:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"--out {out}: can't be made: {error.strerror}; give another folder") from error
    return out


def _machine(profile: Profile) -> "Machine":
    from sim_backend.machine import load_machine

    try:
        return load_machine(profile.name)
    except ProfileError as error:
        raise RequestError(
            f"profile {profile.name}: the rig has no machine of that name to measure on; give a RUN ({error})"
        ) from error


def _of_run(profile: Profile, run: Run, law: str | None) -> tuple[str, Any, list[Stretch]]:
    """Return law, machine (None where a real one was driven) and stretches of a run's last motion."""
    made_with = profile_of(run)
    if made_with.name != profile.name:
        raise RequestError(f"{run.folder} is of profile {made_with.name}, not of {profile.name}; give that profile")
    motions = [one for one in last_finished(segments(run)) if law is None or one.law == law]
    if not motions:
        which = f" under {law}" if law is not None else ""
        raise RequestError(f"{run.folder}: no finished motion along a trajectory{which}; make one with `stagectl run`")
    motion = motions[-1]
    score = score_motion(run, motion, read_truth(run.folder))
    rows = run.rows[motion.first_row : motion.first_row + motion.rows_count][-score.t_s.size :]
    x_b_m = rows["macro_position_m"] - rows["end_position_m"]
    machine = _machine(profile) if run.manifest.get("backend") in _SIMULATED else None
    return motion.law, machine, stretches_of(score, x_b_m)


def _data(profile: Profile, found: Budget, measured_on: str) -> dict[str, Any]:
    bounds = found.bounds
    return {
        "profile": profile.name,
        "law": found.law,
        "measured_on": measured_on,
        "parts": [
            {
                "name": part.stretch.name,
                "is_true_position": part.stretch.is_true,
                "predicted_rms_m": part.spectra.rms_m,
                "measured_rms_m": part.stretch.rms_m,
                "ratio": part.ratio,
                "agrees": part.agrees,
                "sources": [
                    {"source": share.source, "predicted_m2": share.predicted_m2, "measured_m2": share.measured_m2}
                    for share in part.shares
                ],
            }
            for part in found.parts
        ],
        "hold_m": found.hold_m,
        "max_sensitivity": found.margins.sensitivity_peak_ratio,
        "delay_margin_s": found.margins.delay_margin_s,
        "step_peak_m": found.step_peak_m,
        "bounds": {
            "delay_s": bounds.around.delay_s,
            "least_hold": _hold_data(bounds.hold),
            "best_hold_at_sensitivity": _hold_data(bounds.robust),
            "as_stiff_at_sensitivity": None if bounds.as_stiff is None else _hold_data(bounds.as_stiff),
            "stiffest_at_sensitivity": _hold_data(bounds.stiff) | {"step_peak_m": bounds.stiff_step_peak_m},
        },
        "over_as_stiff_ratio": None if bounds.as_stiff is None else found.hold_m / bounds.as_stiff.true_rms_m,
        "over_bound_ratio": found.hold_m / bounds.hold.true_rms_m,
        "over_robust_bound_ratio": found.hold_m / bounds.robust.true_rms_m,
        "levers": [{"what": lever.what, "hold_m": lever.hold_m, "saved_m": lever.saved_m} for lever in found.levers],
        "is_force_noise_fitted": found.is_force_noise_fitted,
        "verdict": page.verdict(found),
        "advice": page.advice(found),
    }


def _hold_data(hold: Hold) -> dict[str, Any]:
    return {
        "true_rms_m": hold.true_rms_m,
        "measured_rms_m": hold.measured_rms_m,
        "max_sensitivity": hold.robustness.max_sensitivity,
        "delay_margin_s": hold.robustness.delay_margin_s,
        "by_source_m": hold.by_source_m,
    }
