"""Laws that are nearly alike: the simpler one where recordings can't tell them apart, and only there."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from stagectl.effects import CATALOGUE
from stagectl.gap import balance, looks
from stagectl.gap.aliases import aliases_of
from stagectl.gap.competition import Competition
from stagectl.gap.crew import Serial
from stagectl.gap.findings import Named
from stagectl.gap.judge import ALIAS_GAIN, ALIAS_SHARE, EXACT_RATIO, LEFT_SDS, Judge
from stagectl.gap.left_over import excess, unknown_rest
from stagectl.gap.noise import slow_noise
from stagectl.gap.normal_equations import Group
from stagectl.gap.parts import as_two_others, levelled
from stagectl.gap.selection import MOST_NAMES_COUNT, select
from stagectl.gap.settling import Left
from tests.driven_axis import AXIS, STEPS, H, axis_under

Made = Callable[[float, float, float], float]


def _search(made_n: Callable[[], Made], apart_n: Callable[[], Made] | None = None, steps: int = STEPS) -> Competition:
    """Let all hypotheses get ready on two runs; `made_n` makes the motor's force anew for each.

    apart_n: that of the second run, which no fit sees then; steps: of the axis in a sample interval.
    """
    both = (made_n, apart_n or made_n)
    recordings = [balance.recording_of(axis_under(one(), seed, steps), AXIS) for seed, one in enumerate(both, start=1)]
    training_count = 2 if apart_n is None else 1
    search = Competition(recordings, training_count, nulls_count=20, noise=slow_noise(AXIS, recordings[0]))
    search.judge.calibrate()
    return search


def _of_library(search: Competition, name: str) -> Group:
    return next(group for group in search.judge.library if group.key == (name, "macro_force"))


def _pulled_by(stiffness_n_per_m: float, anchor_m: float) -> Callable[[], Made]:
    return lambda: lambda command_n, x, v: command_n - stiffness_n_per_m * (x - anchor_m)


def _bristled(level_n: float, static_ratio: float, damping_s: float) -> Callable[[], Made]:
    """Bristles that slip by 17 um, and what they hold at rest more than in motion, below 1.5 mm/s."""

    def make() -> Made:
        bent = np.zeros(1)  # of the slip

        def made_n(command_n: float, x: float, v: float) -> float:
            most = 1.0 + (static_ratio - 1.0) * np.exp(-((v / 1.5e-3) ** 2))
            rate = (v - abs(v) * bent[0] / most) / 17e-6
            bent[0] = np.clip(bent[0] + rate * H / STEPS, -most, most)
            return command_n - level_n * (bent[0] + damping_s * rate)

        return made_n

    return make


def _dahl_loses(search: Competition) -> tuple[float, float]:
    """Return by how much less than LuGre's law Dahl's gains alone, and the share of that gain."""
    judge = search.judge
    gains = {group.key[0]: judge.gain([group]) - judge.gain([]) for group in judge.rivals([])}
    less = gains["lugre_friction"] - gains["dahl_friction"]
    return less, less / gains["lugre_friction"]


@pytest.mark.parametrize("anchor_m", [0.02, 0.25, -0.45])
def test_a_cable_is_found_wherever_its_anchor_is(anchor_m):
    """From the middle of the travel alone, one whose anchor lay beside it was the offset that it mostly is."""
    search = _search(_pulled_by(60.0, anchor_m))
    (found,) = select(search.judge)
    term = search.term(found)
    assert term.name == "cable_spring"
    assert term.shape["anchor_m"] == pytest.approx(anchor_m, rel=0.02)


def test_an_offset_and_a_spring_are_no_cable_from_beyond_the_travel():
    """An offset and a cubic stiffness were one that was anchored 0.9 m away, beside a travel of 1 m (2997)."""
    search = _search(_pulled_by(60.0, -3.0))
    assert sorted(group.key[0] for group in select(search.judge)) == ["linear_stiffness", "offset"]


def test_an_offset_and_a_spring_are_one_cable():
    """As they start from a look before: beside either of them a cable says what the other says, with a number more."""
    search = _search(_pulled_by(60.0, 0.25))
    start = [_of_library(search, "offset"), _of_library(search, "linear_stiffness")]
    assert [group.key[0] for group in select(search.judge, start)] == ["cable_spring"]


def test_two_levels_that_a_rise_stands_on_are_one_level_and_a_push():
    """Along the motion they are the same, of as many numbers; a level alone is none that was asymmetric."""

    def risen(command_n: float, x: float, v: float) -> float:
        return command_n - 3.0 * float(np.sign(v)) * (1.0 + 0.8 * float(np.exp(-((v / 0.02) ** 2)))) - 1.2

    search = _search(lambda: risen)
    levels, rise = (_of_library(search, name) for name in ("asymmetric_coulomb_friction", "stribeck_friction"))
    (rise,) = search.judge.refine([*search.judge.base, levels], [rise])
    assert [group.key[0] for group in levelled(search.judge, [rise, levels])] == [
        "stribeck_friction",
        "coulomb_friction",
        "offset",
    ]
    assert levelled(search.judge, [levels]) == [levels]


def test_a_push_and_a_cable_are_an_offset_and_a_spring():
    """The same forces with a number more; what only a cable does beside another law stays one."""
    search = _search(_pulled_by(60.0, -3.0))
    two = [_of_library(search, name) for name in ("cable_spring", "gravity_tilt")]
    assert sorted(group.key[0] for group in as_two_others(search.judge, two)) == ["linear_stiffness", "offset"]
    search = _search(lambda: lambda command_n, x, v: command_n - 60.0 * (x - 0.25) - 8.0 * v)
    two = [_of_library(search, name) for name in ("cable_spring", "viscous_friction")]
    two = search.judge.reshaped(two)
    assert as_two_others(search.judge, two) == two


def test_a_spring_about_zero_is_no_cable():
    """A cable gains what noise does more: by that, and 0.002 % of what both gain, they are the same."""
    search = _search(_pulled_by(60.0, 0.0))
    assert [group.key[0] for group in select(search.judge)] == ["linear_stiffness"]


def test_an_offset_is_no_cable_from_ten_metres_away():
    """A constant force, but for a hundredth: a set with a cable in it asks for a move that could split nothing."""
    search = _search(lambda: lambda command_n, x, v: command_n - 3.0)
    (found,) = select(search.judge)
    assert found.key[0] == "offset"
    assert "cable_spring" in {group.key[0] for group in search.judge.rivals([])}
    assert [key[0] for key, _ in aliases_of(search.judge, [found], found)] == ["gravity_tilt"]


def _rubbed(level_n: float) -> Callable[[], Made]:
    return lambda: lambda command_n, x, v: command_n - level_n * float(np.sign(v)) * (abs(v) / 0.1) ** 0.43


@pytest.mark.parametrize("made_n", [_bristled(2.0, 1.0, 0.0), _rubbed(6.0)])
def test_frictions_leave_what_smooth_laws_do(made_n):
    """By 0.05 % of what they gain a lag of a drive, or a cubic spring, was taken for what their law is inexact by.

    Another friction of the body still is: one along the way was named beside bristles.
    """
    search = _search(made_n)
    judge = search.judge
    (found,) = select(judge)
    gained = judge.gain([found]) - judge.gain([])
    assert judge._inexact([found], _of_library(search, "cubic_stiffness")) < 0.1 * EXACT_RATIO * gained
    assert judge._inexact([found], _of_library(search, "position_dependent_friction")) > 0.9 * EXACT_RATIO * gained
    both = [found, _of_library(search, "coulomb_friction")]  # each explains most of what the other does
    assert judge._inexact(both, _of_library(search, "cubic_stiffness")) < 0.1 * EXACT_RATIO * gained


def test_a_dead_band_leaves_what_smooth_laws_do():
    """By 0.05 % of 11 million squares of a cyclic error a cable of 490 was taken for what that is inexact by."""
    search = _search(lambda: lambda command_n, x, v: float(np.sign(command_n)) * max(abs(command_n) - 3.0, 0.0))
    judge = search.judge
    (found,) = select(judge)
    assert found.key[0] == "amplifier_dead_band"
    gained = judge.gain([found]) - judge.gain([])
    assert judge._inexact([found], _of_library(search, "cubic_stiffness")) < 0.1 * EXACT_RATIO * gained


def test_laws_are_more_exact_along_the_motion_under_them():
    """For 2e-5 of a friction of 143 million squares a cubic stiffness of 535 was left out; closer, it leaves 3e-7."""
    search = _search(_rubbed(6.0), steps=100)
    (found,) = select(search.judge)
    look = looks.looked_closely(search, search.evidence.recordings, frozenset(), lambda _: None, Serial())
    shares = []
    for competition, friction in ((search, found), (look.search, *look.chosen)):
        judge = competition.judge
        inexact = judge._inexact([friction], _of_library(competition, "linear_stiffness"))
        shares.append(inexact / (judge.gain([friction]) - judge.gain([])))
    assert shares[1] < 0.2 * shares[0]


@pytest.mark.parametrize(("force_n", "is_unknown"), [(0.5, True), (0.0, False)])
def test_a_look_with_more_names_than_may_stand_is_the_last_where_something_is_left(force_n, is_unknown):
    """In the place of a base that shakes ten names stood at their sizes, and four looks took twenty minutes."""
    search = _search(lambda: lambda command_n, x, v: command_n - force_n * float(np.sin(1e3 * x * abs(x) ** 0.5)))
    case = looks._Case(search, search.evidence.recordings, frozenset(), Serial())
    late = (CATALOGUE["sensor_delay"], "macro_sensor", {"delay_s": 1e-4})
    search.moved = MOST_NAMES_COUNT * (late,)
    assert not looks._is_unknown(case, looks.Look(search, [], ()))
    search.moved += (late,)
    assert looks._is_unknown(case, looks.Look(search, [], ())) == is_unknown


def test_what_takes_more_than_three_laws_that_rub_has_no_name():
    """A friction that grows with the time since each reversal was four of them, and left nothing (1011107)."""
    search = _search(lambda: lambda command_n, x, v: command_n - 3.0 * float(np.sign(v)), steps=100)
    names = ("coulomb_friction", "stribeck_friction", "dahl_friction", "cable_hysteresis")
    *three, fourth = (_of_library(search, name) for name in names)
    assert unknown_rest(search, three, excess(search.judge, [])) is None
    assert unknown_rest(search, [*three, fourth], excess(search.judge, [])) is not None


def test_what_gains_more_and_is_spoken_against_is_no_alias():
    """Iron of the other motor gained 109 squares more than a friction, of what other iron was inexact by (1010103)."""

    def softened(command_n: float, x: float, v: float) -> float:
        return command_n + 0.3 * (x / 0.1) ** 3

    search = _search(_pulled_by(20.0, 0.0), lambda: softened)
    judge = search.judge
    laws = {group.key[0]: group for group in judge.rivals([])}
    cable, spring = laws["cable_hysteresis"], laws["linear_stiffness"]
    assert judge.gain([spring]) > judge.gain([cable]) + ALIAS_GAIN
    assert not judge.stays([], spring)
    assert "linear_stiffness" not in {key[0] for key, _ in aliases_of(judge, [cable], cable)}


def _shaken() -> Made:
    """Make friction, and a force that sweeps upwards from 20 Hz, which no law of the library is."""
    steps = np.zeros(1)

    def made_n(command_n: float, x: float, v: float) -> float:
        steps[0] += 1.0
        t = steps[0] * H / STEPS
        return _rubbed(6.0)()(command_n, x, v) + 0.012 * float(np.sin(2.0 * np.pi * (20.0 + 0.3 * t) * t))

    return made_n


def _rippled() -> Made:
    return lambda command_n, x, v: _rubbed(6.0)()(command_n * (1.0 + 1e-3 * np.sin(2.0 * np.pi * x / 15e-3)), x, v)


@pytest.mark.parametrize(("made_n", "stays"), [(_shaken, False), (_rippled, True)])
def test_what_explains_a_small_part_of_what_is_left_is_no_name(made_n, stays):
    """Beside a friction and a mode that left 4300 squares a base that shakes at the mode's frequency gained 286."""
    search = _search(made_n)
    judge = search.judge
    friction = next(g for g in judge.rivals([]) if g.key[0] == "sublinear_viscous_friction")
    (ripple,) = (group for group in judge.rivals([friction]) if group.key[0] == "current_ripple")
    assert judge.gain([friction, ripple]) - judge.gain([friction]) > 2.0 * judge.threshold_of([friction], ripple)
    judge.curves = []  # a table over position finds some of the sweep, too
    assert judge._is_exact_with([friction], ripple) == stays


def test_dahls_law_is_found_where_lugres_gains_what_noise_does():
    """Of bristles that hold no more at rest it has three numbers for nothing."""
    search = _search(_bristled(2.0, 1.0, 0.0))
    (found,) = select(search.judge)
    assert found.key[0] == "dahl_friction"
    assert _dahl_loses(search)[1] < 0.2 * EXACT_RATIO


def test_what_leaves_no_curve_is_told_from_a_simpler_law_by_less_than_inexact_laws_are():
    """A rise of 0.14 N is 0.08 % of what the bristles gain, and less than noise may hide of what is left."""
    search = _search(_bristled(0.35, 1.4, 3e-4))
    (found,) = select(search.judge)
    assert found.key[0] == "lugre_friction"
    less, share = _dahl_loses(search)
    assert EXACT_RATIO < share < ALIAS_SHARE
    assert less < LEFT_SDS * np.sqrt(2.0 * sum(s.count for s in search.evidence.sums))


def test_no_law_is_inexact_by_more_than_all_that_is_left():
    """Bristles that left nothing gained 4700 squares, 0.04 %, more than Dahl's, and were a level beside Dahl's."""
    search = _search(_bristled(2.0, 1.1, 3e-4))
    (found,) = select(search.judge)
    assert found.key[0] == "lugre_friction"
    less, share = _dahl_loses(search)
    assert share < EXACT_RATIO
    assert less > 2.0 * LEFT_SDS * np.sqrt(2.0 * sum(s.count for s in search.evidence.sums))


def test_a_level_and_a_rise_between_two_speeds_of_the_grid_are_no_bristles():
    """Bristles that slip by nothing are both at once; of pairs as the grid has them two steps gained more."""

    def rubbed_n(command_n: float, x: float, v: float) -> float:
        return command_n - 2.0 * (1.0 + 0.6 * np.exp(-((v / 5.5e-3) ** 2))) * np.sign(v)

    search = _search(lambda: rubbed_n)
    found = {group.key[0]: search.term(group).shape for group in select(search.judge)}
    assert found.keys() == {"coulomb_friction", "stribeck_friction"}
    assert found["stribeck_friction"]["stribeck_m_per_s"] == pytest.approx(5.5e-3, rel=0.02)


@pytest.mark.parametrize(("stays", "name"), [(True, "linear_stiffness"), (False, "sensor_lag")])
def test_what_leaves_less_at_its_size_takes_a_place_where_it_would_have_stayed(stays, name, monkeypatch):
    """A rise that a friction was inexact by took the place of a lag: 400 squares for 240, and no name by itself."""
    search = _search(_pulled_by(60.0, 0.0))
    stood = Judge.stays
    monkeypatch.setattr(
        Judge,
        "stays",
        lambda judge, chosen, group: stood(judge, chosen, group) and (stays or group.key[0] == "sensor_lag"),
    )
    lag = next(group for group in search.judge.library if group.key == ("sensor_lag", "macro_sensor"))

    def left_under(search: Competition, models: list[list[Group]], *_: object) -> list[Left]:
        return [Left(0.0 if model[-1].key[0] == "linear_stiffness" else 1000.0, 16_000, {}) for model in models]

    monkeypatch.setattr(looks, "_left_under", left_under)
    monkeypatch.setattr(looks, "all_named", lambda *_: ())
    look = looks._told_at_size(looks.Look(search, [lag], ()), [], Serial())
    assert [group.key[0] for group in look.chosen] == [name]


def test_no_name_is_dropped_where_forms_are_told_apart_beside_all_names(monkeypatch):
    """A spring left less at its size than a wear beside which it stood, and a delay and a lag were compared without."""
    search = _search(_pulled_by(60.0, 0.0))
    stood = Judge.stays
    monkeypatch.setattr(
        Judge, "stays", lambda judge, chosen, group: group.key[0] == "sensor_lag" or stood(judge, chosen, group)
    )
    lag = next(group for group in search.judge.library if group.key == ("sensor_lag", "macro_sensor"))
    spring = _of_library(search, "linear_stiffness")

    def left_under(search: Competition, models: list[list[Group]], *_: object) -> list[Left]:
        return [Left(0.0 if model[-1].key == spring.key else 1000.0, 16_000, {}) for model in models]

    monkeypatch.setattr(looks, "_left_under", left_under)
    monkeypatch.setattr(looks, "all_named", lambda *_: ())
    first, closer = looks.Look(search, [lag], ()), looks.Look(search, [lag, spring], ())
    again = looks._again_in(search, first, closer, [], Serial())
    assert again is not None
    assert {group.key for group in again.chosen} == {lag.key, spring.key}


@pytest.mark.parametrize("own", [(), (("command_delay", "macro_command", 2.0),)])
def test_forms_of_what_moves_readings_are_those_of_the_first_look_and_all_else_is_the_closer_ones(own, monkeypatch):
    """Beside a clock that was a little off, a lag of 62 us seemed to be 8 us, and a delay of either drive as well."""
    search = _search(_pulled_by(60.0, 0.0))
    monkeypatch.setattr(looks, "moves_readings", lambda search, group: True)
    lag = next(group for group in search.judge.library if group.key == ("sensor_lag", "macro_sensor"))
    delay = ("sensor_delay", "macro_sensor", 0.5)
    named = [
        Named(*lag.key, parameters={}, sds={}, gain=0.0, held_out_gain=0.0, aliases=aliases)
        for aliases in (own, (("command_delay", "micro_command", -14.0), delay))
    ]
    closer, first = (looks.Look(search, [lag], (one,)) for one in named)
    (told,) = looks._with_forms_of(closer, first).named
    assert set(told.aliases) == {*own, delay}


@pytest.mark.parametrize(("left", "are_alike"), [(0.0, True), (1000.0, False)])
def test_what_a_closer_look_can_t_tell_apart_is_compared_at_its_size_too(left, are_alike, monkeypatch):
    """Of a scale error of 384 ppm the first look saw 30, and an Abbe error as its alias, not the other sensor's."""
    search = _search(_pulled_by(60.0, 0.0))
    monkeypatch.setattr(looks, "moves_readings", lambda search, group: True)
    monkeypatch.setattr(looks, "is_of_readings", lambda place: True)
    spring = _of_library(search, "linear_stiffness")
    alone = Named(*spring.key, parameters={}, sds={}, gain=0.0, held_out_gain=0.0, aliases=())
    closer = replace(alone, aliases=(("cubic_stiffness", "macro_force", 0.5),))

    def left_under(search: Competition, models: list[list[Group]], *_: object) -> list[Left]:
        return [Left(0.0 if model[-1].key == spring.key else left, 16_000, {}) for model in models]

    monkeypatch.setattr(looks, "_left_under", left_under)
    monkeypatch.setattr(looks, "all_named", lambda *_: (alone,))
    first, other = looks.Look(search, [spring], (alone,)), looks.Look(search, [spring], (closer,))
    (told,) = looks._of_best_form(first, [], Serial(), other).named
    assert told.aliases == (closer.aliases if are_alike else ())


@pytest.mark.parametrize(
    ("told", "form", "size"),
    [
        (("scale_error", "end_sensor", "error_ppm", 134.0), ("scale_error", "macro_sensor"), -134.0),
        (("scale_error", "end_sensor", "error_ppm", 134.0), ("abbe_error", "end_sensor"), -1e-6),
        (("sensor_delay", "end_sensor", "delay_s", 2e-4), ("sensor_lag", "end_sensor"), -2e-4),
    ],
)
def test_a_form_begins_with_the_size_of_the_other_where_both_are_the_same_number(told, form, size):
    """An Abbe error that began with the ppm of a scale error as its bow in 1/m would have lost by that alone."""
    name, place, parameter, found = told
    closer = looks.Look(None, [], (Named(name, place, {parameter: found}, {}, 0.0, 0.0, ()),))  # pyright: ignore[reportArgumentType]
    law = CATALOGUE[form[0]]
    _, _, values = looks._as_large_as(closer, (law, form[1], {law.parameters[0]: -1e-6}), (name, place))
    assert values[law.parameters[0]] == size


def test_one_law_at_two_places_and_two_laws_at_one_are_compared_at_their_sizes(monkeypatch):
    """As a column a scale error of the other sensor gained 421 squares of 207 000 more than the one that there was."""
    monkeypatch.setattr(looks, "moves_readings", lambda search, group: True)
    search = _search(_pulled_by(60.0, 0.0))
    found = Group(("scale_error", "macro_sensor"), (0,), "structural", (1.0,))
    others = [("scale_error", "end_sensor"), ("sensor_lag", "macro_sensor"), ("sensor_lag", "end_sensor"), found.key]
    forms = [looks._is_other_form(search, found, Group(key, (1,), "structural", (1.0,))) for key in others]
    assert forms == [True, True, False, False]
