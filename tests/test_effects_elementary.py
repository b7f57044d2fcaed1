"""Functions that laws are made of: the libraries' numbers, nothing where nothing is left, nan where unknown."""

import math

import numpy as np
import pytest

from stagectl.effects.elementary import fading, power_of_rest, wave


@pytest.mark.parametrize("x", [-2.0, 0.0, 1e-9, 0.7, 40.0, 699.9])
def test_what_fades_is_the_exponential(x):
    assert fading(x) == pytest.approx(math.exp(-x), rel=1e-15)


@pytest.mark.parametrize("x", [701.0, 745.0, 1e9, math.inf])
def test_nothing_is_left_where_it_is_hardly_a_number(x):
    assert fading(x) == 0.0


@pytest.mark.parametrize(("base", "left"), [(-0.3, 0.0), (0.0, 0.0), (0.25, 0.5), (4.0, 2.0)])
def test_no_power_is_left_of_nothing(base, left):
    assert power_of_rest(base, 0.5) == left


def test_a_wave_without_an_amplitude_is_none():
    assert wave(0.0, 0.4) == 0.0
    assert wave(-3.0, 0.4) == pytest.approx(-3.0 * math.sin(0.4), rel=1e-15)
    assert wave(2.0, np.array([0.0, 0.5 * math.pi])) == pytest.approx([0.0, 2.0])


@pytest.mark.parametrize(
    "law", [fading, lambda x: power_of_rest(x, 0.5), lambda x: wave(x, 0.4), lambda x: wave(1.0, x)]
)
def test_what_is_unknown_stays_unknown(law):
    assert math.isnan(law(math.nan))
