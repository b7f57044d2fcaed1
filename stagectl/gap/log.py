"""One recording as the gap workflow sees it: positions and commands on the sensor's own grid.

From run folders of ours and from imported tables alike. What can't be used is refused or excluded here, and said.
Pure but for `read_log`; knows no clock.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from stagectl.errors import RecordError
from stagectl.gap.believed import Believed
from stagectl.record import Run, read_run
from stagectl.requests import Phase

LEAST_SAMPLES_COUNT = 1000
"""Shorter recordings say nothing below 1 Hz, where cables and tilt live."""

GAP_LIMIT_RATIO = 0.2
"""Share of excluded samples beyond which a recording is refused."""

LONGEST_GAP_COUNT = 20
"""So many samples in a row can be predicted over; the stage moves too far in more."""

SATURATED_S = 0.02
"""A command that stands at its limit for longer is no command that the force follows."""

RETURNING_S = 0.1
"""One that comes back to a limit within SATURATED_S, again and again, for longer is of a loop that is not stable."""

STILL_M = 20e-6
"""An axis that moves less says nothing of what depends on motion."""

_PERIOD_RATIO = 5e-3  # a period that is wrong by this makes every force wrong by 1 %
_JITTER_RATIO = 0.05  # of a period, rms: at 0.1 m/s and 1 kHz it is 5 um
_MILLIMETRES_SPAN = 2.0
_LIMIT_RATIO = 0.999
_BEYOND_RATIO = 1.5
_STUCK_COUNT = 20
_STUCK_RATIO = 3.0
_UNDER_LAW = (Phase.TRACKING, Phase.STOPPING)  # in a guided stop the macro's drive makes its own force


@dataclass(frozen=True, slots=True)
class Log:
    """Values of one recording, one element a sample of the position sensor.

    `valid` is False where a sample is missing or its cycle is unusable: such samples are predicted over.
    """

    name: str
    period_s: float
    macro_position_m: np.ndarray
    macro_command_n: np.ndarray
    valid: np.ndarray
    session: str
    end_position_m: np.ndarray | None = None
    micro_command_n: np.ndarray | None = None
    reference_m: np.ndarray | None = None
    command_extra_n: np.ndarray | None = None  # known, added to the macro's command behind its controller
    macro_payload_kg: float = 0.0
    end_payload_kg: float = 0.0
    macro_current_a: np.ndarray | None = None  # as the drive reports it at the sample; ours at the SYNC behind it
    micro_current_a: np.ndarray | None = None
    start_s: float = 0.0  # since the machine was switched on, or since its first recording: drift and wear know no runs
    remarks: tuple[str, ...] = field(default=())

    @property
    def samples_count(self) -> int:
        """Samples on the grid, missing ones included."""
        return self.macro_position_m.size

    @property
    def times_s(self) -> np.ndarray:
        """Sample instants since the recording's first."""
        return np.arange(self.samples_count) * self.period_s


def read_log(folder: Path, period_s: float, believed: Believed | None = None) -> Log:
    """Read a run folder; RecordError where it can't be used, with the reason.

    With `believed`, columns that its axes need are asked for, stretches with a command at its limit are left out, and
    forces that drives report become currents.
    """
    run = read_run(folder)
    if run.manifest.get("backend") == "import":
        session = f"{folder.name}:{int(run.rows['homing_id'][0]) if run.rows.size else 0}"
        return log_of_rows(run.rows, str(folder), period_s, session, imported=True, believed=believed)
    rows = _under_law(run, period_s)
    homing = int(rows["homing_id"][0]) if rows.size else 0
    return log_of_rows(rows, str(folder), period_s, f"{folder.name}:{homing}", imported=False, believed=believed)


def _under_law(run: Run, period_s: float) -> np.ndarray:
    """Return the rows of one homing in which a law moved both axes, in one zero. Errors: RecordError."""
    profile = run.manifest.get("profile", {})
    rate_hz = profile.get("cycle", {}).get("rate_hz")
    if rate_hz and not math.isclose(rate_hz * period_s, 1.0, rel_tol=_PERIOD_RATIO):
        raise RecordError(
            f"{run.folder}: recorded at {rate_hz:g} Hz, the profile says {1.0 / period_s:g} Hz; "
            "give the profile of this machine"
        )
    if profile.get("macro", {}).get("mode") == "position":
        raise RecordError(
            f"{run.folder}: the macro's drive closed its own position loop, so its force is not recorded; "
            'record in macro.mode = "torque"'
        )
    rows = run.rows[np.isin(run.rows["run_phase"], [int(phase) for phase in _UNDER_LAW])]
    if rows.size:
        homings, counts = np.unique(rows["homing_id"], return_counts=True)
        homing = int(homings[np.argmax(counts)])
        rows = rows[rows["homing_id"] == homing].copy()
        # Homing presses both edges in a zero that is wrong by up to half the gap: no motion that a user asked for.
        ends = [e["t_ns"] for e in run.events if e.get("event") == "homing" and int(e["number"]) == homing]
        if ends:
            rows = rows[rows["t_ns"] > ends[-1]]
    if rows.size:
        _put_in_one_zero(rows, run.events)
    return rows


def _put_in_one_zero(rows: np.ndarray, events: list[dict[str, Any]]) -> None:
    """Express all positions in the zero that homing ended with: touching the edges of the joint moves the end's."""
    zeros = {int(event["number"]): event for event in events if event.get("event") == "update"}
    last = zeros.get(int(rows["update_number"][-1]))
    for axis in ("macro", "end"):
        counts, position_m = rows[f"{axis}_counts"], rows[f"{axis}_position_m"]
        good = np.isfinite(counts) & np.isfinite(position_m) & (rows["update_number"] == rows["update_number"][-1])
        if last is None or np.count_nonzero(good) < 2 or not np.ptp(counts[good]) > 0.0:
            continue
        scale_m = float(np.polyfit(counts[good] - counts[good][0], position_m[good], 1)[0])
        for number in np.unique(rows["update_number"]):
            zero = zeros.get(int(number))
            if zero is not None:
                shift = float(zero[f"{axis}_zero_counts"]) - float(last[f"{axis}_zero_counts"])
                position_m[rows["update_number"] == number] += shift * scale_m


def log_of_rows(
    rows: np.ndarray, name: str, period_s: float, session: str, *, imported: bool, believed: Believed | None = None
) -> Log:
    """Put rows on the sensor's grid, leave out what can't be used, and say so. Errors: RecordError."""
    remarks: list[str] = []
    place = _places(rows, name, period_s, imported)
    first_place = place[0] if place.size else 0
    rows, place = _longest_whole(rows, place, name, period_s, remarks)
    if rows.size < LEAST_SAMPLES_COUNT:
        raise RecordError(
            f"{name}: {rows.size} rows in motion, at least {LEAST_SAMPLES_COUNT} are needed; record a longer motion"
        )
    started = int(place[0] - first_place)
    place = place - place[0]
    count = int(place[-1]) + 1
    fresh = (
        (rows["samples_new"] > 0) & (rows["sequence"] == rows["cycle"]) if not imported else np.ones(rows.size, bool)
    )
    columns = {
        column: _on_grid(rows[column].astype(float), place, count, fresh if column.endswith("position_m") else None)
        for column in _COLUMNS
        if not np.all(np.isnan(rows[column].astype(float)))
    }
    _check_columns(columns, name, believed)
    valid = np.ones(count, bool)
    for column in _JUDGED:
        if column in columns:
            valid &= columns[column][1]
    excluded = 1.0 - float(valid.mean())
    if excluded > GAP_LIMIT_RATIO:
        raise RecordError(
            f"{name}: {excluded:.0%} of the samples are missing or late, limit {GAP_LIMIT_RATIO:.0%}; "
            "record on a quieter host"
        )
    if excluded > 0.0:
        remarks.append(f"{name}: {excluded:.2%} of the samples are missing or late and were predicted over")
    values = {column: grid for column, (grid, _) in columns.items()}
    whole = Log(
        name=name,
        period_s=period_s,
        macro_position_m=values["macro_position_m"],
        macro_command_n=values["macro_force_n"],
        valid=valid,
        session=session,
        end_position_m=values.get("end_position_m"),
        micro_command_n=values.get("micro_force_n"),
        reference_m=values.get("setpoint_position_m"),
        macro_current_a=_current_a(values, "macro", believed, imported),
        micro_current_a=_current_a(values, "micro", believed, imported),
        start_s=started * period_s,
        remarks=tuple(remarks),
    )
    log = whole if believed is None else without_saturation(whole, believed)
    return replace(log, remarks=(*log.remarks, *_checked(log)))


_JUDGED = ("macro_position_m", "end_position_m", "macro_force_n", "micro_force_n")
_COLUMNS = (*_JUDGED, "setpoint_position_m", "macro_reported_force_n", "micro_reported_force_n")


def _places(rows: np.ndarray, name: str, period_s: float, imported: bool) -> np.ndarray:
    """Return which sample of the grid each row is, shape (n,), rising. Errors: RecordError."""
    cycles = rows["cycle"].astype(np.int64)
    if np.any(np.diff(cycles) <= 0):
        raise RecordError(f"{name}: cycle numbers do not rise; the recording is damaged or two were joined")
    if not imported or rows.size < 2:
        return cycles
    steps = np.diff(rows["t_ns"]) * 1e-9 / period_s
    _check_times(steps, period_s, name)
    # A sample that was dropped shows in the number of its cycle, where the table has one, or in the time.
    return np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps).astype(np.int64), np.diff(cycles)))])


def _check_times(steps: np.ndarray, period_s: float, name: str) -> None:
    """Refuse times that jump, scatter or disagree with the profile's rate; `steps` in periods, shape (n - 1,)."""
    middle = float(np.median(steps))
    whole = np.rint(steps)
    regular = steps[whole == 1.0]
    mean = float(np.mean(regular)) if regular.size else middle
    if not (abs(middle - 1.0) <= 0.5 and abs(mean - 1.0) <= _PERIOD_RATIO):
        shown = mean if abs(middle - 1.0) <= 0.5 else middle
        raise RecordError(
            f"{name}: samples come every {shown * period_s * 1e3:.4g} ms, the profile says {period_s * 1e3:.4g} ms; "
            "correct rate_hz, or the unit of the time column"
        )
    wrong = np.flatnonzero((whole < 1.0) | (whole > LONGEST_GAP_COUNT))
    if wrong.size:
        raise RecordError(
            f"{name}: time jumps by {steps[wrong[0]] * period_s * 1e3:.4g} ms at row {int(wrong[0])}, {wrong.size} "
            "times in all; cut the recording there"
        )
    jitter = float(np.sqrt(np.mean((steps - whole) ** 2)))
    if not jitter <= _JITTER_RATIO:
        raise RecordError(
            f"{name}: sample times scatter by {jitter:.1%} of a period, limit {_JITTER_RATIO:.0%}; positions must be "
            "sampled at even instants: give the sensor's own times, with all their digits"
        )


def _longest_whole(
    rows: np.ndarray, place: np.ndarray, name: str, period_s: float, remarks: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the longest stretch without a gap that is too long to be predicted over."""
    breaks = np.flatnonzero(np.diff(place) > LONGEST_GAP_COUNT) + 1
    if not breaks.size:
        return rows, place
    edges = np.concatenate([[0], breaks, [rows.size]])
    longest = int(np.argmax(np.diff(edges)))
    first, last = int(edges[longest]), int(edges[longest + 1])
    left_out_s = (rows.size - (last - first)) * period_s
    remarks.append(
        f"{name}: {breaks.size} gaps of more than {LONGEST_GAP_COUNT} samples; the longest stretch between them, "
        f"{(last - first) * period_s:.3g} s, is used, {left_out_s:.3g} s are left out"
    )
    return rows[first:last], place[first:last]


def _on_grid(
    values: np.ndarray, place: np.ndarray, count: int, fresh: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return (values at every sample of the grid, which of them were measured).

    A late line leaves the position of the sample before in its row, which is none of this instant.
    """
    known = np.isfinite(values)
    if fresh is not None:
        known &= fresh
    measured = np.zeros(count, bool)
    measured[place[known]] = True
    grid = np.zeros(count)
    grid[place[known]] = values[known]
    if np.count_nonzero(known) < 4 or measured.all():
        return grid, measured
    missing = np.flatnonzero(~measured)
    if fresh is None:  # commands have steps
        grid[missing] = np.interp(missing, place[known], values[known])
    else:  # positions have none: along a line, 2 m/s^2 would be off by 1 um at 1 kHz
        grid[missing] = CubicSpline(place[known], values[known])(np.clip(missing, place[known][0], place[known][-1]))
    return grid, measured


def _check_columns(columns: dict[str, Any], name: str, believed: Believed | None) -> None:
    """Refuse a recording that lacks a column that its profile needs."""
    needed = ["macro_position_m", "macro_force_n"]
    if believed is not None and believed.micro is not None:
        needed += ["end_position_m", "micro_force_n"]
    lacking = [column for column in needed if column not in columns]
    if lacking:
        whose = f", which profile {believed.name} needs" if believed is not None else ""
        raise RecordError(f"{name}: no column {', '.join(lacking)}{whose}; map it with `stagectl runs import`")


def without_saturation(log: Log, believed: Believed) -> Log:
    """Return the longest stretch of a recording in which no command stands at its limit or keeps coming back to it.

    What the force does meanwhile nobody knows, and the motion remembers it: the stretches are not joined. A loop that
    swings between its limits is unstable: a micro at 100 Hz, 180 N and 100 m/s2 left 16 000 squares of 4.2 billion to
    a name that was not there. A command far beyond its limit is none of this profile, or in another unit. Errors:
    RecordError.
    """
    clipped = np.zeros(log.samples_count, bool)
    for axis, command_n in (("macro", log.macro_command_n), ("micro", log.micro_command_n)):
        belief = believed.macro if axis == "macro" else believed.micro
        if command_n is None or belief is None or not math.isfinite(belief.force_limit_n):
            continue
        highest_n = float(np.max(np.abs(command_n)))
        if highest_n > _BEYOND_RATIO * belief.force_limit_n:
            raise RecordError(
                f"{log.name}: {axis}_force_n reaches {highest_n:.4g} N, the profile limits it to "
                f"{belief.force_limit_n:g} N; check the column's unit in the import, or correct the profile's limit"
            )
        clipped |= _at_limit(command_n / belief.force_limit_n, log.period_s)
    if not clipped.any():
        return log
    starts, ends = _stretches(~clipped)
    clipped_s = np.count_nonzero(clipped) * log.period_s
    if not starts.size or int(np.max(ends - starts)) < LEAST_SAMPLES_COUNT:
        raise RecordError(
            f"{log.name}: commands stand at their limits or keep coming back to them for {clipped_s:.3g} s, and no "
            f"{LEAST_SAMPLES_COUNT} samples in a row are free of it; record a gentler motion, in a stable loop"
        )
    longest = int(np.argmax(ends - starts))
    first, last = int(starts[longest]), int(ends[longest])
    remark = (
        f"{log.name}: commands stand at their limits or keep coming back to them for {clipped_s:.3g} s (saturated); "
        f"the longest stretch between, {first * log.period_s:.3g} to {last * log.period_s:.3g} s, is used, the rest is "
        "left out"
    )
    return replace(_stretch_of(log, first, last), remarks=(*log.remarks, remark))


def _at_limit(command_ratio: np.ndarray, period_s: float) -> np.ndarray:
    """Tell where a command, as a share of its limit, stands at it for long, or keeps coming back to it."""
    clipped = np.zeros(command_ratio.size, bool)
    starts, ends = _stretches(np.abs(command_ratio) >= _LIMIT_RATIO)
    at_once = max(2, round(SATURATED_S / period_s))
    for start, end in zip(starts, ends, strict=True):
        clipped[start:end] = end - start >= at_once
    if starts.size:
        is_return = starts[1:] - ends[:-1] < at_once
        firsts = starts[np.concatenate([[True], ~is_return])]
        lasts = ends[np.concatenate([~is_return, [True]])]
        for first, last in zip(firsts, lasts, strict=True):
            if (last - first) * period_s >= RETURNING_S:
                clipped[first:last] = True
    return clipped


def _stretch_of(log: Log, first: int, last: int) -> Log:
    """Return the samples from `first` to before `last`; what drifts has drifted since."""
    there = slice(first, last)

    def cut(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[there]

    return replace(
        log,
        macro_position_m=log.macro_position_m[there],
        macro_command_n=log.macro_command_n[there],
        valid=log.valid[there],
        end_position_m=cut(log.end_position_m),
        micro_command_n=cut(log.micro_command_n),
        reference_m=cut(log.reference_m),
        command_extra_n=cut(log.command_extra_n),
        macro_current_a=cut(log.macro_current_a),
        micro_current_a=cut(log.micro_current_a),
        start_s=log.start_s + first * log.period_s,
    )


def _stretches(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (first, behind last) of every stretch in which a mask is True."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(int))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def _checked(log: Log) -> list[str]:
    """Refuse what no stage does; return what is to be said of what says little."""
    for column, position_m in (("macro_position_m", log.macro_position_m), ("end_position_m", log.end_position_m)):
        if position_m is None:
            continue
        span_m = float(np.ptp(position_m))
        if span_m > _MILLIMETRES_SPAN:
            raise RecordError(
                f"{log.name}: {column} spans {span_m:.3g} m; are these millimetres, or is it another column? Give "
                "column and unit in the import"
            )
        _check_alive(position_m, f"{log.name}: {column}")
    if not np.ptp(log.macro_command_n) > 0.0:
        raise RecordError(f"{log.name}: macro_force_n is constant; swapped columns, or the stage was not driven")
    moved_m = float(np.ptp(log.macro_position_m))
    if moved_m > STILL_M:
        return []
    return [f"{log.name}: the macro moved by {moved_m * 1e6:.1f} um only; what depends on motion is not seen"]


def _check_alive(position_m: np.ndarray, place: str) -> None:
    """Refuse a position that is held while the stage moves: a sensor that stuck, or one slower than the table."""
    steps_m = np.abs(np.diff(position_m))
    if not steps_m.any():
        return  # constant: said elsewhere
    held = steps_m == 0.0
    starts, ends = _stretches(held)
    jumps_m = np.where(ends < steps_m.size, steps_m[np.minimum(ends, steps_m.size - 1)], 0.0)
    usual_m = float(np.quantile(steps_m[~held], 0.999))
    stuck = (ends - starts >= _STUCK_COUNT) & (jumps_m > _STUCK_RATIO * usual_m)
    if stuck.any():
        first = int(np.argmax(stuck))
        raise RecordError(
            f"{place} stays the same for {int(ends[first] - starts[first]) + 1} samples from sample "
            f"{int(starts[first])} on and then jumps by {jumps_m[first] * 1e6:.3g} um; the sensor stuck: cut the "
            "recording there"
        )
    reach = _STUCK_COUNT // 2
    least_m = float(steps_m[~held].min())
    moving = np.abs(position_m[2 * reach :] - position_m[: -2 * reach])[: held.size - reach] > 4 * reach * least_m
    repeated = float(held[reach : reach + moving.size][moving].mean()) if moving.any() else 0.0
    if repeated > GAP_LIMIT_RATIO:
        raise RecordError(
            f"{place} repeats the sample before in {repeated:.0%} of the samples in motion, limit "
            f"{GAP_LIMIT_RATIO:.0%}; the sensor is slower than the table: import it at the sensor's own rate"
        )


def _current_a(
    values: dict[str, np.ndarray], axis: str, believed: Believed | None, imported: bool
) -> np.ndarray | None:
    """Return the current behind the force that a drive reports."""
    force_n = values.get(f"{axis}_reported_force_n")
    belief = None if believed is None else getattr(believed, axis)
    if force_n is None or belief is None:
        return None
    if not imported:  # a row of ours holds what was sampled at the SYNC of the cycle before
        force_n = np.concatenate([force_n[1:], force_n[-1:]])
    return force_n / belief.force_constant_n_per_a


def constant_columns(log: Log) -> list[str]:
    """Name channels that never change: swapped or dead."""
    channels: dict[str, Any] = {
        "macro_position_m": log.macro_position_m,
        "end_position_m": log.end_position_m,
        "macro_force_n": log.macro_command_n,
        "micro_force_n": log.micro_command_n,
    }
    return [name for name, values in channels.items() if values is not None and not np.ptp(values) > 0.0]
