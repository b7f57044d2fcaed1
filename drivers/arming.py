"""What a drive must be told, and must confirm, before it may move a stage.

Every object is written and read back; what differs refuses to arm. The codecs come from the mapping
that was read back, never from the one that was asked for. Knows no bus: it speaks through a master.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from drivers import cia402
from drivers.pdo import Codec
from stagectl.errors import DriveError, ProfileError
from stagectl.signals import MODES

if TYPE_CHECKING:
    from drivers.canopen_master import Master  # the servo unpickles a DriveMapping and must not load canopen

SYNC_ID = 0x080
RPDO1_ID = 0x200
TPDO1_ID = 0x180
TPDO2_ID = 0x280
EMERGENCY_ID = 0x080

PDO_INVALID = 1 << 31
_COB_ID_CARE = 0xBFFF_FFFF  # bit 30 (no remote request) is often fixed by the drive and harms nobody
_ID_MASK = 0x7FF

TRANSMISSION_EVERY_SYNC = 1
TRANSMISSION_ON_EVENT = 255
HEARTBEATS_PER_TIMEOUT = 4  # a producer sends this many in the time after which it is missed

_CIA402_PROFILE_NUMBER = 402
_MAPPING_TORQUE = (0x6040_00_10, 0x6071_00_10)
_MAPPING_POSITION = (0x6040_00_10, 0x607A_00_20, 0x60B2_00_10)
_MAPPING_ACTUAL = (0x6041_00_10, 0x6064_00_20, 0x6077_00_10)
_MAPPING_INPUTS = (0x60FD_00_20,)
_MAPPING_INPUTS_AND_MODE = (*_MAPPING_INPUTS, 0x6061_00_08)

_NEEDED = (
    (cia402.DEVICE_TYPE, (0,)),
    (cia402.COB_ID_SYNC, (0,)),
    (cia402.COB_ID_EMCY, (0,)),
    (cia402.CONSUMER_HEARTBEAT_TIME, (1,)),
    (cia402.PRODUCER_HEARTBEAT_TIME, (0,)),
    (cia402.IDENTITY, (0,)),
    (cia402.RPDO_COMMUNICATION, (1, 2)),
    (cia402.TPDO_COMMUNICATION, (1, 2)),
    (cia402.TPDO_COMMUNICATION + 1, (1, 2, 3)),
    (cia402.TPDO_MAPPING, (0, 1, 2, 3)),
    (cia402.TPDO_MAPPING + 1, (0, 1)),
    (cia402.ABORT_CONNECTION_OPTION_CODE, (0,)),
    (cia402.CONTROLWORD, (0,)),
    (cia402.STATUSWORD, (0,)),
    (cia402.QUICK_STOP_OPTION_CODE, (0,)),
    (cia402.MODES_OF_OPERATION, (0,)),
    (cia402.MODES_OF_OPERATION_DISPLAY, (0,)),
    (cia402.MAX_TORQUE, (0,)),
    (cia402.MOTOR_RATED_TORQUE, (0,)),
    (cia402.QUICK_STOP_DECELERATION, (0,)),
    (cia402.INTERPOLATION_TIME_PERIOD, (1, 2)),
)
_NEEDED_TO_HOME = (
    (cia402.HOMING_METHOD, (0,)),
    (cia402.HOMING_SPEEDS, (1, 2)),
    (cia402.HOMING_ACCELERATION, (0,)),
)

_ENERGISED = (cia402.State.OPERATION_ENABLED, cia402.State.QUICK_STOP_ACTIVE, cia402.State.FAULT_REACTION_ACTIVE)
_IDENTITY_NAMES = ("vendor id", "product code", "revision number", "serial number")  # 0x1018:01 .. :04
_REST_M_PER_S = 1e-3  # slower than this is standstill
_REST_WINDOW_S = 0.1  # between two looks at the encoder: 100 um at that speed, a thousand counts of 100 nm
_LEAVE_TIMEOUT_S = 0.5  # for Disable voltage
_LEAVE_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class StaleTorque:
    """How far a torque that nobody renews may push a drive that has no RPDO deadline, SI.

    Until the drive misses the heartbeat, t after the last command, it keeps up the last torque: from rest that moves
    the axes against each other by F t^2 / (2 m). The joint, spring and damping only make it less.
    """

    mass_kg: float  # m: what F accelerates as seen from the other axis
    way_m: float  # that it may use up
    needed_n: float  # the least limit with which the profile's motion can be done


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """What one drive must be and do; names ending in _word are in the drive's own units."""

    node_id: int
    eds_path: str
    identity: tuple[int | None, ...]  # 0x1018:01 .. :04, vendor first; None, and what is left out, may be anything
    mode: Literal["torque", "position"]  # CST, or CSP with torque offset
    rated_torque_word: int  # 0x6076, 1e-3 N
    max_torque_word: int  # 0x6072, 0.1 % of rated
    quick_stop_deceleration_word: int  # 0x6085, counts/s^2
    quick_stop_option: int  # 0x605A
    heartbeat_ms: int  # the servo's heartbeat is missed after this; the drive sends its own four times as often
    servo_node_id: int = 0x7E
    rpdo_deadline_ms: int = 10  # 0x1400:05
    stale_torque: StaleTorque | None = (
        None  # caps the torque of a drive without 0x1400:05; None = such a one is refused
    )
    cycle_us: int = 1000
    inputs_inhibit_us: int = 2000  # TPDO2 at most this often: a bouncing switch must not fill the bus, nor a trip wait
    rated_current_word: int | None = None  # 0x6075, mA; None = not compared
    encoder_step_m: float | None = None  # None = not compared, or no encoder


@dataclass(frozen=True, slots=True)
class RatedValues:
    """Ratings as the drive states them; None where it has no such object."""

    torque_word: int  # 0x6076, 1e-3 N
    current_word: int | None  # 0x6075, mA
    encoder_step_m: float | None  # 0x608F


@dataclass(frozen=True, slots=True)
class DriveMapping:
    """Process data of one armed drive, as read back; picklable."""

    node_id: int
    rpdo: Codec
    tpdo: Codec
    inputs_tpdo: Codec
    rpdo_id: int
    tpdo_id: int
    inputs_id: int
    emcy_id: int


def configure(
    master: "Master", drives: list[DriveSettings], remark: Callable[[str], None] = lambda text: None
) -> list[DriveMapping]:
    """Check and configure all drives, leave them in NMT pre-operational, return what was read back.

    Nothing is written before every drive has shown the right identity and stands without power, or held by a quick
    stop that a former run left: that one is ended first. `remark` is called with what the operator should know.
    DriveError names object, wrote, read and remedy; LinkError where a drive is silent.
    """
    _check_settings(drives)
    for drive in drives:
        master.add_node(drive.node_id, drive.eds_path)
        _check_identity(master, drive)
    held: list[DriveSettings] = []
    for drive in drives:
        _check_mode_supported(master, drive)
        rated = _check_ratings(master, drive)
        if _is_held(master, drive, rated.encoder_step_m or drive.encoder_step_m):
            held.append(drive)
    for drive in held:
        remark(_end_quick_stop(master, drive))
    mappings: list[DriveMapping] = []
    for drive in drives:
        # The mapping may only be changed here (CiA 301), and cyclic frames would overtake the answers.
        master.nmt(drive.node_id, "pre-operational")
        mappings.append(_configure_drive(master, drive, remark))
    return mappings


def needed_objects(mode: Literal["torque", "position"], homes: bool) -> list[tuple[int, int]]:
    """Return (index, subindex) of every object without which `configure`, or the drive's homing, can't be done."""
    mapped = _MAPPING_TORQUE if mode == "torque" else _MAPPING_POSITION
    rpdo = (cia402.RPDO_MAPPING, tuple(range(len(mapped) + 1)))
    tables = (*_NEEDED, rpdo, *(_NEEDED_TO_HOME if homes else ()))
    return [(index, subindex) for index, subindices in tables for subindex in subindices]


def read_rated_values(master: "Master", node_id: int) -> RatedValues:
    """Read the ratings of a drive that the master knows."""
    current_word = None
    if master.has(node_id, cia402.MOTOR_RATED_CURRENT):
        current_word = master.read(node_id, cia402.MOTOR_RATED_CURRENT, 0)
    encoder_step_m = None
    if master.has(node_id, cia402.POSITION_ENCODER_RESOLUTION, 2):
        increments = master.read(node_id, cia402.POSITION_ENCODER_RESOLUTION, 1)
        metres = master.read(node_id, cia402.POSITION_ENCODER_RESOLUTION, 2)
        if increments > 0 and metres > 0:
            encoder_step_m = metres / increments
    return RatedValues(master.read(node_id, cia402.MOTOR_RATED_TORQUE, 0), current_word, encoder_step_m)


def interpolation_words(cycle_us: int) -> tuple[int, int]:
    """Return (value, index) of 0x60C2 with value x 10^index s = the cycle; ProfileError where none is exact."""
    for index in (-3, -4, -5, -6):
        unit_us = 10 ** (6 + index)
        if cycle_us > 0 and cycle_us % unit_us == 0 and cycle_us // unit_us <= 255:
            return cycle_us // unit_us, index
    raise ProfileError(
        f"cycle of {cycle_us} us can't be written to 0x60C2 as a value of 1 .. 255 times a power of ten; "
        "choose a rate_hz such as 1000, 500 or 250"
    )


def heartbeat_producer_ms(heartbeat_ms: int) -> int:
    """Return the period at which a heartbeat is sent that is missed after `heartbeat_ms`."""
    return max(1, heartbeat_ms // HEARTBEATS_PER_TIMEOUT)


def _check_settings(drives: list[DriveSettings]) -> None:
    cycles_us = {drive.cycle_us for drive in drives}
    if len(cycles_us) > 1:
        raise ProfileError(f"drives on one SYNC have cycles of {sorted(cycles_us)} us; give them the same")
    node_ids = [drive.node_id for drive in drives]
    for drive in drives:
        if node_ids.count(drive.node_id) > 1 or drive.node_id == drive.servo_node_id:
            raise ProfileError(f"node id {drive.node_id} is used twice on the bus; give each node its own")
        if not 1 <= drive.heartbeat_ms <= 0xFFFF:
            raise ProfileError(f"node {drive.node_id}: heartbeat of {drive.heartbeat_ms} ms is outside 1 .. 65535")
        if not 1 <= drive.rpdo_deadline_ms <= 0xFFFF:
            raise ProfileError(f"node {drive.node_id}: RPDO deadline {drive.rpdo_deadline_ms} ms is outside 1 .. 65535")
        if drive.mode not in MODES:
            raise ProfileError(f"node {drive.node_id}: mode = {drive.mode!r} is not one of {', '.join(MODES)}")


def _check_identity(master: "Master", drive: DriveSettings) -> None:
    shown = master.identity(drive.node_id)
    for subindex, (name, wanted, read) in enumerate(zip(_IDENTITY_NAMES, drive.identity, shown, strict=False), 1):
        if wanted is not None and read != wanted:
            said = "nothing" if read is None else f"0x{read:X}"
            raise DriveError(
                f"node {drive.node_id}: 0x1018:{subindex:02X} {name}: wanted 0x{wanted:X}, read {said}; "
                f"{_IDENTITY_REMEDIES[name]}"
            )
    device_type = master.read(drive.node_id, cia402.DEVICE_TYPE, 0)
    if device_type & 0xFFFF != _CIA402_PROFILE_NUMBER:
        raise DriveError(
            f"node {drive.node_id}: 0x1000:00 device type: wanted profile {_CIA402_PROFILE_NUMBER}, "
            f"read {device_type & 0xFFFF}; this node is no CiA 402 drive: correct node_id"
        )


_IDENTITY_REMEDIES = {
    "vendor id": "the opened backend and the drives on this bus don't belong together: correct --backend or identity",
    "product code": "swap the node ids or correct identity in the profile",
    "revision number": "load the firmware that the profile was made for, or correct identity.revision_number",
    "serial number": "this is another unit of that drive: check its parameters, then correct identity.serial_number",
}


def _is_held(master: "Master", drive: DriveSettings, step_m: float | None) -> bool:
    """Return whether a quick stop holds the drive still; DriveError where it has power otherwise, or still moves."""
    state = cia402.state_of(master.read(drive.node_id, cia402.STATUSWORD, 0))
    if state not in _ENERGISED:
        return False
    place = f"node {drive.node_id}: 0x6041:00 shows {state.name}, wanted a drive without power; "
    if state is not cia402.State.QUICK_STOP_ACTIVE:
        raise DriveError(place + "another master drives it, or a run ended badly: disable it first")
    if step_m is None:
        raise DriveError(place + "no encoder tells whether it stands: switch its power off and on")
    # Without power the axis coasts: a ramp that is still under way must come to its end first.
    before = master.read(drive.node_id, cia402.POSITION_ACTUAL_VALUE, 0)
    master.pause(_REST_WINDOW_S)
    after = master.read(drive.node_id, cia402.POSITION_ACTUAL_VALUE, 0)
    speed_m_per_s = abs(after - before) * step_m / _REST_WINDOW_S
    if not speed_m_per_s <= _REST_M_PER_S:
        raise DriveError(
            f"{place}it moves at {speed_m_per_s:.4g} m/s by its encoder, and its quick stop is ended below "
            f"{_REST_M_PER_S:g} m/s only: wait until it stands, then arm again"
        )
    return True


def _end_quick_stop(master: "Master", drive: DriveSettings) -> str:
    """Disable voltage (CiA 402 transition 12); returns what the operator should know."""
    master.write(drive.node_id, cia402.CONTROLWORD, 0, cia402.DISABLE_VOLTAGE)
    for _ in range(round(_LEAVE_TIMEOUT_S / _LEAVE_STEP_S)):
        state = cia402.state_of(master.read(drive.node_id, cia402.STATUSWORD, 0))
        if state not in _ENERGISED:
            return (
                f"node {drive.node_id} stood in QUICK_STOP_ACTIVE, as a run that was killed leaves it; its power was "
                f"taken away (0x6040 = 0), it shows {state.name}"
            )
        master.pause(_LEAVE_STEP_S)
    raise DriveError(
        f"node {drive.node_id}: 0x6041:00 shows {state.name} {_LEAVE_TIMEOUT_S:g} s after 0x6040 = 0, wanted "
        "SWITCH_ON_DISABLED; switch its power off and on"
    )


def _check_mode_supported(master: "Master", drive: DriveSettings) -> None:
    if not master.has(drive.node_id, cia402.SUPPORTED_DRIVE_MODES):
        return
    supported = master.read(drive.node_id, cia402.SUPPORTED_DRIVE_MODES, 0)
    mode = MODES[drive.mode]
    if not supported >> mode - 1 & 1:
        raise DriveError(
            f"node {drive.node_id}: 0x6502:00 supported modes: wanted bit {mode - 1} ({drive.mode}), "
            f"read 0x{supported:X}; choose another mode in the profile or another drive"
        )


def _check_ratings(master: "Master", drive: DriveSettings) -> RatedValues:
    rated = read_rated_values(master, drive.node_id)
    if rated.torque_word != drive.rated_torque_word:
        raise DriveError(
            f"node {drive.node_id}: 0x6076:00 rated torque: wanted {drive.rated_torque_word} mN, "
            f"read {rated.torque_word} mN; forces would be wrong by the ratio: correct rated_force_n or the drive"
        )
    if None not in (drive.rated_current_word, rated.current_word) and rated.current_word != drive.rated_current_word:
        raise DriveError(
            f"node {drive.node_id}: 0x6075:00 rated current: wanted {drive.rated_current_word} mA, "
            f"read {rated.current_word} mA; correct rated_current_a or the drive"
        )
    if drive.encoder_step_m is not None and rated.encoder_step_m is not None:
        difference_ratio = abs(rated.encoder_step_m / drive.encoder_step_m - 1.0)
        if not difference_ratio <= 1e-6:
            raise DriveError(
                f"node {drive.node_id}: 0x608F encoder resolution: wanted {drive.encoder_step_m:g} m a count, "
                f"read {rated.encoder_step_m:g} m; correct encoder_step_m or the drive"
            )
    return rated


def _configure_drive(master: "Master", drive: DriveSettings, remark: Callable[[str], None]) -> DriveMapping:
    """Write and read back everything; the limits first, so that no half-armed drive is stronger than it may be."""
    node_id = drive.node_id
    store = _Store(master, node_id)
    period_value, period_index = interpolation_words(drive.cycle_us)
    consumer_word = drive.servo_node_id << 16 | drive.heartbeat_ms
    producer_ms = heartbeat_producer_ms(drive.heartbeat_ms)

    remedy = "lower force_limit_n or raise the drive's own limit"
    store(cia402.MAX_TORQUE, 0, drive.max_torque_word, "max torque", remedy)
    remedy = "choose a stop that this drive has, or correct its EDS"
    store(cia402.QUICK_STOP_OPTION_CODE, 0, drive.quick_stop_option, "quick stop option code", remedy)
    remedy = "correct stop_deceleration_m_per_s2 or the drive's own limit"
    store(cia402.QUICK_STOP_DECELERATION, 0, drive.quick_stop_deceleration_word, "quick stop deceleration", remedy)
    remedy = "without it a dead servo is not noticed: use a drive or firmware that stores it"
    quick_stop = cia402.ABORT_CONNECTION_QUICK_STOP
    store(cia402.ABORT_CONNECTION_OPTION_CODE, 0, quick_stop, "abort connection option code", remedy)
    store(cia402.CONSUMER_HEARTBEAT_TIME, 1, consumer_word, "consumer heartbeat time", remedy)
    store(cia402.PRODUCER_HEARTBEAT_TIME, 0, producer_ms, "producer heartbeat time", "lengthen trip.heartbeat_s")
    remedy = "the servo alone produces SYNC: correct the drive's configuration"
    store(cia402.COB_ID_SYNC, 0, SYNC_ID, "COB-ID SYNC", remedy)
    remedy = "choose a cycle.rate_hz that this drive can follow"
    if master.has(node_id, cia402.COMMUNICATION_CYCLE_PERIOD):
        store(cia402.COMMUNICATION_CYCLE_PERIOD, 0, drive.cycle_us, "communication cycle period", remedy)
    store(cia402.INTERPOLATION_TIME_PERIOD, 1, period_value, "interpolation time period value", remedy)
    store(cia402.INTERPOLATION_TIME_PERIOD, 2, period_index, "interpolation time index", remedy)
    store(cia402.COB_ID_EMCY, 0, EMERGENCY_ID + node_id, "COB-ID EMCY", "correct the drive's COB-ID")
    remedy = "choose another mode in the profile, or another drive"
    store(cia402.MODES_OF_OPERATION, 0, MODES[drive.mode], "mode of operation", remedy)

    _silence_other_pdos(master, store)
    _watch_the_servo(store, drive, remark)
    rpdo, rpdo_id = _map_pdo(
        store,
        cia402.RPDO_COMMUNICATION,
        RPDO1_ID + node_id,
        _MAPPING_TORQUE if drive.mode == "torque" else _MAPPING_POSITION,
        TRANSMISSION_EVERY_SYNC,
    )
    tpdo, tpdo_id = _map_pdo(
        store, cia402.TPDO_COMMUNICATION, TPDO1_ID + node_id, _MAPPING_ACTUAL, TRANSMISSION_EVERY_SYNC
    )
    inputs, inputs_id = _map_events(store, drive, remark)
    emcy_id = master.read(node_id, cia402.COB_ID_EMCY, 0) & _ID_MASK
    return DriveMapping(node_id, rpdo, tpdo, inputs, rpdo_id, tpdo_id, inputs_id, emcy_id)


def detection_time_s(drive: DriveSettings) -> float:
    """Return the longest that a drive without RPDO deadline keeps up the last torque of a dead servo.

    The heartbeat is missed 0x1016 after the last one, which is at most a cycle older than the last command. A SYNC
    that fails to come is not counted on: no object says after how many periods a drive reacts.
    """
    return 1e-3 * drive.heartbeat_ms + 1e-6 * drive.cycle_us


def torque_cap_n(stale: StaleTorque, detection_s: float) -> float:
    """Return the force that uses up `way_m` within the detection time: 2 m s / t^2."""
    return 2.0 * stale.mass_kg * stale.way_m / (detection_s * detection_s)


def _watch_the_servo(store: "_Store", drive: DriveSettings, remark: Callable[[str], None]) -> None:
    """Set the RPDO deadline; where the drive has none, cap its torque for the time until it misses the heartbeat."""
    stale, detection_s = drive.stale_torque, detection_time_s(drive)
    _invalidate(store, cia402.RPDO_COMMUNICATION)
    remedy = "without it the last torque of a dead servo stays until the heartbeat is missed, and nothing here bounds "
    remedy += 'how far that pushes: use macro.mode = "position", or a drive or firmware that has it'
    try:
        store(cia402.RPDO_COMMUNICATION, 5, drive.rpdo_deadline_ms, "event timer", remedy)
        return
    except DriveError as error:
        if drive.mode == "torque" and stale is None:
            raise
        lacking = f"node {drive.node_id} has no RPDO deadline (0x1400:05)"
        until = f"a dead servo is noticed by its heartbeat after {detection_s * 1e3:g} ms"
        if drive.mode == "position" or stale is None:
            remark(f"{lacking}: {until}, and the drive holds its last target until then")
            return
        rated_n = 1e-3 * drive.rated_torque_word
        cap_n = torque_cap_n(stale, detection_s)
        word = math.floor(1e3 * cap_n / rated_n)
        physics = f"2 x {stale.mass_kg:.4g} kg x {stale.way_m * 1e3:.3g} mm / ({detection_s * 1e3:g} ms)^2"
        if word >= drive.max_torque_word:
            remark(f"{lacking}: {until}, in which {cap_n:.4g} N do no harm ({physics}): its torque stays as it was")
            return
        if not 1e-3 * word * rated_n >= stale.needed_n:
            longest_s = math.sqrt(2.0 * stale.mass_kg * stale.way_m / stale.needed_n) - 1e-6 * drive.cycle_us
            longest_ms = math.floor(1e3 * longest_s)  # 0x1016 counts them
            shorten = f"shorten trip.heartbeat_s to {1e-3 * longest_ms:g} s, " if longest_ms >= 1 else ""
            raise DriveError(
                f"{lacking}: {until}, so its torque may be {cap_n:.3g} N at most ({physics}), and the profile's motion "
                f"takes {stale.needed_n:.3g} N; {shorten}lower macro.acceleration_limit_m_per_s2 and "
                f"macro.stop_deceleration_m_per_s2 to fit, or use a drive that has it ({error})"
            ) from error
        remedy = "the drive must take a lower limit where it has no RPDO deadline: use another firmware or drive"
        store(cia402.MAX_TORQUE, 0, word, "max torque", remedy)
        remark(
            f"{lacking}: {until}, so max torque (0x6072) is {1e-3 * word * rated_n:.4g} N instead of "
            f"{1e-3 * drive.max_torque_word * rated_n:.4g} N ({physics})"
        )


def _map_events(store: "_Store", drive: DriveSettings, remark: Callable[[str], None]) -> tuple[Codec, int]:
    """Map what the drive tells when it changes: inputs and mode of operation, the inputs alone where it can't."""

    def mapped(words: tuple[int, ...]) -> tuple[Codec, int]:
        communication, can_id = cia402.TPDO_COMMUNICATION + 1, TPDO2_ID + drive.node_id
        inhibit_100us = drive.inputs_inhibit_us // 100
        return _map_pdo(store, communication, can_id, words, TRANSMISSION_ON_EVENT, inhibit_100us)

    try:
        return mapped(_MAPPING_INPUTS_AND_MODE)
    except DriveError as refusal:
        found = mapped(_MAPPING_INPUTS)
        remark(
            f"node {drive.node_id} can't tell its mode of operation (0x6061) behind its inputs (0x60FD): another "
            f"master that changes it is noticed by what the drive does then, not before ({refusal})"
        )
        return found


class _Store:
    """Writes an object of one drive and demands it back."""

    def __init__(self, master: "Master", node_id: int):
        self.master = master
        self.node_id = node_id

    def __call__(self, index: int, subindex: int, value: int, name: str, remedy: str, care: int = -1) -> None:
        """Write and read back; only bits in `care` are compared."""
        self.put(index, subindex, value, name, remedy)
        self.demand(index, subindex, value, name, remedy, care)

    def put(self, index: int, subindex: int, value: int, name: str, remedy: str) -> None:
        """Write; a refusal raises DriveError that also tells what the object holds."""
        try:
            self.master.write(self.node_id, index, subindex, value)
        except DriveError as refusal:
            try:
                held = _shown(self.master.read(self.node_id, index, subindex))
            except DriveError:
                held = "nothing"
            text = self._text(index, subindex, name, value, held, remedy)
            raise DriveError(f"{text} ({refusal})") from refusal

    def demand(self, index: int, subindex: int, value: int, name: str, remedy: str, care: int = -1) -> None:
        """Read and compare with what was written."""
        held = self.master.read(self.node_id, index, subindex)
        if (held ^ value) & care:
            raise DriveError(self._text(index, subindex, name, value, _shown(held), remedy))

    def _text(self, index: int, subindex: int, name: str, wrote: int, held: str, remedy: str) -> str:
        place = f"node {self.node_id}: 0x{index:04X}:{subindex:02X} {name}"
        return f"{place}: wrote {_shown(wrote)}, read {held}; {remedy}"


def _shown(value: int) -> str:
    return f"{value} (0x{value:X})" if value > 9 else str(value)


def _silence_other_pdos(master: "Master", store: _Store) -> None:
    """Make every PDO invalid that the servo doesn't use: it would load the bus, or hear somebody else's commands."""
    for index in master.indices(store.node_id):
        if 0x1401 <= index <= 0x15FF or 0x1802 <= index <= 0x19FF:
            cob_id = master.read(store.node_id, index, 1)
            remedy = "switch this PDO off in the drive's own configuration"
            store(index, 1, cob_id | PDO_INVALID, "COB-ID of an unused PDO", remedy, _COB_ID_CARE)


_PDO_REMEDY = "this drive can't carry the PDO that the servo needs: use another firmware, or correct its EDS"


def _invalidate(store: _Store, communication: int) -> int:
    """Switch a PDO off, as bits 0 .. 30 may not change while it is valid; returns the COB-ID that it had."""
    held = store.master.read(store.node_id, communication, 1)
    store(communication, 1, held | PDO_INVALID, "COB-ID used by PDO", _PDO_REMEDY, _COB_ID_CARE)
    return held


def _map_pdo(
    store: _Store,
    communication: int,
    can_id: int,
    wanted_words: tuple[int, ...],
    transmission: int,
    inhibit_100us: int = 0,
) -> tuple[Codec, int]:
    """Map one PDO as CiA 301 wants it (invalid, count 0, entries, count, valid); return codec and id read back."""
    mapping = communication + 0x200
    remedy = _PDO_REMEDY
    held = _invalidate(store, communication)
    store(mapping, 0, 0, "number of mapped objects", remedy)
    for subindex, word in enumerate(wanted_words, 1):
        store.put(mapping, subindex, word, f"mapped object {subindex}", remedy)
    store(mapping, 0, len(wanted_words), "number of mapped objects", remedy)
    store(communication, 2, transmission, "transmission type", remedy)
    if inhibit_100us:
        store(communication, 3, inhibit_100us, "inhibit time", "lengthen or shorten the inhibit time of the inputs")
    no_remote = held & 1 << 30
    store(communication, 1, no_remote | can_id, "COB-ID used by PDO", remedy, _COB_ID_CARE)

    # Only now: a later entry may have changed an earlier one.
    for subindex, word in enumerate(wanted_words, 1):
        store.demand(mapping, subindex, word, f"mapped object {subindex}", remedy)
    count = store.master.read(store.node_id, mapping, 0)
    words = [store.master.read(store.node_id, mapping, subindex) for subindex in range(1, count + 1)]
    return Codec.from_mapping(words), store.master.read(store.node_id, communication, 1) & _ID_MASK
