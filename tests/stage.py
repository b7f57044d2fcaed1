"""Machines, beliefs and a cycle-by-cycle loop for the tests of the core."""

from dataclasses import dataclass, field

import numpy as np

from stagectl import batch, compose, plant, tick
from stagectl.plant import BRIDGE_CURRENT, PLANT_PARAMETERS, PLANT_STATE

HARD = 1e9
"""Travel, stroke or mass that never matters, SI."""


def with_values(model, **values):
    """Copy a profile or machine with other values, `macro__mass_kg=70.0` for macro.mass_kg; nothing is checked."""
    tables: dict[str, dict] = {}
    for name, value in values.items():
        table, _, key = name.partition("__")
        if key:
            tables.setdefault(table, {})[key] = value
    update = {name: value for name, value in values.items() if "__" not in name}
    update |= {table: getattr(model, table).model_copy(update=keys) for table, keys in tables.items()}
    return model.model_copy(update=update)


def exact(machine, profile):
    """Copy a machine with the masses and force constants that the profile believes."""
    values = {}
    for name in ("macro", "micro"):
        axis = getattr(profile, name)
        values[f"{name}__mass_kg"] = axis.mass_kg
        values[f"{name}__force_constant_n_per_a"] = axis.rated_force_n / axis.rated_current_a
    return with_values(machine, **values)


def centre_m(profile) -> float:
    """Return x_b in the middle of the believed gap."""
    if profile.micro is None:
        return 0.0
    return 0.5 * (profile.backlash.right_m - profile.backlash.left_m)


def simulated(profile, machine, law: str, *, at_m: float = 0.0, relative_m: float = 0.0, seed: int = 1):
    """Put a controller before a machine that rests with its end at `at_m`, `relative_m` before the gap's centre."""
    controller = tick.controller(profile, law, has_drives=False)
    delay_s = profile.cycle.actuation_delay_s
    simulation = batch.simulation(controller, machine, latch_delay_s=delay_s, seed=seed)
    simulation.state["end_position_m"] = at_m
    simulation.state["macro_position_m"] = at_m - relative_m + centre_m(profile)
    return simulation


def followed(profile, machine, law: str, setpoints: np.ndarray, *, seed: int = 1, rest_s: float = 1.0):
    """Rest where the trajectory begins until the observer has settled, then follow it; returns the recording."""
    start = setpoints[0]
    at_m, relative_m = float(start["position_m"]), float(start["relative_position_m"])
    simulation = simulated(profile, machine, law, at_m=at_m, relative_m=relative_m, seed=seed)
    hold = np.zeros(round(rest_s * profile.cycle.rate_hz), setpoints.dtype)
    hold["position_m"], hold["relative_position_m"] = at_m, relative_m
    batch.run(simulation, hold)
    return batch.run(simulation, setpoints)


def true_error_m(recording) -> np.ndarray:
    """Return the end's true position minus its setpoint at the samples."""
    return recording.truth["end_position_m"] - recording.setpoints["position_m"]


def rms(values) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def believed(simulation) -> None:
    """Make the machine behind the seam exactly what the controller believes, seen without noise."""
    controller = simulation.controller
    simulation.parameters[...] = controller.belief
    count = len(controller.effects) - 1
    structure = simulation.effects
    structure[:] = 0.0
    simulation.devices["macro_resolution_m"] = simulation.devices["end_resolution_m"] = 1e-16
    simulation.devices["longest_substep_s"] = controller.estimator["longest_substep_s"]
    simulation.devices["period_s"] = controller.estimator["period_s"]
    simulation.noise_m = 0.0
    # profile: viscous, reaction, contact damping; machine: viscous, reaction, cogging (3), cable (2), contact damping
    assert count == 3
    assert structure.size == 9
    structure[0], structure[1], structure[7] = controller.effects[:3]
    structure[3] = 1.0  # a pitch of 0 would make nan of a cogging of 0 N


@dataclass
class Bench:
    """A bare plant with named parameters: easy to set, easy to advance."""

    effects: list[dict] = field(default_factory=list)
    values: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.module = compose.plant_module(self.effects)
        self.effect_parameters = compose.effect_parameters(self.effects)
        self.state = np.zeros(1, PLANT_STATE)
        self.parameters = np.zeros(1, PLANT_PARAMETERS)
        plain = {
            "macro_mass_kg": 70.0,
            "micro_mass_kg": 40.0,
            "left_m": HARD,
            "right_m": HARD,
            "travel_low_m": -HARD,
            "travel_high_m": HARD,
            "stroke_low_m": -HARD,
            "stroke_high_m": HARD,
            "has_micro": 1.0,
        }
        for axis in ("macro", "micro"):
            plain |= {
                f"{axis}_force_constant_n_per_a": 10.0,
                f"{axis}_resistance_ohm": 1.0,
                f"{axis}_inductance_h": 1e-3,
                f"{axis}_supply_v": 1e12,
                f"{axis}_current_limit_a": 100.0,
                f"{axis}_current_loop_s": 0.15e-3,
            }
        for name, value in (plain | self.values).items():
            self.parameters[name] = value

    def __getitem__(self, name: str) -> float:
        return float(self.state[name][0])

    def advance(self, until_s, macro_a=0.0, micro_a=0.0, bridges=(BRIDGE_CURRENT, BRIDGE_CURRENT), longest_s=50e-6):
        """Advance to `until_s` with held commands."""
        self.module.advance(
            self.state, self.parameters, self.effect_parameters, until_s, longest_s, macro_a, micro_a, *bridges
        )
        return self


def place(state, **values) -> None:
    """Write fields of a one-element array."""
    for name, value in values.items():
        state[name] = value


__all__ = ["HARD", "Bench", "believed", "centre_m", "exact", "followed", "place", "plant", "rms", "simulated"]
__all__ += ["true_error_m", "with_values"]
