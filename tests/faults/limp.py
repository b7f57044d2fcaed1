"""How far a micro goes that has lost its power, its winding shorted, beside a macro that moves as it truly did.

    m x'' = -k x - b x' + K i + contact + stops - m x_macro'',   L i' = -R i - K x'

with x the relative position. The rig's numbers, and nothing of its code.
"""

from typing import Any

import numpy as np

from sim_backend.machine import Machine

_STEPS_COUNT = 20  # of a sample: 50 us


def shorted_way_m(machine: Machine, seen: dict[str, Any], at: int, end: int, *, shorted: bool = True) -> float:
    """Return the greatest relative position from sample `at` to `end`; not `shorted`: of a micro that coasts."""
    micro, joint = machine.micro, machine.backlash
    contact_damping = sum(row["damping_n_s_per_m"] for row in machine.effects if row["name"] == "contact_damping")
    low_m, high_m = micro.stroke_m
    t_s = 1e-9 * (seen["t_ns"][at:end] - seen["t_ns"][at])
    pulls = np.diff(seen["macro_velocity_m_per_s"][at:end]) / np.diff(t_s)
    x = float(seen["end_position_m"][at] - seen["macro_position_m"][at])
    v = float(seen["end_velocity_m_per_s"][at] - seen["macro_velocity_m_per_s"][at])
    current_a = float(seen["micro_force_n"][at]) / micro.force_constant_n_per_a if shorted else 0.0
    furthest_m = abs(x)
    for span_s, pull in zip(np.diff(t_s).tolist(), pulls.tolist(), strict=True):
        dt_s = span_s / _STEPS_COUNT
        for _ in range(_STEPS_COUNT):
            force_n = -micro.spring_n_per_m * x - micro.damping_n_s_per_m * v
            if shorted:
                force_n += micro.force_constant_n_per_a * current_a
                drop_v = micro.resistance_ohm * current_a + micro.back_emf_v_s_per_m * v
                current_a -= dt_s * drop_v / micro.inductance_h
            if x > joint.left_m:  # the joint's sides are counted on macro minus end
                force_n -= joint.left_stiffness_n_per_m * (x - joint.left_m) + contact_damping * v
            elif x < -joint.right_m:
                force_n -= joint.right_stiffness_n_per_m * (x + joint.right_m) + contact_damping * v
            if x > high_m:
                force_n -= micro.stop_stiffness_n_per_m * (x - high_m) + micro.stop_damping_n_s_per_m * v
            elif x < low_m:
                force_n -= micro.stop_stiffness_n_per_m * (x - low_m) + micro.stop_damping_n_s_per_m * v
            v += dt_s * (force_n / micro.mass_kg - pull)
            x += dt_s * v
            furthest_m = max(furthest_m, abs(x))
    return furthest_m
