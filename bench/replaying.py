"""A short run of every machine under every law, replayed from its raw bytes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_backend.machine import Machine, load_machine
from stagectl import trajectory
from stagectl.backend import BatchBackend
from stagectl.profile import Profile, load_profile
from stagectl.record import Run, read_run
from stagectl.replay import replay_run
from stagectl.supervisor import Supervisor
from stagectl.tracker import LAW_NAMES

MACHINES = ("oled-printer", "oled-printer-umd2", "kang-2023", "single-axis")


@dataclass(frozen=True, slots=True)
class Replayed:
    """What the replay of one machine's run found."""

    machine: str
    ticks: dict[str, int]  # by law, in which the stage moved
    differing_rows: int
    first_difference: str


def record(name: str, seed: int, folder: Path) -> Run:
    """Record a shipped machine under its profile."""
    return record_of(load_profile(name), load_machine(name), seed, folder)


def record_of(profile: Profile, machine: Machine, seed: int, folder: Path) -> Run:
    """Home a machine and move it under every law; homing, switching and stopping are part of the run."""
    backend = BatchBackend(machine, seed=seed)
    with Supervisor(profile, backend, folder) as stage:
        stage.home()
        for law in LAW_NAMES:
            if stage.enable(law) == 0:
                stage.run(trajectory.trapezoid(0.02, 0.1, dwell_s=0.2, lead_s=0.2), law)
            stage.disarm()
    return read_run(folder)


def replayed(name: str, seed: int, folder: Path) -> Replayed:
    """Record a run and replay it."""
    run = record(name, seed, folder)
    found = replay_run(run)
    moving = run.rows[run.rows["setpoint_velocity_m_per_s"] != 0.0]
    ticks = {law: int(np.sum(moving["law_number"] == number)) for number, law in enumerate(LAW_NAMES)}
    return Replayed(name, ticks, found.differing_rows, found.first_difference)
