"""Compiled code of the truth generator, kept under a hash of all of its sources.

Numba looks at the one file that a function stands in: a law that was changed stayed what it was in the integrator that
calls it, and the old motions were kept under the new sources' name.
"""

import hashlib
from pathlib import Path

import numba

_SOURCES = sorted(Path(__file__).parent.glob("*.py"))
_DIGEST = hashlib.sha256(b"".join(path.read_bytes() for path in _SOURCES)).hexdigest()[:12]
_FOLDER = Path(__file__).parent / "__pycache__" / _DIGEST


def compiled(function):
    """Compile on first call. Where code is kept is asked for here and now: whoever set another place keeps it."""
    theirs = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(_FOLDER)
    try:
        return numba.njit(cache=True)(function)
    finally:
        numba.config.CACHE_DIR = theirs
