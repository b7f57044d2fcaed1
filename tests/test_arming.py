"""Arming against true CANopen nodes (`canopen.LocalNode` loaded with our EDS files) and our EDS files themselves."""

import configparser
import pickle
import re
import threading
import time
from dataclasses import replace
from pathlib import Path

import can
import canopen
import pytest
from canopen.sdo.exceptions import SdoAbortedError

from drivers import cia402
from drivers.arming import (
    DriveSettings,
    StaleTorque,
    configure,
    detection_time_s,
    heartbeat_producer_ms,
    interpolation_words,
    read_rated_values,
    torque_cap_n,
)
from drivers.can_bus import open_network
from drivers.canopen_master import Master
from drivers.pdo import Codec
from stagectl.errors import DriveError, LinkError, ProfileError

PROFILES = Path(__file__).parent.parent / "profiles"
EDS_LINEAR = str(PROFILES / "stagectl-linear-motor.eds")
EDS_VOICE = str(PROFILES / "stagectl-voice-coil.eds")

MACRO = DriveSettings(
    node_id=1,
    eds_path=EDS_LINEAR,
    identity=(0x539, 0x10001),
    mode="torque",
    rated_torque_word=500_000,
    max_torque_word=4000,
    quick_stop_deceleration_word=20_000_000,
    quick_stop_option=6,
    heartbeat_ms=200,
    rated_current_word=5000,
    encoder_step_m=100e-9,
)
MICRO = DriveSettings(
    node_id=2,
    eds_path=EDS_VOICE,
    identity=(0x539, 0x10002),
    mode="torque",
    rated_torque_word=60_000,
    max_torque_word=3000,
    quick_stop_deceleration_word=20_000_000,
    quick_stop_option=2,
    heartbeat_ms=200,
    rated_current_word=2000,
)


class IdleTask:
    """A periodic task that nobody runs: this bus has no time."""

    def stop(self):
        pass

    def modify_data(self, messages):
        pass


class InstantBus(can.BusABC):
    """One end of a bus in this thread: a frame is delivered before `send` returns, and kept in `frames`."""

    def __init__(self, ends, frames):
        self.ends, self.frames, self.deliver = ends, frames, None
        ends.append(self)
        super().__init__(channel="instant")

    def attach(self, notify):
        self.deliver = notify

    def send(self, msg, timeout=None):
        self.frames.append((msg.arbitration_id, bytes(msg.data)))
        for end in self.ends:
            if end is not self and end.deliver is not None:
                end.deliver(msg.arbitration_id, bytearray(msg.data), 0.0)

    def _send_periodic_internal(self, *args, **kwargs):
        return IdleTask()


class Drive(canopen.LocalNode):
    """A CiA 402 drive as an object dictionary, with what it won't store and what it refuses."""

    def __init__(self, node_id, eds_path):
        super().__init__(node_id, eds_path)
        self.stuck = {}  # (index, subindex) -> value that reading gives whatever was written
        self.refused = {}  # (index, subindex) -> SDO abort code
        self.written = []
        self.add_read_callback(lambda index, subindex, od: self.stuck.get((index, subindex)))
        self.add_write_callback(self.on_write)

    def on_write(self, index, subindex, od, data):
        self.written.append((index, subindex, bytes(data)))
        if (index, subindex) in self.refused:
            raise SdoAbortedError(self.refused[index, subindex])


class Bench:
    """A master and two drives on an instant bus; `now_s` is its clock."""

    def __init__(self, eds_macro=EDS_LINEAR):
        self.frames, self.now_s, ends = [], 0.0, []
        self.master = Master(InstantBus(ends, self.frames), synchronous=True, clock_s=lambda: self.now_s)
        bus = InstantBus(ends, self.frames)
        self.network = canopen.Network(bus)
        bus.attach(self.network.notify)
        self.macro = self.network.create_node(Drive(1, eds_macro))
        self.micro = self.network.create_node(Drive(2, EDS_VOICE))

    def close(self):
        self.master.close()
        self.network.disconnect()


@pytest.fixture
def bench():
    opened = Bench()
    yield opened
    opened.close()


def test_torque_mode_gives_the_mapping_read_back(bench):
    macro, micro = configure(bench.master, [MACRO, MICRO])
    assert (macro.node_id, macro.rpdo_id, macro.tpdo_id, macro.inputs_id, macro.emcy_id) == (
        1,
        0x201,
        0x181,
        0x281,
        0x081,
    )
    assert (micro.node_id, micro.rpdo_id, micro.tpdo_id, micro.inputs_id, micro.emcy_id) == (
        2,
        0x202,
        0x182,
        0x282,
        0x082,
    )
    assert macro.rpdo.names == ("controlword", "target_torque")
    assert macro.rpdo.encode(15, -123) == bytes.fromhex("0F 00 85 FF")
    assert macro.tpdo.names == ("statusword", "position", "torque")
    assert macro.inputs_tpdo.names == micro.inputs_tpdo.names == ("digital_inputs", "mode_display")
    assert pickle.loads(pickle.dumps(macro)) == macro


def test_position_mode_carries_a_torque_offset(bench):
    (macro,) = configure(bench.master, [replace(MACRO, mode="position")])
    assert macro.rpdo.names == ("controlword", "target_position", "torque_offset")
    assert macro.rpdo.length_bytes == 8
    assert bench.macro.data_store[0x6060][0] == b"\x08"


def test_what_the_drive_holds_afterwards(bench):
    configure(bench.master, [MACRO])
    held = bench.macro.data_store
    expected = {
        (0x1005, 0): "80000000",
        (0x1006, 0): "E8030000",  # 1000 us
        (0x1014, 0): "81000000",
        (0x1016, 1): "C8007E00",  # 200 ms = 0x00C8 below node id 0x7E
        (0x1017, 0): "3200",  # a quarter: 50 ms
        (0x1400, 1): "01020000",
        (0x1400, 2): "01",
        (0x1400, 5): "0A00",  # 10 ms
        (0x1600, 0): "02",
        (0x1600, 1): "10004060",  # 0x60400010
        (0x1600, 2): "10007160",  # 0x60710010
        (0x1800, 1): "81010040",  # id 0x181, bit 30 left as the drive had it
        (0x1800, 2): "01",
        (0x1A00, 0): "03",
        (0x1A00, 1): "10004160",
        (0x1A00, 2): "20006460",
        (0x1A00, 3): "10007760",
        (0x1801, 1): "81020040",
        (0x1801, 2): "FF",
        (0x1801, 3): "1400",  # 2 ms = 20 x 100 us
        (0x1A01, 0): "02",
        (0x1A01, 1): "2000FD60",
        (0x1A01, 2): "08006160",  # 0x60610008
        (0x6007, 0): "0300",  # quick stop
        (0x605A, 0): "0600",
        (0x6060, 0): "0A",
        (0x6072, 0): "A00F",  # 4000
        (0x6085, 0): "002D3101",  # 20 000 000 = 0x01312D00
        (0x60C2, 1): "01",
        (0x60C2, 2): "FD",  # 10^-3 s
    }
    assert {key: held[key[0]][key[1]].hex().upper() for key in expected} == expected


def test_bytes_on_the_wire(bench):
    """SDO by CiA 301: 0x600 + node; 23 = write 4 bytes, 2B = 2, 2F = 1; index little endian, sub-index, data."""
    configure(bench.master, [MACRO])
    sent = [data.hex().upper() for can_id, data in bench.frames if can_id == 0x601]
    assert "23161001C8007E00" in sent
    assert "2B07600003000000" in sent
    assert "2F606000" + "0A000000" in sent
    assert (0x000, b"\x80\x01") in bench.frames
    # 40 = read: every written object is asked for again afterwards.
    for write in [data for data in sent if data[:2] in ("23", "2B", "2F")]:
        read = "40" + write[2:8] + "00000000"
        assert read in sent[sent.index(write) :]


def test_mapping_changes_only_while_the_pdo_is_invalid(bench):
    """CiA 301: bit 31 of the COB-ID set, count 0, entries, count, types; valid last."""
    configure(bench.master, [MACRO])
    steps = [(index, sub, data.hex()) for index, sub, data in bench.macro.written if index in (0x1800, 0x1A00)]
    assert steps == [
        (0x1800, 1, "810100c0"),
        (0x1A00, 0, "00"),
        (0x1A00, 1, "10004160"),
        (0x1A00, 2, "20006460"),
        (0x1A00, 3, "10007760"),
        (0x1A00, 0, "03"),
        (0x1800, 2, "01"),
        (0x1800, 1, "81010040"),
    ]


def test_configuring_twice_is_harmless(bench):
    assert configure(bench.master, [MACRO, MICRO]) == configure(bench.master, [MACRO, MICRO])


def test_negative_option_code(bench):
    configure(bench.master, [replace(MICRO, quick_stop_option=-1)])  # manufacturer-specific: -1 = FF FF
    assert bench.micro.data_store[0x605A][0] == b"\xff\xff"


# What a drive shows although something else was written to it.
STUCK = [
    ((0x1016, 1), 0, r"0x1016:01 consumer heartbeat time: wrote 8257736 \(0x7E00C8\), read 0; .*dead servo"),
    ((0x1017, 0), 0, r"0x1017:00 producer heartbeat time: wrote 50 \(0x32\), read 0; lengthen"),
    ((0x1005, 0), 0x40000080, r"0x1005:00 COB-ID SYNC: wrote 128 .*read .*0x40000080"),
    ((0x1006, 0), 2000, r"0x1006:00 communication cycle period: wrote 1000 .*read 2000"),
    ((0x1014, 0), 0x8000_0081, r"0x1014:00 COB-ID EMCY: wrote 129 .*0x80000081"),
    ((0x1400, 5), 0, r"0x1400:05 event timer: wrote 10 .*read 0; .*dead servo stays .*macro.mode = \"position\""),
    ((0x1400, 2), 255, r"0x1400:02 transmission type: wrote 1, read 255"),
    ((0x1800, 2), 254, r"0x1800:02 transmission type: wrote 1, read 254"),
    ((0x1801, 2), 1, r"0x1801:02 transmission type: wrote 255 .*read 1"),
    ((0x1801, 3), 0, r"0x1801:03 inhibit time: wrote 20 .*read 0"),
    ((0x1A00, 2), 0x60630020, r"0x1A00:02 mapped object 2: wrote .*0x60640020.* read .*0x60630020"),
    ((0x1600, 0), 1, r"0x1600:00 number of mapped objects: wrote 0, read 1"),
    ((0x6007, 0), 1, r"0x6007:00 abort connection option code: wrote 3, read 1"),
    ((0x605A, 0), 2, r"0x605A:00 quick stop option code: wrote 6, read 2; choose a stop"),
    ((0x6085, 0), 5, r"0x6085:00 quick stop deceleration: wrote 20000000 .*read 5"),
    ((0x6072, 0), 1000, r"0x6072:00 max torque: wrote 4000 .*read 1000 .*force_limit_n"),
    ((0x6060, 0), 1, r"0x6060:00 mode of operation: wrote 10 .*read 1"),
    ((0x60C2, 1), 2, r"0x60C2:01 interpolation time period value: wrote 1, read 2"),
    ((0x60C2, 2), -2, r"0x60C2:02 interpolation time index: wrote -3, read -2"),
]


@pytest.mark.parametrize(("place", "value", "words"), STUCK, ids=[f"{p[0]:04X}-{p[1]}" for p, _, _ in STUCK])
def test_what_is_not_stored_refuses(bench, place, value, words):
    bench.macro.stuck[place] = value
    with pytest.raises(DriveError, match=f"node 1: {words}"):
        configure(bench.master, [MACRO])


def test_an_entry_that_can_t_be_mapped_refuses(bench):
    bench.macro.refused[0x1A00, 3] = 0x06040041
    words = r"node 1: 0x1A00:03 mapped object 3: wrote .*0x60770010.*read 0; this drive can't.*cannot be mapped"
    with pytest.raises(DriveError, match=words):
        configure(bench.master, [MACRO])


@pytest.mark.parametrize(
    ("lack", "words"),
    [
        (lambda drive: drive.refused.update({(0x1A01, 2): 0x06040041}), "cannot be mapped"),
        (lambda drive: drive.stuck.update({(0x1A01, 2): 0}), "read 0"),
    ],
    ids=["refused", "not kept"],
)
def test_a_drive_that_can_t_tell_its_mode_tells_its_inputs(bench, lack, words):
    lack(bench.macro)
    said = []
    macro, micro = configure(bench.master, [MACRO, MICRO], said.append)
    assert macro.inputs_tpdo.names == ("digital_inputs",)
    assert micro.inputs_tpdo.names == ("digital_inputs", "mode_display")
    assert bench.macro.data_store[0x1A01][0] == b"\x01"
    assert bench.macro.data_store[0x1801][1] == bytes.fromhex("81020040")  # valid
    assert len(said) == 1
    pattern = r"node 1 can't tell its mode of operation \(0x6061\) behind its inputs .* mapped object 2: .*" + words
    assert re.match(pattern, said[0])


def test_a_drive_that_can_t_tell_its_inputs_refuses(bench):
    bench.macro.refused[0x1A01, 1] = 0x06040041
    with pytest.raises(DriveError, match="0x1A01:01 mapped object 1"):
        configure(bench.master, [MACRO])


def test_a_refused_pdo_stays_invalid(bench):
    bench.macro.refused[0x1600, 2] = 0x06040041
    with pytest.raises(DriveError, match="0x1600:02"):
        configure(bench.master, [MACRO])
    assert bench.macro.data_store[0x1400][1] == bytes.fromhex("01020080")


def test_later_entry_that_changes_an_earlier_one_refuses(bench):
    def disturb(index, subindex, od, data):
        if (index, subindex) == (0x1A00, 3):
            bench.macro.stuck[0x1A00, 1] = 0x60400010

    bench.macro.add_write_callback(disturb)
    with pytest.raises(DriveError, match="0x1A00:01 mapped object 1"):
        configure(bench.master, [MACRO])


def test_remote_request_bit_of_the_drive_is_its_own(bench):
    bench.macro.stuck[0x1400, 1] = 0x4000_0201
    with pytest.raises(DriveError, match="0x1400:01 COB-ID used by PDO"):
        configure(bench.master, [MACRO])  # it must at least take the invalid bit
    bench.macro.stuck.clear()
    bench.macro.data_store[0x1400] = {1: bytes.fromhex("01020040")}
    (macro,) = configure(bench.master, [MACRO])
    assert macro.rpdo_id == 0x201


WRONG_NODE = [
    ("vendor", {(0x1018, 1): 0x5254}, r"0x1018:01 vendor id: wanted 0x539, read 0x5254; .*backend"),
    ("product", {(0x1018, 2): 0x10001}, r"0x1018:02 product code: wanted 0x10002, read 0x10001; swap the node ids"),
    ("revision", {(0x1018, 3): 0x20000}, r"0x1018:03 revision number: wanted 0x10000, read 0x20000; load the firmware"),
    ("serial", {(0x1018, 4): 0x2A}, r"0x1018:04 serial number: wanted 0x1, read 0x2A; this is another unit"),
    ("no-serial", {(0x1018, 0): 3}, r"0x1018:04 serial number: wanted 0x1, read nothing; this is another unit"),
    ("device-type", {(0x1000, 0): 0x000F0191}, r"0x1000:00 device type: wanted profile 402, read 401"),
    ("rated-torque", {(0x6076, 0): 59_000}, r"0x6076:00 rated torque: wanted 60000 mN, read 59000 mN"),
    ("rated-current", {(0x6075, 0): 2500}, r"0x6075:00 rated current: wanted 2000 mA, read 2500 mA"),
    ("mode", {(0x6502, 0): 0x80}, r"0x6502:00 supported modes: wanted bit 9 \(torque\), read 0x80"),
    ("enabled", {(0x6041, 0): 0x1637}, r"0x6041:00 shows OPERATION_ENABLED, .*disable it first"),
    ("stopping", {(0x6041, 0): 0x0217}, r"0x6041:00 shows QUICK_STOP_ACTIVE, .*no encoder tells whether it stands"),
]


@pytest.mark.parametrize(("stuck", "words"), [case[1:] for case in WRONG_NODE], ids=[case[0] for case in WRONG_NODE])
def test_wrong_second_node_refuses_before_anything_is_written(bench, stuck, words):
    bench.micro.stuck.update(stuck)
    with pytest.raises(DriveError, match=f"node 2: {words}"):
        configure(bench.master, [MACRO, replace(MICRO, identity=(0x539, 0x10002, 0x10000, 1))])
    assert bench.macro.written == bench.micro.written == []
    assert not any(can_id == 0x000 for can_id, _ in bench.frames)


def test_encoder_resolution_is_compared(bench):
    bench.macro.stuck[0x608F, 1] = 1_000_000
    with pytest.raises(DriveError, match=r"0x608F encoder resolution: wanted 1e-07 m a count, read 1e-06 m"):
        configure(bench.master, [MACRO])


def test_identity_of_any_product(bench):
    for drive in (bench.macro, bench.micro):
        drive.stuck[0x1018, 1] = 0x5254
        drive.stuck[0x1018, 2] = 7
    rig = [replace(MACRO, identity=(0x5254, None, None, None)), replace(MICRO, identity=(0x5254,))]
    assert [mapping.node_id for mapping in configure(bench.master, rig)] == [1, 2]


def test_rated_values(bench):
    bench.master.add_node(1, EDS_LINEAR)
    bench.master.add_node(2, EDS_VOICE)
    macro, micro = read_rated_values(bench.master, 1), read_rated_values(bench.master, 2)
    assert (macro.torque_word, macro.current_word, macro.encoder_step_m) == (500_000, 5000, 1e-7)
    assert (micro.torque_word, micro.current_word, micro.encoder_step_m) == (60_000, 2000, None)


def _edited_eds(tmp_path, edit):
    path = tmp_path / "edited.eds"
    path.write_text(edit(Path(EDS_LINEAR).read_text()))
    return str(path)


def _without(index):
    def edit(text):
        blocks = text.split("\n[")
        return "\n[".join(block for block in blocks if not block.upper().startswith(f"{index:04X}"))

    return edit


def test_drive_without_heartbeat_consumer_refuses(tmp_path):
    path = _edited_eds(tmp_path, _without(0x1016))
    bench = Bench(path)
    words = r"0x1016:01 consumer heartbeat time: wrote .*read nothing; .*not in the drive's EDS file"
    with pytest.raises(DriveError, match=words):
        configure(bench.master, [replace(MACRO, eds_path=path)])
    bench.close()


def test_firmware_older_than_its_eds_refuses(tmp_path):
    bench = Bench(_edited_eds(tmp_path, _without(0x1016)))
    with pytest.raises(DriveError, match=r"0x1016:01 .*read nothing; .*Object does not exist"):
        configure(bench.master, [MACRO])
    bench.close()


# -- a drive without an RPDO deadline ---------------------------------------------------------------------------------

# 70 and 40 kg, a third of 1 mm. 10 ms of heartbeat and a cycle of 1 ms: t = 11 ms, t^2 = 1.21e-4 s^2.
# Macro: 2 x 70 kg x 1/3 mm / t^2 = 385.67 N, 771.3 words of 0.5 N. Micro: 70 x 40 / 110 = 25.4545 kg: 140.25 N, 2337.4
# words of 0.06 N.
MACRO_STALE = StaleTorque(mass_kg=70.0, way_m=1e-3 / 3.0, needed_n=220.0)
MICRO_STALE = StaleTorque(mass_kg=70.0 * 40.0 / 110.0, way_m=1e-3 / 3.0, needed_n=80.0)
CAPPED = [
    replace(MACRO, heartbeat_ms=10, stale_torque=MACRO_STALE),
    replace(MICRO, heartbeat_ms=10, stale_torque=MICRO_STALE),
]
LACKS = {
    "refused": lambda drive: drive.refused.update({(0x1400, 5): 0x06090011}),
    "not kept": lambda drive: drive.stuck.update({(0x1400, 5): 0}),
}


def test_a_drive_without_rpdo_deadline_whose_force_nothing_bounds_is_refused(bench):
    bench.macro.refused[0x1400, 5] = 0x06090011
    with pytest.raises(DriveError, match=r"0x1400:05 event timer.*read 0; without it the last .*Subindex does not"):
        configure(bench.master, [MACRO])


@pytest.mark.parametrize("lack", LACKS.values(), ids=list(LACKS))
def test_a_drive_without_rpdo_deadline_gets_less_torque(bench, lack):
    lack(bench.macro)
    lack(bench.micro)
    said = []
    configure(bench.master, CAPPED, said.append)
    assert bench.macro.data_store[0x6072][0] == (771).to_bytes(2, "little")
    assert bench.micro.data_store[0x6072][0] == (2337).to_bytes(2, "little")
    assert said == [
        "node 1 has no RPDO deadline (0x1400:05): a dead servo is noticed by its heartbeat after 11 ms, "
        "so max torque (0x6072) is 385.5 N instead of 2000 N (2 x 70 kg x 0.333 mm / (11 ms)^2)",
        "node 2 has no RPDO deadline (0x1400:05): a dead servo is noticed by its heartbeat after 11 ms, "
        "so max torque (0x6072) is 140.2 N instead of 180 N (2 x 25.45 kg x 0.333 mm / (11 ms)^2)",
    ]


def test_a_drive_with_rpdo_deadline_keeps_its_torque_and_nothing_is_said(bench):
    said = []
    configure(bench.master, CAPPED, said.append)
    assert bench.macro.data_store[0x6072][0] == (4000).to_bytes(2, "little")
    assert said == []


def test_the_cap_moves_a_free_mass_by_its_way_in_the_detection_time():
    cap_n, t_s = torque_cap_n(MICRO_STALE, detection_time_s(CAPPED[1])), 0.011
    assert 0.5 * cap_n / MICRO_STALE.mass_kg * t_s**2 == pytest.approx(MICRO_STALE.way_m, rel=1e-12)


def test_a_cap_that_the_motion_does_not_fit_under_is_refused(bench):
    """t = 201 ms: 25.4545 kg x 2 / 3 mm / t^2 = 0.42 N; 80 N take sqrt(25.4545 kg x 2 / 3 mm / 80 N) = 14.56 ms."""
    LACKS["refused"](bench.micro)
    words = (
        r"node 2 has no RPDO deadline \(0x1400:05\): .* after 201 ms, so its torque may be 0\.42 N at most "
        r"\(2 x 25\.45 kg x 0\.333 mm / \(201 ms\)\^2\), and the profile's motion takes 80 N; "
        r"shorten trip\.heartbeat_s to 0\.013 s, lower macro\.acceleration_limit_m_per_s2 .*Subindex does not exist"
    )
    with pytest.raises(DriveError, match=words):
        configure(bench.master, [MACRO, replace(MICRO, stale_torque=MICRO_STALE)])


def test_a_cap_above_the_limit_changes_nothing(bench):
    LACKS["refused"](bench.micro)
    said = []
    configure(bench.master, [replace(CAPPED[1], max_torque_word=500)], said.append)
    assert bench.micro.data_store[0x6072][0] == (500).to_bytes(2, "little")
    assert said[0].endswith(
        "in which 140.2 N do no harm (2 x 25.45 kg x 0.333 mm / (11 ms)^2): its torque stays as it was"
    )


def test_a_drive_that_does_not_keep_the_cap_is_refused(bench):
    LACKS["refused"](bench.micro)
    bench.micro.stuck[0x6072, 0] = 3000
    with pytest.raises(DriveError, match=r"0x6072:00 max torque: wrote 2337 .*read 3000 .*no RPDO deadline"):
        configure(bench.master, CAPPED)


def test_position_mode_needs_no_cap(bench):
    """The drive's own loop holds the last target: no torque is kept up."""
    LACKS["refused"](bench.macro)
    said = []
    configure(bench.master, [replace(MACRO, mode="position")], said.append)
    assert bench.macro.data_store[0x6072][0] == (4000).to_bytes(2, "little")
    assert re.search(r"noticed by its heartbeat after 201 ms, and the drive holds its last target", said[0])


# -- a drive that a killed run left in a quick stop -------------------------------------------------------------------


def leave_in_quick_stop(drive, positions):
    """Show QUICK_STOP_ACTIVE until Disable voltage comes, and one encoder reading after the other."""
    readings = iter(positions)

    def read(index, subindex, od):
        if index == 0x6041:
            stopped = (0x6040, 0, bytes(2)) not in drive.written
            return 0x0217 if stopped else 0x0250
        return next(readings) if index == 0x6064 else None

    drive.add_read_callback(read)


def test_a_standing_drive_in_quick_stop_is_taken_out_of_it(bench):
    """Disable voltage is controlword 0: 2B = write 2 bytes of 0x6040:00. 1000 counts of 100 nm in 0.1 s are 1 mm/s."""
    leave_in_quick_stop(bench.macro, [0, 1000])
    said = []
    configure(bench.master, [MACRO, MICRO], said.append)
    sent = [data.hex().upper() for can_id, data in bench.frames if can_id == 0x601]
    writes = [data for data in sent if data[:2] in ("23", "2B", "2F")]
    assert writes[0] == "2B40600000000000"
    assert said == [
        "node 1 stood in QUICK_STOP_ACTIVE, as a run that was killed leaves it; its power was taken away (0x6040 = 0), "
        "it shows SWITCH_ON_DISABLED"
    ]


def test_a_drive_that_still_moves_in_quick_stop_is_refused(bench):
    leave_in_quick_stop(bench.macro, [0, -1001])
    with pytest.raises(DriveError, match=r"QUICK_STOP_ACTIVE, .*moves at 0\.001001 m/s .* wait until it stands"):
        configure(bench.master, [MACRO, MICRO])
    assert bench.macro.written == []


def test_a_drive_that_stays_in_quick_stop_is_refused(bench):
    bench.macro.stuck[0x6041, 0] = 0x0217
    with pytest.raises(DriveError, match=r"shows QUICK_STOP_ACTIVE 0\.5 s after 0x6040 = 0, wanted SWITCH_ON_DISABLED"):
        configure(bench.master, [MACRO])


def test_nothing_is_released_before_all_drives_were_looked_at(bench):
    leave_in_quick_stop(bench.macro, [0, 0])
    bench.micro.stuck[0x6041, 0] = 0x0237
    with pytest.raises(DriveError, match="node 2: 0x6041:00 shows OPERATION_ENABLED"):
        configure(bench.master, [MACRO, MICRO])
    assert bench.macro.written == []


def test_unused_pdos_are_switched_off(tmp_path):
    def add_pdos(text):
        for index, name, cob_id in ((0x1401, "RPDO 2", "0x300"), (0x1802, "TPDO 3", "0x380")):
            text += f"\n[{index:04X}]\nParameterName={name} communication\nObjectType=0x9\nSubNumber=2\n"
            text += f"\n[{index:04X}sub0]\nParameterName=Highest\nDataType=0x0005\nAccessType=const\nDefaultValue=2\n"
            text += f"\n[{index:04X}sub1]\nParameterName=COB-ID\nDataType=0x0007\nAccessType=rw\n"
            text += f"DefaultValue=$NODEID+{cob_id}\n"
            text += f"\n[{index + 0x200:04X}]\nParameterName={name} mapping\nObjectType=0x9\nSubNumber=1\n"
            text += f"\n[{index + 0x200:04X}sub0]\nParameterName=Number\nDataType=0x0005\nAccessType=rw\n"
            text += "DefaultValue=0\n"
        return text

    path = _edited_eds(tmp_path, add_pdos)
    bench = Bench(path)
    configure(bench.master, [replace(MACRO, eds_path=path)])
    assert bench.macro.data_store[0x1401][1] == bytes.fromhex("01030080")
    assert bench.macro.data_store[0x1802][1] == bytes.fromhex("81030080")
    bench.close()


def test_a_drive_may_take_half_a_second_to_answer():
    """A host under load, or a drive that writes its flash: no reason to give up."""
    network = canopen.Network()
    network.connect(interface="virtual", channel="slow-drive")
    drive = network.create_node(Drive(1, EDS_LINEAR))
    drive.add_read_callback(lambda index, subindex, od: time.sleep(0.5))
    master = Master(can.Bus(interface="virtual", channel="slow-drive"))
    try:
        master.add_node(1, EDS_LINEAR)
        assert master.read(1, cia402.IDENTITY, 0) == 4
    finally:
        master.close()
        network.disconnect()


class SlowDrive:
    """A drive on a virtual bus whose answers about one object come when `go` is set; a master beside it."""

    def __init__(self, channel):
        self.go, self.asked = threading.Event(), threading.Event()
        self.network = canopen.Network()
        self.network.connect(interface="virtual", channel=channel)
        self.drive = self.network.create_node(Drive(1, EDS_LINEAR))
        self.drive.add_read_callback(self.read)
        self.master = Master(can.Bus(interface="virtual", channel=channel))
        self.master.add_node(1, EDS_LINEAR)

    def read(self, index, subindex, od):
        if index == 0x2010:
            self.asked.set()
            assert self.go.wait(30.0)
            return 415
        return None

    def close(self):
        self.go.set()
        self.master.close()
        self.network.disconnect()


@pytest.fixture
def slow_drive(request):
    opened = SlowDrive(request.node.name)
    yield opened
    opened.close()


def test_an_answer_may_be_waited_for_no_longer_than_that(slow_drive):
    """The drive answers never, as far as this test goes: that it ends shows that nobody waits for it."""
    master = slow_drive.master
    client = master._nodes[1].sdo
    assert client.RESPONSE_TIMEOUT == 1.0
    client.RESPONSE_TIMEOUT = 600.0
    with pytest.raises(LinkError, match="0x2010:00: No SDO response"):
        master.read(1, 0x2010, answer_s=0.01)
    assert slow_drive.asked.wait(30.0)
    assert client.RESPONSE_TIMEOUT == 600.0  # of everybody else


def test_an_answer_that_was_given_up_is_not_the_next_one_s(slow_drive):
    master = slow_drive.master
    with pytest.raises(LinkError, match="0x2010:00: No SDO response"):
        master.read(1, 0x2010, answer_s=0.01)
    # The drive's late answer is on the bus before that to the next request, in this order.
    late = threading.Timer(0.05, slow_drive.go.set)
    late.start()
    assert master.read(1, cia402.IDENTITY, 0) == 4
    late.join()
    assert master.read(1, 0x2010, answer_s=30.0) == 415
    assert master.read(1, cia402.IDENTITY, 0) == 4


def test_who_waits_shortly_does_not_wait_for_another_sdo_either(slow_drive):
    master, found = slow_drive.master, []
    other = threading.Thread(target=lambda: found.append(master.read(1, 0x2010, answer_s=30.0)))
    other.start()
    assert slow_drive.asked.wait(30.0)
    with pytest.raises(LinkError, match=r"another SDO is under way for more than 0\.01 s"):
        master.read(1, cia402.IDENTITY, 0, answer_s=0.01)
    slow_drive.go.set()
    other.join(30.0)
    assert found == [415]  # undisturbed


def test_silent_node_is_a_link_error(bench):
    bench.network.nodes[2].remove_network()
    with pytest.raises(LinkError, match=r"node 2: 0x1018:00: No SDO response.*node id and bit rate"):
        configure(bench.master, [MACRO, MICRO])
    assert bench.macro.written == []


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ([MACRO, replace(MICRO, node_id=1)], "node id 1 is used twice"),
        ([replace(MACRO, node_id=0x7E)], "node id 126 is used twice"),
        ([MACRO, replace(MICRO, cycle_us=2000)], r"cycles of \[1000, 2000\] us"),
        ([replace(MACRO, heartbeat_ms=0)], "heartbeat of 0 ms"),
        ([replace(MACRO, rpdo_deadline_ms=0)], "RPDO deadline 0 ms"),
        ([replace(MACRO, mode="velocity")], "mode = 'velocity' is not one of torque, position"),
        ([replace(MACRO, cycle_us=333)], "cycle of 333 us can't be written to 0x60C2"),
        ([replace(MACRO, eds_path="absent.eds")], "absent.eds: EDS of node 1 can't be read"),
    ],
)
def test_impossible_settings(bench, settings, words):
    with pytest.raises(ProfileError, match=words):
        configure(bench.master, settings)
    assert bench.macro.written == []


def test_value_that_does_not_fit_its_object(bench):
    with pytest.raises(DriveError, match=r"0x6072:00 max torque: wrote 70000 .*doesn't fit its 16 bits \(unsigned\)"):
        configure(bench.master, [replace(MACRO, max_torque_word=70_000)])


@pytest.mark.parametrize(
    ("cycle_us", "words"), [(1000, (1, -3)), (2000, (2, -3)), (500, (5, -4)), (250, (25, -5)), (125, (125, -6))]
)
def test_interpolation_words(cycle_us, words):
    assert interpolation_words(cycle_us) == words


def test_heartbeat_is_sent_four_times_in_its_timeout():
    assert [heartbeat_producer_ms(timeout_ms) for timeout_ms in (200, 20, 3, 1)] == [50, 5, 1, 1]


def test_heartbeat_age_follows_the_clock(bench):
    bench.master.add_node(1, EDS_LINEAR)
    assert bench.master.heartbeat_age_s(1) == float("inf")
    bench.now_s = 5.0
    bench.network.send_message(0x701, b"\x7f")
    bench.now_s = 5.25
    assert bench.master.heartbeat_age_s(1) == 0.25
    assert bench.master.nmt_state(1) == 127


def test_emergencies_are_kept_whatever_their_length(bench):
    bench.master.add_node(1, EDS_LINEAR)
    bench.now_s = 2.0
    bench.macro.emcy.send(0x8130, 0x10, b"\x01\x02\x03\x04\x05")
    bench.network.send_message(0x081, bytes.fromhex("2023"))
    bench.network.send_message(0x081, b"")
    first, second, third = bench.master.emergencies()
    assert str(first) == "node 1: EMCY 0x8130 heartbeat or life guard lost, register 0x10, 0102030405"
    assert (second.code, second.register, second.vendor, second.t_s) == (0x2320, 0, b"", 2.0)
    assert third.code == 0x1000
    assert bench.master.emergencies() == []


def test_emergencies_do_not_grow_without_end(bench):
    bench.master.add_node(1, EDS_LINEAR)
    for code in range(1000):
        bench.macro.emcy.send(code)
    assert [emergency.code for emergency in bench.master.emergencies()] == list(range(744, 1000))


def test_error_frames_are_counted():
    bus, other = (can.Bus(interface="virtual", channel="error-frames", ignore_config=True) for _ in range(2))
    master = Master(bus)
    other.send(can.Message(is_error_frame=True, arbitration_id=0x40))
    deadline_s = time.monotonic() + 5.0
    while not master.error_frames_count and time.monotonic() < deadline_s:
        pass
    assert master.error_frames_count == 1
    master.close()
    other.shutdown()


def test_malformed_frames_do_no_harm(bench):
    """Empty heartbeat and one-byte NMT command: canopen's own consumers raise on them."""
    bench.master.add_node(1, EDS_LINEAR)
    bench.master.notify(0x701, b"")
    bench.master.notify(0x000, b"\x01")
    assert bench.master.heartbeat_age_s(1) == 0.0


def test_nmt_by_name_and_code(bench):
    bench.master.nmt(0, "start")
    bench.master.nmt(2, 0x82)
    assert bench.frames == [(0x000, b"\x01\x00"), (0x000, b"\x82\x02")]


def test_signed_objects_are_read_with_their_sign(bench):
    bench.master.add_node(1, EDS_LINEAR)
    bench.macro.data_store[0x6064] = {0: bytes.fromhex("C0BDF0FF")}
    assert bench.master.read(1, 0x6064, 0) == -1_000_000


def test_unknown_node_and_text_object(bench):
    with pytest.raises(DriveError, match="node 9 is unknown"):
        bench.master.read(9, 0x1000, 0)
    bench.master.add_node(1, EDS_LINEAR)
    with pytest.raises(DriveError, match="0x1008:00: data type 0x9"):
        bench.master.read(1, 0x1008, 0)


def test_over_a_bus_with_a_receiver_thread():
    """The same over python-can's `virtual` with the filters that the supervisor uses, drives behind a thread."""
    master = Master(open_network("virtual", "arming"))
    network = canopen.Network(can.Bus(interface="virtual", channel="arming", ignore_config=True))
    network.NOTIFIER_CYCLE = 0.05
    network.connect()
    macro = network.create_node(Drive(1, EDS_LINEAR))
    micro = network.create_node(Drive(2, EDS_VOICE))
    try:
        mappings = configure(master, [MACRO, MICRO])
        assert [mapping.rpdo for mapping in mappings] == [Codec.from_mapping((0x60400010, 0x60710010))] * 2
        micro.refused[0x1A00, 2] = 0x06040041
        with pytest.raises(DriveError, match="node 2: 0x1A00:02"):
            configure(master, [MACRO, MICRO])
        macro.emcy.send(0x8611, 0x20)
        deadline_s = time.monotonic() + 5.0
        while not (emergencies := master.emergencies()) and time.monotonic() < deadline_s:
            pass
        assert [(emergency.node_id, emergency.code) for emergency in emergencies] == [(1, 0x8611)]
    finally:
        network.disconnect()
        master.close()


def test_a_dead_receiver_is_said():
    class FailingBus(InstantBus):
        def _recv_internal(self, timeout):
            raise can.CanOperationError("Network is down", 100)

    master = Master(FailingBus([], []))
    master.add_node(1, EDS_LINEAR)
    deadline_s = time.monotonic() + 5.0
    while any(thread.name == "CANopen receiver" for thread in threading.enumerate()):
        assert time.monotonic() < deadline_s
    for ask in (lambda: master.heartbeat_age_s(1), lambda: master.read(1, 0x1000, 0)):
        with pytest.raises(LinkError, match=r"CAN receiver stopped: Network is down.*arm again"):
            ask()
    master.close()


EDS_OBJECTS = [0x1000, 0x1001, 0x1018, 0x1005, 0x1014, 0x1016, 0x1017, 0x1400, 0x1600, 0x1800, 0x1A00, 0x1801, 0x1A01]
EDS_OBJECTS += [0x6007, 0x6040, 0x6041, 0x605A, 0x6060, 0x6061, 0x6064, 0x6071, 0x6072, 0x6075, 0x6076, 0x6077, 0x607A]
EDS_OBJECTS += [0x607C, 0x6085, 0x6098, 0x6099, 0x609A, 0x60B2, 0x60C2, 0x60FD, 0x6502]


@pytest.mark.parametrize(("path", "product"), [(EDS_LINEAR, 0x10001), (EDS_VOICE, 0x10002)])
def test_eds_files_are_complete(path, product, caplog):
    dictionary = canopen.import_od(path, 5)
    assert caplog.records == []
    assert [index for index in EDS_OBJECTS if index not in dictionary] == []
    assert dictionary.device_information.vendor_number == dictionary[0x1018][1].default == 0x539
    assert dictionary.device_information.product_number == dictionary[0x1018][2].default == product
    assert dictionary[0x1400][1].default == 0x205
    assert dictionary[0x1800][1].default == 0x4000_0185
    assert dictionary[0x1801][1].default == 0x4000_0285
    for index in dictionary:
        entry = dictionary[index]
        for variable in getattr(entry, "subindices", {0: entry}).values():
            assert variable.default is not None, hex(index)


@pytest.mark.parametrize("path", [EDS_LINEAR, EDS_VOICE])
def test_eds_lists_agree_with_its_sections(path):
    """CiA 306: every object in exactly one list, counts right, SubNumber right, file name right."""
    eds = configparser.RawConfigParser(inline_comment_prefixes=(";",), strict=True)
    eds.optionxform = str
    eds.read(path)
    listed = []
    for section in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        members = [value for key, value in eds[section].items() if key != "SupportedObjects"]
        assert int(eds[section]["SupportedObjects"]) == len(members)
        listed += [int(member, 16) for member in members]
    objects = [int(name, 16) for name in eds.sections() if len(name) == 4]
    assert sorted(listed) == sorted(objects)
    for index in objects:
        members = [name for name in eds.sections() if name.startswith(f"{index:04X}sub")]
        assert len(members) == int(eds[f"{index:04X}"].get("SubNumber", "0"))
    assert eds["FileInfo"]["FileName"] == Path(path).name
    assert int(eds["Comments"]["Lines"]) == len(eds["Comments"]) - 1
