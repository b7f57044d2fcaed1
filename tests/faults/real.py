"""Faults with real processes: service, servo and rig, killed, stopped and lied to; judged by what the rig truly did.

The host of a test is no real-time host: what the host held up the rig, or the servo, is added to the time of detection.

Where nobody closes the loop until the fault is noticed, the drive keeps the force that balanced the magnets at one
place, and theirs changes on the way: from some places the macro runs away from 0.12 to 0.16 m/s in 0.3 s. What a mass
does under that, and nothing else, is the way that it may go before the stop.
"""

import contextlib
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sim_backend.machine import load_machine
from stagectl.errors import LinkError, RecordError, StagectlError
from stagectl.record import read_run
from tests.faults.house import JOG_M_PER_S, LOOK_S, House
from tests.faults.judge import BACK, COURSE, STANDSTILL, STRANGER, TRAVEL, UNREADABLE
from tests.faults.real_kinds import CYCLE_S, KINDS, Kind
from tests.small_disk import small_disk

RAMP_M_PER_S2 = 5.0
STOPS_M, STOPS_GIVE_M, STANDSTILL_M, REST_M_PER_S = 0.17, 8e-3, 20e-6, 1e-3
HICCUP_S = 0.02  # 20 cycles, and the drives say that SYNC is lost
LOOP_S = 0.01  # by which what the loop has balanced lies back
WAKE_S = 5e-3  # of this host: a process that is asked wakes so much later
_REST_S = 0.5
_TRIES = 3
_PLACES = 9
MACHINE = load_machine("single-axis")


@dataclass(frozen=True)
class RealResult:
    """What became of one run."""

    seed: int
    kind: str
    fault_kind: str
    violations: tuple[tuple[str, str], ...]
    travel_m: float
    bound_m: float
    took_s: float
    skipped: str = ""

    @property
    def line(self) -> str:
        """One line for a table."""
        said = "; ".join(": ".join(one) for one in self.violations) or self.skipped or "holds"
        again = f"python -m bench service --part processes --seed {self.seed}"
        return f"real processes, seed {self.seed}: {self.kind}: {said}; {again}"


class HostHeldUp(Exception):
    """This host starved servo or rig for longer than the drives wait for SYNC: the run shows nothing."""


def run(seed: int, folder: Path) -> RealResult:
    """Play one fault with processes of its own."""
    began_s = time.monotonic()
    name = list(KINDS)[seed % len(KINDS)]
    shutil.rmtree(folder, ignore_errors=True)
    kind = KINDS[name]
    for attempt in range(_TRIES):
        try:
            found, travel_m, bound_m, fault_kind = _lived(folder / str(attempt), kind, seed)
            break
        except pytest.skip.Exception as error:
            return RealResult(seed, name, "", (), 0.0, 0.0, time.monotonic() - began_s, str(error))
        except HostHeldUp as error:
            found, travel_m, bound_m, fault_kind = [(COURSE, f"{_TRIES} times: {error}")], 0.0, 0.0, ""
    return RealResult(seed, name, fault_kind, tuple(found), travel_m, bound_m, time.monotonic() - began_s)


def _lived(folder: Path, kind: Kind, seed: int) -> tuple[list[tuple[str, str]], float, float, str]:
    """Play a fault in a house of its own, and read what it recorded."""
    runs = None
    with contextlib.ExitStack() as closing:
        if kind.disk_bytes:
            folder.mkdir(parents=True)
            runs = closing.enter_context(small_disk(folder / "disk", kind.disk_bytes)) / "runs"
        house = House(folder / "house", runs)
        try:
            found, travel_m, bound_m, fault_kind = _play(house, kind, seed)
        finally:
            house.close()
        return [*found, *_unreadable(house.daemon.runs)], travel_m, bound_m, fault_kind


def _unreadable(runs: Path) -> list[tuple[str, str]]:
    found = []
    for run_folder in sorted(runs.iterdir()):
        if (run_folder / "samples.arrow").exists():
            try:
                read_run(run_folder)
            except (RecordError, StagectlError) as error:
                found.append((UNREADABLE, f"{run_folder.name}: {error}"))
    return found


def _play(house: House, kind: Kind, seed: int) -> tuple[list[tuple[str, str]], float, float, str]:
    rng = np.random.default_rng([seed, 6])
    daemon = house.daemon
    daemon.state_is("idle")
    house.find_rig()
    for _ in range(_TRIES):  # a hiccup of the host may trip it before anything was done to it
        trouble = house.ready() or ("" if house.set_off() else "it does not move")
        time.sleep(float(rng.uniform(0.0, 0.3)))
        before = house.state()
        if not trouble and abs(before["plant"]["macro_velocity_m_per_s"]) > 0.95 * JOG_M_PER_S:
            break
        house.let_go()
    else:
        return [(BACK, f"the scene could not be set: {trouble or 'it did not go on moving'}")], 0.0, 0.0, ""
    kind.strike(house)
    found, travel_m, end = _watch(house, kind, before)
    held_up_s = 1e-9 * (end["held_up_ns"] - before["held_up_ns"])
    late_s = house.lateness_s(before["t_ns"])
    bound_m = _bound_m(kind, before["plant"], held_up_s + (0.0 if kind.by_drives else late_s) + WAKE_S)
    house.let_go()
    gone = daemon.process.poll() is not None
    if gone:
        daemon.start()
        daemon.client.lease_token = ""
        daemon.state_is("idle", "fault")
    elif kind.must_stop:  # the stop's end is told when the drives are seen to stand, or are not for seconds
        with contextlib.suppress(AssertionError):
            daemon.state_is("fault")
    status = daemon.client.status()
    fault_kind = status.fault.kind if status.fault is not None else ""
    stopped = bool(fault_kind) or gone
    if kind.must_stop and not stopped:
        found.append((COURSE, "it went on"))
    if not kind.may_stop and stopped and held_up_s + late_s > HICCUP_S:
        raise HostHeldUp(f"{fault_kind}, {(held_up_s + late_s) * 1e3:.0f} ms late")
    if not kind.may_stop and stopped:
        found.append((COURSE, f"stopped by {fault_kind}: {status.fault.values if status.fault else ''}"))
    if stopped and travel_m > bound_m + STANDSTILL_M:
        found.append((TRAVEL, f"went {travel_m * 1e3:.2f} mm, bound {bound_m * 1e3:.2f} mm"))
    if kind.lasts_s:
        time.sleep(0.3)
    back = house.ready()
    if back:
        found.append((BACK, back))
    found += [(STRANGER, name) for name in house.accepted]
    return found, travel_m, bound_m, fault_kind


def _bound_m(kind: Kind, plant: dict[str, float], late_s: float) -> float:
    """Return how far it may go: a key is held that asks for one speed, so that no command keeps an acceleration up."""
    v, at_m = abs(plant["macro_velocity_m_per_s"]), plant["macro_position_m"]
    if kind.without_power:
        way_m = STOPS_M - at_m if plant["macro_velocity_m_per_s"] > 0.0 else at_m + STOPS_M
        return way_m + STOPS_GIVE_M
    t = kind.detection_s + CYCLE_S + late_s
    v = max(v, JOG_M_PER_S)
    runs = [(v * t, v)]
    if kind.open_loop:
        sign = np.sign(plant["macro_velocity_m_per_s"])
        balanced_m = at_m + sign * v * np.linspace(-LOOP_S, late_s, _PLACES)
        runs += [_coasted(float(place_m), float(sign * v), t) for place_m in balanced_m]
    return max(way_m + v * v / (2.0 * RAMP_M_PER_S2) for way_m, v in runs)


def _coasted(at_m: float, v: float, t: float) -> tuple[float, float]:
    """Return (way, speed at its end) of a mass under the magnets' force, less what that was where it begins."""
    x, held_n = at_m, _magnets_n(at_m)
    for _ in range(round(t / CYCLE_S)):
        v += CYCLE_S * (_magnets_n(x) - held_n) / MACHINE.macro.mass_kg
        x += CYCLE_S * v
    return abs(x - at_m), abs(v)


def _magnets_n(x: float) -> float:
    return sum(
        row["amplitude_n"] * np.sin(2.0 * np.pi * x / row["pitch_m"] + row["phase_rad"])
        for row in MACHINE.effects
        if row["name"] == "cogging"
    )


def _watch(house: House, kind: Kind, before: dict) -> tuple[list[tuple[str, str]], float, dict]:
    """Follow the true motion until it rests, or for as long as the fault lasts; then look that nothing moves again."""
    begin_s, rest_s = time.monotonic(), 0.0
    at_m = before["plant"]["macro_position_m"]
    travel_m, state = 0.0, before
    while True:
        try:
            state = house.state()
        except LinkError:  # the service let go of a world that it lost its servo in, and its rig went with it
            if abs(state["plant"]["macro_velocity_m_per_s"]) < REST_M_PER_S:
                return [], travel_m, state
            return [(STANDSTILL, "the rig was gone before the macro stood")], travel_m, state
        now_s = time.monotonic()
        travel_m = max(travel_m, abs(state["plant"]["macro_position_m"] - at_m))
        slow = abs(state["plant"]["macro_velocity_m_per_s"]) < REST_M_PER_S
        rest_s = rest_s if slow and rest_s else (now_s if slow else 0.0)
        rested = rest_s and now_s - rest_s > _REST_S
        if rested and (now_s - begin_s > kind.lasts_s or not kind.must_stop):
            break
        if not kind.must_stop and now_s - begin_s > max(kind.lasts_s, 1.0):
            return [], travel_m, state
        if now_s - begin_s > kind.detection_s + kind.lasts_s + 20.0:
            return [(STANDSTILL, "it never stood still")], travel_m, state
        time.sleep(LOOK_S)
    house.let_go()
    stands_m, found = state["plant"]["macro_position_m"], []
    held_m = stands_m
    for _ in range(15):
        time.sleep(LOOK_S)
        with contextlib.suppress(LinkError):  # of a killed service the rig ends after a while
            state = house.state()
        if state["drives"]["1"] not in ("SWITCH_ON_DISABLED", "FAULT"):
            held_m = state["plant"]["macro_position_m"]
    if abs(held_m - stands_m) > STANDSTILL_M:
        found.append((STANDSTILL, "it moved after standstill"))
    return found, travel_m, state
