"""What a model's forces miss along the recorded motion: measured inertia force minus modelled forces, sample by sample.

    r_k = m (x_k+1 - 2 x_k + x_k-1) / h^2 - (mean over both intervals, weighted towards sample k, of the forces)

For forces that are known on parts of intervals this second difference is exact, so nothing is smoothed away. Then r is
low-passed without delay to the band in which the sensor's own noise, as the profile states it, makes less than
`NOISE_FORCE_N` of it. Positions of missing samples are interpolated, and left out of all statistics. Pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt, sosfreqz

from stagectl.effects import CATALOGUE
from stagectl.gap import balance, hypotheses
from stagectl.gap.arbiter import lap_samples
from stagectl.gap.believed import Believed
from stagectl.gap.effect_forces import effect_forces, known_forces
from stagectl.gap.findings import Findings, Named
from stagectl.gap.forces import Forces, add_forces
from stagectl.gap.interval_parts import PARTS_COUNT, moments
from stagectl.gap.log import Log
from stagectl.gap.recording import Recording

NOISE_FORCE_N = 0.05
"""Rms of the sensor's noise in the residual force; the force that nobody models is about as large."""

_BAND_HZ = (5.0, 200.0)
_BAND_SHARE = 0.25  # of the sample rate
_ORDER = 4
_BRIDGE_COUNT = 1  # samples beside a missing one whose second difference it spoils
_SETTLE_S = 0.3  # at either end the low-pass has seen one side only
_CLUSTER_S = 0.25  # the force that nobody models is correlated over 80 ms
_SEGMENT_S = 2.0  # of a spectrum
_LEAST_CLUSTERS = 3
_LEAST_VALID_COUNT = 4
_LEAST_MOVING_RATIO = 0.1
_NOISE_POINTS_COUNT = 1000
_BISECTIONS_COUNT = 20
_PER_DECADE = 60  # points of a spectrum


@dataclass(frozen=True, slots=True)
class Residual:
    """Residual force of one body in one recording; arrays of shape (n,), one element a sample.

    `before`: with the profile as it is. `after`: with the known parameters as refitted and the named effects.
    `counted` is False where a sample was missing and where the record begins or ends, `moving` where the sign of the
    velocity can't be trusted.
    """

    run: str
    axis: str  # macro | end
    held_out: bool
    period_s: float
    band_hz: float
    before_n: np.ndarray
    after_n: np.ndarray
    position_m: np.ndarray
    velocity_m_per_s: np.ndarray
    counted: np.ndarray
    moving: np.ndarray
    sensor_noise_m: float
    mass_kg: float
    lap_count: int  # samples after which the reference repeats, 0 where it does not
    raw_before_n: np.ndarray  # not low-passed
    raw_after_n: np.ndarray

    @property
    def times_s(self) -> np.ndarray:
        """Sample instants since the recording's first."""
        return np.arange(self.before_n.size) * self.period_s

    @property
    def scored(self) -> np.ndarray:
        """Samples that a root mean square is of: in motion, where the recording moves at all."""
        moved = self.counted & self.moving
        return moved if moved.mean() > _LEAST_MOVING_RATIO else self.counted

    @property
    def before_rms_n(self) -> float:
        """Root mean square before."""
        return _rms(self.before_n[self.scored])

    @property
    def after_rms_n(self) -> float:
        """Root mean square after."""
        return _rms(self.after_n[self.scored])

    @property
    def floor_rms_n(self) -> float:
        """Scatter of the residual from lap to lap; nan where no lap repeats."""
        both, difference_n = self._from_lap_to_lap(self.before_n)
        return _rms(difference_n[both]) / np.sqrt(2.0) if both.any() else float("nan")

    @property
    def sensor_rms_n(self) -> float:
        """What the sensor's noise alone makes of it."""
        return noise_force_n(self.sensor_noise_m, self.mass_kg, self.period_s, self.band_hz)

    def _from_lap_to_lap(self, values_n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lap = self.lap_count
        if not lap:
            return np.zeros(0, bool), np.zeros(0)
        return self.scored[lap:] & self.scored[:-lap], values_n[lap:] - values_n[:-lap]

    def floor_signal_n(self) -> np.ndarray:
        """Return one lap minus the one before, over sqrt 2, not low-passed; empty where no lap repeats."""
        both, difference_n = self._from_lap_to_lap(self.raw_before_n)
        return difference_n[both] / np.sqrt(2.0)


@dataclass(frozen=True, slots=True)
class Bins:
    """Mean residual force in bins of some quantity; nan where a bin is empty or its error unknown."""

    middle: np.ndarray
    before_n: np.ndarray
    before_error_n: np.ndarray  # one standard error
    after_n: np.ndarray
    after_error_n: np.ndarray


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Spectral density of the residual force, N per root hertz, powers averaged in equal steps of log frequency."""

    frequency_hz: np.ndarray
    before: np.ndarray
    after: np.ndarray
    sensor: np.ndarray  # what its noise in the profile makes
    floor: np.ndarray | None  # from lap to lap, None where no lap repeats


def residuals(believed: Believed, findings: Findings, training: Sequence[Log], held: Sequence[Log]) -> list[Residual]:
    """Return the residual force of every body in every recording."""
    found = []
    for log, held_out in [*((log, False) for log in training), *((log, True) for log in held)]:
        recording = balance.recording_of(log, believed)
        before = known_forces(recording)
        after = modelled_forces(recording, findings)
        found += [_residual(recording, axis, held_out, before, after) for axis in recording.axes]
    return found


def modelled_forces(recording: Recording, findings: Findings) -> Forces:
    """Sum what acts after all: known forces with parameters as refitted, and the named effects."""
    total = known_forces(recording)
    for term, _ in hypotheses.parameter_terms(recording):
        error = findings.refitted.get(term.name, 0.0)
        for forces in term.forces(recording):
            add_forces(total, _scaled(forces, error))
    for named in findings.named:
        effect = CATALOGUE[named.name]
        own = own_parameters(named, recording.log)
        values = [own.get(name, 0.0) for name in effect.parameters]
        add_forces(total, effect_forces(recording, effect, named.acts_on, values, whole=True))
    return total


def own_parameters(named: Named, log: Log) -> dict[str, float]:
    """Return the parameters of a named effect in one recording: structural ones, and those of its session and run."""
    places = ("", f"session {log.session}", f"run {log.name}")
    parted = {name: name.partition(" of ") for name in named.parameters}
    return {first: named.parameters[name] for name, (first, _, place) in parted.items() if place in places}


def noise_force_n(noise_m: float, mass_kg: float, period_s: float, band_hz: float) -> float:
    """Return the rms that white noise of a position has in a residual force that is low-passed at a frequency."""
    frequency_hz = np.linspace(0.0, 0.5 / period_s, _NOISE_POINTS_COUNT)
    response = sosfreqz(_low_pass(band_hz, period_s), frequency_hz, fs=1.0 / period_s)[1]
    passed = _noise_density(noise_m, mass_kg, period_s, frequency_hz) * np.abs(response) ** 2  # forwards and backwards
    return float(np.sqrt(np.sum(passed**2) * (frequency_hz[1] - frequency_hz[0])))


def _noise_density(noise_m: float, mass_kg: float, period_s: float, frequency_hz: np.ndarray) -> np.ndarray:
    """Return m times the second difference of white noise of a position, N per root hertz."""
    turn = 2.0 * np.sin(np.pi * frequency_hz * period_s) / period_s
    return mass_kg * turn**2 * noise_m * np.sqrt(2.0 * period_s)


def _low_pass(band_hz: float, period_s: float) -> np.ndarray:
    return np.asarray(butter(_ORDER, band_hz * 2.0 * period_s, output="sos"))


def band_of(noise_m: float, mass_kg: float, period_s: float) -> float:
    """Return the frequency below which a sensor's noise makes `NOISE_FORCE_N` of force, within what can be filtered."""
    low, high = _BAND_HZ[0], min(_BAND_HZ[1], _BAND_SHARE / period_s)
    for _ in range(_BISECTIONS_COUNT):
        middle = float(np.sqrt(low * high))
        if noise_force_n(noise_m, mass_kg, period_s, middle) <= NOISE_FORCE_N:
            low = middle
        else:
            high = middle
    return low


def binned(residuals: Sequence[Residual], over: str, bins_count: int) -> Bins:
    """Average over bins of `position_m` or `velocity_m_per_s`, or over `times_s`, of several recordings of one body.

    Errors are those of cluster means (Liang, Zeger 1986): samples of one bin within 0.25 s count as one, those of
    another pass as another, since the force that nobody models stays the same meanwhile. Standstill and reversals are
    left out but over time, where clusters are as short as the band allows: the slow force is part of what is shown.
    """
    if over == "times_s":
        keep = [r.counted for r in residuals]
        cluster_s = [1.0 / r.band_hz for r in residuals]
    else:
        keep = [r.counted & r.moving for r in residuals]
        cluster_s = [_CLUSTER_S] * len(residuals)
    values = np.concatenate([getattr(r, over)[k] for r, k in zip(residuals, keep, strict=True)])
    if not values.size:
        empty = np.zeros(0)
        return Bins(empty, empty, empty, empty, empty)
    before = np.concatenate([r.before_n[k] for r, k in zip(residuals, keep, strict=True)])
    after = np.concatenate([r.after_n[k] for r, k in zip(residuals, keep, strict=True)])
    clusters = []
    first = 0
    for r, k, length_s in zip(residuals, keep, cluster_s, strict=True):
        own = np.floor(r.times_s[k] / length_s).astype(np.int64)
        clusters.append(own + first)
        first += int(np.ceil(r.times_s[-1] / length_s)) + 1
    low, high = float(values.min()), float(values.max())
    edges = np.linspace(low, high if high > low else low + 1e-12, bins_count + 1)
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, bins_count - 1)
    cluster = np.concatenate(clusters)
    before_n, before_error_n = _clustered(before, place, cluster, bins_count)
    after_n, after_error_n = _clustered(after, place, cluster, bins_count)
    return Bins(0.5 * (edges[1:] + edges[:-1]), before_n, before_error_n, after_n, after_error_n)


def spectrum(residuals: Sequence[Residual]) -> Spectrum | None:
    """Average Welch spectra of several recordings of one body; None where none is long enough."""
    period_s = residuals[0].period_s
    length = round(_SEGMENT_S / period_s)
    long_enough = [r for r in residuals if r.raw_before_n.size >= length]
    if not long_enough:
        return None
    frequency_hz = np.fft.rfftfreq(length, period_s)
    before = _density([r.raw_before_n for r in long_enough], length, period_s)
    after = _density([r.raw_after_n for r in long_enough], length, period_s)
    laps = [signal for r in long_enough if (signal := r.floor_signal_n()).size >= length]
    floor = _density(laps, length, period_s) if laps else None
    noise_m, mass_kg = long_enough[0].sensor_noise_m, long_enough[0].mass_kg
    sensor = _noise_density(noise_m, mass_kg, period_s, frequency_hz)
    edges = np.geomspace(frequency_hz[1] * 0.99, frequency_hz[-1] * 1.01, _points_count(frequency_hz))
    place = np.searchsorted(edges, frequency_hz[1:])

    def thinned(values: np.ndarray) -> np.ndarray:
        count = np.bincount(place)
        power = np.bincount(place, values[1:] ** 2)
        return np.sqrt(power[count > 0] / count[count > 0])

    return Spectrum(
        thinned(frequency_hz),
        thinned(before),
        thinned(after),
        thinned(sensor),
        None if floor is None else thinned(floor),
    )


def _points_count(frequency_hz: np.ndarray) -> int:
    return round(_PER_DECADE * float(np.log10(frequency_hz[-1] / frequency_hz[1])))


def _residual(recording: Recording, axis: str, held_out: bool, before: Forces, after: Forces) -> Residual:
    log, motion = recording.log, recording.motion(axis)
    h, mass_kg, noise_m = log.period_s, recording.mass_kg(axis), recording.belief(axis).noise_m
    band_hz = band_of(noise_m, mass_kg, h)
    raw = [missing_force_n(recording, axis, forces) for forces in (before, after)]
    sos = _low_pass(band_hz, h)
    smooth = [np.asarray(sosfiltfilt(sos, values)) for values in raw]
    settle = round(_SETTLE_S / h)
    counted = ~_spoilt(log)
    counted[:settle] = counted[-settle:] = False
    return Residual(
        run=log.name,
        axis=axis,
        held_out=held_out,
        period_s=h,
        band_hz=band_hz,
        before_n=smooth[0],
        after_n=smooth[1],
        position_m=recording.position_m(axis),
        velocity_m_per_s=motion.velocity_m_per_s[:, 0],
        counted=counted,
        moving=~motion.slow,
        sensor_noise_m=noise_m,
        mass_kg=mass_kg,
        lap_count=lap_samples(log.reference_m),
        raw_before_n=raw[0],
        raw_after_n=raw[1],
    )


def missing_force_n(recording: Recording, axis: str, forces: Forces) -> np.ndarray:
    """Return measured inertia force minus forces at every sample; both ends repeat their neighbour.

    With no forces it is the inertia force alone.
    """
    h = recording.log.period_s
    force_n = forces.macro_n if axis == "macro" else forces.end_n
    error_m = forces.macro_sensor_m if axis == "macro" else forces.end_sensor_m
    position_m = recording.position_m(axis)
    if error_m is not None:
        position_m = position_m - error_m
    position_m = _bridged(position_m, recording.log.valid)
    if force_n is None:
        force_n = np.zeros((position_m.size, PARTS_COUNT))
    mean_n, early_n = moments(force_n)
    following, preceding = 0.5 * early_n, mean_n - 0.5 * early_n
    inner = recording.mass_kg(axis) * np.diff(position_m, 2) / h**2 - following[1:-1] - preceding[:-2]
    return np.concatenate([inner[:1], inner, inner[-1:]])


def _spoilt(log: Log) -> np.ndarray:
    """Tell where a second difference rests on a missing sample."""
    return np.convolve(~log.valid, np.ones(2 * _BRIDGE_COUNT + 1), "same") > 0.5


def _scaled(forces: Forces, factor: float) -> Forces:
    def times(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else factor * values

    return Forces(times(forces.macro_n), times(forces.end_n), times(forces.macro_sensor_m), times(forces.end_sensor_m))


def _bridged(position_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Put positions where samples were missing, so that what is summed of the force there is right."""
    if valid.all() or np.count_nonzero(valid) < _LEAST_VALID_COUNT:
        return position_m
    places = np.flatnonzero(valid)
    missing = np.clip(np.flatnonzero(~valid), places[0], places[-1])
    bridged = position_m.copy()
    bridged[~valid] = CubicSpline(places, position_m[places])(missing)
    return bridged


def _clustered(
    values: np.ndarray, place: np.ndarray, cluster: np.ndarray, bins_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return (mean, standard error) of every bin."""
    count = np.bincount(place, minlength=bins_count).astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(place, values, minlength=bins_count) / count
        pairs, which = np.unique(place * (int(cluster.max()) + 1) + cluster, return_inverse=True)
        sums = np.bincount(which, values - mean[place])
        of_bin = pairs // (int(cluster.max()) + 1)
        clusters = np.bincount(of_bin, minlength=bins_count).astype(float)
        squares = np.bincount(of_bin, sums**2, minlength=bins_count)
        error = np.sqrt(squares * clusters / (clusters - 1.0)) / count
    return mean, np.where(clusters >= _LEAST_CLUSTERS, error, np.nan)


def _density(signals: Sequence[np.ndarray], length: int, period_s: float) -> np.ndarray:
    """Return the amplitude spectral density of several signals, each as heavy as it is long."""
    densities = [
        signal.size * scipy.signal.welch(signal, 1.0 / period_s, nperseg=length, detrend="constant")[1]
        for signal in signals
    ]
    return np.sqrt(np.sum(densities, axis=0) / sum(signal.size for signal in signals))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values * values))) if values.size else float("nan")
