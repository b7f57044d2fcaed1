"""The suite's arithmetic: marks of many blind sets as figures beside their bars, with intervals; pure.

In a part run a figure is called missed only where its 95 % interval excludes the bar; in the full run the value itself
is judged. Shares have Clopper-Pearson intervals, quantiles those of order statistics, ratios of sums a bootstrap over
the sets.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from bench.blind_sets import Marked
from bench.figure import Bar, Figure, absent
from tests.blind import score

SINGLES = Bar("one effect above twice its limit: named exactly, first", "%", 95.0, at_least=True)
MULTIPLES = Bar("pairs and triples, all above twice their limits: exact set", "%", 85.0, at_least=True)
NULLS = Bar("nothing missing: anything named", "%", 2.0)
OUTSIDE = Bar("effect outside the library, separable: called unknown", "%", 90.0, at_least=True)
BELOW = Bar("below the limit or not excited: no wrong name", "%", 98.0, at_least=True)
PARAMETER_ONLY = Bar("only a parameter wrong: that parameter, no effect", "%", 95.0, at_least=True)
SIZE_ERROR = Bar("parameter error above ten times the limit, median", "%", 3.0)
COVERAGE = "coverage of their 95 % intervals"
COVERAGE_LIMITS = (90.0, 99.0)
CLOSED = Bar("reducible gap closed on held-out runs, pooled", "%", 95.0, at_least=True)
CLOSED_DECILE = Bar("the same, worst decile of sets", "%", 80.0, at_least=True)
SET_SIZE = Bar("mean stated set over mean inseparable set", "ratio", 1.2)

CONFIDENCE = 0.95
DRAWS_COUNT = 2000
LEAST_REDUCIBLE_SDS = 3.0
WORST_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its interval, in the unit of its bar."""

    value: float
    low: float
    high: float
    remark: str


def share(right: int, count: int) -> Estimate:
    """Return a share in percent with its exact binomial interval."""
    low, high = score.clopper_pearson(right, count, CONFIDENCE)
    return Estimate(100.0 * right / count, 100.0 * low, 100.0 * high, f"{right} of {count}")


def quantile(values: Sequence[float], q: float) -> Estimate:
    """Return a quantile with the interval that order statistics give it, whatever the distribution."""
    ordered = np.sort(np.asarray(values, dtype=float))
    n, tail = ordered.size, 0.5 * (1.0 - CONFIDENCE)
    first = int(stats.binom.ppf(tail, n, q)) - 1
    last = int(stats.binom.ppf(1.0 - tail, n, q))
    # nearest rank: infinite errors (an amplitude that was not stated) are values too, and must not be interpolated
    value = ordered[max(math.ceil(q * n) - 1, 0)]
    low = float(ordered[first]) if first >= 0 else -math.inf
    high = float(ordered[last]) if last < n else math.inf
    return Estimate(float(value), low, high, f"{n} values")


def pooled(tops: Sequence[float], bottoms: Sequence[float], scale: float = 1.0, complement: bool = False) -> Estimate:
    """Return the ratio of two sums, or one minus it, with a bootstrap interval over their members."""
    top, bottom = np.asarray(tops, dtype=float), np.asarray(bottoms, dtype=float)
    drawn = np.random.default_rng(0).integers(0, top.size, (DRAWS_COUNT, top.size))
    sums = bottom[drawn].sum(axis=1)
    ratios = top[drawn].sum(axis=1)[sums > 0.0] / sums[sums > 0.0]
    value = float(top.sum() / bottom.sum())
    if complement:
        value, ratios = 1.0 - value, 1.0 - ratios
    low, high = np.quantile(ratios, [0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)])
    return Estimate(scale * value, scale * float(low), scale * float(high), f"{top.size} members")


def judged_estimate(bar: Bar, estimate: Estimate, seeds: list[int], full: bool, remark: str = "") -> Figure:
    """Hold an estimate against its bar: the value in a full run, else the end of the interval that is nearest to it."""
    value = estimate.value if full else estimate.high if bar.at_least else estimate.low
    holds = None
    if bar.limit is not None:
        holds = bool(value >= bar.limit) if bar.at_least else bool(value <= bar.limit)
    return Figure(bar.figure, estimate.value, bar.unit, bar.text, holds, seeds, _remark(estimate, bar.unit, remark))


def coverage_figure(covered: int, count: int, seeds: list[int], full: bool, remark: str = "") -> Figure:
    """Hold the coverage of intervals between its two limits."""
    low, high = COVERAGE_LIMITS
    text = f"{low:g} to {high:g} %"
    if not count:
        return Figure(COVERAGE, None, "%", text, None, [], "no effect above ten times its limit was named")
    found = share(covered, count)
    holds = low <= found.value <= high if full else found.high >= low and found.low <= high
    return Figure(COVERAGE, found.value, "%", text, bool(holds), seeds, _remark(found, "%", remark))


def _remark(estimate: Estimate, unit: str, more: str) -> str:
    text = f"{estimate.remark}; 95 % interval {_end(estimate.low)} to {_end(estimate.high)} {unit}"
    return f"{text}; {more}" if more else text


def _end(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "no end"


def suite(all_marked: Sequence[Marked], full: bool) -> Iterator[Figure]:
    """Yield a figure for every bar that the marks of many sets speak of."""
    seeds = sorted(one.searched.seed for one in all_marked)
    yield _category(SINGLES, all_marked, "single", full, seeds)
    yield _category(MULTIPLES, all_marked, "multi", full, seeds)
    yield _category(NULLS, all_marked, "null", full, seeds, wrong=True)
    yield _category(OUTSIDE, all_marked, "outside", full, seeds)
    yield _category(BELOW, all_marked, "below_limit", full, seeds)
    yield _category(PARAMETER_ONLY, all_marked, "parameter", full, seeds)
    yield from _sizes(all_marked, seeds, full)
    yield from _gaps(all_marked, seeds, full)
    yield _set_size(all_marked, seeds, full)
    lost = [one for one in all_marked if one.searched.truth is None]
    if lost:  # the generator or a worker gave up: no bar would notice
        bar = Bar("sets that could not be judged at all", "sets", 0.0)
        yield Figure(bar.figure, len(lost), bar.unit, bar.text, False, seeds, lost[0].searched.error)


def _category(
    bar: Bar, all_marked: Sequence[Marked], name: str, full: bool, seeds: list[int], wrong: bool = False
) -> Figure:
    own = [one for one in all_marked if one.searched.truth is not None and one.mark["category"] == name]
    if not own:
        return absent(bar, "no such set among the seeds")
    hits = sum(bool(one.right) != wrong for one in own)
    failed = [one for one in own if not one.right]
    texts = [f"{one.searched.seed} {one.label}" for one in failed[:6]]
    more = f"; {', '.join(texts)}{' ...' if len(failed) > len(texts) else ''}" if texts else ""
    found = share(hits, len(own))
    return judged_estimate(bar, found, seeds, full, more.removeprefix("; "))


def _sizes(all_marked: Sequence[Marked], seeds: list[int], full: bool) -> Iterator[Figure]:
    marks = [
        mark
        for one in all_marked
        if one.mark["category"] in ("single", "multi")
        for mark in score.parameter_marks(one.mark["pairs"])
    ]
    if not marks:
        yield absent(SIZE_ERROR, "no effect above ten times its limit was named")
        yield coverage_figure(0, 0, seeds, full)
        return
    yield judged_estimate(SIZE_ERROR, quantile([100.0 * error for error, _ in marks], 0.5), seeds, full)
    covered = [cover for _, cover in marks if cover is not None]
    silent = len(marks) - len(covered)
    yield coverage_figure(sum(covered), len(covered), seeds, full, f"{silent} without an interval" if silent else "")


def _gaps(all_marked: Sequence[Marked], seeds: list[int], full: bool) -> Iterator[Figure]:
    own = [
        one.searched
        for one in all_marked
        if one.mark["category"] in ("single", "multi") and not one.searched.error and one.searched.reducible[0] > 0.0
    ]
    if not own:
        yield absent(CLOSED, "no set with a reducible gap")
        yield absent(CLOSED_DECILE, "no set with a reducible gap")
        return
    apart = sum(one.held_count > 0 for one in own)
    estimate = pooled([one.reducible[1] for one in own], [one.reducible[0] for one in own], 100.0, complement=True)
    remark = (
        f"squares of the innovations beyond the floor; {apart} sets with a run apart, the others by leaving one out"
    )
    yield judged_estimate(CLOSED, estimate, seeds, full, remark)
    clear = [one for one in own if one.reducible[0] >= LEAST_REDUCIBLE_SDS * one.reducible_sd]
    if not clear:
        yield absent(CLOSED_DECILE, "no set whose gap is three standard errors of its floor")
        return
    shares = [100.0 * (1.0 - one.reducible[1] / one.reducible[0]) for one in clear]
    worst = min(clear, key=lambda one: 1.0 - one.reducible[1] / one.reducible[0])
    yield judged_estimate(CLOSED_DECILE, quantile(shares, WORST_SHARE), seeds, full, f"worst: seed {worst.seed}")


def _set_size(all_marked: Sequence[Marked], seeds: list[int], full: bool) -> Figure:
    stated, own = [], []
    for one in all_marked:
        if one.mark["category"] in ("single", "multi"):
            for found, member in one.mark["pairs"]:
                stated.append(1.0 + len(found.get("alias_set", ())))
                own.append(1.0 + len(member["inseparable"]))
    if not stated:
        return absent(SET_SIZE, "nothing was named rightly")
    return judged_estimate(SET_SIZE, pooled(stated, own), seeds, full, f"mean stated set {np.mean(stated):.2f}")


def effect_by_effect(all_marked: Sequence[Marked]) -> Iterator[Figure]:
    """Yield recall of every effect that was hidden above twice its limit or named, precision beside it; not judged."""
    usable = [one for one in all_marked if one.searched.truth is not None]
    rows = score.summary([one.mark for one in usable], [one.searched.truth for one in usable])["by_name"]
    for name, row in rows.items():
        value = 100.0 * row["hidden_and_found"] / row["hidden"] if row["hidden"] else None
        precision = f"{100.0 * row['rightly'] / row['named']:.0f} %" if row["named"] else "-"
        text = (
            f"found {row['hidden_and_found']} of {row['hidden']}; "
            f"precision {precision}, {row['rightly']} of {row['named']} names right"
        )
        yield Figure(f"recall of {name}", value, "%", "reported", None, [], text)
