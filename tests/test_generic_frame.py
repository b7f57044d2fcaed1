"""Frames that the profile describes: literals by hand, checksums, every cut, every damaged byte."""

import math
import random
import tomllib
from pathlib import Path

import pytest

from drivers.checksums import CHECKSUMS
from drivers.framers import framer_for
from drivers.reading import END_VALID, MACRO_VALID, REFERENCE_LOST, RESTARTED
from drivers.scale import counts_per_wavelength, counts_per_wavelength_of, metres_per_count, position_m
from stagectl.errors import ProfileError

BOTH = MACRO_VALID | END_VALID
PROFILE = Path(__file__).parent.parent / "profiles" / "oled-printer.toml"
OLED = tomllib.loads(PROFILE.read_text())["interferometer"]

# a5 5a | sequence u32 | macro i64 | end i64 | status | crc16-ccitt over all before it; all little endian.
# The crc was worked out bit by bit apart from the code under test.
FRAME_1 = bytes.fromhex("a55a 01000000 0504030201000000 feffffffffffffff 00 e7b0")
FRAME_2 = bytes.fromhex("a55a 02000000 ffffffffffffffff 0100000000000000 01 c10c")
FRAME_3 = bytes.fromhex("a55a 03000000 0500000000000000 0600000000000000 02 b97e")

# BETA LaserMike LaserSpeed, telegram TB: 5 x FF, quality 15, length 12345678, status, velocity -2, sum.
# 5 * FF + 0F + 00 + BC + 61 + 4E + 39 + FF + FF + FF + FE = AA9: A9.
TB_FRAME = bytes.fromhex("ffffffffff 0f 00bc614e 39 fffffffe a9")
TB = {
    "format": "syncfixed",
    "incremental": False,
    "frame": {
        "sync": "ffffffffff",
        "length": 16,
        "endian": "big",
        "checksum": "sum8",
        "fields": [
            {"name": "quality", "offset": 5, "type": "u8", "role": "check", "maximum": 15},
            {"name": "length", "offset": 6, "type": "i32", "role": "macro"},
            {"name": "status", "offset": 10, "type": "u8", "role": "status", "valid_mask": 0x30, "valid_value": 0x30},
            {"name": "velocity", "offset": 11, "type": "i32", "role": "ignore"},
        ],
    },
}


def oled_frame(sequence, macro, end, status=0):
    body = b"\xa5\x5a" + sequence.to_bytes(4, "little") + macro.to_bytes(8, "little", signed=True)
    body += end.to_bytes(8, "little", signed=True) + bytes([status])
    return body + CHECKSUMS["crc16-ccitt"][1](body).to_bytes(2, "little")


def oled_stream(count=6, start=1000):
    truth = {start + k: (70_000.0 + 0xA55A * k, -900.0 - 77 * k) for k in range(count)}
    return truth, [oled_frame(number, int(macro), int(end)) for number, (macro, end) in truth.items()]


def damaged(data, inserted=b"\x00\x5a\xa5\xff0"):
    for i in range(len(data)):
        yield data[:i] + data[i + 1 :]
        for bit in range(8):
            yield data[:i] + bytes([data[i] ^ 1 << bit]) + data[i + 1 :]
        for byte in inserted:
            yield data[:i] + bytes([byte]) + data[i:]


def as_values(readings):
    return [(r.sequence, repr(r.macro_counts), repr(r.end_counts), r.flags) for r in readings]


def test_checksums():
    assert CHECKSUMS["crc16-ccitt"][1](b"123456789") == 0x29B1  # the published check value of this crc
    assert CHECKSUMS["sum8"][1](b"\xff\x02\x03") == 0x04
    assert CHECKSUMS["xor8"][1](b"\x0f\xf0\x01") == 0xFE


def test_oled_frames():
    framer = framer_for(OLED)
    (first,) = framer.feed(FRAME_1)
    assert (first.sequence, first.macro_counts, first.end_counts, first.flags) == (1, float(0x0102030405), -2.0, BOTH)
    lost = framer.feed(FRAME_2 + FRAME_3)
    assert [r.sequence for r in lost] == [2, 3]
    assert all(r.flags & REFERENCE_LOST for r in lost)
    # The macro's beam is lost in frame 2, the end's in frame 3; incremental: either one costs the reference.
    assert math.isnan(lost[0].macro_counts)
    assert math.isnan(lost[1].end_counts)


def test_status_bits_can_speak_of_one_axis():
    frame = dict(OLED["frame"])
    frame["fields"] = [
        {**field, "macro_mask": 1, "end_mask": 2} if field["role"] == "status" else field for field in frame["fields"]
    ]
    readings = framer_for({**OLED, "frame": frame}).feed(FRAME_1 + FRAME_2 + FRAME_3)
    assert [r.flags for r in readings] == [BOTH, END_VALID | REFERENCE_LOST, MACRO_VALID | REFERENCE_LOST]
    assert (readings[1].end_counts, readings[2].macro_counts) == (1.0, 5.0)


def test_oled_gap_wrap_restart_duplicate():
    numbers = [0xFFFFFFFE, 0xFFFFFFFF, 0, 3, 3, 4, 1]
    framer = framer_for(OLED)
    readings = framer.feed(b"".join(oled_frame(k, 1, 2) for k in numbers))
    assert [r.sequence for r in readings] == [0xFFFFFFFE, 0xFFFFFFFF, 0x100000000, 0x100000003, 0x100000004, 1]
    assert [r.flags for r in readings] == [BOTH] * 5 + [BOTH | RESTARTED | REFERENCE_LOST]
    counters = framer.counters
    assert (counters.sequence_gaps, counters.samples_lost, counters.longest_gap) == (1, 2, 2)
    assert (counters.duplicates, counters.restarts, counters.frames_ok) == (1, 1, 6)


def test_lasermike_frame():
    framer = framer_for(TB)
    (reading,) = framer.feed(TB_FRAME)
    assert (reading.sequence, reading.macro_counts, reading.flags) == (0, 12345678.0, MACRO_VALID)
    assert math.isnan(reading.end_counts)
    # One more FF before a frame: the last five are the sync.
    (reading,) = framer.feed(b"\xff" + TB_FRAME)
    assert (reading.sequence, reading.macro_counts) == (1, 12345678.0)
    assert framer.counters.bytes_discarded == 1


def test_lasermike_bad_sum_is_counted():
    framer = framer_for(TB)
    readings = framer.feed(TB_FRAME[:-1] + b"\xa8" + TB_FRAME)
    assert [r.macro_counts for r in readings] == [12345678.0]
    assert framer.counters.checksum_bad == 1
    assert framer.counters.bytes_discarded == 16
    assert framer.counters.resyncs == 1


def test_no_damaged_byte_gives_a_wrong_value():
    truth, frames = oled_stream()
    data = b"".join(frames)
    for bad in damaged(data):
        framer = framer_for(OLED)
        readings = framer.feed(bad)
        assert len(readings) >= 5
        for r in readings:
            assert (r.macro_counts, r.end_counts) == truth[r.sequence]
            assert r.flags == BOTH
        counters = framer.counters
        # Every byte is in a reading, counted as lost, or still in the buffer (less than a frame).
        waiting = len(bad) - 25 * counters.frames_ok - counters.bytes_discarded
        assert 0 <= waiting < 25


def test_any_cut_gives_the_same():
    _, frames = oled_stream(4)
    data = frames[0][3:] + frames[1] + b"\xa5\x5a\xa5" + frames[2][:20] + frames[3] + b"\xa5"
    whole = framer_for(OLED)
    expected = whole.feed(data)
    assert len(expected) == 2
    for place in range(len(data) + 1):
        cut = framer_for(OLED)
        assert cut.feed(data[:place]) + cut.feed(data[place:]) == expected
        assert cut.snapshot() == whole.snapshot()
    single = framer_for(OLED)
    assert [r for byte in data for r in single.feed(bytes([byte]))] == expected
    assert single.counters == whole.counters


def test_snapshot_goes_on_mid_stream():
    _, frames = oled_stream(4)
    data = b"".join(frames)
    for place in range(len(data)):
        first, second = framer_for(OLED), framer_for(OLED)
        head = first.feed(data[:place])
        second.restore(first.snapshot())
        assert head + second.feed(data[place:]) == framer_for(OLED).feed(data)


def test_without_checksum_the_next_sync_must_follow():
    frame = {
        "sync": "a55a",
        "length": 8,
        "endian": "big",
        "fields": [
            {"offset": 2, "type": "u16", "role": "sequence"},
            {"offset": 4, "type": "i32", "role": "macro"},
        ],
    }
    truth = {k: 100.0 * k + 7 for k in range(40, 48)}
    data = b"".join(b"\xa5\x5a" + k.to_bytes(2, "big") + int(v).to_bytes(4, "big") for k, v in truth.items())
    interferometer = {"format": "syncfixed", "frame": frame}
    # One frame waits for the sync behind it.
    assert [r.macro_counts for r in framer_for(interferometer).feed(data)] == list(truth.values())[:-1]
    for i in range(len(data)):
        for bad in (data[:i] + data[i + 1 :], data[:i] + b"\x33" + data[i:]):
            readings = framer_for(interferometer).feed(bad)
            assert len(readings) >= 4
            assert all(r.macro_counts == truth[r.sequence] for r in readings), i


def test_counts_that_a_float_cannot_hold_are_invalid():
    framer = framer_for({**OLED, "incremental": False})
    readings = framer.feed(oled_frame(1, 2**53, 3) + oled_frame(2, 2**53 + 2, 3))
    assert [r.flags for r in readings] == [BOTH, END_VALID]


LINE = {
    "format": "line",
    "incremental": False,
    "frame": {
        "separator": ",",
        "delimiter": "\r",
        "columns_count": 4,
        "ignore_prefix": "#",
        "fields": [
            {"name": "length", "index": 0, "type": "float", "role": "macro"},
            {"name": "number", "index": 2, "role": "sequence", "modulus": 1000},
            {"name": "status", "index": 3, "role": "status", "valid_mask": 1, "valid_value": 1},
        ],
    },
}


def test_lines():
    framer = framer_for(LINE)
    readings = framer.feed(b"+12.5,x,998,1\r-3,y,999,1\r#hello\r0.25,,0,0\r")
    assert as_values(readings) == [
        (998, "12.5", "nan", MACRO_VALID),
        (999, "-3.0", "nan", MACRO_VALID),
        (1000, "nan", "nan", 0),
    ]


@pytest.mark.parametrize(
    "line",
    [b"1.5,x,7\r", b"1.5,x,7,1,2\r", b"nan,x,7,1\r", b"1e5,x,7,1\r", b"1_0,x,7,1\r", b"1.5,x,07,1\r", b"1.5,x,1000,1\r",
     b" 1.5,x,7,1\r", b"1.5,x,7,\xb2\r", b"1" * 60 + b",x,7,1\r"],
)  # fmt: skip
def test_lines_of_another_shape_are_refused_and_counted(line):
    framer = framer_for(LINE)
    readings = framer.feed(b"1,x,6,1\r" + line + b"2,x,7,1\r3,x,8,1\r")
    assert [r.macro_counts for r in readings] == [1.0, 2.0, 3.0]
    assert framer.counters.field_count_bad == 1
    assert framer.counters.bytes_discarded == len(line)


def test_flagbits_most_significant_first():
    # Two bytes a value, 7 bits each, tags 1 then 0; 300 = 2 * 128 + 44.
    frame = {"tag_bits": 2, "tags": [2, 0], "more_tag": 1, "order": "msb_first", "fields": [{"role": "macro"}]}
    (reading,) = framer_for({"format": "flagbits", "frame": frame}).feed(bytes([0x80 | 4, 44]))  # 4 * 64 + 44
    assert reading.macro_counts == 300.0


@pytest.mark.parametrize("interferometer", [OLED, TB, LINE], ids=["oled", "tb", "line"])
def test_a_megabyte_of_noise(interferometer):
    noise = random.Random(1)
    framer = framer_for(interferometer)
    good, tried = 0, 0
    for k in range(2000):
        part = noise.randbytes(400) + (b"\xff" * 9 if k % 3 else b"\xa5\x5a\xa5") + b"1,2,3,1\r" * (k % 2)
        tried += len(part)
        good += len(framer.feed(part))
    assert tried > 800_000
    assert framer.counters.bytes_discarded > 0
    assert len(framer.snapshot()) < 10_000
    assert good < 1200  # lines are planted in every second part; sum8 lets one in 256 through


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"format": "synced"}, "format"),
        ({"incremental": "yes"}, "incremental"),
        ({"frame": {**OLED["frame"], "sync": "a5z"}}, "sync"),
        ({"frame": {**OLED["frame"], "length": 2}}, "length"),
        ({"frame": {**OLED["frame"], "length": 24}}, "status"),
        ({"frame": {**OLED["frame"], "checksum": "crc32"}}, "checksum"),
        ({"frame": {**OLED["frame"], "endianness": "big"}}, "endianness"),
        ({"frame": {**OLED["frame"], "fields": []}}, "fields"),
        ({"frame": {**OLED["frame"], "fields": [{"role": "macro", "type": "i65"}]}}, "type"),
        ({"frame": {**OLED["frame"], "fields": [{"role": "macro", "offset": 2}] * 2}}, "twice"),
        ({"frame": {**OLED["frame"], "fields": [{"role": "status", "offset": 2}]}}, "macro or end"),
    ],
)
def test_bad_profile_is_named(change, key):
    with pytest.raises(ProfileError, match=key):
        framer_for({**OLED, **change})


def test_scale():
    # 2048 counts a wavelength of displacement in vacuum: 632.991 nm / 2048 = 0.30907763671875 nm.
    step_m = metres_per_count(632.991e-9, 1.0, 2048.0)
    assert step_m == pytest.approx(0.30907763671875e-9, rel=1e-15)
    assert position_m(1000.0 + 2048.0, 1000.0, step_m) == pytest.approx(632.991e-9, rel=1e-15)
    # uMD2, retroreflector, 4 counts a cycle: lambda / 8 = 79.10 nm a count (firmware's own figure).
    assert counts_per_wavelength(4.0, 1.0) == 8.0
    assert metres_per_count(632.8e-9, 1.0, 8.0) == pytest.approx(79.10e-9, rel=1e-3)
    assert counts_per_wavelength_of(OLED) == (2048.0, 2048.0)
    assert counts_per_wavelength_of({"frame": {"counts_per_wavelength": 8}}) == (8.0, 8.0)
    with pytest.raises(ProfileError, match="counts_per_wavelength"):
        counts_per_wavelength_of({"frame": {"counts_per_wavelength": math.nan}})
