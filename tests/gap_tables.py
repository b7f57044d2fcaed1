"""Tables as somebody would bring them to `stagectl gap`: made here, by inverse dynamics, without the project's code."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv

H = 1e-3
MASS_KG = 40.0
NOISE_M = 5e-9

PROFILE = """
name = "table-axis"
[cycle]
rate_hz = 1000.0
latch_s = 0.0
[macro]
mass_kg = {mass_kg}
mass_sd_kg = 0.4
travel_m = 1.0
[sensor]
noise_m = 5e-9
[loop]
law = "cascade"
position_gain_per_s = 10.0
velocity_gain_n_s_per_m = 1000.0
limit_n = 100.0
"""

JOINT_CENTRE_M = 75.3e-6
"""Macro minus end in the middle of the gap of the oled-printer profile."""


def profile_file(folder: Path, mass_kg: float = MASS_KG * 1.005) -> Path:
    """Write what is believed of the axis."""
    path = folder / f"axis-{mass_kg:g}.toml"
    path.write_text(PROFILE.format(mass_kg=mass_kg))
    return path


def axis_table(seed: int, count: int = 8000, friction_n: float = 0.0, amplitude_m: float = 0.02) -> dict:
    """One mass on a motion of three sines, its command held for a millisecond; columns by name, shape (count,).

    Within an interval force and acceleration are constant, so positions are exact.
    """
    random = np.random.default_rng(seed)
    t = np.arange(count) * H
    wanted = np.zeros(count)
    for hertz, share in ((0.4 + 0.1 * seed, 1.0), (1.3, 0.2), (3.1, 0.03)):
        phase = random.uniform(0.0, 2.0 * np.pi)
        wanted -= share * amplitude_m * (2.0 * np.pi * hertz) ** 2 * np.sin(2.0 * np.pi * hertz * t + phase)
    wanted -= wanted.mean()
    velocity = np.concatenate([[0.0], np.cumsum(wanted * H)])[:-1]
    wanted -= np.gradient(np.polyval(np.polyfit(t, velocity, 1), t), H)
    velocity = np.concatenate([[0.0], np.cumsum(wanted * H)])[:-1]
    start = -velocity.mean()
    velocity += start
    reference = np.concatenate([[0.0], np.cumsum(velocity * H + 0.5 * wanted * H * H)])[:-1]
    slow, decay = np.zeros(count), np.exp(-2.0 * np.pi * H)
    for k in range(1, count):
        slow[k] = decay * slow[k - 1] + 0.05 * np.sqrt(1.0 - decay * decay) * random.standard_normal()
    command = MASS_KG * wanted + friction_n * np.sign(velocity + 0.5 * wanted * H) + slow
    return {
        "t_s": t,
        "reference": reference,
        "position": reference + NOISE_M * random.standard_normal(count),
        "command": command,
    }


def stage_table(seed: int, count: int = 8000, end_kg: float = 40.0) -> dict:
    """A macro-micro stage of the oled-printer profile that stays off its edges; columns by name, shape (count,)."""
    random = np.random.default_rng(seed)
    t = np.arange(count) * H

    def sines(*parts):
        x, v, a = np.zeros(count), np.zeros(count), np.zeros(count)
        for hertz, size in parts:
            w, phase = 2.0 * np.pi * hertz, random.uniform(0.0, 2.0 * np.pi)
            x += size * np.sin(w * t + phase)
            v += size * w * np.cos(w * t + phase)
            a -= size * w * w * np.sin(w * t + phase)
        return x, v, a

    x, v, a = sines((0.5, 0.02), (1.7, 0.002))
    apart, apart_rate, _ = sines((1.1, 20e-6), (2.3, 10e-6))
    relative = -JOINT_CENTRE_M + apart  # end minus macro
    joint = -500.0 * relative - 5.0 * apart_rate  # on the end
    micro = end_kg * a - joint  # the end's acceleration is the macro's but for 5 mm/s2
    return {
        "t_s": t,
        "macro": x - relative + NOISE_M * random.standard_normal(count),
        "end": x + NOISE_M * random.standard_normal(count),
        "macro_force": 70.0 * a + joint + micro + 5.0 * v,
        "micro_force": micro,
    }


AXIS_MAP = {
    "t_ns": "t_s:s",
    "setpoint_position_m": "reference:m",
    "macro_position_m": "position:m",
    "macro_force_n": "command:N",
}
STAGE_MAP = {
    "t_ns": "t_s:s",
    "macro_position_m": "macro:m",
    "end_position_m": "end:m",
    "macro_force_n": "macro_force:N",
    "micro_force_n": "micro_force:N",
}


def write_csv(table: dict, path: Path) -> Path:
    """Write a table with all its digits; nan is an empty cell."""
    csv.write_csv(pa.table({name: pa.array(values, from_pandas=True) for name, values in table.items()}), path)
    return path
