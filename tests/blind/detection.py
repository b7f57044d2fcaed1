"""What a perfect observer could see: detection limits, parameter errors, and which laws no likelihood ratio separates.

Given the recorded positions and commands, the balance of each axis leaves `mass x acceleration - known forces`. A
hidden effect adds its own force to it, a wrong base parameter adds its column, sensor noise and the coloured force make
its spectrum; the recorded current minus the current that the command makes is a further channel. That is the closed
loop's likelihood, written where its noise is stationary: whitening the closed loop's differences by the noise
propagated through the loop gives the same numbers (`tests/test_blind.py` holds the two together).
"""

import copy
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, optimize, stats
from scipy.interpolate import CubicSpline

from tests.blind import laws, machine
from tests.blind.compiled import compiled
from tests.blind.draw import PARAMETER_ERRORS, SENSOR_QUANTUM_M, coloured_power, follows, simulate
from tests.blind.laws import contact_force, friction_level, is_contact, is_friction, smooth_force, thrust
from tests.blind.machine import CELLS, SAMPLE_S, STEPS, B

D_PRIME_AT_LIMIT = 5.0
LIMIT_ROUNDS = 3
FALSE_RATE = 0.05
POWER = 0.9
SEPARABLE_D = float(stats.norm.ppf(POWER) + stats.norm.ppf(1.0 - FALSE_RATE))  # 2.93: power 0.9 at 5 % false
TAPER_S = 1.0
SEPARATION_BAND_HZ = 150.0  # laws are told apart below this: only a cyclic error has much above it
CELL_S = SAMPLE_S / CELLS
# a cell's weight in the force that the second difference of positions sees: a triangle of one sample to either side
_UP = (np.arange(CELLS) + 0.5) / CELLS / CELLS
_DOWN = _UP[::-1].copy()
SLOPE_SHARE = 1e-3  # of a middle size: there a law is its slope
SIZE_STARTS = (0.25, 1.0, 4.0)  # of a middle size
SIZE_ROUNDS = 3
SIZE_ROUNDS_BETWEEN = 12
SIZE_TOLERANCE = 1e-3
SIZE_REACH = 4.0  # factor about the nearest size seen, as far as the next start
SIZE_ROUNDS_ABOUT = 20
FAR_SHARE = 0.95  # of the whole signal: a law that takes no more of it at any size seen is none that is looked for
EDGE_LAWS = ("backlash_centre", "backlash_wear")
SHAPE_FACTORS = ("anchor_m", "asymmetry", "breakaway_ratio", "phase_rad", "second_harmonic", "slope_per_100_mm")
"""Parameters that, times the amplitude, are a further factor of their law: its force is linear in both."""
SHAPE_STEP = 1e-3
NOT_OF_PLACE = ("current_loop_lag", "command_delay", "amplifier_dead_band")
"""Laws of a drive that go by its commands alone."""
NONLINEAR = ("soft_contact", "sensor_delay", "sensor_lag", "command_delay", "current_loop_lag", "amplifier_dead_band")


def to_samples(cells):
    """Force over cells of 0.25 ms, as the second difference of positions sees it at samples 1..n-2."""
    blocks = cells.reshape(-1, CELLS)
    return blocks[:-2] @ _UP + blocks[1:-1] @ _DOWN


def knots_at_samples(force):
    """Force that is a line from sample to sample (n + 1), as the second difference of positions sees it."""
    return (force[:-3] + 4.0 * force[1:-2] + force[2:-1]) / 6.0


def second_difference(x):
    """Acceleration at samples 1..n-2."""
    return (x[2:] - 2.0 * x[1:-1] + x[:-2]) / SAMPLE_S**2


@compiled
def actuator(commands, delay, lag, dead):
    """(mean current over cells, current at samples) of commands in A."""
    n = len(commands)
    cells, samples = np.zeros(n * CELLS), np.zeros(n)
    current = 0.0
    for k in range(n):
        samples[k] = current
        for j in range(STEPS):
            current, mean = machine.loop_step(current, commands, k, j * machine.STEP_S, delay, lag, dead)
            cells[k * CELLS + j // machine.CELL_STEPS] += mean / machine.CELL_STEPS
    return cells, samples


@compiled
def along(code, place, p, cells, mass1, mass2, start, t0, contact):
    """Force (2, cells) of a law along a recorded motion; dry friction has the direction that the record shows."""
    n = cells.shape[0]
    out = np.zeros((2, n))
    mem1, mem2 = np.zeros(laws.MEMORIES), np.zeros(laws.MEMORIES)
    empty, plain = np.zeros(laws.PARAMETERS), np.zeros(laws.MEMORIES)
    both = code == 18 or code == 29
    relative = cells[:, 2] - cells[:, 0]
    if code == 28:
        mem1[0] = mem2[0] = start
    for i in range(n):
        x1, v1, x2, v2, drive1, drive2 = cells[i, 0], cells[i, 1], cells[i, 2], cells[i, 3], cells[i, 4], cells[i, 5]
        t = (i + 0.5) * CELL_S
        r = x2 - x1
        if code == laws.CENTRE or code == laws.WEAR:
            there = contact.copy()
            there[2] += -p[0] if code == laws.CENTRE else 0.5 * p[0] * (t0 + t)
            there[3] += p[0] if code == laws.CENTRE else 0.5 * p[0] * (t0 + t)
            out[0, i] = _stop(relative, i, v2 - v1, there) - _stop(relative, i, v2 - v1, contact)
            out[1, i] = -out[0, i]
            continue
        if is_contact(code):
            f = contact_force(code, p, mem1, CELL_S, t0 + t, r, v2 - v1, contact)
            f -= contact_force(-1, empty, plain, 0.0, 0.0, r, v2 - v1, contact)
            out[0, i], out[1, i] = f, -f
            continue
        if is_friction(code):
            if place == 0:
                s = math.copysign(1.0, cells[i, 6])
                out[0, i] = -cells[i, 6] * friction_level(code, p, mem1, CELL_S, x1, v1, drive1, s)
            else:
                s = math.copysign(1.0, cells[i, 7])
                out[1, i] = -cells[i, 7] * friction_level(code, p, mem2, CELL_S, x2, v2, drive2, s)
            continue
        if place == 0 or both:
            out[0, i] = smooth_force(code, p, mem1, CELL_S, t, x1, v1, drive2, mass1)
        if place == 1 or both:
            out[1, i] = smooth_force(code, p, mem2, CELL_S, t, x2, v2, drive1, mass2)
    if code == 28:
        for i in range(1, n - 1):
            if place == 0:
                out[0, i] += p[0] * mass1 * (cells[i + 1, 1] - cells[i - 1, 1]) / (2.0 * CELL_S)
            else:
                out[1, i] += p[0] * mass2 * (cells[i + 1, 3] - cells[i - 1, 3]) / (2.0 * CELL_S)
    return out


class Evidence:
    """The whitened record of a simulated case: what base parameters and effects would add to it."""

    def __init__(self, case, runs, band_hz=0.5 / SAMPLE_S):
        """`runs`: simulated with the effects along which everything is judged; above `band_hz` nothing counts."""
        self.case, self.runs, self.band_hz = case, runs, band_hz
        self._plain = {}
        self.beside = []  # effects along which a sensor is wrong
        self.base = case.base
        self.gains = [self._whitening(run) for run in runs]
        self.contact = np.array([case.base[i] for i in range(6, 11)])
        self.base_columns = {name: self._base_column(name) for name in case.base_names}
        self.names = [name for name in case.base_names if case.uncertainty[name] > 0.0]
        self.set_nuisance()

    # ---- whitening ----

    def _whitening(self, run):
        """(factors on the spectrum of each channel: two forces, two currents, None where absent; taper; FFT length)."""
        m = len(run.samples) - 2
        length = fft.next_fast_len(m, real=True) or m
        f = np.fft.rfftfreq(length, SAMPLE_S)
        f = f[f <= self.band_hz]
        difference = 4.0 * np.sin(math.pi * f * SAMPLE_S) ** 2 / SAMPLE_S**2
        triangle = np.sinc(f * SAMPLE_S) ** 4
        gains = []
        for place in range(2):
            noise = self.case.sensor_noise_m[place] ** 2 + SENSOR_QUANTUM_M**2 / 12.0
            power = coloured_power(f) * triangle + (self._mass(run, place) * difference) ** 2 * noise
            gains.append(np.sqrt(2.0 / (length * power)))
        for place in range(2):
            power = self.case.current_noise_a[place] ** 2 + self.case.current_quantum_a[place] ** 2 / 12.0
            gains.append(np.full(len(f), math.sqrt(2.0 / (length * power))))
        for gain in gains:
            gain[0] *= math.sqrt(0.5)
        if self.case.single:
            gains[1] = gains[3] = None
        ramp = np.minimum(np.arange(m) * SAMPLE_S, np.arange(m)[::-1] * SAMPLE_S) / min(TAPER_S, 0.1 * m * SAMPLE_S)
        return gains, np.sin(0.5 * math.pi * np.minimum(ramp, 1.0)) ** 2, length

    def narrowed(self, band_hz):
        """The same evidence with nothing above `band_hz`."""
        other = copy.copy(self)
        other.band_hz = band_hz
        other.gains = [other._whitening(run) for run in self.runs]
        keep = []
        for wide, narrow in zip(self.gains, other.gains, strict=True):
            for i in range(4):
                if wide[0][i] is not None:
                    one = np.arange(len(wide[0][i])) < len(narrow[0][i])
                    keep += [one, one]
        keep = np.concatenate(keep)
        other.base_columns = {name: column[keep] for name, column in self.base_columns.items()}
        other.set_nuisance()
        return other

    def _mass(self, run, place):
        payload_here = self.case.single == (place == 0)
        return self.base[B["macro_mass_kg"] if place == 0 else B["micro_mass_kg"]] + run.payload_kg * payload_here

    def whitened(self, channels_of_runs):
        """One vector of the channels (lists of four arrays at samples 1..n-2, None where nothing) of all runs."""
        parts = []
        for (gains, taper, length), channels in zip(self.gains, channels_of_runs, strict=True):
            for i, gain in enumerate(gains):
                if gain is None:
                    continue
                if channels is None or channels[i] is None:
                    parts.append(np.zeros(2 * len(gain)))
                else:
                    spectrum = fft.rfft(channels[i] * taper, length)[: len(gain)] * gain
                    parts += [spectrum.real, spectrum.imag]
        return np.concatenate(parts)

    # ---- columns ----

    def _commands(self, run, place):
        """Current commands in A."""
        c = run.control
        return np.ascontiguousarray(run.samples[:, 2 + place] / c[machine.C["macro_force_constant_n_per_a"] + place])

    def _drive_channels(self, run, place, forces, currents):
        """Channels of an extra drive force (cells) and current (samples) of one axis."""
        channels = [None, None, None, None]
        channels[place] = to_samples(forces)
        if place == 1:
            channels[0] = -self.base[B["micro_reaction"]] * channels[1]
        if currents is not None:
            channels[2 + place] = currents[1:-1]
        return channels

    def _actuated(self, run, place):
        """What a run's commands make without any effect: (mean current over cells, current at samples) in A."""
        if (run.number, place) not in self._plain:
            d, tau = self.base[B["macro_command_delay_s"] + place], self.base[B["macro_current_lag_s"] + place]
            self._plain[run.number, place] = actuator(self._commands(run, place), d, tau, 0.0)
        return self._plain[run.number, place]

    def _loop_channels(self, run, place, delay, lag, dead):
        """What a current loop slower by these makes."""
        plain, commands = self._actuated(run, place), self._commands(run, place)
        d, tau = self.base[B["macro_command_delay_s"] + place], self.base[B["macro_current_lag_s"] + place]
        other = actuator(commands, d + delay, tau + lag, dead)
        constant = self.base[B["macro_force_constant_n_per_a"] + place]
        return self._drive_channels(run, place, constant * (other[0] - plain[0]), other[1] - plain[1])

    def _base_column(self, name):
        """Whitened change for a base parameter larger than believed, a unit of it (a relative one where so stated)."""
        return self.whitened([self._base_channels(run, name) for run in self.runs])

    def _base_channels(self, run, name):
        cells = run.cells
        r, speed = cells[:, 2] - cells[:, 0], cells[:, 3] - cells[:, 1]
        if name in ("macro_mass_kg", "micro_mass_kg"):
            place = int(name == "micro_mass_kg")
            channels = [None, None, None, None]
            # what the slow force moves is noise, and none of what a wrong mass makes of the known forces: it told a
            # wrong force constant, which the drive takes the slow force away with, from a wrong mass by 3.7 deviations
            pushed = knots_at_samples(run.coloured[:, place]) / self._mass(run, place)
            channels[place] = pushed - second_difference(run.samples[:, 6 + place])
            return channels
        if name in ("macro_force_constant_n_per_a", "micro_force_constant_n_per_a"):
            place = int(name.startswith("micro"))
            return self._drive_channels(run, place, cells[:, 4 + place] / self.base[B[name]], None)
        if name.endswith("command_delay_s") or name.endswith("current_lag_s"):
            place, step = int(name.startswith("micro")), 5e-6
            changed = (step, 0.0) if name.endswith("delay_s") else (0.0, step)
            channels = self._loop_channels(run, place, *changed, 0.0)
            return [None if channel is None else channel / step for channel in channels]
        if name == "macro_damping_n_s_per_m":
            return [to_samples(-cells[:, 1]), None, None, None]
        if name == "spring_stiffness_n_per_m":
            force = r
        elif name == "spring_damping_n_s_per_m":
            force = speed
        else:
            index = B[name] - 6
            step = (10.0, 10.0, 1e-8, 1e-8, 1.0)[index]
            changed = self.contact.copy()
            changed[index] += step
            force = (_stops(r, speed, changed) - _stops(r, speed, self.contact)) / step
        return [to_samples(force), -to_samples(force), None, None]

    def effect_column(self, index):
        """Whitened change by the case's own effect number `index`, as it was in the simulation."""
        effect = self.case.effects[index]
        channels_of_runs = []
        for run in self.runs:
            if effect.law.family == "sensor":
                channels_of_runs.append(self._sensor_channels(run, effect.place, run.errors[index]))
                continue
            marks = run.marks[index]
            channels = [to_samples(marks[0]), to_samples(marks[1]), None, None]
            if effect.law.name in ("current_loop_lag", "command_delay", "amplifier_dead_band"):
                channels[2 + effect.place] = run.errors[index][1:-1]
            channels_of_runs.append(channels)
        return self.whitened(channels_of_runs)

    def look_at(self, index):
        """Judge what effect number `index` of the case does, or what stands in its place: beside the others."""
        self.beside = [other for i, other in enumerate(self.case.effects) if i != index]

    def free_columns(self, index):
        """What effect number `index` of the case may do, where nobody knows its size nor any factor of its law.

        A cable beside a linear stiffness is a cable that is anchored elsewhere, to the last bit: with the cable's
        anchor known, the stiffness seemed to be 77 deviations large.
        """
        self.look_at(index)
        effect = self.case.effects[index]
        columns = [self.effect_column(index)]
        for parameter in effect.law.parameters[1:]:
            if parameter.name not in SHAPE_FACTORS:
                continue
            per = {"phase": "homing", "run_phase": "number"}.get(parameter.spread)
            moved = [(run, self._moved_channels(run, effect, parameter.name)) for run in self.runs]
            for group in sorted({getattr(run, per) for run in self.runs}) if per else [None]:
                own = [what if per is None or getattr(run, per) == group else None for run, what in moved]
                columns.append(self.whitened(own))
        return columns

    def _moved_channels(self, run, effect, name):
        """What a parameter larger by a small step changes in a run."""
        values = effect.values_in(run)
        channels = [
            self.law_channels(run, effect.law, effect.acts_on, values | {name: values[name] + step})
            for step in (-0.5 * SHAPE_STEP, 0.5 * SHAPE_STEP)
        ]
        return [None if low is None else high - low for low, high in zip(*channels, strict=True)]

    def _sensor_channels(self, run, place, error):
        """A sensor's error in m enters through the masses, the spring, the stops, and what pulls by place."""
        inertia = [None, None, None, None]
        inertia[place] = self._mass(run, place) * second_difference(error)
        # all that is known is evaluated where the sensors say the stages are, which may be the other side of an edge:
        # a difference, no derivative
        n = len(error)
        there = np.interp((np.arange(n * CELLS) + 0.5) / CELLS, np.arange(n), error)
        cells = run.cells.copy()
        cells[:, 2 * place] += there
        cells[:, 2 * place + 1] += np.gradient(there, CELL_S)
        parts = [inertia, *self._pulled_elsewhere(run, replace(run, cells=cells))]
        if not self.case.single:
            between = to_samples(self._between(cells) - self._between(run.cells))
            parts.append([-between, between, None, None])
        return _added(parts)

    def _pulled_elsewhere(self, run, seen):
        """Yield what other effects do by where the stages are, less what they would where they are `seen`.

        A reading that is 51 us late beside a current ripple of 6200 deviations was 26 away from a late command with
        the ripple known where the stage truly was, and nobody knows that (1011172).
        """
        for effect in self.beside:
            if effect.law.family in ("force", "actuator") and effect.law.name not in NOT_OF_PLACE:
                law, values = effect.law, effect.values_in(run)
                true, elsewhere = (self.law_channels(one, law, effect.acts_on, values) for one in (run, seen))
                yield [None if one is None else one - other for one, other in zip(true, elsewhere, strict=True)]

    def _between(self, cells):
        """Force in N of spring, damper and stops on the macro axis along cells."""
        r, speed = cells[:, 2] - cells[:, 0], cells[:, 3] - cells[:, 1]
        force = self.base[B["spring_stiffness_n_per_m"]] * r + self.base[B["spring_damping_n_s_per_m"]] * speed
        return force + _stops(r, speed, self.contact)

    def law_channels(self, run, law, acts_on, values):
        """Channels of any law along a run's record."""
        place = 1 if acts_on in ("micro_force", "micro_actuator", "micro_command", "end_sensor") else 0
        p = law.vector(values)
        if law.name == "command_delay":
            return self._loop_channels(run, place, p[0], 0.0, 0.0)
        if law.name == "current_loop_lag":
            return self._loop_channels(run, place, 0.0, p[0], 0.0)
        if law.name == "amplifier_dead_band":
            return self._loop_channels(run, place, 0.0, 0.0, p[0])
        if law.family == "actuator":
            x = run.cells[:, 2 * place]
            constant = self.base[B["macro_force_constant_n_per_a"] + place]
            currents = self._actuated(run, place)[0]
            forces = _thrust_along(law.code, p, constant, currents, x) - constant * currents
            return self._drive_channels(run, place, forces, None)
        if law.family == "sensor":
            return self._sensor_channels(run, place, self._reading_errors(run, law, place, p))
        forces = along(
            law.code_at(acts_on),
            place,
            p,
            run.cells,
            self._mass(run, 0),
            self._mass(run, 1),
            run.samples[0, 6 + place],
            run.start_s,
            self.contact,
        )
        channels = [to_samples(forces[0]), to_samples(forces[1]), None, None]
        if self.case.single:
            channels[1] = None
        return channels

    def _reading_errors(self, run, law, place, p):
        x = run.samples[:, 6 + place]
        t = np.arange(len(x)) * SAMPLE_S
        if law.name in ("sensor_delay", "sensor_lag", "clock_skew"):
            path = CubicSpline(t, x)
            if law.name == "sensor_delay":
                return np.where(t >= p[0], path(np.maximum(t - p[0], 0.0)), x[0]) - x
            if law.name == "clock_skew":
                late = t - p[0] * (run.start_s + t)
                return np.where(late >= 0.0, path(np.maximum(late, 0.0)), x[0]) - x
            fine = path(np.arange((len(x) - 1) * CELLS + 1) * CELL_S)
            return _lagged(fine, p[0])[::CELLS] - x
        return _reading_errors(law.code, p, run.start_s, x)

    # ---- statistics ----

    def set_nuisance(self, free=(), without=()):
        """Projects out the base parameters but `without` within their uncertainty, and `free` columns of any size."""
        columns = [self.base_columns[name] * self.case.uncertainty[name] for name in self.names if name not in without]
        for column in free:
            norm = np.linalg.norm(column)
            if norm > 0.0:
                columns.append(column * (1e6 / norm))
        rows = np.array(columns)
        root = np.linalg.cholesky(_products(rows, rows) + np.eye(len(rows)))
        self._nuisance = np.einsum("ij,jk->ik", np.linalg.inv(root), rows)

    def inner(self, a, b):
        """Scalar product of two whitened vectors after the nuisances are projected out."""
        pair = np.array([a, b])
        seen = _products(pair, self._nuisance)
        return float(np.einsum("i,i", a, b) - seen[0] @ seen[1])

    def d_prime(self, column, others=()):
        """Detectability of a column, given that the base is known within its uncertainty and `others` not at all."""
        self.set_nuisance(others)
        value = math.sqrt(max(self.inner(column, column), 0.0))
        self.set_nuisance()
        return value

    def parameter_column(self, key):
        """Change by one stated standard deviation of a parameter error."""
        return sum(self.base_columns[name] * self.case.uncertainty[name] for name in PARAMETER_ERRORS[key])

    def rest_after(self, signal, columns, signed):
        """Distance d of `signal` from the best mixture of `columns`, nuisances free within their uncertainty."""
        whole = self.inner(signal, signal)
        columns = [column for column in columns if column.any()]
        if not columns:
            return math.sqrt(max(whole, 0.0))
        raw = np.array(columns)
        seen = _products(raw, self._nuisance)
        gram = _products(raw, raw) - seen @ seen.T
        target = (_products(raw, signal[None]) - seen @ _products(self._nuisance, signal[None]))[:, 0]
        if len(columns) == 1 and not signed and target[0] <= 0.0:
            return math.sqrt(max(whole, 0.0))
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        solution = np.linalg.lstsq(gram / np.outer(scale, scale), target / scale, rcond=1e-10)[0]
        return math.sqrt(max(whole - float((target / scale) @ solution), 0.0))

    def _rest_after_best_size(self, signal, law, acts_on, values, hints):
        """Distance d of `signal` from a law whose column turns with its size: at the size that it asks for.

        Readings that are 20 um wrong put a body behind an edge that those which are 1 um wrong don't. Of a slope and a
        few sizes the nearest one is followed, to where a law asks for as much as it has: step by step, and between two
        of which one asks for more and the other for less. A late reading of 50 us asked for 56 of 78. Where sizes are
        far from each other what a law asks for leads nowhere: a scale error of 800 ppm asked for 742 of 946. So the
        distance itself is followed last. hints: effects, whose own sizes are starts for the same law elsewhere: from
        the few sizes alone a scale error of 1690 ppm seemed 450 deviations from one of the other sensor.
        """
        first, signed, seen = law.parameters[0], law.signed, []

        def asks(size):
            (column,) = self.law_columns(law, acts_on, values | {first.name: size})
            whole = self.inner(column, column)
            share = self.inner(signal, column) / whole if whole > 0.0 else 0.0
            seen.append((self.rest_after(signal, [column], signed), size, size * share))
            return size * share - size

        def distance_at(log_size, sign):
            asks(sign * math.exp(log_size))
            return seen[-1][0]

        starts = [start * first.middle for start in (SLOPE_SHARE, *SIZE_STARTS)]
        starts += [hint.values[first.name] for hint in hints if hint.law.name == law.name]
        for start in starts + [-start for start in starts[1:] if signed]:
            asks(start)
        for _ in range(SIZE_ROUNDS):
            _, _, asked = min(seen)
            if asked == 0.0 or (asked < 0.0 and not signed):
                break
            asks(asked)
        _, nearest, asked = min(seen)
        further = [other for _, other, its in seen if (its - other) * (asked - nearest) < 0.0 and other * nearest > 0.0]
        if further and asked != nearest:
            other = min(further, key=lambda other: abs(other - nearest))
            low, high = sorted((nearest, other))
            optimize.brentq(asks, low, high, rtol=SIZE_TOLERANCE, maxiter=SIZE_ROUNDS_BETWEEN, disp=False)
        distance, nearest, _ = min(seen)
        if SEPARABLE_D <= distance < FAR_SHARE * math.sqrt(max(self.inner(signal, signal), 0.0)) and nearest != 0.0:
            reach, middle = math.log(SIZE_REACH), math.log(abs(nearest))
            optimize.minimize_scalar(
                distance_at,
                bounds=(middle - reach, middle + reach),
                args=(math.copysign(1.0, nearest),),
                method="bounded",
                options={"xatol": SIZE_TOLERANCE, "maxiter": SIZE_ROUNDS_ABOUT},
            )
        return min(seen)[0]

    # ---- alternatives ----

    def alternatives(self, hints=()):
        """Every library law at every place: (law, acts_on, points of its grid)."""
        for law in laws.LIBRARY:
            if self.case.single and not law.single_axis:
                continue
            for acts_on in law.acts_on:
                if self.case.single and acts_on.startswith(("micro", "end", "contact")):
                    continue
                yield law, acts_on, self.points(law, hints)

    def points(self, law, hints=()):
        """Values of a law's parameters but its phase, over a grid; those of one size after those of another.

        hints: effects whose pitches and frequencies join the grids of the periodic laws, and whose shape that of the
        same law elsewhere: a drift of the macro's sensor over 36 s and one of the end's seemed 3.7 apart, as the grid
        has 20 s and 77 s.
        """
        first = law.parameters[0]
        if law.name == "contact_damping" and self.case.uncertainty.get("contact_damping_n_s_per_m", 0.0) > 0.0:
            return []  # the model has one already: an error of a parameter
        if law.name == "micro_reaction" and self.case.belief["micro_reaction"] > 0.0:
            return []
        sizes = [first.middle]
        if law.name in NONLINEAR:
            sizes = [first.low * (first.high / first.low) ** (i / 3.0) for i in range(4)]
        points = [{}]
        for parameter, count in zip(law.parameters[1:], law.grid_counts, strict=False):
            if parameter.is_phase:
                continue
            grid = parameter.grid(count)
            if parameter.name in ("pitch_m", "frequency_hz"):
                grid = grid + [h.values[parameter.name] for h in hints if parameter.name in h.values]
            points = [point | {parameter.name: value} for point in points for value in grid]
        for parameter in law.parameters[1:]:
            if all(parameter.name not in point for point in points) and not parameter.is_phase:
                points = [point | {parameter.name: parameter.middle} for point in points]
        points += [
            {p.name: hint.values[p.name] for p in law.parameters[1:] if not p.is_phase}
            for hint in hints
            if hint.law.name == law.name and len(law.parameters) > 1
        ]
        return [{first.name: size} | point for size in sizes for point in points]

    def turns_with_size(self, law):
        """Whether a law may put a body behind an edge, so that its column turns with its size."""
        return not self.case.single and law.phase is None and (law.family == "sensor" or law.name in EDGE_LAWS)

    def law_columns(self, law, acts_on, values):
        """What a law changes, whitened; one that has a phase at two of them, for each homing or run that draws one."""
        if law.phase is None:
            return [self.whitened([self.law_channels(run, law, acts_on, values) for run in self.runs])]
        columns = []
        group_of = [run.homing if law.phase.spread == "phase" else run.number for run in self.runs]
        for turn in (0.0, 0.5 * math.pi):
            there = values | {law.phase.name: turn}
            channels = [self.law_channels(run, law, acts_on, there) for run in self.runs]
            for group in sorted(set(group_of)):
                own = [one if its == group else None for its, one in zip(group_of, channels, strict=True)]
                columns.append(self.whitened(own))
        return columns

    def distances(self, signal, hints=()):
        """{(name, acts_on): smallest distance of `signal` from that law over its grid}, parameter errors included."""
        nearest = {}
        for law, acts_on, points in self.alternatives(hints):
            size = law.parameters[0].name
            for values in points:
                columns = self.law_columns(law, acts_on, values)
                distance = self.rest_after(signal, columns, law.signed or law.phase is not None)
                if self.turns_with_size(law) and values[size] == points[0][size]:
                    distance = min(distance, self._rest_after_best_size(signal, law, acts_on, values, hints))
                nearest[law.name, acts_on] = min(nearest.get((law.name, acts_on), math.inf), distance)
        for key, names in PARAMETER_ERRORS.items():
            if all(name in self.names for name in names):
                nearest[key] = self.rest_after(signal, [self.parameter_column(key)], True)
        return nearest


def _added(parts):
    """Channels that are the sums of those of some parts; None where none has any."""
    return [
        sum(channel for channel in channels if channel is not None)
        if any(one is not None for one in channels)
        else None
        for channels in zip(*parts, strict=True)
    ]


def _products(a, b):
    """Scalar products of rows: by einsum, as threaded matrix products of this shape cost ten times more."""
    return np.einsum("ik,jk->ij", a, b)


@compiled
def _stops(r, speed, contact):
    """Force in N of the stops on the macro axis at relative positions and speeds, the mean over each cell."""
    out = np.zeros(len(r))
    for i in range(len(r)):
        out[i] = _stop(r, i, speed[i], contact)
    return out


@compiled
def _stop(r, i, speed, contact):
    """The same of cell `i`.

    A cell that an edge is passed in counts by the share of it that lies behind the edge. By its middle alone it would
    count wholly or not at all: moved by 10 nm, an edge passed at 50 mm/s (12 um a cell) was most often not seen to
    move, and once in a thousand times to move by all of a cell.
    """
    low = 0.5 * (r[i - 1] + r[i]) if i > 0 else r[i]
    high = 0.5 * (r[i] + r[i + 1]) if i < len(r) - 1 else r[i]
    force, passed = 0.0, False
    for side, edge, stiffness in ((1.0, contact[3], contact[1]), (-1.0, contact[2], contact[0])):
        first, last = side * low - edge, side * high - edge
        if (first > 0.0) != (last > 0.0):
            passed = True
            deepest = max(first, last)
            behind = deepest / abs(last - first)
            force += side * behind * max(0.0, 0.5 * stiffness * deepest + contact[4] * side * speed)
    if passed:
        return force
    return contact_force(-1, np.zeros(laws.PARAMETERS), np.zeros(laws.MEMORIES), 0.0, 0.0, r[i], speed, contact)


@compiled
def _thrust_along(code, p, constant, currents, x):
    out = np.zeros(len(x))
    for i in range(len(x)):
        out[i] = thrust(code, p, constant, currents[i], x[i])
    return out


@compiled
def _reading_errors(code, p, t0, x):
    out = np.zeros(len(x))
    for i in range(len(x)):
        out[i] = laws.reading_error(code, p, t0 + i * SAMPLE_S, x[i])
    return out


@compiled
def _lagged(fine, lag):
    out = np.zeros(len(fine))
    out[0] = fine[0]
    e = math.exp(-CELL_S / lag)
    for i in range(1, len(fine)):
        slope = (fine[i] - fine[i - 1]) / CELL_S
        out[i] = fine[i] - slope * lag + (out[i - 1] - fine[i - 1] + slope * lag) * e
    return out


@dataclass
class Found:
    """What the generator itself can say of one hidden effect."""

    d_prime: float
    limit: float
    above_twice: bool
    above_ten_times: bool
    inseparable: list
    nearest: dict


def amplitude(effect):
    """An effect's size: its first parameter, without sign."""
    return abs(effect.values[effect.law.parameters[0].name])


def beside(free, index):
    """All that the other effects may do: of `free`, columns by effect, all but those of effect `index`."""
    return [column for i, columns in enumerate(free) if i != index for column in columns]


def limit_of(case, evidence, index, free):
    """(d', limit): d' of effect `index` given the others, and the amplitude where it would be 5.

    d' isn't proportional to the amplitude where the loop's answer to the effect is itself uncertain, so the case is
    simulated again near the limit, at most three times.
    """
    own = evidence.d_prime(free[index][0], beside(free, index))
    size = amplitude(case.effects[index])
    if own <= 0.0:
        return 0.0, math.inf
    scale, probe = 1.0, own
    for _ in range(LIMIT_ROUNDS):
        if abs(math.log(probe / D_PRIME_AT_LIMIT)) < 0.1:
            break
        scale *= min(max(D_PRIME_AT_LIMIT / probe, 1.0 / 30.0), 30.0)
        effects = [effect.scaled(scale) if i == index else effect for i, effect in enumerate(case.effects)]
        there = replace(case, effects=effects)
        runs = simulate(there)
        if not follows(runs):
            return own, size * scale  # it would be seen long before the loop fails
        other = Evidence(there, runs)
        there_free = [other.free_columns(i) for i in range(len(effects))]
        probe = other.d_prime(there_free[index][0], beside(there_free, index))
        if probe <= 0.0:
            return own, math.inf
    return own, size * scale * D_PRIME_AT_LIMIT / probe


def judged(case, separate=True):
    """(a Found for every hidden effect of a simulated case, {parameter error: Found} of its wrong parameters)."""
    if not case.effects and not case.parameter_errors:
        return [], {}
    evidence = Evidence(case, case.runs)
    free = [evidence.free_columns(i) for i in range(len(case.effects))]
    limits = [limit_of(case, evidence, index, free) for index in range(len(case.effects))]
    units = {}
    for key in case.parameter_errors:
        others = [evidence.parameter_column(other) for other in case.parameter_errors if other != key]
        evidence.set_nuisance(others, PARAMETER_ERRORS[key])
        column = evidence.parameter_column(key)
        units[key] = math.sqrt(max(evidence.inner(column, column), 0.0))
    narrow = evidence.narrowed(SEPARATION_BAND_HZ) if separate else evidence
    del evidence
    free = [narrow.free_columns(i) for i in range(len(case.effects))] if separate else []
    found = []
    for index, (effect, (own, limit)) in enumerate(zip(case.effects, limits, strict=True)):
        nearest = {}
        if separate and amplitude(effect) >= 2.0 * limit:
            signal = free[index][0]
            narrow.set_nuisance(beside(free, index))
            narrow.look_at(index)
            nearest = narrow.distances(signal, [] if effect.law.outside else [effect])
            if effect.law.name == "asymmetric_coulomb_friction":
                nearest["coulomb_friction+offset", effect.acts_on] = _coulomb_and_offset(narrow, effect, signal)
            nearest.pop((effect.law.name, effect.acts_on), None)
        found.append(_found(own, limit, amplitude(effect), nearest))
    wrong = {}
    for key, size in case.parameter_errors.items():
        limit = D_PRIME_AT_LIMIT / units[key] if units[key] > 0.0 else math.inf
        nearest = {}
        if separate and abs(size) >= 2.0 * limit:
            others = [narrow.parameter_column(other) for other in case.parameter_errors if other != key]
            narrow.set_nuisance(others, PARAMETER_ERRORS[key])
            nearest = narrow.distances(narrow.parameter_column(key) * size)
            nearest.pop(key, None)
        wrong[key] = _found(abs(size) * units[key], limit, abs(size), nearest)
    return found, wrong


def _found(own, limit, size, nearest):
    inseparable = sorted(key for key, distance in nearest.items() if distance < SEPARABLE_D)
    return Found(own, limit, size >= 2.0 * limit, size >= 10.0 * limit, inseparable, nearest)


def _coulomb_and_offset(evidence, effect, signal):
    columns = []
    for name in ("coulomb_friction", "offset"):
        law = laws.BY_NAME[name]
        values = {law.parameters[0].name: 1.0}
        columns.append(
            evidence.whitened([evidence.law_channels(run, law, effect.acts_on, values) for run in evidence.runs])
        )
    return evidence.rest_after(signal, columns, True)
