"""Forces that repeat with position: magnets, screws, and the ripple of the motor's force constant."""

import numpy as np

from stagectl.effects.declaration import effect
from stagectl.effects.elementary import wave

_AXES = ("macro_force", "micro_force")
_PITCH = (1e-4, 1.0)  # m
_PHASE = (-7.0, 7.0)  # rad


@effect(
    places=_AXES,
    amplitude_n=(0.0, 1e3),
    pitch_m=_PITCH,
    phase_rad=_PHASE,
    linear=("amplitude_n",),
    session=("phase_rad",),
    searched=("pitch_m",),
    shown_by="strokes",
    symptom="periodic in position, whatever the velocity",
    reference="Roehrig, Jochheim, Proc. ACC 2001: force ripple of linear motors",
)
def cogging(position_m, amplitude_n, pitch_m, phase_rad):
    """Position-periodic force of the magnets: F = A sin(2 pi x / p + phi)."""
    return amplitude_n * np.sin(2.0 * np.pi * position_m / pitch_m + phase_rad)


@effect(
    places=_AXES,
    first_n=(0.0, 1e3),
    second_n=(0.0, 1e3),
    pitch_m=_PITCH,
    first_phase_rad=_PHASE,
    second_phase_rad=_PHASE,
    linear=("first_n", "second_n"),
    session=("first_phase_rad", "second_phase_rad"),
    searched=("pitch_m",),
    symptom="periodic in position and not a sine, whatever the velocity",
    reference="Roehrig, Jochheim, Proc. ACC 2001: force ripple of linear motors, first two harmonics",
)
def harmonic_cogging(position_m, first_n, second_n, pitch_m, first_phase_rad, second_phase_rad):
    """Cogging with its second harmonic: F = A_1 sin(2 pi x / p + phi_1) + A_2 sin(4 pi x / p + phi_2)."""
    angle = 2.0 * np.pi * position_m / pitch_m
    return wave(first_n, angle + first_phase_rad) + wave(second_n, 2.0 * angle + second_phase_rad)


@effect(
    places=("macro_actuator", "micro_actuator"),
    ripple_ratio=(0.0, 0.2),
    pitch_m=_PITCH,
    phase_rad=_PHASE,
    linear=("ripple_ratio",),
    session=("phase_rad",),
    searched=("pitch_m",),
    shown_by="acceleration",
    symptom="periodic in position and proportional to the motor's force",
    reference="Roehrig, Jochheim, Proc. ACC 2001: force constant that changes with position",
)
def current_ripple(position_m, motor_force_n, ripple_ratio, pitch_m, phase_rad):
    """Ripple of the force constant: F = r F_motor sin(2 pi x / p + phi)."""
    return ripple_ratio * motor_force_n * np.sin(2.0 * np.pi * position_m / pitch_m + phase_rad)
