"""One recording as the gap workflow sees it: positions and commands on the sensor's own grid.

From run folders of ours and from imported tables alike. What can't be used is refused or excluded here, and said.
Pure but for `read_log`; knows no clock.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stagectl.errors import RecordError
from stagectl.record import read_run
from stagectl.requests import TICKING

LEAST_SAMPLES_COUNT = 1000
"""Shorter recordings say nothing below 1 Hz, where cables and tilt live."""

GAP_LIMIT_RATIO = 0.2
"""Share of excluded samples beyond which a recording is refused."""

_STILL_M = 20e-6
_IRREGULAR_RATIO = 0.05
_MILLIMETRES_SPAN = 2.0


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
    macro_current_a: np.ndarray | None = None  # as the drive reports it at the sample
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


def read_log(folder: Path, period_s: float) -> Log:
    """Read a run folder; RecordError where it can't be used, with the reason."""
    run = read_run(folder)
    rows = run.rows
    imported = run.manifest.get("backend") == "import"
    if not imported:
        rows = rows[np.isin(rows["run_phase"], [int(phase) for phase in TICKING])]
    session = str(int(rows["homing_id"][0])) if rows.size else ""
    return _log_of_rows(rows, str(folder), period_s, f"{folder.name if imported else ''}:{session}", imported)


def _log_of_rows(rows: np.ndarray, name: str, period_s: float, session: str, imported: bool) -> Log:
    """Put rows on the sensor's grid."""
    if rows.size < LEAST_SAMPLES_COUNT:
        raise RecordError(
            f"{name}: {rows.size} rows in motion, at least {LEAST_SAMPLES_COUNT} are needed; record a longer motion"
        )
    cycles = rows["cycle"].astype(np.int64)
    if imported:
        _check_times(rows["t_ns"], period_s, name)
    place = cycles - cycles[0]
    if np.any(np.diff(place) <= 0):
        raise RecordError(f"{name}: cycle numbers do not rise; the recording is damaged or two were joined")
    count = int(place[-1]) + 1
    valid = np.zeros(count, bool)
    valid[place] = (rows["samples_new"] > 0) & (rows["sequence"] == rows["cycle"]) if not imported else True

    def on_grid(column: str) -> np.ndarray | None:
        values = rows[column].astype(float)
        if np.all(np.isnan(values)):
            return None
        grid = np.full(count, np.nan)
        grid[place] = values
        missing = np.isnan(grid)
        if missing.any():
            grid[missing] = np.interp(np.flatnonzero(missing), np.flatnonzero(~missing), grid[~missing])
            valid[missing] = False
        return grid

    macro, command = on_grid("macro_position_m"), on_grid("macro_force_n")
    if macro is None or command is None:
        lacking = "macro_position_m" if macro is None else "macro_force_n"
        raise RecordError(f"{name}: no column {lacking}; map it with `stagectl runs import`")
    remarks = []
    excluded = 1.0 - float(valid.mean())
    if excluded > GAP_LIMIT_RATIO:
        raise RecordError(
            f"{name}: {excluded:.0%} of the samples are missing or late, limit {GAP_LIMIT_RATIO:.0%}; "
            "record on a quieter host"
        )
    if excluded > 0.0:
        remarks.append(f"{name}: {excluded:.2%} of the samples are missing or late and were predicted over")
    if not np.ptp(command) > 0.0:
        raise RecordError(f"{name}: macro_force_n is constant; swapped columns, or the stage was not driven")
    if not np.ptp(macro) > _STILL_M:
        moved_um = np.ptp(macro) * 1e6
        remarks.append(f"{name}: the macro moved by {moved_um:.1f} um only; what depends on motion is not seen")
    if np.ptp(macro) > _MILLIMETRES_SPAN:
        raise RecordError(
            f"{name}: macro_position_m spans {np.ptp(macro):.3g} m; are these millimetres? Give the unit in the import"
        )
    return Log(
        name=name,
        period_s=period_s,
        macro_position_m=macro,
        macro_command_n=command,
        valid=valid,
        session=session,
        end_position_m=on_grid("end_position_m"),
        micro_command_n=on_grid("micro_force_n"),
        reference_m=on_grid("setpoint_position_m"),
        remarks=tuple(remarks),
    )


def _check_times(t_ns: np.ndarray, period_s: float, name: str) -> None:
    """Refuse times that jump or disagree with the profile's rate."""
    steps_s = np.diff(t_ns) * 1e-9
    middle_s = float(np.median(steps_s))
    if not abs(middle_s - period_s) <= _IRREGULAR_RATIO * period_s:
        raise RecordError(
            f"{name}: samples come every {middle_s * 1e3:.4g} ms, the profile says {period_s * 1e3:.4g} ms; "
            "correct rate_hz, or the unit of the time column"
        )
    wrong = np.flatnonzero(np.abs(steps_s - period_s) > 0.5 * period_s)
    if wrong.size:
        raise RecordError(
            f"{name}: time jumps by {steps_s[wrong[0]] * 1e3:.4g} ms at row {int(wrong[0])}, {wrong.size} times in "
            "all; cut the recording there"
        )


def constant_columns(log: Log) -> list[str]:
    """Name channels that never change: swapped or dead."""
    channels: dict[str, Any] = {
        "macro_position_m": log.macro_position_m,
        "end_position_m": log.end_position_m,
        "macro_force_n": log.macro_command_n,
        "micro_force_n": log.micro_command_n,
    }
    return [name for name, values in channels.items() if values is not None and not np.ptp(values) > 0.0]
