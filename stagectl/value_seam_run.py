"""A run behind the value seam: the machine straight behind the tick, hundreds of times faster than real time.

Homes as the supervisor does (touches both edges, believes what it found, moves the end's zero), then follows one
trajectory, and records rows and truth. No bytes, no bus, no host: such a run can be scored and not replayed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim_backend.machine import Machine
from stagectl import backlash, batch, tick, touch_sweep
from stagectl.errors import RequestError
from stagectl.laws.reference import gap_centre
from stagectl.outcome import Outcome
from stagectl.profile import Profile
from stagectl.record import Recorder
from stagectl.requests import Phase
from stagectl.row import new_rows
from stagectl.run_scores import SWEEP_NAME, VALUE_SEAM, write_truth
from stagectl.signals import COMMAND, MEASUREMENT, SETPOINT, STOP_TEXT, Stop, stop_sentence
from stagectl.stop_text import stop_detail
from stagectl.touch_sweep import IDENTIFY_HZ, IDENTIFY_SHARE, TOUCH_HZ, TOUCH_S, TOUCH_SHARE

_WARM_S = 1.0
_EDGES = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")
_SDS = ("left_sd_m", "right_sd_m", "left_stiffness_sd_n_per_m", "right_stiffness_sd_n_per_m")
_FIELDS = (
    "run_phase",
    *(MEASUREMENT.names or ()),
    *(f"setpoint_{name}" for name in SETPOINT.names or ()),
    *(COMMAND.names or ()),
    *(f"backlash_{name}" for name in (*_EDGES, *_SDS)),
    "law_number",
    "segment_number",
    "homing_id",
)

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Homed:
    """What touching both edges found, and where that puts the end's zero."""

    end_zero_m: float
    belief: dict[str, float]


def simulate(
    profile: Profile,
    machine: Machine,
    setpoints: np.ndarray,
    name: str,
    law: str,
    folder: Path,
    seed: int,
    progress: Progress = lambda what, share: None,
) -> Outcome:
    """Home, follow `setpoints` (SETPOINT rows that begin at rest) under a law, record; returns how it ended."""
    homed = None
    if machine.micro is not None:
        progress("touching both edges", 0.0)
        homed = _home(profile, machine, law, seed)
    progress(name, 0.0)
    simulation = _at_rest(profile, machine, law, seed, float(setpoints["position_m"][0]), homed)
    batch.run(simulation, _hold(setpoints, _WARM_S, profile.cycle.rate_hz))
    if homed is not None:
        _forget_edges(simulation, profile)
    recording = batch.run(simulation, setpoints)
    stop, detail = _end_of(simulation, recording, profile, law)
    ended = Outcome(name, stop or Stop.FINISHED, 0, recording.commands.size, detail=detail)
    manifest = {
        "name": folder.name,
        "profile": profile.effective(),
        "profile_path": str(profile.source_path),
        "profile_sha256": profile.sha256,
        "backend": VALUE_SEAM,
        "backend_description": f"machine {machine.name} behind the value seam, seed {seed}",
        "laws": list(tick.LAWS),
        "seeds": [seed],
    }
    _record(simulation, recording, manifest, law, folder, ended)
    write_truth(folder, _truth_of(simulation, recording), machine.backlash)
    return ended


def identify(
    profile: Profile,
    machine: Machine,
    frequency_hz: float | None,
    duration_s: float,
    folder: Path,
    seed: int,
    progress: Progress = lambda what, share: None,
) -> Outcome:
    """Home and identify the joint from a sweep over both edges; recorded like `simulate`."""
    setpoints = touch_sweep.planned(profile, IDENTIFY_SHARE, IDENTIFY_HZ, duration_s, frequency_hz).setpoints
    return simulate(profile, machine, setpoints, SWEEP_NAME, profile.control.law, folder, seed, progress)


def _at_rest(
    profile: Profile, machine: Machine, law: str, seed: int, start_m: float, homed: Homed | None
) -> batch.Simulation:
    """Put a controller in front of a machine that rests in the middle of its gap, the end at `start_m`."""
    controller = tick.controller(profile, law, has_drives=False)
    simulation = batch.simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    end_m = start_m
    if homed is not None:
        simulation.devices["end_zero_m"] = homed.end_zero_m
        end_m += homed.end_zero_m
        for name, value in homed.belief.items():
            controller.belief[name] = value
    centre_m = 0.0 if homed is None else float(gap_centre(controller.belief[0])) - homed.end_zero_m
    simulation.state["macro_position_m"] = end_m + centre_m
    simulation.state["end_position_m"] = end_m
    return simulation


def _home(profile: Profile, machine: Machine, law: str, seed: int) -> Homed:
    """Touch both edges; the end's zero moves so that the gap's centre is where the profile has it."""
    believed = tick.controller(profile, law, has_drives=False).belief
    centre_m = float(gap_centre(believed[0]))
    start = Homed(0.0, {})
    simulation = _at_rest(profile, machine, law, seed, 0.0, start)
    setpoints = touch_sweep.planned(profile, TOUCH_SHARE, TOUCH_HZ, TOUCH_S).setpoints
    batch.run(simulation, _hold(setpoints, _WARM_S, profile.cycle.rate_hz))
    recording = batch.run(simulation, setpoints)
    found = simulation.controller.backlash
    known = all(np.isfinite(found[name][0]) for name in ("left_sd_m", "right_sd_m"))
    stop, detail = _end_of(simulation, recording, profile, law)
    if stop is not Stop.NONE or not known:
        raise RequestError(
            f"machine {machine.name}: touching both edges did not make both known: {stop_sentence(stop, detail)}; "
            "check backlash in profile and machine"
        )
    width_m = float(found["left_m"][0] + found["right_m"][0])
    identified_centre_m = 0.5 * float(found["right_m"][0] - found["left_m"][0])
    belief = {
        "left_m": 0.5 * width_m - centre_m,
        "right_m": 0.5 * width_m + centre_m,
        "left_stiffness_n_per_m": float(found["left_stiffness_n_per_m"][0]),
        "right_stiffness_n_per_m": float(found["right_stiffness_n_per_m"][0]),
    }
    return Homed(centre_m - identified_centre_m, belief)


def _forget_edges(simulation: batch.Simulation, profile: Profile) -> None:
    """Start identification afresh: the rows before belong to no run."""
    simulation.controller.backlash[...] = backlash.init(profile)


def _hold(setpoints: np.ndarray, duration_s: float, rate_hz: float) -> np.ndarray:
    """Stand where a trajectory begins."""
    rows = np.zeros(round(duration_s * rate_hz), SETPOINT)
    rows["position_m"] = setpoints["position_m"][0]
    return rows


def _record(
    simulation: batch.Simulation,
    recording: batch.Recording,
    manifest: dict[str, Any],
    law: str,
    folder: Path,
    ended: Outcome,
) -> None:
    """Write rows, events and manifest; standard deviations are known behind the last row only."""
    rows = new_rows(recording.commands.size)
    rows["run_phase"] = int(Phase.TRACKING)
    for field in MEASUREMENT.names or ():
        rows[field] = recording.measurements[field]
    for field in SETPOINT.names or ():
        rows[f"setpoint_{field}"] = recording.setpoints[field]
    for field in COMMAND.names or ():
        rows[field] = recording.commands[field]
    for column, field in enumerate(_EDGES):
        rows[f"backlash_{field}"] = recording.backlash[:, column]
    for field in _SDS:
        rows[f"backlash_{field}"][-1] = simulation.controller.backlash[field][0]
    rows["law_number"] = list(tick.LAWS).index(law)
    rows["segment_number"] = 1
    rows["homing_id"] = 1
    recorder = Recorder(folder, manifest, _FIELDS)
    with recorder:
        first_t_ns, last_t_ns = int(rows["t_ns"][0]), int(rows["t_ns"][-1])
        count = int(recording.setpoints.size)
        recorder.event("segment", first_t_ns, number=1, segment=ended.name, law=law, setpoints=count)
        recorder.append(rows)
        recorder.event("segment_end", last_t_ns, number=1, stop=ended.stop.name, detail=ended.detail)
        recorder.close({"stop": ended.stop.name, "text": STOP_TEXT[ended.stop], "detail": ended.detail})


def _end_of(simulation: batch.Simulation, recording: batch.Recording, profile: Profile, law: str) -> tuple[Stop, str]:
    """Say what stopped it, with the numbers of its last cycle; NONE where nothing did."""
    stop = Stop(int(recording.commands["stop"][-1]))
    if stop is Stop.NONE:
        return stop, ""
    node_ids = {axis: profile.axis(axis).node_id for axis in profile.axes}
    measurement, setpoint, command = recording.measurements[-1], recording.setpoints[-1], recording.commands[-1]
    return stop, stop_detail(stop, measurement, setpoint, command, simulation.controller.guard[0], node_ids, law)


def _truth_of(simulation: batch.Simulation, recording: batch.Recording) -> dict[str, np.ndarray]:
    """Return the truth in the run's zero, under the names of the rig's log."""
    truth = recording.truth
    return {
        "sequence": recording.measurements["cycle"].copy(),
        "macro_position_m": truth["macro_position_m"].copy(),
        "end_position_m": truth["end_position_m"].copy(),
        "end_mean_position_m": truth["end_mean_m"].copy(),
        "contact_force_n": truth["contact_force_n"].copy(),
        "macro_zero_m": simulation.devices["macro_zero_m"].copy(),
        "end_zero_m": simulation.devices["end_zero_m"].copy(),
    }
