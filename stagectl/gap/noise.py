"""What disturbs a stage besides its slow force: force noise, read off the innovations where no law reaches.

A force that is independent from sample to sample reddens the innovations of a filter that knows nothing of it. How
much there is is what makes them white. Bursts, a friction that turns around, are in few stretches: the middle one of
all counts.

A recording that was low-passed before it was stored has lost its sensor's noise at high frequencies and looks red
whatever moves the stage: beside one as it was read (EMPS), 4 to 8 N of force noise were taken for 1 N. Pure.
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

_LOWER = (0.02, 0.06)
"""Where force noise shows most, and where no more is believed of it than there is: a body without any that was 1.09
times as loud at `_LOW` was given 32 mN, above which it had 0.1 of its power here."""

_PASSED, _STOPPED = (0.2, 0.3), (0.4, 0.5)  # shares of the sample rate
_STOPPED_RATIO = 0.2
"""Of a position's noise between the latter, to that between the former, below which it was low-passed: sensors make 1,
forces alone 0.5, what was stored of EMPS with pulses 0.1."""

_STOPPED_NOISE = 0.5  # of the noise that is stated of the sensor, which such a recording has lost

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

    Those that were low-passed tell of it only where there are no others.

    explained: what is thought to act beyond what is believed; unexplained friction looks like force noise.
    at_most: the noise before anything was explained. What is thought and wrong reddens innovations: with a friction
    that no law is, six wrong names made 0.13 N of 0.03 N, and so were within the noise.
    """
    forces = [Forces() if explained is None else explained(recording) for recording in recordings]
    noise = slow_noise(recordings[0].believed, recordings[0])
    for axis, level in noise.items():
        asked = [k for k, one in enumerate(recordings) if not is_low_passed(one, axis)] or range(len(recordings))
        asked_of = [recordings[k] for k in asked], [forces[k] for k in asked]
        low, high = 0, len(_FORCES_N) - 1
        if at_most is not None:
            high = _FORCES_N.index(at_most[axis].white_force_n)
        while low < high:  # the ratio falls with the force noise that the filter expects
            middle = (low + high) // 2
            at_middle, lower = _redness(*asked_of, axis, replace(level, white_force_n=_FORCES_N[middle]))
            if at_middle <= _WHITE_RATIO or lower <= 1.0:
                high = middle
            else:
                low = middle + 1
        noise[axis] = replace(level, white_force_n=_FORCES_N[low])
    return noise


def is_low_passed(recording: Recording, axis: str) -> bool:
    """Tell whether a body's positions were low-passed before they were stored: their sensor's noise is gone."""
    position_m = recording.position_m(axis)
    if position_m.size < _STRETCH + 4:
        return False
    fourth_m = np.diff(position_m, 4)  # in which motion is nothing
    within, beyond = (_middle_noise_m(fourth_m, band) for band in (_PASSED, _STOPPED))
    return beyond < _STOPPED_RATIO * within and beyond < _STOPPED_NOISE * recording.belief(axis).noise_m


def _middle_noise_m(fourth_m: np.ndarray, band: tuple[float, float]) -> float:
    """Return the noise within a band of a position of which these are the fourth differences."""
    turn = 2.0 * np.pi * np.linspace(*band)
    passed = np.mean((2.0 - 2.0 * np.cos(turn)) ** 4)  # of power
    return float(np.sqrt(np.median(_power(fourth_m, band)) / passed))


def scale_of(left: np.ndarray, low_passed: bool) -> float:
    """Return how large what is left of innovations is where no force reaches, in units of what is believed.

    Where that was filtered away they are judged below, in the middle one of all stretches: an upper limit.
    """
    if low_passed and left.size >= _STRETCH:
        return float(np.sqrt(np.median(_power(left, _LOW))))
    power = np.abs(np.fft.rfft(left)) ** 2 / left.size
    return float(np.sqrt(np.mean(power[np.fft.rfftfreq(left.size) > _HIGH[0]])))


def _redness(recordings: Sequence[Recording], forces: Sequence[Forces], axis: str, level: Noise) -> tuple[float, float]:
    """Return the power of innovations at middle and at lower frequencies over that at high ones, typically."""
    ratios = []
    for recording, more in zip(recordings, forces, strict=True):
        balance.set_noise(recording, {name: level for name in recording.axes})
        z = balance.unexplained(recording, more)[recording.axes.index(axis)]
        if z.size < _STRETCH:
            continue
        high = 1.0 if is_low_passed(recording, axis) else np.maximum(_power(z, _HIGH), 1e-300)
        ratios.append(np.stack([_power(z, band) / high for band in (_LOW, _LOWER)], axis=1))
    if not ratios:
        return 0.0, 0.0
    middle, lower = np.median(np.concatenate(ratios), axis=0)
    return float(middle), float(lower)


def _power(values: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    """Return the mean power within a band of each stretch, of white numbers their variance."""
    count = values.size // _STRETCH
    window = np.hanning(_STRETCH)
    spectrum = np.fft.rfft(values[: count * _STRETCH].reshape(count, _STRETCH) * window, axis=1)
    share = np.fft.rfftfreq(_STRETCH)
    power = np.abs(spectrum[:, (share > band[0]) & (share < band[1])]) ** 2
    return power.mean(axis=1) / float(window @ window)
