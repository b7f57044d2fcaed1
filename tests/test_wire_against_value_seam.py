"""Both seams end in one plant and one tick: with the same noise the same motion comes out."""

import pytest

from bench import main_job
from bench.figure import judged


@pytest.mark.parametrize("law", ["dsmc", "pid"])
def test_both_seams_agree(law, tmp_path):
    """Bytes, frames, scales and words lie between them; nothing of that may move the end."""
    apart = main_job.seams_apart(law, 31, tmp_path)
    assert apart.cycles > 5000
    assert apart.late_lines > 200  # 8 % of the lines come after their cycle began: both seams predict over those
    assert judged(main_job.SEAMS, 1e9 * apart.rms_m).holds
    assert apart.peak_m < 1e-12  # a word that rounds the other way would move the end by nanometres
