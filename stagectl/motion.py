"""Motion of a stage that is armed: segments that the servo follows, moves, jogs, trajectories.

Every plan is checked against the profile's limits before its first cycle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from stagectl import jogging
from stagectl import trajectory as trajectories
from stagectl.backend import SEGMENT_ROWS
from stagectl.errors import RequestError, TimingError
from stagectl.outcome import BacklashEstimate, Outcome
from stagectl.profile import Profile
from stagectl.requests import Phase
from stagectl.scan import Program
from stagectl.session import Session
from stagectl.signals import SETPOINT, Stop
from stagectl.tracker import LAW_NAMES

PLAN_SHARE = 0.9
"""Of the profile's limits that planned moves use."""

_JERK_TIME_S = 0.1


def planned_limits(profile: Profile) -> trajectories.Limits:
    """Return what planned moves, scans and streams keep to."""
    macro = profile.macro
    acceleration = PLAN_SHARE * min(macro.acceleration_limit_m_per_s2, 0.5 * macro.stop_deceleration_m_per_s2)
    return trajectories.Limits(PLAN_SHARE * macro.velocity_limit_m_per_s, acceleration, acceleration / _JERK_TIME_S)


def travel_from(start_m: float, profile: Profile) -> tuple[float, float]:
    """Return where a motion may go that begins at `start_m`: within the travel, or no further out than it stands.

    A stage at the end of its travel rests some nanometres beyond it; it is let back in from wherever the guard lets it
    be.
    """
    (low_m, high_m), stray_m = profile.macro.travel_m, profile.control.error_limit_m
    return min(low_m, max(start_m, low_m - stray_m)), max(high_m, min(start_m, high_m + stray_m))


def check(planned: trajectories.Trajectory, profile: Profile) -> None:
    """Refuse what a stage of this profile can't follow: RequestError names instant, value, limit and remedy."""
    macro, position_m = profile.macro, planned.setpoints["position_m"]
    trajectories.check(
        planned,
        travel_from(float(position_m[0]), profile) if position_m.size else macro.travel_m,
        macro.velocity_limit_m_per_s,
        macro.acceleration_limit_m_per_s2,
        stop_deceleration_m_per_s2=macro.stop_deceleration_m_per_s2,
    )


class Motion(Session):
    """A session that can move."""

    _segment_number = 0
    _segment_free = 0

    def follow(
        self,
        setpoints: np.ndarray,
        name: str,
        law: str | None = None,
        again: np.ndarray | None = None,
        again_count: int = 0,
    ) -> Outcome:
        """Run a segment of SETPOINT rows that begins where the stage holds; returns how it ended.

        `again` follows it without a pause, `again_count` times; both end at rest.
        """
        again_count = 0 if again is None else again_count
        most = SEGMENT_ROWS // (3 if again_count else 1)  # three in turn never overwrite the one under way
        longest = max(setpoints.size, again.size if again is not None else 0)
        if longest > most:
            raise RequestError(f"{name}: {longest} setpoints, {most} fit; split the trajectory")
        for field in SETPOINT.names or ():
            odd = np.flatnonzero(~np.isfinite(setpoints[field]))
            if odd.size:
                value = setpoints[field][odd[0]]
                raise RequestError(f"{name}: setpoint {odd[0]} has {field} = {value}; every value must be finite")
        status = self.status()
        if status["phase"] != Phase.TRACKING and status["stop"] != Stop.NONE:
            # What came between two parts of a motion (on the way to its start, say) ends it like any other stop.
            status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "coming to rest")
            return self._outcome(name, Stop(int(status["stop"])), self.recorder.rows_count)
        if status["phase"] != Phase.TRACKING:
            raise RequestError(f"{name}: the stage is not armed; enable it first")
        away_m = abs(float(setpoints["position_m"][0]) - float(status["setpoint_position_m"]))
        if not away_m <= 1e-6:
            raise RequestError(f"{name} begins {away_m:g} m from where the stage holds; move there first")
        first_row = self.recorder.rows_count
        number = newest = self._begin_segment(setpoints, name, law)
        under_way, left_count = setpoints, again_count
        rows_count = setpoints.size + (0 if again is None else again_count * again.size)
        duration_s = rows_count / self.profile.cycle.rate_hz
        until_t_ns = self.link.now_t_ns() + round((duration_s * 1.5 + 5.0) * 1e9)
        while True:
            status = self.pump()
            if status["phase"] != Phase.TRACKING:
                status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "coming to rest")
                stop = Stop(int(status["stop"]))
                break
            if again is not None and status["segment_number"] == newest:
                if newest != number:
                    number, under_way = newest, again
                if left_count > 0:
                    newest = self._begin_segment(again, name, law, at_row=under_way.size)
                    left_count -= 1
            if status["segment_number"] == newest and status["segment_left_rows"] <= 0:
                stop = Stop.FINISHED
                break
            if self.link.now_t_ns() > until_t_ns:
                raise TimingError(
                    f"{name}: not done after {duration_s * 1.5 + 5.0:g} s; is the sensor's rate_hz right?"
                )
            to_come = left_count + (newest != number)
            left_rows = float(status["segment_left_rows"]) + (0 if again is None else to_come * again.size)
            self._progress(name, 1.0 - left_rows / rows_count)
        detail = "" if stop is Stop.FINISHED else self.detail
        self._event("segment_end", number=newest, stop=stop.name, **({"detail": detail} if detail else {}))
        return self._outcome(name, stop, first_row, self.backlash(status))

    def _begin_segment(self, setpoints: np.ndarray, name: str, law: str | None = None, at_row: int = 0) -> int:
        """Have the servo follow a segment, behind `at_row` rows of the one under way; returns its number."""
        if self._segment_free + setpoints.size > SEGMENT_ROWS:
            self._segment_free = 0
        start = self._segment_free
        self.link.segments[start : start + setpoints.size] = setpoints
        self._segment_free += setpoints.size
        self._segment_number += 1
        number = self._segment_number
        fields: dict[str, Any] = {
            "segment_start": start,
            "segment_rows": setpoints.size,
            "segment_number": number,
            "segment_at_row": at_row,
        }
        if law is not None:
            fields["law_number"] = LAW_NAMES.index(law)
        self._event("segment", number=number, segment=name, law=law, setpoints=int(setpoints.size))
        self._request(**fields)
        return number

    def backlash(self, status: np.void) -> BacklashEstimate | None:
        """Return what a state of the servo says of the joint; None on a stage without a micro."""
        if self.profile.micro is None:
            return None
        return BacklashEstimate(
            **{name: float(status[name]) for name in BacklashEstimate.__dataclass_fields__}  # named alike
        )

    def _limits(self) -> trajectories.Limits:
        return planned_limits(self.profile)

    def move(self, target_m: float, law: str | None = None) -> Outcome:
        """Move the end to a position, jerk-limited; checked before the first cycle."""
        status = self.status()
        start_m = float(status["setpoint_position_m"])
        self._centre(status)
        if abs(target_m - start_m) < 1e-12:
            return Outcome("move", Stop.FINISHED, self.recorder.rows_count, 0)
        planned = trajectories.move(start_m, target_m, self._limits(), 1.0 / self.profile.cycle.rate_hz)
        self._check(planned)
        return self.follow(planned.setpoints, f"moving to {target_m * 1e3:g} mm", law)

    def jog(self, wanted_m_per_s: Callable[[], float | None]) -> Outcome:
        """Move at the velocity that is wanted now, asked for every 20 ms, until that is None; then come to rest.

        Every plan under way ends at rest, at the ends of travel or within `jogging.HORIZON_S`.
        """
        name, first_row = "jogging", self.recorder.rows_count
        limits, travel_m, dt_s = self._limits(), self.profile.macro.travel_m, 1.0 / self.profile.cycle.rate_hz
        self._centre(self.status())
        under_way, number, speed = np.zeros(0, SETPOINT), self._segment_number, 0.0
        pending: tuple[int, jogging.Splice, float] | None = None
        while True:
            status = self.pump()
            if status["phase"] != Phase.TRACKING:
                status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "coming to rest")
                return self._outcome(name, Stop(int(status["stop"])), first_row)
            self._progress(name, 0.0)
            asked = wanted_m_per_s()
            wanted = 0.0 if asked is None else jogging.wanted_speed(asked, limits)
            if pending is not None and status["segment_number"] == pending[0]:
                (number, (_, under_way), speed), pending = pending, None
            if status["segment_number"] != number:  # not begun yet
                continue
            left_rows = max(int(status["segment_left_rows"]), 0)
            done_rows = under_way.size - left_rows
            if pending is not None:
                if done_rows <= pending[1].at_row:
                    continue
                pending = None  # it came too late: once more
            if left_rows == 0:
                if asked is None:
                    return self._outcome(name, Stop.FINISHED, first_row)
                start = trajectories.MotionState(float(status["setpoint_position_m"]))
                if wanted == 0.0 or self._at_end(start.position_m, wanted):
                    continue
                planned = jogging.way(start, wanted, limits, travel_m, dt_s)
                self._check(planned)
                under_way, speed = planned.setpoints, wanted
                number = self._begin_segment(under_way, name)
            elif wanted != speed or self._nears_end(under_way, left_rows * dt_s, wanted):
                spliced = jogging.splice(under_way, done_rows, wanted, limits, travel_m, dt_s)
                if spliced is None:
                    continue
                self._check(spliced[1])
                splice = spliced[0]
                pending = self._begin_segment(splice.setpoints, name, at_row=splice.at_row), splice, wanted

    def _nears_end(self, under_way: np.ndarray, left_s: float, velocity_m_per_s: float) -> bool:
        """Tell whether a jog has used up half of its plan, and there is way left beyond it."""
        if velocity_m_per_s == 0.0 or left_s >= 0.5 * jogging.HORIZON_S:
            return False
        return not self._at_end(float(under_way["position_m"][-1]), velocity_m_per_s)

    def _at_end(self, position_m: float, velocity_m_per_s: float) -> bool:
        """Tell whether there is no way left in that direction."""
        low_m, high_m = self.profile.macro.travel_m
        return position_m >= high_m - 1e-6 if velocity_m_per_s > 0.0 else position_m <= low_m + 1e-6

    def _check(self, planned: trajectories.Trajectory) -> None:
        check(planned, self.profile)

    def _centre(self, status: np.void) -> None:
        """Bring the macro to the middle of the gap, the end at rest, by a fifth-order polynomial."""
        relative_m = float(status["setpoint_relative_position_m"])
        if abs(relative_m) < 1e-9:
            return
        duration_s = 1.0
        count = round(duration_s * self.profile.cycle.rate_hz)
        u = np.arange(1, count + 1) / count
        rows = np.zeros(count, SETPOINT)
        rows["position_m"] = status["setpoint_position_m"]
        rows["relative_position_m"] = relative_m * (1 - (10 * u**3 - 15 * u**4 + 6 * u**5))
        rows["relative_velocity_m_per_s"] = -relative_m * (30 * u**2 - 60 * u**3 + 30 * u**4) / duration_s
        rows["relative_acceleration_m_per_s2"] = -relative_m * (60 * u - 180 * u**2 + 120 * u**3) / duration_s**2
        self.follow(rows, "centring")

    def run(self, planned: trajectories.Trajectory, law: str | None = None) -> Outcome:
        """Move to a trajectory's start, then follow it under a law."""
        self._check(planned)
        there = self.move(float(planned.setpoints["position_m"][0]), law)
        if not there.finished:
            return there
        under = f" under {law}" if law else ""
        return self.follow(planned.setpoints, f"{planned.name}{under}", law)

    def scan(self, program: Program, law: str | None = None) -> Outcome:
        """Move to a scan program's start, then follow all of its repetitions."""
        self._check(program.first)
        self._check(program.again)
        there = self.move(float(program.first.setpoints["position_m"][0]), law)
        if not there.finished:
            return there
        return self.follow(program.first.setpoints, "scanning", law, program.again.setpoints, program.again_count)
