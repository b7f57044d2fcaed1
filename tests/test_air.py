"""Ciddor's index of air against published and independently computed values; the ramp."""

import math

import pytest

from drivers.air import ciddor_index, ramped_index
from stagectl.errors import RequestError

HENE_M = 632.991e-9


@pytest.mark.parametrize(
    ("wavelength_m", "degc", "pa", "rh", "co2", "index"),
    [
        # ref_index 1.0 (BSD), values of its page; the default 450 ppm.
        (633e-9, 20, 101325, 20, 450, 1.0002716285340578),
        (633e-9, 20, 101325, 80, 450, 1.0002711183472626),
        (633e-9, 60, 101325, 80, 450, 1.0002340241754055),
        # Computed twice from NIST's text, apart from this code.
        (HENE_M, 20, 101325, 50, 450, 1.0002713729),
        (HENE_M, 20, 101325, 0, 450, 1.0002717999),
        (HENE_M, 20, 101325, 50, 400, 1.0002713657),
        (HENE_M, 15, 101325, 0, 450, 1.0002765303),
        (HENE_M, 23, 100000, 40, 450, 1.0002651128),
        (HENE_M, 25, 80000, 75, 450, 1.0002101215),
        # Ciddor 1996, table 1: dry air, 633 nm.
        (633e-9, 20, 80000, 0, 450, 1 + 21458.0e-8),
        (633e-9, 20, 100000, 0, 450, 1 + 26824.4e-8),
        (633e-9, 20, 120000, 0, 450, 1 + 32191.6e-8),
        (633e-9, 10, 100000, 0, 450, 1 + 27774.7e-8),
        (633e-9, 30, 100000, 0, 450, 1 + 25937.2e-8),
    ],
)
def test_published_values(wavelength_m, degc, pa, rh, co2, index):
    assert ciddor_index(wavelength_m, degc, pa, rh, co2) == pytest.approx(index, abs=1e-9, rel=0)


def test_published_digits():
    """The full digits of the reference implementation, not only the bar."""
    assert ciddor_index(633e-9, 20, 101325, 20, 450) == pytest.approx(1.0002716285340578, abs=2e-15, rel=0)


def test_sensitivities():
    here = ciddor_index(HENE_M, 20, 101325, 50, 450)
    assert ciddor_index(HENE_M, 21, 101325, 50, 450) - here == pytest.approx(-0.955e-6, abs=0.01e-6)
    assert ciddor_index(HENE_M, 20, 101425, 50, 450) - here == pytest.approx(0.268e-6, abs=0.001e-6)
    assert ciddor_index(HENE_M, 20, 101325, 50, 550) - here == pytest.approx(0.0143e-6, abs=0.0001e-6)
    assert ciddor_index(HENE_M, 20, 101325, 51, 450) - here == pytest.approx(-0.0085e-6, abs=0.0001e-6)


def test_ice_and_water_meet_at_zero():
    below = ciddor_index(HENE_M, -1e-9, 101325, 100, 450)
    above = ciddor_index(HENE_M, 0.0, 101325, 100, 450)
    assert below == pytest.approx(above, abs=1e-9, rel=0)


@pytest.mark.parametrize("place", range(5))
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e9, 1e9])
def test_out_of_range_is_refused(place, value):
    conditions = [HENE_M, 20.0, 101325.0, 50.0, 450.0]
    conditions[place] = value
    with pytest.raises(RequestError, match="outside"):
        ciddor_index(*conditions)


def test_more_vapour_than_pressure_is_refused():
    with pytest.raises(RequestError, match="vapour"):
        ciddor_index(HENE_M, 95.0, 20_000.0, 100.0, 450.0)


def test_ramp_moves_no_position_by_more_than_the_limit():
    index, target, position_m = 1.00027, 1.00027 + 1e-6, 0.45
    steps = 0
    while index != target:
        following = ramped_index(index, target, position_m)
        assert abs(position_m * index / following - position_m) <= 1.0001e-10
        assert following > index
        index = following
        steps += 1
    # 1e-6 of 0.45 m is 450 nm, in steps of 0.1 nm.
    assert 4490 <= steps <= 4510


def test_ramp_goes_both_ways_and_jumps_where_nothing_moves():
    assert ramped_index(1.0003, 1.0002, -0.4) < 1.0003
    assert ramped_index(1.0003, 1.0002, 0.0) == 1.0002
    assert ramped_index(1.0003, math.nan, 0.4) == 1.0003
    assert ramped_index(1.0003, 1.0002, math.nan) == 1.0003
