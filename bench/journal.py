"""A journal of a long measurement: what was measured with these sources is not measured again."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parent.parent
_SOURCES = ("stagectl", "drivers", "sim_backend", "tests/faults", "profiles")


def sources_hash() -> str:
    """Return a hash of everything that a result depends on."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        for path in sorted((_ROOT / name).rglob("*")):
            if path.suffix in (".py", ".toml", ".eds"):
                digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


class Journal:
    """Entries by seed; with a name, they are found again after an interruption."""

    def __init__(self, name: str | None):
        """Read what is there; None keeps nothing beyond this object."""
        self.entries: dict[int, dict[str, Any]] = {}
        self._path: Path | None = None
        if name is not None:
            cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            self._path = cache / "stagectl-bench" / f"{name}-{sources_hash()}.jsonl"
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._path.exists():
                whole = [line for line in self._path.read_text().splitlines(keepends=True) if line.endswith("}\n")]
                self._path.write_text("".join(whole))  # without a last line that was cut off
                for line in whole:
                    entry = json.loads(line)
                    self.entries[entry.pop("seed")] = entry

    def keep(self, seed: int, entry: dict[str, Any]) -> None:
        """Add an entry, and write it at once."""
        self.entries[seed] = entry
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(json.dumps({"seed": seed, **entry}) + "\n")
