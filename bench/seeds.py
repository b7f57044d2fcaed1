"""Seeds as they are written on a command line and in a table: `100-140,150`."""

from collections.abc import Sequence


def seeds_of(text: str) -> list[int]:
    """Read `100-140,150` as seeds; ValueError where that is none."""
    seeds: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        seeds += range(int(first), int(last or first) + 1)
    if not seeds:
        raise ValueError(f"no seed in {text!r}")
    return seeds


def text_of(seeds: Sequence[int]) -> str:
    """Write seeds for a table: those that follow each other as their first and last."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]}-{seeds[-1]}"
    return ", ".join(map(str, seeds))
