"""DSMC beside linear rivals on one machine: where each of them is better is said from what is measured, each time.

The true end position is judged, behind the value seam: at rest, after a force that comes at once, and along a trapezoid
with a macro that follows and with one so weak that the joint touches on both sides.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from stagectl import batch, trajectory
from stagectl.adaptive_filter import in_motion
from stagectl.errors import RequestError
from stagectl.followed import controller_of, rested, scan, true_error_m
from stagectl.report import Quantity
from stagectl.signals import SETPOINT
from stagectl.tick import Controller

if TYPE_CHECKING:
    from stagectl.profile import Profile

SEEDS = (1, 2, 3, 4, 5)
STEP_N = 0.1
HOLD, STEP, FREE, CONTACT = (
    "hold, rms",
    f"{STEP_N:g} N at once, peak of the mean",
    "trapezoid, peak",
    "the same in contact, peak",
)

BETTER, WORSE, NO_DIFFERENT = "better", "worse", "no different"

_EQUAL_RATIO = 0.03  # what other seeds change by
_HOLD_S, _STEP_S = 8.0, 0.3
_OFFSET = MappingProxyType({"name": "offset", "acts_on": "micro_force", "force_n": 0.0})


@dataclass(frozen=True, slots=True)
class Rival:
    """A linear controller of the same stage: its law, what is changed of it, and the macro that touches."""

    name: str
    law: str = "dsmc"
    change: Callable[[Controller], None] = lambda controller: None
    weak_macro_hz: float = 6.0


def _always_stiff(controller: Controller) -> None:
    in_motion(controller.estimator)


def _no_adaptation(controller: Controller) -> None:
    controller.law["adaptation_per_s"] = 0.0


WHOLE = Rival("DSMC")
RIVALS = (
    Rival("PID with feed-forward", "pid", weak_macro_hz=12.0),  # as stiff as the other at 6 Hz: its gain is w^2 / 4
    Rival("DSMC with an observer that is always stiff", change=_always_stiff),
    Rival("DSMC without adaptation", change=_no_adaptation),
)


def said(profile: "Profile", machine: Any) -> tuple[str, ...]:
    """Measure, and say of each rival where it is better and where it is not."""
    ours = measured(profile, machine, WHOLE)
    return tuple(
        f"{rival.name} beside DSMC ({profile.name}, simulated, seeds {SEEDS[0]} to {SEEDS[-1]}, worst): "
        + verdict(measured(profile, machine, rival), ours)
        for rival in RIVALS
    )


def verdict(theirs: Mapping[str, float], ours: Mapping[str, float]) -> str:
    """Say where a rival is better, where it is worse, and where it makes no difference, with both numbers, in m."""
    found: dict[str, list[str]] = {how: [] for how in (BETTER, WORSE, NO_DIFFERENT)}
    for what, our_m in ours.items():
        found[compared(theirs[what], our_m)].append(f"{what} ({_said(theirs[what])} against {_said(our_m)})")
    return "; ".join(f"{how} in {', '.join(rows)}" for how, rows in found.items() if rows) + "."


def compared(their: float, our: float) -> str:
    """Say whether a rival's number is better, less than ours; where one was stopped (nan) the other is better."""
    if abs(their - our) <= _EQUAL_RATIO * our or (math.isnan(their) and math.isnan(our)):
        return NO_DIFFERENT
    return BETTER if their < our or math.isnan(our) else WORSE


def _said(value_m: float) -> str:
    return "stopped" if math.isnan(value_m) else str(Quantity(value_m, "m"))


def measured(profile: "Profile", machine: Any, rival: Rival) -> dict[str, float]:
    """Return what a rival's end does, worst of SEEDS, m; nan where the guard stopped it."""
    pushed = machine.model_copy(update={"effects": (_OFFSET, *machine.effects)})
    weak = {"macro_bandwidth_hz": rival.weak_macro_hz, "macro_feed_forward_ratio": 0.0}
    touching = profile.model_copy(update={"control": profile.control.model_copy(update=weak)})
    still = np.zeros(round(_HOLD_S * profile.cycle.rate_hz), SETPOINT)
    moves = trajectory.trapezoid(0.8, 0.2, start_m=-0.4, dwell_s=1.0, lead_s=0.2).setpoints
    pushes_m = [_pushed_m(profile, pushed, rival, seed) for seed in SEEDS]  # one alone is noise for a quarter
    return {
        HOLD: max(_rms(_error_m(profile, pushed, rival, still, seed)) for seed in SEEDS),
        STEP: float(np.max(np.abs(np.mean(pushes_m, axis=0)))),
        FREE: max(_peak(_error_m(profile, pushed, rival, moves, seed)) for seed in SEEDS),
        CONTACT: max(_peak(_error_m(touching, pushed, rival, moves, seed)) for seed in SEEDS),
    }


def _controller(profile: "Profile", rival: Rival) -> Controller:
    controller = controller_of(profile, rival.law)
    rival.change(controller)
    return controller


def _error_m(profile: "Profile", machine: Any, rival: Rival, setpoints: np.ndarray, seed: int) -> np.ndarray:
    try:
        return true_error_m(scan(_controller(profile, rival), profile, machine, setpoints, seed), setpoints)
    except RequestError:
        return np.array([np.nan])


def _pushed_m(profile: "Profile", machine: Any, rival: Rival, seed: int) -> np.ndarray:
    """Rest at 0, then put STEP_N on the micro: true position at the samples, m."""
    simulation = rested(_controller(profile, rival), profile, machine, 0.0, seed)
    simulation.effects[0] = STEP_N  # of the offset, which is first
    recording = batch.run(simulation, np.zeros(round(_STEP_S * profile.cycle.rate_hz), SETPOINT))
    return recording.truth["end_position_m"]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _peak(values: np.ndarray) -> float:
    return float(np.max(np.abs(values)))
