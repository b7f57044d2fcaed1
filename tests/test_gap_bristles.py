"""Bristles along a motion that is measured: what they hold while a stage sticks, and what they keep it from doing."""

import numpy as np
import pytest

from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.gap import balance, plausibility
from stagectl.gap.believed import Believed, BelievedAxis
from stagectl.gap.log import Log
from stagectl.gap.quantities import along_motion, arguments_of, in_order
from stagectl.gap.recording import Recording

H, MASS = 1e-3, 40.0
SLIP_M, LEVEL_N = 1.2e-6, 6.0


def _believed(noise_m: float) -> Believed:
    return Believed("an axis", H, BelievedAxis(MASS, 0.2, noise_m, 0.0, force_constant_sd_ratio=0.005, latch_sd_s=5e-6))


def _recording(position_m: np.ndarray, command_n: np.ndarray, noise_m: float, seed: int = 1) -> Recording:
    read_m = position_m + noise_m * np.random.default_rng(seed).standard_normal(position_m.size)
    log = Log(f"run {seed}", H, read_m, command_n, np.ones(position_m.size, bool), "one")
    return balance.recording_of(log, _believed(noise_m))


@pytest.mark.parametrize(("noise_m", "loss"), [(2.4e-9, 0.8), (10e-9, 0.4)])
def test_bristles_hold_what_they_held_while_the_stage_sticks(noise_m, loss):
    """2 um aside, then at rest: what noise moves it to and fro there is no way that bristles of 1.2 um slip by."""
    t_s = H * np.arange(1000)
    way_m = 2e-6 * np.clip((t_s - 0.3) / 0.2, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip((t_s - 0.3) / 0.2, 0.0, 1.0))
    held = 1.0 - np.exp(-2e-6 / SLIP_M)  # of the level: x' (1 - z) / D from z = 0 on
    recording = _recording(way_m, 5.0 * np.sin(20.0 * t_s), noise_m)  # that no believed force makes it move so
    effect = CATALOGUE["dahl_friction"]
    arguments = arguments_of(recording, "macro", "macro_force", effect)
    values = {"level_n": LEVEL_N, "slip_m": SLIP_M}
    force_n = along_motion(effect, arguments, in_order(effect, values)).mean(axis=1)
    assert recording.macro.slow[550:950].all()
    share = -force_n / LEVEL_N
    assert share[550] == pytest.approx(held, rel=0.1)
    assert share[950] > loss * held
    arguments[effect.quantities.index("velocity_m_per_s")] = recording.macro.velocity_m_per_s
    assert -along_motion(effect, arguments, in_order(effect, values))[950].mean() / LEVEL_N < 0.6 * loss * held


@pytest.mark.parametrize(
    ("slow_n", "fast_n", "most_factor"),
    [((5.0, 5.0), (3.0, 40.0), 0.2), ((7.0, 3.0), (0.0, 17.0), 0.3)],
    ids=["that says nothing of units", "that says too little for units"],
)
def test_a_recording_that_bristles_hold_is_not_taken_for_one_in_other_units(slow_n, fast_n, most_factor):
    """A motor of 7 N, at so many hertz, held by bristles of 6 N: of what it could do it does a fraction."""
    count, steps, random = 6000, 10, np.random.default_rng(3)
    x, v, z, way_m = 0.0, 0.0, 0.0, np.zeros(count)
    noise_n = 2.0 if fast_n[0] else 1.0
    command_n = random.normal(0.0, noise_n, count)
    for force_n, hz in (slow_n, fast_n):
        command_n += force_n * np.sin(2.0 * np.pi * hz * H * np.arange(count))
    for k in range(count):
        way_m[k] = x
        for _ in range(steps):
            z += H / steps * (v - abs(v) * z) / SLIP_M
            v += H / steps * (command_n[k] - LEVEL_N * z - 30.0 * v) / MASS
            x += H / steps * v
    recording = _recording(way_m, command_n, 2.4e-9)
    one = plausibility._balance(recording, "macro")
    assert one.accelerating
    assert one.factor < most_factor
    plausibility._check_one(recording.believed, one)


def test_iron_that_saturates_is_a_missing_effect_and_no_other_machine():
    """A motor asked for 400 N that gives 107 N does four tenths of what it could; a body of twice the mass, half."""
    phase = np.sin(2.0 * np.pi * 4.0 * H * np.arange(6000))
    asked_n = 400.0 * np.sign(phase) * np.sqrt(np.abs(phase)) + np.random.default_rng(3).normal(0.0, 2.0, phase.size)
    held_n = np.clip(asked_n, -160.0, 160.0)
    saturated = _recording(_pushed_m(held_n * (1.0 - (held_n / 160.0) ** 2 / 3.0), MASS), asked_n, 2.4e-9)
    one = plausibility._balance(saturated, "macro")
    assert one.factor == 1.0
    assert one.explained_ratio > 0.99
    plausibility.check_recordings(saturated.believed, [saturated])
    heavier = _recording(_pushed_m(asked_n, 2.0 * MASS), asked_n, 2.4e-9)
    with pytest.raises(RequestError, match="profile of another machine"):
        plausibility.check_recordings(heavier.believed, [heavier])


def _pushed_m(force_n: np.ndarray, mass_kg: float) -> np.ndarray:
    """Return where a body with viscous friction is at samples whose forces are held."""
    x, v, way_m, steps = 0.0, 0.0, np.zeros(force_n.size), 10
    for k, push_n in enumerate(force_n):
        way_m[k] = x
        for _ in range(steps):
            v += H / steps * (push_n - 30.0 * v) / mass_kg
            x += H / steps * v
    return way_m
