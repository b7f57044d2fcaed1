"""The search for the joint's edges: how much further the next sweep reaches, and when it is not a wider one."""

import math

import numpy as np
import pytest

from stagectl import edge_search, touch_sweep
from stagectl.errors import RequestError
from stagectl.outcome import BacklashEstimate
from stagectl.row import new_rows
from stagectl.touch_sweep import TOUCH_SHARE


def test_a_wider_sweep_presses_an_edge_that_was_just_missed_no_deeper_than_any(oled_profile):
    """By hand: 0.6 * 4 N / 13.2 kN/m = 181.8 um are pressed; 2/3 of them further, or what an answer leaves of them."""
    joint = touch_sweep.joint_of(oled_profile)
    press_m = 0.6 * 4.0 / 13.2e3
    assert joint.press_m(TOUCH_SHARE) == pytest.approx(press_m)
    for pressed_n, further_m in ((0.0, press_m / 1.5), (0.4, press_m / 1.5), (1.2, press_m / 2), (1.8, press_m / 4)):
        width_m = edge_search.wider_m(oled_profile, joint, "left", pressed_n)
        assert width_m == pytest.approx(201.4e-6 + further_m)
        assert pressed_n / 13.2e3 + further_m <= press_m * 1.0000001
        both_m = edge_search.wider_m(oled_profile, joint, None, pressed_n)
        assert both_m == pytest.approx(201.4e-6 + 2.0 * further_m)
    with pytest.raises(RequestError, match=r"what answered there with 2\.3 N could not be identified"):
        edge_search.wider_m(oled_profile, joint, "left", 2.3)


@pytest.mark.parametrize(("met", "most_m"), [("right", 944.2e-6 + 176e-6), ("left", 944.2e-6 + 25.4e-6), (None, 0.0)])
def test_a_wider_sweep_stays_within_the_stroke(met, most_m, oled_profile):
    """Of +-1 mm, 0.95 may be used. From a known edge the gap and the press lie on one side of it."""
    joint = touch_sweep.joint_of(oled_profile)
    widths_m = [joint.left_m + joint.right_m]

    def swept_wider():
        while len(widths_m) < 20:
            wide = joint._replace(left_m=0.5 * widths_m[-1] - 75.3e-6, right_m=0.5 * widths_m[-1] + 75.3e-6)
            widths_m.append(edge_search.wider_m(oled_profile, wide, met, 0.0))

    with pytest.raises(RequestError, match=r"might leave micro\.stroke_m"):
        swept_wider()
    press_m = joint.press_m(TOUCH_SHARE)
    if met is None:  # it may lie off by as much as it swings
        assert 0.5 * widths_m[-1] + press_m < 0.5 * 0.95e-3
        assert len(widths_m) == 2
    else:
        assert most_m - press_m / 1.5 < widths_m[-1] + press_m < most_m + 6e-6


# ---- what a sweep is followed by ----


def met(side, edge_m, sd_m=0.5e-6):
    """What an identification has that met one edge, or none."""
    values = {name: 0.0 for name in BacklashEstimate.__dataclass_fields__}
    values |= {name: math.inf for name in values if "_sd" in name}
    if side:
        values |= {f"{side}_m": edge_m, f"{side}_sd_m": sd_m}
    return BacklashEstimate(**values)


def swept(missing_count=0):
    """The rows of a sweep in which nothing answered; samples are missing in a row from the 100th on."""
    rows = new_rows(2000)
    rows["cycle"], rows["samples_new"] = np.arange(2000), 1
    rows["contact_force_estimate_n"] = rows["micro_disturbance_n"] = 0.0
    rows["samples_new"][100 : 100 + missing_count] = 0
    return rows


@pytest.mark.parametrize("side", ["left", "right"])
def test_an_edge_that_is_met_anchors_the_gap_and_met_again_the_gap_is_wider(side, oled_profile):
    joint = touch_sweep.joint_of(oled_profile)
    search = edge_search.init(oled_profile, joint)
    width_m = joint.left_m + joint.right_m
    assert edge_search.step(search, joint, met(side, 90e-6), swept()) == (width_m, side, 90e-6)
    gap = edge_search.step(search, joint, met(side, 91e-6), swept())
    assert gap == (pytest.approx(width_m + joint.press_m(TOUCH_SHARE) / 1.5), side, 91e-6)
    assert search.wider_count == 1


def test_an_edge_that_is_not_sure_centres_the_next_sweep_and_makes_no_gap_wider(oled_profile):
    joint = touch_sweep.joint_of(oled_profile)
    search = edge_search.init(oled_profile, joint)
    assert edge_search.step(search, joint, met("right", 80e-6), swept()).edge_m == 80e-6
    for _ in range(2):
        gap = edge_search.step(search, joint, met("right", 90e-6, sd_m=19e-6), swept())
        assert gap == (joint.left_m + joint.right_m, "right", 90e-6)
    with pytest.raises(RequestError, match="4 of them met one edge at another place, or missed cycles"):
        edge_search.step(search, joint, met("right", 90e-6, sd_m=19e-6), swept())
    assert search.wider_count == 0


def test_a_sweep_that_the_host_spoilt_is_swept_again_also_where_one_edge_is_known(oled_profile):
    joint = touch_sweep.joint_of(oled_profile)
    search = edge_search.init(oled_profile, joint)
    assert edge_search.step(search, joint, met("left", 30e-6), swept()) is not None
    assert edge_search.step(search, joint, met("left", 30e-6), swept(missing_count=10)) is None
    assert search.wider_count == 0
    assert edge_search.step(search, joint, met("left", 30e-6), swept(missing_count=9)).width_m > 250e-6


def test_a_gap_is_looked_for_no_narrower_than_it_was_found_before(oled_profile):
    own = touch_sweep.joint_of(oled_profile)
    search = edge_search.init(oled_profile, own._replace(right_m=400e-6))
    assert edge_search.step(search, own, met("left", 30e-6), swept()).width_m == own.left_m + 400e-6
