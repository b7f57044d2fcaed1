"""Both seams end in one plant and one tick: with the same noise the same motion comes out."""

import pytest

from bench import main_job, seams
from bench.figure import judged
from stagectl import trajectory
from tests.effect_numbers import everything_that_remembers
from tests.stage import with_values


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_both_seams_agree(law, tmp_path):
    """Bytes, frames, scales and words lie between them; nothing of that may move the end."""
    apart = main_job.seams_apart(law, 31, tmp_path)
    assert apart.cycles > 5000
    assert apart.late_lines > 200  # 8 % of the lines come after their cycle began: both seams predict over those
    assert judged(main_job.SEAMS, 1e9 * apart.rms_m).holds
    assert apart.peak_m < 1e-12  # a word that rounds the other way would move the end by nanometres


def test_both_seams_agree_on_what_effects_remember(oled_profile, oled_machine, tmp_path):
    """Readings, commands, edges and forces with a past: one text behind bytes and behind values."""
    extra = everything_that_remembers()
    machine = with_values(oled_machine, effects=(*oled_machine.effects, *extra))
    profile = with_values(oled_profile, effects=(*oled_profile.effects, *extra))
    planned = trajectory.trapezoid(0.05, 0.1, start_m=-0.02, dwell_s=0.2)
    apart = seams.compare(profile, machine, 31, planned, "dsmc", tmp_path)
    assert apart.cycles > 1000
    assert judged(main_job.SEAMS, 1e9 * apart.rms_m).holds
    assert apart.peak_m < 1e-12
