"""The inverse-dynamics fit: on recordings made without the project's code, and on EMPS where its data is at hand."""

from dataclasses import replace

import numpy as np
import pytest

from bench import emps
from stagectl.errors import RequestError
from stagectl.gap.inverse_dynamics import FRICTION, fit_inverse_dynamics
from stagectl.gap.log import Log
from tests.gap_tables import MASS_KG, H, axis_table

LEVEL_N = 3.0
EMPS = emps.folder()
needs_emps = pytest.mark.skipif(EMPS is None, reason="STAGECTL_DATA names no folder with emps/DATA_EMPS.mat")


def log_of(seed: int, payload_kg: float = 0.0, friction_n: float = LEVEL_N) -> Log:
    table = axis_table(seed, friction_n=friction_n)
    return Log(
        f"table {seed}", H, table["position"], table["command"], np.ones(table["position"].size, bool), "1",
        macro_payload_kg=payload_kg,
    )  # fmt: skip


def test_mass_and_friction_of_a_known_axis():
    """Under a slow force of 0.05 N rms that nobody models; at 0.06 m/s it makes 1 N s/m."""
    found = fit_inverse_dynamics([log_of(1), log_of(2)])
    assert found.values["mass_kg"] == pytest.approx(MASS_KG, rel=5e-3)
    assert found.values["coulomb_friction.level_n"] == pytest.approx(LEVEL_N, rel=0.02)
    assert found.values["viscous_friction.damping_n_s_per_m"] == pytest.approx(0.0, abs=2.0)
    assert found.values["offset.force_n"] == pytest.approx(0.0, abs=0.05)
    assert all(left_n < 0.35 for left_n in found.left_n)


def test_what_it_carries_is_taken_off():
    """The same motion and forces with 5 kg on top: 5 kg less are the axis' own."""
    bare, loaded = (fit_inverse_dynamics([log_of(1, payload_kg=kg)]).values["mass_kg"] for kg in (0.0, 5.0))
    assert bare - loaded == pytest.approx(5.0, rel=1e-9)


def test_a_recording_counts_by_what_is_left_of_it():
    """One in which friction was three times as high leaves more, and pulls less than its half."""
    quiet, other = log_of(1), log_of(2, friction_n=3.0 * LEVEL_N)
    loud = replace(other, macro_command_n=other.macro_command_n + 4.0 * np.sin(40.0 * other.times_s))
    level_n = fit_inverse_dynamics([quiet, loud]).values["coulomb_friction.level_n"]
    assert LEVEL_N < level_n < 1.7 * LEVEL_N


def test_missing_samples_are_left_out():
    log = log_of(3)
    valid, spoilt = log.valid.copy(), log.macro_command_n.copy()
    spoilt[4000:4100] = 500.0
    valid[4000:4100] = False
    whole = fit_inverse_dynamics([log])
    marked = fit_inverse_dynamics([replace(log, macro_command_n=spoilt, valid=valid)])
    assert marked.rows < whole.rows
    assert marked.values["mass_kg"] == pytest.approx(whole.values["mass_kg"], rel=2e-3)


@pytest.mark.parametrize(
    ("laws", "text"),
    [
        ({"no_such_law": {}}, "no effect is called"),
        ({"sensor_delay": {}}, "no force of one axis"),
        ({"coulomb_friction": {}}, "smoothing_m_per_s is not solved for"),
        ({"micro_reaction": {}}, "one axis' position and force lack"),
        ({"offset": {}, "asymmetric_coulomb_friction": {"smoothing_m_per_s": 1e-7}, **FRICTION}, "can't tell"),
    ],
)
def test_what_cant_be_solved_is_refused(laws, text):
    with pytest.raises(RequestError, match=text):
        fit_inverse_dynamics([log_of(1)], laws)


def test_too_short_is_refused():
    log = log_of(1)
    short = replace(
        log, macro_position_m=log.macro_position_m[:400], macro_command_n=log.macro_command_n[:400],
        valid=log.valid[:400],
    )  # fmt: skip
    with pytest.raises(RequestError, match="record longer"):
        fit_inverse_dynamics([short])
    with pytest.raises(RequestError, match="corner_hz is 600"):
        fit_inverse_dynamics([log], corner_hz=600.0)


@needs_emps
def test_emps_gives_what_was_published():
    """Within 0.5 % each; printed beside them 4.08 % of the force left."""
    assert EMPS is not None
    _, training, _ = emps.read(EMPS)
    found = fit_inverse_dynamics(training)
    for name, value in emps.PUBLISHED.items():
        assert found.values[name] == pytest.approx(value, rel=5e-3), name
    assert found.left_ratio == pytest.approx(0.0408, rel=0.02)


@needs_emps
def test_emps_is_asymmetric_as_published():
    """Janot 2017: 166.7 and 240.4 N s/m, 3.11 % of the force left."""
    assert EMPS is not None
    _, training, _ = emps.read(EMPS)
    laws = {"asymmetric_viscous_friction": {}, "coulomb_friction": FRICTION["coulomb_friction"], "offset": {}}
    found = fit_inverse_dynamics(training, laws)
    assert found.values["asymmetric_viscous_friction.forward_n_s_per_m"] == pytest.approx(166.7, rel=5e-3)
    assert found.values["asymmetric_viscous_friction.backward_n_s_per_m"] == pytest.approx(240.4, rel=5e-3)
    assert found.left_ratio == pytest.approx(0.0311, rel=0.03)
