"""The page of a tuning, and its tables for the terminal."""

import math

from stagectl.budget.budget import STEP_N
from stagectl.report import Figure, Quantity, Report, Section, Table
from stagectl.tuning.figures import gain_figure, sensitivity_figure
from stagectl.tuning.rules import MASS_RATIO, Asked, Assessment, Tuned


def report(title: str, tuned: Tuned, asked: Asked) -> Report:
    """Make the page."""
    parts: list[Table | Figure | Section] = [
        values_table(tuned),
        margins_table(tuned),
        Figure("Loop gain in the gap", gain_figure(tuned), "Broken at the command of the axis that carries the end."),
        Figure("Sensitivity", sensitivity_figure(tuned, asked), "What the loop makes of a disturbance: 1 = nothing."),
        Section("The rules", _rules(tuned)),
    ]
    return Report(title, verdict(tuned), parts=parts)


def verdict(tuned: Tuned) -> str:
    """Say in a sentence or two what the new gains bring."""
    before, after = tuned.before, tuned.after
    if not math.isfinite(before.worst_sensitivity):
        was, moved = "The gains as they were are unstable. ", ""
    else:
        was, moved = "", f" (it was {before.step_peak_m * 1e9:.0f})"
    return (
        f"{was}Greatest sensitivity {_from(before, before.worst_sensitivity)}{after.worst_sensitivity:.2f}, delay "
        f"margin {_from(before, before.least_delay_margin_s * 1e3)}{after.least_delay_margin_s * 1e3:.2f} ms, "
        f"crossover {_from(before, before.crossover_hz)}{after.crossover_hz:.3g} Hz; a force of {STEP_N:g} N moves "
        f"the end by {after.step_peak_m * 1e9:.0f} nm{moved}. All from the identified model."
    )


def _from(before: Assessment, value: float) -> str:
    return f"{value:.3g} to " if math.isfinite(before.worst_sensitivity) else ""


def values_table(tuned: Tuned) -> Table:
    """Lay out the gains."""
    rows: list[list[str | Quantity]] = [
        [f"control.{key}", f"{tuned.old_values[key]:g}", f"{value:g}"] for key, value in tuned.values.items()
    ]
    return Table("Gains", ("key", "was", "tuned"), rows)


def margins_table(tuned: Tuned) -> Table:
    """Lay out the margins before and after, at every place."""
    rows: list[list[str | Quantity]] = []
    for name, which in (("was", tuned.before), ("tuned", tuned.after)):
        rows += [
            [
                f"{name}: {one.place}",
                Quantity(one.margins.sensitivity_peak_ratio, "1") if one.margins.is_stable else "unstable",
                Quantity(one.margins.delay_margin_s, "s", prefix="m"),
                Quantity(one.margins.crossover_hz, "Hz"),
                Quantity(which.hold_m, "m", prefix="n") if one is which.loops[0] else "",
                Quantity(which.step_peak_m, "m", prefix="n") if one is which.loops[0] else "",
            ]
            for one in which.loops
        ]
    masses = "; ".join(f"{name} {_mass(which)}" for name, which in (("was", tuned.before), ("tuned", tuned.after)))
    return Table(
        "Margins",
        ("loop", "Ms", "margin", "crossover", "hold", f"{STEP_N:g} N step"),
        rows,
        "Margin: by how much later a command may come. Hold: from the profile's sensor noise and torque step alone. "
        f"With the mass {100 * MASS_RATIO:.0f} % off, {masses}.",
    )


def _mass(which: Assessment) -> str:
    return "stable" if which.stable_with_other_mass else "unstable"


def _rules(tuned: Tuned) -> list[str]:
    if tuned.law == "pid":
        return ["PID has one number, its bandwidth; gains follow from it as `stagectl/laws/pid.py` says."]
    said = [
        "One end of the loop is fast, the other sets the margin: the law is as fast as the cycle allows, k / m at 0.18 "
        "and eta at 0.163 of its rate.",
        "With w the bandwidth, the integral is at w / 8 and the observer's poles at 2 w / 3, by the density of the "
        "force that it reckons with.",
        "The bandwidth is the number that was searched; its margins hold up to the adaptive gain's ceiling (adapted).",
    ]
    if tuned.values.get("notch_frequency_hz", 0.0) > 0.0:
        said.append(
            "The notch is in what the observer learns from the sensor, not in the command. Of several widths and "
            "depths it is the one that leaves the greatest bandwidth, wherever within its bounds the mode is."
        )
    return said
