"""Micro-Epsilon RS422 blocks: literals by hand, flag bits, error codes, counter, replies that share the wire."""

import math
import random

import pytest

from drivers.framers import framer_for
from drivers.reading import END_VALID, MACRO_VALID, REFERENCE_LOST, RESTARTED
from stagectl.errors import ProfileError

BOTH = MACRO_VALID | END_VALID

# 131000 = 31 * 4096 + 62 * 64 + 56; 98232 = 23 * 4096 + 62 * 64 + 56.
# L = 00|56, M = 01|62, H = 10|31 for the first value of a block, 11|23 for a further one.
MACRO = bytes.fromhex("38 7e 9f")
END = bytes.fromhex("38 7e d7")
COUNTER_5 = bytes.fromhex("05 40 c0")
COUNTER_6 = bytes.fromhex("06 40 c0")
COUNTER_7 = bytes.fromhex("07 40 c0")


def framer(*values, **options):
    return framer_for(
        {"format": "micro-epsilon", "incremental": False, "frame": {"values": list(values or DEFAULT), **options}}
    )


DEFAULT = ("macro", "end", "counter")


def value(number, first):
    return bytes([number & 63, 0x40 | number >> 6 & 63, (0x80 if first else 0xC0) | number >> 12])


def block(macro, end, counter):
    return value(macro, True) + value(end, False) + value(counter % (1 << 18), False)


def stream(count=6, start=50):
    truth = {start + k: (100_000.0 + 4099 * k, 90_000.0 - 5003 * k) for k in range(count)}
    return truth, [block(int(macro), int(end), number) for number, (macro, end) in truth.items()]


def test_literal_blocks():
    readings = framer().feed(MACRO + END + COUNTER_5 + MACRO + END + COUNTER_6)
    assert [(r.sequence, r.macro_counts, r.end_counts, r.flags) for r in readings] == [
        (5, 131000.0, 98232.0, BOTH),
        (6, 131000.0, 98232.0, BOTH),
    ]


def test_without_counter_samples_are_numbered_here():
    readings = framer("macro").feed(MACRO + MACRO)
    assert [(r.sequence, r.macro_counts, r.flags) for r in readings] == [(0, 131000.0, 1), (1, 131000.0, 1)]


def test_error_codes_begin_above_262072():
    data = (
        bytes.fromhex("38 7e bf") + END + COUNTER_5  # 262072 = 63 * 4096 + 62 * 64 + 56: the last value
        + bytes.fromhex("39 7e bf") + END + COUNTER_6  # 262073
        + MACRO + bytes.fromhex("3f 7e ff") + COUNTER_7  # 262079
    )  # fmt: skip
    readings = framer().feed(data)
    assert readings[0].macro_counts == 262072.0
    assert [r.flags for r in readings] == [BOTH, END_VALID, MACRO_VALID]
    assert math.isnan(readings[1].macro_counts)
    assert math.isnan(readings[2].end_counts)


def test_counter_may_reach_the_error_codes():
    readings = framer().feed(b"".join(block(1, 2, k) for k in range(262_140, 262_148)))
    assert [r.sequence for r in readings] == list(range(262_140, 262_148))  # unwrapped past 2^18
    assert {r.flags for r in readings} == {BOTH}


def test_gap_and_restart():
    numbers = [50, 51, 52, 55, 56, 3, 4, 5]
    device = framer()
    readings = device.feed(b"".join(block(1, 2, k) for k in numbers))
    assert [r.sequence for r in readings] == numbers
    assert [r.flags for r in readings] == [3, 3, 3, 3, 3, 3 | RESTARTED, 3, 3]  # absolute: no reference to lose
    assert (device.counters.samples_lost, device.counters.restarts) == (2, 1)


def test_incremental_loses_reference_on_an_error_code():
    device = framer_for({"format": "micro-epsilon", "frame": {"values": ["macro", "counter"]}})
    readings = device.feed(b"".join(value(m, True) + value(k, False) for k, m in enumerate([1, 2, 262_076, 4])))
    assert [r.flags for r in readings] == [MACRO_VALID, MACRO_VALID, REFERENCE_LOST, MACRO_VALID]


def test_dropped_byte_gives_no_wrong_value():
    """It costs one block, two where it was a block's last byte: the next one is not trusted then."""
    truth, blocks = stream(9)
    data = b"".join(blocks)
    for i in range(len(data)):
        readings = framer().feed(data[:i] + data[i + 1 :])
        # Near the start and the end a neighbour more is missing: the one that would confirm.
        assert len(readings) >= (7 if 9 <= i < 54 else 6)
        assert all((r.macro_counts, r.end_counts) == truth[r.sequence] for r in readings)


def test_inserted_byte_gives_no_wrong_value():
    truth, blocks = stream()
    data = b"".join(blocks)
    for i in range(len(data) + 1):
        for byte in range(256):
            device = framer()
            readings = device.feed(data[:i] + bytes([byte]) + data[i:])
            assert all((r.macro_counts, r.end_counts) == truth[r.sequence] for r in readings), (i, byte)
            assert device.counters.bytes_discarded + device.counters.unconfirmed > 0 or i == 0 or i >= len(data) - 1


def test_flipped_flag_bit_gives_no_wrong_value():
    truth, blocks = stream()
    data = b"".join(blocks)
    for i in range(len(data)):
        for bit in (6, 7):
            readings = framer().feed(data[:i] + bytes([data[i] ^ 1 << bit]) + data[i + 1 :])
            assert len(readings) >= 3
            assert all((r.macro_counts, r.end_counts) == truth[r.sequence] for r in readings)


def test_flipped_counter_bit_is_neither_gap_nor_restart():
    truth, blocks = stream()
    data = b"".join(blocks)
    for i in (24, 25, 26):
        for bit in range(6):
            device = framer()
            readings = device.feed(data[:i] + bytes([data[i] ^ 1 << bit]) + data[i + 1 :])
            assert [r.sequence for r in readings] == [50, 51, 53, 54, 55]
            assert all((r.macro_counts, r.end_counts) == truth[r.sequence] for r in readings)
            assert device.counters.restarts == 0


@pytest.mark.parametrize("reply", [b"->", b"OUTPUT RS422\r\n->", b"E01 unknown\n->", b">", b"~>"])
def test_reply_inside_the_stream_forges_no_value(reply):
    """A reply that ends in '>' (0x3E, like a low byte) between L and M must not become the low bits of a value."""
    truth, blocks = stream()
    data = b"".join(blocks)
    for i in range(len(data) + 1):
        readings = framer().feed(data[:i] + reply + data[i:])
        assert all((r.macro_counts, r.end_counts) == truth[r.sequence] for r in readings), i
        assert len(readings) >= 3


def test_any_cut_gives_the_same():
    _, blocks = stream(8)
    data = b"".join(blocks[:3]) + b"->junk" + b"".join(blocks[4:]) + blocks[0][:5]
    whole = framer()
    expected = whole.feed(data)
    for place in range(len(data) + 1):
        cut = framer()
        assert cut.feed(data[:place]) + cut.feed(data[place:]) == expected
        assert cut.snapshot() == whole.snapshot()
    single = framer()
    assert [r for byte in data for r in single.feed(bytes([byte]))] == expected
    assert single.counters == whole.counters


def test_snapshot_goes_on_mid_stream():
    _, blocks = stream(8)
    data = b"".join(blocks)
    for place in range(len(data)):
        first, second = framer(), framer()
        head = first.feed(data[:place])
        second.restore(first.snapshot())
        assert head + second.feed(data[place:]) == framer().feed(data)


def test_noise_is_bounded_and_counted():
    noise = random.Random(3)
    device = framer()
    readings = []
    for _ in range(1000):
        readings += device.feed(noise.randbytes(1000))
    assert len(device.snapshot()) < 2000
    assert device.counters.bytes_discarded > 900_000
    # Twenty-seven flag bits and two neighbouring counters have to fall right by chance.
    assert len(readings) < 10


@pytest.mark.parametrize(
    ("values", "options"),
    [(("macro", "macro", "counter"), {}), (("counter",), {}), (("macro", "x"), {}), (("macro",), {"counter": 1})],
)
def test_bad_profile_is_refused(values, options):
    with pytest.raises(ProfileError, match="interferometer"):
        framer(*values, **options)
