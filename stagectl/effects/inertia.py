"""Newton's part: reaction of the micro's drive, a wrong mass, a mass on a spring, a base that shakes.

They take the acceleration of the substep before. An error e of the mass then settles as the geometric series
1 - e + e^2 - ..., within a few substeps, and would loop only where e reaches 1.
"""

import numpy as np

from stagectl.effects.declaration import Trait, effect

_AXES = ("macro_force", "micro_force")


@effect(
    places=("macro_force",),
    fraction_ratio=(0.0, 1.0),
    linear=("fraction_ratio",),
    shown_by="acceleration",
    symptom="the voice coil's force, mirrored on the macro",
    reference="Newton's third law on Kang et al. 2023, (1): the voice coil's stator rides on the macro",
)
def micro_reaction(micro_motor_force_n, fraction_ratio):
    """Reaction of the voice coil on the macro: F = -a F_micro, a = 1 where the stator rides on the macro."""
    return -fraction_ratio * micro_motor_force_n


@effect(
    places=_AXES,
    error_ratio=(-0.5, 0.5),
    linear=("error_ratio",),
    traits=(Trait.KNOWN_PARAMETER,),
    symptom="proportional to acceleration; a force constant that is too small looks alike on one axis",
    reference="Newton",
)
def mass_error(acceleration_m_per_s2, mass_kg, error_ratio):
    """Mass that differs from its nominal value: F = -e m a."""
    return -error_ratio * mass_kg * acceleration_m_per_s2


@effect(
    places=_AXES,
    memory=3,
    share_ratio=(0.0, 0.5),
    frequency_hz=(5.0, 500.0),
    damping_ratio=(1e-3, 0.7),
    traits=(Trait.SWINGS,),
    searched=("frequency_hz", "damping_ratio"),
    shown_by="acceleration",
    symptom="rings at one frequency after each change of acceleration",
    reference="Den Hartog, Mechanical Vibrations, section 3.2: a mass on a spring, moved by its base",
)
def flexible_mode(acceleration_m_per_s2, mass_kg, dt_s, share_ratio, frequency_hz, damping_ratio, memory):
    """A share of the mass sits on a spring: F = -mu m q'', q'' + 2 zeta w q' + w^2 q = -a, w = 2 pi f.

    q is its motion against the axis, f its frequency with the axis held; the whole mass stays what it is. What all
    other forces make of the axis is a - F / m = a_0, so (1 - mu) q'' + 2 zeta w q' + w^2 q = -a_0: stepped so, exactly
    for constant a_0, it is stable for any step (stepped with a itself it diverges at 200 Hz and 0.3 ms). F is the mean.
    memory: q, q', F / m of the step before.
    """
    w = 2.0 * np.pi * frequency_hz
    q, rate = memory[0], memory[1]
    others = acceleration_m_per_s2 - memory[2]
    if not dt_s > 0.0:
        pull = others + 2.0 * damping_ratio * w * rate + w * w * q
        return share_ratio * mass_kg * pull / (1.0 - share_ratio)
    decay = damping_ratio * w / (1.0 - share_ratio)
    free = w * w / (1.0 - share_ratio)  # square of the frequency with the axis free
    damped = np.sqrt(free - decay * decay)
    rest = -others / (w * w)
    apart = q - rest
    shrink = np.exp(-decay * dt_s)
    c, s = np.cos(damped * dt_s), np.sin(damped * dt_s)
    memory[0] = rest + shrink * (apart * c + (rate + decay * apart) / damped * s)
    memory[1] = shrink * (rate * c - (decay * rate + free * apart) / damped * s)
    memory[2] = -share_ratio * (memory[1] - rate) / dt_s
    return mass_kg * memory[2]


@effect(
    places=_AXES,
    amplitude_m_per_s2=(0.0, 10.0),
    frequency_hz=(0.1, 500.0),
    phase_rad=(-7.0, 7.0),
    linear=("amplitude_m_per_s2",),
    run=("phase_rad",),
    traits=(Trait.BASE,),
    searched=("frequency_hz",),
    symptom="periodic in time, whatever the motion, and on both axes in the ratio of their masses",
    reference="Newton in a frame that shakes; ISO 2631-2 for what a floor does",
)
def base_vibration(mass_kg, t_s, amplitude_m_per_s2, frequency_hz, phase_rad):
    """A base that shakes with acceleration A sin(2 pi f t + phi), felt against it: F = -m A sin(2 pi f t + phi)."""
    return -mass_kg * amplitude_m_per_s2 * np.sin(2.0 * np.pi * frequency_hz * t_s + phase_rad)
