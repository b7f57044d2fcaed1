"""What state the stage is in, why, and what clients see of it; faults and what a restart remembers.

Moves nothing: whoever moves the stage enters the states here.
"""

import time
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from stagectl import touch_sweep
from stagectl.errors import RequestError, StagectlError
from stagectl.profile import Profile
from stagectl.requests import Phase
from stagectl.service import faults, messages, recording, states
from stagectl.service.desk import Desk, Order
from stagectl.service.exposition import Figures
from stagectl.service.notify import Notifier
from stagectl.service.recording import Recording
from stagectl.service.remembered import Memory, Remembered
from stagectl.service.scope import Scope
from stagectl.service.service_log import ServiceLog, now_text
from stagectl.service.states import Event, State
from stagectl.service.view import BANNERS, backlash_message, health, limits, positions, temperatures
from stagectl.service.wear_watch import WearWatch
from stagectl.signals import STOP_TEXT, Stop
from stagectl.supervisor import Supervisor
from stagectl.touch_sweep import KNOWN_OF_JOINT
from stagectl.wear import PRODUCTION

_LATENESS_EVERY_S = 0.5
_VERSION = metadata.version("stagectl")


@dataclass(frozen=True, slots=True)
class Settings:
    """What the service was started with."""

    profile: str
    backend: str
    runs_root: Path
    state_folder: Path
    seed: int = 0
    machine: str | None = None


class StageState:
    """The state of one stage, from the service's start to its end."""

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
        self._memory = Memory(settings.state_folder, remembered, self._say_not_kept)
        self._recording = Recording(settings.runs_root, log)
        self._began_s = time.monotonic()
        self._profile_asked, self._backend_asked = settings.profile, settings.backend
        self._profile: Profile | None = None  # as it was read last; the next opening reads it where there is none
        self._backend = ""  # as `auto` was resolved, once
        self._stage: Supervisor | None = None
        self._state, self._since = State.OFF, now_text()
        self._stopped_in: State | None = None  # what a stage that stops by itself was doing
        self._fault: messages.Fault | None = None
        self._waiting_for = "the service has just begun"
        self._retry_at_s = 0.0
        self._leaving = self._rereading = self._opening = self._breaking = False
        self._half_was_there = False  # of the hardware that `auto` looks for
        self._scope = Scope(1000.0)
        self._wear: WearWatch | None = None
        self._homed = False
        self._order: Order | None = None
        self._late: tuple[float, float] | None = None
        self._late_at_s = 0.0

    @property
    def _stop_wanted(self) -> bool:
        """Whether a client or the end of the service asks for rest."""
        return self._leaving or self.desk.stop_asked

    def _tick(self) -> None:
        """Publish where things stand, and feed the watchdog as long as the servo's cycles, or else this loop, go on."""
        self._heed_record_requests()
        self._look_at_joint()
        status = self.show()
        self._say_news()  # once the status has it: who hears of it looks there
        self._notifier.feed(status.health.cycles_count if self._stage is not None else time.monotonic_ns())

    def show(self) -> messages.Status:
        """Publish where things stand."""
        status = self._view()
        self.desk.joint = self._joint()
        self.desk.publish(status, self._state)
        return status

    def _joint(self) -> dict[str, float] | None:
        """Return the edges and stiffnesses that a sweep would go by: before homing, that finds them, the last known."""
        stage = self._stage
        if stage is None or self._opening:
            return None
        if self._homed:
            return stage.believed_backlash()
        kept = self._memory.joint(self._backend, stage.profile.name)
        found = {} if kept is None else {name: getattr(kept, name) for name in KNOWN_OF_JOINT}
        return found if found and touch_sweep.could_be(found) else None  # a file can be edited

    def recall_fault(self) -> None:
        """Begin with the fault that nobody has acknowledged, or with the end of a service whose stage had power."""
        kept = self._memory.now
        if kept.powered_since:
            number = self._memory.next_fault_number
            self._trip(faults.of_lost_service(kept.powered_since, kept.backend, self._state, now_text(), number))
            self._memory.keep(powered_since="")
        elif kept.fault is not None:
            self._fault = kept.fault
            self._enter(Event.TRIPPED, "not acknowledged before the service ended")

    @property
    def _in_production(self) -> bool:
        """Whether what the joint shows is of production: not of a sweep over its edges, nor in zeros not yet laid."""
        return self._homed and self._state in (State.ARMED, State.MOVING)

    def _look_at_joint(self) -> None:
        """Follow the wear of a joint that works."""
        stage, wear = self._stage, self._wear
        if stage is None or wear is None or self._opening or not self._in_production:
            return
        status = stage.status()
        if status["phase"] == Phase.TRACKING:
            wear.look(stage.backlash(status))

    def _say_news(self) -> None:
        """Have the log hold what the stage noticed by itself."""
        if self._stage is not None:
            for news in self._stage.take_news():
                self._log.say(news.event, news.text, **news.fields)

    def _keep_wear(self) -> None:
        """Have what production motion showed survive a restart."""
        wear, stage = self._wear, self._stage
        found = None if wear is None else wear.newest_of_production()
        if wear is None or found is None or stage is None:
            return
        name, run = stage.profile.name, self._recording.folder(stage.folder).name
        before = self._memory.joint(self._backend, name)
        if before is None or before.at != wear.seen_at:  # not what an earlier motion showed, as if it were news
            kept = backlash_message(found, run, name, self._backend, wear.seen_at, PRODUCTION)
            self._memory.keep_joint(kept)

    def _heed_record_requests(self) -> None:
        """Begin or end a run that a client asked for; motions go on meanwhile."""
        trigger = self.desk.next_trigger_request()
        if trigger is not None:
            self._recording.wait_for(None if isinstance(trigger, str) else trigger)
        self._recording.save_event()
        asked = self.desk.next_record_request()
        if asked is None:
            return
        if self._stage is None or self._opening:
            self._log.say("record", f"{asked or 'end'}: not done, the stage was let go of meanwhile")
            return
        if asked == "":
            self._recording.end_on_request(self._state in states.POWERED)
        else:
            self._recording.begin_on_request(asked)

    def _enter(self, event: Event, text: str = "") -> None:
        before, self._state = self._state, states.after(self._state, event)
        if before is not self._state:
            self._stopped_in = None
            self._since = now_text()
            self._log.say("state", text, state=self._state.value, before=before.value, because=event.value)
            self._notifier.say(STATUS=f"{self._state.value}, {self._backend or 'no world'}")
        self.desk.powered = self._state in states.POWERED
        if (before in states.POWERED) is not self.desk.powered:
            self._memory.keep(powered_since=self._since if self.desk.powered else "")
        if before in states.POWERED and not self.desk.powered:
            self._keep_wear()
        if before in states.POWERED and not self.desk.powered and not self._breaking:
            self._recording.end(recording.ARM, *self._why(event, before))

    def _why(self, event: Event, before: State) -> tuple[str, str]:
        """Return how the run of a powered stage ended: the Stop's name, and the sentence."""
        if event is Event.TRIPPED and self._fault is not None:
            return self._fault.kind, f"{self._fault.what}: {self._fault.values}"
        stop = Stop.FINISHED if before is State.MOVING else Stop.OPERATOR
        return stop.name, STOP_TEXT[stop]

    def _trip(self, fault: messages.Fault) -> None:
        self._fault = fault
        self._memory.keep(faults_count=fault.number, fault=fault)
        self._recording.save_last(fault.kind)
        self._enter(Event.TRIPPED, fault.what)
        self._log.say("fault", fault.what, **fault.model_dump(exclude={"what", "at"}))
        self._figures.fault(fault.kind)

    def _stop_by_itself(self) -> None:
        """Have all see that the stage stops, before it stands and can say why."""
        before = self._state
        self._enter(Event.STOP, "it stops by itself")
        self._stopped_in = before

    def _trip_by(self, stop: Stop, stage: Supervisor) -> None:
        state = self._stopped_in or self._state
        self._trip(faults.of_stop(stop, stage.detail, state, now_text(), self._memory.next_fault_number))

    def _fault_of(self, error: StagectlError) -> messages.Fault:
        state = self._stopped_in or self._state
        return faults.of_error(error, state, now_text(), self._memory.next_fault_number)

    def _say_not_kept(self, text: str) -> None:
        self._log.say("state_not_kept", text)

    def _connected(self) -> Supervisor:
        if self._stage is None:
            raise RequestError(f"the stage is not connected; waiting for: {self._waiting_for or 'an acknowledgement'}")
        return self._stage

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
            temperatures=temperatures(stage.temperatures) if stage is not None and connected else {},
            backlash=None if profile is None else self._memory.joint(self._backend, profile.name),
            wear=None if self._wear is None else self._wear.message(),
            fault=self._fault,
            lease=self.desk.lease_state(),
            command=order.message() if order is not None else None,
            recording=self._recording.message(),
            remarks=list(stage.remarks) if stage is not None else [],
            version=_VERSION,
            uptime_s=time.monotonic() - self._began_s,
        )
