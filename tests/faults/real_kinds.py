"""What is done to a service of real processes, drawn from a seed: each kind with how soon it must be noticed.

The profile's limits are those of a patient host (`tests.service.daemon.PATIENT`).
"""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import httpx
import numpy as np

from stagectl.client import Client
from stagectl.errors import StagectlError
from stagectl.service.access import Role, read_tokens
from tests.faults.draws import between, one_of
from tests.faults.house import House
from tests.faults.kinds import CYCLE_S, NEVER_S, Drawn
from tests.faults.nonsense import nonsense
from tests.service.daemon import servo_pid

AT_ONCE_S = 3 * CYCLE_S
SENSOR_S, RPDO_S, HEARTBEAT_S, LEASE_S, SUPERVISOR_S = 0.3, 0.1, 2.0, 2.0, 0.5  # as the profile has them
_LOOKS_AWAY_S = 1.5
DISK_S = 0.5  # rows go onto the disk every 0.25 s; the supervisor hears with the next ones that it took none
_CASES_COUNT = 3  # of every operation of the API, with data that fit and with data that don't; one as who may not
_NO_LEASE = ("/v1/record", "/v1/record/trigger")


@dataclass(frozen=True)
class Real:
    """A fault as it was drawn, and what only processes have; its `act` is on a house."""

    drawn: Drawn
    by_drives: bool = False  # the drives stop it by themselves: how late the servo was is no excuse
    disk_bytes: int = 0  # of a disk of its own for the runs; 0 = none


Draw = Callable[[np.random.Generator, Sequence[int]], Real]
"""From a generator and the ids of the stage's nodes, macro first."""


def killed_child(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    """Kill the servo; the supervisor, with whom the rig would go, looks away until the drives have stopped it."""

    def act(house: House) -> None:
        supervisor = house.daemon.process.pid
        os.kill(supervisor, signal.SIGSTOP)
        _later(_LOOKS_AWAY_S, lambda: _go_on(supervisor))
        os.kill(servo_pid(house.daemon), signal.SIGKILL)

    return Real(Drawn("servo killed", act=act, detection_s=RPDO_S, open_loop=True), by_drives=True)


def stopped_child(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    duration_s = between(rng, 0.03, 3.5)

    def act(house: House) -> None:
        pid = servo_pid(house.daemon)
        os.kill(pid, signal.SIGSTOP)
        _later(duration_s, lambda: _go_on(pid))

    text, must = f"servo stopped for {duration_s * 1e3:.0f} ms", duration_s > 1.5 * RPDO_S
    fault = Drawn(text, act=act, must_stop=must, detection_s=RPDO_S, lasts_s=duration_s, open_loop=True)
    return Real(fault, by_drives=True)


def _later(delay_s: float, action: Callable[[], object]) -> None:
    timer = threading.Timer(delay_s, action)
    timer.daemon = True
    timer.start()


def _go_on(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def _kill_supervisor(house: House) -> None:
    house.daemon.process.kill()
    house.daemon.process.wait()


def killed_supervisor(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    return Real(Drawn("supervisor killed", act=_kill_supervisor, detection_s=SUPERVISOR_S))


def stopped_supervisor(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    duration_s = float(rng.uniform(0.1, 1.5))

    def act(house: House) -> None:
        pid = house.daemon.process.pid
        os.kill(pid, signal.SIGSTOP)
        _later(duration_s, lambda: _go_on(pid))

    must = duration_s > SUPERVISOR_S + 0.1
    detection_s = SUPERVISOR_S if must else NEVER_S
    text = f"supervisor stopped for {duration_s * 1e3:.0f} ms"
    return Real(Drawn(text, act=act, must_stop=must, detection_s=detection_s, lasts_s=duration_s))


def killed_both(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    def act(house: House) -> None:
        os.kill(servo_pid(house.daemon), signal.SIGKILL)
        _kill_supervisor(house)

    return Real(Drawn("servo and supervisor killed", act=act, detection_s=RPDO_S, open_loop=True), by_drives=True)


def client_killed(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    return Real(Drawn("client killed", act=lambda house: house.vanish(), detection_s=LEASE_S, silent=True))


def client_hangs(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    """Its program is stopped: its socket stays open; when it goes on, its lease is over."""
    text = "client stopped, its socket stays open"
    return Real(Drawn(text, act=lambda house: house.vanish(half_open=True), detection_s=LEASE_S, silent=True))


def _of_rig(text: str, faults: dict, **known) -> Real:
    return Real(
        Drawn(text, act=lambda house: house.rig_fault(**faults), lasts_s=faults.get("duration_s", 0.0), **known)
    )


def beam_break(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    axis, duration_s = one_of(rng, ("macro", "end", "both")[: 1 if len(nodes) == 1 else 3]), between(rng, 5e-3, 0.8)
    fault = {"kind": "beam_loss", "axis": axis, "duration_s": duration_s}
    text = f"no beam on {axis} for {duration_s * 1e3:.0f} ms"
    return _of_rig(text, fault, detection_s=AT_ONCE_S, by_lasers=True)


def unplugged(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    duration_s = between(rng, 0.02, 0.8)
    text = f"interferometer unplugged for {duration_s * 1e3:.0f} ms"
    return _of_rig(text, {"kind": "unplug", "duration_s": duration_s}, detection_s=AT_ONCE_S)


def bus_off(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    duration_s = between(rng, 0.02, 0.8)
    text = f"bus-off for {duration_s * 1e3:.0f} ms"
    return _of_rig(text, {"kind": "bus_off", "duration_s": duration_s}, detection_s=AT_ONCE_S)


def sensor_silence(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    duration_s = between(rng, 0.01, 0.8)
    must = duration_s > SENSOR_S + 0.05
    return _of_rig(
        f"interferometer silent for {duration_s * 1e3:.0f} ms",
        {"kind": "sensor_silence", "duration_s": duration_s},
        must_stop=must,
        detection_s=SENSOR_S if must else NEVER_S,
        open_loop=True,
        by_lasers=True,
    )


def emergency(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    node_id, code = one_of(rng, nodes), one_of(rng, (0x2310, 0x3210, 0x4210, 0x7305, 0x8611))
    fault = {"kind": "emergency", "node_id": node_id, "code": code}
    return _of_rig(f"EMCY 0x{code:04X} of node {node_id}", fault, detection_s=AT_ONCE_S)


def drive_reboot(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    node_id, duration_s = one_of(rng, nodes), between(rng, 0.05, 1.0)
    fault = {"kind": "power_loss", "node_id": node_id, "duration_s": duration_s}
    text = f"node {node_id} dark for {duration_s * 1e3:.0f} ms, then boots"
    return _of_rig(text, fault, detection_s=SENSOR_S, without_power=(node_id,))


def frames_lost(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    """Commands, answers, or the beat of both, on their way."""
    node_id, base, duration_s = one_of(rng, nodes), one_of(rng, (0x200, 0x180, 0x080)), between(rng, 0.02, 0.8)
    can_id = base if base == 0x080 else base + node_id
    detection_s = SENSOR_S if base == 0x180 else RPDO_S
    must = duration_s > detection_s + 0.05
    return _of_rig(
        f"frame 0x{can_id:03X} lost for {duration_s * 1e3:.0f} ms",
        {"kind": "drop_frame", "can_id": can_id, "duration_s": duration_s},
        must_stop=must,
        detection_s=detection_s if must else NEVER_S,
        open_loop=base != 0x180,
    )


def drive_heartbeat_lost(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    node_id, duration_s = one_of(rng, nodes), float(rng.uniform(0.5, 3.2))
    must = duration_s > HEARTBEAT_S + 0.5
    return _of_rig(
        f"no heartbeat of node {node_id} for {duration_s * 1e3:.0f} ms",
        {"kind": "heartbeat_silence", "node_id": node_id, "duration_s": duration_s},
        must_stop=must,
        detection_s=HEARTBEAT_S + 0.3 if must else NEVER_S,
    )


def _harmless(text: str, act: Callable[[House], None], lasts_s: float = 0.0) -> Real:
    return Real(Drawn(text, act=act, must_stop=False, may_stop=False, lasts_s=lasts_s))


def two_operators(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    return _harmless("a second operator wants to move", second_operator)


def hostile_clients(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    seed = int(rng.integers(1 << 30))
    return _harmless("hostile bytes", lambda house: hostile_bytes(house, seed))


def hostile_requests(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    seed = int(rng.integers(1 << 30))
    return _harmless("hostile API (schemathesis)", lambda house: hostile_api(house, seed))


def disk_full(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    duration_s = float(rng.uniform(2.5, 4.0))
    fault = Drawn(
        f"disk full for {duration_s * 1e3:.0f} ms",
        act=lambda house: full_disk(house, duration_s),
        detection_s=DISK_S,
        lasts_s=duration_s,
    )
    return Real(fault, disk_bytes=64 << 20)


def nonsense_profile(rng: np.random.Generator, nodes: Sequence[int]) -> Real:
    edited = nonsense(rng, "single-axis" if len(nodes) == 1 else "oled-printer")
    text = f"profile edited to nonsense: {edited.what}"
    return Real(
        Drawn(text, act=lambda house: house.edit_profile(edited), must_stop=False, may_stop=False, nonsense=edited)
    )


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


def hostile_bytes(house: House, seed: int) -> None:
    """Whatever a port scanner, a broken proxy or a fuzzer sends."""
    rng = np.random.default_rng(seed)
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


def hostile_api(house: House, seed: int) -> None:
    """Everything that the OpenAPI document allows, and what it doesn't, over TCP, beside the one who holds the lease.

    `stop` is left out: anybody may. What needs the lease must be refused, and nothing may end in a server error. Who
    may only watch commands nothing, not even what needs no lease; without a token, or with a wrong one, nothing at all
    is answered.
    """
    import schemathesis
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as drawn_from
    from hypothesis.errors import Unsatisfiable
    from schemathesis import GenerationMode

    tokens = read_tokens(house.daemon.state / "tokens")
    url = f"http://127.0.0.1:{house.daemon.tcp_port}"
    operate, observe = ({"Authorization": f"Bearer {tokens[role]}"} for role in (Role.OPERATE, Role.OBSERVE))
    document = httpx.get(f"{url}/openapi.json", headers=operate, trust_env=False).json()
    for headers, mode, cases_count in (
        (operate, GenerationMode.POSITIVE, _CASES_COUNT),
        (operate, GenerationMode.NEGATIVE, _CASES_COUNT),
        (observe, GenerationMode.POSITIVE, 1),
        ({}, GenerationMode.POSITIVE, 1),
        ({"Authorization": "Bearer guessed"}, GenerationMode.POSITIVE, 1),
    ):
        for result in schemathesis.openapi.from_dict(document).get_all_operations():
            operation = result.ok()
            if operation.path == "/v1/stop":
                continue

            @drawn_from(seed)
            @settings(
                max_examples=cases_count,
                deadline=None,
                database=None,
                phases=[Phase.explicit, Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(case=operation.as_strategy(generation_mode=mode))
            def once(case):
                if "wait_s" in (case.query or {}):
                    case.query["wait_s"] = 0
                answer = case.call(base_url=url, headers=headers, timeout=10)  # noqa: B023
                label = f"{case.operation.label}: {answer.status_code}"
                if answer.status_code >= 500 and answer.status_code != 503:  # 503: beyond 100 connections
                    house.accepted.append(label)
                free = headers is operate and case.operation.path in _NO_LEASE  # noqa: B023
                known = headers is operate or headers is observe  # noqa: B023
                if answer.status_code < 300 and not free and (case.method != "GET" or not known):
                    house.accepted.append(label)

            with contextlib.suppress(Unsatisfiable):
                once()


def full_disk(house: House, duration_s: float) -> None:
    """Leave no byte on the disk that the runs are on."""
    with contextlib.suppress(OSError), (house.daemon.runs.parent / "filler").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 16))
    _later(duration_s, lambda: (house.daemon.runs.parent / "filler").unlink(missing_ok=True))


KINDS: dict[str, Draw] = {
    "servo killed": killed_child,
    "supervisor killed": killed_supervisor,
    "both killed": killed_both,
    "servo stopped": stopped_child,
    "supervisor stopped": stopped_supervisor,
    "client vanishes": client_killed,
    "beam break": beam_break,
    "unplug and replug": unplugged,
    "bus-off and back": bus_off,
    "interferometer silent": sensor_silence,
    "EMCY": emergency,
    "drive reboot": drive_reboot,
    "frames lost": frames_lost,
    "drive's heartbeat lost": drive_heartbeat_lost,
    "two operators": two_operators,
    "hostile bytes": hostile_clients,
    "hostile API (schemathesis)": hostile_requests,
    "disk full": disk_full,
    "nonsense profile": nonsense_profile,
}
"""Every kind, by the name that the tables use."""
