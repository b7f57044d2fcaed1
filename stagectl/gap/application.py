"""Findings written into the text of a profile: text in, text out, comments and order kept.

Every written value carries a comment with its 95 % interval; one line on top says from which runs. Pure.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from stagectl.effects import CATALOGUE
from stagectl.effects.table import TABLES
from stagectl.errors import ProfileError, RequestError
from stagectl.gap.applicable import is_tabled, origin_of, refuse_damaged, refuse_other_profile
from stagectl.gap.findings import SIGMAS, Findings, Named
from stagectl.gap.parameter_application import parameters_of_keys, write_parameter, write_refitted
from stagectl.gap.profile_sheet import Change, Sheet, below_title, mark_of, plain
from stagectl.gap.session_values import values_of


@dataclass(frozen=True, slots=True)
class Application:
    """A profile's new text, what changed in it, and what was found and not written, each with its reason."""

    text: str
    changes: tuple[Change, ...]
    left: tuple[str, ...]


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
    refuse_damaged(findings)
    refuse_other_profile(document, findings, origin_of(findings), document_text)
    sheet = Sheet(document, mark_of(document_text, date))
    targets = (*findings.named, *findings.parameter_errors)
    whole = bool(targets) and all(target.confirmed for target in targets)
    for effect in findings.named:
        if effect.confirmed or candidates:
            _write_effect(sheet, effect)
    for error in parameters_of_keys(sheet, findings):
        if error.confirmed or candidates:
            write_parameter(sheet, error)
        else:
            sheet.left.append(f"{error.name} is off by {error.error:.3g}, not confirmed: --candidates writes it")
    # what was fitted together holds together: a prediction that held was that of the whole model
    write_refitted(sheet, findings, whole, candidates)
    if findings.unknown is not None:
        if candidates:
            _write_table(sheet, findings.unknown)
        else:
            sheet.left.append(
                f"the unknown curve over {findings.unknown['over']}: a table is written with --candidates"
            )
    if not sheet.written:
        raise RequestError(_why_nothing(findings, sheet.left, candidates))
    top = f"# {sheet.mark}: values so marked are from `stagectl gap`, {origin_of(findings)}; intervals are 95 %."
    lines = [plain(top), *(plain(f"# {note}") for note in sheet.notes)]
    return Application(below_title(tomlkit.dumps(document), lines), tuple(sheet.written), tuple(sheet.left))


def _write_effect(sheet: Sheet, effect: Named) -> None:
    """Write one found effect; one that holds for one recording only has no place in a profile."""
    known = CATALOGUE[effect.name]
    title = f"{effect.name} on {effect.acts_on}"
    if own := [name for name, tag in known.tags.items() if tag == "run"]:
        sheet.left.append(f"{title}: its {own[0]} is another one in each run, a profile can't hold it")
        return
    values = values_of(effect)
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


def _write_table(sheet: Sheet, unknown: Mapping[str, Any]) -> None:
    """Write the curve of an unknown force as a table; it names nothing."""
    over = unknown["over"]
    if not is_tabled(unknown):
        why = "it is of one recording, a profile can't hold it" if over == "t_s" else "no table of a profile goes by it"
        sheet.left.append(f"the unknown curve over {over}: {why}")
        return
    knots = unknown["knots"]
    step = (knots[-1] - knots[0]) / (len(knots) - 1)
    name = next(table for table, quantity in TABLES.items() if quantity == over)
    known = CATALOGUE[name]
    values = [(knots[0], None), (step, None)]
    values += [(v, SIGMAS * sd) for v, sd in zip(unknown["values"], unknown["sds"], strict=True)]
    key, table = sheet.add_effect(f"{sheet.mark}: unknown, a table of its curve and no name; not confirmed")
    table["name"] = name
    table["acts_on"] = unknown["acts_on"]
    for parameter, (value, half_width) in zip(known.parameters, values, strict=True):
        sheet.set(table, parameter, Change(f"{key}.{parameter}", value, None, half_width, confirmed=False))


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
