"""A CiA 402 drive in software: power states, modes, stops, limits and faults over the compiled servo.

Objects are plain integers by `key`; the node (`sim_backend.node`) moves them between here and the bus.
Knows the motor through `drive_servo` only; no bus and no clock of its own: time is an argument.
"""

import math
from collections.abc import MutableMapping
from typing import Any

from sim_backend import drive_servo, winding
from sim_backend.drive_states import FAULT_RESET_BIT, STATUSWORD, DriveState, Order, next_state, order_of
from sim_backend.object_dictionary import key

ERROR_REGISTER = key(0x1001)
WINDING_TEMPERATURE = key(0x2010)
ABORT_CONNECTION_OPTION = key(0x6007)
ERROR_CODE = key(0x603F)
CONTROLWORD = key(0x6040)
STATUS = key(0x6041)
QUICK_STOP_OPTION = key(0x605A)
FAULT_REACTION_OPTION = key(0x605E)
MODE = key(0x6060)
MODE_DISPLAY = key(0x6061)
POSITION = key(0x6064)
TARGET_TORQUE = key(0x6071)
MAX_TORQUE = key(0x6072)
RATED_CURRENT = key(0x6075)
TORQUE = key(0x6077)
TARGET_POSITION = key(0x607A)
HOME_OFFSET = key(0x607C)
QUICK_STOP_DECELERATION = key(0x6085)
HOMING_METHOD = key(0x6098)
HOMING_SPEED = key(0x6099, 2)
HOMING_ACCELERATION = key(0x609A)
TORQUE_OFFSET = key(0x60B2)
INTERPOLATION_VALUE = key(0x60C2, 1)
INTERPOLATION_INDEX = key(0x60C2, 2)
DIGITAL_INPUTS = key(0x60FD)
SUPPORTED_MODES = key(0x6502)

MODE_HOMING = 6
MODE_POSITION = 8  # cyclic synchronous position
MODE_TORQUE = 10  # cyclic synchronous torque

INPUT_NEGATIVE_LIMIT = 0x0001
INPUT_POSITIVE_LIMIT = 0x0002
INPUT_INTERLOCK = 0x0008  # safe torque off
INPUT_PRESSURE = 0x1_0000  # air bearing

EMERGENCY_NONE = 0x0000
EMERGENCY_HEARTBEAT = 0x8130
EMERGENCY_BUS_OFF = 0x8140
EMERGENCY_PDO_LENGTH = 0x8210
EMERGENCY_RPDO_TIMEOUT = 0x8250
EMERGENCY_FOLLOWING_ERROR = 0x8611
EMERGENCY_LIMIT = 0x8612
EMERGENCY_SYNC_LOST = 0x8700
EMERGENCY_INTERLOCK = 0x9000  # external error
EMERGENCY_PRESSURE = 0x9001

ABORT_VALUE = 0x06090030
ABORT_STATE = 0x08000022

HOMING_METHODS = (33, 34, 35, 37)
QUICK_STOP_OPTIONS = (0, 1, 2, 3, 5, 6, 7)
_DISABLING_OPTIONS = (1, 2, 3)  # 0x605A: ramp down, then switch on disabled

_REGISTER_GENERIC = 0x01
_REGISTER_COMMUNICATION = 0x10
_REGISTER_PROFILE = 0x20

_STATUS_VOLTAGE = 0x0010
_STATUS_REMOTE = 0x0200
_STATUS_TARGET_REACHED = 0x0400
_STATUS_LIMITED = 0x0800
_STATUS_BIT_12 = 0x1000
_STATUS_BIT_13 = 0x2000
_HOMING_START_BIT = 0x0010
_FOLLOWING_ERROR_LIMIT_M = 5e-3
_SHORTED_REST_A = 5e-3
"""In its shorted winding, an axis without encoder counts as at rest: 0.13 mm/s; 40 mN of a spring creep at 0.03."""

_POWERED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)
_WORD_LIMIT = 32767
_COUNTS_PER_DEGC = 10.0  # of WINDING_TEMPERATURE, as the EDS files' comments say


class Drive:
    """One drive; `objects` is its object dictionary as integers, shared with its node."""

    def __init__(
        self, axis: Any, objects: MutableMapping[int, int], position_m: float, ambient_degc: float = 20.0
    ) -> None:
        self.objects = objects
        self.servo_parameters = drive_servo.parameters(axis)
        self.servo = drive_servo.init(self.servo_parameters, position_m)
        self.winding_parameters = winding.parameters(axis, ambient_degc)
        self.winding = winding.init()
        self._limited = self.servo["limited"]  # views: a field by name costs 100 ns
        self._torque_target_a = self.servo["torque_target_a"]
        self.has_encoder = bool(self.servo_parameters["has_encoder"][0])
        self.emergencies: list[tuple[int, int]] = []  # (code, error register), oldest first; the node sends them
        self.state = DriveState.SWITCH_ON_DISABLED
        self._axis_limit_a = float(axis.current_limit_a)
        self._step_m = float(self.servo_parameters["encoder_step_m"][0])
        self._offset_m = float(self.servo_parameters["encoder_offset_m"][0])
        self._origin_count = 0  # encoder count at position actual value 0
        self._mode = 0
        self._homed = False
        self._homing_error = False
        self._stop_is_latched = False  # a stop that no controlword but disable voltage leaves
        self._follows = False  # position mode: a target came since the mode was entered
        self.power_up()

    def shift_encoder(self, offset_m: float) -> None:
        """Let counts appear from nowhere, in its loops and in what it says of its position."""
        self.servo_parameters["encoder_offset_m"] += offset_m
        self._offset_m += offset_m

    def power_up(self) -> None:
        """Bring objects and states to what a reset leaves; the encoder keeps counting."""
        self._controlword = 0
        self._stop_is_latched = False
        self._set_mode(self.objects[MODE])
        self._apply_torque_limit()
        self._set_state(DriveState.SWITCH_ON_DISABLED)

    def boot(self) -> None:
        """Come up after its supply was gone: an incremental encoder begins to count anew where it stands."""
        self._origin_count = int(self.servo["encoder_count"][0])
        self._homed = self._homing_error = False
        self.power_up()

    # -- objects ------------------------------------------------------------------------------------------------------

    def write_error(self, object_key: int, value: int) -> int:
        """Return the SDO abort code that forbids a value, 0 = allowed."""
        if object_key == MODE and not self._mode_exists(value):
            return ABORT_VALUE
        if object_key == QUICK_STOP_OPTION and value not in QUICK_STOP_OPTIONS:
            return ABORT_VALUE
        if object_key == ABORT_CONNECTION_OPTION and value not in (0, 1, 2, 3):
            return ABORT_VALUE
        if object_key == FAULT_REACTION_OPTION and value not in (0, 1, 2):
            return ABORT_VALUE
        if object_key == HOMING_METHOD and value not in HOMING_METHODS:
            return ABORT_VALUE
        if object_key == INTERPOLATION_VALUE and value == 0:
            return ABORT_VALUE
        if object_key in (QUICK_STOP_DECELERATION, HOMING_ACCELERATION) and value == 0 and self.has_encoder:
            return ABORT_VALUE  # without an encoder there is no ramp, and the value means nothing
        if object_key == RATED_CURRENT and (value == 0 or self.state in _POWERED):
            return ABORT_STATE if value else ABORT_VALUE
        return 0

    def written(self, object_key: int) -> None:
        """Take an object that was written by SDO into effect."""
        if object_key in (CONTROLWORD, MODE, TARGET_TORQUE, TARGET_POSITION, TORQUE_OFFSET):
            self.apply()
        elif object_key in (MAX_TORQUE, RATED_CURRENT):
            self._apply_torque_limit()

    def _apply_torque_limit(self) -> None:
        self._max_word = self.objects[MAX_TORQUE]
        self._ampere_per_word = 1e-6 * self.objects[RATED_CURRENT]  # mA of rated current, 0.1 % a count
        self.servo["current_limit_a"] = min(self._max_word * self._ampere_per_word, self._axis_limit_a)

    def _mode_exists(self, mode: int) -> bool:
        return mode == 0 or (0 < mode <= 32 and bool(self.objects[SUPPORTED_MODES] >> (mode - 1) & 1))

    def _set_mode(self, mode: int) -> None:
        """Change the mode of operation; one that the drive lacks leaves the old one (0x6061 shows it)."""
        if not self._mode_exists(mode):
            return
        self._mode = mode
        self.objects[MODE_DISPLAY] = mode
        if self.state == DriveState.OPERATION_ENABLED:
            self._start_mode()

    def _start_mode(self) -> None:
        """Hand the motor to the present mode, without a bump."""
        self._follows = False
        if self._mode == MODE_TORQUE:
            drive_servo.enter(self.servo, drive_servo.TORQUE)
        elif self._mode == MODE_POSITION and self.has_encoder:
            drive_servo.enter(self.servo, drive_servo.POSITION)
        elif self._mode == MODE_HOMING and self.has_encoder:
            self._ramp_down(self.objects[HOMING_ACCELERATION])  # stand until bit 4 starts the search
        else:
            self._power_off()

    # -- commands -----------------------------------------------------------------------------------------------------

    def apply(self) -> None:
        """Obey the present controlword and targets; called at SYNC after the RPDOs are latched."""
        objects = self.objects
        controlword = objects[CONTROLWORD]
        if controlword != self._controlword or self.state != DriveState.OPERATION_ENABLED:
            self._obey(controlword)
        if objects[MODE] != self._mode:
            self._set_mode(objects[MODE])
        if objects[MAX_TORQUE] != self._max_word:
            self._apply_torque_limit()
        if self.state != DriveState.OPERATION_ENABLED:
            return
        if self._mode == MODE_TORQUE:
            self._torque_target_a[0] = (objects[TARGET_TORQUE] + objects[TORQUE_OFFSET]) * self._ampere_per_word
        elif self._mode == MODE_POSITION:
            self._follow()

    def _follow(self) -> None:
        """Give the position loop its next target, with the torque offset."""
        objects = self.objects
        target_m = (objects[TARGET_POSITION] + self._origin_count) * self._step_m
        if not abs(target_m - float(self.servo["reference_m"][0])) <= _FOLLOWING_ERROR_LIMIT_M:
            self.fault(EMERGENCY_FOLLOWING_ERROR, _REGISTER_PROFILE)
            return
        self.servo["torque_offset_a"] = objects[TORQUE_OFFSET] * self._ampere_per_word
        drive_servo.set_target(self.servo, target_m, self.interpolation_s)

    @property
    def interpolation_s(self) -> float:
        """Time from one target to the next, 0x60C2."""
        exponent = self.objects[INTERPOLATION_INDEX]
        return self.objects[INTERPOLATION_VALUE] * math.pow(10.0, exponent)

    def _obey(self, controlword: int) -> None:
        """Walk the power state machine by one controlword, and start homing on the edge of its bit 4."""
        old = self._controlword
        self._controlword = controlword
        reset_edge = bool(controlword & ~old & FAULT_RESET_BIT)
        state = self.state
        held = state == DriveState.QUICK_STOP_ACTIVE and self._stop_is_latched
        if held and order_of(controlword) != Order.DISABLE_VOLTAGE:
            return
        if state in (DriveState.NOT_READY, DriveState.FAULT_REACTION_ACTIVE):
            return
        new = next_state(state, controlword, reset_edge, self.objects[QUICK_STOP_OPTION])
        upwards = state < new <= DriveState.OPERATION_ENABLED and new > DriveState.SWITCH_ON_DISABLED
        if upwards and self.objects[DIGITAL_INPUTS] & (INPUT_INTERLOCK | INPUT_PRESSURE):
            return  # never up while an interlock is open
        if new != state:
            if state == DriveState.FAULT:
                self._emit(EMERGENCY_NONE, 0)
            self._set_state(new)
        if new == DriveState.OPERATION_ENABLED and self._mode == MODE_HOMING:
            if controlword & ~old & _HOMING_START_BIT:
                self._start_homing()
            elif old & ~controlword & _HOMING_START_BIT and self._homes:
                self._ramp_down(self.objects[HOMING_ACCELERATION])

    # -- states -------------------------------------------------------------------------------------------------------

    def _set_state(self, state: DriveState) -> None:
        """Enter a state and do what it does to the motor."""
        self.state = state
        if state == DriveState.OPERATION_ENABLED:
            self._start_mode()
        elif state == DriveState.QUICK_STOP_ACTIVE:
            self._quick_stop()
        elif state == DriveState.FAULT_REACTION_ACTIVE:
            if self.objects[FAULT_REACTION_OPTION] == 0:
                self._power_off()
            else:
                self._ramp_down(self.objects[QUICK_STOP_DECELERATION])
        else:
            self._stop_is_latched = False
            self._power_off()

    def _quick_stop(self) -> None:
        if self.objects[QUICK_STOP_OPTION] == 0:
            self._set_state(DriveState.SWITCH_ON_DISABLED)
        else:
            self._ramp_down(self.objects[QUICK_STOP_DECELERATION])

    def _ramp_down(self, deceleration_counts_per_s2: int) -> None:
        """Bring the axis to rest: on its encoder with a ramp, or by the shorted winding where there is none."""
        if not self.has_encoder:
            drive_servo.enter(self.servo, drive_servo.SHORTED)
            return
        self.servo["ramp_m_per_s2"] = deceleration_counts_per_s2 * self._step_m
        drive_servo.enter(self.servo, drive_servo.STOPPING)

    def _power_off(self) -> None:
        """Take the current away; a motor without encoder has a brake relay that shorts its winding."""
        drive_servo.enter(self.servo, drive_servo.OFF if self.has_encoder else drive_servo.SHORTED)

    @property
    def _homes(self) -> bool:
        return int(self.servo["mode"][0]) == drive_servo.HOMING

    @property
    def is_busy(self) -> bool:
        """Tell whether a ramp or a homing runs that `watch` must see the end of."""
        if self.state == DriveState.OPERATION_ENABLED:
            return self._mode == MODE_HOMING and self._homes
        return self.state == DriveState.QUICK_STOP_ACTIVE or self.state == DriveState.FAULT_REACTION_ACTIVE

    def watch(self, current_a: float) -> None:
        """Finish what takes time: ramps of quick stop and fault reaction, homing."""
        if self.state == DriveState.QUICK_STOP_ACTIVE:
            if self.objects[QUICK_STOP_OPTION] in _DISABLING_OPTIONS and self._rests(current_a):
                self._set_state(DriveState.SWITCH_ON_DISABLED)
        elif self.state == DriveState.FAULT_REACTION_ACTIVE:
            if self._rests(current_a) or int(self.servo["mode"][0]) == drive_servo.OFF:
                self._set_state(DriveState.FAULT)
        elif self._homes:
            self._watch_homing()

    def _rests(self, current_a: float) -> bool:
        if self.has_encoder:
            return bool(self.servo["at_rest"][0])
        return abs(current_a) < _SHORTED_REST_A

    # -- homing -------------------------------------------------------------------------------------------------------

    def _start_homing(self) -> None:
        self._homed = False
        self._homing_error = False
        method = self.objects[HOMING_METHOD]
        if method in (35, 37):
            self._set_origin(int(self.servo["encoder_count"][0]))
            self._homed = True
            return
        speed = self.objects[HOMING_SPEED] * self._step_m
        self.servo["homing_velocity_m_per_s"] = speed if method == 34 else -speed
        self.servo["ramp_m_per_s2"] = self.objects[HOMING_ACCELERATION] * self._step_m
        drive_servo.enter(self.servo, drive_servo.HOMING)

    def _set_origin(self, home_count: int) -> None:
        """Place the zero so that the home position reads the home offset 0x607C."""
        self._origin_count = home_count - self.objects[HOME_OFFSET]

    def _watch_homing(self) -> None:
        phase = int(self.servo["homing_phase"][0])
        if phase == drive_servo.HOMING_DONE:
            self._set_origin(int(self.servo["index_count"][0]))
            self._homed = True
        elif phase == drive_servo.HOMING_FAILED or self.objects[DIGITAL_INPUTS] & (
            INPUT_NEGATIVE_LIMIT | INPUT_POSITIVE_LIMIT
        ):
            self._homing_error = True
        else:
            return
        self._ramp_down(self.objects[HOMING_ACCELERATION])

    # -- the world ----------------------------------------------------------------------------------------------------

    def set_inputs(self, inputs: int) -> None:
        """Change the digital inputs 0x60FD and react to what tripped."""
        tripped = inputs & ~self.objects[DIGITAL_INPUTS]
        self.objects[DIGITAL_INPUTS] = inputs
        powered = self.state in _POWERED
        if tripped & INPUT_INTERLOCK:
            if powered or self.state == DriveState.SWITCHED_ON:
                self._trip(EMERGENCY_INTERLOCK, _REGISTER_GENERIC)
                self._set_state(DriveState.FAULT)  # no torque, so no ramp
            elif self.state == DriveState.READY_TO_SWITCH_ON:
                self._set_state(DriveState.SWITCH_ON_DISABLED)
        if tripped & INPUT_PRESSURE and powered:
            self._emit(EMERGENCY_PRESSURE, _REGISTER_GENERIC)
            self.stop()
        if tripped & (INPUT_NEGATIVE_LIMIT | INPUT_POSITIVE_LIMIT) and powered and not self._homes:
            self._emit(EMERGENCY_LIMIT, _REGISTER_PROFILE)
            self.stop()

    def stop(self) -> None:
        """Quick stop on the drive's own account; only disable voltage leaves it."""
        if self.state == DriveState.OPERATION_ENABLED:
            self._set_state(DriveState.QUICK_STOP_ACTIVE)
        if self.state == DriveState.QUICK_STOP_ACTIVE:
            self._stop_is_latched = True

    def fault(self, code: int, register: int = _REGISTER_GENERIC) -> None:
        """Report a fault and react by 0x605E."""
        self._trip(code, register)
        if self.state == DriveState.OPERATION_ENABLED or self.state == DriveState.QUICK_STOP_ACTIVE:
            self._set_state(DriveState.FAULT_REACTION_ACTIVE)
            if int(self.servo["mode"][0]) == drive_servo.OFF:
                self._set_state(DriveState.FAULT)
        elif self.state != DriveState.FAULT_REACTION_ACTIVE:
            self._set_state(DriveState.FAULT)

    def lose_connection(self, code: int) -> None:
        """React by 0x6007 to a silent master: heartbeat, RPDO deadline, SYNC, bus-off, NMT stop."""
        option = self.objects[ABORT_CONNECTION_OPTION]
        if option == 1:
            self.fault(code, _REGISTER_GENERIC | _REGISTER_COMMUNICATION)
            return
        self._emit(code, _REGISTER_GENERIC | _REGISTER_COMMUNICATION)
        if option == 2 and self.state not in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            self._set_state(DriveState.SWITCH_ON_DISABLED)
        elif option == 3:
            self.stop()
            if self.state in (DriveState.SWITCHED_ON, DriveState.READY_TO_SWITCH_ON):
                self._set_state(DriveState.SWITCH_ON_DISABLED)

    def warn(self, code: int, register: int) -> None:
        """Send an emergency message that changes no state."""
        self._emit(code, register)

    def _trip(self, code: int, register: int) -> None:
        self.objects[ERROR_CODE] = code
        self._emit(code, register)

    def _emit(self, code: int, register: int) -> None:
        self.objects[ERROR_REGISTER] = register
        if code == EMERGENCY_NONE:
            self.objects[ERROR_CODE] = 0
        self.emergencies.append((code, register))

    # -- reports ------------------------------------------------------------------------------------------------------

    def sample(self, position_m: float, current_a: float) -> None:
        """Put position, torque and statusword of this instant into the objects."""
        objects = self.objects
        if self.has_encoder:
            count = math.floor((position_m + self._offset_m) / self._step_m + 0.5) - self._origin_count
            objects[POSITION] = (count + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        word = round(current_a / self._ampere_per_word)
        objects[TORQUE] = min(max(word, -_WORD_LIMIT), _WORD_LIMIT)
        objects[STATUS] = self.statusword()

    def sample_temperature(self) -> None:
        """Put the winding's temperature of this instant into its object."""
        word = round(_COUNTS_PER_DEGC * winding.temperature_degc(self.winding, self.winding_parameters))
        self.objects[WINDING_TEMPERATURE] = min(max(word, -_WORD_LIMIT), _WORD_LIMIT)

    def statusword(self) -> int:
        """Return 0x6041 of the present state and mode."""
        word = STATUSWORD[self.state] | _STATUS_REMOTE
        inputs = self.objects[DIGITAL_INPUTS]
        if not inputs & INPUT_INTERLOCK:
            word |= _STATUS_VOLTAGE
        if inputs & (INPUT_NEGATIVE_LIMIT | INPUT_POSITIVE_LIMIT) or self._limited[0]:
            word |= _STATUS_LIMITED
        if self.state == DriveState.OPERATION_ENABLED:
            if self._mode in (MODE_TORQUE, MODE_POSITION):
                word |= _STATUS_BIT_12  # the drive follows the command
            elif self._mode == MODE_HOMING:
                word |= _STATUS_BIT_12 if self._homed else 0
                word |= _STATUS_BIT_13 if self._homing_error else 0
                word |= 0 if self._homes else _STATUS_TARGET_REACHED
        elif self.state == DriveState.QUICK_STOP_ACTIVE and self.has_encoder and self.servo["at_rest"][0]:
            word |= _STATUS_TARGET_REACHED
        return word
