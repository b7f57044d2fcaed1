"""The arbiter of the gap workflow on a real axis: EMPS (Janot, Gautier, Brunot 2019), where the data is at hand."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from stagectl.gap import addition, arbiter, moves, next_move, prediction
from stagectl.gap.believed import load_believed
from stagectl.gap.log import Log
from stagectl.gap.workflow import find

_DATA = Path(os.environ.get("STAGECTL_DATA", "")) / "emps"
_NEWTONS_PER_VOLT = 35.1507

pytestmark = pytest.mark.skipif(
    not (_DATA / "DATA_EMPS.mat").exists(), reason="STAGECTL_DATA names no folder with emps/DATA_EMPS.mat"
)


@pytest.fixture(scope="module")
def believed():
    return load_believed(Path(__file__).parent.parent / "profiles" / "observed" / "emps.toml")


def _log(name: str) -> Log:
    table = {key: np.ravel(value) for key, value in loadmat(_DATA / f"{name}.mat").items() if key[0] != "_"}
    extra = table["pulses_N"] * 1.014 * _NEWTONS_PER_VOLT if "pulses_N" in table else None
    return Log(
        name, 1e-3, table["qm"], table["vir"] * _NEWTONS_PER_VOLT, np.ones(table["qm"].size, bool), name,
        reference_m=table["qg"], command_extra_n=extra,
    )  # fmt: skip


def test_closed_loop_with_the_published_parameters_leaves_what_was_published(believed):
    """Parameters of Janot et al. 2019 and, asymmetric, of Janot 2017: they leave 2.44 and 1.97 N (measured)."""
    log = _log("DATA_EMPS")
    dry = {"name": "coulomb_friction", "acts_on": "macro_force", "level_n": 20.3935, "smoothing_m_per_s": 1e-4}
    viscous = {"name": "viscous_friction", "acts_on": "macro_force", "damping_n_s_per_m": 203.5034}
    offset = {"name": "offset", "acts_on": "macro_force", "force_n": 3.1648}
    asymmetric = {
        "name": "asymmetric_viscous_friction",
        "acts_on": "macro_force",
        "forward_n_s_per_m": 166.7,
        "backward_n_s_per_m": 240.4,
    }
    four = arbiter.gap_of(log, arbiter.simulate(believed, [viscous, dry, offset], log))
    better = arbiter.gap_of(log, arbiter.simulate(believed, [asymmetric, dry, {**offset, "force_n": 0.255}], log))
    assert four.command_n == pytest.approx(2.44, rel=0.03)
    assert better.command_n == pytest.approx(1.97, rel=0.03)
    assert arbiter.lap_samples(log.reference_m) == 6240
    assert four.command_floor_n == pytest.approx(0.343, rel=0.15)


def test_controller_that_ran_is_told_from_another(believed):
    log = _log("DATA_EMPS")
    assert arbiter.cannot_close(believed, log) == ""
    pulses = _log("DATA_EMPS_PULSES")
    without = Log(
        "x", 1e-3, pulses.macro_position_m, pulses.macro_command_n, pulses.valid, "x", reference_m=pulses.reference_m
    )
    assert "other commands than recorded" in arbiter.cannot_close(believed, without)


@pytest.fixture(scope="module")
def findings(believed):
    """What one of the two recordings shows."""
    return find(believed, [_log("DATA_EMPS")])


def test_effects_of_the_axis_are_named_from_one_recording_and_hold_on_the_other(believed, findings):
    """Reversals in passing can't tell dry from sub-linear friction; a rise before standstill would be neither."""
    log, pulses = _log("DATA_EMPS"), _log("DATA_EMPS_PULSES")
    dry, asymmetric, screw = findings.named
    names = {dry.name, *(alias[0] for alias in dry.aliases)}
    assert {"sublinear_viscous_friction", "asymmetric_coulomb_friction", "dahl_friction"} <= names
    assert "stribeck_friction" not in names
    assert asymmetric.name == "asymmetric_viscous_friction"
    assert screw.parameters["pitch_m"] == pytest.approx(2.5e-3, abs=0.02e-3)
    assert findings.parameter_errors == ()
    gaps_n = []
    for one in (log, pulses):
        effects = addition.effects_with(believed, findings, findings.named, log.session)
        gaps_n.append(arbiter.gap_of(one, arbiter.simulate(believed, effects, one, findings.refitted)).command_n)
    assert gaps_n[0] < 1.35
    assert gaps_n[1] < 2.85


def test_slow_reversals_are_asked_for_to_settle_the_low_speed_law(believed, findings):
    """A planned motion has no noise: read off it as if it were measured, a sine of 3 Hz told 28 times as much."""
    log = _log("DATA_EMPS")
    library = moves.library(moves.room_of_motion([log.macro_position_m], log.period_s))
    proposed = next_move.proposals(prediction.evidence(believed, [log], findings), library)
    asked = {one.name: one for one in proposed}["sublinear_viscous_friction"]
    assert asked.move.name == "slow reversals"
    assert ("coulomb_friction", "macro_force") in asked.against
