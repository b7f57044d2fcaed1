"""Opening a stage: what a world needs to be there."""

import os
import signal
from pathlib import Path

import pytest

from sim_backend.hub import Hub
from stagectl.errors import LinkError
from stagectl.profile import PROFILES_FOLDER, load_profile
from stagectl.stage import open_stage
from tests.toml_text import changed


def servos_count() -> int:
    """Count the servo processes that are children of this one."""
    count = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent_pid = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            count += parent_pid == os.getpid() and b"stagectl.servo_process" in (folder / "cmdline").read_bytes()
        except OSError:
            continue  # it has ended
    return count


def test_hardware_needs_no_machine_file(tmp_path):
    """A stage of one's own has a name of its own, and the rig can't play it: that is no reason to refuse hardware."""
    path = tmp_path / "my-stage.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"name": "my-stage"}))
    stage = open_stage(load_profile(str(path)), "hardware", runs_root=tmp_path / "runs", name="opened")
    try:
        assert stage.backend.name == "hardware"
    finally:
        stage.backend.close()


def test_a_signal_leaves_nothing_of_an_opening_that_failed(tmp_path, monkeypatch):
    """The service's SIGTERM raises while a world is opened; it must not end the closing of what is there already."""

    class Leaving(Exception):
        pass

    def leave(number, frame):
        raise Leaving

    stage = open_stage(load_profile("single-axis"), "batch", runs_root=tmp_path / "runs", name="opened")
    close, closed = stage.backend.close, []

    def closes():
        os.kill(os.getpid(), signal.SIGTERM)
        close()
        closed.append(True)

    monkeypatch.setattr(stage.backend, "close", closes)
    stage.folder.mkdir(parents=True, exist_ok=True)
    (stage.folder / "samples.arrow").mkdir()  # the recorder can't write there
    before = signal.signal(signal.SIGTERM, leave)
    try:
        with pytest.raises(Leaving):
            stage.__enter__()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert closed


def test_drives_that_are_silent_cost_no_servo(tmp_path):
    """The service tries again every five seconds, for hours: loading a servo each time would take half a CPU."""
    path, channel = tmp_path / "silent.toml", str(tmp_path / "can.socket")
    changes = {"name": "silent", "can.interface": "hub", "can.channel": channel}
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", changes))
    hub = Hub(channel)
    try:
        stage = open_stage(load_profile(str(path)), "hardware", runs_root=tmp_path / "runs", name="opened")
        assert servos_count() == 0
        with pytest.raises(LinkError, match="No SDO response"):
            stage.connect()
        assert servos_count() == 0
    finally:
        stage.backend.close()
        hub.close()
