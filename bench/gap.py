"""The gap workflow on data in which the effect is hidden from it: every figure that it promises, and its speed.

A part run takes development seeds and as many sets as fit a quarter of an hour; there a figure is missed only where
the 95 % interval excludes its bar. The full run takes the final seeds, judges the values themselves, and writes itself
into `docs/gap-results.json`.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from bench import emps_figures, final_seeds, left_out, suite_figures
from bench.blind_sets import (
    Job,
    Marked,
    Searched,
    generated,
    held_out,
    line,
    load_set,
    marked,
    searched,
    sets_folder,
)
from bench.figure import Bar, Figure, absent, judged
from bench.journal import measured
from stagectl.gap.believed import Believed
from stagectl.gap.crew import crew_of
from stagectl.gap.heap import give_back, keep_freed
from stagectl.gap.log import Log
from stagectl.gap.workflow import find

ABOUT = (
    "Sets are those of `tests/blind`. A figure is missed where the 95 % interval excludes its bar; the full run judges "
    "the value itself. Bars are written in `bench/gap.py`, `bench/suite_figures.py`, `bench/left_out.py` and "
    "`bench/emps_figures.py`."
)

SPEED = Bar("four recordings of 20 s at 1 kHz, full library, 200 nulls: time with two workers", "s", 30.0)
SERIAL_SPEED = Bar("the same in one thread", "s")

PART_SEEDS = range(7001, 7061)
PART_S = 780.0
PART_LEFT_OUT_COUNT = 4
LEFT_OUT_S = 180.0  # kept back of a part run's time for them
FULL_COUNT = 300  # drawn as the shares of the suite have it; then sets with nothing missing until there are so many:
FULL_NULLS_COUNT = 150
FULL_SINGLES_COUNT = 150  # drawn besides, for the library without one effect
SPEED_SEED = 7006  # it draws four runs of both axes
_SPEED_RUNS_COUNT = 4
_SPEED_WORKERS_COUNT = 2
_SPEED_CASES = {"null": "nothing missing", "multi": "several effects"}
_REPEATS = {False: 2, True: 5}

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row."""
    begin_s = time.monotonic()
    say("speed, alone")
    yield from speed(full, say)
    yield from emps_figures.figures(say)
    give_back()  # the sets are searched by other processes
    if full:
        yield from _full(say)
    else:
        yield from _part(say, begin_s + PART_S)


def speed(full: bool, say: Say) -> Iterator[Figure]:
    """Time the whole search, warm, on four recordings of both axes: with nothing missing, and with several effects."""
    keep_freed()
    cases = {}
    for kind in ("null", "multi"):
        folder, truth = generated(Job(SPEED_SEED, kind, sets_folder()))
        if len(truth["runs"]) != _SPEED_RUNS_COUNT or truth["single_axis"]:
            reason = f"seed {SPEED_SEED} no longer draws four runs of both axes: choose another"
            yield from (absent(bar, reason) for bar in (SPEED, SERIAL_SPEED))
            return
        blind = load_set(folder)
        apart = held_out(blind)
        training = [log for k, log in enumerate(blind.logs) if k not in apart]
        cases[kind] = blind.believed, training, [blind.logs[k] for k in apart]
    find(*cases["null"])  # compiles
    for bar, workers_count in ((SPEED, _SPEED_WORKERS_COUNT), (SERIAL_SPEED, 1)):
        yield _timed(bar, cases, workers_count, _REPEATS[full], say)


def _timed(
    bar: Bar, cases: dict[str, tuple[Believed, list[Log], list[Log]]], workers_count: int, repeats: int, say: Say
) -> Figure:
    """Time each case some times; the machine may be shared, so what the processors worked is said as well."""
    medians_s: dict[str, float] = {}
    said = []
    for kind, case in cases.items():
        times_s, worked_s = [], []
        for _ in range(repeats):
            begin_s, worked_from_s = time.monotonic(), time.process_time()
            with crew_of(workers_count) as crew:
                find(*case, crew=crew)
            times_s.append(time.monotonic() - begin_s)
            worked_s.append(time.process_time() - worked_from_s)
            say(f"  {kind}, {workers_count} at work: {times_s[-1]:.1f} s, of processors {worked_s[-1]:.1f} s")
        medians_s[kind] = statistics.median(times_s)
        said.append(f"{_SPEED_CASES[kind]} {medians_s[kind]:.1f} s (of processors {statistics.median(worked_s):.1f} s)")
    load = os.getloadavg()[0]
    remark = f"medians of {repeats} on {os.cpu_count()} processors, load {load:.1f}, the slower one; {', '.join(said)}"
    return judged(bar, max(medians_s.values()), [SPEED_SEED], remark)


# ---- the suite -------------------------------------------------------------------------------------------------------


def _part(say: Say, until_s: float) -> Iterator[Figure]:
    workers = os.cpu_count() or 1
    jobs = [Job(seed, None, sets_folder()) for seed in PART_SEEDS]
    found = _marked(searched(jobs, workers, until_s - LEFT_OUT_S), say)
    yield from suite_figures.suite(found, full=False)
    yield from left_out.figures(_truths(found), False, say, PART_LEFT_OUT_COUNT, until_s)
    yield from suite_figures.effect_by_effect(found)


def _full(say: Say) -> Iterator[Figure]:
    begin_s = time.monotonic()
    run = final_seeds.begin()
    say(f"run {run.number} over the final seeds; it is in the record from now on")
    done = run.kept()
    end = final_seeds.FIRST_SEED + FULL_COUNT
    _search_all(
        [Job(seed, None, sets_folder(), keep=False) for seed in range(final_seeds.FIRST_SEED, end)], run, done, say
    )
    while missing := FULL_NULLS_COUNT - sum(_is_null(one) for one in done.values()):
        seeds = range(end, end := end + missing)
        _search_all([Job(seed, "null", sets_folder(), keep=False) for seed in seeds], run, done, say)
    found = [marked(done[seed]) for seed in sorted(done)]
    say(f"{FULL_SINGLES_COUNT} more sets with one effect are drawn: of each law one may show better that it is missing")
    drawn = measured(run.journal_of("truths"), range(end, end + FULL_SINGLES_COUNT), left_out.drawn_truths)
    truths = [*_truths(found), *(truth for _, truth in sorted(drawn))]
    results = [
        *suite_figures.suite(found, full=True),
        *left_out.figures(truths, True, say, None, float("inf"), run.journal_of),
        *suite_figures.effect_by_effect(found),
    ]
    run.end(done, results, time.monotonic() - begin_s)
    yield from results


def _search_all(jobs: Sequence[Job], run: final_seeds.FinalRun, done: dict[int, Searched], say: Say) -> None:
    """Search those that are not done yet, and keep them."""
    for one in searched([job for job in jobs if job.seed not in done], os.cpu_count() or 1):
        run.keep(one)
        done[one.seed] = one
        say(line(marked(one)))


def _truths(found: Iterable[Marked]) -> list[dict[str, Any]]:
    return [one.searched.truth for one in found if one.searched.truth is not None]


def _is_null(one: Searched) -> bool:
    return one.truth is not None and one.truth["kind"] == "null"


def _marked(found: Iterable, say: Say) -> list[Marked]:
    result = []
    for one in found:
        result.append(marked(one))
        say(line(result[-1]))
    return result
