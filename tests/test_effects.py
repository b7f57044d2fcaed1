"""All laws: numbers worked by hand, the same law in its homes, memory, linearity, declaration; families beside it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stagectl import compose
from stagectl.effects import CATALOGUE, MOTIONS, PLACES, QUANTITIES_OF, TAGS, Trait, effect
from stagectl.gap import next_move
from stagectl.units import unit_of
from tests.effect_numbers import PARAMETERS, WORKED, columns, motion

REMEMBERING = [name for name, known in CATALOGUE.items() if known.memory]
FORGETFUL = [name for name, known in CATALOGUE.items() if not known.memory]
MOTION = motion()


def along(name: str, parameters, quantities=None) -> np.ndarray:
    """Return an effect's output along a motion, its memory empty at the start."""
    known = CATALOGUE[name]
    rows = columns(name, MOTION if quantities is None else quantities)
    return compose.along(known)(rows, np.array(parameters, dtype=np.float64), np.zeros(max(known.memory, 1)))


def called(law, arguments, memory: np.ndarray) -> float:
    """Call a law, with its memory where it has one."""
    return law(*arguments, memory) if memory.size else law(*arguments)


def test_every_law_has_numbers_worked_by_hand():
    ours = {name for name, known in CATALOGUE.items() if not known.origin}  # a user's own has none
    assert ours == set(WORKED) == set(PARAMETERS)


@pytest.mark.parametrize(("name", "case"), [(name, case) for name, cases in WORKED.items() for case in cases])
def test_worked_number(name, case):
    known = CATALOGUE[name]
    scale = max(abs(case.output), 1e-9)
    for law in (known.law, known.compiled_law):
        memory = np.array(case.before)
        assert called(law, case.arguments, memory) == pytest.approx(case.output, rel=3e-14, abs=1e-15 * scale)
        np.testing.assert_allclose(memory, case.after, rtol=3e-14, atol=1e-18)
    for value, (low, high) in zip(case.arguments[-len(known.parameters) :], known.bounds.values(), strict=True):
        assert low <= value <= high


@pytest.mark.parametrize("name", FORGETFUL)
def test_scalar_equals_array_equals_compiled(name):
    known = CATALOGUE[name]
    values = np.random.default_rng(3).uniform(-0.4, 0.4, 500)
    scales = [1000.0 if name == "motor_force_n" else 1.0 + 0.1 * k for k, name in enumerate(known.quantities)]
    given_values = [values * scale for scale in scales]
    as_array = known.law(*given_values, *PARAMETERS[name])
    one_by_one = np.array([known.law(*map(float, row), *PARAMETERS[name]) for row in zip(*given_values, strict=True)])
    compiled = np.array([known.compiled_law(*row, *PARAMETERS[name]) for row in zip(*given_values, strict=True)])
    np.testing.assert_array_equal(as_array, one_by_one)
    # numpy and the compiler each bring their own sin and tanh: equal to the last bits
    largest = np.max(np.abs(as_array))
    np.testing.assert_allclose(compiled, as_array, rtol=4e-16, atol=8e-16 * largest)


@pytest.mark.parametrize("name", CATALOGUE)
def test_along_rows_is_the_law_in_python_row_by_row(name):
    known = CATALOGUE[name]
    memory = np.zeros(known.memory)
    one_by_one = [called(known.law, (*row, *PARAMETERS[name]), memory) for row in columns(name, MOTION)[:400].tolist()]
    found = along(name, PARAMETERS[name])[:400]
    np.testing.assert_allclose(found, one_by_one, rtol=1e-11, atol=1e-12 * (1e-30 + np.max(np.abs(found))))


@pytest.mark.parametrize("name", CATALOGUE)
def test_linear_where_it_says_so(name):
    """The parts of the linear parameters, each alone, add up to the whole; twice of each is twice the whole."""
    known = CATALOGUE[name]
    if not known.linear:
        return
    values = dict(zip(known.parameters, PARAMETERS[name], strict=True))
    parts = []
    for alone in known.linear:
        others = {key: 0.0 for key in known.linear if key != alone}
        parts.append(values[alone] * along(name, list((values | others | {alone: 1.0}).values())))
    whole = along(name, PARAMETERS[name])
    largest = np.max(np.abs(whole))
    assert largest > 0.0
    np.testing.assert_allclose(np.sum(parts, axis=0), whole, rtol=1e-12, atol=1e-12 * largest)


def test_amplitudes_are_linear_but_where_the_law_is_not():
    assert {name for name, known in CATALOGUE.items() if not known.linear} == {
        *("soft_contact", "force_constant_saturation", "amplifier_dead_band", "current_loop_lag", "command_delay"),
        *("sensor_delay", "sensor_lag", "clock_skew", "flexible_mode", "contact_damping"),
    }


@settings(max_examples=20)
@given(st.data())
@pytest.mark.parametrize("name", CATALOGUE)
def test_finite_within_its_bounds(name, data):
    """Any motion of a stage, any parameters within bounds, any length of a step."""
    known = CATALOGUE[name]
    limits = {"position_m": 1.0, "velocity_m_per_s": 2.0, "acceleration_m_per_s2": 50.0, "mass_kg": 1e3}
    limits |= {"motor_force_n": 5e3, "penetration_m": 1e-3, "contact_stiffness_n_per_m": 1e7, "t_s": 1e5, "dt_s": 0.1}
    limits |= {"current_loop_s": 0.02}
    parameters = [data.draw(st.floats(low, high)) for low, high in known.bounds.values()]
    memory = np.zeros(known.memory)
    for _ in range(5):
        quantities = []
        for key in known.quantities:
            high = limits.get(key, 1.0)
            positive = key in ("mass_kg", "t_s", "dt_s", "penetration_m", "contact_stiffness_n_per_m", "current_loop_s")
            quantities.append(data.draw(st.floats(0.0 if positive else -high, high)))
        assert math.isfinite(called(known.compiled_law, (*quantities, *parameters), memory))
        assert np.all(np.isfinite(memory))


# ---- memory ------------------------------------------------------------------------------------------------------


def step_of(name: str) -> int:
    return CATALOGUE[name].quantities.index("dt_s")


@pytest.mark.parametrize("name", REMEMBERING)
def test_no_time_no_change(name):
    """What a short step tends to is what a step of no length gives, and that one leaves the memory alone."""
    known = CATALOGUE[name]
    memory = np.zeros(known.memory)
    for row in columns(name, MOTION)[:700]:
        known.compiled_law(*row, *PARAMETERS[name], memory)
    row = columns(name, MOTION)[700]
    outputs = []
    for dt_s in (0.0, 1e-9):
        trial = memory.copy()
        row[step_of(name)] = dt_s
        outputs.append(known.compiled_law(*row, *PARAMETERS[name], trial))
        if dt_s == 0.0:
            assert trial.tobytes() == memory.tobytes()
    assert outputs[1] == pytest.approx(outputs[0], rel=1e-4)


@pytest.mark.parametrize("name", REMEMBERING)
@pytest.mark.parametrize("parts", [2, 7])
def test_the_length_of_a_step_is_of_no_matter(name, parts):
    """Held inputs: one step, or several that add up to it, lead to the same memory and the same mean."""
    known = CATALOGUE[name]
    once, often = np.zeros(known.memory), np.zeros(known.memory)
    instant = known.quantities.index("t_s") if "t_s" in known.quantities else None
    for row in columns(name, MOTION)[
        :40
    ]:  # 3.3 mm: the cable, which is exact but where it begins to slip, does not yet
        if name == "flexible_mode":
            once[2] = often[2] = 0.0  # what the other forces do stands still
        whole = known.compiled_law(*row, *PARAMETERS[name], once)
        means = []
        for k in range(parts):
            part = row.copy()
            part[step_of(name)] = row[step_of(name)] / parts
            if instant is not None:
                part[instant] += k * part[step_of(name)]
            if name == "sensor_lag":  # its motion is that at the end of a step
                left_s = (parts - 1 - k) * part[step_of(name)]
                part[0] -= left_s * part[1]
            if name == "flexible_mode":
                often[2] = 0.0
            means.append(known.compiled_law(*part, *PARAMETERS[name], often))
        if name == "flexible_mode":
            once[2] = often[2] = 0.0
        np.testing.assert_allclose(often, once, rtol=1e-9, atol=1e-15)
        if name in ("flexible_mode", "current_loop_lag", "command_delay"):
            assert np.mean(means) == pytest.approx(whole, rel=1e-9, abs=1e-12)


@settings(max_examples=50)
@given(
    st.lists(st.tuples(st.floats(-2.0, 2.0), st.floats(0.0, 1.0)), min_size=1, max_size=40),
    st.sampled_from(REMEMBERING),
)
def test_a_memory_is_bounded_for_any_step(moves, name):
    """Explicit Euler on LuGre diverges at dt > 2 delta / v; here the inputs are bounded, and so is the memory."""
    known = CATALOGUE[name]
    memory = np.zeros(known.memory)
    t_s = 0.0
    for value, dt_s in moves:
        given_values = {"velocity_m_per_s": value, "acceleration_m_per_s2": value, "command_a": value, "mass_kg": 1.0}
        given_values |= {"dt_s": dt_s, "t_s": t_s, "current_loop_s": 0.15e-3}
        given_values |= {"penetration_m": 1e-5, "penetration_velocity_m_per_s": value, "contact_stiffness_n_per_m": 1e4}
        known.compiled_law(*[given_values[key] for key in known.quantities], *PARAMETERS[name], memory)
        t_s += dt_s
    largest = {"dahl_friction": 1.0, "cable_hysteresis": 1.0, "lugre_friction": 1.4, "current_loop_lag": 2.0}
    largest |= {"flexible_mode": 10.0, "sensor_lag": 0.01, "command_delay": 1e3, "contact_hysteresis": 2.0}
    assert np.all(np.abs(memory) <= largest[name] * (1.0 + 1e-12))


# ---- declaration ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known", CATALOGUE.values(), ids=CATALOGUE)
def test_every_declaration_is_complete(known):
    assert known.places
    assert set(known.places) <= set(PLACES)
    assert all(set(known.quantities) <= set(QUANTITIES_OF[place]) for place in known.places)
    assert set(known.bounds) == set(known.parameters) == set(known.tags)
    assert set(known.tags.values()) <= set(TAGS)
    assert set(known.linear) <= set(known.parameters)
    for low, high in known.bounds.values():
        assert -math.inf < low < high < math.inf
    assert all(unit_of(name) for name in (*known.quantities, *known.parameters))
    assert known.summary.endswith((".", "x^3"))
    assert known.symptom
    assert known.reference
    for value, (low, high) in zip(PARAMETERS[known.name], known.bounds.values(), strict=True):
        assert low <= value <= high


def test_what_belongs_to_a_homing_or_a_run_is_tagged():
    tagged = {name: {k: v for k, v in known.tags.items() if v != "structural"} for name, known in CATALOGUE.items()}
    assert {name: tags for name, tags in tagged.items() if tags} == {
        "cable_spring": {"anchor_m": "session"},
        "cogging": {"phase_rad": "session"},
        "harmonic_cogging": {"first_phase_rad": "session", "second_phase_rad": "session"},
        "current_ripple": {"phase_rad": "session"},
        "base_vibration": {"phase_rad": "run"},
        "backlash_centre_shift": {"shift_m": "session"},
        "cyclic_error": {"first_phase_rad": "session", "second_phase_rad": "session"},
        "abbe_error": {"centre_m": "session"},
    }


@pytest.fixture
def catalogue():
    """Leave the catalogue as it was found."""
    kept = dict(CATALOGUE)
    yield CATALOGUE
    CATALOGUE.clear()
    CATALOGUE.update(kept)


def refused(law, places=("macro_force",), **declared) -> str:
    """Declare `law`, and return why that raises; nothing may be left in the catalogue."""
    before = set(CATALOGUE)
    with pytest.raises(TypeError) as caught:
        effect(places=places, symptom="a mark", reference="a book", **declared)(law)
    assert set(CATALOGUE) == before
    return str(caught.value)


def test_a_new_law_is_one_function(catalogue):
    @effect(places=("micro_force",), symptom="odd", reference="this test", linear=("drag_n",), drag_n=(0.0, 10.0))
    def drag(velocity_m_per_s, t_s, drag_n):
        """Drag that grows: F = -d v t."""
        return -drag_n * velocity_m_per_s * t_s

    assert drag(2.0, 3.0, 0.5) == -3.0  # still a plain function
    known = catalogue["drag"]
    assert (known.quantities, known.parameters) == (("velocity_m_per_s", "t_s"), ("drag_n",))
    assert known.summary == "Drag that grows: F = -d v t."
    assert known.compiled_law(2.0, 3.0, 0.5) == -3.0
    assert (known.memory, known.linear, known.tags) == (0, ("drag_n",), {"drag_n": "structural"})


def test_a_new_law_with_memory(catalogue):
    @effect(places=("macro_force",), memory=1, symptom="odd", reference="this test", run=("gain_n",), gain_n=(0.0, 1.0))
    def summed(velocity_m_per_s, dt_s, gain_n, memory):
        """Way that was gone, in newtons: F = -g x."""
        memory[0] += velocity_m_per_s * dt_s
        return -gain_n * memory[0]

    known = catalogue["summed"]
    assert (known.quantities, known.parameters) == (("velocity_m_per_s", "dt_s"), ("gain_n",))
    assert (known.memory, known.tags) == (1, {"gain_n": "run"})
    memory = np.array([0.5])
    assert known.compiled_law(2.0, 0.25, 0.5, memory) == -0.5
    assert memory.tolist() == [1.0]


def test_what_a_search_knows_of_a_law_is_declared_with_it(catalogue):
    @effect(
        places=("macro_sensor",),
        traits=("late reading",),
        searched=("delay_s",),
        shown_by="acceleration",
        symptom="odd",
        reference="this test",
        delay_s=(0.0, 1.0),
    )
    def late(velocity_m_per_s, delay_s):
        """Reading of an earlier instant: -v T."""
        return -velocity_m_per_s * delay_s

    known = catalogue["late"]
    assert known.traits == {Trait.LATE_READING}
    assert (known.searched, known.shape, known.shown_by) == (("delay_s",), ("delay_s",), "acceleration")
    assert (known.has_step, known.period) == (False, "")


@pytest.mark.parametrize(
    ("declared", "said"),
    [
        ({"traits": ("early reading",)}, "unknown trait 'early reading'; choose from ['base',"),
        ({"searched": ("width_m",)}, "width_m is searched, and is no parameter"),
        ({"searched": ("level_n",), "linear": ("level_n",)}, "level_n is linear, so it is solved for"),
        ({"shown_by": "a wave"}, "shown by an unknown motion 'a wave'"),
    ],
)
def test_what_a_search_can_not_know_of_a_law(declared, said):
    def wrong(velocity_m_per_s, level_n):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert said in refused(wrong, level_n=(0.0, 1.0), **declared)


def test_what_laws_say_by_their_arguments():
    """Steps and periods are in the text of a law: nobody lists their names."""
    steps = {name for name, known in CATALOGUE.items() if known.has_step}
    assert {"coulomb_friction", "stribeck_friction", "load_dependent_friction"} <= steps
    assert not steps & {"viscous_friction", "dahl_friction", "cogging", "contact_hysteresis"}
    periods = {name: known.period for name, known in CATALOGUE.items() if known.period}
    assert periods == {
        "cogging": "pitch_m",
        "harmonic_cogging": "pitch_m",
        "current_ripple": "pitch_m",
        "base_vibration": "frequency_hz",
    }


def test_every_kind_of_motion_has_its_moves():
    assert set(next_move.MOVES) == {*MOTIONS, ""}
    assert all(next_move.MOVES[motion] for motion in MOTIONS)


def test_declared_twice():
    def offset(t_s, force_n):
        """A second one."""
        return force_n

    assert "offset is declared twice" in refused(offset, force_n=(0.0, 1.0))


def test_parameter_before_quantity():
    def wrong(level_n, velocity_m_per_s):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert "quantities come before parameters" in refused(wrong, level_n=(0.0, 1.0))


def test_unknown_place():
    def wrong(velocity_m_per_s):
        """Wrong."""
        return velocity_m_per_s

    assert "unknown place base" in refused(wrong, places=("macro_force", "base"))
    assert "no place" in refused(wrong, places=())


@pytest.mark.parametrize("bounds", [{}, {"level_n": (0.0, 1.0), "other_n": (0.0, 1.0)}, {"other_n": (0.0, 1.0)}])
def test_bounds_and_parameters_differ(bounds):
    def wrong(velocity_m_per_s, level_n):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert "do not match parameters ['level_n']" in refused(wrong, **bounds)


@pytest.mark.parametrize("bounds", [(1.0, 0.0), (0.0, math.nan), (0.0, math.inf), (-math.inf, 0.0), (1.0, 1.0)])
def test_bounds_that_are_no_range(bounds):
    def wrong(velocity_m_per_s, level_n):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert "bounds of level_n are no range" in refused(wrong, level_n=bounds)


def test_argument_without_a_unit():
    def wrong(velocity_m_per_s, level):
        """Wrong."""
        return level * velocity_m_per_s

    assert "argument level states no unit" in refused(wrong, level=(0.0, 1.0))


@pytest.mark.parametrize(
    ("places", "strange"),
    [(("contact",), "position_m"), (("contact", "macro_force"), "position_m"), (("macro_command",), "position_m")],
)
def test_a_law_knows_what_is_known_at_its_place(places, strange):
    def wrong(position_m, stiffness_n_per_m):
        """Wrong."""
        return position_m * stiffness_n_per_m

    said = refused(wrong, places=places, stiffness_n_per_m=(0.0, 1.0))
    assert f"{strange} is not known at {places[0]}" in said
    assert "may depend on" in said


def test_memory_and_declaration_agree():
    def forgetful(velocity_m_per_s, dt_s):
        """Wrong."""
        return velocity_m_per_s * dt_s

    def timeless(velocity_m_per_s, memory):
        """Wrong."""
        return velocity_m_per_s + memory[0]

    def edge(contact_side_ratio, t_s, dt_s, memory):
        """Wrong."""
        return contact_side_ratio * memory[0]

    def slow(command_a, current_loop_s):
        """Wrong."""
        return -command_a * current_loop_s

    assert "is no law without memory" in refused(slow, places=("macro_command",))
    assert "memory = 1 in the decorator, and the law does not take" in refused(forgetful, memory=1)
    assert "memory = 0 in the decorator, and the law takes" in refused(timeless)
    assert "advances it by dt_s" in refused(timeless, memory=1)
    assert "both edges" in refused(edge, places=("contact_edge",), memory=1)


@pytest.mark.parametrize("tag", ["linear", "session", "run"])
def test_a_tag_names_a_parameter(tag):
    def wrong(velocity_m_per_s, level_n):
        """Wrong."""
        return level_n * velocity_m_per_s

    assert "force_n is tagged or linear" in refused(wrong, level_n=(0.0, 1.0), **{tag: ("force_n",)})
    assert "can't last" in refused(wrong, level_n=(0.0, 1.0), session=("level_n",), run=("level_n",))


def test_a_law_without_a_summary():
    def wrong(velocity_m_per_s, level_n):
        return level_n * velocity_m_per_s

    assert "no docstring" in refused(wrong, level_n=(0.0, 1.0))
