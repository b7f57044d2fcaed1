"""The profile's description of a frame, checked to the last key.

Pure; knows no bytes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from stagectl.errors import ProfileError

ROLES = ("sequence", "macro", "end", "status", "check", "ignore")

_FIELD_KEYS = {
    "name", "role", "type", "offset", "index", "modulus", "counts_per_wavelength",
    "valid_mask", "valid_value", "macro_mask", "end_mask", "minimum", "maximum", "invalid_from",
}  # fmt: skip

_COUNTER_MODULUS = {"u8": 1 << 8, "u16": 1 << 16, "u32": 1 << 32, "u64": 1 << 64}


@dataclass(frozen=True, slots=True)
class FieldSpec:
    """One field of a frame; what a kind does not need stays at its default."""

    name: str
    role: str
    type: str = "int"
    offset: int = 0  # byte in a syncfixed frame
    index: int = 0  # column of a line, value of a flagbits block
    modulus: int = 0  # of a sequence; 0 = never wraps
    valid_mask: int = 0  # status: (value & valid_mask) == valid_value makes both axes valid
    valid_value: int = 0
    macro_mask: int = 0  # status: any of these bits away from valid_value invalidates the macro only
    end_mask: int = 0
    minimum: int | None = None  # check: outside these it is no frame
    maximum: int | None = None
    invalid_from: int | None = None  # macro, end: values from here on are error codes


def wrong(key: str, value: object, limit: str, remedy: str) -> ProfileError:
    """A ProfileError in the house's wording for a key under [interferometer]."""
    return ProfileError(f"interferometer.{key} = {value!r}: {limit}; {remedy}")


def only(table: Mapping[str, Any], allowed: set[str], where: str) -> None:
    """Refuse keys that nobody reads."""
    for key in table:
        if key not in allowed:
            raise wrong(f"{where}.{key}", table[key], f"no such key (known: {', '.join(sorted(allowed))})", "remove it")


def integer(table: Mapping[str, Any], key: str, default: int, low: int, high: int, where: str = "frame") -> int:
    """An integer of `table` within limits."""
    value = table.get(key)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise wrong(f"{where}.{key}", value, f"must be a whole number within {low} .. {high}", "correct it")
    return value


def flag(table: Mapping[str, Any], key: str, default: bool, where: str = "frame") -> bool:
    """A truth value of `table`."""
    value = table.get(key)
    if value is None:
        return default
    if not isinstance(value, bool):
        raise wrong(f"{where}.{key}", value, "must be true or false", "correct it")
    return value


def choice(table: Mapping[str, Any], key: str, default: str, allowed: tuple[str, ...], where: str = "frame") -> str:
    """One word of `allowed`."""
    value = table.get(key)
    if value is None:
        return default
    if value not in allowed:
        raise wrong(f"{where}.{key}", value, f"must be one of {', '.join(allowed)}", "correct it")
    return str(value)


def field_specs(table: Mapping[str, Any], types: tuple[str, ...]) -> tuple[FieldSpec, ...]:
    """The `fields` of a frame table: at least a macro or an end, each role once, check and ignore freely."""
    rows: Any = table.get("fields")
    if not isinstance(rows, list | tuple) or not rows:
        raise wrong(
            "frame.fields", table.get("fields"), "must be a list with at least one field", "describe the frame's fields"
        )
    specs: list[FieldSpec] = []
    for number, given in enumerate(cast(Sequence[Any], rows)):
        where = f"frame.fields[{number}]"
        if not isinstance(given, Mapping):
            raise wrong(where, given, "must be a table", "write { name = ..., role = ... }")
        row = cast(Mapping[str, Any], given)
        only(row, _FIELD_KEYS, where)
        role = choice(row, "role", "ignore", ROLES, where)
        kind = choice(row, "type", types[0], types, where)
        if role in ("sequence", "status") and kind.startswith("f"):
            raise wrong(f"{where}.type", kind, f"a {role} is a whole number", "choose an integer type")
        big = (1 << 64) - 1
        bounds = {
            key: None if row.get(key) is None else integer(row, key, 0, -big, big, where)
            for key in ("minimum", "maximum", "invalid_from")
        }
        specs.append(
            FieldSpec(
                name=str(row.get("name") or role),
                role=role,
                type=kind,
                offset=integer(row, "offset", 0, 0, 4095, where),
                index=integer(row, "index", number, 0, 255, where),
                modulus=integer(row, "modulus", _COUNTER_MODULUS.get(kind, 0), 0, 1 << 64, where),
                valid_mask=integer(row, "valid_mask", 0, 0, big, where),
                valid_value=integer(row, "valid_value", 0, 0, big, where),
                macro_mask=integer(row, "macro_mask", 0, 0, big, where),
                end_mask=integer(row, "end_mask", 0, 0, big, where),
                **bounds,
            )
        )
    roles = [spec.role for spec in specs]
    for role in ("sequence", "macro", "end", "status"):
        if roles.count(role) > 1:
            raise wrong("frame.fields", role, "this role is given twice", "keep one field of it")
    if "macro" not in roles and "end" not in roles:
        raise wrong("frame.fields", roles, "no field has the role macro or end", "say which field is a position")
    return tuple(specs)
