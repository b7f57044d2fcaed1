"""uMD2 (Micro Measurement Display): ASCII lines of 8 or 16 integers, one a millisecond.

Source: repairfaq.org/sam/uMD2/uMD2.htm and the firmware v1.26 and v264.07. Fields: REF, then MEAS DISP VEL PHASE of
axis 1, SEQ, low-speed code and data, then MEAS DISP VEL PHASE of axes 2 and 3. Position in counts is DISP minus
PHASE / 2^b: the phase is *subtracted*. No checksum; homodyne firmware repeats DISP[n] - DISP[n-1] as VEL, which checks
the displacement. Homodyne firmware has no sign of a lost beam at all. Pure.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from drivers import snapshot as snapshots
from drivers.frame_spec import flag, integer, only, wrong
from drivers.line_buffer import LineBuffer
from drivers.reading import END_VALID, MACRO_VALID, FramerCounters, Reading
from drivers.sequence import Frame, SequenceTracker

_INTEGER = rb"(?:-?[1-9][0-9]{0,18}|0)"
_LINES = {count: re.compile(_INTEGER + rb"(?: " + _INTEGER + rb"){%d}" % (count - 1)) for count in (8, 16)}
_FIRST_COLUMN = {1: 1, 2: 8, 3: 12}
_SEQUENCE, _CODE, _DATA = 5, 6, 7
_I32 = 1 << 31
_PHASE_ERRORS = 0x7E00
"""Bits that stand for errors in an 8-bit phase (ordinary values in a 16-bit one)."""


_KEYS = {
    "macro_axis",
    "end_axis",
    "columns_count",
    "phase_bits",
    "homodyne",
    "velocity_check",
    "counts_per_wavelength",
}


@dataclass(slots=True)
class Environment:
    """What the low-speed codes told so far; nan = not sent yet."""

    laser_power_count: float = math.nan
    signal_count: float = math.nan
    temperature_degc: float = math.nan
    temperature_2_degc: float = math.nan
    pressure_pa: float = math.nan
    relative_humidity_percent: float = math.nan
    sample_rate_hz: float = math.nan
    firmware: float = math.nan  # version x 1, e.g. 1.26
    firmware_sub: float = math.nan
    homodyne_axes_count: float = math.nan
    counts_per_cycle_count: float = math.nan
    phase_bits: float = math.nan


# code -> name, factor, lowest, highest plausible value
_LOW_SPEED = {
    1: ("laser_power_count", 1.0, -math.inf, math.inf),
    2: ("signal_count", 1.0, -math.inf, math.inf),
    3: ("temperature_degc", 0.01, -40.0, 100.0),
    4: ("temperature_2_degc", 0.01, -40.0, 100.0),
    5: ("pressure_pa", 1.0, 50_000.0, 200_000.0),  # sent in 0.01 mbar
    6: ("relative_humidity_percent", 0.1, 0.0, 100.0),
    8: ("sample_rate_hz", 0.01, 1.0, 1e6),
}

_AIR_STEPS = {3: 0.5, 5: 100.0, 6: 5.0}
"""Code -> the most by which air changes between two tellings; more is a wrong digit until it is said again."""


class Umd2Framer:
    """Framer of a uMD2 line with one or more axes."""

    def __init__(self, table: Mapping[str, Any], *, incremental: bool) -> None:
        """`table` is the profile's [interferometer.frame]: macro_axis, end_axis (0 = there is none), columns_count,
        phase_bits (until the device says otherwise), homodyne, velocity_check."""
        only(table, _KEYS, "frame")
        columns = integer(table, "columns_count", 16, 8, 16)
        if columns not in _LINES:
            raise wrong("frame.columns_count", columns, "must be 8 or 16", "16 where more than one axis is compiled in")
        most = 1 if columns == 8 else 3
        macro_axis = integer(table, "macro_axis", 1, 0, most)
        end_axis = integer(table, "end_axis", 0 if columns == 8 else 2, 0, most)
        if macro_axis == end_axis:
            raise wrong("frame.end_axis", end_axis, "must differ from macro_axis", "one axis per position")
        phase_bits = integer(table, "phase_bits", 16, 8, 16)
        if phase_bits not in (8, 16):
            raise wrong("frame.phase_bits", phase_bits, "must be 8 or 16", "16 from firmware 2.61.24 on, else 8")
        self._homodyne = flag(table, "homodyne", False)
        check = flag(table, "velocity_check", self._homodyne)
        self._pattern = _LINES[columns]
        self._macro = _FIRST_COLUMN.get(macro_axis, -1)
        self._end = _FIRST_COLUMN.get(end_axis, -1)
        self._axes = (MACRO_VALID if macro_axis else 0) | (END_VALID if end_axis else 0)
        self._checked = tuple(column for column in (self._macro, self._end) if column >= 0) if check else ()
        self._phase_bits = phase_bits
        self._phase_bits_said: int = phase_bits
        self.environment = Environment()
        self.air = {_LOW_SPEED[code][0]: math.nan for code in _AIR_STEPS}  # said alike twice in a row; nan = not yet
        self.air_number = 0  # counts changes of `air`
        self._air_said = dict.fromkeys(_AIR_STEPS, math.nan)
        self.counters = FramerCounters()
        self._lines = LineBuffer(b"\r\n", self.counters)
        self._tracker = SequenceTracker(
            self.counters,
            modulus=0,
            confirm=True,
            incremental=incremental,
            axes=self._axes,
            linked=_displacement_follows if check else None,
        )
        self._junk = False

    def feed(self, data: bytes) -> list[Reading]:
        """Give the readings that `data` completes."""
        readings: list[Reading] = []
        for line in self._lines.feed(data):
            if line.startswith(b"!"):  # debug text of the firmware
                continue
            numbers = list(map(int, line.split(b" "))) if self._pattern.fullmatch(line) else []
            frame = self._frame(numbers) if numbers else None
            if frame is None:
                self.counters.field_count_bad += 1
                self.counters.bytes_discarded += len(line) + 2
                self._junk = True
                continue
            if self._junk:
                self._junk = False
                self.counters.resyncs += 1
            accepted = self._tracker.admit(frame)
            if accepted:
                readings += accepted
                if numbers[_CODE]:
                    self._low_speed(numbers[_CODE], numbers[_DATA])
        return readings

    def _frame(self, numbers: list[int]) -> Frame | None:
        """The frame of a line, None where a number can't be what its column says."""
        if not 0 <= numbers[_SEQUENCE] < 1 << 63:
            return None
        macro = end = math.nan
        flags = 0
        if self._macro >= 0:
            value = self._counts(numbers, self._macro)
            if value is None:
                return None
            macro = value
            if macro == macro:
                flags = MACRO_VALID
        if self._end >= 0:
            value = self._counts(numbers, self._end)
            if value is None:
                return None
            end = value
            if end == end:
                flags |= END_VALID
        check: tuple[int, ...] = ()
        for column in self._checked:
            check += (numbers[column + 1], numbers[column + 2])
        return Frame(numbers[_SEQUENCE], macro, end, flags, check)

    def _counts(self, numbers: list[int], column: int) -> float | None:
        """Counts of an axis, nan where its beam is lost, None where the line is corrupt."""
        displacement = numbers[column + 1]
        phase = numbers[column + 3]
        if not -_I32 <= displacement < _I32:
            return None
        if self._phase_bits == 16:
            if not -65536 < phase < 65536:
                return None
            counts = displacement - phase / 65536.0
        else:
            if not -256 < phase < 256:
                return math.nan if 0 <= phase <= 0x7FFF and phase & _PHASE_ERRORS else None
            counts = displacement - phase / 256.0
        if not self._homodyne and (numbers[column] == 0 or numbers[0] == 0):
            return math.nan
        return counts

    def _low_speed(self, code: int, data: int) -> None:
        environment = self.environment
        if code in _LOW_SPEED:
            name, factor, low, high = _LOW_SPEED[code]
            value = data * factor
            if low <= value <= high:
                setattr(environment, name, value)
                if code in _AIR_STEPS:
                    # A line has no checksum, and one wrong digit in 20.00 degC would move a stage by micrometres.
                    agrees = abs(value - self._air_said[code]) <= _AIR_STEPS[code]
                    self._air_said[code] = value
                    if agrees and value != self.air[name]:
                        self.air[name] = value
                        self.air_number += 1
        elif code == 10:
            environment.firmware = (data & 0xFFFF) / 100.0
            environment.firmware_sub = float(data >> 16)
        elif code == 20:
            environment.homodyne_axes_count = float(data & 0xFF)
            environment.counts_per_cycle_count = float(data >> 8 & 0xFF)
        elif code == 112:
            said = 8 if data & 2 else 16
            # Twice in a row, because one wrong digit here would rescale every phase that follows.
            if said == self._phase_bits_said:
                self._phase_bits = said
                environment.phase_bits = float(said)
            self._phase_bits_said = said

    def snapshot(self) -> bytes:
        """State as JSON bytes."""
        environment = {name: None if math.isnan(value) else value for name, value in asdict(self.environment).items()}
        said = [(code, None if math.isnan(value) else value) for code, value in self._air_said.items()]
        air = {name: None if math.isnan(value) else value for name, value in self.air.items()}
        return snapshots.pack(
            "umd2",
            lines=self._lines.snapshot(),
            junk=self._junk,
            phase_bits=[self._phase_bits, self._phase_bits_said],
            environment=environment,
            air=air,
            air_number=self.air_number,
            air_said=said,
            tracker=self._tracker.snapshot(),
            counters=self.counters.as_dict(),
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from where `snapshot` was taken; the framer must be made of the same profile."""
        parts = snapshots.unpack("umd2", snapshot)
        self._lines.restore(parts["lines"])
        self._junk = bool(parts["junk"])
        self._phase_bits, self._phase_bits_said = (int(bits) for bits in parts["phase_bits"])
        for field in fields(self.environment):
            value = parts["environment"][field.name]
            setattr(self.environment, field.name, math.nan if value is None else float(value))
        self.air = {name: math.nan if value is None else float(value) for name, value in parts["air"].items()}
        self.air_number = int(parts["air_number"])
        self._air_said = {int(code): math.nan if value is None else float(value) for code, value in parts["air_said"]}
        self._tracker.restore(parts["tracker"])
        self.counters.restore(parts["counters"])


def _displacement_follows(earlier: tuple[int, ...], later: tuple[int, ...]) -> bool:
    """Whether DISP[n] - DISP[n-1] == VEL[n] on every axis; the tuples hold DISP, VEL per axis."""
    return all(later[i] - earlier[i] == later[i + 1] for i in range(0, len(later), 2))
