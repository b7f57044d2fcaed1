"""Iterative learning over repeated scans: what it takes out of the error, and what its guard does when it can't."""

from collections.abc import Callable, Iterator

import numpy as np

from bench.figure import Bar, Figure, judged
from sim_backend.machine import Machine, load_machine
from stagectl import learning, trajectory
from stagectl.errors import RequestError
from stagectl.followed import controller_of, scan, true_error_m
from stagectl.learning import Learning, Limits
from stagectl.profile import Profile, load_profile

FIRST = Bar("learning: peak of the first scan, worst seed", "nm")
AFTER = Bar("learning: peak after 8 scans, worst seed", "nm", 20.0)
AFTER_RMS = Bar("learning: rms after 8 scans, worst seed", "nm", 5.0)
CONTACT_FIRST = Bar("learning, contact active: peak of the first scan, worst seed", "nm")
CONTACT_AFTER = Bar("learning, contact active: peak after 8 scans, worst seed", "nm", 30.0)
CHANGED = Bar("learning, micro 5 % heavier after 8 scans: the next scan's peak over one without learning", "1")
GUARD = Bar("the same: worst of the 5 scans that follow", "1", 1.25)
GUARD_WILD = Bar("learning up to 240 Hz at full gain: worst of 12 scans over the first", "1", 1.5)

SCANS = 8
_SEEDS = (1, 2, 3)
_FOLLOWING = 6
_WEAK = {"macro_bandwidth_hz": 6.0, "macro_feed_forward_ratio": 0.0}
_WILD = Limits(gain_ratio=1.0, bandwidth_hz=240.0)


def figures(*, full: bool, say: Callable[[str], None]) -> Iterator[Figure]:
    """Measure learning with a good macro, with one that lets the joint touch, and its guard."""
    profile, machine = load_profile("oled-printer"), load_machine("oled-printer")
    weak = profile.model_copy(update={"control": profile.control.model_copy(update=_WEAK)})
    seeds = range(1, 11) if full else _SEEDS
    for of, first, after in ((profile, FIRST, AFTER), (weak, CONTACT_FIRST, CONTACT_AFTER)):
        say(f"learning: {first.figure}")
        errors = [repeated(of, machine, SCANS + 1, seed)[0] for seed in seeds]
        yield judged(first, 1e9 * max(_peak(one[0]) for one in errors), list(seeds))
        yield judged(after, 1e9 * max(_peak(one[-1]) for one in errors), list(seeds))
        if of is profile:
            rms_m = max(float(np.sqrt(np.mean(one[-1] ** 2))) for one in errors)
            yield judged(AFTER_RMS, 1e9 * rms_m, list(seeds))
    say("learning: its guard")
    changed = [_after_a_change(profile, machine, seed) for seed in seeds]
    yield judged(CHANGED, max(one[0] for one in changed), list(seeds))
    yield judged(GUARD, max(max(one[1:]) for one in changed), list(seeds))
    wild = [repeated(profile, machine, 12, seed, _WILD)[0] for seed in seeds]
    yield judged(GUARD_WILD, max(max(map(_peak, one)) / _peak(one[0]) for one in wild), list(seeds))


def planned(profile: Profile) -> np.ndarray:
    """Plan the scan: 0.8 m there and back."""
    return trajectory.trapezoid(0.8, 0.2, dwell_s=1.0, start_m=-0.4, lead_s=0.5, dt_s=profile.cycle.period_s).setpoints


def repeated(
    profile: Profile,
    machine: Machine,
    count: int,
    seed: int,
    limits: Limits | None = None,
    begun: Learning | None = None,
) -> tuple[list[np.ndarray], Learning]:
    """Scan and learn, with new noise in every scan; returns every scan's true error, and what is learnt at the end."""
    setpoints = planned(profile)
    state = learning.init(setpoints.size, profile.cycle.period_s, limits) if begun is None else begun
    errors = []
    for number in range(count):
        reference = learning.corrected(setpoints, state)
        recording = scan(controller_of(profile, "dsmc"), profile, machine, reference, 1000 * seed + number)
        errors.append(true_error_m(recording, setpoints))
        state = learning.step(state, recording.measurements["end_position_m"] - setpoints["position_m"])
    return errors, state


def _after_a_change(profile: Profile, machine: Machine, seed: int) -> list[float]:
    """Return the peaks of the scans after the machine has changed, over that of one without learning."""
    _, state = repeated(profile, machine, SCANS, seed)
    other = heavier(machine, 1.05)
    plain, _ = repeated(profile, other, 1, seed + 50)
    errors, _ = repeated(profile, other, _FOLLOWING, seed + 50, begun=state)
    return [_peak(one) / _peak(plain[0]) for one in errors]


def heavier(machine: Machine, ratio: float) -> Machine:
    """Return the machine with another mass on its micro."""
    if machine.micro is None:
        raise RequestError(f"machine {machine.name} has no micro")
    return machine.model_copy(
        update={"micro": machine.micro.model_copy(update={"mass_kg": ratio * machine.micro.mass_kg})}
    )


def _peak(error_m: np.ndarray) -> float:
    return float(np.max(np.abs(error_m)))
