"""Mutation tests of the code that has the last word, from guard to lease, run uncompiled against their tests."""

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.figure import Bar, Figure, judged
from bench.mutation import Mutant, mutants, trial

_ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")


@dataclass(frozen=True)
class Scope:
    """What of a module is mutated, and the tests that are to notice."""

    tests: list[str]
    functions: dict[str, str] | None = None
    """Each with a word that the changed code has in it, "" for all of the function; None: the whole module."""

    def mutants(self, module: str) -> list[Mutant]:
        """Return the mutants; RuntimeError where a function has none, as one that has another name now."""
        made = mutants((_ROOT / (module.replace(".", "/") + ".py")).read_text())
        if self.functions is None:
            return made
        words = self.functions
        found = [one for one in made if one.function in words and words[one.function] in one.change]
        lost = sorted(words.keys() - {one.function for one in found})
        if lost:
            raise RuntimeError(f"{module} has no mutants of {lost[0]}; correct bench/service_mutants.py")
        return found


_LEASE = "lease"
MODULES = {
    "stagectl.guard": Scope(["tests/test_guard.py"]),
    "stagectl.service.lease": Scope(["tests/service/test_lease_edges.py", "tests/service/test_lease.py"]),
    "stagectl.service.desk": Scope(
        ["tests/service/test_desk_lease.py"],
        {
            **dict.fromkeys(
                (
                    "Desk.publish",
                    "Desk.check_order",
                    "Desk.lease_left_s",
                    "Desk.lease_state",
                    "Desk.is_lease_token",
                    "Desk.take_lease",
                    "Desk._taken_before",
                    "Desk.renew_lease",
                    "Desk.give_lease_back",
                    "Desk._busy",
                    "Desk._taken",
                ),
                "",
            ),
            **dict.fromkeys(
                (
                    "Desk.take_setpoints",
                    "Desk._where_it_holds",
                    "Desk.submit",
                    "Desk.submit_own",
                    "Desk.begin_jog",
                    "Desk.jog_at",
                ),
                _LEASE,
            ),
        },
    ),
    "stagectl.session": Scope(
        ["tests/test_lease_deadline.py"],
        dict.fromkeys(("Session.__init__", "Session.pump", "Session.enable", "Session.disarm"), _LEASE),
    ),
    "stagectl.homing": Scope(["tests/test_lease_deadline.py"], {"Homing._search": _LEASE}),
    "stagectl.servo": Scope(
        ["tests/test_lease_deadline.py"],
        {
            **dict.fromkeys(("Servo.cycle", "Servo._refusal", "Servo._advance_phase", "Servo._homing"), _LEASE),
            "Servo._need_no_lease": "",
        },
    ),
}
"""The lease is taken at the desk, renewed by the session, and ends in the servo."""
_TIMEOUT_S = 60.0
_EVERY = 6  # mutants: one is tried where not all are

KILLED = Bar("mutants of the code that has the last word killed, of those not equivalent", "%", 95.0, True)
LISTED = Bar("mutants called equivalent, each with its reason in bench/equivalent_mutants.toml", "mutants")

Say = Callable[[str], None]


def equivalent() -> dict[str, dict[str, str]]:
    """Return the reasons of the mutants that no test can tell from the code, by module and key."""
    return tomllib.loads(EQUIVALENT.read_text())


def figures(*, full: bool, say: Say) -> Iterator[Figure]:
    """Try mutants that are not called equivalent: every one where `full`, else every sixth."""
    tried = listed = 0
    alive: list[str] = []
    for module, tested in MODULES.items():
        reasons = equivalent().get(module, {})
        made = tested.mutants(module)
        unknown = sorted(set(reasons) - {mutant.key for mutant in made})
        if unknown:
            raise RuntimeError(f"{EQUIVALENT}: {module} has no mutant {unknown[0]!r}; correct the list")
        listed += len(reasons)
        judged_ones = [mutant for mutant in made if mutant.key not in reasons][:: 1 if full else _EVERY]
        found = trial(module, judged_ones, tested.tests, _TIMEOUT_S, say)
        alive += [f"{module}:{judged_ones[k].line} {judged_ones[k].key}" for k in found.alive]
        tried += len(judged_ones)
        say(f"{module}: {len(judged_ones)} mutants tried by {found.tests_count} tests, {len(found.alive)} alive")
    said = f"{tried} tried{'' if full else ', every sixth'}; alive: {'; '.join(alive[:5]) or 'none'}"
    yield judged(KILLED, 100.0 * (1.0 - len(alive) / tried) if tried else float("nan"), reason=said)
    yield judged(LISTED, listed)
