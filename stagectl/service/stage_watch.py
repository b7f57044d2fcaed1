"""What stops a stage that nobody commands just now, and how the state follows the servo's phase."""

import time

from stagectl.errors import StagectlError
from stagectl.requests import Phase
from stagectl.service import faults
from stagectl.service.stage_world import ENDING, StageWorld
from stagectl.service.states import Event, State
from stagectl.signals import Stop


class StageWatch(StageWorld):
    """A stage that is watched between commands, and brought to rest."""

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
        if status["reference_lost"] or Stop(int(status["stop"])) in faults.NEEDS_NEW_SERVO:
            self._homed = False  # said at once, and not when the fault is acknowledged
        if self._state is not State.FAULT and status["phase"] == Phase.STOPPED:
            self._settle()
        elif self._state is State.ARMED and status["phase"] != Phase.TRACKING:
            self._wait_until_it_stands()
            self.show()

    def _wait_until_it_stands(self) -> None:
        """Let a stage that stops by itself do so, for all to see; then say why."""
        stage = self._stage
        self._stop_by_itself()
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
        if phase is Phase.TRACKING and self._state is not State.STOPPING:
            self._enter(Event.HELD, name)
        elif phase is Phase.STOPPED and stop is not Stop.OPERATOR:
            self._trip_by(stop, stage)
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
            self._trip_by(stop, stage)
        elif self._state in (State.MOVING, State.STOPPING):
            self._enter(Event.RESTED, name)

    def _come_to_rest(self) -> None:
        """Obey a stop while no command is under way."""
        reason = ENDING if self._leaving else self.desk.stop_reason
        if self._state is State.ARMED:
            self._enter(Event.STOP, reason)
            self._rest(reason)
        elif self._state is State.FAULT and self._stage is not None:
            self._stage.release()
        self.desk.stopped()
        if self._stage is not None:
            self._stage.allow_motion()
