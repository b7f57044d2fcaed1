"""The world that the stage is in: waited for, opened, let go of, broken; the profile read again."""

import time
from pathlib import Path

import numpy as np

from stagectl.errors import LinkError, ProfileError, RequestError, StagectlError
from stagectl.profile import Profile, load_profile
from stagectl.requests import Phase
from stagectl.run_folder import give_back
from stagectl.service import states
from stagectl.service.scope import Scope
from stagectl.service.stage_state import StageState
from stagectl.service.states import Event, State
from stagectl.service.view import BANNERS
from stagectl.service.wear_watch import WearWatch
from stagectl.service.world import missing
from stagectl.signals import Stop
from stagectl.stage import choose, open_stage

_RETRY_S, _RETRY_AFTER_FAILURE_S = 2.0, 5.0
_CONNECT_S = 240.0  # a cold compile cache on a slow host
_CLOSE_S = 60.0  # coming to rest, rows to the disk
_OPENING = "opening the stage"
_STOPS = (Phase.STOPPING, Phase.GUIDED_STOP, Phase.QUICK_STOP)
_NO_FAULTS = (Stop.NONE, Stop.OPERATOR, Stop.FINISHED, Stop.HOMING_GIVEN_UP)
"""With these a stage was asked to stop, or looks for its index on the other side: it does not stop by itself."""
ENDING = "the service was asked to end"
"""Why the stage comes to rest at the service's end."""


class Leaving(Exception):
    """The service was asked to end while it was opening a world."""


class StageWorld(StageState):
    """A stage whose world is opened and let go of."""

    def _open(self) -> None:
        """Try to open the stage; what is missing is waited for, what is wrong is a fault."""
        self._retry_at_s = time.monotonic() + _RETRY_S
        try:
            profile = self._profile_as_read()
            if not self._backend:
                self._backend, self._backend_asked, because = self._world_to_begin_with(profile)
                facts = {"backend": self._backend, "asked": self._backend_asked, "because": because}
                self._log.say("backend", BANNERS[self._backend], **facts)
            absent = missing(profile, self._backend, self.settings.runs_root)
            if absent:
                self._wait_for(absent)
                return
        except LinkError as error:
            self._half_was_there = True
            self._wait_for(str(error))
            return
        except ProfileError as error:
            self._wait_for(str(error))
            return
        except RequestError as error:
            self._trip(self._fault_of(error))
            return
        self._wait_for(_OPENING)
        self._notifier.allow(_CONNECT_S)
        self._recording.save_left()
        if self._leaving:
            return
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
            self._figures.begin_servo(profile)
            self._scope = Scope(profile.cycle.rate_hz)
            self.desk.scope = self._scope
            stage.__enter__()
            self._stage, self._homed, self._waiting_for = stage, False, ""
            self._wear = WearWatch(stage.profile, self._log, time.monotonic)
            self._wear.recall(self._memory.joint(self._backend, stage.profile.name))
        except Leaving:
            return
        except LinkError as error:
            self._wait_for(str(error))
            return
        except StagectlError as error:
            self._trip(self._fault_of(error))
            return
        finally:
            self._opening = False
            self._notifier.allow(0.0)
            if folder is not None and self._stage is None:
                give_back(folder)
                self._recording.discard(folder)
            self._retry_at_s = time.monotonic() + _RETRY_AFTER_FAILURE_S
        self.desk.joint = self._joint()
        self.desk.profile = stage.profile
        self._memory.keep(
            profile=str(profile.source_path),
            profile_name=profile.name,
            backend=self._backend,
            backend_asked=self._backend_asked,
        )
        self._enter(Event.CONNECTED, stage.backend.description)

    def _profile_as_read(self) -> Profile:
        """Return the profile; from its file only where there is none yet, or it was wrong. Errors: ProfileError.

        Read at every opening, a file that somebody is half through editing would be the stage's after a pulled cable.
        """
        if self._profile is None:
            self._profile = load_profile(self._profile_asked)
        return self._profile

    def _world_to_begin_with(self, profile: Profile) -> tuple[str, str, str]:
        """Return the world, what was asked for, and by whom: a client before the restart, else the service's start.

        A swap counts for the profile it was made with and for as long as the service is started in the same way. Where
        `auto` once found hardware, hardware that is late at the next start is waited for; so is all of it where a half
        was there and is gone: a USB adapter counted anew makes no rig of a machine. LinkError where there is a half.
        """
        asked, kept = self._backend_asked, self._memory.now
        if kept.profile == str(profile.source_path):
            if kept.swapped_from == asked:
                return kept.backend, kept.backend_asked or kept.backend, "a client before the restart"
            if asked == "auto" and kept.backend == "hardware" and not kept.swapped_from:
                return kept.backend, asked, "auto found it at an earlier start"
        chosen = choose(profile, asked)
        if chosen != asked and chosen == "rig" and self._half_was_there:
            raise LinkError(
                f"profile {profile.name}: a part of the hardware was there and is gone; plug all of it in, or ask for "
                "--backend rig by name"
            )
        self._memory.keep(swapped_from="")
        return chosen, asked, "the service's start"

    def _wait_for(self, what: str) -> None:
        if what != self._waiting_for:
            self._waiting_for = what
            self._log.say("waiting", what)
            self._notifier.say(STATUS=f"waiting: {what}")
        self._tick()

    def _close_stage(self) -> None:
        """Let go of the world, whatever that says."""
        stage, self._stage, self._wear = self._stage, None, None
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
        self._figures.begin_servo()  # closing brings the last rows, and what they count was counted before
        if states.TRANSITIONS.get((self._state, Event.LET_GO)) is not None and self._state is not State.FAULT:
            self._enter(Event.LET_GO)

    def _reread(self) -> None:
        """Heed a signal: have the profile read again; a wrong one changes nothing."""
        self._rereading = False
        try:
            self._read_again()
        except ProfileError as error:
            self._log.say("profile", f"kept as it was: {error}")

    def _read_again(self) -> None:
        """Read the profile again, and open the stage anew with it. Errors: ProfileError, and nothing is changed."""
        self._profile = load_profile(self._profile_asked)
        self._log.say("profile", "read again", profile=self._profile_asked)
        self._open_anew()

    @property
    def _may_open_another(self) -> bool:
        """Whether the world may be changed: no power, and no stage whose fault somebody must look at first.

        A world that was opened into a fault is none: it can be left, and the acknowledgement opens another.
        """
        return self._state in (State.OFF, State.IDLE) or (self._state is State.FAULT and self._stage is None)

    def _open_anew(self) -> None:
        """Let go of the world; the loop opens one at its next step, and says until then what it waits for.

        Where a fault stands, its acknowledgement comes before that.
        """
        self._close_stage()
        if self._state is State.FAULT:
            self._wait_for("an acknowledgement of the fault")
            return
        self._retry_at_s = 0.0
        self._wait_for(_OPENING)

    def _break(self, error: StagectlError) -> None:
        """What broke on this side: bring the stage to rest, let go of it, and say so."""
        self._breaking = True  # the run ends when the last rows are in it
        self._trip(self._fault_of(error))
        self._tick()  # said at once: closing may take as long as a servo that hangs is given
        if self._order is not None:
            self._order.fail(error)
        self._close_stage()
        self._breaking = False

    def _observe(self, rows: np.ndarray) -> None:
        self._scope.add(rows)
        self._figures.add(rows)
        self._recording.observe(rows)
        if self._wear is not None and self._in_production:
            self._wear.observe(rows)

    def _progress(self, what: str, share: float) -> None:
        """Hear from the supervisor that a motion goes on; the place where a stop comes in."""
        if self._order is not None:
            self._order.progress(what, share)
        if self._stop_wanted and self._stage is not None and not self._opening:
            if states.TRANSITIONS.get((self._state, Event.STOP)) is not None:
                self._enter(Event.STOP, ENDING if self._leaving else self.desk.stop_reason)
            self._stage.ask_to_stop()
        elif self._stage is not None and not self._opening and self._state in (State.MOVING, State.IDENTIFYING):
            status = self._stage.status()
            if status["phase"] in _STOPS and status["stop"] not in _NO_FAULTS:
                self._stop_by_itself()
        self._tick()
