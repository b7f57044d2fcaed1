"""A journal of a long measurement: what was measured with these sources is not measured again."""

import ast
import hashlib
import json
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parent.parent
_SOURCES = ("stagectl", "drivers", "sim_backend", "profiles")
_FAULTS = "tests/faults"
APART = ("stagectl/budget", "stagectl/gap", "stagectl/paper", "stagectl/tuning")
"""Analysis that no process of the service imports."""
PACKAGES = ("numba", "numpy", "python-can", "ruckig")
"""Whose versions count: they compute the motion, or carry its frames."""


def sources(root: Path = _ROOT) -> list[Path]:
    """Return every file below `root` that a result of the service depends on.

    Of the tests: the faults, but no test of them, and what they import, directly or not.
    """
    found = {path for path in (root / _FAULTS).glob("*.py") if not path.name.startswith("test_")}
    new = set(found)
    while new:
        new = {path for one in new for path in _imported_tests(one, root)} - found
        found |= new
    for name in _SOURCES:
        for path in (root / name).rglob("*"):
            apart = any(path.is_relative_to(root / folder) for folder in APART)
            if path.suffix in (".py", ".toml", ".eds") and not apart:
                found.add(path)
    return sorted(found)


def _imported_tests(path: Path, root: Path) -> Iterator[Path]:
    """Yield the modules of `tests` that a file imports, anywhere in it, and the packages that they are in."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module is not None and not node.level:
            names = [node.module, *(f"{node.module}.{one.name}" for one in node.names)]
        for name in names:
            parts = name.split(".")
            if parts[0] == "tests":
                files = [root.joinpath(*parts[:count], "__init__.py") for count in range(1, len(parts) + 1)]
                yield from (one for one in [*files, root.joinpath(*parts).with_suffix(".py")] if one.is_file())


def sources_hash(root: Path = _ROOT) -> str:
    """Return a hash of everything that a result of the service depends on, the versions of `PACKAGES` with it.

    Of Python it is the syntax tree without comments and docstrings: what a sentence says of the code changes no result.
    """
    digest = hashlib.sha256()
    for path in sources(root):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(_code(path.read_text()) if path.suffix == ".py" else path.read_bytes())
    for name in PACKAGES:
        digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.hexdigest()[:16]


def _code(text: str) -> bytes:
    """Return the syntax tree of a Python file, without the places in it, comments and docstrings."""
    return ast.dump(_WithoutDocstrings().visit(ast.parse(text))).encode()


class _WithoutDocstrings(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else node


def beside_figures(name: str) -> Path:
    """Return where the journal of a measurement with these sources is kept: committed, it goes on elsewhere."""
    return _ROOT / "docs" / "journals" / f"{name}-{sources_hash()}.jsonl"


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
