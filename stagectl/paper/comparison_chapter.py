"""Section 6.2, Fig. 20 and 21: model against "rig" under one PID, and what makes gaps of the paper's size."""

from collections.abc import Mapping

import numpy as np

from stagectl.paper import references, twin
from stagectl.paper.figures import CORRECTED, PRINTED, THIRD, Curve, Panel, drawn
from stagectl.paper.references import Reference
from stagectl.paper.rows import Chapter, Row
from stagectl.paper.twin import DT_S, Followed, Servo, Strengths
from stagectl.report import Figure, Quantity

SOFT = Servo(macro_hz=2.0, micro_hz=10.0, macro_feed_forward_ratio=0.0)
STIFF = Servo(macro_hz=12.0, micro_hz=20.0, macro_feed_forward_ratio=1.0)

_PAPER_M = {"sine": 7.5e-6, "trapezoid": 10.2e-6}  # the largest of I and II
_SINE_SETTLED_S = 5.0
_CORNERS_S = (0.2, 0.1, 0.05)

HIDDEN: Mapping[str, Strengths] = {
    "a recording that lags by 0.1 ms": Strengths(record_lag_s=1e-4),
    "sensors that lag by 0.5 ms, in the loop": Strengths(sensor_lag_s=0.5e-3),
    "commands that act a cycle later": Strengths(delayed=True),
    "5 N of Coulomb friction on the macro": Strengths(coulomb_n=5.0),
    "3 N of cogging on the macro": Strengths(cogging_n=3.0),
    "a cable of 100 N/m on the end": Strengths(cable_n_per_m=100.0),
    "a voice coil constant 5 % up": Strengths(force_constant_error_ratio=0.05),
    "four times the damping in contact": Strengths(contact_damping_n_s_per_m=300.0),
    "a gap 6 % down and a stiffness 10 % up": Strengths(width_ratio=0.94, stiffness_ratio=1.1),
}
_REACTION = "the model without the voice coil's reaction, as (1) has it"


def paths() -> dict[str, tuple[Reference, Reference]]:
    """Return both forms of each reference, I and II."""
    return {
        "sine": (
            references.sine("sine I", 0.1, 0.75, 25.0, DT_S),
            references.sine("sine II", 0.05, 1.5, 12.5, DT_S),
        ),
        "trapezoid": (
            references.trapezoid("trapezoid I", 0.05, 2.0, _CORNERS_S, 9.0, DT_S),
            references.trapezoid("trapezoid II", 0.1, 2.0, _CORNERS_S, 9.0, DT_S),
        ),
    }


def gap_m(one: Followed, other: Followed) -> np.ndarray:
    """Return what is seen of the end on one stage minus the other, m; from where a sine's start is forgotten."""
    first = round(_SINE_SETTLED_S / DT_S) if one.reference.name.startswith("sine") else 0
    return (one.end_m - other.end_m)[first:]


def chapter() -> Chapter:
    """Work section 6.2 through."""
    rows: list[Row] = []
    soft: dict[tuple[str, str], Followed] = {}
    contact: list[float] = []
    for pair in paths().values():
        believed = {(which, r.name): twin.follow(r, which) for which in (SOFT, STIFF) for r in pair}
        unlike = {(which, r.name): twin.follow(r, which, Strengths(reaction_ratio=0.0)) for which, r in _both(pair)}
        contact += [100.0 * float(np.mean(believed[which, r.name].contact_n != 0.0)) for which, r in _both(pair)]
        for what, strengths in HIDDEN.items():
            rig = {(which, r.name): twin.follow(r, which, strengths) for which, r in _both(pair)}
            rows += [_row(r, what, None, peaks) for r, peaks in _peaks(pair, rig, believed)]
            soft |= {(what, r.name): rig[SOFT, r.name] for r in pair}
        rows += [_row(r, _REACTION, peaks, None) for r, peaks in _peaks(pair, believed, unlike)]
        soft |= {("believed", r.name): believed[SOFT, r.name] for r in pair}
        soft |= {(_REACTION, r.name): unlike[SOFT, r.name] for r in pair}
    soft_contact, stiff_contact = max(contact[0::2]), max(contact[1::2])
    return Chapter(
        "comparison",
        "6.2",
        "Model against rig under one PID, Fig. 20 and 21",
        rows,
        [_figure(soft)],
        [
            "No recording is published: the rig is a second simulation, the project's plant with one thing more "
            "than the "
            "believed one. Both follow the same reference under the same PID; a gap is the largest difference of what "
            "is seen of both ends.",
            "Sine I 0.1 m at 0.75 rad/s, II 0.05 m at 1.5 rad/s; trapezoid I 0.05 m/s, II 0.1 m/s. The "
            "paper's number is the largest of I and II; whose it is it doesn't say. The joint is that of section 6.1.",
            "The numbers are those of soft servos (macro 2 Hz, micro 10 Hz, no feed-forward), in contact up to "
            f"{soft_contact:.0f} % of the time; remarks have stiff ones (12 and 20 Hz, feed-forward, "
            f"{stiff_contact:.0f} "
            "% contact). The paper's servos are not printed.",
            "A gap of the paper's size proves no cause. Its size follows the servos, which are ours: where a "
            "number meets "
            "the paper's it is by chance. With stiff ones nearly everything hides below a micrometre.",
        ],
    )


def _both(pair: tuple[Reference, Reference]) -> list[tuple[Servo, Reference]]:
    return [(which, reference) for reference in pair for which in (SOFT, STIFF)]


def _peaks(
    pair: tuple[Reference, Reference],
    one: dict[tuple[Servo, str], Followed],
    other: dict[tuple[Servo, str], Followed],
) -> list[tuple[Reference, tuple[float, float]]]:
    """Return each reference with its largest gaps, with soft and with stiff servos, m."""

    def peak_m(which: Servo, r: Reference) -> float:
        return float(np.max(np.abs(gap_m(one[which, r.name], other[which, r.name]))))

    return [(r, (peak_m(SOFT, r), peak_m(STIFF, r))) for r in pair]


def _row(
    reference: Reference, what: str, printed: tuple[float, float] | None, corrected: tuple[float, float] | None
) -> Row:
    peaks = printed or corrected or (np.nan, np.nan)
    kind, _, which = reference.name.partition(" ")
    return Row(
        f"Fig. {20 if kind == 'sine' else 21}, {which}",
        f"{reference.name}: gap by {what}",
        "m",
        _PAPER_M[kind],
        printed[0] if printed else None,
        corrected[0] if corrected else None,
        f"stiff servos: {Quantity(peaks[1], 'm')}",
    )


def _figure(runs: dict[tuple[str, str], Followed]) -> Figure:
    panels = []
    record, damping = "a recording that lags by 0.1 ms", "four times the damping in contact"
    for name in ("sine I", "trapezoid II"):
        believed = runs["believed", name]
        t_s = believed.reference.t_s[-gap_m(believed, believed).size :]
        panels.append(
            Panel(
                "rig minus model (µm)",
                [
                    Curve("recording lags by 0.1 ms", t_s, 1e6 * gap_m(runs[record, name], believed), THIRD),
                    Curve("damping in contact", t_s, 1e6 * gap_m(runs[damping, name], believed), CORRECTED),
                    Curve("reaction missing in (1)", t_s, 1e6 * gap_m(believed, runs[_REACTION, name]), PRINTED),
                ],
                name,
            )
        )
    return Figure(
        "Gaps between model and rig (the paper's Fig. 20 and 21)",
        drawn(panels, "time (s)", share_x=False),
        "Soft servos. A lag of the recording shows all along a ramp; a missing reaction shows where the acceleration "
        "changes, as the paper's Fig. 21 does.",
        "Difference of model and rig over time for three causes.",
    )
