"""The value seam: machine, sensor and tick in one compiled loop, hundreds of times faster than real time.

Sample age, quantisation, noise and delay are the sensor's and the drives' of a machine; no bytes are made.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from stagectl import compose, plant
from stagectl.errors import RequestError
from stagectl.signals import COMMAND, MEASUREMENT
from stagectl.tick import Controller

DEVICES = np.dtype(
    [
        ("period_s", "f8"),  # of the sensor's own clock
        ("latch_delay_s", "f8"),  # sample instant -> SYNC that latches the command
        ("macro_resolution_m", "f8"),
        ("end_resolution_m", "f8"),
        ("reading_ratio", "f8"),  # what the profile takes for a metre: its index of air is not quite the true one
        ("interpolation_speed_m_per_s", "f8"),  # up to it a count is divided further
        ("interpolation_count", "f8"),  # parts of a count then
        ("macro_zero_m", "f8"),  # subtracted from what the sensor sees: the run's own zero
        ("end_zero_m", "f8"),
        ("macro_origin_m", "f8"),  # where the sensor's counter reads zero
        ("end_origin_m", "f8"),
        ("macro_amperes_per_word", "f8"),
        ("micro_amperes_per_word", "f8"),
        ("longest_substep_s", "f8"),
        ("macro_a", "f8"),  # commands that the drives hold
        ("micro_a", "f8"),
        ("sample", "f8"),  # number of the next sample
        ("sampled_s", "f8"),  # instant of the last sample, for what the sensors remember
        ("mean_from_s", "f8"),  # instant of the last sample, and the end's position integral there
        ("mean_from_m_s", "f8"),
        ("latched_after_s", "f8"),  # last sample instant -> its SYNC, as it came; 0 = none yet
        ("late_sample", "f8"),  # whose line comes a cycle late; -1 = none
        ("late_t_s", "f8"),
        ("late_macro_m", "f8"),
        ("late_end_m", "f8"),
    ]
)
"""Sensor and drives behind the value seam."""

TRUTH = np.dtype(
    [
        ("t_s", "f8"),
        ("macro_position_m", "f8"),
        ("end_position_m", "f8"),
        ("end_mean_m", "f8"),  # averaged since the sample before
        ("contact_force_n", "f8"),
    ]
)
"""What was true at a sample."""

_SAME_INSTANT_S = 1e-9
_INTERPOLATION_COUNT = 65536.0  # parts of a count: 16 bits of phase, the uMD2's

_BATCH = '''
@compiled
def run(setpoints, noise_m, late, instants_s, devices, state, parameters, machine_effects, measurement, setpoint,
        later, command, e, model, ahead, after, l, g, b, q, p, measurements, commands, truth, backlashes):
    """Run a cycle a setpoint, or until a stop; returns the number of cycles done."""
    d = devices[0]
    s = state[0]
    m = measurement[0]
    c = command[0]
    for k in range(setpoints.size):
        t_s, latch_s = instants_s[k, 0], instants_s[k, 1]
        plant_module.advance(state, parameters, machine_effects, t_s, d.longest_substep_s, d.macro_a, d.micro_a, 1, 1)
        macro_error_m, end_error_m = plant_module.sense(state, parameters, machine_effects, t_s - d.sampled_s)
        d.sampled_s = t_s
        truth[k].t_s = t_s
        truth[k].end_mean_m = s.end_position_m - d.end_origin_m - d.end_zero_m
        if t_s > d.mean_from_s:
            area_m_s = s.end_position_integral_m_s - d.mean_from_m_s
            truth[k].end_mean_m = area_m_s / (t_s - d.mean_from_s) - d.end_origin_m - d.end_zero_m
        d.mean_from_s = t_s
        d.mean_from_m_s = s.end_position_integral_m_s
        truth[k].macro_position_m = s.macro_position_m - d.macro_origin_m - d.macro_zero_m
        truth[k].end_position_m = s.end_position_m - d.end_origin_m - d.end_zero_m
        truth[k].contact_force_n = s.contact_force_n
        m.cycle = int(d.sample)
        m.t_ns = int(latch_s * 1e9)
        m.lease_left_ns = 1000000000
        m.latched_after_s = d.latched_after_s
        macro_m = s.macro_position_m + macro_error_m + noise_m[k, 0] - d.macro_origin_m
        end_m = s.end_position_m + end_error_m + noise_m[k, 1] - d.end_origin_m
        macro_step_m = d.macro_resolution_m
        if abs(s.macro_velocity_m_per_s) <= d.interpolation_speed_m_per_s:
            macro_step_m /= d.interpolation_count
        end_step_m = d.end_resolution_m
        if abs(s.end_velocity_m_per_s) <= d.interpolation_speed_m_per_s:
            end_step_m /= d.interpolation_count
        macro_m = np.floor(macro_m / macro_step_m + 0.5) * macro_step_m * d.reading_ratio - d.macro_zero_m
        end_m = np.floor(end_m / end_step_m + 0.5) * end_step_m * d.reading_ratio - d.end_zero_m
        m.samples_new = 0
        m.earlier_sequence = -1
        if d.late_sample >= 0.0:  # the line of the sample before is here by now
            m.sequence = int(d.late_sample)
            m.sample_t_ns = int(d.late_t_s * 1e9)
            m.samples_new += 1
            m.macro_position_m = d.late_macro_m
            m.end_position_m = d.late_end_m
        d.late_sample = -1.0
        if late[k]:
            d.late_sample = d.sample
            d.late_t_s = t_s
            d.late_macro_m = macro_m
            d.late_end_m = end_m
        else:
            m.sequence = m.cycle
            m.sample_t_ns = int(t_s * 1e9)
            m.samples_new += 1
            if m.samples_new > 1:
                m.earlier_sequence = m.cycle - 1
                m.macro_earlier_m = m.macro_position_m
                m.end_earlier_m = m.end_position_m
            m.macro_position_m = macro_m
            m.end_position_m = end_m
        setpoint[0] = setpoints[k]
        tick.tick(measurement, setpoint, later, command, e, model, ahead, after, l, g, b, q, p)
        measurements[k] = measurement[0]
        commands[k] = command[0]
        backlashes[k, 0] = b[0].left_m
        backlashes[k, 1] = b[0].right_m
        backlashes[k, 2] = b[0].left_stiffness_n_per_m
        backlashes[k, 3] = b[0].right_stiffness_n_per_m
        plant_module.advance(state, parameters, machine_effects, latch_s, d.longest_substep_s,
                             d.macro_a, d.micro_a, 1, 1)
        d.latched_after_s = latch_s - t_s
        d.macro_a = c.macro_word * d.macro_amperes_per_word
        d.micro_a = c.micro_word * d.micro_amperes_per_word
        d.sample += 1.0
        plant_module.advance(state, parameters, machine_effects, instants_s[k + 1, 0], d.longest_substep_s,
                             d.macro_a, d.micro_a, 1, 1)
        if c.stop != 0:
            return k + 1
    return setpoints.size
'''


@dataclass(slots=True)
class Simulation:
    """A machine and a controller behind the value seam; `run` goes on from where it stands."""

    module: ModuleType
    controller: Controller
    state: np.ndarray
    parameters: np.ndarray
    effects: np.ndarray
    devices: np.ndarray
    noise: np.random.Generator
    noise_m: float


@dataclass(frozen=True, slots=True)
class Recording:
    """What a run behind the value seam left: one row a cycle."""

    measurements: np.ndarray
    commands: np.ndarray
    setpoints: np.ndarray
    truth: np.ndarray
    backlash: np.ndarray


def simulation(controller: Controller, machine: Any, *, latch_delay_s: float, seed: int) -> Simulation:
    """Put a controller in front of a machine (attributes named as in a machine file)."""
    if controller.estimator["position_mode"][0] != 0.0:
        raise RequestError("macro.mode = 'position': the value seam has no drive that closes the loop; use the rig")
    machine_effects = [dict(row) for row in machine.effects]
    plant_module = compose.plant_module(machine_effects)
    source = (
        '"""Generated: one machine under one tick, behind the value seam."""\nimport numpy as np\n\n'
        f"import {controller.module.__name__} as tick\nimport {plant_module.__name__} as plant_module\n"
        "from stagectl.compiled import compiled\n" + _BATCH
    )
    devices = np.zeros(1, DEVICES)
    devices["period_s"] = float(controller.estimator["period_s"][0]) / (1.0 + machine.interferometer.clock_ppm * 1e-6)
    devices["latch_delay_s"] = latch_delay_s
    sensor = machine.interferometer
    # A count in vacuum: what the index of air takes from it (3e-4) matters to bytes, not to a resolution.
    count_m = machine.air.wavelength_vacuum_m / sensor.counts_per_wavelength
    devices["macro_resolution_m"] = devices["end_resolution_m"] = count_m
    devices["reading_ratio"] = 1.0
    devices["interpolation_speed_m_per_s"] = -1.0
    devices["interpolation_count"] = 1.0
    if sensor.interpolation_speed_m_per_s is not None:
        devices["interpolation_speed_m_per_s"] = sensor.interpolation_speed_m_per_s
        devices["interpolation_count"] = _INTERPOLATION_COUNT
    devices["macro_amperes_per_word"] = 1e-3 * machine.macro.rated_current_a
    if machine.micro is not None:
        devices["micro_amperes_per_word"] = 1e-3 * machine.micro.rated_current_a
    devices["longest_substep_s"] = 50e-6
    devices["late_sample"] = -1.0
    return Simulation(
        module=compose.generated_module("batch", source),
        controller=controller,
        state=plant.init(machine),
        parameters=plant.parameters(machine, seed),
        effects=compose.effect_parameters(machine_effects),
        devices=devices,
        noise=np.random.default_rng([seed, 1]),
        noise_m=machine.interferometer.noise_m,
    )


def instants(simulation: Simulation, count: int) -> np.ndarray:
    """Return the instants of the next `count` + 1 samples and of the SYNCs behind them, s, shape (count + 1, 2)."""
    devices = simulation.devices
    period_s, latch_delay_s = (float(devices[name][0]) for name in ("period_s", "latch_delay_s"))
    sample_s = (float(devices["sample"][0]) + np.arange(count + 1)) * period_s
    # A cycle by the host's clock is longer than one by the interferometer's, 20 ppm on the rig.
    return np.column_stack([sample_s, sample_s + min(latch_delay_s, period_s)])


def run(
    simulation: Simulation,
    setpoints: np.ndarray,
    late: np.ndarray | None = None,
    instants_s: np.ndarray | None = None,
) -> Recording:
    """Run a cycle a setpoint (SETPOINT array) or until a stop, and return what was recorded.

    `late` (bool, one a cycle): where the sample's line comes after its cycle began, so that the next cycle has it.
    `instants_s`: other instants than `instants`, where the jitter of a wire is to be felt. RequestError where they are
    not in order, sample, SYNC, sample: a machine has no way back, and what is jittered backwards would not be felt.
    """
    count = setpoints.size
    if late is None:
        late = np.zeros(count, np.bool_)
    if instants_s is None:
        instants_s = instants(simulation, count)
    _refuse_disorder(instants_s[: count + 1])
    noise_m = simulation.noise.standard_normal((count, 2)) * simulation.noise_m
    measurements = np.zeros(count, MEASUREMENT)
    commands = np.zeros(count, COMMAND)
    truth = np.zeros(count, TRUTH)
    estimates = np.zeros((count, 4))
    c = simulation.controller
    done = simulation.module.run(
        setpoints, noise_m, late, instants_s, simulation.devices, simulation.state, simulation.parameters,
        simulation.effects, c.measurement, c.setpoint, c.later, c.command, c.estimator, c.model, c.ahead, c.after,
        c.law, c.guard, c.backlash, c.belief, c.effects, measurements, commands, truth, estimates,
    )  # fmt: skip
    return Recording(measurements[:done], commands[:done], setpoints[:done], truth[:done], estimates[:done])


def _refuse_disorder(instants_s: np.ndarray) -> None:
    steps_s = np.diff(instants_s.ravel()[:-1])
    if not np.all(steps_s >= -_SAME_INSTANT_S):
        place = int(np.argmin(steps_s))
        what = "its SYNC before its sample" if place % 2 == 0 else "the next sample before its SYNC"
        raise RequestError(
            f"cycle {place // 2}: {what}, by {-1e6 * steps_s[place]:.3g} us; "
            "let SYNCs come earlier or samples jitter less"
        )
