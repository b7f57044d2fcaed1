"""Control at the limit: one law, one gain set, true end position, behind the value seam.

The stage is oled-printer with one whole cycle from sample to force. "Wrong" machines have masses, gap and contact
stiffness off by 1 % and contact damping by 20 %, up or down; "calibrated" ones by 0.1 % and 5 %, as identification
leaves them; in contact each of these five may err either way, and the worst of all 32 counts, since errors of masses
and joint cancel in part. Machines keep their cogging, cable and force noise, which no profile knows. Bars are written
here.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.figure import Bar, Figure, judged
from bench.following import peak, rms
from sim_backend.machine import Machine, load_machine
from stagectl import batch, fed_forward, tick, trajectory
from stagectl.adaptive_filter import at_rest, in_motion
from stagectl.laws.reference import gap_centre
from stagectl.linear_loop import GAP, LEFT, ON_THE_WAY, RIGHT, linearise, machine_body
from stagectl.margins import margins
from stagectl.metrics import moving_average_and_deviation
from stagectl.profile import Profile, load_profile
from stagectl.signals import SETPOINT, Stop
from tests.stage_loop import Loop

STAGE = "oled-printer"
SEEDS = (1, 2, 3, 4, 5)
FULL_SEEDS = tuple(range(1, 21))
ONE_CYCLE_S = 1e-3

HOLD = Bar("control, hold: true end position, rms", "nm", 5.0)
HOLD_MEASURED = Bar("the same, measured error", "nm")
FREE_WRONG = Bar("control, trapezoid 0.2 m/s, contact-free, 1 % wrong: peak", "nm", 35.0)
FREE_CALIBRATED = Bar("control, trapezoid 0.2 m/s, contact-free, calibrated: peak", "nm", 25.0)
CONTACT_WRONG = Bar("control, trapezoid, contact active (macro 6 Hz, not fed forward), 1 % wrong: peak", "nm", 70.0)
CONTACT_CALIBRATED = Bar("control, trapezoid, contact active, calibrated: peak", "nm", 30.0)
SETTLING = Bar("control, 0.4 m/s, 1 % wrong: settled to +-50 nm after the reference stops", "ms", 5.0)
AVERAGE = Bar("control, scan 0.2 m/s, calibrated: abs(MA) over 20 ms, largest", "nm", 8.0)
DEVIATION = Bar("control, scan 0.2 m/s, calibrated: MSD over 20 ms, largest", "nm", 10.0)
AVERAGE_WRONG = Bar("the same, 1 % wrong: abs(MA), from the first window of constant speed", "nm")
UNKNOWN = Bar("control, trapezoid, contact-free, calibrated, {} on the end that no profile knows: peak", "nm")
STIFFNESS = Bar("control, contact-free, contact stiffness x1 to x1000: peaks differ by", "%", 10.0)
SATURATED = Bar("control, contact x10: peak 0.3 s after a start that saturates", "nm", 100.0)
SENSITIVITY = Bar(
    "control, Ms at the micro's force, gap and both contacts, adaptive gains at floor and ceiling", "1", 2.0
)
DELAY_MARGIN = Bar("control, delay margin, least of the same", "ms", 0.8, at_least=True)
STEP = Bar("control, 0.1 N at once on the resting end: peak of the mean over machines and seeds", "nm")
MASS = Bar("control, micro's mass 10 % up and down, gap and contact: largest pole", "1", 1.0)
CROSSOVER = Bar("control, crossover in the gap, where a force moves the end", "Hz")
AS_SHIPPED = Bar("control, Ms at the profile's own delay", "1")

Say = Callable[[str], None]
_REST_S = 1.0
_RATIOS = {"wrong": ((1.01, 1.2), (0.99, 0.8)), "calibrated": ((1.001, 1.05), (0.999, 0.95)), "exact": ((1.0, 1.0),)}
_OFF = {"wrong": (0.01, 0.2), "calibrated": (0.001, 0.05)}  # the joint's damping by the second
_UNKNOWN: dict[str, dict[str, Any]] = {
    "0.3 N": {"name": "offset", "force_n": 0.3},
    "a cable of 2 N/m": {"name": "linear_stiffness", "stiffness_n_per_m": 2.0},
    "1 N s/m of friction": {"name": "viscous_friction", "damping_n_s_per_m": 1.0},
    "0.2 N of cogging": {"name": "cogging", "amplitude_n": 0.2, "pitch_m": 0.032, "phase_rad": 0.3},
}
_STIFFNESSES = (1.0, 10.0, 100.0, 1000.0)
_WINDOW_S = 0.02
_SETTLED_M = 50e-9
_JERK_SAMPLES = range(2, 100, 7)  # of the trapezoid's first jerk: the mass that is found on the way has a gain there
_STEP_N = 0.1
_STEP_S = 0.3
_EARLIEST_DEVIATIONS = 6.0  # no sample jitters to before the SYNC of the sample before
_SURGE_M_PER_S = 0.02
"""Speed that a reference begins with at once: 40 kg would need an endless force."""


@dataclass(frozen=True, slots=True)
class Run:
    """One trajectory: true error of the end at the samples, one a cycle, and whether the joint touched."""

    setpoints: np.ndarray
    error_m: np.ndarray
    measured_m: np.ndarray
    touched: np.ndarray
    stop: Stop


def with_tables(described: Any, **tables: dict[str, Any]) -> Any:
    """Copy a profile or machine with other values in its tables."""
    return described.model_copy(
        update={name: getattr(described, name).model_copy(update=values) for name, values in tables.items()}
    )


def stage(**control: float | str) -> Profile:
    """Return the profile with one cycle from sample to force, and other values of its [control] where given."""
    return with_tables(load_profile(STAGE), cycle={"actuation_delay_s": ONE_CYCLE_S}, control=control)


def weak(profile: Profile) -> Profile:
    """Return it with a macro of 6 Hz that no acceleration is fed forward to.

    PID's cascade of w / 4 above w is as stiff as that at 12 Hz; at 6 Hz it strays beyond the micro's stroke.
    """
    hz = 12.0 if profile.control.law == "pid" else 6.0
    return with_tables(profile, control={"macro_bandwidth_hz": hz, "macro_feed_forward_ratio": 0.0})


def machine(profile: Profile, ratio: float = 1.0, damping_ratio: float = 1.0, stiffness_ratio: float = 1.0) -> Machine:
    """Return the machine of a profile, masses, gap and stiffness times `ratio`; what it has besides stays."""
    one, joint = load_machine(STAGE), profile.backlash
    if joint is None or profile.micro is None:
        raise ValueError(f"{STAGE} has a micro and a joint")
    tables: dict[str, dict[str, float]] = {"backlash": {}}
    for name in ("macro", "micro"):
        axis = profile.axis(name)
        constant = axis.rated_force_n / axis.rated_current_a
        tables[name] = {"mass_kg": axis.mass_kg * ratio, "force_constant_n_per_a": constant}
        tables[name]["rated_current_a"] = axis.rated_current_a
    for side in ("left", "right"):
        tables["backlash"][f"{side}_m"] = getattr(joint, f"{side}_m") * ratio
        stiffness = getattr(joint, f"{side}_stiffness_n_per_m")
        tables["backlash"][f"{side}_stiffness_n_per_m"] = stiffness * ratio * stiffness_ratio
    believed = {row["name"]: dict(row) for row in profile.effects}
    damping = believed["contact_damping"]["damping_n_s_per_m"] * damping_ratio
    effects = tuple(dict(row) for row in one.effects)
    for row in effects:
        if row["name"] == "contact_damping":
            row["damping_n_s_per_m"] = damping
    return with_tables(one, **tables).model_copy(update={"effects": effects})


def after_step_m(profile: Profile, one: Machine, seed: int) -> np.ndarray:
    """Rest, then put `_STEP_N` on the micro that nobody told the controller of: true error at the samples after, m."""
    controller = tick.controller(profile, profile.control.law, has_drives=False)
    simulation = batch.simulation(controller, one, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    simulation.state["end_position_m"] = 0.0
    simulation.state["macro_position_m"] = float(gap_centre(controller.belief[0]))
    hold = np.zeros(round(_REST_S * profile.cycle.rate_hz), SETPOINT)
    batch.run(simulation, hold)
    loop, error_m = Loop(simulation), []
    for setpoint in hold[: round(_STEP_S * profile.cycle.rate_hz)]:
        loop.cycle(setpoint, added_micro_n=_STEP_N)
        error_m.append(loop.true_end_m)
    return np.array(error_m)


def machines(profile: Profile, kind: str) -> list[Machine]:
    """Return the machines that are off by as much as `kind` says: wrong, calibrated or exact."""
    return [machine(profile, *ratios) for ratios in _RATIOS[kind]]


def corners(profile: Profile, kind: str) -> list[Machine]:
    """Return machines whose masses, gap, contact stiffness and damping are each off to either side: all 32."""
    off, damping_off = _OFF[kind]
    joint, found = profile.backlash, []
    if joint is None:
        raise ValueError(f"{STAGE} has a joint")
    kg = {"macro": profile.macro.mass_kg, "micro": _micro_kg(profile)}
    for macro, micro, width, stiffness, damping in itertools.product((1.0, -1.0), repeat=5):
        edges = {f"{side}_m": getattr(joint, f"{side}_m") * (1.0 + off * width) for side in ("left", "right")}
        one = machine(profile, 1.0, 1.0 + damping_off * damping, 1.0 + off * stiffness)
        masses = {
            name: {"mass_kg": kg[name] * (1.0 + off * sign)} for name, sign in (("macro", macro), ("micro", micro))
        }
        found.append(with_tables(one, **masses, backlash=edges))
    return found


def felt(one: Machine, effect: dict[str, Any]) -> Machine:
    """Return the machine with one more effect on its micro."""
    return one.model_copy(update={"effects": (*one.effects, {**effect, "acts_on": "micro_force"})})


def run(profile: Profile, one: Machine, setpoints: np.ndarray, seed: int, *, jitter_s: float = 0.0) -> Run:
    """Rest where the trajectory begins, then follow it; samples are taken `jitter_s` rms beside their instants.

    SYNCs come as much earlier as the samples that do.
    """
    controller = tick.controller(profile, profile.control.law, has_drives=False)
    simulation = batch.simulation(controller, one, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    at_m = float(setpoints["position_m"][0])
    simulation.state["end_position_m"] = at_m
    simulation.state["macro_position_m"] = at_m + float(gap_centre(controller.belief[0]))
    rest = np.zeros(round(_REST_S * profile.cycle.rate_hz), SETPOINT)
    rest["position_m"] = at_m
    batch.run(simulation, rest)
    instants_s = batch.instants(simulation, setpoints.size)
    instants_s[1:-1, 0] += np.random.default_rng([seed, 2]).standard_normal(setpoints.size - 1) * jitter_s
    instants_s[:, 1] -= _EARLIEST_DEVIATIONS * jitter_s
    recording = batch.run(simulation, setpoints, instants_s=instants_s)
    # With jitter the truth is of the instants that came; what the end did is asked at those that were due.
    reference_m = recording.setpoints["position_m"] + recording.setpoints["velocity_m_per_s"] * (
        instants_s[: recording.truth.size, 0] - due_s(instants_s, recording.truth.size)
    )
    return Run(
        setpoints=recording.setpoints,
        error_m=recording.truth["end_position_m"] - reference_m,
        measured_m=recording.measurements["end_position_m"] - recording.setpoints["position_m"],
        touched=recording.truth["contact_force_n"] != 0.0,
        stop=Stop(int(recording.commands["stop"][-1])),
    )


def due_s(instants_s: np.ndarray, count: int) -> np.ndarray:
    """Return the evenly spaced instants between the first and the last sample."""
    return np.linspace(instants_s[0, 0], instants_s[-1, 0], instants_s.shape[0])[:count]


def runs(profile: Profile, kind: str, setpoints: np.ndarray, seeds: Sequence[int], **how: float) -> list[Run]:
    """Follow a trajectory on every machine of a kind with every seed."""
    return [run(profile, one, setpoints, seed, **how) for one in machines(profile, kind) for seed in seeds]


def peak_nm(followed: Sequence[Run]) -> float:
    """Return the largest true error; nan where one was stopped."""
    if any(one.stop is not Stop.NONE for one in followed):
        return float("nan")
    return 1e9 * max(peak(one.error_m) for one in followed)


def settling_ms(one: Run) -> float:
    """Return the longest time from where the reference stops until the error stays within 50 nm."""
    moves = one.setpoints["velocity_m_per_s"] != 0.0
    times = []
    for stop in np.flatnonzero(moves[:-1] & ~moves[1:]) + 1:
        ahead = np.flatnonzero(moves[stop:])
        after = one.error_m[stop : stop + ahead[0] if ahead.size else None]
        outside = np.flatnonzero(np.abs(after) > _SETTLED_M)
        times.append(float(outside[-1] + 1) if outside.size else 0.0)
    return max(times)


def scan_nm(one: Run, rate_hz: float) -> tuple[float, float]:
    """Return the largest |MA| and MSD over windows that lie wholly at constant speed."""
    speed = np.abs(one.setpoints["velocity_m_per_s"])
    steady = (speed >= (1.0 - 1e-9) * np.max(speed)) & (np.abs(one.setpoints["acceleration_m_per_s2"]) < 1e-6)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], steady, [False]]).astype(int)))
    averages, deviations = [], []
    for first, last in edges.reshape(-1, 2):
        if last - first >= round(_WINDOW_S * rate_hz):
            moving = moving_average_and_deviation(one.error_m[first:last], 1.0 / rate_hz, _WINDOW_S)
            averages.append(moving.max_average_m)
            deviations.append(moving.max_deviation_m)
    return 1e9 * max(averages), 1e9 * max(deviations)


def trapezoid(velocity_m_per_s: float = 0.2) -> np.ndarray:
    """Return 0.8 m there and back, corners of 0.2, 0.1 and 0.05 s."""
    return trajectory.trapezoid(0.8, velocity_m_per_s, start_m=-0.4, dwell_s=1.0, lead_s=0.2).setpoints


def surge() -> np.ndarray:
    """Return a reference that goes off at once, rests after 1 s and lets two more pass."""
    rows = np.zeros(3000, SETPOINT)
    t_s = 1e-3 * np.arange(rows.size)
    rows["position_m"] = _SURGE_M_PER_S * np.minimum(t_s, 1.0)
    rows["velocity_m_per_s"] = np.where(t_s < 1.0, _SURGE_M_PER_S, 0.0)
    return rows


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row: DSMC against the bars, PID beside it."""
    seeds = FULL_SEEDS if full else SEEDS
    say("control at the limit: margins")
    yield from _margins()
    say("control at the limit: runs")
    profile = stage()
    yield from _rows(profile, seeds, "")
    yield from _robustness(profile, seeds)
    say("control at the limit: the rival")
    yield from _rows(stage(law="pid"), seeds, "PID + feed-forward")


def _margins() -> Iterator[Figure]:
    profile = stage()
    ceiling = profile.control.adaptive_gain_ceiling_ratio
    found, poles = [], []
    for place in (GAP, LEFT, RIGHT):
        for gain, observer in itertools.product((0.0, ceiling), (at_rest, in_motion)):
            body = machine_body(machine(profile))
            found.append(margins(linearise(profile, profile.control.law, body, place, gain, observer)))
            for ratio in (0.9, 1.1):
                body = machine_body(with_tables(machine(profile), micro={"mass_kg": ratio * _micro_kg(profile)}))
                loop = linearise(profile, profile.control.law, body, place, gain, observer).closed()
                poles.append(float(np.max(np.abs(loop.poles()))))
    body = machine_body(machine(profile))
    found += [
        margins(linearise(profile, profile.control.law, body, place, gain, observer))
        for place in (GAP, LEFT, RIGHT)
        for gain in (0.0, ceiling)
        for observer in ON_THE_WAY  # after a force has struck
    ]
    found += [
        margins(linearise(profile, profile.control.law, body, place, ceiling, fed_forward.along(before), jerk))
        for place in (GAP, LEFT, RIGHT)
        for before, jerk in _in_the_first_jerk()
    ]
    worst = max(found, key=lambda one: one.sensitivity_peak_ratio)
    remark = f"at {worst.sensitivity_peak_hz:.0f} Hz; one cycle of delay; test_linear_loop confirms it by a sine"
    yield judged(SENSITIVITY, worst.sensitivity_peak_ratio, reason=remark)
    yield judged(DELAY_MARGIN, 1e3 * min(one.delay_margin_s for one in found))
    yield judged(MASS, max(poles), reason="of the closed loop; within the unit circle it is stable")
    phase = np.degrees(min(one.phase_margin_rad for one in found))
    gain = min(one.gain_margin_ratio for one in found)
    low, high = (found[k].crossover_hz for k in (0, 1))  # without an adaptive gain: at rest, in motion
    said = f"{low:.0f} Hz at rest; phase margin {phase:.0f} deg, gain margin {gain:.2f}"
    yield judged(CROSSOVER, high, reason=said)
    shipped = load_profile(STAGE)
    loop = linearise(shipped, "dsmc", machine_body(machine(shipped)), GAP, ceiling)
    delay_us = 1e6 * shipped.cycle.actuation_delay_s
    yield judged(AS_SHIPPED, margins(loop).sensitivity_peak_ratio, reason=f"{delay_us:.0f} us from sample to force")


def _in_the_first_jerk() -> list[tuple[np.ndarray, float]]:
    """Return (accelerations up to there, jerk) of samples in the trapezoid's first jerk."""
    rows = trapezoid()
    first = int(np.flatnonzero(rows["jerk_m_per_s3"])[0])
    jerk = rows["jerk_m_per_s3"][first:]
    return [(rows["acceleration_m_per_s2"][first : first + k], float(jerk[k])) for k in _JERK_SAMPLES if jerk[k] != 0.0]


def _micro_kg(profile: Profile) -> float:
    return profile.axis("micro").mass_kg


def _named(bar: Bar, who: str) -> Bar:
    """Return the bar as a row of a rival: reported, not judged."""
    if not who:
        return bar
    weak = bar.figure.replace("macro 6 Hz,", "macro 12 Hz, as stiff as DSMC's at 6 Hz,")
    return Bar(f"{who}: {weak.removeprefix('control, ')}", bar.unit)


def _rows(profile: Profile, seeds: Sequence[int], who: str) -> Iterator[Figure]:
    used, rate_hz = list(seeds), profile.cycle.rate_hz
    held = runs(profile, "wrong", np.zeros(8000, SETPOINT), seeds)
    yield judged(_named(HOLD, who), 1e9 * max(rms(one.error_m) for one in held), used)
    if not who:
        yield judged(HOLD_MEASURED, 1e9 * max(rms(one.measured_m) for one in held), used)
    pushed_m = np.mean([after_step_m(profile, one, seed) for one in machines(profile, "wrong") for seed in seeds], 0)
    yield judged(_named(STEP, who), 1e9 * peak(pushed_m), used, "seeds and machines as above")
    for bar, kind in ((FREE_WRONG, "wrong"), (FREE_CALIBRATED, "calibrated")):
        followed = runs(profile, kind, trapezoid(), seeds)
        touched = any(np.any(one.touched) for one in followed)
        remark = "touched" if touched else "no contact"
        median = 1e9 * float(np.median([peak(one.error_m) for one in followed]))
        yield judged(_named(bar, who), peak_nm(followed), used, f"{remark}; median {median:.0f} nm")
        if kind == "wrong":
            continue
        scanned = [scan_nm(one, rate_hz) for one in followed]
        yield judged(_named(AVERAGE, who), max(average for average, _ in scanned), used)
        yield judged(_named(DEVIATION, who), max(deviation for _, deviation in scanned), used)
    for bar, kind in ((CONTACT_WRONG, "wrong"), (CONTACT_CALIBRATED, "calibrated")):
        # every corner of what the law may be wrong in; the rival's own two
        errant = machines(weak(profile), kind) if who else corners(weak(profile), kind)
        drawn = seeds if who else SEEDS
        followed = [run(weak(profile), one, trapezoid(), seed) for one in errant for seed in drawn]
        share = 100.0 * float(np.mean([np.mean(one.touched) for one in followed]))
        remark = f"worst of {len(errant)} machines; in contact {share:.0f} % of the time"
        yield judged(_named(bar, who), peak_nm(followed), list(drawn), remark)
    fast = runs(profile, "wrong", trapezoid(0.4), seeds)
    remark = f"peak {peak_nm(fast):.0f} nm"
    yield judged(_named(SETTLING, who), max(settling_ms(one) for one in fast), used, remark)


def _robustness(profile: Profile, seeds: Sequence[int]) -> Iterator[Figure]:
    used, rate_hz = list(seeds), profile.cycle.rate_hz
    scanned = [scan_nm(one, rate_hz) for one in runs(profile, "wrong", trapezoid(), seeds)]
    yield judged(AVERAGE_WRONG, max(average for average, _ in scanned), used)
    for said, effect in _UNKNOWN.items():
        errant = [felt(one, effect) for one in machines(profile, "calibrated")]
        followed = [run(profile, one, trapezoid(), seed) for one in errant for seed in SEEDS]
        bar = Bar(UNKNOWN.figure.format(said), UNKNOWN.unit)
        yield judged(bar, peak_nm(followed), list(SEEDS))
    peaks = np.array(
        [
            [
                peak(run(profile, machine(profile, 1.01, 1.2, ratio), trapezoid(), seed).error_m)
                for ratio in _STIFFNESSES
            ]
            for seed in seeds
        ]
    )
    apart = 100.0 * float(np.max(np.max(peaks, axis=1) / np.min(peaks, axis=1)) - 1.0)
    yield judged(STIFFNESS, apart, used, "the same seed, stiffness known no better than x1")
    started = [
        run(profile, machine(profile, ratio, damping_ratio, 10.0), surge(), seed)
        for ratio, damping_ratio in _RATIOS["wrong"]
        for seed in seeds
    ]
    late = np.concatenate([np.concatenate([one.error_m[300:950], one.error_m[1300:]]) for one in started])
    strayed = 1e6 * max(peak(one.error_m) for one in started)
    stopped = any(one.stop is not Stop.NONE for one in started)
    value = float("nan") if stopped else 1e9 * peak(late)
    remark = f"the reference goes off at {_SURGE_M_PER_S * 1e3:.0f} mm/s; strayed by {strayed:.0f} um before"
    yield judged(SATURATED, value, used, remark)
