"""From the commanded current to the motor's force: dead band, lag and delay of the command, the force constant.

Command effects add amperes to what the drive is told; actuator effects add newtons to what its current should make.
"""

import numpy as np

from stagectl.effects.declaration import Trait, effect

_ACTUATORS = ("macro_actuator", "micro_actuator")
_COMMANDS = ("macro_command", "micro_command")
_CHANGES_COUNT = 8  # of the command that are on their way at once


@effect(
    places=_ACTUATORS,
    error_ratio=(-0.2, 0.2),
    linear=("error_ratio",),
    traits=(Trait.KNOWN_PARAMETER,),
    symptom="proportional to the motor's force",
    reference="Kang et al. 2023, (4), K_m",
)
def force_constant_error(motor_force_n, error_ratio):
    """Force constant that differs from its nominal value: F = epsilon F_nominal."""
    return error_ratio * motor_force_n


@effect(
    places=_ACTUATORS,
    saturation_n=(1.0, 1e6),
    searched=("saturation_n",),
    shown_by="acceleration",
    symptom="odd in the motor's force, with its cube: the force constant falls where the current is large",
    reference="Gieras, Piech, Zhou, Linear Synchronous Motors, section 3.6: iron that saturates, alike for both signs",
)
def force_constant_saturation(motor_force_n, saturation_n):
    """Force constant that falls with the square of the force: in all F - F^3 / (3 F_s^2), and 2 F_s / 3 beyond F_s.

    The first term that symmetry leaves: a curve such as F_s tanh(F / F_s) begins with it. At F_s more current brings no
    more force.
    """
    held_n = np.minimum(np.maximum(motor_force_n, -saturation_n), saturation_n)
    ratio = held_n / saturation_n
    return held_n * (1.0 - ratio * ratio / 3.0) - motor_force_n


@effect(
    places=_COMMANDS,
    half_width_a=(0.0, 10.0),
    searched=("half_width_a",),
    symptom="no force for small commands, and a constant part missing of larger ones",
    reference="Slotine, Li, Applied Nonlinear Control, section 5.2: dead zone; amplifiers without bias current",
)
def amplifier_dead_band(command_a, half_width_a):
    """Dead band: 0 for |i| < d, i - d sgn i beyond, so -i is added, held within +-d."""
    return -np.minimum(np.maximum(command_a, -half_width_a), half_width_a)


@effect(
    places=_COMMANDS,
    memory=1,
    time_constant_s=(1e-6, 0.02),
    searched=("time_constant_s",),
    shown_by="acceleration",
    symptom="proportional to the change of the command; fades with the time constant of the whole loop",
    reference="Franklin, Powell, Workman, Digital Control of Dynamic Systems, section 4.3: first-order lag, held input",
)
def current_loop_lag(command_a, current_loop_s, dt_s, time_constant_s, memory):
    """Current loop that is slower than stated, of one lag: T + tau in place of T.

    y' = (i - y) / (T + tau), and tau / (T + tau) (y - i) is added before the stated loop, T. memory: y. The drive's
    command is held over a step, so the step is exact; what is added is its mean. Two lags in a row would be another
    machine: of one loop of 0.65 ms they left 73 squares of 4100, which a flexible mode then explained.
    """
    whole_s = current_loop_s + time_constant_s
    apart = memory[0] - command_a
    if not dt_s > 0.0:
        return apart * time_constant_s / whole_s
    left = np.exp(-dt_s / whole_s)
    memory[0] = command_a + apart * left
    return apart * (1.0 - left) * time_constant_s / dt_s


@effect(
    places=_COMMANDS,
    memory=2 + 2 * _CHANGES_COUNT,
    delay_s=(0.0, 0.005),
    searched=("delay_s",),
    shown_by="acceleration",
    symptom="the command's change, times the delay; the same for slow and for fast commands",
    reference="Astrom, Wittenmark, Computer-Controlled Systems, section 2.3: dead time with a held input",
)
def command_delay(command_a, t_s, dt_s, delay_s, memory):
    """Dead time of the drive: i(t - T), and i(t - T) - i is added.

    memory: the command at t - T; how many changes are on their way; (instant, command) of each. What is added is the
    mean over the step, exact for held commands. More than 8 changes within T: the newest takes over the last one's
    instant.
    """
    count = int(memory[1])
    if dt_s > 0.0 and command_a != (memory[0] if count == 0 else memory[1 + 2 * count]):
        if count < _CHANGES_COUNT:
            memory[2 + 2 * count] = t_s
            count += 1
        memory[1 + 2 * count] = command_a
    at_s = t_s - delay_s
    end_s = at_s + dt_s
    value = memory[0]
    area = 0.0
    passed = 0
    while passed < count and memory[2 + 2 * passed] <= end_s:
        change_s = max(memory[2 + 2 * passed], at_s)
        area += value * (change_s - at_s)
        at_s = change_s
        value = memory[3 + 2 * passed]
        passed += 1
    if not dt_s > 0.0:
        return value - command_a
    area += value * (end_s - at_s)
    memory[0] = value
    memory[1] = count - passed
    for k in range(2 * (count - passed)):
        memory[2 + k] = memory[2 + k + 2 * passed]
    return area / dt_s - command_a
