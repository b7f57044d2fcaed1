"""Rows as clients may have them: thinned out once, for everybody, whoever listens. Knows no client and no clock."""

import threading
from collections import deque
from typing import NamedTuple

import numpy as np

from stagectl.requests import TICKING

SCOPE_HZ = 100.0
KEPT_COUNT = 3000
"""Half a minute."""

COLUMNS = (
    "t_s",
    "end_position_m",
    "macro_position_m",
    "setpoint_position_m",
    "error_m",
    "relative_position_m",
    "macro_force_n",
    "micro_force_n",
    "contact_force_estimate_n",
    "phase",
)
"""`t_s` is the servo's clock; `error_m` is the greatest of the rows that a sample stands for, with its sign.

Rows whose line came late have no error: position and set-point are of different instants there. Nor has what came
before the power, or behind it, in a sample whose `phase`, its first row's, is the other's.
"""


class Samples(NamedTuple):
    """Samples behind a number, and the number of the last."""

    last: int
    rows: list[tuple[float, ...]]


class Scope:
    """Takes rows from the supervisor, gives samples to any thread; never grows."""

    def __init__(self, rate_hz: float):
        """`rate_hz` is that of the rows."""
        self._every = max(1, round(rate_hz / SCOPE_HZ))
        self._samples: deque[tuple[float, ...]] = deque(maxlen=KEPT_COUNT)
        self._count = 0
        self._lock = threading.Lock()
        self._rest: np.ndarray | None = None

    def add(self, rows: np.ndarray) -> None:
        """Take rows, oldest first, shape (n,) of ROW."""
        if self._rest is not None:
            rows = np.concatenate([self._rest, rows])
        whole = rows.size - rows.size % self._every
        self._rest = rows[whole:].copy() if whole < rows.size else None
        if whole == 0:
            return
        taken = rows[: whole : self._every]
        fresh = (rows["sequence"] == rows["cycle"]) & (rows["samples_new"] > 0)
        working = np.isin(rows["run_phase"], TICKING)
        fresh &= working == np.repeat(working[:: self._every], self._every)[: rows.size]
        errors_m = np.where(fresh, rows["end_position_m"] - rows["setpoint_position_m"], np.nan)[:whole]
        errors_m = errors_m.reshape(-1, self._every)
        worst = np.argmax(np.where(np.isnan(errors_m), -1.0, np.abs(errors_m)), axis=1)
        columns = (
            taken["t_ns"] * 1e-9,
            taken["end_position_m"],
            taken["macro_position_m"],
            taken["setpoint_position_m"],
            errors_m[np.arange(worst.size), worst],
            taken["end_position_m"] - taken["macro_position_m"],
            taken["macro_force_n"],
            taken["micro_force_n"],
            taken["contact_force_estimate_n"],
            taken["run_phase"],
        )
        samples = list(zip(*(column.tolist() for column in columns), strict=True))
        with self._lock:
            self._samples.extend(samples)
            self._count += len(samples)

    def after(self, number: int) -> Samples:
        """Return the samples behind `number`, as far as they are kept; -1 asks for none, to begin with."""
        with self._lock:
            missing = 0 if number < 0 else min(self._count - number, len(self._samples))
            if missing <= 0:
                return Samples(self._count, [])
            newest = [self._samples[place] for place in range(-missing, 0)]
            return Samples(self._count, newest)
