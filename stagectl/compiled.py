"""The one way to compile: numba, cached under a hash of every source that can reach the tick.

Numba rebuilds a cached function when its own file changes, not when a callee in another file does
(measured: a loop kept 0.01 after its callee went to 0.02), so each version of the sources gets a
cache folder of its own.
"""

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])  # compiled, it is called as before
_PACKAGES = ("stagectl", "sim_backend", "drivers")


def _sources_hash() -> str:
    """Hash all Python sources of the three packages, the interpreter and the compiler."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256(f"{sys.version} numba {numba.__version__}".encode())
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_root() -> Path:
    root = os.environ.get("STAGECTL_CACHE") or os.environ.get("XDG_CACHE_HOME")
    if os.environ.get("STAGECTL_CACHE"):
        return Path(str(root))
    return (Path(root) if root else Path.home() / ".cache") / "stagectl"


CACHE_FOLDER = _cache_root() / _sources_hash()
"""Holds the compiled code and the generated modules of these sources."""

CACHE_FOLDER.mkdir(parents=True, exist_ok=True)
numba.config.CACHE_DIR = str(CACHE_FOLDER / "numba")  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


def compiled(function: _Function) -> _Function:
    """Compile `function` on first call. No fastmath (bits change); division by zero gives inf or nan, as in numpy."""
    return cast(_Function, numba.njit(cache=True, error_model="numpy", nogil=True)(function))


def direct(function: Any, *arguments: Any) -> Callable[..., None]:
    """Return what `compiled` made of a function for these arguments' types, without the look at types in each call.

    That look costs 0.2 us for each structured array. Only for callers whose arrays never change their dtypes.
    """
    type_of = cast(Callable[[Any], Any], numba.typeof)  # pyright: ignore[reportUnknownMemberType]
    return function.compile(tuple(type_of(argument) for argument in arguments))


def inlined(function: _Function) -> _Function:
    """Compile as `compiled` does, and melt into every compiled caller: for small functions of the innermost loop."""
    return cast(_Function, numba.njit(cache=True, error_model="numpy", nogil=True, forceinline=True)(function))
