"""The page of `stagectl gap demo`: what was hidden, what was found, and what knowing it is worth. One HTML file.

Takes plain values; prints nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stagectl import figures
from stagectl.figures import ErrorTrace
from stagectl.gap import findings_figures
from stagectl.gap.findings import Findings, title_of
from stagectl.gap.prediction import Outcome
from stagectl.gap.residual import Residual
from stagectl.report import Figure, Quantity, Report, Section, Table


@dataclass(frozen=True, slots=True)
class Followed:
    """How the stage followed one move, shapes (n,): time since it began, reference, true error of the end."""

    t_s: np.ndarray
    reference_m: np.ndarray
    error_m: np.ndarray

    @property
    def rms_m(self) -> float:
        """Root mean square of the error; samples without truth are left out."""
        return float(np.sqrt(np.nanmean(self.error_m**2)))


@dataclass(frozen=True, slots=True)
class Closed:
    """The loop from a hidden effect to a better profile."""

    hidden: str
    findings: Findings
    residuals: Sequence[Residual]
    outcome: Outcome  # of the prediction that was made for the found effect
    confirming_move: str
    followed_move: str
    before: Followed
    after: Followed


def rows(closed: Closed) -> list[tuple[str, Quantity, Quantity]]:
    """Return the four numbers, each with what it is: gap and tracking error, before and after."""
    gap = closed.outcome
    return [
        ("gap", Quantity(gap.gap_before, gap.unit), Quantity(gap.gap_after, gap.unit)),
        ("tracking error, true, rms", Quantity(closed.before.rms_m, "m"), Quantity(closed.after.rms_m, "m")),
    ]


def page(closed: Closed, findings_page: str, files: Sequence[tuple[str, str]]) -> Report:
    """Make the page; `findings_page` lies beside it, `files` are (name, what it is)."""
    found = ", ".join(title_of(one.name, one.acts_on) for one in closed.findings.named)
    gap, error = rows(closed)
    ratio = closed.before.rms_m / closed.after.rms_m
    table = Table(
        "The loop closed",
        ("", "before", "after"),
        [gap, error],
        f"Gap: force left along the found effect on “{closed.confirming_move}”, the move that was predicted before it "
        f"was recorded, rms. Tracking error: true position of the end minus its reference on “{closed.followed_move}”, "
        "which no fit saw.",
    )
    return Report(
        "stagectl gap demo",
        f"One effect was hidden from the profile. {found} was found, confirmed by a prediction, added: it follows "
        f"{ratio:.1f} times closer. Recorded over the wire with the software rig in virtual time.",
        (table,),
        figures=_figures(closed),
        facts=(
            ("Hidden", closed.hidden),
            ("Found", found),
            ("Confirmed by", closed.confirming_move),
        ),
        sections=(Section("Files beside this page", [f"`{name}`: {what}" for name, what in files]),),
        links=((findings_page, "How it was found: the page of the search"),),
    )


def _figures(closed: Closed) -> list[Figure]:
    found, after = closed.findings, closed.after
    gap, error = rows(closed)
    held = [residual for residual in closed.residuals if residual.held_out]
    traces = [
        ErrorTrace(name, one.t_s, np.nan_to_num(one.error_m))
        for name, one in (("before", closed.before), ("after", after))
    ]
    return [
        Figure(
            f"Following “{closed.followed_move}” before and after",
            figures.tracking_figure(after.t_s, after.reference_m, traces),
            "The same move with the old profile and with the new one, whose feed-forward knows the effect.",
            f"Lines over time. The true error is {error[1]} rms before and {error[2]} after.",
        ),
        Figure(
            "The gap before and after",
            findings_figures.gap_figure(found.reducible_before, found.reducible_after, closed.residuals),
            "Left: how much of the reducible gap is left. Right: force that the model misses, in every recording.",
            f"Bars. On the move that confirmed it the gap fell from {gap[1]} to {gap[2]}.",
        ),
        Figure(
            "What the model misses on a run that no fit saw",
            findings_figures.time_figure(held),
            "Measured inertia force minus modelled forces, with the profile as it was and with what was found.",
            f"Lines over time, before and after, on “{closed.followed_move}”.",
        ),
    ]
