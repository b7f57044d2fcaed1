"""The page of a run: its tables and figures, from scores. The demo, `run` and `runs plot` show the same tables.

Knows no stage and prints nothing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from stagectl import figures, report
from stagectl.figures import BacklashCurve, ErrorTrace, Estimate, HoldTrace, TimeSeries
from stagectl.record import Run
from stagectl.report import Figure, Quantity, Table
from stagectl.run_scores import (
    SETTLING_WINDOW_M,
    BacklashScore,
    CycleScore,
    MotionScore,
    last_finished,
    score_backlash,
    score_cycles,
    score_motion,
    segments,
)
from stagectl.runs import ending, profile_of
from stagectl.signals import Stop

_BALANCE_WINDOW_S = 0.015  # acceleration from 15 samples: 5 nm of noise come to 0.05 N for a micro of 40 kg
_NORMAL_95 = 1.96

_TRUTH_BANNER = (
    "Measured on the software rig. True errors are what the rig's end really did, averaged between samples; "
    "measured ones are what its interferometer showed. The numbers say how the controller does on this model of a "
    "machine; a real stage has effects that no model lists."
)
_MEASURED_BANNER = "Errors are what the interferometer showed, its own noise included; nobody knows the true position."
_SEAM_BANNER = (
    "Simulated behind the value seam: the machine straight behind the control law, no bus, no bytes, no host. "
    "Timing can't be judged here."
)


@dataclass(frozen=True, slots=True)
class Scores:
    """All that is scored of one run."""

    motions: tuple[MotionScore, ...]
    backlash: BacklashScore | None
    cycles: CycleScore | None
    ended_early: tuple[str, ...]  # sentences, one a motion that did not come to its own end


def scores_of(run: Run, truth: dict[str, np.ndarray] | None) -> Scores:
    """Score every finished trajectory, the last identification, and the cycles of a run."""
    found = segments(run)
    return Scores(
        motions=tuple(score_motion(run, segment, truth) for segment in last_finished(found)),
        backlash=score_backlash(run, truth),
        cycles=score_cycles(run),
        ended_early=tuple(one.text for one in found if not one.finished),
    )


def page(run: Run, scores: Scores, title: str) -> report.Report:
    """Make the page of a run."""
    return report.Report(
        title=title,
        banner=_banner(run, scores),
        facts=_facts(run, scores),
        tables=tables(scores),
        figures=[Figure(f"{one.title}", one.draw("svg"), one.caption) for one in pictures(run, scores)],
    )


def _banner(run: Run, scores: Scores) -> str:
    if run.manifest.get("backend") == "plant":
        banner = _SEAM_BANNER
    elif any(motion.true is not None for motion in scores.motions):
        banner = _TRUTH_BANNER
    else:
        banner = _MEASURED_BANNER
    if scores.ended_early:
        banner += f" Ended before its time: {'. '.join(scores.ended_early)}."
    return banner


def _facts(run: Run, scores: Scores) -> list[tuple[str, str]]:
    manifest = run.manifest
    profile = manifest.get("profile", {})
    facts = [
        ("Profile", str(profile.get("name", ""))),
        ("World", str(manifest.get("backend_description", manifest.get("backend", "")))),
        ("Run", run.folder.name),
        ("Rows", f"{len(run.rows):,}".replace(",", "\u2009")),
    ]
    if "cycle" in profile:
        facts.append(("Cycle", str(Quantity(float(profile["cycle"]["rate_hz"]), "Hz"))))
    if manifest.get("profile_sha256"):
        facts.append(("Profile's hash", str(manifest["profile_sha256"])[:12]))
    stop, text = ending(manifest)
    if stop not in ("", Stop.NONE.name, Stop.FINISHED.name):
        facts.append(("Ended", text))
    trajectories = {motion.segment.trajectory for motion in scores.motions}
    if trajectories:
        facts.append(("Trajectory", ", ".join(sorted(trajectories))))
    return facts


# ---- tables -----------------------------------------------------------------------------------------------------


def tables(scores: Scores) -> list[Table]:
    """Make the tables that the scores have data for."""
    made = []
    if scores.motions:
        made.append(tracking_table(scores.motions))
    if scores.backlash is not None:
        made.append(backlash_table(scores.backlash))
    if scores.cycles is not None:
        made.append(cycle_table(scores.cycles))
    return made


def tracking_table(motions: tuple[MotionScore, ...]) -> Table:
    """Errors of the end: one column a motion."""
    rows: list[list[str | Quantity]] = []

    def add(text: str, values: list[float | None], digits: int = 3) -> None:
        rows.append([text, *(Quantity(value, "m", digits) for value in values)])

    if all(motion.true is not None for motion in motions):
        true = [motion.true for motion in motions if motion.true is not None]
        add("true, max", [errors.max_m for errors in true])
        add("true, rms", [errors.rms_m for errors in true])
        add("true, settled, max", [errors.settled.max_m for errors in true])
        add("true, settled, rms", [errors.settled.rms_m for errors in true])
    measured = [motion.measured for motion in motions]
    add("measured, max", [errors.max_m for errors in measured])
    add("measured, rms", [errors.rms_m for errors in measured])
    add("measured, settled, max", [errors.settled.max_m for errors in measured])
    add("measured, settled, rms", [errors.settled.rms_m for errors in measured])
    if any(motion.settling is not None for motion in motions):
        window = Quantity(SETTLING_WINDOW_M, "m")
        cells: list[str | Quantity] = []
        for motion in motions:
            if motion.settling is None:
                cells.append(Quantity(None, "s"))
            elif motion.settling.time_s is None:
                cells.append("did not settle")
            else:
                cells.append(Quantity(motion.settling.time_s, "s", 2))
        rows.append([f"settles to ±{window} in", *cells])
    columns = ["Error of the end", *(_label(motion, motions) for motion in motions)]
    note = "Settled: where the reference has stood still for 0.1 s or longer."
    touched = [motion for motion in motions if motion.contact_ratio]
    if touched:
        shares = ", ".join(f"{_label(one, motions)} {100.0 * (one.contact_ratio or 0.0):.2g} %" for one in touched)
        note += f" Time with the joint in contact: {shares}."
    if any(motion.missed_cycles_count for motion in motions):
        missed = ", ".join(f"{_label(one, motions)} {one.missed_cycles_count}" for one in motions)
        note += f" Cycles that the host missed meanwhile: {missed}; each is an error that no law can help."
    names = sorted({motion.segment.trajectory for motion in motions})
    return Table(f"Tracking: {', '.join(names)}", columns, rows, note)


def _label(motion: MotionScore, motions: tuple[MotionScore, ...]) -> str:
    """Name a motion by its law; by its trajectory too where the run has several."""
    several = len({one.segment.trajectory for one in motions}) > 1
    return f"{motion.segment.law.upper()}, {motion.segment.trajectory}" if several else motion.segment.law.upper()


def backlash_table(score: BacklashScore) -> Table:
    """Identified against true, with standard deviations."""
    known = all(edge.true is not None for edge in score.edges)
    columns = ["Joint", "identified", "± 1 sd"] + (["true", "off by"] if known else [])
    rows: list[list[str | Quantity]] = []
    for edge in score.edges:
        is_length = edge.unit == "m"
        unit, scale = ("m", 1.0) if is_length else ("N/mm", 1e-3)
        prefix = "µ" if is_length else ""
        cells: list[str | Quantity] = [
            edge.name,
            Quantity(scale * edge.identified, unit, 5, prefix),
            Quantity(scale * edge.sd, unit, 2, prefix),
        ]
        if edge.true is not None:
            off = edge.identified - edge.true
            # A place has no share of anything; what has a size is judged by its share.
            is_place = edge.name.endswith("edge")
            shift = Quantity(off, unit, 2, prefix) if is_place else Quantity(100.0 * off / edge.true, "%", 2)
            cells += [Quantity(scale * edge.true, unit, 5, prefix), shift]
        rows.append(cells)
    note = (
        "On macro minus end, in the run's own zero: no force from minus the left to plus the right edge. The standard "
        "deviations hold noise only; a mass or force constant that is off in the profile shifts stiffness alike."
    )
    return Table("Backlash", columns, rows, note)


def cycle_table(score: CycleScore) -> Table:
    """How well the loop kept time."""
    names = [("sample_to_sync_ns", "sensor sample to end of SYNC")]
    if not score.is_virtual:
        names = [("lateness_ns", "wake-up behind its instant"), ("tick_ns", "decode, tick and encode"), *names]
    rows: list[list[str | Quantity]] = []
    for name, text in names:
        timing = score.timing(name)
        values = (timing.p50_ns, timing.p99_ns, timing.max_ns)
        rows.append([text, *(Quantity(value * 1e-9, "s", 3, "µ") for value in values)])
    note = (
        f"{score.cycles_count} cycles with power on: {score.missed_count} missed, {score.samples_lost_count} samples "
        f"lost, {score.late_lines_count} lines late and predicted over "
        f"({100.0 * score.late_lines_count / score.cycles_count:.1f} %). "
        f"SYNC period jitter {Quantity(score.sync_jitter_s, 's', 2)} rms."
    )
    if score.is_virtual:
        note += " Virtual time: no host that could be late."
    return Table("Cycle", ["Time", "p50", "p99", "max"], rows, note)


# ---- figures ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure that can be drawn as SVG or PNG."""

    name: str  # of its file
    title: str
    caption: str
    draw: "Draw"


class Draw:
    """A figure function with its values, waiting for the image format."""

    def __init__(self, function, *values):
        """Hold both."""
        self._function, self._values = function, values

    def __call__(self, image_format: str) -> bytes:
        """Draw as 'svg' or 'png'."""
        return self._function(*self._values, image_format=image_format)


def pictures(run: Run, scores: Scores) -> list[Picture]:
    """Return every figure that the scores have data for."""
    made = _tracking_pictures(scores.motions) + _hold_pictures(scores.motions)
    if scores.backlash is not None:
        made += _backlash_pictures(run, scores.backlash)
    if scores.cycles is not None:
        made.append(_timing_picture(scores.cycles))
    return made


def _tracking_pictures(motions: tuple[MotionScore, ...]) -> list[Picture]:
    made = []
    for trajectory in dict.fromkeys(motion.segment.trajectory for motion in motions):
        of_it = [motion for motion in motions if motion.segment.trajectory == trajectory]
        traces = [_trace(motion) for motion in of_it]
        longest = max(of_it, key=lambda motion: motion.t_s.size)
        caption = "Reference of the end, and how far the end was from it"
        caption += "." if all(motion.true_error_m is not None for motion in of_it) else ", as measured."
        if len(of_it) > 1:
            caption += " The same reference, one after the other."
        draw = Draw(figures.tracking_figure, longest.t_s, longest.reference_m, traces)
        made.append(Picture(f"tracking-{trajectory}", f"Tracking error, {trajectory}", caption, draw))
    return made


def _trace(motion: MotionScore) -> ErrorTrace:
    """Show truth with the measured beside it, or the measured alone; a late line repeats the one before."""
    fresh = np.isfinite(motion.measured_error_m)
    measured_m = np.interp(motion.t_s, motion.t_s[fresh], motion.measured_error_m[fresh])
    label = motion.segment.law.upper()
    if motion.true_error_m is None:
        return ErrorTrace(label, motion.t_s, measured_m)
    return ErrorTrace(label, motion.t_s, motion.true_error_m, measured_m)


def _hold_pictures(motions: tuple[MotionScore, ...]) -> list[Picture]:
    holds = []
    for motion in motions:
        error_m = _trace(motion).true_m[motion.hold]
        if error_m.size:
            holds.append(HoldTrace(_label(motion, motions), error_m, motion.period_s, motion.true_error_m is not None))
    if not holds:
        return []
    caption = "The last rest, from 0.2 s after the reference stopped: how the error is distributed, and from which "
    caption += "frequencies its rms comes. " + (
        "True position." if all(hold.is_true for hold in holds) else "As measured."
    )
    return [Picture("hold", "Holding still", caption, Draw(figures.hold_figure, holds))]


def _backlash_pictures(run: Run, score: BacklashScore) -> list[Picture]:
    identified = _curve(score, lambda edge: edge.identified, with_band=True)
    known = all(edge.true is not None for edge in score.edges)
    true = _curve(score, lambda edge: edge.true or 0.0, with_band=False) if known else None
    made = []
    balance = _contact_points(run, score)
    if balance is not None:
        caption = "Each point: what the joint must have carried, from the micro's mass times the measured "
        caption += "acceleration, less its motor's force and its spring. The line is not fitted to these points: it "
        caption += (
            "is what the estimator in the loop identified while the stage moved. The loop is the contact's damping."
        )
        draw = Draw(figures.backlash_figure, *balance, identified, true)
        made.append(Picture("backlash", "The joint, identified", caption, draw))
    estimates = _estimates(score)
    if estimates:
        caption = "The estimator in the loop while the micro sweeps both edges; "
        caption += "its band holds noise, no error of the profile."
        made.append(Picture("convergence", "Identification", caption, Draw(figures.convergence_figure, estimates)))
    return made


def _curve(score: BacklashScore, value, with_band: bool) -> BacklashCurve:
    left, right = score.edge("left edge"), score.edge("right edge")
    band = {
        "left_half_width_m": _NORMAL_95 * left.sd,
        "right_half_width_m": _NORMAL_95 * right.sd,
    }
    return BacklashCurve(
        value(left),
        value(right),
        value(score.edge("left stiffness")),
        value(score.edge("right stiffness")),
        **(band if with_band else {}),
    )


def _contact_points(run: Run, score: BacklashScore) -> tuple[np.ndarray, np.ndarray] | None:
    """Balance the micro at every sample: (macro minus end, force that the joint must have carried)."""
    profile = profile_of(run)
    micro, period_s = profile.micro, profile.cycle.period_s
    window = 2 * round(0.5 * _BALANCE_WINDOW_S / period_s) + 1
    rows = score.rows
    fresh = (rows["sequence"] == rows["cycle"]) & (rows["samples_new"] > 0)
    if micro is None or np.count_nonzero(fresh) < 2 * window:
        return None
    grid = np.arange(rows["cycle"][0], rows["cycle"][-1] + 1)
    end_m = np.interp(grid, rows["cycle"][fresh], rows["end_position_m"][fresh])
    macro_m = np.interp(grid, rows["cycle"][fresh], rows["macro_position_m"][fresh])

    def smooth(values: np.ndarray, derivative: int = 0) -> np.ndarray:
        return np.asarray(savgol_filter(values, window, 3, deriv=derivative, delta=period_s))

    acceleration = smooth(end_m, 2)
    relative_m = smooth(macro_m - end_m)
    rate = smooth(macro_m - end_m, 1)
    # The word of a row acts from its SYNC on, through the current loop.
    delay = profile.cycle.actuation_delay_s + micro.current_loop_s
    at = np.clip(np.floor(np.interp(grid - delay / period_s, rows["cycle"], np.arange(rows.size))), 0, rows.size - 1)
    ahead = np.clip(np.floor(at + 1), 0, rows.size - 1)
    share = 1.0 - (delay / period_s) % 1.0
    force_n = rows["micro_force_n"]
    motor_n = share * force_n[at.astype(int)] + (1.0 - share) * force_n[ahead.astype(int)]
    motor_n = smooth(motor_n)
    coupling_n = micro.spring_n_per_m * relative_m + micro.damping_n_s_per_m * rate
    contact_n = micro.mass_kg * acceleration - motor_n - coupling_n
    inner = slice(window, -window)
    return relative_m[inner], contact_n[inner]


def _estimates(score: BacklashScore) -> list[Estimate]:
    """Show edges and stiffness as they are identified; none where the run has no standard deviations by row."""
    rows = score.rows
    names = (
        ("left edge", "backlash_left", "µm", 1e6),
        ("right edge", "backlash_right", "µm", 1e6),
        ("left stiffness", "backlash_left_stiffness", "N/mm", 1e-3),
        ("right stiffness", "backlash_right_stiffness", "N/mm", 1e-3),
    )
    estimates = []
    for name, field, unit, scale in names:
        ending = "_n_per_m" if "stiffness" in field else "_m"
        value = rows[f"{field}{ending}"] * scale
        half = _NORMAL_95 * rows[f"{field}_sd{ending}"] * scale
        known = np.isfinite(half) & np.isfinite(value)
        if np.count_nonzero(known) < 2:
            return []
        value, half = np.where(known, value, np.nan), np.where(known, half, np.nan)
        true = score.edge(name).true
        shown = true * scale if true is not None else None
        estimates.append(Estimate(name, unit, score.t_s, value, half, shown))
    return estimates


def _timing_picture(score: CycleScore) -> Picture:
    series = [TimeSeries("sensor sample to end of SYNC", score.sample_to_sync_ns)]
    if not score.is_virtual:
        series += [
            TimeSeries("decode, tick and encode", score.tick_ns),
            TimeSeries("wake-up behind its instant", score.lateness_ns),
        ]
    caption = "Every cycle with power on; the dashed line is one period."
    return Picture("timing", "Timing", caption, Draw(figures.timing_figure, series, score.period_ns))
