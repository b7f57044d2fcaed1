"""The demo: home, identify the backlash, follow one trajectory under one law after the other.

Drives a supervisor object and returns what happened; prints nothing and writes nothing. What it achieved is scored
from the run (`stagectl.run_scores`) and shown by `stagectl.run_page`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from stagectl import trajectory as trajectories
from stagectl.errors import DriveError, LinkError, TimingError
from stagectl.outcome import Outcome
from stagectl.profile import Profile
from stagectl.signals import Stop
from stagectl.supervisor import Supervisor

LAWS = ("pid", "dsmc")
"""The rival first: figures draw ours on top."""

DWELL_S = 1.0
LONGEST_STROKE_M = 0.8
SPEED_M_PER_S = 0.2
_TRAVEL_SHARE = 8.0 / 9.0
_HICCUP_CYCLES = 10

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Trip:
    """A motion that did not come to its own end, and was repeated."""

    motion: str
    outcome: Outcome

    @property
    def stop(self) -> Stop:
        """Why it ended."""
        return self.outcome.stop

    @property
    def text(self) -> str:
        """The sentence for the operator."""
        return f"{self.motion}: {self.outcome.text}"


@dataclass(frozen=True, slots=True)
class Host:
    """How many of its cycles the host missed since its servo started, and which share of them is borne."""

    cycles_count: int
    missed_cycles_count: int
    bears_ratio: float

    @property
    def missed_ratio(self) -> float:
        """Share of the cycles that were missed."""
        return self.missed_cycles_count / max(self.cycles_count, 1)

    @property
    def is_late(self) -> bool:
        """Whether that is more than is borne; a single hiccup says nothing of a host."""
        return self.missed_cycles_count >= _HICCUP_CYCLES and self.missed_ratio > self.bears_ratio


@dataclass(frozen=True, slots=True)
class Driven:
    """What the stage did: every motion's last outcome in order, and what had to be repeated.

    Given up, it may have none.
    """

    outcomes: tuple[Outcome, ...]
    trips: tuple[Trip, ...]
    host: Host

    @property
    def stop(self) -> Stop:
        """FINISHED where every motion came to its own end, else why the last one did not."""
        return self.outcomes[-1].stop

    @property
    def given_up(self) -> bool:
        """Whether it ended because the host missed more cycles than it was asked to bear."""
        return self.host.is_late


def planned(profile: Profile, dwell_s: float = DWELL_S) -> trajectories.Trajectory:
    """Plan the demo's trapezoid: 0.8 m at 0.2 m/s, or what the travel and the speed limit of a profile allow."""
    low_m, high_m = profile.macro.travel_m
    stroke_m = min(LONGEST_STROKE_M, _TRAVEL_SHARE * (high_m - low_m))
    return trajectories.trapezoid(
        stroke_m,
        min(SPEED_M_PER_S, 0.8 * profile.macro.velocity_limit_m_per_s),
        dwell_s=dwell_s,
        dt_s=profile.cycle.period_s,
        start_m=0.5 * (low_m + high_m - stroke_m),
        lead_s=0.5,  # the move that leads there swings out
    )


def drive(
    stage: Supervisor,
    trajectory: trajectories.Trajectory,
    laws: Sequence[str] = LAWS,
    identify_s: float = 20.0,
    say: Say = lambda text: None,
    bears_missed_ratio: float = math.inf,
) -> Driven:
    """Home, identify, follow the trajectory under each law; a motion that the guard ended is repeated once.

    Ends at the first motion that fails twice, or behind which the host has missed more than `bears_missed_ratio` of its
    cycles. `say` hears what had to be repeated, when it happens.
    """
    flow = _Flow(stage, say, bears_missed_ratio)
    if flow.does("home", stage.home) and _identifies(flow, stage, identify_s):
        for law in laws:
            if not flow.does(f"{trajectory.name} under {law}", lambda law=law: _follow(stage, trajectory, law)):
                break
    return Driven(tuple(flow.outcomes), tuple(flow.trips), flow.host())


def _identifies(flow: "_Flow", stage: Supervisor, duration_s: float) -> bool:
    """Identify the joint and believe it; a stage without a micro has nothing to identify."""
    if stage.profile.micro is None:
        return True
    if not flow.does("identify", lambda: _armed(stage, lambda: stage.identify(duration_s=duration_s))):
        return False
    estimate = flow.outcomes[-1].backlash
    if estimate is not None and estimate.identifiable:
        stage.take_backlash(estimate)
    return True


def _follow(stage: Supervisor, trajectory: trajectories.Trajectory, law: str) -> Outcome:
    return _armed(stage, lambda: stage.run(trajectory, law), law)


def _armed(stage: Supervisor, motion: Callable[[], Outcome], law: str | None = None) -> Outcome:
    """Enable the drives where they are not, then move."""
    armed = stage.armed(law)
    return motion() if armed.finished else armed


class _Flow:
    """Does one motion after the other and keeps how each ended."""

    def __init__(self, stage: Supervisor, say: Say, bears_missed_ratio: float):
        self._stage, self._say, self._bears_ratio = stage, say, bears_missed_ratio
        self.outcomes: list[Outcome] = []
        self.trips: list[Trip] = []

    def does(self, name: str, motion: Callable[[], Outcome]) -> bool:
        """Move, once more where the guard ended it; tells whether the motion came to its own end.

        What a late host makes of a motion, an edge that is not met in any sweep say, is no error of drives or wires.
        """
        try:
            outcome = self._outcome(name, motion)
        except (DriveError, LinkError, TimingError):
            if not self.host().is_late:
                raise
            return False
        self.outcomes.append(outcome)
        return outcome.finished and not self.host().is_late

    def _outcome(self, name: str, motion: Callable[[], Outcome]) -> Outcome:
        outcome = motion()
        if not outcome.finished and not self.host().is_late:
            trip = Trip(name, outcome)
            self.trips.append(trip)
            self._say(f"{trip.text}; acknowledging, arming again and repeating it once")
            self._stage.acknowledge()
            if outcome.stop is not Stop.REFERENCE_LOST or name == "home" or self._stage.home().finished:
                outcome = motion()
        return outcome

    def host(self) -> Host:
        """Return what the host missed until now."""
        missed_count = int(self._stage.status()["missed_cycles"])
        return Host(self._stage.recorder.rows_count + missed_count, missed_count, self._bears_ratio)
