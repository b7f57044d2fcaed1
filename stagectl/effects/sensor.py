"""From the true position to an interferometer's reading: what is added, in metres, at the instant of the sample."""

import numpy as np

from stagectl.effects.declaration import Trait, effect
from stagectl.effects.elementary import wave

_SENSORS = ("macro_sensor", "end_sensor")
_PHASE = (-7.0, 7.0)  # rad


@effect(
    places=_SENSORS,
    delay_s=(-0.01, 0.01),
    traits=(Trait.LATE_READING,),
    searched=("delay_s",),
    shown_by="acceleration",
    symptom="proportional to velocity, on the reading",
    reference="Taylor; a position at t - T of a stage whose acceleration stands still for T",
)
def sensor_delay(velocity_m_per_s, acceleration_m_per_s2, delay_s):
    """Reading of an earlier instant: x(t - T) = x - v T + a T^2 / 2, as a device that latches before it stamps."""
    return delay_s * (0.5 * acceleration_m_per_s2 * delay_s - velocity_m_per_s)


@effect(
    places=_SENSORS,
    memory=1,
    time_constant_s=(1e-6, 0.05),
    traits=(Trait.LATE_READING,),
    searched=("time_constant_s",),
    shown_by="acceleration",
    symptom="proportional to velocity, on the reading, and rounded where the acceleration changes",
    reference="Franklin, Powell, Workman, Digital Control of Dynamic Systems, section 4.3: first-order lag of a ramp",
)
def sensor_lag(velocity_m_per_s, acceleration_m_per_s2, dt_s, time_constant_s, memory):
    """Reading through an analogue low-pass: y' = (x - y) / tau, and y - x is added; the device samples y.

    memory: y - x. Its step takes x from sample to sample as a motion of constant acceleration, and is exact for it.
    """
    tau = time_constant_s
    left = np.exp(-dt_s / tau)
    gone = 1.0 - left
    memory[0] = memory[0] * left - tau * (velocity_m_per_s * gone - acceleration_m_per_s2 * (tau * gone - dt_s * left))
    return memory[0]


@effect(
    places=_SENSORS,
    error_ppm=(-1e4, 1e4),
    linear=("error_ppm",),
    shown_by="strokes",
    symptom="proportional to position, on the reading",
    reference="ISO 230-2; index of air, wavelength, cosine error",
)
def scale_error(position_m, error_ppm):
    """Metre that is too short: x (1 + e), so e x is added."""
    return 1e-6 * error_ppm * position_m


@effect(
    places=_SENSORS,
    first_m=(0.0, 1e-6),
    second_m=(0.0, 1e-6),
    wavelength_m=(3e-7, 2e-6),
    first_phase_rad=_PHASE,
    second_phase_rad=_PHASE,
    linear=("first_m", "second_m"),
    session=("first_phase_rad", "second_phase_rad"),
    traits=(Trait.FIRST_ORDER,),
    shown_by="strokes",
    symptom="periodic in position with half (and a quarter of) the laser's wavelength, on the reading",
    reference="Wu, Deslattes, Rev. Sci. Instrum. 69(7), 1998; Heydemann, Applied Optics 20(19), 1981",
)
def cyclic_error(position_m, first_m, second_m, wavelength_m, first_phase_rad, second_phase_rad):
    """Periodic error of the interferometer: A_1 sin(4 pi x / lambda + phi_1) + A_2 sin(8 pi x / lambda + phi_2)."""
    angle = 4.0 * np.pi * position_m / wavelength_m
    return wave(first_m, angle + first_phase_rad) + wave(second_m, 2.0 * angle + second_phase_rad)


@effect(
    places=_SENSORS,
    drift_m=(-1e-3, 1e-3),
    time_constant_s=(10.0, 1e5),
    linear=("drift_m",),
    searched=("time_constant_s",),
    shown_by="time",
    symptom="grows with time and levels off, on the reading, whatever the motion",
    reference="ISO 230-3: thermal drift of a lumped mass after a step in temperature",
)
def thermal_drift(t_s, drift_m, time_constant_s):
    """Drift of a part that warms up: D (1 - exp(-t / tau)), t since the machine was switched on."""
    return -drift_m * np.expm1(-t_s / time_constant_s)


@effect(
    places=_SENSORS,
    bow_per_m=(-1e-2, 1e-2),
    centre_m=(-10.0, 10.0),
    linear=("bow_per_m",),
    session=("centre_m",),
    shown_by="strokes",
    symptom="with the square of the position, on the reading",
    reference="Bryan, Precision Engineering 1(3), 1979: the Abbe principle revisited; ISO 230-1",
)
def abbe_error(position_m, bow_per_m, centre_m):
    """Abbe error h theta(x) of a beam at offset h, for a pitch that grows with the square of the way: B (x - x_0)^2.

    B = h theta'' / 2. What the pitch has of a constant and of a slope is a zero and a scale error.
    """
    way = position_m - centre_m
    return bow_per_m * way * way


@effect(
    places=_SENSORS,
    skew_ppm=(-1000.0, 1000.0),
    traits=(Trait.TIME_SHIFT,),
    searched=("skew_ppm",),
    shown_by="time",
    symptom="proportional to velocity, on the reading, and growing in the course of a run",
    reference="IEEE 1588, clause on rate offset: instants of a clock that runs fast by e are early by e t; Taylor",
)
def clock_skew(velocity_m_per_s, acceleration_m_per_s2, t_s, skew_ppm):
    """Instants of a clock of its own: taken T = e t later than the number says, so v T + a T^2 / 2 is added."""
    late_s = 1e-6 * skew_ppm * t_s
    return late_s * (velocity_m_per_s + 0.5 * acceleration_m_per_s2 * late_s)
