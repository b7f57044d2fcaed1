"""How a command speaks: one answer on stdout, progress and errors on stderr, an exit code that means something."""

import codecs
import contextlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import typer
from rich.console import Console, RenderableType

from stagectl.commands.interruption import Interruption
from stagectl.commands.live_progress import LiveProgress
from stagectl.errors import DriveError, LinkError, ProfileError, RecordError, RequestError, StagectlError, TimingError

EXIT_CODES: dict[type[StagectlError], int] = {
    ProfileError: 2,
    RequestError: 2,
    LinkError: 3,
    DriveError: 3,
    TimingError: 4,
    RecordError: 5,
}
ENDED_EARLY = 1
INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command found: one JSON object, the same for people, and the exit code."""

    data: dict[str, Any]
    shown: Sequence[RenderableType] = ()
    exit_code: int = 0


@dataclass(slots=True)
class Voice:
    """What a command says while it works; `run_folder` is named when it is interrupted or fails."""

    console: Console
    progress: LiveProgress
    hush: Callable[[], None]  # from here on no signal interrupts
    listen: Callable[[], None]  # from here on one does again
    run_folder: Path | None = field(default=None)
    whole_file: Path | None = field(default=None)  # a result that is there whatever comes after
    left_behind: str = "nothing was recorded"  # by an interrupt, where this command has no run of its own

    def check(self) -> None:
        """Let an interrupt come out that was asked for."""
        self.progress.check()

    def note(self, text: str) -> None:
        """Say a sentence on stderr."""
        self.console.print(text, style="dim", highlight=False, markup=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        """Say a sentence that nobody should miss."""
        self.console.print(text, style="yellow", highlight=False, markup=False, soft_wrap=True)


def jsonable(value: Any) -> Any:
    """Turn numpy values and paths into JSON's; what is no finite number becomes null."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, bool | str | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    return str(value)


def deliver(command: str, as_json: bool, work: Callable[[Voice], Answer], compiles: bool = True) -> NoReturn:
    """Do the work and end the command: prints the answer or the error, raises typer.Exit with the exit code.

    `compiles`: whether it may run compiled code in this process; where that is kept is looked at first then.
    """
    console = Console(stderr=True)
    interruption = Interruption()
    voice = Voice(console, LiveProgress(console, interruption.check), interruption.hush, interruption.listen)
    if compiles:
        _say_where_compiled_code_goes(voice)
    try:
        with interruption, voice.progress:
            answer = work(voice)
        _say_answer(command, as_json, answer)
    except StagectlError as error:
        code = EXIT_CODES.get(type(error), ENDED_EARLY)
        _say_error(command, as_json, console, voice, error, code)
        raise typer.Exit(code) from error
    except KeyboardInterrupt as interrupt:
        _say_interrupted(command, as_json, console, voice)
        raise typer.Exit(INTERRUPTED) from interrupt
    raise typer.Exit(answer.exit_code)


@contextlib.contextmanager
def onto_stdout() -> Iterator[None]:
    """Turn what a full disk says into RecordError; a pipe that nobody reads any more ends the command quietly."""
    if sys.stdout is None:
        raise RecordError("stdout: is closed; what was to be said there is lost")
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())  # what Python still holds for it would fail once more at the exit
        os.close(nowhere)
        raise RecordError(f"stdout: can't be written: {error.strerror}; what was to be said there is lost") from error


def say_line(text: str) -> None:
    """Say a line on stdout that doesn't wait for the answer. Errors: RecordError where it can't be written."""
    with onto_stdout():
        print(text, flush=True)


def _say_answer(command: str, as_json: bool, answer: Answer) -> None:
    if as_json:
        _print_json({"command": command, "exit_code": answer.exit_code, **answer.data})
        return
    with onto_stdout():
        out = Console()
        for part in answer.shown:
            out.print(part, highlight=False, soft_wrap=isinstance(part, str))


def _say_where_compiled_code_goes(voice: Voice) -> None:
    from stagectl.compiled import CACHE_REMARK  # numba: not for a command line that is wrong

    if CACHE_REMARK:
        voice.warn(CACHE_REMARK)


def _print_json(value: dict[str, Any]) -> None:
    content = jsonable(value)
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    with onto_stdout():
        if codecs.lookup(sys.stdout.encoding or "ascii").name != "utf-8" or _has_raw_bytes(text):
            text = json.dumps(content, indent=2, allow_nan=False)
        print(text, flush=True)


def _has_raw_bytes(text: str) -> bool:
    """Tell whether bytes of a path that are no UTF-8 stand in a text, as lone surrogates."""
    return any("\ud800" <= letter <= "\udfff" for letter in text)


def _ending(run: Path | None) -> dict[str, str]:
    """Return the name of the Stop that a run was closed with; empty where there is none."""
    if run is None:
        return {}
    from stagectl.record import read_manifest
    from stagectl.runs import ending

    try:
        stop, _ = ending(read_manifest(run))
    except RecordError:  # the error that is said already stands first
        return {}
    return {"stop": stop} if stop else {}


def _say_error(
    command: str, as_json: bool, console: Console, voice: Voice, error: StagectlError, exit_code: int
) -> None:
    kind = type(error).__name__
    console.print(f"[bold red]{kind}[/]", highlight=False)
    console.print(str(error), highlight=False, markup=False, soft_wrap=True)
    run = _existing_run(voice)
    if run is not None:
        voice.note(f"the run up to here: {run}")
    if as_json:
        failure = {"kind": kind, "message": str(error)}
        said = {"command": command, "exit_code": exit_code, "error": failure, "run": run, **_ending(run)}
        with contextlib.suppress(RecordError):  # of stdout itself; the reason stands on stderr
            _print_json(said)


def _say_interrupted(command: str, as_json: bool, console: Console, voice: Voice) -> None:
    run = _existing_run(voice)
    kept = voice.whole_file
    moved = "the stage was brought to rest and the run closed" if run is not None else voice.left_behind
    if kept is not None:
        moved = f"{moved}; {kept} is whole" if run is not None else f"{kept} is whole, what was to follow is not there"
    console.print(f"[bold yellow]interrupted[/]: {moved}", highlight=False)
    if run is not None:
        voice.note(f"the run up to here: {run}")
    if as_json:
        failure = {"kind": "Interrupted", "message": moved}
        _print_json({"command": command, "exit_code": INTERRUPTED, "error": failure, "run": run})


def _existing_run(voice: Voice) -> Path | None:
    folder = voice.run_folder
    return folder if folder is not None and folder.exists() else None
