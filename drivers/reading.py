"""One reading of an interferometer, and what was lost on the way to it.

Pure; knows no protocol, no port and no clock.
"""

import math
from dataclasses import asdict, dataclass, fields
from typing import NamedTuple

MACRO_VALID = 1
"""Flag: `macro_counts` may be used."""
END_VALID = 2
"""Flag: `end_counts` may be used."""
REFERENCE_LOST = 4
"""Flag: an incremental sensor lost its zero here (beam lost, restart, counter jumped); the reader latches it."""
RESTARTED = 8
"""Flag: the device counts its samples anew from here; the sample clock has to start anew too."""


class Reading(NamedTuple):
    """One sample of both axes, in counts of the device (whole and fraction); an invalid count is nan."""

    sequence: int  # unwrapped sample number; goes back only where RESTARTED is set
    macro_counts: float
    end_counts: float
    flags: int

    def as_list(self) -> list[int | float | None]:
        """Plain values for a snapshot; nan becomes None, which JSON has."""
        macro = None if math.isnan(self.macro_counts) else self.macro_counts
        end = None if math.isnan(self.end_counts) else self.end_counts
        return [self.sequence, macro, end, self.flags]


@dataclass(slots=True)
class FramerCounters:
    """What a framer received and what it threw away; nothing is dropped without a count here."""

    frames_ok: int = 0  # readings handed on
    bytes_discarded: int = 0  # bytes that belong to no accepted frame
    checksum_bad: int = 0  # frames, or things that looked like one, with a wrong checksum
    field_count_bad: int = 0  # lines of another shape, or with a number out of its range
    line_check_bad: int = 0  # frames that contradict the one before (uMD2: displacement against velocity)
    unconfirmed: int = 0  # frames with a surprising sequence number that the next frame did not bear out
    sequence_gaps: int = 0  # times that sequence numbers were skipped
    samples_lost: int = 0  # sequence numbers skipped
    duplicates: int = 0
    restarts: int = 0  # sequence went back: the device began anew
    resyncs: int = 0  # times that a good frame followed discarded bytes
    longest_gap: int = 0  # most sequence numbers skipped at once

    def as_dict(self) -> dict[str, int]:
        """All counters by name."""
        return asdict(self)

    def restore(self, values: dict[str, int]) -> None:
        """Take over counters that `as_dict` gave."""
        for field in fields(self):
            setattr(self, field.name, int(values[field.name]))
