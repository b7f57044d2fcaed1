"""What disturbs a stage: noises as variances, and the forces of a machine that its profile does not have, along a move.

A machine is anything with a machine file's attributes; only what scores simulated runs may pass one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from stagectl import compose
from stagectl.effects import CATALOGUE

if TYPE_CHECKING:
    from stagectl.profile import Profile

SENSOR, STEP, FORCE, DELAY, COGGING, CONTACT, MODEL = SOURCES = (
    "sensor noise",
    "torque step",
    "force noise",
    "delay",
    "cogging",
    "contact",
    "model error",
)
"""Every source of a budget, in the order in which it is shown."""

_UNIFORM = math.sqrt(12.0)  # what rounding by a step is smaller than the step, as a standard deviation
_ALONG = ("position_m", "velocity_m_per_s", "acceleration_m_per_s2", "mass_kg", "t_s", "dt_s")
_ALONG_RELATIVE = ("relative_position_m", "relative_velocity_m_per_s")


@dataclass(frozen=True, slots=True)
class Noises:
    """Standard deviations of what is new every cycle, by axis where there is one a drive."""

    sensor_m: float
    rounding_n: dict[str, float]
    force_n: dict[str, float] = field(default_factory=dict)

    def scaled(self, source: str, ratio: float) -> "Noises":
        """Return the same with one source (SENSOR, STEP, FORCE) so many times as large."""
        return Noises(
            self.sensor_m * (ratio if source == SENSOR else 1.0),
            {axis: value * (ratio if source == STEP else 1.0) for axis, value in self.rounding_n.items()},
            {axis: value * (ratio if source == FORCE else 1.0) for axis, value in self.force_n.items()},
        )


def noises_of(profile: "Profile", machine: Any = None) -> Noises:
    """Return the noises that a profile states; with a machine, its sensor's and its forces'."""
    rounding = {axis: profile.axis(axis).torque_step_n / _UNIFORM for axis in profile.axes}
    if machine is None:
        return Noises(profile.interferometer.noise_m, rounding)
    sensor = machine.interferometer
    count_m = machine.air.wavelength_vacuum_m / sensor.counts_per_wavelength
    if sensor.interpolation_speed_m_per_s is not None:
        count_m = 0.0  # divided further where the stage holds
    forces = {axis: getattr(machine, axis).force_noise_n for axis in profile.axes}
    return Noises(math.hypot(sensor.noise_m, count_m / _UNIFORM), rounding, forces)


@dataclass(frozen=True, slots=True, eq=False)
class Forces:
    """Forces that the profile lacks along a move, N, one a cycle, by source and axis."""

    by_source: dict[str, dict[str, np.ndarray]]

    def rows(self, source: str) -> dict[str, np.ndarray]:
        """Return the forces of one source by axis; empty where it has none."""
        return self.by_source.get(source, {})


def forces_missing(profile: "Profile", machine: Any, setpoints: np.ndarray, seen_x_b_m: np.ndarray | None) -> Forces:
    """Return what the machine feels and the profile does not know, along a reference (SETPOINT, shape (n,)).

    What repeats with position is COGGING, the contact's force along the measured `seen_x_b_m` (macro minus end, m) is
    CONTACT, the rest MODEL. Effects with memory and those of motors and commands have no force along a reference.
    """
    count = setpoints.size
    found: dict[str, dict[str, np.ndarray]] = {
        source: {axis: np.zeros(count) for axis in profile.axes} for source in (COGGING, CONTACT, MODEL)
    }
    for sign, effects in ((1.0, machine.effects), (-1.0, profile.effects)):
        for row in effects:
            axis = {"macro_force": "macro", "micro_force": "micro"}.get(row["acts_on"])
            if axis not in profile.axes or not _is_of_motion(row["name"]):
                continue
            source = COGGING if is_periodic(row["name"]) else MODEL
            found[source][axis] += sign * _force_along(row, setpoints, profile.axis(axis).mass_kg, profile)
    if seen_x_b_m is not None and profile.backlash is not None:
        missing_n = _contact_n(machine.backlash, seen_x_b_m) - _contact_n(profile.backlash, seen_x_b_m)
        found[CONTACT]["micro"] += missing_n
        found[CONTACT]["macro"] -= missing_n
    return Forces(found)


def is_periodic(name: str) -> bool:
    """Tell whether an effect repeats with position."""
    return "pitch_m" in CATALOGUE[name].parameters


def _is_of_motion(name: str) -> bool:
    known = CATALOGUE[name]
    return not known.memory and set(known.quantities) <= {*_ALONG, *_ALONG_RELATIVE}


def _force_along(row: Any, setpoints: np.ndarray, mass_kg: float, profile: "Profile") -> np.ndarray:
    known = CATALOGUE[row["name"]]
    at = {
        "position_m": setpoints["position_m"],
        "velocity_m_per_s": setpoints["velocity_m_per_s"],
        "acceleration_m_per_s2": setpoints["acceleration_m_per_s2"],
        "mass_kg": np.full(setpoints.size, mass_kg),
        "t_s": np.arange(setpoints.size) * profile.cycle.period_s,
        "dt_s": np.full(setpoints.size, profile.cycle.period_s),
        "relative_position_m": setpoints["relative_position_m"],
        "relative_velocity_m_per_s": setpoints["relative_velocity_m_per_s"],
    }
    columns = np.column_stack([at[name] for name in known.quantities])
    values = np.array([float(row[name]) for name in known.parameters])
    return compose.along(known)(columns, values, np.zeros(0))


def _contact_n(joint: Any, x_b_m: np.ndarray) -> np.ndarray:
    """Return F_b of (4): positive where the macro leads the end."""
    right_n = joint.right_stiffness_n_per_m * np.maximum(x_b_m - joint.right_m, 0.0)
    return right_n - joint.left_stiffness_n_per_m * np.maximum(-joint.left_m - x_b_m, 0.0)


def of_columns(names: Sequence[str]) -> tuple[str, ...]:
    """Return the axes that a linear system's inputs name, in order."""
    return tuple(axis for axis in ("macro", "micro") if f"{axis}_force_n" in names)
