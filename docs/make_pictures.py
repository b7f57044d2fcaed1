"""Make the pictures of README.md: the demo in virtual time, over the wire. `.venv/bin/python docs/make_pictures.py`

The same bytes, loop and laws as `stagectl demo`, without a host to be late: the same seed gives the same pictures.
"""

import sys
import tempfile
from pathlib import Path

from sim_backend.machine import load_machine
from stagectl import demo
from stagectl.profile import load_profile
from stagectl.record import read_run
from stagectl.run_page import pictures, scores_of
from stagectl.run_scores import read_truth, write_truth
from stagectl.stage import open_stage

PROFILE = "oled-printer"
SEED = 1
IMAGES = Path(__file__).resolve().parent / "images"
WANTED = {"tracking-trapezoid": "tracking.png", "backlash": "backlash.png"}


def main() -> int:
    """Drive, score and draw; 1 where the demo did not come to its own end."""
    profile = load_profile(PROFILE)
    with tempfile.TemporaryDirectory() as runs_root:
        with open_stage(profile, "batch", runs_root=Path(runs_root), name="pictures", seed=SEED) as stage:
            driven = demo.drive(stage, demo.planned(profile), say=print)
            stage.disarm()
            truth = stage.backend.truth()
        if driven.stop.name != "FINISHED" or truth is None:
            print(f"the demo ended early: {driven.outcomes[-1].text}")
            return 1
        write_truth(stage.folder, truth, load_machine(PROFILE).backlash)
        run = read_run(stage.folder)
        made = {picture.name: picture for picture in pictures(run, scores_of(run, read_truth(stage.folder)))}
    IMAGES.mkdir(exist_ok=True)
    for name, file_name in WANTED.items():
        (IMAGES / file_name).write_bytes(made[name].draw("png"))
        print(IMAGES / file_name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
