"""The `[[effects]]` tables of profiles and machines, checked against the catalogue.

A table stays a plain dict (name, acts_on and parameters), as `stagectl.compose` takes it.
"""

import difflib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator

from stagectl.effects import CATALOGUE, Effect
from stagectl.toml_file import Problem, Within, missing, refuse, unknown_key


def _checked(table: Any) -> dict[str, Any]:
    """Check one table; return a copy with all parameters as floats, in the order of the declaration."""
    if not isinstance(table, Mapping):
        refuse([Problem("name", table, "must be a table", "write name, acts_on and parameters under [[effects]]")])
    name, place = table.get("name"), table.get("acts_on")
    if "name" not in table:
        refuse([missing("name")])
    if not isinstance(name, str) or name not in CATALOGUE:
        refuse([Problem("name", name, "is not an effect", _which_effect(name))])
    effect = CATALOGUE[str(name)]
    problems: list[Problem | None] = []
    if "acts_on" not in table:
        problems.append(missing("acts_on"))
    elif place not in effect.places:
        remedy = "choose one of them" if len(effect.places) > 1 else "write that"
        problems.append(Problem("acts_on", place, f"{name} may act on {' or '.join(effect.places)} only", remedy))
    problems += _parameter_problems(effect, {k: v for k, v in table.items() if k not in ("name", "acts_on")})
    refuse(problems)
    return {"name": name, "acts_on": place} | {parameter: float(table[parameter]) for parameter in effect.parameters}


def _parameter_problems(effect: Effect, given: Mapping[str, Any]) -> list[Problem | None]:
    problems: list[Problem | None] = []
    meant: set[str | None] = set()
    for key, value in given.items():
        if key in effect.bounds:
            problems.append(Within(*effect.bounds[key]).problem(key, value))
        else:
            problem, name = unknown_key(key, value, effect.parameters)
            problems.append(problem)
            meant.add(name)
    problems += [missing(name) for name in effect.parameters if name not in given and name not in meant]
    return problems


def _which_effect(name: object) -> str:
    near = difflib.get_close_matches(str(name), CATALOGUE, 1, 0.5)
    return f"did you mean {near[0]}?" if near else f"choose from {', '.join(sorted(CATALOGUE))}"


EffectTable = Annotated[dict[str, Any], BeforeValidator(_checked)]
"""One `[[effects]]` table: a dict with name, acts_on and the effect's parameters."""


def without_micro(effects: Iterable[Mapping[str, Any]]) -> list[Problem | None]:
    """Return a Problem for every effect that needs a micro, for the check of a machine that has none."""
    problems: list[Problem | None] = []
    for number, table in enumerate(effects):
        place = table["acts_on"]
        needs = [q for q in CATALOGUE[table["name"]].quantities if q.startswith(("micro_", "relative_"))]
        if place in ("contact", "contact_edge", "joint", "end_sensor") or place.startswith("micro_") or needs:
            limit = f"{table['name']} on {place} needs a micro, and there is no [micro] table"
            problems.append(Problem(f"effects[{number}].name", table["name"], limit, "remove it"))
    return problems
