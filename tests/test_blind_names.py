"""The truth's names and numbers against ours: the table is whole, and both sides mean the same force."""

import dataclasses
import math

import numpy as np
import pytest

from bench import blind_names
from bench.blind_names import PARAMETERS, TRANSLATIONS, UNMAPPED, in_words_of_the_truth, our_keys, truth_key
from stagectl.effects import CATALOGUE
from stagectl.gap.findings import Findings, Named, ParameterError
from tests.blind import draw, laws, machine, score

RATE_S = 1e-4


def test_every_library_law_at_every_place_is_ours_or_said_not_to_be():
    for law in laws.LIBRARY:
        assert (law.name in UNMAPPED) != any(one.truth == law.name for one in TRANSLATIONS), law.name
        for place in law.acts_on:
            assert law.name in UNMAPPED or our_keys(law.name, place), (law.name, place)
    assert {one.truth for one in TRANSLATIONS} | set(UNMAPPED) == {law.name for law in laws.LIBRARY}
    assert all(UNMAPPED.values())


def test_our_side_of_the_table_is_in_the_catalogue_and_the_other_in_the_generator():
    for one in TRANSLATIONS:
        effect, law = CATALOGUE[one.ours], laws.BY_NAME[one.truth]
        for truth, ours in one.places:
            assert ours in effect.places
            assert truth in law.acts_on
            assert truth_key(one.ours, ours) == (one.truth, truth)
        names = [parameter.name for parameter in law.parameters]
        assert set(one.parameters) <= set(names)
        assert names[0] in one.parameters  # the amplitude, which is marked


def test_wrong_parameters_are_the_generators():
    assert set(PARAMETERS.values()) == set(draw.PARAMETER_ERRORS)


# ---- the same force in both --------------------------------------------------------------------------------------

MOTION = {
    "position_m": 0.03 + 0.05 * np.sin(np.linspace(0.0, 9.0, 4000)),
    "velocity_m_per_s": 0.12 * np.cos(np.linspace(0.0, 9.0, 4000)),
    "acceleration_m_per_s2": -0.3 * np.sin(np.linspace(0.0, 9.0, 4000)),
    "mass_kg": np.full(4000, 41.0),
    "motor_force_n": 20.0 * np.sin(np.linspace(0.0, 31.0, 4000)),
    "micro_motor_force_n": 15.0 * np.sin(np.linspace(0.0, 13.0, 4000)),
    "t_s": np.arange(4000) * RATE_S,
    "dt_s": np.full(4000, RATE_S),
    "penetration_m": 1e-5 * (1.0 + np.sin(np.linspace(0.0, 9.0, 4000))),
    "penetration_velocity_m_per_s": 3e-4 * np.cos(np.linspace(0.0, 9.0, 4000)),
    "contact_stiffness_n_per_m": np.full(4000, 1e4),
}
SMOOTHING = 1e-9

CASES = [  # truth, place, our parameters, of the effect beside it
    ("viscous_friction", "macro_force", {"damping_n_s_per_m": 3.0}, {}),
    ("asymmetric_viscous_friction", "macro_force", {"forward_n_s_per_m": 6.0, "backward_n_s_per_m": 3.0}, {}),
    ("coulomb_friction", "micro_force", {"level_n": 2.0}, {}),
    ("asymmetric_coulomb_friction", "micro_force", {"forward_n": 2.0, "backward_n": 1.2}, {}),
    ("offset", "macro_force", {"force_n": -0.7}, {}),
    ("stribeck_friction", "macro_force", {"excess_n": 1.3, "stribeck_m_per_s": 0.02}, {"level_n": 2.0}),
    ("sublinear_friction", "macro_force", {"level_n": 2.0, "exponent_ratio": 0.6}, {}),
    ("load_dependent_friction", "macro_force", {"coefficient_ratio": 0.05}, {}),
    ("quadratic_drag", "macro_force", {"drag_n_s2_per_m2": 30.0}, {}),
    ("cable_spring", "macro_force", {"stiffness_n_per_m": 20.0, "anchor_m": -0.04}, {}),
    ("tilt", "macro_force", {"grade_ratio": 0.8e-3}, {}),
    ("linear_stiffness", "macro_force", {"stiffness_n_per_m": 20.0}, {}),
    ("cubic_stiffness", "macro_force", {"stiffness_n_per_m3": 900.0}, {}),
    ("position_dependent_friction", "macro_force", {"level_n": 2.0, "slope_n_per_m": -9.0, "ends_m": 10.0}, {}),
    ("position_dependent_friction", "macro_force", {"level_n": 2.0, "slope_n_per_m": -40.0, "ends_m": 0.05}, {}),
    ("micro_reaction", "macro_force", {"fraction_ratio": 0.6}, {}),
    ("dahl_friction", "macro_force", {"level_n": 2.0, "slip_m": 2e-5}, {}),
    ("lugre_friction", "macro_force",
     {"level_n": 2.0, "static_ratio": 1.5, "stribeck_m_per_s": 5e-3, "slip_m": 2e-5, "bristle_damping_s": 3e-4}, {}),
]  # fmt: skip


def ours_along(name, place, parameters, motion=MOTION):
    """Values of one of our laws along the motion."""
    effect = CATALOGUE[name]
    values = parameters | {key: SMOOTHING for key in effect.parameters if key == "smoothing_m_per_s"}
    constants = [values.get(key, 0.0) for key in effect.parameters]
    memory = np.zeros(max(effect.memory, 1))
    assert place in effect.places
    rows = zip(*(motion[quantity] for quantity in effect.quantities), strict=True)
    memories = [memory] if effect.memory else []
    return np.array([effect.law(*row, *constants, *memories) for row in rows], dtype=float)


def truth_along(law, values, acts_on="macro_force"):
    """Values of a law of the generator along the same motion."""
    p = np.zeros(laws.PARAMETERS)
    for place, parameter in enumerate(law.parameters):
        p[place] = values.get(parameter.name, 0.0)
    memory = np.zeros(laws.MEMORIES)
    x, v, t = MOTION["position_m"], MOTION["velocity_m_per_s"], MOTION["t_s"]
    motor, other = MOTION["motor_force_n"], MOTION["micro_motor_force_n"]
    out = []
    for k in range(len(x)):
        if laws.is_friction(law.code):
            side = 1.0 if v[k] > 0.0 else -1.0
            out.append(-side * laws.friction_level(law.code, p, memory, RATE_S, x[k], v[k], motor[k], side))
        else:
            out.append(laws.smooth_force(law.code, p, memory, RATE_S, t[k], x[k], v[k], other[k], 41.0))
    return np.array(out)


def named(name, acts_on, parameters, sds=None, aliases=()):
    return Named(name, acts_on, parameters, sds or {}, 10.0, 10.0, tuple(aliases))


def findings(*effects, errors=(), verdict="found"):
    nothing = (0.0, 0.0)
    return Findings("x", ("a",), (), verdict, effects, errors, {}, (), None, nothing, nothing, nothing)


def translated(*effects):
    return in_words_of_the_truth(findings(*effects))["effects"]


@pytest.mark.parametrize(
    ("truth", "acts_on", "ours", "beside"), CASES, ids=[f"{case[0]} {k}" for k, case in enumerate(CASES)]
)
def test_translated_parameters_make_the_same_force(truth, acts_on, ours, beside):
    table = next(one for one in TRANSLATIONS if one.truth == truth)
    said = [named(table.ours, acts_on, ours)]
    force = ours_along(table.ours, acts_on, ours)
    if table.beside:
        said.append(named(table.beside, acts_on, beside))
        force = force + ours_along(table.beside, acts_on, beside)
    for order in (said, said[::-1]):
        (found,) = translated(*order)
        assert (found["name"], found["acts_on"]) == (truth, acts_on)
        again = truth_along(laws.BY_NAME[truth], found["parameters"])
        trusted = np.abs(MOTION["velocity_m_per_s"]) > 2e-3  # sub-linear is linear near rest in ours
        assert again[trusted] == pytest.approx(
            force[trusted], rel=1e-3, abs=0.05 if truth == "lugre_friction" else 2e-3
        )  # its mean over a step is taken otherwise
        assert np.ptp(force) > 0.01 or truth in ("offset", "tilt")


@pytest.mark.parametrize(
    ("name", "ours"),
    [("cogging", {"amplitude_n": 0.8}), ("harmonic_cogging", {"first_n": 0.8, "second_n": 0.2})],
)
def test_cogging_of_both_kinds_is_the_generators(name, ours):
    (found,) = translated(named(name, "macro_force", ours | {"pitch_m": 0.03}))
    force = ours_along(name, "macro_force", ours | {"pitch_m": 0.03})
    assert truth_along(laws.BY_NAME["cogging"], found["parameters"]) == pytest.approx(force, abs=1e-9)


def test_ripple_and_saturation_make_the_same_force():
    x, motor = MOTION["position_m"], MOTION["motor_force_n"]
    for name, ours in (
        ("current_ripple", {"ripple_ratio": 0.05, "pitch_m": 0.03}),
        ("force_constant_saturation", {"saturation_n": 300.0}),
    ):
        (found,) = translated(named(name, "macro_actuator", ours))
        law = laws.BY_NAME[name]
        p = law.vector(found["parameters"] | {"phase_rad": 0.0})
        truth = [laws.thrust(law.code, p, 100.0, 0.01 * f, at) - f for f, at in zip(motor, x, strict=True)]
        force = ours_along(name, "macro_actuator", ours)
        assert np.array(truth) == pytest.approx(force, abs=0.01 * np.ptp(force))


@pytest.mark.parametrize(
    ("name", "place", "ours", "limit"),
    [
        ("backlash_centre_shift", "contact_edge", {"shift_m": 4e-6}, 1e-9),
        ("backlash_wear", "contact_edge", {"rate_m_per_s": 1e-6}, 1e-9),
        ("contact_damping", "contact", {"damping_n_s_per_m": 90.0}, 1e-9),
        ("soft_contact", "contact", {"knee_m": 8e-6}, 1e-9),
        ("cubic_stiffness", "joint", {"stiffness_n_per_m3": 2e11}, 1e-9),
    ],
)
def test_contact_laws_make_the_same_force(name, place, ours, limit):
    """r is end minus macro; ours touches on the right where the macro is ahead, r < 0."""
    (found,) = translated(named(name, place, ours))
    law = laws.BY_NAME[found["name"]]
    contact = np.array([1.3e4, 1.0e4, 25e-6, 176e-6, 0.0])
    t, effect = 3.0, CATALOGUE[name]
    for r, speed in ((190e-6, 2e-4), (-45e-6, -1e-4), (100e-6, 1e-4)):
        p, empty = law.vector(found["parameters"]), np.zeros(laws.PARAMETERS)
        memory = np.zeros(laws.MEMORIES)
        code = law.code_at("contact")
        truth = laws.contact_force(code, p, memory, 0.0, t, r, speed, contact)
        truth -= laws.contact_force(-1, empty, memory, 0.0, t, r, speed, contact)  # on the macro
        right = 1.0 if r < 0.0 else -1.0  # our side
        stiffness, edge = (1.3e4, 25e-6) if r < 0.0 else (1.0e4, 176e-6)
        depth = max(0.0, abs(r) - edge)
        known = {
            "penetration_m": depth,
            "penetration_velocity_m_per_s": -right * speed,
            "contact_stiffness_n_per_m": stiffness,
            "contact_side_ratio": right,
            "t_s": t,
            "position_m": r,
            "velocity_m_per_s": speed,
            "dt_s": 0.0,
        }
        value = effect.law(*(known[q] for q in effect.quantities), *(ours[q] for q in effect.parameters))
        if place == "joint":
            on_macro = -value
        elif depth == 0.0:
            on_macro = 0.0
        elif place == "contact_edge":
            on_macro = right * stiffness * value
        else:
            on_macro = -right * value
        assert truth == pytest.approx(on_macro, abs=limit)


def test_reading_errors_are_the_same():
    x, v, t = 0.07, 0.05, 40.0
    for name, ours, motion in (
        ("scale_error", {"error_ppm": -120.0}, {"position_m": x}),
        ("abbe_error", {"bow_per_m": 2e-4, "centre_m": 0.0}, {"position_m": x}),
        ("thermal_drift", {"drift_m": 3e-6, "time_constant_s": 50.0}, {"t_s": t}),
    ):
        (found,) = translated(named(name, "end_sensor", ours))
        law, effect = laws.BY_NAME[name], CATALOGUE[name]
        error = effect.law(*(motion[q] for q in effect.quantities), *(ours[q] for q in effect.parameters))
        assert laws.reading_error(law.code, law.vector(found["parameters"]), t, x) == pytest.approx(error, rel=1e-9)
    (skew,) = translated(named("clock_skew", "macro_sensor", {"skew_ppm": -30.0}))
    ours = CATALOGUE["clock_skew"].law(v, 0.0, t, -30.0)
    assert -skew["parameters"]["relative"] * t * v == pytest.approx(ours)  # the truth reads x(t - s T)
    for second, period_m in ((1e-9, 316.4e-9), (9e-9, 158.2e-9)):
        ours = {"first_m": 4e-9, "second_m": second, "wavelength_m": 632.8e-9}
        (cyclic,) = translated(named("cyclic_error", "end_sensor", ours))
        assert cyclic["parameters"] == pytest.approx({"amplitude_m": max(4e-9, second), "period_m": period_m})


def test_laws_of_the_command_name_the_drive():
    for ours, parameter, truth in (
        ("current_loop_lag", "time_constant_s", "lag_s"),
        ("amplifier_dead_band", "half_width_a", "current_a"),
    ):
        (found,) = translated(named(ours, "micro_command", {parameter: 2e-4}))
        assert (found["acts_on"], found["parameters"]) == ("micro_actuator", {truth: 2e-4})
    assert machine.loop_step(0.0, np.ones(9), 4, 0.0, 0.0, 1e-4, 0.0)[0] > 0.0


# ---- merging, pooling, intervals ----------------------------------------------------------------------------------


def test_what_both_axes_feel_is_one_finding():
    both = translated(
        named("gravity_tilt", "macro_force", {"grade_ratio": 1e-3}),
        named("gravity_tilt", "micro_force", {"grade_ratio": 1e-3}),
    )
    assert [(one["name"], one["acts_on"]) for one in both] == [("tilt", "macro_force")]
    two = translated(
        named("coulomb_friction", "macro_force", {"level_n": 1.0}),
        named("coulomb_friction", "micro_force", {"level_n": 1.0}),
    )
    assert len(two) == 2


def test_coulomb_friction_of_the_other_axis_stays_beside_a_stribeck_friction():
    found = translated(
        named("stribeck_friction", "macro_force", {"excess_n": 1.0, "stribeck_m_per_s": 1e-3}),
        named("coulomb_friction", "micro_force", {"level_n": 1.0}),
    )
    assert {(one["name"], one["acts_on"]) for one in found} == {
        ("stribeck_friction", "macro_force"),
        ("coulomb_friction", "micro_force"),
    }


def test_amplitudes_of_sessions_are_pooled():
    (found,) = translated(
        named(
            "cogging",
            "macro_force",
            {
                "amplitude_n of session 0": 1.0,
                "phase_rad of session 0": 0.1,
                "amplitude_n of session 1": 2.0,
                "pitch_m": 0.02,
            },
            {"amplitude_n of session 0": 0.1, "amplitude_n of session 1": 0.2},
        )
    )
    assert found["parameters"]["amplitude_n"] == pytest.approx(1.2)
    low, high = found["interval"]["amplitude_n"]
    assert high - low == pytest.approx(2 * 1.96 / math.sqrt(1 / 0.1**2 + 1 / 0.2**2), rel=1e-3)


def test_no_mean_is_better_known_than_what_its_parts_have_in_common():
    """Masses and force constants scale all forces alike: in both sessions, and in both directions."""
    rippled = named(
        "cogging",
        "macro_force",
        {"amplitude_n of session 0": 1.0, "amplitude_n of session 1": 1.0, "pitch_m": 0.02},
        dict.fromkeys(("amplitude_n of session 0", "amplitude_n of session 1"), 5e-3),
    )
    rubbing = named(
        "asymmetric_coulomb_friction",
        "macro_force",
        {"forward_n": 3.0, "backward_n": 1.0, "smoothing_m_per_s": 1e-5},
        {"forward_n": 0.015, "backward_n": 0.005},
    )
    one, other = (translated(dataclasses.replace(effect, common_sd_ratio=4e-3))[0] for effect in (rippled, rubbing))
    half_width = 1.96 * math.hypot(4e-3, 3e-3 / math.sqrt(2.0))
    assert one["interval"]["amplitude_n"] == pytest.approx((1.0 - half_width, 1.0 + half_width), rel=1e-4)
    half_width = 1.96 * math.hypot(8e-3, 0.5 * 9e-3, 0.5 * 3e-3)
    assert other["interval"]["level_n"] == pytest.approx((2.0 - half_width, 2.0 + half_width), rel=1e-4)
    low, high = other["interval"]["asymmetry"]
    assert high - low == pytest.approx(2.0 * 1.96 * math.hypot(9e-3 / 8.0, 3.0 * 3e-3 / 8.0), rel=0.01)


def test_the_mean_of_two_that_are_wrong_together_is_no_better_known():
    """Both directions of a friction are what they are beyond one that is stated with 0.04 N s/m."""
    dragging = named(
        "asymmetric_viscous_friction",
        "macro_force",
        {"forward_n_s_per_m": 25.0, "backward_n_s_per_m": -1.5},
        {"forward_n_s_per_m": 0.04, "backward_n_s_per_m": 0.04},
    )
    for correlation, mean_sd, half_difference_sd in (
        (1.0, 0.04, 0.0),
        (0.0, 0.04 / math.sqrt(2.0), 0.04 / math.sqrt(2.0)),
    ):
        pair = (("forward_n_s_per_m", "backward_n_s_per_m", correlation),)
        (one,) = translated(dataclasses.replace(dragging, correlations=pair))
        low, high = one["interval"]["coefficient_n_s_per_m"]
        assert high - low == pytest.approx(2.0 * 1.96 * mean_sd, rel=1e-3)
        low, high = one["interval"]["asymmetry"]
        slope = math.hypot(half_difference_sd / 11.75, 13.25 * mean_sd / 11.75**2)
        assert high - low == pytest.approx(2.0 * 1.96 * slope, rel=0.01)


@pytest.mark.parametrize("value", [0.0, -1e9, 1e9, float("inf"), float("nan")])
def test_no_value_is_too_odd_to_be_translated(value):
    """A tool without bounds fits a tilt of sine 5: it is named, and has no angle."""
    for one in TRANSLATIONS:
        effect = CATALOGUE[one.ours]
        parameters = dict.fromkeys(effect.parameters, value)
        (found,) = translated(named(one.ours, one.places[0][1], parameters, dict.fromkeys(parameters, 1.0)))
        assert found["name"] == one.truth
        assert all(math.isfinite(number) for number in found["parameters"].values())


def test_intervals_follow_the_reading():
    (found,) = translated(
        named("tilt", "macro_force", {}),
    )
    assert found["name"] == "tilt"  # unknown to our library: it keeps its name
    (tilt,) = translated(named("gravity_tilt", "macro_force", {"grade_ratio": 1e-3}, {"grade_ratio": 1e-5}))
    low, high = tilt["interval"]["angle_rad"]
    assert low == pytest.approx(-1e-3 - 1.96e-5, rel=1e-4)
    assert high == pytest.approx(-1e-3 + 1.96e-5, rel=1e-4)


def test_aliases_and_parameters_are_said_in_the_truths_words_and_marked():
    effect = named("gravity_tilt", "micro_force", {"grade_ratio": 1e-3}, aliases=[("offset", "macro_force", 1.0)])
    errors = (ParameterError("left_m", 1e-6, 1e-8, 1e-7), ParameterError("right_m", 1e-6, 1e-8, 1e-7))
    said = in_words_of_the_truth(findings(effect, errors=errors))
    assert said["effects"][0]["alias_set"] == [["offset", "macro_force"]]
    assert [row["name"] for row in said["parameter_errors"]] == ["backlash_width"]
    strange = in_words_of_the_truth(findings(errors=(ParameterError("macro_latch_s", 1e-5, 1e-8, 1e-7),)))
    assert strange["parameter_errors"] == [{"name": "macro_latch_s", "acts_on": "parameter", "alias_set": []}]
    member = {
        "name": "tilt", "acts_on": "macro_force", "both_axes": True, "outside": False, "amplitude": "angle_rad",
        "parameters": {"angle_rad": -1e-3}, "above_twice_limit": True, "above_ten_times_limit": True,
        "inseparable": [["offset", "macro_force"]],
    }  # fmt: skip
    truth = {"seed": 1, "kind": "single", "effects": [member], "parameter_errors": []}
    assert score.score(said, truth)["right"]
    assert blind_names.our_keys("tilt", "macro_force") == (
        ("gravity_tilt", "macro_force"),
        ("gravity_tilt", "micro_force"),
    )
