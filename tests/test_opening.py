"""Opening a stage: what a world needs to be there."""

from stagectl.profile import PROFILES_FOLDER, load_profile
from stagectl.stage import open_stage
from tests.toml_text import changed


def test_hardware_needs_no_machine_file(tmp_path):
    """A stage of one's own has a name of its own, and the rig can't play it: that is no reason to refuse hardware."""
    path = tmp_path / "my-stage.toml"
    path.write_text(changed(PROFILES_FOLDER / "single-axis.toml", {"name": "my-stage"}))
    stage = open_stage(load_profile(str(path)), "hardware", runs_root=tmp_path / "runs", name="opened")
    try:
        assert stage.backend.name == "hardware"
    finally:
        stage.backend.close()
