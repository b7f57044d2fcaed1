"""Framer state as JSON bytes, so that a replay can begin in the middle of a stream.

Pure; no pickle: a snapshot from a run folder can't carry code.
"""

import json

from stagectl.errors import RecordError


def pack(kind: str, **parts: object) -> bytes:
    """Plain values as JSON; `kind` names the framer that made them."""
    return json.dumps({"framer": kind, **parts}, allow_nan=False, separators=(",", ":")).encode()


def unpack(kind: str, snapshot: bytes) -> dict:
    """The parts that `pack` was given; RecordError where another framer made them or they are no snapshot."""
    try:
        parts = json.loads(snapshot)
    except ValueError as error:
        raise RecordError(f"framer snapshot is not JSON ({error}); the run folder is damaged") from error
    if not isinstance(parts, dict) or parts.get("framer") != kind:
        found = parts.get("framer") if isinstance(parts, dict) else type(parts).__name__
        raise RecordError(f"framer snapshot is of {found!r}, not {kind!r}; replay with the profile of that run")
    return parts
