"""Sections 3.2 B and 5.2: the recursion (20) as printed, with forgetting, and the project's gated estimator."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stagectl.paper import gated, identification_test, recursive_least_squares
from stagectl.paper.figures import CORRECTED, PRINTED, REFERENCE, THIRD, Curve, Panel, drawn
from stagectl.paper.gated import Gated
from stagectl.paper.identification_test import Samples
from stagectl.paper.observer_chapter import axes_of
from stagectl.paper.printed_values import MACRO_OBSERVER_5_2, TABLE_2, TABLE_3, Backlash
from stagectl.paper.quasi_linear import forces
from stagectl.paper.recursive_least_squares import Identified, errors_percent
from stagectl.paper.rows import Chapter, Row
from stagectl.report import Figure

_DURATION_S = 60.0
_COVARIANCE = 1.0  # P(0), in kN and m; not printed
_OTHER_COVARIANCES = (0.3, 100.0)
_FORGETTING_RATIO = 0.9999
_NOISE_M = 100e-9
_SEED = 1
_NAMES = ("b_l", "b_r", "K_l", "K_r")


@dataclass(frozen=True, slots=True)
class _Variant:
    """One way to run (20) on the test."""

    label: str
    found: Identified


def chapter() -> Chapter:
    """Work sections 3.2 B and 5.2, Fig. 6 and 14, Table 3, through."""
    platform = identification_test.platform()
    samples = identification_test.run(platform, _DURATION_S)
    macro = axes_of(platform, samples)[0]
    observed_n = macro.force_n(macro.observed(MACRO_OBSERVER_5_2))
    printed = _recursion("as printed", samples, observed_n)
    forgetting = _recursion("with forgetting", samples, observed_n, forgetting_ratio=_FORGETTING_RATIO)
    exact_force = _recursion("the true F_b", samples, samples.contact_force_n)
    true_edges = _recursion("the true F_b, marked with the true edges", samples, samples.contact_force_n, True)
    own = _gated(platform, samples)
    rows = _error_rows(printed, own)
    others = [_recursion(f"P(0) = {p:g}", samples, observed_n, covariance=p) for p in _OTHER_COVARIANCES]
    rows += _worst_rows([*others, forgetting, exact_force, true_edges], printed)
    rows.append(_average_row(printed, own))
    rows += _time_rows(samples, own)
    return Chapter(
        "identification",
        "3.2 B, 5.2",
        "Recursive least squares, (20), and the gated estimator",
        rows,
        [
            _convergence_figure(samples, printed.found, forgetting.found, own),
            _force_figure(samples, printed.found, own),
        ],
        [
            "Corrected here is the project's estimator (`stagectl.backlash`) from positions with 100 nm of noise each: "
            "the micro's equation alone, every term through the same filter, samples gated by contact, one estimate a "
            "side, no first values.",
            "K(k) takes h(k); print has h(k - 1). P(0) is not printed: 1, in kN and m. First values 1 and "
            "0.001 are kN/m "
            "and m: the stiffness begins at its true value.",
            "The force comes from the macro's observer with the printed gains: the micro's is lost, and the paper "
            "doesn't say which.",
        ],
    )


# ---- runs ---------------------------------------------------------------------------------------------------------


def _recursion(
    label: str,
    samples: Samples,
    force_n: np.ndarray,
    knows_edges: bool = False,
    forgetting_ratio: float = 1.0,
    covariance: float = _COVARIANCE,
) -> _Variant:
    recursion = recursive_least_squares.init(covariance, forgetting_ratio)
    return _Variant(label, recursive_least_squares.along(recursion, samples.x_b_m, force_n, TABLE_2, knows_edges))


def _gated(platform: np.ndarray, samples: Samples) -> Gated:
    noise_m = np.random.default_rng(_SEED).standard_normal((2, samples.t_s.size)) * _NOISE_M
    q = platform[0]
    return gated.along(
        samples.macro_position_m + noise_m[0],
        samples.end_position_m + noise_m[1],
        float(q["end_spring_n_per_m"]),
        float(q["end_damping_n_s_per_m"]),
    )


# ---- rows ---------------------------------------------------------------------------------------------------------


def _error_rows(printed: _Variant, own: Gated) -> list[Row]:
    paper = errors_percent(TABLE_3, TABLE_2)
    ours = printed.found.errors_percent(TABLE_2)
    best = errors_percent(own.last, TABLE_2)
    remark = "all low, as in Table 3: gap samples that were taken for contact stay in P for ever"
    return [
        Row("(20), Table 3", f"error of {name} after {_DURATION_S:g} s", "%", paper[name], ours[name], best[name],
            remark if k == 0 else "")
        for k, name in enumerate(_NAMES)
    ]  # fmt: skip


def _average_row(printed: _Variant, own: Gated) -> Row:
    def average(errors: dict[str, float]) -> float:
        return 0.5 * (abs(errors["b_l"]) + abs(errors["b_r"]))

    return Row(
        "7, Table 3",
        "average error of b_l and b_r",
        "%",
        6.3,
        average(printed.found.errors_percent(TABLE_2)),
        average(errors_percent(own.last, TABLE_2)),
        'the conclusion\'s 6.3 % for "backlash parameters" leaves the stiffnesses out',
    )


def _worst(found: Identified) -> float:
    return max(abs(error) for error in found.errors_percent(TABLE_2).values())


def _worst_rows(variants: Sequence[_Variant], printed: _Variant) -> list[Row]:
    remarks = (
        *("P(0) is not printed; whatever it is, all four stay low",) * len(_OTHER_COVARIANCES),
        f"lambda = {_FORGETTING_RATIO}: the smallest repair",
        "no observer, no noise, and just as low: the observer is not the cause",
        "the bias is gone: its cause is the marking of the gap with b(0) = 1 mm of 50 mm",
    )
    rows = [
        Row("(20)", f"worst of the four errors: {variant.label}", "%", None, _worst(variant.found), None, remark)
        for variant, remark in zip(variants, remarks, strict=True)
    ]
    false = 100.0 * printed.found.falsely_marked_ratio
    return [
        *rows,
        Row("(9), (20)", "samples counted as contact that lie in the gap, as printed", "%", None, false, None),
    ]


def _time_rows(samples: Samples, own: Gated) -> list[Row]:
    """Say when all four came within 1 % for good, counted from the first contact of the second side."""
    second_s = max(
        float(samples.t_s[np.flatnonzero(samples.x_b_m > TABLE_2.right_m)[0]]),
        float(samples.t_s[np.flatnonzero(samples.x_b_m < -TABLE_2.left_m)[0]]),
    )
    outside = np.zeros(samples.t_s.size, bool)
    for values, true in _with_truth(own):
        outside |= ~(np.abs(values / true - 1.0) < 0.01)
    last_s = float(samples.t_s[np.flatnonzero(outside)[-1]])
    return [
        Row(
            "Fig. 14",
            "all four within 1 % for good, after the second side is first touched",
            "s",
            None,
            "never",
            last_s - second_s,
        )
    ]


def _with_truth(own: Gated) -> list[tuple[np.ndarray, float]]:
    return [
        (own.left_m, TABLE_2.left_m),
        (own.right_m, TABLE_2.right_m),
        (own.left_stiffness_n_per_m, TABLE_2.left_stiffness_n_per_m),
        (own.right_stiffness_n_per_m, TABLE_2.right_stiffness_n_per_m),
    ]


# ---- figures ------------------------------------------------------------------------------------------------------


def _convergence_figure(samples: Samples, printed: Identified, forgetting: Identified, own: Gated) -> Figure:
    t = samples.t_s
    panels = []
    for label, name, scale, true in (
        ("b_l (mm)", "left_m", 1e3, TABLE_2.left_m),
        ("b_r (mm)", "right_m", 1e3, TABLE_2.right_m),
        ("K_l (N/mm)", "left_stiffness_n_per_m", 1e-3, TABLE_2.left_stiffness_n_per_m),
        ("K_r (N/mm)", "right_stiffness_n_per_m", 1e-3, TABLE_2.right_stiffness_n_per_m),
    ):
        panels.append(
            Panel(
                label,
                [
                    Curve("(20) as printed", t, scale * getattr(printed, name), PRINTED),
                    Curve("with forgetting", t, scale * getattr(forgetting, name), THIRD),
                    Curve("gated estimator", t, scale * getattr(own, name), CORRECTED),
                ],
                lines=[scale * true],
                y_range=(0.0, 1.25 * scale * true),
            )
        )
    return Figure(
        "Identification of the backlash over time",
        drawn(panels, "time (s)", columns=2),
        "Dashed: the truth.",
        "Edges and stiffnesses over time: the printed recursion stays low, the gated estimator is on the truth.",
    )


def _force_figure(samples: Samples, printed: Identified, own: Gated) -> Figure:
    grid = np.linspace(float(samples.x_b_m.min()), float(samples.x_b_m.max()), 600)
    last = Backlash(
        float(printed.left_m[-1]),
        float(printed.right_m[-1]),
        float(printed.left_stiffness_n_per_m[-1]),
        float(printed.right_stiffness_n_per_m[-1]),
    )
    curves = []
    for label, joint, colour, style in (
        ("true", TABLE_2, REFERENCE, "-"),
        ("(20) as printed", last, PRINTED, "-"),
        ("gated estimator", own.last, CORRECTED, "--"),
    ):
        numbers = (joint.left_m, joint.right_m, joint.left_stiffness_n_per_m, joint.right_stiffness_n_per_m)
        curves.append(Curve(label, 1e3 * grid, forces(grid, *numbers)[:, 0], colour, style))
    return Figure(
        "Identified force over relative position (the paper's Fig. 14)",
        drawn([Panel("F_b (N)", curves)], "x_b (mm)"),
        f"After {_DURATION_S:g} s.",
        "Identified and true force over relative position.",
    )
