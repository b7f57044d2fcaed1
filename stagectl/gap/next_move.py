"""Which move to record next: the one on which what was found, and what explains it as well, differ most. Pure.

Every effect has moves that suit it, by what it is; among those the one is taken that the model says most of. Where
none of them decides, the whole library is asked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.gap import hypotheses, prediction
from stagectl.gap.balance import channels, recording_of, set_noise
from stagectl.gap.believed import Believed
from stagectl.gap.findings import Findings, Named
from stagectl.gap.grids import grids_for
from stagectl.gap.moves import Move
from stagectl.gap.noise import slow_noise
from stagectl.gap.planned import planned_log
from stagectl.gap.predicted_columns import column
from stagectl.gap.prediction import DETECTED, Evidence, Expected

MOVES: dict[str, tuple[str, ...]] = {
    "low speed": ("slow reversals", "creep"),
    "strokes": ("slow stroke", "middle stroke", "fast stroke"),
    "acceleration": ("fast stroke", "sine 0.3 Hz", "sine 1 Hz", "sine 3 Hz"),
    "holds": ("holds at several places", "slow stroke", "middle stroke"),
    "contact": ("sweep over both edges",),
    "time": ("one minute of strokes",),
    "": (),
}
"""By the kind of motion that an effect is shown by, the moves of that kind; "": the whole library is asked."""

_NEVER_APART = DETECTED  # d' below which a name is out of reach of every move of the library


@dataclass(frozen=True, slots=True)
class Proposal:
    """One move with what is expected of it, for the effect that it was chosen for."""

    move: Move
    name: str
    acts_on: str
    d_prime: float  # to the closest effect that explains the findings as well, or to none at all
    against: tuple[tuple[str, str], ...]  # what it is to be told from; empty: from nothing
    expected: tuple[Expected, ...]  # one for every named effect
    never_apart: tuple[tuple[str, str], ...]  # aliases that no move of the library parts from it

    @property
    def decides(self) -> bool:
        """Whether the run can settle anything."""
        mine = [one for one in self.expected if (one.name, one.acts_on) == (self.name, self.acts_on)]
        return bool(mine) and mine[0].decides and self.d_prime >= DETECTED


def proposals(seen: Evidence, moves: Sequence[Move]) -> list[Proposal]:
    """Return the best move for each finding that is open, in the order of the findings.

    Open is what is not confirmed yet, and an effect with aliases: moves tell effects apart, parameters don't compete.
    """
    by_move = [(move, prediction.expected(seen, planned_log(move.trajectory, seen.believed))) for move in moves]
    found = []
    for target in seen.targets:
        if target.confirmed and not (isinstance(target, Named) and target.aliases):
            continue
        rows = [
            (move, one, tuple(everything))
            for move, everything in by_move
            for one in everything
            if (one.name, one.acts_on) == (target.name, target.acts_on)
        ]
        if not rows:
            continue
        keys = {(name, place) for _, one, _ in rows for name, place, _ in one.separations}
        apart = {key for key in keys if max(_distance(one, (key,)) for _, one, _ in rows) >= _NEVER_APART}
        shown_by = CATALOGUE[target.name].shown_by if isinstance(target, Named) else ""
        suited = [row for row in rows if row[0].name in MOVES[shown_by]]
        deciding = [row for row in suited if _distance(row[1], tuple(apart)) >= DETECTED and row[1].decides]
        move, one, everything = max(deciding or rows, key=lambda row: _distance(row[1], tuple(apart)))
        found.append(
            Proposal(
                move, target.name, target.acts_on, _distance(one, tuple(apart)), tuple(sorted(apart)), everything,
                tuple(sorted(keys - apart)),
            )
        )  # fmt: skip
    return found


def _distance(one: Expected, against: tuple[tuple[str, str], ...]) -> float:
    """Return d' to the closest of some names, to nothing where none is given."""
    return min((d for name, place, d in one.separations if (name, place) in against), default=one.d_prime)


def excitations(believed: Believed, findings: Findings, moves: Sequence[Move]) -> list[tuple[str, str]]:
    """Return (effect, move) for everything that the recordings did not excite: the move it shows most on."""
    wanted = set(findings.not_excited)
    if not wanted:
        return []
    best: dict[str, tuple[float, str]] = {}
    for move in moves:
        recording = recording_of(planned_log(move.trajectory, believed), believed)
        set_noise(recording, slow_noise(believed, recording))
        if not sum(size for _, size in channels(recording)):
            continue
        for term in hypotheses.effect_terms([recording], grids_for([recording])):
            name = f"{term.name} on {term.acts_on}"
            if name not in wanted:
                continue
            energy = max(float(np.sum(column(recording, forces) ** 2)) for forces in term.forces(recording))
            if energy > best.get(name, (0.0, ""))[0]:
                best[name] = (energy, move.name)
    return [(name, best[name][1]) for name in sorted(best)]
