"""What Prometheus may scrape: counted from the rows in the supervisor, laid out when it is asked for."""

import threading
from collections import Counter
from collections.abc import Iterator

import numpy as np
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric

from stagectl.profile import Profile, frame_bits
from stagectl.row import FRAMES
from stagectl.service.messages import Status
from stagectl.service.states import State

LATENESS_BOUNDS_S = (10e-6, 20e-6, 50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3)
AGE_BOUNDS_S = (0.2e-3, 0.3e-3, 0.4e-3, 0.5e-3, 0.7e-3, 1e-3, 2e-3, 3e-3, 5e-3, 10e-3, 20e-3, 50e-3)
_RECENT = 4096
_LOAD_SHARE = 0.02  # of a piece of 20 ms


class _Tally:
    """A histogram of seconds."""

    def __init__(self, bounds_s: tuple[float, ...]):
        self.bounds_s = bounds_s
        self.counts = np.zeros(len(bounds_s) + 1, np.int64)
        self.sum_s = 0.0

    def add(self, values_s: np.ndarray) -> None:
        places = np.searchsorted(self.bounds_s, values_s, side="left")
        self.counts += np.bincount(places, minlength=self.counts.size)
        self.sum_s += float(values_s.sum())

    def family(self, name: str, text: str) -> HistogramMetricFamily:
        sums = np.cumsum(self.counts)
        buckets = [(f"{bound_s:g}", float(count)) for bound_s, count in zip(self.bounds_s, sums, strict=False)]
        return HistogramMetricFamily(name, text, buckets=[*buckets, ("+Inf", float(sums[-1]))], sum_value=self.sum_s)


class Figures:
    """Counts since the service began; added to by the supervisor, read by whoever scrapes."""

    def __init__(self) -> None:
        """Begin with nothing counted."""
        self._lock = threading.Lock()
        self._lateness, self._age = _Tally(LATENESS_BOUNDS_S), _Tally(AGE_BOUNDS_S)
        self._recent_s = np.zeros(_RECENT)
        self._cycles = self._missed = self._lost = self._refused = 0
        self._last_missed = self._last_lost = self._cycles_before = 0
        self._faults: Counter[str] = Counter()
        self._profile: Profile | None = None
        self._load: float | None = None
        self._load_t_ns = 0

    def begin_servo(self, profile: Profile | None = None) -> None:
        """A new servo counts from 0; without a profile there is none."""
        with self._lock:
            self._last_missed = self._last_lost = 0
            self._cycles_before = self._cycles
            self._profile, self._load, self._load_t_ns = profile, None, 0

    def add(self, rows: np.ndarray) -> None:
        """Count rows, shape (n,) of ROW."""
        if rows.size == 0:
            return
        lateness_s = np.maximum(rows["lateness_ns"] * 1e-9, 0.0)
        known = rows["sample_t_ns"] > 0
        age_s = (rows["t_ns"] - rows["sample_t_ns"])[known] * 1e-9
        missed, lost = int(rows["cycles_missed"][-1]), int(rows["samples_lost"][-1])
        with self._lock:
            self._lateness.add(lateness_s)
            self._age.add(age_s)
            places = np.arange(self._cycles, self._cycles + rows.size) % _RECENT
            self._recent_s[places[-_RECENT:]] = lateness_s[-_RECENT:]
            self._cycles += rows.size
            self._refused += int(rows["command_lost"].sum())
            self._missed += max(missed - self._last_missed, 0)
            self._lost += max(lost - self._last_lost, 0)
            self._last_missed, self._last_lost = missed, lost
            self._add_load(rows)

    def _add_load(self, rows: np.ndarray) -> None:
        """Count the bits of the cyclic frames that went over the bus, each as long as stuffing can make it."""
        profile, now_t_ns = self._profile, int(rows["t_ns"][-1])
        before_t_ns, self._load_t_ns = self._load_t_ns, now_t_ns
        if profile is None or before_t_ns == 0 or now_t_ns <= before_t_ns:
            return
        bits = profile.command_frames_bits * rows.size
        for name in FRAMES:
            lengths, counts = np.unique(rows[f"{name}_count"], return_counts=True)
            pairs = zip(lengths.tolist(), counts.tolist(), strict=True)
            bits += sum(frame_bits(length) * count for length, count in pairs if length >= 0)
        load = bits * 1e9 / (now_t_ns - before_t_ns) / profile.can.bitrate_bit_per_s
        self._load = load if self._load is None else self._load + _LOAD_SHARE * (load - self._load)

    def fault(self, kind: str) -> None:
        """Count a fault."""
        with self._lock:
            self._faults[kind] += 1

    def recent_lateness_s(self) -> tuple[float, float] | None:
        """Return the 99th percentile and the greatest of the last 4 s at 1 kHz; None where this servo did no cycle."""
        with self._lock:
            recent = np.arange(max(self._cycles_before, self._cycles - _RECENT), self._cycles)
            recent_s = self._recent_s[recent % _RECENT]
        if recent_s.size == 0:
            return None
        return float(np.percentile(recent_s, 99)), float(recent_s.max())

    def families(self, status: Status) -> Iterator[Metric]:
        """Lay out every figure; what is not known of this stage is left out."""
        with self._lock:
            yield self._lateness.family("stagectl_cycle_lateness_seconds", "Wake-up of a cycle behind its grid point")
            yield self._age.family("stagectl_sample_age_seconds", "Age of the newest sample when its cycle began")
            yield CounterMetricFamily("stagectl_cycles", "Cycles of the servo", value=self._cycles)
            yield CounterMetricFamily("stagectl_cycles_missed", "Grid points that were skipped", value=self._missed)
            yield CounterMetricFamily("stagectl_samples_lost", "Samples of the sensor that were lost", value=self._lost)
            yield CounterMetricFamily("stagectl_commands_refused", "Cycles whose frames the bus refused", self._refused)
            if self._load is not None:
                text = "Share of the bus that cyclic frames take, worst-case stuffing, mean of about a second"
                yield GaugeMetricFamily("stagectl_can_load_ratio", text, value=self._load)
            faults = CounterMetricFamily("stagectl_faults", "Stops by themselves, by kind", labels=["kind"])
            for kind, count in self._faults.items():
                faults.add_metric([kind], count)
            yield faults
        states = GaugeMetricFamily("stagectl_state", "1 for the state that the stage is in", labels=["state"])
        for state in State:
            states.add_metric([state.value], float(status.state == state.value))
        yield states
        backend = GaugeMetricFamily("stagectl_backend", "1 for the world that the stage is in", labels=["backend"])
        backend.add_metric([status.backend or "none"], 1.0)
        yield backend
        yield GaugeMetricFamily("stagectl_homed", "1 where the zeros are valid", value=float(status.homed))
        yield GaugeMetricFamily("stagectl_uptime_seconds", "Since the service began", value=status.uptime_s)
        age_s = status.positions.sample_age_s
        if age_s is not None:
            yield GaugeMetricFamily(
                "stagectl_newest_sample_age_seconds", "Of the interferometer's samples", value=age_s
            )
        for name, value in status.positions.model_dump(exclude={"sample_age_s"}).items():
            if value is not None:
                yield GaugeMetricFamily(f"stagectl_{name.removesuffix('_m')}_meters", name, value=value)
        yield from _temperatures(status)
        yield from _wear(status)

    def exposition(self, status: Status) -> bytes:
        """Return the text format of Prometheus."""
        registry = CollectorRegistry(auto_describe=False)
        registry.register(_Once(list(self.families(status))))  # pyright: ignore[reportArgumentType]
        return generate_latest(registry)


def _temperatures(status: Status) -> Iterator[Metric]:
    if not status.temperatures:
        return
    text = "What the drive said last of its temperature, read every 5 s"
    measured = GaugeMetricFamily("stagectl_drive_temperature_celsius", text, labels=["axis"])
    text = "1 where the profile's warning is passed"
    warning = GaugeMetricFamily("stagectl_drive_temperature_warning", text, labels=["axis"])
    for axis, one in status.temperatures.items():
        measured.add_metric([axis], one.degc)
        warning.add_metric([axis], float(one.warning))
    yield measured
    yield warning


def _wear(status: Status) -> Iterator[Metric]:
    joint = status.wear or status.backlash
    if joint is None:
        return
    yield GaugeMetricFamily("stagectl_backlash_width_meters", "Width of the joint's gap", value=joint.width_m)
    if joint.width_sd_m is not None:
        text = "Standard deviation of the width"
        yield GaugeMetricFamily("stagectl_backlash_width_sd_meters", text, value=joint.width_sd_m)
    for side in ("left", "right"):
        value = getattr(joint, f"{side}_stiffness_n_per_m")
        text = f"Stiffness of the {side} contact"
        yield GaugeMetricFamily(f"stagectl_backlash_{side}_stiffness_newtons_per_meter", text, value=value)
    if status.wear is not None:
        text = "Since the joint's values were found"
        yield GaugeMetricFamily("stagectl_backlash_age_seconds", text, value=status.wear.age_s)
        text = "1 where both edges were touched lately"
        yield GaugeMetricFamily("stagectl_backlash_observable", text, value=float(status.wear.observable))
        text = "1 where a limit of wear is passed"
        yield GaugeMetricFamily("stagectl_backlash_wear_alarm", text, value=float(bool(status.wear.alarm)))


class _Once:
    """A collector of what was laid out already."""

    def __init__(self, families: list[Metric]):
        self._families = families

    def collect(self) -> list[Metric]:
        return self._families
