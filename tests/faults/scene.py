"""The whole service in virtual time before a rig that outlives it: an operator, a motion, a fault, the way back."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim_backend.faults import BUS_KINDS
from sim_backend.machine import load_machine
from stagectl import stage as stages
from stagectl.backend import BatchBackend, ServoLink
from stagectl.errors import JogOver, LinkError, RequestError
from stagectl.profile import PROFILES_FOLDER
from stagectl.service import messages
from stagectl.service.desk import Desk
from stagectl.service.exposition import Figures
from stagectl.service.notify import Notifier
from stagectl.service.remembered import Remembered
from stagectl.service.service_log import KEPT_COUNT, ServiceLog
from stagectl.service.stage_loop import StageLoop
from stagectl.service.stage_state import Settings
from tests.faults.kinds import JOG_HOLD_S, Drawn
from tests.faults.nonsense import Nonsense
from tests.faults.witness import WitnessedRig
from tests.small_disk import small_disk
from tests.struck_stage import home_by_truth
from tests.toml_text import changed

PROFILE = "oled-printer"
_HOMING = {"macro.homing.speed_m_per_s": 0.1, "macro.homing.acceleration_m_per_s2": 0.5}
_RENEW_NS, _PRESS_NS = 300_000_000, 100_000_000
TOP_M_PER_S = 0.449  # moves are planned to 0.9 of the profile's 0.5
_PATIENCE_S = 15.0  # of the rig's time: to a standstill, and from a fault to the next state
_TRIES = 4
_DISK_BYTES = 24 << 20


class _Backend(BatchBackend):
    """A batch backend that lets the scene act every time the supervisor lets time pass."""

    scene: "Scene"

    def start_servo(self, profile, mappings, run_folder) -> ServoLink:
        """Start the servo, with the scene between it and the supervisor's time."""
        link = super().start_servo(profile, mappings, run_folder)
        self.scene.link, self.scene.cycles = link, link.pass_time
        link.pass_time = self.scene.let_pass
        return link


@dataclass
class Facts:
    """What one run left for the judges; instants are the rig's."""

    fault_t_ns: int = 0
    judged_until_t_ns: int = 0  # the acknowledgement, or the end of watching
    begun_t_ns: int = 0
    phase: str = ""
    struck: bool = True  # the fault did something
    trouble: str = ""  # why the stage could not be armed again; empty where it could
    fault_kind: str = ""
    fault_text: str = ""
    late_s: float = 0.0  # by which a host held up who had to notice it
    is_host_time: bool = False  # cycles are as long as a host has them, and counted by SYNC
    planned_m_per_s: float = 0.0  # how fast what was asked for may be
    target_m: float | None = None  # of a move
    stop_asked_t_ns: int = 0  # by the operator, while it moved; 0 = not
    jog_hold_s: float = JOG_HOLD_S
    said_t_ns: int = 0  # the last word of a jog's operator: its key is held no longer; 0 = never
    unasked: list[tuple[int, int]] = field(default_factory=list)  # behind the judged end: nobody asks for power
    accepted: list[str] = field(default_factory=list)  # of what nobody may ask
    reread: list[str] = field(default_factory=list)  # what was said when a profile edited to nonsense was read
    opened_anew: bool = False  # the stage, with that
    seen: dict[str, np.ndarray] = field(default_factory=dict)
    sync_t_ns: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


class Scene:
    """One service, one rig, one operator; use as a context."""

    def __init__(self, folder: Path, seed: int, drawn: Drawn, phase: str, rng: np.random.Generator):
        """Put everything below `folder`."""
        self.folder, self.drawn, self.phase, self.rng = folder, drawn, phase, rng
        self.facts = Facts(phase=phase)
        self.rig = WitnessedRig(load_machine(PROFILE), seed)
        self.profile_path = folder / f"{PROFILE}.toml"
        self.runs = folder / "disk" / "runs"
        self.link: ServoLink | None = None
        self.cycles: Any = None  # the servo's, without the scene
        self._log = ServiceLog(None)
        self.desk = Desk(self._log, lambda: 1e-9 * self.rig.t_ns)
        self._seed = seed
        self._token = ""
        self._keys_count = 0
        self._there = True  # the operator's program runs
        self._renewed_t_ns = self._pressed_t_ns = 0
        self._jog_m_per_s: float | None = None
        self._jog_key = ""
        self._due: Any = None  # says whether the fault is due
        self._fastest_m_per_s = 0.0
        self._rests_t_ns = 0  # since when it rests and nothing was asked that gives power; 0: it was
        self._filler: Path | None = None
        self._gone = False  # the servo
        self._ended = False
        self._closing = contextlib.ExitStack()

    def __enter__(self) -> "Scene":
        text = changed(PROFILES_FOLDER / f"{PROFILE}.toml", _HOMING)
        self.profile_path.write_text(text)
        for eds in PROFILES_FOLDER.glob("*.eds"):
            (self.folder / eds.name).write_bytes(eds.read_bytes())
        disk = self.folder / "disk"
        if self.drawn.text == "disk full":
            self._closing.enter_context(small_disk(disk, _DISK_BYTES))
        else:
            disk.mkdir()

        def backend(machine: Any, *, seed: int = 0) -> BatchBackend:
            made = _Backend(machine, seed=seed, rig=self.rig)
            made.scene, self._gone = self, False
            return made

        before = stages.BatchBackend
        self._closing.callback(setattr, stages, "BatchBackend", before)
        stages.BatchBackend = backend  # type: ignore[misc, assignment]
        settings = Settings(
            str(self.profile_path), "batch", self.runs, self.folder / "state", self._seed, machine=PROFILE
        )
        self.loop = StageLoop(settings, self.desk, self._log, Remembered(), Notifier({}), Figures())
        return self

    def __exit__(self, *_) -> None:
        try:
            self.end()
        finally:
            self._closing.close()

    def end(self) -> None:
        """End the service: its runs are closed, and still there to be read."""
        if self._ended:
            return
        self._ended, self._due = True, None
        self._free_disk()
        self.loop.leave()
        self.loop.run()

    # ---- time --------------------------------------------------------------------------------------------------

    @property
    def t_ns(self) -> int:
        """The rig's time."""
        return self.rig.t_ns

    def let_pass(self, duration_s: float) -> None:
        """Let the servo work; then operator and fault have their turn."""
        if self._gone:
            raise LinkError("the servo process ended with -9; the drives stop the stage by themselves")
        self.cycles(duration_s)
        self._operate()
        if self._due is not None and self._due():
            self._due = None
            self._strike()
        if self.facts.fault_t_ns and self.t_ns > self.facts.fault_t_ns + round(1e9 * self.drawn.lasts_s):
            self._free_disk()

    def _strike(self) -> None:
        origin_t_ns = self.t_ns
        if self.drawn.act is None:
            origin_t_ns += int(self.rng.integers(20_000_000))
        self.facts.fault_t_ns = origin_t_ns
        for fault in self.drawn.faults:
            self.rig.inject(fault, origin_t_ns)
        if self.drawn.act is not None:
            self.drawn.act(self)

    def step(self) -> None:
        """Let the service do the next thing; without a stage only the rig's time passes."""
        before_t_ns = self.t_ns
        self.loop._retry_at_s = 0.0
        self.loop.step()
        if self.t_ns == before_t_ns and self.loop._stage is None:
            self.rig.let_pass(0.02)

    def until(self, done, patience_s: float = _PATIENCE_S) -> bool:
        """Step until `done`; False where that takes too long."""
        give_up_t_ns = self.t_ns + round(1e9 * patience_s)
        while not done():
            if self.t_ns > give_up_t_ns:
                return False
            self.step()
        return True

    # ---- the operator --------------------------------------------------------------------------------------------

    @property
    def status(self) -> messages.Status:
        """What clients are told."""
        return self.desk.status()

    def _operate(self) -> None:
        """Renew the lease, and hold the key of a jog."""
        if not self._there or not self._token:
            return
        if self.facts.fault_t_ns and self._watched_s > self._watch_s:
            self._jog_m_per_s = None
        with contextlib.suppress(RequestError):
            if self.t_ns - self._renewed_t_ns > _RENEW_NS:
                self._renewed_t_ns = self.t_ns
                self.desk.renew_lease(self._token)
            if self._jog_m_per_s is not None and self.t_ns - self._pressed_t_ns > _PRESS_NS:
                self._pressed_t_ns = self.t_ns
                self._press()

    def _press(self) -> None:
        """Say the jog's velocity; begin one where none is under way."""
        self.facts.said_t_ns = self.t_ns
        body = messages.JogAt(velocity_m_per_s=self._jog_m_per_s or 0.0, hold_s=JOG_HOLD_S)
        try:
            self.desk.jog_at(self._jog_key, body, self._token)
        except JogOver:
            key = f"jog-{self.t_ns}"
            self._jog_key = self.desk.begin_jog(messages.BeginJog(), key, self._token).key
            self.desk.jog_at(self._jog_key, body, self._token)

    def _take_lease(self) -> bool:
        """Hold the lease, once nobody else does and the stage is at rest."""
        self._there = True

        def taken() -> bool:
            try:
                self.desk.renew_lease(self._token)
            except RequestError:
                try:
                    self._token = self.desk.take_lease(messages.TakeLease(holder="anna", duration_s=2.0)).token
                except RequestError:
                    return False
            return True

        return self.until(taken)

    def begin(self, name: str, body: Any) -> str:
        """Submit a command and return its key."""
        self._keys_count += 1
        return self.desk.submit(name, body, f"k{self._keys_count}", self._token).key

    def do(self, name: str, body: Any) -> messages.Command | None:
        """Submit a command and see it carried out; None where it was refused or never ended."""
        if not self._take_lease():
            return None
        key = self.begin(name, body)
        self.until(lambda: self._over(key), 120.0)
        self.step()
        return self.desk.command(key)

    def _over(self, key: str) -> bool:
        command = self.desk.command(key)
        return command is not None and command.state in ("done", "failed")

    # ---- what no rig can do ------------------------------------------------------------------------------------

    def hold_host_up(self, duration_s: float) -> None:
        """Let the world go on while no cycle runs."""
        wire = self.loop._stage.backend.wire
        wire.advance_to(wire.t_ns + round(1e9 * duration_s))

    def hang_supervisor(self, duration_s: float) -> None:
        """Run cycles while the supervisor says nothing."""
        self.cycles(duration_s)

    def lose_servo(self) -> None:
        """Run no cycle any more, as after `kill -9`."""
        self._gone = True
        self.link.close = lambda: None
        self.hold_host_up(self.drawn.lasts_s)
        raise LinkError("the servo process ended with -9; the drives stop the stage by themselves")

    def fill_disk(self) -> None:
        """Leave no byte."""
        self._filler = self.folder / "disk" / "filler"
        with self._filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):  # a buffer fails as it closes
            while True:
                file.write(bytes(1 << 16))

    def _free_disk(self) -> None:
        if self._filler is not None:
            self._filler.unlink(missing_ok=True)
            self._filler = None

    def vanish(self) -> None:
        """The operator's program is gone: nothing is renewed, no key is held."""
        self._there = False

    def intrude(self, rng: np.random.Generator) -> None:
        """Ask for everything that another operator's lease forbids."""
        tokens = ("", "guessed", self._token[:-1], self._token + "x")
        asked = {
            "arm": messages.Arm(),
            "home": messages.Home(),
            "move": messages.Move(target_m=0.0),
            "jog": messages.JogBy(distance_m=0.01),
            "identify": messages.Identify(),
            "acknowledge": messages.Acknowledge(number=1),
            "backend": messages.SwapBackend(backend="rig"),
        }
        for token in tokens:
            for name, body in asked.items():
                self._forbidden(name, lambda: self.desk.submit(name, body, f"bert-{rng.integers(10**9)}", token))  # noqa: B023
            velocity = messages.JogAt(velocity_m_per_s=0.1)
            self._forbidden("jog_at", lambda: self.desk.jog_at(self._jog_key, velocity, token))  # noqa: B023
            self._forbidden("begin_jog", lambda: self.desk.begin_jog(messages.BeginJog(), "bert-jogs", token))  # noqa: B023
            self._forbidden("renew", lambda: self.desk.renew_lease(token))  # noqa: B023
            self._forbidden("give back", lambda: self.desk.give_lease_back(token))  # noqa: B023
        self._forbidden("take", lambda: self.desk.take_lease(messages.TakeLease(holder="bert")))

    def _forbidden(self, name: str, ask) -> None:
        with contextlib.suppress(RequestError):
            ask()
            self.facts.accepted.append(name)

    def edit_profile(self, edited: Nonsense) -> None:
        """Spoil the file, and ask for it to be read again."""
        edited.put(self.profile_path)
        self.loop.reread()

    def _have_it_read(self) -> None:
        """Take the power away, without which nothing is read again, and keep what is said of the profile."""
        stage = self.loop._stage
        if self.status.state == "armed":
            self.desk.ask_to_stop("the operator")
        self.until(lambda: self.status.state == "idle" and not self.loop._rereading)
        said = self._log.last(KEPT_COUNT)
        self.facts.reread = [entry.text for entry in said if entry.event == "profile"]
        self.facts.opened_anew = self.loop._stage is not stage

    # ---- the run -------------------------------------------------------------------------------------------------

    def play(self) -> Facts:
        """Bring the stage into the phase, let the fault strike, watch, and find the way back."""
        self.until(lambda: self.loop._state == "idle")
        self.step()
        if self.phase != "homing":
            home_by_truth(self.loop._stage, self.rig.plant_state())
            self.loop._homed = True
            armed = self.do("arm", messages.Arm())
            if armed is None or armed.stop != "FINISHED":
                raise RuntimeError(f"the scene could not be set: {armed}")
        self._take_lease()
        self.facts.begun_t_ns = self.t_ns
        self._set_off()
        self.until(lambda: self.facts.fault_t_ns > 0 and self._quiet(), 40.0)
        self.facts.struck = self._struck()
        self.facts.judged_until_t_ns = self.t_ns
        fault = self.status.fault
        if fault is not None:
            self.facts.fault_kind, self.facts.fault_text = fault.kind, fault.values
        if self.drawn.nonsense is not None:
            self._have_it_read()
        self._rests_t_ns = self.t_ns
        self.facts.trouble = self._way_back()
        self._ask_for_power()
        self.facts.seen = self.rig.seen()
        self.facts.sync_t_ns = self.facts.seen["sync_t_ns"]
        return self.facts

    def _struck(self) -> bool:
        """Tell whether the fault's instant came, and it met frames where it is one of the bus."""
        of_bus = any(fault.kind in BUS_KINDS for fault in self.drawn.faults)
        return self.facts.fault_t_ns > 0 and (not of_bus or self.rig.wire_faults.struck_count > 0)

    def _quiet(self) -> bool:
        """Tell whether the fault is gone, and what it did has come to its end."""
        return self._watched_s > self._watch_s and self.status.state in ("armed", "idle", "fault", "off")

    @property
    def _watched_s(self) -> float:
        """Time since the fault struck."""
        return 1e-9 * (self.t_ns - self.facts.fault_t_ns)

    @property
    def _watch_s(self) -> float:
        """How long a fault is watched: while it lasts, and until it must have been noticed, and a little more."""
        detection_s = self.drawn.detection_s
        return max(self.drawn.lasts_s, detection_s if np.isfinite(detection_s) else 0.0) + 0.6

    def _set_off(self) -> None:
        """Begin the motion of the drawn phase; the fault strikes when the true motion is in that phase."""
        rng, phase, begun_t_ns = self.rng, self.phase, self.t_ns
        sign = 1.0 if rng.random() < 0.5 else -1.0
        after = {"at rest": 0.3, "jogging": 1.5, "identifying": 3.5, "homing": 6.0}.get(phase, 0.0)
        due_t_ns = begun_t_ns + round(1e9 * rng.uniform(0.02, max(after, 0.03)))
        share = rng.uniform(0.1, 0.9)
        self._due = lambda: self.t_ns >= due_t_ns
        if phase == "jogging":
            self._jog_m_per_s = sign * float(rng.uniform(0.05, 0.3))
            self.facts.planned_m_per_s = abs(self._jog_m_per_s)
            self._press()
        elif phase == "identifying":
            self.facts.planned_m_per_s = TOP_M_PER_S
            self.begin("identify", messages.Identify(duration_s=4.0))
        elif phase == "homing":
            self.facts.planned_m_per_s = _HOMING["macro.homing.speed_m_per_s"]
            self.begin("home", messages.Home())
        elif phase != "at rest":
            self._due = lambda: self._in_phase(share)
            self.facts.target_m, self.facts.planned_m_per_s = sign * float(rng.uniform(0.33, 0.42)), TOP_M_PER_S
            self.begin("move", messages.Move(target_m=self.facts.target_m))

    def _in_phase(self, share: float) -> bool:
        """Tell whether a move is where the fault is to strike, by the true speed."""
        speed = abs(self.rig.plant_state()["macro_velocity_m_per_s"])
        self._fastest_m_per_s = max(self._fastest_m_per_s, speed)
        if self.phase == "accelerating":
            return speed >= share * TOP_M_PER_S
        if self.phase == "decelerating":
            return self._fastest_m_per_s > 0.98 * TOP_M_PER_S and speed <= share * TOP_M_PER_S
        if speed < 0.998 * TOP_M_PER_S and self.phase == "constant speed":
            return False
        if self.phase == "stopping" and self._fastest_m_per_s > share * TOP_M_PER_S:
            if not self.desk.stop_asked and self.loop._state == "moving":
                self.facts.stop_asked_t_ns = self.t_ns
                self.desk.ask_to_stop("the operator")
            return speed < 0.9 * self._fastest_m_per_s
        return self.phase == "constant speed"

    # ---- the way back --------------------------------------------------------------------------------------------

    def _way_back(self) -> str:
        """Acknowledge, home where that was voided, arm; return what stands in the way."""
        self._jog_m_per_s = None
        failure = ""
        for _ in range(_TRIES):
            failure = self._try_back()
            if not failure:
                return ""
            self.until(lambda: False, 0.5)
        return failure

    def _try_back(self) -> str:
        if not self._take_lease():
            return f"no lease: {self.status.lease}"
        fault = self.status.fault
        if fault is not None:
            self._rests_t_ns = self._rests_t_ns or self.t_ns
            done = self.do("acknowledge", messages.Acknowledge(number=fault.number))
            if done is None or done.state != "done":
                return f"not acknowledged: {done.text if done else self.status.state}"
        if not self.until(lambda: self.status.state in ("idle", "armed")):
            return f"still {self.status.state}: {self.status.waiting_for}"
        if not self.status.homed or (fault is not None and fault.kind == "TRAVEL"):  # as that fault says
            self._ask_for_power()
            homed = self.do("home", messages.Home())
            if homed is None or homed.stop != "FINISHED":
                return f"not homed: {homed.text if homed else self.status.state}"
        if self.status.state == "idle":
            self._ask_for_power()
            armed = self.do("arm", messages.Arm())
            if armed is None or armed.stop != "FINISHED":
                return f"not armed: {armed.text if armed else self.status.state}"
        return "" if self.status.state == "armed" else f"{self.status.state}, not armed"

    def _ask_for_power(self) -> None:
        """Note until when nothing was asked for that gives power, since the stage came to rest."""
        if self._rests_t_ns:
            self.facts.unasked.append((self._rests_t_ns, self.t_ns))
            self._rests_t_ns = 0

    def run_folders(self) -> Iterator[Path]:
        """Return all runs of the service that hold rows."""
        for folder in sorted(self.runs.iterdir()):
            if folder.is_dir() and (folder / "samples.arrow").exists():
                yield folder
