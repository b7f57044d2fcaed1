"""How fast things are: the tick, the value seam, the wire in batch, the servo in real time."""

import statistics
import time
from pathlib import Path

import numpy as np

from drivers.framers import framer_for
from sim_backend.machine import Machine
from stagectl import batch, tick, trajectory
from stagectl.backend import BatchBackend
from stagectl.errors import RequestError, StagectlError
from stagectl.profile import Profile
from stagectl.record import read_run
from stagectl.requests import Phase
from stagectl.signals import SETPOINT
from stagectl.stage import open_stage
from stagectl.supervisor import Supervisor

RUNS_COUNT = 5
"""Absolute times are the median of so many runs."""

_MOVE = (0.8, 0.2, -0.4)  # stroke, speed, start
_LINES_COUNT = 2000
_RIG_TRIES_COUNT = 6
_RIG_ROWS_COUNT = 5000
_DUE_NS = 20_000  # a line that comes so shortly before the cycle is due is decoded behind it


def _move() -> trajectory.Trajectory:
    stroke_m, speed_m_per_s, start_m = _MOVE
    return trajectory.trapezoid(stroke_m, speed_m_per_s, start_m=start_m)


def _at_rest(profile: Profile, machine: Machine, law: str, start_m: float) -> batch.Simulation:
    """Put a controller in front of a machine that rests in the middle of its gap, and let it settle."""
    controller = tick.controller(profile, law, has_drives=False)
    simulation = batch.simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=1)
    centre_m = 0.0 if profile.backlash is None else 0.5 * (profile.backlash.right_m - profile.backlash.left_m)
    simulation.state["macro_position_m"] = start_m + centre_m
    simulation.state["end_position_m"] = start_m
    rest = np.zeros(1000, SETPOINT)
    rest["position_m"] = start_m
    batch.run(simulation, rest)
    return simulation


def tick_s(profile: Profile, machine: Machine, law: str) -> float:
    """Return the p50 of one tick called from Python on the measurements of a move: median of the runs, s."""
    planned = _move()
    simulation = _at_rest(profile, machine, law, _MOVE[2])
    recording = batch.run(simulation, planned.setpoints)
    controller = tick.controller(profile, law, has_drives=False)
    clock_ns = time.perf_counter_ns
    medians = []
    for _ in range(RUNS_COUNT):
        spent_ns = np.zeros(recording.commands.size, np.int64)
        for k in range(recording.commands.size):
            controller.measurement[0] = recording.measurements[k]
            controller.setpoint[0] = recording.setpoints[k]
            begin_ns = clock_ns()
            controller.step()
            spent_ns[k] = clock_ns() - begin_ns
        medians.append(float(np.median(spent_ns)) * 1e-9)
    return statistics.median(medians)


def line_s() -> float:
    """Return the p50 of decoding a line of a uMD2 that reads two beams: median of the runs, s."""
    line = b"3000 3001 1234567 5 16384 %d 0 0 2999 -1234567 1 32768 0 0 0 0\r\n"
    medians = []
    for _ in range(RUNS_COUNT):
        framer = framer_for({"format": "umd2", "incremental": True, "frame": {}})
        spent_ns = []
        for number in range(_LINES_COUNT):
            data = line % (100_000 + number)
            begin_ns = time.perf_counter_ns()
            framer.feed(data)
            spent_ns.append(time.perf_counter_ns() - begin_ns)
        medians.append(statistics.median(spent_ns) * 1e-9)
    return statistics.median(medians)


def value_seam_ratio(profile: Profile, machine: Machine, law: str) -> float:
    """Return simulated time over processor time behind the value seam: median of the runs."""
    planned = _move()
    ratios = []
    for _ in range(RUNS_COUNT):
        simulation = _at_rest(profile, machine, law, _MOVE[2])
        begin_s = time.process_time()
        recording = batch.run(simulation, planned.setpoints)
        ratios.append(recording.commands.size / profile.cycle.rate_hz / (time.process_time() - begin_s))
        if recording.commands.size != planned.setpoints.size:
            raise RequestError(f"{law}: the value seam stopped after {recording.commands.size} cycles")
    return statistics.median(ratios)


def wire_ratio(profile: Profile, machine: Machine, law: str, folder: Path) -> float:
    """Return virtual time over processor time of whole runs over the wire in batch, recorder included."""
    backend = BatchBackend(machine, seed=1)
    ratios = []
    with Supervisor(profile, backend, folder) as stage:
        if not stage.home().finished:
            raise RequestError("homing ended early")
        stage.enable(law)
        stage.move(0.0, law)
        for _ in range(RUNS_COUNT):
            begin_s, begin_t_ns = time.process_time(), backend.wire.t_ns
            outcome = stage.run(trajectory.trapezoid(0.1, 0.2, dwell_s=1.0), law)
            if not outcome.finished:
                raise RequestError(f"{law}: {outcome.text}")
            ratios.append((backend.wire.t_ns - begin_t_ns) * 1e-9 / (time.process_time() - begin_s))
    return statistics.median(ratios)


def servo_s(profile: Profile, folder: Path) -> dict[str, float]:
    """Run the servo as a process against the rig as another, in real time; return medians in s.

    `readable_to_written`: from the instant that the line is readable to the last frame written, of lines that came when
    the cycle was due or later: reading, decoding, tick, encoding, writing, with nothing done ahead and no waiting for
    the phase. `all_readable_to_written`: of all lines, waiting included. `due_to_written`: from the instant due; most
    lines are decoded by then. `tick`: decoding, tick and encoding after the instant due. Errors: StagectlError where
    host or rig don't let it run.
    """
    found, problem = [], "the rig did not come to a tick"
    for attempt in range(_RIG_TRIES_COUNT):
        stage = open_stage(profile, "rig", runs_root=folder, name=f"servo-{attempt}", seed=attempt)
        try:
            with stage:
                homed = stage.home()
                problem = homed.text
                if homed.finished:
                    stage.enable("dsmc")
                    problem = stage.run(trajectory.trapezoid(0.05, 0.05, dwell_s=1.0), "dsmc").text
        except StagectlError as error:  # a host that stops for 20 ms ends a run; its cycles up to then count
            problem = str(error)
        if (stage.folder / "manifest.json").exists():
            rows = read_run(stage.folder).rows
            found.append(rows[(rows["run_phase"] == int(Phase.TRACKING)) & (rows["sensor_bytes_count"] > 0)])
        if sum(rows.size for rows in found) >= _RIG_ROWS_COUNT:
            return _medians(np.concatenate(found))
    raise RequestError(f"no {_RIG_ROWS_COUNT} cycles in {_RIG_TRIES_COUNT} tries; the last one ended so: {problem}")


def _medians(rows: np.ndarray) -> dict[str, float]:
    """Median of the runs' p50, where a run is a fifth of the rows."""
    due_t_ns = rows["t_ns"] - rows["lateness_ns"]
    waited = rows["first_arrival_t_ns"] >= due_t_ns - _DUE_NS
    readable_to_written = rows["sync_end_t_ns"] - rows["first_arrival_t_ns"]
    columns = {
        "readable_to_written": readable_to_written[waited],
        "all_readable_to_written": readable_to_written,
        "due_to_written": rows["sync_end_t_ns"] - due_t_ns,
        "tick": rows["tick_ns"],
    }
    return {
        name: statistics.median(float(np.median(part)) for part in np.array_split(column, RUNS_COUNT)) * 1e-9
        for name, column in columns.items()
    }
