"""Wear of the joint: what production motion, touch probes and identifications say of it, and how sure that still is.

The estimator of the servo (`stagectl.backlash`) says what contact teaches it since the stage was armed. Here it is
looked at from time to time: published while both edges were touched lately; else the last value with its age, less and
less sure, *not observable*. What a probe or an identification measured stands until production touches both edges after
it, and says of them what is as sure or differs for sure. Pure; knows no stage and no clock.
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
_DIFFERENT_SDS = 3.0  # joint ones, between what stands and a less sure value that is taken in its place
_ALARM_SDS = 2.0  # beyond a limit: an identified 1000 um, followed by 1060 +- 60 um of production, rang at 50 um
_STEADY_RATIO = 0.1  # of the trusted standard deviation, by which looks may differ beside their own
_TRUSTED_STIFFNESS_SD_RATIO = 0.1  # of the limit of its change: 12.8e3 +- 1.9e3 N/m was believed
_BACK_RATIO = 0.8  # of a limit: what is less is within it again. At the limit itself noise rang the alarm three times.
_SIDES = ("left", "right")
_VALUES = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")


@dataclass(frozen=True, slots=True)
class WearLimits:
    """What a profile says of wear; the profile's joint is what it is compared with."""

    left_m: float
    right_m: float
    stiffness_n_per_m: tuple[float, float]  # left, right
    width_change_limit_m: float
    stiffness_change_limit_ratio: float
    trusted_sd_m: float
    drift_m_per_sqrt_s: float
    """Random walk of each edge: by it a value that nothing confirms gets less sure."""
    stiffness_drift_ratio_per_sqrt_s: float = 0.0
    """The same of each stiffness, as a share of it."""

    @property
    def width_m(self) -> float:
        """Distance of the edges."""
        return self.left_m + self.right_m

    @property
    def centre_m(self) -> float:
        """Middle of the gap on x_b: homing puts it there."""
        return 0.5 * (self.right_m - self.left_m)

    @property
    def centre_change_limit_m(self) -> float:
        """By how much wear of one side alone moves the middle, at the limit of the width.

        Wear moves edges outward: what moves the middle further is none, but a laser that drifts. With both limits no
        edge changes by more than that of the width.
        """
        return 0.5 * self.width_change_limit_m

    @property
    def trusted_stiffness_sds_n_per_m(self) -> tuple[float, float]:
        """How sure each stiffness must be to be believed, left and right."""
        ratio = _TRUSTED_STIFFNESS_SD_RATIO * self.stiffness_change_limit_ratio
        return ratio * self.stiffness_n_per_m[0], ratio * self.stiffness_n_per_m[1]


@dataclass(frozen=True, slots=True)
class Look:
    """An estimate, when it was taken, and what it came from."""

    t_s: float
    estimate: BacklashEstimate
    source: str


def width_sd_m(estimate: BacklashEstimate) -> float:
    """Return the standard deviation of a width."""
    return math.hypot(estimate.left_sd_m, estimate.right_sd_m)


def alarm(estimate: BacklashEstimate, limits: WearLimits, sds_count: float = _ALARM_SDS) -> str:
    """Say which limit is passed, by more than `sds_count` standard deviations, and what to do; empty where none is."""
    worn: list[str] = []
    change_m, limit_m = estimate.width_m - limits.width_m, limits.width_change_limit_m
    if _is_beyond(change_m, limit_m, width_sd_m(estimate), sds_count):
        worn.append(
            f"the gap is {estimate.width_m * 1e6:.4g} um wide, {change_m * 1e6:+.3g} um from the profile's; "
            f"the limit is {limit_m * 1e6:.3g} um"
        )
    found = (estimate.left_stiffness_n_per_m, estimate.right_stiffness_n_per_m)
    sds = (estimate.left_stiffness_sd_n_per_m, estimate.right_stiffness_sd_n_per_m)
    for side, value, sd, believed in zip(_SIDES, found, sds, limits.stiffness_n_per_m, strict=True):
        change = value / believed - 1.0
        if _is_beyond(change, limits.stiffness_change_limit_ratio, sd / believed, sds_count):
            worn.append(
                f"the {side} contact has {value:.4g} N/m, {change:+.0%} from the profile's; "
                f"the limit is {limits.stiffness_change_limit_ratio:.0%}"
            )
    said = ["; ".join(worn) + "; look at the joint, then identify"] if worn else []
    change_m, limit_m = estimate.centre_m - limits.centre_m, limits.centre_change_limit_m
    if _is_beyond(change_m, limit_m, 0.5 * width_sd_m(estimate), sds_count):
        said.insert(
            0,
            f"the gap's middle is at {estimate.centre_m * 1e6:.4g} um, {change_m * 1e6:+.3g} um from the profile's; "
            f"the limit is {limit_m * 1e6:.3g} um; look at the end's interferometer, then home",
        )
    return "; ".join(said)


def _is_beyond(change: float, limit: float, sd: float, sds_count: float) -> bool:
    return not abs(change) - limit <= (sds_count * sd if sds_count > 0.0 else 0.0)


class WearTracker:
    """What is known of the joint's wear, from one look to the next."""

    def __init__(self, limits: WearLimits, last: Look | None = None):
        """Go on from what was published last, where there is any."""
        self._limits = limits
        self.newest: Look | None = None
        self.known_s = -math.inf
        """When something as sure as is trusted, or surer than what stood, was last said of the joint."""
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
        self.newest, self.known_s = last, last.t_s
        # Rung by what is beyond for sure; over with a value that is within, however sure.
        self._alarm = alarm(last.estimate, self._limits) or (self._alarm if alarm(last.estimate, limits, 0.0) else "")

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
        Nor does production replace what is surer and agrees with it.
        """
        known = estimate.identifiable and all(math.isfinite(getattr(estimate, one.name)) for one in fields(estimate))
        is_news = source != PRODUCTION or (self.observable(t_s) and min(self._touched_s) > self._measured_s)
        if not known or estimate.width_m <= 0.0 or not is_news:
            self._looks.clear()
            return False
        news = estimate if source != PRODUCTION else self._news(estimate, t_s)
        if news is None:
            if width_sd_m(estimate) <= self._limits.trusted_sd_m:
                self.known_s = t_s
            return False
        look = Look(t_s, news, source)
        self.go_on_from(look)
        if source == PRODUCTION:
            self._measured = None
            self._looks.append(look)
        else:
            self._measured, self._measured_s = look, t_s
            self._looks.clear()
        return True

    def _news(self, estimate: BacklashEstimate, t_s: float) -> BacklashEstimate | None:
        """Return what stands with what production says better: as sure as what stands by now, or different for sure.

        The edges together, each stiffness by itself. None where production has no news.
        """
        stands = self._aged(t_s)
        if stands is None:
            return estimate
        sd_m, stands_sd_m = width_sd_m(estimate), width_sd_m(stands)
        takes_edges = (
            sd_m <= stands_sd_m
            or _differ(estimate.width_m, sd_m, stands.width_m, stands_sd_m)
            or any(_differ_in(f"{side}_m", estimate, stands) for side in _SIDES)
        )
        differing = [side for side in _SIDES if _differ_in(f"{side}_stiffness_n_per_m", estimate, stands)]
        if not takes_edges and not differing:
            return None
        kept = [] if takes_edges else ["left_m", "right_m"]
        for side in _SIDES:
            sure, stands_sure = (getattr(one, f"{side}_stiffness_sd_n_per_m") for one in (estimate, stands))
            if side not in differing and not sure <= stands_sure:
                kept.append(f"{side}_stiffness_n_per_m")
        return replace(estimate, **{name: getattr(stands, name) for value in kept for name in (value, _sd_name(value))})

    def _aged(self, t_s: float) -> BacklashEstimate | None:
        """Return what was published last, as sure as it is now: its own standard deviations, and the walk since."""
        if self.newest is None:
            return None
        one, root_s = self.newest.estimate, math.sqrt(max(t_s - self.newest.t_s, 0.0))
        walk_m = self._limits.drift_m_per_sqrt_s * root_s
        walk = self._limits.stiffness_drift_ratio_per_sqrt_s * root_s
        return replace(
            one,
            left_sd_m=math.hypot(one.left_sd_m, walk_m),
            right_sd_m=math.hypot(one.right_sd_m, walk_m),
            left_stiffness_sd_n_per_m=math.hypot(one.left_stiffness_sd_n_per_m, walk * one.left_stiffness_n_per_m),
            right_stiffness_sd_n_per_m=math.hypot(one.right_stiffness_sd_n_per_m, walk * one.right_stiffness_n_per_m),
        )

    def sd_m(self, t_s: float) -> float:
        """Return how sure the newest width is now: its own standard deviation, and the walk of both edges since."""
        aged = self._aged(t_s)
        return math.inf if aged is None else width_sd_m(aged)

    def stiffness_sds_n_per_m(self, t_s: float) -> tuple[float, float]:
        """Return how sure the newest stiffness is now, left and right; grows like `sd_m`."""
        aged = self._aged(t_s)
        if aged is None:
            return math.inf, math.inf
        return aged.left_stiffness_sd_n_per_m, aged.right_stiffness_sd_n_per_m

    @property
    def alarm(self) -> str:
        """Say which limit of wear a value passed, until one is well within it again; empty where none did."""
        return self._alarm

    def believable(self) -> BacklashEstimate | None:
        """Return what may be believed from now on: sure, steady over `LOOKS_COUNT` looks, within the limits; or None.

        Edges and stiffnesses alike; no edge at or beyond zero. The value is the looks' median. What was measured is
        fitted over many touches: it counts by itself.
        """
        looks, limits = [one.estimate for one in ([self._measured] if self._measured else self._looks)], self._limits
        enough = self._measured is not None or len(looks) == LOOKS_COUNT
        if not enough or any(width_sd_m(one) > limits.trusted_sd_m for one in looks):
            return None
        left, right = limits.trusted_stiffness_sds_n_per_m
        trusted_sds = dict(zip(_VALUES, (limits.trusted_sd_m, limits.trusted_sd_m, left, right), strict=True))
        for name, trusted_sd in trusted_sds.items():
            values = [getattr(one, name) for one in looks]
            sd = max(getattr(one, _sd_name(name)) for one in looks)
            steady = max(values) - min(values) <= _SPREAD_SDS * sd + _STEADY_RATIO * trusted_sd
            if not (sd <= trusted_sd and steady):
                return None
        filtered = _median(looks)
        bounded = filtered.left_m > 0.0 and filtered.right_m > 0.0 and not alarm(filtered, limits, 0.0)
        return filtered if bounded else None

    def taken(self) -> None:
        """A value was taken into the compensation: what follows must agree anew."""
        self._looks.clear()
        self._measured = None


def _sd_name(value_name: str) -> str:
    """Return which field says how sure a value is."""
    side, rest = value_name.split("_", 1)
    return f"{side}_sd_m" if rest == "m" else f"{side}_stiffness_sd_n_per_m"


def _differ(one: float, one_sd: float, other: float, other_sd: float) -> bool:
    return abs(one - other) > _DIFFERENT_SDS * math.hypot(one_sd, other_sd)


def _differ_in(name: str, one: BacklashEstimate, other: BacklashEstimate) -> bool:
    values = ((getattr(estimate, name), getattr(estimate, _sd_name(name))) for estimate in (one, other))
    return _differ(*(number for pair in values for number in pair))


def _median(looks: Sequence[BacklashEstimate]) -> BacklashEstimate:
    values = {name: median(getattr(one, name) for one in looks) for name in _VALUES}
    newest = {one.name: getattr(looks[-1], one.name) for one in fields(looks[-1])}
    return BacklashEstimate(**{**newest, **values})
