"""The search for the joint's edges: how much further the next sweep reaches, and when it is not a wider one."""

import pytest

from stagectl import edge_search, touch_sweep
from stagectl.errors import RequestError
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
