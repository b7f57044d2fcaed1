"""What the rig saw of a run: true motion, the drives' power states, every SYNC. Knows no controller."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from sim_backend.drive_states import DriveState
from sim_backend.rig import Rig

SYNC_ID = 0x080
ENABLED = int(DriveState.OPERATION_ENABLED)
STOPPING = (int(DriveState.QUICK_STOP_ACTIVE), int(DriveState.FAULT_REACTION_ACTIVE))


class WitnessedRig(Rig):
    """A rig that also keeps the drives' states at every sample, and the instants of SYNC."""

    def __init__(self, machine: Any, seed: int) -> None:
        """Begin with nothing seen."""
        self.sync_t_ns: list[int] = []
        self._states: list[tuple[int, ...]] = []
        super().__init__(machine, seed)

    def on_frame(self, can_id: int, payload: bytes, t_ns: int) -> list[tuple[int, bytes]]:
        """Take a frame as a rig does, and note a SYNC."""
        if can_id == SYNC_ID:
            self.sync_t_ns.append(t_ns)
        return super().on_frame(can_id, payload, t_ns)

    def _take_sample(self, t_ns: int) -> None:
        super()._take_sample(t_ns)
        self._states.append(tuple(int(node.drive.state) for node in self.nodes))

    def seen(self) -> dict[str, np.ndarray]:
        """Return the truth log with `states` (one row a sample, macro first) beside it."""
        return {**self.truth.arrays(), "states": np.array(self._states, dtype=np.int64)}

    def let_pass(self, duration_s: float) -> None:
        """Let time pass while no controller has the bus."""
        self.advance(self.t_ns + round(1e9 * duration_s))
        self.take_frames()


def node_ids(rig: Rig) -> Iterable[int]:
    """Return the nodes' ids, macro first."""
    return [node.node_id for node in rig.nodes]
