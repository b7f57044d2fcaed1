"""The three kinds of frame that a profile can describe without code: syncfixed, line, flagbits.

Pure; a chooser and nothing else.
"""

from collections.abc import Mapping
from typing import Any

from drivers.flagbits_frame import FlagBitsFramer
from drivers.frame_spec import wrong
from drivers.line_frame import LineFramer
from drivers.syncfixed_frame import SyncFixedFramer

KINDS = {"syncfixed": SyncFixedFramer, "line": LineFramer, "flagbits": FlagBitsFramer}


def generic_framer(
    kind: str, table: Mapping[str, Any], *, incremental: bool
) -> SyncFixedFramer | LineFramer | FlagBitsFramer:
    """Make the framer of `kind` from the profile's [interferometer.frame]."""
    if kind not in KINDS:
        raise wrong("format", kind, f"must be one of {', '.join(KINDS)}", "correct it")
    return KINDS[kind](table, incremental=incremental)
