"""Installed, upgraded, read back, removed."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import stage_pc
from stage_pc import PORT, UNIT, Failed, check, pids, rig, servo_pid, shell, stage, unit, until

INSTALL = "/srv/stagectl/deploy/install.sh"
INSTALL_BEFORE = "/srv/before/deploy/install.sh"
PROGRAM = Path("/opt/stagectl")

PROFILE = Path("/etc/stagectl/stage-100hz.toml")
RUNS = Path("/var/lib/stagectl/runs")
DROP_IN = Path("/etc/systemd/system/stagectl.service.d/guest.conf")
FOLDERS = ("/", "/run/stagectl", "/dev/shm", "/dev/stagectl")
# No disk's, or this test's own.
PASSED_OVER = {"/proc", "/sys", "/dev", "/run", "/tmp", "/var/tmp", "/srv", "/mnt"}
# The system's own: its state and logs, and the copies that it keeps of the accounts' files.
OF_THE_SYSTEM = (
    "/var/lib/systemd/", "/var/log/journal/", "/var/lib/dbus/", "/var/cache/ldconfig/", "/etc/ld.so.cache",
    "/etc/machine-id", "/etc/passwd-", "/etc/group-", "/etc/shadow-", "/etc/gshadow-", "/etc/subuid-", "/etc/subgid-",
    "/etc/.pwd.lock",
)  # fmt: skip
# Between packages and sources only the links count: what lies in an environment is pip's.
ENVIRONMENT = "/venv/"
EXPOSURE_LIMIT = 2.0
RELOADS_S = 60.0
VELOCITY_LIMIT, SLOWER_M_PER_S = "velocity_limit_m_per_s = 0.05", 0.04
LIMITS = [["unlimited", "unlimited"], ["60", "60"]]


def everything() -> set[str]:
    """Return all paths and accounts that an installation could leave behind."""
    found = set()
    for folder in FOLDERS:
        for place, folders, files in os.walk(folder):
            place = place.rstrip("/")
            folders[:] = [n for n in folders if f"/{n}/" != ENVIRONMENT and f"{place}/{n}" not in PASSED_OVER]
            found.update(f"{place}/{name}" for name in [*folders, *files])
    accounts = [*Path("/etc/passwd").read_text().split("\n"), *Path("/etc/group").read_text().split("\n")]
    return {path for path in found if not path.startswith(OF_THE_SYSTEM)} | {line for line in accounts if line}


def bring_release(before: bool) -> Path:
    """Put a release that the image has unpacked where install.sh would unpack it; that one finds it there."""
    PROGRAM.mkdir(exist_ok=True)
    for folder in Path("/srv/releases").iterdir():
        if (folder / "CHANGELOG.md").read_text().endswith("The release before.\n") == before:
            return folder.rename(PROGRAM / folder.name)
    raise Failed(f"the image has no release {'before' if before else 'to install'}")


def installed() -> None:
    """The release before is installed, twice, and given a profile and a run."""
    bring_release(before=True)
    shell(INSTALL_BEFORE, "install")
    first = everything()
    shell(INSTALL_BEFORE, "install")
    check("installing a second time changes nothing", everything() == first, sorted(everything() ^ first)[:10])
    shutil.copytree("/srv/runs", RUNS, dirs_exist_ok=True)
    shell("chown", "-R", "stagectl:stagectl", str(RUNS))
    configure()


def ready() -> None:
    """The release is installed and given a profile, without further questions."""
    release = bring_release(before=False)
    rig.start(release)  # nothing is connected to it yet
    # The machine that the service's own rig plays for this profile.
    shutil.copy(stage_pc.HERE / "machine.toml", release / "sim_backend/machines" / PROFILE.name)
    shell(INSTALL, "install")
    configure()


def configure() -> None:
    """Give the service its profile, the processor that its code was compiled for, and time to start in.

    What takes 1.4 s of a processor takes 20 s of one that is emulated, and 120 s of one that has a host's third.
    """
    shutil.copy(stage_pc.HERE / PROFILE.name, PROFILE)
    Path("/etc/stagectl/stagectl.env").write_text(f"STAGECTL_SERVE={PROFILE.stem} --backend hardware\n")
    DROP_IN.parent.mkdir(parents=True)
    generic = " ".join(f"{name}={value}" for name, value in stage_pc.GENERIC.items())
    DROP_IN.write_text(f"[Service]\nEnvironment={generic}\nTimeoutStartSec={stage_pc.PATIENCE_S:g}\n")
    shell("systemctl", "daemon-reload")


def upgraded() -> None:
    """Without hardware it waits and says so; an upgrade stops it, keeps what is yours, and starts it again."""
    shell("systemctl", "start", UNIT)
    waits = stage.await_state("off")["waiting_for"]
    check("without hardware it waits, and says so", "vcan0" in waits and "LASER001" not in waits, waits)
    yours = [path for folder in (PROFILE.parent, RUNS) for path in folder.rglob("*") if path.is_file()]
    content = [path.read_bytes() for path in yours]
    release = os.readlink(PROGRAM / "current")
    rig.start(bring_release(before=False))  # nothing is connected to it yet
    fails_to_start(release)
    shell(INSTALL, "upgrade")
    now = os.readlink(PROGRAM / "current")
    check("an upgrade switches to the new release", now != release, now)
    kept = len(yours) > 3 and all(path.exists() for path in yours) and [path.read_bytes() for path in yours] == content
    check("an upgrade keeps profile, settings and runs", kept, f"{len(yours)} files")
    check("an upgrade starts again what ran", unit("ActiveState") == "active")
    listed = until("the runs", lambda: stage.ask("GET", "/v1/runs"))
    check("the runs are listed", listed, [run["name"] for run in listed])


def fails_to_start(release: str) -> None:
    """An upgrade to what doesn't start ends with an error, and with `release` running as before."""
    refusing = DROP_IN.with_name("refusing.conf")
    refusing.write_text(f"[Service]\nExecStartPre=/bin/sh -c 'test $$(readlink {PROGRAM}/current) = {release}'\n")
    shell("systemctl", "daemon-reload")
    failed = subprocess.run([INSTALL, "upgrade"], capture_output=True, text=True)
    left = os.readlink(PROGRAM / "current"), unit("ActiveState")
    went_back = failed.returncode != 0 and left == (release, "active")
    check("an upgrade to what does not start leaves the one before running", went_back, f"{left}, {failed.stderr}")
    refusing.unlink()
    shell("systemctl", "daemon-reload")


def hardened(pid: int) -> None:
    """What a process of the unit can't do, read back from /proc, and what systemd says of the unit."""
    facts = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    capabilities = [facts[name].strip() for name in ("CapEff", "CapPrm", "CapInh", "CapAmb", "CapBnd")]
    check("it has no capability, and no way to one", set(capabilities) == {"0" * 16}, capabilities)
    secure = facts["NoNewPrivs"].strip(), facts["Seccomp"].strip()
    check("it gains no privileges, and its system calls are filtered", secure == ("1", "2"), secure)
    check("it is no root", facts["Uid"].split()[0] != "0", facts["Uid"].split())
    exposure = shell("systemd-analyze", "security", "--no-pager", UNIT).strip().split("\n")[-1]
    level = float(exposure.split(f"{UNIT}:")[1].split()[0])
    check(f"exposure is at most {EXPOSURE_LIMIT}", level <= EXPOSURE_LIMIT, level)


def confined() -> None:
    """Hardening and real time that the unit gives, read back from /proc and from systemd."""
    pid = int(unit("MainPID"))
    hardened(pid)
    check("it has two CPUs, the servo's among them", os.sched_getaffinity(pid) == {0, 1}, os.sched_getaffinity(pid))
    limits = Path(f"/proc/{pid}/limits").read_text()
    granted = [line.split()[3:5] for line in limits.splitlines() if line.startswith(("Max realtime p", "Max locked"))]
    check("it may lock memory, and run at priority 60", granted == LIMITS, granted)
    check("the kernel is PREEMPT_RT", Path("/sys/kernel/realtime").read_text().strip() == "1", os.uname().release)
    tty = Path(os.path.realpath(PORT)).name
    latency = Path(f"/sys/bus/usb-serial/devices/{tty}/latency_timer").read_text().strip()
    check("the adapter has its name, and hands out within 1 ms", latency == "1", f"{tty}, {latency} ms")


def reloaded() -> None:
    """`systemctl reload`, hardened and without power: a wrong profile changes nothing, a right one is read."""
    good = PROFILE.read_text()
    slower = good.replace(VELOCITY_LIMIT, f"velocity_limit_m_per_s = {SLOWER_M_PER_S}", 1)
    servo = servo_pid()
    _reload(good.replace(VELOCITY_LIMIT, "velocity_limit_m_per_s = nan", 1), "kept as it was")
    status = stage.status()
    check("with a wrong profile the stage stays open", (status["state"], servo_pid()) == ("idle", servo))
    _reload(slower, "read again")
    until("another servo", lambda: servo_pid() != servo)
    status = stage.await_state("idle", "fault")
    check("the stage is opened with the new one", status["state"] == "idle", status["fault"])
    limit_m_per_s = status["limits"]["velocity_m_per_s"]
    check("its limit is the new one's", limit_m_per_s == SLOWER_M_PER_S, limit_m_per_s)


def _reload(profile: str, wanted: str) -> None:
    """Have the service read this; a check of what it says of that in the journal."""

    def lines() -> list[str]:
        said = shell("journalctl", "-u", UNIT, "--no-pager", "-o", "cat").splitlines()
        return [line for line in said if line.startswith('{"event": "profile"')]

    earlier = lines()
    PROFILE.write_text(profile)
    shell("systemctl", "reload", UNIT)
    (line,) = until("the profile is read", lambda: lines()[len(earlier) :], RELOADS_S)
    check(f"reloaded, the log says: {wanted}", json.loads(line)["text"].startswith(wanted), line[:200])


def removed(before: set[str]) -> None:
    """It stops as asked, and leaves nothing."""
    shell("systemctl", "stop", UNIT)
    check("it stops without a complaint", unit("Result") == "success", unit("Result"))
    check("nothing of it runs", not pids("."), pids("."))
    rig.stop()
    shell(INSTALL, "uninstall", "--yes")
    after = everything()
    check("uninstall leaves nothing", not after - before, sorted(after - before)[:20])
    check("and takes nothing of others", not before - after, sorted(before - after)[:20])
    leaves = subprocess.run(["systemctl", "cat", UNIT], capture_output=True).returncode != 0
    check("systemd knows no such unit any more", leaves)
