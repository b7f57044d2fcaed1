"""Laws that jump where a body turns round, as their means over the parts of intervals in which it does so.

At the middle of such a part a law is all of one direction: by up to an eighth of a millisecond too early or too late. A
friction of 3.6 N of the micro, known exactly, left 18 900 squares so, and 2100 as a mean; what that did to the motion
behind a reversal hid a command that was 163 us late (1010222). Pure.
"""

from collections.abc import Sequence

import numpy as np

from stagectl.effects import Effect
from stagectl.gap.quantities import along_motion

_VELOCITY = "velocity_m_per_s"


def jumps_at(effect: Effect, place: str) -> bool:
    """Tell whether a law without memory jumps with the velocity of the body that it pushes; a user's own may not."""
    return effect.has_step and not effect.memory and _VELOCITY in effect.quantities and place.endswith("_force")


def with_jumps(
    effect: Effect,
    arguments: Sequence[np.ndarray],
    acceleration_m_per_s2: np.ndarray,
    parameters: list[float],
    force_n: np.ndarray,
    period_s: float,
) -> np.ndarray:
    """Return forces of a law that jumps, shape (n, parts), as means where the velocity changes its sign.

    arguments: what the law asks for, in its order, and force_n what it is there, at the middles of parts. A body goes
    on into its reversal as before it: behind it, what jumps acts already.
    """
    part_s = period_s / force_n.shape[1]
    middle, acceleration = arguments[effect.quantities.index(_VELOCITY)].ravel(), acceleration_m_per_s2.ravel()
    turns = np.flatnonzero(np.abs(middle) < 0.5 * part_s * np.abs(acceleration))
    change = part_s * acceleration[turns]
    begin, end = middle[turns] - 0.5 * change, middle[turns] + 0.5 * change
    before = part_s * acceleration[np.maximum(turns - 1, 0)]
    share, slows = begin / (begin - end), before * begin < 0.0
    share[slows] = np.minimum(-begin[slows] / before[slows], 1.0)
    mean_n = np.zeros(turns.size)
    for speed_m_per_s, lasts in ((0.5 * begin, share), (0.5 * end, 1.0 - share)):
        there = [
            speed_m_per_s if name == _VELOCITY else values.ravel()[turns]
            for name, values in zip(effect.quantities, arguments, strict=True)
        ]
        mean_n += lasts * along_motion(effect, [values[:, None] for values in there], parameters)[:, 0]
    turned_n = force_n.copy()
    turned_n.ravel()[turns] = mean_n
    return turned_n
