"""Judges of a fault run: the rig's own log and the recorded files, by laws of motion alone. No code of the controller.

The macro may go, from the fault on,

    v t + a t^2 / 2 + (v + a t)^2 / (2 ramp)

with v and a true at that instant and t the detection time and one cycle, with real processes also what the host held
servo or rig up. Until the fault is noticed the planned motion goes on, or the drive keeps the force that balanced
magnets and cables at one place: a is the greatest gain of speed that was truly seen within t, and never more than a
plan may reach in it, or those forces may change by; those of a micro that loses its power change as well.

A macro without power coasts: it has the way to its end stops instead, and may nowhere be faster than the guard lets it
be where its power went, and what magnets and cables give it on the way. A micro without power has its winding shorted:
from where its power went on it is computed how far such a one goes beside this macro, and it may go no further. A drive
that hears nothing is stopped by its own watch, and detection is what that takes; one whose commands come late does what
it was told before, which is judged as a motion that nothing has stopped yet.

Rest is |v| < 1 mm/s, also for an axis that loses its power: one that is let go of faster has not come to rest, and its
way goes on counting, unless it stood a cycle before (a drive that failed took its power as it stood). From rest on a
drive holds on its encoder. Its loop needs 0.2 s until it stands; that way is part of the travel, and no more than 0.2
mm, so no instant is judged by neither bar. An obstacle pushes the macro back, against a drive that holds; when it is
gone the drive comes back to where its ramp ended, and beyond: a fifth of that way, which is the overshoot of its
position loop, and by what its integral was wound up to meanwhile. That is at most the rest of its greatest force, F / m
- w^2 e at e from its goal, and throws it F / (m w^2) - e beyond. All that is a spring, no command: only forward travel
is judged until the obstacle is gone and the loop stands, by the same bound; from there on the macro must stand as after
any fault. A drive whose encoder jumps goes with it, there and back, with that overshoot: it holds on nothing else. By
how much more such an encoder misleads its ramp is no excuse. An end that swings, as its motor is too weak to hold it,
strikes its stops as long as that lasts: each time an elastic blow of it gives the macro a speed, which over the
bandwidth of the drive's loop is how far it may go on top.

A motion that no fault stops, or none has stopped yet, is judged in `unstopped.py`; a stop that the operator asked for
by the same bound with the law's ramp. Where a homing had let go of the macro before anything was noticed, it rolls:
then it must have been at rest as it was let go of. Behind the acknowledgement nothing may move or get power until it
is asked for.
"""

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tests.faults.kinds import CYCLE_S, MACRO, MICRO, SILENCE_S, Drawn
from tests.faults.limp import shorted_way_m
from tests.faults.mechanics import REST_M_PER_S, SETTLING_M, STANDSTILL_M, Mechanics, mechanics_of
from tests.faults.scene import PROFILE, Facts
from tests.faults.unstopped import astray, moved_at_rest, not_at_rest, not_ended, silent_way_m
from tests.faults.witness import ENABLED, STOPPING

REST_SAMPLES = 20
SETTLED_SAMPLES = 200  # what a drive's position loop needs until it stands; part of the travel
RELEASED_SAMPLES = 500  # the same, where an obstacle had pushed it millimetres away: six times the integral's 80 ms
OVERSHOOT = 0.2  # of the way back
SLOPE_SAMPLES = 10  # over which an acceleration is taken
BEGUN_CYCLES = 2
ASKED_S = 0.023  # from an operator's word to the servo: the supervisor looks every 20 ms, and three cycles
STOPS_GIVE_M = 8e-3
SPEED_SHARE = 1.02  # of what the guard allows: its own speed is filtered
LIMP_SHARE, LIMP_M = (
    1.03,
    10e-6,
)  # of the computed way; in motion it is met to 0.1 %, a winding left open goes 16 % beyond
_POWERED = (ENABLED, *STOPPING)
AT_WILL = ("idle", "arming", "stopping")  # phases in which a fault may go by
_LAW_STOPS, _ENDED = 5, (5, 6, 7, 8)  # run_phase

TRAVEL, STANDSTILL = "travel beyond the bound", "followed a command after standstill"
BEGUN, LOST, UNREADABLE = "stop begun late", "recorded cycles lost", "run unreadable"
STRANGER, BACK, COURSE = "unauthorised command accepted", "not armed again", "went on, or stopped without need"
STRUCK, LIMP = "macro without power too fast", "micro without power too far"
NONSENSE = "nonsense taken for a profile, or refused unclearly"
BARS = (TRAVEL, STRUCK, LIMP, STANDSTILL, BEGUN, LOST, UNREADABLE, STRANGER, BACK, COURSE, NONSENSE)
"""What a run can miss."""
GENTLE = (
    "and 20 um; a: the greatest gain of speed until it was noticed, at most a plan's; behind an obstacle forward only, "
    "and back by its drive's overshoot; of an encoder that jumps 1.2 times that; of an end that swings what its blow "
    "gives; of a deaf drive from its own watch on, of one that is told late from there on; beside a limp micro "
    "a by 0.17 m/s^2 more; a macro at rest that frames told another force what that throws it by"
)
"""Where the bound differs from v t + a t^2 / 2 + (v + a t)^2 / (2 ramp) with what was true at the fault."""


@dataclass(frozen=True)
class Verdict:
    """What the judges found."""

    violations: tuple[tuple[str, str], ...]
    """Of `BARS`, with what was seen."""
    stopped: bool
    travel_m: float
    bound_m: float
    begun_cycles: float | None
    """None where nothing was noticed that a drive with power had to be stopped for."""
    cycles_lost: int
    cycles_owed: int
    drift_m: float  # of an axis without power, after standstill; not judged


class Record:
    """Rows of all runs, each once, as the files have them."""

    def __init__(self, folders: list[Path]) -> None:
        """Read every file that there is; a file that can't be read is named in `unreadable`."""
        self.unreadable: list[str] = []
        pieces = []
        for folder in folders:
            try:
                pieces.append(_columns(folder / "samples.arrow"))
            except (OSError, pa.ArrowException) as error:
                self.unreadable.append(f"{folder.name}: {error}")
        joined = {name: np.concatenate([piece[name] for piece in pieces]) for name in _WANTED} if pieces else {}
        if joined:
            _, first = np.unique(joined["t_ns"], return_index=True)
            joined = {name: values[first] for name, values in joined.items()}
        self.columns: dict[str, np.ndarray] = joined or {name: np.zeros(0, np.int64) for name in _WANTED}

    def noticed_t_ns(self, fault_t_ns: int) -> int | None:
        """Return when the record first says that a stop was under way, after the fault."""
        t_ns, phase, stop = (self.columns[name] for name in ("t_ns", "run_phase", "stop"))
        after = np.flatnonzero(t_ns >= fault_t_ns)
        if not after.size:
            return None
        before = int(phase[max(after[0] - 1, 0)])
        found = after[(stop[after] > 0) | (np.isin(phase[after], _ENDED) & (phase[after] != before))]
        return int(t_ns[found[0]]) if found.size else None


_WANTED = ("t_ns", "run_phase", "stop", "setpoint_position_m", "setpoint_velocity_m_per_s")


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Read the batches of an Arrow stream that are whole."""
    batches = []
    with pa.OSFile(str(path)) as file, pa.ipc.open_stream(file) as reader:
        schema = reader.schema
        with contextlib.suppress(pa.ArrowInvalid):  # the last batch of a run under way
            while True:
                try:
                    batches.append(reader.read_next_batch().select(list(_WANTED)))
                except StopIteration:
                    break
    table = pa.Table.from_batches(batches, pa.schema([schema.field(name) for name in _WANTED]))
    return {name: table.column(name).to_numpy() for name in _WANTED}


def judge(drawn: Drawn, facts: Facts, record: Record, of: Mechanics | None = None) -> Verdict:
    """Hold one run against every bar; `of`: the stage, the campaign's where None."""
    of = of or mechanics_of(PROFILE)
    seen = facts.seen
    t_ns, velocity, position = seen["t_ns"], seen["macro_velocity_m_per_s"], seen["macro_position_m"]
    noticed = record.noticed_t_ns(facts.fault_t_ns)
    noticed = noticed if noticed is not None and noticed < facts.judged_until_t_ns else None
    heard = None if noticed is None else noticed + round(1e9 * drawn.told_late_s)  # by the macro's drive
    stopped = bool(facts.fault_kind) or noticed is not None
    found: list[tuple[str, str]] = []
    if not facts.struck:
        found.append((COURSE, "the fault never struck: what there is says nothing of it"))
    if drawn.must_stop and not facts.fault_kind and facts.phase not in AT_WILL and not _drive_homes(drawn, facts):
        found.append((COURSE, "it went on"))
    if not drawn.may_stop and facts.fault_kind:
        found.append((COURSE, f"stopped by {facts.fault_kind}: {facts.fault_text}"))
    travel_m = bound_m = drift_m = 0.0
    begun: float | None = None
    end = rests = int(np.searchsorted(t_ns, facts.judged_until_t_ns))
    if not facts.fault_kind and facts.phase in ("stopping", "idle"):  # a homing takes power away and gives it again
        at = int(np.searchsorted(t_ns, facts.fault_t_ns))
        found += [(STANDSTILL, text) for text in _enabled_again(seen, at, end)]
    blind_s = drawn.lasts_s if drawn.open_loop and not np.isfinite(drawn.detection_s) else 0.0
    if not facts.fault_kind:
        found += _unstopped(drawn, facts, record, of, blind_s)
    elif heard is not None and not np.isfinite(drawn.detection_s):
        found += [(TRAVEL, text) for text in astray(facts, record.columns, heard, of, blind_s)]
    if drawn.silent and facts.phase == "jogging":
        way_m, silent_m = silent_way_m(facts, facts.fault_t_ns, end, of)
        if not way_m <= silent_m:
            found.append((TRAVEL, f"nobody held its key: macro went {way_m * 1e3:.3f} mm, bound {silent_m * 1e3:.3f}"))
    for from_t_ns, until_t_ns in facts.unasked:
        found += [(STANDSTILL, text) for text in moved_at_rest(seen, from_t_ns, until_t_ns)]
    counts_from, detection_s = facts.fault_t_ns, drawn.detection_s
    if not np.isfinite(detection_s):
        counts_from, detection_s = heard or facts.fault_t_ns, CYCLE_S
    at = int(np.searchsorted(t_ns, counts_from))
    asked_at = int(np.searchsorted(t_ns, _asked_until_t_ns(drawn, facts, counts_from, noticed)))
    dark = MACRO in drawn.without_power
    if facts.fault_kind and not _had_power(seen, facts.fault_t_ns if dark else counts_from, heard, end):
        found += [(STANDSTILL, text) for text in _enabled_again(seen, asked_at, end)]
        found += _let_go(seen, int(np.searchsorted(t_ns, facts.fault_t_ns)), at)
    elif facts.fault_kind:
        rest = _rest(seen, at, end, noticed)
        stands, rests = _stands(seen, rest, end), end if rest is None else rest
        shifted_m = (1.0 + OVERSHOOT) * drawn.encoder_m
        back_m = shifted_m
        free = min(int(np.searchsorted(t_ns, facts.fault_t_ns + round(1e9 * drawn.lasts_s))), end)
        struck_m = 0.0
        if drawn.swings:
            stands = min(max(stands, free + SETTLED_SAMPLES), _power_ends(seen, rest, end))
            relative = seen["end_velocity_m_per_s"][at:stands] - velocity[at:stands]
            struck_m = of.struck_m(float(np.abs(relative).max(initial=0.0)))
        if drawn.obstacle_m is not None:
            stands = min(max(stands, free + RELEASED_SAMPLES), _power_ends(seen, rest, end))
            away_m = (position[at:stands] - position[at]) * _goes_to(facts, at, drawn.obstacle_m)
            pushed_m = abs(float(position[stands - 1] - position[free]))
            back_m = OVERSHOOT * pushed_m + max(0.0, of.drive_gives_m - pushed_m)
        else:
            away_m = np.abs(position[at:stands] - position[at])
        travel_m = float(away_m.max(initial=0.0))
        if dark:
            bound_m = _way_to_stops_m(velocity, position, at, stands, of)
            found += _too_fast(seen, at, stands, of)
        else:
            limp = MICRO in drawn.without_power
            t_s = detection_s + facts.late_s
            bound_m = back_m + _bound_m(t_ns, velocity, at, t_s, of, drawn.open_loop, limp)
        if MICRO in drawn.without_power:
            gone = np.flatnonzero(~np.isin(seen["states"][at:stands, 1], _POWERED))
            found += _too_far(seen, at + (int(gone[0]) if gone.size else 0), stands, of)
        if not travel_m <= bound_m + struck_m + STANDSTILL_M:
            found.append((TRAVEL, f"macro went {travel_m * 1e3:.3f} mm, bound {bound_m * 1e3:.3f} mm"))
        if rest is None and not dark:
            found.append((STANDSTILL, "it never stood still"))
        found += [(STANDSTILL, text) for text in _enabled_again(seen, asked_at, end)]
        held_m, drift_m = _moved_after(seen, stands, end)
        if rest is not None and drawn.obstacle_m is None:
            settled_m = float(np.abs(position[rest:stands] - position[rest]).max(initial=0.0))
            if settled_m > SETTLING_M + shifted_m + struck_m:
                found.append((STANDSTILL, f"macro moved {settled_m * 1e6:.0f} um while it settled"))
        if held_m > STANDSTILL_M + shifted_m:
            found.append((STANDSTILL, f"macro moved {held_m * 1e6:.0f} um after standstill, with power"))
        if heard is not None and not dark:
            heard = heard if MACRO not in drawn.deaf else max(heard, facts.fault_t_ns + round(1e9 * SILENCE_S))
            begun = _begun_cycles(facts, record, heard)
            if not begun <= BEGUN_CYCLES:
                found.append((BEGUN, f"stop begun {begun:.0f} cycles after detection"))
    lost, owed = _cycles_lost(facts, record, rests)
    if lost:
        found.append((LOST, f"{lost} cycles on the bus have no row"))
    found += [(UNREADABLE, text) for text in record.unreadable]
    found += [(STRANGER, name) for name in facts.accepted]
    if drawn.nonsense is not None:
        found += [(NONSENSE, text) for text in drawn.nonsense.missed(facts.reread)]
        if facts.opened_anew:
            found.append((NONSENSE, "the stage was opened anew"))
    if facts.trouble:
        found.append((BACK, facts.trouble))
    return Verdict(tuple(found), stopped, travel_m, bound_m, begun, lost, owed, drift_m)


def _drive_homes(drawn: Drawn, facts: Facts) -> bool:
    """Tell whether the macro's drive homed by itself while the lasers failed, or the micro's drive was told nothing.

    The micro gets power when a law does.
    """
    if not (drawn.by_lasers or drawn.deaf == (MICRO,)) or facts.phase != "homing":
        return False
    failed = facts.fault_t_ns, facts.fault_t_ns + round(1e9 * (drawn.lasts_s + drawn.detection_s))
    at, end = (int(np.searchsorted(facts.seen["t_ns"], t_ns)) for t_ns in failed)
    return not (facts.seen["states"][at : end + 1, 1] == ENABLED).any()


def _unstopped(drawn: Drawn, facts: Facts, record: Record, of: Mechanics, blind_s: float) -> list[tuple[str, str]]:
    """Judge a run in which nothing stopped the motion but its own end, or the operator."""
    holds_m = of.error_limit_m if drawn.swings else STANDSTILL_M
    kicked_m_per_s, kicked_m = of.kicked(drawn.kicked_words, drawn.kicked_s)
    found = [(STANDSTILL, text) for text in not_at_rest(facts, holds_m, kicked_m)]
    until_t_ns = facts.judged_until_t_ns
    found += [(TRAVEL, text) for text in astray(facts, record.columns, until_t_ns, of, blind_s, kicked_m_per_s)]
    found += [(TRAVEL, text) for text in not_ended(facts, record.columns, of)]
    if facts.stop_asked_t_ns:
        seen = facts.seen
        at, end = (int(np.searchsorted(seen["t_ns"], t)) for t in (facts.stop_asked_t_ns, facts.judged_until_t_ns))
        off = np.flatnonzero(~np.isin(seen["states"][at:end, 0], _POWERED))
        # At rest its power is taken, and it may roll, or be thrown back by what it pressed against.
        end = at + max(int(off[0]), 1) if off.size else end
        position, speed = seen["macro_position_m"][at:end], np.abs(seen["macro_velocity_m_per_s"][at:end])
        way_m = float(np.abs(position - position[0]).max(initial=0.0))
        by_law = replace(of, ramp_m_per_s2=of.law_ramp_m_per_s2)
        bound_m = _bound_m(seen["t_ns"], seen["macro_velocity_m_per_s"], at, ASKED_S + facts.late_s, by_law)
        if not way_m <= bound_m + STANDSTILL_M:
            found.append((TRAVEL, f"macro went {way_m * 1e3:.3f} mm behind a stop, bound {bound_m * 1e3:.3f} mm"))
        if not speed[-1] < REST_M_PER_S:
            found.append((STANDSTILL, f"macro was let go of, or went on, at {speed[-1]:.3f} m/s behind a stop"))
    return found


def _bound_m(
    t_ns: np.ndarray,
    velocity: np.ndarray,
    at: int,
    detection_s: float,
    of: Mechanics,
    open_loop: bool = False,
    limp: bool = False,
) -> float:
    """Return how far the macro may go from sample `at` on; `limp`: beside a micro that has just lost its power."""
    before = max(at - SLOPE_SAMPLES, 0)
    span_s = 1e-9 * float(t_ns[at] - t_ns[before]) or CYCLE_S
    a = abs(float(velocity[at] - velocity[before])) / span_s
    t = detection_s + CYCLE_S
    until = max(int(np.searchsorted(t_ns, t_ns[at] + round(1e9 * t))), at + 1)
    speed = np.abs(velocity[before:until])
    gained = float(((speed[SLOPE_SAMPLES:] - speed[:-SLOPE_SAMPLES]) / (SLOPE_SAMPLES * CYCLE_S)).max(initial=0.0))
    planned = min(a + of.plan_m_per_s3 * t, of.plan_m_per_s2)
    most = a + of.drift_m_per_s2 if open_loop else planned + limp * of.drift_m_per_s2
    a = max(a, min(most, gained))
    v = abs(float(velocity[at]))
    return v * t + 0.5 * a * t * t + (v + a * t) ** 2 / (2.0 * of.ramp_m_per_s2)


def _goes_to(facts: Facts, at: int, obstacle_m: float) -> float:
    """Return the direction that is forward at sample `at`: where it goes, or to the obstacle that it has struck.

    What had struck one was on its way back when the stop began.
    """
    begin = int(np.searchsorted(facts.seen["t_ns"], facts.fault_t_ns))
    away_m = facts.seen["macro_position_m"][begin : at + 1] - facts.seen["macro_position_m"][begin]
    furthest_m = float(away_m[np.argmax(np.abs(away_m))])
    struck = abs(furthest_m) >= obstacle_m
    return float(np.sign(furthest_m if struck else facts.seen["macro_velocity_m_per_s"][at]))


def _way_to_stops_m(velocity: np.ndarray, position: np.ndarray, at: int, end: int, of: Mechanics) -> float:
    """Return the way of an axis without power: to the stop that it coasts to; thrown back there, to the other."""
    low_m, high_m = of.machine.macro.travel_m
    down_m, up_m = float(position[at] - low_m), float(high_m - position[at])
    goes_up = bool(velocity[at] > 0.0)
    struck = bool((position[at:end] >= high_m).any() if goes_up else (position[at:end] <= low_m).any())
    return (max(down_m, up_m) if struck else up_m if goes_up else down_m) + STOPS_GIVE_M


def _too_fast(seen: dict[str, Any], at: int, end: int, of: Mechanics) -> list[tuple[str, str]]:
    """Return where a macro without power was faster than the guard lets it be, and what it rolls down to."""
    allowed = SPEED_SHARE * of.coasting_m_per_s(seen["macro_position_m"][at], seen["macro_velocity_m_per_s"][at])
    fastest = float(np.abs(seen["macro_velocity_m_per_s"][at : max(end, at + 1)]).max())
    return [] if fastest <= allowed else [(STRUCK, f"{fastest:.3f} m/s, the guard allows {allowed:.3f}")]


def _too_far(seen: dict[str, Any], at: int, end: int, of: Mechanics) -> list[tuple[str, str]]:
    """Return where a micro without power went further, relative to the macro, than its shorted winding lets it."""
    allowed_m = LIMP_SHARE * shorted_way_m(of.machine, seen, at, end) + LIMP_M
    went_m = float(np.abs(seen["end_position_m"][at:end] - seen["macro_position_m"][at:end]).max(initial=0.0))
    return [] if went_m <= allowed_m else [(LIMP, f"{went_m * 1e6:.0f} um, computed {allowed_m * 1e6:.0f}")]


def _rest(seen: dict[str, Any], at: int, end: int, noticed_t_ns: int | None) -> int | None:
    """Return the sample at which the macro had come to rest, or was let go of at rest; None where it did not.

    Its drive takes the power from what stands in one cycle, and in the next the motor no longer holds it.
    """
    states, velocity = seen["states"][at:end, 0], seen["macro_velocity_m_per_s"][at:end]
    starts = np.flatnonzero(states != ENABLED)[:1].tolist()
    if noticed_t_ns is not None:
        starts.append(max(0, int(np.searchsorted(seen["t_ns"], noticed_t_ns)) - at))
    if not starts:  # the rig was gone before anything was done: all that was seen of it must be a standstill
        stood = velocity.size >= REST_SAMPLES and bool((np.abs(velocity) < REST_M_PER_S).all())
        return at if stood else None
    first = min(starts)
    slow, powered = np.abs(velocity[first:]) < REST_M_PER_S, np.isin(states[first:], _POWERED)
    slow_count = np.concatenate([[0], np.cumsum(slow)])
    found = np.flatnonzero(slow_count[REST_SAMPLES:] - slow_count[:-REST_SAMPLES] == REST_SAMPLES)[:1].tolist()
    stood = np.concatenate([[False], powered[:-1] & slow[:-1]])
    found += np.flatnonzero(~powered & (slow | stood))[:1].tolist()
    return at + first + min(found) if found else None


def _had_power(seen: dict[str, Any], fault_t_ns: int, noticed_t_ns: int | None, end: int) -> bool:
    """Tell whether the macro had power at the fault, or got it until that was noticed; without it is free to roll."""
    at = max(int(np.searchsorted(seen["t_ns"], fault_t_ns)) - 1, 0)
    until = end if noticed_t_ns is None else int(np.searchsorted(seen["t_ns"], noticed_t_ns))
    return bool(np.isin(seen["states"][at : until + 1, 0], _POWERED).any())


def _asked_until_t_ns(drawn: Drawn, facts: Facts, counts_from: int, noticed_t_ns: int | None) -> int:
    """Return until when power was asked for: by an arming or a homing until its fault is, or must be, noticed."""
    if facts.phase not in ("arming", "homing"):
        return counts_from
    until_t_ns = facts.judged_until_t_ns if noticed_t_ns is None else noticed_t_ns
    if drawn.must_stop and np.isfinite(drawn.detection_s):
        noticed_s = drawn.detection_s + facts.late_s + BEGUN_CYCLES * CYCLE_S
        until_t_ns = min(until_t_ns, counts_from + round(1e9 * noticed_s))
    return until_t_ns


def _let_go(seen: dict[str, Any], at: int, end: int) -> list[tuple[str, str]]:
    """Return where the macro lost its power while it moved."""
    powered, speed = np.isin(seen["states"][at:end, 0], _POWERED), np.abs(seen["macro_velocity_m_per_s"][at:end])
    fastest = float(speed[1:][powered[:-1] & ~powered[1:]].max(initial=0.0))
    return [] if fastest < REST_M_PER_S else [(STANDSTILL, f"macro was let go of at {fastest:.3f} m/s")]


def _enabled_again(seen: dict[str, Any], at: int, end: int) -> list[str]:
    found = []
    for axis, name in enumerate(("macro", "micro")):
        enabled = seen["states"][at:end, axis] == ENABLED
        off = np.flatnonzero(~enabled)
        if off.size and enabled[off[0] :].any():
            found.append(f"{name} was enabled again without an acknowledgement")
    return found


def _stands(seen: dict[str, Any], rest: int | None, end: int) -> int:
    """Return the sample from which on the macro must not move: its drive's loop has settled, or its power is gone."""
    return end if rest is None else min(rest + SETTLED_SAMPLES, _power_ends(seen, rest, end))


def _power_ends(seen: dict[str, Any], rest: int | None, end: int) -> int:
    """Return the sample behind the macro's rest at which its power is gone: from there on it may roll."""
    if rest is None:
        return end
    off = np.flatnonzero(~np.isin(seen["states"][rest:end, 0], _POWERED))
    return min(rest + int(off[0]) + 1, end) if off.size else end


def _moved_after(seen: dict[str, Any], stands: int, end: int) -> tuple[float, float]:
    """Return how far the macro moved with power after it stood, and how far without: that is a drift, not judged."""
    if stands >= end:
        return 0.0, 0.0
    powered = np.isin(seen["states"][stands:end, 0], _POWERED)
    moved_m = np.abs(seen["macro_position_m"][stands:end] - seen["macro_position_m"][stands])
    off = np.flatnonzero(~powered)
    held_until = int(off[0]) if off.size else moved_m.size
    return float(moved_m[:held_until].max(initial=0.0)), float(moved_m[~powered].max(initial=0.0))


def _begun_cycles(facts: Facts, record: Record, noticed_t_ns: int) -> float:
    """Return the cycles from the row that noticed to the drive that no longer follows, or the reference that slows.

    On a host that keeps no time they are those that it had: one a SYNC.
    """
    seen = facts.seen
    t_ns, phase, speed = (record.columns[name] for name in ("t_ns", "run_phase", "setpoint_velocity_m_per_s"))
    row = int(np.searchsorted(t_ns, noticed_t_ns))
    at, end = np.searchsorted(seen["t_ns"], (noticed_t_ns, facts.judged_until_t_ns))
    left = np.flatnonzero(seen["states"][at:end, 0] != ENABLED)
    begun_t_ns = [int(seen["t_ns"][at + left[0]])] if left.size else []
    if phase[row] == _LAW_STOPS:
        begin = abs(float(speed[max(row - 1, 0)]))
        slower = np.flatnonzero(np.abs(speed[row:]) < begin)
        if begin == 0.0:
            begun_t_ns.append(noticed_t_ns)
        elif slower.size:
            begun_t_ns.append(int(t_ns[row + slower[0]]))
    if not begun_t_ns:
        return float("inf")
    first_t_ns = min(begun_t_ns)
    cycles = np.ceil(1e-9 * float(first_t_ns - noticed_t_ns) / CYCLE_S)
    if facts.is_host_time:
        cycles = np.count_nonzero((facts.sync_t_ns > noticed_t_ns) & (facts.sync_t_ns <= first_t_ns))
    return max(0.0, float(cycles) - 1.0)  # a state is seen at the sample after it changed


def _cycles_lost(facts: Facts, record: Record, rests: int) -> tuple[int, int]:
    """Count SYNCs on the bus that no row stands for, and all, from the motion's begin to rest or the power's end.

    A cycle has one SYNC, behind its row's instant and before the next one's; a fault may hold it up beyond that. So a
    cycle is lost where rows lie further apart than a cycle and more than one SYNC lies between, and at both ends.
    """
    t_ns, seen_t_ns = record.columns["t_ns"], facts.seen["t_ns"]
    powered = np.flatnonzero(
        np.isin(facts.seen["states"], _POWERED).any(axis=1) & (seen_t_ns <= facts.judged_until_t_ns)
    )
    until_t_ns = facts.begun_t_ns
    if powered.size:
        until_t_ns = int(min(seen_t_ns[powered[-1]], seen_t_ns[min(rests, seen_t_ns.size - 1)]))
    rows = t_ns[(t_ns >= facts.begun_t_ns) & (t_ns <= facts.judged_until_t_ns)]
    sync = np.unique(facts.sync_t_ns)  # one that a fault doubled comes at one instant
    begun_t_ns = facts.begun_t_ns
    if facts.phase == "homing":  # it has no run before it has power
        first = np.flatnonzero(np.isin(facts.seen["states"], _POWERED).any(axis=1) & (seen_t_ns >= begun_t_ns))
        begun_t_ns = int(seen_t_ns[first[0]]) if first.size else until_t_ns
    owed = int(((sync > begun_t_ns) & (sync <= until_t_ns)).sum())
    if not rows.size:
        return owed, owed
    cycle_ns = round(1e9 * CYCLE_S)
    places = np.searchsorted(sync, rows)
    between = np.diff(places)
    inside = int((between[np.diff(rows) > 1.5 * cycle_ns] - 1).clip(min=0).sum())
    head = int(((sync > begun_t_ns) & (sync <= rows[0] - cycle_ns)).sum())
    tail = int(((sync > rows[-1] + cycle_ns) & (sync <= until_t_ns)).sum())
    return inside + head + tail, owed
