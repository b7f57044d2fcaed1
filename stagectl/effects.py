"""Every force law, once: an effect is a function whose argument names are its declaration.

Names in `QUANTITIES` are what the effect depends on, every other argument is a parameter, and every
name ends in its unit. The same text compiles for the tick and runs on arrays in analysis. Forces are
positive in the direction of positive position. Pure; knows no bus and no clock.
"""

# An effect's bare argument names are its declaration, and take floats as well as arrays: no types beside them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stagectl.compiled import compiled
from stagectl.units import unit_of

QUANTITIES = (
    "position_m",  # of the axis that the effect acts on
    "velocity_m_per_s",
    "relative_position_m",  # end minus macro
    "relative_velocity_m_per_s",
    "current_a",  # of the axis' motor
    "motor_force_n",  # force that the axis' current should make
    "micro_motor_force_n",  # the voice coil's force, whichever axis the effect acts on
    "t_s",  # since the start of the run
)
"""What a force or actuator effect may depend on."""

CONTACT_QUANTITIES = ("penetration_m", "penetration_velocity_m_per_s")
"""What a contact effect may depend on: overlap of the joint's two parts (> 0 in contact) and its rate."""

PLACES = ("macro_force", "micro_force", "contact", "macro_actuator", "micro_actuator")
"""Where an effect may act: an actuator effect adds to what the current should make, a contact effect to the joint."""


@dataclass(frozen=True, slots=True)
class Effect:
    """One declared force law."""

    name: str
    law: Callable[..., float]
    compiled_law: Callable[..., float]
    quantities: tuple[str, ...]
    parameters: tuple[str, ...]
    places: tuple[str, ...]
    bounds: dict[str, tuple[float, float]]
    symptom: str
    reference: str

    @property
    def summary(self) -> str:
        """First line of the law's docstring."""
        return (inspect.getdoc(self.law) or "").splitlines()[0]


CATALOGUE: dict[str, Effect] = {}
"""All declared effects by name."""


def effect(*, places: tuple[str, ...], symptom: str, reference: str, **bounds: tuple[float, float]):
    """Declare the decorated function as an effect; wrong declarations raise TypeError at import."""

    def declare(law: Callable[..., float]) -> Callable[..., float]:
        arguments = tuple(inspect.signature(law).parameters)
        known = CONTACT_QUANTITIES if places == ("contact",) else QUANTITIES
        quantities = tuple(name for name in arguments if name in known)
        parameters = tuple(name for name in arguments if name not in known)
        name = law.__name__
        if name in CATALOGUE:
            raise TypeError(f"effect {name} is declared twice")
        if arguments != quantities + parameters:
            raise TypeError(f"effect {name}: quantities come before parameters, got {arguments}")
        if unknown := [place for place in places if place not in PLACES]:
            raise TypeError(f"effect {name}: unknown place {unknown[0]}; choose from {PLACES}")
        if "contact" in places and places != ("contact",):
            raise TypeError(f"effect {name}: contact effects know no motion of an axis; declare it for contact alone")
        if not inspect.getdoc(law):
            raise TypeError(f"effect {name}: no docstring; its first line is the summary in reports")
        if set(bounds) != set(parameters):
            raise TypeError(f"effect {name}: bounds {sorted(bounds)} do not match parameters {sorted(parameters)}")
        if wrong := [key for key, (low, high) in bounds.items() if not -np.inf < low < high < np.inf]:
            raise TypeError(f"effect {name}: bounds of {wrong[0]} are no range: {bounds[wrong[0]]}")
        if nameless := [argument for argument in arguments if unit_of(argument) is None]:
            raise TypeError(f"effect {name}: argument {nameless[0]} states no unit")
        CATALOGUE[name] = Effect(
            name, law, compiled(law), quantities, parameters, places, dict(bounds), symptom, reference
        )
        return law

    return declare


@effect(
    places=("macro_force", "micro_force"),
    damping_n_s_per_m=(0.0, 1e5),
    symptom="odd in velocity and proportional to it",
    reference="Kang et al. 2023, (1) and (2), b1 and b2",
)
def viscous_friction(velocity_m_per_s, damping_n_s_per_m):
    """Viscous friction: F = -b v."""
    return -damping_n_s_per_m * velocity_m_per_s


@effect(
    places=("macro_force", "micro_force"),
    level_n=(0.0, 1e3),
    smoothing_m_per_s=(1e-7, 1e-1),
    symptom="odd in velocity; a step at each reversal",
    reference="Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994",
)
def coulomb_friction(velocity_m_per_s, level_n, smoothing_m_per_s):
    """Dry friction of constant size against the motion: F = -F_c tanh(v / v_s)."""
    return -level_n * np.tanh(velocity_m_per_s / smoothing_m_per_s)


@effect(
    places=("macro_force", "micro_force"),
    amplitude_n=(0.0, 1e3),
    pitch_m=(1e-4, 1.0),
    phase_rad=(-7.0, 7.0),
    symptom="periodic in position, whatever the velocity",
    reference="Roehrig, Jochheim, Proc. ACC 2001: force ripple of linear motors",
)
def cogging(position_m, amplitude_n, pitch_m, phase_rad):
    """Position-periodic force of the magnets: F = A sin(2 pi x / p + phi)."""
    return amplitude_n * np.sin(2.0 * np.pi * position_m / pitch_m + phase_rad)


@effect(
    places=("macro_force", "micro_force"),
    stiffness_n_per_m=(0.0, 1e4),
    anchor_m=(-10.0, 10.0),
    symptom="linear in position",
    reference="Hooke; cable carriers of linear stages",
)
def cable_spring(position_m, stiffness_n_per_m, anchor_m):
    """Pull of a cable towards its anchor: F = -k (x - x_0)."""
    return -stiffness_n_per_m * (position_m - anchor_m)


@effect(
    places=("macro_force", "micro_force"),
    force_n=(-1e3, 1e3),
    symptom="constant",
    reference="Newton; tilt, amplifier offset and preload look alike",
)
def offset(t_s, force_n):
    """Constant force."""
    return force_n + 0.0 * t_s


@effect(
    places=("contact",),
    damping_n_s_per_m=(0.0, 1e5),
    symptom="proportional to the speed of the joint, in contact only",
    reference="Kelvin-Voigt contact; Kang et al. 2023, section 6.1",
)
def contact_damping(penetration_velocity_m_per_s, damping_n_s_per_m):
    """Damping of the joint in contact: F = c dp/dt (the contact never pulls: the plant sees to that)."""
    return damping_n_s_per_m * penetration_velocity_m_per_s


@effect(
    places=("macro_force",),
    fraction_ratio=(0.0, 1.0),
    symptom="the voice coil's force, mirrored on the macro",
    reference="Newton's third law on Kang et al. 2023, (1): the voice coil's stator rides on the macro",
)
def micro_reaction(micro_motor_force_n, fraction_ratio):
    """Reaction of the voice coil on the macro: F = -a F_micro, a = 1 where the stator rides on the macro."""
    return -fraction_ratio * micro_motor_force_n


@effect(
    places=("macro_actuator", "micro_actuator"),
    error_ratio=(-0.2, 0.2),
    symptom="proportional to the motor's force",
    reference="Kang et al. 2023, (4), K_m",
)
def force_constant_error(motor_force_n, error_ratio):
    """Force constant that differs from its nominal value: F = epsilon F_nominal."""
    return error_ratio * motor_force_n
