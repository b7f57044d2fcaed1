"""What a request for a scan, a table or a stream becomes: a plan that was checked before anything moves. Pure."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from pydantic import BaseModel

from stagectl import scan, suspected_units, touch_sweep
from stagectl import trajectory as trajectories
from stagectl.backend import SEGMENT_ROWS
from stagectl.errors import RequestError
from stagectl.motion import check, planned_limits, travel_from
from stagectl.profile import Profile
from stagectl.service import messages
from stagectl.service.used_keys import digest
from stagectl.streaming import Room, SetpointBuffer
from stagectl.trajectory import Waypoint

_FILLED_S = 2.0  # short repetitions go together


class Plan(NamedTuple):
    """What the stage follows, and what a person should look at."""

    motion: Any
    remark: str = ""


def kept(body: BaseModel) -> BaseModel:
    """Return what is kept of a request: tables and set-points go by their digest."""
    if isinstance(body, messages.Follow):
        return messages.Followed(name=body.name, law=body.law, sha256=digest(body.text).hex())
    if isinstance(body, messages.Setpoints):
        return messages.StreamBegun(period_s=body.period_s, sha256=digest(body).hex())
    return body


def positions(body: BaseModel) -> dict[str, float]:
    """Return the positions that a request names itself, each by its place, m."""
    if isinstance(body, messages.Move):
        return {"target_m": body.target_m}
    if isinstance(body, messages.Scan):
        start = {} if body.start_m is None else {"start_m": body.start_m}
        return {**start, **{f"segments.{k}.target_m": part.target_m for k, part in enumerate(body.segments)}}
    if isinstance(body, messages.Setpoints):
        return {"position_m.0": body.position_m[0]}
    return {}


def planned(body: BaseModel, profile: Profile, holds_m: float) -> Plan | None:
    """Plan what begins where the stage holds; None for a motion that needs no plan. Errors: RequestError."""
    if isinstance(body, messages.Scan):
        return scanned(body, profile, holds_m)
    if isinstance(body, messages.Follow):
        return followed(body, profile)
    return None


def rehearse(
    body: BaseModel, profile: Profile, holds_m: float, joint: Mapping[str, float] | None = None, found: str = ""
) -> None:
    """Plan what is planned only when it begins, too. Errors: RequestError.

    A sweep goes by the edges and stiffnesses of `joint`, of which `found` says how they were found, the profile's
    without; a stream begins at its own first position.
    """
    if isinstance(body, messages.Identify):
        touch_sweep.planned(
            profile,
            touch_sweep.IDENTIFY_SHARE,
            touch_sweep.IDENTIFY_HZ,
            body.duration_s,
            body.frequency_hz,
            joint,
            found=found,
        )
    elif isinstance(body, messages.Setpoints):
        streamed(body, profile, body.position_m[0])
    else:
        planned(body, profile, holds_m)


def scanned(body: messages.Scan, profile: Profile, holds_m: float) -> Plan:
    """Plan a scan program. Errors: RequestError with segment or instant, value, limit, remedy."""
    limits = planned_limits(profile)
    waypoints = [
        Waypoint(
            part.target_m,
            limits.velocity_m_per_s if part.velocity_m_per_s is None else part.velocity_m_per_s,
            part.pass_velocity_m_per_s,
            part.dwell_s,
        )
        for part in body.segments
    ]
    start_m = holds_m if body.start_m is None else body.start_m
    longest_s = (SEGMENT_ROWS // 3 - 1) * profile.cycle.period_s - _FILLED_S
    program = scan.plan(start_m, waypoints, body.repeat_count, limits, profile.cycle.period_s, longest_s)
    check(program.first, profile)
    check(program.again, profile)
    return Plan(program)


def followed(body: messages.Follow, profile: Profile) -> Plan:
    """Plan the motion of a table. Errors: RequestError, with the units that it seems to have."""
    dt_s = profile.cycle.period_s
    planned = trajectories.from_text(body.text, dt_s, body.name, longest_s=(SEGMENT_ROWS - 1) * dt_s)
    try:
        check(planned, profile)
    except RequestError as error:
        suspected = suspected_units.of_positions(planned, profile.macro.travel_m)
        raise RequestError(f"{error}. {suspected}" if suspected else str(error)) from error
    return Plan(planned, suspected_units.of_times(planned, profile.macro.velocity_limit_m_per_s))


def streamed(body: messages.Setpoints, profile: Profile, holds_m: float) -> Plan:
    """Begin a stream with its first set-points. Errors: RequestError with number, value, limit, remedy."""
    macro = profile.macro
    room = Room(travel_from(holds_m, profile), planned_limits(profile), macro.stop_deceleration_m_per_s2)
    buffer = SetpointBuffer(holds_m, body.period_s, room, profile.cycle.period_s)
    buffer.take(0, body.position_m, body.last)
    return Plan(buffer)
