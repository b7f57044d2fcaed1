"""Forces on equal parts of sample intervals, and what they move: their mean, and one weighted towards the start.

    v(h) = v(0) + h mean / m,    x(h) = x(0) + h v(0) + h^2 early / 2 m,    early = 2 / h^2 integral of (h - s) f(s) ds

Forces are kept as their means over parts. Within a part they go on a line, as far as the parts of the same interval
tell (no later one: what acts there knows of a later sample). Held over parts they came late: the mass that a multisine
of 13 Hz moved seemed 37 ppm too large, nine deviations of a reading of 7 nm, and a lag of 151 us was a delay beside
another mass. Pure.
"""

import numpy as np

from stagectl.compiled import compiled, inlined

PARTS_COUNT = 4
"""Parts of a sample interval: friction on whole milliseconds left 57 times its noise, on quarters 8 (prototype)."""

_MIDDLES = (np.arange(PARTS_COUNT) + 0.5) / PARTS_COUNT
_RISE = np.zeros(PARTS_COUNT)  # from begin to end of an interval, from means of its parts
_RISE[:2] -= (1.5, -0.5)
_RISE[-2:] += (-0.5, 1.5)
_EARLY = 2.0 * (1.0 - _MIDDLES) / PARTS_COUNT - _RISE / (6.0 * PARTS_COUNT**2)
"""What the mean over each part counts in the mean that is weighted towards the start: exactly, up to parabolas."""

_TILT = _MIDDLES - 0.5
_TILT_EARLY = float(_EARLY @ _TILT)


@inlined
def moments_of(fine_n, k):
    """Return (mean, early) of one interval of forces on parts, shape (n, PARTS_COUNT)."""
    mean, early = 0.0, 0.0
    for part in range(PARTS_COUNT):
        mean += fine_n[k, part]
        early += _EARLY[part] * fine_n[k, part]
    return mean / PARTS_COUNT, early


@compiled
def moments(fine_n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (mean, early) of each interval of forces on parts, shape (n, PARTS_COUNT)."""
    mean_n, early_n = np.empty(fine_n.shape[0]), np.empty(fine_n.shape[0])
    for k in range(fine_n.shape[0]):
        mean_n[k], early_n[k] = moments_of(fine_n, k)
    return mean_n, early_n


@compiled
def with_early(fine_n: np.ndarray, early_n: np.ndarray) -> np.ndarray:
    """Return means over parts tilted within each interval until `moments` has `early_n` of it: steps are no lines."""
    tilted_n = np.empty_like(fine_n)
    for k in range(fine_n.shape[0]):
        tilt_n = (early_n[k] - moments_of(fine_n, k)[1]) / _TILT_EARLY
        for part in range(PARTS_COUNT):
            tilted_n[k, part] = fine_n[k, part] + tilt_n * _TILT[part]
    return tilted_n
