"""Follow the reference's trajectories over the wire in batch, and say what the end really did."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_backend.machine import Machine
from stagectl import trajectory
from stagectl.backend import BatchBackend
from stagectl.errors import RequestError
from stagectl.outcome import Outcome
from stagectl.profile import Profile
from stagectl.record import Run, read_run
from stagectl.scoring import Scored, score
from stagectl.signals import SETPOINT
from stagectl.supervisor import Supervisor

SETTLED_S = 0.3
"""Rest after a motion before it counts as a hold."""

_REST_S = 0.5  # under the law before a trajectory begins: a change of law is no part of it


@dataclass(frozen=True, slots=True)
class Followed:
    """One trajectory under one law; errors of the end."""

    law: str
    trajectory: str
    seed: int
    cycles: int
    true_peak_m: float
    true_hold_rms_m: float
    measured_peak_m: float
    measured_hold_rms_m: float
    contact_share: float
    sample_to_sync_p50_s: float  # sample instant to end of the SYNC that latches the command
    sync_jitter_rms_s: float
    sample_error_rms_s: float  # of the recovered sample instant


def reference_trajectories(profile: Profile) -> list[trajectory.Trajectory]:
    """Return sine and trapezoid of the reference (Kang et al. 2023, 5.3), fitted to this stage's travel.

    The printed sine, 0.5 m at 0.75 rad/s, is longer than the travel of oled-printer: 0.4 m at 0.9375 rad/s has the
    same peak speed and 25 % more acceleration.
    """
    if not profile.macro.travel_m[1] > 0.4:
        raise RequestError(f"profile {profile.name}: travel_m ends at {profile.macro.travel_m[1]:g} m; 0.4 m is needed")
    return [
        trajectory.sine(0.4, 0.9375, 20.2),
        trajectory.trapezoid(0.8, 0.2, start_m=-0.4, dwell_s=1.5),
    ]


def follow(
    profile: Profile,
    machine: Machine,
    seed: int,
    laws: tuple[str, ...],
    planned: list[trajectory.Trajectory],
    folder: Path,
    tick_s: float,
) -> list[Followed]:
    """Home, then follow each trajectory under each law; RequestError where one does not come to its end."""
    backend = BatchBackend(machine, seed=seed, tick_s=tick_s)
    outcomes: list[tuple[str, str, Outcome]] = []
    with Supervisor(profile, backend, folder) as stage:
        _finished(stage.home(), seed)
        stage.enable(laws[0])
        for law in laws:
            for one in planned:
                _finished(stage.move(float(one.setpoints["position_m"][0]), law), seed)
                rest = np.zeros(round(_REST_S * profile.cycle.rate_hz), SETPOINT)
                rest["position_m"] = one.setpoints["position_m"][0]
                _finished(stage.follow(rest, "resting", law), seed)
                outcomes.append((law, one.name, _finished(stage.run(one, law), seed)))
    run, truth = read_run(folder), backend.truth()
    return [_followed(run, truth, law, name, seed, outcome) for law, name, outcome in outcomes]


def _finished(outcome: Outcome, seed: int) -> Outcome:
    if not outcome.finished:
        raise RequestError(f"seed {seed}: {outcome.name} ended early: {outcome.text}")
    return outcome


def _followed(run: Run, truth: dict[str, np.ndarray], law: str, name: str, seed: int, outcome: Outcome) -> Followed:
    scored = score(run, truth, outcome.first_row, outcome.rows)
    rows = scored.rows
    mine = rows["segment_number"] == rows["segment_number"][-1]
    hold = mine & holding(rows["setpoint_velocity_m_per_s"], run.manifest["profile"]["cycle"]["rate_hz"])
    place = np.searchsorted(truth["sequence"], rows["cycle"])
    sample_to_sync_ns = (rows["sync_end_t_ns"] - truth["t_ns"][place])[mine]
    newest = np.searchsorted(truth["sequence"], rows["sequence"])
    return Followed(
        law=law,
        trajectory=name,
        seed=seed,
        cycles=int(mine.sum()),
        true_peak_m=peak(scored.true_mean_error_m[mine]),
        true_hold_rms_m=rms(scored.true_mean_error_m[hold]),
        measured_peak_m=peak(scored.measured_error_m[mine]),
        measured_hold_rms_m=rms(scored.measured_error_m[hold]),
        contact_share=_share(scored, mine),
        sample_to_sync_p50_s=float(np.median(sample_to_sync_ns)) * 1e-9,
        sync_jitter_rms_s=float(np.std(np.diff(rows["sync_end_t_ns"][mine]))) * 1e-9,
        sample_error_rms_s=rms((rows["sample_t_ns"] - truth["t_ns"][newest])[mine]) * 1e-9,
    )


def _share(scored: Scored, mine: np.ndarray) -> float:
    return float(np.mean(scored.contact_force_n[mine] != 0.0))


def holding(speed_m_per_s: np.ndarray, rate_hz: float) -> np.ndarray:
    """Tell the rows in which the reference has stood for `SETTLED_S` after a motion, shape (n,)."""
    moving = np.flatnonzero(speed_m_per_s != 0.0)
    index = np.arange(speed_m_per_s.size)
    if moving.size == 0:
        return np.zeros(speed_m_per_s.size, bool)
    before = np.searchsorted(moving, index, side="right") - 1
    return (before >= 0) & (index - moving[np.maximum(before, 0)] >= SETTLED_S * rate_hz)


def peak(values: np.ndarray) -> float:
    """Return the greatest magnitude; nan counts as not seen."""
    return float(np.nanmax(np.abs(values)))


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square about zero; nan counts as not seen, nothing at all gives nan."""
    seen = np.asarray(values, float)
    seen = seen[~np.isnan(seen)]
    return float(np.sqrt(np.mean(seen * seen))) if seen.size else float("nan")
