"""EMPS, a real ball-screw axis (Janot, Gautier, Brunot 2019), where its data is at hand: STAGECTL_DATA/emps.

The data has no licence that lets it be kept here; `docs` and the profile say where it comes from.
"""

import os
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from stagectl.gap.believed import Believed, load_believed
from stagectl.gap.log import Log

TRAINING, HELD = "DATA_EMPS", "DATA_EMPS_PULSES"
_NEWTONS_PER_VOLT = 35.1507
_PULSE_GAIN = 1.014  # of the pulses that were added behind the controller, by regression on what was recorded
_PERIOD_S = 1e-3
_PROFILE = Path(__file__).parent.parent / "profiles" / "observed" / "emps.toml"

RIGHT = ("coulomb_friction", "offset", "asymmetric_viscous_friction", "cogging")
"""What the machine has, beyond doubt; a cogging with its second harmonic is one, too."""
WRONG = (
    "stribeck_friction",
    "linear_stiffness",
    "cable_spring",
    "thermal_drift",
    "load_dependent_friction",
    "gravity_tilt",
)
"""What earlier work has shown that it lacks, or can't be told from the offset."""

PUBLISHED = {
    "mass_kg": 95.11,
    "viscous_friction.damping_n_s_per_m": 203.5,
    "coulomb_friction.level_n": 20.39,
    "offset.force_n": 3.16,  # printed as -3.16: there it stands on the other side
}
"""Standard model by least squares of the inverse dynamic model, Janot, Gautier, Brunot 2019."""


def folder() -> Path | None:
    """Return the folder of the data, None where it is not at hand."""
    path = Path(os.environ.get("STAGECTL_DATA", "")) / "emps"
    return path if (path / f"{TRAINING}.mat").exists() and (path / f"{HELD}.mat").exists() else None


def read(path: Path) -> tuple[Believed, list[Log], list[Log]]:
    """Return what is believed (mass and viscous friction), the recording to learn from and the one kept apart."""
    return load_believed(_PROFILE), [_log(path, TRAINING)], [_log(path, HELD)]


def _log(path: Path, name: str) -> Log:
    table = {key: np.ravel(value) for key, value in loadmat(path / f"{name}.mat").items() if key[0] != "_"}
    extra = table["pulses_N"] * _PULSE_GAIN * _NEWTONS_PER_VOLT if "pulses_N" in table else None
    return Log(
        name,
        _PERIOD_S,
        table["qm"],
        table["vir"] * _NEWTONS_PER_VOLT,
        np.ones(table["qm"].size, bool),
        name,
        reference_m=table["qg"],
        command_extra_n=extra,
    )
