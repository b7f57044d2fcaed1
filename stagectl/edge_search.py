"""The search for both edges of the joint in homing: which gap the next sweep goes by, from what the last one met.

Without power the micro swings on its spring between the edges, so where it stood when the zero was taken says little:
a first guess is off by up to half the gap, and the edge that was met says where the other one is. Where a sweep that
was centred by it meets it again and not the other one, the gap is wider than it is believed, and the next one reaches
a part of its press further. Cycles that the host missed, more in a row than the identification is carried over, begin
its holds anew: with 12 ms in every 200 ms a sweep met both edges and learnt of none. Such a sweep is swept again.

Pure; knows no bus and no clock (decision 0054).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stagectl.errors import RequestError
from stagectl.estimator import BRIDGED_SAMPLES
from stagectl.guard import STROKE_SHARE
from stagectl.outcome import BacklashEstimate
from stagectl.profile import Profile
from stagectl.touch_sweep import TOUCH_SHARE, Joint

_SIDES = ("right", "left")
_TRIES = 4  # sweeps that find one edge, or that the host spoilt
_WIDER_TRIES = 6  # oled-printer's stroke ends before; each takes 7 s, 25 s where the joint is wide and damped
_WIDENING_RATIO = 2.0 / 3.0
"""By which share of its press a sweep that did not meet an edge reaches further the next time.

An edge that was pressed by up to a third of it may have let go before the identification could tell: it is pressed as
deep as any other then, and no deeper.
"""

_LEAST_WIDENING_RATIO = 0.1
_SURE_RATIO = 0.1  # standard deviation of an edge that a gap is believed wider by, to the press of a sweep
_ANSWER_S = 0.1  # as long as the identification looks at least


class Gap(NamedTuple):
    """What to believe for the next sweep: a gap as wide as that from its `known` edge on, which is at `edge_m`."""

    width_m: float
    known: str | None = None
    """'left' or 'right'; None: about the same middle."""

    edge_m: float = 0.0


@dataclass(slots=True)
class EdgeSearch:
    """What a homing has found out so far; `init` begins one."""

    profile: Profile
    least_width_m: float
    """What was believed before: what has worn does not grow narrower."""

    known: str | None = None
    tries_count: int = 0
    wider_count: int = 0
    pressed_n: float = 0.0
    """What answered on the side that the last sweep did not meet."""


def init(profile: Profile, believed: Joint) -> EdgeSearch:
    """Begin a search of a stage whose joint was believed to be `believed`."""
    return EdgeSearch(profile, believed.left_m + believed.right_m)


def step(search: EdgeSearch, joint: Joint, estimate: BacklashEstimate, rows: np.ndarray) -> Gap | None:
    """Return the gap that the next sweep goes by, None for the same once more, after one that did not meet both edges.

    `joint` is what the last sweep went by, `estimate` what it found, `rows` what was recorded of it. Errors:
    RequestError where there is nothing more to try.
    """
    met = next((side for side in _SIDES if math.isfinite(getattr(estimate, f"{side}_sd_m"))), None)
    is_sure = met is None or getattr(estimate, f"{met}_sd_m") < _SURE_RATIO * joint.press_m(TOUCH_SHARE)
    edge_m = 0.0 if met is None else float(getattr(estimate, f"{met}_m"))
    if met is not None and (met != search.known or not is_sure):
        _count_try(search)
        search.known = met if is_sure else None
        return Gap(max(search.least_width_m, joint.left_m + joint.right_m), met, edge_m)
    if was_held_up(rows):
        _count_try(search)
        return None
    search.known = met
    pressed_n = answers_n(rows, search.profile.cycle.period_s)
    search.pressed_n = max(force_n for side, force_n in pressed_n.items() if side != met)
    width_m = wider_m(search.profile, joint, met, search.pressed_n)
    if search.wider_count == _WIDER_TRIES:
        raise RequestError(f"wider {_WIDER_TRIES} times")
    search.wider_count += 1
    return Gap(width_m, met, edge_m)


def _count_try(search: EdgeSearch) -> None:
    search.tries_count += 1
    if search.tries_count == _TRIES:
        raise RequestError(f"{_TRIES} of them met one edge at another place, or missed cycles")


def answers_n(rows: np.ndarray, period_s: float) -> dict[str, float]:
    """Return with how much the joint answered on each side, whether it was identified or not.

    From what the compensation took for contact and what it was taught better by. The spring's middle is not where
    the zeros have it, which is there all the time; the blow of a believed edge that is none is over in 50 ms.
    """
    force_n = rows["contact_force_estimate_n"] + rows["micro_disturbance_n"]
    count = round(_ANSWER_S / period_s)
    answer_n = np.convolve(force_n, np.full(count, 1.0 / count), "valid") - np.median(force_n)
    return {"left": -float(answer_n.min()), "right": float(answer_n.max())}


def was_held_up(rows: np.ndarray) -> bool:
    """Tell whether samples were missing, more in a row than the identification is carried over."""
    sampled_cycles = rows["cycle"][rows["samples_new"] > 0]
    return bool(np.any(np.diff(sampled_cycles) > BRIDGED_SAMPLES))


def wider_m(profile: Profile, joint: Joint, met: str | None, pressed_n: float) -> float:
    """Return how wide to believe the gap after a sweep that `met` one edge, 'left' or 'right', where it was believed.

    None as `met`: it met neither, and reaches further on both sides the next time. `pressed_n` is what answered where
    no edge was met: with the next sweep that edge is pressed as deep as any. Errors: RequestError where the edge is
    pressed that deep by now, and where the wider sweep would leave the micro's stroke.

    Where in the stroke the edge stands that was met is known from the profile, for an edge that has worn has moved
    outwards; nobody knows where a sweep lies that met none, except that it was as far away as it swings.
    """
    backlash, micro = profile.backlash, profile.micro
    if backlash is None or micro is None:
        raise RequestError(f"profile {profile.name}: this stage has no micro; there is no backlash to identify")
    press_m = joint.press_m(TOUCH_SHARE)
    left_m = press_m * (1.0 - pressed_n / (TOUCH_SHARE * joint.touch_force_n))
    if left_m < _LEAST_WIDENING_RATIO * press_m:
        raise RequestError(f"what answered there with {pressed_n:.1f} N could not be identified")
    width_m = joint.left_m + joint.right_m + (1.0 if met else 2.0) * min(left_m, _WIDENING_RATIO * press_m)
    amplitude_m = 0.5 * width_m + press_m
    # End minus macro is -x_b. These are the zeros that hold, by which the guard judges: the middle is the profile's.
    middle_m = 0.5 * (backlash.left_m - backlash.right_m)
    reached_m = [middle_m - amplitude_m, middle_m + amplitude_m]
    if met == "right":
        reached_m.append(-backlash.right_m + width_m + press_m)
    elif met == "left":
        reached_m.append(backlash.left_m - width_m - press_m)
    else:
        reached_m += [middle_m - 2.0 * amplitude_m, middle_m + 2.0 * amplitude_m]
    low_m, high_m = (STROKE_SHARE * end_m for end_m in micro.stroke_m)
    if not (low_m <= min(reached_m) and max(reached_m) <= high_m):
        raise RequestError("a wider one might leave micro.stroke_m")
    return width_m
