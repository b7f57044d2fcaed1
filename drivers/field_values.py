"""From the numbers of a decoded frame to counts and validity, by the roles of the profile.

Pure; shared by the three kinds of generic frame.
"""

import math
from collections.abc import Sequence
from typing import Any

from drivers.frame_spec import FieldSpec
from drivers.reading import END_VALID, MACRO_VALID
from drivers.sequence import Frame

_EXACT = float(1 << 53)
"""Counts beyond this are not whole numbers in a float64 any more."""


class FieldValues:
    """Picks sequence, counts and validity out of the numbers of one frame (in the order of the fields)."""

    def __init__(self, specs: tuple[FieldSpec, ...]) -> None:
        place = {spec.role: number for number, spec in enumerate(specs)}
        self._sequence = place.get("sequence", -1)
        self._macro = place.get("macro", -1)
        self._end = place.get("end", -1)
        self._status = place.get("status", -1)
        self._checks = [(number, spec) for number, spec in enumerate(specs) if spec.role == "check"]
        self.axes = (MACRO_VALID if self._macro >= 0 else 0) | (END_VALID if self._end >= 0 else 0)
        self.modulus = specs[self._sequence].modulus if self._sequence >= 0 else 0
        self._sequence_end = min(self.modulus or 1 << 63, 1 << 63)  # readings carry it as int64
        self.has_sequence = self._sequence >= 0
        self._macro_invalid_from = _invalid_from(specs, self._macro)
        self._end_invalid_from = _invalid_from(specs, self._end)
        if self._status >= 0:
            status = specs[self._status]
            shared = status.valid_mask & ~(status.macro_mask | status.end_mask)
            self._valid_value = status.valid_value
            self._macro_mask = shared | status.macro_mask
            self._end_mask = shared | status.end_mask

    def is_frame(self, values: Sequence[float]) -> bool:
        """Whether the sequence number and all check fields are within their limits."""
        if self._sequence >= 0 and not 0 <= values[self._sequence] < self._sequence_end:
            return False
        for number, spec in self._checks:
            value = values[number]
            if spec.minimum is not None and value < spec.minimum:
                return False
            if spec.maximum is not None and value > spec.maximum:
                return False
        return True

    def frame(self, values: Sequence[Any], next_raw: int) -> Frame:
        """The frame; `next_raw` numbers it where the device sends no sequence."""
        flags = self.axes
        if self._status >= 0:
            differs = values[self._status] ^ self._valid_value
            if differs & self._macro_mask:
                flags &= ~MACRO_VALID
            if differs & self._end_mask:
                flags &= ~END_VALID
        macro = end = math.nan
        if flags & MACRO_VALID:
            macro = float(values[self._macro])
            if not -_EXACT <= macro <= _EXACT or not macro < self._macro_invalid_from:
                macro = math.nan
                flags &= ~MACRO_VALID
        if flags & END_VALID:
            end = float(values[self._end])
            if not -_EXACT <= end <= _EXACT or not end < self._end_invalid_from:
                end = math.nan
                flags &= ~END_VALID
        return Frame(values[self._sequence] if self._sequence >= 0 else next_raw, macro, end, flags)


def _invalid_from(specs: tuple[FieldSpec, ...], place: int) -> float:
    limit = specs[place].invalid_from if place >= 0 else None
    return math.inf if limit is None else float(limit)
