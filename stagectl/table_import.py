"""A measured table from elsewhere (CSV, MAT) becomes a run: columns mapped to ROW fields, units to SI, all of it said.

Reads no clock.
"""

import codecs
import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from stagectl.errors import RecordError, RequestError
from stagectl.record import Recorder
from stagectl.row import ROW, new_rows
from stagectl.suggestion import closest
from stagectl.units import unit_of

_SCALES = {
    "m": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "cm": 1e-2},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6, "µm/s": 1e-6},
    "m/s^2": {"m/s^2": 1.0, "mm/s^2": 1e-3, "g": 9.80665},
    "m/s^3": {"m/s^3": 1.0, "mm/s^3": 1e-3},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "N/m": {"N/m": 1.0, "N/mm": 1e3, "N/um": 1e6},
    "1": {"1": 1.0, "%": 1e-2, "ppm": 1e-6},
}
_TIME_NS = {"ns": 1.0, "us": 1e3, "µs": 1e3, "ms": 1e6, "s": 1e9, "min": 60e9}
_PLAIN = {"1": 1.0, "count": 1.0, "counts": 1.0}

POSITION_SPAN_LIMIT_M = 2.0
"""A stage of this class travels less; a wider column said to be metres is probably millimetres."""

VELOCITY_LIMIT_M_PER_S = 10.0
"""No stage of this class is faster over 10 ms; a column of positions that says so is probably millimetres."""

PERIOD_LIMIT_S = 0.1
"""No servo samples slower; a time column said to be seconds that does is probably milliseconds."""


@dataclass(frozen=True)
class Conversion:
    """How one column of the table became a ROW field: value = column x factor, in the unit of the field."""

    name: str
    column: str
    unit: str
    factor: float
    factor_unit: str

    @property
    def text(self) -> str:
        """The conversion as a sentence."""
        return f"{self.name} = {self.column} [{self.unit}] x {self.factor:.12g}, in {self.factor_unit}"


@dataclass(frozen=True)
class Imported:
    """The run that a table became, and what a person should know of it."""

    folder: Path
    rows_count: int
    conversions: tuple[str, ...]
    remarks: tuple[str, ...]


def import_table(path: Path, column_map: Path | Sequence[str] | Mapping[str, Any], out: Path) -> Imported:
    """Turn a .csv or .mat table into the run folder `out`.

    `column_map` is a TOML file (or its content) of `name = { column = "qm", unit = "mm" }` or `name = "qm:mm"`, or a
    list of items `name=column:unit`. A unit may carry a number, `vir:35.15 N`, where a column counts in that. `t_ns`
    must be mapped. Fields that are not mapped are missing from the run.
    Errors: RequestError (map, unit, missing column), RecordError (file, nan, time that does not rise).
    """
    path, out = Path(path), Path(out)
    items = _map_items(column_map)
    table, remarks = _read_table(path)
    conversions = _conversions(items, table, path)
    fields = [conversion.name for conversion in conversions]
    rows = new_rows(len(table[next(c.column for c in conversions if c.name == "t_ns")]))
    for conversion in conversions:
        if len(table[conversion.column]) != len(rows):
            raise RecordError(
                f"{path}: column {conversion.column!r} has {len(table[conversion.column])} values and the time has "
                f"{len(rows)}; map columns of one length"
            )
        rows[conversion.name] = _converted(table[conversion.column], conversion, path)
    _check_time(rows["t_ns"], next(c for c in conversions if c.name == "t_ns"), path)
    if "cycle" not in fields:
        rows["cycle"] = np.arange(len(rows))
        fields.append("cycle")
    remarks += _doubts(rows, conversions)
    texts = tuple(conversion.text for conversion in conversions)
    manifest = {
        "name": path.stem,
        "backend": "import",
        "import": {"source": str(path), "conversions": list(texts), "remarks": remarks},
    }
    with Recorder(out, manifest, [name for name in ROW.names or () if name in fields]) as recorder:
        recorder.event("imported", int(rows["t_ns"][0]), source=path, conversions=list(texts), remarks=remarks)
        recorder.append(rows)
    return Imported(out, len(rows), texts, tuple(remarks))


def _map_items(column_map: Path | Sequence[str] | Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return (name, column, unit) of every item. Errors: RequestError."""
    if isinstance(column_map, str | Path):
        try:
            with open(column_map, "rb") as file:
                column_map = tomllib.load(file)
        except (OSError, tomllib.TOMLDecodeError) as error:
            raise RequestError(
                f"{column_map}: not a readable column map: {error}; it is TOML, one field a line"
            ) from error
    pairs: Iterable[tuple[str, Any]]
    if isinstance(column_map, Mapping):
        pairs = column_map.items()
    else:
        pairs = [_split_item(item) for item in column_map]
    items = [(name, *_column_and_unit(name, value)) for name, value in pairs]
    names = [name for name, _, _ in items]
    for name in names:
        if names.count(name) > 1:
            raise RequestError(f"column map: {name} is mapped twice; keep one")
    if "t_ns" not in names:
        raise RequestError("column map: t_ns is missing; map the time of each sample, for example t_ns=time:s")
    return items


def _split_item(item: str) -> tuple[str, str]:
    name, equals, rest = item.partition("=")
    if not equals:
        raise RequestError(f"column map item {item!r}: write it as name=column:unit, for example end_position_m=qm:mm")
    return name.strip(), rest


def _column_and_unit(name: str, value: Any) -> tuple[str, str]:
    if isinstance(value, Mapping):
        unknown = set(value) - {"column", "unit"}
        if unknown or set(value) != {"column", "unit"}:
            raise RequestError(f"column map: {name} takes exactly column and unit, not {', '.join(sorted(value))}")
        return str(value["column"]), str(value["unit"])
    column, colon, unit = str(value).rpartition(":")
    if not colon or not column or not unit.strip():
        raise RequestError(f"column map: {name} = {value!r} states no unit; write column:unit, for example qm:mm")
    return column.strip(), unit.strip()


def _conversions(items: list[tuple[str, str, str]], table: dict[str, np.ndarray], path: Path) -> list[Conversion]:
    mappable = [name for name in ROW.names or () if ROW[name].shape == ()]
    conversions = []
    for name, column, unit in items:
        if name not in mappable:
            raise RequestError(f"column map: {name!r} is no field of a row{closest(name, mappable)}")
        if column not in table:
            raise RequestError(f"{path}: no column {column!r} for {name}{closest(column, table)}")
        conversions.append(_conversion(name, column, unit))
    return conversions


def _conversion(name: str, column: str, unit: str) -> Conversion:
    number, symbol = _number_and_symbol(name, unit)
    target = unit_of(name)
    if target == "ns":
        scales = _TIME_NS
    elif target is None or ROW[name] == np.int64:
        scales = _PLAIN
    else:
        scales = _SCALES.get(target, {target: 1.0})
    if symbol not in scales:
        raise RequestError(f"column map: {name} can't be had from unit {unit!r}; use one of {', '.join(scales)}")
    return Conversion(name, column, unit, number * scales[symbol], target or "1")


def _number_and_symbol(name: str, unit: str) -> tuple[float, str]:
    first, _, rest = unit.partition(" ")
    if not rest:
        return 1.0, unit
    try:
        number = float(first)
    except ValueError:
        raise RequestError(f"column map: unit {unit!r} of {name} is not `unit` or `number unit`") from None
    if not math.isfinite(number) or number == 0.0:
        raise RequestError(f"column map: unit {unit!r} of {name}: the number must be finite and not zero")
    return number, rest.strip()


def _converted(values: np.ndarray, conversion: Conversion, path: Path) -> np.ndarray:
    """Return the column in the unit of its field; integers that need no factor stay exact. Errors: RecordError."""
    place = f"{path}: column {conversion.column!r} ({conversion.name})"
    if values.dtype.kind == "O":
        row = next((number for number, text in enumerate(values) if not _is_number(text)), 0)
        raise RecordError(f"{place}: {values[row]!r} in data row {row + 1} is no number; correct the table")
    if conversion.factor == 1.0 and np.can_cast(values.dtype, np.int64):
        return values.astype(ROW[conversion.name])
    with np.errstate(over="ignore"):  # what grows beyond a double is infinite, and refused below
        scaled = values.astype(np.float64) * conversion.factor
    bad = np.flatnonzero(~np.isfinite(scaled))
    if bad.size:
        raise RecordError(
            f"{place}: {bad.size} of {len(values)} values are empty, nan or infinite, the first in data row "
            f"{bad[0] + 1}; cut those rows or fill them before importing"
        )
    if ROW[conversion.name] == np.float64:
        return scaled
    if not np.all(np.abs(scaled) < 2.0**63):
        raise RecordError(f"{place}: a value is beyond 64-bit integers; check unit {conversion.unit!r}")
    whole = np.rint(scaled)
    if conversion.factor_unit != "ns" and not np.array_equal(whole, scaled):
        row = int(np.flatnonzero(whole != scaled)[0])
        raise RecordError(f"{place}: {scaled[row]!r} in data row {row + 1} is not a whole number; map another column")
    return whole.astype(np.int64)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check_time(t_ns: np.ndarray, conversion: Conversion, path: Path) -> None:
    if len(t_ns) < 2:
        raise RecordError(f"{path}: {len(t_ns)} data rows are no run; at least 2 are needed")
    wrong = np.flatnonzero(np.diff(t_ns) <= 0)
    if wrong.size:
        row = int(wrong[0])
        raise RecordError(
            f"{path}: time in column {conversion.column!r} does not rise after data row {row + 1} "
            f"({int(t_ns[row])} ns, then {int(t_ns[row + 1])} ns; {wrong.size} such rows); "
            "sort the table, cut double rows, or import laps one by one"
        )


def _doubts(rows: np.ndarray, conversions: list[Conversion]) -> list[str]:
    """Say what looks like a wrong unit."""
    remarks = []
    t_s = (rows["t_ns"] - rows["t_ns"][0]) * 1e-9
    period_s = float(np.median(np.diff(t_s)))
    time = next(conversion for conversion in conversions if conversion.name == "t_ns")
    if period_s > PERIOD_LIMIT_S:
        remarks.append(
            f"{time.column}: a sample every {period_s:.3g} s looks like ms read as {time.unit}; check its unit"
        )
    if period_s < 1e-6:
        remarks.append(
            f"{time.column}: a sample every {period_s:.3g} s is too fast for a servo; check unit {time.unit}"
        )
    step_count = min(max(1, round(0.01 / period_s)), len(rows) - 1)
    for conversion in conversions:
        if not conversion.name.endswith("_m") or conversion.name.startswith("backlash"):
            continue
        position_m = rows[conversion.name]
        span_m = float(np.ptp(position_m))
        moved_m = np.abs(position_m[step_count:] - position_m[:-step_count])
        elapsed_s = t_s[step_count:] - t_s[:-step_count]
        fastest_m_per_s = float(np.max(moved_m / elapsed_s))
        if span_m > POSITION_SPAN_LIMIT_M:
            why = f"spans {span_m:.4g} m"
        elif fastest_m_per_s > VELOCITY_LIMIT_M_PER_S:
            why = f"moves at {fastest_m_per_s:.4g} m/s"
        else:
            continue
        remarks.append(
            f"{conversion.column} ({conversion.name}) {why}: "
            f"that looks like mm read as {conversion.unit}; check its unit"
        )
    return remarks


def _read_table(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the numeric columns of a file by name, each of shape (n,), and remarks on how it was read."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _read_csv(path)
    if suffix == ".mat":
        return _read_mat(path), []
    raise RequestError(f"{path}: a table is .csv or .mat, not {suffix or 'without ending'}; convert it first")


def _read_csv(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    import pyarrow.csv as arrow_csv

    remarks = []
    _check_encoding(path)
    try:
        with open(path, encoding="utf-8-sig", errors="replace") as file:
            header = file.readline()
        delimiter = max(",;\t", key=header.count)
        decimal_point = "," if delimiter == ";" and _has_decimal_commas(path) else "."
        with open(path, "rb") as content:  # Arrow opens no path that is not UTF-8
            table = arrow_csv.read_csv(
                content,
                parse_options=arrow_csv.ParseOptions(delimiter=delimiter),
                convert_options=arrow_csv.ConvertOptions(decimal_point=decimal_point, strings_can_be_null=True),
            )
    except OSError as error:
        raise RecordError(f"{path}: can't be read: {error.strerror or error}; check path and permissions") from error
    except pa.ArrowInvalid as error:
        raise RecordError(
            f"{path}: not a CSV table: {error}; one header line, then as many values in each row"
        ) from error
    if delimiter != ",":
        remarks.append(f"read with {'tabs' if delimiter == chr(9) else delimiter} between columns")
    if decimal_point == ",":
        remarks.append("read with decimal commas")
    names = [name.strip() for name in table.column_names]
    for name in names:
        if names.count(name) > 1:
            raise RecordError(f"{path}: two columns are called {name!r}; rename one")
    return {name: _numbers(column) for name, column in zip(names, table.columns, strict=True)}, remarks


def _check_encoding(path: Path) -> None:
    """Refuse a table whose header is not UTF-8. Errors: RecordError."""
    try:
        with open(path, "rb") as file:
            header = file.readline(1 << 20)
    except OSError as error:
        raise RecordError(f"{path}: can't be read: {error.strerror or error}; check path and permissions") from error
    if header.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in header:
        raise RecordError(f"{path}: looks like UTF-16, not UTF-8; save as UTF-8 (in a spreadsheet: CSV UTF-8)")
    try:
        header.decode("utf-8")
    except UnicodeDecodeError as error:
        raise RecordError(
            f"{path}: byte 0x{header[error.start]:02X} in the header, behind "
            f"{header[: error.start].decode(errors='replace')!r}, is not UTF-8 (Latin-1?); save as UTF-8"
        ) from error


def _numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Return a CSV column as numbers, nan where empty; as Python objects where it is text."""
    if pa.types.is_null(column.type):
        return np.full(len(column), np.nan)
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        return column.to_numpy()
    return np.array([str(value) for value in column.to_pylist()], dtype=object)


def _has_decimal_commas(path: Path) -> bool:
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        file.readline()
        return "," in file.readline()


def _read_mat(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path, simplify_cells=True, appendmat=False)
    except NotImplementedError as error:
        raise RecordError(f"{path}: MAT 7.3 (HDF5) is not read; save it with -v7 in MATLAB, or as CSV") from error
    except OSError as error:
        raise RecordError(f"{path}: can't be read: {error.strerror or error}; check path and permissions") from error
    except (MatReadError, ValueError, TypeError) as error:
        raise RecordError(f"{path}: not a MAT file, or a damaged one: {error}; save it again with -v7") from error
    columns: dict[str, np.ndarray] = {}
    _collect(content, "", columns)
    if not columns:
        raise RecordError(f"{path}: holds no numeric vector; a column is a variable of n x 1 or 1 x n numbers")
    return columns


def _collect(content: Mapping[str, Any], prefix: str, columns: dict[str, np.ndarray]) -> None:
    """Take the numeric vectors out of nested structs, named with dots."""
    for name, value in content.items():
        if name.startswith("__"):
            continue
        if isinstance(value, Mapping):
            _collect(value, f"{prefix}{name}.", columns)
        elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "iuf" and value.size > 1:
            columns[prefix + name] = value
