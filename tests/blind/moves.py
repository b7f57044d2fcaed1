"""Reference moves as users record them: paths of the end stage and of the end stage relative to the macro axis."""

import numpy as np

from tests.blind.machine import SAMPLE_S

TRAVEL_M = 0.16  # either side of the middle
TOP_ACCELERATION_M_PER_S2 = 1.5


def smoothed(path, lengths):
    """A path after moving averages of these many samples; its ends stand still."""
    for length in lengths:
        length = max(int(length), 1)
        padded = np.concatenate([np.full(length - 1, path[0]), path])
        total = np.concatenate([[0.0], np.cumsum(padded - path[0])])
        path = path[0] + (total[length:] - total[:-length]) / length
    return path


def with_derivatives(path):
    """(n, 3): position, speed, acceleration by central differences; it stands before its start, goes on after it."""
    padded = np.concatenate([[path[0]], path, [2.0 * path[-1] - path[-2]]])
    speed = (padded[2:] - padded[:-2]) / (2.0 * SAMPLE_S)
    acceleration = (padded[2:] - 2.0 * padded[1:-1] + padded[:-2]) / SAMPLE_S**2
    return np.ascontiguousarray(np.column_stack([path, speed, acceleration]))


def eased(n, seconds=1.0):
    """A factor that rises from 0 to 1 without a jerk."""
    u = np.clip(np.arange(n) * SAMPLE_S / seconds, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u * u)


def through(corners, n):
    """A path along straight lines through (time, position) corners."""
    t, x = zip(*corners, strict=True)
    return np.interp(np.arange(n) * SAMPLE_S, t, x)


def sine(rng, n):
    """One or two slow sines."""
    t = np.arange(n) * SAMPLE_S
    path = np.zeros(n)
    for _ in range(rng.integers(1, 3)):
        frequency = rng.uniform(0.08, 0.5)
        amplitude = min(rng.uniform(0.02, 0.12), 0.5 * TOP_ACCELERATION_M_PER_S2 / (2 * np.pi * frequency) ** 2)
        path += amplitude * np.sin(2 * np.pi * frequency * t)
    path *= min(1.0, TRAVEL_M / np.abs(path).max())
    return rng.uniform(-1, 1) * (TRAVEL_M - np.abs(path).max()) + eased(n) * path


def trapezoid(rng, n):
    """Moves at a constant speed between random places, with dwells."""
    speed = rng.uniform(0.03, 0.3)
    ramp_s = max(speed / rng.uniform(0.5, TOP_ACCELERATION_M_PER_S2), 0.05)
    t, x = rng.uniform(0.2, 0.6), rng.uniform(-TRAVEL_M, TRAVEL_M)
    corners = [(0.0, x), (t, x)]
    while t < n * SAMPLE_S:
        goal = rng.uniform(-TRAVEL_M, TRAVEL_M)
        if abs(goal - x) < 0.03:
            continue
        t += abs(goal - x) / speed
        x = goal
        corners.append((t, x))
        t += ramp_s * 1.5 + rng.uniform(0.2, 1.0)
        corners.append((t, x))
    return smoothed(through(corners, n), [1e3 * ramp_s, 500 * ramp_s, 250 * ramp_s])


def multisine(rng, n):
    """Lines between 0.3 and 20 Hz on a slow sine."""
    t = np.arange(n) * SAMPLE_S
    lines = 0.3 * (20.0 / 0.3) ** rng.random(12)
    rest = rng.uniform(0.2, 0.6)  # m/s2 rms, all lines together
    path = np.zeros(n)
    for frequency in lines:
        amplitude = min(rest * np.sqrt(2.0 / len(lines)) / (2 * np.pi * frequency) ** 2, 0.02)
        path += amplitude * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 2 * np.pi))
    frequency = rng.uniform(0.05, 0.2)
    path += rng.uniform(0.0, 0.08) * np.sin(2 * np.pi * frequency * t)
    return rng.uniform(-0.04, 0.04) + eased(n) * (path - path[0])


def slow_speeds(rng, n):
    """Constant speeds both ways, five or more of 0.2 to 30 mm/s."""
    t, x = 0.5, rng.uniform(-0.1, 0.1)
    corners = [(0.0, x), (t, x)]
    leg = n * SAMPLE_S / 11.0
    while t < n * SAMPLE_S:
        speed = 0.2e-3 * (30e-3 / 0.2e-3) ** rng.random()
        for way in (1.0, -1.0):
            t += leg
            x += way * speed * leg
            corners.append((t, x))
    return smoothed(through(corners, n), [100, 50, 25])


def micrometre_reversals(rng, n):
    """Triangles of 2 to 50 um at two to four places."""
    t, x = 0.3, rng.uniform(-0.1, 0.1)
    corners = [(0.0, x), (t, x)]
    places = int(rng.integers(2, 5))
    for _ in range(places):
        end = t + 0.8 * n * SAMPLE_S / places
        size, half = 2e-6 * 25.0 ** rng.random(), rng.uniform(0.25, 1.0)
        side = 1.0
        while t < end:
            t += half
            corners.append((t, x + side * size))
            side = -side
        x = float(np.clip(x + rng.uniform(-0.05, 0.05), -TRAVEL_M, TRAVEL_M))
        t += 0.15 * n * SAMPLE_S / places
        corners.append((t, x))
    return smoothed(through(corners, n), [60, 40, 20])


def standstill(rng, n):
    """Waits at several places."""
    t, x = 2.0, rng.uniform(-0.1, 0.1)
    corners = [(0.0, x), (t, x)]
    while t < n * SAMPLE_S:
        x = float(np.clip(x + rng.uniform(-0.1, 0.1), -TRAVEL_M, TRAVEL_M))
        t += 1.0
        corners.append((t, x))
        t += rng.uniform(2.0, 4.0)
        corners.append((t, x))
    return smoothed(through(corners, n), [200, 100, 50])


RECIPES = {
    "sine": sine,
    "trapezoid": trapezoid,
    "multisine": multisine,
    "slow_speeds": slow_speeds,
    "micrometre_reversals": micrometre_reversals,
    "standstill": standstill,
    "two_sided_contact": None,
}


def contact_path(rng, n, left_m, right_m):
    """The end stage pushed into both stops, 40 to 300 um deep, at 0.2 to 1.2 Hz: relative position in m."""
    t = np.arange(n) * SAMPLE_S
    centre, half = 0.5 * (right_m - left_m), 0.5 * (right_m + left_m)
    swing = half + rng.uniform(40e-6, 300e-6)
    frequency = rng.uniform(0.2, 1.2)
    wave = np.sin(2 * np.pi * frequency * t)
    if rng.random() < 0.4:  # slow and fast touches in one run
        wave = np.sin(2 * np.pi * (0.3 * frequency * t + 0.35 * frequency * t * t / (n * SAMPLE_S)))
    return centre + eased(n) * swing * wave


def run_paths(recipe, rng, n, single, left_m, right_m):
    """(reference, relative) of a run, (n, 3) each."""
    centre = 0.5 * (right_m - left_m)
    relative = np.full(n, 0.0 if single else centre)
    if recipe == "two_sided_contact":
        under = rng.choice(("standstill", "sine", "slow_speeds"))
        path = RECIPES[under](rng, n)
        relative = contact_path(rng, n, left_m, right_m)
    else:
        path = RECIPES[recipe](rng, n)
        if not single and rng.random() < 0.25:  # the end stage wanders inside its play
            t = np.arange(n) * SAMPLE_S
            half = 0.5 * (right_m + left_m)
            relative = relative + eased(n) * rng.uniform(0.2, 0.6) * half * np.sin(2 * np.pi * rng.uniform(0.1, 2) * t)
    return with_derivatives(path), with_derivatives(relative)
