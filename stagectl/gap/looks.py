"""Two looks at the same recordings: along the motion as believed, and along the motion under what the first look found.

An effect is known along a motion that knows of the effect, and an edge where the joint is. Everything competes again in
the second look. Pure.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from stagectl.gap.competition import Competition
from stagectl.gap.crew import Crew
from stagectl.gap.findings import Named
from stagectl.gap.innovations import Noise
from stagectl.gap.known_motion import moved_under
from stagectl.gap.left_over import excess, unknown_rest
from stagectl.gap.naming import all_named
from stagectl.gap.noise import noise_of
from stagectl.gap.normal_equations import Group
from stagectl.gap.recording import Recording
from stagectl.gap.settling import moves_joint, remeasured, stands

_CLOSER_LOOKS = 2


class Look(NamedTuple):
    """Who competed, who stayed, and what that is in words."""

    search: Competition
    chosen: list[Group]
    named: tuple[Named, ...]


def looked_closely(
    first: Competition,
    unsettled: Sequence[Recording],
    noise: dict[str, Noise],
    without: frozenset[str],
    say: Callable[[str], None],
    crew: Crew,
) -> Look:
    """Return the closer look at what stays in the first competition; the first look where nothing does.

    unsettled: the recordings before the joint's edges were put where they are.
    """
    found = first.judge.select(until=lambda group: moves_joint(first, group))
    look = rough = Look(first, found, all_named(first, found))
    for _ in range(_CLOSER_LOOKS):
        if not look.chosen:
            break
        say("once more, along the motion and at the place where the joint is now known to be")
        rough = look
        search = _under(rough.chosen, first, unsettled, noise, without, crew)
        chosen = search.judge.select(search.judge.reshaped(search.kept))
        at_size = remeasured(search, chosen, rough.named, search.moved) if search.moved else ()
        look = Look(search, chosen, at_size + all_named(search, chosen))
        gone = {(one.name, one.acts_on) for one in at_size if not stands(one, search.evidence.recordings[0])}
        if not gone:
            break
        found = [group for group in rough.chosen if group.key not in gone]  # at its size it is nothing
        look = rough = Look(first, found, all_named(first, found))
    before = excess(first, [])
    if unknown_rest(look.search, look.chosen, before) and not unknown_rest(first, rough.chosen, before):
        return rough  # the first look had reached the floor
    return look


def _under(
    known: list[Group],
    first: Competition,
    unsettled: Sequence[Recording],
    noise: dict[str, Noise],
    without: frozenset[str],
    crew: Crew,
) -> Competition:
    """Make the competition along the motion that `known` effects make, at the place where they put the joint."""
    motion = moved_under(known, first, unsettled, noise, crew)
    search = Competition(
        motion.recordings,
        first.judge.training_count,
        without=without,
        moved=motion.moved,
        kept=motion.kept,
        noise=noise_of(motion.recordings, motion.explained),
        crew=crew,
    )
    search.judge.threshold, search.judge.trace = first.judge.threshold, first.judge.trace
    return search
