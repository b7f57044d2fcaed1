"""Whitening: what a mass on known forces is off from its measured position, as independent numbers of unit variance.

    m x'' = f + d,    d' = w e,    e' = -w d - 2^(1/2) w e + noise,    y = x + n

A Kalman filter of (x, v, d, e) predicts each sample from the ones before; d stands for the slow force that nobody
models, n for the sensor. The slow force has been through a Butterworth filter of second order, flat up to its corner:
with one pole it would be believed to have thirty times its power at 20 Hz, and hide every friction there; with two
poles at one place it has 1.6 times its power at standstill, and hides springs and tilts. With recorded commands as
input, whatever controller ran, the innovations hold all that the positions say of the forces (prediction-error
method, Ljung 1999, 7). The filter is linear: the innovations of f0 + a f1 are those of f0 plus a times those of f1
alone, which makes every effect a column of a regression.

Forces come as two numbers a sample interval, their mean and what moves the position (`interval_parts`). Pure; knows no
clock.
"""

from dataclasses import dataclass

import numpy as np

from stagectl.compiled import compiled, inlined
from stagectl.gap.interval_parts import PARTS_COUNT, moments_of

_START_SD = (1e-6, 1e-2)  # of position and velocity before the first sample, m and m/s
_STATES = 4


@dataclass(frozen=True, slots=True)
class Noise:
    """What the filter believes of an axis: sensor, and the force that nobody models (Gauss-Markov, second order)."""

    sensor_m: float
    force_n: float
    corner_rad_per_s: float
    white_force_n: float  # besides, independent from sample to sample


@compiled
def _slow(turn):
    """Return how (d, e) go on over a phase w h: (d of d, d of e, e of d, e of e)."""
    q = turn / np.sqrt(2.0)
    decay, c, s = np.exp(-q), np.cos(q), np.sin(q)
    return decay * (c + s), decay * np.sqrt(2.0) * s, -decay * np.sqrt(2.0) * s, decay * (c - s)


@compiled
def _model(mass_kg, period_s, sensor_m, force_n, corner_rad_per_s):
    """Return (transition, driving covariance of the slow force, covariance before the first sample), (4, 4) each."""
    h = period_s
    a = np.zeros((_STATES, _STATES))
    a[0] = np.array([1.0, h, 0.5 * h * h / mass_kg, 0.0])
    a[1] = np.array([0.0, 1.0, h / mass_kg, 0.0])
    a[2, 2], a[2, 3], a[3, 2], a[3, 3] = _slow(corner_rad_per_s * h)
    steady = np.zeros((_STATES, _STATES))  # of the slow force: d and e are as large, and independent at one instant
    steady[2, 2] = steady[3, 3] = force_n * force_n
    moved = a @ steady @ a.T
    drive = np.zeros((_STATES, _STATES))
    drive[2:, 2:] = steady[2:, 2:] - moved[2:, 2:]
    p = steady.copy()
    p[0, 0] = _START_SD[0] ** 2 + sensor_m * sensor_m
    p[1, 1] = _START_SD[1] ** 2
    return a, drive, p


@inlined
def _let_loose(p, acceleration_m_per_s2, period_s):
    """Add to a covariance what a force that is held over one interval, and that nobody knows, moves in it."""
    q, h = acceleration_m_per_s2 * acceleration_m_per_s2, period_s
    p[0, 0] += 0.25 * q * h**4
    p[0, 1] += 0.5 * q * h**3
    p[1, 0] = p[0, 1]
    p[1, 1] += q * h * h


@compiled
def gains(valid, loose, mass_kg, period_s, sensor_m, force_n, corner_rad_per_s, white_force_n, loose_force_n):
    """Return (gains (n, 4), innovation variances (n,)); `loose` intervals feel an unknown force of `loose_force_n`."""
    n = valid.size
    gain = np.zeros((n, _STATES))
    variance = np.zeros(n)
    h = period_s
    a, drive, p = _model(mass_kg, period_s, sensor_m, force_n, corner_rad_per_s)
    half = np.zeros((_STATES, _STATES))
    for k in range(n):
        variance[k] = p[0, 0] + sensor_m * sensor_m
        if valid[k]:
            for i in range(_STATES):
                gain[k, i] = p[i, 0] / variance[k]
            row = p[0].copy()
            for i in range(_STATES):
                for j in range(_STATES):
                    p[i, j] -= gain[k, i] * row[j]
        for i in range(_STATES):
            for j in range(_STATES):
                total = 0.0
                for c in range(min(i, 2), _STATES):  # a is block upper triangular
                    total += a[i, c] * p[c, j]
                half[i, j] = total
        for i in range(_STATES):
            for j in range(_STATES):
                total = drive[i, j]
                for c in range(min(j, 2), _STATES):
                    total += half[i, c] * a[j, c]
                p[i, j] = total
        white = white_force_n + (loose_force_n if loose[k] else 0.0)
        _let_loose(p, white / mass_kg, h)
    return gain, variance


@compiled
def filter_steps(gain, variance, mass_kg, period_s, corner_rad_per_s):
    """Return what `innovations` needs of a filter at each sample, (n, 5): what an innovation adds by the next one, sd.

    What is added to position, velocity and both of the slow force holds the step, and is all that one sample waits for
    of the sample before: twelve cycles, not forty. Only the filter decides about it, and it runs a thousand times.
    """
    h = period_s
    moved, turned = 0.5 * h * h / mass_kg, h / mass_kg
    dd, de, ed, ee = _slow(corner_rad_per_s * h)
    out = np.zeros((gain.shape[0], 5))
    for k in range(gain.shape[0]):
        g0, g1, g2, g3 = gain[k, 0], gain[k, 1], gain[k, 2], gain[k, 3]
        out[k, 0], out[k, 1] = g0 + g1 * h + moved * g2, g1 + turned * g2
        out[k, 2], out[k, 3] = dd * g2 + de * g3, ed * g2 + ee * g3
        out[k, 4] = np.sqrt(variance[k]) if g0 != 0.0 else np.inf  # no sample, no innovation
    return out


@compiled
def innovations(position_m, force_n, sign, steps, judged, mass_kg, period_s, corner_rad_per_s, start_m):
    """Return the whitened innovations at judged samples, (m,), of positions under `sign` times forces.

    position_m: (n,), force_n: (n, PARTS_COUNT); either one may be empty, and is zero then.
    """
    out = np.empty(judged.size)
    has_position, has_force = position_m.size > 0, force_n.size > 0
    if has_force and force_n.shape != (judged.size, PARTS_COUNT):
        raise ValueError("forces are not on the parts of these intervals")
    h = period_s
    moved, turned = 0.5 * h * h / mass_kg, h / mass_kg
    x = start_m
    v = 0.0
    d = 0.0
    e = 0.0
    mean_n = 0.0
    early_n = 0.0
    dd, de, ed, ee = _slow(corner_rad_per_s * h)
    judged_count = 0
    for k in range(judged.size):
        z = (position_m[k] if has_position else 0.0) - x
        out[judged_count] = z / steps[k, 4]
        judged_count += judged[k]
        if has_force:
            mean_n, early_n = moments_of(force_n, k)
            mean_n, early_n = sign * mean_n, sign * early_n
        x = (x + v * h + moved * (early_n + d)) + steps[k, 0] * z
        v = (v + turned * (mean_n + d)) + steps[k, 1] * z
        d, e = (dd * d + de * e) + steps[k, 2] * z, (ed * d + ee * e) + steps[k, 3] * z
    return out[:judged_count].copy()


@compiled
def is_nothing(values: np.ndarray) -> bool:
    """Tell whether all values are zero; of others the first ones tell."""
    for value in values.flat:  # noqa: SIM110
        if value != 0.0:
            return False
    return True


@compiled
def certainty(valid, loose, mass_kg, period_s, sensor_m, force_n, corner_rad_per_s, loose_force_n):
    """Return (gains (n, 4), innovation variances (n,), standard deviations of the known velocity, m/s, (n,)).

    What a filter knows depends on which samples are valid and which intervals `loose`, as in `gains`, and on nothing
    that samples hold.
    """
    n = valid.size
    h = period_s
    a, drive, p = _model(mass_kg, period_s, sensor_m, force_n, corner_rad_per_s)
    gains_here, variances, spread_m_per_s = np.zeros((n, _STATES)), np.zeros(n), np.zeros(n)
    for k in range(n):
        if valid[k]:
            variance = p[0, 0] + sensor_m * sensor_m
            gain = p[:, 0] / variance
            p = p - np.outer(gain, p[0])
            gains_here[k] = gain
            variances[k] = variance
        spread_m_per_s[k] = np.sqrt(p[1, 1])
        p = a @ p @ a.T + drive
        p = 0.5 * (p + p.T)
        if loose[k]:
            _let_loose(p, loose_force_n / mass_kg, h)
    return gains_here, variances, spread_m_per_s


@compiled
def filtered(position_m, valid, mean_n, early_n, gain, variance, mass_kg, period_s, corner_rad_per_s):
    """Return (known, foretold, unlikely): what the filter knows along the samples, and how likely they are.

    gain, variance: of `certainty`. known: position, velocity and slow force with each sample, shape (n, 3); foretold:
    position and velocity before it, (n, 2); unlikely: minus twice the log-likelihood.
    """
    n = position_m.size
    h = period_s
    a, _, _ = _model(mass_kg, period_s, 0.0, 0.0, corner_rad_per_s)
    known, foretold = np.zeros((n, 3)), np.zeros((n, 2))
    unlikely = 0.0
    x, v, d, e = position_m[0], 0.0, 0.0, 0.0
    for k in range(n):
        foretold[k, 0], foretold[k, 1] = x, v
        if valid[k]:
            z = position_m[k] - x
            unlikely += z * z / variance[k] + np.log(variance[k])
            x, v, d, e = x + gain[k, 0] * z, v + gain[k, 1] * z, d + gain[k, 2] * z, e + gain[k, 3] * z
        known[k, 0], known[k, 1], known[k, 2] = x, v, d
        x += a[0, 1] * v + a[0, 2] * d + 0.5 * h * h * early_n[k] / mass_kg
        v += a[1, 2] * d + h * mean_n[k] / mass_kg
        d, e = a[2, 2] * d + a[2, 3] * e, a[3, 2] * d + a[3, 3] * e
    return known, foretold, unlikely
