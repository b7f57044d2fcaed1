"""Control at the limit on a machine that has one thing more: a mode, a base that shakes, a cyclic error, coarse words.

Every figure of `bench.control_limit` is measured again; here stands the worst of them, over its bar there. Where no bar
applies a bound is computed beside it: of the linear loop for what shakes it, of LQG for what makes the sensor or the
motor coarser. The mode's own gain set is what `stagectl tune --mode-hz` makes of it.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bench import control_limit as limit
from bench.figure import Bar, Figure, judged
from bench.following import rms
from sim_backend.machine import Machine
from stagectl.adaptive_filter import at_rest, at_speed, in_motion
from stagectl.budget import lqg
from stagectl.budget.lqg import Surroundings
from stagectl.linear_loop import GAP, LEFT, ON_THE_WAY, RIGHT, Linearised, linearise, machine_body
from stagectl.profile import Profile
from stagectl.signals import SETPOINT
from stagectl.tuning import mode as modes
from stagectl.tuning.mode import Mode
from stagectl.tuning.rules import Asked, Tuned, step_peak_m, tuned

MODES_HZ = (120.0, 160.0, 200.0, 275.0, 350.0)
SHAKEN_HZ = (30.0, 100.0, 200.0, 300.0)
JITTERS_S = (0.1e-6, 1e-6)

MODE_SENSITIVITY = (
    "control, mode at {hz:g} Hz: Ms, wherever within 3 %, however damped; gap, contacts, gains, observers"
)
MODE_WORST = "control, mode at {hz:g} Hz: worst of the figures over its bar"
SHAKEN = "control, base shakes with 6.25 um/s rms at {hz:g} Hz: worst of the figures over its bar"
SHAKEN_HOLD = "control, base shakes with 6.25 um/s rms at {hz:g} Hz: hold over what the linear loop foretells"
CYCLIC = Bar("control, cyclic error 2 nm: worst of the figures over its bar", "1", 2.0)
COARSE = Bar("control, torque step 0.18 N: hold over the bound", "1", 1.2)
COARSE_AS_STIFF = Bar("control, torque step 0.18 N: hold over the optimum at Ms 2.0 as stiff", "1")
COARSE_HOLD = Bar("control, torque step 0.18 N: hold, rms", "nm")
COARSE_PEAK = Bar("control, torque step 0.18 N, contact-free, calibrated: peak", "nm")
JITTER = "control, sample jitter {us:g} us rms, 0.2 m/s: rms at constant speed over the bound"
JITTER_AS_STIFF = "control, sample jitter {us:g} us rms: the same over the optimum at Ms 2.0 as stiff"
JITTER_UNTOLD = "control, sample jitter {us:g} us rms, and nobody told: over the bound"
JITTER_PEAK = "control, sample jitter {us:g} us rms, contact-free, calibrated: peak"
JITTER_WRONG = "control, sample jitter {us:g} us rms, contact-free, 1 % wrong: peak"

PLACES = {GAP: "in the gap", LEFT: "in contact on the left", RIGHT: "in contact on the right"}
OBSERVERS = {
    "observer at rest": at_rest,
    "observer in motion": in_motion,
    **{f"observer on the way ({number})": one for number, one in enumerate(ON_THE_WAY, start=1)},
}

_SENSITIVITY = 2.5
_TWICE = 2.0
_OF_BOUND = 1.2
_FROM_HZ = 200.0
_SHAKING_M_PER_S = 6.25e-6  # rms, criterion VC-D (Amick et al., Proc. SPIE 5933, 2005)
_SPEED_M_PER_S = 0.2
_HOLD_ROWS = 8000
_FORCE_NOISE_N = 5e-3

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row."""
    seeds = limit.SEEDS
    for hz in MODES_HZ:
        say(f"control at the limit: a mode at {hz:g} Hz")
        yield from _with_mode(hz, seeds)
    say("control at the limit: a base that shakes")
    for hz in SHAKEN_HZ:
        yield from _shaken(hz, seeds)
    cyclic = {"name": "cyclic_error", "acts_on": "end_sensor", "first_m": 2e-9, "second_m": 0.0}
    cyclic |= {"wavelength_m": 316.5e-9, "first_phase_rad": 0.0, "second_phase_rad": 0.0}
    value, remark = over_bars(limit.stage(), [cyclic], seeds)
    yield judged(CYCLIC, value, list(seeds), f"{remark}; period 158 nm, of the end's reading")
    say("control at the limit: coarse words, jitter")
    yield from _coarse(seeds)
    yield from _jitter(seeds)


def over_bars(profile: Profile, effects: Sequence[dict[str, Any]], seeds: Sequence[int]) -> tuple[float, str]:
    """Follow what `bench.control_limit` follows with machines that have effects more.

    Returns the worst figure over its bar there (nan where a run was stopped), and all of them in words.
    """
    found = {}
    held = _runs(profile, "wrong", np.zeros(_HOLD_ROWS, SETPOINT), effects, seeds)
    found["hold"] = 1e9 * max(rms(one.error_m) for one in held) / _limit(limit.HOLD)
    for name, bar, kind in (
        ("free, wrong", limit.FREE_WRONG, "wrong"),
        ("free, calibrated", limit.FREE_CALIBRATED, "calibrated"),
    ):
        followed = _runs(profile, kind, limit.trapezoid(), effects, seeds)
        found[name] = limit.peak_nm(followed) / _limit(bar)
    scanned = [limit.scan_nm(one, profile.cycle.rate_hz) for one in followed]
    found["MA"] = max(average for average, _ in scanned) / _limit(limit.AVERAGE)
    found["MSD"] = max(deviation for _, deviation in scanned) / _limit(limit.DEVIATION)
    for name, bar, kind in (
        ("contact, wrong", limit.CONTACT_WRONG, "wrong"),
        ("contact, calibrated", limit.CONTACT_CALIBRATED, "calibrated"),
    ):
        followed = _runs(limit.weak(profile), kind, limit.trapezoid(), effects, seeds)
        found[name] = limit.peak_nm(followed) / _limit(bar)
    fast = _runs(profile, "wrong", limit.trapezoid(0.4), effects, seeds)
    found["settling"] = max(limit.settling_ms(one) for one in fast) / _limit(limit.SETTLING)
    worst = math.nan if any(math.isnan(value) for value in found.values()) else max(found.values())
    return worst, ", ".join(f"{name} {value:.2f}" for name, value in found.items())


def _limit(bar: Bar) -> float:
    if bar.limit is None:
        raise ValueError(f"{bar.figure} has no bar")
    return bar.limit


def _runs(
    profile: Profile, kind: str, setpoints: np.ndarray, effects: Sequence[dict[str, Any]], seeds: Sequence[int]
) -> list[limit.Run]:
    return [
        limit.run(profile, _with(one, effects), setpoints, seed)
        for one in limit.machines(profile, kind)
        for seed in seeds
    ]


def _with(one: Machine, effects: Sequence[dict[str, Any]]) -> Machine:
    return one.model_copy(update={"effects": (*one.effects, *effects)})


# ---- a flexible mode ----------------------------------------------------------------------------------------------


def gains_for(hz: float) -> Tuned:
    """Return what `tune` makes of the stage with a mode there."""
    return tuned(limit.stage(), "dsmc", Asked(max_sensitivity=_SENSITIVITY, mode=Mode(hz)))


def _with_mode(hz: float, seeds: Sequence[int]) -> Iterator[Figure]:
    found = gains_for(hz)
    profile = limit.stage(**found.values)
    mode = Mode(hz)
    sensitivity, loop, where = worst_with_mode(profile, mode)
    notch = f"notch {profile.control.notch_damping_ratio:g} wide, {profile.control.notch_depth_ratio:g} deep"
    if profile.control.notch_frequency_hz == 0.0:
        notch = "no notch"
    remark = (
        f"{where}; {notch}, bandwidth {profile.control.micro_bandwidth_hz:.0f} Hz; residue -10 %, damping 1 %, and half"
    )
    yield judged(Bar(MODE_SENSITIVITY.format(hz=hz), "1", _SENSITIVITY), sensitivity, reason=remark)
    row = max(
        mode.corners(), key=lambda one: modes.sensitivity(replace(loop, body=modes.with_effect(loop.body, one)), mode)
    )
    value, remark = over_bars(profile, [row], seeds)
    softer = found.after.step_peak_m / found.before.step_peak_m
    bar = Bar(MODE_WORST.format(hz=hz), "1", _TWICE if hz >= _FROM_HZ else None)
    said = f"{remark}; computed: a force moves the end {softer:.2f} times as far as without the mode"
    yield judged(bar, value, list(seeds), said)


def worst_with_mode(profile: Profile, mode: Mode) -> tuple[float, Linearised, str]:
    """Return the greatest Ms with a mode over places, adaptive gains and observers, the loop and its name in words.

    All are judged at the hardest of what the mode may be, the worst of them at all of it.
    """
    body = machine_body(limit.machine(profile))
    gains = {"floor": 0.0, "ceiling": profile.control.adaptive_gain_ceiling_ratio}
    loops = {
        f"worst {PLACES[place]}, gain at its {gain}, {observer}": linearise(
            profile, "dsmc", body, place, gains[gain], OBSERVERS[observer]
        )
        for place, gain, observer in itertools.product(PLACES, gains, OBSERVERS)
    }
    where = max(loops, key=lambda one: modes.worst_sensitivity(loops[one], mode, modes.HARD_COUNT))
    return modes.worst_sensitivity(loops[where], mode), loops[where], where


# ---- a base that shakes --------------------------------------------------------------------------------------------


def _shaken(hz: float, seeds: Sequence[int]) -> Iterator[Figure]:
    amplitude = math.sqrt(2.0) * _SHAKING_M_PER_S * 2.0 * math.pi * hz
    rows = [
        {
            "name": "base_vibration",
            "acts_on": f"{axis}_force",
            "amplitude_m_per_s2": amplitude,
            "frequency_hz": hz,
            "phase_rad": 0.0,
        }
        for axis in ("macro", "micro")
    ]
    profile = limit.stage()
    value, remark = over_bars(profile, rows, seeds)
    used = list(seeds)
    yield judged(Bar(SHAKEN.format(hz=hz), "1", _TWICE if hz >= _FROM_HZ else None), value, used, remark)
    loop = linearise(profile, "dsmc", machine_body(limit.machine(profile))).closed()
    moved = sum(
        profile.axis(axis).mass_kg * amplitude * loop.response(np.array([hz]), f"{axis}_force_n", "end_position_m")[0]
        for axis in profile.axes
    )
    still_m = max(rms(one.error_m) for one in _runs(profile, "wrong", np.zeros(_HOLD_ROWS, SETPOINT), [], seeds))
    foretold_m = math.hypot(abs(moved) / math.sqrt(2.0), still_m)
    held_m = max(rms(one.error_m) for one in _runs(profile, "wrong", np.zeros(_HOLD_ROWS, SETPOINT), rows, seeds))
    said = f"{1e9 * held_m:.1f} nm, computed {1e9 * foretold_m:.1f} nm; {1e9 * still_m:.1f} nm without"
    yield judged(Bar(SHAKEN_HOLD.format(hz=hz), "1"), held_m / foretold_m, used, said)


# ---- coarse words, jitter ------------------------------------------------------------------------------------------


def surroundings(profile: Profile, sensor_noise_m: float) -> Surroundings:
    """Return what the end has to live with; no force but the motor's noise."""
    axis = profile.axis("micro")
    return Surroundings(
        mass_kg=axis.mass_kg,
        period_s=profile.cycle.period_s,
        delay_s=profile.cycle.actuation_delay_s + axis.current_loop_s,
        sensor_noise_m=sensor_noise_m,
        force_noise_n=_FORCE_NOISE_N,
        torque_step_n=axis.torque_step_n,
    )


def bound_m(profile: Profile, sensor_noise_m: float) -> float:
    """Return the least hold of any loop, m: of LQG without a margin, that withstands no other force."""
    return lqg.bound(surroundings(profile, sensor_noise_m)).true_rms_m


def as_stiff_m(profile: Profile, sensor_noise_m: float, observer: Callable[[np.ndarray], None] = at_rest) -> float:
    """Return the best hold at Ms 2.0 of a loop that is as stiff as the profile's, m."""
    around = surroundings(profile, sensor_noise_m)
    loop = linearise(profile, "dsmc", machine_body(limit.machine(profile)), observer=observer)
    return lqg.optimum(around, 2.0, step_peak_m(loop) / 0.1).true_rms_m


def _coarse(seeds: Sequence[int]) -> Iterator[Figure]:
    coarse = limit.with_tables(limit.stage(), micro={"rated_force_n": 180.0, "rated_current_a": 6.0})
    used = list(seeds)
    held_m = max(rms(one.error_m) for one in limit.runs(coarse, "calibrated", np.zeros(_HOLD_ROWS, SETPOINT), seeds))
    noise_m = coarse.interferometer.noise_m
    least_m, best_m = bound_m(coarse, noise_m), as_stiff_m(coarse, noise_m)
    yield judged(COARSE, held_m / least_m, used, f"the bound is {1e9 * least_m:.2f} nm")
    yield judged(COARSE_AS_STIFF, held_m / best_m, used, f"that optimum holds to {1e9 * best_m:.2f} nm")
    yield judged(COARSE_HOLD, 1e9 * held_m, used)
    yield judged(COARSE_PEAK, limit.peak_nm(limit.runs(coarse, "calibrated", limit.trapezoid(), seeds)), used)


def _jitter(seeds: Sequence[int]) -> Iterator[Figure]:
    """Judge by the bound for that much noise; beside it the optimum of a loop as stiff as this one at that speed."""
    used = list(seeds)
    for jitter_s in JITTERS_S:
        us = 1e6 * jitter_s
        profile = limit.with_tables(limit.stage(), interferometer={"jitter_s": jitter_s})
        noise_m = math.hypot(profile.interferometer.noise_m, _SPEED_M_PER_S * jitter_s)
        least_m, best_m = bound_m(profile, noise_m), as_stiff_m(profile, noise_m, at_speed(_SPEED_M_PER_S))
        told, untold = (
            limit.runs(one, "calibrated", limit.trapezoid(), seeds, jitter_s=jitter_s)
            for one in (profile, limit.stage())
        )
        all_m = [rms(one.error_m[_steady(one)]) for one in told]
        at_speed_m, untold_m = max(all_m), max(rms(one.error_m[_steady(one)]) for one in untold)
        said = (
            f"worst run {1e9 * at_speed_m:.1f} nm, mean of all {1e9 * sum(all_m) / len(all_m):.1f} nm; "
            f"the bound for so much noise of the sensor is {1e9 * least_m:.1f} nm"
        )
        yield judged(Bar(JITTER.format(us=us), "1", _OF_BOUND), at_speed_m / least_m, used, said)
        said = f"that optimum holds to {1e9 * best_m:.1f} nm"
        yield judged(Bar(JITTER_AS_STIFF.format(us=us), "1"), at_speed_m / best_m, used, said)
        yield judged(Bar(JITTER_UNTOLD.format(us=us), "1"), untold_m / least_m, used, f"{1e9 * untold_m:.1f} nm")
        yield judged(Bar(JITTER_PEAK.format(us=us), "nm"), limit.peak_nm(told), used)
        wrong_nm, ignorant_nm = (
            limit.peak_nm(limit.runs(one, "wrong", limit.trapezoid(), seeds, jitter_s=jitter_s))
            for one in (profile, limit.stage())
        )
        said = f"nobody told: {ignorant_nm:.0f} nm"
        yield judged(Bar(JITTER_WRONG.format(us=us), "nm"), wrong_nm, used, said)


def _steady(one: limit.Run) -> np.ndarray:
    speed = np.abs(one.setpoints["velocity_m_per_s"])
    return (speed >= (1.0 - 1e-9) * np.max(speed)) & (np.abs(one.setpoints["acceleration_m_per_s2"]) < 1e-6)
