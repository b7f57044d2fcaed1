"""Closer looks of the gap workflow: what is the same to first order, and what is known along readings without it.

Sets of the blind suite, shortened; their truths are asked of the generator.
"""

from pathlib import Path

import pytest

from bench.blind_sets import load_set
from stagectl.gap.findings import Named
from stagectl.gap.workflow import find
from tests.blind import generate


def _named(seed: int, duration_s: float, folder: Path) -> tuple[Named, dict[str, float]]:
    """Return the one name that is found in a set, and the parameters of the one effect that is hidden there."""
    case = generate.draw(seed, None, duration_s)
    generate.write(case, folder)
    blind = load_set(folder)
    (named,) = find(blind.believed, list(blind.logs), [], nulls_count=20).named
    (hidden,) = generate.truth(case)["effects"]
    assert (named.name, named.acts_on) == (hidden["name"], hidden["acts_on"])
    return named, hidden["parameters"]


def test_a_cyclic_error_has_its_size_along_readings_without_it(tmp_path):
    """Along what the past foretells, which such an error spoils by 0.1 um, 17.9 nm were 1.9 nm."""
    named, hidden = _named(2119, 5.0, tmp_path)
    size, sd = named.parameters["first_m of session 0"], named.sds["first_m of session 0"]
    assert sd < 0.01 * hidden["amplitude_m"]
    assert size == pytest.approx(hidden["amplitude_m"], abs=3.0 * sd)
    assert named.parameters["second_m of session 0"] < 3.0 * named.sds["second_m of session 0"]


def test_a_delay_is_told_from_a_lag_at_its_size(tmp_path):
    """Their columns are one and the same; where the joint touches 0.17 ms of one or of the other are not."""
    named, hidden = _named(2122, 6.0, tmp_path)
    assert ("sensor_lag", "macro_sensor") not in [alias[:2] for alias in named.aliases]
    assert named.parameters["delay_s"] == pytest.approx(hidden["delay_s"], abs=3.0 * named.sds["delay_s"])
