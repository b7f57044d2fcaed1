"""One cycle's bytes and frames to a MEASUREMENT, and a COMMAND to frames; the same live and in replay.

`Inbox` is what came in, untouched. `WireDecoder` holds all memory that decoding needs (framer, sample clock, zeros,
last process data) and reads no clock: times come with the inbox. Pure; opens nothing.
"""

import contextlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers import cia402, sample_clock
from drivers.air import ciddor_index, ramped_index
from drivers.arming import SYNC_ID, DriveMapping
from drivers.framers import framer_for
from drivers.pdo import Codec
from drivers.reading import END_VALID, MACRO_VALID, REFERENCE_LOST, RESTARTED, Reading
from drivers.scale import counts_per_wavelength_of, metres_per_count
from drivers.umd2 import Umd2Framer
from stagectl.errors import LinkError, RequestError
from stagectl.signals import MODE_TOLD

if TYPE_CHECKING:
    from stagectl.profile import Profile

SERVO_NODE_ID = 0x7E
HEARTBEAT_FRAME = (0x700 + SERVO_NODE_ID, b"\x05")
SYNC_FRAME = (SYNC_ID, b"")

BOTH_VALID = MACRO_VALID | END_VALID
_SILENCE_CODES = (0x81, 0x82, 0x87)  # communication, protocol, SYNC: without power only "nobody talked to me"
_POWERED = (cia402.State.OPERATION_ENABLED, cia402.State.QUICK_STOP_ACTIVE, cia402.State.FAULT_REACTION_ACTIVE)
_NO_ERROR = b"\0\0"  # an EMCY that takes the one before back
_DISAGREEMENTS_IN_A_ROW = 5  # a host that holds a SYNC up by a millisecond is no lost reference
_GAIN_MARGIN = 1.5  # of what the motor's full force adds to a cycle's way: 29 um at 1 kHz, 2.9 mm at 100 Hz
_NEVER_AGREED = (-1, math.nan, math.nan)
_CLOCK_SAMPLES = 200  # before the sample clock can tell that a number came too early
_REPEATS_PROBABILITY = 1e-20  # that noise makes so many equal samples in a row
_LEAST_REPEATS = 12  # of a sensor that is five times quieter than it is stated: one false alarm in 150 years
_MOST_REPEATED_SHARE = 0.5  # of samples: above it a sensor may rest on one count
_INDEX_STEP = 2e-8  # Ciddor's own uncertainty; below it the last digits of sensors flicker (0.01 K: 1e-8)
_EARLIEST_SHARE = 0.5  # of the transport's constant part: no line of a sample younger than this can be there


@dataclass(slots=True)
class Inbox:
    """What one cycle received."""

    t_ns: int = 0
    sensor_bytes: bytes = b""
    first_bytes_count: int = 0  # of them came with the first read, ...
    first_arrival_t_ns: int = 0  # ... readable at this time, ...
    sensor_arrival_t_ns: int = 0  # ... and all after them at this one
    sync_t_ns: int = 0  # end of the last SYNC: when the drives sampled what their TPDOs carry
    macro_tpdo: bytes | None = None
    micro_tpdo: bytes | None = None
    macro_inputs_tpdo: bytes | None = None
    micro_inputs_tpdo: bytes | None = None
    macro_emcy: bytes | None = None
    micro_emcy: bytes | None = None

    FRAMES = ("macro_tpdo", "micro_tpdo", "macro_inputs_tpdo", "micro_inputs_tpdo", "macro_emcy", "micro_emcy")

    @property
    def has_events(self) -> bool:
        """Whether a frame is here that drives send only when something happened."""
        return not (
            self.macro_inputs_tpdo is None
            and self.micro_inputs_tpdo is None
            and self.macro_emcy is None
            and self.micro_emcy is None
        )

    def take(self, name: str, payload: bytes) -> None:
        """Keep a frame; of several in one cycle the newest, but an emergency stays until it was seen."""
        if name.endswith("_emcy") and getattr(self, name) is not None and payload[:2] == _NO_ERROR:
            return
        setattr(self, name, payload)

    def add_sensor_bytes(self, data: bytes, arrival_t_ns: int) -> None:
        """Append what one read of the port gave."""
        if not self.sensor_bytes:
            self.first_bytes_count = len(data)
            self.first_arrival_t_ns = arrival_t_ns
        self.sensor_bytes += data
        self.sensor_arrival_t_ns = arrival_t_ns

    def clear(self) -> None:
        """Forget the cycle before; when its last bytes came stays known."""
        self.sensor_bytes = b""
        self.first_bytes_count = 0
        self.macro_tpdo = self.micro_tpdo = None
        self.macro_inputs_tpdo = self.micro_inputs_tpdo = None
        self.macro_emcy = self.micro_emcy = None


def frame_names(mappings: Mapping[str, DriveMapping]) -> dict[int, str]:
    """Return the inbox slot of every CAN id that the servo listens to."""
    names: dict[int, str] = {}
    for axis, mapping in mappings.items():
        names[mapping.tpdo_id] = f"{axis}_tpdo"
        names[mapping.inputs_id] = f"{axis}_inputs_tpdo"
        names[mapping.emcy_id] = f"{axis}_emcy"
    return names


class WireDecoder:
    """Everything that turns an inbox into a measurement; `snapshot` and `restore` make replay start anywhere."""

    def __init__(self, profile: "Profile", mappings: Mapping[str, DriveMapping]):
        """Build framer, clock and scales from a profile (attributes named as in a profile file)."""
        sensor = profile.interferometer
        table = sensor.model_dump()
        self.framer = framer_for(table)
        self.mappings = dict(mappings)
        self.period_ns = 1e9 / sensor.rate_hz
        self.clock = sample_clock.init(self.period_ns, sensor.transport_s * 1e9)
        self._fresh_clock = self.clock.copy()
        self.restarts = 0
        self._air = profile.air.model_dump()
        self._counts_per_wavelength = counts_per_wavelength_of(table)
        self._air_number: int = 0  # of the device's own air that the target is made of; 0 = the profile's
        self._air_target = ciddor_index(**self._air)
        self.macro_m_per_count = self.end_m_per_count = math.nan
        self._use_index(self._air_target)
        self.macro_zero_counts = math.nan
        self.end_zero_counts = math.nan
        self.macro_counts = math.nan
        self.end_counts = math.nan
        self.sequence = -1
        self._earlier = (-1, math.nan, math.nan)  # the valid sample before the newest: number, counts
        self.cycle = -1
        self.reference_lost = 0
        self.reference_text = ""  # why it was lost, for people
        self.encoder_text = ""  # what shows that the drive's encoder lies, and not the laser; empty while nothing does
        self._laser_step_m = math.nan
        self._agreed = _NEVER_AGREED  # sample at which laser and encoder agreed last, and what each said
        self._encoder_jumped = False
        self._encoder_m = self._encoder_step_m = math.nan
        self._encoder_cycles = 0  # since it came last
        self._encoder_jump_sequence = -1  # sample at which it left its own way last
        self.encoder_jumps = 0  # how often
        self._position_mode = profile.macro.mode == "position"
        self.encoder_trusted = False  # only after a homing do laser and encoder share a zero
        self.samples_lost = 0
        self._taken_bytes_count = 0  # of the present inbox
        self._valid_count = 0  # samples in them
        self._compared_sequence = -2
        self._compared_m = 0.0
        self._disagreements = 0
        self._macro_moved = (math.nan, math.nan)  # counts of each axis when they last changed, and the encoder then
        self._end_moved = (math.nan, math.nan)
        self._macro_moved_sequence = self._end_moved_sequence = math.inf  # and the sample
        self._macro_repeats_limit = _repeats_limit(self.macro_m_per_count, sensor.noise_m)
        self._end_repeats_limit = _repeats_limit(self.end_m_per_count, sensor.noise_m)
        self._earliest_ns = _EARLIEST_SHARE * sensor.transport_s * 1e9
        self._jump_m = sensor.jump_limit_m
        self._disagreement_m = sensor.encoder_disagreement_m
        motor_gains_m = profile.macro.force_limit_n / profile.macro.mass_kg / profile.cycle.rate_hz**2
        self._gain_limit_m = max(0.5 * self._disagreement_m, _GAIN_MARGIN * motor_gains_m)
        self._incremental = sensor.incremental
        self._single = profile.micro is None
        self._axes: dict[str, tuple[Codec, int, int, int, float, float, str]] = {}
        for axis, settings in (("macro", profile.macro), ("micro", profile.micro)):
            if settings is not None and axis in self.mappings:
                codec = self.mappings[axis].tpdo
                self._axes[axis] = (
                    codec,
                    codec.slot("statusword"),
                    codec.slot("position"),
                    codec.slot("torque"),
                    settings.encoder_step_m or 0.0,
                    settings.rated_force_n * 1e-3,
                    f"{axis} (node {self.mappings[axis].node_id})",
                )

    def _use_index(self, index: float) -> None:
        """Scale counts with this index of air from here on."""
        self.air_index = index
        macro_counts, end_counts = self._counts_per_wavelength
        self.macro_m_per_count = metres_per_count(self._air["wavelength_vacuum_m"], index, macro_counts)
        self.end_m_per_count = metres_per_count(self._air["wavelength_vacuum_m"], index, end_counts)

    def _follow_air(self) -> None:
        """Take the air that the device measured, and bring the index towards it without a step of any position."""
        framer = self.framer
        if isinstance(framer, Umd2Framer) and framer.air_number != self._air_number:
            self._air_number = framer.air_number
            told = {name: value for name, value in framer.air.items() if not math.isnan(value)}
            with contextlib.suppress(RequestError):  # outside Ciddor's range it is no air of a stage: keep what was
                target = ciddor_index(**{**self._air, **told})
                if abs(target - self._air_target) > _INDEX_STEP:
                    self._air_target = target
        if self.air_index != self._air_target:
            macro_m = abs(self.macro_counts - self.macro_zero_counts) * self.macro_m_per_count
            end_m = abs(self.end_counts - self.end_zero_counts) * self.end_m_per_count
            self._use_index(ramped_index(self.air_index, self._air_target, max(macro_m, end_m)))

    def _take_reading(self, reading: Reading) -> bool:
        """Take one reading; returns whether it is a valid sample of both axes."""
        if reading.flags & REFERENCE_LOST:
            self._lose_reference(_loss_text(reading.flags, self._single))
        wanted = MACRO_VALID if self._single else BOTH_VALID
        if reading.flags & wanted != wanted:
            return False
        if self.sequence >= 0 and not reading.flags & RESTARTED:
            elapsed = reading.sequence - self.sequence
            if elapsed <= 0:
                return False
            self.samples_lost += elapsed - 1
            reach_m = self._jump_m * elapsed
            if self._incremental and not (
                abs(reading.macro_counts - self.macro_counts) * self.macro_m_per_count <= reach_m
                and (self._single or abs(reading.end_counts - self.end_counts) * self.end_m_per_count <= reach_m)
            ):
                self._lose_reference(self._jump_text(reading, reach_m))
        self._earlier = (self.sequence, self.macro_counts, self.end_counts)
        self.sequence = reading.sequence
        self.macro_counts = reading.macro_counts
        self.end_counts = reading.macro_counts if self._single else reading.end_counts
        if math.isnan(self.macro_zero_counts):  # until homed, positions count from the first sample
            self.macro_zero_counts = self.macro_counts
            self.end_zero_counts = self.end_counts
        return True

    def _renumbers(self, reading: Reading, arrival_t_ns: int) -> bool:
        """Tell whether the device began to count anew: back, or ahead so that a sample is here before its instant.

        Either latches *reference lost*: nobody knows what else it forgot.
        """
        if reading.flags & RESTARTED:
            return True
        if reading.sequence <= self.sequence + 1 or self.sequence < 0:
            return False
        early_ns = int(sample_clock.sample_t_ns(self.clock, reading.sequence)) - arrival_t_ns
        if self.clock["samples"][0] < _CLOCK_SAMPLES or early_ns <= 0.5 * self.period_ns:
            return False
        skipped = reading.sequence - self.sequence - 1
        self._lose_reference(
            f"the interferometer's numbers jumped ahead by {skipped}: sample {reading.sequence} came "
            f"{early_ns * 1e-6:.1f} ms before its instant"
        )
        return True

    def _lose_reference(self, text: str) -> None:
        """Latch it; the first cause stays."""
        if not self.reference_lost:
            self.reference_text = text
        self.reference_lost = 1

    def _jump_text(self, reading: Reading, reach_m: float) -> str:
        macro_m = abs(reading.macro_counts - self.macro_counts) * self.macro_m_per_count
        end_m = 0.0 if self._single else abs(reading.end_counts - self.end_counts) * self.end_m_per_count
        axis, jump_m = ("macro", macro_m) if macro_m > reach_m else ("end", end_m)
        return f"{axis} jumped by {jump_m * 1e3:.3g} mm between two samples, {reach_m * 1e3:.3g} mm are possible"

    def _take_frames(self, inbox: Inbox, seen: Any) -> None:
        """Decode process data, inputs and emergencies; LinkError on a short frame, nothing of it taken."""
        seen.tpdos_new = 0
        fresh = 0
        if inbox.macro_tpdo is not None and "macro" in self._axes:
            codec, status, position, torque, step_m, force_n, source = self._axes["macro"]
            values = _decoded(codec, inbox.macro_tpdo, source)
            seen.macro_statusword = values[status]
            seen.macro_encoder_m = values[position] * step_m
            seen.macro_reported_force_n = values[torque] * force_n
            fresh = 1
        if inbox.micro_tpdo is not None and "micro" in self._axes:
            codec, status, position, torque, step_m, force_n, source = self._axes["micro"]
            values = _decoded(codec, inbox.micro_tpdo, source)
            seen.micro_statusword = values[status]
            seen.micro_encoder_m = values[position] * step_m
            seen.micro_reported_force_n = values[torque] * force_n
            fresh |= 2
        if inbox.has_events:
            for axis in self._axes:
                self._take_events(axis, inbox, seen)
        seen.tpdos_new = fresh

    def _take_events(self, axis: str, inbox: Inbox, seen: Any) -> None:
        """Decode what a drive sends only when something happened: inputs, mode, emergencies."""
        mapping = self.mappings[axis]
        payload = getattr(inbox, f"{axis}_inputs_tpdo")
        if payload is not None:
            codec, source = mapping.inputs_tpdo, f"inputs of {axis} (node {mapping.node_id})"
            values = dict(zip(codec.names, _decoded(codec, payload, source), strict=True))
            setattr(seen, f"{axis}_digital_inputs", values["digital_inputs"])
            if "mode_display" in values:  # not every drive can map it there, and older runs have none
                setattr(seen, f"{axis}_mode_display", values["mode_display"])
                seen.modes_told |= MODE_TOLD[axis]
        payload = getattr(inbox, f"{axis}_emcy")
        if payload is not None:
            code = cia402.decode_emergency(payload)[0]
            powered = cia402.state_of(getattr(seen, f"{axis}_statusword")) in _POWERED
            if powered or code >> 8 not in _SILENCE_CODES:
                seen.emergency = mapping.node_id << 16 | code if code else 0

    def take_first_bytes(self, inbox: Inbox) -> None:
        """Decode what the first read of the cycle gave, where that was not taken yet.

        A servo calls it as soon as they are in, so that SYNC does not wait for that; `decode` takes the rest.
        When it is called changes nothing of what comes out.
        """
        first = inbox.first_bytes_count
        if self._taken_bytes_count == 0 < first:
            self._taken_bytes_count = first
            self._feed(inbox.sensor_bytes[:first], inbox.first_arrival_t_ns)

    def _take_bytes(self, inbox: Inbox) -> None:
        """Decode all that was not taken yet; what came with later reads has one arrival, that of the last."""
        self.take_first_bytes(inbox)
        if self._taken_bytes_count < len(inbox.sensor_bytes):
            rest = inbox.sensor_bytes[self._taken_bytes_count :]
            self._taken_bytes_count = len(inbox.sensor_bytes)
            self._feed(rest, inbox.sensor_arrival_t_ns)

    def _feed(self, data: bytes, arrival_t_ns: int) -> None:
        """Take the samples that bytes of one arrival complete."""
        for reading in self.framer.feed(data):
            if self._renumbers(reading, arrival_t_ns):
                self.clock[...] = self._fresh_clock
                self.cycle = -1
                self.restarts += 1
            sample_clock.step(self.clock, reading.sequence, arrival_t_ns)
            self._valid_count += self._take_reading(reading)

    def decode(self, inbox: Inbox, seen: Any) -> str:
        """Write what the inbox says into the fields of a MEASUREMENT; lease, overrun, lost commands are the caller's.

        `seen` has a plain number for each field (`stagectl.fields`). Returns what is wrong where a drive's frame can't
        be what was agreed, else an empty text.
        """
        text = ""
        last_cycle = self.cycle
        self._take_bytes(inbox)
        valid = self._valid_count
        self._taken_bytes_count = self._valid_count = 0
        try:
            self._take_frames(inbox, seen)
        except LinkError as error:
            text = str(error)
        self._encoder_cycles += 1
        if seen.tpdos_new & 1:
            self._follow_encoder(seen.macro_encoder_m)
        seen.t_ns = inbox.t_ns
        seen.samples_new = valid
        seen.sequence = self.sequence
        seen.earlier_sequence = -1
        seen.latched_after_s = 0.0
        if self.sequence >= 0:
            seen.sample_t_ns, age_ns = sample_clock.sample_at(self.clock, self.sequence, inbox.t_ns)
            due = self.sequence + math.floor((age_ns - self._earliest_ns) / self.period_ns)
            self.cycle = max(due, self.cycle + 1 if valid and self.cycle < 0 else self.cycle, self.sequence)
            if last_cycle >= 0 and inbox.sync_t_ns:
                sample_t_ns = seen.sample_t_ns - (self.sequence - last_cycle) * self.period_ns
                seen.latched_after_s = 1e-9 * (inbox.sync_t_ns - sample_t_ns)
            self._follow_air()
            seen.macro_position_m = (self.macro_counts - self.macro_zero_counts) * self.macro_m_per_count
            seen.end_position_m = (self.end_counts - self.end_zero_counts) * self.end_m_per_count
            if valid > 1:
                seen.earlier_sequence, macro_counts, end_counts = self._earlier
                seen.macro_earlier_m = (macro_counts - self.macro_zero_counts) * self.macro_m_per_count
                seen.end_earlier_m = (end_counts - self.end_zero_counts) * self.end_m_per_count
            if valid and self.encoder_trusted and seen.tpdos_new & 1:
                self._look_for_stuck_counts(seen.macro_encoder_m)
            if valid and self.sequence == self.cycle:  # behind a late line the drive's position is of a later SYNC
                self._compare_with_encoder(seen, inbox.sync_t_ns)
        seen.cycle = self.cycle
        seen.reference_lost = self.reference_lost
        return text

    def _follow_encoder(self, encoder_m: float) -> None:
        """Note where the encoder leaves its own way by more than the motor can in a cycle: it jumped."""
        step_m = (encoder_m - self._encoder_m) / self._encoder_cycles
        if abs(step_m - self._encoder_step_m) > self._gain_limit_m:
            self._encoder_jump_sequence = self.sequence
            self.encoder_jumps += 1
        self._encoder_m, self._encoder_step_m, self._encoder_cycles = encoder_m, step_m, 0

    def _look_for_stuck_counts(self, encoder_m: float) -> None:
        """Latch *reference lost* where an axis repeats its counts, to the last bit, more often than its noise can.

        Or while the drive moves: with counts coarser than the noise nothing else tells. An encoder that jumped since
        they changed says nothing of that: one that came back while a sample repeated another by chance ended a stop
        by the lasers, and the drive ramped down from the speed of that jump, over 130 mm.
        """
        if self.macro_counts != self._macro_moved[0]:
            self._macro_moved, self._macro_moved_sequence = (self.macro_counts, encoder_m), self.sequence
        if self.end_counts != self._end_moved[0]:
            self._end_moved, self._end_moved_sequence = (self.end_counts, encoder_m), self.sequence
        for axis, moved_m, since, limit in (
            ("macro", self._macro_moved[1], self._macro_moved_sequence, self._macro_repeats_limit),
            ("end", self._end_moved[1], self._end_moved_sequence, self._end_repeats_limit),
        ):
            repeats = self.sequence - since
            if self._encoder_jump_sequence <= since and not abs(encoder_m - moved_m) <= self._disagreement_m:
                away_um = abs(encoder_m - moved_m) * 1e6
                self._lose_reference(
                    f"{axis} counts are stuck: the drive's encoder moved {away_um:.0f} um meanwhile, "
                    f"limit {self._disagreement_m * 1e6:.0f} um"
                )
                break
            if not repeats <= limit:
                self._lose_reference(
                    f"{axis} counts are stuck: {repeats} samples after it repeat one to the last bit, limit {limit}; "
                    "look at the counter, or state interferometer.noise_m as it is measured at rest"
                )
                break

    def _compare_with_encoder(self, seen: Any, sync_t_ns: int) -> None:
        """Notice where laser and drive disagree for several cycles, both at the last SYNC's instant.

        It is told as `encoder_text` where the encoder jumped while the laser went on as before, and the drive does not
        position by it: then the lasers are what a stop can go by. Else it latches *reference lost*.
        The drive sampled its encoder between the last two laser samples: at 0.2 m/s that is 90 um away. How long the
        host held the SYNC up is not known to better than a period, so one period's way is allowed besides: an offset
        stays when the stage stands, and is found then.
        """
        macro_m = seen.macro_position_m
        if self.encoder_trusted and self.sequence == self._compared_sequence + 1 and seen.tpdos_new & 1:
            since_ns = seen.sample_t_ns - sync_t_ns
            laser_m = macro_m - (macro_m - self._compared_m) * (since_ns / self.period_ns)
            allowed_m = self._disagreement_m + abs(macro_m - self._compared_m)
            if abs(laser_m - seen.macro_encoder_m) <= allowed_m:
                self._disagreements = 0
                self._agreed = (self.sequence, macro_m, seen.macro_encoder_m)
            else:
                if self._disagreements == 0:
                    # Late lines may lie between, and the jump before the first that could be compared again.
                    sequence, agreed_m, agreed_encoder_m = self._agreed
                    way_m = (self.sequence - sequence) * self._laser_step_m
                    laser_bends_m = abs(macro_m - agreed_m - way_m)
                    encoder_bends_m = abs(seen.macro_encoder_m - agreed_encoder_m - way_m)
                    bends_more = encoder_bends_m > laser_bends_m + 0.5 * self._disagreement_m
                    self._encoder_jumped = bends_more and not self._position_mode
                self._disagreements += 1
                told = self.encoder_text != "" or self.reference_lost != 0  # the first cause stays
                if self._disagreements >= _DISAGREEMENTS_IN_A_ROW and not told:
                    away_um = abs(laser_m - seen.macro_encoder_m) * 1e6
                    text = f"differ by {away_um:.0f} um, limit {allowed_m * 1e6:.0f} um"
                    if self._encoder_jumped:
                        self.encoder_text = f"macro laser and the drive's encoder, which jumped, {text}"
                    else:
                        self._lose_reference(f"macro laser and the drive's encoder {text}")
            self._laser_step_m = macro_m - self._compared_m
        self._compared_sequence = self.sequence
        self._compared_m = macro_m

    def set_zeros(self, macro_zero_counts: float, end_zero_counts: float) -> tuple[float, float]:
        """Take new laser zeros (a homing); returns by how much all macro and end positions moved, in m."""
        macro_shift_m = (self.macro_zero_counts - macro_zero_counts) * self.macro_m_per_count
        end_shift_m = (self.end_zero_counts - end_zero_counts) * self.end_m_per_count
        self.macro_zero_counts = macro_zero_counts
        self.end_zero_counts = end_zero_counts
        self.reference_lost = 0
        self.reference_text = self.encoder_text = ""
        self.encoder_trusted = True
        self._laser_step_m, self._agreed = math.nan, _NEVER_AGREED
        self._macro_moved = self._end_moved = (math.nan, math.nan)
        self._macro_moved_sequence = self._end_moved_sequence = math.inf
        self._compared_sequence = -2
        self._disagreements = 0
        return macro_shift_m, end_shift_m

    def next_start_t_ns(self, phase_ns: float) -> int:
        """Return when the next cycle should start: its sample's instant plus the phase; 0 before the first sample."""
        if self.sequence < 0:
            return 0
        return int(sample_clock.sample_t_ns(self.clock, self.cycle + 1)) + int(phase_ns)

    _PLAIN = (
        "macro_zero_counts",
        "end_zero_counts",
        "macro_counts",
        "end_counts",
        "sequence",
        "cycle",
        "reference_lost",
        "encoder_trusted",
        "samples_lost",
        "_compared_sequence",
        "_compared_m",
        "_laser_step_m",
        "_agreed",
        "_encoder_jumped",
        "_encoder_m",
        "_encoder_step_m",
        "_encoder_cycles",
        "_encoder_jump_sequence",
        "encoder_jumps",
        "_disagreements",
        "_macro_moved",
        "_end_moved",
        "_macro_moved_sequence",
        "_end_moved_sequence",
        "air_index",
        "_air_number",
        "_air_target",
    )

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copy all memory as arrays for a run's snapshot."""
        values = {name: getattr(self, name) for name in self._PLAIN}
        return {
            "decoder_values": np.frombuffer(json.dumps(values).encode(), np.uint8).copy(),
            "decoder_framer": np.frombuffer(self.framer.snapshot(), np.uint8).copy(),
            "decoder_clock": self.clock.copy(),
        }

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Go on from where `snapshot` was taken."""
        for name, value in json.loads(bytes(snapshot["decoder_values"])).items():
            setattr(self, name, value)
        self._use_index(self.air_index)
        self.framer.restore(bytes(snapshot["decoder_framer"]))
        self.clock[...] = snapshot["decoder_clock"]


def _decoded(codec: Codec, payload: bytes, source: str) -> tuple[int, ...]:
    """Decode a PDO; LinkError says whose."""
    try:
        return codec.decode(payload)
    except LinkError as error:
        raise LinkError(f"{source}: {error}") from error


def _repeats_limit(step_m: float, noise_m: float) -> float:
    """Return how many samples in a row may be equal, a count being `step_m` wide; inf where all of them may.

    Two samples fall on one count with a probability of step / (2 sqrt(pi) noise) where the step is the smaller.
    """
    share = step_m / (2.0 * math.sqrt(math.pi) * noise_m)
    if not share < _MOST_REPEATED_SHARE:
        return math.inf
    return max(_LEAST_REPEATS, math.ceil(math.log(_REPEATS_PROBABILITY) / math.log(share)))


def _loss_text(flags: int, single: bool) -> str:
    """Say what a reading's flags mean for the reference."""
    if flags & RESTARTED:
        return "the interferometer restarted: its numbers went back"
    dark = [name for name, bit in (("macro", MACRO_VALID), ("end", END_VALID)) if not flags & bit]
    if single and "end" in dark:
        dark.remove("end")
    return f"no beam on {' and '.join(dark)}" if dark else "the interferometer says that a counter was reset"


class WireEncoder:
    """A command and two controlwords to the frames of a cycle: micro first, then macro; SYNC is the caller's."""

    def __init__(self, profile: "Profile", mappings: Mapping[str, DriveMapping]):
        """Take the RPDO codecs as read back from the drives."""
        self._position_mode = profile.macro.mode == "position"
        self._encoder_step_m = profile.macro.encoder_step_m
        self._macro = mappings["macro"]
        self._micro = mappings.get("micro")

    def micro(self, controlword: int, word: int) -> tuple[int, bytes] | None:
        """Return the micro's frame, None without a micro."""
        if self._micro is None:
            return None
        return self._micro.rpdo_id, self._micro.rpdo.encode(controlword, word)

    def macro(self, controlword: int, word: int, target_m: float) -> tuple[int, bytes]:
        """Return the macro's frame: target torque, or position target and torque offset."""
        if self._position_mode:
            target = math.floor(target_m / self._encoder_step_m + 0.5)
            return self._macro.rpdo_id, self._macro.rpdo.encode(controlword, target, word)
        return self._macro.rpdo_id, self._macro.rpdo.encode(controlword, word)
