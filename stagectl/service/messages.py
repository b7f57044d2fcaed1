"""What goes over the API, both ways; the server checks it and the client has it as types. Units are in the names."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
Key = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[A-Za-z0-9._:-]+$")]
LeaseKey = Annotated[Key, Field(min_length=16)]
"""Whoever says it again gets the lease: nothing to be guessed, or used twice by chance."""
LawName = Literal["pid", "dsmc"]
RunName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]


_SHOWN_LETTERS = 60


def sentence(problem: Mapping[str, Any]) -> str:
    """Say what is wrong with one value of a request (an entry of pydantic's errors): place, value, limit."""
    place = ".".join(str(part) for part in problem.get("loc", ()))
    value = repr(problem.get("input"))
    shown = value if len(value) <= _SHOWN_LETTERS else f"{value[:_SHOWN_LETTERS]}..."
    text = f"{place} is {shown}: {problem.get('msg', 'is wrong')}"
    return text.encode("utf-8", "backslashreplace").decode()


class _Asked(BaseModel):
    """A request's body: every key known, numbers are numbers and finite."""

    model_config = ConfigDict(extra="forbid", strict=True)


_ODD = r"\x00-\x1f\x7f-\xa0\xad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\U000e0000-\U000e007f"
_PLAIN = f"^[^ {_ODD}][^{_ODD}]*$"
"""Text that is seen and does nothing to a terminal: no character that controls it, turns text about or has no width."""


class TakeLease(_Asked):
    """Ask for the lease on motion."""

    holder: Annotated[str, Field(min_length=1, max_length=100, pattern=_PLAIN)]
    duration_s: Annotated[Finite, Field(ge=0.2, le=30.0)] = 2.0


class Arm(_Asked):
    """Give the drives power and hold."""

    law: LawName | None = None


class Home(_Asked):
    """Home both axes."""


class Move(_Asked):
    """Move the end to a position, from the homed zero."""

    target_m: Annotated[Finite, Field(ge=-100.0, le=100.0)]
    law: LawName | None = None


class JogBy(_Asked):
    """Move the end by a distance."""

    distance_m: Annotated[Finite, Field(ge=-100.0, le=100.0)]
    law: LawName | None = None


class BeginJog(_Asked):
    """Begin to jog, at rest; how fast is said next, before `hold_s` is over."""

    hold_s: Annotated[Finite, Field(ge=0.05, le=1.0)] = 0.3


class JogAt(_Asked):
    """Go on with a jog at a velocity, for as long as this is said again before `hold_s` is over; 0 holds still."""

    velocity_m_per_s: Annotated[Finite, Field(ge=-20.0, le=20.0)]
    hold_s: Annotated[Finite, Field(ge=0.05, le=1.0)] = 0.3


class Identify(_Asked):
    """Sweep the micro over both edges."""

    frequency_hz: Annotated[Finite, Field(ge=0.05, le=5.0)] | None = None
    duration_s: Annotated[Finite, Field(ge=2.0, le=240.0)] = 20.0


class Segment(_Asked):
    """One part of a scan: to a position, there at rest for `dwell_s`, or passing it without a stop."""

    target_m: Annotated[Finite, Field(ge=-100.0, le=100.0)]
    velocity_m_per_s: Annotated[Finite, Field(ge=1e-6, le=20.0)] | None = None
    """At most; without it, as fast as a move."""
    pass_velocity_m_per_s: Annotated[Finite, Field(ge=-20.0, le=20.0)] = 0.0
    """With which the target is passed, signed: the next segment goes on from there."""
    dwell_s: Annotated[Finite, Field(ge=0.0, le=3600.0)] = 0.0


class Scan(_Asked):
    """A scan program: its segments one after the other, `repeat_count` times; begins at `start_m`, or where it is."""

    segments: Annotated[list[Segment], Field(min_length=1, max_length=200)]
    repeat_count: Annotated[int, Field(ge=1, le=10**6)] = 1
    start_m: Annotated[Finite, Field(ge=-100.0, le=100.0)] | None = None
    law: LawName | None = None


class Follow(_Asked):
    """A motion over time: CSV with the header `t_s,position_m`, smoothed by a quintic spline, at rest at its ends."""

    text: Annotated[str, Field(min_length=1, max_length=2_000_000)]
    name: RunName = "trajectory"
    law: LawName | None = None


class Followed(BaseModel):
    """What is kept of such a motion's request."""

    name: str
    law: LawName | None
    sha256: str


class Setpoints(_Asked):
    """Positions `period_s` apart, ahead of time, numbered from 0; number 0 is where the stage holds and begins."""

    first_number: Annotated[int, Field(ge=0, le=10**12)]
    period_s: Annotated[Finite, Field(ge=1e-4, le=1.0)]
    position_m: Annotated[list[Finite], Field(min_length=1, max_length=2000)]
    last: bool = False
    """Whether the stage comes to rest behind these."""


class StreamBegun(BaseModel):
    """What is kept of the request that began a stream."""

    period_s: float
    sha256: str


class StreamState(BaseModel):
    """How a stream stands: what must come next, for how long there is enough, how many have room."""

    key: str
    """Of the command; says what became of it."""
    next_number: int
    ahead_s: float
    room_count: int


class Probe(_Asked):
    """Touch both edges with a few newtons; only where the profile permits it."""


class SwapBackend(_Asked):
    """Work in another world; only without power."""

    backend: Literal["auto", "hardware", "rig", "rig-drives", "rig-sensor"]


class StartRecord(_Asked):
    """Begin a run on request."""

    name: RunName = "request"


class SetTrigger(_Asked):
    """Record what is around an event: an error above a level, a contact above a force; without either, a reversal."""

    name: RunName = "trigger"
    error_m: Annotated[Finite, Field(gt=0.0, le=1.0)] | None = None
    contact_force_n: Annotated[Finite, Field(gt=0.0, le=1e6)] | None = None
    before_s: Annotated[Finite, Field(ge=0.0, le=600.0)] = 1.0
    after_s: Annotated[Finite, Field(ge=0.0, le=600.0)] = 1.0
    count: Annotated[int, Field(ge=1, le=1000)] = 1
    """How often it may."""


class Acknowledge(_Asked):
    """Take note of a fault; enables nothing. `number` is the fault's, so that no newer one goes unseen."""

    number: Annotated[int, Field(ge=1, le=10**9)]


class Failure(BaseModel):
    """Why something was refused or failed: place, value, limit, remedy."""

    kind: str
    message: str


class Backlash(BaseModel):
    """The joint as it was known last."""

    width_m: float
    centre_m: float
    left_m: float
    right_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float
    width_sd_m: float | None
    left_stiffness_sd_n_per_m: float | None = None
    right_stiffness_sd_n_per_m: float | None = None
    source: str = ""
    """What it was learned from: identified, touch probe, production; empty where an older service kept it."""
    at: str
    """When, UTC."""
    run: str
    profile_name: str
    backend: str
    """World that it is of: the rig's joint is not the machine's."""


class Wear(BaseModel):
    """The joint as production motion, a probe or an identification showed it last, and how sure that is now."""

    left_m: float
    right_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float
    left_stiffness_sd_n_per_m: float | None
    right_stiffness_sd_n_per_m: float | None
    width_m: float
    width_sd_m: float | None
    """Grows with the age."""
    at: str
    age_s: float
    source: str
    """production | touch probe | identified"""
    observable: bool
    """Whether both edges were touched lately; where not, the last value stands here."""
    text: str
    alarm: str
    """Which limit of wear is passed; empty where none."""
    believed_since: str
    """When the compensation took a value over by itself, UTC; empty where it did not."""


class Fault(BaseModel):
    """Why the stage stopped by itself: what happened, when, the values, and what to do."""

    number: int
    kind: str
    what: str
    values: str
    remedy: str
    at: str
    state: str
    """What it was doing then."""


class LeaseState(BaseModel):
    """Who may move the stage."""

    holder: str
    left_s: float
    duration_s: float


class TakenLease(LeaseState):
    """A lease with its token, for its holder alone."""

    token: str


class Command(BaseModel):
    """A command and what became of it."""

    key: str
    name: str
    state: Literal["waiting", "running", "done", "failed"]
    share: float
    at: str
    text: str = ""
    stop: str = ""
    """Name of the Stop that ended a motion; FINISHED where it came to its own end."""
    run: str = ""
    backlash: Backlash | None = None
    error: Failure | None = None


class Recording(BaseModel):
    """What goes to the disk now."""

    run: str
    trigger: str
    """arm | request | always; empty where only the flight recorder keeps the last seconds."""
    rows_count: int
    trouble: str
    """What the disk refuses; empty where all is well."""
    next_name: str = ""
    """Name of the run that was asked for and is about to begin, or begins when the motion's ends; empty where none."""
    waits_for: str = ""
    """The event that is waited for, and how often still; empty where none is."""


class Health(BaseModel):
    """How the loop keeps time."""

    cycles_count: int
    missed_cycles_count: int
    lost_samples_count: int
    discarded_bytes_count: int
    rate_hz: float
    lateness_p99_s: float | None
    lateness_max_s: float | None


class Temperature(BaseModel):
    """What a drive said of its temperature last."""

    degc: float
    warning: bool
    """Whether the profile's warning is passed; it is taken back 2 K below."""
    age_s: float


class Positions(BaseModel):
    """Where the stage is; from the homed zero once it is homed."""

    end_position_m: float | None
    macro_position_m: float | None
    macro_encoder_m: float | None
    relative_position_m: float | None
    setpoint_position_m: float | None
    error_m: float | None
    sample_age_s: float | None
    """Of the interferometer's newest sample; what it measures is null where that is older than 0.1 s."""


class Limits(BaseModel):
    """What this stage may be asked for."""

    travel_m: tuple[float, float]
    velocity_m_per_s: float
    jog_velocity_m_per_s: float
    has_micro: bool
    rate_hz: float


class Status(BaseModel):
    """Everything that a client needs to know at a glance."""

    state: str
    since: str
    banner: str
    """Which world this is; to be shown by every client."""
    backend: str
    backend_description: str
    profile: str
    profile_path: str
    waiting_for: str
    homed: bool
    phase: str
    limits: Limits | None
    positions: Positions
    health: Health
    temperatures: dict[str, Temperature] = {}
    """By axis, macro and micro; an axis whose drive says none, or whose profile names none, is not here."""
    backlash: Backlash | None
    wear: Wear | None
    fault: Fault | None
    lease: LeaseState | None
    command: Command | None
    recording: Recording | None
    remarks: list[str]
    version: str
    uptime_s: float


class LogEntry(BaseModel):
    """One line of the service's log."""

    number: int
    at: str
    event: str
    text: str
    fields: dict[str, Any]


class RunEntry(BaseModel):
    """One recorded run."""

    name: str
    state: str
    rows_count: int
    duration_s: float
    profile: str
    stop: str
    text: str
