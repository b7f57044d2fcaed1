"""The drives' temperatures: when each is read, what a reading is worth, whose is too high.

Knows no bus and no clock: the readings' way and the time are handed to it. A temperature that can't be read is said and
left alone; nothing here stops a stage.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from stagectl.errors import StagectlError
from stagectl.profile import Temperature, Trip

EVERY_S = 5.0  # of each axis
HYSTERESIS_K = 2.0  # that a temperature falls below its warning before that is taken back
FAILURES_LIMIT = 3  # in a row; then it is not asked for any more
_ANSWER_S = 0.05
_SILENCE_SHARE = 0.25  # of the time after which the servo takes this side for dead, or its lease for over

WARNING = "temperature_warning"
BACK = "temperature"
UNREAD = "temperature_unread"


def answer_s(trip: Trip) -> float:
    """Return how long an answer may be waited for: the servo stops the stage where this side is silent for long."""
    return min(_ANSWER_S, _SILENCE_SHARE * trip.supervisor_silence_s, _SILENCE_SHARE * trip.lease_s)


@dataclass(frozen=True, slots=True)
class DriveTemperature:
    """What a drive said last; `t_s` is the clock of who read it."""

    degc: float
    warning: bool
    t_s: float


@dataclass(frozen=True, slots=True)
class News:
    """What happened to a temperature: the event's name, a sentence, and the event's numbers."""

    event: str
    text: str
    fields: dict[str, str | int | float]


class Temperatures:
    """The temperatures of the axes whose profile says where their drive has one."""

    def __init__(self, tables: Mapping[str, Temperature], read_count: Callable[[str, Temperature], int]):
        """`read_count` gives the object's value. Errors of it: DriveError, LinkError, which count as no answer."""
        self._tables, self._read_count = tables, read_count
        self._due_s: dict[str, float] = dict.fromkeys(tables, float("-inf"))
        self._failures: dict[str, int] = dict.fromkeys(tables, 0)
        self.newest: dict[str, DriveTemperature] = {}
        """By axis; none before its first good answer, none after it was given up."""

    def look(self, now_s: float, absent: Iterable[str] = ()) -> list[News]:
        """Read the one that waits longest, where one is due; returns what is news. `absent` are not asked."""
        due = [axis for axis in self._due_s if now_s >= self._due_s[axis] and axis not in absent]
        if not due:
            return []
        axis = min(due, key=lambda one: self._due_s[one])
        self._due_s[axis] = now_s + EVERY_S
        table = self._tables[axis]
        try:
            degc = table.degc_per_count * self._read_count(axis, table)
        except StagectlError as error:
            return self._failed(axis, str(error))
        self._failures[axis] = 0
        return self._take(axis, degc, now_s)

    def _take(self, axis: str, degc: float, now_s: float) -> list[News]:
        before, limit_degc = self.newest.get(axis), self._tables[axis].warning_degc
        warned = before is not None and before.warning
        warning = limit_degc is not None and degc >= limit_degc - (HYSTERESIS_K if warned else 0.0)
        self.newest[axis] = DriveTemperature(degc, warning, now_s)
        if limit_degc is None or warning == warned:
            return []
        key = f"{axis}.temperature.warning_degc = {limit_degc:g} degC"
        if warning:
            text = f"{axis}: {degc:.1f} degC, limit {key}; have it move less, or cool the motor"
        else:
            text = f"{axis}: {degc:.1f} degC, more than {HYSTERESIS_K:g} K below {key} again"
        return [News(WARNING if warning else BACK, text, {"axis": axis, "degc": degc, "warning_degc": limit_degc})]

    def _failed(self, axis: str, reason: str) -> list[News]:
        self._failures[axis] += 1
        if self._failures[axis] < FAILURES_LIMIT:
            return []
        del self._due_s[axis]
        self.newest.pop(axis, None)
        text = (
            f"{axis}: the temperature can't be read, {FAILURES_LIMIT} times in a row, and is not asked for until the "
            f"stage is opened anew: {reason}"
        )
        return [News(UNREAD, text, {"axis": axis, "failures_count": FAILURES_LIMIT})]
