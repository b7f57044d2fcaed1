"""Figures of merit of a run: tracking error, settling, moving average and deviation, spectrum, timing.

Pure numpy; knows no run folder. Names and rules follow what makers and users of stages call them.
"""

import math
from dataclasses import dataclass

import numpy as np

from stagectl.errors import RequestError

MOVING_SAMPLES_MIN_COUNT = 10
"""With fewer samples a window, a moving deviation says more about the sampling than about the stage."""

REST_RATIO = 1e-6
"""A setpoint whose speed or acceleration is below this part of the trajectory's largest counts as zero."""


@dataclass(frozen=True, slots=True)
class PhaseErrors:
    """Error within one phase of the motion; nan where the motion has no such phase."""

    max_m: float
    rms_m: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class Errors:
    """Error of a whole run and of its phases, each row in one phase at most."""

    max_m: float
    rms_m: float
    mean_m: float
    acceleration: PhaseErrors
    constant_speed: PhaseErrors
    settled: PhaseErrors


@dataclass(frozen=True, slots=True)
class Settling:
    """When the error came into its window for good; `time_s` is None where it did not."""

    time_s: float | None
    window_m: float
    dwell_s: float
    observed_s: float


@dataclass(frozen=True, slots=True)
class MovingErrors:
    """Moving average and moving standard deviation over an exposure window, shapes (n - window_samples + 1,)."""

    average_m: np.ndarray
    deviation_m: np.ndarray
    window_s: float
    window_samples_count: int
    warning: str | None

    @property
    def max_average_m(self) -> float:
        """Largest |MA|: what becomes overlay."""
        return float(np.max(np.abs(self.average_m)))

    @property
    def max_deviation_m(self) -> float:
        """Largest MSD: what becomes blur."""
        return float(np.max(self.deviation_m))


@dataclass(frozen=True, slots=True)
class Timing:
    """Percentiles of a time (nearest rank: each is a time that happened) and how many passed the deadline."""

    p50_ns: int
    p99_ns: int
    p999_ns: int
    max_ns: int
    missed_count: int
    cycles_count: int


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Cumulative rms from the lowest frequency up; its last value is the standard deviation of the error."""

    frequency_hz: np.ndarray
    cumulative_rms_m: np.ndarray


def error_statistics(t_s: np.ndarray, error_m: np.ndarray, setpoints: np.ndarray, settle_s: float = 0.1) -> Errors:
    """Error of the whole run and by phase of its reference; all shapes (n,), error = reference minus position.

    Acceleration: the reference accelerates. Constant speed: it moves and does not. Settled: it has stood for
    `settle_s` or longer (rest before the first move counts at once). RequestError for nan or unequal lengths.
    """
    times, error = _columns(t_s, error_m)
    if setpoints.shape != error.shape:
        raise RequestError(f"setpoints have shape {setpoints.shape}, error_m {error.shape}: cut both to the same rows")
    if not settle_s >= 0.0:
        raise RequestError(f"settle_s is {settle_s} s; 0 or more is needed")
    accelerates = _moves(setpoints["acceleration_m_per_s2"])
    runs = _moves(setpoints["velocity_m_per_s"])
    moving = accelerates | runs
    # Time since the reference last moved; rows before the first move have waited for ever.
    last_motion_s = np.maximum.accumulate(np.where(moving, times, -math.inf))
    settled = ~moving & (times - last_motion_s >= settle_s)
    step_s = float(np.median(np.diff(times)))
    return Errors(
        max_m=float(np.max(np.abs(error))),
        rms_m=_rms(error),
        mean_m=float(np.mean(error)),
        acceleration=_phase(error[accelerates], step_s),
        constant_speed=_phase(error[runs & ~accelerates], step_s),
        settled=_phase(error[settled], step_s),
    )


def settling(t_s: np.ndarray, error_m: np.ndarray, window_m: float, reference_end_s: float, dwell_s: float) -> Settling:
    """Last instant with |error| > window, minus the instant where the reference came to rest (0 where that is earlier).

    The first entry into the window does not count. Not settled: the last violation is within `dwell_s` of the end.
    """
    times, error = _columns(t_s, error_m)
    for name, value in (("window_m", window_m), ("dwell_s", dwell_s)):
        if not (math.isfinite(value) and value > 0.0):
            raise RequestError(f"{name} is {value}; a finite number above 0 is needed")
    observed_s = float(times[-1]) - reference_end_s
    if not observed_s >= dwell_s:
        raise RequestError(
            f"{observed_s:.4g} s were recorded after the reference came to rest and dwell_s is {dwell_s:g} s: "
            "record longer"
        )
    outside = np.flatnonzero(np.abs(error) > window_m)
    last_s = float(times[outside[-1]]) if outside.size else -math.inf
    if times[-1] - last_s < dwell_s:
        return Settling(None, window_m, dwell_s, observed_s)
    return Settling(max(last_s - reference_end_s, 0.0), window_m, dwell_s, observed_s)


def settling_time_s(
    t_s: np.ndarray, error_m: np.ndarray, window_m: float, reference_end_s: float, dwell_s: float
) -> float | None:
    """Settling time alone; None where the error did not settle. Report it with its window and dwell."""
    return settling(t_s, error_m, window_m, reference_end_s, dwell_s).time_s


def moving_average_and_deviation(error_m: np.ndarray, dt_s: float, window_s: float) -> MovingErrors:
    """MA and MSD over every whole window (population variance about the window's own average).

    Row i is the window over samples i .. i + window_samples - 1. Fewer than ten samples a window come with a warning.
    """
    error = _finite_column("error_m", error_m)
    for name, value in (("dt_s", dt_s), ("window_s", window_s)):
        if not (math.isfinite(value) and value > 0.0):
            raise RequestError(f"{name} is {value}; a finite number above 0 is needed")
    count = round(window_s / dt_s)
    if not 1 <= count <= error.size:
        raise RequestError(
            f"window_s is {window_s:g} s, {count} samples of {dt_s:g} s; the run has {error.size}: "
            "choose a window within it"
        )
    windows = np.lib.stride_tricks.sliding_window_view(error, count)
    average, deviation = np.empty(len(windows)), np.empty(len(windows))
    # In pieces: the deviations of all windows at once would take count times the memory of the run.
    piece = max(1, 2_000_000 // count)
    for start in range(0, len(windows), piece):
        some = windows[start : start + piece]
        average[start : start + piece] = some.mean(axis=1)
        deviation[start : start + piece] = some.std(axis=1)
    warning = None
    if count < MOVING_SAMPLES_MIN_COUNT:
        warning = (
            f"a window of {window_s * 1e3:g} ms holds {count} samples; below {MOVING_SAMPLES_MIN_COUNT} the moving "
            "deviation is not a meaningful number: sample faster or take a longer window"
        )
    return MovingErrors(average, deviation, window_s, count, warning)


def timing_statistics(time_ns: np.ndarray, deadline_ns: int | None = None) -> Timing:
    """Percentiles of times (latency, age, lateness; shape (n,), integers) and the count above `deadline_ns`."""
    values = np.asarray(time_ns)
    if values.ndim != 1 or values.size == 0 or not np.issubdtype(values.dtype, np.integer):
        raise RequestError(
            f"times have shape {values.shape} and type {values.dtype}; one column of whole nanoseconds is needed"
        )
    ordered = np.sort(values)
    ranks = [min(math.ceil(share * ordered.size), ordered.size) - 1 for share in (0.5, 0.99, 0.999)]
    p50_ns, p99_ns, p999_ns = (int(ordered[rank]) for rank in ranks)
    missed = 0 if deadline_ns is None else int(np.count_nonzero(values > deadline_ns))
    return Timing(p50_ns, p99_ns, p999_ns, int(ordered[-1]), missed, int(values.size))


def cumulative_rms(error_m: np.ndarray, dt_s: float) -> Spectrum:
    """Cumulative rms of an error about its mean, from its plain periodogram (Parseval: it ends at the deviation)."""
    error = _finite_column("error_m", error_m)
    if error.size < 2:
        raise RequestError(f"error_m has {error.size} samples; a spectrum needs at least 2")
    if not (math.isfinite(dt_s) and dt_s > 0.0):
        raise RequestError(f"dt_s is {dt_s}; a finite number above 0 is needed")
    power = np.abs(np.fft.rfft(error - error.mean())) ** 2 / error.size**2
    # Every line but the mean and, with an even count, the last one stands for two of opposite sign.
    power[1 : (error.size + 1) // 2] *= 2.0
    frequency_hz = np.fft.rfftfreq(error.size, dt_s)
    return Spectrum(frequency_hz[1:], np.sqrt(np.cumsum(power[1:])))


def _columns(t_s: np.ndarray, error_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Check time and error: equal lengths, finite, time rising."""
    times, error = _finite_column("t_s", t_s), _finite_column("error_m", error_m)
    if times.shape != error.shape:
        raise RequestError(f"t_s has {times.size} rows and error_m {error.size}: cut both to the same rows")
    if error.size < 2:
        raise RequestError(f"error_m has {error.size} rows; at least 2 are needed")
    if not np.all(np.diff(times) > 0.0):
        row = int(np.argmin(np.diff(times) > 0.0)) + 1
        raise RequestError(f"t_s, row {row}: {times[row]} s after {times[row - 1]} s; time must rise")
    return times, error


def _finite_column(name: str, values: np.ndarray) -> np.ndarray:
    column = np.asarray(values, dtype=float)
    if column.ndim != 1 or column.size == 0:
        raise RequestError(f"{name} has shape {column.shape}; one column with at least one row is needed")
    bad = np.flatnonzero(~np.isfinite(column))
    if bad.size:
        raise RequestError(
            f"{name}, row {bad[0]}: {column[bad[0]]}; {bad.size} of {column.size} rows "
            "are no finite numbers: cut them out"
        )
    return column


def _moves(values: np.ndarray) -> np.ndarray:
    """Mark rows that are not zero but for rounding."""
    size = np.abs(values)
    return size > REST_RATIO * np.max(size)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _phase(error_m: np.ndarray, step_s: float) -> PhaseErrors:
    if error_m.size == 0:
        return PhaseErrors(math.nan, math.nan, 0.0)
    return PhaseErrors(float(np.max(np.abs(error_m))), _rms(error_m), error_m.size * step_s)
