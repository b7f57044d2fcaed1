"""What would do as well as a name: laws that recordings can't tell from it. Pure."""

from collections.abc import Sequence

import numpy as np

from stagectl.gap.judge import ALIAS_GAIN, ALIAS_SHARE, Judge
from stagectl.gap.kinds import form, is_joint_against_zeros, shows_at_low_speed
from stagectl.gap.normal_equations import Group

BETWEEN_SDS = 3.0
"""From so many deviations of the noise on, what two names say differently is said by neither."""

LOW_SPEED_SHARE = 0.03
"""Of a machine with more force noise than its sensors explain, no friction is an exact law: where a real axis passes
through low speeds on its way only, dry friction, bristles and sub-linear friction differ by 1.6 to 2.4 % of their gain,
and a Stribeck friction by 9 %. Slow reversals tell them apart."""


def aliases_of(judge: Judge, chosen: Sequence[Group], group: Group) -> list[tuple[tuple[str, str], float]]:
    """Return the keys that would do as well as `group` beside the others, with the margin that they lose by.

    What acts about a place does so from along the travel: anchored ten metres away, a cable is an offset, whose set
    it was named in. The same law elsewhere does so at the same shape: a drift of the end's sensor over 52 s and one
    of the macro's over 36 s were 10 squares apart, over 52 s both are one. And what is chosen beside them may act about
    another place: beside a cable a tilt of both bodies was an offset of the micro, and 1.1 N of the cable's.

    What gains more and yet does not stay gains what laws beside it are inexact by: iron of the micro's motor 109
    squares more than the friction that was there, beside 570 million of the macro's (1010103).
    """
    rest = [other for other in chosen if other is not group]
    with_it = judge.gain(chosen)
    gained = with_it - judge.gain(rest)
    left, surprise = judge.left_at_most(chosen), judge.surprise(rest, group)
    margins: dict[tuple[str, str], float] = {}
    taken = {other.key for other in chosen}
    anchors = [moved for moved in judge.anchors_moved(chosen, group) if moved.key not in taken]
    for rival in judge.rivals(rest):
        is_wider = form(rival) > form(group) and not is_joint_against_zeros(rival, group)
        if rival.key in taken or is_wider:
            continue
        beside = [*rest, *(moved for moved in anchors if moved.key != rival.key)]
        forms = [one for one in judge.brought_near(rival, group) if judge.allows([*beside, one])]
        if not forms:
            continue
        distances = [judge.distance([*rest, group], [*beside, one]) for one in forms]
        apart = min(distances)
        other = forms[distances.index(apart)]
        margin = with_it - judge.gain([*beside, other])
        if margin < -ALIAS_GAIN and not judge.stays(beside, other):
            continue
        share = margin / max(gained, 1e-300)
        inexact = margin < left and share < ALIAS_SHARE and _lies_between(margin, apart)
        if judge.surprise(beside, other) - surprise > ALIAS_GAIN:
            continue
        if apart < ALIAS_GAIN or inexact or _is_rough_friction(judge, group, other, share):
            margins[other.key] = margin
    return sorted(margins.items(), key=lambda row: row[1])


def _is_rough_friction(judge: Judge, group: Group, other: Group, share: float) -> bool:
    """Tell whether two frictions of a rough machine differ by no more of a gain than such laws are inexact by."""
    frictions = shows_at_low_speed(group) and shows_at_low_speed(other)
    return judge.is_rough and frictions and share < LOW_SPEED_SHARE


def _lies_between(margin: float, apart: float) -> bool:
    """Tell whether recordings lie between two names, `apart` squares from each other, by more than noise does.

    An exact law beats the other one by their distance, give or take twice its root. What gains less than that is no
    exact law, and its margin no proof.
    """
    return margin < apart - BETWEEN_SDS * 2.0 * float(np.sqrt(max(apart, 0.0)))
