"""The controllers of a stage, one a law, and every change that reaches them from outside.

The servo calls it live and `stagectl.replay` calls it on recorded rows: whatever changes a controller does so
here, from values that rows and events hold. Pure; knows no bus and no clock.
"""

from typing import TYPE_CHECKING

import numpy as np

from stagectl import backlash, estimator, fed_forward
from stagectl.laws.reference import gap_centre
from stagectl.plant import PLANT_PARAMETERS
from stagectl.signals import SETPOINT, new
from stagectl.tick import LAWS, Controller, controller

if TYPE_CHECKING:
    from stagectl.profile import Profile

LAW_NAMES = tuple(LAWS)


class Tracker:
    """Shares measurement, estimator, guard and belief between the laws; only `law` differs."""

    def __init__(self, profile: "Profile", *, has_drives: bool):
        """Compile or load the tick of every law, nothing seen yet."""
        self._profile = profile
        self._has_drives = has_drives
        first = controller(profile, LAW_NAMES[0], has_drives=has_drives)
        self.measurement = first.measurement
        self.setpoint = first.setpoint
        self.hold = new(SETPOINT)
        self._controllers: list[Controller] = [first]
        for name in LAW_NAMES[1:]:
            other = controller(profile, name, has_drives=has_drives)
            for shared in ("measurement", "setpoint", "later", "command", "estimator", "model", "ahead", "after"):
                setattr(other, shared, getattr(first, shared))
            for shared in ("guard", "backlash", "belief", "effects"):
                setattr(other, shared, getattr(first, shared))
            self._controllers.append(other)
        self._fresh = [one.snapshot() for one in self._controllers]
        self.law_number = 0
        self.active = first

    def warm(self) -> None:
        """Run every tick once on copies, so that nothing compiles later."""
        for number, one in enumerate(self._controllers):
            kept = one.snapshot()
            measurement = self.measurement.copy()
            self.measurement["samples_new"] = 1
            for cycle in (1, 2, 3):
                self.measurement["cycle"] = self.measurement["sequence"] = cycle
                one.step()
            self.measurement[...] = measurement
            one.restore(kept)
            one.restore(self._fresh[number])

    def begin(self, law_number: int) -> None:
        """Start from nothing at the present measurement: observer, law, guard; hold where the stage is."""
        belief = self.active.belief.copy()
        for one, fresh in zip(self._controllers, self._fresh, strict=True):
            one.restore(fresh)
        self.active.belief[...] = belief
        self.switch(law_number)
        centre_m = gap_centre(belief[0])
        self.hold[...] = np.zeros(1, SETPOINT)
        self.hold["position_m"] = self.measurement["end_position_m"]
        relative_m = self.measurement["end_position_m"] - self.measurement["macro_position_m"]
        self.hold["relative_position_m"] = relative_m + centre_m if belief["has_micro"][0] else 0.0

    def guide(self) -> None:
        """From here the macro's drive brakes by itself: what it reports is the force that the macro feels.

        A law that can park does: the micro has to stay off its hard stops, not on a reference. One that goes on at full
        speed shakes the macro that it follows, and swung by 0.5 mm.
        """
        self.active.estimator["position_mode"] = 1.0
        if "park_error_m" in (self.active.law.dtype.names or ()):
            self.active.law["park_error_m"] = -1.0  # below every error: it parks, and stays so
        self.active.guard["braking"] = 1.0

    def switch(self, law_number: int) -> None:
        """Change the law; the new one starts from rest."""
        self.law_number = law_number
        self.active = self._controllers[law_number]
        self.active.law[...] = self._fresh[law_number]["law"]

    def update(self, belief: np.ndarray, macro_shift_m: float, end_shift_m: float) -> None:
        """Take a new belief, and zeros that moved all measured positions by the shifts, without moving the stage."""
        one = self.active
        centre_before_m = gap_centre(one.belief[0])
        one.belief[...] = belief
        centre_shift_m = gap_centre(one.belief[0]) - centre_before_m
        for state in (one.model, one.ahead):
            state["macro_position_m"] += macro_shift_m
            state["end_position_m"] += end_shift_m
        for setpoint in (self.hold, self.setpoint):
            setpoint["position_m"] += end_shift_m
            if belief["has_micro"][0]:
                setpoint["relative_position_m"] += end_shift_m - macro_shift_m + centre_shift_m
        one.guard["macro_position_m"] += macro_shift_m
        one.backlash[...] = backlash.init(self._profile)
        one.estimator["identification_waits"] = 0.0
        fed_forward.forget(one.estimator[0])

    def new_belief(self) -> np.ndarray:
        """Return what the profile believes, for a request that changes nothing."""
        return estimator.belief(self._profile)


def belief_of(request: np.ndarray) -> np.ndarray:
    """Take PLANT_PARAMETERS out of a REQUEST."""
    belief = np.zeros(1, PLANT_PARAMETERS)
    for name in PLANT_PARAMETERS.names or ():
        belief[name] = request[f"belief_{name}"]
    return belief
