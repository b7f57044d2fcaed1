"""The main job on real bytes: every figure that it promises, and the bars, written once.

Timing comes first and alone; the deterministic rows share the processors after it.
"""

import concurrent.futures
import itertools
import multiprocessing
import os
import statistics
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench import following, identifying, replaying, sample_instants, seams, speeds, variants
from bench.figure import Bar, Figure, absent, judged
from sim_backend.machine import load_machine
from stagectl import trajectory
from stagectl.errors import StagectlError
from stagectl.profile import load_profile
from stagectl.tracker import LAW_NAMES

ABOUT = "Where there are several seeds the worst of them stands here. Bars are written in `bench/main_job.py`."

STAGE = "oled-printer"
IDENTIFICATION_NOISE_M = 100e-9
IDENTIFICATION_S = 20.0
FREQUENCIES_HZ = (0.5, 1.0, 1.5)

PEAK = Bar("DSMC, sine and trapezoid: true end error, peak, contact-free", "nm", 100.0)
HOLD = Bar("DSMC, trapezoid: true end error at rest, rms", "nm", 8.0)
PEAK_MEASURED = Bar("the same, measured: peak", "nm")
HOLD_MEASURED = Bar("the same, measured: at rest, rms", "nm")
PID_PEAK = Bar("PID + feed-forward, the same loop: true end error, peak", "nm")
PID_HOLD = Bar("PID + feed-forward: true end error at rest, rms", "nm")
LATENCY = Bar("sample instant to end of the SYNC that latches the torque, p50", "ms", 0.6)
JITTER = Bar("SYNC period jitter, rms", "us", 20.0)
JOINT_EXACT = Bar("identification, masses exact: Kl, Kr, width, worst", "%", 1.0)
EDGE_EXACT = Bar("identification, masses exact: edges in the run's own zero, worst", "um", 0.5)
WIDTH_WRONG = Bar("identification, masses and force constants 1 % wrong: width", "%", 1.5)
STIFFNESS_WRONG = Bar("identification, masses and force constants 1 % wrong: stiffness, worst", "%", 2.0)
INSTANT_LINE = Bar("recovered sample instant, lines, error rms", "us", 0.15)
INSTANT_USB = Bar("recovered sample instant, 125 us USB frames, error rms", "us")
SEAMS = Bar("wire against value seam, same noise: end position, rms", "nm", 0.5)
REPLAY = Bar("replay, every law, every machine: rows that differ", "rows", 0.0)
TICK = Bar("estimate + law + guard, one tick called from Python, p50", "us", 15.0)
LINE = Bar("a text line of two beams (uMD2), decoded, p50", "us", 15.0)
SERVO = Bar("line readable to TPDOs decoded, tick, RPDOs and SYNC written, p50", "us", 100.0)
VALUE_SEAM = Bar("value seam, effects on, substep <= 50 us", "x real time", 500.0, at_least=True)
WIRE = Bar("wire seam in batch, one process", "x real time", 5.0, at_least=True)

_DEFAULT_TICK_S = 60e-6

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row."""
    with tempfile.TemporaryDirectory(prefix="stagectl-bench-") as name:
        folder = Path(name)
        say("speeds, one after the other")
        yield from _speeds()
        yield _wire_speed(folder)
        servo, tick_s = _servo(folder)
        yield servo
        yield from _deterministic(folder, full, tick_s, say)


def _speeds() -> Iterator[Figure]:
    profile, machine = load_profile(STAGE), load_machine(STAGE)
    slowest_s = max(speeds.tick_s(profile, machine, law) for law in LAW_NAMES)
    yield judged(TICK, slowest_s * 1e6, reason="the slower law")
    yield judged(LINE, speeds.line_s() * 1e6, reason="aim 5 us")
    least = min(speeds.value_seam_ratio(profile, machine, law) for law in LAW_NAMES)
    yield judged(VALUE_SEAM, least, [1], "of processor time, one core; the slower law")


def _wire_speed(folder: Path) -> Figure:
    profile, machine = load_profile(STAGE), load_machine(STAGE)
    least = min(speeds.wire_ratio(profile, machine, law, folder / f"speed-{law}") for law in LAW_NAMES)
    return judged(WIRE, least, [1], "of processor time, one core, recorder included; the slower law")


def _servo(folder: Path) -> tuple[Figure, float]:
    """Measure the servo in real time; its p50 is what a tick takes in batch."""
    try:
        found = speeds.servo_s(load_profile(STAGE), folder)
    except StagectlError as error:
        return absent(SERVO, f"no real-time run on this host: {error}"), _DEFAULT_TICK_S
    remark = (
        "lines that came when the cycle was due or later; all lines, with the wait for the phase: "
        f"{found['all_readable_to_written'] * 1e6:.0f} us; from due: {found['due_to_written'] * 1e6:.0f} us, of it "
        f"decoding, tick and encoding {found['tick'] * 1e6:.0f} us"
    )
    return judged(SERVO, found["readable_to_written"] * 1e6, reason=remark), found["tick"]


def _deterministic(folder: Path, full: bool, tick_s: float, say: Say) -> Iterator[Figure]:
    """Spread the rows that depend on seeds only over the processors."""
    seeds = list(range(1, 21)) if full else list(range(1, 6))
    few = seeds[: 5 if full else 2]
    many = list(range(1, 21))
    workers = max(1, min(len(os.sched_getaffinity(0)), 8))
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
        following_jobs = [pool.submit(follow, seed, tick_s, folder) for seed in seeds]
        cases = [(seed, hz, exact) for exact in (True, False) for hz in FREQUENCIES_HZ for seed in few]
        identified_jobs = [pool.submit(identify, *case, tick_s, folder) for case in cases]
        replay_jobs = [pool.submit(replay, name, folder) for name in replaying.MACHINES]
        seam_jobs = [pool.submit(seams_apart, law, seed, folder) for law in LAW_NAMES for seed in few]
        line_jobs = [pool.submit(instants, "line", seed) for seed in many]
        usb_jobs = [pool.submit(instants, "usb-125us", seed) for seed in few]
        say(f"following sine and trapezoid, {len(seeds)} seeds")
        yield from _following_figures(list(itertools.chain.from_iterable(_results(following_jobs))), seeds, tick_s)
        say("identifying")
        yield from _identification_figures(list(zip(cases, _results(identified_jobs), strict=True)), few)
        say("sample instants")
        yield _instants_figure(INSTANT_LINE, _results(line_jobs), many)
        yield _instants_figure(INSTANT_USB, _results(usb_jobs), few)
        say("seams and replay")
        yield _seams_figure(list(_results(seam_jobs)), few)
        yield _replay_figure(list(_results(replay_jobs)))


def _results(jobs: Iterable[concurrent.futures.Future]) -> Iterator[Any]:
    return (job.result() for job in jobs)


# ---- jobs: each in a process of its own ------------------------------------------------------------------------------


def follow(seed: int, tick_s: float, folder: Path, laws: tuple[str, ...] = ("pid", "dsmc")) -> list[following.Followed]:
    """Follow sine and trapezoid of the reference under the laws."""
    profile = load_profile(STAGE)
    planned = following.reference_trajectories(profile)
    return following.follow(profile, load_machine(STAGE), seed, laws, planned, folder / f"follow-{seed}", tick_s)


def identify(seed: int, frequency_hz: float, exact: bool, tick_s: float, folder: Path) -> identifying.Identified:
    """Identify the joint, masses and force constants exactly as believed or 1 % off as the machine has them."""
    profile = variants.with_noise(load_profile(STAGE), IDENTIFICATION_NOISE_M)
    machine = variants.with_noise(load_machine(STAGE), IDENTIFICATION_NOISE_M)
    if exact:
        machine = variants.believed(machine, profile)
    place = folder / f"identify-{seed}-{frequency_hz:g}-{exact}"
    return identifying.identify(profile, machine, seed, frequency_hz, IDENTIFICATION_S, place, tick_s)


def instants(transport: str, seed: int, duration_s: float = 20.0) -> np.ndarray:
    """Return the errors of the recovered sample instants of one seed, s."""
    machine = variants.with_transport(load_machine(STAGE), transport)
    return sample_instants.errors_s(load_profile(STAGE), machine, seed, duration_s)


def seams_apart(law: str, seed: int, folder: Path) -> seams.SeamsApart:
    """Compare both seams on a trapezoid."""
    planned = trajectory.trapezoid(0.2, 0.2, start_m=-0.1, dwell_s=1.0)
    profile, machine = load_profile(STAGE), load_machine(STAGE)
    return seams.compare(profile, machine, seed, planned, law, folder / f"seams-{law}-{seed}")


def replay(name: str, folder: Path) -> replaying.Replayed:
    """Record and replay one machine."""
    return replaying.replayed(name, 1, folder / f"replay-{name}")


# ---- figures: the worst of the seeds ---------------------------------------------------------------------------------


def _following_figures(found: list[following.Followed], seeds: list[int], tick_s: float) -> Iterator[Figure]:
    dsmc = [one for one in found if one.law == "dsmc"]
    pid = [one for one in found if one.law == "pid"]
    yield judged(PEAK, 1e9 * max(one.true_peak_m for one in dsmc), seeds, _by_trajectory(dsmc))
    yield judged(HOLD, 1e9 * max(_holds(dsmc, "true_hold_rms_m")), seeds)
    yield judged(PEAK_MEASURED, 1e9 * max(one.measured_peak_m for one in dsmc), seeds)
    yield judged(HOLD_MEASURED, 1e9 * max(_holds(dsmc, "measured_hold_rms_m")), seeds)
    yield judged(PID_PEAK, 1e9 * max(one.true_peak_m for one in pid), seeds, _by_trajectory(pid))
    yield judged(PID_HOLD, 1e9 * max(_holds(pid, "true_hold_rms_m")), seeds)
    remark = f"bus-load model; a tick takes {tick_s * 1e6:.0f} us; current loop not counted"
    yield judged(LATENCY, 1e3 * max(one.sample_to_sync_p50_s for one in found), seeds, remark)
    yield judged(JITTER, 1e6 * max(one.sync_jitter_rms_s for one in found), seeds)


def _holds(found: list[following.Followed], name: str) -> list[float]:
    return [getattr(one, name) for one in found if one.trajectory == "trapezoid"]


def _by_trajectory(found: list[following.Followed]) -> str:
    parts = []
    for name in sorted({one.trajectory for one in found}):
        worst = 1e9 * max(one.true_peak_m for one in found if one.trajectory == name)
        parts.append(f"{name} {worst:.0f} nm")
    contact = max(one.contact_share for one in found)
    return f"{', '.join(parts)}; {'no contact' if contact == 0.0 else f'contact in {contact:.1%} of the rows'}"


def _identification_figures(
    found: list[tuple[tuple[int, float, bool], identifying.Identified]], seeds: list[int]
) -> Iterator[Figure]:
    exact = [one for case, one in found if case[2]]
    wrong = [one for case, one in found if not case[2]]
    remark = f"sweeps at {', '.join(f'{hz:g}' for hz in FREQUENCIES_HZ)} Hz, {IDENTIFICATION_S:g} s, 100 nm noise"
    yield judged(JOINT_EXACT, 100.0 * max(max(one.stiffness_share, one.width_share) for one in exact), seeds, remark)
    yield judged(EDGE_EXACT, 1e6 * max(one.edge_m for one in exact), seeds)
    yield judged(WIDTH_WRONG, 100.0 * max(one.width_share for one in wrong), seeds, remark)
    yield judged(STIFFNESS_WRONG, 100.0 * max(one.stiffness_share for one in wrong), seeds)


def _instants_figure(bar: Bar, errors_s: Iterable[np.ndarray], seeds: list[int]) -> Figure:
    each = list(errors_s)
    worst = max(following.rms(one) for one in each)
    mean = statistics.fmean(float(np.mean(one)) for one in each)
    remark = f"all seeds together; worst seed {worst * 1e6:.3g} us, mean error {mean * 1e6:.3g} us"
    return judged(bar, 1e6 * following.rms(np.concatenate(each)), seeds, remark)


def _seams_figure(found: list[seams.SeamsApart], seeds: list[int]) -> Figure:
    remark = f"both laws; {sum(one.late_lines for one in found)} late lines among {sum(one.cycles for one in found)}"
    return judged(SEAMS, 1e9 * max(one.rms_m for one in found), seeds, remark)


def _replay_figure(found: list[replaying.Replayed]) -> Figure:
    differing = sum(one.differing_rows for one in found)
    first = next((f"{one.machine}: {one.first_difference}" for one in found if one.differing_rows), "")
    idle = [f"{one.machine} {law}" for one in found for law, ticks in one.ticks.items() if ticks == 0]
    if idle:  # nothing moved there, so nothing was shown
        return Figure(REPLAY.figure, float(differing), REPLAY.unit, REPLAY.text, False, [1], f"no motion: {idle}")
    moving = sum(sum(one.ticks.values()) for one in found)
    return judged(REPLAY, differing, [1], first or f"{moving} cycles in motion on {len(found)} machines")
