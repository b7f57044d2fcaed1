"""Identification at the limit: wrong masses, wear, soft contacts, one side alone, ordinary motion; and its cost.

Truth comes from `bench.joint_truth` and from the software machine behind the value seam. Seeds from 101 on: what was
tuned was tuned on others.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from bench.figure import Bar, Figure, judged
from bench.joint_truth import Joint, Motion, Rig, motion
from sim_backend.machine import load_machine
from stagectl import backlash, batch, tick, trajectory
from stagectl.paper import gated
from stagectl.paper.gated import Gated
from stagectl.profile import Profile, load_profile
from stagectl.regression import Doubts

MASS_WIDTH = Bar("identification, rig's joint, masses 1 % wrong: width", "%", 0.2)
MASS_CENTRE = Bar("the same: centre", "um", 0.1)
MASS_STIFFNESS = Bar("the same: stiffness", "%", 1.0)
MASS_COVERED = Bar("the same: 95 % intervals that hold the truth, least of four", "%", 90.0, True)
MASS_NAMED = Bar("the same: runs that miss the truth with an interval and don't name the mass", "runs", 0.0)
DRIFT_WIDTH = Bar("identification, rig's joint, 10 % of wear over 60 s: width, worst moment", "%", 0.5)
UNTOUCHED = Bar("identification, one side never touched: runs that give it a number", "runs", 0.0)
UNTOUCHED_OTHER = Bar("the same: edge of the other side", "um")
SOFT_WIDTH = Bar("identification, contact as in Fig. 17, 5 % hysteresis, 5 nm: width of the onsets", "%", 1.0)
SOFT_COVERED = Bar("the same: 95 % intervals of the edges that hold the truth", "%", 90.0, True)
SOFT_HARD = Bar("the same by the model of a hard contact", "%")
SOFT_NOISY = Bar("the same at 100 nm, 60 s", "%")
SOFT_NOISY_COVERED = Bar("the same at 100 nm, 60 s: intervals that hold the truth", "%", 90.0, True)
MOTION_WIDTH = Bar("identification in trapezoids under a weak macro of 6 Hz: width", "%", 1.0)
MOTION_MASS = Bar("the same: micro's mass to force constant", "%", 0.1)
MOTION_DAMPING = Bar("the same: contact damping", "%", 10.0)
MOTION_FREE = Bar("the same without contact: runs that give an edge a number", "runs", 0.0)
COST_ALL = Bar("identification, a step, compiled, everything doubted, knee and hysteresis", "us", 2.0)

MASS = Doubts(mass_kg=0.4)
"""1 % of the micro."""

SOFT = Doubts(knee_n_m=10e-6, hysteresis_n_per_m=5000.0)
"""A knee of up to 100 um, a hysteresis of up to half the stiffness."""

LOOSE = Doubts(
    mass_kg=0.4,
    spring_n_per_m=10.0,
    damping_n_s_per_m=1.0,
    end_spring_n_per_m=5.0,
    end_damping_n_s_per_m=1.0,
    force_n=1.0,
)
"""Of a stage in ordinary motion: masses and force constants by a per cent, a cable, an offset."""

EDGE_DRIFT_M_PER_SQRT_S = 1e-7
_END = (8780.0, 50.0)  # spring and damping of the end to the base
_SEEDS = range(101, 121)
_INTERVAL_SEEDS = range(101, 301)
_FEW_SEEDS = range(101, 106)
_NORMAL_95 = 1.96
_SETTLED_S = 1.0
_REPEATS = 5

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row; `full` changes nothing: the seeds are those of the bars."""
    say("wrong masses")
    yield from wrong_masses(_SEEDS, _INTERVAL_SEEDS)
    say("wear")
    yield wear(_SEEDS)
    say("one side alone")
    yield from one_side(_FEW_SEEDS)
    say("soft contacts")
    yield from soft_contacts(_SEEDS)
    say("ordinary motion")
    yield from ordinary_motion(_FEW_SEEDS)
    yield _cost_of_all()


def seen(moved: Motion, noise_m: float, seed: int, **beliefs) -> Gated:
    """Run the estimator over what noisy sensors see of a motion; `beliefs` as `gated.along` takes them."""
    noise = np.random.default_rng([seed, round(1e9 * noise_m)]).standard_normal((2, moved.macro_m.size)) * noise_m
    return gated.along(moved.macro_m + noise[0], moved.end_m + noise[1], *_END, noise_m=noise_m, **beliefs)


# ---- masses -------------------------------------------------------------------------------------------------------


def wrong_masses(seeds: range, interval_seeds: range) -> Iterator[Figure]:
    """Believe the micro's mass 1 % too light and too heavy, and doubt it by that much."""
    joint = Joint(damping_n_s_per_m=100.0)
    moved = motion(joint, Rig(), 20.0)
    widths, centres, stiffnesses = [], [], []
    for noise_m in (1e-9, 10e-9, 100e-9):
        for seed in seeds:
            for off in (-0.01, 0.01):
                one = seen(moved, noise_m, seed, mass_error_ratio=off, doubts=MASS)
                left_m, right_m, left, right = errors(one, joint)
                widths.append(100.0 * (left_m + right_m) / joint.width_m)
                centres.append(0.5e6 * (right_m - left_m))
                stiffnesses += [100.0 * left / joint.left_n_per_m, 100.0 * right / joint.right_n_per_m]
    remark = "20 s, 1-100 nm, contact damping; the mass is found from the gap and the blows"
    yield judged(MASS_WIDTH, float(np.max(np.abs(widths))), list(seeds), remark)
    yield judged(MASS_CENTRE, float(np.max(np.abs(centres))), list(seeds), remark)
    yield judged(MASS_STIFFNESS, float(np.max(np.abs(stiffnesses))), list(seeds), remark)
    held, unnamed = [], 0
    for seed in interval_seeds:
        off = 0.01 if seed % 2 else -0.01
        one = seen(moved, 100e-9, seed, mass_error_ratio=off, doubts=MASS)
        sds = (one.sd.left_m, one.sd.right_m, one.sd.left_stiffness_n_per_m, one.sd.right_stiffness_n_per_m)
        held.append(np.abs(errors(one, joint)) <= _NORMAL_95 * np.array(sds))
        named = abs(one.mass_kg) > 5.0 * one.mass_sd_kg and abs(one.mass_kg + 40.0 * off) < 4.0 * one.mass_sd_kg
        unnamed += not (named or np.all(held[-1]))
    yield judged(MASS_COVERED, 100.0 * float(np.min(np.mean(held, axis=0))), list(interval_seeds), "100 nm")
    yield judged(MASS_NAMED, float(unnamed), list(interval_seeds), "named: 5 sd from the believed, 4 from the true one")


def errors(one: Gated, joint: Joint) -> tuple[float, float, float, float]:
    """Return those of the edges, m, and of the stiffnesses, N/m: left, right, left, right."""
    return (
        *(one.last.left_m - joint.left_m, one.last.right_m - joint.right_m),
        one.last.left_stiffness_n_per_m - joint.left_n_per_m,
        one.last.right_stiffness_n_per_m - joint.right_n_per_m,
    )


# ---- wear ---------------------------------------------------------------------------------------------------------


def wear(seeds: range) -> Figure:
    """Widen the gap by a tenth within a minute: on both sides, on one, on the other."""
    rate = 0.1 * Joint().width_m / 60.0
    worst = 0.0
    for left, right in ((0.5, 0.5), (1.0, 0.0), (0.0, 1.0)):
        joint = Joint(damping_n_s_per_m=100.0, left_wear_m_per_s=left * rate, right_wear_m_per_s=right * rate)
        moved = motion(joint, Rig(), 60.0)
        for noise_m in (10e-9, 100e-9):
            for seed in seeds:
                one = seen(moved, noise_m, seed, edge_drift_m_per_sqrt_s=EDGE_DRIFT_M_PER_SQRT_S)
                error = 100.0 * np.abs((one.left_m + one.right_m) / (moved.left_m + moved.right_m) - 1.0)
                known = int(np.flatnonzero(np.isfinite(error))[0]) + round(1000 * _SETTLED_S)
                worst = max(worst, float(np.max(error[known:])))
    remark = f"10 and 100 nm; both sides, left, right; from {_SETTLED_S:g} s after both edges are known"
    return judged(DRIFT_WIDTH, worst, list(seeds), remark)


# ---- one side -----------------------------------------------------------------------------------------------------


def one_side(seeds: range) -> Iterator[Figure]:
    """Push to one side so hard that the other is never met, with exact and with doubted, wrong masses."""
    joint = Joint(damping_n_s_per_m=100.0)
    runs, worst_m = 0, 0.0
    for name, sign in (("right", 1.0), ("left", -1.0)):
        other = "left" if name == "right" else "right"
        moved = motion(joint, Rig(amplitude_n=3.0, offset_n=4.0 * sign), 20.0)
        if not np.all(sign * moved.contact_n >= 0.0):
            raise RuntimeError(f"the {other} side was touched: this row would show nothing")
        for noise_m in (1e-9, 10e-9, 100e-9):
            for seed in seeds:
                for off, doubts in ((0.0, gated.EXACT), (0.01, MASS)):
                    one = seen(moved, noise_m, seed, mass_error_ratio=off, doubts=doubts)
                    unknown = np.isnan(getattr(one, f"{other}_m")) & np.isinf(getattr(one, f"{other}_sd_m"))
                    runs += not bool(np.all(unknown))
                    worst_m = max(worst_m, abs(getattr(one.last, f"{name}_m") - getattr(joint, f"{name}_m")))
    yield judged(UNTOUCHED, float(runs), list(seeds), "nan with an infinite standard deviation, at every sample")
    yield judged(UNTOUCHED_OTHER, 1e6 * worst_m, list(seeds), "exact masses and 1 % wrong ones; 1-100 nm")


# ---- soft contact -------------------------------------------------------------------------------------------------


def soft_joint(seed: int) -> Joint:
    """Draw knees of 5-15 um on each side."""
    left_m, right_m = np.random.default_rng([seed, 17]).uniform(5e-6, 15e-6, 2)
    return Joint(left_knee_m=float(left_m), right_knee_m=float(right_m), hysteresis_ratio=0.05)


@dataclass(slots=True)
class _Scored:
    """Width errors, %, and which intervals held."""

    errors: list[float]
    held: list[bool]

    def add(self, one: Gated, joint: Joint) -> None:
        left_m, right_m, _, _ = errors(one, joint)
        self.errors.append(100.0 * (left_m + right_m) / joint.width_m)
        self.held += [abs(left_m) <= _NORMAL_95 * one.sd.left_m, abs(right_m) <= _NORMAL_95 * one.sd.right_m]

    @property
    def worst(self) -> float:
        return float(np.max(np.abs(self.errors)))

    @property
    def covered(self) -> float:
        return 100.0 * float(np.mean(self.held))


def soft_contacts(seeds: range) -> Iterator[Figure]:
    """Find onsets of contacts that set in along a parabola whose length nobody knows."""
    soft, hard, noisy = _Scored([], []), _Scored([], []), _Scored([], [])
    for seed in seeds:
        joint = soft_joint(seed)
        moved = motion(joint, Rig(), 60.0)
        short = Motion(joint, moved.rig, moved.macro_m[:20_000], moved.end_m[:20_000], moved.contact_n[:20_000])
        soft.add(seen(short, 5e-9, seed, doubts=SOFT), joint)
        hard.add(seen(short, 5e-9, seed), joint)
        noisy.add(seen(moved, 100e-9, seed, doubts=SOFT), joint)
    remark = "20 s; knees of 5-15 um, drawn for each side and seed"
    yield judged(SOFT_WIDTH, soft.worst, list(seeds), remark)
    yield judged(SOFT_COVERED, soft.covered, list(seeds), remark)
    yield judged(SOFT_HARD, hard.worst, list(seeds), f"{remark}; its bias is half the knees")
    yield judged(SOFT_NOISY, noisy.worst, list(seeds), "worst; a knee is a blow of 10 uN s, and the noise hides it")
    yield judged(SOFT_NOISY_COVERED, noisy.covered, list(seeds))


# ---- ordinary motion ----------------------------------------------------------------------------------------------


def weak_macro(profile: Profile) -> Profile:
    """Slow the macro's servo to 6 Hz, with hardly a disturbance observer."""
    values = {"macro_bandwidth_hz": 6.0, "macro_drift_n_per_sqrt_s": 0.01}
    macro = profile.macro.model_copy(update={"thermal_force_n": 1e4})
    return profile.model_copy(update={"control": profile.control.model_copy(update=values), "macro": macro})


def trapezoids(seed: int, *, feed_forward: bool, count: int = 3) -> tuple[np.void, np.ndarray]:
    """Move 0.8 m there and back `count` times; returns the estimator's state and the contact forces, N.

    A macro without feed-forward lags behind each corner and meets both edges.
    """
    profile = weak_macro(load_profile("oled-printer"))
    machine = load_machine("oled-printer")
    cable = {"name": "cable_spring", "acts_on": "micro_force", "stiffness_n_per_m": 2.0, "anchor_m": 0.05}
    machine = machine.model_copy(update={"effects": (*machine.effects, cable)})
    setpoints = trajectory.trapezoid(0.8, 0.2, start_m=-0.4).setpoints
    if not feed_forward:
        setpoints["relative_acceleration_m_per_s2"] = setpoints["acceleration_m_per_s2"]
    controller = tick.controller(profile, "dsmc", has_drives=False)
    controller.backlash[...] = backlash.init(profile, doubts=LOOSE)
    simulation = batch.simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    joint = profile.backlash
    if joint is None:
        raise RuntimeError("oled-printer: no joint in the profile")
    simulation.state["end_position_m"] = -0.4
    simulation.state["macro_position_m"] = -0.4 + 0.5 * (joint.right_m - joint.left_m)
    contact = [batch.run(simulation, setpoints).truth["contact_force_n"] for _ in range(count)]
    return controller.backlash[0], np.concatenate(contact)


def ordinary_motion(seeds: range) -> Iterator[Figure]:
    """Identify while the stage works: no sweep, force constants and masses 1 % wrong, a cable on the end."""
    profile, machine = load_profile("oled-printer"), load_machine("oled-printer")
    joint = machine.backlash
    if joint is None or machine.micro is None or profile.micro is None:
        raise RuntimeError("oled-printer: no joint in profile or machine")
    ratio = machine.micro.mass_kg / machine.micro.force_constant_n_per_a
    believed_n_per_a = profile.micro.rated_force_n / profile.micro.rated_current_a
    damping = next(row["damping_n_s_per_m"] for row in machine.effects if row["name"] == "contact_damping")
    widths, masses, dampings, free = [], [], [], 0
    for seed in seeds:
        b, contact_n = trapezoids(seed, feed_forward=False)
        if not (np.any(contact_n > 0.0) and np.any(contact_n < 0.0)):
            raise RuntimeError("not both sides were touched: this row would show nothing")
        widths.append(100.0 * float((b["left_m"] + b["right_m"]) / (joint.left_m + joint.right_m) - 1.0))
        masses.append(100.0 * float((profile.micro.mass_kg + b["mass_kg"]) / believed_n_per_a / ratio - 1.0))
        dampings += [100.0 * float(b[f"{side}_damping_n_s_per_m"] / damping - 1.0) for side in ("left", "right")]
        b, contact_n = trapezoids(seed, feed_forward=True, count=1)
        if np.any(contact_n):
            raise RuntimeError("an edge was touched: this row would show nothing")
        free += bool(np.isfinite(b["left_sd_m"]) or np.isfinite(b["right_sd_m"]))
    remark = "three moves of 0.8 m at 0.2 m/s there and back; masses and force constants 1 % off, a cable of 2 N/m"
    yield judged(MOTION_WIDTH, float(np.max(np.abs(widths))), list(seeds), remark)
    yield judged(MOTION_MASS, float(np.max(np.abs(masses))), list(seeds), remark)
    yield judged(MOTION_DAMPING, float(np.max(np.abs(dampings))), list(seeds), "1 % of it the force constant's")
    yield judged(MOTION_FREE, float(free), list(seeds), "a macro with feed-forward touches nothing")


# ---- cost ---------------------------------------------------------------------------------------------------------


def cost(bar: Bar, work: Callable[[], object], samples_count: int) -> Figure:
    """Time a run over so many samples, in processor time; compiled before."""
    work()
    times_s = []
    for _ in range(_REPEATS):
        begin_s = time.process_time()
        work()
        times_s.append(time.process_time() - begin_s)
    median_us = 1e6 * statistics.median(times_s) / samples_count
    return judged(bar, median_us, reason=f"median of {_REPEATS} runs over {samples_count} samples")


def _cost_of_all() -> Figure:
    moved = motion(soft_joint(1), Rig(), 60.0)
    doubts = Doubts(0.4, 10.0, 1.0, 5.0, 1.0, 0.05, SOFT.knee_n_m, SOFT.hysteresis_n_per_m)
    return cost(COST_ALL, lambda: seen(moved, 5e-9, 1, doubts=doubts), moved.macro_m.size)
