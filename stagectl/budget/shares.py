"""Each source's share in the end's error, predicted: its spectrum through the linearised loop (`stagectl.linear_loop`).

A share is a power by cells of frequency, m^2: shares add up. `delay` is what all noises gain because a force follows
its sample as late as it does, `model error` what they gain because the machine is not quite the believed one, with the
forces that the profile lacks; both may be below zero.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stagectl.adaptive_filter import at_rest
from stagectl.budget.disturbances import (
    COGGING,
    CONTACT,
    DELAY,
    FORCE,
    MODEL,
    SENSOR,
    SOURCES,
    STEP,
    Forces,
    Noises,
    of_columns,
)
from stagectl.errors import RequestError
from stagectl.linear_loop import Body, LinearSystem, believed_body, linearise

if TYPE_CHECKING:
    from stagectl.profile import Profile

CELLS_COUNT = 600
LOWEST_HZ = 0.05
_AT_ONCE_S = 1e-6  # sample to force, where there is no delay to speak of


@dataclass(frozen=True, slots=True, eq=False)
class Spectra:
    """Power by cells of frequency, m^2, shapes (cells,); `edge_hz` is one longer."""

    edge_hz: np.ndarray
    by_source: dict[str, np.ndarray]

    @property
    def total(self) -> np.ndarray:
        """Power of all sources together, shape (cells,)."""
        return np.sum(list(self.by_source.values()), axis=0)

    @property
    def rms_m(self) -> float:
        """Root mean square of all sources together."""
        return math.sqrt(max(float(np.sum(self.total)), 0.0))

    def power_m2(self, source: str) -> float:
        """Return the power of one source; below zero where it takes some away."""
        return float(np.sum(self.by_source[source]))


def edges_hz(period_s: float) -> np.ndarray:
    """Return the cells' edges, even in their logarithm up to half the rate."""
    return np.geomspace(LOWEST_HZ, 0.5 / period_s, CELLS_COUNT + 1)


def spectra(
    profile: "Profile",
    law: str,
    noises: Noises,
    *,
    body: Body | None = None,
    forces: Forces | None = None,
    adaptive_gain_ratio: float = 0.0,
    is_true: bool = True,
) -> Spectra:
    """Predict every source's share in the true error, averaged between samples, or in the measured one.

    `body` is the machine where it is known (`linear_loop.machine_body`), else it is as believed. RequestError where
    the loop is unstable or can't be linearised.
    """
    edge_hz = edges_hz(profile.cycle.period_s)
    believed = believed_body(profile)

    def loop(of: Body, at: "Profile") -> LinearSystem:
        return stable_loop(at, law, of, adaptive_gain_ratio)

    as_it_is = loop(believed, profile)
    at_once = _of_noises(loop(believed, without_delay(profile)), noises, edge_hz, is_true)
    late = _of_noises(as_it_is, noises, edge_hz, is_true)
    found = {source: np.zeros(CELLS_COUNT) for source in SOURCES} | at_once
    found[DELAY] = _sum(late) - _sum(at_once)
    real = as_it_is
    if body is not None:
        real = loop(body, profile)
        found[MODEL] = _sum(_of_noises(real, noises, edge_hz, is_true)) - _sum(late)
    if forces is not None:
        for source in (COGGING, CONTACT, MODEL):
            found[source] = found[source] + _of_forces(real, forces, source, edge_hz)
    return Spectra(edge_hz, found)


def stable_loop(profile: "Profile", law: str, body: Body, adaptive_gain_ratio: float = 0.0) -> LinearSystem:
    """Return the closed loop as it is at rest; RequestError where it is unstable, for then it has no spectrum."""
    system = linearise(profile, law, body, adaptive_gain_ratio=adaptive_gain_ratio, observer=at_rest).closed()
    if not system.is_stable():
        greatest = float(np.max(np.abs(system.poles())))
        raise RequestError(
            f"profile {profile.name} under {law}: the loop is unstable (a pole at {greatest:.4f} of the unit circle); "
            "lower control.micro_bandwidth_hz, or let `stagectl tune` find gains"
        )
    return system


def without_delay(profile: "Profile") -> "Profile":
    """Return the profile of a stage whose force follows its sample at once; nothing checks it."""
    cycle = profile.cycle.model_copy(update={"phase_s": 0.5 * _AT_ONCE_S, "actuation_delay_s": _AT_ONCE_S})
    return profile.model_copy(update={"cycle": cycle})


def total_rms_m(
    profile: "Profile", law: str, noises: Noises, body: Body | None = None, adaptive_gain_ratio: float = 0.0
) -> float:
    """Predict the true hold error alone, all noises together; RequestError as above."""
    body = believed_body(profile) if body is None else body
    system = stable_loop(profile, law, body, adaptive_gain_ratio)
    parts = _of_noises(system, noises, edges_hz(profile.cycle.period_s), True)
    return math.sqrt(float(np.sum(list(parts.values()))))


def _of_noises(system: LinearSystem, noises: Noises, edge_hz: np.ndarray, is_true: bool) -> dict[str, np.ndarray]:
    """Return the power by cells of SENSOR and FORCE, white, and of STEP, white and differenced."""
    axes = of_columns(system.inputs)
    at_hz = np.sqrt(edge_hz[:-1] * edge_hz[1:])
    by_input = _responses(system, at_hz, "end_mean_m" if is_true else "end_position_m")
    share = 2.0 * system.period_s * np.diff(edge_hz)  # of a variance, by cell
    precise = ("macro", "end")[len(axes) - 1]

    def power(name: str, deviation: float) -> np.ndarray:
        response = by_input[name]
        if name == f"{precise}_noise_m" and not is_true:
            response = response + 1.0  # what is read has the reading's own noise
        return np.abs(response) ** 2 * share * deviation**2

    seen = ("macro", "end")[: len(axes)]
    # what a word is rounded by the next one owes (`stagectl.tick`): white, differenced
    paid_back = np.abs(1.0 - np.exp(-2j * np.pi * at_hz * system.period_s)) ** 2
    return {
        SENSOR: sum((power(f"{name}_noise_m", noises.sensor_m) for name in seen), np.zeros(at_hz.size)),
        STEP: paid_back
        * sum((power(f"{axis}_rounding_n", noises.rounding_n[axis]) for axis in axes), np.zeros(at_hz.size)),
        FORCE: sum((power(f"{axis}_force_n", noises.force_n.get(axis, 0.0)) for axis in axes), np.zeros(at_hz.size)),
    }


def _sum(parts: dict[str, np.ndarray]) -> np.ndarray:
    return np.sum(list(parts.values()), axis=0)


def _responses(system: LinearSystem, at_hz: np.ndarray, outcome: str) -> dict[str, np.ndarray]:
    """Return an output's response to every input; one system of equations a frequency for all."""
    row = system.outputs.index(outcome)
    z = np.exp(2j * np.pi * at_hz * system.period_s)
    size = system.a.shape[0]
    right = np.broadcast_to(system.c[row][:, None], (z.size, size, 1))
    solved = np.linalg.solve(z[:, None, None] * np.eye(size) - system.a.T, right)[:, :, 0]
    found = solved @ system.b + system.d[row]
    return {name: found[:, k] for k, name in enumerate(system.inputs)}


def _of_forces(system: LinearSystem, forces: Forces, source: str, edge_hz: np.ndarray) -> np.ndarray:
    """Return the power by cells of forces along a move, its mean left out (the observer takes it)."""
    rows = forces.rows(source)
    if not any(np.any(values) for values in rows.values()):
        return np.zeros(edge_hz.size - 1)
    error_m = answer(system, {f"{axis}_force_n": values for axis, values in rows.items()})
    return binned(error_m, system.period_s, edge_hz)


def answer(system: LinearSystem, inputs: dict[str, np.ndarray], outcome: str = "end_mean_m") -> np.ndarray:
    """Return an output over time, shape (n,), to inputs of shape (n,); it starts settled at the first values."""
    columns = [system.inputs.index(name) for name in inputs]
    values = np.column_stack(list(inputs.values()))
    row = system.outputs.index(outcome)
    b, d = system.b[:, columns], system.d[row, columns]
    state = np.linalg.solve(np.eye(system.a.shape[0]) - system.a, b @ values[0])
    found = np.empty(values.shape[0])
    for k, value in enumerate(values):
        found[k] = system.c[row] @ state + d @ value
        state = system.a @ state + b @ value
    return found


def binned(error_m: np.ndarray, period_s: float, edge_hz: np.ndarray) -> np.ndarray:
    """Return the power of an error about its mean by cells, m^2; what is below the first edge counts into its cell."""
    power = np.abs(np.fft.rfft(error_m - np.mean(error_m))) ** 2 / error_m.size**2
    power[1 : (error_m.size + 1) // 2] *= 2.0
    at_hz = np.clip(np.fft.rfftfreq(error_m.size, period_s)[1:], edge_hz[0], edge_hz[-1])
    return np.histogram(at_hz, edge_hz, weights=power[1:])[0]
