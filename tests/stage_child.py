"""A supervisor in a process of its own, to be killed: `python -m tests.stage_child RUN_FOLDER`.

Says in JSON lines where its rig is, when the stage moves at full speed, and how it ended. After a failure it waits
for a line before it closes the stage, and the rig with it.
"""

import json
import sys
from pathlib import Path

from sim_backend.machine import machine_path_for
from stagectl import trajectory as trajectories
from stagectl.backend import RigBackend
from stagectl.errors import LinkError
from stagectl.profile import Profile, load_profile
from stagectl.supervisor import Supervisor
from tests.stage import with_values
from tests.struck_stage import home_by_truth

NAME = "oled-printer"
SPEED_M_PER_S = 0.2
STROKE_M = 0.36
RIG_OUTLIVES_S = 60.0


def patient_profile() -> Profile:
    """Return the profile with limits that a busy test host does not pass; the drives' own deadline is one of them."""
    return with_values(
        load_profile(NAME),
        trip__sensor_age_s=0.3,
        trip__overrun_s=0.3,
        trip__rpdo_deadline_s=0.1,
        trip__heartbeat_s=2.0,
        trip__lease_s=3.0,
    )


def opened(folder: Path, progress=lambda what, share: None) -> Supervisor:
    """Return a supervisor on a rig that outlives it."""
    profile = patient_profile()
    backend = RigBackend(profile, machine_path_for(NAME), seed=3, linger_s=RIG_OUTLIVES_S)
    return Supervisor(profile, backend, folder, progress)


def arm(stage: Supervisor) -> bool:
    """Home by truth, enable, bring the macro to the middle of the gap; False where the host's hiccups trip it."""
    stage.pump(0.2)
    home_by_truth(stage, stage.backend.request({"state": True})["plant"])
    if stage.enable():
        return False
    stage._centre(stage.status())
    return not stage.enable()


def cross(stage: Supervisor) -> trajectories.Trajectory:
    """Plan a long way at constant speed from where the stage holds."""
    start_m = float(stage.status()["setpoint_position_m"])
    return trajectories.trapezoid(STROKE_M, SPEED_M_PER_S, (0.1, 0.05), dwell_s=0.2, start_m=start_m, lead_s=0.05)


def main() -> int:
    """Move until somebody ends it."""

    def say(**message) -> None:
        print(json.dumps(message), flush=True)

    said = []

    def progress(what: str, share: float) -> None:
        if what == "crossing" and share > 0.1 and not said:
            said.append(what)
            say(moving=True)

    stage = opened(Path(sys.argv[1]), progress)
    backend = stage.backend
    say(channel=backend.channel, rig_pid=backend.rig_pid, servo_pid=backend.servo_pid)
    try:
        with stage:
            say(ring=str(backend._paths["ring"]))
            if not arm(stage):
                say(moving=False, why=stage.detail)
                return 1
            try:
                outcome = stage.follow(cross(stage).setpoints, "crossing")
                say(ended=outcome.stop.name, text=outcome.text)
            except LinkError as error:
                say(failed=str(error))
                sys.stdin.readline()
                raise
    except LinkError:
        say(ended="failed")
    except KeyboardInterrupt:
        say(ended="interrupted")
    return 0


if __name__ == "__main__":
    sys.exit(main())
