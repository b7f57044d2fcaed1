"""Whose heartbeat is missing: a host's hiccup misses one look, a drive that is gone misses the next one too.

Knows no bus and no clock: the ages are handed to it.
"""

from collections.abc import Mapping

_MISSED = 2  # looks in a row that find a heartbeat too old


class Heartbeats:
    """The drives' heartbeats, as the supervisor has seen them."""

    def __init__(self, limit_s: float):
        """None is missing."""
        self._limit_s = limit_s
        self._missed: dict[str, int] = {}
        self._ages_s: dict[str, float] = {}

    def look(self, ages_s: Mapping[str, float]) -> tuple[list[str], list[str]]:
        """Take the ages of all axes; returns whose heartbeat came back by this look, and whose was lost."""
        self._ages_s = dict(ages_s)
        back: list[str] = []
        lost: list[str] = []
        for axis, age_s in ages_s.items():
            missed = self._missed.get(axis, 0)
            self._missed[axis] = 0 if age_s <= self._limit_s else missed + 1
            if age_s <= self._limit_s and missed >= _MISSED:
                back.append(axis)
            elif missed + 1 == _MISSED and not age_s <= self._limit_s:
                lost.append(axis)
        return back, lost

    @property
    def missing(self) -> list[str]:
        """Name the axes whose drives send no heartbeat."""
        return [axis for axis, missed in self._missed.items() if missed >= _MISSED]

    def detail(self, node_ids: Mapping[str, int]) -> str:
        """Say whose heartbeat is missing and since when; empty where none is."""
        if not self.missing:
            return ""
        ages = [f"{axis} (node {node_ids[axis]}): {self._ages_s[axis] * 1e3:.0f} ms ago" for axis in self.missing]
        return f"the last of {', '.join(ages)}, limit {self._limit_s * 1e3:g} ms; check the drive's power and firmware"
