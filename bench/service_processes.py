"""Faults with real processes, what a recording loses, and the memory of a long session."""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from bench.figure import Bar, Figure, absent, judged
from bench.journal import Journal
from tests.faults import losses, real, soak
from tests.faults.judge import BACK, BARS, BEGUN, LOST

SEEDS = (0, 1, 3, 4, 5, 7, 11, 14, 15, 16, 17, 18)  # what only processes can show, and two faults of the wire
FULL_RUNS = 100
_SOAK_S, _FULL_SOAK_S, _WARM_UP_S = 150.0, 1200.0, 30.0
_CUTS = 3
_FULL_CUTS = 10

COUNT = Bar("real processes: runs", "runs")
MISSED = {name: Bar(f"real processes: {name}", "runs", 0.0) for name in BARS if name not in (BACK, BEGUN, LOST)}
RECOVERED = Bar("real processes: armed again without a restart, of a killed supervisor by systemd's", "%", 100.0, True)
LOST_SERVO = Bar("recorded cycles lost, kill -9 of the servo", "cycles", 0.0)
LOST_SUPERVISOR = Bar("recorded cycles lost, kill -9 of the supervisor", "cycles", 0.0)
LOST_POWER = Bar("recorded time lost, power cut, worst", "s", 0.25)
UNREADABLE = Bar("runs unreadable after kill or power cut", "runs", 0.0)
SERVO_GROWTH = Bar("soak: memory growth of the servo after warm-up", "bytes", soak.PAGE_BYTES)
SUPERVISOR_GROWTH = Bar("soak: memory growth of the supervisor after warm-up", "MiB", 1.0)
SOAKED = Bar("soak: cycles", "cycles")
SOAK_MISSED = Bar("soak: missed cycles a minute", "cycles")

Say = Callable[[str], None]


def figures(*, full: bool, say: Say, seeds: Sequence[int] | None = None) -> Iterator[Figure]:
    """Play the seeds with real processes, or go on with what the journal has not."""
    wanted = list(seeds) if seeds is not None else list(range(FULL_RUNS) if full else SEEDS)
    journal = Journal("service-processes" if full and seeds is None else None)
    with tempfile.TemporaryDirectory(prefix="stagectl-real-") as folder:
        for seed in wanted:
            if seed in journal.entries:
                continue
            result = real.run(seed, Path(folder) / str(seed))
            shutil.rmtree(Path(folder) / str(seed), ignore_errors=True)
            journal.keep(
                seed,
                {
                    "kind": result.kind,
                    "fault": result.fault_kind,
                    "violations": [list(one) for one in result.violations],
                    "line": result.line,
                    "skipped": result.skipped,
                },
            )
            say(f"{result.line} ({result.took_s:.0f} s)")
    played = [journal.entries[seed] for seed in wanted]
    entries = [entry for entry in played if not entry["skipped"]]
    said = [", ".join(sorted({entry["kind"] for entry in entries})), *{entry["skipped"] for entry in played} - {""}]
    yield judged(COUNT, len(entries), wanted, "; skipped: ".join(said))
    for name, bar in MISSED.items():
        missed = [entry["line"] for entry in entries if any(one == name for one, _ in entry["violations"])]
        yield judged(bar, len(missed), reason="; ".join(missed[:3]))
    lame = [entry["line"] for entry in entries if any(one == BACK for one, _ in entry["violations"])]
    yield judged(RECOVERED, 100.0 * (1.0 - len(lame) / max(len(entries), 1)), reason="; ".join(lame[:3]))


def loss_figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Kill and cut, and count the rows that are left against the SYNCs that the rig heard."""
    unreadable: list[str] = []
    with tempfile.TemporaryDirectory(prefix="stagectl-loss-") as folder:
        for bar, which in ((LOST_SERVO, "servo"), (LOST_SUPERVISOR, "supervisor")):
            found = [losses.after_kill(Path(folder) / f"{which}{k}", which) for k in range(5 if full else 1)]
            unreadable += [text for one in found for text in one.unreadable]
            counts = ", ".join(f"{one.rows_count} rows of {one.syncs_count} SYNCs" for one in found[:3])
            say(f"{which} killed: {counts}")
            yield judged(bar, max(one.cycles_lost for one in found), reason=counts)
        cuts: list[losses.Loss] = []
        try:
            for k in range(_FULL_CUTS if full else _CUTS):
                cuts.append(losses.after_power_cut(Path(folder) / f"cut{k}", 2.0 + 0.37 * k))
                say(f"power cut: {cuts[-1]}")
        except losses.NotHere as error:
            yield absent(LOST_POWER, f"needs to mount a disk: {error}")
        unreadable += [text for one in cuts for text in one.unreadable]
        if cuts:
            lost = [one.cycles_lost for one in cuts]
            yield judged(LOST_POWER, max(lost) * real.CYCLE_S, reason=f"cycles lost in {len(cuts)} cuts: {lost}")
    yield judged(UNREADABLE, len(unreadable), reason="; ".join(unreadable[:3]))


def soak_figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Work for minutes, and see what the processes take more."""
    duration_s = _FULL_SOAK_S if full else _SOAK_S
    with tempfile.TemporaryDirectory(prefix="stagectl-soak-") as folder:
        grown = soak.soak(Path(folder) / "soak", duration_s, _WARM_UP_S, say)
    said = f"{duration_s:g} s behind {_WARM_UP_S:g} s of warm-up; faults of the host: {len(grown.faults)}"
    yield judged(SERVO_GROWTH, grown.servo_bytes, reason=said)
    yield judged(SUPERVISOR_GROWTH, grown.supervisor_bytes / 2**20, reason=said)
    yield judged(SOAKED, grown.cycles_count, reason="; ".join(grown.faults[:2]))
    yield judged(SOAK_MISSED, 60.0 * grown.missed_count / duration_s)
