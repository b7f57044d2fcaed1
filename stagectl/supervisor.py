"""The supervisor object: everything that commands, API and tests ask of a stage goes through it.

Configures the drives, starts the servo, asks it by requests and segments, drains the ring into the run folder. It
never computes a command and nothing that the servo waits for.
"""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers import cia402
from drivers.arming import DriveMapping, DriveSettings, StaleTorque, configure
from drivers.canopen_master import Master
from stagectl import jogging
from stagectl import trajectory as trajectories
from stagectl.backend import SEGMENT_ROWS, Backend, ServoLink
from stagectl.errors import DriveError, LinkError, RecordError, RequestError, StagectlError, TimingError
from stagectl.flight_recorder import FlightRecorder
from stagectl.plant import PLANT_PARAMETERS
from stagectl.profile import AxisName, Profile
from stagectl.record import Recorder
from stagectl.replay import describe_mapping
from stagectl.requests import RESTING, Mode, Phase
from stagectl.signals import SETPOINT, STOP_TEXT, Stop, stop_sentence
from stagectl.touch_sweep import (
    IDENTIFY_HZ,
    IDENTIFY_SHARE,
    TOUCH_HZ,
    TOUCH_S,
    TOUCH_SHARE,
    Joint,
    contact_damping_n_s_per_m,
    plan,
)
from stagectl.tracker import LAW_NAMES
from stagectl.undisturbed import undisturbed

_STEP_S = 0.02
_SENSOR_TIMEOUT_S = 5.0
_INDEX_METHODS = (33, 34)  # on the index mark: searched in negative, in positive direction
_TOUCH_TRIES = 4
_JOINT = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")
PLAN_SHARE = 0.9
"""Of the profile's limits that planned moves use."""

_JERK_TIME_S = 0.1
_QUICK_STOP_HOLD, _QUICK_STOP_OFF = 6, 2
_STALE_SHARE = 1.0 / 3.0  # of the micro's way to a stop that each drive may use up before it misses a dead servo
_RESET_TIMEOUT_S = 2.0
_HEARTBEATS_MISSED = 2  # looks in a row that find a heartbeat too old
_FAULTS = (cia402.State.FAULT, cia402.State.FAULT_REACTION_ACTIVE)

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class BacklashEstimate:
    """Edges and stiffness of the joint, with standard deviations; x_b = macro minus end, in the run's zero."""

    left_m: float
    right_m: float
    left_sd_m: float
    right_sd_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float
    left_stiffness_sd_n_per_m: float
    right_stiffness_sd_n_per_m: float

    @property
    def width_m(self) -> float:
        """Distance of the edges."""
        return self.left_m + self.right_m

    @property
    def centre_m(self) -> float:
        """Middle of the gap on x_b."""
        return 0.5 * (self.right_m - self.left_m)

    @property
    def identifiable(self) -> bool:
        """Whether both sides were touched long enough to say anything."""
        return math.isfinite(self.left_sd_m) and math.isfinite(self.right_sd_m)


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a motion ended, and which rows of the run hold it."""

    name: str
    stop: Stop
    first_row: int
    rows: int
    backlash: BacklashEstimate | None = None
    detail: str = ""
    """Where, the value, its limit and the remedy, of a stop that has them."""

    @property
    def text(self) -> str:
        """The sentence for the operator."""
        return stop_sentence(self.stop, self.detail)

    @property
    def finished(self) -> bool:
        """Whether it came to its own end."""
        return self.stop is Stop.FINISHED


def drive_settings(profile: Profile, vendor_id: int | None) -> dict[AxisName, DriveSettings]:
    """Say what each drive must be and do."""
    settings: dict[AxisName, DriveSettings] = {}
    for axis_name in profile.axes:
        axis = profile.axis(axis_name)
        is_macro = axis_name == "macro"
        step_m = getattr(axis, "encoder_step_m", None)
        asked = axis.identity
        own = (asked.vendor_id, asked.product_code, asked.revision_number, asked.serial_number)
        ramp = profile.macro.stop_deceleration_m_per_s2 / (step_m or profile.macro.encoder_step_m)
        hold = profile.macro.standstill == "hold"
        settings[axis_name] = DriveSettings(
            node_id=axis.node_id,
            eds_path=str(profile.eds_path(axis_name)),
            identity=own if vendor_id is None else (vendor_id,),  # the rig plays whatever unit the profile names
            mode=profile.macro.mode if is_macro else "torque",
            rated_torque_word=round(axis.rated_force_n * 1e3),
            max_torque_word=round(axis.force_limit_n / axis.rated_force_n * 1e3),
            quick_stop_deceleration_word=round(ramp),
            quick_stop_option=_QUICK_STOP_HOLD if is_macro and hold else _QUICK_STOP_OFF,
            heartbeat_ms=round(profile.trip.heartbeat_s * 1e3),
            rpdo_deadline_ms=round(profile.trip.rpdo_deadline_s * 1e3),
            stale_torque=_stale_torque(profile, axis_name),
            cycle_us=round(1e6 / profile.cycle.rate_hz),
            rated_current_word=round(axis.rated_current_a * 1e3),
            encoder_step_m=step_m if is_macro else None,
        )
    return settings


def _stale_torque(profile: Profile, axis: AxisName) -> StaleTorque | None:
    """Say what may become of the micro while a drive keeps up a dead servo's torque; None on a stage without one.

    The macro's force moves the macro alone away from a limp micro; the micro's acts on both, one against the other.
    """
    macro, micro = profile.macro, profile.micro
    if micro is None:
        return None
    both_kg = macro.mass_kg * micro.mass_kg / (macro.mass_kg + micro.mass_kg)
    way_m = _STALE_SHARE * min(-micro.stroke_m[0], micro.stroke_m[1])
    needed_n = min(profile.motion_force_n(axis), profile.axis(axis).force_limit_n)
    return StaleTorque(macro.mass_kg if axis == "macro" else both_kg, way_m, needed_n)


class Supervisor:
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
        self._segment_number = 0
        self._segment_free = 0
        self._update_number = 0
        self._homing_id = 0
        self._belief = np.zeros(1, PLANT_PARAMETERS)
        self._holds_lease = False
        self._watches = False
        self._asked_to_stop = False
        self._heartbeats_missed: dict[str, int] = {}
        self._heartbeat_ages_s: dict[str, float] = {}
        self._reason = ""  # why this side asked the servo to stop
        self._trouble: StagectlError | None = None  # raised as soon as the stage rests
        self.mappings: dict[str, DriveMapping] = {}
        self.remarks: list[str] = []
        """What the operator should know of this arming, in words."""

    def __enter__(self) -> "Supervisor":
        try:
            self.connect()
        except BaseException as error:
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
        return status["text"].tobytes().rstrip(b"\0").decode(errors="replace") or self._reason

    def _outcome(self, name: str, stop: Stop, first_row: int, backlash: BacklashEstimate | None = None) -> Outcome:
        detail = "" if stop is Stop.FINISHED else self.detail
        return Outcome(name, stop, first_row, self.recorder.rows_count - first_row, backlash, detail)

    # ---- time ------------------------------------------------------------------------------------------------

    def pump(self, duration_s: float = _STEP_S) -> np.void:
        """Let time pass: renew counter and lease, drain the ring, watch the drives; returns the newest state.

        What goes wrong on this side (full disk, dead receiver) first brings the stage to rest, and is raised then.
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
        if self._trouble is not None and status["phase"] in RESTING:
            trouble, self._trouble = self._trouble, None
            raise trouble
        return status

    def _distress(self, stop: Stop, reason: str, trouble: StagectlError | None = None) -> None:
        """Have the servo bring the stage to rest under its law; `trouble` is raised when it has."""
        if trouble is not None and self._trouble is None:
            self._trouble = trouble
        if self.status()["phase"] not in RESTING and not self._reason:
            self._reason = reason
            self._event("distress", stop=stop.name, text=reason)
            self._request(mode=int(Mode.STOP), stop=int(stop))

    def _watch_drives(self) -> None:
        """Record emergencies; stop where a drive's heartbeat is missed twice running (a host's hiccup misses once)."""
        limit_s = self.profile.trip.heartbeat_s
        try:
            for emergency in self.master.emergencies():
                self._event("emergency", node_id=emergency.node_id, code=emergency.code, text=str(emergency))
            ages_s = {axis: self.master.heartbeat_age_s(mapping.node_id) for axis, mapping in self.mappings.items()}
            self._heartbeat_ages_s = ages_s
        except LinkError as error:
            self._watches = False
            self._distress(Stop.LINK_LOST, str(error), error)
            return
        for axis, age_s in ages_s.items():
            missed = self._heartbeats_missed.get(axis, 0)
            self._heartbeats_missed[axis] = 0 if age_s <= limit_s else missed + 1
            node_id = self.mappings[axis].node_id
            if age_s <= limit_s and missed >= _HEARTBEATS_MISSED:
                self._event("heartbeat_back", axis=axis, node_id=node_id)
            elif missed + 1 == _HEARTBEATS_MISSED and not age_s <= limit_s:
                self._event("heartbeat_lost", axis=axis, node_id=node_id, age_s=age_s)
        if self._heartless():
            self._distress(Stop.HEARTBEAT_LOST, self._heartbeat_detail())

    def _heartless(self) -> list[str]:
        """Name the axes whose drives send no heartbeat."""
        return [axis for axis, missed in self._heartbeats_missed.items() if missed >= _HEARTBEATS_MISSED]

    def _heartbeat_detail(self) -> str:
        """Say whose heartbeat is missing and since when; empty where none is."""
        if not self._heartless():
            return ""
        ages = [
            f"{axis} (node {self.mappings[axis].node_id}): {self._heartbeat_ages_s[axis] * 1e3:.0f} ms ago"
            for axis in self._heartless()
        ]
        limit_ms = self.profile.trip.heartbeat_s * 1e3
        return f"the last of {', '.join(ages)}, limit {limit_ms:g} ms; check the drive's power and firmware"

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
        self._await_sensor()
        self._watches = True

    def _remark(self, text: str) -> None:
        """Keep what the operator should know, and say it at once."""
        self.remarks.append(text)
        self._progress(text, 0.0)

    def _force_limits_n(self, settings: dict[AxisName, DriveSettings]) -> dict[AxisName, float]:
        """Return the limits of the drives that arming capped below what the profile asked for."""
        limits_n: dict[AxisName, float] = {}
        for axis, drive in settings.items():
            word = self.master.read(drive.node_id, cia402.MAX_TORQUE, 0)
            if word < drive.max_torque_word:
                limits_n[axis] = word * self.profile.axis(axis).torque_step_n
        return limits_n

    def _await_sensor(self) -> np.void:
        """Wait until the sensor's clock is locked; LinkError says what the interferometer lacks."""
        try:
            status = self._wait(lambda s: bool(s["sensor_ready"]), _SENSOR_TIMEOUT_S, "waiting for the interferometer")
        except TimingError as error:
            raise LinkError(self._sensor_text()) from error
        if not status["sensor_ready"]:
            raise LinkError(stop_sentence(Stop(int(status["stop"])), self.detail))
        return status

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
        if self._asked_to_stop:
            return Stop.OPERATOR
        if self._heartless():
            return Stop.HEARTBEAT_LOST
        self._holds_lease = True
        self._reason = ""
        self._request(
            mode=int(Mode.TRACK), stop=int(Stop.NONE), law_number=LAW_NAMES.index(law or self.profile.control.law)
        )
        self.pump()
        status = self._wait(lambda s: s["phase"] == Phase.TRACKING, 5.0, "enabling the drives")
        return Stop(int(status["stop"]))

    def armed(self, law: str | None = None) -> Outcome:
        """Enable like `enable`; FINISHED where the stage holds, else why it doesn't."""
        first_row = self.recorder.rows_count
        stop = self.enable(law)
        if stop is Stop.HEARTBEAT_LOST:  # refused: the servo did not even hear of it
            return Outcome("enable", stop, first_row, 0, detail=self._heartbeat_detail())
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
        """Bring the stage to rest under the law, then take the power away."""
        phase = self.status()["phase"]
        if phase in (Phase.IDLE, Phase.HOMED_DRIVE):
            return Stop.NONE
        self._request(mode=int(Mode.STOP), stop=int(Stop.NONE))
        status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "stopping")
        self._holds_lease = False
        stop = Stop(int(status["stop"]))
        if stop is Stop.OPERATOR:
            self.acknowledge()
        return stop

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

    # ---- homing ----------------------------------------------------------------------------------------------

    def home(self) -> Outcome:
        """Home the macro by its drive, set its laser, touch both edges, set the end's laser, centre."""
        first_row = self.recorder.rows_count
        stop = self._home_drive()
        if stop is not Stop.NONE:
            return self._outcome("home", stop, first_row)
        self.pump(0.3)
        status = self._await_sensor()
        macro_scale, end_scale = self._scales()
        macro_zero = float(status["macro_counts"]) - float(status["macro_encoder_m"]) / macro_scale
        # At rest without power the spring stands at its middle: end = macro there, until the edges say better.
        end_zero = float(status["end_counts"]) - float(status["macro_encoder_m"]) / end_scale
        self._homing_id += 1
        self._publish_update(macro_zero, end_zero)
        estimate = None
        if self.profile.micro is not None:
            held = self.armed()
            if not held.finished:
                return held
            outcome = self._touch()
            estimate = outcome.backlash
            if not outcome.finished or estimate is None:
                return self._outcome("home", outcome.stop, first_row)
            self.take_backlash(estimate)
        self._event("homing", number=self._homing_id, macro_zero_counts=macro_zero, end_zero_counts=end_zero)
        return self._outcome("home", Stop.FINISHED, first_row, estimate)

    def _touch(self) -> Outcome:
        """Sweep until both edges have been pressed; a first guess of the end's zero may be off by half the gap.

        Without power the micro swings on its spring between the edges, so where it stood when the zero was taken
        says little; the edge that was met says where the other one is.
        """
        for _ in range(_TOUCH_TRIES):
            outcome = self.sweep(TOUCH_SHARE, TOUCH_HZ, TOUCH_S, "touching both edges")
            estimate = outcome.backlash
            if not outcome.finished or estimate is None or estimate.identifiable:
                return outcome
            width_m = float(self._belief["left_m"][0]) + float(self._belief["right_m"][0])
            known = {name: float(self._belief[name][0]) for name in _JOINT}
            if math.isfinite(estimate.right_sd_m):
                known["right_m"], known["left_m"] = estimate.right_m, width_m - estimate.right_m
            elif math.isfinite(estimate.left_sd_m):
                known["left_m"], known["right_m"] = estimate.left_m, width_m - estimate.left_m
            else:
                break
            sds = {name: math.inf for name in BacklashEstimate.__dataclass_fields__ if "_sd" in name}
            self.take_backlash(BacklashEstimate(**known, **sds))
        raise DriveError(
            f"homing: not both edges of the joint were touched in {_TOUCH_TRIES} sweeps at {TOUCH_SHARE:.0%} of "
            "backlash.touch_force_n; check backlash.left_m and right_m, micro.stroke_m and the voice coil"
        )

    def _scales(self) -> tuple[float, float]:
        from drivers.wire import WireDecoder

        decoder = WireDecoder(self.profile, self.mappings)
        ratio = decoder.air_index / float(self.status()["air_index_ratio"])  # the index in use follows the air
        return decoder.macro_m_per_count * ratio, decoder.end_m_per_count * ratio

    def _homing_method(self) -> int:
        """Return the profile's method; where the index was found before, search towards it (CiA 402, 33 and 34)."""
        method = self.profile.macro.homing.method
        if self._homing_id == 0 or method not in _INDEX_METHODS:
            return method
        return _INDEX_METHODS[1] if float(self.status()["macro_encoder_m"]) < 0.0 else _INDEX_METHODS[0]

    def _home_drive(self) -> Stop:
        """Let the macro's drive find its index."""
        homing, node = self.profile.macro.homing, self.profile.macro.node_id
        step_m = self.profile.macro.encoder_step_m
        self.disarm()
        master = self.master
        master.write(node, cia402.MODES_OF_OPERATION, 0, cia402.MODE_HOMING)
        master.write(node, cia402.HOMING_METHOD, 0, self._homing_method())
        master.write(node, cia402.HOMING_SPEEDS, 1, round(homing.speed_m_per_s / step_m))
        master.write(node, cia402.HOMING_SPEEDS, 2, round(homing.speed_m_per_s / step_m))
        master.write(node, cia402.HOMING_ACCELERATION, 0, round(homing.acceleration_m_per_s2 / step_m))
        if self._asked_to_stop:
            return Stop.OPERATOR
        self._holds_lease = True
        self.pump()
        self._request(mode=int(Mode.HOME_DRIVE))
        self.pump()
        status = self._wait(lambda s: s["phase"] == Phase.HOMED_DRIVE, homing.timeout_s, "homing the macro")
        stop = Stop(int(status["stop"]))
        self._request(mode=int(Mode.IDLE))
        if stop is Stop.NONE:
            self._wait(
                lambda s: cia402.state_of(int(s["macro_statusword"])) is cia402.State.SWITCH_ON_DISABLED, 5.0, "resting"
            )
            mode = cia402.MODE_CSP if self.profile.macro.mode == "position" else cia402.MODE_CST
            master.write(node, cia402.MODES_OF_OPERATION, 0, mode)
        return stop

    def take_backlash(self, estimate: BacklashEstimate) -> None:
        """Believe an identified backlash; the end's zero moves so that the gap's centre is where the profile has it.

        RequestError where it is none.
        """
        stiffnesses = (estimate.left_stiffness_n_per_m, estimate.right_stiffness_n_per_m)
        believable = math.isfinite(estimate.centre_m) and 0.0 < estimate.width_m < math.inf
        if not (believable and all(0.0 < stiffness < math.inf for stiffness in stiffnesses)):
            raise RequestError(
                f"backlash of {estimate.width_m:g} m about {estimate.centre_m:g} m with {stiffnesses} N/m: every value "
                "must be finite, width and stiffness above 0; identify again, touching both edges"
            )
        status = self.status()
        macro_scale, end_scale = self._scales()
        before_m = float(status["end_counts"]) * end_scale - float(status["end_position_m"])
        centre_m = 0.5 * (float(self._belief["right_m"][0]) - float(self._belief["left_m"][0]))
        # x_b = macro - end must grow by (centre - identified centre): the end's positions shrink by it
        end_zero = (before_m + (centre_m - estimate.centre_m)) / end_scale
        macro_zero = float(status["macro_counts"]) - float(status["macro_position_m"]) / macro_scale
        self._belief["left_m"] = 0.5 * estimate.width_m - centre_m
        self._belief["right_m"] = 0.5 * estimate.width_m + centre_m
        self._belief["left_stiffness_n_per_m"] = estimate.left_stiffness_n_per_m
        self._belief["right_stiffness_n_per_m"] = estimate.right_stiffness_n_per_m
        self._publish_update(macro_zero, end_zero)

    # ---- motion ----------------------------------------------------------------------------------------------

    def follow(self, setpoints: np.ndarray, name: str, law: str | None = None) -> Outcome:
        """Run a segment of SETPOINT rows that begins where the stage holds; returns how it ended."""
        if setpoints.size > SEGMENT_ROWS:
            raise RequestError(f"{name}: {setpoints.size} setpoints, {SEGMENT_ROWS} fit; split the trajectory")
        for field in SETPOINT.names or ():
            odd = np.flatnonzero(~np.isfinite(setpoints[field]))
            if odd.size:
                value = setpoints[field][odd[0]]
                raise RequestError(f"{name}: setpoint {odd[0]} has {field} = {value}; every value must be finite")
        status = self.status()
        if status["phase"] != Phase.TRACKING and status["stop"] != Stop.NONE:
            # What came between two parts of a motion (on the way to its start, say) ends it like any other stop.
            status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "coming to rest")
            return self._outcome(name, Stop(int(status["stop"])), self.recorder.rows_count)
        if status["phase"] != Phase.TRACKING:
            raise RequestError(f"{name}: the stage is not armed; enable it first")
        away_m = abs(float(setpoints["position_m"][0]) - float(status["setpoint_position_m"]))
        if not away_m <= 1e-6:
            raise RequestError(f"{name} begins {away_m:g} m from where the stage holds; move there first")
        first_row = self.recorder.rows_count
        number = self._begin_segment(setpoints, name, law)
        duration_s = setpoints.size / self.profile.cycle.rate_hz
        until_t_ns = self.link.now_t_ns() + round((duration_s * 1.5 + 5.0) * 1e9)
        while True:
            status = self.pump()
            if status["phase"] != Phase.TRACKING:
                status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "coming to rest")
                stop = Stop(int(status["stop"]))
                break
            if status["segment_number"] == number and status["segment_left_rows"] <= 0:
                stop = Stop.FINISHED
                break
            if self.link.now_t_ns() > until_t_ns:
                raise TimingError(
                    f"{name}: not done after {duration_s * 1.5 + 5.0:g} s; is the sensor's rate_hz right?"
                )
            self._progress(name, 1.0 - float(status["segment_left_rows"]) / setpoints.size)
        detail = "" if stop is Stop.FINISHED else self.detail
        self._event("segment_end", number=number, stop=stop.name, **({"detail": detail} if detail else {}))
        return self._outcome(name, stop, first_row, self._backlash(status))

    def _begin_segment(self, setpoints: np.ndarray, name: str, law: str | None = None, at_row: int = 0) -> int:
        """Have the servo follow a segment, behind `at_row` rows of the one under way; returns its number."""
        if self._segment_free + setpoints.size > SEGMENT_ROWS:
            self._segment_free = 0
        start = self._segment_free
        self.link.segments[start : start + setpoints.size] = setpoints
        self._segment_free += setpoints.size
        self._segment_number += 1
        number = self._segment_number
        fields: dict[str, Any] = {
            "segment_start": start,
            "segment_rows": setpoints.size,
            "segment_number": number,
            "segment_at_row": at_row,
        }
        if law is not None:
            fields["law_number"] = LAW_NAMES.index(law)
        self._event("segment", number=number, segment=name, law=law, setpoints=int(setpoints.size))
        self._request(**fields)
        return number

    def _backlash(self, status: np.void) -> BacklashEstimate | None:
        if self.profile.micro is None:
            return None
        return BacklashEstimate(
            **{name: float(status[name]) for name in BacklashEstimate.__dataclass_fields__}  # named alike
        )

    def _limits(self) -> trajectories.Limits:
        macro = self.profile.macro
        acceleration = PLAN_SHARE * min(macro.acceleration_limit_m_per_s2, 0.5 * macro.stop_deceleration_m_per_s2)
        return trajectories.Limits(PLAN_SHARE * macro.velocity_limit_m_per_s, acceleration, acceleration / _JERK_TIME_S)

    def move(self, target_m: float, law: str | None = None) -> Outcome:
        """Move the end to a position, jerk-limited; checked before the first cycle."""
        status = self.status()
        start_m = float(status["setpoint_position_m"])
        self._centre(status)
        if abs(target_m - start_m) < 1e-12:
            return Outcome("move", Stop.FINISHED, self.recorder.rows_count, 0)
        planned = trajectories.move(start_m, target_m, self._limits(), 1.0 / self.profile.cycle.rate_hz)
        self._check(planned)
        return self.follow(planned.setpoints, f"moving to {target_m * 1e3:g} mm", law)

    def jog(self, wanted_m_per_s: Callable[[], float | None]) -> Outcome:
        """Move at the velocity that is wanted now, asked for every 20 ms, until that is None; then come to rest.

        Every plan under way ends at rest, at the ends of travel or within `jogging.HORIZON_S`.
        """
        name, first_row = "jogging", self.recorder.rows_count
        limits, travel_m, dt_s = self._limits(), self.profile.macro.travel_m, 1.0 / self.profile.cycle.rate_hz
        self._centre(self.status())
        under_way, number, speed = np.zeros(0, SETPOINT), self._segment_number, 0.0
        pending: tuple[int, jogging.Splice, float] | None = None
        while True:
            status = self.pump()
            if status["phase"] != Phase.TRACKING:
                status = self._wait(lambda s: s["phase"] == Phase.STOPPED, 20.0, "coming to rest")
                return self._outcome(name, Stop(int(status["stop"])), first_row)
            self._progress(name, 0.0)
            asked = wanted_m_per_s()
            wanted = 0.0 if asked is None else jogging.wanted_speed(asked, limits)
            if pending is not None and status["segment_number"] == pending[0]:
                (number, (_, under_way), speed), pending = pending, None
            if status["segment_number"] != number:  # not begun yet
                continue
            left_rows = max(int(status["segment_left_rows"]), 0)
            done_rows = under_way.size - left_rows
            if pending is not None:
                if done_rows <= pending[1].at_row:
                    continue
                pending = None  # it came too late: once more
            if left_rows == 0:
                if asked is None:
                    return self._outcome(name, Stop.FINISHED, first_row)
                start = trajectories.MotionState(float(status["setpoint_position_m"]))
                if wanted == 0.0 or self._at_end(start.position_m, wanted):
                    continue
                planned = jogging.way(start, wanted, limits, travel_m, dt_s)
                self._check(planned)
                under_way, speed = planned.setpoints, wanted
                number = self._begin_segment(under_way, name)
            elif wanted != speed or self._nears_end(under_way, left_rows * dt_s, wanted):
                spliced = jogging.splice(under_way, done_rows, wanted, limits, travel_m, dt_s)
                if spliced is None:
                    continue
                self._check(spliced[1])
                splice = spliced[0]
                pending = self._begin_segment(splice.setpoints, name, at_row=splice.at_row), splice, wanted

    def _nears_end(self, under_way: np.ndarray, left_s: float, velocity_m_per_s: float) -> bool:
        """Tell whether a jog has used up half of its plan, and there is way left beyond it."""
        if velocity_m_per_s == 0.0 or left_s >= 0.5 * jogging.HORIZON_S:
            return False
        return not self._at_end(float(under_way["position_m"][-1]), velocity_m_per_s)

    def _at_end(self, position_m: float, velocity_m_per_s: float) -> bool:
        """Tell whether there is no way left in that direction."""
        low_m, high_m = self.profile.macro.travel_m
        return position_m >= high_m - 1e-6 if velocity_m_per_s > 0.0 else position_m <= low_m + 1e-6

    def _check(self, planned: trajectories.Trajectory) -> None:
        macro = self.profile.macro
        trajectories.check(
            planned,
            macro.travel_m,
            macro.velocity_limit_m_per_s,
            macro.acceleration_limit_m_per_s2,
            stop_deceleration_m_per_s2=macro.stop_deceleration_m_per_s2,
        )

    def _centre(self, status: np.void) -> None:
        """Bring the macro to the middle of the gap, the end at rest, by a fifth-order polynomial."""
        relative_m = float(status["setpoint_relative_position_m"])
        if abs(relative_m) < 1e-9:
            return
        duration_s = 1.0
        count = round(duration_s * self.profile.cycle.rate_hz)
        u = np.arange(1, count + 1) / count
        rows = np.zeros(count, SETPOINT)
        rows["position_m"] = status["setpoint_position_m"]
        rows["relative_position_m"] = relative_m * (1 - (10 * u**3 - 15 * u**4 + 6 * u**5))
        rows["relative_velocity_m_per_s"] = -relative_m * (30 * u**2 - 60 * u**3 + 30 * u**4) / duration_s
        rows["relative_acceleration_m_per_s2"] = -relative_m * (60 * u - 180 * u**2 + 120 * u**3) / duration_s**2
        self.follow(rows, "centring")

    def run(self, planned: trajectories.Trajectory, law: str) -> Outcome:
        """Move to a trajectory's start, then follow it under a law."""
        self._check(planned)
        there = self.move(float(planned.setpoints["position_m"][0]), law)
        if not there.finished:
            return there
        return self.follow(planned.setpoints, f"{planned.name} under {law}", law)

    def sweep(
        self, force_share: float, usual_hz: float, duration_s: float, name: str, asked_hz: float | None = None
    ) -> Outcome:
        """Let the micro meet both edges, as `stagectl.touch_sweep.plan` has it for the joint that is believed now."""
        if self.profile.micro is None or self.profile.backlash is None:
            raise RequestError(f"{name}: this stage has no micro; there is no backlash to identify")
        status = self.status()
        self._centre(status)
        joint = Joint(
            damping_n_s_per_m=contact_damping_n_s_per_m(self.profile.effects),
            touch_force_n=self.profile.backlash.touch_force_n,
            **{name: float(self._belief[name][0]) for name in _JOINT},
        )
        planned = trajectories.sweep(
            *plan(joint, force_share, usual_hz, duration_s, asked_hz),
            centre_m=float(status["setpoint_position_m"]),
            dt_s=1.0 / self.profile.cycle.rate_hz,
        )
        return self.follow(planned.setpoints, name)

    def identify(self, frequency_hz: float | None = None, duration_s: float = 20.0) -> Outcome:
        """Identify the backlash from a sweep over both contacts; without a frequency, one that suits the joint."""
        return self.sweep(IDENTIFY_SHARE, IDENTIFY_HZ, duration_s, "identifying the backlash", frequency_hz)
