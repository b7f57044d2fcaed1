"""What of a session goes to the disk: every powered motion, what is asked for, the last seconds before a fault."""

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stagectl.errors import RecordError, RequestError
from stagectl.flight_recorder import FlightRecorder
from stagectl.left_runs import finish_left_runs
from stagectl.profile import Profile
from stagectl.record import read_manifest, recover_orphans
from stagectl.recording_trigger import Trigger, TriggerWatch
from stagectl.retention import prune
from stagectl.row import ROW
from stagectl.run_folder import reserve
from stagectl.service import messages
from stagectl.service.service_log import ServiceLog
from stagectl.signals import STOP_TEXT, Stop

ARM, REQUEST, FAULT, ALWAYS = "arm", "request", "fault", "always"
_PRUNE_EVERY_S = 600.0
_RUNS_LEAST_COUNT = 10
"""Runs that share the room for all: the oldest can only go when it is closed."""
_RUN_LEAST_ROWS_COUNT = 60_000  # a minute at 1 kHz, however little room there is


class Recording:
    """The recorder of the session under way, and the reasons that begin and end its runs."""

    def __init__(self, runs_root: Path, log: ServiceLog):
        """No session yet."""
        self._runs_root, self._log = runs_root, log
        self._recorder: FlightRecorder | None = None
        self._over = threading.Event()
        self._profile: Profile | None = None
        self._pruning: threading.Thread | None = None
        self._asked: messages.SetTrigger | None = None
        self._watch: TriggerWatch | None = None
        self._left_count = 0
        self._name_after_motion = ""  # of the run that was asked for while a motion's was under way
        self._name_asked = ""  # of the run that was asked for last
        self._window: tuple[int, int] | None = None  # rows of the session, the end of which is still to come
        self._unsaved: set[Path] = set()  # what a session left and nobody could save yet

    def factory(self, profile: Profile) -> Callable[[Path, dict[str, Any]], FlightRecorder]:
        """Return what makes the recorder of a session with this profile."""
        self._profile = profile

        def make(folder: Path, manifest: dict[str, Any]) -> FlightRecorder:
            limits, rate_hz = profile.record, profile.cycle.rate_hz
            room_count = max(limits.size_limit_bytes // _RUNS_LEAST_COUNT // ROW.itemsize, _RUN_LEAST_ROWS_COUNT)
            recorder = self._recorder = FlightRecorder(
                folder,
                manifest,
                lambda name: reserve(self._runs_root, name),
                round(limits.flight_s * rate_hz),
                limits.on_full_disk,
                self._log.say,
                min(round(limits.run_length_s * rate_hz), room_count),
                self._end_session,
            )
            if profile.record.when == ALWAYS:
                try:
                    recorder.begin_run(f"service-{ALWAYS}", ALWAYS, None)
                except RecordError:
                    recorder.abandon()
                    raise
            return recorder

        return make

    def begin(self, name: str, trigger: str, t_ns: int) -> None:
        """Begin a run where none is under way. Errors: RequestError where the disk does not take it."""
        flight = self._recorder
        if flight is None or flight.run_folder is not None:
            return
        try:
            flight.begin_run(f"service-{name}", trigger, t_ns)
        except RecordError as error:
            raise RequestError(f"{name}: nothing may move that can't be recorded: {error}") from error
        if flight.run_folder is not None:
            self._log.say("run", "begun", run=flight.run_folder.name, trigger=trigger)

    def end(self, trigger: str, stop: str, text: str) -> None:
        """End the run under way where `trigger` began it, or would begin what it is about to go on in."""
        flight = self._recorder
        if flight is None or trigger not in (flight.trigger, flight.trigger_soon):
            return
        if trigger == ARM and self._name_after_motion:
            name, self._name_after_motion = self._name_after_motion, ""
            flight.go_on_as(f"service-{name}", REQUEST, {"stop": stop, "text": text})
        if flight.run_folder is None or flight.trigger_soon != trigger:
            return
        try:
            folder = flight.end_run({"stop": stop, "text": text})
        except RecordError as error:
            self._log.say("record_lost", str(error))
            return
        self._log.say("run", "ended", run=folder.name if folder is not None else "", trigger=trigger)

    def begin_on_request(self, name: str) -> None:
        """Begin a run that a client asked for, behind a motion's where that is under way; the stage may move meanwhile.

        Where another is under way that was asked for, or the session's, that one has the rows already.
        """
        flight = self._recorder
        if flight is None:
            return
        self._name_asked = name
        if flight.run_folder is None:
            flight.go_on_as(f"service-{name}", REQUEST)
            return
        if flight.trigger_soon == ARM:
            self._name_after_motion = name
            self._log.say("run", f"{name} begins when this one ends", run=flight.run_folder.name, trigger=ARM)
        else:
            self._log.say("run", f"{name}: this one goes on", run=flight.run_folder.name, trigger=flight.trigger)

    def end_on_request(self, powered: bool) -> None:
        """End the run that a client asked for; a motion that is under way goes on being recorded, in its own."""
        flight, stop, text = self._recorder, Stop.OPERATOR.name, STOP_TEXT[Stop.OPERATOR]
        self._name_after_motion = self._name_asked = ""
        if flight is None:
            return
        if flight.run_folder is None:
            flight.end_run()  # it is not there yet
        elif powered and flight.trigger_soon == REQUEST:
            flight.go_on_as(f"service-{ARM}", ARM, {"stop": stop, "text": text})
        else:
            self.end(REQUEST, stop, text)

    def save_last(self, kind: str) -> None:
        """Write the last seconds, where no run has them."""
        flight = self._recorder
        if flight is not None and flight.run_folder is None:
            flight.save_last(f"service-{FAULT}", kind, "the last seconds")

    def wait_for(self, asked: messages.SetTrigger | None) -> None:
        """Wait for an event to record, or for none any more."""
        self._asked, self._window = asked, None
        self._watch = None if asked is None else TriggerWatch(Trigger(asked.error_m, asked.contact_force_n))
        self._left_count = 0 if asked is None else asked.count

    def observe(self, rows: np.ndarray) -> None:
        """Look for the event in rows, shape (n,) of ROW, that the recorder takes next."""
        flight, watch, asked, profile = self._recorder, self._watch, self._asked, self._profile
        if flight is None or watch is None or asked is None or profile is None:
            return
        found = watch.first(rows)
        if found is not None and self._window is None and self._left_count > 0:
            row, rate_hz = flight.rows_count + found, profile.cycle.rate_hz
            self._window = row - round(asked.before_s * rate_hz), row + 1 + round(asked.after_s * rate_hz)

    def save_event(self) -> None:
        """Write what is around the event as a run, once its end is there."""
        if self._recorder is not None and self._window is not None and self._recorder.rows_count >= self._window[1]:
            self._save_window("around an event")

    def _end_session(self) -> None:
        """Write what there is around an event whose end does not come any more: the session ends."""
        self._say_not_begun()
        self.save_event()
        if self._window is not None:
            self._save_window("around an event, to the session's end")

    def _save_window(self, text: str) -> None:
        flight, asked, watch, window = self._recorder, self._asked, self._watch, self._window
        if flight is None or asked is None or watch is None or window is None:
            return
        self._window, self._left_count = None, self._left_count - 1
        flight.save_window(f"service-{asked.name}", watch.trigger.text, text, *window)

    def folder(self, session: Path) -> Path:
        """Return the run that rows go to now, the session's own folder where there is none."""
        flight = self._recorder
        return session if flight is None or flight.run_folder is None else flight.run_folder

    def message(self) -> messages.Recording | None:
        """Say what goes to the disk now."""
        flight = self._recorder
        if flight is None:
            return None
        run = flight.run_folder
        return messages.Recording(
            run="" if run is None else run.name,
            trigger=flight.trigger,
            rows_count=flight.run_rows_count,
            trouble=flight.trouble,
            next_name=self._next_name,
            waits_for="" if self._watch is None else self._waits_for(self._watch),
        )

    def _waits_for(self, watch: TriggerWatch) -> str:
        return f"{watch.trigger.text}, {self._left_count} times" if self._left_count > 0 else ""

    def forget(self) -> None:
        """The session is over."""
        self._say_not_begun()
        self._recorder = self._window = None

    def _say_not_begun(self) -> None:
        """Say that the session ends before a run that was asked for, where it does."""
        if self._next_name:
            self._log.say("record_lost", f"{self._next_name}: asked for, and the session ended before it began")
        self._name_after_motion = self._name_asked = ""

    @property
    def _next_name(self) -> str:
        """Name of the run that was asked for and is not there yet."""
        flight = self._recorder
        is_due = flight is not None and flight.trigger_soon == REQUEST != flight.trigger
        return self._name_after_motion or (self._name_asked if is_due else "")

    def discard(self, session: Path) -> None:
        """Remove the folder of a session that did not come about, where it holds no row."""
        self._recorder = self._window = None
        try:
            rows_count = read_manifest(session)["record"].get("rows_count", -1)
        except RecordError:
            return  # given back already, or not ours
        if rows_count == 0:
            shutil.rmtree(session, ignore_errors=True)

    def save_left(self) -> None:
        """Save rows and end runs that sessions left behind whose disk was full; to be called while none is open."""
        unsaved: set[Path] = set()
        try:
            outcomes = [*recover_orphans(runs_root=self._runs_root), *finish_left_runs(self._runs_root)]
        except OSError as error:  # the opening meets it too, and says what to do
            self._log.say("not_recovered", str(error))
            return
        for place, outcome in outcomes:
            if not isinstance(outcome, RecordError):
                self._log.say("recovered", str(outcome), place=str(place))
                continue
            unsaved.add(place)
            if place not in self._unsaved:  # it is tried again every few seconds
                self._log.say("not_recovered", str(outcome), place=str(place))
        self._unsaved = unsaved

    # ---- retention -------------------------------------------------------------------------------------------

    def begin_pruning(self) -> None:
        """Keep the runs within the profile's limits, from a thread of its own: removing takes time."""
        self._pruning = threading.Thread(target=self._prune, name="retention", daemon=True)
        self._pruning.start()

    def end_pruning(self) -> None:
        """Remove no more."""
        self._over.set()

    def _prune(self) -> None:
        looked_s = time.monotonic()
        while True:
            profile = self._profile
            if profile is not None:
                now_s, limits = time.monotonic(), profile.record
                elapsed_s, looked_s = now_s - looked_s, now_s
                for gone in prune(self._runs_root, limits.size_limit_bytes, limits.age_limit_s, elapsed_s):
                    self._log.say("run_removed", gone.because, run=gone.folder.name)
            if self._over.wait(_PRUNE_EVERY_S if profile is not None else 5.0):
                return
