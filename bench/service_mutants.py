"""Mutation tests of the code that has the last word: guard and lease, run uncompiled against their tests."""

import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

from bench.figure import Bar, Figure, judged
from bench.mutation import mutants, trial

_ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")
MODULES = {
    "stagectl.guard": ["tests/test_guard.py"],
    "stagectl.service.lease": ["tests/service/test_lease_edges.py", "tests/service/test_lease.py"],
}
_TIMEOUT_S = 60.0
_EVERY = 4  # mutants: one is tried where not all are

KILLED = Bar("mutants of guard and lease killed, of those that are not equivalent", "%", 95.0, True)
LISTED = Bar("mutants called equivalent, each with its reason in bench/equivalent_mutants.toml", "mutants")

Say = Callable[[str], None]


def equivalent() -> dict[str, dict[str, str]]:
    """Return the reasons of the mutants that no test can tell from the code, by module and key."""
    return tomllib.loads(EQUIVALENT.read_text())


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Try mutants that are not called equivalent: every one where `full`, else every fourth."""
    tried = listed = 0
    alive: list[str] = []
    for module, tests in MODULES.items():
        source = (_ROOT / (module.replace(".", "/") + ".py")).read_text()
        reasons = equivalent().get(module, {})
        made = mutants(source)
        unknown = sorted(set(reasons) - {mutant.key for mutant in made})
        if unknown:
            raise RuntimeError(f"{EQUIVALENT}: {module} has no mutant {unknown[0]!r}; correct the list")
        listed += len(reasons)
        judged_ones = [mutant for mutant in made if mutant.key not in reasons][:: 1 if full else _EVERY]
        found = trial(module, judged_ones, tests, _TIMEOUT_S, say)
        alive += [f"{module}:{judged_ones[k].line} {judged_ones[k].key}" for k in found.alive]
        tried += len(judged_ones)
        say(f"{module}: {len(judged_ones)} mutants tried by {found.tests_count} tests, {len(found.alive)} alive")
    said = f"{tried} tried{'' if full else ', every fourth'}; alive: {'; '.join(alive[:5]) or 'none'}"
    yield judged(KILLED, 100.0 * (1.0 - len(alive) / max(tried, 1)), reason=said)
    yield judged(LISTED, listed)
