"""What is done to a service of real processes: each kind with how soon it must be noticed.

The profile's limits are those of a patient host (`tests.service.daemon.PATIENT`).
"""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass

import httpx
import numpy as np

from stagectl.client import Client
from stagectl.errors import StagectlError
from stagectl.service.access import Role, read_tokens
from tests.faults.house import House
from tests.service.daemon import servo_pid

CYCLE_S = 1e-3
SENSOR_S, RPDO_S, HEARTBEAT_S, LEASE_S, SUPERVISOR_S = 0.3, 0.1, 2.0, 2.0, 0.5  # as the profile has them
DISK_S = 0.5  # rows go onto the disk every 0.25 s; the supervisor hears with the next ones that it took none
_CASES_COUNT = 3  # of every operation of the API, with data that fit and with data that don't
_NO_LEASE = ("/v1/record", "/v1/record/trigger")


@dataclass(frozen=True)
class Kind:
    """One fault: what is done, how soon it must be noticed, what is left of the processes."""

    strike: Callable[[House], None]
    detection_s: float = CYCLE_S
    must_stop: bool = True
    may_stop: bool = True
    without_power: bool = False
    lasts_s: float = 0.0
    by_drives: bool = False  # the drives stop it by themselves: how late the servo was is no excuse
    open_loop: bool = False  # the drive keeps its last force until the fault is noticed
    disk_bytes: int = 0  # of a disk of its own for the runs; 0 = none


def killed_child(house: House) -> None:
    """Kill the servo; the supervisor, with whom the rig would go, looks away until the drives have stopped it."""
    supervisor = house.daemon.process.pid
    os.kill(supervisor, signal.SIGSTOP)
    _later(1.0, lambda: _go_on(supervisor))
    os.kill(servo_pid(house.daemon), signal.SIGKILL)


def stopped_child(house: House) -> None:
    pid = servo_pid(house.daemon)
    os.kill(pid, signal.SIGSTOP)
    _later(3.0, lambda: _go_on(pid))


def _later(delay_s: float, action: Callable[[], object]) -> None:
    timer = threading.Timer(delay_s, action)
    timer.daemon = True
    timer.start()


def _go_on(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def killed_supervisor(house: House) -> None:
    house.daemon.process.kill()
    house.daemon.process.wait()


def stopped_supervisor(house: House) -> None:
    pid = house.daemon.process.pid
    os.kill(pid, signal.SIGSTOP)
    _later(1.5, lambda: _go_on(pid))


def killed_both(house: House) -> None:
    servo = servo_pid(house.daemon)
    os.kill(servo, signal.SIGKILL)
    killed_supervisor(house)


def second_operator(house: House) -> None:
    with Client(house.daemon.socket) as other:
        for token in ("", "guessed"):
            other.lease_token = token
            asked = {
                "arm": other.arm,
                "home": other.home,
                "move": lambda: other.move(0.0),
                "begin to jog": other.begin_jog,
                "jog": lambda: other.jog_at("jog-1", 0.1),
                "renew": other.renew_lease,
                "give back": other.give_lease_back,
                "take": lambda: other.take_lease("bert"),
            }
            for name, ask in asked.items():
                with contextlib.suppress(StagectlError):
                    ask()
                    house.accepted.append(name)


def hostile_bytes(house: House) -> None:
    """Whatever a port scanner, a broken proxy or a fuzzer sends."""
    rng = np.random.default_rng(1)
    pieces = (
        b"POST /v1/move HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n\r\n",
        b"POST /v1/arm HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n{}",
        b"GET /v1/status HTTP/9.9\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        rng.bytes(4096),
        b"A" * 100_000,
        b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 5000 + b"\r\n",
    )
    for piece in pieces:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as one:
            one.settimeout(0.1)
            one.connect(str(house.daemon.socket))
            one.sendall(piece)
            one.recv(1000)


def hostile_api(house: House) -> None:
    """Everything that the OpenAPI document allows, and what it doesn't, over TCP, beside the one who holds the lease.

    `stop` is left out: anybody may. What needs the lease must be refused, and nothing may end in a server error.
    """
    import schemathesis
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis.errors import Unsatisfiable
    from schemathesis import GenerationMode

    tokens = read_tokens(house.daemon.state / "tokens")
    url = f"http://127.0.0.1:{house.daemon.tcp_port}"
    headers = {"Authorization": f"Bearer {tokens[Role.OPERATE]}"}
    document = httpx.get(f"{url}/openapi.json", headers=headers, trust_env=False).json()
    for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
        for result in schemathesis.openapi.from_dict(document).get_all_operations():
            operation = result.ok()
            if operation.path == "/v1/stop":
                continue

            @settings(
                max_examples=_CASES_COUNT,
                deadline=None,
                database=None,
                derandomize=True,
                phases=[Phase.explicit, Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(case=operation.as_strategy(generation_mode=mode))
            def once(case):
                if "wait_s" in (case.query or {}):
                    case.query["wait_s"] = 0
                answer = case.call(base_url=url, headers=headers, timeout=10)
                label = f"{case.operation.label}: {answer.status_code}"
                if answer.status_code >= 500 and answer.status_code != 503:  # 503: beyond 100 connections
                    house.accepted.append(label)
                if case.method != "GET" and answer.status_code < 300 and case.operation.path not in _NO_LEASE:
                    house.accepted.append(label)

            with contextlib.suppress(Unsatisfiable):
                once()


def full_disk(house: House) -> None:
    """Leave no byte on the disk that the runs are on."""
    with contextlib.suppress(OSError), (house.daemon.runs.parent / "filler").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 16))
    _later(1.5, lambda: (house.daemon.runs.parent / "filler").unlink(missing_ok=True))


def nonsense_profile(house: House) -> None:
    kept = house.daemon.profile.read_text()
    house.daemon.profile.write_text('name = "x"\n[macro]\nmass_kg = nan\n')
    house.daemon.process.send_signal(signal.SIGHUP)
    _later(1.0, lambda: house.daemon.profile.write_text(kept))


def client_vanishes(house: House) -> None:
    """A client's program ends while it holds the key."""
    house.vanish()


def _rig(**fault) -> Callable[[House], None]:
    return lambda house: house.rig_fault(**fault)


KINDS: dict[str, Kind] = {
    "servo killed": Kind(killed_child, RPDO_S, by_drives=True, open_loop=True),
    "supervisor killed": Kind(killed_supervisor, SUPERVISOR_S),
    "both killed": Kind(killed_both, RPDO_S, by_drives=True, open_loop=True),
    "servo stopped": Kind(stopped_child, RPDO_S, lasts_s=3.5, by_drives=True, open_loop=True),
    "supervisor stopped": Kind(stopped_supervisor, SUPERVISOR_S, lasts_s=1.6),
    "client vanishes in mid jog": Kind(client_vanishes, LEASE_S, lasts_s=2.5),
    "beam break": Kind(_rig(kind="beam_loss", axis="macro", duration_s=0.5), 3 * CYCLE_S, lasts_s=0.5),
    "unplug and replug": Kind(_rig(kind="unplug", duration_s=0.5), 3 * CYCLE_S, lasts_s=0.6),
    "bus-off and back": Kind(_rig(kind="bus_off", duration_s=0.4), 3 * CYCLE_S, lasts_s=0.4),
    "interferometer silent": Kind(_rig(kind="sensor_silence", duration_s=0.6), SENSOR_S, lasts_s=0.6, open_loop=True),
    "EMCY": Kind(_rig(kind="emergency", node_id=1, code=0x7305), 3 * CYCLE_S),
    "drive reboot": Kind(_rig(kind="power_loss", node_id=1, duration_s=0.5), SENSOR_S, without_power=True, lasts_s=0.6),
    "frames lost": Kind(_rig(kind="drop_frame", can_id=0x201, duration_s=0.5), RPDO_S, lasts_s=0.5, open_loop=True),
    "drive's heartbeat lost": Kind(
        _rig(kind="heartbeat_silence", node_id=1, duration_s=3.0), HEARTBEAT_S + 0.3, lasts_s=3.2
    ),
    "two operators": Kind(second_operator, must_stop=False, may_stop=False),
    "hostile bytes": Kind(hostile_bytes, must_stop=False, may_stop=False),
    "hostile API (schemathesis)": Kind(hostile_api, must_stop=False, may_stop=False),
    "disk full": Kind(full_disk, DISK_S, lasts_s=2.0, disk_bytes=64 << 20),
    "nonsense profile": Kind(nonsense_profile, must_stop=False, may_stop=False, lasts_s=1.2),
}
"""Every kind, by the name that the tables use."""
