"""What really happened, at every sample of the interferometer, and when SYNC came: never the controller's view."""

from array import array
from bisect import bisect_left
from pathlib import Path

import numpy as np

from stagectl.errors import RecordError

COLUMNS = (
    "macro_position_m",
    "end_position_m",
    "macro_velocity_m_per_s",
    "end_velocity_m_per_s",
    "macro_mean_position_m",  # over the interval since the sample before
    "end_mean_position_m",
    "contact_force_n",
    "macro_force_n",
    "micro_force_n",
    "macro_zero_m",  # position at which the laser's counter reads zero
    "end_zero_m",
    "macro_drive_state",  # `drive_states.DriveState`
    "micro_drive_state",  # -1: this stage has no micro
)


class TruthLog:
    """Grows by one row a sample."""

    def __init__(self, rows_limit: int | None = None) -> None:
        """`rows_limit`: keep at least so many newest rows, forget older ones now and then; None = keep all."""
        self._rows_limit = rows_limit
        self._t_ns = array("q")
        self._sequence = array("q")
        self._values = array("d")
        self._sync_t_ns = array("q")

    def append(self, t_ns: int, sequence: int, values: tuple[float, ...]) -> None:
        """Add a row; `values` in the order of `COLUMNS`."""
        self._t_ns.append(t_ns)
        self._sequence.append(sequence)
        self._values.extend(values)
        if self._rows_limit is not None and len(self._t_ns) > 2 * self._rows_limit:
            self._forget(len(self._t_ns) - self._rows_limit)

    def note_sync(self, t_ns: int) -> None:
        """Add the instant of a SYNC."""
        self._sync_t_ns.append(t_ns)

    def _forget(self, rows_count: int) -> None:
        del self._sync_t_ns[: bisect_left(self._sync_t_ns, self._t_ns[rows_count])]
        del self._t_ns[:rows_count]
        del self._sequence[:rows_count]
        del self._values[: rows_count * len(COLUMNS)]

    def __len__(self) -> int:
        return len(self._t_ns)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return t_ns, sequence (int64) and all `COLUMNS` (float64), one element a sample, and `sync_t_ns` (int64)."""
        values = np.array(self._values, dtype=np.float64).reshape(-1, len(COLUMNS))
        found = {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(COLUMNS)}
        return {
            "t_ns": np.array(self._t_ns, dtype=np.int64),
            "sequence": np.array(self._sequence, dtype=np.int64),
            **found,
            "sync_t_ns": np.array(self._sync_t_ns, dtype=np.int64),
        }

    def write(self, path: str | Path) -> None:
        """Write all arrays to a .npz file; RecordError where that fails. A reader never sees half a file."""
        target = Path(path)
        partial = target.with_name(target.name + ".part")
        try:
            with partial.open("wb") as file:
                np.savez(file, **self.arrays())  # pyright: ignore[reportArgumentType]
            partial.replace(target)
        except OSError as error:
            raise RecordError(
                f"{target}: the rig's truth can't be written: {error}; free the disk or choose a path"
            ) from error
