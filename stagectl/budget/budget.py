"""A budget: predicted shares beside measured ones, the bound beside both, and what would help most.

Pure but for the simulation behind `measured.hold`; knows no file and no page.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from stagectl import compose
from stagectl.budget import lqg, measured, shares
from stagectl.budget.disturbances import FORCE, SENSOR, SOURCES, STEP, Forces, Noises, forces_missing, noises_of
from stagectl.budget.lqg import Hold, Surroundings
from stagectl.budget.measured import Stretch
from stagectl.budget.shares import Spectra
from stagectl.errors import RequestError
from stagectl.linear_loop import Body, linearise, machine_body
from stagectl.margins import Margins, margins

if TYPE_CHECKING:
    from stagectl.profile import Profile

MAX_SENSITIVITY = 2.0
AGREEMENT_RATIO = 0.15
STEP_N = 0.1  # the force whose step a loop's stiffness is told by

_BANDWIDTHS = (0.4, 0.55, 0.7, 0.85, 1.15, 1.3)  # of the profile's, tried as advice
_DRIFTS = (0.1, 0.2, 0.4, 2.0, 4.0)
_FORCE_BAND_HZ = (5.0, 60.0)  # where an unknown force noise shows most


@dataclass(frozen=True, slots=True)
class Share:
    """One source: predicted and measured power, m^2; `measured_m2` is None where it can't be switched off."""

    source: str
    predicted_m2: float
    measured_m2: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """The budget of one stretch."""

    stretch: Stretch
    spectra: Spectra
    measured_cells_m2: np.ndarray
    shares: tuple[Share, ...]

    @property
    def ratio(self) -> float:
        """Predicted over measured, root mean square."""
        return self.spectra.rms_m / self.stretch.rms_m if self.stretch.rms_m > 0.0 else math.nan

    @property
    def agrees(self) -> bool:
        """Whether the sum of the sources is what was measured, within AGREEMENT_RATIO."""
        return abs(self.ratio - 1.0) <= AGREEMENT_RATIO


@dataclass(frozen=True, slots=True)
class Bounds:
    """What sensor, delay and torque step leave: see `lqg`."""

    around: Surroundings
    hold: Hold
    robust: Hold  # the best with MAX_SENSITIVITY
    stiff: Hold  # of the loop that a force moves least with MAX_SENSITIVITY
    stiff_step_peak_m: float
    as_stiff: Hold | None  # the best with MAX_SENSITIVITY that a force moves no more than the law; None = there is none


@dataclass(frozen=True, slots=True)
class Lever:
    """What could be changed, and what the hold would then be, m; `is_gain` where it costs nothing but a number."""

    what: str
    hold_m: float
    saved_m: float
    is_gain: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """Everything that `stagectl budget` shows."""

    law: str
    noises: Noises
    parts: tuple[Part, ...]
    bounds: Bounds
    margins: Margins  # where a force moves the end
    hold_m: float  # predicted
    step_peak_m: float  # of the law as it is at rest, for STEP_N
    levers: tuple[Lever, ...]
    is_force_noise_fitted: bool = False  # to the stretch itself: then its sum proves nothing


def of_machine(
    profile: "Profile", law: str, machine: Any, seed: int, say: Callable[[str, float], None] = lambda what, share: None
) -> Budget:
    """Predict and simulate a hold of the machine that plays a profile, each source switched off once."""
    say("holding", 0.0)
    whole = measured.hold(profile, machine, law, seed)
    lost: dict[str, float] = {}
    for number, source in enumerate(measured.SWITCHES):
        say(f"holding without {source}", (1.0 + number) / (2.0 + len(measured.SWITCHES)))
        lost[source] = whole.rms_m**2 - measured.hold(profile, machine, law, seed, source).rms_m ** 2
    noises = noises_of(profile, machine)
    body = machine_body(machine)
    part = _part(profile, law, noises, whole, body, None, lost)
    return _with_bounds(profile, law, noises, (part,), body, say)


def of_stretches(
    profile: "Profile",
    law: str,
    machine: Any,
    stretches: list[Stretch],
    say: Callable[[str, float], None] = lambda what, share: None,
) -> Budget:
    """Predict what a run shows; `machine` is what played it, None where that was a real one.

    A real stage states no force noise: it is then fitted to the first stretch, which is said.
    """
    body = machine_body(machine) if machine is not None else None
    noises = noises_of(profile, machine)
    fitted = machine is None
    if fitted:
        noises = _with_fitted_force(profile, law, noises, stretches[0])
    parts = []
    for number, stretch in enumerate(stretches):
        say(f"predicting {stretch.name}", number / (len(stretches) + 1.0))
        forces = None
        if machine is not None and stretch.setpoints is not None and stretch.name != "hold":
            forces = forces_missing(profile, machine, stretch.setpoints, stretch.x_b_m if _touches(stretch) else None)
        parts.append(_part(profile, law, noises, stretch, body, forces, {}))
    return _with_bounds(profile, law, noises, tuple(parts), body, say, fitted)


def _touches(stretch: Stretch) -> bool:
    return stretch.contact_ratio is not None and stretch.contact_ratio > 0.0


def _part(
    profile: "Profile",
    law: str,
    noises: Noises,
    stretch: Stretch,
    body: Body | None,
    forces: Forces | None,
    lost: dict[str, float],
) -> Part:
    found = shares.spectra(
        profile,
        law,
        noises,
        body=body,
        forces=forces,
        adaptive_gain_ratio=stretch.adaptive_gain_ratio,
        is_true=stretch.is_true,
    )
    cells = shares.binned(stretch.error_m, stretch.period_s, found.edge_hz)
    rows = tuple(Share(source, found.power_m2(source), lost.get(source)) for source in SOURCES)
    return Part(stretch, found, cells, rows)


def _with_bounds(
    profile: "Profile",
    law: str,
    noises: Noises,
    parts: tuple[Part, ...],
    body: Body | None,
    say: Callable[[str, float], None],
    fitted: bool = False,
) -> Budget:
    say("computing the bound", 0.8)
    hold_m = shares.total_rms_m(profile, law, noises, body)
    of_body = body if body is not None else shares.believed_body(profile)
    loop = linearise(profile, law, of_body)
    system = shares.stable_loop(profile, law, of_body)
    force_n = np.full(round(0.5 / profile.cycle.period_s), STEP_N)
    force_n[0] = 0.0
    answer_m = shares.answer(system, {f"{loop.precise_axis}_force_n": force_n}, "end_position_m")
    peak_m = float(np.max(np.abs(answer_m)))
    bounds = bounds_of(profile, noises, peak_m)
    say("looking for what would help", 0.9)
    levers = _levers(profile, law, noises, body, hold_m)
    return Budget(law, noises, parts, bounds, margins(loop), hold_m, peak_m, levers, fitted)


def bounds_of(profile: "Profile", noises: Noises, step_peak_m: float) -> Bounds:
    """Compute the bounds of a profile's sensor, delay and torque step; RequestError where it states no noise.

    `step_peak_m`: how far STEP_N moves the end under the law that they are held against.
    """
    precise = profile.axes[-1]
    axis = profile.axis(precise)
    lag_s = axis.current_loop_s + compose.command_lag_s(profile.effects, f"{precise}_command")
    around = Surroundings(
        mass_kg=axis.mass_kg,
        period_s=profile.cycle.period_s,
        delay_s=profile.cycle.actuation_delay_s + lag_s,
        sensor_noise_m=noises.sensor_m,
        force_noise_n=noises.force_n.get(precise, 0.0),
        torque_step_n=axis.torque_step_n,
    )
    stiff = lqg.stiffest(around, MAX_SENSITIVITY)
    try:
        as_stiff = lqg.optimum(around, MAX_SENSITIVITY, step_peak_m / STEP_N)
    except RequestError:
        as_stiff = None
    robust = lqg.optimum(around, MAX_SENSITIVITY)
    return Bounds(around, lqg.bound(around), robust, stiff.hold(), stiff.step_peak_m(STEP_N), as_stiff)


def _levers(profile: "Profile", law: str, noises: Noises, body: Body | None, hold_m: float) -> tuple[Lever, ...]:
    """Try what could be changed, one at a time; the greatest saving first."""
    precise = profile.axes[-1]
    axis = profile.axis(precise)

    def hold(of: "Profile", with_noises: Noises) -> float:
        return shares.total_rms_m(of, law, with_noises, body)

    found = [
        Lever(
            f"halve the sensor's noise ({noises.sensor_m * 1e9:.3g} to {noises.sensor_m * 5e8:.3g} nm)",
            hold(profile, noises.scaled(SENSOR, 0.5)),
            0.0,
        ),
        Lever(
            f"halve the torque step ({axis.torque_step_n:.3g} to {0.5 * axis.torque_step_n:.3g} N): a drive with a "
            "smaller rated torque, or a finer word",
            hold(profile, noises.scaled(STEP, 0.5)),
            0.0,
        ),
        Lever(
            f"halve the delay from sample to force ({profile.cycle.actuation_delay_s * 1e3:.3g} ms), gains as they are",
            hold(_with_delay(profile, 0.5), noises),
            0.0,
        ),
    ]
    if any(noises.force_n.values()):
        found.append(Lever("halve the motor's force noise", hold(profile, noises.scaled(FORCE, 0.5)), 0.0))
    found += _gain_levers(profile, law, hold, noises)
    saved = [replace(lever, saved_m=hold_m - lever.hold_m) for lever in found]
    return tuple(sorted(saved, key=lambda lever: -lever.saved_m))


def _gain_levers(
    profile: "Profile", law: str, hold: Callable[["Profile", Noises], float], noises: Noises
) -> list[Lever]:
    """Return the best value of each number that costs nothing to change, where one is better than the profile's."""
    has_micro, control = profile.micro is not None, profile.control
    axis = "micro" if has_micro else "macro"
    bandwidth = "pid_bandwidth_hz" if law == "pid" and has_micro else f"{axis}_bandwidth_hz"
    found = []
    for key, ratios, unit in ((bandwidth, _BANDWIDTHS, "Hz"), (f"{axis}_drift_n_per_sqrt_s", _DRIFTS, "N/sqrt(s)")):
        now = getattr(control, key)
        tried = []
        for ratio in ratios:
            of = profile.model_copy(update={"control": control.model_copy(update={key: ratio * now})})
            try:
                tried.append((hold(of, noises), ratio * now))
            except RequestError:  # unstable
                continue
        if tried:
            at_m, value = min(tried)
            less = "less" if value > now else "more"
            said = f"set control.{key} from {now:g} to {value:.3g} {unit}; a force then moves the end {less}"
            found.append(Lever(said, at_m, 0.0, is_gain=True))
    return found


def _with_delay(profile: "Profile", ratio: float) -> "Profile":
    cycle = profile.cycle
    shorter = {"phase_s": ratio * cycle.phase_s, "actuation_delay_s": ratio * cycle.actuation_delay_s}
    return profile.model_copy(update={"cycle": cycle.model_copy(update=shorter)})


def _with_fitted_force(profile: "Profile", law: str, noises: Noises, stretch: Stretch) -> Noises:
    """Return the noises with the force noise on the precise axis that a stretch's middle frequencies show."""
    precise = profile.axes[-1]
    one = replace(noises, force_n={precise: 1.0})
    found = shares.spectra(profile, law, one, is_true=stretch.is_true)
    cells = shares.binned(stretch.error_m, stretch.period_s, found.edge_hz)
    known = shares.spectra(profile, law, replace(noises, force_n={}), is_true=stretch.is_true)
    low, high = (int(np.searchsorted(found.edge_hz, at_hz)) for at_hz in _FORCE_BAND_HZ)
    band = slice(low, high)
    by_force = float(np.sum(found.total[band]) - np.sum(known.total[band]))
    missing = float(np.sum(cells[band]) - np.sum(known.total[band]))
    return replace(noises, force_n={precise: math.sqrt(max(missing, 0.0) / by_force)})
