"""Another world at run time: without power only, and whoever asks is told which one it is."""

import os
from subprocess import run

from stage_pc import POWERED, check, rig, shell, stage, until

COMMAND = "/usr/local/bin/stagectl"
MOVED_M = 5e-3
BANNERS = {"rig": "SOFTWARE RIG: nothing real moves", "hardware": "HARDWARE: what moves here is real"}


def swap_refused() -> None:
    """Ask for the rig while the stage has power, under the lease that is held; nothing may come of it."""
    asked = [COMMAND, "backend", "rig"]
    refused = run(asked, capture_output=True, text=True, env={**os.environ, "STAGECTL_LEASE": stage.token})
    said = " ".join((refused.stderr + refused.stdout).split())
    check("armed, another world is refused", refused.returncode != 0 and "without power only" in said, said)
    status = stage.status()
    stays = status["state"], status["backend"], status["homed"]
    check("it is the hardware's still, armed and homed", stays == ("armed", "hardware", True), stays)
    drives = rig.state()["drives"]
    check("its drives hold it still", set(drives.values()) == {"OPERATION_ENABLED"}, drives)


def swapped() -> None:
    """The world is changed to the software rig's and back, by the command."""
    _swap("rig", "software rig stage-100hz")
    before_m = stage.status()["positions"]["macro_position_m"]
    with stage.lease():
        stage.begin("home")
        until("the rig moves", lambda: abs(stage.status()["positions"]["macro_position_m"] - before_m) > MOVED_M)
        drives = rig.state()["drives"]
        check("a motion in the rig gives the hardware's drives no power", not POWERED & set(drives.values()), drives)
    stage.await_state("idle")
    _swap("hardware", "vcan0")
    check("another servo asks for homing", not stage.status()["homed"])


def _swap(name: str, of: str) -> None:
    said = " ".join(shell(COMMAND, "backend", name).split())
    status = stage.await_state("idle", "fault")
    check(f"{name}: the stage is opened there", status["state"] == "idle", status["fault"])
    check(f"{name}: the status says so", (status["backend"], status["banner"]) == (name, BANNERS[name]))
    check(f"{name}: and of what", of in status["backend_description"], status["backend_description"])
    check(f"{name}: so does the command", BANNERS[name] in said, said)
