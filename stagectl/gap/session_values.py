"""One value for each parameter of a found effect, out of those of its sessions: what a profile can hold. Pure."""

import re

from stagectl.effects import CATALOGUE
from stagectl.gap import addition
from stagectl.gap.findings import Named
from stagectl.gap.hypotheses import phase_of

SIGMAS = 1.96
"""Of a 95 % interval."""


def values_of(effect: Named) -> dict[str, tuple[float, float | None, str]]:
    """Return (value, half width of its interval, remark) of every parameter, in the order of the declaration.

    What belongs to the machine is the mean over the sessions, weighted; what belongs to a homing is the newest one's.
    """
    known = CATALOGUE[effect.name]
    by_place: dict[str, dict[str, float]] = {}
    sds: dict[str, dict[str, float]] = {}
    for name, value in effect.parameters.items():
        parameter, place = addition.parted(name)
        by_place.setdefault(parameter, {})[place] = value
        if name in effect.sds:
            sds.setdefault(parameter, {})[place] = effect.sds[name]
    for amplitude in known.linear:
        phase = phase_of(known, amplitude)
        if phase in by_place and amplitude in sds:  # the sine and the cosine are known alike
            sds[phase] = {
                place: sd / abs(by_place[amplitude][place])
                for place, sd in sds[amplitude].items()
                if by_place[amplitude][place]
            }
    found: dict[str, tuple[float, float | None, str]] = {}
    for parameter in known.parameters:
        values, errors = by_place[parameter], sds.get(parameter, {})
        if known.tags[parameter] == "session":
            found[parameter] = _of_newest(values, errors)
        else:
            found[parameter] = _mean_of(values, errors)
    return found


def _of_newest(values: dict[str, float], errors: dict[str, float]) -> tuple[float, float | None, str]:
    newest, *others = sorted(values, key=_natural, reverse=True)
    half_width = SIGMAS * errors[newest] if newest in errors else None
    if not newest:
        return values[newest], half_width, "per session, taken as fixed: set it again after a homing"
    remark = f"per session, this is {newest}, the newest: find it again after a homing"
    if others:
        remark += "; " + ", ".join(f"{place} had {values[place]:.4g}" for place in others)
    return values[newest], half_width, remark


def _mean_of(values: dict[str, float], errors: dict[str, float]) -> tuple[float, float | None, str]:
    if set(errors) != set(values):
        mean = sum(values.values()) / len(values)
        return mean, None, "searched, no interval"
    weights = {place: max(errors[place], 1e-300) ** -2 for place in values}
    total = sum(weights.values())
    mean = sum(weights[place] * value for place, value in values.items()) / total
    remark = f"mean of {len(values)} sessions" if len(values) > 1 else ""
    return mean, SIGMAS * total**-0.5, remark


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Order names as people number them: session 9 before session 10, dated names by date."""
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", text)]
