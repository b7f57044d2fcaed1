"""The page of the gap demo, from values: four numbers, figures of both, and a way to the page of the search."""

import dataclasses
import re

import numpy as np

from stagectl.gap import demo_page
from stagectl.gap.demo_page import Closed, Followed
from stagectl.gap.findings import Findings, Named
from stagectl.gap.prediction import Outcome
from stagectl.gap.residual import residuals
from tests.test_gap_page import _believed, _pushed, _sine


def _followed(size_m: float) -> Followed:
    error_m = size_m * np.sqrt(2.0) * _sine(3000, 1.0, 1.0)
    error_m[0] = np.nan  # a sample without truth
    return Followed(np.arange(3000) * 1e-3, _sine(3000, 0.5, 0.1), error_m)


def _closed() -> Closed:
    friction = Named("offset", "macro_force", {"force_n": 0.4}, {"force_n": 0.01}, 90.0, 80.0, (), confirmed=True)
    found = Findings("axis", ("a",), ("b",), "found", (friction,), (), {}, (), None, (90.0, 80.0), (1.0, 2.0), 16.0)
    training = _pushed(_sine(3000, 1.0, 9.0), np.full(3000, 0.4))
    held = dataclasses.replace(training, name="b")
    outcome = Outcome("offset", "macro_force", "N", 0.4, 0.012, 0.388, 80.0, 1.0, True, (), ())
    return Closed(
        "offset on macro_force: force_n = 0.4", found, residuals(_believed(), found, [training], [held]), outcome,
        "slow reversals", "fast stroke", _followed(4e-6), _followed(1e-6),
    )  # fmt: skip


def test_the_page_shows_four_numbers_three_figures_and_the_way_to_the_search():
    text = demo_page.page(_closed(), "findings.html", [("found.toml", "the profile")]).html()
    for number in ("400 mN", "12.0 mN", "4.00 µm", "1.00 µm", "4.0 times closer"):
        assert number in text, number
    assert text.count("<svg") == 3
    assert re.findall(r'href="(?!#|data:)([^"]+)"', text) == ["findings.html"]
    for words in ("offset on macro_force", "slow reversals", "fast stroke", "found.toml"):
        assert words in text
    assert "before: peak" in text
    assert "after: peak" in text
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL)
