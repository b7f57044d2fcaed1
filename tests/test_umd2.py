"""uMD2 lines: literals by hand, every cut, every damaged byte, restarts, lost beams."""

import json
import math
import random

import pytest

from drivers.framers import framer_for
from drivers.reading import END_VALID, MACRO_VALID, REFERENCE_LOST, RESTARTED
from stagectl.errors import ProfileError, RecordError

BOTH = MACRO_VALID | END_VALID


def heterodyne(**frame):
    return framer_for({"format": "umd2", "incremental": True, "frame": frame})


def homodyne():
    return heterodyne(homodyne=True)


# REF MEAS1 DISP1 VEL1 PHASE1 SEQ LSC LSD MEAS2 DISP2 VEL2 PHASE2 MEAS3 DISP3 VEL3 PHASE3
LINE_7 = b"3000 3001 1000 5 16384 7 0 0 2999 -20 1 32768 0 0 0 0\r\n"
LINE_8 = b"3000 3001 1005 5 -16384 8 0 0 2999 -19 1 0 0 0 0 0\r\n"
LINE_9 = b"3000 3001 1010 5 65535 9 0 0 2999 -18 1 1 0 0 0 0\r\n"


def homodyne_stream(count=6, start=100):
    """Lines whose displacement and velocity agree, positions 250 counts apart, and the positions by number."""
    truth, lines = {}, []
    for k in range(count):
        macro, end = 7000 + 257 * k, -312 - 31 * k
        truth[start + k] = (macro, end)
        lines.append(b"0 0 %d 257 0 %d 0 0 0 %d -31 0 0 0 0 0\r\n" % (macro, start + k, end))
    return truth, lines


def feed_all(framer, data, size=None):
    if size is None:
        return framer.feed(data)
    return [r for i in range(0, len(data), size) for r in framer.feed(data[i : i + size])]


def test_phase_is_subtracted():
    readings = heterodyne().feed(LINE_7 + LINE_8 + LINE_9)
    assert [(r.sequence, r.macro_counts, r.end_counts, r.flags) for r in readings] == [
        (7, 999.75, -20.5, BOTH),  # 1000 - 16384 / 65536, -20 - 32768 / 65536
        (8, 1005.25, -19.0, BOTH),
        (9, 1010.0 - 65535 / 65536, -18.0 - 1 / 65536, BOTH),
    ]


def test_axes_are_configured():
    framer = heterodyne(macro_axis=2, end_axis=1)
    readings = framer.feed(LINE_7 + LINE_8)
    assert (readings[0].macro_counts, readings[0].end_counts) == (-20.5, 999.75)


def test_one_axis_device():
    framer = heterodyne(columns_count=8)
    readings = framer.feed(b"9 9 4 1 0 1 0 0\r\n9 9 5 1 0 2 0 0\r\n")
    assert [(r.macro_counts, math.isnan(r.end_counts), r.flags) for r in readings] == [
        (4.0, True, MACRO_VALID),
        (5.0, True, MACRO_VALID),
    ]


@pytest.mark.parametrize(
    ("line", "flags"),
    [
        (b"0 3001 1010 5 0 9 0 0 2999 -18 1 1 0 0 0 0\r\n", 0),  # no reference beam: neither axis counts
        (b"3000 0 1010 5 0 9 0 0 2999 -18 1 1 0 0 0 0\r\n", END_VALID),
        (b"3000 3001 1010 5 0 9 0 0 0 -18 1 1 0 0 0 0\r\n", MACRO_VALID),
    ],
)
def test_beam_loss(line, flags):
    reading = heterodyne().feed(LINE_7 + LINE_8 + line)[-1]
    assert reading.flags == flags | REFERENCE_LOST
    assert math.isnan(reading.macro_counts) == (not flags & MACRO_VALID)
    assert math.isnan(reading.end_counts) == (not flags & END_VALID)


def test_eight_bit_phase_and_its_error_codes():
    framer = heterodyne(phase_bits=8)
    lines = (
        b"3000 3001 1000 5 64 7 0 0 2999 -20 1 -128 0 0 0 0\r\n"
        b"3000 3001 1001 1 0 8 0 0 2999 -20 1 0 0 0 0 0\r\n"
        b"3000 3001 1001 0 2048 9 0 0 2999 -20 1 0 0 0 0 0\r\n"  # 0x800: no MEAS 1
        b"3000 3001 1001 0 300 10 0 0 2999 -20 1 0 0 0 0 0\r\n"  # neither a fraction nor a code
    )
    readings = framer.feed(lines)
    assert [(r.macro_counts, r.end_counts) for r in readings[:2]] == [(999.75, -19.5), (1001.0, -20.0)]
    assert readings[2].flags == END_VALID | REFERENCE_LOST
    assert len(readings) == 3
    assert framer.counters.field_count_bad == 1


def test_device_announces_eight_bit_phase():
    framer = heterodyne()
    line = b"3000 3001 1000 0 128 %d 112 2 2999 -20 0 0 0 0 0 0\r\n"
    readings = framer.feed(b"".join(line % k for k in range(5)))
    # Held, confirmed, said once, said twice: from the line after the second on.
    assert [r.macro_counts for r in readings] == [1000 - 128 / 65536] * 3 + [999.5] * 2
    assert framer.environment.phase_bits == 8.0


def test_one_odd_phase_announcement_changes_nothing():
    framer = heterodyne()
    data = [112, 0], [112, 0], [112, 2], [112, 0], [112, 0]
    line = b"3000 3001 1000 0 128 %d %d %d 2999 -20 0 0 0 0 0 0\r\n"
    readings = framer.feed(b"".join(line % (k, *pair) for k, pair in enumerate(data)))
    assert {r.macro_counts for r in readings} == {1000 - 128 / 65536}


def test_environment():
    framer = heterodyne()
    low_speed = [(0, 0), (0, 0), (3, 2015), (4, 2110), (5, 101325), (6, 487), (8, 100000), (10, 126), (20, 0x0402)]
    line = b"3000 3001 1000 0 0 %d %d %d 2999 -20 0 0 0 0 0 0\r\n"
    framer.feed(b"".join(line % (k, *pair) for k, pair in enumerate(low_speed)))
    environment = framer.environment
    assert environment.temperature_degc == pytest.approx(20.15)
    assert environment.temperature_2_degc == pytest.approx(21.10)
    assert environment.pressure_pa == 101325.0  # 1013.25 mbar
    assert environment.relative_humidity_percent == pytest.approx(48.7)
    assert environment.sample_rate_hz == 1000.0
    assert environment.firmware == 1.26
    assert (environment.homodyne_axes_count, environment.counts_per_cycle_count) == (2.0, 4.0)


def told(framer, pairs, first: int = 0) -> None:
    """Feed lines that carry these low-speed codes and data."""
    line = b"3000 3001 1000 0 0 %d %d %d 2999 -20 0 0 0 0 0 0\r\n"
    framer.feed(b"".join(line % (first + k, *pair) for k, pair in enumerate(pairs)))


def test_air_counts_when_it_was_said_twice_alike():
    framer = heterodyne()
    told(framer, [(0, 0), (0, 0), (3, 2015), (5, 101325), (6, 487)])
    assert all(math.isnan(value) for value in framer.air.values())
    told(framer, [(3, 2016), (5, 101325)], 5)
    assert framer.air["temperature_degc"] == pytest.approx(20.16)
    assert framer.air["pressure_pa"] == 101325.0
    assert math.isnan(framer.air["relative_humidity_percent"])
    assert framer.air_number == 2
    told(framer, [(3, 2016)], 7)
    assert framer.air_number == 2  # nothing new


def test_a_wrong_digit_is_no_air():
    framer = heterodyne()
    told(framer, [(0, 0), (0, 0), (3, 2015), (3, 2015), (3, 6015), (3, 2015), (5, 101325), (5, 171325), (5, 101325)])
    assert framer.air["temperature_degc"] == pytest.approx(20.15)
    assert math.isnan(framer.air["pressure_pa"])
    told(framer, [(5, 101326), (3, 9900000), (3, 2115), (3, 2116)], 9)
    assert framer.air == pytest.approx(
        {"temperature_degc": 21.16, "pressure_pa": 101326.0, "relative_humidity_percent": math.nan}, nan_ok=True
    )


def test_air_is_in_the_snapshot():
    framer, other = heterodyne(), heterodyne()
    told(framer, [(0, 0), (0, 0), (3, 2015), (3, 2015), (5, 101325)])
    other.restore(framer.snapshot())
    for one in (framer, other):
        told(one, [(5, 101325), (3, 2020)], 5)
    assert (other.air["temperature_degc"], other.air["pressure_pa"]) == pytest.approx((20.2, 101325.0))
    assert other.air_number == framer.air_number == 3
    assert other.snapshot() == framer.snapshot()


def test_debug_lines_and_banner():
    framer = heterodyne()
    readings = framer.feed(b"uMD2 ready\r\n! debug 1 2 3\r\n" + LINE_7 + b"!\r\n" + LINE_8)
    assert [r.sequence for r in readings] == [7, 8]
    assert framer.counters.field_count_bad == 1  # the banner
    assert framer.counters.resyncs == 1


def test_gap_is_counted():
    framer = heterodyne()
    lines = [LINE_7.replace(b" 7 ", b" %d " % k) for k in (7, 8, 12, 13)]
    readings = framer.feed(b"".join(lines))
    assert [r.sequence for r in readings] == [7, 8, 12, 13]
    counters = framer.counters
    assert (counters.sequence_gaps, counters.samples_lost, counters.longest_gap, counters.restarts) == (1, 3, 3, 0)
    assert all(r.flags == BOTH for r in readings)


def test_restart_loses_the_reference():
    framer = heterodyne()
    lines = [LINE_7.replace(b" 7 ", b" %d " % k) for k in (907, 908, 0, 1, 2)]
    readings = framer.feed(b"".join(lines))
    assert [(r.sequence, r.flags) for r in readings] == [
        (907, BOTH),
        (908, BOTH),
        (0, BOTH | REFERENCE_LOST | RESTARTED),
        (1, BOTH),
        (2, BOTH),
    ]
    assert framer.counters.restarts == 1


def test_homodyne_displacement_is_checked_against_velocity():
    framer = homodyne()
    truth, lines = homodyne_stream()
    lines[3] = lines[3].replace(b" 7771 ", b" 7171 ")
    readings = framer.feed(b"".join(lines))
    assert [r.sequence for r in readings] == [100, 101, 102, 104, 105]
    assert all((r.macro_counts, r.end_counts) == truth[r.sequence] for r in readings)
    assert framer.counters.line_check_bad == 1
    assert framer.counters.samples_lost == 1


def test_homodyne_counter_zeroed_in_the_device():
    """Displacement that jumps while the velocity says it did not: the zero is gone, however small the jump."""
    framer = homodyne()
    _, lines = homodyne_stream()
    shifted = [line.replace(b" 0 0 0 -", b" 0 0 0 -9") for line in lines[3:]]
    readings = framer.feed(b"".join(lines[:3] + shifted))
    assert [r.flags & REFERENCE_LOST for r in readings] == [0, 0, 0, REFERENCE_LOST, 0, 0]


@pytest.mark.parametrize("size", [1, 2, 3, 7, 64])
def test_any_cut_gives_the_same(size):
    _, lines = homodyne_stream(12)
    data = b"junk\r\n" + b"".join(lines[:5]) + b"!x\r\n" + b"\xff" * 30 + b"".join(lines[6:])
    whole, cut = homodyne(), homodyne()
    assert feed_all(whole, data) == feed_all(cut, data, size)
    assert whole.counters == cut.counters
    assert whole.snapshot() == cut.snapshot()


def test_cut_at_every_position():
    _, lines = homodyne_stream()
    data = b"".join(lines)
    expected = homodyne().feed(data)
    for place in range(len(data) + 1):
        framer = homodyne()
        assert framer.feed(data[:place]) + framer.feed(data[place:]) == expected


def damaged(data):
    """`data` with one byte dropped, one inserted, one bit flipped, at every position."""
    for i in range(len(data)):
        yield data[:i] + data[i + 1 :]
        for bit in range(8):
            yield data[:i] + bytes([data[i] ^ 1 << bit]) + data[i + 1 :]
        for byte in b"059- \r\n!\x00\xff":
            yield data[:i] + bytes([byte]) + data[i:]


def test_no_damaged_byte_gives_a_wrong_value():
    """Displacement and number are always right; a damaged phase, which nothing checks, is less than a count."""
    truth, lines = homodyne_stream(5)
    data = b"".join(lines)
    for bad in damaged(data):
        framer = homodyne()
        readings = framer.feed(bad)
        assert len(readings) >= 2
        for r in readings:
            macro, end = truth[r.sequence]
            assert abs(r.macro_counts - macro) < 1
            assert abs(r.end_counts - end) < 1
            assert not r.flags & RESTARTED
        counters = framer.counters
        lost = counters.field_count_bad + counters.line_check_bad + counters.unconfirmed + counters.samples_lost
        if len(readings) < 5:
            assert lost > 0 or readings[0].sequence > 100 or readings[-1].sequence < 104


def test_damaged_sequence_number_is_neither_gap_nor_restart():
    lines = [LINE_7.replace(b" 7 ", b" %d " % k) for k in range(95, 105)]
    for number in range(100000):
        if number in range(95, 105):
            continue
        if number > 300 and number % 997:
            continue
        framer = heterodyne()
        bad = [*lines[:5], LINE_7.replace(b" 7 ", b" %d " % number), *lines[6:]]
        readings = framer.feed(b"".join(bad))
        assert [r.sequence for r in readings] == [95, 96, 97, 98, 99, 101, 102, 103, 104], number
        assert framer.counters.restarts == 0


def test_snapshot_goes_on_mid_stream():
    _, lines = homodyne_stream(8)
    lines[4] = lines[4].replace(b" 104 ", b" 204 ")
    data = b"".join(lines)
    for place in range(0, len(data), 5):
        first, second = homodyne(), homodyne()
        head = first.feed(data[:place])
        second.restore(first.snapshot())
        assert head + second.feed(data[place:]) == homodyne().feed(data)
        first.feed(data[place:])
        assert first.snapshot() == second.snapshot()
    json.loads(first.snapshot())  # plain JSON


def test_snapshot_of_another_framer_is_refused():
    other = framer_for({"format": "micro-epsilon", "frame": {"values": ["macro", "end", "counter"]}})
    with pytest.raises(RecordError, match="flagbits"):
        heterodyne().restore(other.snapshot())
    with pytest.raises(RecordError, match="not JSON"):
        heterodyne().restore(b"\x80\x04")


def test_junk_without_end_is_bounded_and_counted():
    framer = heterodyne()
    for _ in range(100):
        framer.feed(b"7 " * 300)
    assert len(framer.snapshot()) < 10_000
    assert len(framer.feed(b"\r\n" + LINE_7 + LINE_8)) == 2
    assert framer.counters.bytes_discarded == 100 * 600 + 2


def test_a_megabyte_of_noise():
    random_bytes = random.Random(5)
    digits = b"0123456789 -\r\n!"
    framer = heterodyne()
    for _ in range(1000):
        framer.feed(random_bytes.randbytes(512))
        framer.feed(bytes(random_bytes.choices(digits, k=512)))
    assert framer.counters.bytes_discarded > 900_000


@pytest.mark.parametrize(
    ("frame", "key"),
    [
        ({"macro_axis": 2, "end_axis": 2}, "end_axis"),
        ({"phase_bits": 12}, "phase_bits"),
        ({"columns_count": 9}, "columns_count"),
        ({"macro_axes": 1}, "macro_axes"),
        ({"homodyne": 1}, "homodyne"),
        ({"macro_axis": 4}, "macro_axis"),
    ],
)
def test_bad_profile_is_named(frame, key):
    with pytest.raises(ProfileError, match=key):
        heterodyne(**frame)
