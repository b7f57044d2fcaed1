"""Recordings with the joint, the readings and the motors' currents put where effects have them. Pure."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stagectl.effects import Effect
from stagectl.gap.balance import recording_of
from stagectl.gap.believed import Believed
from stagectl.gap.contact import CONTACT_DAMPING
from stagectl.gap.effect_forces import edges_out_m
from stagectl.gap.late_readings import makes_late
from stagectl.gap.quantities import in_order
from stagectl.gap.reading_errors import reading_error_m
from stagectl.gap.recording import Recording

Moved = tuple[Effect, str, dict[str, float]]
"""An effect that moves the joint's geometry, the readings or what the drives make of commands, or that decides where a
contact lets go: place, parameters."""


_CORRECTIONS = 2


def operating_point(recording: Recording, moved: Sequence[Moved]) -> Recording:
    """Return a recording with sensor errors taken out of its positions, edges where effects have put them, drives that
    make of their commands what effects of the command path do, contacts that let go where the damping that was found
    has them, and bodies that feel as late as they are read.

    What a sensor adds is taken along the readings at first, then along the motion that is left without it.
    """
    raw, believed = recording.log, recording.believed
    rows = [{"name": effect.name, "acts_on": place, **values} for effect, place, values in moved]
    at_size = tuple(row for row in rows if row["acts_on"].endswith("_command") or row["acts_on"] == "contact")
    late = tuple(row for row, (effect, *_) in zip(rows, moved, strict=True) if makes_late(effect))
    misreading = [one for one in moved if one[1].endswith("_sensor") and not makes_late(one[0])]
    there = recording
    left_m = right_m = 0.0
    for effect, place, values in moved:
        if place == "contact_edge" and believed.joint is not None:
            more_m = edges_out_m(recording, effect, in_order(effect, values))
            left_m, right_m = left_m + more_m[0], right_m + more_m[1]
    for number in range(_CORRECTIONS if misreading else 1):
        log = raw
        for effect, place, values in misreading:
            parameters = in_order(effect, values)
            if place == "macro_sensor":
                true_m = _true_m(there, log.macro_position_m, effect, place, parameters, number == 0)
                log = replace(log, macro_position_m=true_m)
            elif log.end_position_m is not None:
                true_m = _true_m(there, log.end_position_m, effect, place, parameters, number == 0)
                log = replace(log, end_position_m=true_m)
        there = recording_of(log, believed, at_size, late, (left_m, right_m))
    return there


def _true_m(
    recording: Recording, read_m: np.ndarray, effect: Effect, place: str, parameters: list[float], first: bool
) -> np.ndarray:
    """Return readings without what a sensor effect adds."""
    return read_m - reading_error_m(recording, effect, place, parameters, first)[:, 0]


def with_joint_changed(recording: Recording, left_out_m: float, right_out_m: float, damping_ratio: float) -> Recording:
    """Return a recording whose joint has its edges further out, and a contact damping that is larger by a ratio."""
    believed = _edges_out(recording.believed, left_out_m, right_out_m)
    effects = tuple(
        {**row, "damping_n_s_per_m": row["damping_n_s_per_m"] * (1.0 + damping_ratio)}
        if row["name"] == CONTACT_DAMPING
        else row
        for row in believed.effects
    )
    return recording_of(recording.log, replace(believed, effects=effects))


def _edges_out(believed: Believed, left_m: float, right_m: float) -> Believed:
    joint = believed.joint
    if joint is None:
        return believed
    return replace(believed, joint=replace(joint, left_m=joint.left_m + left_m, right_m=joint.right_m + right_m))
