"""The verdict on ten pages: exact against SciPy's signed-rank test, and blind to which pairs share a burst."""

import numpy as np
import pytest
from scipy.stats import wilcoxon

from bench.ten_pages import Window, figures_of, lower_limit


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


def judged_pairs(increase, bursts=()):
    """Windows of a minute that miss 3 to 10 cycles, those with pages `increase` more."""
    none = [Window(3 + k, 60_000, 60.0, True) for k in range(8)]
    ten = [Window(3 + k + increase + (500 if k in bursts else 0), 60_000, 60.0, True) for k in range(8)]
    return next(figures_of(list(zip(none, ten, strict=True))))


def test_one_more_miss_in_each_window_is_an_increase_and_a_burst_in_one_is_none():
    assert judged_pairs(1).holds is False
    assert judged_pairs(0).holds is True
    assert judged_pairs(-1, bursts=(3,)).holds is True
    assert judged_pairs(1, bursts=(3,)).holds is False  # nor does it hide one
