"""The paper's method as printed and corrected, and what the project's identification makes of the paper's tests.

Rows of the chapters are reported beside the paper's number; bars are those of the identification, of its cost, of
control at the limit (`bench.control_limit`), and of the time that `stagectl reproduce` takes from nothing.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from bench import (
    ablation,
    adaptive_drift,
    control_disturbed,
    control_limit,
    identification_limit,
    identification_wire,
    learning,
    limits,
)
from bench.figure import Bar, Figure, judged
from stagectl.paper import gated, identification_test, recursive_least_squares, rig_chapter
from stagectl.paper.chapters import CHAPTERS, work_through
from stagectl.paper.identification_test import Samples
from stagectl.paper.observer_chapter import axes_of
from stagectl.paper.printed_values import MACRO_OBSERVER_5_2, RIG_6_1, TABLE_2
from stagectl.paper.recursive_least_squares import errors_percent
from stagectl.paper.rivals import BETTER, compared
from stagectl.paper.rows import Chapter

ABOUT = (
    "As printed and corrected: `docs/paper.md` says where each equation stands. "
    "Bars are written in `bench/paper.py` and `bench/control_limit.py`. Remarks say where a linear rival, or the law "
    "without a part, is better."
)

TABLE_2_ERROR = Bar("identification, Table 2 test, 100 nm, exact masses: worst of four", "%", 0.001)
TABLE_2_TIME = Bar("identification, Table 2 test, 100 nm: all four within 1 % after the second contact", "s", 0.2)
RIG_ERROR = Bar("identification, rig's joint at 0.5 Hz, 1-100 nm, contact damping: worst of four, worst seed", "%", 0.1)
RIG_ERROR_SOON = Bar("the same after 20 s", "%")
COVERED_LEAST = Bar(
    "identification, rig's joint, 100 nm: 95 % intervals that hold the truth, least of four", "%", 90.0, True
)
COVERED_MOST = Bar("the same, most of four", "%", 99.0)
COST = Bar("identification, a step, compiled", "us", 2.0)
PAPER_COST = Bar("the paper's observer and recursion, a step, compiled", "us")
RIVAL_WINS = Bar("PID + feed-forward: rows in which it is better than DSMC", "rows")
COLD = Bar("stagectl reproduce, nothing compiled: time", "s", 120.0)

_SEEDS = range(1, 6)
_RIG_SEEDS = range(1, 21)
_INTERVAL_SEEDS = range(1, 201)
_NORMAL_95 = 1.96
_NAMES = ("left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m")
_NOISE_M = 100e-9
_RIVAL = "PID + feed-forward"

Say = Callable[[str], None]


def figures(*, full: bool, say: Say, part: str | None = None) -> Iterator[Figure]:
    """Measure every row, or those of one part."""
    for name, measure in PARTS.items():
        if part in (None, name):
            begin_s = time.monotonic()
            say(name)
            yield from measure(full=full, say=say)
            say(f"{name}: {time.monotonic() - begin_s:.0f} s")


def _paper_tests(*, full: bool, say: Say) -> Iterator[Figure]:
    """Identify on the paper's own tests; `full` changes nothing: the seeds are those of the bars."""
    samples = identification_test.run(identification_test.platform(), 60.0)
    say("identification")
    yield from _table_2(samples)
    yield from _rig()
    yield from _costs(samples)


def _chapters(*, full: bool, say: Say) -> Iterator[Figure]:
    for chapter in work_through(tuple(CHAPTERS), lambda what, _: say(what)):
        yield from figures_of(chapter)


def figures_of(chapter: Chapter) -> Iterator[Figure]:
    """Report every number of a chapter, metres in um."""
    for row in chapter.rows:
        scale, unit = (1e6, "um") if row.unit == "m" else (1.0, row.unit)
        said = f"the paper: {row.paper * scale:g} {unit}" if isinstance(row.paper, float) else ""
        for which, value in (("as printed", row.printed), ("corrected", row.corrected)):
            if isinstance(value, float):
                quantity = re.sub(r"\|(\w+)\|", r"abs(\1)", row.quantity)  # a bar would end the cell of a table
                bar = Bar(f"{chapter.section} {row.equation} {quantity}: {which}", unit)
                yield judged(bar, value * scale, reason=said)


def _control(*, full: bool, say: Say) -> Iterator[Figure]:
    """Control at the limit; to each of the rival's rows it is said what DSMC has there, and who is better."""
    yield from beside_ours(control_limit.figures(full=full, say=say))


def beside_ours(figures: Iterable[Figure]) -> Iterator[Figure]:
    """Give rows through, those of a rival with DSMC's number of before and who is better; at last where it wins."""
    ours: dict[str, Figure] = {}
    wins: list[str] = []
    count = 0
    for figure in figures:
        is_rival = figure.figure.startswith(_RIVAL)
        what = figure.figure.removeprefix(f"{_RIVAL}: ").removeprefix("control, ")
        what = re.sub(r" \([^)]*\)", "", what)  # what the macro is like stands there
        our = ours.get(what)
        if not is_rival:
            ours[what] = figure
        elif our is not None and our.value is not None and figure.value is not None:
            how = compared(figure.value, our.value)
            count += 1
            wins += [what] * (how == BETTER)
            said = f"DSMC has {our.value:.3g} {our.unit}: {_RIVAL} is {how}"
            figure = replace(figure, reason="; ".join(filter(None, (figure.reason, said))))
        yield figure
    if count:
        yield judged(RIVAL_WINS, len(wins), reason=f"of {count}: {', '.join(wins) or 'none'}")


def _cold(*, full: bool, say: Say) -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        begin_s = time.monotonic()
        subprocess.run(
            [sys.executable, "-m", "stagectl.cli", "reproduce", "--out", folder, "--json"],
            check=True,
            capture_output=True,
            env=os.environ | {"STAGECTL_CACHE": f"{folder}/cache"},
        )
        yield judged(COLD, time.monotonic() - begin_s, reason=f"{os.cpu_count()} processors")


def _noisy(samples: Samples, seed: int) -> gated.Gated:
    noise_m = np.random.default_rng(seed).standard_normal((2, samples.t_s.size)) * _NOISE_M
    return gated.along(samples.macro_position_m + noise_m[0], samples.end_position_m + noise_m[1], 400.0, 100.0)


def _table_2(samples: Samples) -> Iterator[Figure]:
    found = [_noisy(samples, seed) for seed in _SEEDS]
    worst = max(abs(error) for one in found for error in errors_percent(one.last, TABLE_2).values())
    yield judged(TABLE_2_ERROR, worst, list(_SEEDS))
    second_s = float(samples.t_s[np.flatnonzero(samples.x_b_m < -TABLE_2.left_m)[0]])
    times_s = []
    for one in found:
        outside = np.zeros(samples.t_s.size, bool)
        for name in _NAMES:
            outside |= ~(np.abs(getattr(one, name) / getattr(TABLE_2, name) - 1.0) < 0.01)
        times_s.append(float(samples.t_s[np.flatnonzero(outside)[-1]]) - second_s)
    yield judged(TABLE_2_TIME, max(times_s), list(_SEEDS), "within 1 % for good; the left side is touched second")


def _rig() -> Iterator[Figure]:
    for bar, duration_s in ((RIG_ERROR, 60.0), (RIG_ERROR_SOON, 20.0)):
        _, samples = rig_chapter.recording(duration_s)
        found = [
            rig_chapter.identified(samples, noise_m, seed) for noise_m in rig_chapter.NOISES_M for seed in _RIG_SEEDS
        ]
        worst = max(rig_chapter.worst(found, name) for name in ("b_l", "b_r", "K_l", "K_r"))
        yield judged(bar, worst, list(_RIG_SEEDS), f"{duration_s:g} s each, exact masses")
    _, samples = rig_chapter.recording()
    held = dict.fromkeys(_NAMES, 0)
    for seed in _INTERVAL_SEEDS:
        one = rig_chapter.identified(samples, _NOISE_M, seed)
        for name in _NAMES:
            off = abs(getattr(one.last, name) - getattr(RIG_6_1, name))
            held[name] += off <= _NORMAL_95 * getattr(one.sd, name)
    shares = [100.0 * count / len(_INTERVAL_SEEDS) for count in held.values()]
    remark = (
        f"20 s each, exact masses; {', '.join(f'{n} {share:.0f} %' for n, share in zip(_NAMES, shares, strict=True))}"
    )
    yield judged(COVERED_LEAST, min(shares), list(_INTERVAL_SEEDS), remark)
    yield judged(COVERED_MOST, max(shares), list(_INTERVAL_SEEDS), remark)


def _costs(samples: Samples) -> Iterator[Figure]:
    macro = axes_of(identification_test.platform(), samples)[0]

    def ours() -> None:
        gated.along(samples.macro_position_m, samples.end_position_m, 400.0, 100.0)

    def theirs() -> None:
        force_n = macro.force_n(macro.observed(MACRO_OBSERVER_5_2))
        recursive_least_squares.along(recursive_least_squares.init(1.0), samples.x_b_m, force_n, TABLE_2)

    for bar, work in ((COST, ours), (PAPER_COST, theirs)):
        yield identification_limit.cost(bar, work, samples.t_s.size)


PARTS: dict[str, Callable[..., Iterator[Figure]]] = {
    "cold": _cold,
    "identification": _paper_tests,
    "identification-limit": identification_limit.figures,
    "identification-wire": identification_wire.figures,
    "control": _control,
    "disturbed": control_disturbed.figures,
    "adaptive-drift": adaptive_drift.figures,
    "bounds": limits.figures,
    "ablation": ablation.figures,
    "learning": learning.figures,
    "chapters": _chapters,
}
"""By the name that `--part` takes."""
