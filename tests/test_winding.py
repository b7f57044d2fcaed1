"""How warm the rig's motors become: against the closed form, through their drives' own objects, in virtual time."""

import math

import numpy as np
import pytest

from sim_backend import winding
from sim_backend.machine import Winding
from sim_backend.rig import Rig
from tests.stage import with_values
from tests.test_drive import Bench

AMBIENT_DEGC = 21.5
RISE_K, TIME_CONSTANT_S = 58.0, 300.0


def heated(machine, current_a, duration_s, steps_count):
    axis = with_values(
        machine, macro__winding=Winding(rise_at_rated_current_k=RISE_K, time_constant_s=TIME_CONSTANT_S)
    ).macro
    parameters, state = winding.parameters(axis, AMBIENT_DEGC), winding.init()
    for _ in range(steps_count):
        winding.step(state, parameters, current_a, duration_s / steps_count)
    return winding.temperature_degc(state, parameters), state, parameters


@pytest.mark.parametrize("share", [0.5, 1.0, -2.0])
@pytest.mark.parametrize("steps_count", [1, 7, 20_000])
def test_a_constant_current_heats_as_the_closed_form_says_however_long_the_steps(single_machine, share, steps_count):
    current_a = share * single_machine.macro.rated_current_a
    for duration_s in (1.0, TIME_CONSTANT_S, 20.0 * TIME_CONSTANT_S):
        degc, state, parameters = heated(single_machine, current_a, duration_s, steps_count)
        rise_k = share * share * RISE_K * (1.0 - math.exp(-duration_s / TIME_CONSTANT_S))
        assert degc == pytest.approx(AMBIENT_DEGC + rise_k, rel=1e-11)
        winding.step(state, parameters, 0.0, 2.0 * TIME_CONSTANT_S)
        cooled_degc = AMBIENT_DEGC + rise_k * math.exp(-2.0)
        assert winding.temperature_degc(state, parameters) == pytest.approx(cooled_degc, rel=1e-11)


def test_a_motor_without_current_has_the_air_s_temperature_in_its_drive():
    bench = Bench()
    bench.wait(50.0)
    for node_id in (1, 2):
        assert bench.read(node_id, 0x2010, signed=True) == 200  # 20.0 degC of the machine's air


def test_a_drive_s_object_follows_the_current_that_its_motor_had():
    """Half of the rated current to and fro: heat knows no sign, and one winding's is not the other's."""
    bench = Bench(macro_position_m=-0.45)
    tau_s = 2.0
    bench.rig.drive(1).winding_parameters["time_constant_s"] = tau_s
    rise_k = bench.rig.machine.macro.winding.rise_at_rated_current_k
    bench.arm()
    bench.enable()
    rated_a = bench.rig.machine.macro.rated_current_a
    forth, back = ((b"\x0f\x00" + word.to_bytes(2, "little", signed=True)) for word in (500, -500))
    square_a2_s, decayed = 0.0, 0.0
    for k in range(1200):
        _, _, torque = bench.cycle(forth if k // 100 % 2 == 0 else back)
        current_a = 1e-3 * torque * rated_a
        square_a2_s += 1e-3 * current_a * current_a
        decayed += 1e-3 / tau_s * (rise_k * (current_a / rated_a) ** 2 - decayed)
    assert square_a2_s == pytest.approx(1.2 * (0.5 * rated_a) ** 2, rel=0.01)
    assert decayed > 6.0
    read_degc = 0.1 * bench.read(1, 0x2010, signed=True)
    assert read_degc == pytest.approx(20.0 + decayed, abs=0.05 + 0.005 * decayed)
    assert 200 <= bench.read(2, 0x2010, signed=True) < 210  # shaken, in its shorted winding


def test_it_cools_while_its_drive_is_dark(oled_machine):
    rig = Rig(oled_machine)
    drive = rig.drive(1)
    drive.winding["rise_k"] = 40.0
    tau_s = oled_machine.macro.winding.time_constant_s
    rig.nodes[0].lose_power(rig.t_ns)
    rig.advance(rig.t_ns + 2_000_000_000)
    rig.nodes[0].boot(rig.t_ns)
    assert float(drive.winding["rise_k"][0]) == pytest.approx(40.0 * math.exp(-2.0 / tau_s), abs=1e-6)


def test_the_temperature_can_t_be_written_nor_mapped_and_a_machine_may_lack_it(oled_machine):
    bench = Bench()
    assert bench.sdo(1, "2b 10 20 00 00 00 00 00") == "80 10 20 00 02 00 01 06"  # read only
    bench.write(1, 0x1800, 1, 0x8000_0181, 4)
    bench.write(1, 0x1A00, 0, 0, 1)
    assert bench.sdo(1, "23 00 1a 01 10 00 10 20") == "80 00 1a 01 41 00 04 06"  # can't be mapped
    bench.rig = Rig(with_values(oled_machine, macro__winding=None))
    assert bench.sdo(1, "40 10 20 00 00 00 00 00") == "80 10 20 00 00 00 02 06"  # no such object
    assert bench.sdo(2, "40 10 20 00 00 00 00 00").startswith("4b 10 20 00")


def test_asking_moves_no_motor(oled_machine):
    """A step of the plant at one more instant changes what noise makes of the motion; who asks must not."""
    asked, left_alone = Rig(oled_machine, seed=3), Rig(oled_machine, seed=3)
    for k in range(1, 200):
        for rig in (asked, left_alone):
            rig.advance(rig.start_t_ns + k * 1_000_000)
        asked.on_frame(0x601, bytes.fromhex("40 10 20 00 00 00 00 00"), asked.t_ns + 370_000)
    assert asked.plant_state() == left_alone.plant_state()
    assert np.array_equal(asked.drive(1).winding, left_alone.drive(1).winding)
