"""What counts as right and as wrong on EMPS."""

import pytest

from bench import emps_figures
from bench.emps_figures import right_names, wrong_names
from stagectl.gap.findings import Findings, Named


def named(name, aliases=(), **parameters):
    return Named(name, "macro_force", parameters, {}, 9.0, 9.0, tuple((alias, "macro_force", 1.0) for alias in aliases))


def findings(*effects):
    nothing = (0.0, 0.0)
    return Findings("emps", (), (), "found", effects, (), {}, (), None, nothing, nothing, nothing)


def test_all_four_by_name_or_by_alias():
    asymmetric = named("asymmetric_viscous_friction")
    screw = named("harmonic_cogging", pitch_m=2.501e-3)
    everything = {"coulomb_friction", "offset", "asymmetric_viscous_friction", "cogging"}
    assert right_names(findings(named("coulomb_friction"), named("offset"), asymmetric, screw)) == everything
    assert right_names(findings(named("asymmetric_coulomb_friction"), asymmetric, screw)) == everything
    assert right_names(findings(named("coulomb_friction"), named("gravity_tilt", ["offset"]))) == {
        "coulomb_friction",
        "offset",
    }


@pytest.mark.parametrize("pitch_m", [2.47e-3, 2.53e-3, 1.25e-3])
def test_a_force_of_another_pitch_is_not_the_screw(pitch_m):
    assert right_names(findings(named("cogging", pitch_m=pitch_m))) == set()


def test_tilt_is_wrong_as_a_name_and_not_as_an_alias():
    assert wrong_names(findings(named("gravity_tilt"), named("stribeck_friction"))) == {
        "gravity_tilt",
        "stribeck_friction",
    }
    assert wrong_names(findings(named("offset", ["gravity_tilt"]), named("coulomb_friction"))) == set()


def test_without_its_data_every_row_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("STAGECTL_DATA", str(tmp_path))
    rows = list(emps_figures.figures(lambda text: None))
    assert [row.holds for row in rows] == [None] * len(rows)
    assert all("STAGECTL_DATA" in row.reason for row in rows)
    assert len(rows) == 7
