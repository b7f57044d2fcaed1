"""Wear: what contact shows is published, what nothing confirms gets less sure, only the sure and steady is believed."""

import math
import re
from dataclasses import replace

import pytest

from stagectl.outcome import BacklashEstimate
from stagectl.wear import IDENTIFIED, LOOKS_COUNT, PROBE, Look, WearLimits, WearTracker, alarm, width_sd_m

LIMITS = WearLimits(
    left_m=240e-6,
    right_m=240e-6,
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


def drifted(by_m, **changes):
    """The good joint after the end's laser drifted: both edges went one way, the width is as it was."""
    return replace(GOOD, left_m=GOOD.left_m - by_m, right_m=GOOD.right_m + by_m, **changes)


def test_edges_that_wandered_off_are_an_alarm_and_never_believed():
    """The width alone was bounded: 1.2 and -0.2 mm were believed for 0.5 and 0.5 mm."""
    limits = replace(LIMITS, left_m=0.5e-3, right_m=0.5e-3)
    tracker = looked(WearTracker(limits), *[replace(GOOD, left_m=1.2e-3, right_m=-0.2e-3)] * LOOKS_COUNT)
    assert tracker.believable() is None
    assert tracker.alarm == (
        "the gap's middle is at -700 um, -700 um from the profile's; the limit is 10 um; "
        "look at the end's interferometer, then home"
    )


@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_a_slow_drift_of_the_end_s_laser_is_believed_up_to_the_limit_of_the_middle_only(way):
    tracker = WearTracker(LIMITS)
    believed_m, rung_m = [], []
    for step in range(40):
        drift_m = way * step * 0.5e-6
        found = looked(tracker, *[drifted(drift_m)] * LOOKS_COUNT, from_s=100.0 + 20.0 * step).believable()
        if found is not None:
            believed_m.append(found.centre_m - LIMITS.centre_m)
            tracker.taken()
        if tracker.alarm:
            rung_m.append(drifted(drift_m).centre_m - LIMITS.centre_m)
    assert max(map(abs, believed_m)) == pytest.approx(LIMITS.centre_change_limit_m, abs=0.51e-6)
    assert max(map(abs, believed_m)) <= LIMITS.centre_change_limit_m
    assert LIMITS.centre_change_limit_m < min(map(abs, rung_m)) < LIMITS.centre_change_limit_m + 1.1e-6


@pytest.mark.parametrize("source", ["production", PROBE])
def test_no_edge_at_or_beyond_zero_is_believed_whatever_the_limits(source):
    limits = replace(LIMITS, left_m=5e-6, right_m=475e-6)
    for left_m, is_believed in ((1e-6, True), (0.0, False), (-1e-6, False)):
        tracker, found = WearTracker(limits), replace(GOOD, left_m=left_m, right_m=475e-6)
        if source == PROBE:
            tracker.look(found, 100.0, source)
        else:
            looked(tracker, *[found] * LOOKS_COUNT)
        assert (tracker.believable() is not None) == is_believed
        assert tracker.alarm == ""


@pytest.mark.parametrize(
    ("change", "sds"),
    [
        ({"left_m": 259e-6}, {"left_sd_m": 0.6e-6}),
        ({"left_m": 229e-6, "right_m": 251e-6}, {"right_sd_m": 1.1e-6}),
        ({"left_stiffness_n_per_m": 8.9e3}, {"left_stiffness_sd_n_per_m": 120.0}),
    ],
    ids=["width", "middle", "stiffness"],
)
def test_an_alarm_rings_where_the_excess_is_sure_and_nothing_beyond_is_believed_before(change, sds):
    sure, unsure = replace(GOOD, **change), replace(GOOD, **change, **sds)
    assert alarm(sure, LIMITS) != ""
    assert alarm(unsure, LIMITS) == ""
    tracker = WearTracker(replace(LIMITS, trusted_sd_m=5e-6))
    assert tracker.look(unsure, 100.0, PROBE)
    assert (tracker.alarm, tracker.believable()) == ("", None)


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
    "change",
    [
        {"left_sd_m": 0.6e-6},
        {"left_m": 260e-6},
        {"left_stiffness_n_per_m": 9e3},
        {"left_stiffness_sd_n_per_m": 1.9e3},
        {"right_stiffness_sd_n_per_m": 1.9e3},
    ],
    ids=str,
)
def test_what_was_measured_is_believed_only_where_it_is_sure_and_within_the_limits(change):
    tracker = WearTracker(LIMITS)
    assert tracker.look(replace(GOOD, **change), 100.0, PROBE)
    assert tracker.believable() is None


@pytest.mark.parametrize(
    "odd",
    [
        {"left_sd_m": 0.6e-6},
        {"left_m": 240.5e-6},
        {"right_m": 241.5e-6},
        {"left_m": 400e-6},
        {"left_m": 240.5e-6, "left_stiffness_n_per_m": 13.3e3},
        {"right_stiffness_n_per_m": 13.4e3},
    ],
    ids=["not sure", "left moves", "right moves", "far off", "left and its stiffness", "right stiffness"],
)
def test_one_odd_look_among_them_keeps_it_from_being_believed(odd):
    looks = [GOOD] * (LOOKS_COUNT - 1)
    looks.insert(4, replace(GOOD, **odd))
    assert looked(WearTracker(LIMITS), *looks).believable() is None
    assert looked(WearTracker(LIMITS), *[GOOD] * LOOKS_COUNT).believable() is not None


def test_stiffness_that_is_not_sure_is_not_believed():
    """It was, at 12.8e3 +- 1.9e3 N/m."""
    for sd_n_per_m, is_believed in ((1.9e3, False), (400.0, False), (380.0, True)):
        for side in ("left", "right"):
            one = replace(GOOD, **{f"{side}_stiffness_sd_n_per_m": sd_n_per_m})
            assert (looked(WearTracker(LIMITS), *[one] * LOOKS_COUNT).believable() is not None) == is_believed


SURE = replace(GOOD, left_sd_m=0.05e-6, right_sd_m=0.05e-6)
UNSURE_SDS = {"left_sd_m": 42e-6, "right_sd_m": 42e-6}  # of the width 60 um


def said(change, from_s=101.0):
    """What is published after an identification, and a second of production that shows it with a change."""
    tracker = WearTracker(LIMITS)
    assert tracker.look(SURE, 100.0, IDENTIFIED)
    looked(tracker, replace(SURE, **change), from_s=from_s)
    return tracker


def test_what_is_sure_is_not_replaced_by_what_is_less_sure_and_agrees():
    tracker = said({"left_m": 300e-6, **UNSURE_SDS})
    assert tracker.newest == Look(100.0, SURE, IDENTIFIED)
    assert tracker.alarm == ""
    assert tracker.believable() == SURE  # what was measured waits on
    assert tracker.observable(110.0)


@pytest.mark.parametrize(
    "change",
    [
        {"left_sd_m": 0.04e-6},  # surer
        {"left_m": 440e-6, **UNSURE_SDS},  # 200 um wider
        {"left_m": 241e-6, "right_m": 241e-6, "left_sd_m": 0.1e-6},  # as wide, elsewhere
    ],
    ids=str,
)
def test_production_replaces_what_stands_where_it_is_as_sure_or_differs_for_sure(change):
    assert said(change).newest == Look(101.0, replace(SURE, **change), "production")


def test_what_stands_grows_less_sure_until_production_is_as_sure():
    by_then_s = 100.0 + ((0.1**2 - 0.05**2) / 0.001**2)  # each edge walks to 0.1 um
    change = {"left_sd_m": 0.1e-6, "right_sd_m": 0.1e-6}
    assert said(change, by_then_s - 10.0).newest.source == IDENTIFIED
    assert said(change, by_then_s + 10.0).newest.source == "production"


def test_each_stiffness_is_replaced_only_by_one_that_is_as_sure_or_differs_for_sure():
    edges = {"left_m": 240.01e-6, "left_sd_m": 0.04e-6}
    softer = {"left_stiffness_n_per_m": 12.5e3, "left_stiffness_sd_n_per_m": 400.0}
    assert said({**edges, **softer}).newest.estimate == replace(SURE, **edges)
    softer["left_stiffness_n_per_m"] = 11e3  # by 5 joint standard deviations
    assert said({**edges, **softer}).newest.estimate == replace(SURE, **edges, **softer)
    walked = dict.fromkeys(("left_sd_m", "right_sd_m"), math.hypot(0.05e-6, 1e-9))  # in the second since
    assert said({"left_m": 300e-6, **UNSURE_SDS, **softer}).newest.estimate == replace(SURE, **walked, **softer)


def test_production_that_confirms_surely_enough_tells_when_the_joint_was_known_last():
    assert said({"left_sd_m": 0.2e-6}).known_s == 101.0
    assert said({"left_sd_m": 0.6e-6}).known_s == 100.0
    assert said({"left_sd_m": 0.04e-6}).known_s == 101.0


def test_a_pause_begins_the_looks_anew():
    tracker = looked(WearTracker(LIMITS), *[GOOD] * (LOOKS_COUNT - 1))
    assert not tracker.look(GOOD, 500.0)
    assert looked(tracker, GOOD, from_s=501.0).believable() is None
