"""What kind of law a hypothesis is: of how many numbers, smooth or dry, and whether another is akin to it. Pure."""

from collections.abc import Sequence

from stagectl.effects import CATALOGUE, Trait
from stagectl.gap.normal_equations import Group


def form(group: Group) -> int:
    """Return the numbers that a law is made of, without the place about which it acts.

    A cable pulls towards its anchor wherever that is: with one near zero it is still a cable, and no wider a law than a
    spring about zero. A Stribeck friction without a rise would be none.
    """
    known = CATALOGUE.get(group.key[0])
    return group.complexity - (1 if known is not None and Trait.PLACED in known.traits else 0)


_JOINT_AND_ZEROS = frozenset({"backlash_centre_shift", "thermal_drift"})


def is_joint_against_zeros(one: Group, other: Group) -> bool:
    """Tell whether two laws say where the joint lies between zeros of its sensors: either may have moved.

    None of them is a narrower form of the other. A drift over 130 s of which four recordings saw the end was a shift
    of the joint by 2.3 um, 3 squares behind it, and stood alone as that.
    """
    return {one.key[0], other.key[0]} <= _JOINT_AND_ZEROS


def is_smooth(group: Group) -> bool:
    """Tell whether a law of the library is a force without step and memory, away from the joint.

    Of a user's own nobody knows that its shape is found to the end: one that left 0.9 % drew three more names.
    """
    known = CATALOGUE.get(group.key[0])
    return (
        known is not None
        and not known.origin
        and not known.has_step
        and not known.memory
        and not shows_at_low_speed(group)
        and group.key[1].endswith(("_force", "_actuator"))
    )


def is_friction(group: Group) -> bool:
    """Tell whether a law of the library, none of a user's own, is a friction that turns with the direction."""
    known = CATALOGUE.get(group.key[0])
    return known is not None and not known.origin and (known.has_step or shows_at_low_speed(group))


def is_dry(group: Group) -> bool:
    """Tell whether a law of the library holds a body by what rubs on it: a friction, or a cable that slips."""
    return is_friction(group) or group.key[0] == "cable_hysteresis"


def is_off_joint(group: Group) -> bool:
    """Tell whether a law of the library, none of a user's own, acts away from the joint."""
    known = CATALOGUE.get(group.key[0])
    return known is not None and not known.origin and group.key[1] not in ("contact", "joint")


def act_apart(one: Group, other: Group) -> bool:
    """Tell whether two laws push different bodies, of which no motor pushes the other one back.

    Where the joint touches goes by readings: what a law of the macro is inexact by leaves nothing in the end's motion.
    The micro's motor pushes the macro, too.
    """
    bodies = {_PUSHED.get(group.key[1]) for group in (one, other)}
    return bodies == {"macro", "micro"}


_PUSHED = {"macro_force": "macro", "macro_actuator": "macro", "macro_command": "macro", "micro_force": "micro"}


def shows_at_low_speed(group: Group) -> bool:
    known = CATALOGUE.get(group.key[0])
    return known is not None and known.shown_by == "low speed"


def has_akin(chosen: Sequence[Group], group: Group) -> bool:
    """Tell whether another friction acts where a friction does."""
    return shows_at_low_speed(group) and any(
        shows_at_low_speed(other) and other.key[1] == group.key[1] for other in chosen
    )
