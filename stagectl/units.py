"""What a name's ending means: the unit of every quantity that crosses a boundary.

Pure; imports nothing.
"""

_SYMBOLS = {
    "m": "m",
    "s": "s",
    "s2": "s^2",
    "s3": "s^3",
    "m2": "m^2",
    "m3": "m^3",
    "ns": "ns",
    "hz": "Hz",
    "kg": "kg",
    "n": "N",
    "a": "A",
    "v": "V",
    "h": "H",
    "ohm": "ohm",
    "rad": "rad",
    "k": "K",
    "degc": "degC",
    "pa": "Pa",
}
_PLAIN = {"ratio": "1", "count": "1", "percent": "%", "ppm": "1e-6"}
"""Numbers without a unit; they stand alone."""

_COUNTED = {"bit": "bit", "counts": "counts"}
"""What is counted is a unit only as a part of one: `_counts_per_m`."""

_SCALED = frozenset(("km", "cm", "mm", "um", "nm", "pm", "ms", "us", "kn", "mn", "ma", "mv"))
"""No SI: a name in which one of them multiplies the ending states no unit (mm_per_s is no 1/s)."""


def unit_of(name: str) -> str | None:
    """Return the unit that a name's ending states ("1" for plain numbers), None where it states none.

    The longest ending that can be read counts: `_` multiplies, `_per_` divides, `_sqrt_` takes a root.
    """
    words = name.split("_")
    if len(words) > 1 and words[-1] in _PLAIN:
        return _PLAIN[words[-1]]
    for first in range(0 if "per" in words else 1, len(words)):
        unit = _product(words[first:])
        if unit is not None:
            return None if first and words[first - 1] in _SCALED else unit
    return None


def _product(words: list[str]) -> str | None:
    """Read words as one unit, None where they are none."""
    if "per" not in words:
        symbols = _factors(words, _SYMBOLS)
        return None if symbols is None else " ".join(symbols)
    divided = words.index("per")
    above = ["1"] if divided == 0 else _factors(words[:divided], _SYMBOLS | _COUNTED)
    below = _factors(words[divided + 1 :], _SYMBOLS)
    if above is None or below is None:
        return None
    divisor = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return f"{' '.join(above)}/{divisor}"


def _factors(words: list[str], known: dict[str, str]) -> list[str] | None:
    """Read words as units to be multiplied, each below a root where `sqrt` stands before it."""
    symbols: list[str] = []
    rooted = False
    for word in words:
        if word == "sqrt" and not rooted:
            rooted = True
            continue
        if word not in known:
            return None
        symbols.append(f"sqrt({known[word]})" if rooted else known[word])
        rooted = False
    return symbols if symbols and not rooted else None
