"""Identify the joint over the wire in batch, and hold it against what the rig knows."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_backend.machine import Machine
from stagectl.backend import BatchBackend
from stagectl.errors import RequestError
from stagectl.profile import Profile
from stagectl.record import read_run
from stagectl.scoring import score
from stagectl.supervisor import Supervisor


@dataclass(frozen=True, slots=True)
class Identified:
    """Errors of one identification; shares are magnitudes relative to the truth."""

    seed: int
    frequency_hz: float | None  # None: what suits the joint
    left_stiffness_share: float
    right_stiffness_share: float
    width_share: float
    left_edge_m: float  # magnitudes, in the run's own zero
    right_edge_m: float
    pulls: tuple[float, float, float, float]  # edges, stiffnesses, left first: error over its stated deviation

    @property
    def stiffness_share(self) -> float:
        """The worse of both sides."""
        return max(self.left_stiffness_share, self.right_stiffness_share)

    @property
    def edge_m(self) -> float:
        """The worse of both edges."""
        return max(self.left_edge_m, self.right_edge_m)


def identify(
    profile: Profile,
    machine: Machine,
    seed: int,
    frequency_hz: float | None,
    duration_s: float,
    folder: Path,
    tick_s: float,
) -> Identified:
    """Home, sweep the micro over both edges in closed loop, compare; RequestError where the sweep ends early."""
    backend = BatchBackend(machine, seed=seed, tick_s=tick_s)
    with Supervisor(profile, backend, folder) as stage:
        homed = stage.home()
        if not homed.finished:
            raise RequestError(f"seed {seed}: homing ended early: {homed.text}")
        stage.enable()
        outcome = stage.identify(frequency_hz, duration_s)
    found, joint = outcome.backlash, machine.backlash
    if not outcome.finished or found is None or joint is None or not found.identifiable:
        raise RequestError(f"seed {seed}, {frequency_hz or 'own'} Hz: nothing was identified: {outcome.text}")
    run, truth = read_run(folder), backend.truth()
    scored = score(run, truth, outcome.first_row, outcome.rows)
    place = np.searchsorted(truth["sequence"], scored.rows["cycle"])
    # How far x_b in the run's own zero lies from the true x_b: both zeros of the laser are the run's own.
    shift_m = float(
        np.mean(scored.true_macro_minus_end_m - (truth["macro_position_m"] - truth["end_position_m"])[place])
    )
    pulls = (
        (found.left_m - (joint.left_m - shift_m)) / found.left_sd_m,
        (found.right_m - (joint.right_m + shift_m)) / found.right_sd_m,
        (found.left_stiffness_n_per_m - joint.left_stiffness_n_per_m) / found.left_stiffness_sd_n_per_m,
        (found.right_stiffness_n_per_m - joint.right_stiffness_n_per_m) / found.right_stiffness_sd_n_per_m,
    )
    return Identified(
        seed=seed,
        frequency_hz=frequency_hz,
        left_stiffness_share=abs(found.left_stiffness_n_per_m / joint.left_stiffness_n_per_m - 1.0),
        right_stiffness_share=abs(found.right_stiffness_n_per_m / joint.right_stiffness_n_per_m - 1.0),
        width_share=abs(found.width_m / (joint.left_m + joint.right_m) - 1.0),
        left_edge_m=abs(found.left_m - (joint.left_m - shift_m)),
        right_edge_m=abs(found.right_m - (joint.right_m + shift_m)),
        pulls=pulls,
    )
