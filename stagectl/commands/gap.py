"""`stagectl gap`: where a model and recordings disagree, which effect is missing, and what remains."""

import os
from collections.abc import Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from stagectl import toml_file
from stagectl.commands.answer import Answer, Voice
from stagectl.commands.new_profile import refuse_place, text_of, write_checked
from stagectl.commands.runs import folder_of
from stagectl.errors import RequestError
from stagectl.gap import addition, arbiter, findings_page, residual
from stagectl.gap.application import Application, application
from stagectl.gap.believed import Believed, document_of, load_believed
from stagectl.gap.crew import Dask, crew_of
from stagectl.gap.findings import Findings, Named
from stagectl.gap.findings_file import FINDINGS, read_findings, write_findings
from stagectl.gap.heap import keep_freed
from stagectl.gap.log import Log, read_log
from stagectl.gap.profile_sheet import Change
from stagectl.gap.workflow import find
from stagectl.profile import search_folders

PAGE = "findings.html"


def search(
    voice: Voice,
    profile: str,
    training: Sequence[str],
    held: Sequence[str],
    runs_root: Path,
    out: Path,
    seed: int,
    workers_count: int | None = None,
    dask: str | None = None,
) -> Answer:
    """Compete all effects on the recordings, judge on those held out, and write what was found."""
    if workers_count is not None and dask is not None:
        raise RequestError("--workers is of this machine and --dask of a cluster; give one of them")
    keep_freed()
    believed = load_believed(profile)
    logs = [_log(run, runs_root, believed) for run in training]
    apart = [_log(run, runs_root, believed) for run in held]
    with Dask(dask) if dask is not None else crew_of(workers_count or len(os.sched_getaffinity(0))) as crew:
        findings = find(believed, logs, apart, seed=seed, say=lambda step: voice.progress(step, 0.0), crew=crew)
    voice.progress.done()
    for remark in findings.remarks:
        voice.note(remark)
    out.mkdir(parents=True, exist_ok=True)
    write_findings(findings, out / FINDINGS)
    voice.whole_file = out / FINDINGS
    ladder = _ladder(believed, findings, [*logs, *apart], voice)
    voice.progress("drawing the page", 0.0)
    residuals = residual.residuals(believed, findings, logs, apart)
    page = findings_page.page(findings, residuals, ladder, profile=profile, file=out / FINDINGS, seed=seed)
    page.write(out / PAGE)
    voice.progress.done()
    data = {
        "findings": asdict(findings),
        "file": str(out / FINDINGS),
        "page": str(out / PAGE),
        "verdict": findings_page.verdict_of(findings),
        "seed": seed,
        "closed_loop": ladder,
        "residual": findings_page.summary(residuals),
    }
    said = [*_sentences(findings, out / FINDINGS), f"Page: {out / PAGE}"]
    return Answer(data, [_named(findings), *_ladder_table(ladder), *said])


def apply(voice: Voice, profile: str, findings: Path, out: Path, candidates: bool, force: bool) -> Answer:
    """Write a new profile: the old one's text with the findings in it; the old one is never touched."""
    path = toml_file.find(profile, search_folders(), "profile")
    refuse_place(path, out, force)
    old = text_of(path)
    document_of(old.encode(), path)  # the old one is right by itself, and its own effects are known from here on
    file = findings / FINDINGS if findings.is_dir() else findings
    done = application(old, read_findings(file), candidates=candidates, date=date.today().isoformat())
    write_checked(done.text, out, "findings")
    for reason in done.left:
        voice.warn(f"not written: {reason}")
    data = {"profile": out, "changes": [asdict(change) for change in done.changes], "left": list(done.left)}
    return Answer(data, [_changes_table(done), f"Profile: {out}"])


def _changes_table(done: Application) -> Table:
    table = Table("key", "was", "is", "95 %", "", box=None, header_style="bold")
    for change in done.changes:
        table.add_row(
            escape(change.key),
            "" if change.before is None else f"{change.before:.6g}",
            f"{change.value:.6g}",
            _interval(change),
            "" if change.confirmed else "candidate",
        )
    return table


def _interval(change: Change) -> str:
    return "" if change.half_width is None else f"+- {change.half_width:.2g}"


def _log(run: str, runs_root: Path, believed: Believed) -> Log:
    return read_log(folder_of(run, runs_root), believed.period_s, believed)


def _named(findings: Findings) -> Table:
    table = Table("effect", "acts on", "parameters", "gain", "held out", "as well", box=None, header_style="bold")
    for effect in findings.named:
        aliases = ", ".join(f"{name} on {place}" for name, place, _ in effect.aliases)
        table.add_row(
            effect.name,
            effect.acts_on,
            escape(_parameters(effect)),
            f"{effect.gain:.0f}",
            f"{effect.held_out_gain:.0f}",
            escape(aliases),
        )
    return table


def _parameters(effect: Named) -> str:
    said = []
    for name, value in effect.parameters.items():
        sd = effect.sds.get(name)
        said.append(f"{name} = {value:.4g}" + (f" +- {1.96 * sd:.2g}" if sd is not None else ""))
    return "\n".join(said)


def _sentences(findings: Findings, path: Path) -> list[str]:
    said = [findings_page.VERDICTS[findings.verdict]]
    said += [
        f"Known parameter {wrong.name} is off by {wrong.error:.3g} +- {1.96 * wrong.sd:.2g}; "
        f"the profile states {wrong.stated_sd:.2g} (one standard deviation)."
        for wrong in findings.parameter_errors
    ]
    if findings.not_excited:
        said.append(f"Not excited: {', '.join(findings.not_excited)}.")
    said += [f"Not told apart by these runs: {text}." for text in findings.not_separable]
    return [*said, f"Findings: {path}"]


def _ladder(believed: Believed, findings: Findings, logs: Sequence[Log], voice: Voice) -> list[dict[str, float | str]]:
    """Simulate the closed loop with no, then all effects found, where the controller is known."""
    rungs: list[dict[str, float | str]] = []
    for log in logs:
        problem = arbiter.cannot_close(believed, log)
        if problem:
            voice.note(problem)
            continue
        for name, named in (("before", ()), ("after", findings.named)):
            if name == "before":
                simulated = arbiter.simulate(believed, [dict(row) for row in believed.effects], log)
            else:
                effects = addition.effects_with(believed, findings, named, log.session)
                simulated = arbiter.simulate(believed, effects, log, findings.refitted)
            gap = arbiter.gap_of(log, simulated)
            rungs.append({"run": log.name, "with": name, **asdict(gap)})
    return rungs


def _ladder_table(ladder: list[dict[str, float | str]]) -> list[Table]:
    if not ladder:
        return []
    table = Table("closed loop", "", "force gap", "floor", "position gap", "floor", box=None, header_style="bold")
    for rung in ladder:
        table.add_row(
            escape(str(rung["run"])),
            str(rung["with"]),
            f"{rung['command_n']:.3g} N",
            f"{rung['command_floor_n']:.3g} N",
            f"{float(rung['position_m']) * 1e6:.3g} um",
            f"{float(rung['position_floor_m']) * 1e6:.3g} um",
        )
    return [table]
