"""What a set of recordings says of a machine, as values. Pure."""

from dataclasses import dataclass, field
from typing import Any

PARAMETER = "parameter"

SIGMAS = 1.96
"""So many of any deviation that is stated here are the half width of a 95 % interval."""


Alias = tuple[str, str, float]
"""An effect that would do as well: name, place, and the squares that it leaves more."""


def title_of(name: str, acts_on: str) -> str:
    """Say what a finding is about."""
    return f"{name} (known parameter)" if acts_on == PARAMETER else f"{name} on {acts_on}"


@dataclass(frozen=True, slots=True)
class Named:
    """One effect that the recordings show."""

    name: str
    acts_on: str
    parameters: dict[str, float]
    sds: dict[str, float]
    gain: float
    held_out_gain: float
    aliases: tuple[Alias, ...]
    confirmed: bool = False
    common_sd_ratio: float = 0.0  # what all of `sds` hold in common: of the scale of forces; 0 in older findings
    correlations: tuple[tuple[str, str, float], ...] = ()  # of the errors of pairs of `sds`; none in older findings


@dataclass(frozen=True, slots=True)
class ParameterError:
    """A known parameter that the recordings contradict."""

    name: str
    error: float  # ratio, metres for an edge, or seconds for a time
    sd: float
    stated_sd: float
    aliases: tuple[str, ...] = ()  # parameters that would do as well
    confirmed: bool = False

    @property
    def acts_on(self) -> str:
        """Where predictions and outcomes say that it acts: it has no place of its own."""
        return PARAMETER


@dataclass(frozen=True, slots=True)
class Findings:
    """What a set of recordings says of a machine."""

    profile: str
    runs: tuple[str, ...]
    holdout: tuple[str, ...]
    verdict: str  # nothing | found | unknown
    named: tuple[Named, ...]
    parameter_errors: tuple[ParameterError, ...]
    refitted: dict[str, float]  # every known parameter's error as fitted: a ratio, or in its own unit
    not_excited: tuple[str, ...]
    unknown: dict[str, Any] | None
    reducible_before: tuple[float, float]
    reducible_after: tuple[float, float]
    threshold: float
    remarks: tuple[str, ...] = ()
    not_separable: tuple[str, ...] = ()  # what these runs can't tell apart, and what would; a line each
    trace: tuple[str, ...] = ()
    refitted_sds: dict[str, float] = field(default_factory=dict)  # absent from findings of older versions
    profile_path: str = ""  # "" where the belief came from no file
    profile_sha256: str = ""
    reducible_sds: tuple[float, float] = (0.0, 0.0)  # standard errors of the floors; 0 in older findings
