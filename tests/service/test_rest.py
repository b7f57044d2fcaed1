"""How a stage with a micro comes to rest where that was asked for: nothing is sent off, and nothing thrown back."""

import numpy as np
import pytest

from stagectl.record import read_run
from stagectl.requests import Phase
from stagectl.service import messages
from tests.service.test_stage_loop import Bench


@pytest.fixture
def armed(tmp_path):
    """An armed stage in virtual time, homed by what the rig knows."""
    bench = Bench(tmp_path, "oled-printer")
    bench.hold_as_homed_by_truth()
    yield bench
    bench.loop.leave()
    bench.loop.run()


def stopped(bench, name, body, due):
    """Stop a command once what is true says so; returns the rows of its stop and what was true, from then on."""
    stage = bench.loop._stage
    backend, before = stage.backend, stage._progress

    def then_stop(what, share):
        if due(backend.rig.plant_state()):
            bench.desk.ask_to_stop("anna")
        before(what, share)

    stage._progress = then_stop
    key = bench.begin(name, body)
    bench.until(lambda: bench.desk.command(key).state == "done")
    assert bench.desk.command(key).stop == "OPERATOR"
    stage._progress = before
    bench.until(lambda: bench.status.state == "idle")
    rows = read_run(max(bench.settings.runs_root.glob("*-arm"))).rows
    rows = rows[rows["run_phase"] == int(Phase.STOPPING)]
    truth = backend.truth()
    after = truth["t_ns"] >= rows["t_ns"][0]
    return rows, {name: truth[name][after] for name in ("t_ns", "macro_position_m", "macro_velocity_m_per_s")}


def test_a_stop_in_an_identification_leaves_the_macro_where_it_stands(armed):
    def swings(plant):
        return abs(plant["end_velocity_m_per_s"] - plant["macro_velocity_m_per_s"]) > 1.5e-3

    rows, truth = stopped(armed, "identify", messages.Identify(duration_s=4.0), swings)
    assert np.abs(rows["setpoint_relative_velocity_m_per_s"][0]) > 1e-3
    assert np.ptp(rows["setpoint_position_m"] - rows["setpoint_relative_position_m"]) < 1e-9
    with_power = truth["t_ns"] <= rows["t_ns"][-1]
    assert np.ptp(truth["macro_position_m"][with_power]) < 2e-6


def test_power_goes_only_once_what_braked_the_macro_is_gone(armed):
    def is_fast(plant):
        return plant["macro_velocity_m_per_s"] > 0.3

    rows, truth = stopped(armed, "move", messages.Move(target_m=0.3), is_fast)
    assert rows["setpoint_velocity_m_per_s"][-1] == 0.0
    soon = (truth["t_ns"] > rows["t_ns"][-1]) & (truth["t_ns"] < rows["t_ns"][-1] + 10_000_000)
    assert np.abs(truth["macro_velocity_m_per_s"][soon]).max() < 0.5e-3
