"""One value for each parameter of a found effect, out of those of its sessions: what a profile can hold. Pure."""

import math
import re
from collections.abc import Sequence

from stagectl.effects import CATALOGUE
from stagectl.gap import addition
from stagectl.gap.findings import SIGMAS, Named
from stagectl.gap.hypotheses import phase_of


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
            found[parameter] = _mean_of(values, errors, effect.common_sd_ratio)
    return found


_OWN_RATIO = 1e-3
"""Of a deviation, the least that is its own."""


def own_sd(value: float, sd: float, common_sd_ratio: float) -> float:
    """Return what a value is uncertain by besides what it has in common with others of its effect."""
    return max(math.sqrt(max(sd * sd - (value * common_sd_ratio) ** 2, 0.0)), _OWN_RATIO * sd, 1e-300)


def pooled(values: Sequence[float], sds: Sequence[float], common_sd_ratio: float) -> tuple[float, float]:
    """Return the mean of one parameter over sessions, weighted, and its deviation.

    What all have in common no mean makes smaller: of an amplitude of 3 N in two sessions, both as uncertain as the
    scale of forces is, 0.4 %, the mean was stated to 0.3 %.
    """
    weights = [own_sd(value, sd, common_sd_ratio) ** -2 for value, sd in zip(values, sds, strict=True)]
    total = sum(weights)
    mean = sum(weight * value for weight, value in zip(weights, values, strict=True)) / total
    return mean, math.hypot(total**-0.5, mean * common_sd_ratio)


def _of_newest(values: dict[str, float], errors: dict[str, float]) -> tuple[float, float | None, str]:
    newest, *others = sorted(values, key=_natural, reverse=True)
    half_width = SIGMAS * errors[newest] if newest in errors else None
    if not newest:
        return values[newest], half_width, "per session, taken as fixed: set it again after a homing"
    remark = f"per session, this is {newest}, the newest: find it again after a homing"
    if others:
        remark += "; " + ", ".join(f"{place} had {values[place]:.4g}" for place in others)
    return values[newest], half_width, remark


def _mean_of(
    values: dict[str, float], errors: dict[str, float], common_sd_ratio: float
) -> tuple[float, float | None, str]:
    if set(errors) != set(values):
        mean = sum(values.values()) / len(values)
        return mean, None, "searched, no interval"
    mean, sd = pooled(list(values.values()), [errors[place] for place in values], common_sd_ratio)
    remark = f"mean of {len(values)} sessions" if len(values) > 1 else ""
    return mean, SIGMAS * sd, remark


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Order names as people number them: session 9 before session 10, dated names by date."""
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", text)]
