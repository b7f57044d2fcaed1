"""A journal of a long measurement: what was measured with these sources is not measured again."""

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from bench.sources import ROOT, service_hash


def beside_figures(name: str) -> Path:
    """Return where the journal of a measurement with these sources is kept: committed, it goes on elsewhere."""
    return ROOT / "docs" / "journals" / f"{name}-{service_hash()}.jsonl"


class Journal:
    """Entries by seed; with a file, they are found again after an interruption."""

    def __init__(self, path: Path | None):
        """Read what is there; None keeps nothing beyond this object."""
        self.entries: dict[int, dict[str, Any]] = {}
        self._path = path
        if path is not None and path.exists():
            whole = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("}\n")]
            path.write_text("".join(whole))  # without a last line that was cut off
            for line in whole:
                entry = json.loads(line)
                self.entries[entry.pop("seed")] = entry

    def keep(self, seed: int, entry: dict[str, Any]) -> None:
        """Add an entry, and write it at once."""
        self.entries[seed] = entry
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(json.dumps({"seed": seed, **entry}) + "\n")

    def end(self) -> None:
        """Remove the file: what it was for is done."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)


def measured(
    journal: Journal, seeds: Iterable[int], measure: Callable[[list[int]], Iterable[tuple[int, dict[str, Any]]]]
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (seed, entry) of seeds: first what is kept, then what `measure` yields of the others, kept as it comes."""
    wanted = list(seeds)
    open_ones = [seed for seed in wanted if seed not in journal.entries]
    yield from [(seed, journal.entries[seed]) for seed in wanted if seed in journal.entries]
    for seed, entry in measure(open_ones) if open_ones else ():
        journal.keep(seed, entry)
        yield seed, entry
