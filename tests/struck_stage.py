"""A stage in batch that something goes wrong with while it moves: strike, let it end, look at what is left."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_backend.faults import Fault
from stagectl import trajectory as trajectories
from stagectl.backend import BatchBackend
from stagectl.outcome import Outcome
from stagectl.record import Run, read_run
from stagectl.replay import replay_run
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor

STROKE_M = 0.08
SPEED_M_PER_S = 0.2
REST_M_PER_S = 1e-3
AT_SHARE = 0.2  # of the trapezoid: at full speed
SEED = 7

Strike = Callable[[Supervisor, BatchBackend], None]


def home_by_truth(stage: Supervisor, plant: dict[str, float]) -> None:
    """Set both laser zeros from what the rig knows, as a homing would have; it stands for 10 s of touching."""
    status = stage.status()
    macro_scale, end_scale = stage._scales()
    macro_m = float(status["macro_encoder_m"])
    end_m = macro_m - (plant["macro_position_m"] - plant["end_position_m"])
    stage._homing_id += 1
    stage._publish_update(
        float(status["macro_counts"]) - macro_m / macro_scale, float(status["end_counts"]) - end_m / end_scale
    )


def trapezoid(stage: Supervisor, speed_m_per_s: float = SPEED_M_PER_S) -> trajectories.Trajectory:
    """Plan a short way there and back from where the stage holds."""
    start_m = float(stage.status()["setpoint_position_m"])
    return trajectories.trapezoid(STROKE_M, speed_m_per_s, (0.1, 0.05), dwell_s=0.1, start_m=start_m, lead_s=0.05)


def inject(*faults: Fault) -> Strike:
    """Make faults of the rig begin `at_s` after the strike."""

    def strike(stage: Supervisor, backend: BatchBackend) -> None:
        for fault in faults:
            backend.rig.inject(fault, backend.wire.t_ns)

    return strike


@dataclass
class Struck:
    """What a stage did after a strike, and what its run holds."""

    outcome: Outcome
    run: Run
    truth: dict[str, np.ndarray]
    struck_t_ns: int
    rows_written: int
    rest_velocity_m_per_s: float  # true, of the macro, 0.2 s after the outcome
    drive_states: tuple[str, ...]  # then

    @property
    def first_stop_row(self) -> int:
        """The row whose tick ended the run, the run's length where none did."""
        found = np.flatnonzero(self.run.rows["stop"] > 0)
        return int(found[0]) if found.size else self.run.rows.size

    @property
    def relative_m(self) -> np.ndarray:
        """True end minus macro from the strike on."""
        after = self.truth["t_ns"] >= self.struck_t_ns
        return (self.truth["end_position_m"] - self.truth["macro_position_m"])[after]

    def replays(self, rows_count: int | None = None) -> str:
        """Return the first difference of a replay, empty where every row comes out bit for bit."""
        return replay_run(dataclasses.replace(self.run, rows=self.run.rows[:rows_count])).first_difference


class Stage:
    """An armed stage in batch, homed by truth, its gap centred."""

    def __init__(self, folder: Path, profile, machine, law: str = "dsmc"):
        self.backend = BatchBackend(machine, seed=SEED)
        self.law = law
        self.strike: Strike | None = None
        self.struck_t_ns = 0
        self.stage = Supervisor(profile, self.backend, folder, self._progress)

    def _progress(self, what: str, share: float) -> None:
        if self.strike is not None and what == "struck" and share >= AT_SHARE:
            strike, self.strike = self.strike, None
            self.struck_t_ns = self.backend.wire.t_ns
            assert abs(self.plant["macro_velocity_m_per_s"]) > 0.9 * SPEED_M_PER_S
            strike(self.stage, self.backend)

    @property
    def plant(self) -> dict[str, float]:
        """The true state, now."""
        return self.backend.rig.plant_state()

    @property
    def drive_states(self) -> tuple[str, ...]:
        """The true power states, macro first."""
        return tuple(node.drive.state.name for node in self.backend.rig.nodes)

    def arm(self) -> Stop:
        """Enable and bring the macro to the middle of the gap."""
        stop = self.stage.enable(self.law)
        if stop is Stop.NONE:
            self.stage._centre(self.stage.status())
        return stop

    def __enter__(self) -> "Stage":
        self.stage.__enter__()
        home_by_truth(self.stage, self.plant)
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.stage.__exit__(kind, error, trace)

    def move(self, strike: Strike | None = None) -> Outcome:
        """Follow the trapezoid, struck at full speed."""
        self.strike = strike
        return self.stage.follow(trapezoid(self.stage).setpoints, "struck", self.law)


def struck(folder: Path, profile, machine, strike: Strike, law: str = "dsmc") -> Struck:
    """Arm, move, strike, and read the run."""
    one = Stage(folder, profile, machine, law)
    with one:
        assert one.arm() is Stop.NONE
        outcome = one.move(strike)
        one.stage.pump(0.2)
        rest_m_per_s = abs(one.plant["macro_velocity_m_per_s"])
        states = one.drive_states
    run = read_run(folder)
    return Struck(outcome, run, one.backend.truth(), one.struck_t_ns, rows_of(one), rest_m_per_s, states)


def rows_of(one: Stage) -> int:
    """Return how many cycles the servo ran."""
    servo = one.backend.servo
    return 0 if servo is None else servo.ring.written_count
