"""The joint's wear in the service: rows and estimates in, what clients see and what is to be done next out.

Moves nothing: the stage's thread asks what is due between two commands.
"""

import math
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np

from stagectl.outcome import BacklashEstimate
from stagectl.profile import Profile
from stagectl.requests import TICKING
from stagectl.service import messages
from stagectl.service.service_log import ServiceLog, now_text
from stagectl.service.view import finite
from stagectl.wear import IDENTIFIED, PRODUCTION, Look, WearLimits, WearTracker

_LOOK_EVERY_S = 1.0
_TOUCH_SHARE = 0.1  # of the touch force: less is no contact for sure
_LEAST_FORCE_N = 0.3
_LEAST_DRIFT_M_PER_SQRT_S = 1e-9  # 0.3 um in a day, where the profile says nothing
_STIFFNESS_DRIFT_RATIO_PER_SQRT_S = 1e-5  # 0.3 % in a day
_NEWS_RATIO = 0.02  # of a stiffness


class WearWatch:
    """Follows the joint of one profile."""

    def __init__(self, profile: Profile, log: ServiceLog, now_s: Callable[[], float]):
        """`now_s` goes on while the service runs. Nothing is known yet; `seen_at`: when something was."""
        self._profile, self._log, self._now_s = profile, log, now_s
        self._tracker: WearTracker | None = None
        self._looked_s = self._probed_s = -math.inf
        self._told = ""
        self._believed_since = self.seen_at = ""
        joint = profile.backlash
        if profile.micro is None or joint is None:
            return
        wear = profile.wear
        self._least_n = max(_LEAST_FORCE_N, _TOUCH_SHARE * joint.touch_force_n)
        self._tracker = WearTracker(
            WearLimits(
                left_m=joint.left_m,
                right_m=joint.right_m,
                stiffness_n_per_m=(joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m),
                width_change_limit_m=wear.width_change_limit_m,
                stiffness_change_limit_ratio=wear.stiffness_change_limit_ratio,
                trusted_sd_m=wear.trusted_sd_m,
                drift_m_per_sqrt_s=max(wear.edge_drift_m_per_sqrt_s, _LEAST_DRIFT_M_PER_SQRT_S),
                stiffness_drift_ratio_per_sqrt_s=_STIFFNESS_DRIFT_RATIO_PER_SQRT_S,
            )
        )

    def recall(self, last: messages.Backlash | None) -> None:
        """Go on from what was known of this world's joint earlier."""
        if self._tracker is None or last is None:
            return
        sd_m = math.inf if last.width_sd_m is None else last.width_sd_m / math.sqrt(2.0)
        values = {name: getattr(last, name) for name in ("left_m", "right_m")}
        for name in (f"{side}_stiffness" for side in ("left", "right")):
            stiffness_sd = getattr(last, f"{name}_sd_n_per_m")
            values[f"{name}_n_per_m"] = getattr(last, f"{name}_n_per_m")
            values[f"{name}_sd_n_per_m"] = math.inf if stiffness_sd is None else stiffness_sd
        estimate = BacklashEstimate(**values, left_sd_m=sd_m, right_sd_m=sd_m)
        age_s = (datetime.now(UTC) - datetime.fromisoformat(last.at)).total_seconds()
        self._tracker.go_on_from(Look(self._now_s() - max(age_s, 0.0), estimate, last.source or IDENTIFIED))
        self.seen_at = last.at

    def observe(self, rows: np.ndarray) -> None:
        """Note from rows, shape (n,) of ROW, which edges were pressed."""
        if self._tracker is None or rows.size == 0:
            return
        force_n = rows["contact_force_estimate_n"][np.isin(rows["run_phase"], TICKING)]
        self._tracker.touched(
            self._now_s(), left=bool(np.any(force_n < -self._least_n)), right=bool(np.any(force_n > self._least_n))
        )

    def look(self, estimate: BacklashEstimate | None) -> None:
        """Look at the servo's estimate now and then; says an alarm once."""
        now_s = self._now_s()
        if self._tracker is None or estimate is None or now_s - self._looked_s < _LOOK_EVERY_S:
            return
        self._looked_s = now_s
        if self._tracker.look(estimate, now_s, PRODUCTION):
            self.seen_at = now_text()
        self._tell()

    def found(self, estimate: BacklashEstimate | None, source: str, is_believed: bool = False) -> None:
        """Take what an identification, a homing or a probe found.

        `is_believed`: the compensation has it already, as after a homing.
        """
        if self._tracker is not None and estimate is not None:
            if self._tracker.look(estimate, self._now_s(), source):
                self.seen_at = now_text()
            if is_believed:
                self._tracker.taken()
            self._tell()

    def _tell(self) -> None:
        told = "" if self._tracker is None else self._tracker.alarm
        if bool(told) != bool(self._told):
            self._log.say("wear_alarm" if told else "wear", told or "within its limits again")
        self._told = told

    def replacement(self, believed: dict[str, float]) -> BacklashEstimate | None:
        """Return what the compensation should believe instead; None where nothing is sure, permitted, and news."""
        if self._tracker is None or not self._profile.wear.compensate:
            return None
        found = self._tracker.believable()
        if found is None:
            return None
        news = any(abs(getattr(found, name) - value) > self._news(name, value) for name, value in believed.items())
        return found if news else None

    def _news(self, name: str, value: float) -> float:
        return (
            self._profile.wear.trusted_sd_m if name.endswith("_m") and "stiffness" not in name else _NEWS_RATIO * value
        )

    def replaced(self, estimate: BacklashEstimate) -> None:
        """The compensation believes it now."""
        if self._tracker is not None:
            self._tracker.taken()
            self._believed_since = now_text()
            self._log.say("backlash_replaced", f"the compensation believes {estimate.width_m * 1e6:.2f} um from now on")

    def probe_due(self) -> bool:
        """Tell whether the profile wants both edges touched now, `wear.probe_every_s` after it was known last."""
        every_s, now_s = self._profile.wear.probe_every_s, self._now_s()
        if self._tracker is None or every_s is None:
            return False
        return now_s - max(self._probed_s, self._tracker.known_s) >= every_s

    def probe_begun(self) -> None:
        """A probe begins; whatever becomes of it, the next is not due before `wear.probe_every_s`."""
        self._probed_s = self._now_s()

    def message(self) -> messages.Wear | None:
        """Say what is known of the joint now; None where nothing ever was."""
        tracker = self._tracker
        if tracker is None or tracker.newest is None:
            return None
        now_s, newest = self._now_s(), tracker.newest
        left_sd, right_sd = tracker.stiffness_sds_n_per_m(now_s)
        one, age_s, observable = newest.estimate, max(now_s - newest.t_s, 0.0), tracker.observable(now_s)
        age = (
            "" if observable else f"not observable: both edges were not touched lately; the value is {_span(age_s)} old"
        )
        return messages.Wear(
            left_m=one.left_m,
            right_m=one.right_m,
            left_stiffness_n_per_m=one.left_stiffness_n_per_m,
            right_stiffness_n_per_m=one.right_stiffness_n_per_m,
            left_stiffness_sd_n_per_m=finite(left_sd),
            right_stiffness_sd_n_per_m=finite(right_sd),
            width_m=one.width_m,
            width_sd_m=finite(tracker.sd_m(now_s)),
            at=self.seen_at,
            age_s=age_s,
            source=newest.source,
            observable=observable,
            text=age,
            alarm=tracker.alarm,
            believed_since=self._believed_since,
        )

    def newest_of_production(self) -> BacklashEstimate | None:
        """Return the newest value where production motion showed it; None where it is somebody else's."""
        newest = None if self._tracker is None else self._tracker.newest
        return None if newest is None or newest.source != PRODUCTION else newest.estimate


def _span(time_s: float) -> str:
    """Say a time in the largest unit of which it has two or more."""
    for unit, unit_s in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if time_s >= 2.0 * unit_s:
            return f"{time_s / unit_s:.1f} {unit}"
    return f"{time_s:.0f} s"
