"""The main thread of the service: owns the supervisor object, carries out one command after the other, keeps watch.

Clients reach it through `Desk`; nothing here waits for one of them, and nothing that the servo waits for is here.
"""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from stagectl.errors import DriveError, LinkError, ProfileError, RequestError, StagectlError
from stagectl.profile import Profile, load_profile
from stagectl.requests import Phase
from stagectl.ring import RingReader, writer_alive
from stagectl.run_folder import give_back
from stagectl.service import faults, messages, recording, states
from stagectl.service.desk import Desk, Order
from stagectl.service.exposition import Figures
from stagectl.service.notify import Notifier
from stagectl.service.recording import Recording
from stagectl.service.remembered import Remembered, keep
from stagectl.service.scope import Scope
from stagectl.service.service_log import ServiceLog, now_text
from stagectl.service.states import Event, State
from stagectl.service.view import BANNERS, backlash_message, health, limits, positions
from stagectl.signals import Stop
from stagectl.stage import choose, open_stage, present
from stagectl.supervisor import Outcome, Supervisor

_RETRY_S, _RETRY_AFTER_FAILURE_S = 2.0, 5.0
_CONNECT_S = 240.0  # a cold compile cache on a slow host
_CLOSE_S = 60.0  # coming to rest, rows to the disk
_LATENESS_EVERY_S = 0.5
_ENDING = "the service was asked to end"
_VERSION = metadata.version("stagectl")


class Leaving(Exception):
    """The service was asked to end while it was opening a world."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What the service was started with."""

    profile: str
    backend: str
    runs_root: Path
    state_folder: Path
    seed: int = 0
    machine: str | None = None


class StageLoop:
    """One stage, from the service's start to its end."""

    def __init__(
        self,
        settings: Settings,
        desk: Desk,
        log: ServiceLog,
        remembered: Remembered,
        notifier: Notifier,
        figures: Figures,
    ):
        """Hold the parts; `run` opens the stage."""
        self.settings, self.desk, self._log, self._notifier, self._figures = settings, desk, log, notifier, figures
        self._remembered = remembered
        self._recording = Recording(settings.runs_root, log)
        self._began_s = time.monotonic()
        self._profile_asked, self._backend_asked = settings.profile, settings.backend
        self._profile: Profile | None = None
        self._backend = ""  # as `auto` was resolved, once
        self._stage: Supervisor | None = None
        self._state, self._since = State.OFF, now_text()
        self._fault: messages.Fault | None = None
        self._waiting_for = "the service has just begun"
        self._retry_at_s = 0.0
        self._leaving = self._rereading = self._opening = self._breaking = False
        self._scope = Scope(1000.0)
        self._homed = False
        self._order: Order | None = None
        self._work: dict[str, Callable[[Order], None]] = {
            "arm": self._do_arm,
            "home": self._do_home,
            "move": self._do_move,
            "jog": self._do_jog,
            "jog_at": self._do_jog_at,
            "identify": self._do_identify,
            "acknowledge": self._do_acknowledge,
            "backend": self._do_backend,
            "reread": self._do_reread,
        }
        self._late: tuple[float, float] | None = None
        self._late_at_s = 0.0

    # ---- the loop --------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Work until `leave`; then bring the stage to rest and close its run."""
        self._recording.begin_pruning()
        try:
            while not self._leaving:
                self.step()
        finally:
            self._leave()

    def step(self) -> None:
        """Do the next thing: a command, a look at the stage, or a try to open it."""
        self._tick()
        if self._rereading and self._state in (State.OFF, State.IDLE):
            self._reread()
        elif self.desk.stop_asked:
            self._come_to_rest()
        elif (order := self.desk.next_order()) is not None:
            self._carry_out(order)
        elif self._stage is not None:
            self._watch()
        elif self._state is State.OFF and time.monotonic() >= self._retry_at_s:
            self._open()
        else:
            time.sleep(0.02)

    def leave(self) -> None:
        """Have `run` end; the stage comes to rest first. May be called from a signal handler."""
        self._leaving = True  # nothing else: locks may be held by what the signal interrupted
        if self._opening:
            raise Leaving

    def reread(self) -> None:
        """Have the profile read again as soon as the stage has no power. May be called from a signal handler."""
        self._rereading = True

    @property
    def _stop_wanted(self) -> bool:
        """Whether a client or the end of the service asks for rest."""
        return self._leaving or self.desk.stop_asked

    def _leave(self) -> None:
        self._notifier.say(STOPPING=1, STATUS="bringing the stage to rest")
        self.desk.close()
        if self._stage is not None and self._state is State.ARMED:
            self._come_to_rest()
        self._close_stage()
        self._recording.end_pruning()
        self._tick()

    def _tick(self) -> None:
        """Publish where things stand, and feed the watchdog as long as the servo's cycles, or else this loop, go on."""
        self._heed_record_requests()
        status = self._view()
        self.desk.publish(status, self._state)
        self._notifier.feed(status.health.cycles_count if self._stage is not None else time.monotonic_ns())

    def _heed_record_requests(self) -> None:
        """Begin or end a run that a client asked for; motions go on meanwhile."""
        asked, stage = self.desk.next_record_request(), self._stage
        if asked is None or stage is None or self._opening:
            return
        try:
            if asked == "":
                self._recording.end(recording.REQUEST, text="a client asked for its end")
            else:
                self._recording.begin(asked, recording.REQUEST, stage.link.now_t_ns())
        except RequestError as error:
            self._log.say("record_lost", str(error))

    def _progress(self, what: str, share: float) -> None:
        """Hear from the supervisor that a motion goes on; the place where a stop comes in."""
        if self._order is not None:
            self._order.progress(what, share)
        if self._stop_wanted and self._stage is not None and not self._opening:
            if states.TRANSITIONS.get((self._state, Event.STOP)) is not None:
                self._enter(Event.STOP, _ENDING if self._leaving else self.desk.stop_reason)
            self._stage.ask_to_stop()
        self._tick()

    def _enter(self, event: Event, text: str = "") -> None:
        before, self._state = self._state, states.after(self._state, event)
        if before is not self._state:
            self._since = now_text()
            self._log.say("state", text, state=self._state.value, before=before.value, because=event.value)
            self._notifier.say(STATUS=f"{self._state.value}, {self._backend or 'no world'}")
        self.desk.powered = self._state in states.POWERED
        if before in states.POWERED and not self.desk.powered and not self._breaking:
            self._recording.end(recording.ARM, *self._why(event))

    def _why(self, event: Event) -> tuple[str, str]:
        """Return how the run of a powered stage ended: the Stop's name, and the sentence."""
        if event is Event.TRIPPED and self._fault is not None:
            return self._fault.kind, f"{self._fault.what}: {self._fault.values}"
        return "", ""

    # ---- opening and closing ---------------------------------------------------------------------------------

    def _open(self) -> None:
        """Try to open the stage; what is missing is waited for, what is wrong is a fault."""
        self._retry_at_s = time.monotonic() + _RETRY_S
        try:
            profile = self._profile = load_profile(self._profile_asked)
            if not self._backend:
                self._backend = choose(profile, self._backend_asked)
                self._log.say("backend", BANNERS[self._backend], backend=self._backend, asked=self._backend_asked)
            missing = self._missing(profile)
            if missing:
                self._wait_for(missing)
                return
        except (ProfileError, LinkError) as error:
            self._wait_for(str(error))
            return
        except RequestError as error:
            self._trip(faults.of_error(error, self._state, now_text(), self._next_fault()))
            return
        self._wait_for("opening the stage")
        self._notifier.allow(_CONNECT_S)
        folder: Path | None = None
        self._opening = True
        try:
            stage = open_stage(
                profile,
                self._backend,
                runs_root=self.settings.runs_root,
                name="service",
                seed=self.settings.seed,
                machine=self.settings.machine,
                progress=self._progress,
                manifest={"banner": BANNERS[self._backend], "backend_asked": self._backend_asked},
                lease_left_s=self.desk.lease_left_s,
                observe=self._observe,
                record=self._recording.factory(profile),
            )
            folder = stage.folder
            self._figures.begin_servo()
            self._scope = Scope(profile.cycle.rate_hz)
            self.desk.scope = self._scope
            stage.__enter__()
            self._stage, self._homed, self._waiting_for = stage, False, ""
        except Leaving:
            return
        except LinkError as error:
            self._wait_for(str(error))
            return
        except StagectlError as error:
            self._trip(faults.of_error(error, self._state, now_text(), self._next_fault()))
            return
        finally:
            self._opening = False
            self._notifier.allow(0.0)
            if folder is not None and self._stage is None:
                give_back(folder)
                self._recording.discard(folder)
            self._retry_at_s = time.monotonic() + _RETRY_AFTER_FAILURE_S
        self.desk.profile = stage.profile
        self._keep(profile=str(profile.source_path), profile_name=profile.name, backend=self._backend)
        self._enter(Event.CONNECTED, stage.backend.description)

    def _missing(self, profile: Profile) -> str:
        """Say what hardware is not there, or who still has it; empty where all is ready."""
        if self._backend != "hardware":
            return ""
        absent = [name for name, there in present(profile).items() if not there]
        if absent:
            return f"{', '.join(absent)}: not there; plug it in, or ask for another backend"
        for ring in sorted(Path("/dev/shm").glob("stagectl-*.ring")):
            try:
                reader = RingReader(ring)
            except StagectlError:
                continue
            mine = reader.run_folder is not None and self.settings.runs_root.resolve() in reader.run_folder.parents
            if mine and writer_alive(ring):
                return f"servo {reader.writer_pid} of the last service still brings the stage to rest"
        return ""

    def _wait_for(self, what: str) -> None:
        if what != self._waiting_for:
            self._waiting_for = what
            self._log.say("waiting", what)
            self._notifier.say(STATUS=f"waiting: {what}")
        self._tick()

    def _close_stage(self) -> None:
        """Let go of the world, whatever that says."""
        stage, self._stage = self._stage, None
        self._homed = False
        self.desk.profile = None
        if stage is not None:
            self._opening = False
            self._notifier.allow(_CLOSE_S)
            try:
                stage.close()
            except StagectlError as error:
                self._log.say("closing", str(error), kind=type(error).__name__)
            give_back(stage.folder)
            self._recording.forget()
            self._notifier.allow(0.0)
        if states.TRANSITIONS.get((self._state, Event.LET_GO)) is not None and self._state is not State.FAULT:
            self._enter(Event.LET_GO)

    def _reread(self) -> None:
        """Read the profile again, and open the stage anew with it; a wrong one changes nothing."""
        self._rereading = False
        try:
            load_profile(self._profile_asked)
        except ProfileError as error:
            self._log.say("profile", f"kept as it was: {error}")
            return
        self._log.say("profile", "read again", profile=self._profile_asked)
        self._close_stage()
        self._retry_at_s = 0.0

    # ---- watching --------------------------------------------------------------------------------------------

    def _observe(self, rows: np.ndarray) -> None:
        self._scope.add(rows)
        self._figures.add(rows)

    def _watch(self) -> None:
        """Let 20 ms pass, and notice what stops a stage that holds or rests."""
        stage = self._stage
        if stage is None:
            return
        try:
            status = stage.pump()
        except StagectlError as error:
            self._break(error)
            return
        if status["reference_lost"]:
            self._homed = False
        if self._state is not State.FAULT and status["phase"] == Phase.STOPPED:
            self._settle()
        elif self._state is State.ARMED and status["phase"] != Phase.TRACKING:
            self._wait_until_it_stands()

    def _wait_until_it_stands(self) -> None:
        """Let a stage that stops by itself do so; then say why."""
        stage = self._stage
        until_s = time.monotonic() + 30.0
        try:
            while stage is not None and stage.status()["phase"] != Phase.STOPPED and time.monotonic() < until_s:
                stage.pump()
                self._tick()
        except StagectlError as error:
            self._break(error)
            return
        self._settle()

    def _settle(self, name: str = "") -> None:
        """Bring the state into line with the servo's phase, after a motion or a stop."""
        stage = self._stage
        if stage is None:
            return
        status = stage.status()
        phase, stop = Phase(int(status["phase"])), Stop(int(status["stop"]))
        if phase is Phase.TRACKING:
            self._enter(Event.HELD, name)
        elif phase is Phase.STOPPED and stop is not Stop.OPERATOR:
            self._trip(faults.of_stop(stop, stage.detail, self._state, now_text(), self._next_fault()))
        else:
            self._rest(name)

    def _rest(self, name: str) -> None:
        """Take the power away from a stage that comes to rest as asked."""
        stage = self._stage
        if stage is None:
            return
        if self._state in (State.ARMING, State.ARMED, State.IDENTIFYING):
            self._enter(Event.STOP, name)
        try:
            stop = stage.disarm()
        except StagectlError as error:
            self._break(error)
            return
        if stop not in (Stop.NONE, Stop.OPERATOR):
            self._trip(faults.of_stop(stop, stage.detail, self._state, now_text(), self._next_fault()))
        elif self._state in (State.MOVING, State.STOPPING):
            self._enter(Event.RESTED, name)

    def _come_to_rest(self) -> None:
        """Obey a stop while no command is under way."""
        reason = _ENDING if self._leaving else self.desk.stop_reason
        if self._state is State.ARMED:
            self._enter(Event.STOP, reason)
            self._rest(reason)
        self.desk.stopped()
        if self._stage is not None:
            self._stage.allow_motion()

    def _trip(self, fault: messages.Fault) -> None:
        self._fault = fault
        self._recording.save_last(fault.kind)
        self._enter(Event.TRIPPED, fault.what)
        self._log.say("fault", fault.what, **fault.model_dump(exclude={"what", "at"}))
        self._figures.fault(fault.kind)

    def _break(self, error: StagectlError) -> None:
        """What broke on this side: bring the stage to rest, let go of it, and say so."""
        self._breaking = True  # the run ends when the last rows are in it
        self._trip(faults.of_error(error, self._state, now_text(), self._next_fault()))
        self._close_stage()
        self._breaking = False

    def _next_fault(self) -> int:
        count = self._remembered.faults_count + 1
        self._keep(faults_count=count)
        return count

    def _keep(self, **changes: Any) -> None:
        self._remembered = self._remembered.model_copy(update=changes)
        try:
            keep(self.settings.state_folder, self._remembered)
        except StagectlError as error:
            self._log.say("state_not_kept", str(error))

    # ---- commands --------------------------------------------------------------------------------------------

    def _carry_out(self, order: Order) -> None:
        """Carry out one command; its record says what became of it."""
        self._order = order
        try:
            self.desk.check_order(order)
            order.begin()
            self._log.say("command", order.name, key=order.key, body=order.body.model_dump())
            self._work[order.name](order)
        except StagectlError as error:
            order.fail(error)
            self._log.say("command_failed", str(error), name=order.name, key=order.key, kind=type(error).__name__)
            if isinstance(error, RequestError):
                self._after_refusal()
            else:
                self._break(error)
        finally:
            self._order = None
            if not self._stop_wanted and self._stage is not None:
                self._stage.allow_motion()

    def _after_refusal(self) -> None:
        """A request that was refused half way leaves the stage holding, or on its way to rest."""
        stage = self._stage
        if stage is None or self._state not in states.POWERED:
            return
        if stage.status()["phase"] == Phase.TRACKING and stage.status()["segment_left_rows"] > 0:
            self._rest("refused half way")
        else:
            self._settle("refused")

    def _motion(self, order: Order, event: Event, work: Callable[[Supervisor], Outcome]) -> Outcome:
        """Do a motion and bring the state into line with how it ended."""
        stage = self._connected()
        states.after(self._state, event)
        if event in (Event.ARM, Event.MOVE, Event.IDENTIFY) and not self._homed:
            raise RequestError(f"{order.name}: the stage is not homed since it was connected; home it first")
        stage.allow_motion()
        if self._state is State.IDLE:
            self._recording.begin(order.name, recording.ARM, stage.link.now_t_ns())
        folder = self._recording.folder(stage.folder)
        self._enter(event, order.name)
        outcome = work(stage)
        if order.name == "home":
            self._homed = outcome.finished
        self._settle(order.name)
        backlash = self._kept_backlash(outcome, folder.name) if order.name in ("home", "identify") else None
        order.finish(outcome.text, outcome.stop.name, str(folder), backlash)
        self._log.say("command_done", outcome.text, name=order.name, key=order.key, stop=outcome.stop.name)
        return outcome

    def _kept_backlash(self, outcome: Outcome, run: str) -> messages.Backlash | None:
        estimate, stage = outcome.backlash, self._stage
        if estimate is None or not outcome.finished or not estimate.identifiable or stage is None:
            return None
        found = backlash_message(estimate, run, stage.profile.name, now_text())
        self._keep(backlash=found)
        return found

    def _connected(self) -> Supervisor:
        if self._stage is None:
            raise RequestError(f"the stage is not connected; waiting for: {self._waiting_for or 'an acknowledgement'}")
        return self._stage

    def _do_arm(self, order: Order) -> None:
        self._motion(order, Event.ARM, lambda stage: stage.armed(order.body.law))

    def _do_home(self, order: Order) -> None:
        self._homed = False
        self._motion(order, Event.HOME, lambda stage: stage.home())

    def _do_move(self, order: Order) -> None:
        self._motion(order, Event.MOVE, lambda stage: stage.move(order.body.target_m, order.body.law))

    def _do_jog(self, order: Order) -> None:
        def by_distance(stage: Supervisor) -> Outcome:
            return stage.move(float(stage.status()["setpoint_position_m"]) + order.body.distance_m, order.body.law)

        self._motion(order, Event.MOVE, by_distance)

    def _do_jog_at(self, order: Order) -> None:
        self._motion(order, Event.MOVE, lambda stage: stage.jog(order.wanted_m_per_s))

    def _do_identify(self, order: Order) -> None:
        body = order.body
        self._motion(order, Event.IDENTIFY, lambda stage: stage.identify(body.frequency_hz, body.duration_s))

    def _do_acknowledge(self, order: Order) -> None:
        if self._fault is None or self._state is not State.FAULT:
            raise RequestError(f"there is no fault to acknowledge; the state is {self._state}")
        if order.body.number != self._fault.number:
            raise RequestError(
                f"fault {order.body.number} is not the newest; look at fault {self._fault.number} and acknowledge that"
            )
        stage = self._stage
        renew = stage is not None and Stop(int(stage.status()["stop"])) in faults.NEEDS_NEW_SERVO
        if stage is None or renew:
            self._close_stage()
            self._enter(Event.LET_GO, "acknowledged")
            self._retry_at_s = 0.0
        else:
            try:
                again = stage.acknowledge()
            except DriveError as error:  # still in fault: the world is as open as before
                self._trip(faults.of_error(error, self._state, now_text(), self._next_fault()))
                raise RequestError(str(error)) from error
            if again is not Stop.NONE:
                self._trip(faults.of_stop(again, stage.detail, self._state, now_text(), self._next_fault()))
                raise RequestError(f"it stopped again at once: {stage.detail or again.name}; clear the cause first")
            self._homed = self._homed and not stage.status()["reference_lost"]
            self._enter(Event.ACKNOWLEDGE, "acknowledged")
        self._fault = None
        order.finish("acknowledged; nothing was enabled", "", "", None)

    def _do_backend(self, order: Order) -> None:
        if self._state not in (State.OFF, State.IDLE):
            raise RequestError(f"the world can be changed without power only; the state is {self._state}: stop first")
        profile = self._profile if self._profile is not None else load_profile(self._profile_asked)
        chosen = choose(profile, order.body.backend)
        self._log.say("backend", BANNERS[chosen], backend=chosen, asked=order.body.backend, before=self._backend)
        if chosen != self._backend:
            self._close_stage()
            self._backend, self._backend_asked, self._retry_at_s = chosen, order.body.backend, 0.0
        order.finish(BANNERS[chosen], "", "", None)

    def _do_reread(self, order: Order) -> None:
        if self._state not in (State.OFF, State.IDLE):
            raise RequestError(f"the profile is read again without power only; the state is {self._state}: stop first")
        load_profile(self._profile_asked)
        self._reread()
        order.finish("the profile was read again", "", "", None)

    # ---- what clients see ------------------------------------------------------------------------------------

    def _view(self) -> messages.Status:
        stage, profile = self._stage, self._profile
        connected = stage is not None and not self._opening
        status = stage.status() if stage is not None and connected else None
        if time.monotonic() - self._late_at_s > _LATENESS_EVERY_S:
            self._late, self._late_at_s = self._figures.recent_lateness_s(), time.monotonic()
        order = self._order
        return messages.Status(
            state=self._state.value,
            since=self._since,
            banner=BANNERS.get(self._backend, "NO WORLD is open"),
            backend=self._backend,
            backend_description=stage.backend.description if stage is not None else "",
            profile=profile.name if profile is not None else "",
            profile_path=str(profile.source_path) if profile is not None else self._profile_asked,
            waiting_for=self._waiting_for,
            homed=self._homed and status is not None,
            phase=Phase(int(status["phase"])).name if status is not None else "",
            limits=limits(stage.profile if stage is not None else profile),
            positions=positions(status),
            health=health(status, profile.cycle.rate_hz if profile is not None else 0.0, self._late),
            backlash=self._remembered.backlash,
            fault=self._fault,
            lease=self.desk.lease_state(),
            command=order.message() if order is not None else None,
            recording=self._recording.message(),
            remarks=list(stage.remarks) if stage is not None else [],
            version=_VERSION,
            uptime_s=time.monotonic() - self._began_s,
        )


def hear_signals(loop: StageLoop) -> None:
    """SIGTERM and Ctrl-C end the service, SIGHUP has it read its profile again."""
    signal.signal(signal.SIGTERM, lambda number, frame: loop.leave())
    signal.signal(signal.SIGINT, lambda number, frame: loop.leave())
    signal.signal(signal.SIGHUP, lambda number, frame: loop.reread())
