"""Marks findings against the sealed truth by the suite's bars, with exact binomial intervals.

    python -m tests.blind.score FINDINGS TRUTH      # folders of <seed>/findings.json and <seed>/truth.json

Findings: {"verdict": "nothing" | "found" | "unknown", "effects": [{"name", "acts_on", "alias_set":
[[name, acts_on], ...], "parameters": {}, "interval": {name: [low, high]}}], "parameter_errors": [{"name", "acts_on",
"alias_set"}], "not_excited": [name, ...]}. Parameter names and units are those of the README's table.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np
from scipy import stats

VERDICTS = ("nothing", "found", "unknown")
BARS = {"single": 0.95, "multi": 0.85, "null": 0.98, "outside": 0.90, "below_limit": 0.98, "parameter": 0.95}
PARAMETER_ERROR_BAR = 0.03
COVERAGE_BAR = (0.90, 0.99)
SET_SIZE_BAR = 1.2


def clopper_pearson(right, count, confidence=0.95):
    """Exact binomial interval of a share."""
    if not 0 <= right <= count:
        raise ValueError(f"{right} right of {count}")
    tail = 0.5 * (1.0 - confidence)
    low = 0.0 if right == 0 else float(stats.beta.ppf(tail, right, count - right + 1))
    high = 1.0 if right == count else float(stats.beta.ppf(1.0 - tail, right + 1, count - right))
    return low, high


def category(truth):
    """Which bar a set is judged by; None where no bar speaks of it (an outside effect that a library law mimics)."""
    kind = truth["kind"]
    members = truth["parameter_errors"] if kind == "parameter" else truth["effects"]
    if kind == "null":
        return "null"
    if not all(member["above_twice_limit"] for member in members):
        return "below_limit"
    if kind == "outside" and members[0]["inseparable"]:
        return None
    return kind


def _names(found):
    """{(name, acts_on)} that a finding states: its name and its alias set."""
    named = {(found["name"], found["acts_on"])}
    for alias in found.get("alias_set", ()):
        named.add(tuple(alias) if not isinstance(alias, str) else (alias, found["acts_on"]))
    return named


def _same(stated, true, both_axes):
    return stated[0] == true[0] and (both_axes or stated[1] == true[1])


def matches(found, member, judged_aliases=True):
    """Whether a finding names a true effect: exactly, or in a stated set whose other members nobody could separate.

    Where the truth holds no inseparable sets (below the limit) any stated set with the true name in it counts.
    """
    true = (member["name"], member["acts_on"])
    both = member.get("both_axes", False)
    allowed = [tuple(key) for key in member["inseparable"]]
    names = _names(found)
    if not any(_same(name, true, both) for name in names):
        return False
    if not judged_aliases:
        return True
    others = [name for name in names if not _same(name, true, both)]
    return all(any(name[0] == key[0] and name[1] == key[1] for key in allowed) for name in others)


def matched(findings, members, judged_aliases=True):
    """[(finding, member)] one to one, greedily; findings may be left over."""
    pairs, left = [], list(members)
    for found in findings:
        for member in left:
            if matches(found, member, judged_aliases):
                pairs.append((found, member))
                left.remove(member)
                break
    return pairs


def _respelled(findings, members):
    """Findings with asymmetric Coulomb friction spelled as the truth has it: exactly Coulomb friction and an offset.

    An offset is also what the truth holds to be one: a tilt that nobody can tell from it.
    """
    result = list(findings)
    present = {(member["name"], member["acts_on"]) for member in members}
    for axis in ("macro_force", "micro_force"):
        one = [found for found in result if (found["name"], found["acts_on"]) == ("asymmetric_coulomb_friction", axis)]
        friction = [found for found in result if (found["name"], found["acts_on"]) == ("coulomb_friction", axis)]
        constant = [found for found in result if found not in friction and ("offset", axis) in _names(found)]
        others = [member for member in members if (member["name"], member["acts_on"]) != ("coulomb_friction", axis)]
        stands_for = next((member for member in others if _may_be(member, "offset", axis)), None)
        if one and ("coulomb_friction", axis) in present and stands_for:
            result.remove(one[0])
            result.append(_respelled_as("coulomb_friction", axis))
            result.append(_respelled_as(stands_for["name"], stands_for["acts_on"]))
        elif friction and constant and ("asymmetric_coulomb_friction", axis) in present:
            result = [found for found in result if found is not friction[0] and found is not constant[0]]
            result.append(_respelled_as("asymmetric_coulomb_friction", axis))
    return result


def _may_be(member, name, axis):
    """Whether a true effect is a law, or one that nobody can tell from it."""
    return (name, axis) in {(member["name"], member["acts_on"]), *(tuple(key) for key in member["inseparable"])}


def _respelled_as(name, axis):
    return {"name": name, "acts_on": axis, "alias_set": [], "parameters": {}}


def score(findings, truth):
    """One set's mark: {"category", "right", "why", "pairs", "named"}."""
    if findings["verdict"] not in VERDICTS:
        raise ValueError(f"verdict {findings['verdict']!r} is none of {', '.join(VERDICTS)}")
    effects, errors = _respelled(findings.get("effects", []), truth["effects"]), findings.get("parameter_errors", [])
    where = category(truth)
    pairs = matched(effects, truth["effects"], where != "below_limit")
    why = ""
    if where == "null":
        right = not effects
        why = "" if right else f"named {effects[0]['name']} where nothing is missing"
    elif where == "parameter":
        met = matched(errors, truth["parameter_errors"])
        right = not effects and len(met) == len(truth["parameter_errors"]) == len(errors)
        why = "" if right else "an effect was named" if effects else "not the parameters that are wrong"
    elif where == "outside":
        right = findings["verdict"] == "unknown" and not effects
        why = "" if right else f"named {effects[0]['name']}" if effects else f"verdict {findings['verdict']}"
    elif where == "below_limit":
        right = len(pairs) == len(effects)
        why = "" if right else "a wrong name"
    elif where is None:
        right, why = None, "a library law mimics this one"
    else:
        right = len(pairs) == len(effects) == len(truth["effects"])
        why = "" if right else f"{len(pairs)} of {len(truth['effects'])} named, {len(effects) - len(pairs)} wrong"
    return {"seed": truth["seed"], "category": where, "right": right, "why": why, "pairs": pairs, "named": effects}


def parameter_marks(pairs):
    """[(relative error of the amplitude, whether its interval holds it or None)] above ten times the limit.

    An effect that was named first as one of a set that can't be separated has no amplitude of the true one's: the bow
    of the other ruler has the other sign.
    """
    marks = []
    for found, member in pairs:
        name = member["amplitude"]
        if not member["above_ten_times_limit"] or any(found[key] != member[key] for key in ("name", "acts_on")):
            continue
        true, value = member["parameters"][name], found.get("parameters", {}).get(name)
        if value is None:
            marks.append((math.inf, None))
            continue
        interval = found.get("interval", {}).get(name)
        covered = None if interval is None else bool(interval[0] <= true <= interval[1])
        marks.append((abs(value - true) / abs(true), covered))
    return marks


def _figure(name, right, count, bar):
    low, high = clopper_pearson(right, count)
    value = right / count if count else None
    return {
        "figure": name,
        "value": value,
        "right": right,
        "count": count,
        "interval": [low, high],
        "bar": bar,
        "point_holds": None if not count else value >= bar,
        "holds": None if not count else high >= bar,  # false only where the 95 % interval excludes the bar
    }


def summary(marks, truths):
    """Figures of many sets, and precision and recall effect by effect. marks and truths in the same order."""
    figures = []
    for name, bar in BARS.items():
        own = [mark for mark in marks if mark["category"] == name]
        figures.append(_figure(name, sum(mark["right"] for mark in own), len(own), bar))
    parameters = [
        one for mark in marks if mark["category"] in ("single", "multi") for one in parameter_marks(mark["pairs"])
    ]
    median = float(np.median([error for error, _ in parameters])) if parameters else None
    covered = [cover for _, cover in parameters if cover is not None]
    low, high = clopper_pearson(sum(covered), len(covered))
    sizes, own_sizes = [], []
    for mark in marks:
        if mark["category"] in ("single", "multi"):
            for found, member in mark["pairs"]:
                sizes.append(len(_names(found)))
                own_sizes.append(1 + len(member["inseparable"]))
    by_name = {}
    for mark, truth in zip(marks, truths, strict=True):
        for found in mark["named"]:
            row = by_name.setdefault(found["name"], {"named": 0, "rightly": 0, "hidden": 0, "hidden_and_found": 0})
            row["named"] += 1
        for found, _ in mark["pairs"]:
            by_name[found["name"]]["rightly"] += 1
        for member in truth["effects"]:
            if member["above_twice_limit"] and not member["outside"]:
                row = by_name.setdefault(member["name"], {"named": 0, "rightly": 0, "hidden": 0, "hidden_and_found": 0})
                row["hidden"] += 1
                row["hidden_and_found"] += any(other is member for _, other in mark["pairs"])
    return {
        "figures": figures,
        "parameter_error_median": median,
        "parameter_error_holds": None if median is None else median <= PARAMETER_ERROR_BAR,
        "coverage": sum(covered) / len(covered) if covered else None,
        "coverage_interval": [low, high],
        "coverage_holds": None if not covered else high >= COVERAGE_BAR[0] and low <= COVERAGE_BAR[1],
        "mean_set_size": float(np.mean(sizes)) if sizes else None,
        "mean_own_set_size": float(np.mean(own_sizes)) if sizes else None,
        "set_size_holds": None if not sizes else float(np.mean(sizes)) <= SET_SIZE_BAR * float(np.mean(own_sizes)),
        "by_name": dict(sorted(by_name.items())),
    }


def main(arguments=None):
    """Command line: prints the summary as JSON."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.score", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("findings", type=Path)
    parser.add_argument("truth", type=Path)
    given = parser.parse_args(arguments)
    marks, truths = [], []
    for path in sorted(given.truth.glob("*/truth.json")):
        truth = json.loads(path.read_text())
        truths.append(truth)
        marks.append(score(json.loads((given.findings / path.parent.name / "findings.json").read_text()), truth))
    result = summary(marks, truths)
    result["wrong"] = [
        {key: mark[key] for key in ("seed", "category", "why")} for mark in marks if mark["right"] is False
    ]
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
