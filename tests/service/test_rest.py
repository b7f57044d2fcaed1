"""How a stage with a micro comes to rest where that was asked for: nothing is sent off, and nothing thrown back."""

import threading
import time

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


def test_a_stop_that_is_obeyed_before_it_is_answered_lets_nothing_begin(tmp_path):
    """Whoever asks is held up behind the word itself: the stage's thread may see to it and look for work meanwhile."""
    bench = Bench(tmp_path)
    bench.loop.show()
    bench.until(lambda: bench.status.state == "idle")
    bench.loop.step()
    bench.take()
    key = bench.begin("home", messages.Home())
    asks = threading.Thread(target=bench.desk.ask_to_stop, args=("anna",))
    with bench.desk._lock:  # others wait for it; this thread, which is the stage's, does not
        asks.start()
        give_up_s = time.monotonic() + 10.0
        while not bench.desk.stop_asked:
            assert time.monotonic() < give_up_s, "a stop waits for a client that has the desk's lock"
            time.sleep(1e-3)
        for _ in range(3):
            bench.loop.step()
    asks.join()
    home = bench.desk.command(key)
    assert (home.state, home.error.kind) == ("failed", "Busy")
    assert home.text == "home: stopped before it began: anna"
    assert (bench.status.state, bench.desk.stop_asked) == ("idle", False)
    assert "moving" not in [entry.fields["state"] for entry in bench.log.last(200) if entry.event == "state"]
    assert bench.do("arm", messages.Arm()).error.message.endswith("home it first")  # what comes later is heard again
    bench.loop.leave()
    bench.loop.run()
