"""Final seeds are for a result, not for development: every run over them is written down before it begins.

The record is a committed file, and so is the journal of a run that takes longer than a machine is there: it goes on
where it stopped, as long as no source has changed; any other start counts as one more run.
"""

import dataclasses
import json
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bench.blind_sets import Searched
from bench.figure import Figure
from bench.journal import Journal
from bench.sources import ROOT, gap_hash, gap_sources

FIRST_SEED = 1_012_000  # those before were looked at, and the workflow was worked on since
RECORD = ROOT / "docs" / "gap-results.json"


def commit() -> str:
    """Return the commit, with a mark where the sources differ from it."""
    try:
        name = _git("rev-parse", "HEAD")
        changed = _git("status", "--porcelain", "--", *map(str, gap_sources()))
    except (OSError, subprocess.CalledProcessError):
        return "unknown: no git here"
    return f"{name}, with changes" if changed else name


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.strip()


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


@dataclasses.dataclass(slots=True)
class FinalRun:
    """One run over the final seeds: its entry in the record, and what it has so far."""

    record: Path
    number: int
    journal: Journal
    _others: list[Journal] = dataclasses.field(default_factory=list)

    def keep(self, one: Searched) -> None:
        """Keep what was found on one set, so that a run that is cut short need not search it again."""
        self.journal.keep(*entry_of(one))

    def kept(self) -> dict[int, Searched]:
        """Return what was found before this run was cut short."""
        return {seed: searched_of(seed, entry) for seed, entry in self.journal.entries.items()}

    def journal_of(self, what: str) -> Journal:
        """Return where something else of this run is kept, until it ends."""
        self._others.append(Journal(_journal(self.record, f"{self.number}-{what}")))
        return self._others[-1]

    def end(self, seeds: Iterable[int], figures: Iterable[Figure], took_s: float) -> None:
        """Write the result into the record."""
        content = _read(self.record)
        row = content["runs"][self.number - 1]
        ordered = sorted(seeds)
        row |= {
            "ended": _now(),
            "seeds": f"{ordered[0]}-{ordered[-1]}",
            "sets": len(ordered),
            "took_s": round(row.get("took_s", 0.0) + took_s, 1),
            "figures": [figure.as_json() | {"seeds": []} for figure in figures],
        }
        _write(self.record, content)
        for journal in (self.journal, *self._others):
            journal.end()


def entry_of(one: Searched) -> tuple[int, dict[str, Any]]:
    """Return the seed of a searched set, and what a journal keeps of it."""
    entry = dataclasses.asdict(one)
    return entry.pop("seed"), entry


def searched_of(seed: int, entry: dict[str, Any]) -> Searched:
    """Return a searched set as a journal has it."""
    return Searched(seed=seed, **{**entry, "reducible": tuple(entry["reducible"])})


def begin(record: Path = RECORD) -> FinalRun:
    """Count this run in the record, or go on with one that was cut short on the same sources."""
    digest = gap_hash()
    content = _read(record)
    for row in content["runs"]:
        journal = _journal(record, row["number"])
        if row["sources"] == digest and row["ended"] is None and journal.exists():
            row["continued"] = [*row.get("continued", []), _now()]
            _write(record, content)
            return FinalRun(record, row["number"], Journal(journal))
    number = len(content["runs"]) + 1
    content["runs"].append({"number": number, "commit": commit(), "sources": digest, "begun": _now(), "ended": None})
    _write(record, content)
    return FinalRun(record, number, Journal(_journal(record, number)))


def _journal(record: Path, name: int | str) -> Path:
    return record.with_name(f"{record.stem}-run-{name}.jsonl")


def _read(record: Path) -> dict[str, Any]:
    return json.loads(record.read_text()) if record.exists() else {"runs": []}


def _write(record: Path, content: dict[str, Any]) -> None:
    content = {"final_seeds_were_run": len(content["runs"]), "runs": content["runs"]}
    part = record.with_suffix(".part")
    part.write_text(json.dumps(content, indent=1) + "\n")
    part.replace(record)
