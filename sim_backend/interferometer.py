"""The rig's interferometer: samples both axes at its own clock, adds noise, counts, loses beams, writes lines.

Counts are zero where the stage stood at the start (the laser zero). Noise is drawn per sample in the order
macro, end. Knows no port and no clock of the host.
"""

import numpy as np

from sim_backend import air
from sim_backend.sensor_lines import Sample, writer_for
from sim_backend.transport import Transport

MACRO_BIT = 1
END_BIT = 2
_BLOCK = 4096


class Interferometer:
    """Turns true positions at its sample instants into lines with an arrival time."""

    def __init__(self, machine, seed: int, start_t_ns: int, macro_position_m: float, end_position_m: float) -> None:
        sensor = machine.interferometer
        self.next_sequence = 0
        self.macro_zero_m = macro_position_m  # position at which the counter reads zero
        self.end_zero_m = end_position_m
        self.lost_axes = 0  # MACRO_BIT | END_BIT: beams that are interrupted
        self.is_stuck = False  # the device repeats its last counts
        self.is_silent = False
        self.garbage = b""  # put before the next line
        self.next_line_length: int | None = None  # cut the next line to this many bytes
        self._start_t_ns = start_t_ns
        self._period_ns = 1e9 / sensor.rate_hz / (1.0 + 1e-6 * sensor.clock_ppm)  # a fast clock has short periods
        self._own_period_ns = self._period_ns
        self._counts_per_m = sensor.counts_per_wavelength * air.index_of(machine.air) / machine.air.wavelength_vacuum_m
        self._noise_m = sensor.noise_m
        self._speed_limit_m_per_s = sensor.interpolation_speed_m_per_s
        self._noise = np.random.default_rng([seed, 1])
        self._draws: list[float] = []
        self._transport = Transport(sensor, np.random.default_rng([seed, 2]))
        self._writer = writer_for(sensor, machine.air, 2 if machine.micro is not None else 1)
        self._number = 0  # samples taken; the sequence number may jump or restart
        self._start_number = 0  # of the sample at `_start_t_ns`
        self.next_sample_t_ns = start_t_ns
        self.next_arrival_t_ns = self._transport.arrival_t_ns(start_t_ns)  # of the next sample's line
        self._sample = Sample(0, 0.0, 0.0, False, False, True, True)

    def sample_t_ns(self, number: int) -> int:
        """Return the instant of the sample of that number (0 = the first, at the start), host clock.

        Of past samples only while the clock does not drift.
        """
        return self._start_t_ns + round((number - self._start_number) * self._period_ns)

    def sample(
        self, macro_m: float, end_m: float, macro_m_per_s: float, end_m_per_s: float
    ) -> tuple[int, bytes] | None:
        """Take the next sample at the given true state; return (arrival instant, bytes), None when nothing is sent."""
        if not self._draws:
            self._draws = self._noise.standard_normal(2 * _BLOCK).tolist()
            self._draws.reverse()
        macro_noise_m = self._noise_m * self._draws.pop()
        end_noise_m = self._noise_m * self._draws.pop()
        arrival_t_ns = self.next_arrival_t_ns
        self._number += 1
        self.next_sample_t_ns = self.sample_t_ns(self._number)
        self.next_arrival_t_ns = self._transport.arrival_t_ns(self.next_sample_t_ns)
        sample = self._sample
        sample.sequence = self.next_sequence
        self.next_sequence += 1
        if self.lost_axes:
            self._lose_counts(macro_m, end_m)
        if not self.is_stuck:
            sample.macro_lost = bool(self.lost_axes & MACRO_BIT)
            sample.end_lost = bool(self.lost_axes & END_BIT)
            if not sample.macro_lost:
                sample.macro_counts = (macro_m + macro_noise_m - self.macro_zero_m) * self._counts_per_m
            if not sample.end_lost:
                sample.end_counts = (end_m + end_noise_m - self.end_zero_m) * self._counts_per_m
            limit = self._speed_limit_m_per_s
            if limit is not None:
                sample.macro_interpolates = abs(macro_m_per_s) <= limit
                sample.end_interpolates = abs(end_m_per_s) <= limit
        line = self._writer.line(sample)
        if self.is_silent:
            return None
        if self.next_line_length is not None:
            line = line[: self.next_line_length]
            self.next_line_length = None
        if self.garbage:
            line = self.garbage + line
            self.garbage = b""
        return arrival_t_ns, line

    def _lose_counts(self, macro_m: float, end_m: float) -> None:
        """An incremental counter stands while its beam is away: what moves meanwhile shifts its zero."""
        if self.lost_axes & MACRO_BIT:
            self.macro_zero_m = macro_m - self._sample.macro_counts / self._counts_per_m
        if self.lost_axes & END_BIT:
            self.end_zero_m = end_m - self._sample.end_counts / self._counts_per_m

    def drift(self, ppm: float) -> None:
        """Let the clock run faster than its own by `ppm` from the next sample on; 0 ends that."""
        self._start_t_ns, self._start_number = self.next_sample_t_ns, self._number
        self._period_ns = self._own_period_ns / (1.0 + 1e-6 * ppm)

    def restart(self, macro_m: float, end_m: float) -> None:
        """Power-cycle the device: sequence and counts begin at zero again."""
        self.next_sequence = 0
        self.macro_zero_m = macro_m
        self.end_zero_m = end_m
