"""A figure: one number that the project promises, beside its bar. Pure."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Bar:
    """What a figure must keep to; `limit` None = reported, not judged."""

    figure: str
    unit: str
    limit: float | None = None
    at_least: bool = False  # else at most

    @property
    def text(self) -> str:
        """The bar as a reader writes it."""
        if self.limit is None:
            return "reported"
        return f"{'>=' if self.at_least else '<='} {self.limit:g} {self.unit}"


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure."""

    figure: str
    value: float | None
    unit: str
    bar: str
    holds: bool | None  # None: reported only, or not measured for `reason`
    seeds: list[int] = field(default_factory=list)
    reason: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return plain JSON values; no nan and no infinity."""
        values = asdict(self)
        if self.value is not None and not math.isfinite(self.value):
            values["value"] = None
        return values


def judged(bar: Bar, value: float, seeds: list[int] | tuple[int, ...] = (), reason: str = "") -> Figure:
    """Hold a value against its bar; nan never holds."""
    holds: bool | None = None
    if bar.limit is not None:
        holds = bool(value >= bar.limit) if bar.at_least else bool(value <= bar.limit)
    return Figure(bar.figure, float(value), bar.unit, bar.text, holds, list(seeds), reason)


def absent(bar: Bar, reason: str) -> Figure:
    """State that a figure could not be measured here, and why."""
    return Figure(bar.figure, None, bar.unit, bar.text, None, [], reason)
