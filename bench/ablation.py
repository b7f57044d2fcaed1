"""What each part of DSMC buys: each is switched off once, on the same seeds, the same machine, the same motions.

Parts are switched off in the controller's states, never in its code, so that nothing else differs.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from bench.control_limit import with_tables
from bench.figure import Bar, Figure, absent, judged
from sim_backend.machine import Machine, load_machine
from stagectl import estimator, trajectory
from stagectl.adaptive_filter import at_rest, in_motion
from stagectl.batch import simulation
from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.followed import controller_of, scan, true_error_m
from stagectl.laws.reference import gap_centre
from stagectl.paper.rivals import compared
from stagectl.profile import Profile, load_profile
from stagectl.tick import Controller
from tests.stage_loop import Loop

ABOUT = "Each part of the law switched off once; see `bench/ablation.py`."

_SEEDS = (1, 2, 3, 4, 5)
_SETTLED_S = 0.3
_WEAK = {"macro_bandwidth_hz": 6.0, "macro_feed_forward_ratio": 0.0}  # so that the joint touches on both sides
_AT_ONCE_S = 1e-6
_NO_STIFFNESS = 1e-9  # N/m


@dataclass(frozen=True, slots=True)
class Part:
    """One part of the law and how it is switched off: once, or behind every cycle."""

    name: str
    off: Callable[[Controller, Profile], None]
    behind_cycle: Callable[[Controller], None] | None = None


def _nothing(controller: Controller, profile: Profile) -> None:
    pass


def _no_contact(controller: Controller, profile: Profile) -> None:
    """Believe in a joint that pushes with nothing; its centre stays known."""
    controller.belief["left_stiffness_n_per_m"] = controller.belief["right_stiffness_n_per_m"] = _NO_STIFFNESS
    place = 0
    for row in profile.effects:
        count = len(CATALOGUE[row["name"]].parameters)
        if row["acts_on"] == "contact":
            controller.effects[place : place + count] = 0.0
        place += count


def _no_delay(controller: Controller, profile: Profile) -> None:
    controller.estimator["actuation_delay_s"] = _AT_ONCE_S


def _no_unknown_force(controller: Controller) -> None:
    controller.model["micro_disturbance_n"] = 0.0


def _asked_fed(controller: Controller) -> None:
    """Feed observer and rounding what was asked for."""
    for axis in ("macro", "micro"):
        step_n = float(controller.estimator[f"{axis}_amperes_per_word"][0])
        step_n *= float(controller.belief[f"{axis}_force_constant_n_per_a"][0])
        controller.estimator[f"{axis}_word"] = controller.command[f"{axis}_force_asked_n"] / step_n
        controller.estimator[f"{axis}_carried_word"] = 0.0


def _always_stiff(controller: Controller, profile: Profile) -> None:
    in_motion(controller.estimator)


def _always_soft(controller: Controller, profile: Profile) -> None:
    at_rest(controller.estimator)
    controller.estimator["filter_walk"] = controller.estimator["filter_rest_walk"]


def _believing(**tables: dict[str, float]) -> Callable[[Controller, Profile], None]:
    """Return what gives the observer, and nothing else, the word of a profile with other values in its tables."""

    def off(controller: Controller, profile: Profile) -> None:
        controller.estimator[:] = estimator.init(with_tables(profile, **tables))

    return off


def _no_sliding(controller: Controller, profile: Profile) -> None:
    """Leave the surface alone to bring the error back: what was k s is no more."""
    controller.law["sliding_gain_per_s"] = 0.0


def _no_integral(controller: Controller, profile: Profile) -> None:
    """Take z out of the surface: a linear law on e and e' with the same k and eta."""
    controller.law["gamma_per_s2"] = 0.0


def _no_adaptation(controller: Controller, profile: Profile) -> None:
    controller.law["adaptation_per_s"] = 0.0


PARTS = (
    Part("whole", _nothing),
    Part("no contact prediction", _no_contact),
    Part("asked force fed, not the integer sent", _nothing, _asked_fed),
    Part("no delay compensation", _no_delay),
    Part("no unknown force", _nothing, _no_unknown_force),
    Part("observer always as stiff as in motion", _always_stiff),
    Part("observer always as soft as at rest", _always_soft),
    Part("no mass found on the way", _believing(micro={"mass_sd_kg": 0.0})),
    Part("no doubt of the contact's force", _believing(backlash={"force_sd_ratio": 0.0})),
    Part("no drift by the way", _believing(control={"travel_drift_n_per_sqrt_m": 0.0})),
    Part("no sliding part (k = 0)", _no_sliding),
    Part("no integral in the surface", _no_integral),
    Part("no adaptation", _no_adaptation),
)
"""The first is the law as it is; the others lack one part each."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one part's absence leaves, worst of the seeds, m; nan where the guard ended it, for `reason`."""

    hold_m: float
    peak_m: float
    contact_peak_m: float
    reason: str = ""


def figures(*, full: bool, say: Callable[[str], None]) -> Iterator[Figure]:
    """Measure every part's absence."""
    profile, machine = load_profile("oled-printer"), load_machine("oled-printer")
    seeds = tuple(range(1, 21)) if full else _SEEDS
    whole: dict[str, float] = {}
    for part in PARTS:
        say(f"ablation: {part.name}")
        found = measured(part, profile, machine, seeds)
        rows = (("hold", found.hold_m), ("peak, contact-free", found.peak_m), ("peak, contact", found.contact_peak_m))
        for what, value_m in rows:
            bar = Bar(f"ablation, {part.name}: {what}", "nm")
            if np.isnan(value_m):
                yield absent(bar, found.reason)
            elif what in whole:
                said = (
                    f"the whole law has {1e9 * whole[what]:.3g} nm: {compared(value_m, whole[what])} without the part"
                )
                yield judged(bar, value_m * 1e9, list(seeds), said)
            else:
                whole[what] = value_m
                yield judged(bar, value_m * 1e9, list(seeds))


def measured(part: Part, profile: Profile, machine: Machine, seeds: tuple[int, ...]) -> Outcome:
    """Follow the 0.8 m trapezoid with a good macro and with a weak one that lets the joint touch."""
    weak = profile.model_copy(update={"control": profile.control.model_copy(update=_WEAK)})
    planned = trajectory.trapezoid(0.8, 0.2, dwell_s=1.5, start_m=-0.4, lead_s=0.5, dt_s=profile.cycle.period_s)
    values = {}
    reasons = []
    for name, of in (("good", profile), ("weak", weak)):
        try:
            values[name] = [_errors(part, of, machine, planned.setpoints, seed) for seed in seeds]
        except RequestError as error:
            values[name] = []
            reasons.append(str(error))
    hold_m, peak_m = _worst(values["good"], planned.setpoints, profile.cycle.rate_hz)
    _, contact_peak_m = _worst(values["weak"], planned.setpoints, profile.cycle.rate_hz)
    return Outcome(hold_m, peak_m, contact_peak_m, "; ".join(reasons))


def _worst(errors: list[np.ndarray], setpoints: np.ndarray, rate_hz: float) -> tuple[float, float]:
    """Return the greatest rms in rest, and the greatest error at all."""
    if not errors:
        return float("nan"), float("nan")
    moving = np.flatnonzero(setpoints["velocity_m_per_s"] != 0.0)
    index = np.arange(setpoints.size)
    before = np.searchsorted(moving, index, side="right") - 1
    rest = (before >= 0) & (index - moving[np.maximum(before, 0)] >= _SETTLED_S * rate_hz)
    return (
        max(float(np.sqrt(np.mean(error[rest] ** 2))) for error in errors),
        max(float(np.max(np.abs(error))) for error in errors),
    )


def _errors(part: Part, profile: Profile, machine: Machine, setpoints: np.ndarray, seed: int) -> np.ndarray:
    controller = controller_of(profile, "dsmc")
    part.off(controller, profile)
    if part.behind_cycle is not None:
        return _with_cycles(part.behind_cycle, controller, profile, machine, setpoints, seed)
    return true_error_m(scan(controller, profile, machine, setpoints, seed), setpoints)


def _with_cycles(
    behind_cycle: Callable[[Controller], None],
    controller: Controller,
    profile: Profile,
    machine: Machine,
    setpoints: np.ndarray,
    seed: int,
) -> np.ndarray:
    """Follow in Python, where the controller can be changed behind every cycle: error at the samples."""
    one = simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    start_m = float(setpoints["position_m"][0])
    one.state["end_position_m"] = start_m
    one.state["macro_position_m"] = start_m + float(gap_centre(controller.belief[0]))
    loop = Loop(one)
    rest = np.zeros(round(profile.cycle.rate_hz), setpoints.dtype)
    rest["position_m"] = start_m
    error_m = []
    for setpoint in np.concatenate([rest, setpoints]):
        loop.cycle(setpoint)
        if loop.stop:
            raise RequestError(f"machine {machine.name}, seed {seed}: stop {loop.stop}")
        behind_cycle(controller)
        error_m.append(loop.true_end_m - setpoint["position_m"])
    return np.array(error_m[rest.size :])
