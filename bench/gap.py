"""The gap workflow on data in which the effect is hidden from it: every figure that it promises, and its speed.

A part run takes development seeds and as many sets as fit a quarter of an hour; there a figure is missed only where
the 95 % interval excludes its bar. The full run takes the final seeds, judges the values themselves, and writes itself
into `docs/gap-results.json`.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterable, Iterator

from bench import emps_figures, final_seeds, suite_figures
from bench.blind_names import our_keys
from bench.blind_sets import Job, Marked, generated, held_out, line, load_set, marked, searched, sets_folder
from bench.figure import Bar, Figure, absent, judged
from stagectl.gap.workflow import find

ABOUT = (
    "Sets are those of `tests/blind`. A figure is missed where the 95 % interval excludes its bar; the full run judges "
    "the value itself. Bars are written in `bench/gap.py`, `bench/suite_figures.py` and `bench/emps_figures.py`."
)

SPEED = Bar("four recordings of 20 s at 1 kHz, full library, 200 nulls: time", "s", 30.0)

PART_SEEDS = range(7001, 7061)
PART_S = 780.0
PART_LEFT_OUT_COUNT = 4
LEFT_OUT_S = 100.0  # kept back of a part run's time for them
FULL_COUNT = 720
FULL_NULLS_COUNT = 150
_BATCH_COUNT = 40
SPEED_SEED = 7006  # it draws four runs of both axes
_SPEED_RUNS_COUNT = 4
_REPEATS = {False: 2, True: 5}

Say = Callable[[str], None]


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Measure every row."""
    begin_s = time.monotonic()
    say("speed, alone")
    yield speed(full, say)
    yield from emps_figures.figures(say)
    if full:
        yield from _full(say)
    else:
        yield from _part(say, begin_s + PART_S)


def speed(full: bool, say: Say) -> Figure:
    """Time the whole search, warm, on four recordings of both axes: with nothing missing, and with several effects."""
    medians_s: dict[str, float] = {}
    for kind in ("null", "multi"):
        folder, truth = generated(Job(SPEED_SEED, kind, sets_folder()))
        if len(truth["runs"]) != _SPEED_RUNS_COUNT or truth["single_axis"]:
            return absent(SPEED, f"seed {SPEED_SEED} no longer draws four runs of both axes: choose another")
        blind = load_set(folder)
        apart = held_out(blind)
        training = [log for k, log in enumerate(blind.logs) if k not in apart]
        held = [blind.logs[k] for k in apart]
        if not medians_s:
            find(blind.believed, training, held)  # compiles
        times_s = []
        for _ in range(_REPEATS[full]):
            begin_s = time.monotonic()
            find(blind.believed, training, held)
            times_s.append(time.monotonic() - begin_s)
            say(f"  {kind}: {times_s[-1]:.1f} s")
        medians_s[kind] = statistics.median(times_s)
    each = f"nothing missing {medians_s['null']:.1f} s, several effects {medians_s['multi']:.1f} s"
    remark = f"medians of {_REPEATS[full]} on {os.cpu_count()} processors, the slower one; {each}"
    return judged(SPEED, max(medians_s.values()), [SPEED_SEED], remark)


# ---- the suite -------------------------------------------------------------------------------------------------------


def _part(say: Say, until_s: float) -> Iterator[Figure]:
    workers = os.cpu_count() or 1
    jobs = [Job(seed, None, sets_folder()) for seed in PART_SEEDS]
    found = _marked(searched(jobs, workers, until_s - LEFT_OUT_S), say)
    yield from suite_figures.suite(found, full=False)
    yield left_out(found, False, say, PART_LEFT_OUT_COUNT, until_s)
    yield from suite_figures.effect_by_effect(found)


def _full(say: Say) -> Iterator[Figure]:
    begin_s = time.monotonic()
    run = final_seeds.begin()
    say(f"run {run.number} over the final seeds; it is in the record from now on")
    done = run.kept()
    count = FULL_COUNT
    while True:
        seeds = range(final_seeds.FIRST_SEED, final_seeds.FIRST_SEED + count)
        jobs = [Job(seed, None, sets_folder(), keep=False) for seed in seeds if seed not in done]
        for one in searched(jobs, os.cpu_count() or 1):
            run.keep(one)
            done[one.seed] = one
            say(line(marked(one)))
        nulls = sum(one.truth is not None and one.truth["kind"] == "null" for one in done.values())
        if nulls >= FULL_NULLS_COUNT:
            break
        count += _BATCH_COUNT
    found = [marked(done[seed]) for seed in sorted(done)]
    measured = [
        *suite_figures.suite(found, full=True),
        left_out(found, True, say, None, float("inf")),
        *suite_figures.effect_by_effect(found),
    ]
    run.end(done, measured, time.monotonic() - begin_s)
    yield from measured


def _marked(found: Iterable, say: Say) -> list[Marked]:
    result = []
    for one in found:
        result.append(marked(one))
        say(line(result[-1]))
    return result


# ---- the library without one of its effects --------------------------------------------------------------------------


def without(name: str, acts_on: str) -> frozenset[str]:
    """Return the names of our effects that answer to a law of the truth."""
    return frozenset(key[0] for key in our_keys(name, acts_on))


def left_out(found: list[Marked], full: bool, say: Say, most: int | None, until_s: float) -> Figure:
    """Search the first single of every effect again, with a library that lacks it."""
    first: dict[str, tuple[int, str | None, str, str]] = {}
    for one in found:
        truth = one.searched.truth
        if truth is not None and one.mark["category"] == "single":
            (member,) = truth["effects"]
            first.setdefault(member["name"], (one.searched.seed, None, member["name"], member["acts_on"]))
    chosen = list(first.values())[:most]
    jobs = [
        Job(seed, kind, sets_folder(), keep=not full, options=(("without", without(name, acts_on)),))
        for seed, kind, name, acts_on in chosen
    ]
    say(f"the library without one effect, {len(jobs)} times")
    again = []
    for one in searched(jobs, os.cpu_count() or 1, until_s):
        again.append(marked(one))
        right = suite_figures.left_out_right(again[-1])
        say(f"{'unknown or an alias' if right else 'MISNAMED or missed'}: {line(again[-1])}")
    remark = f"{len(again)} effects, each on a set that hides it alone"
    return suite_figures.left_out_figure(again, full, remark)
