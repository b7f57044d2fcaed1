"""What `stagectl status` says of the joint: how sure, since when, and what of it is worn."""

import io

from rich.console import Console

from stagectl.commands.watching import status_table
from stagectl.service import messages

AT = "2026-05-04T03:02:01Z"
JOINT = {
    "left_m": 27.9e-6,
    "right_m": 171.3e-6,
    "left_stiffness_n_per_m": 1.32e4,
    "right_stiffness_n_per_m": 9.87e3,
    "width_m": 199.2e-6,
    "width_sd_m": 0.35e-6,
    "at": AT,
}
WEAR = messages.Wear(
    **JOINT,
    left_stiffness_sd_n_per_m=None,
    right_stiffness_sd_n_per_m=None,
    age_s=5.0,
    source="production",
    observable=True,
    text="",
    alarm="",
    believed_since="",
)


def shown(**changes):
    positions = messages.Positions(
        end_position_m=None,
        macro_position_m=None,
        macro_encoder_m=None,
        relative_position_m=None,
        setpoint_position_m=None,
        error_m=None,
        sample_age_s=None,
    )
    health = messages.Health(
        cycles_count=1,
        missed_cycles_count=0,
        lost_samples_count=0,
        discarded_bytes_count=0,
        rate_hz=1000.0,
        lateness_p99_s=None,
        lateness_max_s=None,
    )
    fields = dict.fromkeys(("fault", "command", "lease", "backlash", "wear", "recording"))
    fields |= {"banner": "SOFTWARE RIG", "state": "idle", "homed": True, "profile": "p", "profile_path": "/p.toml"}
    fields |= {"waiting_for": "", "positions": positions, "health": health, "temperatures": {}, "remarks": []}
    console = Console(record=True, width=200, file=io.StringIO())
    console.print(status_table(messages.Status.model_construct(**fields | changes)))
    return console.export_text()


def test_the_joint_stands_there_with_its_sureness_and_where_it_is_from():
    assert "backlash" not in shown()
    identified = messages.Backlash(**JOINT, centre_m=0.0, run="r", profile_name="p", backend="rig")
    assert f"199.20 um +- 0.35 um, identified {AT}" in shown(backlash=identified)
    text = shown(backlash=identified, wear=WEAR)
    assert f"199.20 um +- 0.35 um, production at {AT}" in text
    assert "identified" not in text
    assert "wear" not in text


def test_a_joint_that_is_not_seen_and_one_that_is_worn_say_so():
    unseen = WEAR.model_copy(update={"observable": False, "text": "not observable: the value is 3.0 days old"})
    assert "not observable: the value is 3.0 days old" in shown(wear=unseen)
    worn = WEAR.model_copy(update={"alarm": "the gap is 201 um wide", "believed_since": AT})
    text = shown(wear=worn)
    assert "the gap is 201 um wide" in text
    assert f"learned at {AT}" in text
