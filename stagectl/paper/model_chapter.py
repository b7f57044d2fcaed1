"""Sections 2 and 5.1: the platform (1)-(5) on both references of Fig. 10, and what its printed form gives."""

import numpy as np

from stagectl.paper import closed_loop, identification_test, limit_cycle, plant_as_printed, references
from stagectl.paper.figures import CORRECTED, PRINTED, REFERENCE, THIRD, Curve, Panel, drawn
from stagectl.paper.printed_values import GAP_5_1_M, TABLE_1, TABLE_1_MACRO, TABLE_2, Backlash
from stagectl.paper.references import Reference
from stagectl.paper.rows import Chapter, Row
from stagectl.report import Figure

_DT_S = 1e-3
_SUBSTEPS = 20
_MICRO_BANDWIDTH_HZ = 2.0
_LOST_M = 10.0  # a joint that has come apart this far
_REST_S = 15.0  # x_h2 stands by then
_STIFFNESS_N_PER_M = TABLE_2.left_stiffness_n_per_m
_CYCLE_S = 400.0
_CYCLE_STARTS_M = (0.03, 0.2)
_CYCLE_GAIN_HZ = 0.5  # of the servo that drags the micro by its end


def chapter() -> Chapter:
    """Work sections 2 and 5.1 through."""
    sine, ramp = references.macro_sine_5_1(_DT_S), references.macro_ramp_5_1(_DT_S)
    corrected = [_follow(reference, _plant()) for reference in (sine, ramp)]
    free = [_follow(reference, _without_joint()) for reference in (sine, ramp)]
    printed = [_follow(reference, _as_printed()) for reference in (sine, ramp)]
    right = identification_test.run(identification_test.platform(), 60.0)
    wrong = identification_test.run(identification_test.platform(coupling_sign=-1.0), 60.0)
    servo, plant = _dragging()
    expected = limit_cycle.predicted(
        servo, 0.5 * GAP_5_1_M, _STIFFNESS_N_PER_M, TABLE_1.macro_mass_kg, TABLE_1.micro_mass_kg
    )
    swings = [limit_cycle.swing(servo, plant, start_m, _CYCLE_S) for start_m in _CYCLE_STARTS_M]
    found = limit_cycle.met(swings[0])
    rows = [
        _current_row(corrected[0]),
        _carrying_row(sine),
        Row(
            "(2)",
            "force of K2 = 8.78 kN/m in rest, with x_w = d - d1 + b and b = 40 mm",
            "N",
            None,
            TABLE_1.spring_n_per_m * GAP_5_1_M,
            float(TABLE_1.spring_n_per_m * _plant()["spring_offset_m"][0]),
            "offset b in x_w: the spring rests a whole gap behind the macro; corrected: in the middle of the gap",
        ),
        _sign_row(right, wrong),
        *(
            _distortion_row(name, one, other, without)
            for name, one, other, without in zip(("x_h1", "x_h2"), printed, corrected, free, strict=True)
        ),
    ]
    if expected is not None:
        rows += [
            Row(
                "Fig. 10",
                "limit cycle, amplitude of x_b: predicted by harmonic balance",
                "m",
                None,
                None,
                expected.amplitude_m,
                "the paper gives no number and no servo; ours holds the end through the gap with integral action",
            ),
            Row("Fig. 10", "the same, met in simulation", "m", None, None, found.amplitude_m),
            Row("Fig. 10", "limit cycle, frequency: predicted", "Hz", None, None, expected.frequency_hz),
            Row("Fig. 10", "the same, met in simulation", "Hz", None, None, found.frequency_hz),
        ]
    return Chapter(
        "model",
        "2, 5.1",
        "Platform with coupling and backlash, (1)-(5)",
        rows,
        [
            _displacement_figure(corrected, printed, free),
            _cycle_figure(swings, expected),
            _divergence_figure(right, wrong),
        ],
        [
            "The inertia term of (2) is m2 times the relative acceleration; Newton needs the absolute one. Taken: "
            "m2 d''.",
            "The voice coil sits on the macro, so its reaction belongs into (1), where it is missing. Taken: with it.",
            "Sign of the coupling: with x_b = d - d1 in (5) and F_b as in (1) the joint is a negative spring. Taken: "
            "x_b = d1 - d in (5), all else as printed.",
            "K1 of Table 1 would need kiloamperes, and (25) has none: K1 = 0. K2 = 500 N/m between the stages.",
            "Motor constants are printed in rotary units. Taken: times 2 pi / 10 mm (macro) and times 100 (micro).",
            "Section 5.1 prints neither stiffness nor servos: 1 kN/m as in Table 2, an 8 Hz servo on the macro, "
            f"{_MICRO_BANDWIDTH_HZ:g} Hz on the micro's relative position. Before 3 s and after 14 s x_h2 stands.",
        ],
    )


# ---- runs ---------------------------------------------------------------------------------------------------------


def _plant() -> np.ndarray:
    half = 0.5 * GAP_5_1_M
    return plant_as_printed.parameters(Backlash(half, half, _STIFFNESS_N_PER_M, _STIFFNESS_N_PER_M), 0.0)


def _without_joint() -> np.ndarray:
    plant = _plant()
    plant["left_m"] = plant["right_m"] = np.inf
    plant["reaction"] = 0.0
    return plant


def _as_printed() -> np.ndarray:
    plant = _plant()
    plant["coupling_sign"] = -1.0
    plant["relative_inertia"], plant["reaction"] = 1.0, 0.0
    plant["spring_offset_m"] = GAP_5_1_M
    return plant


def _loop() -> np.ndarray:
    loop = closed_loop.init(_DT_S, _SUBSTEPS)
    w = 2.0 * np.pi * _MICRO_BANDWIDTH_HZ
    loop["micro_law"] = closed_loop.MICRO_RELATIVE
    loop["micro_stiffness_per_s2"], loop["micro_damping_per_s"] = w * w, 1.4 * w
    return loop


def _follow(reference: Reference, plant: np.ndarray) -> closed_loop.Run:
    return closed_loop.run(plant, _loop(), reference, relative=references.micro_sine_5_1(_DT_S))


def _dragging() -> tuple[limit_cycle.Servo, np.ndarray]:
    """Return a servo on the end, and the platform with an undriven micro that nothing but the gap holds."""
    w = 2.0 * np.pi * _CYCLE_GAIN_HZ
    plant = _plant()
    plant["drive"] = plant_as_printed.DRIVE_CURRENT
    plant["spring_n_per_m"] = plant["damping_n_s_per_m"] = plant["base_damping_n_s_per_m"] = 0.0
    return limit_cycle.Servo(w * w, 0.2 * w**3, 2.0 * w), plant


# ---- rows ---------------------------------------------------------------------------------------------------------


def _current_row(run: closed_loop.Run) -> Row:
    amplitude_m = float(np.max(np.abs(run.reference.position_m)))
    printed_a = TABLE_1.base_spring_n_per_m * amplitude_m / TABLE_1_MACRO.force_constant_n_per_a
    return Row(
        "(1), (4), Table 1",
        "macro's current along x_h1, peak",
        "A",
        None,
        printed_a,
        float(np.max(np.abs(run.macro_current_a))),
        "as printed: what K1 = 43.5 kN/m and K_m = 0.357 N/A ask for at 0.4 m",
    )


def _carrying_row(reference: Reference) -> Row:
    """Show what carries the micro along the macro: with the relative inertia nothing needs to."""
    forces = []
    for relative_inertia in (1.0, 0.0):
        plant = _plant()
        plant["relative_inertia"] = relative_inertia
        plant["spring_n_per_m"] = 0.0
        run = closed_loop.run(plant, _loop(), reference)
        late = run.after(4.0)
        forces.append(float(np.max(np.abs(plant["micro_force_constant_n_per_a"] * run.micro_current_a[late]))))
    return Row(
        "(2)",
        "voice coil's force that carries 40 kg along x_h1 inside the gap, peak",
        "N",
        None,
        forces[0],
        forces[1],
        "inertia of (2) against Newton: with the relative acceleration the micro is carried along for nothing",
    )


def _sign_row(right: identification_test.Samples, wrong: identification_test.Samples) -> Row:
    apart = np.flatnonzero(np.abs(wrong.x_b_m) > _LOST_M)
    printed = float(wrong.t_s[apart[0]]) if apart.size else "stays together"
    return Row(
        "(5), (10)",
        f"time until the joint is {_LOST_M:g} m apart in the test of 5.2",
        "s",
        None,
        printed,
        f"never: {1e3 * float(np.max(np.abs(right.x_b_m))):.0f} mm in 60 s",
        "sign of the coupling: x_b = d - d1 makes the joint a negative spring; it diverges at the first contact",
    )


def _distortion_row(name: str, printed: closed_loop.Run, corrected: closed_loop.Run, free: closed_loop.Run) -> Row:
    """Compare the end with what the same servos do without coupling and backlash."""
    if not printed.is_whole:
        value: float | str = f"diverges at {printed.t_s[-1]:.1f} s"
    else:
        value = _rms(printed.end_m - free.end_m)
    return Row(
        f"Fig. 10, {name}",
        "end against the same servos without coupling and backlash, rms",
        "m",
        None,
        value,
        _rms(corrected.end_m - free.end_m),
        "the paper shows distortion without a number",
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


# ---- figures ------------------------------------------------------------------------------------------------------


def _displacement_figure(
    corrected: list[closed_loop.Run], printed: list[closed_loop.Run], free: list[closed_loop.Run]
) -> Figure:
    panels = []
    for name, run, literal, without in zip(("x_h1", "x_h2"), corrected, printed, free, strict=True):
        shown = slice(0, run.t_s.size)
        panels.append(
            Panel(
                "end (m)",
                [
                    Curve("macro's reference", run.t_s[shown], run.reference.position_m[shown], REFERENCE, "-", 0.8),
                    Curve("corrected", run.t_s[shown], run.end_m[shown], CORRECTED),
                ],
                f"{name} and 40 mm at 1 Hz on the micro",
            )
        )
        panels.append(
            Panel(
                "against no joint (mm)",
                [
                    Curve(
                        "as printed", literal.t_s, 1e3 * (literal.end_m - without.end_m[: literal.t_s.size]), PRINTED
                    ),
                    Curve("corrected", run.t_s[shown], 1e3 * (run.end_m - without.end_m)[shown], CORRECTED),
                ],
            )
        )
    return Figure(
        "Displacement of the end (the paper's Fig. 10)",
        drawn(panels, "time (s)"),
        "Below each: the end minus what the same servos do without coupling and backlash: the distortion.",
        "End over time for both references, and the distortion by the joint below each.",
    )


def _cycle_figure(swings: list[np.ndarray], expected: limit_cycle.Cycle | None) -> Figure:
    shown = slice(0, round(60.0 / limit_cycle.DT_S))
    t_s = np.arange(swings[0].size)[shown] * limit_cycle.DT_S
    curves = [
        Curve(f"from {1e3 * start_m:g} mm off", t_s, 1e3 * x_b_m[shown], colour)
        for start_m, x_b_m, colour in zip(_CYCLE_STARTS_M, swings, (CORRECTED, THIRD), strict=True)
    ]
    amplitude = () if expected is None else (-1e3 * expected.amplitude_m, 1e3 * expected.amplitude_m)
    return Figure(
        "The limit cycle of a servo that holds the end through the gap",
        drawn([Panel("macro minus end (mm)", curves, lines=amplitude)], "time (s)"),
        "Dashed: the amplitude that harmonic balance predicts. Both starts end there.",
        "Relative position over time from two starts: both end in the same oscillation.",
    )


def _divergence_figure(right: identification_test.Samples, wrong: identification_test.Samples) -> Figure:
    kept = wrong.t_s <= 2.3
    until = right.t_s <= 8.0
    panel = Panel(
        "macro minus end (m)",
        [
            Curve("x_b = d - d1, as printed", wrong.t_s[kept], wrong.x_b_m[kept], PRINTED),
            Curve("x_b = d1 - d", right.t_s[until], right.x_b_m[until], CORRECTED),
            Curve("edges of the gap", right.t_s[until], np.full(int(until.sum()), TABLE_2.right_m), THIRD, "--", 0.8),
            Curve("", right.t_s[until], np.full(int(until.sum()), -TABLE_2.left_m), THIRD, "--", 0.8),
        ],
        y_range=(-0.3, 0.3),
    )
    return Figure(
        "Sign of the coupling in (5)",
        drawn([panel], "time (s)"),
        "The test of section 5.2. With the printed sign the first contact pushes the stages apart.",
        "Relative position over time: with the printed sign it runs away at the first contact.",
    )
