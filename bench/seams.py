"""The same closed loop over the wire and behind the value seam, with the same noise: how far apart the ends are."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_backend.air import index_of
from sim_backend.machine import Machine
from stagectl import batch, tick, trajectory
from stagectl.backend import BatchBackend
from stagectl.errors import RequestError
from stagectl.plant import PLANT_STATE
from stagectl.profile import Profile
from stagectl.record import read_run
from stagectl.signals import SETPOINT
from stagectl.supervisor import Supervisor

_REST_S = 0.2
_HEARTBEAT_S = 60.0  # longer than a comparison


@dataclass(frozen=True, slots=True)
class SeamsApart:
    """End positions at the same samples, wire minus value seam."""

    cycles: int
    rms_m: float
    peak_m: float
    late_lines: int


def compare(
    profile: Profile, machine: Machine, seed: int, planned: trajectory.Trajectory, law: str, folder: Path
) -> SeamsApart:
    """Home over the wire, copy machine and controller behind the value seam, let both follow the same setpoints.

    The value seam gets the wire's noise: the same draws, late lines, and instants of samples and SYNCs. A torque word
    that rounds the other way moves the end by 3 nm and brings others like it, so picometres apart become nanometres:
    the drives' heartbeats are slow here, because the rig divides a substep where one is sent.
    """
    profile = profile.model_copy(update={"trip": profile.trip.model_copy(update={"heartbeat_s": _HEARTBEAT_S})})
    backend = BatchBackend(machine, seed=seed)
    with Supervisor(profile, backend, folder) as stage:
        homed = stage.home()
        if not homed.finished:
            raise RequestError(f"seed {seed}: homing ended early: {homed.text}")
        stage.enable(law)
        stage.move(float(planned.setpoints["position_m"][0]), law)
        if backend.servo is None:
            raise RequestError("the servo is gone before the comparison")
        state = np.zeros(1, PLANT_STATE)
        for name, value in backend.rig.plant_state().items():
            state[name] = value
        state["memory"] = backend.rig.effects_memory()
        controller_state = backend.servo.tracker.active.snapshot()
        first_sample = int(controller_state["estimator"]["cycle"][0]) + 1
        held_a = [float(node.drive.servo["torque_target_a"][0]) for node in backend.rig.nodes]
        measured, decoder = backend.servo.tracker.measurement.copy(), backend.servo.decoder
        rest = np.zeros(round(_REST_S * profile.cycle.rate_hz), SETPOINT)
        rest["position_m"] = planned.setpoints["position_m"][0]
        stage.follow(rest, "resting", law)
        outcome = stage.follow(planned.setpoints, planned.name, law)
        if not outcome.finished:
            raise RequestError(f"seed {seed}: {planned.name} ended early: {outcome.text}")
    rows, truth = read_run(folder).rows, backend.truth()
    place = int(np.flatnonzero(rows["cycle"] == first_sample)[0])
    rows = rows[place : outcome.first_row + outcome.rows]
    if not (np.diff(rows["cycle"]) == 1).all():
        raise RequestError(f"seed {seed}: cycles are missing between sample {first_sample} and the end")
    in_truth = np.searchsorted(truth["sequence"], rows["cycle"])

    controller = tick.controller(profile, law, has_drives=False)
    without_drives = controller.guard["has_drives"].copy()
    controller.restore(controller_state)
    controller.guard["has_drives"] = without_drives
    controller.measurement[...] = measured
    controller.measurement["sample_t_ns"] -= backend.rig.start_t_ns  # the value seam's time begins with the rig
    simulation = batch.simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    simulation.state[...] = state
    simulation.noise.standard_normal((first_sample, 2))  # what the wire's sensor drew up to here
    devices = simulation.devices
    devices["sample"] = first_sample
    devices["macro_a"] = held_a[0]
    devices["micro_a"] = held_a[-1] if machine.micro is not None else 0.0
    # Rig and drivers have an index of air each, 3e-12 apart: that rounds one count in a thousand the other way.
    step_m = machine.air.wavelength_vacuum_m / index_of(machine.air) / machine.interferometer.counts_per_wavelength
    for axis in ("macro", "end"):
        devices[f"{axis}_resolution_m"] = step_m
        devices[f"{axis}_origin_m"] = truth[f"{axis}_zero_m"][in_truth[0]]
        devices[f"{axis}_zero_m"] = getattr(decoder, f"{axis}_zero_counts") * decoder.end_m_per_count
    devices["reading_ratio"] = decoder.end_m_per_count / step_m
    first = rows[0]
    if first["samples_new"] > 0 and first["sequence"] < first["cycle"]:  # the line of the cycle before is on its way
        devices["late_sample"] = first["sequence"]
        devices["late_t_s"] = 1e-9 * (first["sample_t_ns"] - backend.rig.start_t_ns)
        devices["late_macro_m"], devices["late_end_m"] = first["macro_position_m"], first["end_position_m"]
    setpoints = np.zeros(rows.size, SETPOINT)
    for name in SETPOINT.names or ():
        setpoints[name] = rows[f"setpoint_{name}"]
    late = rows["sequence"] < rows["cycle"]
    start_t_ns = backend.rig.start_t_ns
    following = np.append(in_truth, in_truth[-1] + 1)
    devices["sampled_s"] = 1e-9 * (truth["t_ns"][in_truth[0] - 1] - start_t_ns)
    instants_s = np.zeros((rows.size + 1, 2))
    instants_s[:, 0] = 1e-9 * (truth["t_ns"][following] - start_t_ns)
    instants_s[:-1, 1] = 1e-9 * (rows["sync_end_t_ns"] - start_t_ns)
    recording = batch.run(simulation, setpoints, late, instants_s)
    if recording.truth.size != rows.size:
        raise RequestError(f"seed {seed}: the value seam stopped after {recording.truth.size} of {rows.size} cycles")
    zero_m = float(devices["end_zero_m"][0] + devices["end_origin_m"][0])
    apart_m = (truth["end_position_m"][in_truth] - zero_m - recording.truth["end_position_m"])[
        -planned.setpoints.size :
    ]
    return SeamsApart(
        cycles=apart_m.size,
        rms_m=float(np.sqrt(np.mean(apart_m * apart_m))),
        peak_m=float(np.max(np.abs(apart_m))),
        late_lines=int(late[-planned.setpoints.size :].sum()),
    )
