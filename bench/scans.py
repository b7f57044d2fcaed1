"""One machine behind the value seam along one reference: what scans, ablation and learning are measured on."""

import numpy as np

from sim_backend.machine import Machine
from stagectl import batch, tick
from stagectl.batch import Recording
from stagectl.errors import RequestError
from stagectl.laws.reference import gap_centre
from stagectl.profile import Profile
from stagectl.signals import SETPOINT, STOP_TEXT, Stop
from stagectl.tick import Controller

_REST_S = 1.0


def controller_of(profile: Profile, law: str) -> Controller:
    """Make a controller for the value seam."""
    return tick.controller(profile, law, has_drives=False)


def scan(controller: Controller, profile: Profile, machine: Machine, setpoints: np.ndarray, seed: int) -> Recording:
    """Rest where the reference begins until the observer has settled, then follow it; RequestError where it stops.

    The machine rests in the middle of the believed gap.
    """
    simulation = batch.simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    start_m = float(setpoints["position_m"][0])
    simulation.state["end_position_m"] = start_m
    simulation.state["macro_position_m"] = start_m + float(gap_centre(controller.belief[0]))
    rest = np.zeros(round(_REST_S * profile.cycle.rate_hz), SETPOINT)
    rest["position_m"] = start_m
    batch.run(simulation, rest)
    recording = batch.run(simulation, setpoints)
    stop = Stop(int(recording.commands["stop"][-1]))
    if stop is not Stop.NONE:
        raise RequestError(
            f"machine {machine.name}, seed {seed}: {STOP_TEXT[stop]} after {recording.truth.size} cycles"
        )
    return recording


def true_error_m(recording: Recording, setpoints: np.ndarray) -> np.ndarray:
    """Return the true end position against a reference, averaged between samples, shape (n,)."""
    position_m, speed = setpoints["position_m"], setpoints["velocity_m_per_s"]
    before_m, before = np.roll(position_m, 1), np.roll(speed, 1)
    before_m[0], before[0] = position_m[0], speed[0]
    period_s = 1e-3 if recording.truth.size < 2 else float(np.median(np.diff(recording.truth["t_s"])))
    # Mean of the reference over the interval (Hermite), as `stagectl.scoring` takes it.
    return recording.truth["end_mean_m"] - (0.5 * (position_m + before_m) + (before - speed) * period_s / 12.0)
