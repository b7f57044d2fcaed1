"""The notch: its response by hand, and a mode that would ring without it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench import control_limit as limit
from stagectl import estimator, notch
from stagectl.errors import ProfileError, RequestError
from stagectl.linear_loop import GAP, linearise, machine_body
from stagectl.profile import load_profile, profile_from_effective
from stagectl.signals import SETPOINT
from stagectl.tuning import mode as modes
from stagectl.tuning.mode import Mode
from stagectl.tuning.rules import Asked, tuned
from tests.stage import rms, with_values

AT_200 = {"control__notch_frequency_hz": 200.0, "control__notch_damping_ratio": 0.3, "control__notch_depth_ratio": 0.1}


@pytest.fixture
def record(oled_profile):
    return estimator.init(with_values(oled_profile, **AT_200))[0]


def response(record, hz: float) -> complex:
    """Of what the record holds, at a frequency of a loop of 1 kHz."""
    z = np.exp(2j * math.pi * hz * 1e-3)
    new, old = record["notch_new"], record["notch_old"]
    return (new[0] + new[1] / z + new[2] / z**2) / (1.0 + old[0] / z + old[1] / z**2)


def test_it_is_deep_in_its_middle_and_nothing_far_off(record):
    assert abs(response(record, 200.0)) == pytest.approx(0.1, rel=1e-9)
    assert response(record, 1e-6) == pytest.approx(1.0, abs=1e-6)
    assert abs(response(record, 499.99)) == pytest.approx(1.0, abs=1e-3)
    # by hand at the crossover, from s = j tan: phase of (w^2 - v^2 + 2 j zeta w v), numerator less denominator
    w, v = math.tan(math.pi * 0.2), math.tan(math.pi * 0.048)
    phase = math.atan2(2 * 0.03 * w * v, w * w - v * v) - math.atan2(2 * 0.3 * w * v, w * w - v * v)
    assert np.angle(response(record, 48.0)) == pytest.approx(phase, rel=1e-9)


def test_what_it_lets_through_is_its_response(record):
    asked = np.sin(2.0 * math.pi * 200.0 * 1e-3 * np.arange(2000))
    out = np.array([notch.passed(record, float(value)) for value in asked])
    assert np.max(np.abs(out[1000:])) == pytest.approx(0.1, rel=0.05)


def test_without_one_nothing_is_changed(oled_profile):
    record = estimator.init(oled_profile)[0]
    assert record["has_notch"] == 0.0
    assert notch.passed(record, 3.25) == 3.25
    assert linearise(oled_profile, "dsmc", machine_body(limit.machine(oled_profile))).closed().is_stable()


def test_a_notch_at_half_the_rate_is_refused(oled_profile):
    wrong = oled_profile.effective() | {"control": oled_profile.control.model_dump() | {"notch_frequency_hz": 500.0}}
    with pytest.raises(ProfileError, match=r"notch_frequency_hz.*must be below half of cycle.rate_hz, 500 Hz"):
        profile_from_effective(wrong, "a run")


def test_a_mode_rings_without_its_notch_and_holds_with_it():
    """Against the motor at 120 Hz, -10 % and 1 %: on the linear loop at its corners, then on the machine.

    At rest the observer is too soft for it to ring: without its notch it is kept stiff there.
    """
    bare, mode = limit.stage(), Mode(120.0)
    body = machine_body(limit.machine(bare))
    assert math.isinf(modes.worst_sensitivity(linearise(bare, "dsmc", body), mode, 3))
    found = tuned(bare, "dsmc", Asked(max_sensitivity=2.5, mode=mode))
    profile = limit.stage(**found.values)
    loop = linearise(profile, "dsmc", body, GAP, profile.control.adaptive_gain_ceiling_ratio)
    assert modes.worst_sensitivity(loop, mode) <= 2.6
    one = limit.machine(profile)
    ringing = one.model_copy(update={"effects": (*one.effects, modes.effect(120.0, 0.1, 0.01))})
    held = {
        name: rms(limit.run(controlled, ringing, np.zeros(2000, SETPOINT), 1).error_m)
        for name, controlled in (("bare", limit.stage(rest_drift_ratio=1.0)), ("notched", profile))
    }
    assert held["notched"] < 10e-9
    assert held["bare"] > 100e-9


def test_the_mode_has_the_residue_that_it_is_given():
    """Of an axis alone: x / F beside a mass, fitted where the mode is, is -10 % of 1 / (m (w^2 - v^2 + ...))."""
    profile = limit.stage()
    bare = machine_body(limit.machine(profile))
    hz = np.array([150.0, 195.0, 205.0, 260.0])
    loop = linearise(profile, "dsmc", bare)
    with_mode = replace(loop, body=modes.with_effect(bare, modes.effect(200.0, 0.1, 0.01)))
    ratio = with_mode.loop_gain(hz) / loop.loop_gain(hz)
    v2 = (hz / 200.0) ** 2
    expected = 1.0 - 0.1 * -v2 / (1.0 - v2 + 2j * 0.01 * np.sqrt(v2))
    # the rigid body's own residue is that of the whole mass
    assert np.abs(ratio) == pytest.approx(np.abs(expected), rel=0.1)


def test_pid_has_no_notch():
    with pytest.raises(RequestError, match=r"pid has none; take --law dsmc"):
        tuned(load_profile("oled-printer"), "pid", Asked(mode=Mode(200.0)))
    with pytest.raises(RequestError, match=r"below half of cycle\.rate_hz"):
        tuned(load_profile("oled-printer"), "dsmc", Asked(mode=Mode(700.0)))
