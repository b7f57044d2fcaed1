"""What in the rows begins a recording: an error that rises, a contact, a reversal. Pure; knows no clock and no file."""

from dataclasses import dataclass

import numpy as np

from stagectl.requests import TICKING

_ERROR, _CONTACT, _REVERSAL = "error", "contact", "reversal"


@dataclass(frozen=True, slots=True)
class Trigger:
    """One condition: an error above `error_m`, a contact above `contact_force_n`; neither means a reversal."""

    error_m: float | None = None
    contact_force_n: float | None = None

    @property
    def text(self) -> str:
        """Say what is waited for."""
        if self.error_m is not None:
            return f"error above {self.error_m:g} m"
        if self.contact_force_n is not None:
            return f"contact above {self.contact_force_n:g} N"
        return "reversal"


class TriggerWatch:
    """Finds where a condition begins to hold, over rows that come in pieces."""

    def __init__(self, trigger: Trigger):
        """Nothing was seen yet: what holds from the start does not trigger."""
        self.trigger = trigger
        self._held = True
        self._direction = 0.0

    def first(self, rows: np.ndarray) -> int | None:
        """Return the index in rows, shape (n,) of ROW, at which it began; None where it didn't."""
        if rows.size == 0:
            return None
        working = np.isin(rows["run_phase"], TICKING)
        if self.trigger.error_m is None and self.trigger.contact_force_n is None:
            return self._reversal(rows["setpoint_velocity_m_per_s"] * working)
        known = np.ones(rows.size, bool)
        if self.trigger.error_m is not None:
            beyond = np.abs(rows["end_position_m"] - rows["setpoint_position_m"]) > self.trigger.error_m
            # Behind a late line position and set-point are of different instants: such a row begins and ends nothing.
            known = ~working | (rows["sequence"] == rows["cycle"]) & (rows["samples_new"] > 0)
        else:
            beyond = np.abs(rows["contact_force_estimate_n"]) > self.trigger.contact_force_n
        places = np.flatnonzero(known)
        if places.size == 0:
            return None
        holds = (beyond & working)[places]
        before = np.concatenate([[self._held], holds[:-1]])
        self._held = bool(holds[-1])
        begins = np.flatnonzero(holds & ~before)
        return int(places[begins[0]]) if begins.size else None

    def _reversal(self, velocity: np.ndarray) -> int | None:
        moving = np.flatnonzero(velocity)
        if moving.size == 0:
            return None
        directions = np.sign(velocity[moving])
        before = np.concatenate([[self._direction or directions[0]], directions[:-1]])
        self._direction = float(directions[-1])
        turns = np.flatnonzero(directions != before)
        return int(moving[turns[0]]) if turns.size else None
