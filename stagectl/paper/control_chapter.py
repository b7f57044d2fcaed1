"""Section 5.3: cases A and B on sine and trapezoid, as printed, against a fair PID and against the corrected law."""

import numpy as np

from stagectl.paper import cases
from stagectl.paper.cases import SETTLED_S, stable_range_m
from stagectl.paper.closed_loop import Run
from stagectl.paper.figures import CORRECTED, FOURTH, PRINTED, REFERENCE, Curve, Panel, drawn
from stagectl.paper.printed_values import MICRO_SUPPLY_V
from stagectl.paper.rows import Chapter, Row, pair
from stagectl.report import Figure

_NEAR_ZERO_RATIO = 0.01  # of the stroke: an error relative to less is no number

# Errors in m: case A, then case B; average positioning errors in percent; reductions of the largest error.
_PAPER_RANGE_M = {
    ("sine", "A"): (-12e-3, 11e-3),
    ("trapezoid", "A"): (-12e-3, 10e-3),
    ("sine", "B"): (-18e-6, 22e-6),
    ("trapezoid", "B"): (-17e-6, 19e-6),
}
_PAPER_AVERAGE_PERCENT = {
    ("sine", "A"): 6.7,
    ("trapezoid", "A"): 7.9,
    ("sine", "B"): 0.015,
    ("trapezoid", "B"): 0.018,
}
_PAPER_REDUCTION_PERCENT = {"sine": 99.7, "trapezoid": 99.6}
_NUMBER = {"A": "15", "B": "16"}


def chapter() -> Chapter:
    """Work section 5.3 through."""
    rows: list[Row] = []
    figures: list[Figure] = []
    for name in cases.REFERENCES:
        weak, fair = cases.printed_pid(name), cases.fair_pid(name)
        printed, ideal = (cases.printed_sliding(name, ideal=which) for which in (False, True))
        corrected = cases.corrected_sliding(name)
        rows += _case_rows(
            name,
            "A",
            "PID",
            weak,
            fair,
            "as printed P_w = 0.4 V/m is no control: the micro is dragged; "
            "corrected: a triple pole at 10 Hz, no compensation (A')",
        )
        rows += _case_rows(
            name, "B", "DSMC", printed, corrected, "as printed at 1 ms with L_w = 2.52 mH, which (29) leaves out"
        )
        rows += _range_rows(name, "B", "DSMC without L_w, at 50 us", ideal, None, "the artefact of y(e): about 3/4 phi")
        if name == "sine":
            rows.append(_rest_row())
        rows.append(_reduction_row(name, weak, fair, ideal, corrected))
        figures += [_figure(name, "A", weak, fair), _figure(name, "B", ideal, corrected)]
    return Chapter(
        "control",
        "5.3",
        "Cases A and B, Fig. 15 and 16",
        rows,
        figures,
        [
            "Same platform for all: 7.5 mm of gap to each side, K2 = 500 N/m, voltage drives, macro servo of 8 Hz with "
            "feed-forward; P_h is a gain on its position command. Positions and velocities are known as they are.",
            "As printed means the corrected platform under the printed law: (2) and (5) as printed are shown "
            "in their own "
            "chapters.",
            "The stage begins on the reference unless said: x_ref1 begins at 0.375 m/s.",
            "x_ref2 is printed as a picture: 1 s rest, 0.8 m at 0.2 m/s with corners of 0.33 m/s², 4 s rest, and back.",
            "Average positioning error: mean |e / d_r| where |d_r| is above 1 % of its peak; the paper "
            "doesn't define it.",
            "Supplies are not printed: 300 V and 48 V. The joint is damped with 300 N s/m.",
        ],
    )


# ---- rows ---------------------------------------------------------------------------------------------------------


def _range_rows(name: str, case: str, label: str, printed: Run, corrected: Run | None, remark: str) -> list[Row]:
    ours = stable_range_m(printed)
    better = (None, None) if corrected is None else stable_range_m(corrected)
    figure, paper = f"Fig. {_NUMBER[case]}, {case}", _PAPER_RANGE_M[name, case]
    return [
        Row(figure, f"{name}: {label}: {which} error", "m", paper[k], ours[k], better[k], remark if k == 0 else "")
        for k, which in enumerate(("least", "greatest"))
    ]


def _case_rows(name: str, case: str, label: str, printed: Run, corrected: Run, remark: str) -> list[Row]:
    figure = f"Fig. {_NUMBER[case]}, {case}"
    return [
        *_range_rows(name, case, label, printed, corrected, remark),
        Row(figure, f"{name}: {label}: average positioning error", "%", _PAPER_AVERAGE_PERCENT[name, case],
            _average_percent(printed), _average_percent(corrected)),
        Row(figure, f"{name}: {label}: micro's voltage, peak", "V", None, _peak_v(printed), _peak_v(corrected),
            f"saturated {_saturated_percent(printed):.1f} % and {_saturated_percent(corrected):.1f} % of the time; the "
            f"supply is {MICRO_SUPPLY_V:g} V"),
    ]  # fmt: skip


def _reduction_row(name: str, weak: Run, fair: Run, ideal: Run, corrected: Run) -> Row:
    def share(before: Run, after: Run) -> float:
        largest = [max(abs(edge) for edge in stable_range_m(run)) for run in (before, after)]
        return 100.0 * (1.0 - largest[1] / largest[0])

    return Row(
        "5.3",
        f"{name}: largest error, reduced from A to B by",
        "%",
        _PAPER_REDUCTION_PERCENT[name],
        share(weak, ideal),
        share(fair, corrected),
        "as printed: weak PID against DSMC without L_w; corrected: fair PID against the corrected law",
    )


def _rest_row() -> Row:
    peaks = [
        max(abs(edge) for edge in stable_range_m(run))
        for run in (
            cases.printed_sliding("sine", ideal=True, begins_at_rest=True),
            cases.corrected_sliding("sine", begins_at_rest=True),
        )
    ]
    return pair(
        "Fig. 16, B",
        "sine: DSMC from rest, 0.375 m/s behind: largest error after 8 s",
        "m",
        None,
        peaks,
        "the printed surface is undamped: what the start leaves swings on, into the edges of the gap",
    )


def _average_percent(run: Run) -> float:
    late = run.after(SETTLED_S[run.reference.name])
    d_r = np.abs(run.reference.position_m[late])
    far = d_r > _NEAR_ZERO_RATIO * float(d_r.max())
    return 100.0 * float(np.mean(np.abs(run.error_m[late][far]) / d_r[far]))


def _peak_v(run: Run) -> float:
    return float(np.max(np.abs(run.micro_input)))


def _saturated_percent(run: Run) -> float:
    return 100.0 * float(np.mean(np.abs(run.micro_input) >= MICRO_SUPPLY_V))


# ---- figures ------------------------------------------------------------------------------------------------------


def _figure(name: str, case: str, printed: Run, corrected: Run) -> Figure:
    unit, scale = ("mm", 1e3) if case == "A" else ("µm", 1e6)
    labels = ("A as printed", "A', a fair PID") if case == "A" else ("B as printed, without L_w", "B corrected")
    colour = FOURTH if case == "A" else CORRECTED
    runs = ((printed, labels[0], PRINTED), (corrected, labels[1], colour))
    panels = [
        Panel(
            "end (m)",
            [
                Curve("reference", printed.t_s, printed.reference.position_m, REFERENCE, "-", 0.8),
                *(Curve(label, run.t_s, run.end_m, shown) for run, label, shown in runs),
            ],
        ),
        Panel(f"error ({unit})", [Curve("", run.t_s, scale * run.error_m, shown) for run, _, shown in runs]),
        Panel("micro's voltage (V)", [Curve("", run.t_s, run.micro_input, shown) for run, _, shown in runs]),
    ]
    return Figure(
        f"Case {case}, {name} (the paper's Fig. {_NUMBER[case]})",
        drawn(panels, "time (s)"),
        "",
        f"Displacement, error and the micro's voltage over time in case {case} on the {name}.",
    )
