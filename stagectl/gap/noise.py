"""What disturbs a stage besides its slow force: force noise, read off the innovations where no law reaches.

A force that is independent from sample to sample reddens the innovations of a filter that knows nothing of it. How
much there is is what makes them white. Bursts, a friction that turns around, are in few stretches: the middle one of
all counts. Pure.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from stagectl.gap import balance
from stagectl.gap.believed import Believed
from stagectl.gap.forces import Forces
from stagectl.gap.innovations import Noise
from stagectl.gap.motion import SLOW_CORNER_RAD_PER_S, SLOW_FORCE_N
from stagectl.gap.recording import Recording

_FORCES_N = (0.0, *(1e-3 * 2.0**k for k in range(14)))
_STRETCH = 512
_LOW, _HIGH = (0.06, 0.2), (0.3, 0.5)  # shares of the sample rate
_WHITE_RATIO = 1.08

Explained = Callable[[Recording], Forces]
"""What is thought to act in a recording beyond what is believed."""


def slow_noise(believed: Believed, recording: Recording) -> dict[str, Noise]:
    """Return what is believed of each body before its recordings are looked at."""
    noise = {"macro": Noise(believed.macro.noise_m, SLOW_FORCE_N, SLOW_CORNER_RAD_PER_S, 0.0)}
    if believed.micro is not None and "end" in recording.axes:
        noise["end"] = Noise(believed.micro.noise_m, SLOW_FORCE_N, SLOW_CORNER_RAD_PER_S, 0.0)
    return noise


def noise_of(
    recordings: Sequence[Recording], explained: Explained | None = None, at_most: dict[str, Noise] | None = None
) -> dict[str, Noise]:
    """Return slow force, force noise and sensor noise of each body, the force noise from all recordings together.

    explained: what is thought to act beyond what is believed; unexplained friction looks like force noise.
    at_most: the noise before anything was explained. What is thought and wrong reddens innovations: with a friction
    that no law is, six wrong names made 0.13 N of 0.03 N, and so were within the noise.
    """
    forces = [Forces() if explained is None else explained(recording) for recording in recordings]
    noise = slow_noise(recordings[0].believed, recordings[0])
    for axis, level in noise.items():
        low, high = 0, len(_FORCES_N) - 1
        if at_most is not None:
            high = _FORCES_N.index(at_most[axis].white_force_n)
        while low < high:  # the ratio falls with the force noise that the filter expects
            middle = (low + high) // 2
            if _redness(recordings, forces, axis, replace(level, white_force_n=_FORCES_N[middle])) <= _WHITE_RATIO:
                high = middle
            else:
                low = middle + 1
        noise[axis] = replace(level, white_force_n=_FORCES_N[low])
    return noise


def _redness(recordings: Sequence[Recording], forces: Sequence[Forces], axis: str, level: Noise) -> float:
    """Return the innovations' power at middle over that at high frequencies, in the middle one of all stretches."""
    ratios = []
    for recording, more in zip(recordings, forces, strict=True):
        balance.set_noise(recording, {name: level for name in recording.axes})
        z = balance.unexplained(recording, more)[recording.axes.index(axis)]
        count = z.size // _STRETCH
        if not count:
            continue
        power = np.abs(np.fft.rfft(z[: count * _STRETCH].reshape(count, _STRETCH) * np.hanning(_STRETCH), axis=1)) ** 2
        share = np.fft.rfftfreq(_STRETCH)
        low, high = (power[:, (share > band[0]) & (share < band[1])].mean(axis=1) for band in (_LOW, _HIGH))
        ratios.append(low / np.maximum(high, 1e-300))
    return float(np.median(np.concatenate(ratios))) if ratios else 0.0
