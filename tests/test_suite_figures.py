"""The suite's figures: their arithmetic, when a bar counts as missed, and the record of the final seeds."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bench import final_seeds, suite_figures
from bench.blind_sets import Searched, marked
from bench.figure import Bar
from bench.journal import Journal, measured
from bench.sources import ROOT, gap_sources
from bench.suite_figures import (
    coverage_figure,
    judged_estimate,
    pooled,
    quantile,
    share,
    suite,
)
from tests.marks import found, member, one


def figure(figures, bar):
    name = bar if isinstance(bar, str) else bar.figure
    return next(row for row in figures if row.figure == name)


def test_a_part_run_misses_a_bar_only_where_the_interval_excludes_it_and_the_full_run_judges_the_value():
    bar = Bar("x", "%", 95.0, at_least=True)
    estimate = share(8, 10)  # 80 %, 44 to 97 %
    assert (estimate.low, estimate.high) == pytest.approx((44.39, 97.48), abs=0.01)
    assert judged_estimate(bar, estimate, [], full=False).holds
    assert not judged_estimate(bar, estimate, [], full=True).holds
    assert not judged_estimate(bar, share(5, 10), [], full=False).holds
    most = Bar("x", "%", 2.0)
    assert judged_estimate(most, share(1, 10), [], full=False).holds
    assert not judged_estimate(most, share(1, 10), [], full=True).holds
    assert not judged_estimate(most, share(5, 10), [], full=False).holds
    assert "44.4 to 97.5 %" in judged_estimate(bar, estimate, [], full=False).reason


def test_quantile_interval_covers_as_often_as_it_says():
    random = np.random.default_rng(1)
    inside = 0
    for _ in range(400):
        estimate = quantile(random.standard_exponential(40), 0.5)
        inside += estimate.low <= math.log(2.0) <= estimate.high
    assert inside / 400 > 0.93
    assert quantile([3.0, 1.0, 2.0], 0.5).value == 2.0
    few = quantile([1.0, 2.0, math.inf], 0.5)
    assert (few.value, few.low, few.high) == (2.0, -math.inf, math.inf)
    assert quantile(range(100), 0.1).value == 9


def test_pooled_ratio_is_of_sums_and_its_interval_is_that_of_the_sets():
    tops, bottoms = [1.0, 9.0], [100.0, 100.0]
    estimate = pooled(tops, bottoms, 100.0, complement=True)
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((95.0, 91.0, 99.0))
    random = np.random.default_rng(2)
    many = random.normal(1.0, 0.2, 400)
    estimate = pooled(many, np.ones(400))
    half = stats.norm.ppf(0.975) * many.std() / 20.0
    assert (estimate.low, estimate.high) == pytest.approx((many.mean() - half, many.mean() + half), abs=0.006)


def test_coverage_has_two_sides():
    assert coverage_figure(95, 100, [], full=True).holds
    assert not coverage_figure(100, 100, [], full=True).holds
    assert not coverage_figure(80, 100, [], full=True).holds
    assert coverage_figure(40, 40, [], full=False).holds  # 91 to 100 %
    assert not coverage_figure(20, 40, [], full=False).holds
    assert coverage_figure(0, 0, [], full=True).holds is None


def test_bars_take_their_own_sets():
    sets = [
        *(one(k, "single", [found()], member()) for k in range(19)),
        one(19, "single", [found("offset")], member()),
        *(one(20 + k, "null") for k in range(9)),
        one(29, "null", [found()]),
        one(30, "outside", (), member("bumps_in_the_guide"), verdict="unknown"),
    ]
    rows = list(suite(sets, full=True))
    assert figure(rows, suite_figures.SINGLES).value == pytest.approx(95.0)
    assert figure(rows, suite_figures.SINGLES).holds
    assert "19 confused" in figure(rows, suite_figures.SINGLES).reason
    assert figure(rows, suite_figures.NULLS).value == pytest.approx(10.0)
    assert not figure(rows, suite_figures.NULLS).holds
    assert "29 false" in figure(rows, suite_figures.NULLS).reason
    assert figure(rows, suite_figures.OUTSIDE).value == 100.0
    assert figure(rows, suite_figures.MULTIPLES).holds is None
    assert figure(rows, suite_figures.SET_SIZE).value == pytest.approx(1.0)
    assert not any(row.figure.startswith("sets that could not") for row in rows)


def test_sizes_are_judged_by_median_and_coverage():
    sets = [one(k, "single", [found(value=2.0 * (1.0 + 0.01 * k))], member()) for k in range(11)]
    rows = list(suite(sets, full=True))
    assert figure(rows, suite_figures.SIZE_ERROR).value == pytest.approx(5.0)
    assert not figure(rows, suite_figures.SIZE_ERROR).holds
    assert figure(rows, suite_figures.COVERAGE).value == pytest.approx(100.0 * 6 / 11)  # up to 5 %


def test_gap_closed_is_pooled_and_the_worst_decile_takes_clear_gaps_only():
    shares = [0.01] * 18 + [0.5, 0.5]
    sets = [one(k, "single", [found()], member(), reducible=(100.0, 100.0 * s)) for k, s in enumerate(shares)]
    sets.append(one(90, "single", (), member(), reducible=(2.0, 2.0)))  # below three standard errors
    rows = list(suite(sets, full=True))
    assert figure(rows, suite_figures.CLOSED).value == pytest.approx(100.0 * (1.0 - 120.0 / 2002.0))
    assert figure(rows, suite_figures.CLOSED_DECILE).value == pytest.approx(50.0)
    assert not figure(rows, suite_figures.CLOSED_DECILE).holds


def test_stated_sets_are_held_against_inseparable_ones():
    sets = [
        one(1, "single", [found(aliases=[("offset", "macro_force")])], member(inseparable=[("offset", "macro_force")])),
        one(2, "single", [found()], member(inseparable=[("offset", "macro_force"), ("tilt", "macro_force")])),
    ]
    assert figure(list(suite(sets, full=True)), suite_figures.SET_SIZE).value == pytest.approx(3.0 / 5.0)


def test_a_set_that_nobody_could_judge_is_said():
    lost = marked(Searched(3, None, {"verdict": "nothing", "effects": []}, 0, (0.0, 0.0), 0.0, 0.0, "the worker died"))
    rows = list(suite([lost, one(4, "null")], full=False))
    assert rows[-1].holds is False
    assert rows[-1].reason == "the worker died"


def test_effect_by_effect():
    sets = [
        one(1, "single", [found()], member()),
        one(2, "single", [found("offset")], member()),
        one(3, "null", [found("offset")]),
    ]
    rows = {row.figure: row for row in suite_figures.effect_by_effect(sets)}
    assert rows["recall of coulomb_friction"].value == pytest.approx(50.0)
    assert "precision 100 %, 1 of 1" in rows["recall of coulomb_friction"].reason
    assert rows["recall of offset"].value is None
    assert "0 of 2 names right" in rows["recall of offset"].reason


# ---- the record of the final seeds -----------------------------------------------------------------------------------


def test_final_seeds_are_counted_before_they_are_run_and_a_run_cut_short_goes_on(tmp_path, monkeypatch):
    record = tmp_path / "gap-results.json"
    first = final_seeds.begin(record)
    assert json.loads(record.read_text())["final_seeds_were_run"] == 1
    row = one(1_000_000, "null").searched
    first.keep(row)
    again = final_seeds.begin(record)  # it was cut short: no second run
    assert again.number == 1
    assert again.kept() == {1_000_000: row}
    again.journal_of("truths").keep(1_000_001, {"kind": "single"})
    assert final_seeds.begin(record).journal_of("truths").entries == {1_000_001: {"kind": "single"}}
    bar = Bar("x", "%", 2.0)
    again.end([1_000_000], [judged_estimate(bar, share(1, 10), [1_000_000], full=True)], 3.0)
    content = json.loads(record.read_text())
    assert content["runs"][0]["sets"] == 1
    assert content["runs"][0]["figures"][0]["holds"] is False
    assert content["runs"][0]["ended"]
    assert content["runs"][0]["commit"]
    assert [path.name for path in tmp_path.iterdir()] == [record.name]  # its journal is done with
    second = final_seeds.begin(record)
    assert second.number == 2
    assert second.kept() == {}
    monkeypatch.setattr(final_seeds, "gap_hash", lambda: "other")
    assert final_seeds.begin(record).number == 3
    assert json.loads(record.read_text())["final_seeds_were_run"] == 3


def test_what_is_kept_is_not_measured_again(tmp_path):
    path, were_measured = tmp_path / "kept.jsonl", []

    def measure(seeds):
        for seed in seeds:
            were_measured.append(seed)
            yield seed, {"distance": 0.5 * seed}

    first = measured(Journal(path), [4, 6], measure)
    assert next(first) == (4, {"distance": 2.0})  # and cut short
    assert list(measured(Journal(path), [6, 4, 8], measure)) == [(seed, {"distance": 0.5 * seed}) for seed in (4, 6, 8)]
    assert list(measured(Journal(path), [8], measure)) == [(8, {"distance": 4.0})]
    assert were_measured == [4, 6, 8]


def test_a_result_of_the_gap_depends_on_what_it_imports_and_on_nothing_else():
    code = "import sys, bench.gap; print(*(getattr(one, '__file__', None) for one in list(sys.modules.values())))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    imported = {path for one in done.stdout.split() if (path := Path(one)).is_relative_to(ROOT)}
    imported = {path for path in imported if path.relative_to(ROOT).parts[0] in ("bench", "stagectl", "tests")}
    found = set(gap_sources())
    assert imported <= found  # and what is imported within functions
    names = {str(path.relative_to(ROOT)) for path in found}
    assert {"stagectl/gap/judge.py", "stagectl/effects/friction.py", "tests/blind/laws.py"} <= names
    assert not any(name.startswith(("stagectl/service", "tests/faults", "bench/service")) for name in names)
