"""Replay: bit for bit from the raw bytes, for every law on every machine, and it notices what was changed."""

import dataclasses
import shutil

import numpy as np
import pytest

from bench import replaying
from drivers.air import ciddor_index
from sim_backend.air import index_of
from sim_backend.machine import load_machine
from stagectl.backend import BatchBackend
from stagectl.errors import RecordError
from stagectl.profile import load_profile
from stagectl.record import Recorder, Run, read_run
from stagectl.replay import replay, replay_run
from stagectl.row import new_rows
from stagectl.supervisor import Supervisor
from stagectl.tracker import LAW_NAMES
from tests.effect_numbers import everything_that_remembers
from tests.stage import with_values


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run of the machine with one axis: homing, both laws, stops."""
    return replaying.record("single-axis", 3, tmp_path_factory.mktemp("replay") / "single-axis")


def test_what_effects_remember_is_replayed(oled_profile, oled_machine, tmp_path):
    """A memory is a part of the observer's state: in the snapshot, in its copies, forgotten at a fresh start."""
    extra = everything_that_remembers()
    profile = with_values(oled_profile, effects=(*oled_profile.effects, *extra))
    machine = with_values(oled_machine, effects=(*oled_machine.effects, *extra))
    run = replaying.record_of(profile, machine, 4, tmp_path / "remembers")
    assert np.sum(run.rows["setpoint_velocity_m_per_s"] != 0.0) > 600
    found = replay_run(run)
    assert found.differing_rows == 0, found.first_difference


@pytest.mark.parametrize("name", replaying.MACHINES)
def test_every_law_on_every_machine_bit_for_bit(name, tmp_path):
    found = replaying.replayed(name, 2, tmp_path / name)
    assert found.differing_rows == 0, found.first_difference
    assert set(found.ticks) == set(LAW_NAMES)
    for law, ticks in found.ticks.items():
        assert ticks > 300, f"{law} hardly moved"


def changed(run: Run, name: str, row: int, byte: int, bit: int) -> Run:
    """Copy a run with one bit of one recorded byte flipped."""
    rows = run.rows.copy()
    rows[name][row, byte] ^= 1 << bit
    return dataclasses.replace(run, rows=rows)


def moving_row(run: Run, wanted: str) -> int:
    """Return a row in the midst of motion in which `wanted` holds bytes."""
    there = (run.rows["setpoint_velocity_m_per_s"] != 0.0) & (run.rows[wanted] > 0)
    rows = np.flatnonzero(there)
    return int(rows[rows.size // 2])


@pytest.mark.parametrize("byte", [0, 3, 6, 13, 22, 24])
def test_a_flipped_bit_in_a_sensor_byte_is_noticed(recorded, byte):
    """Sync, sequence, both ends of the count, status, checksum: each makes another sample, or none, of the line."""
    row = moving_row(recorded, "sensor_bytes_count")
    found = replay_run(changed(recorded, "sensor_bytes", row, byte, 0))
    assert not found.exact
    assert found.first_difference.startswith(f"row {row},")


def test_a_run_of_drives_that_told_their_inputs_alone_replays(recorded):
    """Older runs have no 0x6061 in TPDO2, and no field for it in their rows."""
    rows, mappings = recorded.rows.copy(), recorded.manifest["mappings"]
    assert rows["modes_told"].any()
    for name in ("modes_told", "macro_mode_display", "micro_mode_display"):
        rows[name] = 0
    counts = rows["macro_inputs_tpdo_count"]
    counts[counts > 0] = 4
    older = {axis: {**mapping, "inputs_tpdo": [0x60FD_0020]} for axis, mapping in mappings.items()}
    run = dataclasses.replace(recorded, rows=rows, manifest={**recorded.manifest, "mappings": older})
    assert replay_run(run).first_difference == ""


def test_a_flipped_bit_in_a_drive_s_position_is_noticed(recorded):
    row = moving_row(recorded, "macro_tpdo_count")
    found = replay_run(changed(recorded, "macro_tpdo", row, 2, 0))
    assert found.first_difference.startswith(f"row {row},")
    assert "macro_encoder_m" in found.first_difference


def test_another_setpoint_gives_another_command(recorded):
    row = moving_row(recorded, "sensor_bytes_count")
    rows = recorded.rows.copy()
    rows["setpoint_position_m"][row] += 1e-9
    found = replay_run(dataclasses.replace(recorded, rows=rows))
    assert not found.exact
    assert found.greatest_force_difference_n > 0.0


def test_a_change_without_its_event_is_refused(recorded):
    events = [event for event in recorded.events if event.get("event") != "update"]
    with pytest.raises(RecordError, match=r"update 1 has no event; events\.jsonl is incomplete"):
        replay_run(dataclasses.replace(recorded, events=events))


def test_a_run_without_bytes_is_refused(tmp_path):
    folder = tmp_path / "table"
    with Recorder(folder, {"name": "table", "backend": "import"}) as recorder:
        rows = new_rows(3)
        rows["t_ns"] = [1, 2, 3]
        recorder.append(rows)
    with pytest.raises(RecordError, match="no raw bytes to start from"):
        replay(folder)


def test_a_run_without_its_snapshot_is_refused(recorded):
    with pytest.raises(RecordError, match="nothing to replay"):
        replay_run(dataclasses.replace(recorded, snapshot=None))


@pytest.mark.parametrize("kept_share", [0.0, 0.5])
def test_a_run_that_lost_rows_is_not_exact(recorded, tmp_path, kept_share):
    shutil.copytree(recorded.folder, tmp_path / "cut")
    path = tmp_path / "cut" / "samples.arrow"
    content = path.read_bytes()
    path.write_bytes(content[: int(kept_share * len(content))])
    missing = recorded.rows.size - read_run(tmp_path / "cut").rows.size
    with pytest.raises(RecordError, match=f"{missing} of {recorded.rows.size} rows are missing.*nothing to replay"):
        replay(tmp_path / "cut")


@pytest.mark.parametrize("mappings", [{"macro": None}, {"macro": {}}, {"macro": {"rpdo": 3}}])
def test_damaged_mappings_are_refused(recorded, mappings):
    with pytest.raises(RecordError, match="mappings are damaged"):
        replay_run(dataclasses.replace(recorded, manifest={**recorded.manifest, "mappings": mappings}))


def test_a_run_read_twice_replays_alike(recorded):
    again = read_run(recorded.folder)
    assert replay_run(again) == replay_run(recorded)
    assert replay_run(again).exact


def test_the_index_of_air_that_a_device_tells_is_in_the_rows_and_replays(tmp_path):
    """The machine's air is 2 K and 10 hPa away from the profile's; the uMD2 tells it."""
    machine = load_machine("oled-printer-umd2")
    warm = machine.model_copy(
        update={"air": machine.air.model_copy(update={"temperature_degc": 22.0, "pressure_pa": 100325.0})}
    )
    with Supervisor(load_profile("oled-printer-umd2"), BatchBackend(warm, seed=4), tmp_path / "warm") as stage:
        assert stage.home().finished
        stage.enable()
        assert stage.move(0.02).finished
        used_now = float(stage.status()["air_index_ratio"])
        assert stage._scales() == pytest.approx((632.991e-9 / (8.0 * used_now),) * 2, rel=1e-15)
    run = read_run(tmp_path / "warm")
    used = run.rows["air_index_ratio"]
    believed = ciddor_index(632.991e-9, 20.0, 101_325.0, 50.0, 450.0)
    assert used[0] == believed
    assert abs(used[-1] - index_of(warm.air)) < 2e-8 < 4e-6 < abs(used[-1] - believed)
    found = replay_run(run)
    assert found.exact, found.first_difference
