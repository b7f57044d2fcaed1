"""The servo: one cycle of receive, decode, estimate, law, guard, encode, send; then record.

The same `Servo.cycle` serves hardware, the rig over the wire and batch in virtual time: only the transport differs.
It owns nothing that waits but the transport, and speaks with the supervisor through one request block, one status
block and the ring. No SDO, no files, no logging here.
"""

import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from drivers import cia402
from drivers.wire import HEARTBEAT_FRAME, SYNC_FRAME, Inbox, WireDecoder, WireEncoder
from stagectl.fields import fields
from stagectl.guard import NEGATIVE_LIMIT, POSITIVE_LIMIT, PRESSURE_LOW, SAFE_TORQUE_OFF, UNHEEDED_CYCLES, hear_drives
from stagectl.laws.reference import gap_centre
from stagectl.rehearsal import Rehearsal
from stagectl.requests import STATUS, TEXT_BYTES_COUNT, TICKING, Mode, Phase
from stagectl.ring import RequestReader, RequestWriter, RingWriter
from stagectl.row import FRAME_BYTES_COUNT, ROW, new_rows
from stagectl.row_fill import fill_row, fill_status
from stagectl.signals import COMMAND, MODE_TOLD, SETPOINT, Stop
from stagectl.stop_text import emergency_detail, mode_detail, stop_detail
from stagectl.tracker import LAW_NAMES, Tracker, belief_of

_TRACKING, _TRACK = Phase.TRACKING, Mode.TRACK  # a look-up in an enum costs 0.1 us
_ENABLE_TIMEOUT_S = 2.0
_QUICK_STOP_TIMEOUT_S = 5.0
_HEARTBEATS_PER_TIMEOUT = 4
_REST_M_PER_S = 1e-3
_REST_WINDOW_NS = 50_000_000
_STILL_WINDOWS = 2
_LEAST_STOPPING_S = 0.3
_SETTLING_NS = 100_000_000
"""From the reference's and the macro's rest until power goes: cut in its last cycle, what braked threw it back."""
_LONGEST_SETTLING_NS = 2_000_000_000
"""Until power goes although the macro is not at rest: beside an end that its motor can't hold it swings with 4 mm/s."""
_INTERLOCKS = SAFE_TORQUE_OFF | PRESSURE_LOW
_LIMIT_SWITCHES = NEGATIVE_LIMIT | POSITIVE_LIMIT
_RELATIVE_KEPT_RATIO = 0.9  # of the relative speed, from cycle to cycle of a stop
_RELATIVE_REST_M_PER_S = 1e-6
_READY_SAMPLES = 200  # before the sample clock counts as locked: 60 us / 200 = 0.3 us

_GUIDED_STOPS = (
    Stop.TRAVEL,
    Stop.VELOCITY,
    Stop.FOLLOWING_ERROR,
    Stop.OVERRUN,
    Stop.THERMAL,
    Stop.LEASE,
    Stop.DRIVE_FAULT,
    Stop.DIGITAL_INPUT,
    Stop.EMERGENCY,
    Stop.LINK_SILENT,
    Stop.DRIVE_MODE,
    Stop.FORCE_UNHEEDED,
)
"""Stops after which sensor and law can be trusted with the micro until the macro is slow, where its drive can."""

_GENTLE_STOPS = (Stop.OPERATOR,)
"""Nothing is wrong: half the ramp is enough. After all others the stage stops as short as the drive would."""

_UNPOWERED_STOPS = (Stop.OPERATOR, Stop.FINISHED)
"""After these the power goes; after all others the drives hold what they hold until somebody acknowledges."""

_POWERED = (cia402.State.OPERATION_ENABLED, cia402.State.QUICK_STOP_ACTIVE, cia402.State.FAULT_REACTION_ACTIVE)

_DRIVE_HOMES = (Phase.HOMING_DRIVE, Phase.HOMED_DRIVE)
"""The start of its homing stays set while the drive holds the index: a second edge would search again."""

_HELD_S, _HELD_M = 0.02, 1e-4
"""How far a macro may be from where its drive held it that long before: settled, it moves 1.4 um (three machines)."""
_JUMP_SETTLES_NS, _JUMPS_NS = 200_000_000, 1_000_000_000
"""What its loop needs to stand where an encoder that jumped says; of one that goes on jumping, from the first jump."""
_STARTS_S = 0.05  # in which a drive takes back the bits of a search before this one
_ATTAINED_S = 0.05  # in which a drive counts from its index on, and settles there

RELEASE_CYCLES = 100
"""What a drive has for showing that it is without power, before a servo that was asked to leaves."""

_LENGTHS = tuple(count.to_bytes(8, "little") for count in range(FRAME_BYTES_COUNT + 1))


def _bytes_of(values: np.ndarray) -> memoryview:
    """Return the array's memory: copied so, a setpoint takes 0.15 us; numpy copies field by field, 2.6 us."""
    return memoryview(values).cast("B")  # pyright: ignore[reportArgumentType]


class Transport(Protocol):
    """Bus, serial line and clock of one world."""

    failure: str
    """What is wrong with bus or port for good, empty while both work."""

    @property
    def lost_count(self) -> int:
        """Frames that the bus did not take."""
        ...

    def now_t_ns(self) -> int:
        """Return the time of this world's clock."""
        ...

    def sleep(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Sleep until shortly before the deadline, stamping what comes; tell whether there is time for a rehearsal."""
        ...

    def await_bytes(self, deadline_t_ns: int, inbox: Inbox) -> bool:
        """Wait until the deadline, or until the cycle's first sensor bytes are in the inbox; tell whether they are."""
        ...

    def receive(self, deadline_t_ns: int, inbox: Inbox) -> int:
        """Wait until the deadline, put what else arrived into the inbox, return the time."""
        ...

    def send(self, frames: list[tuple[int, bytes]]) -> tuple[bool, int]:
        """Put frames on the bus in this order; returns (all went out, end of the last)."""
        ...


class Servo:
    """All that one stage's loop holds between cycles."""

    def __init__(
        self,
        profile,
        decoder: WireDecoder,
        encoder: WireEncoder,
        tracker: Tracker,
        transport: Transport,
        segments: np.ndarray,
        requests: RequestReader,
        status: RequestWriter,
        ring: RingWriter,
        clock_ns: Callable[[], int] = time.perf_counter_ns,
    ):
        """Join the parts; `clock_ns` only measures how long a tick takes."""
        self.decoder, self.encoder, self.tracker, self.transport = decoder, encoder, tracker, transport
        self.segments, self.requests, self.status, self.ring = segments, requests, status, ring
        self._clock_ns = clock_ns
        self._rehearsal = Rehearsal(profile, decoder, encoder)
        self.inbox = Inbox()
        self.row = new_rows(1)
        self._row_bytes = _bytes_of(self.row)
        self._fresh_bytes = new_rows(1).tobytes()
        layout: Any = ROW.fields  # its keys are typed as literals
        self._offsets = {name: layout[name][1] for name in ROW.names or ()}
        self._homing_id = 0
        self._searches = False  # the macro's drive has power for its homing
        self._encoder_jumps = 0  # of the encoder that the index is held on
        self._jumped_t_ns = self._jumps_from_t_ns = 0  # when it did last, and first, while it is held; 0: at no time
        self._held_m = float("nan")  # where it holds its index, smoothed; nan: not looked at yet
        self._stated_text = ""
        self._status = np.zeros(1, STATUS)
        self._status["error_m"] = np.nan  # until a line was there
        self._request_number, request = requests.read()
        self._request = request  # the reader's own copy, the same array for good
        self._asked = fields(request)
        self._seen = fields(tracker.measurement)
        self._decided = fields(tracker.active.command)  # shared by all laws
        self._hold_bytes, self._setpoint_bytes = _bytes_of(tracker.hold), _bytes_of(tracker.setpoint)
        self._segment_bytes = _bytes_of(segments)
        self._has_micro = profile.micro is not None
        self._position_mode = profile.macro.mode == "position"
        self._period_ns = round(1e9 / profile.cycle.rate_hz)
        self._period_s = 1.0 / profile.cycle.rate_hz
        self._phase_ns = profile.cycle.phase_s * 1e9
        trip = profile.trip
        self._silence_ns = int(trip.supervisor_silence_s * 1e9)
        self._heartbeat_every = max(1, int(trip.heartbeat_s / _HEARTBEATS_PER_TIMEOUT * profile.cycle.rate_hz))
        self._stop_deceleration = profile.macro.stop_deceleration_m_per_s2
        self._node_ids = {axis: profile.axis(axis).node_id for axis in profile.axes}
        guard = tracker.active.guard
        law_modes = {axis: int(guard[f"{axis}_mode"][0]) for axis in profile.axes}
        self._modes = {Mode.TRACK: law_modes, Mode.HOME_DRIVE: {"macro": cia402.MODE_HOMING}}  # of drives with power
        self.phase = Phase.IDLE
        self.stop = Stop.NONE
        self.text = ""
        self._phase_since_t_ns = 0
        self._segment_number = 0
        self._segment_row = 0
        self._segment_start = 0
        self._segment_rows = 0
        self._late_segment_number = 0
        self._update_number = 0
        self._acknowledged = 0
        self._counter = -1
        self._counter_t_ns = 0
        self._rows = 0
        self._valid_samples = 0
        self._restarts = 0
        self._grid_cycle = -1
        self._missed = 0
        self._command_lost = 0
        self._last_cycle = -1
        self._deadline_t_ns = 0
        self._rest_mark_t_ns = self._settles_from_t_ns = 0
        self._rest_mark_m = 0.0
        self._still_windows_count = 0
        self._rests_from_t_ns = 0  # before that no ramp can have brought it to rest

    @property
    def mode(self) -> Mode:
        """What the supervisor asked for last."""
        return Mode(self._asked.mode)

    @property
    def supervisor_silence_s(self) -> float:
        """Time since the supervisor's counter changed."""
        return (self.inbox.t_ns - self._counter_t_ns) * 1e-9

    @property
    def released(self) -> bool:
        """Whether both drives have shown that they are without power."""
        seen = self._seen
        words = [getattr(seen, f"{axis}_statusword") for axis in self._node_ids]
        return not any(cia402.state_of(word) in _POWERED for word in words)

    def leave(self) -> None:
        """Go on as if the supervisor, who is gone, had asked for the end: a stage at rest loses its power."""
        self._asked.mode = int(Mode.EXIT)

    # ---- one cycle ---------------------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Run one cycle, from waiting for its start to its row in the ring."""
        inbox, seen = self.inbox, self._seen
        inbox.clear()
        if self._rows == 0:  # what passed since the servo was made is nobody's lateness
            self._deadline_t_ns = self.transport.now_t_ns() + self._period_ns
        if self.transport.sleep(self._deadline_t_ns, inbox):
            self._rehearsal.step()
            self.requests.read()  # heeded when the cycle's own bytes are in
        if self.transport.await_bytes(self._deadline_t_ns, inbox):
            self.decoder.take_first_bytes(inbox)
        self._take_request()
        t_ns = self.transport.receive(self._deadline_t_ns, inbox)
        lateness_ns = t_ns - self._deadline_t_ns
        inbox.t_ns = t_ns
        started_ns = self._clock_ns()
        self._decode(t_ns)
        self._valid_samples += seen.samples_new
        if self.decoder.restarts != self._restarts:  # the sensor's clock has to be found again
            self._restarts = self.decoder.restarts
            self._valid_samples = 0
            self._grid_cycle = -1
        self._count_missed(seen.cycle)
        self._heed_request(t_ns)
        seen.command_lost = self._command_lost
        seen.overrun_ns = lateness_ns if lateness_ns > self._period_ns else 0
        seen.lease_left_ns = self._asked.lease_until_t_ns - t_ns
        seen.store()
        if self.phase not in TICKING:
            hear_drives(self.tracker.active.guard[0], self.tracker.measurement[0])
        macro_target, micro_target = self._advance_phase(t_ns)
        decided = self._decided
        stop = Stop.NONE
        if self.phase in TICKING:
            self._next_setpoint(seen.cycle)
            self.tracker.active.step()
            decided.load()
            if decided.stop != Stop.NONE:
                stop = Stop(decided.stop)
        else:
            self.tracker.active.command[...] = np.zeros(1, COMMAND)
            self.tracker.active.command["macro_target_m"] = seen.macro_encoder_m
            decided.load()
        guided = False
        target_m = decided.macro_target_m
        if stop is not Stop.NONE:
            guided = self._can_guide(stop)
            macro_target = cia402.State.QUICK_STOP_ACTIVE
            target_m = seen.macro_encoder_m  # a stopped law's own may be nan
            if not guided:
                micro_target = cia402.State.QUICK_STOP_ACTIVE
        macro_word = self._controlword(seen.macro_statusword, macro_target)
        micro_word = self._controlword(seen.micro_statusword, micro_target)
        if self.phase in _DRIVE_HOMES and macro_word == cia402.ENABLE_OPERATION:
            macro_word |= cia402.HOMING_START
        frames = []
        micro_frame = self.encoder.micro(micro_word, decided.micro_word)
        if micro_frame is not None:
            frames.append(micro_frame)
        macro_frame = self.encoder.macro(macro_word, decided.macro_word, target_m)
        frames += [macro_frame, SYNC_FRAME]
        if self._rows % self._heartbeat_every == 0:
            frames.append(HEARTBEAT_FRAME)
        tick_ns = self._clock_ns() - started_ns
        sent, sync_end_t_ns = self.transport.send(frames)
        self._command_lost = 0 if sent else 1
        inbox.sync_t_ns = sync_end_t_ns  # what the next cycle's TPDOs were sampled at
        self._record(lateness_ns, tick_ns, sync_end_t_ns, macro_word, micro_word, macro_frame[1], micro_frame)
        if stop is not Stop.NONE:
            self._brake(stop, guided, t_ns)
        self._publish()
        self._rehearsal.keep(inbox)
        self._plan_next()

    def _decode(self, t_ns: int) -> None:
        """Decode the inbox; bytes that can't be what was agreed, or none for good, end the run."""
        text = self.decoder.decode(self.inbox, self._seen)
        text = self.transport.failure or text
        if text and self.phase in (Phase.IDLE, Phase.HOMED_DRIVE, Phase.ENABLING):
            self._end(Stop.LINK_LOST, Phase.STOPPED, t_ns, text)
        elif text and self.phase not in (Phase.STOPPED, Phase.QUICK_STOP):
            self._end(Stop.LINK_LOST, Phase.QUICK_STOP, t_ns, text)

    def _can_guide(self, stop: Stop) -> bool:
        """Tell whether the micro can be kept off its stops: sensor and law are sound, and its own drive obeys."""
        if not self._has_micro or self.phase is Phase.GUIDED_STOP or stop not in _GUIDED_STOPS:
            return False
        seen = self._seen
        is_enabled = cia402.state_of(seen.micro_statusword) is cia402.State.OPERATION_ENABLED
        obeys = is_enabled and not self._shows_other_mode("micro", Mode.TRACK)
        tripped = seen.micro_digital_inputs & (_INTERLOCKS | _LIMIT_SWITCHES)
        failed = seen.emergency >> 16 == self._node_ids["micro"]
        guard = self.tracker.active.guard
        silent = stop is Stop.LINK_SILENT and guard["micro_silence"][0] > 0.0
        unheeded = stop is Stop.FORCE_UNHEEDED and guard["micro_unheeded"][0] > UNHEEDED_CYCLES
        return obeys and not tripped and not failed and not silent and not unheeded

    def _shows_other_mode(self, axis: str, mode: Mode) -> bool:
        """Tell whether a drive has told another mode of operation (0x6061) than it works in where `mode` is asked."""
        seen = self._seen
        shown = getattr(seen, f"{axis}_mode_display")
        return bool(seen.modes_told & MODE_TOLD[axis]) and shown != self._modes[mode][axis]

    def _brake(self, stop: Stop, guided: bool, t_ns: int) -> None:
        """Leave the law: the macro by its drive; the micro still guided where it can be."""
        text = self._detail(stop)
        if guided:
            self.tracker.guide()
            self._end(stop, Phase.GUIDED_STOP, t_ns, text)
        else:
            self._end(stop, Phase.QUICK_STOP, t_ns, text)

    def _detail(self, stop: Stop) -> str:
        """Say in numbers why a tick ended the run."""
        if stop is Stop.REFERENCE_LOST:
            return self.decoder.reference_text
        if stop is Stop.COMMAND_LOST:
            return f"{self.transport.lost_count} frames were refused so far; look for what else loads the bus"
        one = self.tracker.active
        parts = (one.measurement[0], one.setpoint[0], one.command[0], one.guard[0])
        return stop_detail(stop, *parts, self._node_ids, LAW_NAMES[self.tracker.law_number])

    def _count_missed(self, cycle: int) -> None:
        """Count the grid points between this cycle and the one before."""
        if 0 <= self._grid_cycle < cycle - 1:
            self._missed += cycle - 1 - self._grid_cycle
        self._grid_cycle = cycle

    def _plan_next(self) -> None:
        """Set the start of the next cycle: the sensor's next sample plus the phase, else a free-running period."""
        due = self.decoder.next_start_t_ns(self._phase_ns)
        if due == 0:
            due = self._deadline_t_ns + self._period_ns
        now = self.transport.now_t_ns()
        if due <= now:  # the grid point is gone: skip to the next one
            due += ((now - due) // self._period_ns + 1) * self._period_ns
        self._deadline_t_ns = due

    # ---- requests and phases ---------------------------------------------------------------------------------

    def _take_request(self) -> None:
        """Copy the newest request; heeding it waits until the cycle is due."""
        number, _ = self.requests.read()
        if number != self._request_number:
            self._request_number = number
            self._asked.load()

    def _heed_request(self, t_ns: int) -> None:
        """Notice a supervisor that stands still; take a change of zeros and belief."""
        asked = self._asked
        counter = asked.counter
        if counter != self._counter:
            self._counter, self._counter_t_ns = counter, t_ns
        if self.phase is not Phase.STOPPED:  # only a stop that is there can be acknowledged
            self._acknowledged = asked.acknowledge_number
        number = asked.update_number
        if number != self._update_number:
            zeros = asked.macro_zero_counts, asked.end_zero_counts
            shifts = self.decoder.set_zeros(*zeros)
            seen = self._seen
            seen.macro_position_m += shifts[0]
            seen.end_position_m += shifts[1]
            seen.macro_earlier_m += shifts[0]
            seen.end_earlier_m += shifts[1]
            self.tracker.update(belief_of(self._request), *shifts)
            self._update_number = number
            self._homing_id = asked.homing_id

    def _enter(self, phase: Phase, t_ns: int) -> None:
        self.phase = phase
        self._phase_since_t_ns = t_ns

    def _end(self, stop: Stop, phase: Phase, t_ns: int, text: str = "") -> None:
        """Latch why the run ended and go to the phase that brings the stage to rest.

        The first reason stays; but who asked for rest has to hear of what broke on the way to it.
        """
        if self.stop is Stop.NONE or (self.stop in _UNPOWERED_STOPS and stop not in _UNPOWERED_STOPS):
            self.stop, self.text = stop, text
        elif phase is Phase.QUICK_STOP and text and text not in self.text:
            self.text = f"{self.text}; then {text}"
        self._look_for_rest(t_ns)
        if self.phase in (Phase.TRACKING, Phase.STOPPING):
            guard = self.tracker.active.guard
            speed, limit = abs(float(guard["macro_velocity_m_per_s"][0])), float(guard["velocity_limit_m_per_s"][0])
            ramp_s = (speed if speed <= limit else limit) / float(guard["stop_deceleration_m_per_s2"][0])
            self._rests_from_t_ns = t_ns + round(1e9 * ramp_s)
        self._enter(phase, t_ns)

    def _asked_stop(self) -> Stop:
        """Return why the supervisor wants the stage at rest."""
        return Stop(self._asked.stop) or Stop.OPERATOR

    def _refusal(self, mode: Mode) -> tuple[Stop, str]:
        """Return why the drives must not be powered now, (NONE, "") when they may."""
        seen = self._seen
        if seen.emergency != 0:
            return Stop.EMERGENCY, emergency_detail(seen.emergency)
        inputs = seen.macro_digital_inputs | seen.micro_digital_inputs
        if inputs & (_INTERLOCKS if mode is Mode.HOME_DRIVE else _INTERLOCKS | _LIMIT_SWITCHES):
            return Stop.DIGITAL_INPUT, self._detail(Stop.DIGITAL_INPUT)
        if any(self._shows_other_mode(axis, mode) for axis in self._modes[mode]):
            return Stop.DRIVE_MODE, mode_detail(self.tracker.active.measurement[0], self._modes[mode], self._node_ids)
        guard = self.tracker.active.guard
        if not max(guard["macro_silence"][0], guard["micro_silence"][0]) <= guard["silent_cycles"][0]:
            return Stop.LINK_SILENT, self._detail(Stop.LINK_SILENT)
        if mode is Mode.TRACK and seen.reference_lost != 0:
            return Stop.REFERENCE_LOST, self.decoder.reference_text
        if mode is Mode.TRACK and self.decoder.encoder_text:
            return Stop.ENCODER_LOST, self.decoder.encoder_text
        if seen.lease_left_ns <= 0:
            return Stop.LEASE, "there was none when the drives were to get power; renew it as long as the stage moves"
        return Stop.NONE, ""

    def _advance_phase(self, t_ns: int) -> tuple[cia402.State, cia402.State]:
        """Move between phases; returns the drive states wanted of macro and micro."""
        off, on = cia402.State.SWITCH_ON_DISABLED, cia402.State.OPERATION_ENABLED
        seen = self._seen
        silent = t_ns - self._counter_t_ns > self._silence_ns
        lies = self.decoder.encoder_text
        if (
            self.phase is _TRACKING
            and self._asked.mode == _TRACK
            and seen.lease_left_ns > 0
            and not silent
            and not lies
        ):
            return on, on  # as in almost every cycle
        mode = Mode(self._asked.mode)
        in_phase_s = (t_ns - self._phase_since_t_ns) * 1e-9
        macro_state = cia402.state_of(seen.macro_statusword)
        if self.phase is Phase.HOMED_DRIVE and self._encoder_jumped(t_ns):
            return self._behind_a_jump(macro_state, t_ns)
        if self.phase in (Phase.IDLE, Phase.HOMED_DRIVE):
            wanted = mode is Mode.TRACK or (mode is Mode.HOME_DRIVE and self.phase is Phase.IDLE)
            if wanted and not silent:
                stop, text = self._refusal(mode)
                if stop is not Stop.NONE:
                    self._end(stop, Phase.STOPPED, t_ns, text)
                else:
                    self._searches = False
                    self._enter(Phase.ENABLING if mode is Mode.TRACK else Phase.HOMING_DRIVE, t_ns)
            elif mode is Mode.IDLE:
                self._enter(Phase.IDLE, t_ns)
            elif self.phase is Phase.HOMED_DRIVE and mode in (Mode.HOME_DRIVE, Mode.STOP):
                return self._homing(mode, macro_state, silent, t_ns)
            return off, off
        if self.phase is Phase.HOMING_DRIVE:
            return self._homing(mode, macro_state, silent, t_ns)
        if self.phase is Phase.ENABLING:
            if silent or mode is not Mode.TRACK:
                self._end(Stop.SUPERVISOR_SILENT if silent else self._asked_stop(), Phase.STOPPED, t_ns)
                return off, off
            stop, text = self._refusal(mode)
            if stop is not Stop.NONE:
                self._end(stop, Phase.STOPPED, t_ns, text)
                return off, off
            micro_on = not self._has_micro or cia402.state_of(seen.micro_statusword) is on
            if macro_state is on and micro_on and seen.samples_new > 0:
                self.tracker.begin(self._asked.law_number)
                self._last_cycle = seen.cycle
                # What a stop cut short, or what was asked for and not begun before it, is never taken up again.
                self._segment_number = self._asked.segment_number
                self._segment_row = self._segment_rows
                self._enter(Phase.TRACKING, t_ns)
            elif in_phase_s > _ENABLE_TIMEOUT_S or self._failed_drive():
                stop, text = self._not_enabled()
                self._end(stop, Phase.STOPPED, t_ns, text)
                return off, off
            return on, on
        if self.phase is Phase.TRACKING:
            if silent:
                silence_s = (t_ns - self._counter_t_ns) * 1e-9
                text = f"no sign of life for {silence_s:.3f} s, limit {self._silence_ns * 1e-9:g} s"
                self._end(Stop.SUPERVISOR_SILENT, Phase.STOPPING, t_ns, text)
            elif lies:  # the law goes by the lasers; the drive would ramp down on what lies, which threw it forward
                self._end(Stop.ENCODER_LOST, Phase.STOPPING, t_ns, lies)
            elif mode is not Mode.TRACK:
                self._end(self._asked_stop(), Phase.STOPPING, t_ns)
            elif seen.lease_left_ns <= 0:
                text = f"it ended {-seen.lease_left_ns * 1e-6:.1f} ms ago; renew it as long as the stage moves"
                self._end(Stop.LEASE, Phase.STOPPING, t_ns, text)
            self._need_no_lease()
            return on, on
        if self.phase is Phase.STOPPING:
            self._need_no_lease()
            if self.tracker.hold["velocity_m_per_s"][0] != 0.0:
                self._rest_mark_t_ns = self._settles_from_t_ns = t_ns
            elif not self._macro_is_slow() and t_ns - self._settles_from_t_ns <= _LONGEST_SETTLING_NS:
                self._rest_mark_t_ns = t_ns
            if t_ns - self._rest_mark_t_ns > _SETTLING_NS and in_phase_s > _LEAST_STOPPING_S:
                self._enter(Phase.STOPPED, t_ns)
                return self._stopped_targets(mode)
            return on, on
        if self.phase is Phase.GUIDED_STOP:
            return self._guided(t_ns, in_phase_s)
        if self.phase is Phase.QUICK_STOP:
            if self._stands(t_ns):
                self._enter(Phase.STOPPED, t_ns)
            elif in_phase_s > _QUICK_STOP_TIMEOUT_S:
                unseen = f"the macro was not seen to stand within {_QUICK_STOP_TIMEOUT_S:g} s: keep clear of it"
                self.text = f"{self.text}; {unseen}" if self.text else unseen
                self._enter(Phase.STOPPED, t_ns)
            return cia402.State.QUICK_STOP_ACTIVE, cia402.State.QUICK_STOP_ACTIVE
        # STOPPED: hold what the drives hold until the fault is acknowledged
        number = self._asked.acknowledge_number
        if number != self._acknowledged and mode in (Mode.RESET, Mode.IDLE):
            self._acknowledged = number
            if (
                self.stop not in _UNPOWERED_STOPS
            ):  # else whoever asked for rest has heard of none: the next arming tells
                seen.emergency = 0
                seen.store()
            self.stop = Stop.NONE
            self.text = ""
            self._enter(Phase.IDLE, t_ns)
            return off, off
        return self._stopped_targets(mode)

    def _need_no_lease(self) -> None:
        """Keep the guard from stopping on the lease: coming to rest needs none."""
        self._seen.lease_left_ns = max(self._seen.lease_left_ns, self._period_ns)
        self._seen.store()

    def _stopped_targets(self, mode: Mode) -> tuple[cia402.State, cia402.State]:
        """Return the drive states of a stage at rest: held, but for power that nobody wants or an encoder that lies."""
        if mode in (Mode.EXIT, Mode.RELEASE) or self.stop in _UNPOWERED_STOPS or self.stop is Stop.ENCODER_LOST:
            return cia402.State.SWITCH_ON_DISABLED, cia402.State.SWITCH_ON_DISABLED
        return cia402.State.QUICK_STOP_ACTIVE, cia402.State.QUICK_STOP_ACTIVE

    def _failed_drive(self) -> bool:
        """Tell whether a drive is in FAULT, which only an acknowledgement ends."""
        seen = self._seen
        words = [getattr(seen, f"{axis}_statusword") for axis in self._node_ids]
        return any(cia402.state_of(word) is cia402.State.FAULT for word in words)

    def _not_enabled(self) -> tuple[Stop, str]:
        """Say why the drives did not come up in time."""
        seen = self._seen
        words = [getattr(seen, f"{axis}_statusword") for axis in self._node_ids]
        if all(cia402.state_of(word) is cia402.State.OPERATION_ENABLED for word in words):
            text = f"the drives are up, but no valid sample came within {_ENABLE_TIMEOUT_S:g} s; check beams and cable"
            return Stop.SENSOR_AGE, text
        return Stop.DRIVE_FAULT, self._detail(Stop.DRIVE_FAULT)

    def _look_for_rest(self, t_ns: int) -> None:
        """Look from here on whether the macro's encoder stands."""
        self._rest_mark_t_ns, self._rest_mark_m = t_ns, float("nan")
        self._settles_from_t_ns = t_ns
        self._still_windows_count = 0

    def _stands(self, t_ns: int) -> bool:
        """Tell whether the macro's own encoder has been still for a while, no sooner than its ramp can end.

        One window is not enough: a macro that swings has turned round within it. A position that is stuck, or no
        position at all in a mapping that another master changed, is still too.
        """
        seen = self._seen
        if t_ns < self._rests_from_t_ns:
            return False
        if not seen.tpdos_new & 1 or t_ns - self._rest_mark_t_ns < _REST_WINDOW_NS:
            return False
        encoder_m, since_s = seen.macro_encoder_m, (t_ns - self._rest_mark_t_ns) * 1e-9
        moved_m = abs(encoder_m - self._rest_mark_m)
        self._rest_mark_t_ns, self._rest_mark_m = t_ns, encoder_m
        self._still_windows_count = self._still_windows_count + 1 if moved_m <= _REST_M_PER_S * since_s else 0
        return self._still_windows_count >= _STILL_WINDOWS

    def _macro_is_slow(self) -> bool:
        """Tell whether the law sees the macro as good as at rest."""
        return abs(float(self.tracker.active.model["macro_velocity_m_per_s"][0])) < _REST_M_PER_S

    def _guided(self, t_ns: int, in_phase_s: float) -> tuple[cia402.State, cia402.State]:
        """Keep the micro on the braking macro until that is slow, or until the sensor falls silent."""
        if (self._macro_is_slow() and in_phase_s > 0.1) or in_phase_s > _QUICK_STOP_TIMEOUT_S:
            self._look_for_rest(t_ns)
            self._enter(Phase.QUICK_STOP, t_ns)
            return cia402.State.QUICK_STOP_ACTIVE, cia402.State.QUICK_STOP_ACTIVE
        return cia402.State.QUICK_STOP_ACTIVE, cia402.State.OPERATION_ENABLED

    def _homing(self, mode: Mode, state: cia402.State, silent: bool, t_ns: int) -> tuple[cia402.State, cia402.State]:
        """Let the macro's drive home, and hold where it is then; the micro stays without power."""
        off, on = cia402.State.SWITCH_ON_DISABLED, cia402.State.OPERATION_ENABLED
        seen = self._seen
        if silent or mode is not Mode.HOME_DRIVE or seen.lease_left_ns <= 0:
            given_up = self._asked_stop() if mode is not Mode.HOME_DRIVE else Stop.LEASE
            self._end(Stop.SUPERVISOR_SILENT if silent else given_up, Phase.QUICK_STOP, t_ns)
            return cia402.State.QUICK_STOP_ACTIVE, off
        stop, text = self._refusal(mode)
        if stop is not Stop.NONE:
            self._end(stop, Phase.QUICK_STOP, t_ns, text)
            return cia402.State.QUICK_STOP_ACTIVE, off
        homed = self.phase is Phase.HOMED_DRIVE
        # One that let go by itself would be walked up again, and search again.
        if state in (cia402.State.FAULT, cia402.State.FAULT_REACTION_ACTIVE) or (self._searches and state is not on):
            self._end(Stop.DRIVE_FAULT, Phase.QUICK_STOP, t_ns, self._detail(Stop.DRIVE_FAULT))
            return cia402.State.QUICK_STOP_ACTIVE, off
        self._searches = state is on
        if homed and not self._holds_index((t_ns - self._phase_since_t_ns) * 1e-9):
            moved_m = abs(seen.macro_encoder_m - self._held_m)
            text = (
                f"the macro's drive held its index, and moved {moved_m * 1e6:.0f} um within {_HELD_S * 1e3:g} ms, "
                f"limit {_HELD_M * 1e6:g} um; see who else writes to the drive, its mode say, and what pushes the macro"
            )
            self._end(Stop.FOLLOWING_ERROR, Phase.QUICK_STOP, t_ns, text)
            return cia402.State.QUICK_STOP_ACTIVE, off
        if not homed and state is on and (t_ns - self._phase_since_t_ns) * 1e-9 > _STARTS_S:
            progress = cia402.homing_of(seen.macro_statusword)
            if progress is cia402.Homing.ATTAINED:
                self._enter(Phase.HOMED_DRIVE, t_ns)
                self._jumped_t_ns = self._jumps_from_t_ns = 0
                return on, off
            if progress in (cia402.Homing.ERROR, cia402.Homing.ERROR_MOVING):
                text = "no index on this side; check index, limit switches and macro.homing"
                self._end(Stop.HOMING_GIVEN_UP, Phase.QUICK_STOP, t_ns, text)
                return cia402.State.QUICK_STOP_ACTIVE, off
        return on, off

    def _encoder_jumped(self, t_ns: int) -> bool:
        """Tell whether the macro's encoder jumped since its drive has held the index on it."""
        if (t_ns - self._phase_since_t_ns) * 1e-9 <= _ATTAINED_S:
            self._encoder_jumps = self.decoder.encoder_jumps
        if self.decoder.encoder_jumps != self._encoder_jumps:
            self._encoder_jumps, self._jumped_t_ns = self.decoder.encoder_jumps, t_ns
            self._jumps_from_t_ns = self._jumps_from_t_ns or t_ns
        return self._jumped_t_ns != 0

    def _behind_a_jump(self, state: cia402.State, t_ns: int) -> tuple[cia402.State, cia402.State]:
        """Let the macro's drive stand where its encoder says it was, then stop it; whatever else is wrong stops it now.

        Stopped at once, it ramped down from the speed of a jump of 0.6 mm in a cycle: 7.7 mm.
        """
        stop, text = self._refusal(Mode.HOME_DRIVE)
        settles = t_ns - self._jumped_t_ns <= _JUMP_SETTLES_NS and t_ns - self._jumps_from_t_ns <= _JUMPS_NS
        if stop is Stop.NONE and state is not cia402.State.OPERATION_ENABLED:  # it would be walked up, and search again
            stop, text = Stop.DRIVE_FAULT, self._detail(Stop.DRIVE_FAULT)
        elif stop is Stop.NONE and settles:
            return cia402.State.OPERATION_ENABLED, cia402.State.SWITCH_ON_DISABLED
        elif stop is Stop.NONE:
            stop, text = Stop.ENCODER_LOST, "it jumped while the drive held its index on it; check encoder and cable"
        self._end(stop, Phase.QUICK_STOP, t_ns, text)
        return cia402.State.QUICK_STOP_ACTIVE, cia402.State.SWITCH_ON_DISABLED

    def _holds_index(self, in_phase_s: float) -> bool:
        """Tell whether the macro is where its drive held it; no law or guard looks at it meanwhile.

        A foreign master that changed the drive's mode sent it off at 23 m/s^2.
        """
        encoder_m = self._seen.macro_encoder_m
        if in_phase_s <= _ATTAINED_S:
            self._held_m = encoder_m
        moved_m = encoder_m - self._held_m
        if not abs(moved_m) <= _HELD_M:
            return False
        self._held_m += min(self._period_s / _HELD_S, 1.0) * moved_m
        return True

    def _controlword(self, statusword: int, target: cia402.State) -> int:
        """Return the next controlword; a fault is reset only on request, on a rising edge."""
        state = cia402.state_of(statusword)
        if state is cia402.State.FAULT and self._asked.mode == Mode.RESET:
            return cia402.FAULT_RESET if self._rows & 1 else 0
        return cia402.controlword(state, target)

    # ---- setpoints ---------------------------------------------------------------------------------------------

    def _next_setpoint(self, cycle: int) -> None:
        """Advance the reference by the cycles that passed on the sensor's own sequence."""
        passed = max(cycle - self._last_cycle, 0)
        self._last_cycle = max(cycle, self._last_cycle)
        hold = self.tracker.hold
        asked = self._asked
        if self.phase is Phase.STOPPING:
            self._slow_down(passed)
        elif self.phase is Phase.GUIDED_STOP:
            self._follow_macro()
        else:
            number = asked.segment_number
            if number != self._segment_number and number != self._late_segment_number:
                passed = self._begin_segment(number, passed)
            if self._segment_row < self._segment_rows and passed:
                self._segment_row = min(self._segment_row + passed, self._segment_rows)
                start = (self._segment_start + self._segment_row - 1) * SETPOINT.itemsize
                self._hold_bytes[:] = self._segment_bytes[start : start + SETPOINT.itemsize]
                if self._segment_row == self._segment_rows:
                    self._rest(hold)
        self._setpoint_bytes[:] = self._hold_bytes

    def _begin_segment(self, number: int, passed: int) -> int:
        """Take a new segment; returns the rows to advance by.

        One that goes on within the segment under way is taken at its row, and never where that is past: what is
        under way ends at rest by itself, and a step in the reference would be a blow.
        """
        asked = self._asked
        if asked.segment_at_row > 0:
            if self._segment_row > asked.segment_at_row:
                self._late_segment_number = number
                return passed
            ahead = self._segment_row + passed - asked.segment_at_row
            if ahead <= 0:
                return passed
            passed = ahead
        else:
            passed = max(passed, 1)
        self._segment_number = number
        self._segment_start = asked.segment_start
        self._segment_rows = asked.segment_rows
        self._segment_row = 0
        if asked.law_number != self.tracker.law_number:
            self.tracker.switch(asked.law_number)
        return passed

    @staticmethod
    def _rest(hold: np.ndarray) -> None:
        """Keep position and relative position, drop everything that moves."""
        kept = float(hold["position_m"][0]), float(hold["relative_position_m"][0])
        hold[...] = np.zeros(1, SETPOINT)
        hold["position_m"], hold["relative_position_m"] = kept

    def _follow_macro(self) -> None:
        """Take the macro's own motion as the micro's reference while the drive brakes it."""
        hold, model = self.tracker.hold, self.tracker.active.model
        hold[...] = np.zeros(1, SETPOINT)
        hold["position_m"] = model["macro_position_m"] - gap_centre(self.tracker.active.belief[0])
        hold["velocity_m_per_s"] = model["macro_velocity_m_per_s"]
        hold["acceleration_m_per_s2"] = model["macro_acceleration_m_per_s2"]

    def _slow_down(self, passed: int) -> None:
        """Bring the macro's reference to rest at its drive's ramp, half of it where an operator asked; the micro's too.

        Each by itself: with the end's reference at rest at once and the micro's on its way for 10 ms more, a stop in
        an identification sent the macro off by 20 um.
        """
        if passed == 0:
            return
        hold = self.tracker.hold
        dt_s = passed * self._period_s
        rate = float(hold["relative_velocity_m_per_s"][0])
        slower = rate * _RELATIVE_KEPT_RATIO**passed if abs(rate) > _RELATIVE_REST_M_PER_S else 0.0
        v = float(hold["velocity_m_per_s"][0]) - rate
        share = 0.5 if self.stop in _GENTLE_STOPS else 1.0
        step = share * self._stop_deceleration * dt_s
        after = v - step if v > step else v + step if v < -step else 0.0
        hold["position_m"] += (0.5 * (v + after) + rate) * dt_s
        hold["velocity_m_per_s"] = after + slower
        hold["relative_position_m"] += rate * dt_s
        hold["relative_velocity_m_per_s"] = slower
        hold["relative_acceleration_m_per_s2"] = (slower - rate) / dt_s
        macro_m_per_s2 = (after - v) / dt_s if after != 0.0 else 0.0
        hold["acceleration_m_per_s2"] = macro_m_per_s2 + (slower - rate) / dt_s
        hold["jerk_m_per_s3"] = 0.0

    # ---- what remains ------------------------------------------------------------------------------------------

    def _record(
        self,
        lateness_ns: int,
        tick_ns: int,
        sync_end_t_ns: int,
        macro_word: int,
        micro_word: int,
        macro_payload: bytes,
        micro_frame: tuple[int, bytes] | None,
    ) -> None:
        """Fill the row and count it in the ring."""
        inbox, one, decoder, tracker = self.inbox, self.tracker.active, self.decoder, self.tracker
        bytes_ = self._row_bytes
        bytes_[:] = self._fresh_bytes
        count = len(inbox.sensor_bytes)
        fill_row(
            self.row, one.measurement, tracker.setpoint, one.command, one.estimator, one.model, one.law, one.backlash,
            int(self.phase), lateness_ns, tick_ns, sync_end_t_ns,
            inbox.first_arrival_t_ns, inbox.first_bytes_count, inbox.sensor_arrival_t_ns, count,
            macro_word, micro_word, decoder.macro_counts, decoder.end_counts, tracker.law_number,
            self._segment_number, self._update_number, self._homing_id, decoder.samples_lost, self._missed,
            decoder.air_index,
        )  # fmt: skip
        at = self._offsets
        if count:
            start = at["sensor_bytes"]
            bytes_[start : start + count] = inbox.sensor_bytes
        for name in Inbox.FRAMES:
            payload = getattr(inbox, name)
            if payload is not None:
                start = at[name]
                bytes_[start : start + len(payload)] = payload
                start = at[f"{name}_count"]
                bytes_[start : start + 8] = _LENGTHS[len(payload)]
        start = at["macro_rpdo"]
        bytes_[start : start + len(macro_payload)] = macro_payload
        if micro_frame is not None:
            start = at["micro_rpdo"]
            bytes_[start : start + len(micro_frame[1])] = micro_frame[1]
        self.ring.write(self.row)
        self._rows += 1

    def _publish(self) -> None:
        """Tell the supervisor where things stand."""
        one, decoder = self.tracker.active, self.decoder
        ready = self._valid_samples >= _READY_SAMPLES and self._seen.samples_new > 0
        fill_status(
            self._status, one.measurement, self.tracker.setpoint, self.tracker.hold, one.backlash,
            self._rows, int(self.phase), int(self.stop), self._segment_number,
            self._segment_rows - self._segment_row, self._update_number, int(ready), self._missed,
            decoder.samples_lost, decoder.framer.counters.bytes_discarded, decoder.macro_counts, decoder.end_counts,
            decoder.air_index,
        )  # fmt: skip
        if self.decoder.encoder_text:  # only a homing makes encoder and lasers agree again
            self._status["reference_lost"] = 1
        if self.text != self._stated_text:
            self._stated_text = self.text
            encoded = self.text.encode()[:TEXT_BYTES_COUNT].ljust(TEXT_BYTES_COUNT, b"\0")
            self._status["text"][0] = np.frombuffer(encoded, np.uint8)
        self.status.publish(self._status)
