"""The page of a tuning, and its tables for the terminal."""

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
        Section("The rules", _rules(tuned.law)),
    ]
    return Report(title, verdict(tuned), parts=parts)


def verdict(tuned: Tuned) -> str:
    """Say in a sentence what the new gains bring."""
    before, after = tuned.before, tuned.after
    return (
        f"Greatest sensitivity {before.worst_sensitivity:.2f} to {after.worst_sensitivity:.2f}, delay margin "
        f"{before.least_delay_margin_s * 1e3:.2f} to {after.least_delay_margin_s * 1e3:.2f} ms, crossover "
        f"{before.crossover_hz:.0f} to {after.crossover_hz:.0f} Hz; a force of {STEP_N:g} N moves the end by "
        f"{after.step_peak_m * 1e9:.0f} nm (it was {before.step_peak_m * 1e9:.0f}). All from the identified model."
    )


def values_table(tuned: Tuned) -> Table:
    """Lay out the gains."""
    rows: list[list[str | Quantity]] = [[f"control.{key}", f"{value:g}"] for key, value in tuned.values.items()]
    return Table("Gains", ("key", "tuned"), rows)


def margins_table(tuned: Tuned) -> Table:
    """Lay out the margins before and after, at every place."""
    rows: list[list[str | Quantity]] = []
    for name, which in (("as it was", tuned.before), ("tuned", tuned.after)):
        rows += [
            [
                f"{name}, {one.place}",
                Quantity(one.margins.sensitivity_peak_ratio, "1") if one.margins.is_stable else "unstable",
                Quantity(one.margins.delay_margin_s, "s", prefix="m"),
                Quantity(one.margins.crossover_hz, "Hz"),
                Quantity(which.hold_m, "m", prefix="n") if one is which.loops[0] else "",
                Quantity(which.step_peak_m, "m", prefix="n") if one is which.loops[0] else "",
            ]
            for one in which.loops
        ]
    masses = "; ".join(
        f"{name}: {_mass(which)}" for name, which in (("as it was", tuned.before), ("tuned", tuned.after))
    )
    return Table(
        "Margins",
        ("loop", "Ms", "margin", "crossover", "hold", f"{STEP_N:g} N step"),
        rows,
        "Margin: by how much later a command may come. Hold: from the profile's sensor noise and torque step alone. "
        f"With the mass {100 * MASS_RATIO:.0f} % off, {masses}.",
    )


def _mass(which: Assessment) -> str:
    return "stable" if which.stable_with_other_mass else "unstable"


def _rules(law: str) -> list[str]:
    if law == "pid":
        return ["PID has one number, its bandwidth; gains follow from it as `stagectl/laws/pid.py` says."]
    return [
        "The law is fast: 8 % of the cycle rate, with eta and k twice that. It acts on a prediction, so that it adds "
        "little noise of its own.",
        "gamma is small: the sliding surface is damped, and its integral slow; what a steady force needs is the "
        "observer's to know.",
        "The filter decides: the drift that it allows an unknown force sets bandwidth and margin together, and is the "
        "number that was searched.",
    ]
