"""The rig's drives over literal frames: power states, modes, stops, watches, inputs. Bytes from CiA 301 / 402."""

import struct

import numpy as np
import pytest

from sim_backend import drive_servo
from sim_backend.drive_states import STATUSWORD, DriveState, next_state
from sim_backend.machine import Start, load_machine
from sim_backend.rig import Rig
from tests.stage import with_values

MS = 1_000_000
S = DriveState

# -- the table --------------------------------------------------------------------------------------------------------

TRANSITIONS = [  # IEC 61800-7-201 table: state, controlword, state after
    (S.SWITCH_ON_DISABLED, 0x0006, S.READY_TO_SWITCH_ON),  # 2
    (S.SWITCH_ON_DISABLED, 0x0007, S.SWITCH_ON_DISABLED),
    (S.SWITCH_ON_DISABLED, 0x000F, S.SWITCH_ON_DISABLED),
    (S.READY_TO_SWITCH_ON, 0x0007, S.SWITCHED_ON),  # 3
    (S.READY_TO_SWITCH_ON, 0x0002, S.SWITCH_ON_DISABLED),  # 7
    (S.READY_TO_SWITCH_ON, 0x0000, S.SWITCH_ON_DISABLED),  # 7
    (S.SWITCHED_ON, 0x000F, S.OPERATION_ENABLED),  # 4
    (S.SWITCHED_ON, 0x0006, S.READY_TO_SWITCH_ON),  # 6
    (S.SWITCHED_ON, 0x0000, S.SWITCH_ON_DISABLED),  # 10
    (S.SWITCHED_ON, 0x0002, S.SWITCH_ON_DISABLED),  # 10
    (S.OPERATION_ENABLED, 0x0007, S.SWITCHED_ON),  # 5
    (S.OPERATION_ENABLED, 0x0006, S.READY_TO_SWITCH_ON),  # 8
    (S.OPERATION_ENABLED, 0x0000, S.SWITCH_ON_DISABLED),  # 9
    (S.OPERATION_ENABLED, 0x0002, S.QUICK_STOP_ACTIVE),  # 11
    (S.OPERATION_ENABLED, 0x000F, S.OPERATION_ENABLED),
    (S.OPERATION_ENABLED, 0x001F, S.OPERATION_ENABLED),  # bit 4 is the mode's
    (S.QUICK_STOP_ACTIVE, 0x0000, S.SWITCH_ON_DISABLED),  # 12
    (S.QUICK_STOP_ACTIVE, 0x0006, S.QUICK_STOP_ACTIVE),
    (S.QUICK_STOP_ACTIVE, 0x000F, S.OPERATION_ENABLED),  # 16, option 6
    (S.FAULT, 0x000F, S.FAULT),
]


@pytest.mark.parametrize(("state", "controlword", "after"), TRANSITIONS)
def test_controlwords_move_the_power_states_as_the_standard_says(state, controlword, after):
    assert next_state(state, controlword, reset_edge=False, quick_stop_option=6) == after


def test_a_fault_is_left_by_the_edge_of_bit_7_only():
    assert next_state(S.FAULT, 0x0080, reset_edge=False, quick_stop_option=2) == S.FAULT
    assert next_state(S.FAULT, 0x0080, reset_edge=True, quick_stop_option=2) == S.SWITCH_ON_DISABLED


def test_quick_stop_is_not_left_by_enable_operation_with_a_disabling_option():
    assert next_state(S.QUICK_STOP_ACTIVE, 0x000F, False, 2) == S.QUICK_STOP_ACTIVE


def test_statuswords_of_the_states():
    masked = {state: word & 0x6F for state, word in STATUSWORD.items()}
    assert masked == {
        S.NOT_READY: 0x00, S.SWITCH_ON_DISABLED: 0x40, S.READY_TO_SWITCH_ON: 0x21, S.SWITCHED_ON: 0x23,
        S.OPERATION_ENABLED: 0x27, S.QUICK_STOP_ACTIVE: 0x07, S.FAULT_REACTION_ACTIVE: 0x0F, S.FAULT: 0x08,
    }  # fmt: skip


# -- a bench with one rig, driven by frames ---------------------------------------------------------------------------


class Bench:
    """A master made of frames: every byte is written here, none by our drivers."""

    def __init__(self, lacks_deadline: bool = False, **start) -> None:
        machine = load_machine("oled-printer")
        if lacks_deadline:
            machine = with_values(machine, macro__has_rpdo_deadline=False, micro__has_rpdo_deadline=False)
        if start:
            machine = machine.model_copy(update={"start": Start(**start)})
        self.rig = Rig(machine, seed=1)
        self.t_ns = self.rig.t_ns
        self.heard: list[tuple[int, bytes]] = []
        self.own_frames()

    def own_frames(self) -> list[tuple[int, bytes]]:
        frames = [(can_id, payload) for _, can_id, payload in self.rig.take_frames()]
        self.heard += frames
        return frames

    def wait(self, span_ms: float) -> list[tuple[int, bytes]]:
        self.t_ns += round(span_ms * MS)
        self.rig.advance(self.t_ns)
        return self.own_frames()

    def send(self, can_id: int, text: str | bytes) -> list[tuple[int, bytes]]:
        payload = bytes.fromhex(text) if isinstance(text, str) else text
        answers = self.rig.on_frame(can_id, payload, self.t_ns)
        self.heard += answers
        return answers

    def sdo(self, node_id: int, text: str) -> str:
        answers = [data for can_id, data in self.send(0x600 + node_id, text) if can_id == 0x580 + node_id]
        assert len(answers) == 1
        return answers[0].hex(" ")

    def write(self, node_id: int, index: int, sub: int, value: int, size: int) -> None:
        command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
        data = (value & (1 << 8 * size) - 1).to_bytes(4, "little")
        answer = self.sdo(node_id, struct.pack("<BHB", command, index, sub).hex() + data.hex())
        assert answer.startswith("60"), f"{index:04X}:{sub} = {value}: {answer}"

    def read(self, node_id: int, index: int, sub: int = 0, signed: bool = False) -> int:
        answer = bytes.fromhex(self.sdo(node_id, struct.pack("<BHB4x", 0x40, index, sub).hex()))
        size = 4 - (answer[0] >> 2 & 3)
        return int.from_bytes(answer[4 : 4 + size], "little", signed=signed)

    def map(self, node_id: int, communication: int, cob_id: int, entries: list[int], kind: int = 1) -> None:
        self.write(node_id, communication, 1, 0x8000_0000 | cob_id, 4)
        self.write(node_id, communication + 0x200, 0, 0, 1)
        for k, entry in enumerate(entries, 1):
            self.write(node_id, communication + 0x200, k, entry, 4)
        self.write(node_id, communication + 0x200, 0, len(entries), 1)
        self.write(node_id, communication, 2, kind, 1)
        self.write(node_id, communication, 1, cob_id, 4)

    def arm(self, node_id: int = 1, mode: int = 10, deadline_ms: int = 0, abort: int = 3, stop: int = 6) -> None:
        self.write(node_id, 0x6007, 0, abort, 2)
        self.write(node_id, 0x605A, 0, stop, 2)
        self.write(node_id, 0x6085, 0, 20_000_000, 4)  # 2 m/s^2 in counts of 100 nm
        self.write(node_id, 0x6072, 0, 4000, 2)
        self.write(node_id, 0x60C2, 1, 1, 1)
        self.write(node_id, 0x60C2, 2, -3, 1)
        self.write(node_id, 0x6060, 0, mode, 1)
        entries = [0x60400010, 0x607A0020, 0x60B20010] if mode == 8 else [0x60400010, 0x60710010]
        self.map(node_id, 0x1400, 0x200 + node_id, entries)
        if deadline_ms:
            self.write(node_id, 0x1400, 5, deadline_ms, 2)
        self.map(node_id, 0x1800, 0x180 + node_id, [0x60410010, 0x60640020, 0x60770010])
        self.map(node_id, 0x1801, 0x280 + node_id, [0x60FD0020], kind=255)
        self.send(0x000, bytes((1, node_id)))

    def cycle(self, rpdo: bytes, node_id: int = 1) -> tuple[int, int, int]:
        """One millisecond, RPDO, SYNC; return statusword, position, torque of the node's TPDO1."""
        self.wait(1.0)
        self.send(0x200 + node_id, rpdo)
        found = [data for can_id, data in self.send(0x080, b"") if can_id == 0x180 + node_id]
        assert len(found) == 1
        return struct.unpack("<Hih", found[0])

    def enable(self, node_id: int = 1, rest: bytes = bytes(2)) -> tuple[int, int, int]:
        for controlword in (0x0006, 0x0007, 0x000F):
            answer = self.cycle(struct.pack("<H", controlword) + rest, node_id)
        answer = self.cycle(struct.pack("<H", 0x000F) + rest, node_id)
        assert answer[0] & 0x6F == 0x27
        return answer

    def velocity(self) -> float:
        return self.rig.plant_state()["macro_velocity_m_per_s"]

    def accelerate(self, goal_m_per_s: float = 0.2) -> None:
        """Bring the macro to speed with 10 A."""
        while self.velocity() < goal_m_per_s:
            self.cycle(bytes.fromhex("0f00 d007"))  # 2000 = 200 % of 5 A


@pytest.fixture
def bench():
    return Bench()


# -- objects ----------------------------------------------------------------------------------------------------------


def test_nodes_boot_up_with_the_rigs_own_identity(bench):
    assert bench.heard[:2] == [(0x701, b"\x00"), (0x702, b"\x00")]
    assert bench.sdo(1, "40 18 10 01 00 00 00 00") == "43 18 10 01 54 52 00 00"
    assert bench.sdo(2, "40 18 10 02 00 00 00 00") == "43 18 10 02 02 00 01 00"
    assert bench.sdo(1, "40 75 60 00 00 00 00 00") == "43 75 60 00 88 13 00 00"  # 5000 mA


def test_a_mapping_changes_only_while_its_pdo_is_off(bench):
    assert bench.sdo(1, "2f 00 16 00 00 00 00 00") == "80 00 16 00 22 00 00 08"
    bench.write(1, 0x1400, 1, 0x80000201, 4)
    bench.write(1, 0x1600, 0, 0, 1)
    assert bench.sdo(1, "23 00 16 01 10 00 99 60") == "80 00 16 01 41 00 04 06"  # no such object
    assert bench.sdo(1, "23 00 16 01 08 00 40 60") == "80 00 16 01 41 00 04 06"  # wrong length
    bench.write(1, 0x1600, 1, 0x60400010, 4)
    bench.write(1, 0x1600, 0, 1, 1)
    assert bench.sdo(1, "23 00 16 02 10 00 71 60") == "80 00 16 02 22 00 00 08"


def test_values_that_the_drive_lacks_are_refused(bench):
    assert bench.sdo(1, "2f 60 60 00 03 00 00 00") == "80 60 60 00 30 00 09 06"  # profile velocity
    assert bench.sdo(2, "2f 60 60 00 08 00 00 00") == "80 60 60 00 30 00 09 06"  # the voice coil has no encoder
    assert bench.sdo(1, "2b 5a 60 00 09 00 00 00") == "80 5a 60 00 30 00 09 06"


def test_process_data_wait_for_operational(bench):
    bench.arm()
    bench.send(0x000, "80 01")  # pre-operational
    bench.heard.clear()
    bench.send(0x201, "06 00 00 00")
    assert bench.send(0x080, b"") == []
    assert bench.read(1, 0x6041) & 0x6F == 0x40


def test_a_stopped_node_answers_no_sdo(bench):
    bench.send(0x000, "02 01")
    assert bench.send(0x601, "40 18 10 01 00 00 00 00") == []


def test_heartbeats_come_at_their_period_and_tell_the_state(bench):
    bench.write(1, 0x1017, 0, 50, 2)
    bench.own_frames()
    assert [f for f in bench.wait(100) if f[0] == 0x701] == [(0x701, b"\x7f")] * 2
    bench.send(0x000, "01 00")
    assert (0x701, b"\x05") in bench.wait(50)


def test_reset_brings_back_the_defaults_and_boots_again(bench):
    bench.arm()
    bench.heard.clear()
    bench.send(0x000, "81 01")
    assert (0x701, b"\x00") in bench.heard
    assert bench.read(1, 0x1600, 0) == 1
    assert bench.read(1, 0x6072) == 1000


# -- process data -----------------------------------------------------------------------------------------------------


def test_a_synchronous_rpdo_takes_effect_at_the_next_sync(bench):
    bench.arm()
    bench.wait(1.0)
    assert bench.send(0x201, "06 00 00 00") == []
    assert bench.read(1, 0x6041) & 0x6F == 0x40
    (answer,) = [data for can_id, data in bench.send(0x080, b"") if can_id == 0x181]
    assert answer[:2] == bytes.fromhex("3102")  # ready to switch on, voltage, remote
    assert len(answer) == 8


def test_a_short_rpdo_is_reported_and_not_obeyed(bench):
    bench.arm()
    bench.enable()
    bench.wait(1.0)
    assert bench.send(0x201, "0f 00 d0") == [(0x081, bytes.fromhex("1082110000000000"))]
    bench.send(0x080, b"")
    assert bench.rig.drive(1).servo["torque_target_a"][0] == 0.0


def test_torque_goes_to_the_motor_and_is_reported(bench):
    bench.arm()
    bench.enable()
    for _ in range(5):
        word, _, torque = bench.cycle(bytes.fromhex("0f00 f401"))  # 500 = half of 5 A
    assert word & 0x1000  # follows the command
    assert torque == pytest.approx(500, abs=1)
    state = bench.rig.plant_state()
    assert state["macro_current_a"] == pytest.approx(2.5, rel=1e-3)
    assert state["macro_force_n"] == pytest.approx(2.5 * 99.0, rel=1e-2)  # the true constant, not the profile's 100


def test_max_torque_limits_the_current(bench):
    bench.arm()
    bench.write(1, 0x6072, 0, 300, 2)
    bench.enable()
    for _ in range(5):
        word, _, torque = bench.cycle(bytes.fromhex("0f00 e803"))
    assert torque == pytest.approx(300, abs=1)
    assert word & 0x0800  # internal limit active


def test_the_encoder_counts_100_nm_from_its_own_zero(bench):
    bench.arm()
    _, position, _ = bench.enable()
    truth = bench.rig.plant_state()["macro_position_m"]
    assert position == np.floor((truth + 0.0123) / 100e-9 + 0.5)


def test_cyclic_position_follows_its_targets(bench):
    bench.arm(mode=8)
    position = bench.read(1, 0x6064, signed=True)
    bench.enable(rest=struct.pack("<ih", position, 0))
    start = position
    for k in range(1, 401):  # 10 mm/s for 0.4 s, after a ramp of 0.1 s
        start += round(100 * min(1.0, k / 100))
        _, reached, _ = bench.cycle(struct.pack("<Hih", 0x0F, start, 0))
    for _ in range(400):
        word, reached, _ = bench.cycle(struct.pack("<Hih", 0x0F, start, 0))
    assert abs(reached - start) < 50  # 5 um
    assert word & 0x1000


def test_a_target_far_away_is_a_following_error_not_a_jump(bench):
    bench.arm(mode=8)
    position = bench.read(1, 0x6064, signed=True)
    bench.enable(rest=struct.pack("<ih", position, 0))
    word, _, _ = bench.cycle(struct.pack("<Hih", 0x0F, position + 1_000_000, 0))
    assert word & 0x6F in (0x0F, 0x08)
    assert (0x081, bytes.fromhex("1186200000000000")) in bench.heard


@pytest.mark.parametrize(("method", "start_m"), [(34, -0.003), (33, 0.003)])
def test_homing_finds_the_index_mark(method, start_m):
    bench = Bench(macro_position_m=start_m, relative_position_m=5e-5)
    bench.arm(mode=6)
    bench.write(1, 0x6098, 0, method, 1)
    bench.write(1, 0x607C, 0, 1000, 4)
    bench.enable()
    for _ in range(3000):
        word, _, _ = bench.cycle(bytes.fromhex("1f00 0000"))
        assert not word & 0x2000
        if word & 0x1400 == 0x1400:
            break
    assert word & 0x1400 == 0x1400  # attained, target reached
    for _ in range(300):
        word, position, _ = bench.cycle(bytes.fromhex("1f00 0000"))
    truth = bench.rig.plant_state()["macro_position_m"]
    assert position == pytest.approx(1000 + truth / 100e-9, abs=1.0)  # the mark is at the laser's zero


def test_homing_away_from_the_mark_runs_into_the_end_and_says_so():
    bench = Bench(macro_position_m=0.49, relative_position_m=5e-5)
    bench.arm(mode=6)
    bench.enable()
    for _ in range(3000):
        word, _, _ = bench.cycle(bytes.fromhex("1f00 0000"))  # method 34, the mark is behind
        if word & 0x2000:
            break
    assert word & 0x3000 == 0x2000  # homing error, not attained


# -- stops ------------------------------------------------------------------------------------------------------------


def stopping_distance(bench: Bench, limit_ms: float = 500.0) -> tuple[float, float]:
    """Let time pass until |v| < 1 mm/s; return (distance in m, time in s)."""
    begin = bench.rig.plant_state()["macro_position_m"]
    waited = 0.0
    while abs(bench.velocity()) >= 1e-3:
        bench.wait(0.25)
        waited += 0.25
        assert waited < limit_ms
    return abs(bench.rig.plant_state()["macro_position_m"] - begin), 1e-3 * waited


def test_quick_stop_follows_its_ramp_and_holds(bench):
    bench.arm()
    bench.enable()
    bench.accelerate(0.2)
    word, _, _ = bench.cycle(bytes.fromhex("0200 0000"))
    assert word & 0x6F == 0x07
    speed = bench.velocity()
    begin = bench.rig.plant_state()["macro_position_m"]
    distance, seconds = stopping_distance(bench)
    assert distance <= speed**2 / (2 * 2.0) + 0.2e-3
    assert seconds == pytest.approx(speed / 2.0, rel=0.1)
    bench.wait(1000)
    assert abs(bench.velocity()) < 1e-4
    assert bench.rig.plant_state()["macro_position_m"] - begin == pytest.approx(distance, abs=0.3e-3)
    assert bench.read(1, 0x6041) & 0x6F == 0x07
    assert bench.read(1, 0x6041) & 0x0400  # reached standstill


def way_beyond_ramp_m(macro):
    """How far a macro with 40 kg that go with it rigidly swings beyond its ramp of 2 m/s^2 from 0.1 m/s."""
    told = drive_servo.parameters(macro)
    servo = drive_servo.init(told, 0.0)
    position_m, velocity, dt_s = 0.0, 0.1, 62.5e-6
    servo["velocity_m_per_s"], servo["ramp_m_per_s2"], servo["current_limit_a"] = velocity, 2.0, 20.0
    drive_servo.enter(servo, drive_servo.STOPPING)
    furthest_m = 0.0
    for _ in range(4000):
        drive_servo.step(servo, told, position_m, dt_s)
        force_n = macro.force_constant_n_per_a * float(servo["current_command_a"][0])
        velocity += force_n / (macro.mass_kg + 40.0) * dt_s
        position_m += velocity * dt_s
        furthest_m = max(furthest_m, position_m)
    return furthest_m - 0.1**2 / (2.0 * 2.0)


def test_a_drive_that_was_told_its_load_follows_its_ramp():
    macro = load_machine("oled-printer").macro
    assert macro.commissioned_load_kg == 40.0
    assert abs(way_beyond_ramp_m(macro)) < 5e-6
    assert way_beyond_ramp_m(macro.model_copy(update={"commissioned_load_kg": 0.0})) > 50e-6


def test_quick_stop_option_2_ends_without_power(bench):
    bench.arm(stop=2)
    bench.enable()
    bench.accelerate(0.1)
    bench.cycle(bytes.fromhex("0200 0000"))
    bench.wait(500)
    assert bench.read(1, 0x6041) & 0x6F == 0x40
    assert bench.rig.plant_state()["macro_current_a"] == 0.0


def test_a_quick_stop_by_controlword_may_be_taken_back(bench):
    bench.arm()
    bench.enable()
    bench.cycle(bytes.fromhex("0200 0000"))
    word, _, _ = bench.cycle(bytes.fromhex("0f00 0000"))
    assert word & 0x6F == 0x27


@pytest.mark.parametrize("speed_goal", [0.05, 0.2])
def test_a_dead_servo_is_noticed_and_the_macro_stops_within_the_bound(speed_goal):
    bench = Bench()
    bench.arm(deadline_ms=10)
    bench.enable()
    bench.accelerate(speed_goal)  # the last command keeps on pushing with 10 A
    speed = bench.velocity()
    pushed = 2.0 * 99.0 * 5.0 / 70.7  # at most: macro alone
    t = 0.010 + 0.001
    bound = speed * t + pushed * t**2 / 2 + (speed + pushed * t) ** 2 / (2 * 2.0)
    bench.heard.clear()
    distance, _ = stopping_distance_after_push(bench)
    assert distance <= bound
    assert (0x081, bytes.fromhex("5082110000000000")) in bench.heard  # EMCY 0x8250
    place = bench.rig.plant_state()["macro_position_m"]
    bench.wait(2000)
    assert bench.rig.plant_state()["macro_position_m"] == pytest.approx(place, abs=1e-3)
    # after that no command is followed, until the voltage was disabled
    word, _, _ = bench.cycle(bytes.fromhex("0f00 d007"))
    assert word & 0x6F == 0x07
    assert abs(bench.rig.plant_state()["macro_current_a"]) < 2.0
    word, _, _ = bench.cycle(bytes.fromhex("0000 0000"))
    assert word & 0x6F == 0x40


def stopping_distance_after_push(bench: Bench) -> tuple[float, float]:
    """As `stopping_distance`, from the last RPDO on: the speed may grow first."""
    begin = bench.rig.plant_state()["macro_position_m"]
    bench.wait(10.5)
    assert bench.velocity() > 0.0
    _, seconds = stopping_distance(bench)
    return bench.rig.plant_state()["macro_position_m"] - begin, seconds


def test_time_that_the_rig_was_held_up_is_no_silence(bench):
    bench.arm(deadline_ms=10)
    bench.enable()
    bench.wait(8)
    bench.rig.postpone_watches(5 * MS)
    bench.wait(6)
    assert bench.rig.drive(1).state == S.OPERATION_ENABLED
    bench.wait(2)
    assert bench.rig.drive(1).state == S.QUICK_STOP_ACTIVE


def test_a_missing_heartbeat_stops_the_drive(bench):
    bench.arm()
    bench.write(1, 0x1016, 1, 0x7E << 16 | 40, 4)
    bench.enable()
    bench.send(0x77E, "05")
    for _ in range(39):
        bench.cycle(bytes.fromhex("0f00 0000"))
    bench.send(0x77E, "05")
    for _ in range(39):
        word, _, _ = bench.cycle(bytes.fromhex("0f00 0000"))
    assert word & 0x6F == 0x27
    for _ in range(3):
        word, _, _ = bench.cycle(bytes.fromhex("0f00 0000"))
    assert word & 0x6F == 0x07
    assert (0x081, bytes.fromhex("3081110000000000")) in bench.heard


def test_a_missing_sync_stops_the_drive(bench):
    bench.arm()
    bench.write(1, 0x1006, 0, 1000, 4)
    bench.enable()
    bench.wait(19)
    assert bench.rig.drive(1).state == S.OPERATION_ENABLED
    bench.wait(2)
    assert bench.rig.drive(1).state == S.QUICK_STOP_ACTIVE
    assert (0x081, bytes.fromhex("0087110000000000")) in bench.heard


@pytest.mark.parametrize(
    ("option", "state"), [(0, S.OPERATION_ENABLED), (1, S.FAULT), (2, S.SWITCH_ON_DISABLED), (3, S.QUICK_STOP_ACTIVE)]
)
def test_abort_connection_options(option, state):
    bench = Bench()
    bench.arm(deadline_ms=10, abort=option)
    bench.enable()
    bench.wait(200)
    assert bench.rig.drive(1).state == state


@pytest.mark.parametrize("node_id", [1, 2])
def test_a_drive_may_lack_the_rpdo_deadline(node_id):
    """Sub-index 5 is aborted with 0609 0011h (no such sub-index), and the highest is 3."""
    bench = Bench(lacks_deadline=True)
    assert bench.sdo(node_id, "2b 00 14 05 0a 00 00 00") == "80 00 14 05 11 00 09 06"
    assert bench.sdo(node_id, "40 00 14 05 00 00 00 00") == "80 00 14 05 11 00 09 06"
    assert bench.read(node_id, 0x1400, 0) == 3


def test_under_the_cap_a_stale_torque_moves_the_micro_less_than_a_third_of_its_way():
    """2337 words (140.2 N of 60 N x 300 %) on 70 and 40 kg, a heartbeat of 10 ms; see `drivers.arming.StaleTorque`."""
    bench = Bench(lacks_deadline=True)
    bench.arm(node_id=2, stop=2)
    bench.write(2, 0x6072, 0, 2337, 2)
    bench.write(2, 0x1016, 1, 0x7E << 16 | 10, 4)
    bench.enable(node_id=2)
    state = bench.rig.plant_state()
    before_m = state["end_position_m"] - state["macro_position_m"]
    bench.cycle(struct.pack("<Hh", 0x0F, 3000), node_id=2)  # more than it may give
    bench.send(0x77E, "05")  # the last of the servo
    waited_ms = 0.0
    while bench.rig.drive(2).state == S.OPERATION_ENABLED:
        bench.wait(0.25)
        waited_ms += 0.25
        assert waited_ms <= 11.0
    assert waited_ms == 10.0
    assert (0x082, bytes.fromhex("3081110000000000")) in bench.heard
    state = bench.rig.plant_state()
    moved_m = abs(state["end_position_m"] - state["macro_position_m"] - before_m)
    assert 0.2e-3 < moved_m < 1e-3 / 3.0


def test_leaving_operational_counts_as_a_lost_connection(bench):
    bench.arm()
    bench.enable()
    bench.send(0x000, "80 00")
    assert bench.rig.drive(1).state == S.QUICK_STOP_ACTIVE


def test_the_voice_coil_is_shorted_when_it_stops(bench):
    bench.arm(node_id=2)
    bench.enable(node_id=2)
    for _ in range(20):
        bench.cycle(bytes.fromhex("0f00 2c01"), node_id=2)
    state = bench.rig.plant_state()
    assert abs(state["end_velocity_m_per_s"] - state["macro_velocity_m_per_s"]) > 5e-3
    bench.cycle(bytes.fromhex("0200 0000"), node_id=2)
    bench.wait(300)
    state = bench.rig.plant_state()
    relative = state["end_velocity_m_per_s"] - state["macro_velocity_m_per_s"]
    assert abs(relative) < 2e-3
    assert int(bench.rig.drive(2).servo["bridge"][0]) == 2


# -- faults and inputs ------------------------------------------------------------------------------------------------


def test_a_fault_brakes_reports_and_needs_a_reset(bench):
    bench.arm()
    bench.enable()
    bench.accelerate(0.1)
    bench.rig.nodes[0].raise_fault(0x2310, bench.t_ns)
    assert bench.rig.drive(1).state == S.FAULT_REACTION_ACTIVE
    for _ in range(100):
        if bench.rig.drive(1).state == S.FAULT:
            break
        bench.wait(1.0)
    assert bench.rig.drive(1).state == S.FAULT
    assert abs(bench.velocity()) < 2e-3
    assert bench.read(1, 0x603F) == 0x2310
    word, _, _ = bench.cycle(bytes.fromhex("0f00 0000"))
    assert word & 0x6F == 0x08
    word, _, _ = bench.cycle(bytes.fromhex("8000 0000"))
    assert word & 0x6F == 0x40
    assert (0x081, bytes(8)) in bench.heard  # error reset


def test_safe_torque_off_takes_the_current_at_once(bench):
    bench.arm()
    bench.enable()
    bench.accelerate(0.05)
    frames = bench.rig.nodes[0].set_inputs(0x0008, bench.t_ns)
    assert (0x281, bytes.fromhex("08000000")) in frames
    assert (0x081, bytes.fromhex("0090010000000000")) in frames
    bench.wait(1.0)
    assert bench.rig.plant_state()["macro_current_a"] == 0.0
    word, _, _ = bench.cycle(bytes.fromhex("0f00 0000"))
    assert word & 0x7F == 0x08  # fault, no voltage
    bench.cycle(bytes.fromhex("8000 0000"))
    word, _, _ = bench.cycle(bytes.fromhex("0600 0000"))
    assert word & 0x6F == 0x40  # never up while it is open


@pytest.mark.parametrize("bit", [0x0001, 0x0002, 0x1_0000])
def test_limit_and_pressure_inputs_stop_the_drive(bench, bit):
    bench.arm()
    bench.enable()
    bench.accelerate(0.05)
    bench.rig.nodes[0].set_inputs(bit, bench.t_ns)
    word, _, _ = bench.cycle(bytes.fromhex("0f00 d007"))
    assert word & 0x6F == 0x07
    bench.wait(100)
    assert abs(bench.velocity()) < 1e-3


def test_inputs_are_sent_on_change_and_keep_their_inhibit_time(bench):
    bench.arm()
    bench.send(0x000, "80 01")
    bench.write(1, 0x1801, 1, 0x80000281, 4)
    bench.write(1, 0x1801, 3, 20, 2)  # 2 ms
    bench.write(1, 0x1801, 1, 0x281, 4)
    assert (0x281, bytes(4)) in bench.send(0x000, "01 01")  # once on entering operational
    bench.wait(5)
    node = bench.rig.nodes[0]
    assert (0x281, bytes.fromhex("04000000")) in node.set_inputs(0x4, bench.t_ns)
    assert node.set_inputs(0x0, bench.t_ns) == []  # inhibited
    bench.rig.on_frame(0x000, bytes.fromhex("0101"), bench.t_ns)  # lets the rig plan the node's timers
    assert bench.wait(1.9) == []
    assert bench.wait(0.2) == [(0x281, bytes(4))]
