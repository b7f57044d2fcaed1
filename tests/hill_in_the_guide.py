"""A law of a user's own, an axis that has it, and what is recorded there."""

import numpy as np

from stagectl.gap.log import Log

HILL = (
    "import numpy as np\nfrom stagectl.effects import effect\n\n\n"
    '@effect(places=("macro_force",), force_n=(-100.0, 100.0), width_m=(1e-3, 9e-3), linear=("force_n",), '
    'symptom="a hill at zero", reference="this test")\n'
    "def scratch_in_the_guide(position_m, force_n, width_m):\n"
    '    """A hill in the guide: F = A exp(-(x / w)^2)."""\n'
    "    ratio = position_m / width_m\n    return force_n * np.exp(-ratio * ratio)\n"
)
HILL_AXIS = """name = "axis"
effect_files = ["hill.py"]
[cycle]
rate_hz = 1000.0
latch_s = 0.0
[macro]
mass_kg = 40.2
mass_sd_kg = 0.4
travel_m = 0.1
[sensor]
noise_m = 5e-9
[[effects]]
name = "viscous_friction"
acts_on = "macro_force"
damping_n_s_per_m = 33.0
"""


def hill_log(name: str, seed: int, samples_count: int = 8000) -> Log:
    """An axis of 40 kg that runs over a hill of 3 N, 5 mm wide, under a controller of its own; semi-implicit."""
    random = np.random.default_rng(seed)
    h, count, parts = 1e-3, samples_count, 10
    t = np.arange(count) * h
    reference = 0.02 * np.sin(2.0 * np.pi * (0.4 + 0.1 * seed) * t) + 0.004 * np.sin(2.0 * np.pi * 2.3 * t + seed)
    speed = np.gradient(reference, h)
    x, v, seen, command = reference[0], speed[0], np.zeros(count), np.zeros(count)
    slow, decay = 0.0, np.exp(-2.0 * np.pi * h)
    for k in range(count):
        slow = decay * slow + 0.05 * np.sqrt(1.0 - decay * decay) * random.standard_normal()
        seen[k] = x + 5e-9 * random.standard_normal()
        command[k] = 4.0e4 * (reference[k] - seen[k]) + 2.5e3 * (speed[k] - v)
        for _ in range(parts):
            v += (command[k] + 3.0 * np.exp(-((x / 5e-3) ** 2)) - 30.0 * v + slow) / 40.0 * h / parts
            x += v * h / parts
    return Log(name, h, seen, command, np.ones(count, bool), "1", reference_m=reference)
