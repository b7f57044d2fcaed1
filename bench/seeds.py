"""Seeds as they are written on a command line and in a table: `100-140,150`."""

from argparse import ArgumentTypeError
from collections.abc import Sequence

_MOST = 100_000


def seeds_of(text: str) -> list[int]:
    """Read `100-140,150` as seeds; ArgumentTypeError where that is none, or too many to be meant."""
    try:
        ends = [
            (int(first), int(last or first)) for first, _, last in (part.partition("-") for part in text.split(","))
        ]
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is no seed; write 7, 100-140 or 100-140,150") from None
    for first, last in ends:
        if not 0 <= last - first < _MOST:
            raise ArgumentTypeError(f"{first}-{last} holds no seed, or more than {_MOST}; the smaller one comes first")
    return [seed for first, last in ends for seed in range(first, last + 1)]


def text_of(seeds: Sequence[int]) -> str:
    """Write seeds for a table: those that follow each other as their first and last."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]}-{seeds[-1]}"
    return ", ".join(map(str, seeds))
