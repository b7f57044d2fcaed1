"""The runs in closed loop that several chapters share: section 5.3's platform, its references, its laws.

The gap of 15 mm is taken as 7.5 mm to each side of a spring that rests in its middle, with Table 2's stiffness. The
stage begins on the reference unless said: x_ref1 begins at 0.375 m/s.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stagectl.paper import closed_loop, compensation, plant_as_printed, references, sliding_mode
from stagectl.paper.closed_loop import Run
from stagectl.paper.printed_values import DSMC_MACRO_GAIN_RATIO, GAP_5_3_M, PID_5_3, TABLE_2, Backlash
from stagectl.paper.references import Reference

SAMPLE_S = 1e-3
SUBSTEPS = 20
LIMIT_S = 50e-6
"""Control period that stands for continuous time."""

SETTLED_S = {"sine": 8.0, "trapezoid": 1.0}
"""From when on an error counts as stable."""

_FAIR_PID_HZ = 10.0

REFERENCES: dict[str, Callable[[float], Reference]] = {
    "sine": references.sine_5_3,
    "trapezoid": references.trapezoid_5_3,
}


@dataclass(frozen=True, slots=True)
class Setting:
    """How a run departs from: voltage drives sampled at 1 ms, macro fed forward, no decoupling, P_h = 1."""

    period_s: float = SAMPLE_S
    drive: int = plant_as_printed.DRIVE_VOLTAGE
    decoupling: int = closed_loop.DECOUPLING_NONE
    coupling_ratio: float = 1.0  # K_c of (26) over K_mw
    macro_gain_ratio: float = 1.0
    macro_feedback: int = compensation.FEEDBACK_OWN
    macro_feed_forward_ratio: float = 1.0
    relative_inertia: float = 0.0
    disturbance_n: float = 0.0
    disturbance_hz: float = 0.0
    start_offset_m: float = 0.0  # of the end
    begins_at_rest: bool = False  # else with the reference's speed


def backlash() -> Backlash:
    """Return the joint of section 5.3."""
    half = 0.5 * GAP_5_3_M
    return Backlash(half, half, TABLE_2.left_stiffness_n_per_m, TABLE_2.right_stiffness_n_per_m)


def prepared(setting: Setting) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return plant, loop and decoupler of a setting."""
    plant = plant_as_printed.parameters(backlash())
    plant["drive"] = setting.drive
    plant["relative_inertia"] = setting.relative_inertia
    plant["disturbance_n"] = setting.disturbance_n
    plant["disturbance_rad_per_s"] = 2.0 * np.pi * setting.disturbance_hz
    loop = closed_loop.init(setting.period_s, max(1, round(SUBSTEPS * setting.period_s / SAMPLE_S)))
    for name in ("decoupling", "macro_gain_ratio", "macro_feedback", "macro_feed_forward_ratio"):
        loop[name] = getattr(setting, name)
    loop["centre_m"] = 0.5 * float(plant["right_m"][0] - plant["left_m"][0])
    made = np.zeros(1, compensation.FILTER)
    if setting.decoupling == closed_loop.DECOUPLING_PRINTED:
        made = compensation.printed_decoupler(plant[0], setting.coupling_ratio).sampled(setting.period_s)
    elif setting.decoupling == closed_loop.DECOUPLING_DYNAMIC:
        made = compensation.corrected_decoupler(plant[0]).sampled(setting.period_s)
    return plant, loop, made


def _state(reference: Reference, setting: Setting) -> np.ndarray:
    speed = 0.0 if setting.begins_at_rest else float(reference.velocity_m_per_s[0])
    state = plant_as_printed.init(float(reference.position_m[0]), speed)
    state["end_position_m"] += setting.start_offset_m
    return state


def sliding(name: str, law: np.ndarray, setting: Setting) -> Run:
    """Follow a reference of section 5.3 with the sliding mode on the micro."""
    plant, loop, decoupler = prepared(setting)
    reference = REFERENCES[name](setting.period_s)
    return closed_loop.run(plant, loop, reference, law=law, decoupler=decoupler, state=_state(reference, setting))


def printed_pid(name: str) -> Run:
    """Case A: P_w, I_w, D_w as volts per metre, P_h as a gain on the macro's position command."""
    plant, loop, _ = prepared(Setting(macro_gain_ratio=PID_5_3["P_h"]))
    loop["micro_law"] = closed_loop.MICRO_PID
    loop["proportional_v_per_m"] = PID_5_3["P_w"]
    loop["integral_v_per_m_s"] = PID_5_3["I_w"]
    loop["derivative_v_s_per_m"] = PID_5_3["D_w"]
    return closed_loop.run(plant, loop, REFERENCES[name](SAMPLE_S))


def fair_pid(name: str) -> Run:
    """Case A': the same PID with gains of a micro that can carry itself, a triple pole at 10 Hz; no compensation."""
    plant, loop, _ = prepared(Setting())
    q = plant[0]
    w = 2.0 * np.pi * _FAIR_PID_HZ
    volts_per_newton = float(q["micro_resistance_ohm"] / q["micro_force_constant_n_per_a"])
    gain = volts_per_newton * float(q["micro_mass_kg"])
    loop["micro_law"] = closed_loop.MICRO_PID
    loop["proportional_v_per_m"] = 3.0 * w * w * gain
    loop["integral_v_per_m_s"] = w**3 * gain
    loop["derivative_v_s_per_m"] = 3.0 * w * gain
    return closed_loop.run(plant, loop, REFERENCES[name](SAMPLE_S))


def printed_sliding(name: str, *, ideal: bool, begins_at_rest: bool = False) -> Run:
    """Case B as printed; `ideal`: without L_w, as (29) has it, and in the limit of continuous time."""
    setting = Setting(
        LIMIT_S if ideal else SAMPLE_S,
        plant_as_printed.DRIVE_WITHOUT_INDUCTANCE if ideal else plant_as_printed.DRIVE_VOLTAGE,
        macro_gain_ratio=DSMC_MACRO_GAIN_RATIO,
        begins_at_rest=begins_at_rest,
    )
    return sliding(name, sliding_mode.init(), setting)


def corrected_sliding(name: str, *, begins_at_rest: bool = False) -> Run:
    """Case B corrected: y, eta, adaptive law and decoupling; k, r, alpha, gamma and phi as printed."""
    setting = Setting(decoupling=closed_loop.DECOUPLING_DYNAMIC, begins_at_rest=begins_at_rest)
    return sliding(name, sliding_mode.corrected(), setting)


def stable_range_m(run: Run) -> tuple[float, float]:
    """Return the least and the greatest error of the end once it is stable, m."""
    error = run.error_m[run.after(SETTLED_S[run.reference.name])]
    return float(error.min()), float(error.max())


def macro_peak_m(run: Run) -> float:
    """Return the macro's greatest error once it is stable, m."""
    return float(np.max(np.abs(run.macro_error_m[run.after(SETTLED_S[run.reference.name])])))
