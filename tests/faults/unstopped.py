"""Judges of a motion that no fault stopped, or none has stopped yet: it must be the one that was asked for.

That is a plan's, so its laws are: no faster than it was asked for; never further from its own reference, as recorded,
than the profile's error limit, at which the guard stops it; a stage that holds stands. A move ends at its target. A jog
whose operator says nothing more comes to rest within its hold, what plans look ahead, and a plan's own way to stop.
"""

from typing import Any

import numpy as np

from tests.faults.mechanics import REST_M_PER_S, SETTLING_M, STANDSTILL_M, Mechanics
from tests.faults.scene import Facts
from tests.faults.witness import ENABLED, STOPPING

AHEAD_S = 0.02 + 0.15  # a jog is looked at so often, and is planned anew from so far ahead
NOTICED_S = 0.003  # an error beyond its limit: the line on its way, the cycle that reads it, one more
GAIN_SHARE = 1.02
_FOLLOWS = (4, 5)  # run_phase: a reference is followed
_KEPT = ("at rest", "accelerating", "constant speed", "decelerating", "jogging", "moving", "identifying")
"""Phases that have one reference from their begin to their end; a homing finds its zero only then."""


def astray(
    facts: Facts,
    columns: dict[str, np.ndarray],
    until_t_ns: int,
    of: Mechanics,
    blind_s: float = 0.0,
    kicked_m_per_s: float = 0.0,
) -> list[str]:
    """Return where the true motion, from the fault until then, was not the one that was asked for.

    For `blind_s` nobody sees the stage: the drive keeps its force, while magnets and cables change theirs.
    `kicked_m_per_s`: what frames may have given the macro whose force was not the law's; of one it is allowed always.
    """
    seen = facts.seen
    at, end = (int(np.searchsorted(seen["t_ns"], t_ns)) for t_ns in (facts.fault_t_ns, until_t_ns))
    found = []
    fastest = float(np.abs(seen["macro_velocity_m_per_s"][at:end]).max(initial=0.0))
    allowed = GAIN_SHARE * facts.planned_m_per_s + max(of.kick_m_per_s, kicked_m_per_s) + of.drift_m_per_s2 * blind_s
    if facts.planned_m_per_s > 0.0 and not fastest <= allowed:
        found.append(f"macro was {fastest:.3f} m/s fast, asked for were {facts.planned_m_per_s:.3f}")
    if facts.phase not in _KEPT:
        return found
    t_ns, setpoint_m = columns["t_ns"], columns["setpoint_position_m"]
    follows = np.isin(columns["run_phase"], _FOLLOWS) & (t_ns <= until_t_ns)
    begins, rows = follows & (t_ns >= facts.begun_t_ns), follows & (t_ns >= facts.fault_t_ns)
    if begins.any():
        true_m = np.interp(t_ns, seen["t_ns"], seen["end_position_m"])
        error_m = true_m - setpoint_m
        error_m = np.abs(error_m[rows] - error_m[np.flatnonzero(begins)[0]])  # the reference has its own zero
        end_m_per_s = float(np.abs(seen["end_velocity_m_per_s"][at:end]).max(initial=0.0))
        limit_m = of.error_limit_m + max(facts.planned_m_per_s, end_m_per_s) * (NOTICED_S + facts.late_s)
        limit_m += 0.5 * of.drift_m_per_s2 * blind_s**2
        worst_m = float(error_m.max(initial=0.0))
        if not worst_m <= limit_m:
            found.append(f"end was {worst_m * 1e6:.0f} um from its reference, allowed {limit_m * 1e6:.0f}")
    return found


def not_ended(facts: Facts, columns: dict[str, np.ndarray], of: Mechanics) -> list[str]:
    """Return where a motion that nothing stopped did not end where and when it should."""
    seen, t_ns = facts.seen, facts.seen["t_ns"]
    end = int(np.searchsorted(t_ns, facts.judged_until_t_ns))
    found = []
    if facts.target_m is not None and facts.phase != "stopping":
        begun = np.flatnonzero(columns["t_ns"] >= facts.begun_t_ns)
        begin = int(np.searchsorted(t_ns, facts.begun_t_ns))
        if not begun.size:
            return ["nothing was recorded of the move"]
        zero_m = float(seen["end_position_m"][begin] - columns["setpoint_position_m"][begun[0]])
        off_m = abs(float(seen["end_position_m"][end - 1]) - zero_m - facts.target_m)
        if not off_m <= STANDSTILL_M:
            found.append(f"the move ended {off_m * 1e6:.0f} um from its target")
    if facts.phase == "jogging" and facts.said_t_ns:
        way_m, allowed_m = silent_way_m(facts, facts.said_t_ns, end, of)
        if not way_m <= allowed_m:
            found.append(
                f"macro went {way_m * 1e3:.3f} mm behind the last word of its jog, bound {allowed_m * 1e3:.3f}"
            )
    return found


def silent_way_m(facts: Facts, said_t_ns: int, end: int, of: Mechanics) -> tuple[float, float]:
    """Return how far a jogging macro went after its operator's last word, and how far it may."""
    position, speed = facts.seen["macro_position_m"], facts.planned_m_per_s
    at = int(np.searchsorted(facts.seen["t_ns"], said_t_ns))
    way_m = float(np.abs(position[at:end] - position[at]).max(initial=0.0))
    ramped_m = 0.5 * speed * (speed / of.plan_m_per_s2 + of.plan_m_per_s2 / of.plan_m_per_s3)
    return way_m, speed * (facts.jog_hold_s + AHEAD_S + facts.late_s) + ramped_m + STANDSTILL_M


def moved_at_rest(seen: dict[str, Any], from_t_ns: int, until_t_ns: int) -> list[str]:
    """Return how a stage that nobody asks for anything moved with power, or got it, or had not come to rest."""
    at, end = (int(np.searchsorted(seen["t_ns"], t_ns)) for t_ns in (from_t_ns, until_t_ns))
    if end - at < 2:
        return []
    states, position = seen["states"][at:end], seen["macro_position_m"][at:end]
    found = []
    for axis, name in enumerate(("macro", "micro")):
        given = np.diff((states[:, axis] == ENABLED).astype(int)) > 0
        if given.any():
            found.append(f"{name} was enabled, and nobody had asked for power")
    holds = np.isin(states[:, 0], (ENABLED, *STOPPING))
    until = int(np.flatnonzero(~holds)[0]) if not holds.all() else holds.size
    moved_m = float(np.abs(position[:until] - position[0]).max(initial=0.0)) if until else 0.0
    if not moved_m <= STANDSTILL_M:
        found.append(f"macro moved {moved_m * 1e6:.0f} um with power, and nobody had asked for it")
    return found


def not_at_rest(facts: Facts, holds_m: float, kicked_m: float = 0.0) -> list[str]:
    """Return how a stage moved that holds, or has come to rest with power.

    `holds_m`: how far its macro may; that of an end which its own motor can't hold goes with it, as far as that may.
    `kicked_m`: how far frames may have thrown it whose force was not the law's.
    """
    seen = facts.seen
    at, end = (int(np.searchsorted(seen["t_ns"], t_ns)) for t_ns in (facts.fault_t_ns, facts.judged_until_t_ns))
    position, powered = seen["macro_position_m"][at:end], seen["states"][at:end, 0] == ENABLED
    found = []
    if facts.phase in ("at rest", "arming") and powered.any():
        first = int(np.flatnonzero(powered)[0])
        moved_m = float(np.abs(position[first:][powered[first:]] - position[first]).max())
        limit_m = holds_m if facts.phase == "at rest" else SETTLING_M
        if not moved_m <= limit_m + kicked_m:
            found.append(f"macro moved {moved_m * 1e6:.0f} um while it held")
    speed = abs(float(seen["macro_velocity_m_per_s"][end - 1]))
    if powered.size and powered[-1] and not speed < REST_M_PER_S:
        found.append(f"macro had not come to rest: {speed:.3f} m/s")
    return found
