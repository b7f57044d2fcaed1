"""The page of findings: what is missing, how sure that is, what it closes, and how to go on. One HTML file.

Takes findings and residual forces; prints nothing.
"""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stagectl.gap import findings_figures
from stagectl.gap.findings import Findings, Named, ParameterError
from stagectl.gap.residual import Residual
from stagectl.report import Figure, Quantity, Report, Section, Table, rounded
from stagectl.units import unit_of

_NORMAL_95 = 1.96
_RUNS_SHOWN = 8
_EDGES = ("left_m", "right_m", "backlash_width_m")
_NO_BREAK = "\u00a0"

VERDICTS = {
    "nothing": "Nothing is missing that these recordings could show.",
    "found": "Candidates: each gains on the recordings it was fitted on and on recordings that no fit saw.",
    "unknown": "Something repeats that no effect of the library explains; its curve is in the findings.",
}


def verdict_of(findings: Findings) -> str:
    """Say in one or two sentences what the recordings show."""
    names = ", ".join(f"{effect.name} on {effect.acts_on}" for effect in findings.named)
    said = VERDICTS[findings.verdict]
    if findings.verdict == "found":
        state = "" if any(effect.confirmed for effect in findings.named) else " None is confirmed yet."
        return f"{names}. {said}{state}"
    if findings.verdict == "unknown":
        beside = ", ".join(f"{name} on {place}" for name, place in (findings.unknown or {}).get("beside", ()))
        return f"{said} No name is stated; {beside} would explain a part." if beside else said
    if findings.verdict == "nothing" and findings.parameter_errors:
        return f"{said} Known parameters are wrong: {', '.join(wrong.name for wrong in findings.parameter_errors)}."
    return said


def page(
    findings: Findings,
    residuals: Sequence[Residual],
    ladder: Sequence[dict[str, float | str]],
    *,
    profile: str,
    file: Path,
    seed: int,
) -> Report:
    """Make the page; `ladder` has the rungs of the simulated closed loop, none where no controller is known."""
    return Report(
        title=f"The gap of {findings.profile}",
        banner=verdict_of(findings),
        facts=_facts(findings, seed),
        tables=_tables(findings, residuals, ladder),
        figures=_figures(findings, residuals),
        sections=_sections(findings, profile, file),
    )


def summary(residuals: Sequence[Residual]) -> list[dict[str, Any]]:
    """Return the residual force of every body in every recording as plain numbers, for --json."""
    return [
        {
            "run": r.run,
            "axis": r.axis,
            "held_out": r.held_out,
            "band_hz": r.band_hz,
            "before_n": r.before_rms_n,
            "after_n": r.after_rms_n,
            "floor_n": r.floor_rms_n,
            "sensor_n": r.sensor_rms_n,
            "counted_ratio": float(r.counted.mean()),
        }
        for r in residuals
    ]


def _facts(findings: Findings, seed: int) -> list[tuple[str, str]]:
    held = ", ".join(Path(run).name for run in findings.holdout) or "none apart: each training run is held out once"
    return [
        ("Profile", findings.profile),
        *([("Profile's hash", findings.profile_sha256[:12])] if findings.profile_sha256 else []),
        ("Training runs", ", ".join(Path(run).name for run in findings.runs)),
        ("Held-out runs", held),
        ("Seed", str(seed)),
        ("Threshold of the gain", rounded(findings.threshold, 3)),
    ]


# ---- tables -----------------------------------------------------------------------------------------------------


def _tables(findings: Findings, residuals: Sequence[Residual], ladder: Sequence[dict[str, float | str]]) -> list[Table]:
    made = []
    if findings.named:
        made.append(_candidates_table(findings.named))
        if any(effect.aliases for effect in findings.named):
            made.append(_alias_table(findings.named))
    if findings.parameter_errors:
        made.append(_parameter_table(findings.parameter_errors))
    made += [_gap_table(findings), _force_table(residuals, findings.unknown is not None)]
    if ladder:
        made.append(_ladder_table(ladder))
    return made


def _candidates_table(named: Sequence[Named]) -> Table:
    rows: list[list[str | Quantity]] = []
    for effect in named:
        head = [
            f"{effect.name}{'' if effect.confirmed else ' (candidate)'}",
            effect.acts_on,
            _grouped(effect.gain),
            _grouped(effect.held_out_gain),
        ]
        for number, (name, value) in enumerate(effect.parameters.items()):
            name_and_place = _readable(name)
            cells = head if number == 0 else ["", "", "", ""]
            rows.append([cells[0], cells[1], name_and_place, _interval(name, value, effect.sds.get(name)), *cells[2:]])
    note = (
        "Values with 95 % intervals, fitted on all runs once the choice was made. Without an interval: searched on a "
        "grid or in the spectrum, not fitted. A gain is twice the log-likelihood ratio; beyond its threshold one in a "
        "hundred data sets without any effect would show one."
    )
    return Table("Missing effects", ["Effect", "Acts on", "Parameter", "Value", "Gain", "Gain, held-out"], rows, note)


def _alias_table(named: Sequence[Named]) -> Table:
    rows: list[list[str | Quantity]] = [
        [effect.name if number == 0 else "", f"{name} on {place}", _margin(margin)]
        for effect in named
        for number, (name, place, margin) in enumerate(effect.aliases)
    ]
    note = (
        "These runs can't tell the effect from what stands beside it. Margin: by how much the other's gain on all runs "
        "is lower than that of the effect."
    )
    return Table("As well possible", ["Effect", "Instead", "Margin"], rows, note)


def _margin(margin: float) -> str:
    return f"{_grouped(-margin)} higher" if margin < 0.0 else _grouped(margin)


def _grouped(value: float) -> str:
    """Round to three digits, thousands apart."""
    if not abs(value) >= 1e4:
        return rounded(value, 3)
    return f"{float(f'{value:.2e}'):,.0f}".replace(",", "\u202f").replace("-", "\u2212")


def _parameter_table(errors: Sequence[ParameterError]) -> Table:
    rows: list[list[str | Quantity]] = [
        [
            f"{wrong.name}{'' if wrong.confirmed else ' (candidate)'}",
            _error_text(wrong.name, wrong.error, wrong.sd),
            _error_text(wrong.name, wrong.stated_sd),
            ", ".join(wrong.aliases) or "–",
        ]
        for wrong in errors
    ]
    note = "Known parameters that the runs contradict, beyond what the profile states of their uncertainty."
    return Table("Parameter errors", ["Parameter", "Off by", "Stated, 1 sd", "Or instead"], rows, note)


def _error_text(name: str, error: float, sd: float | None = None) -> str:
    """Say an error: metres for an edge and seconds for a time, else a share of the parameter."""
    unit = "m" if name in _EDGES else "s" if name.endswith(("_latch_s", "_current_loop_s")) else "%"
    scale = 100.0 if unit == "%" else 1.0
    if sd is None:
        return str(Quantity(scale * error, unit, 2)).replace(" ", _NO_BREAK)
    return _valued(scale * error, scale * sd, unit)


def _gap_table(findings: Findings) -> Table:
    rows: list[list[str | Quantity]] = []
    for name, before, after, sd in zip(
        ("training runs", "held-out runs"),
        findings.reducible_before,
        findings.reducible_after,
        findings.reducible_sds,
        strict=True,
    ):
        closed = f"{rounded(100.0 * (1.0 - after / before), 3)} %" if before > 0.0 else "nothing to close"
        rows.append([name, _grouped(before), _grouped(after), f"+- {_grouped(sd)}", closed])
    note = (
        "What is above the floor, in squares of the noise; 0 is the floor itself. Before: known parameters refitted, "
        "nothing named. On held-out runs every structural value is the one that the training runs gave; where no run "
        "was kept apart each is held out once, but for one that alone touches a side of the joint."
    )
    if findings.unknown is not None:
        note += " After: with what would explain a part, though it is not stated as a name."
    return Table("Reducible gap", ["", "before", "after", "floor", "closed"], rows, note)


def _force_table(residuals: Sequence[Residual], unknown: bool) -> Table:
    rows: list[list[str | Quantity]] = []
    for r in residuals:
        floor = r.floor_rms_n
        rows.append(
            [
                Path(r.run).name,
                r.axis,
                "held-out" if r.held_out else "training",
                Quantity(r.before_rms_n, "N"),
                Quantity(r.after_rms_n, "N"),
                Quantity(floor, "N") if math.isfinite(floor) else Quantity(None, "N"),
                Quantity(r.sensor_rms_n, "N"),
                Quantity(r.band_hz, "Hz"),
            ]
        )
    note = (
        "Measured inertia force minus modelled forces, rms, in a band in which the sensor's noise makes 50 mN. "
        "Before: the profile as it is. After: with the named effects, and known parameters as refitted. Floor: scatter "
        "from lap to lap, where the reference repeats. Standstill and reversals are left out of a run that moves."
    )
    if unknown:
        note += " Nothing is named here: after has the known parameters alone."
    columns = ["Run", "Body", "", "before", "after", "floor", "sensor noise", "band"]
    return Table("Residual force", columns, rows, note)


def _ladder_table(ladder: Sequence[dict[str, float | str]]) -> Table:
    rows: list[list[str | Quantity]] = [
        [
            Path(str(rung["run"])).name,
            str(rung["with"]),
            Quantity(float(rung["command_n"]), "N"),
            Quantity(float(rung["command_floor_n"]), "N"),
            Quantity(float(rung["position_m"]), "m"),
            Quantity(float(rung["position_floor_m"]), "m"),
        ]
        for rung in ladder
    ]
    note = "The machine under its own controller, simulated along the recorded reference, minus what was measured; rms."
    columns = ["Run", "with", "force gap", "floor", "position gap", "floor"]
    return Table("Closed loop, simulated", columns, rows, note)


def _readable(name: str) -> str:
    parameter, of, place = name.partition(" of ")
    return f"{parameter}, {place}" if of else parameter


def _interval(name: str, value: float, sd: float | None) -> str:
    unit = unit_of(name.partition(" of ")[0]) or "1"
    return _valued(value, sd, {"s^2": "s²", "m/s^2": "m/s²"}.get(unit, unit))


def _valued(value: float, sd: float | None, unit: str) -> str:
    """Say a value with its 95 % half width, both with one prefix and no more digits than the half width leaves."""
    if sd is None or not (math.isfinite(sd) and sd > 0.0):
        return str(Quantity(value, unit, 4)).replace(" ", _NO_BREAK)
    half = _NORMAL_95 * sd
    largest = max(abs(value), half)
    number, _, symbol = str(Quantity(largest, unit)).partition(" ")
    scale = 10.0 ** (3 * round(math.log10(float(number) / largest) / 3.0))
    decimals = max(1 - math.floor(math.log10(half * scale)), 0)
    words = [f"{value * scale:.{decimals}f}".replace("-", "\u2212"), "±", f"{half * scale:.{decimals}f}"]
    return _NO_BREAK.join([*words, *([symbol] if symbol else [])])


# ---- figures ----------------------------------------------------------------------------------------------------


def _figures(findings: Findings, residuals: Sequence[Residual]) -> list[Figure]:
    axes = list(dict.fromkeys(r.axis for r in residuals))
    drawn = findings_figures.gap_figure(findings.reducible_before, findings.reducible_after, residuals)
    made = [
        Figure(
            "Before and after",
            drawn,
            "Left: how much of the reducible gap is left. Right: the residual force; the thin line is the floor, from "
            "lap to lap, or from the sensor's noise where no lap repeats.",
            _gap_words(findings, residuals),
        )
    ]
    if findings.unknown is not None and "knots" in findings.unknown:
        where = f"over {findings.unknown['over']} at {findings.unknown['acts_on']}"
        shown = _CURVES[findings_figures.curve_of(findings.unknown)]
        made.append(
            Figure(
                "What no effect explains",
                findings_figures.unknown_figure(findings.unknown),
                f"{shown}, {where}, with its 95 % band. It has no name; a table of it never counts as one.",
                f"Curve {where}: {_range_words(findings.unknown['values'], findings.unknown['unit'])}.",
            )
        )
    for axis in axes:
        of_axis = [r for r in residuals if r.axis == axis]
        made += _axis_figures(axis, of_axis)
    return made


def _axis_figures(axis: str, residuals: Sequence[Residual]) -> list[Figure]:
    words = _force_words(residuals)
    shown = _some(residuals)
    caption = "What the model's forces miss, run by run."
    if len(shown) < len(residuals):
        caption += f" {len(shown)} of {len(residuals)} runs are shown."
    return [
        Figure(
            f"The {axis}'s residual force over time",
            findings_figures.time_figure(shown),
            caption,
            f"Lines over time, one panel a run. {words}",
        ),
        Figure(
            f"The {axis}'s residual force over position and velocity",
            findings_figures.place_figure(residuals),
            "Means of all runs of one kind in bins, both directions of motion together; passes are counted as one "
            "measurement each, so the band says what would repeat. Standstill and reversals are left out: the sign of "
            "the velocity is not known there.",
            f"Means with bands over position and over velocity. {words}",
        ),
        Figure(
            f"The {axis}'s residual force over frequency",
            findings_figures.frequency_figure(residuals),
            "Welch spectra, segments of 2 s, not low-passed. Where before and after meet the dashed line nothing is "
            "left but the sensor's noise.",
            f"Spectra before and after, and the floor. {words}",
        ),
    ]


def _some(residuals: Sequence[Residual]) -> list[Residual]:
    """Return so many runs as a figure can hold, held-out ones among them."""
    held = [r for r in residuals if r.held_out][: _RUNS_SHOWN // 2]
    training = [r for r in residuals if not r.held_out][: _RUNS_SHOWN - len(held)]
    return [*training, *held]


def _gap_words(findings: Findings, residuals: Sequence[Residual]) -> str:
    parts = []
    for name, before, after in zip(
        ("training", "held-out"), findings.reducible_before, findings.reducible_after, strict=True
    ):
        left = f"{rounded(100.0 * after / before, 3)} % is left" if before > 0.0 else "nothing was above the floor"
        parts.append(f"on {name} runs {left}")
    bodies = [f"{axis}: {_force_words([r for r in residuals if r.axis == axis])}" for axis in _axes(residuals)]
    return f"Bars. Reducible gap: {'; '.join(parts)}. Residual force, {' '.join(bodies)}"


def _axes(residuals: Sequence[Residual]) -> list[str]:
    return list(dict.fromkeys(r.axis for r in residuals))


def _force_words(residuals: Sequence[Residual]) -> str:
    said = []
    for name, held_out in (("training", False), ("held-out", True)):
        of_side = [r for r in residuals if r.held_out is held_out]
        if of_side:
            before = math.sqrt(sum(r.before_rms_n**2 for r in of_side) / len(of_side))
            after = math.sqrt(sum(r.after_rms_n**2 for r in of_side) / len(of_side))
            said.append(f"{name} runs {Quantity(before, 'N')} rms before, {Quantity(after, 'N')} after")
    return "; ".join(said) + "."


_CURVES = {
    "N": "The force that repeats on runs that no fit saw",
    "m": "What the sensor reads too much in all runs",
    "edge": "By how much both of the joint's edges lie further out than where it first touched",
    "centre": "By how much the joint lies further to the right than where it first touched",
    "ratio": "What the body feels of its motor's force of so long ago, beyond what is known of its drive",
    "spread": "How far the late reading is spread out over time, or not where it lags: 1 is a lag in a delay's place",
}
"""What a curve shows, by what it is of."""


def _range_words(values: Sequence[float], unit: str) -> str:
    if unit == "ratio":
        return f"from {min(values):.3g} to {max(values):.3g}"
    return f"from {Quantity(min(values), unit)} to {Quantity(max(values), unit)}"


# ---- sentences --------------------------------------------------------------------------------------------------


def _sections(findings: Findings, profile: str, file: Path) -> list[Section]:
    made = [Section("How to go on", _next_steps(findings, profile, file))]
    if findings.not_excited:
        made.append(
            Section(
                "Not excited",
                [f"These runs say nothing of: {', '.join(findings.not_excited)}."],
            )
        )
    if findings.not_separable:
        made.append(Section("What these runs can't tell apart", [f"{text}." for text in findings.not_separable]))
    if findings.remarks:
        made.append(Section("Remarks", list(findings.remarks)))
    return made


def _next_steps(findings: Findings, profile: str, file: Path) -> list[str]:
    steps = []
    if findings.named or findings.unknown is not None or findings.not_excited:
        steps.append(
            f"`stagectl gap next {shlex.quote(str(file))}` says which move would confirm the candidates, and tell "
            "apart what can't be told apart here."
        )
    if findings.named:
        new = Path(profile).stem + "-2.toml"
        steps.append(
            f"`stagectl gap apply {shlex.quote(profile)} {shlex.quote(str(file))} -o {shlex.quote(new)} --candidates` "
            "writes a new profile with the values above, marked as candidates."
        )
    if findings.parameter_errors:
        steps.append(f"Check {', '.join(wrong.name for wrong in findings.parameter_errors)} in the profile.")
    if findings.verdict == "nothing":
        steps.append("Record other speeds, loads and places to see what these runs do not excite.")
    return steps
