"""What a long measurement depends on: its sources as code, comments and docstrings left out, and what computes them."""

import ast
import functools
import hashlib
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_RIG_AND_SERVICE = ("stagectl", "drivers", "sim_backend", "profiles")
_FAULTS = "tests/faults"
APART = ("stagectl/budget", "stagectl/gap", "stagectl/paper", "stagectl/tuning")
"""Analysis that no process of the service imports."""
_SERVICE_PACKAGES = ("numba", "numpy", "python-can", "ruckig")
"""Whose versions count: they compute the motion, or carry its frames."""
_GAP = "bench/gap.py"
_GAP_PACKAGES = ("numba", "numpy", "scipy")


def service_sources(root: Path = ROOT) -> list[Path]:
    """Return every file below `root` that a result of the service depends on.

    Of the tests: the faults, but no test of them, and what they import, directly or not.
    """
    begun = {path for path in (root / _FAULTS).glob("*.py") if not path.name.startswith("test_")}
    found = _with_imports(begun, root, ("tests",))
    for name in _RIG_AND_SERVICE:
        for path in (root / name).rglob("*"):
            apart = any(path.is_relative_to(root / folder) for folder in APART)
            if path.suffix in (".py", ".toml", ".eds") and not apart:
                found.add(path)
    return sorted(found)


def gap_sources(root: Path = ROOT) -> list[Path]:
    """Return every file below `root` that a result of the gap workflow on blind sets depends on: what it imports."""
    return sorted(_with_imports({root / _GAP}, root, ("bench", "stagectl", "tests")))


def service_hash(root: Path = ROOT) -> str:
    """Return a hash of `service_sources` and of the versions of `_SERVICE_PACKAGES`."""
    return _hash_of(service_sources(root), root, _SERVICE_PACKAGES)


def gap_hash(root: Path = ROOT) -> str:
    """Return a hash of `gap_sources` and of the versions of `_GAP_PACKAGES`."""
    return _hash_of(gap_sources(root), root, _GAP_PACKAGES)


def _with_imports(begun: Iterable[Path], root: Path, folders: tuple[str, ...]) -> set[Path]:
    """Return these files, and what they import of these folders, directly or not."""
    found = new = set(begun)
    while new:
        new = {path for one in new for path in _imported(one, root, folders)} - found
        found = found | new
    return found


def _imported(path: Path, root: Path, folders: tuple[str, ...]) -> Iterator[Path]:
    """Yield the modules of these folders that a file imports, anywhere in it, and the packages that they are in."""
    for name in _imported_names(path.read_text()):
        parts = name.split(".")
        if parts[0] in folders:
            files = [root.joinpath(*parts[:count], "__init__.py") for count in range(1, len(parts) + 1)]
            yield from (one for one in [*files, root.joinpath(*parts).with_suffix(".py")] if one.is_file())


@functools.cache  # by the text: of three hundred files one is another the next time
def _imported_names(text: str) -> tuple[str, ...]:
    """Return what a Python file imports by absolute names; of `from a import b` both a and a.b, whichever is a file."""
    found: list[str] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None and not node.level:
            found += [node.module, *(f"{node.module}.{one.name}" for one in node.names)]
    return tuple(found)


def _hash_of(paths: Iterable[Path], root: Path, packages: Iterable[str]) -> str:
    """Return a hash of these files and versions; what a sentence says of the code changes no result."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(str(path.relative_to(root)).encode())
        digest.update(_code(path.read_text()) if path.suffix == ".py" else path.read_bytes())
    for name in packages:
        digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.hexdigest()[:16]


@functools.cache
def _code(text: str) -> bytes:
    """Return the syntax tree of a Python file, without the places in it, comments and docstrings."""
    return ast.dump(_WithoutDocstrings().visit(ast.parse(text))).encode()


class _WithoutDocstrings(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else node
