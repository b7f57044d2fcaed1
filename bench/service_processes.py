"""Faults with real processes, what a recording loses, and the memory of a long session."""

import itertools
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from bench.figure import Bar, Figure, absent, judged
from bench.journal import Journal, beside_figures
from tests.faults import losses, real, soak
from tests.faults.judge import BACK, BARS, BEGUN_CYCLES, GENTLE, TRAVEL
from tests.faults.kinds import CYCLE_S

SEEDS = (1, 11, 26, 33, 35, 36, 38, 41, 62, 99)  # what only processes can show, two faults of the wire, all motions
FULL_SEEDS = range(1000, 1100)  # moved on behind every mend, as those of the batch campaign
_SOAK_S, _FULL_SOAK_S, _WARM_UP_S = 180.0, 1200.0, 30.0
LOSS_SEEDS = {"servo": (9,), "supervisor": (6,), "both": (1,), "power": (5, 37)}  # one of the cuts with a micro
FULL_LOSS_SEEDS = {
    "servo": (*range(10), *range(40, 55)),  # where the macro moves, the rig's log has the stop
    "supervisor": range(10, 20),
    "both": range(20, 30),
    "power": range(30, 40),
}

COUNT = Bar("real processes: runs", "runs", 10.0, True)
COUNT_FULL = Bar("real processes: runs", "runs", len(FULL_SEEDS), True)
COUNT_ONE = Bar("real processes: runs", "runs")  # of a run that is played again
MISSED = {name: Bar(f"real processes: {name}", "runs", 0.0) for name in BARS if name != BACK}
BEGUN = Bar(
    "real processes: stop begun after fault detection, in cycles that the host had, worst run", "cycles", BEGUN_CYCLES
)
RECOVERED = Bar(
    "real processes: armed again, a killed supervisor started again by the test as systemd does", "%", 100.0, True
)
LOST_SERVO = Bar("recorded cycles lost, kill -9 of the servo", "cycles", 0.0)
STOP_BEGUN = Bar("drive-side stop begun after kill -9 of the servo, worst", "s", losses.SHIPPED_HEARTBEAT_S)
STOP_ENDED = Bar("and at rest after that, from 0.25 m/s at most at 5 m/s^2 (50 ms by the ramp alone), worst", "s")
LOST_SUPERVISOR = Bar("recorded cycles lost, kill -9 of the supervisor", "cycles", 0.0)
LOST_BOTH = Bar("recorded cycles lost, kill -9 of servo and supervisor", "cycles", 0.0)
LOST_POWER = Bar("recorded time lost, power cut in mid motion, worst", "s", 0.25)
_WATCHES = "the drive that misses 20 SYNCs is sooner than its heartbeat watch"
UNREADABLE = Bar("runs unreadable after kill or power cut", "runs", 0.0)
SERVO_GROWTH = Bar("soak: memory growth of the servo after warm-up", "bytes", soak.PAGE_BYTES)
SUPERVISOR_GROWTH = Bar("soak: memory growth of the supervisor after warm-up", "MiB", 1.0)
SOAK_MOTIONS = "soak: motions that came to their end"
SOAKED = Bar("soak: cycles", "cycles")
SOAK_MISSED = Bar("soak: missed cycles a minute", "cycles")

Say = Callable[[str], None]


def figures(*, full: bool, say: Say, seeds: Sequence[int] | None = None) -> Iterator[Figure]:
    """Play the seeds with real processes, or go on with what the journal has not."""
    wanted = list(seeds) if seeds is not None else list(FULL_SEEDS if full else SEEDS)
    journal = Journal(beside_figures("service-processes") if full and seeds is None else None)
    with tempfile.TemporaryDirectory(prefix="stagectl-real-") as folder:
        for seed in wanted:
            if seed in journal.entries:
                continue
            result = real.run(seed, Path(folder) / str(seed))
            shutil.rmtree(Path(folder) / str(seed), ignore_errors=True)
            journal.keep(
                seed,
                {
                    "kind": result.scenario.kind,
                    "phase": result.scenario.phase,
                    "fault": result.fault_kind,
                    "violations": [list(one) for one in result.violations],
                    "begun_cycles": None if result.verdict is None else result.verdict.begun_cycles,
                    "line": result.line,
                    "skipped": result.skipped,
                },
            )
            say(f"{result.line} ({result.took_s:.0f} s)")
    played = [journal.entries[seed] for seed in wanted]
    entries = [entry for entry in played if not entry["skipped"]]
    kinds, phases = (", ".join(sorted({entry[name] for entry in entries})) for name in ("kind", "phase"))
    said = [f"{kinds}; {phases}", *{entry["skipped"] for entry in played} - {""}]
    count = COUNT_ONE if seeds is not None else COUNT_FULL if full else COUNT
    yield judged(count, len(entries), wanted, "; skipped: ".join(said))
    nothing = float("nan")  # of no run; never holds
    for name, bar in MISSED.items():
        missed = [entry["line"] for entry in entries if any(one == name for one, _ in entry["violations"])]
        said = f"{GENTLE}; t with what the host held servo or rig up, and 5 ms" if name == TRAVEL else ""
        yield judged(bar, len(missed) if entries else nothing, reason="; ".join(missed[:3]) or said)
    begun = [entry["begun_cycles"] for entry in entries if entry["begun_cycles"] is not None]
    yield judged(BEGUN, max(begun, default=nothing), reason=f"measured in {len(begun)} of {len(entries)} runs")
    lame = [entry["line"] for entry in entries if any(one == BACK for one, _ in entry["violations"])]
    share = 100.0 * (1.0 - len(lame) / len(entries)) if entries else nothing
    yield judged(RECOVERED, share, reason="; ".join(lame[:3]))


def loss_figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Kill and cut, and count the rows that are left against the SYNCs that the rig heard."""
    seeds = FULL_LOSS_SEEDS if full else LOSS_SEEDS
    strikes = {name: [losses.drawn(seed) for seed in chosen] for name, chosen in seeds.items()}
    unreadable: list[str] = []
    with tempfile.TemporaryDirectory(prefix="stagectl-loss-") as folder:
        places = (Path(folder) / str(number) for number in itertools.count())
        stops: list[losses.Stopped] = []

        def after_servo_kill(place: Path, strike: losses.Strike) -> losses.Loss:
            loss, stop = losses.after_servo_kill(place, strike)
            stops.extend([stop] if stop is not None else [])
            return loss

        kills = {
            "servo": (LOST_SERVO, after_servo_kill),
            "supervisor": (LOST_SUPERVISOR, losses.after_supervisor_kill),
            "both": (LOST_BOTH, losses.after_both_killed),
        }
        for name, (bar, kill) in kills.items():
            found, counts = [], []
            for strike in strikes[name]:
                found.append(kill(next(places), strike))
                one = found[-1]
                counts.append(f"{strike.text}: {one.rows_count} rows of {one.syncs_count} SYNCs")
                say(f"{bar.figure}: {counts[-1]}, {one.cycles_lost} lost")
            unreadable += [text for one in found for text in one.unreadable]
            yield lost_figure(bar, found, list(seeds[name]), "; ".join(counts[:3]))
        begun = ", ".join(f"{stop.begun_s * 1e3:.0f} ms" for stop in stops)
        said = f"by the rig's log, in {len(stops)} of {len(strikes['servo'])} kills: {begun}; {_WATCHES}"
        nan = float("nan")
        yield judged(STOP_BEGUN, max((stop.begun_s for stop in stops), default=nan), list(seeds["servo"]), said)
        yield judged(STOP_ENDED, max((stop.rest_s for stop in stops), default=nan), list(seeds["servo"]))
        cuts: list[losses.Loss] = []
        try:
            for strike in strikes["power"]:
                cuts.append(losses.after_power_cut(next(places), strike))
                say(f"power cut, {strike.text}: {cuts[-1]}")
        except losses.NotHere as error:
            yield absent(LOST_POWER, f"needs to mount a disk: {error}")
        unreadable += [text for one in cuts for text in one.unreadable]
        if cuts:
            lost = [one.cycles_lost for one in cuts]
            said = (
                f"cycles lost in {len(cuts)} cuts: {lost}; {'; '.join(strike.text for strike in strikes['power'][:3])}"
            )
            yield lost_figure(LOST_POWER, cuts, list(seeds["power"]), said, CYCLE_S)
    struck = f"{sum(len(strikes[name]) for name in kills)} kills, {len(cuts)} power cuts"
    yield judged(UNREADABLE, len(unreadable), reason="; ".join([struck, *unreadable[:3]]))


def lost_figure(
    bar: Bar, found: Sequence[losses.Loss], seeds: list[int], remark: str, unit_per_cycle: float = 1.0
) -> Figure:
    """Judge the worst of some strikes; missed where any of them owed no row, and so measured nothing."""
    empty_count = sum(one.syncs_count == 0 for one in found)
    if empty_count:
        said = f"no SYNC of a stage with power in {empty_count} of {len(found)}: nothing measured there; {remark}"
        return judged(bar, float("nan"), seeds, said)
    return judged(bar, unit_per_cycle * max(one.cycles_lost for one in found), seeds, remark)


def soak_figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Work for minutes, and see what the processes take more."""
    duration_s = _FULL_SOAK_S if full else _SOAK_S
    with tempfile.TemporaryDirectory(prefix="stagectl-soak-") as folder:
        soaked = soak.soak(Path(folder) / "soak", duration_s, _WARM_UP_S, say)
    yield from of_soak(soaked, duration_s)


def of_soak(soaked: soak.Soaked, duration_s: float) -> Iterator[Figure]:
    """Judge a soak by the samples of its memory, and by what the stage did."""
    faults_count = len(soaked.faults)
    said = f"{duration_s:g} s behind {_WARM_UP_S:g} s of warm-up; last of {len(soaked.servo_bytes)} samples, less the"
    for bar, unit_bytes, samples in (
        (SERVO_GROWTH, 1, soaked.servo_bytes),
        (SUPERVISOR_GROWTH, 2**20, soaked.supervisor_bytes),
    ):
        held = f"{samples[0] / 1e6:.3f} MB at first, {min(samples) / 1e6:.3f} to {max(samples) / 1e6:.3f} since"
        yield judged(bar, soak.growth_bytes(samples) / unit_bytes, reason=f"{said} lowest; {held}")
    least = soak.least_motions(duration_s)
    said = f"of {2 * least} that the pauses leave time for; faults of the host: {faults_count}"
    yield judged(Bar(SOAK_MOTIONS, "motions", least, True), soaked.motions_count, reason=said)
    yield judged(SOAKED, soaked.cycles_count, reason="; ".join(soaked.faults[:2]))
    yield judged(SOAK_MISSED, 60.0 * soaked.missed_count / duration_s)
