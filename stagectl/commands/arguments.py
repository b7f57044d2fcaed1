"""What all command lines share: how an option is declared, what help ends with, how work is delivered."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from stagectl.commands.answer import Answer, Voice

EXIT_CODES = (
    "Exit codes: 0 done; 1 ended early (a stop by guard or drive, or a replay that differs); 2 wrong usage, profile or "
    "request; 3 link or drive; 4 timing (a step took too long); 5 run folder; 130 Ctrl-C, SIGTERM or a closed terminal "
    "(stage at rest, run closed)."
)


def epilog(*examples: str) -> str:
    """Examples first, each on a line of its own, then the exit codes."""
    return "\n\n".join([*(f"Example: [cyan]{example}[/]" for example in examples), f"[dim]{EXIT_CODES}[/]"])


def option(help: str, *names: str, metavar: str | None = None, **more: Any) -> Any:
    """Declare an option."""
    return typer.Option(*names, help=help, metavar=metavar, **more)


def deliver(command: str, as_json: bool, work: "Callable[[Voice], Answer]", compiles: bool = True) -> NoReturn:
    """Do the work and end the command; what that takes is imported here."""
    from stagectl.commands.answer import deliver as deliver_answer

    deliver_answer(command, as_json, work, compiles)


Json = Annotated[bool, option("One JSON object on stdout and nothing else; progress on stderr.", "--json")]
