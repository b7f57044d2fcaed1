"""What the rig's newer faults do to its bytes and its motion."""

import struct

import numpy as np
import pytest

from sim_backend.batch import BatchWire
from sim_backend.drive_states import DriveState
from sim_backend.faults import Fault, WireFaults, fault_of
from sim_backend.object_dictionary import key
from sim_backend.rig import Rig
from stagectl.errors import ProfileError

MS = 1_000_000
MACRO, MICRO = 1, 2


@pytest.fixture
def rig(oled_machine) -> Rig:
    made = Rig(oled_machine, seed=1)
    made.take_frames()
    return made


def inject(rig: Rig, **fault) -> None:
    rig.inject(Fault(**fault), rig.t_ns)


def test_bits_of_a_payload_turn_over():
    faults = WireFaults()
    faults.change(True, Fault("corrupt_frame", can_id=0x181, bits=0x8001, count=1))
    assert faults.passed(0x181, b"\x00\x00\xff") == [(0, b"\x01\x80\xff")]
    assert faults.passed(0x181, b"\x00") == [(0, b"\x00")]


def test_a_drive_without_supply_is_dark_and_comes_back_with_its_defaults(rig):
    node = rig.nodes[0]
    node.change_object(0x1017, 0, 100)
    node.objects[key(0x6085)] = 7
    origin = node.objects[key(0x6064)]
    inject(rig, kind="power_loss", node_id=MACRO, duration_s=0.05)
    rig.advance(rig.t_ns + 40 * MS)
    assert node.is_dark
    read_identity = struct.pack("<BHB4x", 0x40, 0x1018, 1)
    assert not [frame for frame in rig.on_frame(0x601, read_identity, rig.t_ns) if frame[0] == 0x581]
    assert not [frame for frame in rig.on_frame(0x080, b"", rig.t_ns) if frame[0] == 0x181]
    assert not [frame for frame in rig.take_frames() if frame[1] & 0x7F == MACRO]
    rig.advance(rig.t_ns + 20 * MS)
    assert [frame[1:] for frame in rig.take_frames() if frame[1] == 0x701] == [(0x701, b"\x00")]
    assert node.objects[key(0x6085)] != 7
    assert node.drive.state is DriveState.SWITCH_ON_DISABLED
    node.drive.sample(rig.plant_state()["macro_position_m"], 0.0)
    assert abs(node.objects[key(0x6064)]) < 1000 < origin  # an incremental encoder counts from where it stands
    assert rig.on_frame(0x601, read_identity, rig.t_ns)[0][0] == 0x581


def test_a_mapping_that_another_tool_writes_takes_effect(rig):
    rig.on_frame(0x000, bytes([1, MACRO]), rig.t_ns)
    for subindex, value in ((2, 1), (1, 0x181)):
        inject(rig, kind="object_change", node_id=MACRO, index=0x1800, subindex=subindex, value=value)
    rig.advance(rig.t_ns + MS)
    assert 0x181 in dict(rig.on_frame(0x080, b"", rig.t_ns + MS))
    inject(rig, kind="object_change", node_id=MACRO, index=0x1800, subindex=1, value=0x8000_0181)
    rig.advance(rig.t_ns + MS)
    assert 0x181 not in dict(rig.on_frame(0x080, b"", rig.t_ns + MS))
    ((_, answer),) = rig.on_frame(0x601, struct.pack("<BHB4x", 0x40, 0x1800, 1), rig.t_ns)
    assert answer[4:] == struct.pack("<I", 0x8000_0181)  # an SDO upload says so too


def test_an_encoder_jumps_and_comes_back(rig):
    inject(rig, kind="encoder_jump", node_id=MACRO, offset_m=1e-3, duration_s=0.01)
    drive, servo = rig.nodes[0].drive, rig.nodes[0].drive.servo
    before = int(servo["encoder_count"][0])

    def said() -> int:
        drive.sample(rig.plant_state()["macro_position_m"], 0.0)
        return drive.objects[key(0x6064)]

    said_before = said()
    rig.advance(rig.t_ns + 5 * MS)
    assert int(servo["encoder_count"][0]) == pytest.approx(before + 10_000, abs=500)
    assert said() == pytest.approx(said_before + 10_000, abs=500)
    rig.advance(rig.t_ns + 20 * MS)
    assert int(servo["encoder_count"][0]) == pytest.approx(before, abs=500)
    assert said() == pytest.approx(said_before, abs=500)


def test_a_clock_drifts_for_a_while(rig):
    rig.advance(rig.t_ns + 100 * MS)
    inject(rig, kind="clock_drift", ppm=10_000.0, duration_s=0.1)
    rig.advance(rig.t_ns + 300 * MS)
    spans = np.diff(rig.truth.arrays()["t_ns"][-290:])
    assert abs(spans[:80].mean() - 990_079) < 2
    assert abs(spans[-50:].mean() - 999_980) < 1
    assert spans.max() < 1_000_000  # no jump where it changes


def test_a_node_that_talks_without_end_holds_everybody_up(oled_machine):
    wire = BatchWire(Rig(oled_machine, seed=1))
    wire.rig.inject(Fault("flood", node_id=MACRO, can_id=0x001, count=500), wire.t_ns)
    wire.advance_to(wire.t_ns + MS)
    assert wire.queue(0x080, b"")
    wire.advance_to(wire.t_ns + 40 * MS)
    assert wire.last_sync_t_ns == 0
    wire.advance_to(wire.t_ns + 40 * MS)
    assert wire.last_sync_t_ns > 0
    wire.close()


def test_an_edge_wears_and_an_obstacle_stands_in_the_way(rig):
    before = float(rig._plant_parameters["right_m"][0])
    inject(rig, kind="edge_jump", offset_m=50e-6)
    inject(rig, kind="obstacle", offset_m=-1e-3, duration_s=0.05)
    rig._state["macro_velocity_m_per_s"] = rig._state["end_velocity_m_per_s"] = -0.1
    at_m = rig.plant_state()["macro_position_m"]
    rig.advance(rig.t_ns + 40 * MS)
    assert float(rig._plant_parameters["right_m"][0]) == pytest.approx(before + 50e-6)
    assert rig.plant_state()["macro_position_m"] > at_m - 3e-3  # 4 mm without it
    rig.advance(rig.t_ns + 20 * MS)
    assert float(rig._plant_parameters["travel_low_m"][0]) == -0.5


def test_a_weak_motor_gives_a_part_of_its_force_for_a_while(rig):
    whole = float(rig._plant_parameters["micro_force_constant_n_per_a"][0])
    inject(rig, kind="weak_motor", node_id=MICRO, force_ratio=0.25, duration_s=0.05)
    rig.advance(rig.t_ns + 10 * MS)
    assert float(rig._plant_parameters["micro_force_constant_n_per_a"][0]) == pytest.approx(0.25 * whole)
    rig.advance(rig.t_ns + 60 * MS)
    assert float(rig._plant_parameters["micro_force_constant_n_per_a"][0]) == pytest.approx(whole)


@pytest.mark.parametrize(
    "kind", ["corrupt_frame", "power_loss", "object_change", "encoder_jump", "flood", "clock_drift"]
)
def test_what_a_fault_needs_is_named(kind):
    with pytest.raises(ProfileError, match=rf"fault {kind}: \w+ is missing; add it"):
        fault_of({"kind": kind})
