"""What a run achieved, from its rows, its events and, where somebody knows it, the truth: values, no pictures.

Motions are found by the events that the supervisor wrote; the demo, `run` and `runs plot` all score alike.
"""

import itertools
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stagectl.errors import RecordError
from stagectl.metrics import Errors, Settling, Timing, error_statistics, settling, timing_statistics
from stagectl.record import EVENTS, Run
from stagectl.requests import Phase
from stagectl.runs import profile_of
from stagectl.scoring import Scored, score
from stagectl.signals import SETPOINT, Stop, stop_sentence

TRUTH_FILE = "truth.npz"
"""What really happened, beside the run that it belongs to; only the scoring reads it."""

VALUE_SEAM = "plant"
"""The `backend` of a manifest whose rows never were bytes."""

SETTLING_WINDOW_M = 100e-9
SETTLING_DWELL_S = 0.2
LEAD_IN_S = 0.2
"""Rest before the first motion that is scored; what swings out before it belongs to the move that led there."""

SWEEP_NAME = "identifying the backlash"
_UNDER = re.compile(r"(?P<trajectory>.+) under (?P<law>\w+)")
_JOINT = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")
_SDS = ("left_sd_m", "right_sd_m", "left_stiffness_sd_n_per_m", "right_stiffness_sd_n_per_m")
_CYCLE_FIELDS = ("lateness_ns", "tick_ns", "sync_end_t_ns", "cycles_missed", "samples_lost")


@dataclass(frozen=True, slots=True)
class Segment:
    """One motion of a run: rows `first_row` to `first_row + rows_count`, and how it ended."""

    name: str
    trajectory: str  # empty where it followed none
    law: str  # likewise
    first_row: int
    rows_count: int
    stop: Stop
    detail: str = ""  # where, the value, its limit and the remedy, of a stop that has them

    @property
    def finished(self) -> bool:
        """Whether it came to its own end."""
        return self.stop is Stop.FINISHED

    @property
    def text(self) -> str:
        """The sentence for the operator."""
        return f"{self.name}: {stop_sentence(self.stop, self.detail)}"


@dataclass(frozen=True, slots=True)
class MotionScore:
    """How well one trajectory was followed; errors of the end, one element a row; None where nobody knows the truth."""

    segment: Segment
    t_s: np.ndarray
    reference_m: np.ndarray
    true_error_m: np.ndarray | None  # averaged between samples
    measured_error_m: np.ndarray  # nan where the line came late
    true: Errors | None
    measured: Errors
    settling: Settling | None  # of the worst rest; None where the reference never rests long enough
    hold: slice  # rows of the last rest
    contact_ratio: float | None  # share of rows with the joint in contact
    missed_cycles_count: int  # that the host was late for, while it moved
    period_s: float


@dataclass(frozen=True, slots=True)
class Edge:
    """One quantity of the joint: identified with its standard deviation, and true where known."""

    name: str
    unit: str
    identified: float
    sd: float
    true: float | None


@dataclass(frozen=True, slots=True)
class BacklashScore:
    """An identification: the joint in the run's own zero, and the rows that it came from."""

    segment: Segment
    edges: tuple[Edge, ...]  # left and right edge (no force from -left to +right), width, both stiffnesses
    rows: np.ndarray
    t_s: np.ndarray

    def edge(self, name: str) -> Edge:
        """Return one of `edges`."""
        return next(edge for edge in self.edges if edge.name == name)


@dataclass(frozen=True, slots=True)
class CycleScore:
    """Timing of the cycles in which the stage was armed, shapes (n,)."""

    lateness_ns: np.ndarray
    tick_ns: np.ndarray
    sample_to_sync_ns: np.ndarray
    sync_jitter_s: float
    cycles_count: int
    missed_count: int
    samples_lost_count: int
    late_lines_count: int
    period_ns: int
    is_virtual: bool  # no host to be late, no tick that takes its time

    def timing(self, name: str) -> Timing:
        """Return percentiles of one of the columns."""
        return timing_statistics(getattr(self, name), self.period_ns)


def read_truth(folder: Path) -> dict[str, np.ndarray] | None:
    """Read the truth beside a run, None where there is none. Errors: RecordError."""
    path = folder / TRUTH_FILE
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except OSError as error:
        raise RecordError(f"{path}: can't be read: {error.strerror}; the run itself is whole") from error
    except (EOFError, ValueError, zipfile.BadZipFile) as error:
        raise RecordError(f"{path}: is damaged or not ours; the run itself is whole: move this file away") from error


def write_truth(folder: Path, truth: dict[str, np.ndarray], joint) -> None:
    """Keep the truth beside its run, with the true joint (left_m, ... as in a machine file; None = none)."""
    values = dict(truth)
    if joint is not None:
        values |= {f"joint_{name}": np.array(float(getattr(joint, name))) for name in _JOINT}
    path = folder / TRUTH_FILE
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            np.savez(file, **values)  # pyright: ignore[reportArgumentType]
        part.replace(path)
    except OSError as error:
        raise RecordError(f"{path}: can't be written: {error.strerror}; free space on that disk") from error


def segments(run: Run) -> list[Segment]:
    """Find every motion of a run, in order; one that the run's end cut off counts as not finished.

    Errors: RecordError where an event does not say what it should.
    """
    found = []
    rows = run.rows
    armed = rows["run_phase"] == int(Phase.TRACKING)
    for begin, end in _pairs(run):
        try:
            number, name, setpoints = int(begin["number"]), str(begin["segment"]), int(begin["setpoints"])
            stop = Stop[end["stop"]] if end else Stop.OPERATOR
        except (KeyError, ValueError, TypeError) as error:
            raise RecordError(
                f"{run.folder / EVENTS}: motion {begin.get('segment')!r}: its events say {error}, or lack it; "
                "use the version that made the run"
            ) from error
        of_it = np.flatnonzero(armed & (rows["segment_number"] == number))
        if not of_it.size:
            continue
        match = _UNDER.fullmatch(name)
        trajectory, law = (match["trajectory"], match["law"]) if match else ("", "")
        # Rows behind the last setpoint only hold; a missed cycle has no row, and the reference goes on by cycles.
        cycles = rows["cycle"][of_it] - rows["cycle"][of_it[0]]
        count = int(np.count_nonzero(cycles < setpoints))
        found.append(Segment(name, trajectory, law, int(of_it[0]), count, stop, str(end.get("detail", ""))))
    return found


def _pairs(run: Run) -> list[tuple[dict, dict]]:
    """Return every motion's first event with the one that ended it, empty where none is recorded."""
    pairs: list[tuple[dict, dict]] = []
    for event in run.events:
        if event.get("event") == "segment":
            pairs.append((event, {}))
        elif event.get("event") == "segment_end" and pairs:
            pairs[-1] = (pairs[-1][0], event)
    return pairs


def last_finished(all_segments: list[Segment]) -> list[Segment]:
    """Keep finished motions along a trajectory; where one was repeated, the last."""
    kept = {segment.name: segment for segment in all_segments if segment.law and segment.finished}
    return list(kept.values())


def times_s(cycles: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return rising times of rows, s from the first: rows of one cycle share its period.

    A servo that a host held up may run twice within one period of the sensor, and both rows carry its number.
    """
    cycles = cycles - cycles[0]
    _, first, counts = np.unique(cycles, return_index=True, return_counts=True)
    share = (np.arange(cycles.size) - np.repeat(first, counts)) / np.repeat(counts, counts)
    return (cycles + share) / rate_hz


def score_motion(run: Run, segment: Segment, truth: dict[str, np.ndarray] | None) -> MotionScore:
    """Score one motion along a trajectory."""
    profile = profile_of(run)
    scored = _joined(run, truth, segment) if truth is not None else None
    rows = run.rows[segment.first_row : segment.first_row + segment.rows_count]
    skipped = _lead_in(rows, profile.cycle.rate_hz)
    rows = rows[skipped:]
    t_s = times_s(rows["cycle"], profile.cycle.rate_hz)
    fresh = (rows["sequence"] == rows["cycle"]) & (rows["samples_new"] > 0)
    measured_m = np.where(fresh, rows["end_position_m"] - rows["setpoint_position_m"], np.nan)
    setpoints = np.zeros(rows.size, SETPOINT)
    for name in SETPOINT.names or ():
        setpoints[name] = rows[f"setpoint_{name}"]
    rests = _rests(setpoints)
    true_m = None if scored is None else scored.true_mean_error_m[skipped:]
    judged_m, judged_t_s = (measured_m[fresh], t_s[fresh]) if true_m is None else (true_m, t_s)
    return MotionScore(
        segment=segment,
        t_s=t_s,
        reference_m=rows["setpoint_position_m"].copy(),
        true_error_m=true_m,
        measured_error_m=measured_m,
        true=None if true_m is None else error_statistics(t_s, true_m, setpoints),
        measured=error_statistics(t_s[fresh], measured_m[fresh], setpoints[fresh]),
        settling=_worst_settling(judged_t_s, judged_m, t_s, rests),
        hold=_last_hold(t_s, rests),
        contact_ratio=None if scored is None else float(np.mean(scored.contact_force_n[skipped:] != 0.0)),
        missed_cycles_count=int(rows["cycles_missed"][-1] - rows["cycles_missed"][0]),
        period_s=profile.cycle.period_s,
    )


def _joined(run: Run, truth: dict[str, np.ndarray], segment: Segment) -> Scored:
    """Join rows and truth; behind the value seam the truth is in the run's zero already."""
    if run.manifest.get("backend") != VALUE_SEAM:
        return score(run, truth, segment.first_row, segment.rows_count)
    rows = run.rows[segment.first_row : segment.first_row + segment.rows_count]
    part = slice(segment.first_row, segment.first_row + segment.rows_count)
    rate_hz = float(run.manifest["profile"]["cycle"]["rate_hz"])
    setpoint_m, speed = rows["setpoint_position_m"], rows["setpoint_velocity_m_per_s"]
    before_m = np.concatenate([setpoint_m[:1], setpoint_m[:-1]])
    before = np.concatenate([speed[:1], speed[:-1]])
    reference_mean_m = 0.5 * (setpoint_m + before_m) + (before - speed) / (12.0 * rate_hz)
    return Scored(
        rows=rows,
        t_s=times_s(rows["cycle"], rate_hz),
        true_error_m=truth["end_position_m"][part] - setpoint_m,
        true_mean_error_m=truth["end_mean_position_m"][part] - reference_mean_m,
        measured_error_m=rows["end_position_m"] - setpoint_m,
        true_macro_minus_end_m=truth["macro_position_m"][part] - truth["end_position_m"][part],
        contact_force_n=truth["contact_force_n"][part],
    )


def _lead_in(rows: np.ndarray, rate_hz: float) -> int:
    """Count the rows of rest before the first motion, less what counts as its lead-in."""
    moving = np.flatnonzero(np.abs(rows["setpoint_velocity_m_per_s"]) > 0.0)
    return max(int(moving[0]) - round(LEAD_IN_S * rate_hz), 0) if moving.size else 0


def _rests(setpoints: np.ndarray) -> list[slice]:
    """Return the stretches in which the reference stands still behind a motion."""
    still = np.ones(setpoints.size, bool)
    for name in ("velocity_m_per_s", "acceleration_m_per_s2"):
        size = np.abs(setpoints[name])
        still &= size <= 1e-6 * np.max(size)
    edges = np.flatnonzero(np.diff(still.astype(int)))
    bounds = [0, *(edges + 1), still.size]
    stretches = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds) if still[a]]
    return [stretch for stretch in stretches if stretch.start > 0]


def _worst_settling(t_s: np.ndarray, error_m: np.ndarray, row_t_s: np.ndarray, rests: list[slice]) -> Settling | None:
    """Settle at every rest that is long enough; the slowest counts, one that never settled most."""
    worst = None
    for rest in rests:
        begin_s, end_s = float(row_t_s[rest.start]), float(row_t_s[rest.stop - 1])
        within = (t_s >= begin_s) & (t_s <= end_s)
        if np.count_nonzero(within) < 2 or float(t_s[within][-1]) - begin_s < SETTLING_DWELL_S:
            continue
        one = settling(t_s[within], error_m[within], SETTLING_WINDOW_M, begin_s, SETTLING_DWELL_S)
        if worst is None or one.time_s is None or (worst.time_s is not None and one.time_s > worst.time_s):
            worst = one
            if one.time_s is None:
                break
    return worst


def _last_hold(t_s: np.ndarray, rests: list[slice], settle_s: float = 0.2) -> slice:
    """Return the rows of the last rest behind its settling; empty where there is none."""
    if not rests:
        return slice(0, 0)
    rest = rests[-1]
    first = int(np.searchsorted(t_s, t_s[rest.start] + settle_s))
    return slice(first, rest.stop) if rest.stop - first >= 100 else slice(0, 0)


def score_backlash(run: Run, truth: dict[str, np.ndarray] | None) -> BacklashScore | None:
    """Score the last finished identification of a run; None where there is none, or it said nothing."""
    sweeps = [segment for segment in segments(run) if segment.name == SWEEP_NAME and segment.finished]
    if not sweeps:
        return None
    segment = sweeps[-1]
    rows = run.rows[segment.first_row : segment.first_row + segment.rows_count]
    last = rows[-1]
    identified = {name: float(last[f"backlash_{name}"]) for name in _JOINT + _SDS}
    if not (np.isfinite(identified["left_sd_m"]) and np.isfinite(identified["right_sd_m"])):
        return None
    true = _true_joint(run, truth, segment)
    return BacklashScore(
        segment=segment,
        edges=_edges(identified, true),
        rows=rows,
        t_s=times_s(rows["cycle"], float(run.manifest["profile"]["cycle"]["rate_hz"])),
    )


def _edges(identified: dict[str, float], true: dict[str, float] | None) -> tuple[Edge, ...]:
    known = true or {}
    both_known = "left_m" in known
    sides = ("left", "right")
    return (
        Edge("left edge", "m", identified["left_m"], identified["left_sd_m"], known.get("left_m")),
        Edge("right edge", "m", identified["right_m"], identified["right_sd_m"], known.get("right_m")),
        Edge(
            "width",
            "m",
            identified["left_m"] + identified["right_m"],
            float(np.hypot(identified["left_sd_m"], identified["right_sd_m"])),
            known["left_m"] + known["right_m"] if both_known else None,
        ),
        *(
            Edge(
                f"{side} stiffness",
                "N/m",
                identified[f"{side}_stiffness_n_per_m"],
                identified[f"{side}_stiffness_sd_n_per_m"],
                known.get(f"{side}_stiffness_n_per_m"),
            )
            for side in sides
        ),
    )


def _true_joint(run: Run, truth: dict[str, np.ndarray] | None, segment: Segment) -> dict[str, float] | None:
    """Shift the true edges from the machine's frame into the run's own zero."""
    if truth is None or "joint_left_m" not in truth:
        return None
    joint = {name: float(truth[f"joint_{name}"]) for name in _JOINT}
    scored = _joined(run, truth, segment)
    if run.manifest.get("backend") == VALUE_SEAM:
        shift_m = float(truth["end_zero_m"][0] - truth["macro_zero_m"][0])
    else:
        place = np.searchsorted(truth["sequence"], scored.rows["cycle"])
        in_frame_m = truth["macro_position_m"][place] - truth["end_position_m"][place]
        shift_m = float(np.mean(scored.true_macro_minus_end_m - in_frame_m))
    joint["left_m"] -= shift_m
    joint["right_m"] += shift_m
    return joint


def score_cycles(run: Run) -> CycleScore | None:
    """Score the timing of the cycles in which the stage was armed; None where the run has no cycles of a servo."""
    if any(name in run.missing_fields for name in _CYCLE_FIELDS):
        return None
    rows = run.rows[run.rows["run_phase"] == int(Phase.TRACKING)]
    if rows.size < 3:
        return None
    period_ns = round(1e9 / float(run.manifest["profile"]["cycle"]["rate_hz"]))
    sync_ns = rows["sync_end_t_ns"]
    # In virtual time the end of a SYNC is known one row later: the bus carries it while the loop waits.
    latch_ns = np.where(sync_ns[:-1] >= rows["t_ns"][:-1], sync_ns[:-1], sync_ns[1:])
    sample_ns = rows["sample_t_ns"] + (rows["cycle"] - rows["sequence"]) * period_ns
    gaps_ns = np.diff(latch_ns)
    neighbours = gaps_ns < 1.5 * period_ns
    fresh = (rows["sequence"] == rows["cycle"]) & (rows["samples_new"] > 0)
    return CycleScore(
        lateness_ns=np.maximum(rows["lateness_ns"], 0),
        tick_ns=rows["tick_ns"].copy(),
        sample_to_sync_ns=np.maximum(latch_ns - sample_ns[:-1], 0)[np.abs(latch_ns - sample_ns[:-1]) < 10**9],
        sync_jitter_s=float(np.std(gaps_ns[neighbours])) * 1e-9,
        cycles_count=int(rows.size),
        missed_count=int(rows["cycles_missed"][-1] - rows["cycles_missed"][0]),
        samples_lost_count=int(rows["samples_lost"][-1] - rows["samples_lost"][0]),
        late_lines_count=int(np.count_nonzero(~fresh)),
        period_ns=period_ns,
        is_virtual=not np.any(rows["tick_ns"]),
    )
