"""A drive as a CANopen node: `canopen.LocalNode` for SDO, NMT, heartbeat and EMCY, a cyclic path of our own.

Synchronous RPDOs take effect at the next SYNC, synchronous TPDOs are sampled there; event-driven TPDOs keep
their inhibit time; the watches of a drive on its master (heartbeat, RPDO deadline, SYNC) run on the time
that is handed in. No thread, no socket, no clock.
"""

import struct
from collections.abc import Callable
from typing import Any

import canopen
from canopen.sdo.exceptions import SdoAbortedError

from sim_backend import drive as cia402
from sim_backend import object_dictionary, process_data
from sim_backend.drive import Drive
from sim_backend.object_dictionary import key

NMT_INITIALISING = 0
NMT_STOPPED = 4
NMT_OPERATIONAL = 5
NMT_PRE_OPERATIONAL = 127

_NMT_COMMAND_ID = 0x000
_SYNC_KEY = key(0x1005)
_CYCLE_PERIOD = key(0x1006)
_EMERGENCY_COB_ID = key(0x1014)
_HEARTBEAT_CONSUMER = key(0x1016, 1)
_RPDO = ((0x1400, 0x1600),)
_TPDO = ((0x1800, 0x1A00), (0x1801, 0x1A01))
_PDO_INDICES = (0x1400, 0x1600, 0x1800, 0x1801, 0x1A00, 0x1A01)
_MAPPING_INDICES = (0x1600, 0x1A00, 0x1A01)
_SYNC_LOST_PERIODS = 20
_WATCH_PERIOD_NS = 1_000_000
_NEVER_NS = 1 << 62
_TEMPERATURE_REQUEST = struct.pack("<BHB", 0x40, cia402.WINDING_TEMPERATURE >> 8, cia402.WINDING_TEMPERATURE & 0xFF)
_EMERGENCY = struct.Struct("<HB5x")

_PROCESS_KEYS = frozenset(
    (
        cia402.ERROR_REGISTER,
        cia402.ERROR_CODE,
        cia402.CONTROLWORD,
        cia402.STATUS,
        cia402.MODE,
        cia402.MODE_DISPLAY,
        cia402.POSITION,
        cia402.TARGET_TORQUE,
        cia402.MAX_TORQUE,
        cia402.TORQUE,
        cia402.TARGET_POSITION,
        cia402.TORQUE_OFFSET,
        cia402.DIGITAL_INPUTS,
    )
)


def reads_temperature(payload: bytes) -> bool:
    """Tell whether an SDO asks for the winding's temperature (CiA 301, 7.2.4.3.5): needs no motor at this instant."""
    return payload[:4] == _TEMPERATURE_REQUEST


class _Periodic:
    """A message that the node repeats (its heartbeat); the shape of canopen's periodic task, without a thread."""

    def __init__(self, wire: "_NodeWire", can_id: int, data: bytes, period_s: float) -> None:
        self.can_id = can_id
        self.data = bytes(data)
        self.period_ns = round(1e9 * period_s)
        self.due_t_ns = wire.t_ns + self.period_ns
        self._wire = wire

    def update(self, data: bytes) -> None:
        """Change what the next message says."""
        self.data = bytes(data)

    def stop(self) -> None:
        """End the repetition."""
        if self in self._wire.periodic:
            self._wire.periodic.remove(self)


class _NodeWire(canopen.Network):
    """What LocalNode takes for a network: frames go to a list, time stands where it was set."""

    def __init__(self) -> None:
        super().__init__()
        self.t_ns = 0
        self.outbox: list[tuple[int, bytes]] = []
        self.periodic: list[_Periodic] = []

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Collect a frame."""
        self.outbox.append((can_id, bytes(data)))

    def send_periodic(self, can_id: int, data: Any, period: float, remote: bool = False) -> Any:
        """Collect a frame now and every `period` s."""
        task = _Periodic(self, can_id, data, period)
        self.periodic.append(task)
        self.outbox.append((can_id, bytes(data)))
        return task


class DriveNode:
    """One node: its object dictionary, its drive, its PDOs and its watches."""

    def __init__(
        self,
        node_id: int,
        dictionary: canopen.ObjectDictionary,
        make_drive: Callable[[dict[int, int]], Drive],
        t_ns: int,
    ) -> None:
        self.node_id = node_id
        self.objects = object_dictionary.numbers(dictionary)
        self.drive = make_drive(self.objects)
        self.heartbeat_is_silent = False  # fault injection
        self.is_dark = False  # without supply
        self._wire = _NodeWire()
        self._wire.t_ns = t_ns
        self._dictionary = dictionary
        self._defaults = dict(self.objects)
        self._local = canopen.LocalNode(node_id, dictionary)
        self._local.add_read_callback(self._on_read)
        self._local.add_write_callback(self._on_write)
        self._local.associate_network(self._wire)
        self.nmt_state = NMT_INITIALISING
        self._position_m = 0.0
        self._current_a = 0.0
        self._start()

    def _start(self) -> None:
        """Boot up into PRE-OPERATIONAL."""
        self._local.nmt.state = "INITIALISING"  # sends the boot-up message
        self._local.nmt.state = "PRE-OPERATIONAL"
        self.nmt_state = NMT_PRE_OPERATIONAL
        self._heartbeat_t_ns = _NEVER_NS
        self._rpdo_t_ns = _NEVER_NS
        self._sync_t_ns = _NEVER_NS
        self._sync_count = 0
        self._watch_t_ns = _NEVER_NS
        self._read_pdos()

    def _reset(self, application: bool) -> None:
        """NMT reset: communication objects back to defaults, with `application` all of them."""
        self.drive.lose_connection(cia402.EMERGENCY_SYNC_LOST)
        for object_key, value in self._defaults.items():
            if application or object_key >> 8 < 0x2000:
                self.objects[object_key] = value
        self._local.data_store.clear()
        self._local.nmt.stop_heartbeat()
        self.drive.emergencies.clear()
        if application:
            self.drive.power_up()
        self._start()

    def lose_power(self, t_ns: int) -> list[tuple[int, bytes]]:
        """Go dark at once: no torque, no frame; the supply of a node is its own, the motor's goes with it."""
        self._wire.t_ns = t_ns
        self._local.nmt.stop_heartbeat()
        self.drive.power_up()
        self.drive.emergencies.clear()
        self._wire.outbox.clear()
        self.nmt_state = NMT_INITIALISING
        self.is_dark = True
        return []

    def boot(self, t_ns: int) -> list[tuple[int, bytes]]:
        """Come back with the defaults of every object, and an encoder that counts from where it stands."""
        self._wire.t_ns = t_ns
        self.is_dark = False
        self.objects.update(self._defaults)
        self._local.data_store.clear()
        self.drive.boot()
        self._start()
        return self._take()

    def change_object(self, index: int, subindex: int, value: int) -> None:
        """Put a value into an object as another master's tool would; it is checked by nobody."""
        self.objects[key(index, subindex)] = value
        variable = self._dictionary.get_variable(index, subindex)
        if variable is not None:  # what an SDO upload gives
            data = (value & (1 << len(variable)) - 1).to_bytes(len(variable) // 8, "little")
            self._local.data_store.setdefault(index, {})[subindex] = data
        if index in _PDO_INDICES:
            self._read_pdos()
        else:
            self.drive.written(key(index, subindex))

    # -- SDO ----------------------------------------------------------------------------------------------------------

    def _on_read(self, index: int, subindex: int, od: Any) -> int | None:
        object_key = key(index, subindex)
        if object_key in _PROCESS_KEYS:
            self.drive.sample(self._position_m, self._current_a)
            return self.objects[object_key]
        if object_key == cia402.WINDING_TEMPERATURE:
            self.drive.sample_temperature()
            return self.objects[object_key]
        return None

    def _on_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        object_key = key(index, subindex)
        if object_key not in self.objects:
            return
        signed = od.data_type in object_dictionary.SIGNED_TYPES
        value = int.from_bytes(data, "little", signed=signed)
        if index in _MAPPING_INDICES:
            code = process_data.mapping_error(self._dictionary, self.objects, index, subindex, value)
        else:
            code = self.drive.write_error(object_key, value)
        if code:
            raise SdoAbortedError(code)
        self.objects[object_key] = value
        if index in _PDO_INDICES:
            self._read_pdos()
        elif object_key == _HEARTBEAT_CONSUMER:
            self._heartbeat_t_ns = _NEVER_NS  # watched from the next heartbeat on
        else:
            self.drive.written(object_key)
            self._after()

    def _read_pdos(self) -> None:
        """Rebuild the PDO codecs and the table of ids from the objects."""
        self._rpdos = [process_data.read(self._dictionary, self.objects, *pair) for pair in _RPDO]
        self._tpdos = [process_data.read(self._dictionary, self.objects, *pair) for pair in _TPDO]
        self.sync_cob_id = self.objects[_SYNC_KEY] & 0x7FF
        self._rpdo_of = {pdo.cob_id: pdo for pdo in self._rpdos if pdo.exists}
        self._sync_rpdos = [pdo for pdo in self._rpdos if pdo.exists and pdo.synchronous]
        self._sync_tpdos = [pdo for pdo in self._tpdos if pdo.exists and pdo.synchronous]
        self._event_tpdos = [pdo for pdo in self._tpdos if pdo.exists and not pdo.synchronous]

    # -- frames -------------------------------------------------------------------------------------------------------

    def on_frame(self, can_id: int, payload: bytes, t_ns: int) -> list[tuple[int, bytes]]:
        """Take a frame (SYNC has `on_sync`), return the frames that the node answers with at once."""
        if self.is_dark:
            return []
        self._wire.t_ns = t_ns
        pdo = self._rpdo_of.get(can_id)
        if pdo is not None:
            if self.nmt_state == NMT_OPERATIONAL:
                self._on_rpdo(pdo, payload, t_ns)
        elif can_id == 0x600 + self.node_id:
            if self.nmt_state != NMT_STOPPED and len(payload) == 8:
                self._local.sdo.on_request(can_id, bytearray(payload), 1e-9 * t_ns)
        elif can_id == _NMT_COMMAND_ID:
            if len(payload) == 2 and payload[1] in (0, self.node_id):
                self._on_nmt(payload[0], t_ns)
        elif can_id & 0x780 == 0x700:
            consumer = self.objects[_HEARTBEAT_CONSUMER]
            if can_id & 0x7F == consumer >> 16 & 0x7F and consumer & 0xFFFF:
                self._heartbeat_t_ns = t_ns + 1_000_000 * (consumer & 0xFFFF)
        return self._take()

    def place(self, position_m: float, current_a: float) -> None:
        """Tell where the motor is, for objects that are read between SYNCs."""
        self._position_m = position_m
        self._current_a = current_a

    def _on_rpdo(self, pdo: process_data.ProcessData, payload: bytes, t_ns: int) -> None:
        if len(payload) < pdo.codec.size:
            self.drive.warn(cia402.EMERGENCY_PDO_LENGTH, 0x11)
            self._send_emergencies()
            return
        pdo.pending = pdo.codec.unpack_from(payload)
        if pdo.event_ns:
            self._rpdo_t_ns = t_ns + pdo.event_ns
        if not pdo.synchronous:
            self._latch(pdo)
            self._after()

    def _latch(self, pdo: process_data.ProcessData) -> None:
        """Put a received RPDO into the objects and act on it."""
        values = pdo.pending
        if values is None:
            return
        pdo.pending = None
        objects = self.objects
        for object_key, value in zip(pdo.keys, values, strict=True):
            objects[object_key] = value
        self.drive.apply()

    def _on_nmt(self, command: int, t_ns: int) -> None:
        was = self.nmt_state
        if command in (129, 130):
            self._reset(application=command == 129)
            return
        states = {1: NMT_OPERATIONAL, 2: NMT_STOPPED, 128: NMT_PRE_OPERATIONAL}
        if command not in states:
            return
        self._local.nmt.on_command(0, bytes((command, self.node_id)), 1e-9 * t_ns)
        self.nmt_state = states[command]
        if self.nmt_state == was:
            return
        if self.nmt_state == NMT_OPERATIONAL:
            self._sync_count = 0
            for pdo in self._tpdos:
                pdo.last_payload = b""  # event-driven ones report once on entry
            self._send_events(t_ns)
        elif was == NMT_OPERATIONAL:
            self._rpdo_t_ns = self._sync_t_ns = _NEVER_NS
            for pdo in self._rpdos:
                pdo.pending = None
            # RPDOs are dead from here on: a drive that kept its last torque would run away
            self.drive.lose_connection(cia402.EMERGENCY_SYNC_LOST)
            self._after()

    def on_sync(self, t_ns: int, position_m: float, current_a: float) -> list[tuple[int, bytes]]:
        """Latch synchronous RPDOs, sample synchronous TPDOs at the motor's present position and current."""
        wire = self._wire
        wire.t_ns = t_ns
        self._position_m = position_m
        self._current_a = current_a
        if self.nmt_state != NMT_OPERATIONAL:
            return self._take() if wire.outbox else []
        self._sync_count += 1
        period_us = self.objects[_CYCLE_PERIOD]
        if period_us:
            self._sync_t_ns = t_ns + 1000 * period_us * _SYNC_LOST_PERIODS
        for pdo in self._sync_rpdos:
            if pdo.pending is not None:
                self._latch(pdo)
        drive = self.drive
        if drive.is_busy:
            drive.watch(current_a)
        drive.sample(position_m, current_a)
        for pdo in self._sync_tpdos:
            payload = pdo.payload(self.objects)
            if pdo.transmission_type == 0:
                if payload == pdo.last_payload:
                    continue
            elif self._sync_count % pdo.transmission_type:
                continue
            pdo.last_payload = payload
            wire.outbox.append((pdo.cob_id, payload))
        self._send_events(t_ns)
        self._plan_watch(t_ns)
        return self._take()

    # -- timers -------------------------------------------------------------------------------------------------------

    def next_t_ns(self) -> int:
        """Return when `on_time` wants to be called next."""
        if self.is_dark:
            return _NEVER_NS
        due = min(self._heartbeat_t_ns, self._rpdo_t_ns, self._sync_t_ns, self._watch_t_ns)
        for task in self._wire.periodic:
            if task.due_t_ns < due:
                due = task.due_t_ns
        if self.nmt_state == NMT_OPERATIONAL:
            for pdo in self._event_tpdos:
                if pdo.due_t_ns is not None and pdo.due_t_ns < due:
                    due = pdo.due_t_ns
        return due

    def on_time(self, t_ns: int, position_m: float, current_a: float) -> list[tuple[int, bytes]]:
        """Do what is due at `t_ns`."""
        self._wire.t_ns = t_ns
        self._position_m = position_m
        self._current_a = current_a
        for task in list(self._wire.periodic):
            if task.due_t_ns <= t_ns:
                task.due_t_ns += task.period_ns
                if not self.heartbeat_is_silent:
                    self._wire.outbox.append((task.can_id, task.data))
        if self._heartbeat_t_ns <= t_ns:
            self._heartbeat_t_ns = _NEVER_NS
            self.drive.lose_connection(cia402.EMERGENCY_HEARTBEAT)
        if self._rpdo_t_ns <= t_ns:
            self._rpdo_t_ns = _NEVER_NS
            self.drive.lose_connection(cia402.EMERGENCY_RPDO_TIMEOUT)
        if self._sync_t_ns <= t_ns:
            self._sync_t_ns = _NEVER_NS
            self.drive.lose_connection(cia402.EMERGENCY_SYNC_LOST)
        if self._watch_t_ns <= t_ns:
            self._watch_t_ns = _NEVER_NS
            self.drive.watch(current_a)
        self._after()
        return self._take()

    def postpone_watches(self, span_ns: int) -> None:
        """Move the deadlines of heartbeat, RPDO and SYNC: the time that the rig itself was held up is not silence."""
        self._heartbeat_t_ns = min(_NEVER_NS, self._heartbeat_t_ns + span_ns)
        self._rpdo_t_ns = min(_NEVER_NS, self._rpdo_t_ns + span_ns)
        self._sync_t_ns = min(_NEVER_NS, self._sync_t_ns + span_ns)

    def set_inputs(self, inputs: int, t_ns: int) -> list[tuple[int, bytes]]:
        """Change the drive's digital inputs."""
        self._wire.t_ns = t_ns
        self.drive.set_inputs(inputs)
        self._after()
        return self._take()

    def raise_fault(self, code: int, t_ns: int) -> list[tuple[int, bytes]]:
        """Let the drive fail with an emergency code."""
        self._wire.t_ns = t_ns
        self.drive.fault(code)
        self._after()
        return self._take()

    def lose_bus(self, t_ns: int) -> None:
        """Tell the drive that its bus is off."""
        self._wire.t_ns = t_ns
        self.drive.lose_connection(cia402.EMERGENCY_BUS_OFF)
        self._after()

    def _after(self) -> None:
        """Report what the drive did outside SYNC."""
        self.drive.sample(self._position_m, self._current_a)
        self._send_emergencies()
        if self.nmt_state == NMT_OPERATIONAL:
            self._send_events(self._wire.t_ns)
        self._plan_watch(self._wire.t_ns)

    def _plan_watch(self, t_ns: int) -> None:
        if self.drive.emergencies:
            self._send_emergencies()
        if self._watch_t_ns <= t_ns or self._watch_t_ns == _NEVER_NS:
            self._watch_t_ns = t_ns + _WATCH_PERIOD_NS if self.drive.is_busy else _NEVER_NS

    def _send_events(self, t_ns: int) -> None:
        """Send event-driven TPDOs whose content changed or whose event timer ran out, inhibit time kept."""
        for pdo in self._event_tpdos:
            payload = pdo.payload(self.objects)
            timed = pdo.event_ns > 0 and t_ns >= pdo.last_sent_t_ns + pdo.event_ns
            if payload == pdo.last_payload and not timed:
                pdo.due_t_ns = pdo.last_sent_t_ns + pdo.event_ns if pdo.event_ns else None
                continue
            allowed_t_ns = pdo.last_sent_t_ns + pdo.inhibit_ns
            if t_ns < allowed_t_ns:
                pdo.due_t_ns = allowed_t_ns
                continue
            pdo.last_payload = payload
            pdo.last_sent_t_ns = t_ns
            pdo.due_t_ns = t_ns + pdo.event_ns if pdo.event_ns else None
            self._wire.outbox.append((pdo.cob_id, payload))

    def _send_emergencies(self) -> None:
        cob_id = self.objects[_EMERGENCY_COB_ID]
        for code, register in self.drive.emergencies:
            if not cob_id & 0x8000_0000 and self.nmt_state != NMT_STOPPED:
                self._wire.outbox.append((cob_id & 0x7FF, _EMERGENCY.pack(code, register)))
        self.drive.emergencies.clear()

    def _take(self) -> list[tuple[int, bytes]]:
        frames = self._wire.outbox
        self._wire.outbox = []
        return [] if self.is_dark else frames
