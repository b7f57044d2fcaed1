"""`stagectl scan`, `follow` and `stream`: motion over time through the service."""

import itertools
import math
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

from pydantic import ValidationError

from stagectl.commands import remote
from stagectl.commands.answer import Answer, Voice
from stagectl.errors import RequestError
from stagectl.service import messages


def scan(voice: Voice, socket: Path | None, token: str | None, path: Path) -> Answer:
    """Follow the scan program of a TOML file."""
    body = _program(path)
    return remote.motion(voice, socket, token, None, "auto", "scan", body)


def _program(path: Path) -> messages.Scan:
    try:
        return messages.Scan.model_validate(tomllib.loads(path.read_text()))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RequestError(f"{path}: {error}; give a readable TOML file with [[segments]]") from error
    except ValidationError as error:
        raise RequestError(f"{path}: {messages.sentence(error.errors()[0])}") from error


def follow(voice: Voice, socket: Path | None, token: str | None, path: Path, law: str | None) -> Answer:
    """Follow the motion of a CSV file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"trajectory {path}: {error}; give a CSV file with the header t_s,position_m") from error
    body = remote.checked(messages.Follow, text=text, law=law)
    return remote.motion(voice, socket, token, None, "auto", "follow", body)


def stream(voice: Voice, socket: Path | None, token: str | None, period_s: float) -> Answer:
    """Follow positions from standard input, one a line; goes to the first one before."""
    positions = _numbers(sys.stdin)
    first = next(positions, None)
    if first is None:
        raise RequestError("standard input is empty; give positions in metres, one a line")
    beginning = remote.checked(messages.Setpoints, first_number=0, period_s=period_s, position_m=[first])
    with remote.connected(socket) as stage:
        status = stage.status()
        voice.note(f"{status.profile} through the service: {status.banner}")
        with remote.leased(voice, stage, token):
            stage.check("setpoints", beginning)
            command = remote.prepared(voice, stage, status, "stream")
            if command is None:
                command = stage.move(first)
            if command.stop == "FINISHED":
                command = stage.stream(itertools.chain([first], positions), period_s)
        at_rest = stage.status()
    return remote.answered(command, at_rest)


def _numbers(lines: Iterable[str]) -> Iterator[float]:
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            position_m = float(line)
        except ValueError:
            position_m = math.nan
        if not math.isfinite(position_m):
            raise RequestError(f"line {number} is {line.strip()[:60]!r}; give one position in metres a line")
        yield position_m
