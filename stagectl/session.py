"""A stage from connecting to the end: drives, servo, ring and run, power on and power off.

Everything that moves is asked for through it (`stagectl.motion`, `stagectl.homing`); it plans nothing itself.
"""

import contextlib
import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np

from drivers import cia402
from drivers.agreed import Agreed, changed, read_agreed
from drivers.arming import DriveMapping, DriveSettings, configure
from drivers.canopen_master import Master
from stagectl.backend import Backend, ServoLink
from stagectl.drive_settings import drive_settings
from stagectl.errors import DriveError, LinkError, RecordError, RequestError, StagectlError, TimingError
from stagectl.flight_recorder import FlightRecorder
from stagectl.heartbeats import Heartbeats
from stagectl.outcome import BacklashEstimate, Outcome
from stagectl.plant import PLANT_PARAMETERS
from stagectl.profile import AxisName, Profile, Temperature
from stagectl.record import Recorder
from stagectl.replay import describe_mapping
from stagectl.requests import RESTING, Mode, Phase
from stagectl.signals import MODES, STOP_TEXT, Stop, stop_sentence
from stagectl.temperatures import DriveTemperature, News, Temperatures, answer_s
from stagectl.tracker import LAW_NAMES
from stagectl.undisturbed import undisturbed

_STEP_S = 0.02
_SENSOR_TIMEOUT_S = 5.0
_RESET_TIMEOUT_S = 2.0
_REST_NOTED_S = 0.5
_MODE_TIMEOUT_S = 0.5
_NEWS_KEPT_COUNT = 100
_STALL_S = 1.5  # without a cycle: three times what the servo grants this side
_FAULTS = (cia402.State.FAULT, cia402.State.FAULT_REACTION_ACTIVE)

_NOTHING_TO_STOP = (Phase.IDLE, Phase.STOPPED)  # a drive that holds after its homing has power still
_WITH_POWER = (int(Mode.TRACK), int(Mode.HOME_DRIVE))
WATCHED_ONLY = (
    "real drives on a simulated interferometer may only be watched: what moves is not what is measured; connect the "
    "interferometer and take the backend hardware, or rig"
)
"""Why nothing is armed in such a world."""

Progress = Callable[[str, float], None]


class Session:
    """One stage, one holder. Use as a context; leaving it brings the stage to rest and closes the run."""

    def __init__(
        self,
        profile: Profile,
        backend: Backend,
        run_folder: Path,
        progress: Progress = lambda what, share: None,
        manifest: dict[str, Any] | None = None,
        *,
        lease_left_s: Callable[[], float] = lambda: math.inf,
        observe: Callable[[np.ndarray], None] = lambda rows: None,
        record: Callable[[Path, dict[str, Any]], Recorder | FlightRecorder] = Recorder,
    ):
        """Hold the parts; nothing is touched before `connect`.

        The servo's lease lasts as long as `lease_left_s` says, `trip.lease_s` at most. `observe` sees every row once.
        """
        self.profile, self.backend, self.folder = profile, backend, run_folder
        self._progress = progress
        self._manifest = dict(manifest or {})
        self._lease_left_s, self._observe, self._record = lease_left_s, observe, record
        self._master: Master | None = None
        self._link: ServoLink | None = None
        self._recorder: Recorder | FlightRecorder | None = None
        self._counter = 0

        self._update_number = 0
        self._homing_id = 0
        self._belief = np.zeros(1, PLANT_PARAMETERS)
        self._holds_lease = False
        self._watches = False
        self._asked_to_stop = False
        self._rows_seen, self._stalled_s = -1, 0.0
        self._heartbeats = Heartbeats(profile.trip.heartbeat_s)
        axes = ((axis, profile.axis(axis).temperature) for axis in profile.axes)
        tables = {axis: table for axis, table in axes if table is not None}
        self._temperatures = Temperatures(tables, self._temperature_count)
        self._news: deque[News] = deque(maxlen=_NEWS_KEPT_COUNT)
        self._reason, self._reason_stop = "", Stop.NONE  # why this side asked the servo to stop, and as what
        self._trouble: StagectlError | None = None  # raised as soon as the stage rests
        self.mappings: dict[str, DriveMapping] = {}
        self._modes: dict[AxisName, int] = {}
        self._written_modes: dict[AxisName, int] = {}  # since arming
        self._agreed: dict[int, Agreed] = {}
        self.remarks: list[str] = []
        """What the operator should know of this arming, in words."""

    def __enter__(self) -> Self:
        try:
            self.connect()
        except BaseException as error:
            with undisturbed():  # a signal that raises would leave servo or rig behind
                self._close(error)
            raise
        return self

    def __exit__(self, kind, error, trace) -> None:
        self._close(error)

    # ---- parts -----------------------------------------------------------------------------------------------

    @property
    def link(self) -> ServoLink:
        """The servo; RequestError before `connect`."""
        if self._link is None:
            raise RequestError("the stage is not connected; call connect() first")
        return self._link

    @property
    def master(self) -> Master:
        """The CANopen master; RequestError before `connect`."""
        if self._master is None:
            raise RequestError("the stage is not connected; call connect() first")
        return self._master

    @property
    def recorder(self) -> Recorder | FlightRecorder:
        """The run's recorder; RequestError before `connect`."""
        if self._recorder is None:
            raise RequestError("the stage is not connected; call connect() first")
        return self._recorder

    def status(self) -> np.void:
        """Return the servo's newest state (STATUS)."""
        return self.link.status.read()[1][0]

    @property
    def detail(self) -> str:
        """What the last stop has to say beyond its `STOP_TEXT`; empty where nothing stopped."""
        status = self.status()
        if status["stop"] == Stop.NONE:
            return ""
        text = status["text"].tobytes().rstrip(b"\0").decode(errors="replace")
        if self._reason and text and status["stop"] == self._reason_stop:
            return f"{self._reason}; {text}"
        return text or self._reason

    def _outcome(self, name: str, stop: Stop, first_row: int, backlash: BacklashEstimate | None = None) -> Outcome:
        detail = "" if stop is Stop.FINISHED else self.detail
        if stop is Stop.HEARTBEAT_LOST and not detail:  # refused: the servo did not even hear of it
            detail = self._heartbeats.detail(self._node_ids)
        return Outcome(name, stop, first_row, self.recorder.rows_count - first_row, backlash, detail)

    # ---- time ------------------------------------------------------------------------------------------------

    def pump(self, duration_s: float = _STEP_S) -> np.void:
        """Let time pass: renew counter and lease, drain the ring, watch the drives; returns the newest state.

        What goes wrong on this side (full disk, dead receiver) first brings the stage to rest, and is raised then.
        TimingError where the servo does no cycle any more: it can bring nothing to rest.
        """
        link = self.link
        self._counter += 1
        lease_s = min(self.profile.trip.lease_s, self._lease_left_s()) if self._holds_lease else 0.0
        lease_ns = round(max(lease_s, 0.0) * 1e9)
        link.requests.publish({"counter": self._counter, "lease_until_t_ns": link.now_t_ns() + lease_ns})
        link.pass_time(duration_s)
        with undisturbed():  # rows that left the ring must reach the recorder
            try:
                rows = link.rows.read_new()
                self._observe(rows)
                self.recorder.append(rows)
            except RecordError as error:
                self._distress(Stop.RECORD_LOST, str(error), error)
        if self._watches:
            self._watch_drives()
        status = self.status()
        self._demand_cycles(int(status["rows"]), duration_s)
        if self._trouble is not None and status["phase"] in RESTING:
            trouble, self._trouble = self._trouble, None
            raise trouble
        return status

    def _demand_cycles(self, rows_count: int, duration_s: float) -> None:
        """Notice a servo that hangs. What counts is the time asked to pass: a host that slept held up both sides."""
        self._stalled_s = self._stalled_s + duration_s if rows_count == self._rows_seen else 0.0
        self._rows_seen = rows_count
        if self._stalled_s > _STALL_S:
            raise TimingError(f"the servo has done no cycle for {_STALL_S:g} s; it hangs, or the host does")

    def _distress(self, stop: Stop, reason: str, trouble: StagectlError | None = None) -> None:
        """Have the servo bring the stage to rest under its law; `trouble` is raised when it has."""
        if trouble is not None and self._trouble is None:
            self._trouble = trouble
        if self.status()["phase"] not in _NOTHING_TO_STOP and not self._reason:
            self._reason, self._reason_stop = reason, stop
            self._event("distress", stop=stop.name, text=reason)
            self._request(mode=int(Mode.STOP), stop=int(stop))

    def _watch_drives(self) -> None:
        """Record emergencies and lost heartbeats; a lost heartbeat stops the stage."""
        try:
            for emergency in self.master.emergencies():
                self._event("emergency", node_id=emergency.node_id, code=emergency.code, text=str(emergency))
            ages_s = {axis: self.master.heartbeat_age_s(mapping.node_id) for axis, mapping in self.mappings.items()}
        except LinkError as error:
            self._watches = False
            self._distress(Stop.LINK_LOST, str(error), error)
            return
        back, lost = self._heartbeats.look(ages_s)
        for axis in back:
            self._event("heartbeat_back", axis=axis, node_id=self._node_ids[axis])
        for axis in lost:
            self._event("heartbeat_lost", axis=axis, node_id=self._node_ids[axis], age_s=ages_s[axis])
        if self._heartbeats.missing:
            self._distress(Stop.HEARTBEAT_LOST, self._heartbeats.detail(self._node_ids))
        for news in self._temperatures.look(self._now_s, self._heartbeats.missing):
            self._event(news.event, text=news.text, **news.fields)
            self._news.append(news)

    def _temperature_count(self, axis: str, table: Temperature) -> int:
        """Read a drive's temperature; no longer than the servo may go without hearing of this side."""
        node_id = self.mappings[axis].node_id
        return self.master.read(node_id, table.index, table.subindex, answer_s=answer_s(self.profile.trip))

    @property
    def _now_s(self) -> float:
        return 1e-9 * self.link.now_t_ns()

    @property
    def temperatures(self) -> dict[str, tuple[DriveTemperature, float]]:
        """What the drives said of their temperatures last, by axis, and how long ago, s."""
        now_s = self._now_s
        return {axis: (found, now_s - found.t_s) for axis, found in self._temperatures.newest.items()}

    def take_news(self) -> list[News]:
        """Return what happened to temperatures since the last call, oldest first; the run's events have it, too."""
        taken = list(self._news)
        self._news.clear()
        return taken

    @property
    def _node_ids(self) -> dict[str, int]:
        return {axis: mapping.node_id for axis, mapping in self.mappings.items()}

    def _wait(self, done: Callable[[np.void], bool], timeout_s: float, what: str, share: float = 0.0) -> np.void:
        """Pump until `done`; a servo that stopped by itself ends the wait too; TimingError after the timeout."""
        until_t_ns = self.link.now_t_ns() + round(timeout_s * 1e9)
        while True:
            status = self.pump()
            if done(status) or status["phase"] == Phase.STOPPED:
                return status
            if self.link.now_t_ns() > until_t_ns:
                raise TimingError(f"{what}: not done after {timeout_s:g} s; phase {Phase(int(status['phase'])).name}")
            self._progress(what, share)

    def _event(self, name: str, **fields: Any) -> None:
        try:
            self.recorder.event(name, self.link.now_t_ns(), **fields)
        except RecordError as error:  # the recorder holds it until there is room
            self._distress(Stop.RECORD_LOST, str(error), error)

    # ---- arming ----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Configure and read back the drives, start the servo, wait for sensor and process data."""
        backend = self.backend
        self._progress("configuring the drives", 0.0)
        master = Master(backend.network_bus(), backend.synchronous, backend.clock_s, backend.pause)
        self._master = master
        settings = drive_settings(self.profile, backend.vendor_id)
        found = configure(master, list(settings.values()), self._remark)
        self.mappings = dict(zip(settings, found, strict=True))
        self._modes = {axis: MODES[drive.mode] for axis, drive in settings.items()}
        self._agreed = {drive.node_id: read_agreed(master, drive) for drive in settings.values()}
        # What a drive was capped to is what laws, guard, plans and replay go by from here on.
        profile = self.profile = self.profile.with_force_limits(self._force_limits_n(settings))
        manifest = {
            **self._manifest,
            "profile": profile.effective(),
            "profile_path": str(profile.source_path),
            "profile_sha256": profile.sha256,
            "backend": self.backend.name,
            "backend_description": self.backend.description,
            "mappings": {axis: describe_mapping(mapping) for axis, mapping in self.mappings.items()},
            "laws": list(LAW_NAMES),
        }
        self._recorder = self._record(self.folder, manifest)
        self._link = self.backend.start_servo(profile, self.mappings, self._recorder.recovery_folder)
        self._belief[...] = self._link.tracker_belief
        self._recorder.save_snapshot(self._link.snapshot)
        master.nmt(0, "start")
        self._request(mode=int(Mode.IDLE))
        self._event("connected", backend=self.backend.name, profile=profile.name)
        for remark in self.backend.remarks:
            self._remark(remark)
        for remark in self.remarks:
            self._event("remark", text=remark)
        status = self._await_sensor()
        if not status["sensor_ready"]:
            raise LinkError(stop_sentence(Stop(int(status["stop"])), self.detail))
        self._watches = True

    def _remark(self, text: str) -> None:
        """Keep what the operator should know, and say it at once."""
        self.remarks.append(text)
        self._progress(text, 0.0)

    def drives_changed(self) -> str:
        """Say which drive is not configured any more as it was; empty where all are. Errors: LinkError, DriveError."""
        found = (changed(self.master, node_id, agreed) for node_id, agreed in self._agreed.items())
        return next((text for text in found if text), "")

    def _demand_agreed(self) -> None:
        """Give no drive power that is not what it was configured to be. Errors: LinkError, DriveError."""
        text = self.drives_changed()
        if text:
            raise DriveError(f"{text}; connect the stage anew")

    def _write_mode(self, axis: AxisName, mode: int) -> None:
        self.master.write(self.profile.axis(axis).node_id, cia402.MODES_OF_OPERATION, 0, mode)
        self._written_modes[axis] = mode

    def _demand_mode(self, axis: AxisName, mode: int) -> None:
        """Give no drive power in another mode of operation than it is commanded in. Errors: LinkError, DriveError.

        One drive takes a mode at once, another a little after it was written.
        """
        node_id = self.profile.axis(axis).node_id
        give_up_t_ns = self.link.now_t_ns() + round(_MODE_TIMEOUT_S * 1e9)
        while (shown := self.master.read(node_id, cia402.MODES_OF_OPERATION_DISPLAY)) != mode:
            if self.link.now_t_ns() > give_up_t_ns:
                raise DriveError(
                    f"{axis} (node {node_id}): mode of operation 0x6061 is {shown}, wanted {mode}, for "
                    f"{_MODE_TIMEOUT_S:g} s: another master wrote 0x6060, or the drive does not take it; "
                    "connect the stage anew"
                )
            self.pump()

    def _force_limits_n(self, settings: dict[AxisName, DriveSettings]) -> dict[AxisName, float]:
        """Return the limits of the drives that arming capped below what the profile asked for."""
        limits_n: dict[AxisName, float] = {}
        for axis, drive in settings.items():
            word = self.master.read(drive.node_id, cia402.MAX_TORQUE, 0)
            if word < drive.max_torque_word:
                limits_n[axis] = word * self.profile.axis(axis).torque_step_n
        return limits_n

    def _await_sensor(self) -> np.void:
        """Wait until the sensor's clock is locked, or something stops the stage; LinkError where it takes too long."""
        try:
            return self._wait(lambda s: bool(s["sensor_ready"]), _SENSOR_TIMEOUT_S, "waiting for the interferometer")
        except TimingError as error:
            if self._stalled_s > _STALL_S:
                raise
            raise LinkError(self._sensor_text()) from error

    def _sensor_text(self) -> str:
        """Say what came of the interferometer in the last second instead of valid samples."""
        sensor, rows = self.profile.interferometer, self.link.rows.read_last(round(self.profile.cycle.rate_hz))
        bytes_count = int(rows["sensor_bytes_count"].sum())
        if bytes_count == 0:
            found = "nothing came; check its power and cable, and interferometer.port"
        elif int(rows["samples_new"].sum()) == 0:
            found = f"{bytes_count} bytes came in the last second, no valid sample; check beams, format and baud rate"
        else:
            found = f"samples come too seldom; check rate_hz = {sensor.rate_hz:g} and the beams"
        return f"interferometer {sensor.port}: no steady valid samples within {_SENSOR_TIMEOUT_S:g} s: {found}"

    def _request(self, **fields: Any) -> None:
        if not self.backend.may_move and fields.get("mode") in _WITH_POWER:
            raise RequestError(WATCHED_ONLY)
        self._counter += 1
        self.link.requests.publish({"counter": self._counter, **fields})

    def _publish_update(self, macro_zero_counts: float, end_zero_counts: float) -> None:
        """Have the servo take zeros and belief; the event holds them for replay."""
        self._update_number += 1
        names = PLANT_PARAMETERS.names or ()
        belief = {name: float(self._belief[name][0]) for name in names}
        self._event(
            "update",
            number=self._update_number,
            macro_zero_counts=macro_zero_counts,
            end_zero_counts=end_zero_counts,
            belief={name: repr(value) for name, value in belief.items()},
        )
        self._request(
            update_number=self._update_number,
            homing_id=self._homing_id,
            macro_zero_counts=macro_zero_counts,
            end_zero_counts=end_zero_counts,
            **{f"belief_{name}": value for name, value in belief.items()},
        )
        number = self._update_number
        self._wait(lambda s: s["update_number"] == number, 2.0, "taking over zeros")

    def enable(self, law: str | None = None) -> Stop:
        """Enable both drives and hold where the stage is; returns why not, NONE when it holds."""
        if self.status()["phase"] == Phase.TRACKING:
            return Stop.NONE
        if not self.backend.may_move:
            raise RequestError(WATCHED_ONLY)
        if self._asked_to_stop:
            return Stop.OPERATOR
        self._demand_agreed()  # a drive that restarted sends no heartbeat for good: that says more
        if self._heartbeats.missing:
            return Stop.HEARTBEAT_LOST
        if self.status()["phase"] != Phase.STOPPED:  # else nothing is enabled before somebody acknowledges
            for axis, mode in self._modes.items():
                if self._written_modes.get(axis, mode) != mode:  # a homing's own
                    self._write_mode(axis, mode)
                self._demand_mode(axis, mode)
        if self._stopped_meanwhile("enabling the drives"):
            return Stop.OPERATOR
        self._holds_lease = True
        self._reason = ""
        self.pump()
        self._request(
            mode=int(Mode.TRACK), stop=int(Stop.NONE), law_number=LAW_NAMES.index(law or self.profile.control.law)
        )
        self.pump()
        status = self._wait(lambda s: s["phase"] == Phase.TRACKING, 5.0, "enabling the drives")
        return Stop(int(status["stop"]))

    def _stopped_meanwhile(self, what: str) -> bool:
        """Hear whether somebody asked for rest while drives were read and written, which takes a second."""
        self._progress(what, 0.0)
        return self._asked_to_stop

    def armed(self, law: str | None = None) -> Outcome:
        """Enable like `enable`; FINISHED where the stage holds, else why it doesn't."""
        first_row = self.recorder.rows_count
        stop = self.enable(law)
        return self._outcome("enable", Stop.FINISHED if stop is Stop.NONE else stop, first_row)

    def ask_to_stop(self) -> None:
        """Have the motion under way come to rest; nothing is enabled or homed before `allow_motion`.

        To be called between two steps of a motion, from `progress` say; the motion ends with OPERATOR.
        """
        self._asked_to_stop = True
        if self.status()["phase"] not in RESTING:
            self._request(mode=int(Mode.STOP), stop=int(Stop.NONE))

    def allow_motion(self) -> None:
        """Take back `ask_to_stop`; moves and enables nothing."""
        self._asked_to_stop = False

    def disarm(self) -> Stop:
        """Bring the stage to rest under the law, then take the power away; returns what stopped it, or a drive at rest.

        Drives in fault stay so: only an acknowledgement resets them.
        """
        phase = self.status()["phase"]
        if phase in (Phase.IDLE, Phase.HOMED_DRIVE):
            return Stop.NONE
        self._request(mode=int(Mode.STOP), stop=int(Stop.NONE))
        status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "stopping")
        self._holds_lease = False
        stop = Stop(int(status["stop"]))
        if stop is not Stop.OPERATOR:
            return stop
        failed = self._failed(status)
        if failed:
            self._reason = f"{' and '.join(failed)} in fault as the stage came to rest; its emergency says why"
            return Stop.DRIVE_FAULT
        self._request(mode=int(Mode.IDLE), acknowledge_number=self._counter + 1)
        self._pump_until(lambda s: s["phase"] != Phase.STOPPED, _REST_NOTED_S)
        return stop

    def release(self) -> None:
        """Take the power away from a stage that stopped by itself; why it did is acknowledged by nobody."""
        if self.status()["phase"] == Phase.STOPPED:
            self._request(mode=int(Mode.RELEASE))

    def acknowledge(self) -> Stop:
        """Acknowledge why the servo stopped, reset drives in fault; enables nothing. Returns what stops it again.

        DriveError where a drive stays in fault.
        """
        self._wait(lambda s: s["phase"] in RESTING, 20.0, "coming to rest")
        self._reason = ""
        self._request(mode=int(Mode.RESET), stop=int(Stop.NONE), acknowledge_number=self._counter + 1)
        self._pump_until(lambda s: s["phase"] != Phase.STOPPED, 0.5)
        status = self._pump_until(lambda s: not self._failed(s), _RESET_TIMEOUT_S)
        self._request(mode=int(Mode.IDLE))
        if status["phase"] == Phase.STOPPED:
            return Stop(int(status["stop"]))
        failed = self._failed(status)
        if failed:
            raise DriveError(
                f"{' and '.join(failed)} still in fault {_RESET_TIMEOUT_S:g} s after the reset; clear its cause "
                "(the events hold its emergency messages), then acknowledge again"
            )
        return Stop.NONE

    def _pump_until(self, done: Callable[[np.void], bool], timeout_s: float) -> np.void:
        until_t_ns = self.link.now_t_ns() + round(timeout_s * 1e9)
        status = self.pump()
        while not done(status) and self.link.now_t_ns() < until_t_ns:
            status = self.pump()
        return status

    def _failed(self, status: np.void) -> list[str]:
        """Name the drives that are in fault."""
        named = {axis: cia402.state_of(int(status[f"{axis}_statusword"])) for axis in self.mappings}
        return [f"{axis} (node {self.mappings[axis].node_id})" for axis, state in named.items() if state in _FAULTS]

    def close(self) -> None:
        """Rest, power off, rows to disk; lets go of everything whatever fails, and raises what failed."""
        self._close(None)

    def _close(self, under_way: BaseException | None) -> None:
        """Close; an error that is under way already says more than what follows from it, and stands in the run."""
        link, recorder, master = self._link, self._recorder, self._master
        self._master = None
        with contextlib.ExitStack() as stack:
            stack.callback(self.backend.close)
            if master is not None:
                stack.callback(master.close)
            asked = Stop.OPERATOR if isinstance(under_way, KeyboardInterrupt) else Stop.NONE
            end: dict[str, Any] = {"stop": asked.name, "text": STOP_TEXT[asked]}
            if isinstance(under_way, StagectlError):
                end["error"] = f"{type(under_way).__name__}: {under_way}"
            if recorder is not None and link is None:  # no servo, so no row that could be missing
                stack.callback(recorder.close, end)
            if recorder is not None and link is not None:
                stack.callback(self._end_run, link, recorder, end)
                self._rest(end, asked, quiet=under_way is not None)

    def _rest(self, end: dict[str, Any], asked: Stop, quiet: bool) -> None:
        """Bring the stage to rest and fill in how the run ended; `asked` where nothing else stopped it."""
        self._watches = False
        try:
            detail = self.detail
            stop = self.disarm() or asked
            self.pump(0.1)
            end.update(stop=stop.name, text=STOP_TEXT[stop], detail=detail)
            status = self.status()
            end.update({name: int(status[name]) for name in ("lost_samples", "discarded_bytes", "missed_cycles")})
        except StagectlError as error:
            stop = Stop(int(self.status()["stop"])) or Stop.LINK_LOST
            end.update(stop=stop.name, text=STOP_TEXT[stop], detail=self.detail or str(error))
            if not quiet:
                raise

    def _end_run(self, link: ServoLink, recorder: Recorder | FlightRecorder, end: dict[str, Any]) -> None:
        """End the servo, which first stops what moves, and put its last rows on the disk."""
        with undisturbed():
            self._link = None
            link.close()
            try:
                with contextlib.suppress(RecordError):  # held; closing says so where it still finds no room
                    recorder.append(link.rows.read_new())
                recorder.close(end)
            except RecordError:
                recorder.abandon()  # what is not on the disk stays in the ring
                raise
            link.forget_rows()
