"""Framer state as JSON bytes, so that a replay can begin in the middle of a stream.

Pure; no pickle: a snapshot from a run folder can't carry code.
"""

import json
from typing import Any, cast

from stagectl.errors import RecordError


def pack(kind: str, **parts: object) -> bytes:
    """Plain values as JSON; `kind` names the framer that made them."""
    return json.dumps({"framer": kind, **parts}, allow_nan=False, separators=(",", ":")).encode()


def unpack(kind: str, snapshot: bytes) -> dict[str, Any]:
    """The parts that `pack` was given; RecordError where another framer made them or they are no snapshot."""
    try:
        parts: Any = json.loads(snapshot)
    except ValueError as error:
        raise RecordError(f"framer snapshot is not JSON ({error}); the run folder is damaged") from error
    if not isinstance(parts, dict):
        raise RecordError(f"framer snapshot is a {type(parts).__name__}, not of {kind!r}; the run folder is damaged")
    named = cast(dict[str, Any], parts)
    found = named.get("framer")
    if found != kind:
        raise RecordError(f"framer snapshot is of {found!r}, not {kind!r}; replay with the profile of that run")
    return named
