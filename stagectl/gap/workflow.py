"""From recordings to findings: whiten, compete, judge on recordings that no fit saw, and say what can't be said.

Values in, values out; same input, same answer. Pure.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stagectl import effect_text
from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError, StagectlError
from stagectl.gap import balance, hypotheses, plausibility
from stagectl.gap.believed import Believed
from stagectl.gap.competition import Competition
from stagectl.gap.crew import Crew, Serial, one_blas_thread
from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.gap.hypotheses import Term
from stagectl.gap.identifiability import not_separable
from stagectl.gap.log import Log
from stagectl.gap.noise import noise_of
from stagectl.gap.normal_equations import Group, Solution, solve
from stagectl.gap.settling import moved_by, moves_joint, remeasured, settled, stands

_LEFT_SDS = 4.0
_LEFT_SHARE = 0.03
_CURVE_SHARE = 0.03
_SECOND_PASSES = 2
_FORETOLD_PASSES = 3  # a friction is known along a motion that knows of the friction

Say = Callable[[str], None]


def find(
    believed: Believed,
    training: Sequence[Log],
    held: Sequence[Log] = (),
    *,
    nulls_count: int = 200,
    seed: int = 0,
    without: frozenset[str] = frozenset(),
    say: Say = lambda text: None,
    crew: Crew | None = None,
) -> Findings:
    """Find what is missing from a believed machine, `without` some effects of the library.

    crew: who does the work, see `stagectl.gap.crew`; None is this thread. The answer is the same whoever does it.
    Errors: RequestError where a log is on both sides, or recordings can't be of this machine (`plausibility`); what the
    crew raises.
    """
    with one_blas_thread():
        return _found(believed, training, held, nulls_count, seed, without, say, crew or Serial())


Recordings = tuple[Sequence[Log], Sequence[Log]]
"""What one search takes: recordings to learn from, recordings that no fit sees."""


def find_many(
    believed: Believed, sets: Sequence[Recordings], crew: Crew | None = None, *, nulls_count: int = 200, seed: int = 0
) -> list[Findings | StagectlError]:
    """Search many sets of recordings of one machine or of machines of one kind, each on its own, in their order.

    A cluster gets one task a set. What is wrong with a set stands in its place; errors of the crew itself are raised.
    """
    crew = crew or Serial()
    if crew.is_elsewhere:
        return crew.map(_one_of_many, (believed, nulls_count, seed), sets)
    return [_one_of_many(believed, nulls_count, seed, one, crew) for one in sets]


def _one_of_many(
    believed: Believed, nulls_count: int, seed: int, one: Recordings, crew: Crew | None = None
) -> Findings | StagectlError:
    for title, text in believed.effect_texts:  # unknown yet in another process
        effect_text.declare(text, title)
    try:
        return find(believed, *one, nulls_count=nulls_count, seed=seed, crew=crew)
    except StagectlError as error:
        return error


def _found(
    believed: Believed,
    training: Sequence[Log],
    held: Sequence[Log],
    nulls_count: int,
    seed: int,
    without: frozenset[str],
    say: Say,
    crew: Crew,
) -> Findings:
    if {log.name for log in training} & {log.name for log in held}:
        raise RequestError("a recording is both training and holdout; give recordings that no fit sees as --holdout")
    logs = [*training, *held]
    say("reading the motion")
    remarks = plausibility.check_logs(believed, training, held)
    unsettled = crew.here(lambda log: balance.recording_of(log, believed), logs)
    plausibility.check_recordings(believed, unsettled)
    noise = noise_of(unsettled)
    recordings, _ = settled(unsettled, noise, crew=crew)
    first = Competition(
        recordings, len(training), nulls_count=nulls_count, seed=seed, without=without, noise=noise, crew=crew
    )
    judge = first.judge
    say(f"{len(judge.library)} hypotheses of {len({g.key for g in judge.library})} names on {len(logs)} recordings")
    judge.calibrate()
    say("effects compete")
    before = judge.reducible([])

    def again(known: list[Group]) -> Competition:
        """Look along the motion that `known` effects make, at the place where they put the joint."""
        moving = [group for group in known if moves_joint(first, group)]
        still = [group for group in known if group not in moving]
        explained = first.explained(still)
        first.evidence.forget_trials()
        there, moved = settled(unsettled, noise, tuple(moved_by(first, known, group) for group in moving), crew)
        for _ in range(_FORETOLD_PASSES if still else 1):
            there = crew.here(
                lambda r: balance.foretold_under(r, balance.sum_of(balance.known_forces(r), explained(r))), there
            )
        made = Competition(
            there,
            len(training),
            seed=seed,
            without=without,
            moved=moved,
            kept=tuple(first.term(group) for group in still),
            noise=noise_of(there, explained),
            crew=crew,
        )
        made.judge.threshold, made.judge.trace = judge.threshold, judge.trace
        return made

    chosen = found = judge.select(until=lambda group: moves_joint(first, group))
    last, named = first, _all_named(first, chosen)
    for _ in range(_SECOND_PASSES):
        if not found:
            break
        say("once more, along the motion and at the place where the joint is now known to be")
        last = again(found)
        chosen = last.judge.select(last.kept)
        at_size = remeasured(last, chosen, _all_named(first, found), last.moved) if last.moved else ()
        named = at_size + _all_named(last, chosen)
        gone = {(one.name, one.acts_on) for one in at_size if not stands(one, last.evidence.recordings[0])}
        if not gone:
            break
        found = [group for group in found if group.key not in gone]  # at its size it is nothing
        last, chosen, named = first, found, _all_named(first, found)
    before_excess = _excess(first, [])
    if _unknown(last, chosen, before_excess) is not None and _unknown(first, found, before_excess) is None:
        last, chosen, named = first, found, _all_named(first, found)  # the first look had reached the floor
    widths = tuple(_width_error(one, last) for one in named if one.name == _WIDTH)
    named = tuple(one for one in named if one.name != _WIDTH)
    after = last.judge.reducible(chosen)
    unknown = _unknown(last, chosen, before_excess)
    verdict = "unknown" if unknown is not None else "found" if named else "nothing"
    if unknown is not None:
        unknown["beside"] = [[effect.name, effect.acts_on] for effect in named]
        named = ()
    solution = solve([*last.judge.base, *chosen], last.evidence.sums)
    refitted = _refitted(last, chosen, solution, believed)
    for wrong in widths:
        for name in hypotheses.parts_of(wrong.name):
            value, sd = refitted[name]
            refitted[name] = value + wrong.error, float(np.hypot(sd, wrong.sd))
    return Findings(
        profile=believed.name,
        runs=tuple(log.name for log in training),
        holdout=tuple(log.name for log in held),
        verdict=verdict,
        named=named,
        parameter_errors=_parameter_errors(last, chosen, solution) + widths,
        refitted={name: value for name, (value, _) in refitted.items()},
        not_excited=first.not_excited(),
        not_separable=tuple(one.text for one in not_separable(first.evidence.recordings)),
        unknown=unknown,
        reducible_before=before,
        reducible_after=after,
        threshold=judge.threshold,
        remarks=(*remarks, *(remark for log in logs for remark in log.remarks)),
        trace=tuple(judge.trace),
        refitted_sds={name: sd for name, (_, sd) in refitted.items()},
        profile_path=believed.path,
        profile_sha256=believed.sha256,
    )


def _all_named(search: Competition, chosen: list[Group]) -> tuple[Named, ...]:
    """Return every chosen effect, known parameters left out."""
    judge, solution = search.judge, solve([*search.judge.base, *chosen], search.evidence.sums)
    whole = judge.gains(chosen)
    found = []
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            continue
        values, sds = solution.of(group)
        rest = judge.gains([other for other in chosen if other is not group])
        parameters, errors = _readable(term, values, sds, _places(solution, group))
        if term.linear:
            parameters, errors = _in_true_force(search, solution, term, parameters, errors)
        found.append(
            Named(
                name=term.name,
                acts_on=term.acts_on,
                parameters=parameters if not term.linear else term.shape | parameters,
                sds=errors,
                gain=whole[0] - rest[0],
                held_out_gain=whole[1] - rest[1],
                aliases=tuple((*key, margin) for key, margin in judge.aliases(chosen, group)),
            )
        )
    return tuple(found)


_MOTOR_QUANTITIES = {
    "motor_force_n": "own",
    "current_a": "own",
    "micro_motor_force_n": "micro",
}
"""Quantities that are known as well as a force constant is: of the effect's own axis, or of the micro."""


def _in_true_force(
    search: Competition, solution: Solution, term: Term, parameters: dict[str, float], errors: dict[str, float]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return amplitudes and deviations with what the scale of forces is off, and uncertain, by.

    A motion shows forces over masses: with a mass that is e too large in truth every force is, and the masses are known
    to what is stated of them and of the force constants. Levels came out 0.3 to 1.2 % off, eight deviations.
    """
    if term.acts_on.endswith(("_sensor", "_command", "contact_edge")):
        return parameters, errors
    side = "macro" if term.acts_on.startswith("macro") else "micro"
    weights = {f"{side}_mass_kg": 1.0}
    for quantity in CATALOGUE[term.name].quantities:
        motor = _MOTOR_QUANTITIES.get(quantity)
        if motor is not None:
            weights[f"{side if motor == 'own' else motor}_force_constant"] = -1.0
    columns = {
        known.name: group.columns[0]
        for (known, _), group in zip(search.parameters, search.judge.base, strict=False)
        if known.name in weights
    }
    vector = np.zeros(len(solution.slots))
    for name, column in columns.items():
        vector[[slot for slot, (number, _) in enumerate(solution.slots) if number == column]] = weights[name]
    off, uncertain = float(vector @ solution.values), float(np.sqrt(max(vector @ solution.covariance @ vector, 0.0)))
    scaled = {name: value * (1.0 + off) if name in errors else value for name, value in parameters.items()}
    return scaled, {name: float(np.hypot(sd, scaled[name] * uncertain)) for name, sd in errors.items()}


def _places(solution: Solution, group: Group) -> list[str]:
    """Name the sessions or runs that the values of a group belong to, in their order; one empty name where to none."""
    return [scope for column, scope in solution.slots if column == group.columns[0]]


def _readable(
    term: Term, values: np.ndarray, sds: np.ndarray, places: list[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Turn pairs of a sine and a cosine into amplitude and phase, session by session, and a share into its value."""
    parameters: dict[str, float] = {}
    errors: dict[str, float] = {}
    per = len(term.amplitudes)
    if not term.linear:
        (first, at), *rest = term.shape.items()
        for place, value, sd in zip(places, values, sds, strict=True):
            mark = f" of {place}" if place else ""
            parameters[first + mark] = float(value) * at
            errors[first + mark] = float(sd) * abs(at)
        return parameters | dict(rest), errors
    for number, place in enumerate(places):
        mark = f" of {place}" if place else ""
        here, sd = values[number * per : (number + 1) * per], sds[number * per : (number + 1) * per]
        if all(name.endswith("*") for name in term.amplitudes):
            effect = CATALOGUE[term.name]
            for pair in range(0, per, 2):
                name = term.amplitudes[pair].removesuffix("*")
                phase = hypotheses.phase_of(effect, name)
                parameters[name + mark] = float(np.hypot(here[pair], here[pair + 1]))
                parameters[f"{phase}{mark}"] = float(np.arctan2(here[pair + 1], here[pair]))
                errors[name + mark] = float(np.mean(sd[pair : pair + 2]))
        else:
            for name, value, one in zip(term.amplitudes, here, sd, strict=True):
                parameters[name + mark] = float(value)
                errors[name + mark] = float(one)
    return parameters, errors


def _parameter_errors(search: Competition, chosen: list[Group], solution: Solution) -> tuple[ParameterError, ...]:
    """Return the known parameters that competed with the effects and stayed, each with what would do as well."""
    stated = {term.name: sd for term, sd in search.parameters}
    found = []
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            values, sds = solution.of(group)
            own = stated[hypotheses.parts_of(term.name)[0]]
            aliases = tuple(key[0] for key, _ in search.judge.aliases(chosen, group) if key[1] == "parameter")
            found.append(ParameterError(term.name, float(values[0]), float(sds[0]), own, aliases))
    return tuple(found)


_WIDTH = "backlash_width_change"


def _width_error(one: Named, search: Competition) -> ParameterError:
    """Return a gap of another width, found as an effect at its size, as what it is: a known parameter that is wrong."""
    stated = {term.name: sd for term, sd in search.parameters}
    change_m = one.parameters["change_m"]
    aliases = tuple(name for name, place, _ in one.aliases if place == "parameter" and name != "backlash_width_m")
    return ParameterError(
        "backlash_width_m", 0.5 * change_m, 0.5 * one.sds["change_m"], stated.get("left_m", 0.0), aliases
    )


def _refitted(
    search: Competition, chosen: list[Group], solution: Solution, believed: Believed
) -> dict[str, tuple[float, float]]:
    """Return every known parameter's error as fitted and its standard deviation.

    What a parameter is off beyond its stated uncertainty is included.
    """
    base = search.judge.base[: len(search.parameters)]
    groups = {term.name: [group] for (term, _), group in zip(search.parameters, base, strict=True)}
    for group in chosen:
        term = search.term(group)
        if term.acts_on == "parameter":
            for name in hypotheses.parts_of(term.name):
                groups[name].append(group)
    found = {name: solution.total_of(summed) for name, summed in groups.items()}
    settled = search.evidence.recordings[0].believed.joint
    if believed.joint is not None and settled is not None and not search.moved:
        for name in ("left_m", "right_m"):
            value, sd = found[name]
            found[name] = value + getattr(settled, name) - getattr(believed.joint, name), sd
    return found


def _excess(search: Competition, chosen: list[Group]) -> float:
    """Return what is left above the noise, in squares of it."""
    sums = search.evidence.sums
    return sum(float(s.gram[0, 0]) - s.count for s in sums) - search.judge.gain(chosen)


def _noise(search: Competition) -> float:
    """Return the standard error of the floor, in squares of the noise."""
    return float(np.sqrt(2.0 * sum(s.count for s in search.evidence.sums)))


def _unknown(search: Competition, chosen: list[Group], before_excess: float) -> dict[str, Any] | None:
    """Return what no effect explains, with the curve that goes furthest, or None where the floor is reached.

    Names are worth stating only where with them nothing is left: a law of the library that fits an unknown force half
    is a wrong name.
    """
    judge, evidence = search.judge, search.evidence
    left, first = _excess(search, chosen), before_excess
    noise = _noise(search)
    best, gained = None, 0.0
    for curve in search.curves:
        gain = judge.gain([*chosen, curve]) - judge.gain(chosen)
        if gain > gained:
            best, gained = curve, gain
    judge.trace.append(f"left over {left:.0f} of {first:.0f}, noise {noise:.0f}, best curve {gained:.0f}")
    floor = _LEFT_SDS * noise + _LEFT_SHARE * max(first, 0.0)
    material = best is not None and gained > max(3.0 * judge.threshold, _CURVE_SHARE * max(first, 0.0))
    if not left > floor and not material:
        return None
    found: dict[str, Any] = {"left": left, "before": first, "gain": gained}
    if best is not None:
        term = evidence.terms[best.columns[0]]
        values, sds = solve([*judge.base, *chosen, best], evidence.sums).of(best)
        found |= {
            "over": term.name.removeprefix("curve over "),
            "acts_on": term.acts_on,
            "knots": [float(name) for name in term.amplitudes],
            "values_n": values.tolist(),
            "sds_n": sds.tolist(),
        }
    return found
