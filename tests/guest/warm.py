"""Compile everything that servo, service and rig reach: a stage on the rig. `warm.py RUNS_FOLDER`."""

import sys
from pathlib import Path

from stagectl.profile import load_profile
from stagectl.stage import open_stage

HERE = Path(__file__).resolve().parent


def main(runs_root: str) -> int:
    """Open the stage, let it cycle, close it; its run is what an upgrade has to keep."""
    profile = load_profile(HERE / "stage-100hz.toml")
    Path(runs_root).mkdir()
    machine = str(HERE / "machine.toml")
    with open_stage(profile, "rig", runs_root=Path(runs_root), name="before", machine=machine) as stage:
        stage.pump(0.5)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
