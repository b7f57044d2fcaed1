"""A motion that is only planned, as the log that it would leave on a machine that is exactly what is believed. Pure."""

from dataclasses import replace

import numpy as np

from stagectl.gap import balance
from stagectl.gap.believed import Believed, BelievedAxis
from stagectl.gap.effect_forces import known_forces
from stagectl.gap.forces import Forces
from stagectl.gap.log import Log
from stagectl.gap.recording import REACTION
from stagectl.trajectory import Trajectory


def planned_log(planned: Trajectory, believed: Believed) -> Log:
    """Return positions as planned, and the commands that this takes: mass times acceleration less what else acts."""
    rows = planned.setpoints
    end_m = rows["position_m"].astype(float)
    zeros = np.zeros(end_m.size)
    valid = np.ones(end_m.size, bool)
    joint = believed.joint
    acceleration = _means(rows["acceleration_m_per_s2"])
    if believed.micro is None or joint is None:
        still = Log(planned.name, planned.dt_s, end_m, zeros, valid, "planned", reference_m=end_m)
        macro_n = believed.macro.mass_kg * acceleration - _others(still, believed).macro_n
        return _with_commands(still, believed, macro_n, None)
    macro_m = end_m - rows["relative_position_m"] + 0.5 * (joint.right_m - joint.left_m)
    still = Log(
        planned.name, planned.dt_s, macro_m, zeros, valid, "planned",
        end_position_m=end_m, micro_command_n=zeros, reference_m=end_m,
    )  # fmt: skip
    others = _others(still, believed)
    micro_n = believed.micro.mass_kg * acceleration - others.end_n
    reaction = sum(row["fraction_ratio"] for row in believed.effects if row["name"] == REACTION)
    macro_acceleration = acceleration - _means(rows["relative_acceleration_m_per_s2"])
    macro_n = believed.macro.mass_kg * macro_acceleration - others.macro_n + reaction * micro_n
    return _with_commands(still, believed, macro_n, micro_n)


def _means(values: np.ndarray) -> np.ndarray:
    """Bring values at samples to means over the intervals that begin there."""
    following = np.append(values[1:], values[-1:])
    return 0.5 * (values + following)


class _Others:
    """What acts without the motors, means over sample intervals, shape (n,)."""

    def __init__(self, forces: Forces, size: int):
        self.macro_n = np.zeros(size) if forces.macro_n is None else forces.macro_n.mean(axis=1)
        self.end_n = np.zeros(size) if forces.end_n is None else forces.end_n.mean(axis=1)


def _others(still: Log, believed: Believed) -> _Others:
    """Evaluate what is believed along a log without commands; effects of a motor are nothing there."""
    return _Others(known_forces(balance.recording_of(still, believed)), still.samples_count)


def _with_commands(still: Log, believed: Believed, macro_n: np.ndarray, micro_n: np.ndarray | None) -> Log:
    """Ask for each force as much earlier as it takes to come: a command acts in the interval behind its latch."""

    def asked(force_n: np.ndarray, axis: BelievedAxis) -> np.ndarray:
        return np.interp(still.times_s + axis.latch_s + axis.current_loop_s, still.times_s, force_n)

    micro_command_n = None
    if micro_n is not None and believed.micro is not None:
        micro_command_n = asked(micro_n, believed.micro)
    return replace(still, macro_command_n=asked(macro_n, believed.macro), micro_command_n=micro_command_n)
