"""An axis in closed loop whose motor's force a test makes, stepped more finely than it is read."""

from collections.abc import Callable

import numpy as np

from stagectl.gap.believed import Believed, BelievedAxis
from stagectl.gap.log import Log

H, STEPS, MASS, NOISE_M = 1e-3, 10, 40.0, 5e-9
DURATION_S = 8.0

AXIS = Believed("an axis", H, BelievedAxis(MASS, 0.2, NOISE_M, 0.0, force_constant_sd_ratio=0.005, latch_sd_s=5e-6))


def axis_under(made_n: Callable[[float, float, float], float], seed: int, steps: int = STEPS) -> Log:
    """Run an axis in closed loop, its motor's force made by `made_n` of command, position and velocity.

    steps: in a sample interval. What a friction does where the axis turns round takes more than ten: beside 6.5 million
    squares of a sub-linear one a ripple gained 47 with ten of them, and 2 with 100.
    """
    random = np.random.default_rng(seed)
    count = round(DURATION_S / H)
    t = np.arange(count) * H
    stroke_m, hz, phase = 0.03 + 0.01 * seed, 0.6 + 0.1 * seed, 0.4 * seed
    turn = 2.0 * np.pi * hz
    goal = stroke_m * np.sin(turn * t + phase) + 0.01 * np.sin(2.6 * turn * t)
    rate, pull = np.gradient(goal, H), np.gradient(np.gradient(goal, H), H)
    noise = NOISE_M * random.standard_normal(count)
    x, v = float(goal[0]), float(rate[0])
    seen, command = np.zeros(count), np.zeros(count)
    h = H / steps
    for k in range(count):
        seen[k] = x + noise[k]
        command[k] = MASS * (pull[k] + 900.0 * (goal[k] - seen[k]) + 42.0 * (rate[k] - v))
        for _ in range(steps):
            x += 0.5 * h * v
            v += h * made_n(command[k], x, v) / MASS
            x += 0.5 * h * v
    return Log(f"run {seed}", H, seen, command, np.ones(count, bool), "one")
