"""Intervals of an identification in closed loop at 100 nm: whether what it says of its own error is true there as well.

The loop turns the sensors' noise into motion, and lines come late: neither is in the covariance. Behind the value
seam two hundred seeds take a minute. Over the wire, where SYNC ends when its frames let it and homing has laid the
zeros, a seed takes ten seconds. Masses and force constants are exactly what the profile believes.
"""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench import identifying, variants
from bench.figure import Bar, Figure, judged
from sim_backend.machine import Machine, load_machine
from stagectl import backlash, batch, tick, touch_sweep
from stagectl.laws.reference import gap_centre
from stagectl.profile import Profile, load_profile
from stagectl.signals import SETPOINT, Stop

SEAM_COVERED = Bar(
    "identification in closed loop, 100 nm, 8 % late lines: 95 % intervals that hold the truth", "%", 90.0, True
)
SEAM_PULL = Bar("the same: error over its stated standard deviation, rms", "1")
SEAM_MASS = Bar("the same: error of the mass over its stated standard deviation, mean", "1")
COVERED = Bar(
    "identification over the wire, 100 nm: 95 % intervals that hold the truth, of edges and stiffness", "%", 90.0, True
)
PULL = Bar("the same: error over its stated standard deviation, rms", "1")
WORST = Bar("the same: worst error over its stated standard deviation", "1")
EDGE = Bar("the same: worst edge", "um", 0.5)

_STAGE = "oled-printer"
_NOISE_M = 100e-9
_FREQUENCY_HZ = 1.0
_SHARE = 0.8
_DURATION_S = 20.0
_TICK_S = 60e-6
_LATE_RATIO = 0.083  # of the lines of a wire with 60 us of jitter
_SEAM_SEEDS = range(201, 401)  # the filter was chosen on 1 to 200
_SEEDS = range(101, 105)
_FULL_SEEDS = range(101, 125)
_NORMAL_95 = 1.96

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row; with `full` over the wire on as many seeds as a share of intervals takes."""
    profile = variants.with_noise(load_profile(_STAGE), _NOISE_M)
    machine = variants.believed(variants.with_noise(load_machine(_STAGE), _NOISE_M), profile)
    say(f"identification in closed loop, {len(_SEAM_SEEDS)} seeds")
    yield from _behind_the_value_seam(profile, machine)
    seeds = list(_FULL_SEEDS if full else _SEEDS)
    found = []
    with tempfile.TemporaryDirectory(prefix="stagectl-bench-") as name:
        for seed in seeds:
            say(f"identification over the wire, seed {seed}")
            folder = Path(name) / f"{seed}"
            found.append(identifying.identify(profile, machine, seed, _FREQUENCY_HZ, _DURATION_S, folder, _TICK_S))
    pulls = np.abs([one.pulls for one in found])
    remark = (
        f"sweeps at {_FREQUENCY_HZ:g} Hz, {_DURATION_S:g} s, masses exact; edges and stiffness of both sides, "
        "which err together: the share of 24 seeds is known to some 4 %"
    )
    # What four seeds hold is luck: judged is the long run.
    bar = COVERED if full else replace(COVERED, limit=None)
    yield judged(bar, 100.0 * float(np.mean(pulls <= _NORMAL_95)), seeds, remark)
    yield judged(PULL, float(np.sqrt(np.mean(pulls**2))), seeds)
    yield judged(WORST, float(np.max(pulls)), seeds)
    yield judged(EDGE, 1e6 * max(one.edge_m for one in found), seeds)


def _behind_the_value_seam(profile: Profile, machine: Machine) -> Iterator[Figure]:
    seeds = list(_SEAM_SEEDS)
    pulls = np.array([_pulls(profile, machine, seed) for seed in seeds])
    share = 100.0 * np.mean(np.abs(pulls[:, :4]) <= _NORMAL_95, axis=0)
    remark = f"least of four, {', '.join(f'{one:.0f}' for one in share)} %; sweeps as over the wire"
    yield judged(SEAM_COVERED, float(np.min(share)), seeds, remark)
    yield judged(SEAM_PULL, float(np.sqrt(np.mean(pulls[:, :4] ** 2))), seeds)
    said = "a part of the noise that the loop turned into motion is left in it"
    yield judged(SEAM_MASS, float(np.mean(pulls[:, 4])), seeds, said)


def _pulls(profile: Profile, machine: Machine, seed: int) -> tuple[float, ...]:
    """Sweep over both edges; returns the errors of edges, stiffnesses and mass over their stated deviations."""
    joint = machine.backlash
    if joint is None:
        raise RuntimeError(f"{_STAGE}: no joint in the machine")
    setpoints = touch_sweep.planned(profile, _SHARE, _FREQUENCY_HZ, _DURATION_S, _FREQUENCY_HZ).setpoints
    controller = tick.controller(profile, profile.control.law, has_drives=False)
    delay_s = profile.cycle.actuation_delay_s
    simulation = batch.simulation(controller, machine, latch_delay_s=delay_s, seed=seed)
    simulation.state["end_position_m"] = 0.0
    simulation.state["macro_position_m"] = float(gap_centre(controller.belief[0]))
    batch.run(simulation, np.zeros(round(profile.cycle.rate_hz), SETPOINT))
    controller.backlash[...] = backlash.init(profile)
    late = np.random.default_rng([seed, 2]).random(setpoints.size) < _LATE_RATIO
    recording = batch.run(simulation, setpoints, late)
    b = controller.backlash[0]
    if recording.commands["stop"][-1] != Stop.NONE or not np.isfinite(b["left_sd_m"] + b["right_sd_m"]):
        raise RuntimeError(f"seed {seed}: nothing was identified: this row would show nothing")
    names = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")
    sds = ("left_sd_m", "right_sd_m", "left_stiffness_sd_n_per_m", "right_stiffness_sd_n_per_m")
    edges = [float((b[name] - getattr(joint, name)) / b[sd]) for name, sd in zip(names, sds, strict=True)]
    return (*edges, float(b["mass_kg"] / b["mass_sd_kg"]))
