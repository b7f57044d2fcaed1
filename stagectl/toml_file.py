"""Strict TOML reading: one pydantic model, one path, and one ProfileError that lists everything wrong in the file.

Every number states its bounds with `within` or `whole`; relations between keys are `Problem`s given to `refuse`.
A relation is checked once the keys it needs are right by themselves. Knows no profile and no machine.
"""

import difflib
import hashlib
import json
import math
import os
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, PrivateAttr, Strict, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from stagectl.errors import ProfileError
from stagectl.units import unit_of

Flag = Annotated[bool, Strict()]
"""A boolean that is written as one: "yes" and 1 are refused."""

NO_BLANKS = r"[^\s\x00-\x1f\x7f]+"
"""Pattern of a name that is given to the system: one with a byte 0 in it is no error there, it raises."""

# fmt: off
_UNIT_WORDS = frozenset((
    "m", "mm", "um", "nm", "pm", "cm", "km", "inch", "in", "ft", "s", "ms", "us", "ns", "min", "h", "hz", "khz", "mhz",
    "kg", "g", "mg", "t", "lb", "n", "kn", "mn", "un", "a", "ma", "ka", "v", "mv", "kv", "ohm", "mohm", "mh", "uh",
    "pa", "hpa", "kpa", "mpa", "bar", "mbar", "degc", "degf", "k", "c", "f", "rad", "mrad", "deg", "arcsec", "percent",
    "ratio", "count", "counts", "ppm", "ppb", "bit", "baud", "per", "sqrt", "s2", "s3", "m2", "mm2", "rpm",
))
"""What the ending of a key may consist of when somebody meant a unit."""
# fmt: on


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing wrong in a file; `key` is dotted, relative to the table that found it."""

    key: str
    value: object
    limit: str
    remedy: str


_ABSENT = object()


def refuse(problems: Iterable[Problem | None]) -> None:
    """Raise the error that pydantic collects, when there is any problem."""
    found = [problem for problem in problems if problem is not None]
    if found:
        raise PydanticCustomError("problems", "the file contradicts itself", {"problems": found})


def problem_if(wrong: bool, key: str, value: object, limit: str, remedy: str) -> Problem | None:
    """Return a Problem where `wrong`, None elsewhere. Write `wrong` as `not (a < b)`, so that nan is wrong."""
    return Problem(key, value, limit, remedy) if wrong else None


def missing(key: str, why: str = "") -> Problem:
    """Return the Problem of a key that must be there and is not."""
    unit = unit_of(key.rpartition(".")[2])
    limit = f"is missing: {why}" if why else "is missing"
    return Problem(key, _ABSENT, limit, f"add it, in {unit}" if unit not in (None, "1") else "add it")


@dataclass(frozen=True, slots=True)
class Within:
    """Bounds of a number, ends included unless `above`; refuses nan, infinity, booleans, text and dates."""

    low: float
    high: float
    above: bool = False
    whole: bool = False

    def problem(self, key: str, value: object) -> Problem | None:
        """Return what is wrong with `value` as a number, None where nothing is."""
        unit = unit_of(key.rpartition(".")[2].partition("[")[0])
        symbol = "" if unit in (None, "1") else f" {unit}"
        inside = f"in{symbol}" if symbol else "a plain number"
        if isinstance(value, str):
            return Problem(key, value, "must be a number, not text", f"write it without quotes, {inside}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            return Problem(key, value, "must be a number", f"write one, {inside}")
        if isinstance(value, float) and not math.isfinite(value):
            return Problem(key, value, "must be a finite number", f"write the true value, {inside}")
        if self.whole and not isinstance(value, int):
            return Problem(key, value, "must be a whole number", "write it without a decimal point or exponent")
        if not self.low <= value <= self.high or (self.above and value == self.low):
            limit = f"must be above {self.low:g} and at most" if self.above else f"must be {self.low:.10g} to"
            return Problem(key, value, f"{limit} {self.high:.10g}{symbol}", f"correct it, {inside}")
        return None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Check before pydantic converts anything."""
        return core_schema.no_info_before_validator_function(self._checked, handler(source))

    def _checked(self, value: Any) -> Any:
        if self.problem("", value) is not None:
            raise PydanticCustomError("number", "a number is wrong", {"within": self})
        return value


def within(low: float, high: float) -> Within:
    """Bounds of a float, both included."""
    return Within(low, high)


def above(low: float, high: float) -> Within:
    """Bounds of a float that must be above `low`."""
    return Within(low, high, above=True)


def whole(low: int, high: int) -> Within:
    """Bounds of an integer, both included."""
    return Within(low, high, whole=True)


class Table(BaseModel):
    """A table of a file: frozen, every key known."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class Document(Table):
    """The table that is a whole file; knows where it came from."""

    _source_path: Path | None = PrivateAttr(default=None)
    _sha256: str = PrivateAttr(default="")

    def model_post_init(self, context: Any, /) -> None:
        """Take path and hash of the file from the reader."""
        if isinstance(context, Mapping):
            self._source_path = context.get("path")
            self._sha256 = context.get("sha256", "")

    @property
    def source_path(self) -> Path | None:
        """Path of the file, None for values that came from elsewhere (a run's manifest)."""
        return self._source_path

    @property
    def sha256(self) -> str:
        """SHA-256 of the file's bytes, in hexadecimal; empty where there was no file."""
        return self._sha256

    def effective(self) -> dict[str, Any]:
        """Return all values with defaults filled in, ready for JSON; keys that are absent by choice are left out."""
        return self.model_dump(mode="json", exclude_none=True)


DocumentT = TypeVar("DocumentT", bound=Document)


def read(model: type[DocumentT], path: Path) -> DocumentT:
    """Read `path` into `model`; raise one ProfileError that lists every problem."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ProfileError(f"{_place(path)}: can't be read ({error.strerror}); check path and permissions") from error
    return read_content(model, content, path)


def read_content(model: type[DocumentT], content: bytes, path: Path) -> DocumentT:
    """Read what stands in `path`, or is about to; raise one ProfileError that lists every problem."""
    place = _place(path)
    try:
        data = tomllib.loads(content.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ProfileError(f"{place}: is not UTF-8 text ({error}); save it as UTF-8") from error
    except RecursionError as error:
        raise ProfileError(f"{place}: is nested too deeply to be TOML for people; flatten it") from error
    except ValueError as error:
        raise ProfileError(f"{place}: is not TOML: {error}; correct that line") from error
    context = {"path": path.resolve(), "sha256": hashlib.sha256(content).hexdigest()}
    return check(model, data, place, context)


def check(
    model: type[DocumentT], data: Mapping[str, Any], place: str, context: dict[str, Any] | None = None
) -> DocumentT:
    """Check `data` against `model`; `place` names its origin in the ProfileError that lists every problem."""
    try:
        return model.model_validate(dict(data), context=context)
    except ValidationError as error:
        found = _problems(model, data, error.errors(include_url=False))
    raise ProfileError("\n".join(_sentence(place, problem) for problem in found))


def find(name_or_path: str | Path, folders: Sequence[Path], kind: str) -> Path:
    """Return the path meant: a bare name is looked for in `folders` (ProfileError if absent), the rest is a path."""
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or os.sep in text or text.endswith(".toml"):
        return Path(text).expanduser()
    for folder in folders:
        if (path := folder / f"{text}.toml").is_file():
            return path
    known = names_in(folders)
    looked = ", ".join(_place(folder) for folder in folders)
    near = difflib.get_close_matches(text, known, 1, 0.5)
    remedy = f"did you mean {near[0]}?" if near else f"choose from {', '.join(known) or 'none'}, or give a path"
    raise ProfileError(f"{kind} {text!r} is not in {looked}; {remedy}")


def names_in(folders: Sequence[Path]) -> list[str]:
    """Return the names of all TOML files in `folders`, sorted, each once."""
    return sorted({path.stem for folder in folders if folder.is_dir() for path in folder.glob("*.toml")})


def closest_key(key: str, known: Iterable[str]) -> str | None:
    """Return the known key that `key` was meant to be: the same name with its unit, else the nearest spelling."""
    candidates = list(known)
    for candidate in candidates:
        if _differs_in_unit(key, candidate):
            return candidate
    near = difflib.get_close_matches(key, candidates, 1, 0.6)
    return near[0] if near else None


def unknown_key(key: str, value: object, known: Iterable[str]) -> tuple[Problem, str | None]:
    """Return the Problem of a key that nobody reads, and the key that it probably stands for."""
    names = list(known)
    meant = closest_key(key, names)
    if meant is None:
        return Problem(
            _key(key), value, "is not a key of this table", f"remove it, or choose from {', '.join(names)}"
        ), None
    unit = unit_of(meant)
    if _differs_in_unit(key, meant):
        if unit == "1":
            return Problem(_key(key), value, "the name must say that it is a plain number", f"write {meant}"), meant
        return Problem(_key(key), value, f"the name must end in its unit, {unit}", f"write {meant}, in {unit}"), meant
    also = f" ({unit})" if unit not in (None, "1") else ""
    return Problem(_key(key), value, "is not a key of this table", f"did you mean {meant}{also}?"), meant


def _differs_in_unit(key: str, known: str) -> bool:
    """Return whether `key` is the name of `known` with no unit or another one."""
    stem = _stem(known)
    if stem is None or not key.startswith(stem):
        return False
    rest = key[len(stem) :]
    return not rest or (rest[0] == "_" and set(rest[1:].split("_")) <= _UNIT_WORDS)


def _stem(name: str) -> str | None:
    """Return `name` without its unit, None where it states no unit: the shortest ending with the same unit is cut."""
    unit = unit_of(name)
    words = name.split("_")
    if unit is None:
        return None
    for count in range(1, len(words)):
        if unit_of("x_" + "_".join(words[-count:])) == unit:
            return "_".join(words[:-count])
    return None


def _problems(model: type[BaseModel], data: Mapping[str, Any], errors: list[ErrorDetails]) -> list[Problem]:
    """Turn pydantic's errors into problems with dotted keys; a missing key that was merely misspelt is told once."""
    found: list[Problem] = []
    meant: set[str] = set()
    absent: list[Problem] = []
    for error in errors:
        location = _without_tags(data, error)
        key = _dotted(location)
        table = _dotted(location[:-1])
        value, context = error["input"], error.get("ctx", {})
        match error["type"]:
            case "number":
                found.append(context["within"].problem(key, value) or Problem(key, value, "is wrong", "correct it"))
            case "problems":
                prefix = f"{key}." if key else ""
                found += [Problem(prefix + p.key, p.value, p.limit, p.remedy) for p in context["problems"]]
            case "extra_forbidden":
                known = _known_keys(model, error["loc"])
                problem, name = unknown_key(str(location[-1]), value, known)
                prefix = f"{table}." if table else ""
                meant.add(f"{prefix}{name}")
                found.append(Problem(key, value, problem.limit, problem.remedy))
            case "missing":
                absent.append(missing(key))
            case "union_tag_not_found":
                absent.append(missing(f"{key}.{_unquoted(context)}"))
            case "union_tag_invalid":
                name = _unquoted(context)
                limit = f"must be one of {context['expected_tags']}"
                found.append(Problem(f"{key}.{name}", context["tag"], limit, "choose one of them"))
            case "literal_error":
                found.append(Problem(key, value, f"must be {context['expected']}", "choose one of them"))
            case "string_type":
                found.append(Problem(key, value, "must be text", "put it in quotes"))
            case "string_pattern_mismatch":
                found.append(Problem(key, value, f"must look like {context['pattern']}", "rewrite it"))
            case "bool_type":
                found.append(Problem(key, value, "must be true or false", "write one of them, without quotes"))
            case "tuple_type":
                found.append(Problem(key, value, "must be a list", "write it in [ ]"))
            case "too_long":
                remedy = f"remove {context['actual_length'] - context['max_length']}"
                found.append(Problem(key, value, f"must have at most {context['max_length']} elements", remedy))
            case "too_short":
                found.append(Problem(key, value, f"must have at least {context['min_length']} elements", "add to it"))
            case "model_type" | "model_attributes_type" | "dict_type":
                found.append(Problem(key, value, "must be a table", f"write its keys under [{key}]"))
            case _:
                found.append(Problem(key, value, error["msg"].lower(), "correct it"))
    return found + [problem for problem in absent if problem.key not in meant]


def _unquoted(context: Mapping[str, Any]) -> str:
    return str(context["discriminator"]).strip("'")


def _without_tags(data: object, error: ErrorDetails) -> list[str | int]:
    """Return the location in the file: pydantic also names the chosen branch of a union, which is no key."""
    kept: list[str | int] = []
    steps = error["loc"]
    for number, step in enumerate(steps):
        last_of_missing = error["type"] == "missing" and number == len(steps) - 1
        if isinstance(data, Mapping) and step not in data and step in _texts(data) and not last_of_missing:
            continue
        kept.append(step)
        if isinstance(data, Mapping):
            data = data.get(step)
        elif isinstance(data, list) and isinstance(step, int) and step < len(data):
            data = data[step]
        else:
            data = None
    return kept


def _texts(data: Mapping[str, Any]) -> list[str]:
    return [value for value in data.values() if isinstance(value, str)]


def _known_keys(model: type[BaseModel], location: tuple[str | int, ...]) -> list[str]:
    """Return the keys that the table around `location` may have."""
    tables = [model]
    for step in location[:-1]:
        if isinstance(step, int):
            continue
        inner = [table.model_fields[step].annotation for table in tables if step in table.model_fields]
        if inner:
            tables = [found for annotation in inner for found in _tables_in(annotation)]
        else:
            tables = [table for table in tables if step in _tags(table)]
    return [name for table in tables for name in table.model_fields]


def _tables_in(annotation: Any) -> list[type[BaseModel]]:
    """Return every table class that an annotation mentions."""
    if isinstance(annotation, type) and get_origin(annotation) is None and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for argument in get_args(annotation) for table in _tables_in(argument)]


def _tags(table: type[BaseModel]) -> list[Any]:
    """Return the values of the table's Literal keys."""
    annotations = [field.annotation for field in table.model_fields.values()]
    return [tag for annotation in annotations if get_origin(annotation) is Literal for tag in get_args(annotation)]


def _dotted(location: Sequence[str | int]) -> str:
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{_key(step)}" for step in location)
    return text.removeprefix(".")


def _key(text: str) -> str:
    return text if text.replace("_", "").replace("-", "").isalnum() else json.dumps(text)


def _sentence(place: str, problem: Problem) -> str:
    if problem.value is _ABSENT:
        return f"{place}: {problem.key} {problem.limit}; {problem.remedy}"
    return f"{place}: {problem.key} = {_shown(problem.value)}: {problem.limit}; {problem.remedy}"


def _shown(value: object) -> str:
    """Write a value as TOML would, shortened."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        text = json.dumps(value, ensure_ascii=not value.isprintable())  # escape codes stay off the terminal
    elif isinstance(value, Mapping):
        text = "{ " + ", ".join(f"{key} = {_shown(inner)}" for key, inner in value.items()) + " }"
    elif isinstance(value, list | tuple):
        text = "[" + ", ".join(_shown(inner) for inner in value) + "]"
    elif isinstance(value, int) and value.bit_length() > 128:
        text = f"a number of {value.bit_length()} bits"  # Python refuses to print it
    else:
        text = str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _place(path: Path) -> str:
    """Return the path as a person would type it here."""
    absolute = path.absolute()
    here = Path.cwd()
    return str(absolute.relative_to(here)) if absolute.is_relative_to(here) else str(path)
