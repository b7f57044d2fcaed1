"""A run's folder, made before the run: two commands of the same second get two folders."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from stagectl.errors import RecordError
from stagectl.runs import new_run_folder


def reserve(root: Path, name: str) -> Path:
    """Make and return an empty folder like runs/2026-11-20T09-14-03-NAME, with -2, -3 ... where others have that.

    Only the making tells who was first: between a look and a mkdir another command may come. Errors: RequestError
    where `name` is none, RecordError where the folder can't be made.
    """
    while True:
        folder = new_run_folder(root, name)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise RecordError(
                f"{folder}: can't begin a run: {error.strerror}; nothing was recorded; "
                "free space, check permissions, or give another folder"
            ) from error
        return folder


def give_back(folder: Path) -> None:
    """Remove a reserved folder in which nothing was written; any other stays."""
    with contextlib.suppress(OSError):
        folder.rmdir()


@contextlib.contextmanager
def reserved(root: Path, name: str) -> Iterator[Path]:
    """Yield a reserved folder, and give it back where nothing was written."""
    folder = reserve(root, name)
    try:
        yield folder
    finally:
        give_back(folder)
