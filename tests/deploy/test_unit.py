"""The systemd unit against a table of what it must say, and against systemd's own judgement of it."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from stagectl import servo_process

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
UNIT = DEPLOY / "stagectl.service"
EXPOSURE_LIMIT_TENTHS = 20

REQUIRED = {
    # service
    "Type": "notify",
    "NotifyAccess": "main",
    "Restart": "on-failure",
    "RestartPreventExitStatus": "2",
    "KillMode": "process",
    "OOMPolicy": "continue",
    # place
    "User": "stagectl",
    "Group": "stagectl",
    "SupplementaryGroups": "dialout",
    "StateDirectory": "stagectl stagectl/runs",
    "CacheDirectory": "stagectl",
    "RuntimeDirectory": "stagectl",
    # real time
    "CPUAffinity": "0 1",
    "LimitMEMLOCK": "infinity",
    # hardening
    "NoNewPrivileges": "yes",
    "CapabilityBoundingSet": "",
    "AmbientCapabilities": "",
    "PrivateUsers": "yes",
    "PrivateTmp": "yes",
    "ProtectSystem": "strict",
    "ProtectHome": "yes",
    "ProtectProc": "invisible",
    "ProtectClock": "yes",
    "ProtectControlGroups": "yes",
    "ProtectHostname": "yes",
    "ProtectKernelLogs": "yes",
    "ProtectKernelModules": "yes",
    "ProtectKernelTunables": "yes",
    "LockPersonality": "yes",
    "RestrictNamespaces": "yes",
    "RestrictSUIDSGID": "yes",
    "DevicePolicy": "closed",
    "SystemCallArchitectures": "native",
    "IPAddressDeny": "any",
    "IPAddressAllow": "localhost",
}
# Each of these takes something that the servo can't do without; "no" is systemd's default.
FORBIDDEN = {
    "MemoryDenyWriteExecute": "compiled code",
    "PrivateDevices": "serial ports",
    "PrivateNetwork": "CAN interfaces",
    "RestrictRealtime": "SCHED_FIFO",
    "RemoveIPC": "rows of a killed servo in /dev/shm",
    "TemporaryFileSystem": "rows of a killed servo in /dev/shm",
    "InaccessiblePaths": "/dev/shm, /sys",
    "MemoryMax": "locked memory",
    "LimitRTTIME": "SCHED_FIFO for months",
}


def directives(path: Path) -> dict[str, list[str]]:
    """Return all values of each directive of a unit, in their order."""
    found: dict[str, list[str]] = {}
    for line in path.read_text().splitlines():
        if line and line[0] not in "#[;":
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
    return found


@pytest.fixture(scope="module")
def unit():
    return directives(UNIT)


@pytest.mark.parametrize(("name", "value"), REQUIRED.items())
def test_the_unit_says_what_it_must(unit, name, value):
    assert unit.get(name) == [value]


@pytest.mark.parametrize("name", FORBIDDEN)
def test_the_unit_takes_nothing_that_the_servo_needs(unit, name):
    assert name not in unit, f"{name} takes away: {FORBIDDEN[name]}"


def test_the_priority_that_the_servo_takes_is_allowed(unit):
    assert int(unit["LimitRTPRIO"][0]) >= servo_process._PRIORITY


def test_bus_socket_and_ports_are_allowed(unit):
    families = unit["RestrictAddressFamilies"][0].split()
    assert set(families) == {"AF_UNIX", "AF_CAN", "AF_INET"}
    assert {"char-ttyS rw", "char-ttyUSB rw", "char-ttyACM rw", "char-pts rw"} == set(unit["DeviceAllow"])


def test_the_watchdog_waits_longer_than_a_stop_that_the_servo_makes(unit):
    watchdog_s = float(unit["WatchdogSec"][0])
    assert 2.0 < watchdog_s <= 10.0
    assert float(unit["TimeoutStopSec"][0]) > watchdog_s


@pytest.fixture(scope="module")
def calls_of():
    analyze = _tool("systemd-analyze")

    def expand(sets):
        """Return the names of all system calls of some sets, and of the sets within them."""
        found = set()
        for line in subprocess.run([analyze, "syscall-filter", *sets], capture_output=True, text=True).stdout.split(
            "\n"
        ):
            word = line.strip()
            if line.startswith(" ") and word and not word.startswith("#"):
                found |= expand([word]) if word.startswith("@") else {word}
        return found

    return expand


def test_the_system_calls_of_the_servo_are_allowed(unit, calls_of):
    allowed = set()
    for value in unit["SystemCallFilter"]:
        sets = value.removeprefix("~").split()
        allowed = allowed - calls_of(sets) if value.startswith("~") else allowed | calls_of(sets)
    needed = (
        "mlockall sched_setscheduler sched_setaffinity clock_nanosleep prctl mmap ioctl flock socket bind epoll_wait"
    )
    assert not set(needed.split()) - allowed
    refused = {"mount", "init_module", "ptrace", "chroot", "reboot", "bpf", "settimeofday"}
    assert refused & allowed == set()


def _tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"this host has no {name}")
    return path


def test_systemd_finds_nothing_wrong(tmp_path):
    """The programs that the unit names are made, as empty files: they exist only where it is installed."""
    analyze = _tool("systemd-analyze")
    for name in ("venv/bin/stagectl", "deploy/await_servo.sh"):
        program = tmp_path / "current" / name
        program.parent.mkdir(parents=True)
        program.touch(0o755)
    copy = tmp_path / "stagectl.service"
    copy.write_text(UNIT.read_text().replace("/opt/stagectl/", f"{tmp_path}/"))
    found = subprocess.run([analyze, "verify", "--man=no", str(copy)], capture_output=True, text=True)
    ours = [line for line in found.stderr.splitlines() if "stagectl" in line]
    assert ours == []
    assert found.returncode == 0, found.stderr

    copy.write_text(copy.read_text().replace("WatchdogSec", "WatchdogSecs"))
    found = subprocess.run([analyze, "verify", "--man=no", str(copy)], capture_output=True, text=True)
    assert "WatchdogSecs" in found.stderr  # it looks


def test_the_exposure_is_within_its_limit():
    analyze = _tool("systemd-analyze")
    helped = subprocess.run([analyze, "--help"], capture_output=True, text=True).stdout
    if "--offline" not in helped:
        pytest.skip("this systemd-analyze can't judge a file (before systemd 250)")
    command = [analyze, "security", "--offline=true", "--no-pager", f"--threshold={EXPOSURE_LIMIT_TENTHS}", str(UNIT)]
    found = subprocess.run(command, capture_output=True, text=True)
    overall = re.search(r"exposure level for stagectl.service: ([0-9.]+)", found.stdout)
    assert overall, found.stdout + found.stderr
    assert float(overall[1]) <= EXPOSURE_LIMIT_TENTHS / 10
    assert found.returncode == 0


RULE = re.compile(
    r'([A-Z]+(?:\{[\w-]+\})?)(==|!=|\+=|:=|=)"([^"]*)"(?:,\s*|$)',
)
RULE_KEYS = {"ACTION", "SUBSYSTEM", "DRIVER", "ENV", "ATTR", "SYMLINK"}
MATCHED_KEYS = {"ACTION", "SUBSYSTEM", "DRIVER"}


def rules():
    """Return the udev rules as lists of (key, operator, value)."""
    found = []
    for line in (DEPLOY / "stagectl.rules").read_text().splitlines():
        if line and not line.startswith("#"):
            parts = RULE.findall(line)
            assert RULE.sub("", line) == "", f"not a rule: {line}"
            found.append(parts)
    return found


def test_every_udev_rule_is_well_formed():
    for rule in rules():
        for key, operator, _value in rule:
            name = key.partition("{")[0]
            assert name in RULE_KEYS
            assert (operator in ("==", "!=")) >= (name in MATCHED_KEYS)
        assert any(operator in ("=", "+=") for _key, operator, _value in rule)


def test_udev_rules_give_stable_names_and_a_millisecond_of_latency():
    given = {(key, value) for rule in rules() for key, operator, value in rule if operator in ("=", "+=")}
    assert ("SYMLINK", "stagectl/$env{ID_SERIAL_SHORT}-if$env{ID_USB_INTERFACE_NUM}") in given
    assert ("ATTR{latency_timer}", "1") in given
