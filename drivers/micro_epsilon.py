"""Micro-Epsilon RS422: blocks of three-byte values, self-synchronising by flag bits, errors as large values.

Source: optoNCDT 1420 manual p. 84 and confocalDT 24x1 manual p. 102-116. Bytes L, M, H of a value carry 6 bits each,
least significant first, tagged 00, 01, 10 (first value of a block) or 11 (every further one). No checksum: always let
the sensor send COUNTER, as the last value: a byte slipped into the last value then spoils the counter, which shows.
The sensor must have OUTHOLD NONE, else it repeats the last good value on an error. Pure.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

from drivers.flagbits_frame import FlagBitsFramer
from drivers.frame_spec import integer, only, wrong

LAST_VALUE = 262_072
"""Values above are error codes."""

ERROR_TEXT = {
    262_073: "below the representable range",
    262_074: "above the representable range",
    262_075: "too much data for the baud rate",
    262_076: "no peak: no light comes back",
    262_077: "peak before the measuring range",
    262_078: "peak behind the measuring range",
    262_079: "value can't be calculated",
}

_VALUES = ("macro", "end", "counter", "ignore")


def micro_epsilon_framer(table: Mapping[str, Any], *, incremental: bool) -> FlagBitsFramer:
    """Make the framer; `values` names the values of a block in order, e.g. ["macro", "end", "counter"]."""
    only(table, {"values", "counter_modulus", "counts_per_wavelength"}, "frame")
    given: Any = table.get("values")
    values = cast(Sequence[Any], given) if isinstance(given, list | tuple) else ()
    if not values or any(value not in _VALUES for value in values):
        raise wrong(
            "frame.values",
            table.get("values"),
            f"must be a list of {', '.join(_VALUES)}",
            "name the values in output order",
        )
    modulus = integer(table, "counter_modulus", 1 << 18, 2, 1 << 18)
    fields: list[dict[str, object]] = []
    for index, value in enumerate(values):
        field: dict[str, object] = {"name": value, "index": index, "role": "sequence" if value == "counter" else value}
        if value == "counter":
            field["modulus"] = modulus
        elif value != "ignore":
            field["invalid_from"] = LAST_VALUE + 1
        fields.append(field)
    return FlagBitsFramer({"values_count": len(values), "fields": fields}, incremental=incremental)
