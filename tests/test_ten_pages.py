"""The verdict on ten pages: exact against SciPy's signed-rank test, and blind to which pairs share a burst."""

import numpy as np
import pytest
from scipy.stats import wilcoxon

from bench.ten_pages import (
    INCREASE,
    INCREASE_LOAD,
    LATE,
    WITH_PAGES,
    Window,
    Windows,
    figures_of,
    lower_limit,
    with_power,
)


@pytest.mark.parametrize("seed", range(20))
def test_the_limit_is_where_the_signed_rank_test_begins_to_reject(seed):
    rng = np.random.default_rng(seed)
    differences = rng.standard_cauchy(int(rng.integers(5, 20))) + 0.5
    limit = lower_limit(differences)
    just_below, just_above = differences - limit + 1e-9, differences - limit - 1e-9
    assert wilcoxon(just_below, alternative="greater", method="exact").pvalue <= 0.05
    assert wilcoxon(just_above, alternative="greater", method="exact").pvalue > 0.05


def test_four_pairs_show_nothing():
    with pytest.raises(ValueError, match="five or more"):
        lower_limit([1.0, 2.0, 3.0, 4.0])


def judged_windows(increase, bursts=(), load_increase=0):
    """Windows of a minute that miss 3 to 10 cycles, those with pages or another load so many more; by figure."""
    none = [Window(3 + k, 60_000, 60.0, True) for k in range(8)]
    ten = [Window(3 + k + increase + (500 if k in bursts else 0), 60_000, 60.0, True, 300) for k in range(8)]
    load = [Window(3 + k + load_increase, 60_000, 60.0, True) for k in range(8)]
    return {one.figure: one for one in figures_of([Windows(*each) for each in zip(none, ten, load, strict=True)])}


def test_one_more_miss_in_each_window_is_an_increase_and_a_burst_in_one_is_none():
    assert judged_windows(1)[INCREASE.figure].holds is False
    assert judged_windows(0)[INCREASE.figure].holds is True
    assert judged_windows(-1, bursts=(3,))[INCREASE.figure].holds is True
    assert judged_windows(1, bursts=(3,))[INCREASE.figure].holds is False  # nor does it hide one


def test_a_verdict_says_what_it_could_not_have_told():
    """Eight pairs apart by -30 to 40 a minute: 95 % from -15 on; 20 more in each pair, and the lower end is above 0."""
    apart = [-30, -20, -10, 0, 10, 20, 30, 40]
    one = Window(100, 60_000, 60.0, True)
    for added, holds in ((0, True), (15, True), (16, False)):
        found = [Windows(one, one._replace(missed_count=100 + k + added), one) for k in apart]
        figure = next(figures_of(found))
        assert (figure.holds, figure.value) == (holds, -15.0 + added)
        assert (
            f"{5 + added:+.2f}, 95 % each way {-15 + added:+.2f} .. {25 + added:+.2f}; an increase of up to 20.00 "
            in (figure.reason)
        )


def test_a_load_without_a_client_has_a_row_of_its_own_and_excuses_nothing():
    figures = judged_windows(5, load_increase=5)
    assert figures[INCREASE.figure].holds is False
    assert (figures[INCREASE_LOAD.figure].value, figures[INCREASE_LOAD.figure].holds) == (5.0, None)


def windows(held, missed=3):
    window = Window(missed, 60_000, 60.0, True)
    return Windows(window, window._replace(missed_count=-900, held=held), window)


def test_windows_without_power_are_left_out_on_all_sides():
    """A servo made anew counts from 0: its window would speak for the pages."""
    found = {one.figure: one for one in figures_of([windows(True)] * 6)}
    assert found[WITH_PAGES.figure].value == -900.0
    kept = [Windows(*[Window(3, 60_000, 60.0, True)] * 3)] * 6
    found = {one.figure: one for one in figures_of([*kept, windows(False)])}
    assert found[WITH_PAGES.figure].value == 3.0
    assert "power on in 6 of 7 pairs" in found[INCREASE.figure].reason
    (few,) = figures_of([*kept[:4], windows(False)])
    assert few.holds is False


def test_windows_in_which_the_stage_lost_its_power_are_drawn_again():
    drawn = iter([windows(False), windows(False), windows(True)])
    assert with_power(lambda: next(drawn)).ten.held
    assert not with_power(lambda: windows(False)).ten.held


def test_late_lines_are_counted_in_each_kind_of_window():
    figures = judged_windows(0)
    assert figures[LATE["ten"].figure].value == 0.5
    assert figures[LATE["none"].figure].value == 0.0
