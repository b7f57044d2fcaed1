"""Elementary functions of laws, without the time that they take where nothing is left of them.

A search runs a law over 100 000 parts of intervals some thousand times. Bristles that have slipped, and a rise that is
over, were three quarters of what LuGre's law took; of two harmonics a fit asks for one at a time.
"""

import numpy as np

from stagectl.compiled import inlined

_HARDLY_A_NUMBER = 700.0
"""exp(-708) is the smallest normal number: beyond it an exponential takes 38 ns in place of 8, and each product with it
as long again."""


@inlined
def fading(x):
    """Return exp(-x) of a number, and 0 where that is hardly one any more."""
    return 0.0 if x > _HARDLY_A_NUMBER else np.exp(-x)


@inlined
def power_of_rest(base, exponent):
    """Return base ^ exponent of numbers, the exponent above zero, and 0 where nothing is left of the base."""
    return 0.0 if base <= 0.0 else np.power(base, exponent)


@inlined
def wave(amplitude, angle_rad):
    """Return amplitude sin(angle) of numbers or arrays of angles; without an amplitude of 0, which takes no time."""
    return amplitude * np.sin(0.0 * angle_rad if amplitude == 0.0 else angle_rad)
