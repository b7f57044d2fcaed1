"""No drive gets power that is not configured any more as arming left it."""

import re

import pytest

from sim_backend.faults import Fault
from stagectl.errors import DriveError
from stagectl.signals import Stop
from tests.struck_stage import Stage, inject

REBOOT = Fault("power_loss", node_id=2, duration_s=0.02)
REMAPPED = Fault("object_change", node_id=1, index=0x1A00, subindex=2, value=0x60FD_0020)
MODE = 0x6060
STRONGER = Fault("object_change", node_id=2, index=0x6072, subindex=0, value=3001)


@pytest.mark.parametrize(
    ("fault", "pattern"),
    [
        (REBOOT, r"node 2(: 0x\w+:\w+ was 0x\w+ when the drive was configured, and is| left NMT operational)"),
        (REMAPPED, r"node 1: 0x1A00:02 was 0x60640020 when the drive was configured, and is 0x60FD0020: it restarted"),
        (STRONGER, r"node 2: 0x6072:00 was 0xBB8 when .* and is 0xBB9: .* another master wrote it; connect the stage"),
    ],
    ids=["reboot", "mapping", "torque limit"],
)
def test_a_drive_that_changed_behind_us_is_not_powered(fault, pattern, tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        assert one.stage.drives_changed() == ""
        inject(fault)(one.stage, one.backend)
        one.stage.pump(0.05)
        one.stage.pump(0.2)
        assert re.match(pattern.partition("; connect")[0], one.stage.drives_changed())
        one.stage.acknowledge()
        with pytest.raises(DriveError, match=pattern):
            one.stage.enable()
        with pytest.raises(DriveError, match=pattern):
            one.stage.home()
        assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")


@pytest.mark.parametrize(("axis", "other"), [("macro", 8), ("micro", 0)])
def test_a_drive_in_another_mode_is_not_powered(axis, other, tmp_path, oled_profile, oled_machine):
    """Another master's tool left it so: it would go to the position that it was given last, or wherever it coasts."""
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        node_id = oled_profile.axis(axis).node_id
        one.stage.master.write(node_id, MODE, 0, other)
        pattern = (
            rf"{axis} \(node {node_id}\): mode of operation 0x6061 is {other}, wanted 10, for 0\.5 s: another master"
        )
        with pytest.raises(DriveError, match=pattern):
            one.stage.enable()
        assert one.drive_states == ("SWITCH_ON_DISABLED", "SWITCH_ON_DISABLED")


def test_a_drive_that_takes_the_mode_late_is_waited_for(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        one.stage.master.write(1, MODE, 0, 6)
        inject(Fault("object_change", node_id=1, index=MODE, subindex=0, value=10, at_s=0.3))(one.stage, one.backend)
        assert one.stage.enable() is Stop.NONE


def test_a_stage_that_nothing_happened_to_is_armed_as_before(tmp_path, oled_profile, oled_machine):
    one = Stage(tmp_path / "run", oled_profile, oled_machine)
    with one:
        assert one.stage.enable() is Stop.NONE
        assert one.stage.disarm() is Stop.OPERATOR
        assert one.stage.drives_changed() == ""
