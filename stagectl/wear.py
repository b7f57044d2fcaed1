"""Wear of the joint: what production motion, touch probes and identifications say of it, and how sure that still is.

The estimator of the servo (`stagectl.backlash`) says what contact teaches it since the stage was armed. Here it is
looked at from time to time: published while both edges were touched lately; else the last value with its age, less and
less sure, *not observable*. What a probe or an identification measured stands until production touches both edges after
it. Pure; knows no stage and no clock.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from statistics import median

from stagectl.outcome import BacklashEstimate

PRODUCTION, PROBE, IDENTIFIED = "production", "touch probe", "identified"
LOOKS_COUNT = 10
"""Looks in a row that must agree before a value may be believed."""

LATELY_S = 10.0
"""Since contact on both sides, as long as the joint counts as observed."""

_SPREAD_SDS = 3.0
_BACK_RATIO = 0.8  # of a limit: what is less is within it again. At the limit itself noise rang the alarm three times.
_VALUES = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")


@dataclass(frozen=True, slots=True)
class WearLimits:
    """What a profile says of wear; the profile's joint is what it is compared with."""

    width_m: float
    stiffness_n_per_m: tuple[float, float]  # left, right
    width_change_limit_m: float
    stiffness_change_limit_ratio: float
    trusted_sd_m: float
    drift_m_per_sqrt_s: float
    """Random walk of each edge: by it a value that nothing confirms gets less sure."""
    stiffness_drift_ratio_per_sqrt_s: float = 0.0
    """The same of each stiffness, as a share of it."""


@dataclass(frozen=True, slots=True)
class Look:
    """An estimate, when it was taken, and what it came from."""

    t_s: float
    estimate: BacklashEstimate
    source: str


def width_sd_m(estimate: BacklashEstimate) -> float:
    """Return the standard deviation of a width."""
    return math.hypot(estimate.left_sd_m, estimate.right_sd_m)


def alarm(estimate: BacklashEstimate, limits: WearLimits) -> str:
    """Say which limit of wear is passed, with value and limit; empty where none is."""
    said: list[str] = []
    change_m = estimate.width_m - limits.width_m
    if not abs(change_m) <= limits.width_change_limit_m:
        said.append(
            f"the gap is {estimate.width_m * 1e6:.4g} um wide, {change_m * 1e6:+.3g} um from the profile's; "
            f"the limit is {limits.width_change_limit_m * 1e6:.3g} um"
        )
    found = (estimate.left_stiffness_n_per_m, estimate.right_stiffness_n_per_m)
    for side, value, believed in zip(("left", "right"), found, limits.stiffness_n_per_m, strict=True):
        change = value / believed - 1.0
        if not abs(change) <= limits.stiffness_change_limit_ratio:
            said.append(
                f"the {side} contact has {value:.4g} N/m, {change:+.0%} from the profile's; "
                f"the limit is {limits.stiffness_change_limit_ratio:.0%}"
            )
    return "; ".join(said) + "; look at the joint, then identify" if said else ""


class WearTracker:
    """What is known of the joint's wear, from one look to the next."""

    def __init__(self, limits: WearLimits, last: Look | None = None):
        """Go on from what was published last, where there is any."""
        self._limits = limits
        self.newest: Look | None = None
        self._alarm = ""
        if last is not None:
            self.go_on_from(last)
        self._looks: deque[Look] = deque(maxlen=LOOKS_COUNT)  # of production
        self._measured: Look | None = None  # until it is taken, or production says something newer
        self._measured_s = -math.inf
        self._touched_s = [-math.inf, -math.inf]  # left, right

    def go_on_from(self, last: Look) -> None:
        """Take a value as it is."""
        limits = self._limits
        if self._alarm:
            limits = replace(
                limits,
                width_change_limit_m=_BACK_RATIO * limits.width_change_limit_m,
                stiffness_change_limit_ratio=_BACK_RATIO * limits.stiffness_change_limit_ratio,
            )
        self.newest = last
        self._alarm = alarm(last.estimate, self._limits) or (self._alarm if alarm(last.estimate, limits) else "")

    def touched(self, t_s: float, left: bool, right: bool) -> None:
        """Note which sides were pressed just now."""
        for side, pressed in enumerate((left, right)):
            if pressed:
                self._touched_s[side] = t_s

    def observable(self, t_s: float) -> bool:
        """Tell whether both edges were touched lately."""
        return t_s - max(self._measured_s, min(self._touched_s)) <= LATELY_S

    def look(self, estimate: BacklashEstimate, t_s: float, source: str = PRODUCTION) -> bool:
        """Take an estimate where it says something and contact lately stands behind it; returns whether it did.

        What was measured has all contact up to then in it: production says something newer by what it touches after.
        """
        known = estimate.identifiable and all(math.isfinite(getattr(estimate, one.name)) for one in fields(estimate))
        is_news = source != PRODUCTION or (self.observable(t_s) and min(self._touched_s) > self._measured_s)
        if not known or estimate.width_m <= 0.0 or not is_news:
            self._looks.clear()
            return False
        look = Look(t_s, estimate, source)
        self.go_on_from(look)
        if source == PRODUCTION:
            self._measured = None
            self._looks.append(look)
        else:
            self._measured, self._measured_s = look, t_s
            self._looks.clear()
        return True

    def sd_m(self, t_s: float) -> float:
        """Return how sure the newest width is now: its own standard deviation, and the walk of both edges since."""
        if self.newest is None:
            return math.inf
        age_s = max(t_s - self.newest.t_s, 0.0)
        walk_m = self._limits.drift_m_per_sqrt_s * math.sqrt(2.0 * age_s)
        return math.hypot(width_sd_m(self.newest.estimate), walk_m)

    def stiffness_sds_n_per_m(self, t_s: float) -> tuple[float, float]:
        """Return how sure the newest stiffness is now, left and right; grows like `sd_m`."""
        if self.newest is None:
            return math.inf, math.inf
        one, age_s = self.newest.estimate, max(t_s - self.newest.t_s, 0.0)
        walk = self._limits.stiffness_drift_ratio_per_sqrt_s * math.sqrt(age_s)
        return (
            math.hypot(one.left_stiffness_sd_n_per_m, walk * one.left_stiffness_n_per_m),
            math.hypot(one.right_stiffness_sd_n_per_m, walk * one.right_stiffness_n_per_m),
        )

    @property
    def alarm(self) -> str:
        """Say which limit of wear a value passed, until one is well within it again; empty where none did."""
        return self._alarm

    def believable(self) -> BacklashEstimate | None:
        """Return what may be believed from now on: sure, steady over `LOOKS_COUNT` looks, within the limits; or None.

        The value is the looks' median. What was measured is fitted over many touches: it counts by itself.
        """
        looks, limits = [one.estimate for one in ([self._measured] if self._measured else self._looks)], self._limits
        enough = self._measured is not None or len(looks) == LOOKS_COUNT
        if not enough or any(width_sd_m(one) > limits.trusted_sd_m for one in looks):
            return None
        for name in ("left_m", "right_m"):
            values = [getattr(one, name) for one in looks]
            sd_m = max(getattr(one, name.replace("_m", "_sd_m")) for one in looks)
            if max(values) - min(values) > _SPREAD_SDS * sd_m + 0.1 * limits.trusted_sd_m:
                return None
        filtered = _median(looks)
        return None if alarm(filtered, limits) else filtered

    def taken(self) -> None:
        """A value was taken into the compensation: what follows must agree anew."""
        self._looks.clear()
        self._measured = None


def _median(looks: Sequence[BacklashEstimate]) -> BacklashEstimate:
    values = {name: median(getattr(one, name) for one in looks) for name in _VALUES}
    newest = {one.name: getattr(looks[-1], one.name) for one in fields(looks[-1])}
    return BacklashEstimate(**{**newest, **values})
