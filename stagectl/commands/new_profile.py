"""A new profile beside the old one: its place is checked first, then its content as a profile; it is written whole."""

from pathlib import Path

from stagectl.commands.profiles import check_eds
from stagectl.errors import ProfileError, RequestError
from stagectl.gap.believed import document_of
from stagectl.profile import Profile
from stagectl.whole_file import replace_whole


def refuse_place(path: Path, out: Path, force: bool) -> None:
    """Refuse what no command could name, the old profile itself, and another file without a word.

    Errors: RequestError.
    """
    if out.exists() and path.exists() and out.samefile(path):
        raise RequestError(f"-o {out} is the profile itself, which is never changed; give another file")
    if out.is_dir():
        raise RequestError(f"-o {out} is a folder; give the file to write")
    if out.suffix != ".toml":
        raise RequestError(
            f"-o {out}: ends in '{out.suffix}', and commands find a profile by a name that ends in '.toml' only; "
            f"give {out}.toml"
        )
    if not out.parent.is_dir():
        raise RequestError(f"-o {out}: there is no folder {out.parent}; make it, or give another file")
    if out.exists() and not force:
        raise RequestError(f"-o {out} is there already; give another file, or --force to replace it")


def text_of(path: Path) -> str:
    """Read a profile's text. Errors: ProfileError."""
    try:
        return path.read_bytes().decode()
    except OSError as error:
        raise ProfileError(f"{path}: can't be read ({error.strerror}); check path and permissions") from error
    except UnicodeDecodeError as error:
        raise ProfileError(f"{path}: is not UTF-8 text ({error}); save it as UTF-8") from error


def write_checked(text: str, out: Path, what: str) -> None:
    """Check a new profile's text as a profile, EDS files and all, and write it. Errors: ProfileError, RequestError."""
    content = text.encode()
    try:
        document = document_of(content, out)
        if isinstance(document, Profile):
            check_eds(document)
    except ProfileError as error:
        raise ProfileError(f"the profile with these {what} fails its check, {out} is not written:\n{error}") from error
    try:
        replace_whole(out, content)
    except OSError as error:
        raise RequestError(f"-o {out}: can't be written: {error.strerror}; give another file") from error
