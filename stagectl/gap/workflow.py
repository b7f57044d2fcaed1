"""From recordings to findings: whiten, compete, judge on recordings that no fit saw, and say what can't be said.

Values in, values out; same input, same answer. Pure.
"""

from collections.abc import Callable, Sequence

from stagectl import effect_text
from stagectl.errors import RequestError, StagectlError
from stagectl.gap import balance, plausibility
from stagectl.gap.believed import Believed
from stagectl.gap.competition import Competition
from stagectl.gap.crew import Crew, Serial, one_blas_thread
from stagectl.gap.findings import Findings
from stagectl.gap.identifiability import not_separable
from stagectl.gap.left_over import excess, unknown_rest
from stagectl.gap.log import Log
from stagectl.gap.looks import looked_closely
from stagectl.gap.naming import (
    ending,
    friction_that_drives,
    parameter_errors,
    refitted_errors,
    second_pitches,
    spoken_against,
    without_widths,
)
from stagectl.gap.noise import noise_of
from stagectl.gap.normal_equations import solve
from stagectl.gap.settling import settled

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
    remarks += plausibility.check_recordings(believed, unsettled)
    noise = noise_of(unsettled)
    recordings, *_ = settled(unsettled, noise, crew=crew)
    first = Competition(
        recordings, len(training), nulls_count=nulls_count, seed=seed, without=without, noise=noise, crew=crew
    )
    judge = first.judge
    say(f"{len(judge.library)} hypotheses of {len({g.key for g in judge.library})} names on {len(logs)} recordings")
    judge.calibrate()
    say("effects compete")
    look = looked_closely(first, unsettled, without, say, crew)
    solution = look.solution or solve([*look.search.judge.base, *look.chosen], look.search.evidence.sums)
    named, widths = without_widths(look.named, look.search)
    seen = look.search.evidence.recordings
    doubtful = (*friction_that_drives(named, seen), *second_pitches(named, seen))
    gone = {(one.name, one.acts_on) for one in doubtful}
    possible = [group for group in look.chosen if group.key not in gone]
    belief = look.belief or judge
    unknown = unknown_rest(look.search, possible, excess(belief, []))
    if unknown is not None:
        unknown["beside"] = [[effect.name, effect.acts_on] for effect in named]
        named = ()
    refitted = refitted_errors(look.search, look.chosen, solution, believed, widths)
    return Findings(
        profile=believed.name,
        runs=tuple(log.name for log in training),
        holdout=tuple(log.name for log in held),
        verdict="unknown" if unknown is not None else "found" if named else "nothing",
        named=ending(named, seen),
        parameter_errors=parameter_errors(look.search, look.chosen, solution) + widths,
        refitted={name: value for name, (value, _) in refitted.items()},
        not_excited=first.not_excited(),
        not_separable=tuple(one.text for one in not_separable(first.evidence.recordings)),
        unknown=unknown,
        reducible_before=belief.reducible_before(),
        reducible_after=look.search.judge.reducible(look.chosen),
        threshold=judge.threshold,
        remarks=(*remarks, *spoken_against(named), *(remark for log in logs for remark in log.remarks)),
        trace=tuple(judge.trace),
        refitted_sds={name: sd for name, (_, sd) in refitted.items()},
        profile_path=believed.path,
        profile_sha256=believed.sha256,
        reducible_sds=look.search.judge.floor_sds(),
    )
