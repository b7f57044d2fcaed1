"""Known parameters that were found wrong, written to the keys of a profile that they are.

Pure.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from stagectl.effects import CATALOGUE
from stagectl.gap import addition
from stagectl.gap.findings import SIGMAS, Findings, ParameterError
from stagectl.gap.hypotheses import parts_of
from stagectl.gap.profile_sheet import Change, Sheet

_LEAST_RATIO = 1e-3  # effects of the profile that were refitted by less stay as they are


@dataclass(frozen=True, slots=True)
class _Place:
    table: str
    key: str
    is_ratio: bool = True  # whether the error is a ratio, or in the key's own unit


PLACES = {
    "macro_mass_kg": _Place("macro", "mass_kg"),
    "micro_mass_kg": _Place("micro", "mass_kg"),
    "spring_n_per_m": _Place("micro", "spring_n_per_m"),
    "damping_n_s_per_m": _Place("micro", "damping_n_s_per_m"),
    "left_stiffness_n_per_m": _Place("backlash", "left_stiffness_n_per_m"),
    "right_stiffness_n_per_m": _Place("backlash", "right_stiffness_n_per_m"),
    "left_m": _Place("backlash", "left_m", is_ratio=False),
    "right_m": _Place("backlash", "right_m", is_ratio=False),
    "macro_current_loop_s": _Place("macro", "current_loop_s", is_ratio=False),
    "micro_current_loop_s": _Place("micro", "current_loop_s", is_ratio=False),
}
"""Which key of a profile a known parameter of the findings is."""

FORCE_CONSTANTS = {"macro_force_constant": "macro_actuator", "micro_force_constant": "micro_actuator"}
"""Where its error is written as an effect: rated_force_n is the drive's name plate (0x6076), which arming compares."""


LATCHES = ("macro_latch_s", "micro_latch_s")
_LATCH_KEYS = ("actuation_delay_s", "latch_s")  # of [cycle]: in a profile, in the file of an observed machine


def parameters_of_keys(sheet: Sheet, findings: Findings) -> Iterator[ParameterError]:
    """Yield the parameter errors of keys; the latch of both axes is one key, so they must agree."""
    latches = [error for error in findings.parameter_errors if error.name in LATCHES]
    for error in findings.parameter_errors:
        if error not in latches and " on " not in error.name:
            yield from (replace(error, name=part) for part in parts_of(error.name))
    if not latches:
        return
    sharing = sum(name in findings.refitted for name in LATCHES)
    if len(latches) < sharing:
        other = next(name for name in LATCHES if name != latches[0].name)
        sheet.left.append(
            f"{latches[0].name} is off by {latches[0].error:.3g} s and {other} is not: the profile has one delay for "
            "both; write a command_delay on that axis by hand"
        )
        return
    weights = [max(error.sd, 1e-300) ** -2 for error in latches]
    apart = max(error.error for error in latches) - min(error.error for error in latches)
    if apart > SIGMAS * math.hypot(*(error.sd for error in latches)):
        both = " and ".join(f"{error.name} by {error.error:.3g} s" for error in latches)
        sheet.left.append(f"{both}: they differ, and the profile has one delay for both; write command_delay by hand")
        return
    mean = sum(w * error.error for w, error in zip(weights, latches, strict=True)) / sum(weights)
    confirmed = all(error.confirmed for error in latches)
    yield ParameterError(LATCHES[0], mean, sum(weights) ** -0.5, latches[0].stated_sd, confirmed=confirmed)


def write_parameter(sheet: Sheet, error: ParameterError) -> None:
    """Correct one known parameter."""
    if error.name in FORCE_CONSTANTS:
        _write_force_constant(sheet, error, FORCE_CONSTANTS[error.name])
        return
    if error.name in LATCHES:
        cycle = sheet.document.get("cycle", {})
        key = next((name for name in _LATCH_KEYS if name in cycle), _LATCH_KEYS[0])
        place = _Place("cycle", key, is_ratio=False)
    else:
        place = PLACES[error.name]
    table = sheet.document.get(place.table, {})
    if place.key not in table:
        sheet.left.append(f"{error.name} is off by {error.error:.3g}: this file has no {place.table}.{place.key}")
        return
    before = float(table[place.key])
    scale = before if place.is_ratio else 1.0
    value = before + scale * error.error
    half_width = SIGMAS * abs(scale) * error.sd
    change = Change(f"{place.table}.{place.key}", value, before, half_width, error.confirmed, _instead(error))
    sheet.set(table, place.key, change)


def _instead(error: ParameterError) -> str:
    return "explained as well by " + ", ".join(error.aliases) if error.aliases else ""


def _write_force_constant(sheet: Sheet, error: ParameterError, acts_on: str) -> None:
    confirmed, remark = error.confirmed, _instead(error)
    half_width = SIGMAS * error.sd
    for number, row in enumerate(sheet.effects):
        if (row["name"], row["acts_on"]) == ("force_constant_error", acts_on):
            before = float(row["error_ratio"])
            key, value = f"effects[{number}].error_ratio", before + error.error
            sheet.set(row, "error_ratio", Change(key, value, before, half_width, confirmed, remark))
            return
    state = "confirmed" if confirmed else "candidate, not confirmed yet"
    key, table = sheet.add_effect(f"{sheet.mark}: {state}; rated_force_n stays the drive's name plate")
    table["name"] = "force_constant_error"
    table["acts_on"] = acts_on
    sheet.set(table, "error_ratio", Change(f"{key}.error_ratio", error.error, None, half_width, confirmed, remark))


def write_refitted(sheet: Sheet, findings: Findings, whole: bool, candidates: bool) -> None:
    """Replace the amplitudes of the profile's own effects by those that were fitted together with what was found."""
    errors = {error.name: error for error in findings.parameter_errors}
    for number, row in enumerate(sheet.effects):
        title = addition.key_of(row)
        ratio = findings.refitted.get(title, 0.0)
        error = errors.get(title)
        if abs(ratio) < _LEAST_RATIO and error is None:
            continue
        confirmed = whole or (error is not None and error.confirmed)
        if not confirmed and not candidates:
            if error is not None:
                sheet.left.append(f"{title} is off by {ratio:.3g}, not confirmed: --candidates writes it")
            continue
        if f"effects[{number}]" in {change.key.partition(".")[0] for change in sheet.written}:
            continue  # added above, or corrected as a force constant
        known = CATALOGUE[row["name"]]
        if not known.linear:
            if error is not None:
                sheet.left.append(f"{title} is off by {ratio:.3g} of its force, and in no parameter alone; fit by hand")
            continue
        values = addition.refitted({name: float(row[name]) for name in known.linear} | {"name": row["name"]}, ratio)
        if outside := [n for n, v in values.items() if not known.bounds[n][0] <= v <= known.bounds[n][1]]:
            low, high = known.bounds[outside[0]]
            said = f"{outside[0]} = {values[outside[0]]:.4g} is outside {low:g} to {high:g}"
            sheet.left.append(f"{title}: refitted, its {said}; is the effect there at all?")
            continue
        sd = error.sd if error is not None else findings.refitted_sds.get(title)
        remark = "" if error is not None else "refitted with what was found"
        remark += "" if sd is not None else ", no interval"
        for name, value in values.items():
            before = float(row[name])
            half_width = None if sd is None else SIGMAS * sd * abs(before)
            sheet.set(row, name, Change(f"effects[{number}].{name}", value, before, half_width, confirmed, remark))
