"""Whether findings may be written into a profile: whole, of this profile, and of this state of it. Pure."""

import hashlib
import itertools
import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from stagectl.effects import CATALOGUE
from stagectl.effects.table import KNOTS_COUNT, TABLES
from stagectl.errors import ProfileError, RequestError
from stagectl.gap import addition
from stagectl.gap.findings import Findings
from stagectl.gap.hypotheses import parts_of
from stagectl.gap.parameter_application import FORCE_CONSTANTS, LATCHES, PLACES
from stagectl.gap.profile_sheet import plain

_EVEN_RATIO = 0.01  # findings round their knots


def refuse_other_profile(document: Mapping[str, Any], findings: Findings, origin: str, text: str) -> None:
    """Refuse findings about another profile, or about this one before it was changed."""
    name = document.get("name")
    if name != findings.profile:
        raise RequestError(f"the findings are of profile {findings.profile!r}, this is {name!r}; give that profile")
    if f"{origin}; intervals" in text:
        raise RequestError(f"the findings of {origin} stand in this profile already; give the profile before them")
    try:
        there = {addition.key_of(row) for row in document.get("effects", ())}
    except (KeyError, TypeError) as error:
        raise ProfileError("an [[effects]] table of the profile lacks name or acts_on; see `profile check`") from error
    if strange := [title for title in there if title.partition(" on ")[0] not in CATALOGUE]:
        raise ProfileError(f"the profile has {strange[0]}, which is not an effect; see `profile check`")
    seen = {title for title in findings.refitted if " on " in title}
    if there != seen:
        odd = ", ".join(sorted(there ^ seen))
        raise RequestError(
            f"profile {name} has changed since the findings were made ({odd}): give the profile of that time, or run "
            "`stagectl gap` again"
        )
    now = hashlib.sha256(text.encode()).hexdigest()
    if findings.profile_sha256 not in ("", now):
        raise RequestError(
            f"profile {name} has changed since the findings were made (sha256 {now[:12]}, then "
            f"{findings.profile_sha256[:12]}): give the profile of that time, or run `stagectl gap` again"
        )


def refuse_damaged(findings: Findings) -> None:
    """Refuse findings that name what can't be, or hold no numbers."""
    problem = ""
    for effect in findings.named:
        known = CATALOGUE.get(effect.name)
        if known is None:
            problem = f"{effect.name} is not an effect of this profile or version"
        elif effect.acts_on not in known.places:
            problem = f"{effect.name} can't act on {effect.acts_on}"
        else:
            given = {addition.parted(name)[0] for name in effect.parameters}
            if given != set(known.parameters):
                odd = ", ".join(sorted(given ^ set(known.parameters)))
                problem = f"{effect.name} on {effect.acts_on} has not its parameters: {odd}"
            elif not _are_numbers([*effect.parameters.values(), *effect.sds.values()]):
                problem = f"{effect.name} on {effect.acts_on} has values that are no numbers"
    known_names = {*PLACES, *FORCE_CONSTANTS, *LATCHES, *findings.refitted}
    for error in findings.parameter_errors:
        if strange := [part for part in parts_of(error.name) if part not in known_names]:
            problem = f"{strange[0]} is no parameter"
        elif not _are_numbers([error.error, error.sd]):
            problem = f"{error.name} has values that are no numbers"
    if findings.unknown is not None and (said := _curve_problem(findings.unknown)):
        problem = f"the unknown curve {said}"
    if not _are_numbers([*findings.refitted.values(), *findings.refitted_sds.values()]):
        problem = "refitted values that are no numbers"
    if problem:
        raise RequestError(f"the findings are damaged or of another version: {problem}; run `stagectl gap` again")


def _curve_problem(unknown: Mapping[str, Any]) -> str:
    if strange := [name for name in ("over", "acts_on", "unit", "knots", "values", "sds") if name not in unknown]:
        return f"lacks {strange[0]}"
    lists = [unknown[name] for name in ("knots", "values", "sds")]
    if not all(isinstance(one, list) and one and _are_numbers(one) for one in lists):
        return "has no numbers in knots, values and sds"
    count = KNOTS_COUNT if is_tabled(unknown) else len(lists[0])
    if not all(len(one) == count for one in lists):
        return f"has not {count} numbers in knots, values and sds"
    steps = [after - before for before, after in itertools.pairwise(lists[0])]
    if is_tabled(unknown) and not 0.0 < max(steps) < (1.0 + _EVEN_RATIO) * min(steps):
        return "has knots at uneven steps"
    return ""


def is_tabled(unknown: Mapping[str, Any]) -> bool:
    """Tell whether a profile has a table of what a curve goes by: of a force over some quantities."""
    return unknown["unit"] == "N" and unknown["over"] in TABLES.values()


def _are_numbers(values: list[Any]) -> bool:
    return all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) for value in values
    )


def origin_of(findings: Findings) -> str:
    """Say from which runs findings come."""
    runs = ", ".join(PurePath(run).name for run in findings.runs)
    held = ", ".join(PurePath(run).name for run in findings.holdout)
    return plain(f"runs {runs}" + (f", judged on {held}" if held else ""))
