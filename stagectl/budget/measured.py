"""The error that a budget is held against: a hold of the machine behind the value seam, or a stretch of a run.

Each source can be switched off in the simulated machine, with the same noise otherwise; what the error loses is its
share as measured. A machine is anything with a machine file's attributes.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stagectl import batch, tick
from stagectl.budget.disturbances import COGGING, DELAY, FORCE, MODEL, SENSOR, STEP, is_periodic
from stagectl.budget.shares import without_delay
from stagectl.effects import CATALOGUE
from stagectl.errors import RequestError
from stagectl.laws.reference import gap_centre
from stagectl.run_scores import MotionScore
from stagectl.signals import SETPOINT, STOP_TEXT, Stop

if TYPE_CHECKING:
    from stagectl.profile import Profile

HOLD_S = 30.0
SWITCHES = (SENSOR, STEP, FORCE, DELAY, COGGING, MODEL)
"""Sources that can be switched off in a simulated machine that holds."""

_SETTLE_S = 2.0
_FINE_RATIO = 1e-6  # of a torque word, where it is to have no steps
_SHORTEST_S = 1.0  # of a stretch: half a hertz is the lowest that it can show
_REST_RATIO = 1e-3  # of the greatest acceleration, speed: below it the reference stands or runs evenly


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """An error over time, shape (n,), while the reference stands still or runs evenly."""

    name: str
    error_m: np.ndarray
    period_s: float
    is_true: bool  # the true end position's, averaged between samples; else as the interferometer shows it
    adaptive_gain_ratio: float = 0.0
    setpoints: np.ndarray | None = None  # where it moves: the reference, SETPOINT
    x_b_m: np.ndarray | None = None  # where it moves: macro minus end as measured
    contact_ratio: float | None = None

    @property
    def rms_m(self) -> float:
        """Root mean square about the mean."""
        return float(np.std(self.error_m))


def hold(
    profile: "Profile", machine: Any, law: str, seed: int, without: str | None = None, duration_s: float = HOLD_S
) -> Stretch:
    """Hold a machine in the middle of its gap; `without` switches one of SWITCHES off. RequestError where it stops."""
    if without == DELAY:
        profile = without_delay(profile)
    if without == COGGING:
        machine = _of_effects(machine, [_idle(row) if is_periodic(row["name"]) else row for row in machine.effects])
    if without == MODEL:
        known = {(row["name"], row["acts_on"]): row for row in profile.effects}
        rows = [known.get((row["name"], row["acts_on"])) or _idle(row) for row in machine.effects]
        machine = _of_effects(machine, rows)
    controller = tick.controller(profile, law, has_drives=False)
    simulation = batch.simulation(controller, machine, latch_delay_s=profile.cycle.actuation_delay_s, seed=seed)
    if without == MODEL:
        _as_believed(simulation.parameters, controller.belief)
    simulation.state["macro_position_m"] = float(gap_centre(controller.belief[0]))
    simulation.state["end_position_m"] = 0.0
    if without == SENSOR:
        simulation.noise_m = 0.0
    for axis in profile.axes:
        if without == STEP:
            simulation.devices[f"{axis}_amperes_per_word"] *= _FINE_RATIO
            controller.estimator[f"{axis}_amperes_per_word"] *= _FINE_RATIO
        if without == FORCE:
            simulation.parameters[f"{axis}_noise_n"] = 0.0
    rate_hz = profile.cycle.rate_hz
    recording = batch.run(simulation, np.zeros(round((_SETTLE_S + duration_s) * rate_hz), SETPOINT))
    stop = Stop(int(recording.commands["stop"][-1]))
    if stop is not Stop.NONE:
        raise RequestError(f"machine {machine.name} under {law} does not hold: {STOP_TEXT[stop]}; see `stagectl tune`")
    gains = simulation.controller.law
    adaptive = float(gains["adaptive_gain_ratio"][0]) if "adaptive_gain_ratio" in (gains.dtype.names or ()) else 0.0
    settled = recording.truth["end_mean_m"][round(_SETTLE_S * rate_hz) :]
    return Stretch("hold", settled, profile.cycle.period_s, is_true=True, adaptive_gain_ratio=adaptive)


def stretches_of(score: MotionScore, x_b_m: np.ndarray) -> list[Stretch]:
    """Return the longest hold and the longest even run of a scored motion, where each lasts long enough.

    `x_b_m`: macro minus end as measured, one a row of the score.
    """
    speed = np.gradient(score.reference_m, score.period_s)
    acceleration = np.gradient(speed, score.period_s)
    even = np.abs(acceleration) <= _REST_RATIO * max(float(np.max(np.abs(acceleration))), 1e-9)
    stands = np.abs(speed) <= _REST_RATIO * max(float(np.max(np.abs(speed))), 1e-9)
    found = []
    for name, mask in (("hold", stands & even), ("even speed", even & ~stands)):
        part = _longest(mask, round(0.3 / score.period_s))
        if (part.stop - part.start) * score.period_s < _SHORTEST_S:
            continue
        found.append(_stretch(score, x_b_m, name, part, float(speed[part.start])))
    if not found:
        raise RequestError(
            f"{score.segment.name}: holds or runs evenly nowhere for {_SHORTEST_S:g} s; take a run with a longer one"
        )
    return found


def _stretch(score: MotionScore, x_b_m: np.ndarray, name: str, part: slice, speed: float) -> Stretch:
    is_true = score.true_error_m is not None
    error = (score.true_error_m if score.true_error_m is not None else score.measured_error_m)[part]
    seen = np.isfinite(error)
    error = np.interp(np.arange(error.size), np.flatnonzero(seen), error[seen])
    setpoints = np.zeros(error.size, SETPOINT)
    setpoints["position_m"] = score.reference_m[part]
    setpoints["velocity_m_per_s"] = speed if name != "hold" else 0.0
    if name != "hold":
        name = f"{abs(speed) * 1e3:.3g} mm/s"
    return Stretch(
        name, error, score.period_s, is_true, setpoints=setpoints, x_b_m=x_b_m[part], contact_ratio=score.contact_ratio
    )


def _longest(mask: np.ndarray, skipped: int) -> slice:
    """Return the longest run of true values, without its first rows: what swings out belongs to the motion before."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    starts, stops = edges[::2] + skipped, edges[1::2]
    lengths = stops - starts
    if not lengths.size or np.max(lengths) <= 0:
        return slice(0, 0)
    best = int(np.argmax(lengths))
    return slice(int(starts[best]), int(stops[best]))


def _of_effects(machine: Any, rows: list[Any]) -> Any:
    return machine.model_copy(update={"effects": tuple(rows)})


def _idle(row: Any) -> dict[str, Any]:
    """Return an effect that does nothing: its amplitudes are zero, so that nothing has to be compiled anew."""
    return dict(row) | dict.fromkeys(CATALOGUE[row["name"]].linear, 0.0)


def _as_believed(parameters: np.ndarray, belief: np.ndarray) -> None:
    """Make a machine's parameters those that its controller believes; noise, stops and supply stay."""
    names = [f"{axis}_{what}" for axis in ("macro", "micro") for what in ("mass_kg", "force_constant_n_per_a")]
    names += ["macro_current_loop_s", "micro_current_loop_s", "spring_n_per_m", "damping_n_s_per_m"]
    for name in (*names, "left_m", "right_m", "left_stiffness_n_per_m", "right_stiffness_n_per_m"):
        parameters[name] = belief[name]
