"""The rig's interferometer: literal bytes of every format, its own clock, transport, noise and faults."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_backend import air
from sim_backend.faults import Fault
from sim_backend.interferometer import MACRO_BIT, Interferometer
from sim_backend.machine import load_machine
from sim_backend.rig import Rig
from sim_backend.sensor_lines import MicroEpsilonWriter, Sample, SyncFixedWriter, Umd2Writer
from sim_backend.transport import Transport

START_T_NS = 1_000_000_000


def sample(sequence=0, macro=0.0, end=0.0, macro_lost=False, end_lost=False, slow=True) -> Sample:
    return Sample(sequence, macro, end, macro_lost, end_lost, slow, slow)


# -- bytes ------------------------------------------------------------------------------------------------------------


def test_sync_frame():
    # sync, sequence 1, macro 1000, end -2, status 0, CRC-16/CCITT (init FFFF) of the 23 bytes: 0xE888
    line = SyncFixedWriter().line(sample(1, macro=999.6, end=-2.4))
    assert line == bytes.fromhex("a55a 01000000 e803000000000000 feffffffffffffff 00 88e8")
    assert len(line) == 25


def test_sync_frame_wraps_its_sequence_and_shows_a_lost_beam():
    line = SyncFixedWriter().line(sample(0xFFFF_FFFF, end_lost=True))
    assert line == bytes.fromhex("a55a ffffffff 0000000000000000 0000000000000000 02 d89d")
    assert SyncFixedWriter().line(sample(1 << 32, macro_lost=True))[2:6] == bytes(4)


def test_umd2_line_subtracts_its_phase():
    writer = Umd2Writer(2, 1000.0, load_machine("oled-printer").air)
    # 12.25 = 13 - 49152/65536; MEAS = REF + VEL; nothing on the third axis
    assert writer.line(sample(0, macro=12.25, end=-2.0)) == b"2000 2013 13 13 49152 0 0 0 1998 -2 -2 0 0 0 0 0\r\n"
    assert writer.line(sample(1, macro=12.0, end=-2.5)) == (
        b"2000 1999 12 -1 0 1 10 459016 2000 -2 0 32768 0 0 0 0\r\n"  # low-speed: firmware 264, sub-version 7
    )


def test_umd2_line_has_whole_counts_only_when_fast():
    writer = Umd2Writer(1, 1000.0, load_machine("oled-printer").air)
    assert writer.line(sample(0, macro=12.25, slow=False)) == b"2000 2012 12 12 0 0 0 0\r\n"
    assert writer.line(sample(2, macro=12.75, slow=False)) == b"2000 2001 13 1 0 2 8 100000\r\n"  # 1000.00 Hz


def test_umd2_line_shows_a_lost_beam_as_no_counts():
    writer = Umd2Writer(1, 1000.0, load_machine("oled-printer").air)
    assert writer.line(sample(0, macro_lost=True)) == b"2000 0 0 0 0 0 0 0\r\n"


def test_umd2_phase_never_reaches_a_whole_count():
    writer = Umd2Writer(1, 1000.0, load_machine("oled-printer").air)
    assert writer.line(sample(0, macro=4.999999)).split()[2:5:2] == [b"5", b"0"]
    assert writer.line(sample(0, macro=4.000001)).split()[2:5:2] == [b"4", b"0"]


def test_micro_epsilon_block():
    # 131005 = 0x1FFBD: 3d, 3e, 1f with tags 00 01 10; no peak 262076 = 0x3FFBC: 3c, 3e, 3f, tags 00 01 11; counter 7
    line = MicroEpsilonWriter(2).line(sample(7, macro=5.2, end_lost=True))
    assert line == bytes.fromhex("3d7e9f 3c7eff 0740c0")


def test_micro_epsilon_limits_are_error_codes():
    writer = MicroEpsilonWriter(1)
    assert writer.line(sample(0, macro=-131_001.0))[:3] == bytes.fromhex("397ebf")  # 262073
    assert writer.line(sample(0, macro=131_073.0))[:3] == bytes.fromhex("3a7ebf")  # 262074
    assert writer.line(sample(0, macro=131_072.0))[:3] == bytes.fromhex("387ebf")  # 262072, the largest value


def test_air_of_the_rig_agrees_with_the_published_index():
    row = SimpleNamespace(
        wavelength_vacuum_m=632.991e-9, temperature_degc=20.0, pressure_pa=101_325.0, relative_humidity_percent=50.0,
        co2_ppm=450.0,
    )  # fmt: skip
    assert air.index_of(row) == pytest.approx(1.0002713729, abs=1e-10)
    row.temperature_degc, row.pressure_pa, row.relative_humidity_percent = 25.0, 80_000.0, 75.0
    assert air.index_of(row) == pytest.approx(1.0002101215, abs=1e-10)


# -- clock, transport, noise ------------------------------------------------------------------------------------------


def test_the_sensor_runs_on_its_own_clock():
    device = Interferometer(load_machine("oled-printer"), 1, START_T_NS, 0.0, 0.0)
    assert device.sample_t_ns(0) == START_T_NS
    assert device.sample_t_ns(50_000) == START_T_NS + 49_999_000_020  # 50 s at +20 ppm


def table(transport: str) -> SimpleNamespace:
    return SimpleNamespace(transport_s=150e-6, transport_jitter_s=60e-6, transport=transport)


def test_lines_come_late_by_a_constant_and_an_exponential_part():
    transport = Transport(table("line"), np.random.default_rng([1, 2]))
    sent = np.arange(20_000) * 1_000_000
    late = np.array([transport.arrival_t_ns(int(t)) for t in sent]) - sent
    assert late.min() >= 150_000
    assert np.mean(late) == pytest.approx(210_000, rel=0.01)
    assert np.std(late) == pytest.approx(60_000, rel=0.03)


def test_usb_frames_and_ftdi_bursts_round_up_to_their_grid():
    usb = Transport(table("usb-125us"), np.random.default_rng([1, 2]))
    assert {usb.arrival_t_ns(k * 1_000_000) % 125_000 for k in range(50)} == {0}
    ftdi = Transport(table("ftdi-16ms"), np.random.default_rng([1, 2]))
    assert len({ftdi.arrival_t_ns(k * 1_000_000) for k in range(160)}) <= 11


def test_noise_is_drawn_macro_then_end_from_its_own_stream():
    machine = load_machine("oled-printer")
    device = Interferometer(machine, 7, START_T_NS, 0.0, 0.0)
    draws = np.random.default_rng([7, 1]).standard_normal((6000, 2)) * 5e-9
    counts_per_m = 2048.0 * air.index_of(machine.air) / machine.air.wavelength_vacuum_m
    for row in draws:
        taken = device.sample(0.0, 0.0, 0.0, 0.0)
        assert taken is not None
        counts = np.frombuffer(taken[1][6:22], "<i8")
        assert np.array_equal(counts, np.floor(row * counts_per_m + 0.5))


def test_counts_are_zero_where_the_stage_stood():
    machine = load_machine("oled-printer")
    quiet = machine.model_copy(update={"interferometer": machine.interferometer.model_copy(update={"noise_m": 0.0})})
    device = Interferometer(quiet, 1, START_T_NS, 0.004, 0.00405)
    wavelength_m = 632.991e-9 / 1.0002713729
    taken = device.sample(0.004 + wavelength_m, 0.00405 - 10 * wavelength_m, 0.0, 0.0)
    assert taken is not None
    assert np.frombuffer(taken[1][6:22], "<i8").tolist() == [2048, -20480]


# -- in the rig -------------------------------------------------------------------------------------------------------


def lines_of(rig: Rig, span_ms: int) -> list[tuple[int, bytes]]:
    rig.advance(rig.t_ns + span_ms * 1_000_000)
    return rig.sensor_lines_due(rig.t_ns)


def test_the_rig_sends_a_line_a_millisecond_with_true_counts_in_the_log():
    rig = Rig(load_machine("oled-printer"), seed=3)
    lines = lines_of(rig, 500)
    assert len(lines) in (500, 501)
    truth = rig.truth.arrays()
    sequences = [int.from_bytes(line[2:6], "little") for _, line in lines]
    assert sequences == list(range(len(lines)))
    macro = np.array([int.from_bytes(line[6:14], "little", signed=True) for _, line in lines])
    n = len(lines)
    position = macro * 632.991e-9 / 1.0002713729 / 2048 + truth["macro_zero_m"][:n]
    assert np.std(position - truth["macro_position_m"][:n]) == pytest.approx(5e-9, rel=0.15)
    assert abs(truth["macro_position_m"][-1] - truth["macro_position_m"][0]) > 1e-4  # it drifts without power
    assert np.allclose(
        truth["end_mean_position_m"][1:],
        (truth["end_position_m"][1:] + truth["end_position_m"][:-1]) / 2,
        atol=2e-9,
    )


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    machine = load_machine("oled-printer")
    first, second, third = (lines_of(Rig(machine, seed), 100) for seed in (5, 5, 6))
    assert first == second
    assert first != third


def test_a_lost_beam_freezes_the_counts_and_shifts_the_zero():
    fault = Fault("beam_loss", at_s=0.1, duration_s=0.1, axis="macro")
    rig = Rig(load_machine("oled-printer"), seed=3, faults=[fault])
    lines = lines_of(rig, 300)
    status = [line[22] for _, line in lines]
    assert status[50] == 0
    assert status[150] == MACRO_BIT
    assert status[250] == 0
    assert len({line[6:14] for _, line in lines[105:195]}) == 1
    zero = rig.truth.arrays()["macro_zero_m"]
    assert zero[50] == zero[0]
    assert zero[250] != zero[0]


def test_stuck_silent_skipping_and_garbled_lines():
    faults = [
        Fault("stuck_counts", at_s=0.010, duration_s=0.010),
        Fault("sensor_silence", at_s=0.030, duration_s=0.010),
        Fault("sequence_gap", at_s=0.050, count=5),
        Fault("garbage", at_s=0.060, count=7),
        Fault("half_line", at_s=0.070, length_count=11),
        Fault("sensor_restart", at_s=0.080),
    ]
    rig = Rig(load_machine("oled-printer"), seed=3, faults=faults)
    lines = lines_of(rig, 100)
    by_sequence = {int.from_bytes(line[2:6], "little"): line for _, line in lines[:65] if line[:2] == b"\xa5\x5a"}
    assert len({by_sequence[k][6:22] for k in range(11, 20)}) == 1
    assert not set(range(31, 40)) & set(by_sequence)
    assert 50 in by_sequence
    assert 52 not in by_sequence
    assert [len(line) for _, line in lines].count(25 + 7) == 1
    assert [len(line) for _, line in lines].count(11) == 1
    assert int.from_bytes(lines[-1][1][2:6], "little") < 25  # began again at zero


def test_garbage_of_a_seed_is_bytes_of_every_kind_and_the_same_again():
    first, again, other = (
        lines_of(Rig(load_machine("oled-printer"), seed=3, faults=[Fault("garbage", count=2000, seed=seed)]), 3)[0][1]
        for seed in (5, 5, 6)
    )
    assert first == again
    assert first != other
    assert len(set(first[:2000])) == 256  # sync bytes, digits and line ends among them


def test_umd2_machine_writes_lines_and_a_single_axis_eight_fields():
    line = lines_of(Rig(load_machine("oled-printer-umd2"), seed=1), 5)[0][1]
    assert len(line.split()) == 16
    single = load_machine("single-axis")
    umd2 = single.interferometer.model_copy(update={"format": "umd2"})
    line = lines_of(Rig(single.model_copy(update={"interferometer": umd2}), seed=1), 5)[0][1]
    assert len(line.split()) == 8
