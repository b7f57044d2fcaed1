"""From the profile's [interferometer] table to the framer that reads its bytes.

Pure; a chooser and nothing else.
"""

from collections.abc import Mapping
from typing import Any, Protocol

from drivers.frame_spec import flag, wrong
from drivers.generic_frame import KINDS, generic_framer
from drivers.micro_epsilon import micro_epsilon_framer
from drivers.reading import FramerCounters, Reading
from drivers.umd2 import Umd2Framer

_OWN = {"umd2": Umd2Framer, "micro-epsilon": micro_epsilon_framer}


class Framer(Protocol):
    """Bytes to readings: no port, no clock; the same bytes give the same readings however they are cut."""

    counters: FramerCounters

    def feed(self, data: bytes) -> list[Reading]:
        """Give the readings that `data` completes."""
        ...

    def snapshot(self) -> bytes:
        """State as JSON bytes."""
        ...

    def restore(self, snapshot: bytes) -> None:
        """Go on from where `snapshot` was taken."""
        ...


def framer_for(interferometer: Mapping[str, Any]) -> Framer:
    """Make the framer that [interferometer] describes; ProfileError where it describes none."""
    name = interferometer.get("format")
    table: Mapping[str, Any] = interferometer.get("frame") or {}
    incremental = flag(interferometer, "incremental", True, "interferometer")
    if isinstance(name, str) and name in _OWN:
        return _OWN[name](table, incremental=incremental)
    if isinstance(name, str) and name in KINDS:
        return generic_framer(name, table, incremental=incremental)
    raise wrong("format", name, f"must be one of {', '.join((*_OWN, *KINDS))}", "choose the sensor's format")
