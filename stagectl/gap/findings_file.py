"""Findings as JSON: what `stagectl gap` writes and the other steps read. Pure but for reading and writing the file."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from stagectl.errors import RecordError
from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.whole_file import replace_whole

FINDINGS = "findings.json"
_FORMAT = 1


def write_findings(findings: Findings, path: Path) -> None:
    """Write findings whole or not at all; RecordError where the folder can't take them."""
    content = {"format": _FORMAT, **dataclasses.asdict(findings)}
    try:
        replace_whole(path, json.dumps(_plain(content), indent=2, allow_nan=False).encode())
    except OSError as error:
        raise RecordError(f"{path}: can't write the findings: {error.strerror}; give another --out") from error


def read_findings(path: Path) -> Findings:
    """Read findings; RecordError where the file is missing, damaged or of another version."""
    try:
        content = json.loads(path.read_text())
        if content.pop("format", None) != _FORMAT:
            raise RecordError(f"{path}: findings of another version; run `stagectl gap` again")
        content["named"] = tuple(
            Named(**{**row, **{name: tuple(map(tuple, row.get(name, ()))) for name in ("aliases", "correlations")}})
            for row in content["named"]
        )
        content["parameter_errors"] = tuple(
            ParameterError(**{**row, "aliases": tuple(row["aliases"])}) for row in content["parameter_errors"]
        )
        lists = [name for name, value in content.items() if isinstance(value, list)]
        return Findings(**{**content, **{name: tuple(content[name]) for name in lists}})
    except OSError as error:
        raise RecordError(f"{path}: can't read the findings: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordError(f"{path}: not findings of `stagectl gap`: {error}; run it again") from error


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
