"""What the rig saw of a run: true motion, the drives' power states, every SYNC. Knows no controller."""

import numpy as np

from sim_backend.drive_states import DriveState
from sim_backend.rig import Rig

ENABLED = int(DriveState.OPERATION_ENABLED)
STOPPING = (int(DriveState.QUICK_STOP_ACTIVE), int(DriveState.FAULT_REACTION_ACTIVE))


def seen_of(truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a truth log with `states` (one row a sample, macro first) beside it."""
    states = np.stack([truth["macro_drive_state"], truth["micro_drive_state"]], axis=1)
    return {**truth, "states": states.astype(np.int64)}


def joined(before: dict[str, np.ndarray], now: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return what two rigs saw, one behind the other; of one that is asked again, what it saw at last."""
    if not before or now["t_ns"][0] <= before["t_ns"][-1]:
        return now
    return {name: np.concatenate([before[name], now[name]]) for name in now}


class WitnessedRig(Rig):
    """A rig that is asked what it saw, and goes on while no controller has the bus."""

    def seen(self) -> dict[str, np.ndarray]:
        """Return what it saw so far."""
        return seen_of(self.truth.arrays())

    def let_pass(self, duration_s: float) -> None:
        """Let time pass while no controller has the bus."""
        self.advance(self.t_ns + round(1e9 * duration_s))
        self.take_frames()
