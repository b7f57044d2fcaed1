"""The library without one effect: which set it is asked of, and which answers are right."""

import math

import pytest

from bench import left_out
from bench.left_out import Asked, Single, asked, farthest_singles, is_right, is_together, without
from tests.blind import detection, draw, together
from tests.marks import found, member, one


def test_unknown_an_alias_or_a_law_that_holds_it_is_right():
    assert is_right(one(1, "single", (), member(), verdict="unknown"))
    assert not is_right(one(1, "single", (), member()))
    assert is_right(one(1, "single", [found("offset")], member(inseparable=[("offset", "macro_force")])))
    assert not is_right(one(1, "single", [found("offset")], member()))
    assert is_right(one(1, "single", [found("asymmetric_viscous_friction")], member("viscous_friction")))
    asymmetric = member("asymmetric_coulomb_friction")
    assert is_right(one(1, "single", [found("offset"), found("coulomb_friction")], asymmetric))
    tilt = found("tilt", aliases=[("offset", "macro_force")])
    assert is_right(one(1, "single", [tilt, found("coulomb_friction")], asymmetric))
    elsewhere = found("tilt", aliases=[("offset", "micro_force")])
    assert not is_right(one(1, "single", [elsewhere, found("coulomb_friction")], asymmetric))
    assert not is_right(one(1, "single", [found("coulomb_friction")], asymmetric))
    beside_a_third = [found("offset"), found("coulomb_friction"), found("tilt")]
    assert not is_right(one(1, "single", beside_a_third, asymmetric))
    assert is_right(one(1, "single", [found("lugre_friction")], member("stribeck_friction")))
    assert not is_right(one(1, "single", [found("stribeck_friction")], member("lugre_friction")))


def test_our_names_of_a_law_of_the_truth():
    assert without("cogging", "macro_force") == {"cogging", "harmonic_cogging"}
    assert without("tilt", "macro_force") == {"gravity_tilt"}


def test_an_effect_is_left_out_of_the_set_that_no_other_law_comes_near():
    def single(seed, name, nearest):
        place = "macro_sensor" if name == "scale_error" else "macro_force"
        return one(seed, "single", [found(name)], member(name) | {"nearest": nearest, "acts_on": place})

    lag, mass = ["sensor_lag", "macro_sensor"], ["mass_error", "macro_force"]
    sets = [
        single(1, "sensor_delay", [[*lag, 9.3], [*mass, 250.0]]),
        single(2, "sensor_delay", [[*lag, 38.3], [*mass, 40.0]]),
        single(3, "sensor_delay", [[*lag, 0.8], [*mass, 900.0]]),
        single(4, "coulomb_friction", [[*mass, 12.0]]),
        single(8, "scale_error", [["scale_error", "end_sensor", 0.1], [*mass, 54.0]]),  # goes at both sensors
        single(9, "scale_error", [["scale_error", "end_sensor", 2.2], [*mass, 40.0]]),
        one(5, "multi", [found()], member("offset"), member("tilt")),
        one(6, "null"),
    ]
    below = single(7, "offset", [])
    below.searched.truth["effects"][0]["above_twice_limit"] = False
    truths = [marked.searched.truth for marked in [*sets, below]]
    assert farthest_singles(truths, 2) == {
        "sensor_delay": [Single(38.3, 2, "macro_force", (*lag,)), Single(9.3, 1, "macro_force", (*lag,))],
        "coulomb_friction": [Single(12.0, 4, "macro_force", (*mass,))],
        "scale_error": [Single(54.0, 8, "macro_sensor", (*mass,)), Single(40.0, 9, "macro_sensor", (*mass,))],
    }


def test_an_effect_is_asked_of_the_set_that_no_wrong_answer_comes_near():
    """Further sets only where two laws leave of those before what a floor may hide."""

    def singles(*distances):
        return [Single(d, round(d), "macro_force", ("offset", "macro_force")) for d in distances]

    of_two = {144: 9.1, 130: 25.0, 120: 24.0, 90: 71.0, 80: 80.0, 50: 6.0, 49: 2.9}
    were_asked = []

    def distances_of(some):
        were_asked.extend(one.seed for one in some)
        return [of_two[one.seed] for one in some]

    of_effects = {"tilt": singles(144, 130, 120), "lugre_friction": singles(90, 80), "sensor_lag": singles(50, 49)}
    assert asked(of_effects, distances_of) == {
        "tilt": Asked(130, "macro_force", 25.0),
        "lugre_friction": Asked(90, "macro_force", 71.0),
        "sensor_lag": Asked(49, "macro_force", 49.0),  # of which two laws are the lag: a wrong answer is one alone
    }
    assert sorted(were_asked) == [49, 50, 90, 120, 130, 144]
    assert asked({}, distances_of) == {}


def test_the_share_of_right_answers_is_held_against_its_bar():
    sets = [one(1, "single", (), member("tilt")), one(2, "single", (), member("offset"))]
    figure = left_out.judged(sets, [False, True], full=True)
    assert (figure.value, figure.holds) == (pytest.approx(50.0), False)
    assert "not: tilt" in figure.reason
    assert left_out.judged(sets, [True, True], full=True).holds
    assert left_out.judged([], [], full=True).value is None


def test_where_two_laws_leave_less_than_the_floor_scatters_by_no_rest_is_asked_for():
    distances = {1: 22.0, 2: 24.0, 3: 300.0}
    near, far, farther = (one(seed, "single", (), member(), sd=100.0) for seed in distances)
    figure = left_out.judged_shown([near, far, farther], [False, False, True], distances, full=True)
    assert (figure.value, figure.holds, figure.seeds) == (pytest.approx(50.0), None, [2, 3])
    assert "1 others" in figure.reason
    assert left_out.judged_shown([near], [True], distances, full=True).value is None


# ---- laws that are together another one ------------------------------------------------------------------------------


def told(*names):
    """Laws by name@place, nothing told of their sizes."""
    return [(*one.split("@"), {}) for one in names]


@pytest.fixture(scope="module")
def tilted():
    return draw.draw(90, "single", 5.0)


def test_two_offsets_are_a_tilt_and_one_is_not(tilted):
    assert [effect.law.name for effect in tilted.effects] == ["tilt"]
    alone = together.distance(tilted, [])
    assert together.distance(tilted, told("offset@macro_force", "offset@micro_force")) < 1e-3 * alone
    assert detection.SEPARABLE_D < together.distance(tilted, told("offset@macro_force")) < alone


def test_the_two_laws_that_come_nearest_are_found(tilted):
    """Beside an offset of the macro nothing is nearer to a tilt than one of the micro, or a cable far away there."""
    first = ("offset", "macro_force")
    assert together.distance_of_two(tilted, first, lambda name, _: name != "tilt") < detection.SEPARABLE_D
    none_left = together.distance_of_two(tilted, first, lambda name, acts_on: name == "clock_skew")
    assert detection.SEPARABLE_D < none_left <= together.distance(tilted, told("offset@macro_force"))


def test_a_cable_that_is_anchored_far_away_is_an_offset(tilted):
    assert together.distance(tilted, told("offset@macro_force", "cable_spring@micro_force")) < 0.1


def test_viscous_and_coulomb_friction_are_no_drag():
    drag = draw.draw(95, "single", 5.0)
    assert [effect.law.name for effect in drag.effects] == ["quadratic_drag"]
    two = together.distance(drag, told("viscous_friction@macro_force", "coulomb_friction@macro_force"))
    assert detection.SEPARABLE_D < two < together.distance(drag, told("viscous_friction@macro_force"))


def test_a_law_is_no_mixture_of_two_of_its_speeds(tilted):
    evidence = detection.Evidence(tilted, tilted.runs).narrowed(detection.SEPARATION_BAND_HZ)
    for name, columns_count in (("stribeck_friction", 1), ("cable_spring", 2)):
        member = together._member(evidence, name, "macro_force", tilted.effects)
        assert {len(member.columns(point)) for point in member.points} == {columns_count}


def test_a_law_that_the_generator_has_not_is_infinitely_far(tilted):
    assert together.distance(tilted, told("force_over_position@macro_force")) == math.inf


def test_a_late_reading_is_followed_to_where_it_comes_nearest_to_one_that_lags():
    """The lag is 712 us; no delay of the grid comes nearer than 27 deviations."""
    lag = draw.draw(232, "single", 5.0)
    assert [effect.law.name for effect in lag.effects] == ["sensor_lag"]
    delay = together.distance(lag, told("sensor_delay@macro_sensor"))
    assert delay == pytest.approx(1.84, abs=0.05)


def test_a_mode_is_followed_beyond_the_band_that_it_is_drawn_from():
    """Beside a delay it takes of a lag of 244 us what no mode of up to 90 Hz does."""
    lag = draw.draw(169, "single", 5.0)
    assert [effect.law.name for effect in lag.effects] == ["sensor_lag"]
    delay = together.distance(lag, told("sensor_delay@end_sensor"))
    assert together.distance(lag, told("sensor_delay@end_sensor", "flexible_mode@micro_force")) < 0.85 * delay


def test_an_answer_without_names_is_no_law_together():
    assert not is_together(one(1, "single", (), member(), verdict="unknown"))
