"""The page of a budget, and its tables for the terminal."""

import math
from collections.abc import Sequence

from stagectl.budget.budget import AGREEMENT_RATIO, MAX_SENSITIVITY, STEP_N, Budget, Part
from stagectl.budget.figures import bounds_figure, shares_figure, spectrum_figure
from stagectl.report import Figure, Quantity, Report, Section, Table

_LEAST_SAVED_RATIO = 0.005


def report(title: str, budget: Budget) -> Report:
    """Make the page."""
    parts: list[Table | Figure | Section] = []
    for part in budget.parts:
        parts += [
            shares_table(part),
            Figure(
                f"From which frequencies the error comes: {part.stretch.name}",
                spectrum_figure(part),
                "Areas are predicted and lie on one another; the full line is measured.",
            ),
            Figure(f"Shares: {part.stretch.name}", shares_figure(part)),
        ]
    parts += [
        bounds_table(budget),
        Figure(
            "How far the law is from the bound",
            bounds_figure(budget),
            "Bounds are those of a linear filter and regulator for this sensor, delay, force noise and torque step.",
        ),
        Section("What to improve next", advice(budget)),
        Section("How to read it", _explained(budget)),
    ]
    return Report(title, verdict(budget), parts=parts)


def verdict(budget: Budget) -> str:
    """Say in one or two sentences how good the law is and whether the prediction can be believed."""
    part = budget.parts[0]
    off = 100.0 * (part.ratio - 1.0)
    believed = (
        f"The sum of the sources is {part.spectra.rms_m * 1e9:.2f} nm, {abs(off):.1f} % "
        f"{'above' if off > 0 else 'below'} the measured {part.stretch.rms_m * 1e9:.2f} nm ({part.stretch.name})."
    )
    if not part.agrees:
        believed += f" That is more than {100 * AGREEMENT_RATIO:.0f} %: something is missing in the profile."
    if budget.is_force_noise_fitted:
        believed += " The force noise was fitted to this run, so that the sum says little."
    bound = budget.bounds.hold.true_rms_m
    over = budget.hold_m / bound
    said = f"{believed} Least hold possible here: {bound * 1e9:.2f} nm; {budget.law} is {over:.2f} x that"
    as_stiff = budget.bounds.as_stiff
    if as_stiff is None:
        return f"{said}, and stiffer than any linear loop with a sensitivity of {MAX_SENSITIVITY:g}."
    return f"{said}, and {budget.hold_m / as_stiff.true_rms_m:.2f} x the best that is as stiff."


def shares_table(part: Part) -> Table:
    """Lay out the sources of one stretch; their own measured column is there where they could be switched off."""
    total = sum(share.predicted_m2 for share in part.shares)
    rows: list[list[str | Quantity]] = [
        [
            share.source,
            _signed(share.predicted_m2),
            Quantity(100.0 * share.predicted_m2 / total if total > 0.0 else math.nan, "%", digits=2),
            "" if share.measured_m2 is None else _signed(share.measured_m2),
        ]
        for share in part.shares
    ]
    rows.append(["all together", _rms(part.spectra.rms_m), Quantity(100.0, "%"), _rms(part.stretch.rms_m)])
    kind = "true end position" if part.stretch.is_true else "as the interferometer measures it"
    note = f"Root mean squares of the {kind}; their squares add up, and a minus marks power that is taken away."
    if any(share.measured_m2 is not None for share in part.shares):
        note += " Measured: what the simulated error loses when that one source is switched off."
    return Table(f"Error budget: {part.stretch.name}", ("source", "predicted", "of the power", "measured"), rows, note)


def bounds_table(budget: Budget) -> Table:
    """Lay out the law beside what is possible."""
    bounds = budget.bounds
    law = budget.margins
    rows = [
        (budget.law, budget.hold_m, law.sensitivity_peak_ratio, law.delay_margin_s, budget.step_peak_m),
        *(
            (name, hold.true_rms_m, hold.robustness.max_sensitivity, hold.robustness.delay_margin_s, peak)
            for name, hold, peak in (
                ("least hold", bounds.hold, None),
                (f"best, Ms <= {MAX_SENSITIVITY:g}", bounds.robust, None),
                (f"as stiff, Ms <= {MAX_SENSITIVITY:g}", bounds.as_stiff, budget.step_peak_m),
                (f"stiffest, Ms <= {MAX_SENSITIVITY:g}", bounds.stiff, bounds.stiff_step_peak_m),
            )
            if hold is not None
        ),
    ]
    return Table(
        "Distance to the bound",
        ("loop", "hold", "x bound", "Ms", "delay margin", f"{STEP_N:g} N step"),
        [
            [
                name,
                _rms(hold_m),
                Quantity(hold_m / bounds.hold.true_rms_m, "1"),
                Quantity(ms, "1"),
                Quantity(margin_s, "s", prefix="m"),
                Quantity(peak_m, "m", prefix="n"),
            ]
            for name, hold_m, ms, margin_s, peak_m in rows
        ],
        f"Hold in root mean square; the last column is the peak after a step of force. LQG for "
        f"{bounds.around.delay_s * 1e3:.3g} ms from sample to force, {bounds.around.sensor_noise_m * 1e9:.3g} nm of "
        f"sensor noise, {bounds.around.force_noise_n * 1e3:.3g} mN of force noise, steps of "
        f"{bounds.around.torque_step_n:.3g} N. The least hold is that of a loop that forces move far; what a loop "
        "gains against forces it pays in hold. As stiff: the best found over all weights that a force moves no more "
        "than it moves the law. Hold and step of the law are those at rest; its Ms and delay margin are those of the "
        "stiffer loop that it is where a force moves the end.",
    )


def advice(budget: Budget) -> list[str]:
    """Say what would help, the most first, and what would not."""
    said = [
        f"{lever.what}: hold {budget.hold_m * 1e9:.2f} to {lever.hold_m * 1e9:.2f} nm "
        f"({lever.saved_m * 1e9:.2f} nm less)."
        for lever in budget.levers
        if lever.saved_m > _LEAST_SAVED_RATIO * budget.hold_m
    ]
    said = [one[0].upper() + one[1:] for one in said]
    idle = [
        lever.what.partition(" (")[0] for lever in budget.levers if lever.saved_m <= _LEAST_SAVED_RATIO * budget.hold_m
    ]
    if idle:
        said.append(f"No use now: {'; '.join(idle)}.")
    ms = budget.margins.sensitivity_peak_ratio
    if ms > MAX_SENSITIVITY:
        said.append(
            f"First of all: the greatest sensitivity is {ms:.2f}, above {MAX_SENSITIVITY:g}; `stagectl tune` finds "
            "gains that keep a margin."
        )
    return said


def _explained(budget: Budget) -> Sequence[str]:
    said = [
        "Sensor noise, torque step and force noise are what they would be if the force followed its sample at once; "
        "delay is what all of them gain because it does not.",
        "Model error is what the noises gain because the machine is not quite the believed one, and the forces that "
        "the profile lacks; cogging and contact are those of them that repeat with position or come from the joint.",
        "A source that is switched off takes others along: without any sensor noise the torque word stands still, and "
        "its share goes too. So measured shares need not add up; the sum that counts is the last row. A measured share "
        "of a few per cent of the power is chance: no two recordings of this length agree better.",
        "A hold is not disturbed by cogging, nor by contact in the gap: give a run to see them.",
    ]
    if budget.is_force_noise_fitted:
        said.append(
            "A real stage states no force noise: what stands here is what its own spectrum shows between 5 and 60 Hz."
        )
    return said


def _rms(value_m: float) -> Quantity:
    return Quantity(value_m, "m", prefix="n")


def _signed(power_m2: float) -> Quantity:
    return Quantity(math.copysign(math.sqrt(abs(power_m2)), power_m2), "m", prefix="n")
