"""Blind sets for the gap workflow: what a user hands over is read, searched, and marked against the sealed truth.

    python -m bench.blind_sets --seeds 100-140 [--kind single] [--workers 2] [--json FILE]

One line a set, then the bars. Sets and their truth are generated once and kept in a folder of their own under a hash
of the generator's sources (`--sets`), so that a second call takes the searching only.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import queue
import sys
import tempfile
import time
import tomllib
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import csv

from bench.blind_names import in_words_of_the_truth
from bench.seeds import seeds_of
from stagectl.errors import RecordError
from stagectl.gap.believed import Believed, BelievedAxis, BelievedJoint
from stagectl.gap.heap import give_back, keep_freed
from stagectl.gap.log import Log, without_saturation
from stagectl.gap.workflow import find
from tests.blind import generate, score

DURATION_S = 20.0
LEAST_RUNS_FOR_HOLDOUT_COUNT = 4
_KNOWN_EXACTLY_RATIO = 1e-6  # a standard deviation of 0 is stated; a prior needs one above
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


# ---- reading a set ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BlindSet:
    """One set as a user hands it over."""

    believed: Believed
    logs: tuple[Log, ...]
    gains: tuple[dict[str, float], ...]  # of each run's controller
    relative_reference_m: tuple[np.ndarray | None, ...]


def load_set(folder: Path) -> BlindSet:
    """Read modeller.toml, runs.toml and the runs of one set."""
    modeller = tomllib.loads((folder / "modeller.toml").read_text())
    runs = tomllib.loads((folder / "runs.toml").read_text())["runs"]
    tables = [_table(folder / run["file"]) for run in runs]
    period_s = modeller["stage"]["rate_s"]
    believed = _believed(folder.name, modeller, runs[0]["gains"])
    used = []
    for run, table in zip(runs, tables, strict=True):
        whole = _log(run, table, period_s)
        try:
            log = without_saturation(whole, believed)
        except RecordError:  # as a user does who is told to record it anew
            continue
        used.append((log, run["gains"], _relative_reference_m(table, whole, log)))
    logs, gains, relative_m = zip(*used, strict=True)
    return BlindSet(believed, logs, gains, relative_m)


def _relative_reference_m(table: dict[str, np.ndarray], whole: Log, log: Log) -> np.ndarray | None:
    """Return what the stage was asked for between its bodies, in the stretch of a run that is used."""
    if "relative_reference_m" not in table:
        return None
    first = round((log.start_s - whole.start_s) / log.period_s)
    return table["relative_reference_m"][first : first + log.samples_count]


def _table(path: Path) -> dict[str, np.ndarray]:
    table = csv.read_csv(path)
    return {name: table[name].to_numpy().astype(float) for name in table.column_names}


def _log(run: dict[str, Any], table: dict[str, np.ndarray], period_s: float) -> Log:
    payload = {"macro": 0.0, "end": 0.0} | {run["payload_on"]: run["payload_kg"]}
    return Log(
        name=Path(run["file"]).stem,
        period_s=period_s,
        macro_position_m=table["macro_position_m"],
        macro_command_n=_command_n(table, "macro", run["gains"]),
        valid=np.ones(table["t_s"].size, bool),
        session=str(run["homing_id"]),
        end_position_m=table.get("end_position_m"),
        micro_command_n=_command_n(table, "micro", run["gains"]) if "end_position_m" in table else None,
        reference_m=table["reference_m"],
        macro_payload_kg=payload["macro"],
        end_payload_kg=payload["end"],
        start_s=run["starts_at_session_s"],
        macro_current_a=table["macro_current_a"],
        micro_current_a=table.get("micro_current_a"),
    )


def _command_n(table: dict[str, np.ndarray], axis: str, gains: dict[str, float]) -> np.ndarray:
    if f"{axis}_command_n" in table:
        return table[f"{axis}_command_n"]
    return table[f"{axis}_command_a"] * gains[f"{axis}_force_constant_n_per_a"]


def _believed(name: str, modeller: dict[str, Any], gains: dict[str, float]) -> Believed:
    """Say what the modeller states in our words; the modeller's right edge, of end minus macro, is our left one."""
    values, sds = modeller["values"], modeller["standard_deviations"]
    single = modeller["stage"]["axes"] == "single"

    def ratio(key: str) -> float:
        return max(sds[key] / values[key], _KNOWN_EXACTLY_RATIO)

    def axis(side: str, sensor: str) -> BelievedAxis:
        return BelievedAxis(
            mass_kg=values[f"{side}_mass_kg"],
            mass_sd_kg=sds[f"{side}_mass_kg"],
            noise_m=modeller["sensors"][f"{sensor}_position_noise_m"],
            current_loop_s=values[f"{side}_current_lag_s"],
            force_limit_n=gains[f"{side}_force_limit_n"],
            force_constant_n_per_a=values[f"{side}_force_constant_n_per_a"],
            force_constant_sd_ratio=ratio(f"{side}_force_constant_n_per_a"),
            latch_s=values[f"{side}_command_delay_s"],
            latch_sd_s=sds[f"{side}_command_delay_s"],
            current_loop_sd_s=sds[f"{side}_current_lag_s"],
            current_noise_a=float(
                np.hypot(
                    modeller["sensors"][f"{side}_current_noise_a"],
                    modeller["sensors"][f"{side}_current_quantum_a"] / np.sqrt(12.0),
                )
            ),
        )

    joint = None
    if not single:
        joint = BelievedJoint(
            spring_n_per_m=values["spring_stiffness_n_per_m"],
            damping_n_s_per_m=values["spring_damping_n_s_per_m"],
            left_m=values["right_edge_m"],
            right_m=values["left_edge_m"],
            left_stiffness_n_per_m=values["right_contact_stiffness_n_per_m"],
            right_stiffness_n_per_m=values["left_contact_stiffness_n_per_m"],
            width_sd_m=max(sds["left_edge_m"], sds["right_edge_m"]),
            stiffness_sd_ratio=ratio("spring_stiffness_n_per_m"),
            damping_sd_ratio=ratio("spring_damping_n_s_per_m"),
            left_stiffness_sd_ratio=ratio("right_contact_stiffness_n_per_m"),
            right_stiffness_sd_ratio=ratio("left_contact_stiffness_n_per_m"),
        )
    effects: list[dict[str, Any]] = []
    ratios: dict[str, float] = {}
    for key, effect, place, parameter in (
        ("macro_damping_n_s_per_m", "viscous_friction", "macro_force", "damping_n_s_per_m"),
        ("contact_damping_n_s_per_m", "contact_damping", "contact", "damping_n_s_per_m"),
        ("micro_reaction", "micro_reaction", "macro_force", "fraction_ratio"),
    ):
        if values.get(key, 0.0):
            effects.append({"name": effect, "acts_on": place, parameter: values[key]})
            ratios[f"{effect} on {place}"] = ratio(key)
    return Believed(
        name=name,
        period_s=modeller["stage"]["rate_s"],
        macro=axis("macro", "macro"),
        micro=None if single else axis("micro", "end"),
        joint=joint,
        effects=tuple(effects),
        effect_sd_ratios=ratios,
    )


def held_out(blind: BlindSet) -> tuple[int, ...]:
    """Choose the run that a user would keep apart: none of three, one of four or five.

    It is the one that differs in most of homing, payload and gains from all others, the last of equals; never the only
    one that touches the stops, and none that is faster than all others, since nothing could be learnt of that. Of a
    drag for which the others were too slow eleven times as much was left in the fast run as before (1001115).
    """
    if len(blind.logs) < LEAST_RUNS_FOR_HOLDOUT_COUNT:
        return ()
    traits = [
        (log.session, (log.macro_payload_kg, log.end_payload_kg), tuple(sorted(gains.items())))
        for log, gains in zip(blind.logs, blind.gains, strict=True)
    ]
    touching = [k for k in range(len(blind.logs)) if _touches(blind, k)]
    speeds = [_speed_m_per_s(log) for log in blind.logs]
    fastest = [k for k, speed in enumerate(speeds) if speed == max(speeds)]
    free = [k for k in range(len(blind.logs)) if [k] not in (touching, fastest)]

    def difference(k: int) -> int:
        others = traits[:k] + traits[k + 1 :]
        return sum(all(mine != other[place] for other in others) for place, mine in enumerate(traits[k]))

    return (max(free, key=lambda k: (difference(k), k)),)


def _speed_m_per_s(log: Log) -> float:
    """Return the highest speed that a run was asked for."""
    return 0.0 if log.reference_m is None else float(np.max(np.abs(np.diff(log.reference_m)))) / log.period_s


def _touches(blind: BlindSet, number: int) -> bool:
    relative_m, joint = blind.relative_reference_m[number], blind.believed.joint
    if relative_m is None or joint is None:
        return False
    return bool(np.max(relative_m) > joint.left_m or np.min(relative_m) < -joint.right_m)


# ---- generating, searching -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Job:
    """One set to search."""

    seed: int
    kind: str | None  # None: the seed draws one
    sets: Path
    keep: bool = True  # the recordings, for a second time
    nulls_count: int = 200
    options: tuple[tuple[str, Any], ...] = ()  # further arguments of `find`


@dataclass(frozen=True, slots=True)
class Searched:
    """What the workflow said of one set, in the truth's words, beside the truth."""

    seed: int
    truth: dict[str, Any] | None  # None where not even the generator came to an end
    findings: dict[str, Any]
    held_count: int
    reducible: tuple[float, float]  # on held-out runs, before and after
    reducible_sd: float  # standard error of the floor there, in the same unit
    took_s: float
    error: str = ""


NOTHING: dict[str, Any] = {"verdict": "nothing", "effects": [], "parameter_errors": [], "not_excited": []}


def sets_folder() -> Path:
    """Return where sets are kept: a folder for this version of the generator."""
    sources = sorted(Path(generate.__file__).parent.glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
    return Path(tempfile.gettempdir()) / f"stagectl-blind-{os.getuid()}-{digest}"


def generated(job: Job) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a set and its truth, which lies elsewhere; both are made where they are absent."""
    name = f"{job.seed}-{job.kind or 'drawn'}"
    folder, sealed = job.sets / "sets" / name, job.sets / "truths" / f"{name}.json"
    if not (folder / "modeller.toml").exists() or not sealed.exists():  # modeller.toml is written last
        case = generate.draw(job.seed, job.kind, DURATION_S)
        truth = json.dumps(generate.truth(case))
        generate.write(case, folder)
        sealed.parent.mkdir(parents=True, exist_ok=True)
        sealed.with_suffix(f".{os.getpid()}").write_text(truth)
        sealed.with_suffix(f".{os.getpid()}").replace(sealed)
    return folder, json.loads(sealed.read_text())


def search(job: Job) -> Searched:
    """Generate, read and search one set; an error of the workflow is a result, and counts as wrong."""
    truth = None
    begin_s = time.monotonic()
    keep_freed()
    give_back()  # what the set before held
    try:
        folder, truth = generated(job)
        blind = load_set(folder)
        apart = held_out(blind)
        training = [log for k, log in enumerate(blind.logs) if k not in apart]
        held = [blind.logs[k] for k in apart]
        begin_s = time.monotonic()
        findings = find(blind.believed, training, held, nulls_count=job.nulls_count, **dict(job.options))
        took_s = time.monotonic() - begin_s
        if not job.keep:
            for path in folder.iterdir():
                path.unlink()
        return Searched(
            job.seed,
            truth,
            in_words_of_the_truth(findings),
            len(held),
            (findings.reducible_before[1], findings.reducible_after[1]),
            findings.reducible_sds[1],
            took_s,
        )
    except Exception as error:  # noqa: BLE001  whatever it is, the other sets go on and this one counts as wrong
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        return Searched(job.seed, truth, NOTHING, 0, (0.0, 0.0), 0.0, time.monotonic() - begin_s, text)


def searched(jobs: Sequence[Job], workers: int, until_s: float = float("inf")) -> Iterator[Searched]:
    """Search sets, each in a process of its own pool, in the order in which they end.

    What has not begun at `until_s` of the monotonic clock is left out; sets begin in the order given.
    """
    if workers <= 1:
        for job in jobs:
            if time.monotonic() < until_s:
                yield search(job)
        return
    for name in _THREADS:  # heard by the workers: they must not fight for the processors
        os.environ.setdefault(name, str(max(1, (os.cpu_count() or 1) // workers)))
    lanes: queue.SimpleQueue[ProcessPoolExecutor] = queue.SimpleQueue()
    for _ in range(workers):
        lanes.put(_lane())
    try:
        with ThreadPoolExecutor(workers) as waiting:
            for future in as_completed([waiting.submit(_searched_in, lanes, job, until_s) for job in jobs]):
                if (one := future.result()) is not None:
                    yield one
    finally:
        while not lanes.empty():
            lanes.get().shutdown()


def _lane() -> ProcessPoolExecutor:
    """Return a pool of one process: where it dies, the other sets don't die with it."""
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def _searched_in(lanes: queue.SimpleQueue[ProcessPoolExecutor], job: Job, until_s: float) -> Searched | None:
    """Search a set in whichever process is free; None where the time is up."""
    lane = lanes.get()
    try:
        return lane.submit(search, job).result() if time.monotonic() < until_s else None
    except BrokenProcessPool as error:
        lane = _lane()
        return Searched(job.seed, None, NOTHING, 0, (0.0, 0.0), 0.0, 0.0, f"the worker died: {error}")
    finally:
        lanes.put(lane)


# ---- marking ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Marked:
    """One set with its mark by the suite's bars."""

    searched: Searched
    mark: dict[str, Any]
    label: str

    @property
    def right(self) -> bool | None:
        """Whether it counts as right; None where no bar speaks of it."""
        return self.mark["right"]


def marked(one: Searched) -> Marked:
    """Mark one set; an error is wrong wherever a bar speaks of the set."""
    if one.truth is None:
        mark = {"seed": one.seed, "category": None, "right": False, "why": one.error, "pairs": [], "named": []}
        return Marked(one, mark, "error")
    mark = score.score(one.findings, one.truth)
    if one.error:
        mark |= {"right": False, "why": one.error, "pairs": [], "named": []}
    return Marked(one, mark, _label(one, mark))


def _label(one: Searched, mark: dict[str, Any]) -> str:
    """Say in a word what kind of right or wrong it is."""
    named, verdict = mark["named"], one.findings["verdict"]
    if one.error:
        return "error"
    if mark["right"]:
        return "right"
    if mark["right"] is None:
        return "unjudged"
    if mark["category"] in ("null", "below_limit"):
        return "false"
    if mark["category"] == "outside":
        return "misnamed" if named else "missed"
    if mark["category"] == "parameter":
        return "false" if named else "wrong parameter" if one.findings["parameter_errors"] else "missed"
    if not named:
        return "unknown" if verdict == "unknown" else "missed"
    pairs, members = mark["pairs"], (one.truth or {})["effects"]
    loose = score.matched(named, members, judged_aliases=False)
    if len(loose) > len(pairs):
        return "set too wide"
    if len(pairs) == len(members):
        return "extra name"
    return "partly" if len(pairs) == len(named) else "confused"


def line(one: Marked) -> str:
    """Write one set as one line."""
    done, truth = one.searched, one.searched.truth
    head = f"{done.seed:>7} {truth['kind'] if truth else '?':<9}"
    if truth is None:
        return f"{head} {one.label.upper()}: {done.error}"
    hidden = "; ".join(_member(member) for member in [*truth["effects"], *truth["parameter_errors"]]) or "nothing"
    if done.error:
        return f"{head} {hidden} => ERROR {done.error}  {done.took_s:.1f} s"
    said = [_named(effect) for effect in done.findings["effects"]]
    said += [f"PAR {_named(wrong)}" for wrong in done.findings["parameter_errors"]]
    errors = [
        f"{100 * error:.2g} %{'' if covered is None else ' in' if covered else ' OUT'}"
        for error, covered in score.parameter_marks(one.mark["pairs"])
    ]
    parts = [f"{head} {hidden} => {done.findings['verdict']}", "; ".join(said) or "-"]
    parts += [f"off by {', '.join(errors)}"] if errors else []
    parts += [f"{one.mark['category'] or 'no bar'}: {one.label.upper() if one.right is False else one.label}"]
    return " | ".join(parts) + f"  {done.took_s:.1f} s"


def _member(member: dict[str, Any]) -> str:
    text = f"{member['name']}@{member['acts_on']} d' {member['d_prime']:.3g}"
    text += "" if member["above_twice_limit"] else " (below)"
    inseparable = [f"{name}@{place}" for name, place in member["inseparable"]]
    return text + (f" ~{{{', '.join(inseparable)}}}" if inseparable else "")


def _named(found: dict[str, Any]) -> str:
    aliases = [f"{name}@{place}" for name, place in found["alias_set"]]
    return f"{found['name']}@{found['acts_on']}" + (f" +{{{', '.join(aliases)}}}" if aliases else "")


def summary_lines(all_marked: Sequence[Marked]) -> list[str]:
    """Write the bars, then precision and recall effect by effect."""
    judged = [one for one in all_marked if one.searched.truth is not None]
    result = score.summary([one.mark for one in judged], [one.searched.truth for one in judged])
    lines = []
    for row in result["figures"]:
        share = "-" if row["value"] is None else f"{100 * row['value']:5.1f} %"
        low, high = row["interval"]
        verdict = {True: "", False: "MISSED", None: ""}[row["point_holds"]]
        lines.append(
            f"{row['figure']:<12} {row['right']:>3}/{row['count']:<3} {share} "
            f"({100 * low:.0f} to {100 * high:.0f} %), bar {100 * row['bar']:.0f} % {verdict}"
        )
    means = ("parameter_error_median", "coverage", "mean_set_size", "mean_own_set_size")
    lines += [f"{name.replace('_', ' ')}: {result[name]:.3g}" for name in means if result[name] is not None]
    if result["coverage"] is not None:
        low, high = result["coverage_interval"]
        lines.append(f"coverage between {100 * low:.0f} and {100 * high:.0f} % by the number of its intervals")
    lines.append(f"reducible gap closed: {closed_text(all_marked)}")
    for name, row in result["by_name"].items():
        lines.append(
            f"  {name:<36} named {row['named']:>3}, rightly {row['rightly']:>3}; "
            f"hidden {row['hidden']:>3}, found {row['hidden_and_found']:>3}"
        )
    errors = [one for one in all_marked if one.searched.error]
    if errors:
        lines.append(f"{len(errors)} sets ended in an error: {', '.join(str(one.searched.seed) for one in errors)}")
    labels = sorted({one.label for one in all_marked})
    lines.append(", ".join(f"{label} {sum(one.label == label for one in all_marked)}" for label in labels))
    return lines


def closed_text(all_marked: Iterable[Marked]) -> str:
    """Say how much of the reducible gap is closed, over all sets with an effect above twice its limit."""
    reducible = [one.searched.reducible for one in all_marked if one.mark["category"] in ("single", "multi")]
    before, after = sum(pair[0] for pair in reducible), sum(pair[1] for pair in reducible)
    return f"{100 * (1 - after / before):.1f} % on {len(reducible)} sets" if before > 0.0 else "-"


# ---- command line ----------------------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None, say: Callable[[str], None] = print) -> int:
    """Search sets of development seeds and say how each was marked."""
    parser = argparse.ArgumentParser(prog="python -m bench.blind_sets", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=seeds_of, required=True, help="such as 100-140,150; below 10000")
    parser.add_argument("--kind", choices=("null", "single", "multi", "outside", "parameter"))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--nulls", type=int, default=200, help="of the ranking stage")
    parser.add_argument("--sets", type=Path, default=sets_folder(), help="where sets are kept")
    parser.add_argument("--generate-only", action="store_true", help="make the sets, search nothing")
    parser.add_argument("--json", type=Path, help="write findings, truths and marks to this file")
    given = parser.parse_args(arguments)
    if max(given.seeds) > generate.DEVELOPMENT_SEEDS[1]:
        parser.error(f"seed {max(given.seeds)} is no development seed; those end at {generate.DEVELOPMENT_SEEDS[1]}")
    jobs = [Job(seed, given.kind, given.sets, nulls_count=given.nulls) for seed in given.seeds]
    if given.generate_only:
        with multiprocessing.get_context("spawn").Pool(given.workers) as pool:
            for folder, _ in pool.imap_unordered(generated, jobs):
                say(str(folder))
        return 0
    all_marked = []
    for one in searched(jobs, given.workers):
        all_marked.append(marked(one))
        say(line(all_marked[-1]))
        sys.stdout.flush()
    say("")
    for text in summary_lines(all_marked):
        say(text)
    if given.json:
        given.json.write_text(json.dumps([_plain(one) for one in sorted(all_marked, key=_seed)], indent=1))
    return 0


def _seed(one: Marked) -> int:
    return one.searched.seed


def _plain(one: Marked) -> dict[str, Any]:
    done = one.searched
    return {
        "seed": done.seed,
        "label": one.label,
        "right": one.right,
        "category": one.mark["category"],
        "why": one.mark["why"],
        "truth": done.truth,
        "findings": done.findings,
        "reducible": done.reducible,
        "took_s": done.took_s,
        "error": done.error,
    }


if __name__ == "__main__":
    sys.exit(main())
