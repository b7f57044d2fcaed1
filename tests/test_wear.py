"""Wear: what contact shows is published, what nothing confirms gets less sure, only the sure and steady is believed."""

import math
import re
from dataclasses import replace

import pytest

from stagectl.outcome import BacklashEstimate
from stagectl.wear import IDENTIFIED, LOOKS_COUNT, PROBE, Look, WearLimits, WearTracker, alarm, width_sd_m

LIMITS = WearLimits(
    width_m=480e-6,
    stiffness_n_per_m=(13e3, 13e3),
    width_change_limit_m=20e-6,
    stiffness_change_limit_ratio=0.3,
    trusted_sd_m=0.5e-6,
    drift_m_per_sqrt_s=1e-9,
)
GOOD = BacklashEstimate(240e-6, 242e-6, 0.1e-6, 0.1e-6, 13e3, 13.1e3, 50.0, 50.0)


def looked(tracker, *estimates, from_s=100.0):
    for i, one in enumerate(estimates):
        tracker.touched(from_s + i, left=True, right=True)
        tracker.look(one, from_s + i)
    return tracker


def test_without_contact_lately_nothing_is_published():
    tracker = WearTracker(LIMITS)
    assert not tracker.look(GOOD, 100.0)
    tracker.touched(100.0, left=True, right=False)
    assert not tracker.look(GOOD, 101.0)
    tracker.touched(102.0, left=False, right=True)
    assert tracker.look(GOOD, 103.0)
    assert tracker.newest == Look(103.0, GOOD, "production")
    assert tracker.observable(109.0)
    assert not tracker.observable(111.0)
    assert not tracker.look(replace(GOOD, left_m=300e-6), 111.0)
    assert tracker.newest.estimate == GOOD


def test_a_probe_and_an_identification_need_no_other_contact():
    tracker = WearTracker(LIMITS)
    for source in (PROBE, IDENTIFIED):
        assert tracker.look(GOOD, 5.0, source)
        assert tracker.newest.source == source


@pytest.mark.parametrize("source", [PROBE, IDENTIFIED])
def test_what_was_measured_stands_until_production_touches_both_edges_after_it(source):
    tracker, later = WearTracker(LIMITS), replace(GOOD, left_m=300e-6)
    tracker.touched(100.0, left=True, right=True)  # what measured it
    assert tracker.look(GOOD, 100.0, source)
    for t_s in (100.5, 102.0):
        assert not tracker.look(later, t_s)
        assert tracker.newest == Look(100.0, GOOD, source)
    assert tracker.observable(109.0)
    assert not tracker.observable(111.0)
    tracker.touched(112.0, left=True, right=False)
    assert not tracker.look(later, 112.0)
    tracker.touched(113.0, left=False, right=True)
    assert tracker.look(later, 113.0)
    assert tracker.newest == Look(113.0, later, "production")


@pytest.mark.parametrize("change", [{"left_sd_m": math.inf}, {"left_m": math.nan}, {"left_m": -1e-3}])
def test_what_says_nothing_is_not_published(change):
    tracker = looked(WearTracker(LIMITS), GOOD)
    assert not looked(tracker, replace(GOOD, **change), from_s=200.0).newest.t_s > 100.0


def test_a_value_that_nothing_confirms_gets_less_sure():
    tracker = looked(WearTracker(LIMITS), GOOD)
    fresh = width_sd_m(GOOD)
    assert tracker.sd_m(100.0) == pytest.approx(fresh)
    assert tracker.sd_m(100.0 + 86400.0) == pytest.approx(math.hypot(fresh, 1e-9 * math.sqrt(2.0 * 86400.0)))
    walk = replace(LIMITS, stiffness_drift_ratio_per_sqrt_s=1e-5)
    stiff = WearTracker(walk, Look(100.0, GOOD, IDENTIFIED)).stiffness_sds_n_per_m(100.0 + 86400.0)
    walked = 1e-5 * math.sqrt(86400.0)
    assert stiff == pytest.approx(
        (
            math.hypot(GOOD.left_stiffness_sd_n_per_m, walked * GOOD.left_stiffness_n_per_m),
            math.hypot(GOOD.right_stiffness_sd_n_per_m, walked * GOOD.right_stiffness_n_per_m),
        )
    )
    sds = [tracker.sd_m(100.0 + 10.0**k) for k in range(8)]
    assert sds == sorted(sds)
    assert WearTracker(LIMITS).sd_m(0.0) == math.inf


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"left_m": 260e-6, "right_m": 241e-6},
            "the gap is 501 um wide, .21 um from the profile's; the limit is 20 um",
        ),
        ({"left_m": 220e-6, "right_m": 239e-6}, r"459 um wide, -21 um"),
        ({"left_stiffness_n_per_m": 9e3}, r"the left contact has 9000 N/m, -31% from the profile's; the limit is 30%"),
        ({"right_stiffness_n_per_m": 18e3}, r"the right contact has 1.8e\+04 N/m, \+38%"),
        ({"left_m": math.nan}, "the gap is nan"),
    ],
)
def test_wear_beyond_a_limit_is_an_alarm_with_value_and_limit(change, said):
    worn = replace(GOOD, **change)
    assert re.search(said, alarm(worn, LIMITS))
    assert alarm(worn, LIMITS).endswith("look at the joint, then identify")
    assert looked(WearTracker(LIMITS), *[worn] * LOOKS_COUNT).believable() is None
    assert alarm(GOOD, LIMITS) == ""


def test_an_alarm_stays_until_a_value_is_well_within_the_limit():
    tracker = WearTracker(LIMITS)
    rung = []
    for change_m in (19e-6, 21e-6, 19e-6, 17e-6, 21e-6, 15e-6, 19e-6):
        looked(tracker, replace(GOOD, left_m=GOOD.left_m - GOOD.width_m + LIMITS.width_m + change_m))
        rung.append(bool(tracker.alarm))
    assert rung == [False, True, True, True, True, False, False]


def test_only_what_is_steady_is_believed_and_it_is_the_median():
    steady = [replace(GOOD, left_m=240e-6 + 1e-8 * (i % 3)) for i in range(LOOKS_COUNT)]
    tracker = looked(WearTracker(LIMITS), *steady[:-1])
    assert tracker.believable() is None
    found = looked(tracker, steady[-1], from_s=120.0).believable()
    assert found.left_m == pytest.approx(240e-6 + 1e-8)
    assert found.right_m == 242e-6
    tracker.taken()
    assert tracker.believable() is None


@pytest.mark.parametrize("source", [PROBE, IDENTIFIED])
def test_what_was_measured_is_believed_by_itself_until_it_is_taken(source):
    before = replace(GOOD, left_m=241e-6)
    tracker = looked(WearTracker(LIMITS), *[before] * LOOKS_COUNT)
    assert tracker.look(GOOD, 120.0, source)
    assert not tracker.look(before, 130.0)  # production has nothing newer
    assert tracker.believable() == GOOD
    tracker.taken()
    assert tracker.believable() is None
    assert tracker.look(GOOD, 140.0, source)
    looked(tracker, *[before] * (LOOKS_COUNT - 1), from_s=150.0)
    assert tracker.believable() is None  # production speaks again, and must be steady
    assert looked(tracker, before, from_s=170.0).believable() == before


@pytest.mark.parametrize(
    "change", [{"left_sd_m": 0.6e-6}, {"left_m": 260e-6}, {"left_stiffness_n_per_m": 9e3}], ids=str
)
def test_what_was_measured_is_believed_only_where_it_is_sure_and_within_the_limits(change):
    tracker = WearTracker(LIMITS)
    assert tracker.look(replace(GOOD, **change), 100.0, PROBE)
    assert tracker.believable() is None


@pytest.mark.parametrize(
    "odd",
    [{"left_sd_m": 0.6e-6}, {"left_m": 240.5e-6}, {"right_m": 241.5e-6}, {"left_m": 400e-6}],
    ids=["not sure", "left moves", "right moves", "far off"],
)
def test_one_odd_look_among_them_keeps_it_from_being_believed(odd):
    looks = [GOOD] * (LOOKS_COUNT - 1)
    looks.insert(4, replace(GOOD, **odd))
    assert looked(WearTracker(LIMITS), *looks).believable() is None
    assert looked(WearTracker(LIMITS), *[GOOD] * LOOKS_COUNT).believable() is not None


def test_a_pause_begins_the_looks_anew():
    tracker = looked(WearTracker(LIMITS), *[GOOD] * (LOOKS_COUNT - 1))
    assert not tracker.look(GOOD, 500.0)
    assert looked(tracker, GOOD, from_s=501.0).believable() is None
