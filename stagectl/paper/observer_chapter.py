"""Sections 3.2 A and 5.2: the super-twisting observer (10)-(19) with the printed gains and with gains from (13)."""

from dataclasses import dataclass

import numpy as np

from stagectl.paper import identification_test, super_twisting
from stagectl.paper.figures import CORRECTED, PRINTED, REFERENCE, Curve, Panel, drawn
from stagectl.paper.identification_test import Samples
from stagectl.paper.printed_values import (
    MACRO_OBSERVER_5_2,
    MICRO_OBSERVER_5_2,
    OBSERVATION_ERRORS_5_2_PERCENT,
    ObserverGains,
)
from stagectl.paper.rows import Chapter, Row, Value, pair
from stagectl.paper.super_twisting import Observed
from stagectl.report import Figure

_DURATION_S = 60.0
_START_S = 40.0  # observers that begin here, at rest, have to catch up with a stage in motion
_CONVERGED_RATIO = 0.05  # of the largest speed
_AXES: tuple[str, ...] = ("macro", "micro")


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of the test as its observer sees it, shapes (n,)."""

    name: str
    mass_kg: float
    spring_n_per_m: float
    damping_n_s_per_m: float
    sign: float  # of F_b in (17)
    position_m: np.ndarray
    velocity_m_per_s: np.ndarray
    input_n: np.ndarray
    contact_force_n: np.ndarray
    dt_s: float

    @property
    def bound_m_per_s2(self) -> float:
        """C of (13): twice the largest acceleration of the axis."""
        return 2.0 * float(np.max(np.abs(np.gradient(self.velocity_m_per_s, self.dt_s))))

    @property
    def needed_m_per_s2(self) -> float:
        """What (12) has to bear: the largest |F_b| over the mass."""
        return float(np.max(np.abs(self.contact_force_n))) / self.mass_kg

    def observed(self, gains: ObserverGains, first: int = 0) -> Observed:
        """Run (12) from rest at the first sample's position."""
        observer = super_twisting.init(
            gains, self.mass_kg, self.spring_n_per_m, self.damping_n_s_per_m, float(self.position_m[first])
        )
        return super_twisting.along(observer, self.position_m[first:], self.input_n[first:], self.dt_s)

    def force_n(self, observed: Observed) -> np.ndarray:
        """Return F_b of (17), N, shape (n,): chi of (15), (16) times the mass, with the axis' sign."""
        return self.sign * self.mass_kg * observed.chi_m_per_s2


def axes_of(platform: np.ndarray, samples: Samples) -> tuple[Axis, Axis]:
    """Return macro and micro of the test."""
    q = platform[0]
    return (
        Axis(
            "macro", float(q["macro_mass_kg"]), float(q["macro_spring_n_per_m"]), float(q["macro_damping_n_s_per_m"]),
            -1.0, samples.macro_position_m, samples.macro_velocity_m_per_s, samples.input_n, samples.contact_force_n,
            samples.dt_s,
        ),
        Axis(
            "micro", float(q["micro_mass_kg"]), float(q["end_spring_n_per_m"]), float(q["end_damping_n_s_per_m"]),
            1.0, samples.end_position_m, samples.end_velocity_m_per_s, np.zeros_like(samples.input_n),
            samples.contact_force_n, samples.dt_s,
        ),
    )  # fmt: skip


def chapter() -> Chapter:
    """Work sections 3.2 A and 5.2, Fig. 11 to 13, through."""
    platform = identification_test.platform()
    samples = identification_test.run(platform, _DURATION_S)
    axes = axes_of(platform, samples)
    printed = dict(zip(_AXES, (MACRO_OBSERVER_5_2, MICRO_OBSERVER_5_2), strict=True))
    kept = {axis.name: super_twisting.gains_for(axis.bound_m_per_s2) for axis in axes}
    observed = {
        (axis.name, which): axis.observed(gains[axis.name])
        for axis in axes
        for which, gains in (("printed", printed), ("kept", kept))
    }
    rows = [_condition_row(axis, printed[axis.name], kept[axis.name]) for axis in axes]
    for axis in axes:
        rows += _error_rows(axis, observed[axis.name, "printed"], observed[axis.name, "kept"])
    for axis in axes:
        rows += _force_rows(axis, observed[axis.name, "printed"], observed[axis.name, "kept"])
    for axis in axes:
        rows += _time_rows(axis, printed[axis.name], kept[axis.name])
    figures = [_axis_figure(axis, observed[axis.name, "printed"], observed[axis.name, "kept"]) for axis in axes]
    figures.append(_force_figure(axes, observed))
    return Chapter(
        "observer",
        "3.2 A, 5.2",
        "Super-twisting observer, (10)-(19)",
        rows,
        figures,
        [
            "Corrected here means gains from (13): C = 2 max |x2'| as printed but of the acceleration, iota "
            "= 2 C, eta 5 % "
            "above its limit. The printed gains contradict each other: they bear 49 N on the macro and 1.2 N on the "
            "micro, of one and the same F_b.",
            "F_1 and F_2 are not printed: (500 N/m, 150 N s/m) and (400 N/m, 100 N s/m), with which both "
            "sides of Table "
            "2's gap are touched and the macro's printed gains bear F_b.",
            "An observation error is the largest one over 60 s in percent of the largest value; the paper doesn't say.",
            "(16) with a measured velocity is an identity; in sliding its derivative vanishes on average, and the "
            "printed low-pass (20 ms) makes chi of the switching term.",
            "Bounds (18), (19): the sum runs over the oscillations of the error that were measured, C is that of (13). "
            f"The observers begin at rest at {_START_S:g} s; converged is within {100.0 * _CONVERGED_RATIO:g} % of the "
            "largest speed.",
        ],
    )


# ---- rows ---------------------------------------------------------------------------------------------------------


def _condition_row(axis: Axis, printed: ObserverGains, kept: ObserverGains) -> Row:
    allowed = [super_twisting.largest_bound_m_per_s2(gains) for gains in (printed, kept)]
    return pair(
        "(13)",
        f"{axis.name}: C of the test over the largest C that the gains allow",
        "1",
        "below 1",
        [axis.bound_m_per_s2 / bound for bound in allowed],
        f"C = {axis.bound_m_per_s2:.2f} m/s²; F_b alone asks for {axis.needed_m_per_s2:.2f} m/s²",
    )


def _percent(seen: np.ndarray, true: np.ndarray) -> float:
    return 100.0 * float(np.max(np.abs(seen - true)) / np.max(np.abs(true)))


def _error_rows(axis: Axis, printed: Observed, kept: Observed) -> list[Row]:
    bears_n = MICRO_OBSERVER_5_2.iota_m_per_s2 * axis.mass_kg
    largest_n = float(np.max(np.abs(axis.contact_force_n)))
    lost = _percent(printed.position_m, axis.position_m) > 10.0
    remark = f"iota bears {bears_n:.1f} N, and F_b goes to {largest_n:.0f} N: the observer is lost" if lost else ""
    return [
        Row(
            f"(12), Fig. {11 + _AXES.index(axis.name)}",
            f"{axis.name}: observation error of the {what}, largest",
            "%",
            OBSERVATION_ERRORS_5_2_PERCENT[f"{axis.name} {what}"],
            _percent(getattr(printed, field), getattr(axis, field)),
            _percent(getattr(kept, field), getattr(axis, field)),
            remark,
        )
        for what, field in (("velocity", "velocity_m_per_s"), ("position", "position_m"))
    ]


def _force_rows(axis: Axis, printed: Observed, kept: Observed) -> list[Row]:
    def rms(observed: Observed) -> float:
        return float(np.sqrt(np.mean((axis.force_n(observed) - axis.contact_force_n) ** 2)))

    largest_n = float(np.max(np.abs(axis.contact_force_n)))
    return [
        Row(
            "(16), (17), Fig. 13",
            f"F_b from the {axis.name}, error, rms",
            "N",
            None,
            rms(printed),
            rms(kept),
            f"F_b goes to {largest_n:.1f} N; the low-pass lags by 20 ms and leaves some of the switching",
        )
    ]


def _time_rows(axis: Axis, printed: ObserverGains, kept: ObserverGains) -> list[Row]:
    first = round(_START_S / axis.dt_s)
    measured: list[Value] = []
    bounds: list[Value] = []
    for gains in (printed, kept):
        seen = axis.observed(gains, first)
        error = axis.velocity_m_per_s[first:] - seen.velocity_m_per_s
        time_s = super_twisting.settled_s(
            error, _CONVERGED_RATIO * float(np.max(np.abs(axis.velocity_m_per_s))), axis.dt_s
        )
        measured.append("never" if time_s is None else time_s)
        if time_s is None:
            bounds.append("none: iota < C")
            continue
        cycles = super_twisting.cycles_s(axis.position_m[first:] - seen.position_m, axis.dt_s)
        within = cycles[: int(np.searchsorted(np.cumsum(cycles), time_s)) + 1]
        bound = super_twisting.time_bound_s(gains, axis.bound_m_per_s2, within)
        bounds.append("none: iota < C" if bound is None else bound)
    number = 18 + _AXES.index(axis.name)
    return [
        pair("Fig. 11, 12", f"{axis.name}: time until the velocity is observed", "s", 0.2, measured,
            "the paper's conclusion: within 0.2 s"),
        pair(f"({number})", f"{axis.name}: bound on that time", "s", None, bounds,
            "a factor times the sum of the error's own oscillations: it needs the time that it bounds"),
    ]  # fmt: skip


# ---- figures ------------------------------------------------------------------------------------------------------


def _axis_figure(axis: Axis, printed: Observed, kept: Observed) -> Figure:
    t_s = np.arange(axis.position_m.size) * axis.dt_s
    shown = t_s <= 20.0
    t = t_s[shown]
    panels = [
        Panel(
            "velocity (m/s)",
            [
                Curve("printed gains", t, printed.velocity_m_per_s[shown], PRINTED),
                Curve("gains from (13)", t, kept.velocity_m_per_s[shown], CORRECTED),
                Curve("true", t, axis.velocity_m_per_s[shown], REFERENCE, "--", 0.8),
            ],
        ),
        Panel(
            "velocity error (mm/s)",
            [
                Curve("", t, 1e3 * (printed.velocity_m_per_s - axis.velocity_m_per_s)[shown], PRINTED),
                Curve("", t, 1e3 * (kept.velocity_m_per_s - axis.velocity_m_per_s)[shown], CORRECTED),
            ],
        ),
        Panel(
            "position error (mm)",
            [
                Curve("", t, 1e3 * (printed.position_m - axis.position_m)[shown], PRINTED),
                Curve("", t, 1e3 * (kept.position_m - axis.position_m)[shown], CORRECTED),
            ],
        ),
    ]
    return Figure(
        f"Observation of the {axis.name} (the paper's Fig. {11 + _AXES.index(axis.name)})",
        drawn(panels, "time (s)"),
        "The first 20 of 60 s.",
        f"Velocity of the {axis.name}, observed and true, and the errors of velocity and position.",
    )


def _force_figure(axes: tuple[Axis, Axis], observed: dict[tuple[str, str], Observed]) -> Figure:
    panels = []
    for axis in axes:
        t_s = np.arange(axis.position_m.size) * axis.dt_s
        shown = t_s <= 20.0
        t = t_s[shown]
        panels.append(
            Panel(
                "F_b (N)",
                [
                    Curve("printed gains", t, axis.force_n(observed[axis.name, "printed"])[shown], PRINTED),
                    Curve("gains from (13)", t, axis.force_n(observed[axis.name, "kept"])[shown], CORRECTED),
                    Curve("true", t, axis.contact_force_n[shown], REFERENCE, "--", 0.8),
                ],
                f"from the {axis.name}",
            )
        )
    return Figure(
        "Force through the backlash (the paper's Fig. 13)",
        drawn(panels, "time (s)"),
        "Observed force behind the printed low-pass.",
        "Observed and true force from the macro's and from the micro's observer.",
    )
