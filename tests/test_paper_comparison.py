"""Section 6.2: two stages that differ in one thing, under the same PID."""

import numpy as np
import pytest

from stagectl.paper import comparison_chapter, twin
from stagectl.paper.comparison_chapter import SOFT, STIFF, gap_m
from stagectl.paper.twin import Strengths


@pytest.fixture(scope="module")
def paths():
    return comparison_chapter.paths()


def peak_m(reference, servo, strengths: Strengths) -> float:
    return float(np.max(np.abs(gap_m(twin.follow(reference, servo, strengths), twin.follow(reference, servo)))))


def test_stages_without_a_difference_do_the_same(paths):
    assert peak_m(paths["trapezoid"][0], SOFT, Strengths()) == 0.0


def test_a_lag_of_the_recording_is_a_gap_of_speed_times_lag(paths):
    for kind, speed_m_per_s in (("sine", 0.075), ("trapezoid", 0.1)):
        gap = peak_m(paths[kind][1], STIFF, Strengths(record_lag_s=1e-4))
        assert gap == pytest.approx(speed_m_per_s * 1e-4, rel=0.01)


def test_the_soft_servos_touch_the_joint_and_the_stiff_ones_dont(paths):
    soft, stiff = (twin.follow(paths["trapezoid"][1], servo) for servo in (SOFT, STIFF))
    assert 0.1 < np.mean(soft.contact_n != 0.0) < 0.6
    assert np.all(stiff.contact_n == 0.0)
    assert np.max(np.abs(stiff.end_m - stiff.reference.position_m)) < 5e-6


def test_what_acts_in_contact_alone_hides_from_stiff_servos(paths):
    damped = Strengths(contact_damping_n_s_per_m=300.0)
    assert peak_m(paths["trapezoid"][1], STIFF, damped) == 0.0
    assert peak_m(paths["trapezoid"][1], SOFT, damped) > 1e-6


def test_a_missing_reaction_shows_where_the_acceleration_changes(paths):
    reference = paths["trapezoid"][1]
    believed = twin.follow(reference, SOFT)
    gap = np.abs(gap_m(believed, twin.follow(reference, SOFT, Strengths(reaction_ratio=0.0))))
    assert 3e-6 < np.max(gap) < 30e-6
    before = reference.t_s < 1.0
    assert np.max(gap[before]) < 0.01 * np.max(gap)


def test_a_different_strength_reaches_the_plant():
    tables = {row["name"]: row for row in Strengths(coulomb_n=5.0, reaction_ratio=0.5).effects()}
    assert tables["coulomb_friction"]["level_n"] == 5.0
    assert tables["micro_reaction"]["fraction_ratio"] == 0.5
    assert {row["name"]: row for row in Strengths().effects()}["coulomb_friction"]["level_n"] == 0.0


def test_every_reference_has_a_row_of_its_own(paths):
    """Twice the speed, twice the gap of a lag: the greater of the two would hide the other."""
    pair = paths["trapezoid"]
    one = {
        (servo, r.name): twin.follow(r, servo, Strengths(record_lag_s=1e-4)) for servo in (SOFT, STIFF) for r in pair
    }
    other = {(servo, r.name): twin.follow(r, servo) for servo in (SOFT, STIFF) for r in pair}
    found = {r.name: peaks for r, peaks in comparison_chapter._peaks(pair, one, other)}
    assert set(found) == {"trapezoid I", "trapezoid II"}
    for k in (0, 1):
        assert found["trapezoid II"][k] == pytest.approx(2.0 * found["trapezoid I"][k], rel=0.02)
    row = comparison_chapter._row(pair[0], "x", None, found["trapezoid I"])
    assert (row.equation, row.quantity) == ("Fig. 21, I", "trapezoid I: gap by x")
    assert row.corrected == found["trapezoid I"][0]
