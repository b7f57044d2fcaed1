"""Readings of other instants: what the body that is read feels, on the clock of its readings.

    y(t) = x(t - T)  of  m x'' = u + f(x, x')  is  m y'' = (1 - T')^2 u(t - T) + f(y, y')

A late body's own laws follow its readings and notice nothing. Motors and what lies between the bodies act on it T
later; a lag of its sensor passes them through the same lag; a clock of its own is a T that grows. Taken as an error
-v T of the readings it would bring the noise of v into them (21 nm into readings of 5), and a reversal would seem to
tell a late sensor from a late motor, which it can't. Bodies meet at one instant: their relative position is of readings
moved there. Pure.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stagectl import compose
from stagectl.compiled import compiled
from stagectl.effects import CATALOGUE, Effect, Trait
from stagectl.gap.believed import BelievedAxis
from stagectl.gap.command_path import (
    Acting,
    at_delays,
    at_once,
    behind,
    changed_by,
    driven,
    driven_later,
    lagged,
)
from stagectl.gap.interval_parts import PARTS_COUNT
from stagectl.gap.log import Log
from stagectl.gap.motion import Motion

Row = dict[str, Any]
"""An effect as a row of a profile."""

_LATE = {Trait.LATE_READING, Trait.TIME_SHIFT}


def makes_late(effect: Effect) -> bool:
    """Tell whether readings with an effect are those of other instants."""
    return not _LATE.isdisjoint(effect.traits)


def _of(rows: Sequence[Row], axis: str) -> Iterator[tuple[Effect, list[float], bool]]:
    """Yield (effect, parameters, whether it is a lag) of what makes one body's readings late."""
    for row in rows:
        if row["acts_on"] == f"{axis}_sensor":
            effect = CATALOGUE[row["name"]]
            yield effect, [row[name] for name in effect.parameters], bool(effect.memory)


def _late_s(effect: Effect, parameters: list[float], t_s: np.ndarray) -> np.ndarray:
    """Return how late readings are: what is missing of one that moves at 1 m/s."""
    if "t_s" not in effect.quantities and t_s.size > 1:
        return np.full(t_s.size, _late_s(effect, parameters, t_s[:1])[0])
    columns = np.zeros((t_s.size, len(effect.quantities)))
    if "t_s" in effect.quantities:
        columns[:, effect.quantities.index("t_s")] = t_s
    law, values = compose.along(effect), np.array([*parameters, 0.0])
    still = np.asarray(law(columns, values, np.zeros(1)))
    columns[:, effect.quantities.index("velocity_m_per_s")] = 1.0
    return still - np.asarray(law(columns, values, np.zeros(1)))


def delay_s(rows: Sequence[Row], axis: str, log: Log) -> np.ndarray:
    """Return the dead time of one body's readings at every sample, shape (n,); lags are none."""
    return _delays_s(rows, axis, log.start_s + log.times_s)


def _delays_s(rows: Sequence[Row], axis: str, t_s: np.ndarray) -> np.ndarray:
    delays = [_late_s(effect, parameters, t_s) for effect, parameters, is_lag in _of(rows, axis) if not is_lag]
    return np.sum(delays, axis=0) if delays else np.zeros(t_s.size)


def motor_n(
    rows: Sequence[Row],
    axis: str,
    log: Log,
    acting: Sequence[Acting],
    command_n: np.ndarray,
    drive: BelievedAxis,
) -> np.ndarray:
    """Return what a late body feels of its motor, on parts of its intervals, shape (n, parts).

    acting: effects of the drive's command path. Exactly; what has a memory and comes ever later goes by `at_delays`,
    and what has one behind a lag of the sensor is smeared over parts.
    """
    h, late_s = log.period_s, delay_s(rows, axis, log)
    lags_s = [parameters[0] for _, parameters, is_lag in _of(rows, axis) if is_lag]
    loop_s, constant = drive.current_loop_s, drive.force_constant_n_per_a
    changed_n, slow = at_once(acting, command_n, constant, h)

    def made(latch_s: float) -> np.ndarray:
        total_n = np.zeros((late_s.size, PARTS_COUNT))
        for lag_s in lags_s:
            total_n += behind(lag_s, changed_n, latch_s, loop_s, h)[0]
        for effect, parameters in slow:
            added_n = constant * changed_by(effect, parameters, command_n / constant, latch_s, loop_s, h)[0]
            for lag_s in lags_s:
                added_n = lagged(added_n, lag_s, h)[0]
            total_n += added_n
        return total_n

    if np.ptp(late_s) == 0.0:
        latch_s = drive.latch_s + float(late_s[0])
        return driven(changed_n, latch_s, loop_s, h)[0] + made(latch_s)
    edges_s = log.start_s + h / PARTS_COUNT * np.arange(late_s.size * PARTS_COUNT + 1)
    total_n = driven_later(changed_n, drive.latch_s, loop_s, h, _delays_s(rows, axis, edges_s))
    if lags_s or slow:
        total_n += at_delays(made, drive.latch_s, late_s, h)
    return total_n * (1.0 - np.gradient(late_s, h))[:, None] ** 2


def felt_n(rows: Sequence[Row], axis: str, log: Log, force_n: np.ndarray) -> np.ndarray:
    """Return what a late body feels of a force that is no step, on parts of its intervals, shape (n, parts)."""
    for effect, parameters, is_lag in _of(rows, axis):
        if is_lag:
            force_n = lagged(force_n, parameters[0], log.period_s)[0]
        else:
            force_n = _shifted(force_n, effect, parameters, log)
    return force_n


def _shifted(force_n: np.ndarray, effect: Effect, parameters: list[float], log: Log) -> np.ndarray:
    """Return means over parts of intervals of a force that comes later; its ends are held."""
    part_s = log.period_s / force_n.shape[1]
    edges = np.arange(force_n.size + 1, dtype=float)
    there = edges - _late_s(effect, parameters, log.start_s + part_s * edges) / part_s
    return _means_between(there, force_n.ravel()).reshape(force_n.shape)


@compiled
def _means_between(edges: np.ndarray, force_n: np.ndarray) -> np.ndarray:
    """Return means over parts of a force on parts whose edges lie elsewhere, times how wide they are; ends are held."""
    n = force_n.size
    impulse = np.zeros(n + 1)
    for k in range(n):
        impulse[k + 1] = impulse[k] + force_n[k]
    means = np.empty(n)
    before = 0.0
    for k in range(n + 1):
        inside = min(max(edges[k], 0.0), float(n))
        low = min(int(inside), n - 1)
        f = inside - low
        moved = impulse[low] + (impulse[low + 1] - impulse[low]) * f
        if 0 < low < n - 1:  # on a cubic through four edges (Lagrange): what a line leaves of it
            before_it, after_it = impulse[low + 1] - impulse[low - 1], impulse[low + 2] - impulse[low]
            here = impulse[low + 1] - impulse[low]
            first, second = 2.0 * here - before_it, after_it - 2.0 * here
            moved += f * (f - 1.0) * (first + (second - first) * (f + 1.0) / 3.0) / 2.0
        moved += (edges[k] - inside) * (force_n[0] if edges[k] < inside else force_n[n - 1])
        if k > 0:
            means[k - 1] = (moved - before) * (edges[k] - edges[k - 1])
        before = moved
    return means


def motion_now(rows: Sequence[Row], axis: str, log: Log, motion: Motion) -> Motion:
    """Return where a late body is at the samples' own instants, from its motion on the clock of its readings.

    Behind a lag x = y + tau y', exactly; behind a delay it is what is read T later.
    """
    for effect, parameters, is_lag in _of(rows, axis):
        x, v, a = motion.position_m, motion.velocity_m_per_s, motion.acceleration_m_per_s2
        if is_lag:
            motion = replace(motion, position_m=x + parameters[0] * v, velocity_m_per_s=v + parameters[0] * a)
            continue
        part_s = log.period_s / PARTS_COUNT
        t_s = log.start_s + part_s * (np.arange(x.size) + 0.5)
        late_s = _late_s(effect, parameters, t_s + _late_s(effect, parameters, t_s))
        position_m, rate_m_per_s = _read_later(x.ravel(), v.ravel(), a.ravel(), late_s, part_s)
        motion = replace(motion, position_m=position_m.reshape(x.shape), velocity_m_per_s=rate_m_per_s.reshape(x.shape))
    return motion


@compiled
def _read_later(
    x: np.ndarray, v: np.ndarray, a: np.ndarray, late_s: np.ndarray, part_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity on parts of intervals, from the motion that is read `late_s` after them."""
    position_m, rate_m_per_s = np.empty(x.size), np.empty(x.size)
    for k in range(x.size):
        there = min(max(k + int(np.rint(late_s[k] / part_s)), 0), x.size - 1)
        rest_s = late_s[k] - part_s * (there - k)
        position_m[k] = x[there] + rest_s * v[there] + 0.5 * rest_s**2 * a[there]
        rate_m_per_s[k] = v[there] + rest_s * a[there]
    return position_m, rate_m_per_s
