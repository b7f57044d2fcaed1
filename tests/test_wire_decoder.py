"""The decoder: when its bytes are taken changes nothing; the index of air follows the device's own air in a ramp."""

import struct

import numpy as np
import pytest

from drivers.air import ciddor_index
from drivers.arming import DriveMapping
from drivers.pdo import Codec
from drivers.wire import Inbox, WireDecoder
from sim_backend.batch import BatchWire
from sim_backend.machine import load_machine
from sim_backend.rig import Rig
from stagectl.fields import fields
from stagectl.profile import load_profile
from stagectl.signals import MEASUREMENT, new

MS = 1_000_000


def _measurements(name: str, taken_early: bool) -> tuple[np.ndarray, np.ndarray]:
    """Listen for 0.6 s, three lines a cycle, each offered at once or all at its end; measurements and clock."""
    wire = BatchWire(Rig(load_machine(name), seed=3))
    decoder = WireDecoder(load_profile(name), {})
    measured, inbox = new(MEASUREMENT), Inbox()
    seen = fields(measured)
    rows = np.zeros(200, MEASUREMENT)
    for number in range(rows.size):
        inbox.clear()
        due_t_ns = wire.t_ns + 3 * MS
        while (line_t_ns := wire.next_line_t_ns()) <= due_t_ns:
            wire.advance_to(line_t_ns)
            inbox.add_sensor_bytes(wire.serial.read(), wire.serial.arrival_t_ns)
            if taken_early:
                decoder.take_first_bytes(inbox)
        wire.advance_to(due_t_ns)
        inbox.t_ns = wire.t_ns
        assert decoder.decode(inbox, seen) == ""
        seen.store()
        rows[number] = measured[0]
    wire.close()
    return rows, decoder.clock


@pytest.mark.parametrize("name", ["oled-printer", "oled-printer-umd2"])
def test_bytes_taken_before_the_cycle_is_due_give_the_same_measurements(name):
    early, late = _measurements(name, True), _measurements(name, False)
    assert early[0]["samples_new"].sum() > 590
    assert np.array_equal(early[0], late[0])
    assert np.array_equal(early[1], late[1])


COUNTS = 5_000_000  # of 79.1 nm: 0.4 m
LINE = b"2000 2000 %d 0 0 %d %d %d 2000 %d 0 0 0 0 0 0\r\n"
HENE_M = 632.991e-9


class Lines:
    """A decoder that hears a uMD2 line a cycle, the stage at rest 0.4 m from its zeros."""

    def __init__(self) -> None:
        self.decoder = WireDecoder(load_profile("oled-printer-umd2"), {})
        self.seen = fields(new(MEASUREMENT))
        self.number = 0
        self.hear()
        self.hear()
        self.decoder.set_zeros(0.0, 0.0)

    def hear(self, code: int = 0, data: int = 0) -> float:
        """Hear one line and return where the macro is; macro and end stand at opposite sides of zero."""
        inbox = Inbox(t_ns=10**9 + self.number * MS + MS // 2)
        line = LINE % (COUNTS, self.number, code, data, -COUNTS // 2)
        inbox.add_sensor_bytes(line, 10**9 + self.number * MS + 150_000)
        self.number += 1
        assert self.decoder.decode(inbox, self.seen) == ""
        return self.seen.macro_position_m


def test_the_index_follows_the_devices_air_and_moves_no_position_by_more_than_a_tenth_of_a_nanometre_a_cycle():
    """From the profile's 20 degC to 21 degC: 0.955e-6 of 0.4 m is 378 nm, 3780 cycles."""
    lines = Lines()
    warm = ciddor_index(HENE_M, 21.0, 101325.0, 50.0, 450.0)
    assert lines.decoder.air_index == ciddor_index(HENE_M, 20.0, 101325.0, 50.0, 450.0)
    before_m = lines.hear(3, 2100)
    assert lines.hear(3, 2100) - before_m == pytest.approx(1e-10, rel=1e-3)  # less air, a longer wave: it grows
    positions_m = [before_m, *(lines.hear() for _ in range(4000))]
    assert np.max(np.abs(np.diff(positions_m[1:]))) <= 1.001e-10
    assert lines.decoder.air_index == warm
    assert positions_m[-1] == pytest.approx(COUNTS * HENE_M / (8.0 * warm), rel=1e-15)
    assert lines.seen.end_position_m == pytest.approx(-0.5 * positions_m[-1], rel=1e-15)
    assert positions_m[-1] - positions_m[0] == pytest.approx(378e-9, abs=2e-9)
    assert 3700 < np.count_nonzero(np.diff(positions_m)) < 3860


def test_pressure_and_humidity_count_as_well():
    lines = Lines()
    for code, data in ((5, 100325), (6, 400), (5, 100325), (6, 400)):
        lines.hear(code, data)
    for _ in range(12_000):
        lines.hear()
    assert lines.decoder.air_index == ciddor_index(HENE_M, 20.0, 100325.0, 40.0, 450.0)


def test_flickering_last_digits_move_nothing():
    """0.01 K and 1 Pa are 1.2e-8 of the index: less than Ciddor's equation knows it."""
    lines = Lines()
    at_m = lines.hear()
    for _ in range(20):
        for code, data in ((3, 2001), (5, 101326), (3, 2000), (5, 101325)):
            assert lines.hear(code, data) == at_m


def test_air_that_is_none_changes_nothing():
    """150 kPa is within what a device may say, and outside Ciddor's range."""
    lines = Lines()
    at_m = lines.hear()
    for _ in range(5):
        assert lines.hear(5, 150_000) == at_m


def test_a_decoder_goes_on_in_the_midst_of_a_ramp():
    lines, other = Lines(), Lines()
    for _ in range(3):
        lines.hear(3, 2100)
    other.decoder.restore(lines.decoder.snapshot())
    other.number = lines.number
    for _ in range(100):
        assert other.hear() == lines.hear()
    assert other.decoder.air_index == lines.decoder.air_index != ciddor_index(HENE_M, 20.0, 101325.0, 50.0, 450.0)


def test_where_no_position_is_the_index_is_there_at_once():
    lines = Lines()
    lines.decoder.set_zeros(float(COUNTS), float(-COUNTS // 2))
    lines.hear(3, 2100)
    assert lines.hear(3, 2100) == 0.0
    assert lines.decoder.air_index == ciddor_index(HENE_M, 21.0, 101325.0, 50.0, 450.0)


def test_when_the_last_command_was_latched_is_told_from_its_own_sample():
    """Lines at 150 us, SYNCs 600 us behind the samples and a little more each: late lines and none change nothing."""
    decoder = WireDecoder(load_profile("oled-printer-umd2"), {})
    seen = fields(new(MEASUREMENT))
    inbox = Inbox()
    told, meant = [], []
    for number in range(3000):
        late, lost = number % 7 == 3, number % 31 == 30
        inbox.clear()
        sample_t_ns = 10**9 + number * MS
        inbox.t_ns = sample_t_ns + 400_000
        if number % 7 == 4:
            inbox.add_sensor_bytes(LINE % (COUNTS, number - 1, 0, 0, -COUNTS // 2), sample_t_ns - 100_000)
        if not late and not lost:
            inbox.add_sensor_bytes(LINE % (COUNTS, number, 0, 0, -COUNTS // 2), sample_t_ns + 150_000)
        assert decoder.decode(inbox, seen) == ""
        told.append(seen.latched_after_s)
        meant.append(1e-9 * (inbox.sync_t_ns - sample_t_ns + MS) if number else 0.0)
        inbox.sync_t_ns = sample_t_ns + 600_000 + 50 * (number % 90)
    assert told[0] == 0.0
    assert np.max(np.abs(np.array(told[2000:]) - meant[2000:])) < 0.2e-6


@pytest.mark.parametrize("waiting", [2, 5, 300])
def test_lines_that_waited_for_minutes_in_an_adapter_are_followed_by_todays(waiting):
    """Such a jump ended the servo: the clock had been found from fewer lines than tell a jump from a gap."""
    decoder, seen = WireDecoder(load_profile("oled-printer-umd2"), {}), fields(new(MEASUREMENT))
    numbers = [*range(waiting), *range(60_000, 63_000)]
    for cycle, number in enumerate(numbers):
        sample_t_ns = 10**9 + cycle * MS
        inbox = Inbox(t_ns=sample_t_ns + 400_000)
        inbox.add_sensor_bytes(LINE % (COUNTS, number, 0, 0, -COUNTS // 2), sample_t_ns + 150_000)
        assert decoder.decode(inbox, seen) == ""
    assert (seen.samples_new, seen.sequence, seen.macro_position_m) == (1, 62_999, 0.0)
    assert seen.sample_t_ns == pytest.approx(sample_t_ns, abs=1000)


def test_a_line_that_comes_with_the_next_is_told_too():
    """Counts of the uMD2 move between them; alone, a sample has none before it."""
    decoder, seen = WireDecoder(load_profile("oled-printer-umd2"), {}), fields(new(MEASUREMENT))
    told = []
    for numbers in ((0,), (1,), (), (2, 3), (4,), (5, 6, 7)):
        inbox = Inbox(t_ns=10**9 + (numbers[-1] if numbers else 2) * MS + MS // 2)
        for number in numbers:
            inbox.add_sensor_bytes(LINE % (100 * number, number, 0, 0, 50 * number), inbox.t_ns - 350_000)
        assert decoder.decode(inbox, seen) == ""
        earlier_m = seen.macro_position_m - seen.macro_earlier_m, seen.end_position_m - seen.end_earlier_m
        told.append((seen.samples_new, seen.earlier_sequence, earlier_m))
    assert [one[:2] for one in told[2:]] == [(0, -1), (2, 2), (1, -1), (3, 6)]  # the first waits for a second
    for place in (3, 5):
        apart_m = told[place][2]
        assert apart_m[0] == pytest.approx(100 * decoder.macro_m_per_count, rel=1e-9)
        assert abs(apart_m[1]) == pytest.approx(50 * decoder.end_m_per_count, rel=1e-9)


def _macro_alone() -> dict[str, DriveMapping]:
    actual, command = Codec.from_mapping((0x6041_0010, 0x6064_0020, 0x6077_0010)), Codec.from_mapping((0x6040_0010,))
    return {"macro": DriveMapping(1, command, actual, Codec.from_mapping((0x60FD_0020,)), 0x201, 0x181, 0x281, 0x81)}


def _heard(decoder: WireDecoder, seen, number: int, counts: tuple[int, int], encoder_count: int) -> None:
    """Decode one cycle: a line of the interferometer, and what the drive's encoder says."""
    inbox = Inbox(t_ns=10**9 + number * MS + 400_000)
    inbox.sync_t_ns = 10**9 + number * MS - 400_000 if number else 0
    inbox.add_sensor_bytes(LINE % (counts[0], number, 0, 0, counts[1]), inbox.t_ns - 250_000)
    inbox.take("macro_tpdo", struct.pack("<Hih", 0x0237, encoder_count, 0))
    assert decoder.decode(inbox, seen) == ""


@pytest.mark.parametrize("late", [(), (60,), (58, 59, 60)])
@pytest.mark.parametrize(("who", "jump_m"), [("encoder", 3e-3), ("encoder", -3e-3), ("laser", 1e-3), ("laser", -1e-3)])
def test_who_jumped_is_told_behind_late_lines_too(who, jump_m, late):
    """At 0.2 m/s, one of the two off from sample 60 on: it can't be compared while lines are late."""
    profile = load_profile("oled-printer-umd2")
    decoder, seen = WireDecoder(profile, _macro_alone()), fields(new(MEASUREMENT))
    inbox, waiting = Inbox(), b""
    for number in range(75):
        way_m, off_m = 2e-4 * number, jump_m if number >= 60 else 0.0
        counts = (way_m + (off_m if who == "laser" else 0.0)) / decoder.macro_m_per_count
        inbox.clear()
        inbox.t_ns = 10**9 + number * MS + 400_000
        waiting += LINE % (round(counts), number, 0, 0, round(counts))
        if number not in late:
            inbox.add_sensor_bytes(waiting, inbox.t_ns - 250_000)
            waiting = b""
        # The drive sampled it at the last SYNC, 0.4 ms before this line's sample.
        encoder_m = way_m - 0.4e-3 * 0.2 + (off_m if who == "encoder" else 0.0)
        inbox.take("macro_tpdo", struct.pack("<Hih", 0x0237, round(encoder_m / profile.macro.encoder_step_m), 0))
        assert decoder.decode(inbox, seen) == ""
        inbox.sync_t_ns = 10**9 + number * MS + 600_000
        if number == 2:
            decoder.set_zeros(0.0, 0.0)
    assert seen.reference_lost == (who == "laser"), decoder.reference_text
    assert ("which jumped" in decoder.encoder_text) == (who == "encoder")


@pytest.mark.parametrize("repeats", [(60,), (80,), (60, 80)])
@pytest.mark.parametrize("jump_m", [2e-3, -2e-3])
def test_an_encoder_that_jumps_while_a_sample_repeats_another_is_no_stuck_laser(jump_m, repeats):
    """At rest, with 5 counts of noise: each axis says the same twice by chance, as the encoder goes or comes back."""
    profile = load_profile("oled-printer-umd2")
    decoder, seen = WireDecoder(profile, _macro_alone()), fields(new(MEASUREMENT))
    jump_count = round(jump_m / profile.macro.encoder_step_m)
    random, counts = np.random.default_rng(1), (0, 0)
    for number in range(100):
        if number not in repeats:
            counts = tuple(counts[k] + int(random.integers(1, 5)) * (-1) ** (number // 2) for k in range(2))
        _heard(decoder, seen, number, counts, jump_count if 60 <= number < 80 else 0)
        if number == 2:
            decoder.set_zeros(0.0, 0.0)
    assert seen.reference_lost == 0, decoder.reference_text
    assert "which jumped" in decoder.encoder_text


@pytest.mark.parametrize("stuck", ["macro", "end", "both"])
def test_counts_that_are_stuck_are_found_under_full_force(stuck):
    """28 um more in each cycle, from rest: no jump of the encoder, and the next sample finds it."""
    profile = load_profile("oled-printer-umd2")
    decoder, seen = WireDecoder(profile, _macro_alone()), fields(new(MEASUREMENT))
    way_m = np.cumsum(28e-6 * np.maximum(np.arange(70) - 50, 0))
    for number in range(62):
        at_m = [way_m[min(number, 60)] if stuck in (axis, "both") else way_m[number] for axis in ("macro", "end")]
        counts = (round(at_m[0] / decoder.macro_m_per_count), round(at_m[1] / decoder.end_m_per_count))
        encoder_m = way_m[number] - 0.4 * (way_m[number] - way_m[max(number - 1, 0)])
        _heard(decoder, seen, number, counts, round(encoder_m / profile.macro.encoder_step_m))
        if number == 2:
            decoder.set_zeros(0.0, 0.0)
        assert (seen.reference_lost != 0) == (number == 61), decoder.reference_text
    assert "counts are stuck" in decoder.reference_text


@pytest.mark.parametrize("step_m", [2e-4, 3e-5])
@pytest.mark.parametrize("stuck", ["macro", "end", "both"])
def test_counts_that_are_stuck_are_found_where_the_encoder_goes_on(stuck, step_m):
    """At 0.2 m/s and where a stage comes to rest: within two samples of where the encoder is the limit away."""
    profile = load_profile("oled-printer-umd2")
    decoder, seen = WireDecoder(profile, _macro_alone()), fields(new(MEASUREMENT))
    lost_at = None
    for number in range(80):
        way_m = [step_m * (min(number, 60) if stuck in (axis, "both") else number) for axis in ("macro", "end")]
        counts = (round(way_m[0] / decoder.macro_m_per_count), round(way_m[1] / decoder.end_m_per_count))
        encoder_m = step_m * (number - 0.4)
        _heard(decoder, seen, number, counts, round(encoder_m / profile.macro.encoder_step_m))
        if number == 2:
            decoder.set_zeros(0.0, 0.0)
        if seen.reference_lost and lost_at is None:
            lost_at = number
    least = profile.interferometer.encoder_disagreement_m / step_m
    assert lost_at is not None
    assert 60 + least < lost_at <= 60 + least + 2
    assert "counts are stuck" in decoder.reference_text
    assert decoder.encoder_text == ""


@pytest.mark.parametrize("axis", ["macro", "micro"])
def test_what_a_drive_tells_of_inputs_and_mode(axis):
    """0x60FD and 0x6061 behind it: 09 00 01 00 is 0x10009, 0A is 10, FF is -1; 0 is a mode, too."""
    actual, command = Codec.from_mapping((0x6041_0010, 0x6064_0020, 0x6077_0010)), Codec.from_mapping((0x6040_0010,))
    events = Codec.from_mapping((0x60FD_0020, 0x6061_0008))
    mappings = {
        name: DriveMapping(node, command, actual, events, 0x200 + node, 0x180 + node, 0x280 + node, 0x080 + node)
        for node, name in ((1, "macro"), (2, "micro"))
    }
    decoder, seen = WireDecoder(load_profile("oled-printer"), mappings), fields(new(MEASUREMENT))

    def told(payload: str) -> tuple[int, int, int]:
        inbox = Inbox()
        inbox.take(f"{axis}_inputs_tpdo", bytes.fromhex(payload))
        assert decoder.decode(inbox, seen) == ""
        return getattr(seen, f"{axis}_digital_inputs"), getattr(seen, f"{axis}_mode_display"), seen.modes_told

    bit = {"macro": 1, "micro": 2}[axis]
    assert decoder.decode(Inbox(), seen) == ""
    assert seen.modes_told == 0
    assert told("09 00 01 00 0A") == (0x10009, 10, bit)
    assert told("00 00 00 00 FF") == (0, -1, bit)
    assert told("00 00 00 00 00") == (0, 0, bit)
    assert decoder.decode(Inbox(), seen) == ""
    assert seen.modes_told == bit  # until the drive tells anew
    short = Inbox()
    short.take(f"{axis}_inputs_tpdo", bytes(4))
    assert f"inputs of {axis} (node {bit}): PDO of 4 bytes" in decoder.decode(short, seen)


def test_inputs_alone_tell_no_mode():
    """Of a drive that can't map it, and of a run that was recorded when none did."""
    actual, command = Codec.from_mapping((0x6041_0010, 0x6064_0020, 0x6077_0010)), Codec.from_mapping((0x6040_0010,))
    mapping = DriveMapping(1, command, actual, Codec.from_mapping((0x60FD_0020,)), 0x201, 0x181, 0x281, 0x081)
    decoder, seen = WireDecoder(load_profile("single-axis"), {"macro": mapping}), fields(new(MEASUREMENT))
    inbox = Inbox()
    inbox.take("macro_inputs_tpdo", bytes.fromhex("01 00 00 00 0A"))  # some drives always send 8 bytes
    assert decoder.decode(inbox, seen) == ""
    assert (seen.macro_digital_inputs, seen.macro_mode_display, seen.modes_told) == (1, 0, 0)
