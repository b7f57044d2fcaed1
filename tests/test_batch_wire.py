"""The wire in virtual time: instants, load, order, faults, determinism, and the drivers' own master on it."""

import math
import struct

import can
import pytest

from sim_backend.batch import BatchWire, attach_all
from sim_backend.bus_load import frame_bits
from sim_backend.faults import Fault
from sim_backend.machine import list_machines, load_machine
from sim_backend.rig import Rig
from stagectl.errors import LinkError

MS = 1_000_000
MAPS = {
    0x1400: (0x201, [0x60400010, 0x60710010], 1),
    0x1800: (0x181, [0x60410010, 0x60640020, 0x60770010], 1),
    0x1801: (0x281, [0x60FD0020], 255),
}


@pytest.fixture
def machine():
    return load_machine("oled-printer")


@pytest.fixture
def wire_of():
    made: list[BatchWire] = []

    def make(machine, faults=(), seed=1, **options) -> BatchWire:
        made.append(BatchWire(Rig(machine, seed, faults=faults), **options))
        return made[-1]

    yield make
    for wire in made:
        wire.close()


def sdo_write(wire: BatchWire, node_id: int, index: int, sub: int, value: int, size: int) -> None:
    heard: list[tuple[int, bytes]] = []
    wire.network_bus.attach(lambda can_id, data, t_s: heard.append((can_id, bytes(data))))
    command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
    payload = struct.pack("<BHBI", command, index, sub, value & 0xFFFF_FFFF)
    wire.network_bus.send(can.Message(arbitration_id=0x600 + node_id, data=payload, is_extended_id=False))
    assert [data[0] for can_id, data in heard if can_id == 0x580 + node_id] == [0x60]


def arm(wire: BatchWire) -> None:
    """Map both drives and start them, with frames written here."""
    for node_id in (1, 2):
        for communication, (cob_id, entries, kind) in MAPS.items():
            sdo_write(wire, node_id, communication, 1, 0x8000_0000 | cob_id - 1 + node_id, 4)
            sdo_write(wire, node_id, communication + 0x200, 0, 0, 1)
            for k, entry in enumerate(entries, 1):
                sdo_write(wire, node_id, communication + 0x200, k, entry, 4)
            sdo_write(wire, node_id, communication + 0x200, 0, len(entries), 1)
            sdo_write(wire, node_id, communication, 2, kind, 1)
            sdo_write(wire, node_id, communication, 1, cob_id - 1 + node_id, 4)
        sdo_write(wire, node_id, 0x6060, 0, 10, 1)
        sdo_write(wire, node_id, 0x6007, 0, 3, 2)
        sdo_write(wire, node_id, 0x605A, 0, 6, 2)
        sdo_write(wire, node_id, 0x1400, 5, 10, 2)
    wire.network_bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))


def cycle(wire: BatchWire, controlword: int, macro: int = 0, micro: int = 0) -> list[tuple[int, int, bytes]]:
    """One millisecond: frames of the last SYNC with their arrival, then RPDOs (micro first) and SYNC."""
    wire.advance_to(wire.t_ns + MS)
    heard = []
    while (frame := wire.cyclic.receive()) is not None:
        heard.append((wire.cyclic.arrival_t_ns, *frame))
    wire.cyclic.send(0x202, struct.pack("<Hh", controlword, micro))
    wire.cyclic.send(0x201, struct.pack("<Hh", controlword, macro))
    wire.cyclic.send(0x080, b"")
    return heard


def enable(wire: BatchWire) -> None:
    for controlword in (0x06, 0x07, 0x0F, 0x0F, 0x0F):
        cycle(wire, controlword)


def test_frames_take_their_time_on_the_bus(machine, wire_of):
    wire = wire_of(machine)
    arm(wire)
    cycle(wire, 6)
    begin_t_ns = wire.t_ns
    heard = cycle(wire, 6)
    micro_bits = frame_bits(0x202, bytes.fromhex("06000000"))
    macro_bits = frame_bits(0x201, bytes.fromhex("06000000"))
    sync_t_ns = begin_t_ns + 1000 * (micro_bits + macro_bits + 51 - 3)
    assert wire.last_sync_t_ns == sync_t_ns
    (first_t_ns, first_id, first), (second_t_ns, second_id, second) = heard
    assert (first_id, second_id) == (0x181, 0x182)  # both ready 20 us after SYNC: the lower id wins
    assert first_t_ns == sync_t_ns + 20_000 + 1000 * (frame_bits(0x181, first) - 3)
    assert second_t_ns == first_t_ns + 3000 + 1000 * (frame_bits(0x182, second) - 3)


def test_without_bus_load_frames_arrive_at_once(machine, wire_of):
    wire = wire_of(machine, bus_load=False)
    arm(wire)
    cycle(wire, 6)
    begin_t_ns = wire.t_ns
    heard = cycle(wire, 6)
    assert [t_ns for t_ns, _, _ in heard] == [begin_t_ns + 20_000] * 2


def test_the_load_of_a_cycle_is_that_of_the_reference(machine, wire_of):
    wire = wire_of(machine)
    arm(wire)
    enable(wire)
    begin_t_ns, begin_busy_ns = wire.t_ns, wire.bus.busy_ns
    for k in range(200):
        cycle(wire, 0x0F, k, -k)
    load = (wire.bus.busy_ns - begin_busy_ns) / (wire.t_ns - begin_t_ns)
    assert 0.43 < load < 0.515  # 46 % typical, 51.5 % worst case


def test_time_stands_still_for_the_master(machine, wire_of):
    wire = wire_of(machine)
    before = wire.rig.plant_state()
    arm(wire)
    assert wire.t_ns == wire.rig.start_t_ns
    assert wire.rig.plant_state() == before


def test_what_was_sent_in_the_future_is_not_heard_now(machine, wire_of):
    wire = wire_of(machine)
    arm(wire)
    cycle(wire, 6)
    wire.advance_to(wire.t_ns + 100_000)
    assert [frame for frame in iter(wire.cyclic.receive, None) if frame[0] == 0x181] == []


def test_serial_bytes_come_at_their_arrival(machine, wire_of):
    wire = wire_of(machine)
    line_t_ns = wire.next_line_t_ns()
    wire.advance_to(line_t_ns - 1)
    assert wire.serial.read() == b""
    wire.advance_to(line_t_ns)
    assert len(wire.serial.read()) == 25
    assert wire.serial.arrival_t_ns == line_t_ns
    wire.advance_to(line_t_ns + 3 * MS + 900_000)
    assert len(wire.serial.read()) in (75, 100)
    assert wire.serial.arrival_t_ns <= wire.t_ns


def test_the_next_line_is_known_before_its_sample(machine, wire_of):
    wire = wire_of(machine)
    for _ in range(50):
        line_t_ns = wire.next_line_t_ns()
        assert line_t_ns > wire.t_ns
        wire.advance_to(line_t_ns)
        assert len(wire.serial.read()) == 25


def test_a_full_queue_refuses_and_counts(machine, wire_of):
    wire = wire_of(machine)
    assert [wire.cyclic.send(0x201, bytes(4)) for _ in range(12)] == [True] * 10 + [False] * 2
    assert wire.cyclic.lost_count == 2


def test_ids_choose_what_the_servo_hears(machine, wire_of):
    wire = wire_of(machine)
    arm(wire)
    wire.cyclic.set_ids([0x182])
    cycle(wire, 6)
    assert [can_id for _, can_id, _ in cycle(wire, 6)] == [0x182]


def test_two_runs_are_equal_to_the_last_bit(machine, wire_of):
    def run() -> tuple[list, dict[str, float]]:
        wire = wire_of(machine, seed=4)
        arm(wire)
        enable(wire)
        heard = []
        for k in range(300):
            heard += cycle(wire, 0x0F, k % 50, 100 - k % 90)
            heard.append(wire.serial.read())
        return heard, wire.rig.plant_state()

    assert run() == run()


def test_a_lost_and_a_late_frame(machine, wire_of):
    faults = [
        Fault("drop_frame", at_s=0.010, count=1, can_id=0x181),
        Fault("delay_frame", at_s=0.020, count=1, can_id=0x182, delay_s=2e-3),
        Fault("duplicate_frame", at_s=0.030, count=1, can_id=0x181),
        Fault("short_frame", at_s=0.040, count=1, can_id=0x181, length_count=5),
    ]
    wire = wire_of(machine, faults)
    arm(wire)
    heard = [[(can_id, len(data)) for _, can_id, data in cycle(wire, 6)] for _ in range(60)]
    usual = [(0x181, 8), (0x182, 8)]
    unusual = [frames for frames in heard[3:] if frames != usual]
    assert unusual == [
        [(0x182, 8)],
        [(0x181, 8)],
        [(0x181, 8), (0x182, 8), (0x182, 8)],
        [(0x181, 8), (0x181, 8), (0x182, 8)],
        [(0x181, 5), (0x182, 8)],
    ]


def test_what_the_master_asks_goes_through_the_faults_too(machine, wire_of):
    faults = [
        Fault("drop_frame", at_s=0.010, count=1, can_id=0x581),
        Fault("drop_frame", at_s=0.010, count=1, can_id=0x602),
        Fault("corrupt_frame", at_s=0.030, count=1, can_id=0x581, bits=0x1),
        Fault("bus_off", at_s=0.040, duration_s=0.010),
        Fault("delay_frame", at_s=0.060, count=1, can_id=0x581, delay_s=2e-3),
    ]
    wire, heard = wire_of(machine, faults), []
    start_t_ns = wire.t_ns
    wire.network_bus.attach(lambda can_id, data, t_s: heard.append((can_id, data[0])))

    def asked(node_id):
        """What is heard at once of a question for object 0x1000."""
        heard.clear()
        payload = bytes([0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0])
        wire.network_bus.send(can.Message(arbitration_id=0x600 + node_id, data=payload, is_extended_id=False))
        return [(can_id, first) for can_id, first in heard if can_id & 0x780 == 0x580]

    answers = {node_id: [(0x580 + node_id, 0x43)] for node_id in (1, 2)}
    assert [asked(1), asked(2)] == [answers[1], answers[2]]
    wire.advance_to(start_t_ns + 12 * MS)
    assert [asked(1), asked(2)] == [[], []]
    assert [asked(1), asked(2)] == [answers[1], answers[2]]
    wire.advance_to(start_t_ns + 32 * MS)
    assert asked(1) == [(0x581, 0x42)]
    wire.advance_to(start_t_ns + 42 * MS)
    assert [asked(1), asked(2)] == [[], []]
    wire.advance_to(start_t_ns + 62 * MS)
    assert asked(1) == []
    wire.advance_to(start_t_ns + 65 * MS)
    assert [(can_id, first) for can_id, first in heard if can_id == 0x581] == answers[1]


def test_bus_off_is_seen_by_both_ends(machine, wire_of):
    wire = wire_of(machine, [Fault("bus_off", at_s=0.020, duration_s=0.005)])
    arm(wire)
    enable(wire)
    heard = [cycle(wire, 0x0F) for _ in range(30)]
    errors = [can_id for frames in heard for _, can_id, _ in frames if can_id & 0x2000_0000]
    assert errors == [0x2000_0040]
    assert wire.cyclic.lost_count >= 12
    words = {struct.unpack_from("<H", data)[0] & 0x6F for _, can_id, data in heard[-1] if can_id == 0x181}
    assert words == {0x07}  # the drive stopped, and a returning bus does not set it going again


def test_an_unplugged_sensor_is_a_link_error(machine, wire_of):
    wire = wire_of(machine, [Fault("unplug", at_s=0.010, duration_s=0.010)])
    wire.advance_to(wire.t_ns + 15 * MS)
    with pytest.raises(LinkError, match="unplugged"):
        wire.serial.read()
    wire.advance_to(wire.t_ns + 15 * MS)
    assert wire.serial.read()


def test_an_input_fault_reaches_the_servo_as_a_pdo_and_the_master_as_an_emergency(machine, wire_of):
    wire = wire_of(machine, [Fault("input", at_s=0.020, node_id=1, bits=8)])
    arm(wire)
    enable(wire)
    emergencies = []
    wire.network_bus.attach(lambda can_id, data, t_s: emergencies.append((can_id, bytes(data))))
    heard = [(can_id, data) for _ in range(30) for _, can_id, data in cycle(wire, 0x0F)]
    assert (0x281, bytes.fromhex("08000000")) in heard
    assert (0x081, bytes.fromhex("0090010000000000")) in heard
    assert emergencies == [(0x081, bytes.fromhex("0090010000000000"))]


def test_a_stuck_statusword_repeats(machine, wire_of):
    wire = wire_of(machine, [Fault("stuck_statusword", at_s=0.006, node_id=1)])
    arm(wire)
    for _ in range(4):
        cycle(wire, 0x00)
    heard = [data[:2] for word in (6, 6, 7, 15, 15, 15) for _, can_id, data in cycle(wire, word) if can_id == 0x181]
    assert len(set(heard[3:])) == 1
    assert wire.rig.drive(1).state.name == "OPERATION_ENABLED"


def test_listeners_hear_synchronously(machine, wire_of):
    wire = wire_of(machine)
    heard: list[can.Message] = []
    attach_all(wire, [heard.append])
    wire.network_bus.send(
        can.Message(arbitration_id=0x601, data=bytes.fromhex("4018100100000000"), is_extended_id=False)
    )
    boot_up, answer = heard[:2], heard[2]
    assert [message.arbitration_id for message in boot_up] == [0x701, 0x702]
    assert answer.data.hex() == "4318100154520000"


@pytest.mark.parametrize("name", list_machines())
def test_every_machine_runs(name, wire_of):
    machine = load_machine(name)
    wire = wire_of(machine)
    for node in wire.rig.nodes:
        sdo_write(wire, node.node_id, 0x1017, 0, 50, 2)
    wire.advance_to(wire.t_ns + 200 * MS)
    assert len(wire.serial.read()) > 190 * 6
    state = wire.rig.plant_state()
    assert all(math.isfinite(value) for value in state.values())
    assert abs(state["macro_position_m"] - machine.start.macro_position_m) < 1e-3
    assert wire.bus.frames_count == 3 * len(wire.rig.nodes)  # 50, 100, 150 ms; that of 200 ms begins just now


def test_the_drivers_master_arms_the_rig(machine, wire_of):
    from drivers import arming, canopen_master

    wire = wire_of(machine)
    master = canopen_master.Master(wire.network_bus, synchronous=True)
    drives = [
        arming.DriveSettings(
            node_id=node_id,
            eds_path=str(machine.eds_path(axis)),
            identity=(0x5254, product),
            mode="torque",
            rated_torque_word=rated,
            max_torque_word=3000,
            quick_stop_deceleration_word=20_000_000,
            quick_stop_option=6,
            heartbeat_ms=200,
            rated_current_word=current,
        )
        for node_id, axis, product, rated, current in (
            (1, "macro", 0x10001, 500_000, 5000),
            (2, "micro", 0x10002, 60_000, 2000),
        )
    ]
    mappings = arming.configure(master, drives)
    master.nmt(0, "start")
    assert [mapping.tpdo_id for mapping in mappings] == [0x181, 0x182]
    enable(wire)
    assert wire.rig.drive(1).state.name == wire.rig.drive(2).state.name == "OPERATION_ENABLED"
    master.close()
