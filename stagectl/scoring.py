"""What a run really did: the rig's truth beside its rows, in the run's own laser zero.

Figures of merit on the rig are the true end position; the measured one stands beside it. Reads no machine file:
the truth is the rig's log (`sim_backend.truth`).
"""

from dataclasses import dataclass

import numpy as np

from drivers.wire import WireDecoder
from stagectl.errors import RecordError
from stagectl.record import Run
from stagectl.replay import mapping_of
from stagectl.runs import profile_of


@dataclass(frozen=True, slots=True)
class Scored:
    """One stretch of rows with what was true at their samples; one element a row."""

    rows: np.ndarray
    t_s: np.ndarray
    true_error_m: np.ndarray  # at the sample
    true_mean_error_m: np.ndarray  # averaged since the sample before
    measured_error_m: np.ndarray  # nan where the line came late
    true_macro_minus_end_m: np.ndarray
    contact_force_n: np.ndarray


def score(run: Run, truth: dict[str, np.ndarray], first_row: int, rows_count: int) -> Scored:
    """Join rows and truth by the sensor's sequence number; RecordError where the truth lacks a row's sample."""
    rows = run.rows[first_row : first_row + rows_count]
    profile = profile_of(run)
    mappings = {axis: mapping_of(table) for axis, table in run.manifest["mappings"].items()}
    decoder = WireDecoder(profile, mappings)
    place = np.searchsorted(truth["sequence"], rows["cycle"])
    place = np.minimum(place, truth["sequence"].size - 1)
    known = truth["sequence"][place] == rows["cycle"]
    if not known.all():
        missing = int(rows["cycle"][~known][0])
        raise RecordError(f"{run.folder}: the rig's truth holds no sample {missing}; is it the truth of this run?")
    # A zero is a count: the position that the laser would show at the true zero of its counter.
    end_zero_m = rows["end_counts"] * decoder.end_m_per_count - rows["end_position_m"]
    macro_zero_m = rows["macro_counts"] * decoder.macro_m_per_count - rows["macro_position_m"]
    end_m = truth["end_position_m"][place] - truth["end_zero_m"][place] - end_zero_m
    mean_m = truth["end_mean_position_m"][place] - truth["end_zero_m"][place] - end_zero_m
    macro_m = truth["macro_position_m"][place] - truth["macro_zero_m"][place] - macro_zero_m
    setpoint_m = rows["setpoint_position_m"]
    speed = rows["setpoint_velocity_m_per_s"]
    before_m = np.concatenate([setpoint_m[:1], setpoint_m[:-1]])
    before = np.concatenate([speed[:1], speed[:-1]])
    # Mean of the reference over the interval (Hermite): the chord alone misses a h^2 / 12, 83 nm at 1 m/s^2.
    reference_mean_m = 0.5 * (setpoint_m + before_m) + (before - speed) / (12.0 * profile.cycle.rate_hz)
    consecutive = np.concatenate([[False], np.diff(rows["cycle"]) == 1])
    fresh = (rows["sequence"] == rows["cycle"]) & (rows["samples_new"] > 0)
    return Scored(
        rows=rows,
        t_s=(rows["cycle"] - rows["cycle"][0]) / profile.cycle.rate_hz,
        true_error_m=end_m - setpoint_m,
        # Where cycles were missed the row before is not the sample before: the error at the sample stands in.
        true_mean_error_m=np.where(consecutive, mean_m - reference_mean_m, end_m - setpoint_m),
        measured_error_m=np.where(fresh, rows["end_position_m"] - setpoint_m, np.nan),
        true_macro_minus_end_m=macro_m - end_m,
        contact_force_n=truth["contact_force_n"][place],
    )
