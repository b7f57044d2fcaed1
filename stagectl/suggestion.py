"""The nearest known name to one that is not known, for error texts. Pure."""

import difflib
from collections.abc import Iterable


def closest(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean X?", or what there is where nothing is near."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    if near:
        return f"; did you mean {near[0]}?"
    if len(known) <= 20:
        return f"; there are {', '.join(known)}"
    return f"; there are {len(known)}, {known[0]} to {known[-1]}"
