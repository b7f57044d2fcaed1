"""Profiles and machines with single values changed, for what a figure asks."""

from typing import TypeVar

from sim_backend.machine import Machine
from stagectl.profile import Profile

Described = TypeVar("Described", Profile, Machine)


def with_noise(described: Described, noise_m: float) -> Described:
    """Copy a profile or machine with another noise of the interferometer, m rms."""
    sensor = described.interferometer.model_copy(update={"noise_m": noise_m})
    return described.model_copy(update={"interferometer": sensor})


def with_transport(machine: Machine, transport: str) -> Machine:
    """Copy a machine whose lines come another way: line, usb-125us or ftdi-16ms."""
    sensor = machine.interferometer.model_copy(update={"transport": transport})
    return machine.model_copy(update={"interferometer": sensor})


def believed(machine: Machine, profile: Profile) -> Machine:
    """Copy a machine whose masses and force constants are exactly what the profile believes."""
    axes = {}
    for name in profile.axes:
        axis = profile.axis(name)
        constant = axis.rated_force_n / axis.rated_current_a
        table = getattr(machine, name)
        axes[name] = table.model_copy(update={"mass_kg": axis.mass_kg, "force_constant_n_per_a": constant})
    return machine.model_copy(update=axes)
