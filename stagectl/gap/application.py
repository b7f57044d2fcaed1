"""Findings written into the text of a profile: text in, text out, comments and order kept.

Every written value carries a comment with its 95 % interval; one line on top says from which runs. Pure.
"""

import hashlib
import itertools
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Item

from stagectl.effects import CATALOGUE
from stagectl.effects.table import KNOTS_COUNT, TABLES
from stagectl.errors import ProfileError, RequestError
from stagectl.gap import addition
from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.gap.hypotheses import parts_of, phase_of

_SIGMAS = 1.96  # of a 95 % interval
_LEAST_RATIO = 1e-3  # effects of the profile that were refitted by less stay as they are
_DIGITS = 7
_EVEN_RATIO = 0.01  # findings round their knots


@dataclass(frozen=True, slots=True)
class Change:
    """One value that was written; `key` is dotted, `before` is None where the key is new."""

    key: str
    value: float
    before: float | None
    half_width: float | None  # of the 95 % interval; None where findings state none
    confirmed: bool
    remark: str = ""


@dataclass(frozen=True, slots=True)
class Application:
    """A profile's new text, what changed in it, and what was found and not written, each with its reason."""

    text: str
    changes: tuple[Change, ...]
    left: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Place:
    table: str
    key: str
    is_ratio: bool = True  # whether the error is a ratio, or in the key's own unit


_PLACES = {
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

_FORCE_CONSTANTS = {"macro_force_constant": "macro_actuator", "micro_force_constant": "micro_actuator"}
"""Where its error is written as an effect: rated_force_n is the drive's name plate (0x6076), which arming compares."""

_LATCHES = ("macro_latch_s", "micro_latch_s")
_LATCH_KEYS = ("actuation_delay_s", "latch_s")  # of [cycle]: in a profile, in the file of an observed machine


def applied(document_text: str, findings: Findings, *, candidates: bool, date: str) -> str:
    """Return the profile's text with the findings in it; errors as in `application`."""
    return application(document_text, findings, candidates=candidates, date=date).text


def application(document_text: str, findings: Findings, *, candidates: bool, date: str) -> Application:
    """Write confirmed findings, and with `candidates` all, into a profile's text; `date` is that of the findings' use.

    The result is not checked as a profile yet. Errors: ProfileError where the text is no TOML; RequestError where there
    is nothing to write, or the findings are damaged or belong to another profile or another state of it.
    """
    try:
        tomllib.loads(document_text)  # the judge of what TOML is; tomlkit keeps comments and order
        document = tomlkit.parse(document_text)
    except (ValueError, TOMLKitError) as error:
        raise ProfileError(f"the profile is not TOML: {error}; correct that line") from error
    _refuse_damaged(findings)
    _refuse_other_profile(document, findings, _origin(findings), document_text)
    sheet = _Sheet(document, _mark(document_text, date))
    targets = (*findings.named, *findings.parameter_errors)
    whole = bool(targets) and all(target.confirmed for target in targets)
    for effect in findings.named:
        if effect.confirmed or candidates:
            _write_effect(sheet, effect)
    for error in _parameters_of_keys(sheet, findings):
        if error.confirmed or candidates:
            _write_parameter(sheet, error)
        else:
            sheet.left.append(f"{error.name} is off by {error.error:.3g}, not confirmed: --candidates writes it")
    # what was fitted together holds together: a prediction that held was that of the whole model
    _write_refitted(sheet, findings, whole, candidates)
    if findings.unknown is not None:
        if candidates:
            _write_table(sheet, findings.unknown)
        else:
            sheet.left.append(
                f"the unknown curve over {findings.unknown['over']}: a table is written with --candidates"
            )
    if not sheet.written:
        raise RequestError(_why_nothing(findings, sheet.left, candidates))
    top = f"# {sheet.mark}: values so marked are from `stagectl gap`, {_origin(findings)}; intervals are 95 %."
    lines = [_plain(top), *(_plain(f"# {note}") for note in sheet.notes)]
    return Application(_below_title(tomlkit.dumps(document), lines), tuple(sheet.written), tuple(sheet.left))


class _Sheet:
    """The document under way."""

    def __init__(self, document: tomlkit.TOMLDocument, mark: str):
        self.document = document
        self.mark = mark
        self.written: list[Change] = []
        self.left: list[str] = []
        self.notes: list[str] = []  # of values whose place can't carry a comment

    @property
    def effects(self) -> list[Any]:
        return list(self.document.get("effects", ()))

    def set(self, table: Any, key: str, change: Change) -> None:
        """Write one value with its comment behind what stands there."""
        value = float(f"{change.value:.{_DIGITS}g}")
        item = tomlkit.float_(value)
        earlier = table.get(key)
        said = _said(self.mark, change)
        if isinstance(table, InlineTable):
            self.notes.append(f"{change.key}: {said}")
            table[key] = value
        else:
            old = earlier.trivia.comment.lstrip("# ").rstrip() if isinstance(earlier, Item) else ""
            table[key] = item
            table[key].comment(_plain(f"{old}; {said}" if old else said))
            if not old:
                table[key].trivia.comment_ws = "  "
        self.written.append(change)

    def add_effect(self, head: str) -> tuple[str, Any]:
        """Add an empty `[[effects]]` table; returns its dotted key and the table."""
        known = self.document.get("effects")
        if known is None or (not isinstance(known, AoT) and not len(known)):
            if known is not None:
                del self.document["effects"]
            known = tomlkit.aot()
            self.document.append("effects", known)
            known = self.document["effects"]
        key = f"effects[{len(known)}]"
        if isinstance(known, AoT):
            table = tomlkit.table()
            table.comment(_plain(head))
            table.trivia.comment_ws = "  "
            table.trivia.indent = "\n"  # a line between it and what stands before
            known.append(table)
        else:  # effects = [{ ... }, { ... }]
            table = tomlkit.inline_table()
            known.append(table)
            self.notes.append(f"{key}: {head}")
        return key, self.document["effects"][-1]


def _write_effect(sheet: _Sheet, effect: Named) -> None:
    """Write one found effect; one that holds for one recording only has no place in a profile."""
    known = CATALOGUE[effect.name]
    title = f"{effect.name} on {effect.acts_on}"
    if own := [name for name, tag in known.tags.items() if tag == "run"]:
        sheet.left.append(f"{title}: its {own[0]} is another one in each run, a profile can't hold it")
        return
    values = _values_of(effect)
    if outside := [n for n, (value, *_) in values.items() if not known.bounds[n][0] <= value <= known.bounds[n][1]]:
        low, high = known.bounds[outside[0]]
        value = values[outside[0]][0]
        sheet.left.append(
            f"{title}: {outside[0]} = {value:.4g} is outside its limits {low:g} to {high:g}; write by hand"
        )
        return
    head = f"{sheet.mark}: {'confirmed' if effect.confirmed else 'candidate, not confirmed yet'}"
    if effect.aliases:
        head += "; explained as well by " + ", ".join(f"{name} on {place}" for name, place, _ in effect.aliases)
    key, table = sheet.add_effect(head)
    table["name"] = effect.name
    table["acts_on"] = effect.acts_on
    for name, (value, half_width, remark) in values.items():
        sheet.set(table, name, Change(f"{key}.{name}", value, None, half_width, effect.confirmed, remark))


def _write_table(sheet: _Sheet, unknown: Mapping[str, Any]) -> None:
    """Write the curve of an unknown force as a table; it names nothing."""
    over = unknown["over"]
    name = next((table for table, quantity in TABLES.items() if quantity == over), None)
    if name is None:
        sheet.left.append(f"the unknown curve over {over}: it is of one recording, a profile can't hold it")
        return
    knots = unknown["knots"]
    step = (knots[-1] - knots[0]) / (len(knots) - 1)
    known = CATALOGUE[name]
    values = [(knots[0], None), (step, None)]
    values += [(v, _SIGMAS * sd) for v, sd in zip(unknown["values_n"], unknown["sds_n"], strict=True)]
    key, table = sheet.add_effect(f"{sheet.mark}: unknown, a table of its curve and no name; not confirmed")
    table["name"] = name
    table["acts_on"] = unknown["acts_on"]
    for parameter, (value, half_width) in zip(known.parameters, values, strict=True):
        sheet.set(table, parameter, Change(f"{key}.{parameter}", value, None, half_width, confirmed=False))


def _values_of(effect: Named) -> dict[str, tuple[float, float | None, str]]:
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
    half_width = _SIGMAS * errors[newest] if newest in errors else None
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
    return mean, _SIGMAS * total**-0.5, remark


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Order names as people number them: session 9 before session 10, dated names by date."""
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", text)]


def _parameters_of_keys(sheet: _Sheet, findings: Findings) -> Iterator[ParameterError]:
    """Yield the parameter errors of keys; the latch of both axes is one key, so they must agree."""
    latches = [error for error in findings.parameter_errors if error.name in _LATCHES]
    for error in findings.parameter_errors:
        if error not in latches and " on " not in error.name:
            yield from (replace(error, name=part) for part in parts_of(error.name))
    if not latches:
        return
    sharing = sum(name in findings.refitted for name in _LATCHES)
    if len(latches) < sharing:
        other = next(name for name in _LATCHES if name != latches[0].name)
        sheet.left.append(
            f"{latches[0].name} is off by {latches[0].error:.3g} s and {other} is not: the profile has one delay for "
            "both; write a command_delay on that axis by hand"
        )
        return
    weights = [max(error.sd, 1e-300) ** -2 for error in latches]
    apart = max(error.error for error in latches) - min(error.error for error in latches)
    if apart > _SIGMAS * math.hypot(*(error.sd for error in latches)):
        both = " and ".join(f"{error.name} by {error.error:.3g} s" for error in latches)
        sheet.left.append(f"{both}: they differ, and the profile has one delay for both; write command_delay by hand")
        return
    mean = sum(w * error.error for w, error in zip(weights, latches, strict=True)) / sum(weights)
    confirmed = all(error.confirmed for error in latches)
    yield ParameterError(_LATCHES[0], mean, sum(weights) ** -0.5, latches[0].stated_sd, confirmed=confirmed)


def _write_parameter(sheet: _Sheet, error: ParameterError) -> None:
    """Correct one known parameter."""
    if error.name in _FORCE_CONSTANTS:
        _write_force_constant(sheet, error, _FORCE_CONSTANTS[error.name])
        return
    if error.name in _LATCHES:
        cycle = sheet.document.get("cycle", {})
        key = next((name for name in _LATCH_KEYS if name in cycle), _LATCH_KEYS[0])
        place = _Place("cycle", key, is_ratio=False)
    else:
        place = _PLACES[error.name]
    table = sheet.document.get(place.table, {})
    if place.key not in table:
        sheet.left.append(f"{error.name} is off by {error.error:.3g}: this file has no {place.table}.{place.key}")
        return
    before = float(table[place.key])
    scale = before if place.is_ratio else 1.0
    value = before + scale * error.error
    half_width = _SIGMAS * abs(scale) * error.sd
    change = Change(f"{place.table}.{place.key}", value, before, half_width, error.confirmed, _instead(error))
    sheet.set(table, place.key, change)


def _instead(error: ParameterError) -> str:
    return "explained as well by " + ", ".join(error.aliases) if error.aliases else ""


def _write_force_constant(sheet: _Sheet, error: ParameterError, acts_on: str) -> None:
    confirmed, remark = error.confirmed, _instead(error)
    half_width = _SIGMAS * error.sd
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


def _write_refitted(sheet: _Sheet, findings: Findings, whole: bool, candidates: bool) -> None:
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
            half_width = None if sd is None else _SIGMAS * sd * abs(before)
            sheet.set(row, name, Change(f"effects[{number}].{name}", value, before, half_width, confirmed, remark))


def _said(mark: str, change: Change) -> str:
    """Return the comment of one value."""
    parts = []
    if change.half_width is not None:
        low, high = change.value - change.half_width, change.value + change.half_width
        parts.append(f"{low:.4g} .. {high:.4g} (95 %)")
    if change.remark:
        parts.append(change.remark)
    if change.before is not None:
        parts.append(f"was {change.before:.{_DIGITS}g}")
        if not change.confirmed:
            parts.append("candidate, not confirmed yet")
    return f"{mark}: {'; '.join(parts)}" if parts else mark


def _origin(findings: Findings) -> str:
    """Say from which runs findings come."""
    runs = ", ".join(PurePath(run).name for run in findings.runs)
    held = ", ".join(PurePath(run).name for run in findings.holdout)
    return _plain(f"runs {runs}" + (f", judged on {held}" if held else ""))


def _mark(text: str, date: str) -> str:
    """Return the mark of this use of findings: its date, numbered where that day's mark is taken."""
    mark, number = f"gap {date}", 1
    while f"# {mark}:" in text:
        number += 1
        mark = f"gap {date} no. {number}"
    return mark


def _below_title(text: str, lines: list[str]) -> str:
    """Put comment lines below the comment that a file begins with."""
    newline = "\r\n" if "\r\n" in text else "\n"
    rows = text.split(newline)
    first = next((k for k, row in enumerate(rows) if not row.startswith("#")), 0)
    return newline.join([*rows[:first], *lines, *rows[first:]])


def _plain(text: str) -> str:
    """Return text that may stand in a comment: control characters have no place in TOML."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _refuse_other_profile(document: Mapping[str, Any], findings: Findings, origin: str, text: str) -> None:
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


def _refuse_damaged(findings: Findings) -> None:
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
    known_names = {*_PLACES, *_FORCE_CONSTANTS, *_LATCHES, *findings.refitted}
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
    if strange := [name for name in ("over", "acts_on", "knots", "values_n", "sds_n") if name not in unknown]:
        return f"lacks {strange[0]}"
    lists = [unknown[name] for name in ("knots", "values_n", "sds_n")]
    if not all(isinstance(one, list) and len(one) == KNOTS_COUNT and _are_numbers(one) for one in lists):
        return f"has not {KNOTS_COUNT} numbers in knots, values_n and sds_n"
    steps = [after - before for before, after in itertools.pairwise(lists[0])]
    return "" if 0.0 < max(steps) < (1.0 + _EVEN_RATIO) * min(steps) else "has knots at uneven steps"


def _are_numbers(values: list[Any]) -> bool:
    return all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) for value in values
    )


def _why_nothing(findings: Findings, left: list[str], candidates: bool) -> str:
    if left:
        return "nothing to write: " + "; ".join(left)
    found = len(findings.named) + len(findings.parameter_errors)
    if found and not candidates:
        return (
            f"nothing to write: none of {found} findings is confirmed; confirm by a new recording "
            "(`stagectl gap next`), or write candidates with --candidates"
        )
    return "nothing to write: the findings name nothing"
