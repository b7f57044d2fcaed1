"""Recordings under effects that are known: readings without their errors, the joint where they put it, the motion that
then follows from the past. Pure.
"""

from collections.abc import Sequence
from typing import NamedTuple

from stagectl.effects import CATALOGUE, Trait
from stagectl.gap import balance
from stagectl.gap.competition import Competition
from stagectl.gap.crew import Crew
from stagectl.gap.effect_forces import known_forces
from stagectl.gap.forces import sum_of_forces
from stagectl.gap.hypotheses import Term
from stagectl.gap.noise import Explained
from stagectl.gap.normal_equations import Group, solve
from stagectl.gap.operating_point import Moved
from stagectl.gap.recording import REACTION, Recording
from stagectl.gap.settling import is_taken_at_size, moved_by, settled

_FORETOLD_PASSES = 3  # a friction is known along a motion that knows of the friction


class KnownMotion(NamedTuple):
    """Recordings under known effects: those that move readings or edges, the others, and what these add."""

    recordings: Sequence[Recording]
    moved: tuple[Moved, ...]
    kept: Sequence[Term]
    explained: Explained


def moved_under(
    known: list[Group],
    moved: tuple[Moved, ...],
    search: Competition,
    unsettled: Sequence[Recording],
    crew: Crew,
) -> KnownMotion:
    """Return the recordings along the motion that `known` effects make, at the place where they put the joint.

    known, moved: what was found in a search, and what was part of its operating point already; unsettled: the
    recordings before the joint's edges were put where they are.
    """
    moving = [group for group in known if is_taken_at_size(search, group)]
    still = [group for group in known if group not in moving]
    parameters = search.known_parameters
    explained = search.explained(known, [*parameters, *still])
    driving = search.explained(known, [group for group in (*parameters, *still) if _drives(search.term(group))])
    reaction_ratio = _reaction_ratio(search, known)
    search.evidence.forget_trials()
    there, moved, kept = settled(
        unsettled,
        search.noise,
        (*moved, *(moved_by(search, known, group) for group in moving)),
        tuple(search.term(group) for group in still),
        crew,
    )
    for _ in range(_FORETOLD_PASSES if still else 1):
        there = crew.here(
            lambda r: balance.foretold_under(
                r, sum_of_forces(known_forces(r), explained(r)), driving(r), reaction_ratio
            ),
            there,
        )
    return KnownMotion(there, moved, kept, explained)


def _reaction_ratio(search: Competition, known: list[Group]) -> float:
    """Return the share of the micro's motor force that was found to push the macro back.

    Iron that saturates at 370 N takes 2 % of the force that it pushes the macro back by, too: without that 12 800
    squares of 390 000 were left, for which a flexible mode and a ripple were named.
    """
    solution = solve([*search.judge.base, *known], search.evidence.sums)
    return sum(float(solution.of(group)[0][0]) for group in known if group.key[0] == REACTION)


def _drives(term: Term) -> bool:
    """Tell whether what a term adds drives a share of the mass that swings; such a share does not."""
    return term.name not in CATALOGUE or Trait.SWINGS not in CATALOGUE[term.name].traits
