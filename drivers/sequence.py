"""Sample numbers of a device: unwrapped, gaps counted, restarts told from gaps, odd ones held until confirmed.

Pure; knows no bytes and no clock.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from drivers.reading import END_VALID, MACRO_VALID, REFERENCE_LOST, RESTARTED, FramerCounters, Reading

_CONFIRM_WITHIN = 3
"""A held frame is borne out by a frame at most this many samples later."""


class Frame(NamedTuple):
    """A decoded frame before its sequence number is believed; `check` holds what ties it to its neighbours."""

    raw: int
    macro_counts: float
    end_counts: float
    flags: int
    check: tuple[int, ...] = ()


class SequenceTracker:
    """Turns frames into readings.

    Where the protocol has no checksum (`confirm`), a frame whose number does not follow the last one is held until the
    next frame follows *it*: one wrong digit in a number is then neither a gap nor a restart.
    """

    def __init__(
        self,
        counters: FramerCounters,
        *,
        modulus: int,
        confirm: bool,
        incremental: bool,
        axes: int = MACRO_VALID | END_VALID,
        linked: Callable[[tuple[int, ...], tuple[int, ...]], bool] | None = None,
    ) -> None:
        """`modulus` 0 = never wraps; `axes` = validity flags of the axes that exist; `linked(earlier, later)` tells
        whether neighbours agree by their content."""
        self._counters = counters
        self._modulus = modulus
        self._confirm = confirm
        self._incremental = incremental
        self._axes = axes
        self._linked = linked
        self._last_raw = 0
        self._last_sequence = -1  # -1 before the first
        self._last_check: tuple[int, ...] = ()
        self._held: Frame | None = None

    @property
    def next_raw(self) -> int:
        """The number that would follow; for devices that send none."""
        return self._last_raw + 1 if self._last_sequence >= 0 else 0

    def admit(self, frame: Frame) -> list[Reading]:
        """Give the readings that this frame completes: none while it is held, two where it confirms a held one."""
        difference = self._difference(self._last_raw, frame.raw)
        if self._last_sequence >= 0:
            if difference == 0:
                self._counters.duplicates += 1
                return []
            if difference == 1 and (self._linked is None or self._linked(self._last_check, frame.check)):
                if self._held is not None:
                    self._held = None
                    self._counters.unconfirmed += 1
                return [self._follow(frame)]
        if not self._confirm:
            return [self._take(frame)]
        if self._last_sequence >= 0 and difference == 1:
            self._counters.line_check_bad += 1
        held = self._held
        if held is None:
            self._held = frame
            return []
        if self._bears_out(held, frame):
            self._held = None
            return [self._take(held), self._take(frame)]
        self._counters.unconfirmed += 1
        self._held = frame
        return []

    def _difference(self, earlier: int, later: int) -> int:
        return (later - earlier) % self._modulus if self._modulus else later - earlier

    def _bears_out(self, held: Frame, frame: Frame) -> bool:
        difference = self._difference(held.raw, frame.raw)
        if self._linked is not None:
            return difference == 1 and self._linked(held.check, frame.check)
        return 1 <= difference <= _CONFIRM_WITHIN

    def _take(self, frame: Frame) -> Reading:
        counters = self._counters
        flags = frame.flags
        sequence = frame.raw
        if self._last_sequence >= 0:
            difference = self._difference(self._last_raw, frame.raw)
            if difference == 1:
                sequence = self._last_sequence + 1
                if self._linked is not None and not self._linked(self._last_check, frame.check) and self._incremental:
                    # The device itself says that its counter did not move here, yet it did: someone zeroed it.
                    flags |= REFERENCE_LOST
            elif difference > 1 and (self._modulus == 0 or difference <= self._modulus // 2):
                sequence = self._last_sequence + difference
                counters.sequence_gaps += 1
                counters.samples_lost += difference - 1
                counters.longest_gap = max(counters.longest_gap, difference - 1)
            else:
                counters.restarts += 1
                flags |= RESTARTED
                if self._incremental:
                    flags |= REFERENCE_LOST
        return self._keep(frame, sequence, flags)

    def _follow(self, frame: Frame) -> Reading:
        return self._keep(frame, self._last_sequence + 1, frame.flags)

    def _keep(self, frame: Frame, sequence: int, flags: int) -> Reading:
        if self._incremental and flags & self._axes != self._axes:
            flags |= REFERENCE_LOST
        self._last_raw = frame.raw
        self._last_sequence = sequence
        self._last_check = frame.check
        self._counters.frames_ok += 1
        return Reading(sequence, frame.macro_counts, frame.end_counts, flags)

    def snapshot(self) -> dict[str, Any]:
        """Plain values that `restore` takes."""
        held = self._held
        return {
            "last_raw": self._last_raw,
            "last_sequence": self._last_sequence,
            "last_check": list(self._last_check),
            "held": None
            if held is None
            else [held.raw, *Reading(0, held.macro_counts, held.end_counts, held.flags).as_list()[1:], held.check],
        }

    def restore(self, values: dict[str, Any]) -> None:
        """Go on from where `snapshot` was taken."""
        self._last_raw = int(values["last_raw"])
        self._last_sequence = int(values["last_sequence"])
        self._last_check = tuple(int(value) for value in values["last_check"])
        held = values["held"]
        if held is None:
            self._held = None
            return
        raw, macro, end, flags, check = held
        self._held = Frame(
            int(raw),
            math.nan if macro is None else float(macro),
            math.nan if end is None else float(end),
            int(flags),
            tuple(int(value) for value in check),
        )
