"""The references of sections 5.1 and 5.3, sampled. Pure numpy.

5.1: x_h1 = 0.4 sin(0.5 pi t), x_h2 = (0.6 / 11)(t - 3) from 3 to 14 s, x_w = 0.04 sin(2 pi t). 5.3: x_ref1 =
0.5 sin(0.75 t); of x_ref2 only the stroke of 0.8 m is printed.
"""

from dataclasses import dataclass

import numpy as np

_TRAPEZOID_SPEED_M_PER_S = 0.2
_TRAPEZOID_CORNERS_S = (0.6, 0.3, 0.15)  # moving averages that round its corners
_TRAPEZOID_S = 18.0


@dataclass(frozen=True, slots=True)
class Reference:
    """A sampled reference, one element a control period, shapes (n,)."""

    name: str
    dt_s: float
    position_m: np.ndarray
    velocity_m_per_s: np.ndarray
    acceleration_m_per_s2: np.ndarray

    @property
    def t_s(self) -> np.ndarray:
        """Times of the samples."""
        return np.arange(self.position_m.size) * self.dt_s

    def columns(self) -> np.ndarray:
        """Position, velocity, acceleration side by side, shape (n, 3)."""
        return np.column_stack([self.position_m, self.velocity_m_per_s, self.acceleration_m_per_s2])


def sine(name: str, amplitude_m: float, rate_rad_per_s: float, duration_s: float, dt_s: float) -> Reference:
    """A sin(w t): it begins with full speed."""
    t_s = np.arange(round(duration_s / dt_s)) * dt_s
    phase = rate_rad_per_s * t_s
    return Reference(
        name,
        dt_s,
        amplitude_m * np.sin(phase),
        amplitude_m * rate_rad_per_s * np.cos(phase),
        -amplitude_m * rate_rad_per_s**2 * np.sin(phase),
    )


def macro_sine_5_1(dt_s: float) -> Reference:
    """x_h1, five periods."""
    return sine("x_h1", 0.4, 0.5 * np.pi, 20.0, dt_s)


def macro_ramp_5_1(dt_s: float) -> Reference:
    """x_h2; at rest before 3 s and after 14 s, which the paper leaves open."""
    t_s = np.arange(round(20.0 / dt_s)) * dt_s
    moves = (t_s >= 3.0) & (t_s < 14.0)
    position_m = 0.6 / 11.0 * (np.clip(t_s, 3.0, 14.0) - 3.0)
    return Reference("x_h2", dt_s, position_m, np.where(moves, 0.6 / 11.0, 0.0), np.zeros_like(t_s))


def micro_sine_5_1(dt_s: float) -> Reference:
    """x_w, of the end against the macro."""
    return sine("x_w", 0.04, 2.0 * np.pi, 20.0, dt_s)


def sine_5_3(dt_s: float) -> Reference:
    """x_ref1, three periods."""
    return sine("sine", 0.5, 0.75, 8.0 * np.pi, dt_s)


def trapezoid_5_3(dt_s: float) -> Reference:
    """x_ref2, our reading: 1 s rest, 0.8 m at 0.2 m/s, 4 s rest, and back; corners rounded to 0.33 m/s^2."""
    return trapezoid("trapezoid", _TRAPEZOID_SPEED_M_PER_S, 4.0, _TRAPEZOID_CORNERS_S, _TRAPEZOID_S, dt_s)


def trapezoid(
    name: str, speed_m_per_s: float, phase_s: float, corners_s: tuple[float, ...], duration_s: float, dt_s: float
) -> Reference:
    """1 s rest, a ramp of `phase_s`, rest for as long, and back; corners rounded by moving averages."""
    t_s = np.arange(round(duration_s / dt_s)) * dt_s
    ends = 1.0 + phase_s * np.arange(4)
    ahead = (t_s >= ends[0]) & (t_s < ends[1])
    back = (t_s >= ends[2]) & (t_s < ends[3])
    velocity = speed_m_per_s * (ahead.astype(float) - back.astype(float))
    for window_s in corners_s:
        count = round(window_s / dt_s)
        velocity = np.cumsum(velocity - np.concatenate([np.zeros(count), velocity[:-count]])) / count
    position = np.concatenate([[0.0], np.cumsum(0.5 * dt_s * (velocity[1:] + velocity[:-1]))])
    return Reference(name, dt_s, position, velocity, np.gradient(velocity, dt_s))
