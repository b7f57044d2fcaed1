"""The files of a user's own effects that a profile or a machine names; their text goes where the profile goes.

So the servo's process, a run's manifest and its replay have the law itself, not the name of a file.
"""

import os
import stat
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PrivateAttr, ValidationInfo, model_validator

from stagectl.effect_text import declare
from stagectl.errors import ProfileError
from stagectl.toml_file import Problem, Table, refuse

_LONGEST_BYTES = 100_000


class EffectText(Table):
    """One file as it was read, declared in the catalogue."""

    file: Annotated[str, Field(pattern=r"\.py$")]
    text: str

    _names: tuple[str, ...] = PrivateAttr(default=())

    @property
    def names(self) -> tuple[str, ...]:
        """Effects that it declares."""
        return self._names

    @model_validator(mode="after")
    def _declare(self) -> "EffectText":
        """Make its effects known, before the tables that name them are looked at."""
        try:
            self._names = declare(self.text, Path(self.file).name)
        except ProfileError as error:
            refuse([Problem("file", self.file, str(error), "correct the file")])
        return self


def _read(value: Any, info: ValidationInfo) -> Any:
    """Read the file that a name means, beside the profile; what was read before stays as it is."""
    if not isinstance(value, str):
        return value
    context = info.context if isinstance(info.context, dict) else {}
    path = Path(value).expanduser()
    if not path.is_absolute():
        profile_path: Path | None = context.get("path")
        if profile_path is None:
            refuse([Problem("file", value, "has no profile file to lie beside", "give its whole path")])
        else:
            path = profile_path.parent / path
    try:
        _refuse_strangers(value, path)
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        limit = f"{path} can't be read ({error.strerror})"
        refuse([Problem("file", value, limit, "put the file beside the profile, or correct the name")])
    except UnicodeDecodeError:
        refuse([Problem("file", value, f"{path} is not UTF-8 text", "save it as UTF-8")])
    else:
        return {"file": value, "text": text}
    return value


def _refuse_strangers(value: str, path: Path) -> None:
    """Refuse what somebody else may have written, or is no file of this kind."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode) or found.st_size > _LONGEST_BYTES:
        limit = f"{path} is no file of at most {_LONGEST_BYTES // 1000} kB"
        refuse([Problem("file", value, limit, "name a Python file")])
    if found.st_uid not in (0, os.geteuid()) or found.st_mode & stat.S_IWOTH:
        limit = f"{path} belongs to somebody else, or anybody may write it"
        refuse([Problem("file", value, limit, "make it root's or yours, and chmod o-w")])


EffectFile = Annotated[EffectText, BeforeValidator(_read)]
"""A name in `effect_files`, or what was read of it: a table with file and text."""
