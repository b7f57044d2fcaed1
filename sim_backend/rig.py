"""The software rig: plant, drives as CANopen nodes, interferometer, faults and truth, driven by events.

No thread and no clock: whoever owns it (a batch bus, a process) hands frames and instants in, and takes frames
and sensor lines out. Time is an integer of nanoseconds on one host clock.
"""

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from sim_backend import drive_servo, object_dictionary
from sim_backend.drive import Drive
from sim_backend.faults import BUS_KINDS, MACHINE_KINDS, Fault, FaultSchedule, WireFaults
from sim_backend.interferometer import END_BIT, MACRO_BIT, Interferometer
from sim_backend.node import DriveNode, reads_temperature
from sim_backend.truth import TruthLog
from stagectl import compose, plant
from stagectl.compiled import direct

START_T_NS = 1_000_000_000
SUBSTEP_S = 50e-6  # the longest

_ADVANCE = '''"""Generated: plant and drives of one machine, advanced together."""
import numpy as np

from sim_backend import drive_servo, winding
from stagectl.compiled import compiled
from {plant_module} import substep


@compiled
def advance(
    state,
    parameters,
    effect_parameters,
    macro,
    macro_parameters,
    micro,
    micro_parameters,
    macro_winding,
    macro_winding_parameters,
    micro_winding,
    micro_winding_parameters,
    until_s,
    longest_s,
):
    """Advance to `until_s` in equal substeps of at most `longest_s`; each begins with the drives' servo steps."""
    s = state[0]
    span_s = until_s - s.t_s
    if not span_s > 0.0:
        return
    count = int(np.ceil(span_s / longest_s - 1e-9))
    dt_s = span_s / count
    for _ in range(count):
        drive_servo.step(macro, macro_parameters, s.macro_position_m, dt_s)
        if parameters[0].has_micro != 0.0:
            drive_servo.step(micro, micro_parameters, s.end_position_m - s.macro_position_m, dt_s)
        substep(
            state,
            parameters,
            effect_parameters,
            dt_s,
            macro[0].current_command_a,
            micro[0].current_command_a,
            macro[0].bridge,
            micro[0].bridge,
        )
        winding.step(macro_winding, macro_winding_parameters, s.macro_current_a, dt_s)
        if parameters[0].has_micro != 0.0:
            winding.step(micro_winding, micro_winding_parameters, s.micro_current_a, dt_s)
    s.t_s = until_s
'''

_BEAMS = {"macro": MACRO_BIT, "end": END_BIT, "both": MACRO_BIT | END_BIT}


class Rig:
    """A machine in software; SI units, instants in ns of the host clock that began at `start_t_ns`."""

    def __init__(
        self,
        machine: Any,
        seed: int = 0,
        start_t_ns: int = START_T_NS,
        faults: Iterable[Fault] = (),
        truth_limit_s: float | None = None,
    ) -> None:
        """`truth_limit_s`: the truth log keeps at least this much of the newest past; None = all."""
        self.machine = machine
        self.start_t_ns = start_t_ns
        self.t_ns = start_t_ns  # the plant stands here
        rows_count = None if truth_limit_s is None else round(truth_limit_s * machine.interferometer.rate_hz)
        self.truth = TruthLog(rows_count)
        self.wire_faults = WireFaults()
        self.is_unplugged = False  # the sensor's port is gone
        self.syncs_count = 0
        self._effects = [dict(effect) for effect in machine.effects]
        self._plant_parameters = plant.parameters(machine, seed)
        self._effect_parameters = compose.effect_parameters(self._effects)
        module = compose.plant_module(self._effects)
        rig_module = compose.generated_module("rig", _ADVANCE.format(plant_module=module.__name__))
        self._senses = any(effect["acts_on"] in ("macro_sensor", "end_sensor") for effect in self._effects)
        self._sense = module.sense
        self._state = plant.init(machine)
        self._flat = self._state.view(np.float64)  # all fields are eight bytes wide, floats; memory stands last
        self._names = {name: k for k, name in enumerate(plant.PLANT_STATE.names or ()) if name != "memory"}
        state = self.plant_state()
        macro_m, end_m = state["macro_position_m"], state["end_position_m"]
        self.nodes: list[DriveNode] = [self._node(machine.macro, "macro", macro_m)]
        if machine.micro is not None:
            self.nodes.append(self._node(machine.micro, "micro", end_m - macro_m))
        self._macro_drive = self.nodes[0].drive
        self._micro_drive = self.nodes[-1].drive  # a stage without micro hands its macro twice; it is not stepped then
        self._arrays = (
            self._state,
            self._plant_parameters,
            self._effect_parameters,
            self._macro_drive.servo,
            self._macro_drive.servo_parameters,
            self._micro_drive.servo,
            self._micro_drive.servo_parameters,
            self._macro_drive.winding,
            self._macro_drive.winding_parameters,
            self._micro_drive.winding,
            self._micro_drive.winding_parameters,
        )
        self._advance = direct(rig_module.advance, *self._arrays, 0.0, SUBSTEP_S)
        self.interferometer = Interferometer(machine, seed, start_t_ns, macro_m, end_m)
        self._lines: deque[tuple[int, bytes]] = deque()
        self._frames: list[tuple[int, int, bytes]] = []
        self._faults = FaultSchedule(faults, start_t_ns)
        self._stuck_statuswords: dict[int, bytes] = {}
        self._last_sample: tuple[int, float, float] | None = None
        self.next_event_t_ns = start_t_ns  # of the next event inside the rig, not of a line's arrival
        self.next_timer_t_ns = start_t_ns  # of drives and faults, samples left out
        self._columns = tuple(
            self._names[name]
            for name in (
                "macro_position_m",
                "end_position_m",
                "macro_velocity_m_per_s",
                "end_velocity_m_per_s",
                "macro_position_integral_m_s",
                "end_position_integral_m_s",
                "contact_force_n",
                "macro_force_n",
                "micro_force_n",
            )
        )
        self._motor_columns = tuple(
            self._names[name] for name in ("macro_position_m", "end_position_m", "macro_current_a", "micro_current_a")
        )
        for node in self.nodes:
            self._collect(start_t_ns, node.on_time(start_t_ns, 0.0, 0.0))
        self._place_nodes()
        self._plan()

    def _node(self, axis: Any, name: str, position_m: float) -> DriveNode:
        path = self.machine.eds_path(name)
        dictionary = object_dictionary.load(path, axis.node_id, axis)
        ambient_degc = self.machine.air.temperature_degc
        return DriveNode(
            axis.node_id, dictionary, lambda objects: Drive(axis, objects, position_m, ambient_degc), self.start_t_ns
        )

    # -- state --------------------------------------------------------------------------------------------------------

    def plant_state(self) -> dict[str, float]:
        """Return the true state by name (`stagectl.plant.PLANT_STATE`), but for the memory of effects."""
        return dict(zip(self._names, self._state.item(), strict=False))  # the memory stands last, and has no name there

    def effects_memory(self) -> np.ndarray:
        """Return a copy of what the machine's effects remember."""
        return self._state["memory"][0].copy()

    def _motors(self) -> tuple[tuple[float, float], ...]:
        """Return (position of the motor's encoder, current) of each node."""
        value = self._flat.item
        macro, end, macro_current, micro_current = self._motor_columns
        macro_m = value(macro)
        return (macro_m, value(macro_current)), (value(end) - macro_m, value(micro_current))

    def _place_nodes(self) -> None:
        for node, motor in zip(self.nodes, self._motors(), strict=False):
            node.place(*motor)

    def drive(self, node_id: int) -> Drive:
        """Return the drive of a node."""
        return next(node.drive for node in self.nodes if node.node_id == node_id)

    # -- time ---------------------------------------------------------------------------------------------------------

    def _move_plant(self, t_ns: int) -> None:
        """Advance plant and servos to `t_ns` exactly."""
        if t_ns <= self.t_ns:
            return
        self._advance(*self._arrays, 1e-9 * (t_ns - self.start_t_ns), SUBSTEP_S)
        self.t_ns = t_ns

    def _plan(self) -> None:
        """Find the next event of our own: a sample, a node's timer, a fault."""
        due = min([node.next_t_ns() for node in self.nodes])
        fault_t_ns = self._faults.next_t_ns
        if fault_t_ns is not None and fault_t_ns < due:
            due = fault_t_ns
        self.next_timer_t_ns = due
        self.next_event_t_ns = min(due, self.interferometer.next_sample_t_ns)

    @property
    def next_wake_t_ns(self) -> int:
        """Instant at which somebody outside must be told something: a drive's timer, or a line that arrives."""
        return min(self.next_timer_t_ns, self.next_line_t_ns)

    def advance(self, t_ns: int) -> None:
        """Let everything happen up to and including `t_ns`; the plant stands there afterwards."""
        if self.next_event_t_ns <= t_ns:
            self._run_events(t_ns)
        self._move_plant(t_ns)

    def _run_events(self, t_ns: int) -> None:
        while self.next_event_t_ns <= t_ns:
            now_t_ns = self.next_event_t_ns
            self._move_plant(now_t_ns)
            for begins, fault in self._faults.due(now_t_ns):
                self._change_fault(begins, fault, now_t_ns)
            if self.interferometer.next_sample_t_ns <= now_t_ns:
                self._take_sample(now_t_ns)
            for k, node in enumerate(self.nodes):
                if node.next_t_ns() <= now_t_ns:
                    self._collect(now_t_ns, node.on_time(now_t_ns, *self._motors()[k]))
            self._plan()

    def postpone_watches(self, span_ns: int) -> None:
        """Tell the drives that the rig was held up for so long by its host: their watches wait as much longer."""
        for node in self.nodes:
            node.postpone_watches(span_ns)
        self._plan()

    # -- bus ----------------------------------------------------------------------------------------------------------

    def on_frame(self, can_id: int, payload: bytes, t_ns: int) -> list[tuple[int, bytes]]:
        """Take a frame whose end on the bus is at `t_ns`; return what the drives send in answer."""
        sync = can_id == self.nodes[0].sync_cob_id
        # To stop a motor's steps at one more instant changes their lengths, and so what noise makes of the motion:
        # who only asks how warm it is should change nothing.
        asks = can_id & 0x780 == 0x600 and not reads_temperature(payload)
        if sync or can_id == 0x000 or asks:
            self.advance(t_ns)
        elif self.next_event_t_ns <= t_ns:
            self._run_events(t_ns)
        answers: list[tuple[int, bytes]] = []
        if sync:
            self.syncs_count += 1
            self.truth.note_sync(t_ns)
            for node, motor in zip(self.nodes, self._motors(), strict=False):
                answers += node.on_sync(t_ns, *motor)
            self._plan()
        elif 0x180 < can_id < 0x580:
            for node in self.nodes:
                answers += node.on_frame(can_id, payload, t_ns)
            if answers:
                self._plan()
        else:
            self._place_nodes()
            for node in self.nodes:
                answers += node.on_frame(can_id, payload, t_ns)
            self._plan()
        if self._stuck_statuswords:
            answers = [(frame_id, self._stick(frame_id, data)) for frame_id, data in answers]
        return answers

    def _stick(self, can_id: int, payload: bytes) -> bytes:
        """Repeat the first statusword (the first two bytes of TPDO1) of a stuck drive."""
        if can_id & 0x780 != 0x180 or can_id & 0x7F not in self._stuck_statuswords:
            return payload
        node_id = can_id & 0x7F
        kept = self._stuck_statuswords[node_id] or payload[:2]
        self._stuck_statuswords[node_id] = kept
        return kept + payload[2:]

    def _collect(self, t_ns: int, frames: list[tuple[int, bytes]]) -> None:
        self._frames += [(t_ns, can_id, payload) for can_id, payload in frames]

    def take_frames(self) -> list[tuple[int, int, bytes]]:
        """Take the frames that drives sent on their own account: (instant, id, payload), oldest first."""
        frames = self._frames
        if frames:
            self._frames = []
        return frames

    # -- sensor -------------------------------------------------------------------------------------------------------

    def _take_sample(self, t_ns: int) -> None:
        value = self._flat.item
        macro_m, end_m, macro_m_per_s, end_m_per_s, macro_integral, end_integral, contact_n, macro_n, micro_n = [
            value(k) for k in self._columns
        ]
        interferometer = self.interferometer
        sequence = interferometer.next_sequence
        macro_error_m, end_error_m = 0.0, 0.0
        if self._senses:
            span_s = 0.0 if self._last_sample is None else 1e-9 * (t_ns - self._last_sample[0])
            macro_error_m, end_error_m = self._sense(
                self._state, self._plant_parameters, self._effect_parameters, span_s
            )
        taken = interferometer.sample(macro_m + macro_error_m, end_m + end_error_m, macro_m_per_s, end_m_per_s)
        if taken is not None and not self.is_unplugged:
            self._lines.append(taken)
        macro_mean_m, end_mean_m = macro_m, end_m
        if self._last_sample is not None:
            last_t_ns, last_macro_integral, last_end_integral = self._last_sample
            span_s = 1e-9 * (t_ns - last_t_ns)
            macro_mean_m = (macro_integral - last_macro_integral) / span_s
            end_mean_m = (end_integral - last_end_integral) / span_s
        self._last_sample = (t_ns, macro_integral, end_integral)
        zeros = (interferometer.macro_zero_m, interferometer.end_zero_m)
        states = (self._macro_drive.state, -1 if self.machine.micro is None else self._micro_drive.state)
        motion = (macro_m, end_m, macro_m_per_s, end_m_per_s, macro_mean_m, end_mean_m)
        self.truth.append(t_ns, sequence, (*motion, contact_n, macro_n, micro_n, *zeros, *states))

    @property
    def next_line_t_ns(self) -> int:
        """Arrival of the oldest line that was not taken yet, sampled already or not; a silent sensor keeps its beat."""
        return self._lines[0][0] if self._lines else self.interferometer.next_arrival_t_ns

    def sensor_lines_due(self, t_ns: int) -> list[tuple[int, bytes]]:
        """Take the lines that arrived up to `t_ns`: (arrival instant, bytes)."""
        lines = self._lines
        due = []
        while lines and lines[0][0] <= t_ns:
            due.append(lines.popleft())
        return due

    # -- faults -------------------------------------------------------------------------------------------------------

    def inject(self, fault: Fault, t_ns: int) -> None:
        """Plan a fault, its `at_s` counted from `t_ns`."""
        self._faults.add(fault, t_ns)
        self._plan()

    def _change_fault(self, begins: bool, fault: Fault, t_ns: int) -> None:
        """Begin or end a fault."""
        if fault.kind in BUS_KINDS:
            self.wire_faults.change(begins, fault)
            if begins and fault.kind == "bus_off":
                for node in self.nodes:
                    node.lose_bus(t_ns)
            return
        if fault.kind in MACHINE_KINDS:
            self._change_machine(begins, fault)
            return
        for node in self.nodes:
            if node.node_id == fault.node_id:
                self._change_drive_fault(begins, fault, node, t_ns)
        self._change_sensor_fault(begins, fault)

    def _change_machine(self, begins: bool, fault: Fault) -> None:
        """Wear or move what the machine is made of."""
        parameters, offset_m = self._plant_parameters, fault.offset_m or 0.0
        if fault.kind == "edge_jump":
            if begins:
                parameters["right_m"] += offset_m
            return
        if fault.kind == "weak_motor":
            axis = "macro" if fault.node_id == self.machine.macro.node_id else "micro"
            ratio = fault.force_ratio if begins and fault.force_ratio is not None else 1.0
            name = f"{axis}_force_constant_n_per_a"
            parameters[name] = ratio * plant.parameters(self.machine, 0)[name]
            return
        side = "travel_high_m" if offset_m > 0.0 else "travel_low_m"
        if begins:
            parameters[side] = self.plant_state()["macro_position_m"] + offset_m
        else:
            parameters[side] = plant.parameters(self.machine, 0)[side]

    def _change_drive_fault(self, begins: bool, fault: Fault, node: DriveNode, t_ns: int) -> None:
        if fault.kind == "heartbeat_silence":
            node.heartbeat_is_silent = begins
        elif fault.kind == "input":
            inputs = node.objects[object_dictionary.key(0x60FD)]
            bits = fault.bits or 0
            self._collect(t_ns, node.set_inputs(inputs | bits if begins else inputs & ~bits, t_ns))
        elif fault.kind == "emergency" and begins:
            self._collect(t_ns, node.raise_fault(fault.code or 0x1000, t_ns))
        elif fault.kind == "stuck_statusword":
            if begins:
                self._stuck_statuswords[node.node_id] = b""
            else:
                self._stuck_statuswords.pop(node.node_id, None)
        elif fault.kind == "power_loss":
            self._collect(t_ns, node.lose_power(t_ns) if begins else node.boot(t_ns))
        elif fault.kind == "object_change" and begins:
            node.change_object(fault.index or 0, fault.subindex or 0, fault.value or 0)
        elif fault.kind == "encoder_jump":
            offset_m = fault.offset_m or 0.0
            node.drive.shift_encoder(offset_m if begins else -offset_m)
        elif fault.kind == "flood" and begins:
            self._collect(t_ns, [(fault.can_id or 0, bytes(8))] * (fault.count or 0))

    def _change_sensor_fault(self, begins: bool, fault: Fault) -> None:
        interferometer = self.interferometer
        kind = fault.kind
        if kind == "beam_loss":
            bits = _BEAMS[fault.axis or "both"]
            interferometer.lost_axes = interferometer.lost_axes | bits if begins else interferometer.lost_axes & ~bits
        elif kind == "stuck_counts":
            interferometer.is_stuck = begins
        elif kind == "sensor_silence":
            interferometer.is_silent = begins
        elif kind == "unplug":
            self.is_unplugged = begins
            self._lines.clear()
        elif kind == "clock_drift":
            interferometer.drift((fault.ppm or 0.0) if begins else 0.0)
        elif begins:
            self._disturb_once(fault)

    def _disturb_once(self, fault: Fault) -> None:
        interferometer = self.interferometer
        if fault.kind == "garbage":
            count = fault.count or 1
            # 0x47 = G, never a sync byte, a digit or a line end
            letters = bytes(0x47 + k % 13 for k in range(count))
            interferometer.garbage = letters if fault.seed is None else np.random.default_rng(fault.seed).bytes(count)
        elif fault.kind == "half_line":
            interferometer.next_line_length = fault.length_count
        elif fault.kind == "sequence_gap":
            interferometer.next_sequence += fault.count or 1
        elif fault.kind == "sensor_restart":
            state = self.plant_state()
            interferometer.restart(state["macro_position_m"], state["end_position_m"])


def warm(machine: Any) -> None:
    """Compile what a rig of this machine runs, on a rig that is thrown away."""
    rig = Rig(machine)
    drive_servo.set_target(rig.nodes[0].drive.servo, 0.0, 1e-3)
    rig.on_frame(0x080, b"", rig.t_ns + 2_000_000)
