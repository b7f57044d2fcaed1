"""What a stage PC has to show, in order: installed, started, read back, moved, hurt in every way, removed.

Runs as root in the guest. One line a check; exit code 1 where one failed. Names of groups in the file `only` beside
this one (from $GUEST_CHECKS) leave out the others.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import stage_pc
from stage_pc import RIG_FOLDER, UNIT, Failed, pids, rig, servo_pid, shell, unit, until

INSTALL = "/srv/stagectl/deploy/install.sh"
INSTALL_BEFORE = "/srv/before/deploy/install.sh"
PROGRAM = Path("/opt/stagectl")
PORT = "/dev/stagectl/LASER001-if00"
PROFILE = Path("/etc/stagectl/stage-100hz.toml")
RUNS = Path("/var/lib/stagectl/runs")
DROP_IN = Path("/etc/systemd/system/stagectl.service.d/guest.conf")
FOLDERS = ("/etc", "/opt", "/usr/local", "/var/lib", "/var/cache", "/run/stagectl", "/dev/shm", "/dev/stagectl")
# The system's own: its state, and the copies that it keeps of the accounts' files.
OF_THE_SYSTEM = (
    "/var/lib/systemd/", "/var/lib/dbus/", "/var/cache/ldconfig/", "/etc/ld.so.cache", "/etc/machine-id",
    "/etc/passwd-", "/etc/group-", "/etc/shadow-", "/etc/gshadow-", "/etc/subuid-", "/etc/subgid-", "/etc/.pwd.lock",
)  # fmt: skip
# Between packages and sources only the links count: what lies in an environment is pip's.
ENVIRONMENT = "/venv/"
EXPOSURE_LIMIT = 2.0
WIDTH_M = 27.9e-6 + 171.3e-6  # machine.toml
FAR_M, BACK_M = 0.12, 0.0  # a way of more than two seconds
AT_REST_M_PER_S = 2e-4
# Heartbeat time of the drives, the ramp from the speed limit, and what the emulation adds.
DRIVES_STOP_S = 6.0
SUPERVISOR_SILENCE_S = 2.0

report = stage_pc.Report()
stage = stage_pc.Stage()
check = report.check


def everything() -> set[str]:
    """Return all paths and accounts that an installation could leave behind."""
    found = set()
    for folder in FOLDERS:
        for place, folders, files in os.walk(folder):
            folders[:] = [name for name in folders if f"/{name}/" != ENVIRONMENT]
            found.update(f"{place}/{name}" for name in [*folders, *files])
    accounts = [*Path("/etc/passwd").read_text().split("\n"), *Path("/etc/group").read_text().split("\n")]
    return {path for path in found if not path.startswith(OF_THE_SYSTEM)} | {line for line in accounts if line}


# ---- installed -------------------------------------------------------------------------------------------------


def bring_release(before: bool) -> None:
    """Put a release that the image has unpacked where install.sh would unpack it; that one finds it there."""
    for folder in Path("/srv/releases").iterdir():
        if (folder / "CHANGELOG.md").read_text().endswith("The release before.\n") == before:
            PROGRAM.mkdir(exist_ok=True)
            folder.rename(PROGRAM / folder.name)


def installed() -> None:
    """The release before is installed, twice, and given a profile and a run."""
    bring_release(before=True)
    shell(INSTALL_BEFORE, "install")
    first = everything()
    shell(INSTALL_BEFORE, "install")
    check("installing a second time changes nothing", everything() == first, sorted(everything() ^ first)[:10])
    shutil.copy(stage_pc.HERE / PROFILE.name, PROFILE)
    Path("/etc/stagectl/stagectl.env").write_text(f"STAGECTL_SERVE={PROFILE.stem} --backend hardware\n")
    shutil.copytree("/srv/runs", RUNS, dirs_exist_ok=True)
    shell("chown", "-R", "stagectl:stagectl", str(RUNS))
    DROP_IN.parent.mkdir(parents=True)
    generic = " ".join(f"{name}={value}" for name, value in stage_pc.GENERIC.items())
    DROP_IN.write_text(f"[Service]\nEnvironment={generic}\n")
    shell("systemctl", "daemon-reload")


def upgraded() -> None:
    """Without hardware it waits and says so; an upgrade stops it, keeps what is yours, and starts it again."""
    shell("systemctl", "start", UNIT)
    waits = stage.await_state("off")["waiting_for"]
    check("without hardware it waits, and says so", "vcan0" in waits and "LASER001" not in waits, waits)
    yours = [path for folder in (PROFILE.parent, RUNS) for path in folder.rglob("*") if path.is_file()]
    content = [path.read_bytes() for path in yours]
    release = os.readlink(PROGRAM / "current")
    bring_release(before=False)
    shell(INSTALL, "upgrade")
    now = os.readlink(PROGRAM / "current")
    check("an upgrade switches to the new release", now != release, now)
    kept = len(yours) > 3 and all(path.exists() for path in yours) and [path.read_bytes() for path in yours] == content
    check("an upgrade keeps profile, settings and runs", kept, f"{len(yours)} files")
    check("an upgrade starts again what ran", unit("ActiveState") == "active")
    listed = until("the runs", lambda: stage.ask("GET", "/v1/runs"))
    check("the runs are listed", listed, [run["name"] for run in listed])


def starts() -> None:
    """Drives and interferometer appear; the stage is opened."""
    shell("tar", "-xf", "/srv/cache.tar", "-C", "/var/cache/stagectl")
    shell("chown", "-R", "stagectl:stagectl", "/var/cache/stagectl")
    stage_pc.start_rig()
    status = stage.await_state("idle", patience_s=300.0)
    check("it opens the stage once the hardware is there", True, status["backend_description"])
    check("the host refused the servo nothing", not status["remarks"], status["remarks"])


def hardened() -> None:
    """Real time and hardening, read back from /proc and from systemd."""
    pid = servo_pid()
    policy, priority = os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority
    check("the servo is SCHED_FIFO 60", (policy, priority) == (os.SCHED_FIFO, 60), (policy, priority))
    check("the servo is on the isolated CPU", os.sched_getaffinity(pid) == {1}, os.sched_getaffinity(pid))
    facts = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    locked_kb, resident_kb = int(facts["VmLck"].split()[0]), int(facts["VmRSS"].split()[0])
    check("the servo's memory is locked", locked_kb > 0.5 * resident_kb, f"{locked_kb} of {resident_kb} kB")
    capabilities = [facts[name].strip() for name in ("CapEff", "CapPrm", "CapInh", "CapAmb", "CapBnd")]
    check("it has no capability, and no way to one", set(capabilities) == {"0" * 16}, capabilities)
    confined = facts["NoNewPrivs"].strip(), facts["Seccomp"].strip()
    check("it gains no privileges, and its system calls are filtered", confined == ("1", "2"), confined)
    check("it is no root", facts["Uid"].split()[0] != "0", facts["Uid"].split())
    check("the kernel is PREEMPT_RT", Path("/sys/kernel/realtime").read_text().strip() == "1", os.uname().release)
    exposure = shell("systemd-analyze", "security", "--no-pager", UNIT).strip().split("\n")[-1]
    level = float(exposure.split(":")[-1].split()[0])
    check(f"exposure is at most {EXPOSURE_LIMIT}", level <= EXPOSURE_LIMIT, level)
    tty = Path(os.path.realpath(PORT)).name
    latency = Path(f"/sys/bus/usb-serial/devices/{tty}/latency_timer").read_text().strip()
    check("the adapter has its name, and hands out within 1 ms", latency == "1", (tty, latency))


def moves() -> None:
    """Home, jog, move there and back, identify: through the API."""
    with stage.lease():
        home()
        began_m = stage.status()["positions"]["end_position_m"]
        stage.do("jog", distance_m=0.005)
        went_m = stage.status()["positions"]["end_position_m"] - began_m
        check("a jog of 5 mm", abs(went_m - 0.005) < 1e-4, f"{went_m * 1e3:.3f} mm")
        for target_m in (0.03, -0.01):
            stage.do("move", target_m=target_m)
            there_m = stage.status()["positions"]["end_position_m"]
            check(f"a move to {target_m * 1e3:g} mm", abs(there_m - target_m) < 1e-4, f"{there_m * 1e3:.3f} mm")
        found = stage.do("identify", duration_s=40.0)["backlash"]
        check("an identification has a result", found is not None and found["width_sd_m"] is not None)
        off_m = found["width_m"] - WIDTH_M
        text = f"{found['width_m'] * 1e6:.2f} um, {WIDTH_M * 1e6:.2f} true, sd {found['width_sd_m'] * 1e6:.2f}"
        check("its 95 % interval holds the true width", abs(off_m) <= 1.96 * found["width_sd_m"], text)
        health = stage.status()["health"]
        report.say(f"        cycles {health['cycles_count']}, missed {health['missed_cycles_count']}")
    check("the lease given back, the stage has no power", stage.await_state("idle")["state"] == "idle", rig()["drives"])
    said = shell("/usr/local/bin/stagectl", "status")
    check("the command says the same", "idle" in said)


# ---- hurt ------------------------------------------------------------------------------------------------------


def home() -> None:
    """Home the stage, where it isn't; it ends armed."""
    if stage.status()["homed"]:
        stage.do("arm")
    else:
        stage.do("home")


@contextmanager
def moving() -> Iterator[None]:
    """A stage under way: homed, armed, a long move begun; the lease is held."""
    with stage.lease():
        home()
        here_m = stage.status()["positions"]["end_position_m"]
        stage.begin("move", target_m=FAR_M if here_m < 0.5 * FAR_M else BACK_M)
        until("full speed", lambda: abs(rig()["plant"]["macro_velocity_m_per_s"]) > 0.03, 20.0)
        yield


@contextmanager
def homing() -> Iterator[None]:
    """A stage whose macro drive looks for its index by itself; the lease is held."""
    with stage.lease():
        stage.begin("home")
        until("the drive moves", lambda: abs(rig()["plant"]["macro_velocity_m_per_s"]) > 0.01, 60.0)
        yield


def stops(what: str, began_s: float) -> None:
    """Wait until the plant rests and no drive follows commands any more; a check of how long that took."""

    def rests() -> bool:
        state = rig()
        slow = abs(state["plant"]["macro_velocity_m_per_s"]) < AT_REST_M_PER_S
        return slow and "OPERATION_ENABLED" not in state["drives"].values()

    until(f"{what}: rest without power", rests, 60.0)
    took_s = time.monotonic() - began_s
    check(f"{what}: the drives stop the stage", took_s < DRIVES_STOP_S, f"{took_s:.1f} s, {rig()['drives']}")


def recovers(what: str) -> None:
    """Acknowledge what there is, and come to idle without a restart by hand."""
    state = stage.await_state("idle", "fault", "off")
    if state["state"] == "fault":
        fault = stage.acknowledge()
        report.say(f"        fault {fault['kind']}: {fault['what']}: {fault['values'][:150]}; {fault['remedy']}")
    stage.await_state("idle")
    check(f"{what}: idle again", unit("ActiveState") == "active", f"{unit('NRestarts')} restarts")
    shell("systemctl", "reset-failed", UNIT)


def restarts_before() -> int:
    """Return how often systemd has restarted the unit."""
    return int(unit("NRestarts"))


def await_restart(what: str, before: int) -> None:
    """Wait for systemd's restart, and check it."""
    until(f"{what}: a restart", lambda: int(unit("NRestarts")) > before and unit("ActiveState") == "active")
    check(f"{what}: systemd brings the service back", True, f"result before {unit('Result')}")


def clock_step() -> None:
    """Somebody sets the clock, an hour on and back: nothing happens."""
    with stage.lease():
        home()
        before = stage.status()
        for step in ("+1 hour", "-1 hour"):
            shell("date", "--set", step)
            time.sleep(2.0)
        after = stage.status()
        cycles_count = after["health"]["cycles_count"] - before["health"]["cycles_count"]
        same = after["state"] == "armed" and after["fault"] is None
        check(
            "clock stepped: it holds the stage", same and cycles_count > 200, f"{after['state']}, {cycles_count} cycles"
        )
        stage.do("jog", distance_m=-0.002)
    stage.await_state("idle")
    check("clock stepped: systemd sees nothing", unit("ActiveState") == "active", f"{unit('NRestarts')} restarts")


def can_down() -> None:
    """The CAN interface is taken down under a moving stage, and comes up again."""
    with moving():
        began_s = time.monotonic()
        shell("ip", "link", "set", "vcan0", "down")
        stops("vcan0 down", began_s)
    fault = stage.await_state("fault")["fault"]
    check("vcan0 down: a fault says so", fault["kind"] in ("LINK_LOST", "LINK_SILENT", "LinkError"), fault["kind"])
    shell("ip", "link", "set", "vcan0", "up")
    recovers("vcan0 up")


def serial_unplug() -> None:
    """The interferometer's adapter is pulled under a moving stage, and plugged in again."""
    serials = Path("/sys/bus/usb/devices").glob("*/serial")
    adapter = next(path.parent for path in serials if path.read_text().strip() in PORT)
    with moving():
        began_s = time.monotonic()
        (adapter / "authorized").write_text("0")
        stops("unplugged", began_s)
    fault = stage.await_state("fault")["fault"]
    check("unplugged: a fault says so", fault["kind"] in ("LINK_LOST", "SENSOR_AGE", "LinkError"), fault["kind"])
    check("unplugged: homing is void", not stage.status()["homed"])
    stage.acknowledge()
    waits = until("unplugged: it waits", lambda: stage.status()["waiting_for"])
    check("unplugged: it waits for the port", "LASER001" in waits, waits)
    (adapter / "authorized").write_text("1")
    until(PORT, lambda: os.path.exists(PORT), 30.0)
    recovers("plugged in")


def kill_servo() -> None:
    """The servo is killed under a moving stage."""
    with moving():
        began_s = time.monotonic()
        os.kill(servo_pid(), signal.SIGKILL)
        stops("servo killed", began_s)
    fault = stage.await_state("fault")["fault"]
    check("servo killed: a fault says so", fault["kind"] == "LinkError", fault["values"][:120])
    recovers("servo killed")


def kill_supervisor() -> None:
    """The supervisor is killed under a moving stage: the servo stops it, systemd brings the service back."""
    before = restarts_before()
    with moving():
        began_s = time.monotonic()
        os.kill(int(unit("MainPID")), signal.SIGKILL)
        stops("supervisor killed", began_s - SUPERVISOR_SILENCE_S)
    await_restart("supervisor killed", before)
    recovers("supervisor killed")


def watchdog() -> None:
    """The supervisor hangs while the drive homes: the stage stops, the watchdog ends the service, and it restarts."""
    before = restarts_before()
    with homing():
        began_s = time.monotonic()
        os.kill(int(unit("MainPID")), signal.SIGSTOP)
        stops("supervisor hangs", began_s)
    await_restart("supervisor hangs", before)
    said = shell("journalctl", "-u", UNIT, "--no-pager", "-o", "cat")
    check("supervisor hangs: it was the watchdog", "Watchdog timeout" in said)
    recovers("supervisor hangs")


def out_of_memory() -> None:
    """The kernel kills for want of memory while the drive homes: the stage stops, systemd restarts the service."""
    before = restarts_before()
    with homing():
        began_s = time.monotonic()
        shell("systemctl", "set-property", "--runtime", UNIT, "MemoryMax=64M")
        stops("out of memory", began_s)
        shell("systemctl", "set-property", "--runtime", UNIT, "MemoryMax=infinity")
    killed = shell("journalctl", "-k", "--no-pager", "-o", "cat").count("Memory cgroup out of memory: Killed process")
    check("out of memory: the kernel killed", killed > 0, f"{killed} processes")
    if not pids("stagectl.serv") or int(unit("NRestarts")) > before:
        await_restart("out of memory", before)
    recovers("out of memory")


def recovered() -> None:
    """After all that, the stage homes, moves and records as before."""
    with stage.lease():
        home()
        stage.do("move", target_m=0.01)
    stage.await_state("idle")
    check("after all that it homes and moves", True)
    rows = [(run["name"], run["state"], run["rows_count"]) for run in stage.ask("GET", "/v1/runs")]
    unreadable = [run for run in rows if run[1] not in ("complete", "recovered", "open", "crashed", "running")]
    check("every run can be read", len(rows) > 5 and not unreadable, unreadable or f"{len(rows)} runs")


GROUPS: tuple[Callable[[], None], ...] = (
    hardened, moves, clock_step, can_down, serial_unplug, kill_servo, kill_supervisor, watchdog, out_of_memory,
    recovered,
)  # fmt: skip


# ---- removed ---------------------------------------------------------------------------------------------------


def removed(before: set[str]) -> None:
    """It stops as asked, and leaves nothing."""
    shell("systemctl", "stop", UNIT)
    check("it stops without a complaint", unit("Result") == "success", unit("Result"))
    check("nothing of it runs", not pids("."), pids("."))
    shell(INSTALL, "uninstall")
    after = everything()
    check("uninstall leaves nothing", not after - before, sorted(after - before)[:20])
    check("and takes nothing of others", not before - after, sorted(before - after)[:20])
    leaves = subprocess.run(["systemctl", "cat", UNIT], capture_output=True).returncode != 0
    check("systemd knows no such unit any more", leaves)


def tried(what: Callable[[], None]) -> bool:
    """Do a group of checks; what breaks it is a failed check."""
    report.say(f"----    {(what.func if isinstance(what, partial) else what).__doc__}")
    try:
        what()
    except (Failed, OSError, KeyError, TypeError, StopIteration) as error:
        check("these checks came to their end", False, f"{type(error).__name__}: {error}")
        return False
    return True


def main() -> int:
    """Do it all; 1 where a check failed."""
    names = (stage_pc.HERE / "only").read_text().split()
    before = everything()
    if all(tried(what) for what in (installed, upgraded, starts)):
        for what in GROUPS:
            if not names or what.__name__ in names:
                tried(what)
    tried(partial(removed, before))
    if report.failed:
        rig_log = RIG_FOLDER / "log"
        print(rig_log.read_text()[-3000:] if rig_log.exists() else "")
        print(shell("journalctl", "-u", UNIT, "--no-pager", "-o", "short-monotonic")[-12000:])
    print(f"{report.count} checks, {len(report.failed)} failed", *report.failed, sep="; ")
    return 1 if report.failed else 0


if __name__ == "__main__":
    sys.exit(main())
