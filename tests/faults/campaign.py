"""One run of the campaign from its seed: draw, play, judge."""

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stagectl.errors import StagectlError
from stagectl.record import read_run
from tests.faults.judge import Record, Verdict, judge
from tests.faults.kinds import KINDS, MOVING, PHASES, Drawn
from tests.faults.scene import Scene

_IN_TURN = {  # kinds whose phases come in turn: mostly the one that they are there for, or none is left to chance
    "client vanishes": tuple(
        phase for other in ("at rest", *MOVING, "identifying", "homing") for phase in ("jogging", other)
    ),
    "following error": (*MOVING, "identifying", *MOVING, "jogging", *PHASES),
    "obstacle": ("constant speed", "jogging", "accelerating", "decelerating", *PHASES),
}


@dataclass(frozen=True)
class Result:
    """What became of one seed."""

    seed: int
    kind: str
    phase: str
    text: str
    fault_kind: str
    verdict: Verdict | None  # None: skipped, for `reason`
    took_s: float
    reason: str = ""

    @property
    def line(self) -> str:
        """One line for a table of violations, with how to see it again."""
        said = "; ".join(": ".join(one) for one in self.verdict.violations) if self.verdict else self.reason
        where = f"seed {self.seed}: {self.kind} ({self.text}), {self.phase}"
        return f"{where}: {said or 'holds'}; python -m bench service --seeds {self.seed}"


def drawn(seed: int) -> tuple[str, str, Drawn, np.random.Generator]:
    """Draw kind, phase and fault; kinds come in turn, so that each has its share."""
    rng = np.random.default_rng([seed, 5])
    names = list(KINDS)
    kind = names[seed % len(names)]
    phase = PHASES[int(rng.integers(len(PHASES)))]
    if kind in _IN_TURN:
        phase = _IN_TURN[kind][seed // len(names) % len(_IN_TURN[kind])]
    return kind, phase, KINDS[kind](rng, phase), rng


def run(seed: int, folder: Path) -> Result:
    """Play one seed below a new folder; what it wrote stays where a bar was missed."""
    began_s = time.monotonic()
    kind, phase, fault, rng = drawn(seed)
    folder.mkdir(parents=True)
    try:
        with Scene(folder, seed, fault, phase, rng) as scene:
            facts = scene.play()
            scene.end()
            record = Record(list(scene.run_folders()))
            for run_folder in scene.run_folders():
                try:
                    read_run(run_folder)
                except StagectlError as error:
                    record.unreadable.append(f"{run_folder.name}: {error}")
    except pytest.skip.Exception as error:
        return Result(seed, kind, phase, fault.text, "", None, time.monotonic() - began_s, str(error))
    verdict = judge(fault, facts, record)
    if not verdict.violations:
        shutil.rmtree(folder, ignore_errors=True)
    return Result(seed, kind, facts.phase, fault.text, facts.fault_kind, verdict, time.monotonic() - began_s)
