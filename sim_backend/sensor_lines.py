"""What the rig's interferometers put on the serial line: whole lines, both axes in one.

Each writer turns one sample (counts as floats, before quantisation) into bytes. Written from the protocols;
shares nothing with the framers. Pure.
"""

import binascii
import math
import struct
from dataclasses import dataclass
from typing import Protocol


@dataclass(slots=True)
class Sample:
    """One sample of both axes, before the device's own quantisation."""

    sequence: int
    macro_counts: float
    end_counts: float
    macro_lost: bool  # no beam
    end_lost: bool
    macro_interpolates: bool  # slow enough for a fraction of a count
    end_interpolates: bool


class LineWriter(Protocol):
    """Writes the line of a sample."""

    def line(self, sample: Sample) -> bytes:
        """Return the bytes of one sample."""
        ...


def _nearest(counts: float) -> int:
    return math.floor(counts + 0.5)


class SyncFixedWriter:
    """25 bytes: a5 5a, u32 sequence, i64 macro, i64 end, u8 status, u16 CRC-16/CCITT (init 0xFFFF), little endian.

    Status bit 0: macro beam lost, bit 1: end beam lost.
    """

    _BODY = struct.Struct("<2sIqqB")
    _CHECK = struct.Struct("<H")

    def line(self, sample: Sample) -> bytes:
        """See `LineWriter.line`."""
        body = self._BODY.pack(
            b"\xa5\x5a",
            sample.sequence & 0xFFFF_FFFF,
            _nearest(sample.macro_counts),
            _nearest(sample.end_counts),
            (1 if sample.macro_lost else 0) | (2 if sample.end_lost else 0),
        )
        return body + self._CHECK.pack(binascii.crc_hqx(body, 0xFFFF))


class Umd2Writer:
    """uMD2 heterodyne firmware (v264.07): 16 (one axis: 8) integer fields, CR LF; the phase is to be subtracted.

    REF MEAS1 DISP1 VEL1 PHASE1 SEQ LSC LSD MEAS2 DISP2 VEL2 PHASE2 MEAS3 DISP3 VEL3 PHASE3
    """

    _REFERENCE_COUNTS = 2000  # a 2 MHz reference, sampled at 1 kHz
    _PHASE_STEPS = 65536

    def __init__(self, axes_count: int, rate_hz: float, air) -> None:
        self._axes_count = axes_count
        self._old = [0, 0]
        self._low_speed = {
            1: (10, 7 << 16 | 264),  # firmware 2.64, sub-version 7
            2: (8, round(100.0 * rate_hz)),
            3: (112, 4),  # new version format, 16-bit phase
            4: (3, round(100.0 * air.temperature_degc)),
            5: (5, round(air.pressure_pa)),  # 0.01 mbar
            6: (6, round(10.0 * air.relative_humidity_percent)),
        }

    def line(self, sample: Sample) -> bytes:
        """See `LineWriter.line`."""
        first = self._axis(0, sample.macro_counts, sample.macro_lost, sample.macro_interpolates)
        code, data = self._low_speed.get(sample.sequence & 0x1F, (0, 0))
        fields = [self._REFERENCE_COUNTS, *first, sample.sequence, code, data]
        if self._axes_count > 1:
            fields += self._axis(1, sample.end_counts, sample.end_lost, sample.end_interpolates)
            fields += (0, 0, 0, 0)
        return " ".join(map(str, fields)).encode("ascii") + b"\r\n"

    def _axis(self, axis: int, counts: float, lost: bool, interpolates: bool) -> tuple[int, int, int, int]:
        """Return MEAS, DISP, VEL, PHASE; position = DISP - PHASE / 65536."""
        phase = 0
        if interpolates:
            steps = math.floor(counts * self._PHASE_STEPS + 0.5)
            displacement = -(-steps // self._PHASE_STEPS)
            phase = displacement * self._PHASE_STEPS - steps
        else:
            displacement = _nearest(counts)
        velocity = displacement - self._old[axis]
        self._old[axis] = displacement
        return 0 if lost else max(1, self._REFERENCE_COUNTS + velocity), displacement, velocity, phase


class MicroEpsilonWriter:
    """Micro-Epsilon RS422 blocks: macro, end, COUNTER as 18-bit values of three bytes L, M, H with two tag bits.

    Mid-range (131000) is where the stage stood at the start; above 262072 stand error codes.
    """

    _MIDDLE = 131_000
    _LARGEST = 262_072
    _BELOW = 262_073
    _ABOVE = 262_074
    _NO_PEAK = 262_076

    def __init__(self, axes_count: int) -> None:
        self._axes_count = axes_count

    def line(self, sample: Sample) -> bytes:
        """See `LineWriter.line`."""
        values = [self._value(sample.macro_counts, sample.macro_lost)]
        if self._axes_count > 1:
            values.append(self._value(sample.end_counts, sample.end_lost))
        values.append(sample.sequence & 0x3FFFF)
        block = bytearray()
        for number, value in enumerate(values):
            high_tag = 0x80 if number == 0 else 0xC0
            block += bytes((value & 0x3F, 0x40 | value >> 6 & 0x3F, high_tag | value >> 12 & 0x3F))
        return bytes(block)

    def _value(self, counts: float, lost: bool) -> int:
        if lost:
            return self._NO_PEAK
        value = self._MIDDLE + _nearest(counts)
        if value < 0:
            return self._BELOW
        return value if value <= self._LARGEST else self._ABOVE


def writer_for(sensor, air, axes_count: int) -> LineWriter:
    """Return the writer of a machine's [interferometer] table."""
    if sensor.format == "umd2":
        return Umd2Writer(axes_count, sensor.rate_hz, air)
    if sensor.format == "micro-epsilon":
        return MicroEpsilonWriter(axes_count)
    return SyncFixedWriter()
