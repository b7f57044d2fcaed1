"""Section 4.1: compensation of the backlash (21) and decoupling of the macro (22)-(26)."""

import numpy as np

from stagectl.paper import cases, closed_loop, compensation, plant_as_printed, sliding_mode
from stagectl.paper.cases import LIMIT_S, Setting, macro_peak_m
from stagectl.paper.closed_loop import Run
from stagectl.paper.figures import CORRECTED, PRINTED, REFERENCE, THIRD, Curve, Panel, drawn
from stagectl.paper.rows import Chapter, Row, Value
from stagectl.report import Figure

_NAMES = ("sine", "trapezoid")
_UNBOUNDED_M = 0.1  # a macro that is this far off is not controlled


def chapter() -> Chapter:
    """Work section 4.1 through."""
    rows: list[Row] = []
    runs: dict[tuple[str, str], Run] = {}
    for name in _NAMES:
        for label, setting in _settings().items():
            runs[name, label] = cases.sliding(name, sliding_mode.corrected(), setting)
        rows += _rows(name, runs)
    return Chapter(
        "decoupling",
        "4.1",
        "Backlash compensation (21) and decoupling (22)-(26)",
        rows,
        [_macro_figure(runs), _drift_figure(runs)],
        [
            "The macro is servoed at 8 Hz with its own inertia fed forward; the micro has the corrected "
            "sliding mode, so "
            "that the end's error stays within some um and only the macro differs.",
            "(21) adds d - d1 to the macro's feedback in the gap: it then sees the end, which the micro holds, and "
            "nobody holds the macro. Corrected: the macro's own position about the middle of the gap, d_r + "
            "(b_r - b_l) "
            "/ 2.",
            "A, B, C, E, K_c of (24) are not printed. From (2)-(4): L_w m2, L_w b2 + R_w m2, L_w K2 + R_w b2 + K_mw "
            "K_emfw, R_w K2, K_mw. That is the end beside a macro that stands, not the reaction on the macro.",
            "Corrected decoupling: the voice coil's current, from its voltage less back-EMF, fed to the macro through "
            "both windings, less K2's force. With current drives a number, K_mw / K_mh.",
        ],
    )


def _settings() -> dict[str, Setting]:
    current = plant_as_printed.DRIVE_CURRENT
    return {
        "none": Setting(),
        "printed": Setting(decoupling=closed_loop.DECOUPLING_PRINTED),
        "mass ratio": Setting(decoupling=closed_loop.DECOUPLING_PRINTED, coupling_ratio=-4.0 / 7.0),
        "dynamic": Setting(decoupling=closed_loop.DECOUPLING_DYNAMIC),
        "none, limit": Setting(LIMIT_S),
        "dynamic, limit": Setting(LIMIT_S, decoupling=closed_loop.DECOUPLING_DYNAMIC),
        "none, current": Setting(drive=current),
        "static": Setting(drive=current, decoupling=closed_loop.DECOUPLING_STATIC),
        "(21)": Setting(macro_feedback=compensation.FEEDBACK_PRINTED),
        "(21), no feed-forward": Setting(macro_feedback=compensation.FEEDBACK_PRINTED, macro_feed_forward_ratio=0.0),
        "centred, no feed-forward": Setting(macro_feed_forward_ratio=0.0),
    }


def _size(run: Run) -> Value:
    """Return the macro's error, or words where it is lost."""
    if not run.is_whole:
        return f"diverges at {run.t_s[-1]:.1f} s"
    peak = macro_peak_m(run)
    return "diverges" if peak > _UNBOUNDED_M else peak


def _rows(name: str, runs: dict[tuple[str, str], Run]) -> list[Row]:
    def row(equation: str, quantity: str, printed: str | None, corrected: str | None, remark: str) -> Row:
        return Row(
            equation,
            f"{name}: macro's error, peak: {quantity}",
            "m",
            None,
            _size(runs[name, printed]) if printed else None,
            _size(runs[name, corrected]) if corrected else None,
            remark,
        )

    contact = 100.0 * float(np.mean(runs[name, "(21)"].contact_n != 0.0))
    drifts = (
        f"(21): it drifts to the edge at 7.5 mm and swings from edge to edge, {contact:.0f} % of the time in contact"
    )
    late = "what is left is the macro's back-EMF, made up for half a sample late"
    experiment = "what an experiment would give on a macro without back-EMF"
    return [
        row("(21)", "(21) against centring", "(21)", "none", drifts),
        row("(21)", "the same, macro without feed-forward", "(21), no feed-forward", "centred, no feed-forward", ""),
        row("(26)", "no decoupling", None, "none", ""),
        row("(26)", "dynamic, 1 ms", "printed", "dynamic", late),
        row("(26)", "K_c = -(m2 / m1) K_mw", "mass ratio", None, experiment),
        row("(26)", "no decoupling, 50 us", None, "none, limit", ""),
        row("(26)", "dynamic, 50 us", None, "dynamic, limit", ""),
        row("(26)", "current drives, no decoupling", None, "none, current", ""),
        row("(26)", "current drives, static", None, "static", "a number is enough"),
    ]


def _macro_figure(runs: dict[tuple[str, str], Run]) -> Figure:
    panels = []
    for name in _NAMES:
        curves = []
        for label, shown, colour in (
            ("none", "no decoupling", THIRD),
            ("dynamic", "dynamic, corrected", CORRECTED),
            ("static", "static, current drives", REFERENCE),
        ):
            run = runs[name, label]
            curves.append(Curve(shown, run.t_s, 1e6 * run.macro_error_m, colour))
        panels.append(Panel("macro's error (µm)", curves, name))
    return Figure(
        "Decoupling of the macro, (26)",
        drawn(panels, "time (s)"),
        "As printed, with K_c = K_mw, the macro is millimetres off on the sine and lost on the trapezoid: not drawn.",
        "Macro's error over time without decoupling, with the dynamic and with the static one.",
    )


def _drift_figure(runs: dict[tuple[str, str], Run]) -> Figure:
    panels = []
    for name in _NAMES:
        drifting, centred = runs[name, "(21)"], runs[name, "none"]
        panels.append(
            Panel(
                "macro minus end (mm)",
                [
                    Curve("(21) as printed", drifting.t_s, 1e3 * (drifting.macro_m - drifting.end_m), PRINTED),
                    Curve("centring", centred.t_s, 1e3 * (centred.macro_m - centred.end_m), CORRECTED),
                ],
                name,
                lines=(-7.5, 7.5),
            )
        )
    return Figure(
        "Compensation of the backlash, (21)",
        drawn(panels, "time (s)"),
        "Dashed: the edges of the gap.",
        "Relative position over time: with (21) as printed the macro swings from edge to edge.",
    )
