"""Faults with real processes: service, servo and rig, killed, stopped and lied to; judged by what the rig truly did.

Stage, phase of its work, moment and fault are drawn from the seed; how the processes then meet is the host's. That
host is no real-time host: what it held up the rig, or the servo, is added to the time of detection.
"""

import contextlib
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stagectl.errors import LinkError, RecordError, StagectlError
from stagectl.record import read_run
from tests.faults.draws import one_of
from tests.faults.house import IDENTIFY_S, LOOK_S, House
from tests.faults.judge import AT_WILL, BACK, COURSE, REST_M_PER_S, Record, Verdict, judge
from tests.faults.kinds import MACRO, MICRO
from tests.faults.mechanics import mechanics_of
from tests.faults.operator_program import JOG_HOLD_S
from tests.faults.real_kinds import KINDS, Real, client_hangs
from tests.faults.scene import TOP_M_PER_S, Facts
from tests.small_disk import small_disk

HICCUP_S = 0.02  # 20 cycles, and the drives say that SYNC is lost
WAKE_S = 5e-3  # of this host: a process that is asked wakes so much later
_STAGES = {"single-axis": (MACRO,), "oled-printer": (MACRO, MICRO)}
_PHASES = {  # for how long a fault may wait in each, and how often one is drawn against the others
    "jogging": (0.3, 3),
    "moving": (0.6, 3),
    "homing": (0.7, 3),  # then it has found its index, and a stage without micro is done
    "identifying": (0.9 * IDENTIFY_S, 4),
    "at rest": (0.5, 2),
    "arming": (0.4, 1),
    "stopping": (0.1, 1),
    "idle": (0.5, 1),
}
_IN_TURN = {"client vanishes": ("jogging", "at rest", "jogging", "jogging", "moving")}  # mostly what it is there for
_EVERY_OTHER = {"client vanishes": client_hangs}
_FASTEST_M_PER_S = 0.25
_GOES_ON_S = 1.5  # that long a jog has room that nobody holds any more: else the end of travel stops it, and hides all
_TOUCHING_S = 2.0  # of a homing with a micro
_REST_S, _OVER_S, _NEVER_RESTS_S = 0.2, 0.6, 10.0
_SEEN_TO_REST_S, _LOOKS_AGAIN_S = 0.05, 0.5  # its power may go 0.1 s after it came to rest; then it rolls
_ENDS_S = 30.0  # a motion that goes on; a homing with a micro takes 15 s
_TRIES = 3
_GONE = "the rig was gone before its macro rested: what it did there is unknown"


@dataclass(frozen=True)
class Scenario:
    """What a seed says."""

    kind: str
    profile: str
    phase: str
    wait_s: float
    speed_m_per_s: float  # of a jog
    target_m: float  # of a move, on the other side of the middle
    fault: Real

    @property
    def text(self) -> str:
        """The run in words."""
        return f"{self.profile}, {self.phase}, after {self.wait_s * 1e3:.0f} ms: {self.fault.drawn.text}"


@dataclass(frozen=True)
class RealResult:
    """What became of one run."""

    seed: int
    scenario: Scenario
    fault_kind: str
    violations: tuple[tuple[str, str], ...]
    verdict: Verdict | None  # None: there was no scene to judge
    took_s: float
    skipped: str = ""

    @property
    def line(self) -> str:
        """One line for a table."""
        said = "; ".join(": ".join(one) for one in self.violations) or self.skipped or "holds"
        again = f"python -m bench service --part processes --seeds {self.seed}"
        return f"real processes, seed {self.seed}: {self.scenario.kind} ({self.scenario.text}): {said}; {again}"


class HostHeldUp(Exception):
    """This host starved servo or rig for longer than the drives wait for SYNC: the run shows nothing."""


def drawn(seed: int) -> Scenario:
    """Draw a run; kinds come in turn, so that each has its share, every third on the stage with a micro."""
    rng = np.random.default_rng([seed, 6])
    kind = list(KINDS)[seed % len(KINDS)]
    profile = "oled-printer" if rng.random() < 1.0 / 3.0 else "single-axis"
    nodes = _STAGES[profile]
    phases = [name for name in _PHASES if name != "identifying" or MICRO in nodes]
    phase = one_of(rng, [name for name in phases for _ in range(_PHASES[name][1])])
    if kind in _IN_TURN:
        phase = _IN_TURN[kind][seed // len(KINDS) % len(_IN_TURN[kind])]
    longest_s = _PHASES[phase][0] + (_TOUCHING_S if phase == "homing" and MICRO in nodes else 0.0)
    wait_s = float(rng.uniform(0.0, longest_s))
    speed_m_per_s = float(rng.uniform(0.05, _FASTEST_M_PER_S))
    end_m = mechanics_of(profile).travel_m[1]
    if kind == "client vanishes":
        speed_m_per_s *= min(1.0, end_m / (_GOES_ON_S * _FASTEST_M_PER_S))
    target_m = float(rng.uniform(0.6, 0.9)) * end_m
    draw = _EVERY_OTHER.get(kind, KINDS[kind]) if seed // len(KINDS) % 2 else KINDS[kind]
    return Scenario(kind, profile, phase, wait_s, speed_m_per_s, target_m, draw(rng, nodes))


def run(seed: int, folder: Path) -> RealResult:
    """Play one seed with processes of its own."""
    began_s = time.monotonic()
    scenario = drawn(seed)
    shutil.rmtree(folder, ignore_errors=True)
    found: list[tuple[str, str]] = []
    fault_kind, verdict = "", None
    for attempt in range(_TRIES):
        try:
            found, fault_kind, verdict = _lived(folder / str(attempt), scenario)
            break
        except pytest.skip.Exception as error:
            return RealResult(seed, scenario, "", (), None, time.monotonic() - began_s, str(error))
        except HostHeldUp as error:
            found = [(COURSE, f"{_TRIES} times: {error}")]
    return RealResult(seed, scenario, fault_kind, tuple(found), verdict, time.monotonic() - began_s)


def _lived(folder: Path, scenario: Scenario) -> tuple[list[tuple[str, str]], str, Verdict | None]:
    """Play a run in a house of its own; return what it missed, its fault, and what the judges saw."""
    runs = None
    with contextlib.ExitStack() as closing:
        if scenario.fault.disk_bytes:
            folder.mkdir(parents=True)
            runs = closing.enter_context(small_disk(folder / "disk", scenario.fault.disk_bytes)) / "runs"
        house = House(folder / "house", runs, scenario.profile)
        try:
            facts = _play(house, scenario)
        finally:
            house.close()
        if isinstance(facts, str):
            return [(BACK, f"the scene could not be set: {facts}")], "", None
        record = _record(house.daemon.runs)
    verdict = judge(scenario.fault.drawn, facts, record, mechanics_of(scenario.profile))
    return list(verdict.violations), facts.fault_kind, verdict


def _record(runs: Path) -> Record:
    folders = [folder for folder in sorted(runs.iterdir()) if (folder / "samples.arrow").exists()]
    record = Record(folders)
    for folder in folders:
        try:
            read_run(folder)
        except (RecordError, StagectlError) as error:
            record.unreadable.append(f"{folder.name}: {error}")
    return record


def under_way(house: House, scenario: Scenario) -> tuple[int, str]:
    """Bring the stage into its phase, and wait; returns an instant of its arming, and why there is no scene, if so.

    A hiccup of the host may trip it before anything was done to it: it gets another try.
    """
    house.daemon.state_is("idle")
    begun_t_ns, trouble = 0, ""
    for _ in range(_TRIES):
        trouble = house.ready()
        house.find_rig()
        begun_t_ns = house.t_ns()
        trouble = trouble or house.begin(scenario.phase, scenario.speed_m_per_s, scenario.target_m)
        if not trouble:
            time.sleep(scenario.wait_s)
            fault = house.daemon.client.status().fault
            if fault is None:
                break
            trouble = fault.kind
        house.let_go()
    return begun_t_ns, trouble


def _play(house: House, scenario: Scenario) -> Facts | str:
    """Bring the stage into its phase, strike, watch, and find the way back; a text where there was no scene."""
    begun_t_ns, trouble = under_way(house, scenario)
    if trouble:
        return trouble
    facts = Facts(begun_t_ns=begun_t_ns, phase=scenario.phase, jog_hold_s=JOG_HOLD_S, is_host_time=True)
    facts.planned_m_per_s = {"jogging": scenario.speed_m_per_s, "moving": TOP_M_PER_S}.get(scenario.phase, 0.0)
    before, drawn_fault = house.state(), scenario.fault.drawn
    facts.fault_t_ns = house.t_ns()
    assert drawn_fault.act is not None
    drawn_fault.act(house)
    watch = _Watch(scenario, before)
    held_up_s = _seen_to_stop(house, watch) if drawn_fault.must_stop else _seen_to_end(house, watch)
    house.let_go()
    if drawn_fault.must_stop:
        facts.judged_until_t_ns = int(house.seen["t_ns"][-1])
    _name_fault(house, scenario, facts)
    if not drawn_fault.must_stop:  # behind the question: to write it all holds the rig up, which may stop the stage
        facts.judged_until_t_ns = _seen_until_t_ns(house)
    time.sleep(0.3 if drawn_fault.lasts_s else 0.0)
    house.go_on_where_it_hung()
    rig = house.rig_place
    if drawn_fault.nonsense is not None:
        house.take_power_away()
    facts.trouble = house.ready()
    if drawn_fault.nonsense is not None:
        facts.reread = house.said_of_profile()
    if not facts.trouble:
        house.find_rig()  # it may be another one
        facts.opened_anew = house.rig_place != rig
        _seen_until_t_ns(house)
    until_t_ns = facts.judged_until_t_ns
    if np.isfinite(drawn_fault.detection_s):
        until_t_ns = facts.fault_t_ns + round(1e9 * (drawn_fault.detection_s + held_up_s))
    servo_late_s = house.lateness_s(facts.fault_t_ns, until_t_ns)
    facts.late_s = held_up_s + WAKE_S + (0.0 if scenario.fault.by_drives else servo_late_s)
    facts.accepted, facts.unasked = house.accepted, house.unasked
    facts.seen = house.seen
    if not drawn_fault.may_stop and facts.fault_kind and held_up_s + servo_late_s > HICCUP_S:
        raise HostHeldUp(f"{facts.fault_kind}, {(held_up_s + servo_late_s) * 1e3:.0f} ms late")
    return facts


def _name_fault(house: House, scenario: Scenario, facts: Facts) -> None:
    """Ask the service why it stopped; one that is gone is started again, as systemd does."""
    daemon = house.daemon
    if daemon.process.poll() is not None:
        daemon.start()
        daemon.client.lease_token = ""
        daemon.state_is("idle", "fault")
        house.note_rest("idle")
        facts.fault_kind = "killed"
        return
    must = scenario.fault.drawn.must_stop and scenario.phase not in AT_WILL
    # The stop's end is told when the drives are seen to stand, or are not for seconds.
    settled = ("fault",) if must else ("off", "idle", "armed", "fault")
    with contextlib.suppress(AssertionError):
        daemon.state_is(*settled)
        house.note_rest(daemon.client.status().state)
    fault = daemon.client.fault()
    if fault is not None:
        facts.fault_kind, facts.fault_text = fault.kind, fault.values


class _Watch:
    """The true motion since a fault: for how long the macro rests, and what the rig was held up until it was noticed.

    What the rig was held up later is no excuse for anything.
    """

    def __init__(self, scenario: Scenario, before: dict) -> None:
        """Begin at the fault; `before`: the rig's state there."""
        fault = scenario.fault.drawn
        self._detection_s = fault.detection_s
        self._must_be_over_s = (fault.detection_s if np.isfinite(fault.detection_s) else 0.0) + _OVER_S
        self.least_s = max(fault.lasts_s + _OVER_S, self._must_be_over_s)
        self._need_not_rest = MACRO in fault.without_power or scenario.phase == "idle"
        self._begin_s, self._before_ns = time.monotonic(), before["held_up_ns"]
        self._rested_s, self._noticed = 0.0, False
        self.held_up_s = self.watched_s = self.rests_s = 0.0

    def look(self, house: House) -> None:
        """Ask the rig; LinkError where it is gone."""
        state = house.state()
        now_s = time.monotonic()
        slow = abs(state["plant"]["macro_velocity_m_per_s"]) < REST_M_PER_S
        self._rested_s = (self._rested_s or now_s) if slow else 0.0
        self.rests_s = now_s - self._rested_s if slow else 0.0
        self.watched_s = now_s - self._begin_s
        if not self._noticed:
            self.held_up_s = 1e-9 * (state["held_up_ns"] - self._before_ns)
            over_s = self._detection_s + self.held_up_s if np.isfinite(self._detection_s) else self.least_s
            self._noticed = self.rests_s > _REST_S or self.watched_s > over_s

    def is_over(self, patience_s: float) -> bool:
        """Tell whether the fault had its effect and the macro rests, or has not for that long."""
        settled = self.rests_s > _REST_S or self._need_not_rest
        return (self.watched_s > self.least_s and settled) or self.watched_s > self.least_s + patience_s


def _seen_to_stop(house: House, watch: _Watch) -> float:
    """Follow a motion that the fault must stop; return for how long the rig was held up until it was noticed, in s.

    What the rig saw is fetched as soon as the macro rests, and no sooner, then again and again: a service that lost its
    servo lets go of that world, and the rig goes with it; but to write it all holds the rig up for 20 ms.
    """
    kept_s = 0.0
    while True:
        try:
            watch.look(house)
            over = watch.is_over(_NEVER_RESTS_S)
            again = time.monotonic() - kept_s > _LOOKS_AGAIN_S if kept_s else watch.rests_s > _SEEN_TO_REST_S
            if over or again:
                house.look_back()
                kept_s = time.monotonic()
            if over:
                return watch.held_up_s
        except LinkError:
            if not kept_s:
                raise HostHeldUp(_GONE) from None
            return watch.held_up_s
        time.sleep(LOOK_S)


def _seen_to_end(house: House, watch: _Watch) -> float:
    """Follow a motion that may go on to its own end, for which a jog's key is let go of; return as `_seen_to_stop`."""
    while True:
        try:
            watch.look(house)
            if watch.watched_s > watch.least_s:
                house.let_go()
            if watch.is_over(_ENDS_S):
                return watch.held_up_s
        except LinkError:
            raise HostHeldUp(_GONE) from None
        time.sleep(LOOK_S)


def _seen_until_t_ns(house: House) -> int:
    """Fetch what the rig saw; return until when."""
    try:
        return int(house.look_back()["t_ns"][-1])
    except LinkError:
        raise HostHeldUp(_GONE) from None
