"""The one way to compile: numba, cached under a hash of every source that compiled code can depend on.

Numba rebuilds a cached function when its own file changes, not when a callee in another file does
(measured: a loop kept 0.01 after its callee went to 0.02), so each version of the sources gets a
cache folder of its own.
"""

import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

from stagectl import sources

_Function = TypeVar("_Function", bound=Callable[..., Any])  # compiled, it is called as before


def _cache_root() -> Path:
    root = os.environ.get("STAGECTL_CACHE") or os.environ.get("XDG_CACHE_HOME")
    if os.environ.get("STAGECTL_CACHE"):
        return Path(str(root))
    return (Path(root) if root else Path("~/.cache").expanduser()) / "stagectl"


def _cache_folder(version: str) -> tuple[Path, str]:
    """Make the folder of this version; returns it, and what to say where it is not the usual one."""
    try:
        usual = _cache_root() / version
        return _made(usual), ""
    except (OSError, RuntimeError) as error:  # RuntimeError: nobody knows a home
        root = _own_temporary_folder()
        os.environ["STAGECTL_CACHE"] = str(root)  # for the processes of servo and rig
        return _made(root / version), (
            f"compiled code can't be kept ({error}); it goes to {root}; set STAGECTL_CACHE to a folder of yours"
        )


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder} can't be written")
    return folder


def _own_temporary_folder() -> Path:
    """Return a folder that nobody else can have put code into: this user's, with no rights for others."""
    folder = Path(tempfile.gettempdir()) / f"stagectl-cache-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
            return Path(tempfile.mkdtemp(prefix="stagectl-cache-"))
    return folder


CACHE_FOLDER, CACHE_REMARK = _cache_folder(sources.compiled_version())
"""Holds the compiled code and the generated modules of these sources; and why it is not the usual one, or empty."""

numba.config.CACHE_DIR = str(CACHE_FOLDER / "numba")  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


def compiled(function: _Function) -> _Function:
    """Compile `function` on first call. No fastmath (bits change); division by zero gives inf or nan, as in numpy."""
    return cast(_Function, numba.njit(cache=True, error_model="numpy", nogil=True)(function))


def direct(function: Any, *arguments: Any) -> Callable[..., None]:
    """Return what `compiled` made of a function for these arguments' types, without the look at types in each call.

    That look costs 0.2 us for each structured array. Only for callers whose arrays never change their dtypes.
    """
    return function.compile(tuple(_type_of(argument) for argument in arguments))


_TYPES: dict[tuple[Any, ...], Any] = {}


def _type_of(argument: Any) -> Any:
    """Return numba's type. It builds that of a structured array anew each time: 6 ms for the arrays of a tick."""
    type_of = cast(Callable[[Any], Any], numba.typeof)  # pyright: ignore[reportUnknownMemberType]
    if not isinstance(argument, np.ndarray):
        return type_of(argument)
    array = cast(np.ndarray, argument)
    flags = array.flags
    kind = (array.dtype, array.ndim, flags.c_contiguous, flags.f_contiguous, flags.writeable, flags.aligned)
    if kind not in _TYPES:
        _TYPES[kind] = type_of(argument)
    return _TYPES[kind]


def inlined(function: _Function) -> _Function:
    """Compile as `compiled` does, and melt into every compiled caller: for small functions of the innermost loop."""
    return cast(_Function, numba.njit(cache=True, error_model="numpy", nogil=True, forceinline=True)(function))
