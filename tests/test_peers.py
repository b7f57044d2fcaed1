"""The comparison with general tools: the regression is the physics, the tools find what is there, the table counts."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from bench import peers
from bench.blind_sets import load_set
from bench.peers import TOOLS, Case, Outcome, Tally, row, run_tool, stepwise, table
from bench.regression import problem_of
from stagectl.gap.findings import Named
from tests.blind import draw, generate, laws
from tests.blind.machine import B


@pytest.fixture(scope="module")
def friction(tmp_path_factory):
    """One axis with known values and 2 N of Coulomb friction: (regression, case)."""
    seed = next(s for s in range(1, 60) if draw.draw(s, "null", 4.0).single)
    case = draw.draw(seed, "null", 10.0)
    case.effects = [draw.Effect(laws.BY_NAME["coulomb_friction"], "macro_force", {"level_n": 2.0})]
    case = replace(case, belief={name: float(case.base[B[name]]) for name in case.belief})
    case.runs = draw.simulate(case)
    folder = tmp_path_factory.mktemp("set")
    generate.write(case, folder)
    blind = load_set(folder)
    return problem_of(blind.believed, blind.logs[:-1], blind.logs[-1:]), blind


def test_the_true_column_with_the_true_size_leaves_noise(friction):
    problem, _ = friction
    coefficients = np.zeros(problem.owner.size)
    before = problem.gap_n(coefficients)
    place = next(k for k, term in enumerate(problem.terms) if term.name == "coulomb_friction")
    coefficients[problem.owner == place] = 2.0
    after = problem.gap_n(coefficients)
    assert before[0] > 1.0
    assert after[0] < 0.1 * before[0]
    assert after[1] < 0.2 * max(before[1], 0.5)
    assert [term.name for term in problem.chosen(coefficients)] == ["coulomb_friction"]


def test_force_laws_are_the_same_rows_with_fewer_columns(friction):
    problem, _ = friction
    fewer = problem.force_laws()
    assert {term.acts_on for term in fewer.terms} == {"macro_force"}
    assert len(fewer.terms) < len(problem.terms)
    assert fewer.training.columns.shape == (problem.training.columns.shape[0], fewer.owner.size)
    for column in (0, fewer.owner.size - 1):
        term = fewer.terms[fewer.owner[column]]
        whole = next(k for k, other in enumerate(problem.terms) if other is term)
        own = np.flatnonzero(problem.owner == whole)
        same = [np.array_equal(problem.training.columns[:, k], fewer.training.columns[:, column]) for k in own]
        assert any(same)


@pytest.mark.filterwarnings("ignore")  # of the tools' own libraries
@pytest.mark.parametrize("tool", TOOLS, ids=lambda tool: tool.name)
def test_every_tool_finds_two_columns_among_many(tool):
    if importlib.util.find_spec(tool.module) is None:
        pytest.skip(f"{tool.module} is not installed: pip install '.[peers]' in an environment of its own")
    random = np.random.default_rng(3)
    columns = random.standard_normal((600, 12))
    left = 3.0 * columns[:, 4] - 2.0 * columns[:, 9] + 0.1 * random.standard_normal(600)
    blocks = np.arange(600) * 6 // 600
    found = tool.fit(left, columns, blocks)
    assert {4, 9} <= set(np.flatnonzero(found))
    assert found[[4, 9]] == pytest.approx([3.0, -2.0], abs=0.05)


def test_stepwise_takes_back_what_another_column_makes_superfluous():
    random = np.random.default_rng(4)
    one, other = random.standard_normal((2, 4000))
    columns = np.column_stack([one + other + 0.3 * random.standard_normal(4000), one, other])
    left = one + other + 0.05 * random.standard_normal(4000)
    assert set(np.flatnonzero(stepwise(left, columns, np.zeros(4000)))) == {1, 2}


def test_compressed_rows_keep_every_sum_of_squares():
    random = np.random.default_rng(5)
    columns, left = random.standard_normal((900, 7)), random.standard_normal(900)
    blocks = np.arange(900) * 6 // 900
    small, narrow, numbers = peers._compressed(left, columns, blocks)
    assert small.size == 6 * 8
    values = random.standard_normal(7)
    for block in range(6):
        whole = np.sum((left - columns @ values)[blocks == block] ** 2)
        assert np.sum((small - narrow @ values)[numbers == block] ** 2) * 900 / 48 == pytest.approx(whole)


def test_a_tool_that_fails_is_a_row_and_a_mark(friction):
    problem, blind = friction
    case = Case("1", "null", blind.believed, blind.logs[:-1], blind.logs[-1:], _truth("null"))

    def broken(left, columns, blocks):
        raise ValueError("singular")

    outcome = run_tool(replace(TOOLS[0], fit=broken), case, problem)
    assert outcome.error == "ValueError: singular"
    assert outcome.named == ()
    tally = Tally("x", "y", "z", [outcome])
    assert "failed on 1: ValueError: singular" in row(tally)[-1]


def _truth(kind, *members):
    return {"seed": 1, "kind": kind, "effects": list(members), "parameter_errors": []}


def test_the_table_counts_names():
    member = {
        "name": "stribeck_friction", "acts_on": "macro_force", "both_axes": False, "outside": False,
        "amplitude": "level_n", "parameters": {"level_n": 2.0}, "above_twice_limit": True,
        "above_ten_times_limit": True, "inseparable": [],
    }  # fmt: skip
    single = Case("1", "single", None, (), (), _truth("single", member))
    null = Case("2", "null", None, (), (), _truth("null"))
    real = Case("EMPS", "emps", None, (), ())

    def named(*names):
        return tuple(Named(name, "macro_force", {}, {}, 0.0, 0.0, ()) for name in names)

    exact = Outcome(
        single, named("coulomb_friction", "stribeck_friction"), (1.0, 1.0), 2.0
    )  # the truth has both as one
    many = Outcome(single, named("stribeck_friction", "offset"), (1.0, 3.0), 2.0)
    false = Outcome(null, named("offset"), (1.0, 1.0), 2.0)
    axis = Outcome(real, named("offset", "harmonic_cogging", "stribeck_friction", "dahl_friction"), (1.0, 1.0), 2.0)
    cells = row(Tally("x", "y", "z", [exact, many, false, axis]))
    assert cells[2:4] == ("1 of 2", "2 of 2")
    assert cells[5:7] == ("1 of 1", "1.0")
    assert cells[9] == "2 of 4 / 1 / 1"
    text = table([Tally("x", "y", "z", [exact]), Tally("gone", "", "z", absent="not installed")])
    assert text.count("\n") == 3
    assert "not installed" in text.splitlines()[-1]
