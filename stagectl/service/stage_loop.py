"""The main thread of the service: owns the supervisor object, carries out one command after the other, keeps watch.

Clients reach it through `Desk`; nothing here waits for one of them, and nothing that the servo waits for is here.
"""

import time
from collections.abc import Callable

from stagectl.errors import DriveError, LinkError, ProfileError, RequestError, StagectlError
from stagectl.outcome import Outcome
from stagectl.requests import Phase
from stagectl.service import faults, messages, recording, states
from stagectl.service.desk import Order
from stagectl.service.motions import MOTIONS
from stagectl.service.service_log import now_text
from stagectl.service.stage_watch import StageWatch
from stagectl.service.stage_world import Leaving
from stagectl.service.states import Event, State
from stagectl.service.view import BANNERS, backlash_message
from stagectl.session import WATCHED_ONLY
from stagectl.signals import Stop
from stagectl.stage import choose, machine_of
from stagectl.supervisor import Supervisor
from stagectl.wear import IDENTIFIED, PROBE


class StageLoop(StageWatch):
    """One stage, from the service's start to its end."""

    # ---- the loop --------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Work until `leave`; then bring the stage to rest and close its run."""
        self._recording.begin_pruning()
        try:
            while not self._leaving:
                self.step()
        except Leaving:
            pass  # while a world was opened, and what of it was there is closed
        finally:
            self._leave()

    def step(self) -> None:
        """Do the next thing: a command, a look at the stage, or a try to open it."""
        self._tick()
        if self._rereading and self._may_open_another:
            self._reread()
        elif self.desk.stop_asked:
            self._come_to_rest()
        elif (order := self.desk.next_order()) is not None:
            self._carry_out(order)
        elif self._stage is not None:
            self._watch()
            self._care_for_joint()
        elif self._state is State.OFF and time.monotonic() >= self._retry_at_s:
            self._open()
        else:
            time.sleep(0.02)

    def leave(self) -> None:
        """Have `run` end; the stage comes to rest first. May be called from a signal handler."""
        again, self._leaving = self._leaving, True  # nothing else: what the signal interrupted may hold locks
        if self._opening and not again:
            raise Leaving

    def reread(self) -> None:
        """Have the profile read again as soon as the stage has no power. May be called from a signal handler."""
        self._rereading = True

    def _leave(self) -> None:
        self._notifier.say(STOPPING=1, STATUS="bringing the stage to rest")
        self.desk.close()
        if self._stage is not None and self._state is State.ARMED:
            self._come_to_rest()
        self._close_stage()
        self._recording.end_pruning()
        self._tick()

    # ---- commands --------------------------------------------------------------------------------------------

    def _carry_out(self, order: Order) -> None:
        """Carry out one command; its record says what became of it."""
        self._order = order
        try:
            self.desk.check_order(order)
            order.begin()
            self._log.say("command", order.name, key=order.key, body=order.body.model_dump())
            self._work(order.name)(order)
        except StagectlError as error:
            self._log.say("command_failed", str(error), name=order.name, key=order.key, kind=type(error).__name__)
            if isinstance(error, RequestError):
                self._after_refusal()
                self._make_public()
                order.fail(error)
            else:
                self._break(error)
        finally:
            self._order = None
            if not self._stop_wanted and self._stage is not None:
                self._stage.allow_motion()

    def _finish(
        self, order: Order, text: str, stop: str = "", run: str = "", backlash: messages.Backlash | None = None
    ) -> None:
        """Say how a command ended."""
        self._make_public()
        order.finish(text, stop, run, backlash)

    def _make_public(self) -> None:
        """Have all see what a command made of the stage: who hears of its end asks for the next thing at once."""
        if self.desk.stop_asked:
            self._come_to_rest()
        self.show()

    def _work(self, name: str) -> Callable[[Order], None]:
        """Return what carries a command out."""
        own: dict[str, Callable[[Order], None]] = {
            "acknowledge": self._do_acknowledge,
            "backend": self._do_backend,
            "reread": self._do_reread,
        }
        return own.get(name, self._move)

    def _after_refusal(self) -> None:
        """A request that was refused half way leaves the stage holding, or on its way to rest."""
        stage = self._stage
        if stage is None or self._state not in states.POWERED - {State.ARMED}:
            return
        if stage.status()["phase"] == Phase.TRACKING and stage.status()["segment_left_rows"] > 0:
            self._rest("refused half way")
        else:
            self._settle("refused")

    def _move(self, order: Order) -> None:
        """Do a motion and bring the state into line with how it ended."""
        motion, stage = MOTIONS[order.name], self._connected()
        states.after(self._state, motion.event)
        if not stage.backend.may_move:
            raise RequestError(f"{order.name}: {WATCHED_ONLY}")
        if motion.needs_homing and not self._homed:
            raise RequestError(f"{order.name}: the stage is not homed since it was connected; home it first")
        stage.allow_motion()
        if self._state is State.IDLE:
            self._recording.begin(order.name, recording.ARM, stage.link.now_t_ns())
        folder = self._recording.folder(stage.folder)
        self._enter(motion.event, order.name)
        if not motion.needs_homing:
            self._homed = False
        if order.name == "probe" and self._wear is not None:
            self._wear.probe_begun()  # one that another command came before is due again when the stage holds
        outcome = motion.work(stage, order)
        if not motion.needs_homing:
            self._homed = outcome.finished
        self._settle(order.name)
        source = PROBE if order.name == "probe" else IDENTIFIED
        backlash = self._kept_backlash(outcome, folder.name, source) if motion.identifies else None
        if backlash is not None and self._wear is not None:
            self._wear.found(outcome.backlash, source, is_believed=order.name == "home")
        self._finish(order, outcome.text, outcome.stop.name, str(folder), backlash)
        self._log.say("command_done", outcome.text, name=order.name, key=order.key, stop=outcome.stop.name)

    def _care_for_joint(self) -> None:
        """Between moves: believe what wear has made of the joint, or have it touched, where the profile permits it."""
        stage, wear = self._stage, self._wear
        if stage is None or wear is None or self._state is not State.ARMED or not self._homed:
            return
        status = stage.status()
        if status["phase"] != Phase.TRACKING or status["segment_left_rows"] > 0:
            return
        found = wear.replacement(stage.believed_backlash())
        if found is not None:
            try:
                stage.replace_backlash(found)
            except StagectlError as error:
                self._break(error)
                return
            wear.replaced(found)
        elif wear.probe_due():
            self.desk.submit_own("probe", messages.Probe())

    def _kept_backlash(self, outcome: Outcome, run: str, source: str) -> messages.Backlash | None:
        estimate, stage = outcome.backlash, self._stage
        if estimate is None or not outcome.finished or not estimate.identifiable or stage is None:
            return None
        found = backlash_message(estimate, run, stage.profile.name, self._backend, now_text(), source)
        self._memory.keep_joint(found)
        return found

    def _needs_anew(self, stage: Supervisor) -> bool:
        """Tell whether the world must be opened anew: the servo gave a link up, or a drive forgot its configuration."""
        if Stop(int(stage.status()["stop"])) in faults.NEEDS_NEW_SERVO:
            return True
        try:
            text = stage.drives_changed()
        except StagectlError as error:  # it does not even answer
            text = str(error)
        if text:
            self._log.say("drives_changed", text)
        return bool(text)

    def _do_acknowledge(self, order: Order) -> None:
        if self._fault is None or self._state is not State.FAULT:
            raise RequestError(f"there is no fault to acknowledge; the state is {self._state}")
        if order.body.number != self._fault.number:
            raise RequestError(
                f"fault {order.body.number} is not the newest; look at fault {self._fault.number} and acknowledge that"
            )
        stage = self._stage
        if stage is None or self._needs_anew(stage):
            self._close_stage()
            if self._fault.kind == ProfileError.__name__:
                self._profile = None  # it was to be corrected first, and is read with no further word
            self._enter(Event.LET_GO, "acknowledged")
        else:
            try:
                again = stage.acknowledge()
            except DriveError as error:  # still in fault: the world is as open as before
                self._trip(self._fault_of(error))
                raise RequestError(str(error)) from error
            if again is not Stop.NONE:
                self._trip_by(again, stage)
                raise RequestError(f"it stopped again at once: {stage.detail or again.name}; clear the cause first")
            self._homed = self._homed and not stage.status()["reference_lost"]
            self._enter(Event.ACKNOWLEDGE, "acknowledged")
        self._fault = None
        self._memory.keep(fault=None)
        if self._stage is None:
            self._open_anew()
        self._finish(order, "acknowledged; nothing was enabled")

    def _do_backend(self, order: Order) -> None:
        self._refuse_unless_free("the world can be changed")
        try:
            profile = self._profile_as_read()
            chosen = choose(profile, order.body.backend)
            machine_of(profile, chosen, self.settings.machine)
        except (ProfileError, LinkError) as error:  # the world that is open is as sound as before
            raise RequestError(str(error)) from error
        self._log.say("backend", BANNERS[chosen], backend=chosen, asked=order.body.backend, before=self._backend)
        asked, began_with, before = order.body.backend, self.settings.backend, self._backend
        if (chosen, asked) != (before, self._backend_asked):  # also to stay in the world that `auto` chose
            self._backend, self._backend_asked = chosen, asked
            self._memory.keep(
                profile=str(profile.source_path),
                backend=chosen,
                backend_asked=asked,
                swapped_from="" if asked == began_with else began_with,  # back to how it was started: no swap any more
            )
        if chosen != before:
            self._open_anew()
        self._finish(order, BANNERS[chosen])

    def _do_reread(self, order: Order) -> None:
        self._refuse_unless_free("the profile is read again")
        try:
            self._read_again()
        except ProfileError as error:
            raise RequestError(f"kept as it was: {error}") from error
        self._finish(order, "the profile was read again")

    def _refuse_unless_free(self, what: str) -> None:
        """Refuse what lets go of the world while the stage has power, or while a fault of it stands."""
        if not self._may_open_another:
            first = "acknowledge that first" if self._state is State.FAULT else "stop first"
            raise RequestError(f"{what} without power only; the state is {self._state}: {first}")
