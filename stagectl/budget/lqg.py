"""The least hold error that a sensor, a delay and a torque step allow: LQG on one mass (Kwakernaak, Sivan 1972, 5-6).

    m x'' = u + d + w,   d' = white,   y = x + n   at every sample

u is a held command that acts `delay_s` after its sample (any fraction of a cycle), d a force that drifts as a random
walk, w a force noise held for a cycle, n the sensor's noise. The Kalman filter takes the newest sample before the
command is made; the regulator is cheap control of the mean square of x between samples: what is left is the bound. A
torque word rounds u and pays the rest back with the next: a white rounding of variance step^2 / 12, differenced,
known to the filter, which is fed the word that was sent.

Inside, all is in periods, nanometres and the force that moves the mass by a nanometre per period squared. Pure.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov
from scipy.optimize import minimize

from stagectl.errors import RequestError

SOURCES = ("sensor noise", "force noise", "force drift", "torque step")

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_NM = 1e9
_LEAST_WALK_RATIO = 1e-5  # of the sensor's noise: a filter without any drift has no integral action
_LEAST_EFFORT = 1e-9  # squared: cheap control, not free
_FREQUENCIES_COUNT = 300
_LOWEST_RATIO = 1e-4  # of half the sampling rate
_STARTS = ((1.0, 0.01, 0.03), (1.0, 0.003, 0.01), (0.3, 0.01, 0.1))
"""Force noise of a filter over the motor's; its drift, price of force, in units of what the sensor's noise could be."""
_LEAST_FORCE = 1e-4  # of that unit: a motor without noise
_SEARCH: Any = {"xatol": 1e-3, "fatol": 1e-5, "maxfev": 300}
_SENSITIVITY_PRICE = 30.0
_LIMIT_SLACK = 1.005
_NO_LOOP = 1e2
_STEP_PERIODS = 200


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a loop has to live with; `force_noise_n` is held for a cycle, `torque_step_n` is that of the word."""

    mass_kg: float
    period_s: float
    delay_s: float  # sample instant -> force
    sensor_noise_m: float
    force_noise_n: float = 0.0
    force_drift_n_per_sqrt_s: float = 0.0
    torque_step_n: float = 0.0


@dataclass(frozen=True, slots=True)
class Design:
    """Weights: the noises that the filter is made for, and the force that is as dear as a nanometre of error, N."""

    force_noise_n: float
    force_drift_n_per_sqrt_s: float
    effort_n: float = math.inf  # infinite: a force costs nothing


@dataclass(frozen=True, slots=True, eq=False)
class Robustness:
    """What the loop, broken at the command, shows; `loop_gain` is complex, shapes (n,)."""

    frequency_hz: np.ndarray
    loop_gain: np.ndarray
    max_sensitivity: float
    delay_margin_s: float  # infinite where the gain never crosses one
    crossover_hz: float  # where the gain first falls below one; nan where it never does


@dataclass(frozen=True, slots=True)
class Hold:
    """What a design holds to: rms of the true end position between samples, and of the measured error at them."""

    true_rms_m: float
    measured_rms_m: float
    by_source_m: dict[str, float]  # SOURCES: root mean squares, whose squares add up
    design: Design
    robustness: Robustness


class Loop:
    """One mass under an LQG regulator with its filter. Errors: RequestError where no such loop exists."""

    def __init__(self, around: Surroundings, design: Design):
        """Solve both Riccati equations; plant state (x, v, commands under way, newest first), filter (x, v, d)."""
        self.around, self.design = around, design
        self._robustness: Robustness | None = None
        for name in ("mass_kg", "period_s", "sensor_noise_m"):
            if not getattr(around, name) > 0.0:
                raise RequestError(f"{name} is {getattr(around, name):g}; a bound needs a number above 0")
        self._newton = around.period_s**2 / around.mass_kg * _NM
        cycles = around.delay_s / around.period_s
        self._whole = math.floor(cycles + 1e-9)
        self._part = max(cycles - self._whole, 0.0)
        self._commands = self._whole + (1 if self._part > 1e-9 else 0)
        self._sensor = around.sensor_noise_m * _NM
        self._walk_unit = math.sqrt(around.period_s) * self._newton
        self._a, self._b = self._step()
        self._make_between()
        try:
            self._law = self._regulator()
            self._gain = self._filter()
        except (np.linalg.LinAlgError, ValueError) as error:
            raise RequestError(f"no LQG loop for {around} with {design}: {error}; take other weights") from error
        self._of_estimate = np.array([self._law[0], self._law[1], 1.0 + float(np.sum(self._law[2:]))])

    @property
    def regulator_n_per_state(self) -> np.ndarray:
        """The regulator on (x in m, v in m/s, commands under way in N, newest first), N; its force is taken off."""
        scale = np.ones(self._law.size)
        scale[0], scale[1] = _NM / self._newton, _NM * self.around.period_s / self._newton
        return self._law * scale

    @property
    def gain_per_m(self) -> np.ndarray:
        """The filter's gain on position, velocity in m/s and force in N, by a metre of innovation."""
        return self._gain * np.array([1.0, 1.0 / self.around.period_s, _NM / self._newton])

    def _moved(self, until: float) -> tuple[np.ndarray, np.ndarray]:
        """Return how (x, v) follow from the state and from the command made now, after a part of a period."""
        rows, now = np.zeros((2, 2 + self._commands)), np.zeros(2)
        rows[:, :2] = [[1.0, until], [0.0, 1.0]]
        first = min(self._part, until)
        rest = until - first
        columns = {
            self._whole: np.array([0.5 * rest * rest, rest]),
            self._whole + 1: np.array([0.5 * first * first + first * rest, first]),
        }
        for age, column in columns.items():
            if age == 0:
                now += column
            elif age <= self._commands:
                rows[:, 1 + age] += column
        return rows, now

    def _step(self) -> tuple[np.ndarray, np.ndarray]:
        rows, now = self._moved(1.0)
        size = 2 + self._commands
        a, b = np.zeros((size, size)), np.zeros(size)
        a[:2], b[:2] = rows, now
        if self._commands:
            b[2] = 1.0
            older = np.arange(3, size)
            a[older, older - 1] = 1.0
        return a, b

    def _make_between(self) -> None:
        """Lay down (share of the period, part of it, row of x on the state, x by the command made now)."""
        self._between: list[tuple[float, float, np.ndarray, float]] = []
        for point, weight in zip(_POINTS, _WEIGHTS, strict=True):
            until = 0.5 * (point + 1.0)
            rows, now = self._moved(until)
            self._between.append((0.5 * weight, until, rows[0], float(now[0])))

    def _regulator(self) -> np.ndarray:
        size = 2 + self._commands
        q, n, r = np.zeros((size, size)), np.zeros(size), _LEAST_EFFORT
        for share, _, row, now in self._between:
            q += share * np.outer(row, row)
            n += share * row * now
            r += share * now * now
        if math.isfinite(self.design.effort_n):
            r += (self.design.effort_n * self._newton) ** -2
        p = solve_discrete_are(self._a, self._b[:, None], q, np.array([[r]]), s=n[:, None])
        return (self._b @ p @ self._a + n) / (r + self._b @ p @ self._b)

    def _filter(self) -> np.ndarray:
        design = self.design
        force = design.force_noise_n * self._newton
        walk = max(design.force_drift_n_per_sqrt_s * self._walk_unit, _LEAST_WALK_RATIO * self._sensor)
        q = np.outer(_HELD, _HELD) * force**2 + _WALK * walk**2
        p = solve_discrete_are(_MOTION.T, np.array([[1.0], [0.0], [0.0]]), q, np.array([[self._sensor**2]]))
        return p[:, 0] / (p[0, 0] + self._sensor**2)

    def _closed(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the closed loop, the command and the part of the newest sample's noise in that command.

        States (x, v, commands under way, errors of the filter before the sample), forces taken relative to d, so that
        a drift that grows without end stays out.
        """
        size = 2 + self._commands
        behind = np.eye(3) - np.outer(self._gain, [1.0, 0.0, 0.0])  # the filter's error behind the sample
        command = np.concatenate([-self._law, self._of_estimate @ behind])
        a = np.zeros((size + 3, size + 3))
        a[:size, :size] = self._a
        a[:size] += np.outer(self._b, command)
        a[size:, size:] = _MOTION @ behind
        return a, command, -float(self._of_estimate @ self._gain)

    def hold(self) -> Hold:
        """Return what the design holds to in its surroundings (Lyapunov's equation, a source at a time)."""
        size = 2 + self._commands
        a, command, noise_now = self._closed()
        by_noise = np.concatenate([self._b * noise_now, -_MOTION @ self._gain])
        by_force = np.zeros((size + 3, 3))  # x, v, d that a period adds
        by_force[[0, 1], [0, 1]] = 1.0
        by_force[2:size, 2] = 1.0
        by_force[size:] = np.eye(3)
        around = self.around
        walk = around.force_drift_n_per_sqrt_s * self._walk_unit
        force = around.force_noise_n * self._newton
        step = around.torque_step_n * self._newton / math.sqrt(12.0)
        held = by_force @ _HELD
        # (what a period adds to the states; what the period itself feels: through the command, a held force, a walk)
        spreads = {
            "sensor noise": (np.outer(by_noise, by_noise) * self._sensor**2, (noise_now * self._sensor) ** 2, 0.0, 0.0),
            "force noise": (np.outer(held, held) * force**2, 0.0, force**2, 0.0),
            "force drift": (by_force @ _WALK @ by_force.T * walk**2, 0.0, 0.0, walk**2),
        }
        rounding, measured = self._of_rounding(a, command, step)
        by_source = {"torque step": math.sqrt(max(rounding, 0.0)) / _NM}
        measured += self._sensor**2
        for name, (covariance, in_command, in_force, in_walk) in spreads.items():
            state = solve_discrete_lyapunov(a, covariance)
            measured += float(state[0, 0])
            power = 0.0
            for share, until, row, now in self._between:
                full = np.concatenate([row, np.zeros(3)]) + now * command
                power += share * (float(full @ state @ full) + now * now * in_command)
                power += share * (0.25 * until**4 * in_force + until**5 / 20.0 * in_walk)
            by_source[name] = math.sqrt(max(power, 0.0)) / _NM
        true = math.sqrt(sum(value**2 for value in by_source.values()))
        return Hold(true, math.sqrt(measured) / _NM, by_source, self.design, self.robustness())

    def _of_rounding(self, a: np.ndarray, command: np.ndarray, step: float) -> tuple[float, float]:
        """Return the power between samples and at them of a rounding that the next command pays back."""
        size = a.shape[0]
        by_command = np.concatenate([self._b, np.zeros(3)])
        whole = np.zeros((size + 1, size + 1))  # the last state is the rounding before
        whole[:size, :size] = a
        whole[:size, size] = -by_command
        new = np.concatenate([by_command, [1.0]]) * step
        state = solve_discrete_lyapunov(whole, np.outer(new, new))
        power = 0.0
        for share, _, row, now in self._between:
            full = np.concatenate([row, np.zeros(3)]) + now * command
            full = np.concatenate([full, [-now]])
            power += share * (float(full @ state @ full) + (now * step) ** 2)
        return power, float(state[0, 0])

    def step_peak_m(self, force_n: float) -> float:
        """Return the greatest error after a step of force, m."""
        a, command, _ = self._closed()
        state = np.zeros(a.shape[0])
        state[2 : 2 + self._commands] = state[-1] = force_n * self._newton
        between = np.zeros((len(self._between), state.size))
        for k, (_, _, row, now) in enumerate(self._between):
            between[k, : row.size] = row
            between[k] += now * command
        states, periods = state[:, None], a  # one column a period, twice as many each time: a third of a search's time
        while states.shape[1] < _STEP_PERIODS:
            states, periods = np.hstack([states, periods @ states]), periods @ periods
        return float(np.max(np.abs(between @ states[:, :_STEP_PERIODS]))) / _NM

    def robustness(self) -> Robustness:
        """Return loop gain, greatest sensitivity and delay margin; the filter is fed what the regulator asks."""
        if self._robustness is None:  # a search asks for it, and what it then holds to for it again
            self._robustness = self._seen_from_command()
        return self._robustness

    def _seen_from_command(self) -> Robustness:
        count, size = self._commands, 2 + self._commands
        behind = np.eye(3) - np.outer(self._gain, [1.0, 0.0, 0.0])
        asked = np.concatenate([-self._of_estimate @ behind, -self._law[2:]])
        asked_now = -float(self._of_estimate @ self._gain)
        a = np.zeros((3 + count, 3 + count))
        a[:3, :3] = _MOTION @ behind
        a[:2, 3:] = self._a[:2, 2:]
        a[3:, 3:] = self._a[2:, 2:]
        by_command = np.concatenate([self._b[:2], [0.0], self._b[2:]])
        a += np.outer(by_command, asked)
        by_sample = np.concatenate([_MOTION @ self._gain, np.zeros(count)]) + by_command * asked_now
        frequency = np.geomspace(_LOWEST_RATIO, 1.0, _FREQUENCIES_COUNT) * 0.5
        z = np.exp(2j * np.pi * frequency)
        of_plant = np.zeros(size)
        of_plant[0] = 1.0
        plant = response(self._a, self._b, of_plant, 0.0, z)
        controller = response(a, by_sample, asked, asked_now, z)
        return robustness_of(frequency / self.around.period_s, -plant * controller)


def response(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: float, z: np.ndarray) -> np.ndarray:
    """Return c (z - a)^-1 b + d at the points z, complex, shape of z."""
    systems = z[:, None, None] * np.eye(a.shape[0]) - a
    return np.linalg.solve(systems, np.broadcast_to(b[:, None].astype(complex), (z.size, b.size, 1)))[:, :, 0] @ c + d


def robustness_of(frequency_hz: np.ndarray, loop_gain: np.ndarray) -> Robustness:
    """Take greatest sensitivity, delay margin and first crossover from a loop gain (complex, rising frequencies)."""
    sensitivity = 1.0 / np.abs(1.0 + loop_gain)
    magnitude = np.abs(loop_gain)
    margin_s, crossover_hz = math.inf, math.nan
    for k in np.flatnonzero((magnitude[:-1] - 1.0) * (magnitude[1:] - 1.0) < 0.0):
        share = np.log(magnitude[k]) / np.log(magnitude[k] / magnitude[k + 1])
        at_hz = float(frequency_hz[k] * (frequency_hz[k + 1] / frequency_hz[k]) ** share)
        turn = np.angle(loop_gain[k + 1] / loop_gain[k])
        phase = (np.angle(loop_gain[k]) + share * turn + np.pi) % (2.0 * np.pi)
        margin_s = min(margin_s, float(phase) / (2.0 * np.pi * at_hz))
        if math.isnan(crossover_hz) and magnitude[k] > magnitude[k + 1]:
            crossover_hz = at_hz
    return Robustness(frequency_hz, loop_gain, float(np.max(sensitivity)), margin_s, crossover_hz)


def bound(around: Surroundings) -> Hold:
    """Return the least hold: a filter made for the true noises, and force that costs nothing."""
    return Loop(around, Design(around.force_noise_n, around.force_drift_n_per_sqrt_s)).hold()


@lru_cache(maxsize=64)  # a search is a thousand loops, and a budget, its page and its advice ask for the same
def optimum(around: Surroundings, max_sensitivity: float = 2.0, step_peak_m_per_n: float = math.inf) -> Hold:
    """Return the best hold whose greatest sensitivity keeps to a limit: the bound where that does, else searched.

    With `step_peak_m_per_n` the loop must be as stiff besides: a step of force moves it no further than that, m a N.
    RequestError where no weights keep to it.
    """
    loop = Loop(around, Design(around.force_noise_n, around.force_drift_n_per_sqrt_s))
    best = loop.hold()
    if best.robustness.max_sensitivity <= max_sensitivity and loop.step_peak_m(1.0) <= step_peak_m_per_n:
        return best

    def size(one: Loop) -> float:
        beyond = max(one.step_peak_m(1.0) / step_peak_m_per_n - 1.0, 0.0)
        return one.hold().true_rms_m * math.exp(_SENSITIVITY_PRICE * beyond)

    try:
        found = _searched(around, max_sensitivity, size)
    except RequestError:
        if math.isinf(step_peak_m_per_n):
            raise
        found = stiffest(around, max_sensitivity)
    if not found.step_peak_m(1.0) <= step_peak_m_per_n * _LIMIT_SLACK:
        least_m = stiffest(around, max_sensitivity).step_peak_m(1.0)
        raise RequestError(
            f"a step of 1 N is to move the end by {step_peak_m_per_n * 1e9:.3g} nm at most; with a greatest "
            f"sensitivity of {max_sensitivity:g} it moves it by {least_m * 1e9:.3g} nm at least: allow more of either"
        )
    return found.hold()


@lru_cache(maxsize=64)
def stiffest(around: Surroundings, max_sensitivity: float = 2.0) -> Loop:
    """Return the loop that a step of force moves least, its greatest sensitivity within a limit.

    It is the other end from the best hold: what a loop gains against forces it pays in noise. RequestError as above.
    """
    return _searched(around, max_sensitivity, lambda loop: loop.step_peak_m(1.0))


def _searched(around: Surroundings, max_sensitivity: float, size: Callable[[Loop], float]) -> Loop:
    """Search force noise and drift of the filter and the price of force for the least `size` (Nelder, Mead).

    A filter made for the 20 mN of a motor on 12 kg allowed 19.9 nm at Ms 2.0, one made for less 8.1 nm.
    """
    typical_n = around.sensor_noise_m * around.mass_kg / around.period_s**2
    units = np.array([max(around.force_noise_n, _LEAST_FORCE * typical_n), typical_n, typical_n])

    def made(place: np.ndarray) -> Loop:
        force_n, drift_n, effort_n = (float(value) for value in np.exp(np.clip(place, -30.0, 10.0)) * units)
        return Loop(around, Design(force_n, drift_n / math.sqrt(around.period_s), effort_n))

    def cost(place: np.ndarray) -> float:
        try:
            loop = made(place)
        except RequestError:
            return _NO_LOOP
        beyond = max(loop.robustness().max_sensitivity - max_sensitivity, 0.0)
        return math.log(size(loop) * _NM) + min(_SENSITIVITY_PRICE * beyond, _NO_LOOP)

    found = [minimize(cost, np.log(start), method="Nelder-Mead", options=_SEARCH) for start in _STARTS]
    best = made(min(found, key=lambda one: float(one.fun)).x)
    reached = best.robustness().max_sensitivity
    if not reached <= max_sensitivity * _LIMIT_SLACK:
        raise RequestError(
            f"no weights keep the greatest sensitivity to {max_sensitivity:g} with {around.delay_s * 1e3:g} ms of "
            f"delay (best {reached:.2f}); raise the limit or shorten the delay"
        )
    return best


def _walk_covariance() -> np.ndarray:
    """Return the covariance that (x, v, d) gain in a period by a walk of d of one unit per root period."""
    rate = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    generator = np.zeros((6, 6))  # van Loan, IEEE Trans. Automatic Control 23(3), 1978
    generator[:3, :3], generator[3:, 3:] = -rate, rate.T
    generator[2, 5] = 1.0
    power = expm(generator)
    return power[3:, 3:].T @ power[:3, 3:]


_MOTION = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
_HELD = np.array([0.5, 1.0, 0.0])
_WALK = _walk_covariance()
