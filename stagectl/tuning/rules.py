"""Gains with a stated bandwidth and margin, from the linearised loop of the identified machine.

DSMC. One end of the loop is fast, the other sets the margin. The law is as fast as the cycle allows: k / m = 0.18 and
eta = 0.163 of the cycle's rate, in 2 pi. With w the bandwidth its integral is at 2 gamma / eta = w / 8, and the poles
of the observer at 2 w / 3, by the density of the force that it reckons with (Kwakernaak, Sivan, Linear Optimal Control
Systems, section 5.3: the law's end recovers the observer's margins). The adaptive gain may rise by 5 %. What is left is
one number, w: it is made as large as the margins allow, the adaptive gain at its ceiling included, or as the bandwidth
that is asked for takes. PID has its bandwidth as that one number. A flexible mode that is known gets a notch
(`stagectl.tuning.mode`), and the bandwidth that the notch leaves.

Every result is checked in the gap and in contact on either side, in motion where there is dry friction, on the
observer's way from soft at rest to stiff, where the margins are less than at either end, and with the moved mass 10 %
off.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from stagectl.adaptive_filter import at_rest, in_motion
from stagectl.budget import shares
from stagectl.budget.budget import STEP_N
from stagectl.budget.disturbances import noises_of
from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.linear_loop import GAP, LEFT, ON_THE_WAY, RIGHT, Body, Linearised, believed_body, linearise
from stagectl.margins import Margins, grid_hz, margins
from stagectl.tuning import mode as modes
from stagectl.tuning.mode import Mode
from stagectl.tuning.triangular import sensitivities

if TYPE_CHECKING:
    from stagectl.profile import Profile

PLACES = {GAP: "gap", LEFT: "left contact", RIGHT: "right contact"}
CEILING = "gap, adapted"
"""With the adaptive gain at its ceiling."""
MOVING = "in motion"
"""In the gap, at a speed at which dry friction is a force that damps nothing."""
RESTING = "gap, at rest"
"""With the observer as soft as it is there."""
STIFFENING = "on the way"
"""With the observer on its way from soft to stiff, wherever that is worst."""
MASS_RATIO = 0.1

_SLIDING_RATIO, _ETA_RATIO = (
    0.18,
    0.163,
)  # of the cycle's rate: from 0.2 on the loop gain rises again towards half of it
_INTEGRAL_RATIO = 0.129  # of the bandwidth
_CEILING_RATIO = 0.05
_OBSERVER_RATIO = 0.67  # of the bandwidth: where the poles of a Kalman filter of a random-walk force are
_SPAN = (1e-2, 1e2)  # of the profile's own number, searched
_GRID_COUNT = 13
_BISECTIONS = 7
_USUAL_SENSITIVITY = 2.0
_SLACK = 1.002  # of a limit that a search ends at
_COARSE = 5  # every fifth frequency tells which loop is the worst
_ENOUGH_RATIO = 1.01  # of a limit: beyond it without a doubt, as a fine grid sees it too


@dataclass(frozen=True, slots=True)
class Asked:
    """What gains have to keep; `bandwidth_hz` None = as much as the margins allow."""

    max_sensitivity: float = _USUAL_SENSITIVITY
    delay_margin_s: float = 0.8e-3
    bandwidth_hz: float | None = None
    mode: Mode | None = None
    """A flexible mode that the machine has and the profile doesn't; sensitivity has to be kept with it too."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """What one profile's loop shows at one place; gains complex, shapes (n,)."""

    place: str
    margins: Margins
    frequency_hz: np.ndarray
    loop_gain: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """A profile's gains, judged: loops at every place, hold and answer to a step of force in the gap."""

    loops: tuple[Loop, ...]
    hold_m: float  # with the sensor's noise and torque step of the profile; nan where unstable
    step_peak_m: float
    stable_with_other_mass: bool

    @property
    def worst_sensitivity(self) -> float:
        """Greatest sensitivity of all places; infinite where one is unstable."""
        return max(one.margins.sensitivity_peak_ratio if one.margins.is_stable else math.inf for one in self.loops)

    @property
    def least_delay_margin_s(self) -> float:
        """Least delay margin of all places."""
        return min(one.margins.delay_margin_s for one in self.loops)

    @property
    def crossover_hz(self) -> float:
        """Crossover in the gap; in motion where dry friction holds the stage at rest."""
        return next((one for one in self.loops if one.place == MOVING), self.loops[0]).margins.crossover_hz


@dataclass(frozen=True, slots=True, eq=False)
class Tuned:
    """New gains by their keys of [control], and both profiles judged."""

    law: str
    values: dict[str, float]
    old_values: dict[str, float]
    before: Assessment
    after: Assessment


def tuned(
    profile: "Profile", law: str, asked: Asked, say: Callable[[str, float], None] = lambda what, share: None
) -> Tuned:
    """Find gains that keep what is asked.

    Errors: RequestError where the identified model is unstable under every gain, or a bandwidth has no such margin.
    """
    say("judging the gains as they are", 0.0)
    mode = asked.mode
    if mode is not None:
        _refuse_mode(profile, law, mode)
    before = assessed(profile, law, mode)
    key = _key(profile, law)
    say("searching", 0.2)
    # The mode may cost margin, and that is no reason to be faster: without it the loop keeps to the usual one.
    bare = asked if mode is None else replace(asked, max_sensitivity=min(asked.max_sensitivity, _USUAL_SENSITIVITY))
    value = _searched(profile, law, key, bare)
    notch: dict[str, float] = {}
    if mode is not None:
        say("fitting the notch", 0.5)
        value, notch = _searched_with(profile, law, mode, asked, value)
    say("checking it everywhere", 0.7)
    found = assessed(_with(profile, law, value, notch), law, mode)
    while asked.bandwidth_hz is None and not _keeps(found, asked):  # a place that is worse than the gap
        value *= 0.9
        if value < _SPAN[0] * getattr(profile.control, key):
            break
        found = assessed(_with(profile, law, value, notch), law, mode)
    _refuse(profile, law, asked, found)
    rounded = float(f"{value:.4g}")
    values = _gains(profile, law, rounded) | notch
    old = {name: float(getattr(profile.control, name)) for name in values}
    return Tuned(law, values, old, before, assessed(_with(profile, law, rounded, notch), law, mode))


def _refuse_mode(profile: "Profile", law: str, mode: Mode) -> None:
    half_hz = 0.5 * profile.cycle.rate_hz
    if law != "dsmc":
        raise RequestError(f"a mode at {mode.frequency_hz:g} Hz needs a notch, and {law} has none; take --law dsmc")
    if not 0.0 < mode.frequency_hz < half_hz:
        raise RequestError(
            f"a mode at {mode.frequency_hz:g} Hz: a notch lies below half of cycle.rate_hz, {half_hz:g} Hz; above it a "
            "sampled loop sees the mode elsewhere: damp it, or sample faster"
        )


def _searched_with(
    profile: "Profile", law: str, mode: Mode, asked: Asked, bandwidth_hz: float
) -> tuple[float, dict[str, float]]:
    """Return bandwidth and notch; a bandwidth that is asked for stays what it is."""
    body = believed_body(profile)

    def made(value: float, notch: Mapping[str, float]) -> Linearised:
        one = _with(profile, law, value, notch)
        return linearise(one, law, body, GAP, most_adaptive_gain_ratio(one, law))

    return modes.searched(made, mode, asked.max_sensitivity, bandwidth_hz, may_slow=asked.bandwidth_hz is None)


def assessed(profile: "Profile", law: str, mode: Mode | None = None) -> Assessment:
    """Judge a profile's gains with the machine that it believes in, and with a mode beside it."""
    body = believed_body(profile)
    frequency_hz = grid_hz(profile.cycle.period_s)
    loops = []
    for place, said in PLACES.items():
        if place != GAP and profile.micro is None:
            continue
        one = linearise(profile, law, body, place)
        loops.append(Loop(said, margins(one), frequency_hz, one.loop_gain(frequency_hz)))
    most = most_adaptive_gain_ratio(profile, law)
    moving = _in_motion(profile)
    if moving is not None:
        one = linearise(moving, law, believed_body(moving), GAP, most)
        loops.append(Loop(MOVING, margins(one), frequency_hz, one.loop_gain(frequency_hz)))
    if most:
        one = linearise(profile, law, body, GAP, most)
        loops.append(Loop(CEILING, margins(one), frequency_hz, one.loop_gain(frequency_hz)))
    if profile.control.rest_drift_ratio < 1.0:
        one = linearise(profile, law, body, GAP, most, observer=at_rest)
        loops.append(Loop(RESTING, margins(one), frequency_hz, one.loop_gain(frequency_hz)))
    if _stiffens(profile, law):
        one = _worst_on_the_way(profile, law, body, PLACES if profile.micro is not None else (GAP,))
        loops.append(Loop(STIFFENING, margins(one), frequency_hz, one.loop_gain(frequency_hz)))
    if mode is not None:
        loops += _loops_with(linearise(profile, law, body, GAP, most), mode)
    in_gap = linearise(profile, law, body)
    hold_m, peak_m = math.nan, math.nan
    if loops[0].margins.is_stable:
        hold_m = shares.total_rms_m(profile, law, noises_of(profile), body)
        peak_m = step_peak_m(in_gap)
    stable = all(
        linearise(one, law, _heavier(believed_body(one), one, ratio), observer=observer).closed().is_stable()
        for one in (profile, moving)
        if one is not None
        for ratio in _OFF
        for observer in (at_rest, in_motion)
    )
    return Assessment(tuple(loops), hold_m, peak_m, stable)


def _in_motion(profile: "Profile") -> "Profile | None":
    """Return the profile without its dry friction; None where it has none.

    At rest 6 N within 1 mm/s are 6000 N s/m of damping, and a loop that lives on them is without them once it moves.
    """
    rows = tuple(row for row in profile.effects if CATALOGUE[row["name"]].shown_by != "low speed")
    return None if len(rows) == len(profile.effects) else profile.model_copy(update={"effects": rows})


def _stiffens(profile: "Profile", law: str) -> bool:
    """Tell whether a law has an observer that is softer at rest."""
    return law == "dsmc" and profile.control.rest_drift_ratio < 1.0


def _worst_on_the_way(
    profile: "Profile", law: str, body: Body, places: Iterable[int], enough_ratio: float = math.inf
) -> Linearised:
    """Return the loop of the greatest sensitivity of those that a stiffening observer passes; an unstable one first.

    The first beyond `enough_ratio` will do: a search then knows that the gain is too high.
    """
    frequency_hz = grid_hz(profile.cycle.period_s)[::_COARSE]

    def sensitivity(one: Linearised) -> float:
        return float(np.max(sensitivities(one, frequency_hz))) if one.closed().is_stable() else math.inf

    gains = sorted({0.0, most_adaptive_gain_ratio(profile, law)})
    passed = (
        linearise(profile, law, body, place, gain, observer)
        for place in places
        for gain in gains
        for observer in ON_THE_WAY
    )
    worst = next(passed)
    greatest = sensitivity(worst)
    while not greatest > enough_ratio and (one := next(passed, None)) is not None:
        found = sensitivity(one)
        if found > greatest:
            worst, greatest = one, found
    return worst


def _loops_with(one: Linearised, mode: Mode) -> list[Loop]:
    """Return the loop with the mode where it is thought to be, and as far off as it may be."""
    off = mode.frequency_off_ratio
    loops = []
    for ratio in (1.0 - off, 1.0, 1.0 + off):
        at_hz = ratio * mode.frequency_hz
        row = modes.effect(at_hz, mode.residue_ratio, mode.damping_ratio)
        with_mode = replace(one, body=modes.with_effect(one.body, row))
        frequency_hz = modes.grid_around(with_mode.period_s, mode)
        found = margins(with_mode)
        gain = with_mode.loop_gain(frequency_hz)
        peak = max(found.sensitivity_peak_ratio, float(np.max(1.0 / np.abs(1.0 + gain))))
        loops.append(Loop(f"mode at {at_hz:.0f} Hz", replace(found, sensitivity_peak_ratio=peak), frequency_hz, gain))
    return loops


def most_adaptive_gain_ratio(profile: "Profile", law: str) -> float:
    """Return the ceiling of the adaptive gain; 0 where a law has none."""
    return profile.control.adaptive_gain_ceiling_ratio if law == "dsmc" else 0.0


def step_peak_m(loop: Linearised) -> float:
    """Return the greatest error after a step of STEP_N on the axis that carries the end."""
    force_n = np.full(round(0.5 / loop.period_s), STEP_N)
    force_n[0] = 0.0
    moved_m = shares.answer(loop.closed(), {f"{loop.precise_axis}_force_n": force_n}, "end_position_m")
    return float(np.max(np.abs(moved_m)))


_OFF = (1.0 - MASS_RATIO, 1.0 + MASS_RATIO)


def _heavier(body: Body, profile: "Profile", ratio: float) -> Body:
    parameters = body.parameters.copy()
    parameters[f"{profile.axes[-1]}_mass_kg"] *= ratio
    return replace(body, parameters=parameters)


def _key(profile: "Profile", law: str) -> str:
    """Return the key of the number that is searched."""
    if law == "pid" and profile.micro is not None:
        return "pid_bandwidth_hz"
    return f"{profile.axes[-1]}_bandwidth_hz"


def _gains(profile: "Profile", law: str, bandwidth_hz: float) -> dict[str, float]:
    """Return the gains that the rules make of a bandwidth, by their keys of [control]."""
    key = _key(profile, law)
    if law == "pid":
        return {key: bandwidth_hz}
    axis = profile.axes[-1]
    observer_per_s = _OBSERVER_RATIO * 2.0 * math.pi * bandwidth_hz
    noise = profile.axis(axis).mass_kg * profile.interferometer.noise_m * math.sqrt(profile.cycle.period_s)
    cycles = profile.cycle.rate_hz / bandwidth_hz
    gains = {
        "eta_ratio": _ETA_RATIO * cycles,
        "gamma_ratio": 0.5 * _INTEGRAL_RATIO * _ETA_RATIO * cycles,
        "sliding_ratio": _SLIDING_RATIO * cycles,
        f"{axis}_drift_n_per_sqrt_s": observer_per_s**3 * noise,
    }
    rounded = {name: float(f"{value:.3g}") for name, value in gains.items()}
    return {key: bandwidth_hz, **rounded, "adaptive_gain_ceiling_ratio": _CEILING_RATIO}


def _with(
    profile: "Profile", law: str, bandwidth_hz: float, notch: Mapping[str, float] = MappingProxyType({})
) -> "Profile":
    gains = _gains(profile, law, bandwidth_hz) | dict(notch)
    return profile.model_copy(update={"control": profile.control.model_copy(update=gains)})


def _searched(profile: "Profile", law: str, key: str, asked: Asked) -> float:
    """Return the greatest value that keeps the margins in the gap, or the one that has the bandwidth asked for."""
    now = getattr(profile.control, key)
    looked_at = [(one, believed_body(one)) for one in (_in_motion(profile), profile) if one is not None]

    most = most_adaptive_gain_ratio(_with(profile, law, now), law) if asked.bandwidth_hz is None else 0.0

    def found(value: float, place: int = 0) -> Margins:
        one, body = looked_at[place]
        return margins(linearise(_with(one, law, value), law, body, GAP, most))

    def keeps(value: float) -> bool:
        one = found(value)
        if asked.bandwidth_hz is not None:
            return one.is_stable and one.crossover_hz <= asked.bandwidth_hz
        if not all(one.is_stable and _within(one, asked) for one in map(partial(found, value), range(len(looked_at)))):
            return False
        if not _stiffens(profile, law):
            return True
        enough = _ENOUGH_RATIO * asked.max_sensitivity
        one = margins(_worst_on_the_way(_with(profile, law, value), law, looked_at[-1][1], (GAP,), enough))
        return one.is_stable and _within(one, asked)

    values = np.geomspace(_SPAN[0], _SPAN[1], _GRID_COUNT) * now
    kept = next((k for k in reversed(range(_GRID_COUNT)) if keeps(float(values[k]))), None)
    if kept is None:
        least = found(float(values[_GRID_COUNT // 2]))
        if not any(found(float(value)).is_stable for value in values):
            raise RequestError(
                f"profile {profile.name}: the identified model is unstable under {law} with every "
                f"control.{key} from {values[0]:.3g} to {values[-1]:.3g}; shorten cycle.actuation_delay_s, or check "
                "mass_kg and rated_force_n (`stagectl gap`)"
            )
        remedy = "allow less margin" if asked.bandwidth_hz is None else "ask for another bandwidth"
        raise RequestError(
            f"profile {profile.name}: no control.{key} keeps {_said(asked)}; with {now:.3g} the "
            f"greatest sensitivity is {least.sensitivity_peak_ratio:.2f}, the delay margin "
            f"{least.delay_margin_s * 1e3:.2f} ms, the crossover {least.crossover_hz:.0f} Hz; {remedy}, or "
            "shorten cycle.actuation_delay_s"
        )
    low = float(values[kept])
    if kept == _GRID_COUNT - 1:
        return low
    high = float(values[kept + 1])
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if keeps(middle) else (low, middle)
    return low


def _within(one: Margins, asked: Asked) -> bool:
    return one.sensitivity_peak_ratio <= asked.max_sensitivity and one.delay_margin_s >= asked.delay_margin_s


def _keeps(found: Assessment, asked: Asked) -> bool:
    return (
        found.worst_sensitivity <= asked.max_sensitivity * _SLACK
        and found.least_delay_margin_s >= asked.delay_margin_s / _SLACK
        and found.stable_with_other_mass
    )


def _refuse(profile: "Profile", law: str, asked: Asked, found: Assessment) -> None:
    """Refuse what is unstable, then what keeps too little margin; both with the place and the value."""
    for one in found.loops:
        if not one.margins.is_stable:
            raise RequestError(
                f"profile {profile.name} under {law} would be unstable ({one.place}); ask for less bandwidth, or check "
                "the joint's stiffness (`stagectl identify`)"
            )
    if not found.stable_with_other_mass:
        raise RequestError(
            f"profile {profile.name} under {law} would be unstable with a mass {100.0 * MASS_RATIO:.0f} % off; ask for "
            "less bandwidth"
        )
    if not _keeps(found, asked):
        worst = max(found.loops, key=lambda one: one.margins.sensitivity_peak_ratio)
        raise RequestError(
            f"profile {profile.name} under {law}: {_said(asked)} can't be kept: greatest sensitivity "
            f"{found.worst_sensitivity:.2f} ({worst.place}), delay margin {found.least_delay_margin_s * 1e3:.2f} ms; "
            "ask for less bandwidth (without --bandwidth-hz the greatest possible is taken), or allow less margin"
        )


def _said(asked: Asked) -> str:
    said = f"sensitivity <= {asked.max_sensitivity:g}, delay margin >= {asked.delay_margin_s * 1e3:g} ms"
    return said if asked.bandwidth_hz is None else f"a bandwidth of {asked.bandwidth_hz:g} Hz with {said}"
