"""What was chosen, in words and numbers: effects by name, known parameters by their errors. Pure."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stagectl.effects import CATALOGUE
from stagectl.gap import hypotheses
from stagectl.gap.aliases import aliases_of
from stagectl.gap.believed import Believed
from stagectl.gap.competition import Competition
from stagectl.gap.findings import Named, ParameterError, title_of
from stagectl.gap.hypotheses import Term
from stagectl.gap.judge import CONTRADICTION
from stagectl.gap.normal_equations import Group, Solution, solve
from stagectl.gap.quantities import along_motion, in_order, quantities
from stagectl.gap.recording import Recording
from stagectl.gap.refinement import power_of_size
from stagectl.gap.scatter import INEXACT_RATIO
from stagectl.gap.settling import settled_by


def all_named(search: Competition, chosen: list[Group]) -> tuple[Named, ...]:
    """Return every chosen effect, known parameters left out."""
    judge, solution = search.judge, solve([*search.judge.base, *chosen], search.evidence.sums)
    whole = judge.gains(chosen)
    found = []
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            continue
        rest = judge.gains([other for other in chosen if other is not group])
        found.append(
            Named(
                name=term.name,
                acts_on=term.acts_on,
                **_sized(search, solution, group),
                gain=whole[0] - rest[0],
                held_out_gain=whole[1] - rest[1],
                aliases=tuple((*key, margin) for key, margin in aliases_of(judge, chosen, group)),
            )
        )
    return tuple(found)


def measured(
    search: Competition, chosen: Sequence[Group], solution: Solution, named: Sequence[Named]
) -> tuple[Named, ...]:
    """Return names of `chosen` with the parameters and deviations of a solution; others as they are."""
    groups = {group.key: group for group in chosen}
    found = []
    for one in named:
        group = groups.get((one.name, one.acts_on))
        if group is None:
            found.append(one)
        else:
            found.append(replace(one, **_sized(search, solution, group)))
    return tuple(found)


def _sized(search: Competition, solution: Solution, group: Group) -> dict[str, Any]:
    """Return what `Named` says of sizes: parameters, deviations of those that were solved for, what goes together.

    What no size is known better than is common, too: the mean over five runs is no better.
    """
    term = search.term(group)
    parameters, slopes = _readable(term, solution, group)
    scale = np.zeros(len(solution.slots))
    if term.linear or not term.is_slope:
        scale = _scale_of_forces(search, solution, term)
    factor = 1.0 + float(scale @ solution.values)
    parameters |= {name: factor * parameters[name] for name in slopes}
    weights = {name: factor * slope + parameters[name] * scale for name, slope in slopes.items()}
    inexact = {name: INEXACT_RATIO * parameters[name] for name in slopes}
    sds = {name: float(np.hypot(solution.sd_of(weights[name]), inexact[name])) for name in slopes}

    def correlation(one: str, other: str) -> float:
        together = solution.covariance_of(weights[one], weights[other]) + inexact[one] * inexact[other]
        return float(together / max(sds[one] * sds[other], 1e-300))

    return {
        "parameters": term.shape | parameters if term.linear else parameters,
        "sds": sds,
        "common_sd_ratio": float(np.hypot(solution.sd_of(scale), INEXACT_RATIO)),
        "correlations": tuple((*two, correlation(*two)) for two in itertools.combinations(slopes, 2)),
    }


_MOTOR_QUANTITIES = {
    "motor_force_n": "own",
    "current_a": "own",
    "micro_motor_force_n": "micro",
}
"""Quantities that are known as well as a force constant is: of the effect's own axis, or of the micro."""


def _right_share(search: Competition) -> float:
    """Return how much of what the contact presses, in squares, its right side does."""
    right = whole = 0.0
    for recording in search.evidence.recordings:
        if recording.side is not None and recording.penetration_m is not None:
            squares = recording.penetration_m**2
            whole += float(squares.sum())
            right += float(squares[recording.side > 0.0].sum())
    return right / whole if whole > 0.0 else 0.5


def _scale_of_forces(search: Competition, solution: Solution, term: Term) -> np.ndarray:
    """Return by what known parameters scale the amplitudes of a term: a share of each slot's value, shape (slots,).

    A motion shows forces over masses: with a mass that is e too large in truth every force is, and the masses are known
    to what is stated of them and of the force constants. Levels came out 0.3 to 1.2 % off, eight deviations. What is
    a share of a known force is as large as that one is: a loop of the contact came out 1.7 % off beside a stiffness
    that is as much too small, and a law that holds the mass itself needs no other. A size that is no factor moves by
    the power of it that the law follows: what saturates with the square of a motor's force, by 1.5 times what the force
    constant is off by.
    """
    vector = np.zeros(len(solution.slots))
    if term.acts_on.endswith(("_sensor", "_command", "contact_edge")):
        return vector
    side = "macro" if term.acts_on.startswith("macro") else "micro"
    quantities = CATALOGUE[term.name].quantities
    weights = {} if "mass_kg" in quantities else {f"{side}_mass_kg": 1.0}
    if "contact_stiffness_n_per_m" in quantities:
        share = _right_share(search)
        weights |= {"left_stiffness_n_per_m": share - 1.0, "right_stiffness_n_per_m": -share}
    for quantity in quantities:
        motor = _MOTOR_QUANTITIES.get(quantity)
        # where a reaction was found, what the micro's force constant is off by pushes the macro back already
        told = motor == "micro" and search.evidence.recordings[0].found_reaction_ratio != 0.0
        if motor is not None and not told:
            power = 1.0 if term.linear else _power_of_motor(search, term, quantity)
            weights[f"{side if motor == 'own' else motor}_force_constant"] = -power
    if weights and not term.linear:
        power = power_of_size(term, search.evidence.recordings)
        weights = {name: weight / power for name, weight in weights.items()}
    columns = {
        known.name: group.columns[0]
        for (known, _), group in zip(search.parameters, search.judge.base, strict=False)
        if known.name in weights
    }
    for name, column in columns.items():
        vector[[slot for slot, (number, _) in enumerate(solution.slots) if number == column]] = weights[name]
    return vector


_SCALED_RATIO = 0.01


def _power_of_motor(search: Competition, term: Term, quantity: str) -> float:
    """Return the power of a motor's force, or current, that a law at its size follows."""
    effect, axis = CATALOGUE[term.name], "macro" if term.acts_on.startswith("macro") else "end"
    squares = []
    for factor in (1.0, 1.0 + _SCALED_RATIO):
        total = 0.0
        for recording in search.evidence.recordings:
            known = quantities(recording, axis, term.acts_on)
            scaled = {**known, quantity: factor * known[quantity]}
            values = [scaled[name] for name in effect.quantities]
            total += float(np.sum(along_motion(effect, values, in_order(effect, term.shape)) ** 2))
        squares.append(total)
    return 0.5 * float(np.log(squares[1] / squares[0]) / np.log1p(_SCALED_RATIO)) if min(squares) > 0.0 else 1.0


def _readable(term: Term, solution: Solution, group: Group) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Turn pairs of a sine and a cosine into amplitude and phase, session by session, and a share into its value.

    Returns (parameters, slopes over all slots of those that were solved for).
    """
    parameters: dict[str, float] = {}
    slopes: dict[str, np.ndarray] = {}
    axes = np.eye(len(solution.slots))
    slots = [[k for k, (number, _) in enumerate(solution.slots) if number == column] for column in group.columns]
    for here in zip(*slots, strict=True):
        place = solution.slots[here[0]][1]
        mark = f" of {place}" if place else ""
        values = [float(solution.values[slot]) for slot in here]
        if not term.linear:
            first, at = next(iter(term.shape.items()))
            parameters[first + mark] = values[0] * at
            slopes[first + mark] = at * axes[here[0]]
        elif all(name.endswith("*") for name in term.amplitudes):
            for pair in range(0, len(values), 2):
                name = term.amplitudes[pair].removesuffix("*")
                angle = float(np.arctan2(values[pair + 1], values[pair]))
                parameters[name + mark] = float(np.hypot(values[pair], values[pair + 1]))
                parameters[f"{hypotheses.phase_of(CATALOGUE[term.name], name)}{mark}"] = angle
                slopes[name + mark] = np.cos(angle) * axes[here[pair]] + np.sin(angle) * axes[here[pair + 1]]
        else:
            for name, value, slot in zip(term.amplitudes, values, here, strict=True):
                parameters[name + mark] = value
                slopes[name + mark] = axes[slot]
    return (parameters if term.linear else parameters | dict(list(term.shape.items())[1:])), slopes


def parameter_errors(search: Competition, chosen: list[Group], solution: Solution) -> tuple[ParameterError, ...]:
    """Return the known parameters that competed with the effects and stayed, each with what would do as well."""
    found = []
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            values, sds = solution.of(group)
            own = search.judge.stated_sds[term.name]
            aliases = tuple(key[0] for key, _ in aliases_of(search.judge, chosen, group) if key[1] == "parameter")
            found.append(ParameterError(term.name, float(values[0]), float(sds[0]), own, aliases))
    return tuple(found)


_ALONG_THE_WAY = "position_dependent_friction"
_DRY_LEVELS = ("level_n", "forward_n", "backward_n")
_DRIVING_SDS = 3.0
_ENDED_RATIO = 0.05  # of a level, what one that has ended may be off by
_DRIVING_SHARE = 0.2
"""Of the way: a friction of 0.9 of its level per 100 mm has ended for the last 15 % of 320 mm."""


def friction_that_drives(named: Sequence[Named], recordings: Sequence[Recording]) -> tuple[Named, ...]:
    """Return frictions that change along the way by more than all dry friction there is, on much of the way.

    A spring that pulls in one direction of motion only is one half of a spring and one half of such a friction: it
    drives on half of the way.
    """
    doubtful = [one for one in named if one.name == _ALONG_THE_WAY]
    return tuple(one for one in doubtful if not _driving_share(one, named, recordings) <= _DRIVING_SHARE)


def _driving_share(one: Named, named: Sequence[Named], recordings: Sequence[Recording]) -> float:
    """Return the share of the way on which a friction that changes along it drives, beside all dry friction there."""
    effect, axis = CATALOGUE[one.name], "macro" if one.acts_on.startswith("macro") else "end"
    beside = [other.parameters for other in named if other is not one and other.acts_on == one.acts_on]
    rows = [row for row in recordings[0].believed.effects if row["acts_on"] == one.acts_on]
    along = [one.parameters, *(row for row in rows if row["name"] == one.name)]
    others = [*beside, *(row for row in rows if row["name"] != one.name)]
    levels = ([float(row[name]) for name in _DRY_LEVELS if name in row] for row in others)
    beside_n = sum(min(level) for level in levels if level)
    driving_m = way_m = 0.0
    for recording in recordings:
        position_m = recording.position_m(axis)
        step_m = np.abs(np.diff(position_m))
        dry_n = beside_n - sum(effect.law(position_m, np.inf, *in_order(effect, law)) for law in along)
        slack_n = (
            _DRIVING_SDS * one.sds["slope_n_per_m"] * np.abs(position_m) + _ENDED_RATIO * one.parameters["level_n"]
        )
        drives = ~(dry_n + slack_n >= 0.0)
        way_m += float(np.sum(step_m))
        driving_m += float(np.sum(step_m[drives[1:]]))
    return driving_m / way_m if way_m > 0.0 else 0.0


def ending(named: Sequence[Named], recordings: Sequence[Recording]) -> tuple[Named, ...]:
    """Return names in which a friction that falls along the way ends where it is nothing, beyond what was recorded.

    Where nobody recorded its end, its straight line would go on: from there on a model, and a feedforward, drives.
    """
    return tuple(_ending(one, recordings) if one.name == _ALONG_THE_WAY else one for one in named)


def _ending(one: Named, recordings: Sequence[Recording]) -> Named:
    low_m, high_m = _recorded_m(one, recordings)
    level_n, slope_n_per_m, ends_m = (one.parameters[name] for name in ("level_n", "slope_n_per_m", "ends_m"))
    nothing_m = -level_n / slope_n_per_m if slope_n_per_m else np.inf
    is_seen = low_m < ends_m < high_m
    is_beyond = nothing_m > max(high_m, 0.0) or nothing_m < min(low_m, 0.0)
    if is_seen or not is_beyond or not abs(nothing_m) < abs(ends_m):
        return one
    return replace(one, parameters={**one.parameters, "ends_m": float(nothing_m)})


def _recorded_m(one: Named, recordings: Sequence[Recording]) -> tuple[float, float]:
    """Return from where to where the body was recorded that an effect acts on."""
    axis = "macro" if one.acts_on.startswith("macro") else "end"
    positions_m = [recording.position_m(axis) for recording in recordings]
    return min(float(x.min()) for x in positions_m), max(float(x.max()) for x in positions_m)


def spoken_against(named: Sequence[Named]) -> tuple[str, ...]:
    """Say of which names recordings that no fit saw are explained worse than without, by more than noise."""
    return tuple(
        f"{title_of(one.name, one.acts_on)}: as large as training says it is it leaves {-one.held_out_gain:.0f} "
        "squares of the noise more on recordings that no fit saw; `gap next` has the move that shows it"
        for one in named
        if one.held_out_gain < -CONTRADICTION
    )


_OF_ONE_PITCH = ("cogging", "harmonic_cogging")


def second_pitches(named: Sequence[Named], recordings: Sequence[Recording]) -> tuple[Named, ...]:
    """Return forces that repeat over a pitch beside a larger one on the same axis: both are one law, of one pitch.

    With two pitches, five amplitudes and phases a force that slows down along the way (periodic in the root of the
    position) is explained to 2 %. Where one of the pitches does not fit twice into the way, nobody has seen either
    repeat: a cable, 200 mm with a harmonic and 64 mm left nothing of a spring with a dead zone, and both are returned.
    """
    found = []
    for place in {one.acts_on for one in named}:
        repeating = [one for one in named if one.acts_on == place and one.name in _OF_ONE_PITCH]
        if len(repeating) > 1:
            axis = "macro" if place.startswith("macro") else "end"
            way_m = max(float(np.ptp(r.position_m(axis))) for r in recordings)
            are_seen = all(2.0 * one.parameters["pitch_m"] <= way_m for one in repeating)
            found += sorted(repeating, key=lambda one: -one.gain)[1 if are_seen else 0 :]
    return tuple(found)


_WIDTH_CHANGE = "backlash_width_change"


def without_widths(
    named: tuple[Named, ...], search: Competition
) -> tuple[tuple[Named, ...], tuple[ParameterError, ...]]:
    """Return effects, and gaps of another width as what they are: a known parameter that is wrong."""
    widths = tuple(_width_error(one, search) for one in named if one.name == _WIDTH_CHANGE)
    return tuple(one for one in named if one.name != _WIDTH_CHANGE), widths


def _width_error(one: Named, search: Competition) -> ParameterError:
    stated = {term.name: sd for term, sd in search.parameters}
    change_m = one.parameters["change_m"]
    aliases = tuple(name for name, place, _ in one.aliases if place == "parameter" and name != "backlash_width_m")
    return ParameterError(
        "backlash_width_m", 0.5 * change_m, 0.5 * one.sds["change_m"], stated.get("left_m", 0.0), aliases
    )


def refitted_errors(
    search: Competition,
    chosen: list[Group],
    solution: Solution,
    believed: Believed,
    widths: tuple[ParameterError, ...],
) -> dict[str, tuple[float, float]]:
    """Return every known parameter's error as fitted and its standard deviation.

    What a parameter is off beyond its stated uncertainty is included, and what `widths` were found to be at their size.
    """
    base = search.judge.base[: len(search.parameters)]
    groups = {term.name: [group] for (term, _), group in zip(search.parameters, base, strict=True)}
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            for name in hypotheses.parts_of(term.name):
                groups[name].append(group)
    found = {name: solution.total_of(summed) for name, summed in groups.items()}
    for name, change in settled_by(believed, search.evidence.recordings[0]).items():
        value, sd = found[name]
        found[name] = value + change, sd
    for wrong in widths:
        for name in hypotheses.parts_of(wrong.name):
            value, sd = found[name]
            found[name] = value + wrong.error, float(np.hypot(sd, wrong.sd))
    return found
