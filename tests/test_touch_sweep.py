"""The sweep over both edges: amplitude and speed from the joint, and what comes of it on a wide and damped gap."""

import math

import pytest

from bench import identifying
from sim_backend.machine import load_machine
from stagectl import touch_sweep
from stagectl.errors import RequestError
from stagectl.profile import load_profile
from stagectl.touch_sweep import IDENTIFY_HZ, IDENTIFY_SHARE, TOUCH_HZ, TOUCH_S, TOUCH_SHARE, Joint

KANG = Joint(7.5e-3, 7.5e-3, 1e3, 1e3, 300.0, 4.0)
OLED = Joint(25.4e-6, 176e-6, 13.2e3, 9.87e3, 75.0, 4.0)
TICK_S = 60e-6


def greatest_force_n(joint: Joint, sweep: touch_sweep.TouchSweep, stiffness_n_per_m: float) -> float:
    """Return the most that k p + c p' comes to over a swing in the steady state, by a fine table."""
    half_m = 0.5 * (joint.left_m + joint.right_m)
    greatest_n = 0.0
    for k in range(100_000):
        phase = 2.0 * math.pi * k / 100_000
        overlap_m = sweep.amplitude_m * math.sin(phase) - half_m
        rate = sweep.amplitude_m * 2.0 * math.pi * sweep.frequency_hz * math.cos(phase)
        if overlap_m > 0.0:
            greatest_n = max(greatest_n, stiffness_n_per_m * overlap_m + joint.damping_n_s_per_m * rate)
    return greatest_n


def pressed_s(joint: Joint, sweep: touch_sweep.TouchSweep) -> float:
    """Return how long a swing in the steady state stays on one side, by a fine table."""
    half_m = 0.5 * (joint.left_m + joint.right_m)
    pressed_count = sum(sweep.amplitude_m * math.sin(2.0 * math.pi * k / 100_000) > half_m for k in range(100_000))
    return pressed_count / 100_000 / sweep.frequency_hz


@pytest.mark.parametrize("share", [TOUCH_SHARE, IDENTIFY_SHARE])
def test_a_damped_joint_is_pressed_with_the_touch_force_and_no_more(share):
    sweep = touch_sweep.plan(KANG, share, IDENTIFY_HZ, 20.0)
    assert sweep.amplitude_m == pytest.approx(7.5e-3 + share * 4e-3)
    assert greatest_force_n(KANG, sweep, 1e3) == pytest.approx(4.0, rel=1e-6)


def test_numbers_of_the_wide_gap_by_hand():
    """(7.5 + 4) / (7.5 + 3.2) = 1.07477; its square less 1 has the root 0.39387; times k / c = 1 / 0.3 s: 0.209 Hz."""
    sweep = touch_sweep.plan(KANG, IDENTIFY_SHARE, IDENTIFY_HZ, 8.0)
    assert sweep.frequency_hz == pytest.approx(0.39387 / 0.3 / (2.0 * math.pi), rel=1e-4)
    assert sweep.duration_s == pytest.approx(5.0 / sweep.frequency_hz)
    assert touch_sweep.plan(KANG, IDENTIFY_SHARE, IDENTIFY_HZ, 60.0).duration_s == 60.0


def test_a_narrow_gap_is_swept_as_fast_as_ever():
    """oled-printer could be swept at 12 Hz; the usual speeds are left alone, and its sides differ."""
    touch = touch_sweep.plan(OLED, TOUCH_SHARE, TOUCH_HZ, TOUCH_S)
    assert touch == (pytest.approx(100.7e-6 + 0.6 * 4.0 / 13.2e3), TOUCH_HZ, TOUCH_S)
    assert touch_sweep.plan(OLED, IDENTIFY_SHARE, IDENTIFY_HZ, 20.0)[1:] == (1.0, 20.0)
    fast = touch_sweep.plan(OLED, IDENTIFY_SHARE, 1e3, 1.0)
    assert fast.frequency_hz > 10.0
    assert max(greatest_force_n(OLED, fast, k) for k in OLED[2:4]) == pytest.approx(4.0, rel=1e-4)


def test_a_joint_without_damping_sets_no_speed():
    assert touch_sweep.plan(KANG._replace(damping_n_s_per_m=0.0), TOUCH_SHARE, TOUCH_HZ, TOUCH_S)[1:] == (0.7, 6.0)


def test_a_speed_beyond_the_usual_is_refused_where_nobody_says_how_the_joint_is_damped():
    unknown = KANG._replace(damping_n_s_per_m=0.0)
    with pytest.raises(RequestError, match=r"frequency_hz = 5: .*at most 1 Hz, or give the effect contact_damping"):
        touch_sweep.plan(unknown, IDENTIFY_SHARE, IDENTIFY_HZ, 20.0, 5.0)
    assert touch_sweep.plan(unknown, IDENTIFY_SHARE, IDENTIFY_HZ, 20.0, 1.0).frequency_hz == 1.0


def test_a_speed_that_presses_too_hard_is_refused_with_the_one_that_does_not():
    with pytest.raises(
        RequestError, match=r"frequency_hz = 1: .*15 mm.*touch_force_n = 4 N; ask for at most 0\.208 Hz"
    ):
        touch_sweep.plan(KANG, IDENTIFY_SHARE, IDENTIFY_HZ, 20.0, 1.0)
    assert touch_sweep.plan(KANG, IDENTIFY_SHARE, IDENTIFY_HZ, 20.0, 0.208).frequency_hz == 0.208


@pytest.mark.parametrize("damping", [[], [120.0], [120.0, 30.0]])
def test_damping_is_that_of_all_contact_effects(damping):
    effects = [{"name": "contact_damping", "acts_on": "contact", "damping_n_s_per_m": value} for value in damping]
    effects.append({"name": "viscous_friction", "acts_on": "macro_force", "damping_n_s_per_m": 5.0})
    assert touch_sweep.contact_damping_n_s_per_m(effects) == sum(damping)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_wide_gap_is_identified_within_two_per_cent(seed, tmp_path):
    """Over the wire in batch; force constant and mass are 1 % wrong, which alone makes 1.5 % of stiffness."""
    profile, machine = load_profile("kang-2023"), load_machine("kang-2023")
    found = identifying.identify(profile, machine, seed, None, 20.0, tmp_path / "run", TICK_S)
    assert found.stiffness_share < 0.02
    assert found.width_share < 0.02


@pytest.mark.parametrize("share", [TOUCH_SHARE, IDENTIFY_SHARE])
def test_a_slow_filter_is_given_time_on_each_side(share):
    """A side counts once the joint has been pressed there for as long as the filter remembers, and it lags as well."""
    slow = OLED._replace(hold_s=0.56)
    sweep = touch_sweep.plan(slow, share, IDENTIFY_HZ, TOUCH_S)
    assert pressed_s(slow, sweep) == pytest.approx(2.25 * 0.56, rel=1e-3)
    assert sweep.duration_s * sweep.frequency_hz == pytest.approx(5.0)
    assert touch_sweep.plan(OLED._replace(hold_s=0.105), share, IDENTIFY_HZ, TOUCH_S).frequency_hz == IDENTIFY_HZ
