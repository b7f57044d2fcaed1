"""How a motion ended, and what it said of the joint. Values; pure."""

import math
from dataclasses import dataclass

from stagectl.signals import Stop, stop_sentence


@dataclass(frozen=True, slots=True)
class BacklashEstimate:
    """Edges and stiffness of the joint, with standard deviations; x_b = macro minus end, in the run's zero."""

    left_m: float
    right_m: float
    left_sd_m: float
    right_sd_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float
    left_stiffness_sd_n_per_m: float
    right_stiffness_sd_n_per_m: float

    @property
    def width_m(self) -> float:
        """Distance of the edges."""
        return self.left_m + self.right_m

    @property
    def centre_m(self) -> float:
        """Middle of the gap on x_b."""
        return 0.5 * (self.right_m - self.left_m)

    @property
    def identifiable(self) -> bool:
        """Whether both sides were touched long enough to say anything."""
        return math.isfinite(self.left_sd_m) and math.isfinite(self.right_sd_m)


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a motion ended, and which rows of the run hold it."""

    name: str
    stop: Stop
    first_row: int
    rows: int
    backlash: BacklashEstimate | None = None
    detail: str = ""
    """Where, the value, its limit and the remedy, of a stop that has them."""

    @property
    def text(self) -> str:
        """The sentence for the operator."""
        return stop_sentence(self.stop, self.detail)

    @property
    def finished(self) -> bool:
        """Whether it came to its own end."""
        return self.stop is Stop.FINISHED
