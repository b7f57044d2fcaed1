"""The gap workflow on EMPS, blind from mass and viscous friction: names, closed-loop force gap, time."""

import time
from collections.abc import Callable, Iterator

from bench import emps
from bench.figure import Bar, Figure, absent, judged
from stagectl.errors import StagectlError
from stagectl.gap import addition, arbiter
from stagectl.gap.believed import Believed
from stagectl.gap.crew import crew_of
from stagectl.gap.findings import Findings, Named
from stagectl.gap.inverse_dynamics import fit_inverse_dynamics
from stagectl.gap.log import Log
from stagectl.gap.workflow import find

RIGHT = Bar("EMPS: Coulomb, offset, asymmetric viscous friction, 2.5 mm force: named", "of 4", 4.0, at_least=True)
WRONG = Bar("EMPS: names of what it lacks", "names", 0.0)
TRAINING = Bar("EMPS: closed-loop force gap, training", "N", 2.0)
HELD = Bar("EMPS: closed-loop force gap, PULSES, which no fit saw", "N", 2.85)
LOW_SPEED = Bar("EMPS: closed-loop force gap, training, a low-speed law among the names", "N", 1.35)
TIME = Bar("EMPS: time", "s", 30.0)
INVERSE = Bar("EMPS: inverse-dynamics fit, largest deviation from published M, Fv, Fc, offset", "%", 0.5)
_ALL = (RIGHT, WRONG, TRAINING, HELD, LOW_SPEED, TIME, INVERSE)

_WORKERS_COUNT = 2
PITCH_M = (2.48e-3, 2.52e-3)
_LOW_SPEED_LAWS = frozenset({"sublinear_viscous_friction", "dahl_friction", "lugre_friction"})

Say = Callable[[str], None]


def figures(say: Say) -> Iterator[Figure]:
    """Measure every row, or say why not."""
    folder = emps.folder()
    if folder is None:
        yield from (absent(bar, "STAGECTL_DATA names no folder with emps/DATA_EMPS.mat") for bar in _ALL)
        return
    say("EMPS, twice: the first search compiles")
    believed, training, held = emps.read(folder)
    find(believed, training, held)
    begin_s = time.monotonic()
    with crew_of(_WORKERS_COUNT) as crew:
        findings = find(believed, training, held, crew=crew)
    took_s = time.monotonic() - begin_s
    said = ", ".join(_text(one) for one in findings.named) or "nothing"
    say(f"  {took_s:.1f} s: {said}")
    yield judged(RIGHT, len(right_names(findings)), reason=f"named: {said}")
    wrong = wrong_names(findings)
    yield judged(WRONG, len(wrong), reason=", ".join(sorted(wrong)))
    say("EMPS: the same from training alone, for the gaps")
    blind = find(believed, training)  # `findings` has its sizes from all recordings, as a user wants them
    logs = training[0], held[0]
    pooled = " and ".join(_newtons(force_gap_n(believed, findings, log)) for log in logs)
    said = f"sizes from training alone; {pooled} on training and PULSES with those from both"
    gaps_n = [force_gap_n(believed, blind, log) for log in logs]
    yield _gap(TRAINING, gaps_n[0], said)
    yield _gap(HELD, gaps_n[1], said)
    if {one.name for one in blind.named} & _LOW_SPEED_LAWS:
        yield _gap(LOW_SPEED, gaps_n[0], said)
    else:
        yield absent(LOW_SPEED, "no low-speed law was named")
    yield judged(TIME, took_s, reason=f"one search, warm, {_WORKERS_COUNT} workers")
    yield inverse_dynamics(training)


def inverse_dynamics(training: list[Log]) -> Figure:
    """Fit the standard model as it was published, and compare."""
    found = fit_inverse_dynamics(training).values
    away = max(abs(found[name] / value - 1.0) for name, value in emps.PUBLISHED.items())
    said = ", ".join(f"{name.split('.')[0].removesuffix('_kg')} {found[name]:.5g}" for name in emps.PUBLISHED)
    return judged(INVERSE, 100.0 * away, reason=said)


def _text(one: Named) -> str:
    aliases = "".join(f" / {name}" for name, _, _ in one.aliases)
    pitch_m = one.parameters.get("pitch_m")
    return one.name + ("" if pitch_m is None else f" of {pitch_m * 1e3:.3f} mm") + aliases


def _newtons(gap: float | str) -> str:
    return gap if isinstance(gap, str) else f"{gap:.2f} N"


def _gap(bar: Bar, value: float | str, said: str) -> Figure:
    """Hold a gap against its bar; a simulation that could not run holds none."""
    if isinstance(value, str):
        return Figure(bar.figure, None, bar.unit, bar.text, False, [], value)
    return judged(bar, value, reason=said)


def right_names(findings: Findings) -> set[str]:
    """Return which of the machine's effects are named, or stand in the alias set of a name."""
    stated: set[str] = set()
    for one in findings.named:
        names = {one.name} | {alias[0] for alias in one.aliases}
        if "asymmetric_coulomb_friction" in names:  # a level for each direction is one level and an offset
            names |= {"coulomb_friction", "offset"}
        if names & {"cogging", "harmonic_cogging"}:
            names.discard("cogging")
            if PITCH_M[0] <= one.parameters.get("pitch_m", 0.0) <= PITCH_M[1]:
                names.add("cogging")
        stated |= names
    return stated & set(emps.RIGHT)


def wrong_names(findings: Findings) -> set[str]:
    """Return names of what the machine lacks; tilt may stand in the alias set of an offset."""
    return {one.name for one in findings.named} & set(emps.WRONG)


def force_gap_n(believed: Believed, findings: Findings, log: Log) -> float | str:
    """Simulate the closed loop with all that was found; why not, where it can't be."""
    problem = arbiter.cannot_close(believed, log)
    if problem:
        return problem
    effects = addition.effects_with(believed, findings, findings.named, log.session)
    try:
        simulated = arbiter.simulate(believed, effects, log, findings.refitted)
    except StagectlError as error:
        return str(error)
    return arbiter.gap_of(log, simulated).command_n
