"""The batch campaign: many seeded faults in virtual time, each bar over all runs, each kind with its count."""

import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from bench.figure import Bar, Figure, judged
from bench.journal import Journal, beside_figures
from tests.faults import campaign
from tests.faults.judge import BACK, BARS, BEGUN_CYCLES, GENTLE, LOST, TRAVEL
from tests.faults.kinds import KINDS

RUNS = 70  # every kind twice
FULL_SEEDS = range(23_000, 23_900)
"""Moved on by as many behind every mend: where code and judges were mended all hold, of 1801 fresh ones 11 did not."""

BEGUN = Bar("batch: stop begun after fault detection, worst run", "cycles", BEGUN_CYCLES)
MISSED = {name: Bar(f"batch: {name}", "cycles" if name == LOST else "runs", 0.0) for name in BARS if name != BACK}
RECOVERED = Bar("batch: armed again without a restart, where the fault is gone", "%", 100.0, True)
COUNT = Bar("batch: runs", "runs", RUNS, True)
COUNT_FULL = Bar("batch: runs", "runs", len(FULL_SEEDS), True)
COUNT_ONE = Bar("batch: runs", "runs")  # of a run that is played again
TIME = Bar("batch: time of a run, mean", "s")

Say = Callable[[str], None]


def figures(*, full: bool, say: Say, seeds: Sequence[int] | None = None) -> Iterator[Figure]:
    """Play the seeds, or go on with what the journal has not; then judge them together."""
    wanted = list(seeds) if seeds is not None else list(FULL_SEEDS if full else range(RUNS))
    journal = Journal(beside_figures("service-batch") if full and seeds is None else None)
    missing = [seed for seed in wanted if seed not in journal.entries]
    with tempfile.TemporaryDirectory(prefix="stagectl-faults-") as folder:
        for count, entry in enumerate(_played(missing, Path(folder)), 1):
            journal.keep(entry.pop("seed"), entry)
            if seeds is not None or entry["violations"]:
                say(entry["line"])
            elif count % 10 == 0:
                say(f"{count} of {len(missing)} runs")
    count = COUNT_ONE if seeds is not None else COUNT_FULL if full else COUNT
    yield from of_entries([journal.entries[seed] for seed in wanted], wanted, count)


def _played(seeds: list[int], folder: Path) -> Iterator[dict]:
    """Play seeds on all processors: virtual time is the same on each."""
    if len(seeds) < 2:
        yield from (_play(seed, folder) for seed in seeds)
        return
    workers_count = len(os.sched_getaffinity(0))
    with ProcessPoolExecutor(workers_count, multiprocessing.get_context("spawn")) as pool:
        for done in as_completed([pool.submit(_play, seed, folder) for seed in seeds]):
            yield done.result()


def _play(seed: int, folder: Path) -> dict:
    own = folder / str(seed)
    entry = {"seed": seed, **as_entry(campaign.run(seed, own))}
    shutil.rmtree(own, ignore_errors=True)  # 450 runs filled a disk of 71 GB
    return entry


def as_entry(result: campaign.Result) -> dict:
    """Return what the journal keeps of a run: plain JSON values."""
    verdict = result.verdict
    return {
        "kind": result.kind,
        "phase": result.phase,
        "fault": result.fault_kind,
        "line": result.line,
        "skipped": result.reason,
        "took_s": result.took_s,
        "violations": [] if verdict is None else [list(one) for one in verdict.violations],
        "begun_cycles": None if verdict is None else verdict.begun_cycles,
        "cycles_lost": 0 if verdict is None else verdict.cycles_lost,
        "cycles_owed": 0 if verdict is None else verdict.cycles_owed,
        "drift_m": 0.0 if verdict is None else verdict.drift_m,
    }


def of_entries(entries: list[dict], seeds: list[int], count: Bar = COUNT_ONE) -> Iterator[Figure]:
    """Hold all runs together against each bar; `count`: that of how many there must be."""
    played = [entry for entry in entries if not entry["skipped"]]
    yield judged(count, len(played), seeds, _skipped(entries))
    nothing = float("nan")  # measured in no run; never holds
    for name, bar in MISSED.items():
        missed = [entry for entry in played if any(bar_name == name for bar_name, _ in entry["violations"])]
        value, said, measured = float(len(missed)), GENTLE if name == TRAVEL else "", bool(played)
        if name == LOST:
            value, owed = (sum(entry[key] for entry in played) for key in ("cycles_lost", "cycles_owed"))
            said, measured = f"of {owed} cycles in motion", owed > 0
        said = "; ".join([said, *(entry["line"] for entry in missed[:3])]).removeprefix("; ")
        yield judged(bar, value if measured else nothing, reason=said)
    begun = [entry["begun_cycles"] for entry in played if entry["begun_cycles"] is not None]
    yield judged(BEGUN, max(begun, default=nothing), reason=f"measured in {len(begun)} of {len(played)} runs")
    lame = [entry for entry in played if any(name == BACK for name, _ in entry["violations"])]
    share = 100.0 * (1.0 - len(lame) / len(played)) if played else nothing
    yield judged(RECOVERED, share, reason="; ".join(entry["line"] for entry in lame[:3]))
    for kind in KINDS:
        of_kind = [entry for entry in played if entry["kind"] == kind]
        stopped = sorted({entry["fault"] for entry in of_kind if entry["fault"]})
        phases = len({entry["phase"] for entry in of_kind})
        said = f"in {phases} phases of motion; stopped by {', '.join(stopped)}" if stopped else f"in {phases} phases"
        yield judged(Bar(f"batch: runs with {kind}", "runs"), len(of_kind), reason=said)
    drift_m = max((entry["drift_m"] for entry in played), default=0.0)
    yield judged(Bar("batch: drift of a macro without power after standstill, worst", "mm"), drift_m * 1e3)
    yield judged(TIME, sum(entry["took_s"] for entry in played) / max(len(played), 1))


def _skipped(entries: list[dict]) -> str:
    reasons = {entry["skipped"] for entry in entries if entry["skipped"]}
    return (
        f"{sum(bool(entry['skipped']) for entry in entries)} skipped: {'; '.join(sorted(reasons))}" if reasons else ""
    )
