"""Predictions as JSON, written before the run that judges them; what came out stands in a file of its own."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stagectl.errors import RecordError
from stagectl.gap.next_move import Proposal
from stagectl.gap.prediction import Outcome
from stagectl.whole_file import replace_whole

PREDICTION = "prediction.json"
OUTCOME = "outcome.json"
_FORMAT = 1


def write_prediction(proposal: Proposal, findings: str, written: str, path: Path) -> None:
    """Write what is expected of a move; RecordError where the folder can't take it. `written` is the instant, ISO."""
    _write(
        path,
        {
            "written": written,
            "findings": findings,
            "move": {"name": proposal.move.name, **proposal.move.trajectory.parameters},
            "duration_s": proposal.move.trajectory.duration_s,
            "for": [proposal.name, proposal.acts_on],
            "d_prime": proposal.d_prime,
            "expected": [dataclasses.asdict(one) for one in proposal.expected],
        },
    )


def write_outcome(outcomes: Sequence[Outcome], run: str, prediction: Path, written: str, path: Path) -> None:
    """Write what a run said of a prediction; RecordError where the folder can't take it."""
    judged = [{**dataclasses.asdict(one), "confirmed": one.confirmed} for one in outcomes]
    _write(path, {"written": written, "run": run, "prediction": prediction.name, "judged": judged})


def _write(path: Path, content: dict[str, Any]) -> None:
    try:
        replace_whole(path, json.dumps({"format": _FORMAT, **content}, indent=2, allow_nan=False).encode())
    except OSError as error:
        raise RecordError(
            f"{path}: can't be written: {error.strerror}; free some space, or check permissions"
        ) from error
