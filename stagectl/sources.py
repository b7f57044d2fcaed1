"""Our own sources: their hash, and the hash of those that compiled code can depend on."""

import functools
import hashlib
import re
import sys
from collections.abc import Iterable
from pathlib import Path

import numba

_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("stagectl", "sim_backend", "drivers")
_COMPILERS = {"numba", "stagectl.compiled.compiled", "stagectl.compiled.inlined"}
# Text, not syntax: the modules that we generate are strings in ours, and what they import counts as well.
# Begins with a plain word, that is searched for 25 times as fast: every process reads all sources when it starts.
_FROM = re.compile(r"from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*)")
_IMPORT = re.compile(r"^[ \t\"']*import[ \t]+([^\n#]*)", re.M)
_NAME = re.compile(r"[\w.]+")


@functools.cache
def version() -> str:
    """Return the hash of all our sources, the interpreter and the compiler: 16 hexadecimal digits."""
    return _hash(_files().values())


@functools.cache
def compiled_version() -> str:
    """Return the hash of the sources that a compiled function can depend on, the interpreter and the compiler."""
    files = _files()
    return _hash(files[name] for name in compiled_modules())


def compiled_modules() -> list[str]:
    """Return the modules that compile, and all that they import, in turn."""
    files = _files()
    imports = {name: _imports(path.read_text()) for name, path in files.items()}
    waiting = [name for name in files if imports[name] & _COMPILERS]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in files and name not in found:
            found.add(name)
            waiting += imports[name]
    return sorted(found)


def _files() -> dict[str, Path]:
    """Return every module of the three packages with its file, in an order of its own."""
    paths = sorted(path for package in _PACKAGES for path in (_ROOT / package).rglob("*.py"))
    return {".".join(path.relative_to(_ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}


def _imports(text: str) -> set[str]:
    """Return every name that a text imports, and the packages that hold them: a superset of its modules."""
    found = {name for names in _IMPORT.findall(text) for name in _NAME.findall(names)}
    for module, names in _FROM.findall(text):
        found |= {module, *(f"{module}.{name}" for name in _NAME.findall(names))}
    parts = [name.split(".") for name in found]
    return {".".join(part[:k]) for part in parts for k in range(1, len(part) + 1)}


def _hash(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256(f"{sys.version} numba {numba.__version__}".encode())
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
