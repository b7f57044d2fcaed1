"""Forces on the bodies and errors of their readings, and how they add up. Pure."""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(slots=True)
class Forces:
    """What acts on the bodies on parts of intervals, and what the sensors add; None is nothing."""

    macro_n: np.ndarray | None = None
    end_n: np.ndarray | None = None
    macro_sensor_m: np.ndarray | None = None
    end_sensor_m: np.ndarray | None = None
    macro_current_a: np.ndarray | None = None  # at the samples, shape (n,)
    end_current_a: np.ndarray | None = None


def add_forces(total: Forces, more: Forces) -> None:
    """Add forces to forces, in place."""
    for name in ("macro_n", "end_n", "macro_sensor_m", "end_sensor_m", "macro_current_a", "end_current_a"):
        extra = getattr(more, name)
        if extra is not None:
            held = getattr(total, name)
            setattr(total, name, extra if held is None else held + extra)


def sum_of_forces(forces: Forces, more: Forces) -> Forces:
    """Return forces and forces together."""
    return scaled_forces(more, 1.0, forces)


def scaled_forces(forces: Forces, factor: float, more: Forces) -> Forces:
    """Return `factor` times some forces, added to others."""
    total = replace(more)
    add_forces(total, Forces(*(None if value is None else factor * value for value in _values_of(forces))))
    return total


def squares_of(forces: Forces) -> float:
    """Return the sum of the squares of all that forces hold, in their units: to compare one law with itself.

    Of means over intervals: when within one a step comes is in its parts, and of a delay no proportion.
    """
    means = (value.reshape(value.shape[0], -1).mean(axis=1) for value in _values_of(forces) if value is not None)
    return sum(float(mean @ mean) for mean in means)


def _values_of(forces: Forces) -> tuple[np.ndarray | None, ...]:
    """Return the fields in their order, without copies."""
    return tuple(getattr(forces, one.name) for one in fields(forces))
