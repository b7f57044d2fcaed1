"""Mutation tests of the code that has the last word: guard and lease, run uncompiled against their tests."""

import ast
import importlib
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from bench.figure import Bar, Figure, judged
from bench.mutation import mutants, survives

_ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")
MODULES = {
    "stagectl.guard": ["tests/test_guard.py"],
    "stagectl.service.lease": ["tests/service/test_lease_edges.py", "tests/service/test_lease.py"],
}
_SAMPLE = 60
_TIMEOUT_S = 120.0

KILLED = Bar("mutants of guard and lease killed, of those that are not equivalent", "%", 95.0, True)
LISTED = Bar("mutants called equivalent, each with its reason in bench/equivalent_mutants.toml", "mutants")

Say = Callable[[str], None]


def equivalent() -> dict[str, dict[str, str]]:
    """Return the reasons of the mutants that no test can tell from the code, by module and key."""
    return tomllib.loads(EQUIVALENT.read_text())


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Run all mutants, or a sample of them, the same each time."""
    tried = killed = listed = 0
    alive: list[str] = []
    for module, tests in MODULES.items():
        for path in tests:  # once, for all processes to come
            importlib.import_module(path.removesuffix(".py").replace("/", "."))
        source = (_ROOT / (module.replace(".", "/") + ".py")).read_text()
        if not survives(module, partial(ast.parse, source), tests, _TIMEOUT_S):
            raise RuntimeError(f"{module} does not pass {tests} uncompiled; mend that first")
        reasons = equivalent().get(module, {})
        made = mutants(source)
        unknown = sorted(set(reasons) - {mutant.key for mutant in made})
        if unknown:
            raise RuntimeError(f"{EQUIVALENT}: {module} has no mutant {unknown[0]!r}; correct the list")
        listed += len(reasons)
        judged_ones = [mutant for mutant in made if mutant.key not in reasons]
        if not full:
            chosen = np.random.default_rng(1).permutation(len(judged_ones))[: _SAMPLE // len(MODULES)]
            judged_ones = [judged_ones[k] for k in sorted(chosen)]
        for mutant in judged_ones:
            tried += 1
            if survives(module, mutant.apply, tests, _TIMEOUT_S):
                alive.append(f"{module}:{mutant.line} {mutant.key}")
                say(f"survived: {alive[-1]}")
            else:
                killed += 1
        say(f"{module}: {len(judged_ones)} mutants tried")
    said = f"{tried} tried{'' if full else ', a sample'}; alive: {'; '.join(alive[:5]) or 'none'}"
    yield judged(KILLED, 100.0 * killed / max(tried, 1), reason=said)
    yield judged(LISTED, listed)
