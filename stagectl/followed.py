"""What a controller makes of a machine along a reference, behind the value seam, from rest.

A machine is anything with a machine file's attributes.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from stagectl import batch, tick
from stagectl.batch import Recording, Simulation
from stagectl.errors import RequestError
from stagectl.laws.reference import gap_centre
from stagectl.signals import SETPOINT, STOP_TEXT, Stop
from stagectl.tick import Controller

if TYPE_CHECKING:
    from stagectl.profile import Profile

_REST_S = 1.0


def controller_of(profile: "Profile", law: str) -> Controller:
    """Make a controller for the value seam."""
    return tick.controller(profile, law, has_drives=False)


def rested(controller: Controller, profile: "Profile", machine: Any, start_m: float, seed: int) -> Simulation:
    """Rest with the end at `start_m`, the macro in the middle of the believed gap, until the observer has settled."""
    simulation = batch.simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    simulation.state["end_position_m"] = start_m
    simulation.state["macro_position_m"] = start_m + float(gap_centre(controller.belief[0]))
    rest = np.zeros(round(_REST_S * profile.cycle.rate_hz), SETPOINT)
    rest["position_m"] = start_m
    batch.run(simulation, rest)
    return simulation


def scan(controller: Controller, profile: "Profile", machine: Any, setpoints: np.ndarray, seed: int) -> Recording:
    """Rest where the reference begins, then follow it. RequestError where the guard stops it."""
    recording = batch.run(rested(controller, profile, machine, float(setpoints["position_m"][0]), seed), setpoints)
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
