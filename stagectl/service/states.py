"""What the service is doing: one table of states and events. Pure; knows no stage, no client and no clock.

Drawn in docs/service.md; a test holds the drawing to this table.
"""

from enum import StrEnum

from stagectl.errors import RequestError


class State(StrEnum):
    """What the stage may be doing now."""

    OFF = "off"  # no drives, no servo: hardware is not there yet, or the service begins or ends
    IDLE = "idle"  # connected, drives without power
    ARMING = "arming"  # the drives are being enabled
    ARMED = "armed"  # power on, the stage holds
    MOVING = "moving"  # a move, a jog or a homing
    IDENTIFYING = "identifying"  # the micro sweeps over both edges
    STOPPING = "stopping"  # towards rest, then without power
    FAULT = "fault"  # it stopped by itself; somebody must acknowledge why


class Event(StrEnum):
    """What leads from one state to another: what a client asks, and what the stage did."""

    ARM = "arm"
    HOME = "home"
    MOVE = "move"
    IDENTIFY = "identify"
    STOP = "stop"
    ACKNOWLEDGE = "acknowledge"
    CONNECTED = "connected"
    HELD = "held"  # what was under way is done, and the stage holds
    RESTED = "rested"  # it stands, without power
    TRIPPED = "tripped"  # guard, drive, link, lease or disk ended it
    LET_GO = "let_go"  # the world was closed: at the end, for another one, or since the servo is gone


TRANSITIONS: dict[tuple[State, Event], State] = {
    (State.OFF, Event.CONNECTED): State.IDLE,
    (State.OFF, Event.TRIPPED): State.FAULT,
    (State.IDLE, Event.ARM): State.ARMING,
    (State.IDLE, Event.HOME): State.MOVING,
    (State.IDLE, Event.TRIPPED): State.FAULT,
    (State.IDLE, Event.LET_GO): State.OFF,
    (State.ARMING, Event.HELD): State.ARMED,
    (State.ARMING, Event.STOP): State.STOPPING,
    (State.ARMING, Event.TRIPPED): State.FAULT,
    (State.ARMED, Event.HOME): State.MOVING,
    (State.ARMED, Event.MOVE): State.MOVING,
    (State.ARMED, Event.IDENTIFY): State.IDENTIFYING,
    (State.ARMED, Event.STOP): State.STOPPING,
    (State.ARMED, Event.TRIPPED): State.FAULT,
    (State.MOVING, Event.HELD): State.ARMED,
    (State.MOVING, Event.RESTED): State.IDLE,
    (State.MOVING, Event.STOP): State.STOPPING,
    (State.MOVING, Event.TRIPPED): State.FAULT,
    (State.IDENTIFYING, Event.HELD): State.ARMED,
    (State.IDENTIFYING, Event.STOP): State.STOPPING,
    (State.IDENTIFYING, Event.TRIPPED): State.FAULT,
    (State.STOPPING, Event.RESTED): State.IDLE,
    (State.STOPPING, Event.TRIPPED): State.FAULT,
    (State.FAULT, Event.ACKNOWLEDGE): State.IDLE,
    (State.FAULT, Event.TRIPPED): State.FAULT,
    (State.FAULT, Event.LET_GO): State.OFF,
}
"""Every transition that there is."""

POWERED = frozenset({State.ARMING, State.ARMED, State.MOVING, State.IDENTIFYING, State.STOPPING})
"""States in which a drive may have power for motion: they need a lease, or lead to rest."""

_REMEDY = {
    State.OFF: "the stage is not connected; `stagectl status` says what it waits for",
    State.IDLE: "the drives have no power; arm first",
    State.ARMING: "wait until it is armed, or stop it",
    State.ARMED: "",
    State.MOVING: "wait for its end, or stop it",
    State.IDENTIFYING: "wait for its end, or stop it",
    State.STOPPING: "wait until it stands",
    State.FAULT: "look at the fault, clear its cause and acknowledge it",
}


def after(state: State, event: Event, asked: str = "") -> State:
    """Return the state that an event leads to; RequestError, naming what was `asked` for, where there is none."""
    found = TRANSITIONS.get((state, event))
    if found is None:
        possible = ", ".join(sorted(one for at, one in TRANSITIONS if at is state))
        remedy = _REMEDY[state] or f"possible are {possible}"
        raise RequestError(f"{asked or event} is not possible in state {state}: {remedy}")
    return found


def diagram() -> str:
    """Draw the table as a Mermaid state diagram, one line a transition."""
    lines = [f"    {begin} --> {end}: {event}" for (begin, event), end in TRANSITIONS.items()]
    return "\n".join(["stateDiagram-v2", "    [*] --> off", *lines])
