"""Faults with real processes: service, servo and rig, killed, stopped and lied to; judged by what the rig truly did.

The host of a test is no real-time host: the profile's limits are patient, and what the host held up the rig, or the
servo, is added to the time of detection.
"""

import contextlib
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import pyarrow as pa

from stagectl.backend import ask_rig
from stagectl.client import Client
from stagectl.errors import LinkError, RecordError, StagectlError
from stagectl.record import read_run
from stagectl.service.access import Role, read_tokens
from tests.faults.judge import BACK, COURSE, STANDSTILL, STRANGER, TRAVEL, UNREADABLE
from tests.service.daemon import PATIENT, Daemon, servo_pid
from tests.small_disk import small_disk

CHANGES = {**PATIENT, "record": {"when": "always"}}
CYCLE_S, RAMP_M_PER_S2, PLAN_M_PER_S2, PLAN_M_PER_S3 = 1e-3, 5.0, 2.25, 22.5
STOPS_M, STOPS_GIVE_M, STANDSTILL_M, REST_M_PER_S = 0.17, 8e-3, 20e-6, 1e-3
SENSOR_S, RPDO_S, HEARTBEAT_S, LEASE_S, SUPERVISOR_S = 0.3, 0.1, 2.0, 2.0, 0.5  # as CHANGES and the profile have them
DISK_S = 0.5  # rows go onto the disk every 0.25 s; the supervisor hears with the next ones that it took none
WAKE_S = 5e-3  # of this host: a process that is asked wakes so much later
_JOG_M_PER_S, _REACH_M = 0.12, 0.12
_LOOK_S = 0.02
_REST_S = 0.5
_PATIENCE_S = 60.0
_TRIES = 3
_CASES_COUNT = 3  # of every operation of the API, with data that fit and with data that don't
_NO_LEASE = ("/v1/record", "/v1/record/trigger")


@dataclass(frozen=True)
class Kind:
    """One fault: what is done, how soon it must be noticed, what is left of the processes."""

    strike: Callable[["House"], None]
    detection_s: float = CYCLE_S
    must_stop: bool = True
    may_stop: bool = True
    without_power: bool = False
    lasts_s: float = 0.0
    by_drives: bool = False  # the drives stop it by themselves: how late the servo was is no excuse
    disk_bytes: int = 0  # of a disk of its own for the runs; 0 = none


@dataclass
class Seen:
    """The true motion of a run, as often as the rig was asked."""

    t_ns: list[int] = field(default_factory=list)
    position_m: list[float] = field(default_factory=list)
    velocity_m_per_s: list[float] = field(default_factory=list)
    drive: list[str] = field(default_factory=list)


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

    @property
    def line(self) -> str:
        """One line for a table."""
        said = "; ".join(": ".join(one) for one in self.violations) or "holds"
        again = f"python -m bench service --part processes --seed {self.seed}"
        return f"real processes, seed {self.seed}: {self.kind}: {said}; {again}"


class House:
    """A service of its own with its rig; made anew by `systemd` where it was killed."""

    def __init__(self, folder: Path, runs: Path | None = None):
        """Start the service below `folder`; its runs may go elsewhere."""
        self.daemon = Daemon(folder, CHANGES, runs)
        self.seen = Seen()
        self.accepted: list[str] = []
        self._jogging = threading.Event()
        self._over = threading.Event()
        self._speed_m_per_s = 0.0
        self._channel = ""

    def close(self) -> None:
        """End everything."""
        self.daemon.end()

    # ---- the rig -------------------------------------------------------------------------------------------------

    def find_rig(self) -> None:
        """Remember where the rig is, so that it can be asked when its service is gone."""
        places = sorted((self.daemon.folder / "tmp").glob("stagectl-rig-*/can.socket"), key=os.path.getmtime)
        self._channel = str(places[-1])

    def state(self) -> dict:
        """Ask the rig what is true, and note it."""
        found = ask_rig(self._channel, {"state": True})
        self.seen.t_ns.append(found["t_ns"])
        self.seen.position_m.append(found["plant"]["macro_position_m"])
        self.seen.velocity_m_per_s.append(found["plant"]["macro_velocity_m_per_s"])
        self.seen.drive.append(found["drives"]["1"])
        return found

    def rig_fault(self, **fault) -> None:
        """Let something go wrong in the rig."""
        ask_rig(self._channel, {"fault": fault})

    # ---- the operator --------------------------------------------------------------------------------------------

    def ready(self) -> str:
        """Bring the stage to armed: acknowledge, home, arm; return what stands in the way."""
        client, last = self.daemon.client, ""
        give_up_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up_s:
            try:
                status = client.status()
                if status.state == "armed" and client.lease_token:
                    return ""
                if not client.lease_token or client.lease_state() is None:
                    client.take_lease("anna", 2.0)
                    self._keep_lease()
                if status.fault is not None:
                    client.acknowledge(status.fault.number)
                elif status.state == "idle" and not status.homed:
                    client.home()
                elif status.state == "idle":
                    client.arm()
            except StagectlError as error:
                last = str(error)
                if "lease" in last:
                    client.lease_token = ""
            time.sleep(0.1)
        return last or f"not armed after {_PATIENCE_S:g} s"

    def _keep_lease(self) -> None:
        self._over.set()
        self._over = threading.Event()
        threading.Thread(target=self._operate, args=(self._over,), daemon=True).start()

    def _operate(self, over: threading.Event) -> None:
        """Renew the lease, and hold the key while jogging, as an operator's program does."""
        with Client(self.daemon.socket) as client:
            client.lease_token = self.daemon.client.lease_token
            while not over.wait(0.1):
                try:
                    client.renew_lease()
                    if self._jogging.is_set():
                        client.jog_at(self._speed_m_per_s, 0.5)
                except LinkError:
                    continue
                except StagectlError:
                    return

    def set_off(self) -> bool:
        """Jog away from the nearer end until it truly moves; False where it does not get there."""
        at_m = self.state()["plant"]["macro_position_m"]
        self._speed_m_per_s = -_JOG_M_PER_S if at_m > 0.0 else _JOG_M_PER_S
        self._jogging.set()
        give_up_s = time.monotonic() + 10.0
        while time.monotonic() < give_up_s:
            if abs(self.state()["plant"]["macro_velocity_m_per_s"]) > 0.9 * _JOG_M_PER_S:
                return True
            time.sleep(_LOOK_S)
        return False

    def let_go(self) -> None:
        """Hold no key any more."""
        self._jogging.clear()

    def vanish(self) -> None:
        """The operator's program is gone."""
        self._over.set()
        self.daemon.client.lease_token = ""

    # ---- judging -------------------------------------------------------------------------------------------------

    def lateness_s(self, since_t_ns: int) -> float:
        """Return how late the servo was at worst after an instant, by the runs' rows."""
        worst = 0
        for path in self.daemon.runs.glob("*/samples.arrow"):
            with contextlib.suppress(pa.ArrowException, OSError), pa.OSFile(str(path)) as file:
                reader = pa.ipc.open_stream(file)
                for batch in reader:
                    late = batch.column("lateness_ns").to_numpy()[batch.column("t_ns").to_numpy() >= since_t_ns]
                    worst = max(worst, int(late.max(initial=0)))
        return 1e-9 * worst


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
                "jog": lambda: other.jog_at(0.1),
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
    with (house.daemon.runs.parent / "filler").open("wb") as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(1 << 16))
            file.flush()
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
    "servo killed": Kind(killed_child, RPDO_S, by_drives=True),
    "supervisor killed": Kind(killed_supervisor, SUPERVISOR_S),
    "both killed": Kind(killed_both, RPDO_S, by_drives=True),
    "servo stopped": Kind(stopped_child, RPDO_S, lasts_s=3.5, by_drives=True),
    "supervisor stopped": Kind(stopped_supervisor, SUPERVISOR_S, lasts_s=1.6),
    "client vanishes in mid jog": Kind(client_vanishes, LEASE_S, lasts_s=2.5),
    "beam break": Kind(_rig(kind="beam_loss", axis="macro", duration_s=0.5), 3 * CYCLE_S, lasts_s=0.5),
    "unplug and replug": Kind(_rig(kind="unplug", duration_s=0.5), 3 * CYCLE_S, lasts_s=0.6),
    "bus-off and back": Kind(_rig(kind="bus_off", duration_s=0.4), 3 * CYCLE_S, lasts_s=0.4),
    "interferometer silent": Kind(_rig(kind="sensor_silence", duration_s=0.6), SENSOR_S, lasts_s=0.6),
    "EMCY": Kind(_rig(kind="emergency", node_id=1, code=0x7305), 3 * CYCLE_S),
    "drive reboot": Kind(_rig(kind="power_loss", node_id=1, duration_s=0.5), SENSOR_S, without_power=True, lasts_s=0.6),
    "frames lost": Kind(_rig(kind="drop_frame", can_id=0x201, duration_s=0.5), RPDO_S, lasts_s=0.5),
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


def run(seed: int, folder: Path) -> RealResult:
    """Play one fault with processes of its own."""
    began_s = time.monotonic()
    name = list(KINDS)[seed % len(KINDS)]
    shutil.rmtree(folder, ignore_errors=True)
    kind, runs = KINDS[name], None
    with contextlib.ExitStack() as closing:
        if kind.disk_bytes:
            folder.mkdir(parents=True)
            runs = closing.enter_context(small_disk(folder / "disk", kind.disk_bytes)) / "runs"
        house = House(folder / "house", runs)
        try:
            found, travel_m, bound_m, fault_kind = _play(house, kind, seed)
        finally:
            house.close()
        found += _unreadable(house.daemon.runs)
    return RealResult(seed, name, fault_kind, tuple(found), travel_m, bound_m, time.monotonic() - began_s)


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
        if not trouble:
            break
        house.let_go()
    else:
        return [(BACK, f"the scene could not be set: {trouble}")], 0.0, 0.0, ""
    time.sleep(float(rng.uniform(0.0, 0.3)))
    before = house.state()
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
    v, at_m = abs(plant["macro_velocity_m_per_s"]), plant["macro_position_m"]
    if kind.without_power:
        way_m = STOPS_M - at_m if plant["macro_velocity_m_per_s"] > 0.0 else at_m + STOPS_M
        return way_m + STOPS_GIVE_M
    t = kind.detection_s + CYCLE_S + late_s
    a = min(PLAN_M_PER_S3 * t, PLAN_M_PER_S2)
    return v * t + 0.5 * a * t * t + (v + a * t) ** 2 / (2.0 * RAMP_M_PER_S2)


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
        time.sleep(_LOOK_S)
    house.let_go()
    stands_m, found = state["plant"]["macro_position_m"], []
    powered = state["drives"]["1"] not in ("SWITCH_ON_DISABLED", "FAULT")
    for _ in range(15):
        time.sleep(_LOOK_S)
        with contextlib.suppress(LinkError):  # of a killed service the rig ends after a while
            state = house.state()
    if powered and abs(state["plant"]["macro_position_m"] - stands_m) > STANDSTILL_M:
        found.append((STANDSTILL, "it moved after standstill"))
    return found, travel_m, state
