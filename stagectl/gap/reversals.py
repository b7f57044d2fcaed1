"""When a body turned round: what remembers, of a friction or a cable, goes by the time since. Pure."""

import numpy as np

from stagectl.compiled import compiled


@compiled
def since_reversal(position_m: np.ndarray, turn_m: float, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (time since the last reversal, s; direction of motion, 0 before it is known) of positions, shape (n,).

    A body has turned round where it went back by `turn_m`, at the farthest place that it had been to.
    """
    n = position_m.size
    since_s, direction = np.zeros(n), np.zeros(n)
    farthest_m, farthest, turned, way = position_m[0], 0, 0, 0.0
    for k in range(n):
        ahead_m = position_m[k] - farthest_m
        if abs(ahead_m) > turn_m and way * ahead_m <= 0.0:
            turned = farthest
            way = np.sign(ahead_m)
        if way * ahead_m > 0.0:
            farthest_m, farthest = position_m[k], k
        since_s[k] = (k - turned) * step_s
        direction[k] = way
    return since_s, direction
