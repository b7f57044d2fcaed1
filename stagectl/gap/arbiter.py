"""The arbiter: the machine with its effects under its own controller, simulated, beside what was measured.

One axis under a cascade (position P over velocity P, as many commercial drives close it). What regression ranks, this
judges: force and position of the whole closed loop, against the scatter from lap to lap. Pure.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from stagectl import compose, plant
from stagectl.errors import RequestError
from stagectl.gap.believed import Believed
from stagectl.gap.log import Log

BAND_HZ = 80.0
"""Commands are compared below it: above, quantised positions times the velocity gain are all there is."""

_LEAST_LAP = 200  # samples
_LAP_REACH = 100
_SAME_RATIO = 1e-3
_CONTROLLER_RATIO = 0.02
_FREE = 1e9  # of limits that an observed machine has none of
_CIRCUIT = {"resistance_ohm": 1.0, "inductance_h": 1e-3, "supply_v": _FREE, "current_limit_a": _FREE}

_LOOP = '''
@compiled
def follow(reference_m, command_extra_n, state, parameters, effects, period_s, latch_s, longest_s, position_gain,
           velocity_gain, limit_n, newtons_per_ampere, positions_m, commands_n):
    """Run the cascade on the plant: u = kv (kp (r - x) - difference of the means of two samples), limited."""
    s = state[0]
    held_a = 0.0
    before_m = s.macro_position_m
    mean_before_m = s.macro_position_m
    for k in range(reference_m.size):
        t_s = k * period_s
        plant_module.advance(state, parameters, effects, t_s, longest_s, held_a, 0.0, 1, 1)
        x_m = s.macro_position_m
        mean_m = 0.5 * (x_m + before_m)
        v = (mean_m - mean_before_m) / period_s
        before_m = x_m
        mean_before_m = mean_m
        u = velocity_gain * (position_gain * (reference_m[k] - x_m) - v)
        u = min(max(u, -limit_n), limit_n) + command_extra_n[k]
        positions_m[k] = x_m
        commands_n[k] = u
        if latch_s > 0.0:
            plant_module.advance(state, parameters, effects, t_s + latch_s, longest_s, held_a, 0.0, 1, 1)
        held_a = u / newtons_per_ampere
'''


@dataclass(frozen=True, slots=True)
class Closed:
    """Simulated closed loop of one recording."""

    position_m: np.ndarray
    command_n: np.ndarray


@dataclass(frozen=True, slots=True)
class Gap:
    """Measured minus simulated, root mean squares, and the scatter from lap to lap (nan where nothing repeats)."""

    command_n: float
    position_m: float
    command_floor_n: float
    position_floor_m: float


_AS_BELIEVED: Mapping[str, float] = MappingProxyType({})


def simulate(
    believed: Believed, effects: list[dict[str, Any]], log: Log, refitted: Mapping[str, float] = _AS_BELIEVED
) -> Closed:
    """Run a believed machine with these effects under its own controller along a log's reference.

    refitted: errors of what is believed of the motor and its drive, by the names that findings have for them. Without
    the 0.27 ms that a drive turned out to be late a machine was off by 1.54 N, with them by 1.35 N.

    Errors: RequestError where controller or reference are not known.
    """
    cascade = believed.cascade
    if cascade is None or log.reference_m is None or believed.micro is not None:
        raise RequestError(
            f"{log.name}: closed loop needs a reference and a [loop] table of one axis; short horizons judge instead"
        )
    plant_module = compose.plant_module(effects)
    source = (
        '"""Generated: one machine under a cascade."""\n'
        f"import {plant_module.__name__} as plant_module\nfrom stagectl.compiled import compiled\n" + _LOOP
    )
    module = compose.generated_module("cascade", source)
    macro = believed.macro
    constant_n_per_a = macro.force_constant_n_per_a * (1.0 + refitted.get("macro_force_constant", 0.0))
    latch_s = macro.latch_s + refitted.get("macro_latch_s", 0.0)
    lag_s = macro.current_loop_s + refitted.get("macro_current_loop_s", 0.0)
    parameters = np.zeros(1, plant.PLANT_PARAMETERS)
    parameters["macro_mass_kg"] = macro.mass_kg * (1.0 + refitted.get("macro_mass_kg", 0.0))
    parameters["micro_mass_kg"] = 1.0
    parameters["travel_low_m"], parameters["travel_high_m"] = -_FREE, _FREE
    for axis in ("macro", "micro"):
        parameters[f"{axis}_force_constant_n_per_a"] = constant_n_per_a
        parameters[f"{axis}_current_loop_s"] = max(lag_s, 1e-6)
        for name, value in _CIRCUIT.items():
            parameters[f"{axis}_{name}"] = value
    state = np.zeros(1, plant.PLANT_STATE)
    state["macro_position_m"] = log.macro_position_m[0]
    velocity = float(np.polyfit(log.times_s[:20], log.macro_position_m[:20], 1)[0])
    state["macro_velocity_m_per_s"] = velocity
    positions, commands = np.zeros(log.samples_count), np.zeros(log.samples_count)
    extra = np.zeros(log.samples_count) if log.command_extra_n is None else log.command_extra_n
    module.follow(
        log.reference_m, extra, state, parameters, compose.effect_parameters(effects), log.period_s,
        max(latch_s, 0.0), 0.25 * log.period_s, cascade.position_gain_per_s,
        cascade.velocity_gain_n_s_per_m, cascade.limit_n, macro.force_constant_n_per_a, positions, commands,
    )  # fmt: skip
    return Closed(positions, commands)


def cannot_close(believed: Believed, log: Log) -> str:
    """Say why the closed loop of a log can't be simulated, empty where it can.

    A controller that does not give the recorded commands from the recorded positions is not the one that ran.
    """
    if believed.cascade is None or log.reference_m is None or believed.micro is not None:
        return f"{log.name}: no controller of one axis and reference are known; the closed loop is not simulated"
    cascade = believed.cascade
    means_m = 0.5 * (log.macro_position_m + np.concatenate([log.macro_position_m[:1], log.macro_position_m[:-1]]))
    speed = np.diff(means_m, prepend=means_m[0]) / log.period_s
    force_n = cascade.velocity_gain_n_s_per_m * (
        cascade.position_gain_per_s * (log.reference_m - log.macro_position_m) - speed
    )
    force_n = np.clip(force_n, -cascade.limit_n, cascade.limit_n)
    if log.command_extra_n is not None:
        force_n = force_n + log.command_extra_n
    settle = round(0.5 / log.period_s)
    misfit = _rms((log.macro_command_n - force_n)[settle:]) / max(_rms(log.macro_command_n[settle:]), 1e-300)
    if not misfit <= _CONTROLLER_RATIO:
        return (
            f"{log.name}: the controller of the profile gives other commands than recorded ({misfit:.1%} of them, "
            f"limit {_CONTROLLER_RATIO:.0%}); the closed loop is not simulated"
        )
    return ""


def gap_of(log: Log, simulated: Closed) -> Gap:
    """Compare a log with its simulation, and with itself one lap later."""
    sos = butter(4, BAND_HZ * 2.0 * log.period_s, output="sos")
    settle = round(0.5 / log.period_s)
    inner = slice(settle, -settle)
    command_n = sosfiltfilt(sos, log.macro_command_n - simulated.command_n)[inner]
    position_m = sosfiltfilt(sos, log.macro_position_m - simulated.position_m)[inner]
    lap = lap_samples(log.reference_m)
    floors = (float("nan"), float("nan"))
    if lap:
        floors = tuple(
            _rms(sosfiltfilt(sos, values)[lap:][inner] - sosfiltfilt(sos, values)[:-lap][inner]) / np.sqrt(2.0)
            for values in (log.macro_command_n, log.macro_position_m)
        )
    return Gap(_rms(command_n), _rms(position_m), float(floors[0]), float(floors[1]))


def lap_samples(reference_m: np.ndarray | None) -> int:
    """Return after how many samples a reference repeats, 0 where it does not."""
    if reference_m is None or not np.ptp(reference_m) > 0.0:
        return 0
    x = reference_m - reference_m.mean()
    size = int(2 ** np.ceil(np.log2(2 * x.size)))
    spectrum = np.fft.rfft(x, size)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2)[: x.size]
    correlation = correlation / np.maximum(np.arange(x.size, 0, -1), 1) / (correlation[0] / x.size)
    rising = correlation[1:-1] >= correlation[:-2]
    peaks = 1 + np.flatnonzero(rising & (correlation[1:-1] > correlation[2:]) & (correlation[1:-1] > 0.9))
    for peak in peaks[(peaks > _LEAST_LAP) & (peaks < int(0.8 * x.size))]:
        near = range(max(_LEAST_LAP, int(peak) - _LAP_REACH), int(peak) + _LAP_REACH + 1)
        misfits = [_rms(reference_m[lap:] - reference_m[:-lap]) for lap in near]
        if min(misfits) < _SAME_RATIO * float(np.ptp(reference_m)):
            return near[int(np.argmin(misfits))]
    return 0


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values * values)))
