"""General tools on the same logs and the same split: which names they give, what they leave, how long they take.

    python -m bench.peers [--sets N] [--markdown FILE]

All get the same rows and columns (`bench/regression.py`: filtered, reversals masked, known parameters taken out under
their priors, pitches from the spectrum), which is more help than their documents ask for; once the whole library, and
once its force laws alone, which regress better. Each one runs as its own
documents advise, with what it leaves to the user chosen on training recordings only: by the error on blocks of them
that a fit did not see, the sparsest within one standard error of the best. Install them with `pip install '.[peers]'`,
in an environment of their own: jax-sysid holds scipy at 1.14.
"""

import argparse
import importlib.util
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from bench import emps
from bench.blind_names import in_words_of_the_truth
from bench.blind_sets import Job, generated, held_out, load_set, sets_folder
from bench.regression import LEFT_OUT, Problem, problem_of
from stagectl.effects import CATALOGUE
from stagectl.errors import StagectlError
from stagectl.gap import addition, arbiter
from stagectl.gap.believed import Believed
from stagectl.gap.findings import Findings, Named
from stagectl.gap.hypotheses import Term, phase_of
from stagectl.gap.log import Log
from stagectl.gap.workflow import find
from tests.blind import score

SINGLE_SEEDS, NULL_SEEDS, OUTSIDE_SEEDS = range(8001, 8200), range(8201, 8300), range(8301, 8400)
SETS_COUNT = 4
_BLOCKS_COUNT = 6
_ALPHA = 0.01
_MOST_TERMS = 20
_STLSQ_THRESHOLDS = np.geomspace(0.01, 3.0, 8)
_L1_WEIGHTS = np.geomspace(1e-4, 0.3, 6)
_ZERO = 1e-4

Fit = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(rows, columns of unit size) -> coefficients."""


# ---- the tools -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Tool:
    """A peer: how it is run, and what it can't say."""

    name: str
    module: str
    fit: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    setting: str
    cannot: str


def stepwise(left: np.ndarray, columns: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Add the column with the largest F as long as p < 0.01, and take back what has fallen above it."""
    chosen: list[int] = []
    for _ in range(3 * _MOST_TERMS):
        rest = left - columns[:, chosen] @ _least_squares(columns[:, chosen], left)
        free = left.size - len(chosen) - 1
        clean = columns - columns[:, chosen] @ np.linalg.lstsq(columns[:, chosen], columns, rcond=None)[0]
        size = np.einsum("ij,ij->j", clean, clean)
        usable = size > 1e-8 * np.einsum("ij,ij->j", columns, columns)
        gain = np.where(usable, (rest @ clean) ** 2 / np.where(usable, size, 1.0), 0.0)
        gain[chosen] = 0.0
        best = int(np.argmax(gain))
        if not stats.f.sf(gain[best] / ((rest @ rest - gain[best]) / free), 1, free) < _ALPHA:
            break
        chosen.append(best)
        chosen = _still_significant(left, columns, chosen)
        if len(chosen) >= _MOST_TERMS:
            break
    return _spread(_least_squares(columns[:, chosen], left), chosen, columns.shape[1])


def _still_significant(left: np.ndarray, columns: np.ndarray, chosen: list[int]) -> list[int]:
    while len(chosen) > 1:
        part = columns[:, chosen]
        values = _least_squares(part, left)
        rest = left - part @ values
        variance = rest @ rest / (left.size - len(chosen))
        t_squared = values**2 / (variance * np.diag(np.linalg.pinv(part.T @ part)))
        worst = int(np.argmin(t_squared))
        if stats.f.sf(t_squared[worst], 1, left.size - len(chosen)) < _ALPHA:
            break
        chosen = chosen[:worst] + chosen[worst + 1 :]
    return chosen


def pysindy_stlsq(left: np.ndarray, columns: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Sequentially thresholded least squares, its threshold from a scan."""
    from pysindy.optimizers import STLSQ  # pyright: ignore[reportMissingImports]

    def of(threshold: float) -> Fit:
        def fit(rows: np.ndarray, part: np.ndarray) -> np.ndarray:
            optimizer = STLSQ(threshold=threshold, alpha=0.05, max_iter=50)
            return np.ravel(optimizer.fit(part, rows[:, None]).coef_)

        return fit

    return _scanned(left, columns, blocks, [of(float(t)) for t in _STLSQ_THRESHOLDS])


def sysidentpy_frols(left: np.ndarray, columns: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Forward regression by the error reduction ratio, its length by Bayes' information criterion."""
    from sysidentpy.basis_function import Polynomial  # pyright: ignore[reportMissingImports]
    from sysidentpy.model_structure_selection import FROLS  # pyright: ignore[reportMissingImports]
    from sysidentpy.parameter_estimation import LeastSquares  # pyright: ignore[reportMissingImports]

    count = columns.shape[1]
    model = FROLS(
        order_selection=True,
        info_criteria="bic",
        n_info_values=min(_MOST_TERMS, count),
        model_type="NFIR",
        xlag=[[1]] * count,
        estimator=LeastSquares(),
        basis_function=Polynomial(degree=1),
    )
    # its inputs act one row later: an input of the row before is the column of this row
    model.fit(X=np.vstack([columns, columns[-1:]]), y=np.concatenate([[0.0], left])[:, None])
    found = np.zeros(count)
    for code, value in zip(np.ravel(np.asarray(model.final_model)[:, 0]), np.ravel(model.theta), strict=True):
        if code:  # 0 is a constant
            found[int(code) // 1000 - 2] = value
    return found


def jax_sysid_l1(left: np.ndarray, columns: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """A static model, linear in its parameters, under L1; its weight from a scan, then refitted without it."""
    import jax  # pyright: ignore[reportMissingImports]
    from jax_sysid.models import StaticModel  # pyright: ignore[reportMissingImports]

    jax.config.update("jax_enable_x64", True)
    count = columns.shape[1]

    @jax.jit
    def output(inputs: Any, parameters: Any) -> Any:
        return inputs @ parameters[0].T

    def of(weight: float) -> Fit:
        def fit(rows: np.ndarray, part: np.ndarray) -> np.ndarray:
            model = StaticModel(1, count, output)
            model.init(params=[np.zeros((1, count))])
            model.loss(rho_th=1e-8, tau_th=weight, zero_coeff=_ZERO)
            model.optimization(adam_epochs=0, lbfgs_epochs=300, iprint=-1)
            model.fit(rows[:, None], part)
            kept = np.flatnonzero(np.abs(np.ravel(np.asarray(model.params[0]))) > _ZERO)
            return _spread(_least_squares(part[:, kept], rows), kept, count)

        return fit

    return _scanned(left, columns, blocks, [of(float(w)) for w in _L1_WEIGHTS])


TOOLS = (
    Tool("stepwise least squares", "numpy", stepwise, "in and out at p = 0.01", "states no alias and no unknown"),
    Tool(
        "pysindy",
        "pysindy",
        pysindy_stlsq,
        "STLSQ, columns of unit size, threshold scanned",
        "no intervals, no alias, no unknown; laws with a past only as columns made for it",
    ),
    Tool(
        "sysidentpy",
        "sysidentpy",
        sysidentpy_frols,
        "FROLS, NFIR, BIC",
        "from raw logs polynomial lags, which name nothing; no alias, no unknown",
    ),
    Tool(
        "jax-sysid",
        "jax_sysid",
        jax_sysid_l1,
        "StaticModel, L1 scanned, refitted",
        "fits a structure that is given: names only through L1 on given columns; no alias, no unknown",
    ),
)


def _least_squares(columns: np.ndarray, left: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(columns, left, rcond=None)[0]


def _spread(values: np.ndarray, places: Sequence[int] | np.ndarray, count: int) -> np.ndarray:
    whole = np.zeros(count)
    whole[np.asarray(places, int)] = values
    return whole


def _scanned(left: np.ndarray, columns: np.ndarray, blocks: np.ndarray, fits: Sequence[Fit]) -> np.ndarray:
    """Choose among settings, many terms first, by blocks that a fit did not see: the sparsest within one error."""
    left, columns, blocks = _compressed(left, columns, blocks)
    errors = np.zeros((len(fits), _BLOCKS_COUNT))
    for place, fit in enumerate(fits):
        for block in range(_BLOCKS_COUNT):
            apart = blocks == block
            coefficients = fit(left[~apart], columns[~apart])
            errors[place, block] = np.mean((left[apart] - columns[apart] @ coefficients) ** 2)
    means = errors.mean(axis=1)
    best = int(np.argmin(means))
    limit = means[best] + errors[best].std(ddof=1) / np.sqrt(_BLOCKS_COUNT)
    sparsest = max(place for place, mean in enumerate(means) if mean <= limit)
    return fits[sparsest](left, columns)


def _compressed(left: np.ndarray, columns: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Replace the rows of each block by as many as there are columns: no sum of squares changes, a fit is faster."""
    parts, numbers = [], []
    for block in range(_BLOCKS_COUNT):
        own = np.column_stack([columns, left])[blocks == block]
        small = np.asarray(np.linalg.qr(own, mode="r")) if own.shape[0] > own.shape[1] else own
        parts.append(small)
        numbers.append(np.full(small.shape[0], block))
    rows = np.vstack(parts)
    rows *= np.sqrt(rows.shape[0] / left.size)  # columns keep their mean square
    return rows[:, -1], rows[:, :-1], np.concatenate(numbers)


# ---- one case --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Case:
    """Recordings with what is believed; the truth where it is known."""

    name: str
    kind: str  # single, null, outside, emps
    believed: Believed
    training: tuple[Log, ...]
    held: tuple[Log, ...]
    truth: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one tool made of one case."""

    case: Case
    named: tuple[Named, ...]
    gap_n: tuple[float, float]  # one step: force left on training and held-out rows
    took_s: float
    closed_n: tuple[float, float] = (float("nan"), float("nan"))  # closed loop, where the controller is known
    error: str = ""
    verdict: str = ""

    def mark(self) -> dict[str, Any]:
        """Mark the names by the suite's bars; a peer's verdict is what its names say."""
        found = _findings(self.named, self.verdict)
        return score.score(in_words_of_the_truth(found), self.case.truth)


def _findings(named: tuple[Named, ...], verdict: str) -> Findings:
    verdict = verdict or ("found" if named else "nothing")
    nothing = (0.0, 0.0)
    return Findings("", (), (), verdict, named, (), {}, (), None, nothing, nothing, 0.0)


def run_tool(tool: Tool, case: Case, problem: Problem) -> Outcome:
    """Let one tool choose among the columns; an error is a result."""
    begin_s = time.monotonic()
    try:
        left, columns = problem.cleaned()
        size = np.sqrt(np.mean(columns**2, axis=0))
        used = np.flatnonzero(size > 1e-9 * size.max())
        blocks = np.arange(left.size) * _BLOCKS_COUNT // left.size
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of convergence and collinear columns: their own
            values = np.asarray(tool.fit(left, columns[:, used] / size[used], blocks), dtype=float)
        took_s = time.monotonic() - begin_s
        coefficients = _spread(values / size[used], used, columns.shape[1])
        named = tuple(_named(problem, term, coefficients) for term in _keyed(problem.chosen(coefficients)))
        rows = [row for term in problem.chosen(coefficients) for row in _rows(problem, term, coefficients)]
        return Outcome(
            case, named, problem.gap_n(coefficients), took_s, _closed(case, rows, problem.refitted(coefficients))
        )
    except Exception as error:  # noqa: BLE001  a tool that fails on one case is a row of the table, not its end
        nan = float("nan")
        return Outcome(case, (), (nan, nan), time.monotonic() - begin_s, error=f"{type(error).__name__}: {error}")


def run_ours(case: Case, problem: Problem) -> Outcome:
    """Let the gap workflow work on the logs themselves; its names are put on the same rows."""
    begin_s = time.monotonic()
    findings = find(case.believed, case.training, case.held)
    took_s = time.monotonic() - begin_s
    keys = {(one.name, one.acts_on) for one in findings.named}
    left, columns = problem.cleaned()
    own = [c for c, k in enumerate(problem.owner) if problem.terms[k].key in keys]
    coefficients = _spread(_least_squares(columns[:, own], left), own, columns.shape[1])
    rows = [addition.table_of(one, log.session) for log in case.training[:1] for one in findings.named]
    again = [addition.table_of(one, log.session) for log in case.held[:1] for one in findings.named]
    refitted = findings.refitted
    closed = (_closed(case, rows, refitted)[0], _closed(case, again or rows, refitted)[1])
    return Outcome(case, findings.named, problem.gap_n(coefficients), took_s, closed, verdict=findings.verdict)


def _keyed(terms: list[Term]) -> list[Term]:
    """Take one term of each name: several shapes of one effect are one name."""
    return list({term.key: term for term in terms}.values())


def _named(problem: Problem, term: Term, coefficients: np.ndarray) -> Named:
    (row, *_) = _rows(problem, term, coefficients)
    values = {key: value for key, value in row.items() if key not in ("name", "acts_on")}
    return Named(term.name, term.acts_on, values, {}, 0.0, 0.0, ())


def _rows(problem: Problem, term: Term, coefficients: np.ndarray) -> Iterator[dict[str, Any]]:
    """Write a term with its coefficients as an effect of a model."""
    place = next(k for k, other in enumerate(problem.terms) if other is term)
    own = coefficients[problem.owner == place]
    values = dict.fromkeys(CATALOGUE[term.name].parameters, 0.0) | term.shape
    if not term.linear:
        (first, value), *_ = term.shape.items()
        values[first] = float(own[0]) * value
    elif term.amplitudes[0].endswith("*"):
        for k in range(0, own.size, 2):
            name = term.amplitudes[k].removesuffix("*")
            values[name] = float(np.hypot(own[k], own[k + 1]))
            values[str(phase_of(CATALOGUE[term.name], name))] = float(np.arctan2(own[k + 1], own[k]))
    else:
        values |= {name: float(value) for name, value in zip(term.amplitudes, own, strict=True)}
    yield {"name": term.name, "acts_on": term.acts_on} | values


def _closed(case: Case, rows: list[dict[str, Any]], refitted: dict[str, float]) -> tuple[float, float]:
    """Return the force gap of the simulated closed loop on a training and a held-out recording."""
    effects: list[dict[str, Any]] = []
    for row in case.believed.effects:
        error = refitted.get(f"{row['name']} on {row['acts_on']}", 0.0)
        effects.append({**row, **{name: row[name] * (1.0 + error) for name in CATALOGUE[row["name"]].linear}})
    first, last = case.training[0], (case.held or case.training)[0]
    return (
        _force_gap_n(case, first, effects + rows, refitted),
        _force_gap_n(case, last, effects + rows, refitted),
    )


def _force_gap_n(case: Case, log: Log, effects: list[dict[str, Any]], refitted: dict[str, float]) -> float:
    """Return the force gap of one recording; nan where no controller is known or the simulation runs away."""
    if arbiter.cannot_close(case.believed, log):
        return float("nan")
    try:
        with np.errstate(all="ignore"):
            return arbiter.gap_of(log, arbiter.simulate(case.believed, effects, log, refitted)).command_n
    except (StagectlError, ValueError, FloatingPointError):
        return float("nan")


# ---- cases -----------------------------------------------------------------------------------------------------------


def emps_case() -> Case | None:
    """Return the real axis, None where its data is not at hand."""
    path = emps.folder()
    if path is None:
        return None
    believed, training, held = emps.read(path)
    return Case("EMPS", "emps", believed, tuple(training), tuple(held))


def blind_cases(count: int) -> Iterator[Case]:
    """Yield `count` singles above twice their limit, as many nulls, and as many with an effect of no library."""
    for kind, seeds in (("single", SINGLE_SEEDS), ("null", NULL_SEEDS), ("outside", OUTSIDE_SEEDS)):
        found = 0
        for seed in seeds:
            folder, truth = generated(Job(seed, kind, sets_folder()))
            if score.category(truth) != kind or any(one["name"] in LEFT_OUT for one in truth["effects"]):
                continue
            blind = load_set(folder)
            apart = held_out(blind)
            training = tuple(log for k, log in enumerate(blind.logs) if k not in apart)
            yield Case(str(seed), kind, blind.believed, training, tuple(blind.logs[k] for k in apart), truth)
            found += 1
            if found == count:
                break


# ---- the table -------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Tally:
    """All outcomes of one tool."""

    name: str
    setting: str
    cannot: str
    outcomes: list[Outcome] = field(default_factory=list)
    absent: str = ""


HEADER = (
    "tool", "setting", "singles: exact", "true name among", "names a single", "nulls: named", "names a null",
    "outside: not misnamed", "held-out force, one step", "EMPS: right / wrong / other names",
    "EMPS force gap, closed loop", "time a case", "can't",
)  # fmt: skip


def row(tally: Tally) -> tuple[str, ...]:
    """Lay one tool's outcomes out as a row."""
    if tally.absent:
        return (tally.name, tally.absent, *["-"] * (len(HEADER) - 3), tally.cannot)
    by_kind = {kind: [one for one in tally.outcomes if one.case.kind == kind] for kind in ("single", "null", "outside")}
    singles = [one.mark() for one in by_kind["single"]]
    nulls = [one.mark() for one in by_kind["null"]]
    outside = [one.mark() for one in by_kind["outside"]]
    real = next((one for one in tally.outcomes if one.case.kind == "emps"), None)
    ratios = [one.gap_n[1] for one in by_kind["single"] if np.isfinite(one.gap_n[1])]
    return (
        tally.name,
        tally.setting,
        f"{sum(mark['right'] for mark in singles)} of {len(singles)}",
        f"{sum(bool(mark['pairs']) for mark in singles)} of {len(singles)}",
        _mean([len(mark["named"]) for mark in singles]),
        f"{sum(bool(mark['named']) for mark in nulls)} of {len(nulls)}",
        _mean([len(mark["named"]) for mark in nulls]),
        f"{sum(not mark['named'] for mark in outside)} of {len(outside)}",
        f"{np.median(ratios):.3g} N" if ratios else "-",
        _emps_names(real),
        "-" if real is None else f"{_newtons(real.closed_n[0])} / {_newtons(real.closed_n[1])}",
        f"{np.median([one.took_s for one in tally.outcomes]):.1f} s" if tally.outcomes else "-",
        _cannot(tally),
    )


def _mean(counts: list[int]) -> str:
    return f"{np.mean(counts):.1f}" if counts else "-"


def _newtons(value: float) -> str:
    return f"{value:.2f} N" if np.isfinite(value) else "runs away"


def _emps_names(real: Outcome | None) -> str:
    if real is None:
        return "no data"
    names = {"cogging" if one.name == "harmonic_cogging" else one.name for one in real.named}
    right, wrong = names & set(emps.RIGHT), names & set(emps.WRONG)
    return f"{len(right)} of {len(emps.RIGHT)} / {len(wrong)} / {len(names) - len(right) - len(wrong)}"


def _cannot(tally: Tally) -> str:
    failed = [one for one in tally.outcomes if one.error]
    return f"{tally.cannot}; failed on {len(failed)}: {failed[0].error[:80]}" if failed else tally.cannot


def table(tallies: Sequence[Tally]) -> str:
    """Lay all tools out as a Markdown table."""
    rows = [HEADER, *(row(tally) for tally in tallies)]
    lines = ["| " + " | ".join(cells) + " |" for cells in rows]
    lines.insert(1, "|" + "---|" * len(HEADER))
    return "\n".join(lines)


def compare(cases: Sequence[Case], say: Callable[[str], None]) -> list[Tally]:
    """Run every tool that is installed on every case."""
    ours = Tally("stagectl gap", "as it comes", "names only what its library or the user's own file has")
    runs: list[tuple[Tool, bool, Tally]] = []
    for tool in TOOLS:
        missing = "" if importlib.util.find_spec(tool.module) else "not installed: pip install '.[peers]'"
        for forces in (False,) if missing else (False, True):
            setting = f"{tool.setting}; {'force laws alone' if forces else 'whole library'}"
            runs.append((tool, forces, Tally(tool.name, setting, tool.cannot, absent=missing)))
    tallies = [ours, *(tally for _, _, tally in runs)]
    for case in cases:
        problem = problem_of(case.believed, case.training, case.held)
        hidden = ", ".join(one["name"] for one in case.truth["effects"]) if case.truth else "measured"
        say(f"{case.kind} {case.name} ({hidden or 'nothing'}): {problem.training.columns.shape} rows and columns")
        ours.outcomes.append(run_ours(case, problem))
        forces_alone = problem.force_laws()
        for tool, forces, tally in runs:
            if not tally.absent:
                tally.outcomes.append(run_tool(tool, case, forces_alone if forces else problem))
        for tally in tallies:
            if tally.outcomes and tally.outcomes[-1].case is case:
                one = tally.outcomes[-1]
                names = ", ".join(f"{n.name}@{n.acts_on}" for n in one.named) or one.error or "-"
                setting = tally.setting.rpartition("; ")[2]
                say(f"  {tally.name}, {setting}: {one.took_s:.1f} s, {one.gap_n[1]:.3g} N held out: {names}")
    return tallies


def main(arguments: list[str] | None = None) -> int:
    """Run the comparison and print its table."""
    parser = argparse.ArgumentParser(prog="python -m bench.peers", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sets", type=int, default=SETS_COUNT, help="blind sets of each kind")
    parser.add_argument("--markdown", type=Path, help="write the table to this file as well")
    given = parser.parse_args(arguments)
    cases = list(blind_cases(given.sets))
    real = emps_case()
    if real is not None:
        cases.append(real)
    tallies = compare(cases, lambda text: print(text, file=sys.stderr, flush=True))
    print(table(tallies))
    if given.markdown is not None:
        given.markdown.write_text(_page(tallies, given.sets, real is not None))
    return 0


def _page(tallies: Sequence[Tally], count: int, measured: bool) -> str:
    day = time.strftime("%Y-%m-%d")
    return (
        "# The gap workflow beside general tools\n\n"
        f"Written by `python -m bench.peers --sets {count} --markdown` on {day}, {os.cpu_count()} CPUs. All tools get "
        "the same rows and columns (`bench/regression.py`), settings chosen on training recordings only. Blind sets: "
        f"{count} with one effect above twice its limit, {count} with nothing missing, {count} with an effect of no "
        f"library. EMPS: {'DATA_EMPS to learn from, DATA_EMPS_PULSES kept apart' if measured else 'no data here'}. "
        "Times are of the choice alone; that of `stagectl gap` is of the whole search from the logs.\n\n"
        f"{table(tallies)}\n"
    )


if __name__ == "__main__":
    sys.exit(main())
