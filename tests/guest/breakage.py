"""Hurt in every way, and recovered: what docs/operations.md says of each fault."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from motions import SCAN
from stage_pc import PORT, POWERED, UNIT, check, report, rig, servo_pid, shell, stage, unit, until

FAR_M, STRUCK_M = 0.1, 0.03
HOMING_M_PER_S = 0.02  # stage-100hz.toml
AT_REST_M_PER_S = 2e-4
COASTS_M_PER_S = 5e-3  # cogging and cables pull at a macro without power
# Heartbeat time of the drives, the ramp from the speed limit, and how seldom it is looked at; a servo that lost its
# supervisor waits for it first.
DRIVES_STOP_S = 5.0
SERVO_STOPS_S = DRIVES_STOP_S + 2.0
REST_PATIENCE_S = 60.0
SEARCH_S = 30.0
STEP_S = 2.0
RUNS = Path("/var/lib/stagectl/runs")
LATE_CYCLES = 8
KILLED_COUNT = 3  # a supervisor, and one out of memory, and one that hung
REPEATED_COUNT = 4  # of the scan: it outlasts two steps of the clock


@contextmanager
def moving() -> Iterator[None]:
    """A stage under way to a far target, well off its index; the lease is held."""
    with stage.lease():
        stage.do("arm" if stage.status()["homed"] else "home")
        stage.begin("move", target_m=FAR_M)
        until("a stage under way", lambda: rig.end_m() > STRUCK_M)
        yield


@contextmanager
def homing() -> Iterator[None]:
    """A stage whose macro drive looks for its index by itself, from where the last fault left it; the lease is held.

    It has to be a centimetre off at least: below that the index is found before the drive is up to speed.
    """

    def searches() -> bool:
        # A stage without power moves, too: cogging and cables pull.
        state = rig.state()
        fast = abs(state["plant"]["macro_velocity_m_per_s"]) > 0.9 * HOMING_M_PER_S
        return fast and state["drives"]["1"] == "OPERATION_ENABLED"

    with stage.lease():
        stage.begin("home")
        until(f"the drive looks for its index from {rig.end_m():.4f} m", searches, SEARCH_S)
        yield


def stops(what: str, began_s: float, limit_s: float = DRIVES_STOP_S) -> None:
    """Wait until the plant rests and no drive follows commands any more; a check of how long that took."""

    def rests() -> bool:
        state = rig.state()
        speed_m_per_s = abs(state["plant"]["macro_velocity_m_per_s"])
        held = "QUICK_STOP_ACTIVE" in state["drives"].values()
        slow = speed_m_per_s < (AT_REST_M_PER_S if held else COASTS_M_PER_S)
        return slow and "OPERATION_ENABLED" not in state["drives"].values()

    until(f"{what}: rest", rests, REST_PATIENCE_S)
    took_s = time.monotonic() - began_s
    check(f"{what}: the drives stop the stage", took_s < limit_s, f"{took_s:.1f} s, {rig.state()['drives']}")


def loses_power(what: str, restarts: int) -> None:
    """Wait until no drive has power; nobody but the servo that is left alone can have taken it."""
    until(f"{what}: no power", lambda: not POWERED & set(rig.state()["drives"].values()), REST_PATIENCE_S)
    check(f"{what}: the servo takes the power away", int(unit("NRestarts")) == restarts, rig.state()["drives"])


def faulted(what: str, *kinds: str) -> None:
    """Check that a fault says what it was."""
    fault = stage.await_state("fault")["fault"]
    check(f"{what}: a fault says so", fault["kind"] in kinds, f"{fault['kind']}: {fault['values'][:150]}")


def recovers(what: str) -> None:
    """Acknowledge what there is, and come to idle without a restart by hand."""
    if stage.await_state("idle", "fault", "off")["state"] == "fault":
        fault = stage.acknowledge()
        report.say(f"        fault {fault['kind']}: {fault['what']}: {fault['values'][:150]}; {fault['remedy']}")
    stage.await_state("idle")
    check(f"{what}: idle again", unit("ActiveState") == "active", f"{unit('NRestarts')} restarts")
    shell("systemctl", "reset-failed", UNIT)


def await_restart(what: str, before: int) -> None:
    """Wait for systemd's restart, and check it."""

    def restarted() -> bool:
        return int(unit("NRestarts")) > before and unit("ActiveState") == "active"

    until(f"{what}: a restart", restarted, period_s=3.0)
    check(f"{what}: systemd brings the service back", True)


def recorded() -> None:
    """After all that, every run is there, and no row is missing."""
    runs = {run["name"]: run["state"] for run in stage.ask("GET", "/v1/runs")}
    # The session under way is the one folder that is not a run yet.
    lost = [run for run in runs.items() if run[1] not in ("closed", "recovered", "recording", "session")]
    check("one session is under way", list(runs.values()).count("session") == 1)
    check("every run is whole, or was recovered", len(runs) > 5 and not lost, lost or sorted(runs.values()))
    records = [json.loads((RUNS / name / "manifest.json").read_text())["record"] for name in runs]
    lost_count = [record["rows_lost_count"] for record in records if record["state"] == "recovered"]
    check("no row of them is lost", not any(lost_count), f"{len(lost_count)} recovered: {lost_count}")


def recovered() -> None:
    """What supervisors that are gone had left was recovered."""
    states = [run["state"] for run in stage.ask("GET", "/v1/runs")]
    check("one run for each of them", states.count("recovered") >= KILLED_COUNT, states)


def clock_stepped() -> None:
    """Somebody sets the clock in the midst of a scan, an hour on and back: it goes on and is recorded without a gap."""
    known = {run["name"] for run in stage.ask("GET", "/v1/runs")}
    before = stage.status()["health"]
    with stage.lease():
        stage.do("arm" if stage.status()["homed"] else "home")
        scan = stage.begin("scan", **SCAN | {"repeat_count": REPEATED_COUNT})
        until("the scan is under way", lambda: stage.status()["state"] == "moving")
        for step in ("+1 hour", "-1 hour"):
            shell("date", "--set", step)
            time.sleep(STEP_S)
        check("clock stepped: that was in the midst of the scan", stage.status()["state"] == "moving")
        stage.finish("scan", scan)
        after = stage.status()
        check("clock stepped: it holds the stage behind the scan", after["state"] == "armed", after["fault"])
    stage.await_state("idle")
    (run,) = [run for run in stage.ask("GET", "/v1/runs") if run["name"] not in known]
    check("clock stepped: its run is listed and closed", run["state"] == "closed", run["name"])
    # Emulated, the servo is woken up too late for one cycle in 120, and counts each; so it does at rest, before and
    # behind. The first and the last row come up to 40 ms late.
    missed_count = stage.status()["health"]["missed_cycles_count"] - before["missed_cycles_count"]
    cycles_count = run["duration_s"] * before["rate_hz"] + 1.0
    found = f"{run['rows_count']} rows in {run['duration_s']:.2f} s, {missed_count} missed"
    whole = cycles_count - missed_count - LATE_CYCLES < run["rows_count"] < cycles_count + LATE_CYCLES
    check("clock stepped: it has every cycle that there was", whole, found)
    check("clock stepped: it is as long as it took", run["duration_s"] < REST_PATIENCE_S * 10.0, found)


def can_down() -> None:
    """The CAN interface is taken down under a moving stage, and comes up again."""
    with moving():
        began_s = time.monotonic()
        shell("ip", "link", "set", "vcan0", "down")
        stops("vcan0 down", began_s)
    faulted("vcan0 down", "LINK_LOST", "LINK_SILENT", "LinkError")
    shell("ip", "link", "set", "vcan0", "up")
    recovers("vcan0 up")


def serial_unplugged() -> None:
    """The interferometer's adapter is pulled under a moving stage, and plugged in again."""
    serials = Path("/sys/bus/usb/devices").glob("*/serial")
    adapter = next(path.parent for path in serials if path.read_text().strip() in PORT)
    with moving():
        began_s = time.monotonic()
        (adapter / "authorized").write_text("0")
        stops("unplugged", began_s)
    faulted("unplugged", "LINK_LOST", "SENSOR_AGE", "LinkError")
    check("unplugged: homing is void", not stage.status()["homed"])
    stage.acknowledge()
    waits = until("unplugged: it waits", lambda: stage.status()["waiting_for"])
    check("unplugged: it waits for the port", "LASER001" in waits, waits)
    (adapter / "authorized").write_text("1")
    until(PORT, lambda: os.path.exists(PORT), 30.0)
    recovers("plugged in")


def servo_killed() -> None:
    """The servo is killed under a moving stage."""
    with moving():
        began_s = time.monotonic()
        os.kill(servo_pid(), signal.SIGKILL)
        stops("servo killed", began_s)
    faulted("servo killed", "LinkError")
    recovers("servo killed")


def supervisor_killed() -> None:
    """The supervisor is killed while the drive homes: the servo stops the stage, systemd brings the service back."""
    _without_supervisor("supervisor killed", signal.SIGKILL)


def supervisor_hung() -> None:
    """The supervisor hangs while the drive homes: the stage stops, the watchdog ends the service, and it restarts."""
    _without_supervisor("supervisor hangs", signal.SIGSTOP)
    said = shell("journalctl", "-u", UNIT, "--no-pager", "-o", "cat")
    check("supervisor hangs: it was the watchdog", "Watchdog timeout" in said)


def _without_supervisor(what: str, number: signal.Signals) -> None:
    before = int(unit("NRestarts"))
    with homing():
        began_s = time.monotonic()
        os.kill(int(unit("MainPID")), number)
        stops(what, began_s, SERVO_STOPS_S)
        loses_power(what, before)
    await_restart(what, before)
    recovers(what)


def homed() -> None:
    """What systemd has started again is homed and armed."""
    with stage.lease():
        stage.do("home")
        drives = rig.state()["drives"]
        check("started again, it is homed and armed", set(drives.values()) == {"OPERATION_ENABLED"}, drives)
    stage.await_state("idle")


def servo_out_of_memory() -> None:
    """The kernel kills the servo for want of memory while the drive homes: the drives stop, and it goes on by hand."""
    what, before = "servo out of memory", int(unit("NRestarts"))
    _without_memory(what, servo_pid(), int(unit("MainPID")), DRIVES_STOP_S)
    check(f"{what}: the service is the same", int(unit("NRestarts")) == before)
    faulted(what, "LinkError")
    recovers(what)


def supervisor_out_of_memory() -> None:
    """The kernel kills the supervisor for want of memory while the drive homes: the servo stops the stage."""
    what, before = "supervisor out of memory", int(unit("NRestarts"))
    _without_memory(what, int(unit("MainPID")), servo_pid(), SERVO_STOPS_S)
    await_restart(what, before)
    recovers(what)


def _without_memory(what: str, victim: int, spared: int, limit_s: float) -> None:
    """Have the kernel kill one process of the service for want of memory, and none but that; the stage has to stop.

    Anonymous memory can't be written out where there is no swap: less of it than there is ends a process for sure.
    """
    group = Path(f"/sys/fs/cgroup{unit('ControlGroup')}")

    def facts(name: str) -> dict[str, int]:
        return {
            word: int(number) for word, number in (line.split() for line in (group / name).read_text().splitlines())
        }

    def killed() -> list[str]:
        said = shell("journalctl", "-k", "--no-pager", "-o", "cat").splitlines()
        return [line.split("Killed process ")[1].split()[0] for line in said if "Killed process" in line]

    earlier, events = killed(), facts("memory.events")["oom_kill"]
    with homing():
        Path(f"/proc/{victim}/oom_score_adj").write_text("1000")
        Path(f"/proc/{spared}/oom_score_adj").write_text("-1000")
        began_s = time.monotonic()
        limit_bytes = facts("memory.stat")["anon"] - _anonymous_bytes(victim) // 2
        (group / "memory.max").write_text(str(limit_bytes))
        until("the kernel kills", lambda: facts("memory.events")["oom_kill"] > events, period_s=0.02)
        (group / "memory.max").write_text("max")
        stops(what, began_s, limit_s)
    found = killed()[len(earlier) :]
    check(f"{what}: the kernel killed just that", found == [str(victim)], f"{found}, {limit_bytes >> 20} MB")
    if os.path.exists(f"/proc/{spared}"):
        Path(f"/proc/{spared}/oom_score_adj").write_text("0")


def _anonymous_bytes(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    return 1024 * int(next(line for line in status if line.startswith("RssAnon")).split()[1])
