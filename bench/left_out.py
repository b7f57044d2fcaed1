"""The library without one of its effects: every effect in its turn, on the set that hides it alone and shows it best.

Right is "unknown", or what nobody can tell from the hidden law: an alias of it, a law that holds it as a special case,
or laws that are together what it is, by the generator's own measure.
"""

import itertools
import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from bench import suite_figures
from bench.blind_names import our_keys
from bench.blind_sets import DURATION_S, Job, Marked, line, marked, searched, sets_folder
from bench.figure import Bar, Figure, absent
from tests.blind import detection, generate, together

BAR = Bar("effect taken out of the library: unknown, or its stated alias", "%", 100.0, at_least=True)

SHOWN = Bar("the same, where what any other law leaves stands out of the floor", "%")
_SHOWN_SDS = 5.3  # a rest is one from 4 standard errors of the floor on: 1.3 more are a power of 0.9

CONTAINED_IN: dict[str, tuple[frozenset[str], ...]] = {
    "viscous_friction": (frozenset({"asymmetric_viscous_friction"}),),
    "coulomb_friction": (frozenset({"asymmetric_coulomb_friction"}),),
    "asymmetric_coulomb_friction": (frozenset({"coulomb_friction", "offset"}),),
    "dahl_friction": (frozenset({"lugre_friction"}),),
    "stribeck_friction": (frozenset({"lugre_friction"}),),
    "linear_stiffness": (frozenset({"cable_spring"}), frozenset({"cable_spring", "offset"})),
    "cable_spring": (frozenset({"linear_stiffness"}), frozenset({"linear_stiffness", "offset"})),
}
"""Laws, and pairs of laws, that hold another as a special case or are the same: naming them isn't wrong."""


def without(name: str, acts_on: str) -> frozenset[str]:
    """Return the names of our effects that answer to a law of the truth."""
    return frozenset(key[0] for key in our_keys(name, acts_on))


def farthest_singles(truths: Iterable[dict[str, Any]]) -> dict[str, tuple[float, int, str]]:
    """Return (distance to the nearest law that remains, seed, place) of the single of every effect that is farthest.

    What another law does as well, but for less than the floor scatters by, nobody calls unknown who has no law for it:
    a sensor's delay of 283 deviations was a lag but for 86 squares, where the floor of a set scatters by 630 to 880.
    """
    farthest: dict[str, tuple[float, int, str]] = {}
    for truth in truths:
        if truth["kind"] != "single":
            continue
        (member,) = truth["effects"]
        if member["above_twice_limit"]:
            own = _remaining_distance(member), truth["seed"], member["acts_on"]
            farthest[member["name"]] = max(farthest.get(member["name"], own), own)
    return farthest


def _remaining_distance(member: dict[str, Any]) -> float:
    """Return the distance to the nearest of the laws that remain without a member's: it goes at all its places.

    A scale error is as near to that of the other sensor as can be, and neither is there.
    """
    gone = without(member["name"], member["acts_on"])
    ours = [(without(name, acts_on), distance) for name, acts_on, distance in member["nearest"]]
    return min(distance for names, distance in ours if not names or not names <= gone)


def drawn_truths(seeds: Iterable[int]) -> list[dict[str, Any]]:
    """Return the truths of further sets that hide one effect each, of which nothing has been searched."""
    with ProcessPoolExecutor(os.cpu_count() or 1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(_drawn_truth, seeds))


def _drawn_truth(seed: int) -> dict[str, Any]:
    return json.loads(json.dumps(generate.truth(generate.draw(seed, "single", DURATION_S))))


def figures(
    truths: Iterable[dict[str, Any]], full: bool, say: Callable[[str], None], most: int | None, until_s: float
) -> Iterator[Figure]:
    """Search the set of every effect that no other law comes near, with a library that lacks the effect."""
    jobs = [
        Job(seed, "single", sets_folder(), keep=not full, options=(("without", without(name, acts_on)),))
        for name, (_, seed, acts_on) in list(farthest_singles(truths).items())[:most]
    ]
    say(f"the library without one effect, {len(jobs)} times")
    again, right = [], []
    for one in searched(jobs, os.cpu_count() or 1, until_s):
        again.append(marked(one))
        right.append(is_right(again[-1]) or is_together(again[-1]))
        say(f"{'unknown or an alias' if right[-1] else 'MISNAMED or missed'}: {line(again[-1])}")
    yield judged(again, right, full)
    yield judged_shown(again, right, full)


def stands_out(one: Marked) -> bool:
    """Tell whether what the nearest other law leaves of a single stands out of what its floor scatters by.

    Where it does not, no look at what is left can tell that a law is missing: 313 squares lie between a sensor's lag of
    476 us and a delay, where the floor scatters by 630.
    """
    (member,) = (one.searched.truth or {})["effects"]
    return _remaining_distance(member) ** 2 > _SHOWN_SDS * one.searched.reducible_sd


def judged_shown(again: Sequence[Marked], right: Sequence[bool], full: bool) -> Figure:
    """Give the share of right answers where a rest can be seen."""
    seen = [(one, is_so) for one, is_so in zip(again, right, strict=True) if one.searched.truth and stands_out(one)]
    hidden = len(again) - len(seen)
    if not seen:
        return absent(SHOWN, f"of {len(again)} effects nothing that another law leaves stands out of the floor")
    seeds = sorted(one.searched.seed for one, _ in seen)
    found = suite_figures.share(sum(is_so for _, is_so in seen), len(seen))
    remark = f"{hidden} others can't show that a law is missing: the nearest one leaves less"
    return suite_figures.judged_estimate(SHOWN, found, seeds, full, remark)


def judged(again: Sequence[Marked], right: Sequence[bool], full: bool) -> Figure:
    """Hold the share of effects that came back as unknown or as an alias against its bar."""
    remark = f"{len(again)} effects, each on the set of those that hide it alone that no other law comes near"
    if not again:
        return absent(BAR, remark)
    wrong = [(one.searched.truth or {}).get("effects") for one, is_so in zip(again, right, strict=True) if not is_so]
    texts = [effects[0]["name"] if effects else "?" for effects in wrong]
    seeds = sorted(one.searched.seed for one in again)
    more = "; ".join(part for part in (remark, f"not: {', '.join(texts)}" if texts else "") if part)
    return suite_figures.judged_estimate(BAR, suite_figures.share(sum(right), len(right)), seeds, full, more)


def is_right(one: Marked) -> bool:
    """Tell whether a single whose law was not in the library came back as unknown or as an alias of it."""
    if one.searched.error or one.searched.truth is None:
        return False
    if one.right:
        return True
    (member,) = one.searched.truth["effects"]
    named = one.mark["named"]
    if not named:
        return one.searched.findings["verdict"] == "unknown"
    if any(names in CONTAINED_IN.get(member["name"], ()) for names in _spellings(named, member["acts_on"])):
        return True
    inseparable = {tuple(key) for key in member["inseparable"]}
    return len(named) == 1 and (named[0]["name"], named[0]["acts_on"]) in inseparable


def _spellings(named: Sequence[dict], acts_on: str) -> list[frozenset[str]]:
    """Return what names at one place can be called, each by its own name or one of its alias set; none elsewhere."""
    keys = [[(found["name"], found["acts_on"]), *map(tuple, found["alias_set"])] for found in named]
    choices = [[name for name, place in own if place == acts_on] for own in keys]
    return [frozenset(names) for names in itertools.product(*choices)]


def is_together(one: Marked) -> bool:
    """Tell whether what was named is together the hidden law, so that no likelihood ratio tells them apart."""
    named, truth = one.mark["named"], one.searched.truth
    if truth is None or not named:
        return False
    told = [(found["name"], found["acts_on"], found["parameters"]) for found in named]
    told += [(error["name"], error["acts_on"], {}) for error in one.searched.findings["parameter_errors"]]
    case = generate.draw(one.searched.seed, truth["kind"], DURATION_S)
    return together.distance(case, told) < detection.SEPARABLE_D
