"""A drive whose mode of operation another master changes at work: it says so itself, and is stopped for that."""

import numpy as np
import pytest

from drivers import cia402
from sim_backend.faults import Fault
from stagectl.errors import DriveError
from stagectl.record import read_run
from stagectl.replay import replay_run
from stagectl.requests import TICKING, Phase
from stagectl.signals import MODES, Stop
from tests.struck_stage import Stage, inject

MACRO, MICRO = 1, 2  # node ids
STALE_M = 2e-3  # within the drive's own following-error window of 5 mm: it makes for that target, and reports nothing
MACRO_INPUTS = 0x281
CYCLE_NS = 1_000_000


def written(node_id: int, index: int, value: int) -> Fault:
    return Fault("object_change", node_id=node_id, index=index, subindex=0, value=value)


def sent_to_a_stale_target(one: Stage, encoder_step_m: float) -> tuple[Fault, Fault]:
    """Let the macro's drive hold a target near by, and change its mode to one that goes there."""
    target = one.stage.master.read(MACRO, cia402.POSITION_ACTUAL_VALUE) + round(STALE_M / encoder_step_m)
    return written(MACRO, cia402.TARGET_POSITION, target), written(MACRO, cia402.MODES_OF_OPERATION, MODES["position"])


def held_and_struck(one: Stage, *faults: Fault) -> tuple[int, dict[str, np.ndarray]]:
    """Hold under the law in force mode, strike, and let it end; returns when it was struck and the truth since then."""
    assert one.arm() is Stop.NONE
    one.stage.pump(0.1)
    struck_t_ns = one.backend.wire.t_ns
    inject(*faults)(one.stage, one.backend)
    for _ in range(20):
        one.stage.pump(0.1)
    truth = one.backend.truth()
    return struck_t_ns, {name: values[truth["t_ns"] >= struck_t_ns] for name, values in truth.items()}


def test_a_macro_that_another_master_sends_to_a_stale_target_is_stopped_at_once(tmp_path, oled_profile, oled_machine):
    """It leapt to 0.2 m/s within 8 ms, at full force, until the micro was at the end of its stroke."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        faults = sent_to_a_stale_target(one, oled_profile.macro.encoder_step_m)
        struck_t_ns, truth = held_and_struck(one, *faults)
        status = one.stage.status()
        assert (status["phase"], status["stop"]) == (Phase.STOPPED, Stop.DRIVE_MODE)
        assert one.stage.detail == (
            "macro (node 1): mode of operation 0x6061 is 8, wanted 10; see who else on the bus writes 0x6060, then "
            "acknowledge"
        )
        one.stage.acknowledge()
        with pytest.raises(DriveError, match=r"0x6061 is 8, wanted 10"):
            one.stage.enable()
    run = read_run(tmp_path / "run")
    rows = run.rows
    first = rows[np.flatnonzero(rows["stop"] > 0)[0]]
    assert first["stop"] == Stop.DRIVE_MODE
    assert first["t_ns"] - struck_t_ns < 2 * CYCLE_NS
    assert Phase.GUIDED_STOP in rows["run_phase"]  # the micro obeys: it is kept off its stops
    assert np.ptp(truth["macro_position_m"]) < 0.5e-3
    relative_m = truth["end_position_m"] - truth["macro_position_m"]
    assert np.abs(relative_m).max() < oled_profile.micro.stroke_m[1]
    assert replay_run(run).differing_rows == 0


def test_without_its_word_the_same_is_noticed_by_what_it_does(tmp_path, oled_profile, oled_machine):
    """What it costs where a drive can't tell: the reason why it is to tell."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        silent = Fault("drop_frame", can_id=MACRO_INPUTS, duration_s=10.0)
        _, truth = held_and_struck(one, silent, *sent_to_a_stale_target(one, oled_profile.macro.encoder_step_m))
        assert one.stage.status()["stop"] == Stop.FORCE_UNHEEDED
        assert one.stage.detail.startswith("macro (node 1) reports ")
    assert np.abs(truth["macro_velocity_m_per_s"]).max() > 0.02


def test_a_micro_in_another_mode_is_not_guided(tmp_path, oled_profile, oled_machine):
    """0 is a mode, too: none, in which a drive does nothing."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        held_and_struck(one, written(MICRO, cia402.MODES_OF_OPERATION, 0))
        assert one.stage.status()["stop"] == Stop.DRIVE_MODE
        assert "micro (node 2): mode of operation 0x6061 is 0, wanted 10" in one.stage.detail
    rows = read_run(tmp_path / "run").rows
    assert Phase.GUIDED_STOP not in rows["run_phase"]


def test_a_mode_that_changes_while_the_other_axis_brakes_is_noticed(tmp_path, oled_profile, oled_machine):
    """The macro's own no longer counts: its drive brakes it in any."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        assert one.arm() is Stop.NONE
        at_s = 0.02
        later = Fault("object_change", node_id=MICRO, index=cia402.MODES_OF_OPERATION, subindex=0, value=0, at_s=at_s)
        outcome = one.move(inject(written(MACRO, cia402.MODES_OF_OPERATION, cia402.MODE_HOMING), later))
        assert outcome.stop is Stop.DRIVE_MODE
        assert "macro (node 1): mode of operation 0x6061 is 6" in outcome.detail
        assert "micro (node 2): mode of operation 0x6061 is 0" in outcome.detail
    rows = read_run(tmp_path / "run").rows
    guided = np.count_nonzero(rows["run_phase"] == Phase.GUIDED_STOP)
    assert 1e3 * at_s - 4 < guided < 1e3 * at_s + 4


def test_a_row_holds_the_modes_that_the_drives_told(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        assert one.arm() is Stop.NONE
        one.stage.pump(0.1)
    rows = read_run(tmp_path / "run").rows
    ticking = rows[np.isin(rows["run_phase"], [int(phase) for phase in TICKING])]
    assert len(ticking) > 100
    for axis in ("macro", "micro"):
        assert set(ticking[f"{axis}_mode_display"]) == {MODES["torque"]}
    assert set(ticking["modes_told"]) == {3}
