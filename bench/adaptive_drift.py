"""The adaptive gain at rest settles: how fast, where, and how far it can have drifted after 200 hours.

Between two samples ten seconds apart nothing is remembered (the leak takes half a second), so a straight line through
them has an honest interval. What `--full` simulates is 10 h; the rest to 200 h is that line.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from bench import control_limit as limit
from bench.figure import Bar, Figure, judged
from stagectl import batch, tick
from stagectl.laws.reference import gap_centre
from stagectl.profile import Profile
from stagectl.signals import SETPOINT, Stop

RATE = Bar("adaptive gain at rest: settles at, over the leak that it is given", "1")
MEAN = Bar("adaptive gain at rest, 5 nm: mean over its ceiling", "1")
DRIFT = Bar("adaptive gain at rest, 5 nm: after 200 h, upper end of 95 %, over its ceiling", "1", 1.0)

_LONG_H, _SHORT_H, _FORETOLD_H = 10.0, 0.25, 200.0
_EVERY_S = 10.0
_SETTLED_S = 20.0
_FALL_S = 1.5
_FALL_STEP_S = 0.05
_NORMAL_95 = 1.96
_SEED = 1

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Hold still for hours, and look at the gain."""
    hours = _LONG_H if full else _SHORT_H
    say(f"the adaptive gain at rest, {hours:g} h")
    profile = limit.stage()
    ceiling = profile.control.adaptive_gain_ceiling_ratio
    rate_per_s = settling_per_s(profile)
    said = f"{rate_per_s:.2f} per s from the ceiling down, leak {profile.control.leak_per_s:g} per s"
    yield judged(RATE, rate_per_s / profile.control.leak_per_s, [_SEED], said)
    gain = at_rest(profile, hours)
    yield judged(MEAN, float(np.mean(gain)) / ceiling, [_SEED], f"{gain.size} samples, {hours:g} h simulated")
    foretold, sd = foretold_after(gain, hours, _FORETOLD_H)
    said = f"{hours:g} h simulated, the rest foretold: {foretold / ceiling:.4f} +- {_NORMAL_95 * sd / ceiling:.4f}"
    # A quarter of an hour says little of 200 h: its interval is wider than the ceiling, and judged is the long run.
    bar = DRIFT if full else replace(DRIFT, limit=None)
    yield judged(bar, (foretold + _NORMAL_95 * sd) / ceiling, [_SEED], said)


def foretold_after(gain: np.ndarray, hours: float, foretold_h: float) -> tuple[float, float]:
    """Return the line through samples over `hours`, evenly spaced, at `foretold_h`, and its standard deviation."""
    t_h = hours * (np.arange(gain.size) + 0.5) / gain.size
    off_h = t_h - np.mean(t_h)
    slope = float(off_h @ gain / (off_h @ off_h))
    rest = gain - np.mean(gain) - slope * off_h
    variance = float(rest @ rest) / (gain.size - 2)
    ahead_h = foretold_h - float(np.mean(t_h))
    sd = np.sqrt(variance * (1.0 / gain.size + ahead_h * ahead_h / float(off_h @ off_h)))
    return float(np.mean(gain)) + slope * ahead_h, float(sd)


def _resting(profile: Profile) -> batch.Simulation:
    controller = tick.controller(profile, "dsmc", has_drives=False)
    delay_s = profile.cycle.actuation_delay_s
    simulation = batch.simulation(controller, limit.machine(profile, 1.01, 1.2), latch_delay_s=delay_s, seed=_SEED)
    simulation.state["end_position_m"] = 0.0
    simulation.state["macro_position_m"] = float(gap_centre(controller.belief[0]))
    _hold(simulation, profile, _SETTLED_S)
    return simulation


def _hold(simulation: batch.Simulation, profile: Profile, duration_s: float) -> float:
    recording = batch.run(simulation, np.zeros(round(duration_s * profile.cycle.rate_hz), SETPOINT))
    if recording.commands["stop"][-1] != Stop.NONE:
        raise RuntimeError("the hold was stopped: this row would show nothing")
    return float(simulation.controller.law["adaptive_gain_ratio"][0])


def at_rest(profile: Profile, hours: float) -> np.ndarray:
    """Return the adaptive gain every ten seconds of a hold, shape (n,)."""
    simulation = _resting(profile)
    return np.array([_hold(simulation, profile, _EVERY_S) for _ in range(round(3600.0 * hours / _EVERY_S))])


def settling_per_s(profile: Profile) -> float:
    """Return the rate at which the gain falls from its ceiling to where it rests."""
    simulation = _resting(profile)
    rest = np.mean([_hold(simulation, profile, _FALL_STEP_S) for _ in range(200)])
    simulation.controller.law["adaptive_gain_ratio"] = profile.control.adaptive_gain_ceiling_ratio
    count = round(_FALL_S / _FALL_STEP_S)
    above = np.array([_hold(simulation, profile, _FALL_STEP_S) for _ in range(count)]) - rest
    t_s = _FALL_STEP_S * np.arange(1, count + 1)
    fit = above > 0.05 * above[0]
    return -float(np.polyfit(t_s[fit], np.log(above[fit]), 1)[0])
