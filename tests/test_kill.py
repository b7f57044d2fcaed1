"""`kill -9` and Ctrl-C, with real processes: judged by what the rig's stage truly did, not by this host's clock."""

import contextlib
import json
import os
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from drivers import cia402
from drivers.can_bus import open_cyclic
from stagectl.backend import ask_rig
from stagectl.record import Recovery, read_run, recover_orphans
from stagectl.replay import replay
from stagectl.requests import Phase
from stagectl.ring import RingReader
from stagectl.signals import Stop
from tests import stage_child
from tests.stage_child import SPEED_M_PER_S

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parent.parent
PATIENCE_S = 120.0  # a cold compile cache on a host that is busy with other things
REST_M_PER_S = 1e-3
STANDSTILL_M = 20e-6
POLL_S = 0.05
TRIP = stage_child.patient_profile().trip
_TRIES = 8
WAKE_NS = 2_000_000  # lateness of the rig's and the servo's own wake-ups that nobody counts


@dataclass(frozen=True)
class Kill:
    """When a process was killed, and how long the rig had been held up by then."""

    t_ns: int
    held_up_ns: int


class Witness:
    """Asks a rig process what is true."""

    def __init__(self, channel: str, folder: Path) -> None:
        self.channel, self._path = channel, folder / "truth.npz"

    def state(self) -> dict:
        """Return the rig's state now."""
        return ask_rig(self.channel, {"state": True})

    def truth(self) -> dict[str, np.ndarray]:
        """Return the rig's log so far."""
        ask_rig(self.channel, {"truth": str(self._path)})
        with np.load(self._path) as stored:
            return {name: stored[name] for name in stored.files}

    def kill(self, *pids: int) -> Kill:
        """Kill processes and note the instant."""
        held_up_ns = self.state()["held_up_ns"]
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        return Kill(time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW), held_up_ns)

    def wait_for_rest(self) -> None:
        """Wait until the macro has been slow for a while, and the drives with it."""
        until_s = time.monotonic() + PATIENCE_S
        still = 0
        while still < 10:
            assert time.monotonic() < until_s, self.state()
            still = still + 1 if abs(self.state()["plant"]["macro_velocity_m_per_s"]) < REST_M_PER_S else 0
            time.sleep(POLL_S)

    def way_m(self, kill: Kill, until_t_ns: int | None = None) -> float:
        """Return how far the macro went after a kill, until now or until an instant."""
        truth = self.truth()
        after = truth["t_ns"] >= kill.t_ns
        if until_t_ns is not None:
            after &= truth["t_ns"] <= until_t_ns
        position_m = truth["macro_position_m"][after]
        return float(np.abs(position_m - position_m[0]).max())

    def bound_m(self, kill: Kill, detection_s: float, late_ns: int = 0) -> float:
        """Return v t + a t^2 / 2 + (v + a t)^2 / (2 ramp), v and a true at the kill, t detection plus one cycle."""
        profile, truth = stage_child.patient_profile(), self.truth()
        at = int(np.searchsorted(truth["t_ns"], kill.t_ns))
        velocity = truth["macro_velocity_m_per_s"]
        v = abs(float(velocity[at]))
        assert v > 0.9 * SPEED_M_PER_S
        a = abs(float(velocity[at] - velocity[at - 10])) / (1e-9 * float(truth["t_ns"][at] - truth["t_ns"][at - 10]))
        held_up_ns = self.state()["held_up_ns"] - kill.held_up_ns
        t = detection_s + profile.cycle.period_s + 1e-9 * (held_up_ns + late_ns + WAKE_NS)
        return v * t + 0.5 * a * t * t + (v + a * t) ** 2 / (2.0 * profile.macro.stop_deceleration_m_per_s2)

    def follows_no_command(self) -> None:
        """Command the macro as a servo would that comes back from the dead; it must hold on its encoder."""
        before = self.state()
        assert before["drives"]["1"] == "QUICK_STOP_ACTIVE"
        self._command((0x06, 0x07, *([0x0F] * 200)))
        after = self.state()
        assert after["drives"]["1"] == "QUICK_STOP_ACTIVE"
        moved_m = after["plant"]["macro_position_m"] - before["plant"]["macro_position_m"]
        assert abs(moved_m) < STANDSTILL_M

    def has_no_power(self) -> None:
        """Let the frames of a motion come late; no drive may have power, or get it, and the macro's motor pushes not.

        How fast the macro coasts says little: cogging of 3 N makes up to 25 mm/s of it. The micro's winding is shorted.
        """
        began_t_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
        self._command([0x0F] * 200)
        assert set(self.state()["drives"].values()) == {"SWITCH_ON_DISABLED"}
        truth = self.truth()
        since = truth["t_ns"] >= began_t_ns
        assert since.sum() > 100
        assert not truth["macro_force_n"][since].any()

    def _command(self, controlwords: Sequence[int]) -> None:
        bus = open_cyclic("hub", self.channel, [])
        try:
            for controlword in controlwords:
                bus.send(0x201, struct.pack("<Hh", controlword, 300))  # 150 N
                bus.send(0x080, b"")
                time.sleep(1e-3)
        finally:
            bus.close()


class Child:
    """A supervisor in a process of its own; what it started is ended here."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.stage_child", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            start_new_session=True,  # a process group, as a terminal gives one
        )
        self.facts: dict = {}

    @property
    def witness(self) -> Witness:
        """Whom to ask what is true."""
        return Witness(self.hear("channel"), self.folder.parent)

    def hear(self, key: str, unless: str = ""):
        """Return the value of the first message that has the key; None where one that has the key `unless` comes."""
        until_s = time.monotonic() + PATIENCE_S
        while key not in self.facts:
            if unless in self.facts:
                return None
            ready, _, _ = select.select([self.process.stdout], [], [], max(0.0, until_s - time.monotonic()))
            line = self.process.stdout.readline() if ready else ""
            assert line, f"the child said no {key!r}: {self.facts}, ended with {self.process.poll()}"
            self.facts |= json.loads(line)
        return self.facts[key]

    def end(self) -> None:
        """Leave nothing behind: child, servo, rig and its folder."""
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()
        for name in ("servo_pid", "rig_pid"):
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.facts.get(name, 0) or self.process.pid, signal.SIGKILL)
        if "channel" in self.facts:
            shutil.rmtree(Path(self.facts["channel"]).parent, ignore_errors=True)
        if "ring" in self.facts:
            ring = Path(self.facts["ring"])
            for path in ring.parent.glob(f"{ring.stem}.*"):
                path.unlink(missing_ok=True)


@pytest.fixture
def child(tmp_path):
    """A child that moves its stage at full speed; a host that trips it before anybody could gets another try."""
    for attempt in range(_TRIES):
        made = Child(tmp_path / f"run-{attempt}")
        try:
            moves = made.hear("moving", unless="ended")
            if moves and abs(made.witness.state()["plant"]["macro_velocity_m_per_s"]) > 0.9 * SPEED_M_PER_S:
                yield made
                return
        finally:
            made.end()
    pytest.fail(f"this host stopped the stage by itself {_TRIES} times")


def check_whole(folder: Path) -> np.ndarray:
    """Return the rows of a run in which no cycle is missing, and which replays bit for bit."""
    run = read_run(folder)
    assert not run.truncated
    rows = run.rows
    skipped = int((np.diff(rows["cycle"][rows["sequence"] >= 0]) - 1).clip(min=0).sum())
    assert skipped == rows["cycles_missed"][-1]
    assert replay(folder).exact
    return rows


def test_the_drives_stop_the_stage_of_a_killed_servo(child):
    """The RPDO deadline of the drives; the supervisor says so and saves every row."""
    witness = child.witness
    kill = witness.kill(child.hear("servo_pid"))
    assert re.match("the servo process ended with -9; the drives stop the stage by themselves", child.hear("failed"))
    witness.wait_for_rest()
    assert witness.way_m(kill) <= witness.bound_m(kill, TRIP.rpdo_deadline_s)
    witness.follows_no_command()
    ring = Path(child.hear("ring"))
    written_count = RingReader(ring).written_count
    child.process.stdin.write("close\n")
    child.process.stdin.flush()
    assert child.process.wait(PATIENCE_S) == 0
    rows = check_whole(child.folder)
    assert rows.size == written_count
    assert rows["run_phase"][-1] == Phase.TRACKING
    end = read_run(child.folder).manifest["end"]
    assert end["stop"] == Stop.LINK_LOST.name
    assert "the servo process ended with -9" in end["detail"]
    assert not list(ring.parent.glob(f"{ring.stem}.*"))


def test_the_servo_stops_the_stage_of_a_killed_supervisor(child):
    """It notices the counter that stands still, brakes as short as the drive would, takes the power, saves the rows."""
    witness = child.witness
    kill = witness.kill(child.process.pid)
    ring = Path(child.hear("ring"))
    until_s = time.monotonic() + PATIENCE_S
    while ring.exists():
        assert time.monotonic() < until_s
        time.sleep(POLL_S)
    witness.has_no_power()
    rows = check_whole(child.folder)
    after = rows[rows["t_ns"] > kill.t_ns]
    words = after["macro_statusword"].tolist()
    without_power = [cia402.state_of(word) is cia402.State.SWITCH_ON_DISABLED for word in words]
    let_go_t_ns = int(after["t_ns"][without_power.index(True)])
    truth = witness.truth()
    let_go = int(np.searchsorted(truth["t_ns"], let_go_t_ns))
    assert abs(truth["macro_velocity_m_per_s"][let_go]) < REST_M_PER_S
    late_ns = int(after["lateness_ns"].max())
    assert witness.way_m(kill, let_go_t_ns) <= witness.bound_m(kill, TRIP.supervisor_silence_s, late_ns)
    record = read_run(child.folder).manifest["record"]
    assert (record["state"], record["rows_lost_count"]) == ("recovered", 0)
    phases = set(rows["run_phase"][rows["t_ns"] > kill.t_ns])
    assert Phase.STOPPED in phases
    if rows["stop"].max() == Stop.NONE:  # unless a hiccup of this host made the guard act first
        assert Phase.STOPPING in phases
    assert not list(ring.parent.glob(f"{ring.stem}.*"))


def test_the_drives_stop_the_stage_when_both_are_killed(child, tmp_path):
    """Rows that nobody drained wait in shared memory for the next start."""
    witness = child.witness
    kill = witness.kill(child.hear("servo_pid"), child.process.pid)
    child.process.wait()
    witness.wait_for_rest()
    assert witness.way_m(kill) <= witness.bound_m(kill, TRIP.rpdo_deadline_s)
    witness.follows_no_command()
    ring = Path(child.hear("ring"))
    (tmp_path / "rings").mkdir()
    kept = Path(shutil.move(ring, tmp_path / "rings" / ring.name))  # others may have rings there: this one is ours
    written_count = RingReader(kept).written_count
    ((_, recovery),) = recover_orphans(kept.parent)
    assert isinstance(recovery, Recovery), recovery
    assert recovery.rows_count > 0
    assert recovery.rows_lost_count == 0
    rows = check_whole(child.folder)
    assert rows.size == written_count
    assert rows["run_phase"][-1] == Phase.TRACKING


def test_ctrl_c_stops_the_stage_and_closes_the_run(child):
    """The terminal's signal reaches every process of the group; only the supervisor acts on it."""
    os.killpg(child.process.pid, signal.SIGINT)
    assert child.hear("ended") == "interrupted"
    assert child.process.wait(PATIENCE_S) == 0
    rows = check_whole(child.folder)
    assert read_run(child.folder).manifest["end"]["stop"] == Stop.OPERATOR.name
    phases = rows["run_phase"]
    assert {Phase.STOPPING, Phase.STOPPED} <= set(phases)
    stopped = int(np.flatnonzero(phases == Phase.STOPPED)[0])
    assert np.ptp(rows["macro_position_m"][stopped - 50 : stopped]) < 50e-3 * REST_M_PER_S
    ring = Path(child.hear("ring"))
    assert not list(ring.parent.glob(f"{ring.stem}.*"))
