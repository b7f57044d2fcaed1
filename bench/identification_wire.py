"""Intervals of an identification over the wire: whether what it says of its own error is true there as well.

Lines come late, SYNC ends when its frames let it, the loop is closed, homing has laid the zeros: none of it is in the
covariance. Masses and force constants are exactly what the profile believes.
"""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from bench import identifying, variants
from bench.figure import Bar, Figure, judged
from sim_backend.machine import load_machine
from stagectl.profile import load_profile

COVERED = Bar("identification over the wire, 100 nm: 95 % intervals that hold the truth, of edges and stiffness", "%")
PULL = Bar("the same: error over its stated standard deviation, rms", "1")
WORST = Bar("the same: worst error over its stated standard deviation", "1")
EDGE = Bar("the same: worst edge", "um", 0.5)

_STAGE = "oled-printer"
_NOISE_M = 100e-9
_FREQUENCY_HZ = 1.0
_DURATION_S = 20.0
_TICK_S = 60e-6
_SEEDS = range(1, 5)
_FULL_SEEDS = range(1, 25)
_NORMAL_95 = 1.96

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row; with `full` on as many seeds as a share of intervals takes."""
    seeds = list(_FULL_SEEDS if full else _SEEDS)
    profile = variants.with_noise(load_profile(_STAGE), _NOISE_M)
    machine = variants.believed(variants.with_noise(load_machine(_STAGE), _NOISE_M), profile)
    found = []
    with tempfile.TemporaryDirectory(prefix="stagectl-bench-") as name:
        for seed in seeds:
            say(f"identification over the wire, seed {seed}")
            folder = Path(name) / f"{seed}"
            found.append(identifying.identify(profile, machine, seed, _FREQUENCY_HZ, _DURATION_S, folder, _TICK_S))
    pulls = np.abs([one.pulls for one in found])
    remark = f"sweeps at {_FREQUENCY_HZ:g} Hz, {_DURATION_S:g} s, masses exact; edges and stiffness of both sides"
    yield judged(COVERED, 100.0 * float(np.mean(pulls <= _NORMAL_95)), seeds, remark)
    yield judged(PULL, float(np.sqrt(np.mean(pulls**2))), seeds)
    yield judged(WORST, float(np.max(pulls)), seeds)
    yield judged(EDGE, 1e6 * max(one.edge_m for one in found), seeds)
