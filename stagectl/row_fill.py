"""Copy what a tick knew and decided into its row, compiled: eighty fields in one call (field by field: 12 us).

Pure; knows no memory and no clock.
"""

from stagectl import compose
from stagectl.signals import COMMAND, MEASUREMENT, SETPOINT

_ESTIMATES = {
    "macro_position_estimate_m": "s.macro_position_m",
    "macro_velocity_estimate_m_per_s": "s.macro_velocity_m_per_s",
    "end_position_estimate_m": "s.end_position_m",
    "end_velocity_estimate_m_per_s": "s.end_velocity_m_per_s",
    "macro_disturbance_n": "s.macro_disturbance_n",
    "micro_disturbance_n": "s.micro_disturbance_n",
    "contact_force_estimate_n": "s.contact_force_n",
    "sliding_variable_m_per_s": "l.sliding_variable_m_per_s",
    "adaptive_gain_ratio": "l.adaptive_gain_ratio",
    "backlash_left_m": "b.left_m",
    "backlash_right_m": "b.right_m",
    "backlash_left_stiffness_n_per_m": "b.left_stiffness_n_per_m",
    "backlash_right_stiffness_n_per_m": "b.right_stiffness_n_per_m",
    "backlash_left_sd_m": "b.left_sd_m",
    "backlash_right_sd_m": "b.right_sd_m",
    "backlash_left_stiffness_sd_n_per_m": "b.left_stiffness_sd_n_per_m",
    "backlash_right_stiffness_sd_n_per_m": "b.right_stiffness_sd_n_per_m",
}


def _source() -> str:
    """Write the copies out, one line a field: compiled code can't loop over names."""
    lines = [
        '"""Generated: the copies of a row."""',
        "from stagectl.compiled import compiled",
        "",
        "",
        "@compiled",
        "def fill_row(row, measurement, setpoint, command, model, law, backlash):",
        "    r = row[0]",
        "    m = measurement[0]",
        "    t = setpoint[0]",
        "    c = command[0]",
        "    s = model[0]",
        "    l = law[0]",
        "    b = backlash[0]",
    ]
    lines += [f"    r.{name} = m.{name}" for name in MEASUREMENT.names or ()]
    lines += [f"    r.setpoint_{name} = t.{name}" for name in SETPOINT.names or ()]
    lines += [f"    r.{name} = c.{name}" for name in COMMAND.names or ()]
    lines += [f"    r.{name} = {value}" for name, value in _ESTIMATES.items()]
    return "\n".join(lines) + "\n"


fill_row = compose.generated_module("row", _source()).fill_row
"""fill_row(row, measurement, setpoint, command, model, law, backlash): all one-element arrays."""
