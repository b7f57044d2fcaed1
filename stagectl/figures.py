"""The figures of a run, as SVG or PNG bytes, in the colours that the page of `report` knows.

Takes plain arrays; knows no run folder.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from stagectl.drawing import STYLE, by_decade, colours_of, envelope, image_of, legend, panels_of, plain_log
from stagectl.metrics import cumulative_rms, timing_statistics
from stagectl.report import INK, MUTED, SERIES, Quantity, rounded

_POINT = "#7f8894"
"""Grey of measured points; they are drawn as pixels, so it has to do on light and on dark."""


_CURVE_POINTS_COUNT = 500
_POINTS_MAX_COUNT = 8000


@dataclass(frozen=True, slots=True)
class ErrorTrace:
    """Error of one law over time, shapes (n,): the true end position's, and the interferometer's beside it."""

    label: str
    t_s: np.ndarray
    true_m: np.ndarray
    measured_m: np.ndarray | None = None


@dataclass(frozen=True, slots=True)
class HoldTrace:
    """Error of one law while the reference stands still, shape (n,)."""

    label: str
    error_m: np.ndarray
    dt_s: float
    is_true: bool = False  # the true end position's, not the interferometer's


@dataclass(frozen=True, slots=True)
class BacklashCurve:
    """Backlash on macro minus end: no force between -left and right, a spring beyond; half widths are 95 %."""

    left_m: float
    right_m: float
    left_stiffness_n_per_m: float
    right_stiffness_n_per_m: float
    left_half_width_m: float = math.nan
    right_half_width_m: float = math.nan


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter while it is identified, shapes (n,), nan before the first estimate; `true_value` where known."""

    label: str
    unit: str
    t_s: np.ndarray
    value: np.ndarray
    half_width: np.ndarray
    true_value: float | None = None


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """Times of one kind, one a cycle, shape (n,)."""

    label: str
    time_ns: np.ndarray


def tracking_figure(
    t_s: np.ndarray, reference_m: np.ndarray, traces: Sequence[ErrorTrace], image_format: str = "svg"
) -> bytes:
    """Reference above, errors of all laws below on one pair of axes; measured errors pale behind the true ones.

    Where one law is far better than another a third panel shows the same again, enlarged to the better one.
    """
    with matplotlib.rc_context(STYLE):
        peaks_m = [float(np.max(np.abs(trace.true_m))) for trace in traces]
        enlarged = max(peaks_m) > 3.0 * min(peaks_m)
        ratios = (1.2, 2.0, 1.6) if enlarged else (1.2, 2.2)
        drawing, panels = panels_of(1.9 + 0.75 * sum(ratios), len(ratios), 1, sharex=True, height_ratios=ratios)
        panels[0].plot(*envelope(t_s, np.asarray(reference_m) * 1e3), color=INK)
        panels[0].set_ylabel("reference (mm)")
        name = "true error" if all(trace.measured_m is not None for trace in traces) else "error"
        for axes, largest_m in zip(panels[1:], (max(peaks_m), min(peaks_m)), strict=False):
            scale, unit = (1e9, "nm") if max(peaks_m) < 10e-6 else (1e6, "µm")
            _errors(axes, traces, scale)
            axes.axhline(0.0, color=MUTED, linewidth=0.6)
            axes.set_ylabel(f"{name} ({unit})")
            # Room for what the interferometer adds to the better law's error.
            axes.set_ylim(-1.25 * largest_m * scale or -1.0, 1.25 * largest_m * scale or 1.0)
        if enlarged:
            panels[2].set_ylabel(panels[1].get_ylabel() + ",\nenlarged")
        panels[-1].set_xlabel("time (s)")
        panels[-1].set_xlim(float(t_s[0]), float(t_s[-1]))
        drawing.align_ylabels()
        legend(drawing, panels[1], columns=2)
        return image_of(drawing, image_format)


def _errors(axes: Axes, traces: Sequence[ErrorTrace], scale: float) -> None:
    """Draw all measured errors, then all true ones on top."""
    for trace, colour in zip(traces, colours_of(traces), strict=True):
        if trace.measured_m is not None:
            t, error = envelope(trace.t_s, np.asarray(trace.measured_m) * scale)
            axes.plot(t, error, color=colour, linewidth=0.6, alpha=0.30)
    for trace, colour in zip(traces, colours_of(traces), strict=True):
        true_m = np.asarray(trace.true_m)
        peak, rms = Quantity(float(np.max(np.abs(true_m))), "m"), Quantity(float(np.sqrt(np.mean(true_m**2))), "m")
        t, error = envelope(trace.t_s, true_m * scale)
        axes.plot(t, error, color=colour, label=f"{trace.label}: peak {peak}, rms {rms}")
    if any(trace.measured_m is not None for trace in traces):
        axes.plot([], [], color=MUTED, linewidth=4.0, alpha=0.35, label="pale: as the interferometer measured it")


def hold_figure(holds: Sequence[HoldTrace], image_format: str = "svg") -> bytes:
    """Error while holding: how it is distributed, and from which frequencies its rms comes."""
    with matplotlib.rc_context(STYLE):
        drawing, (left, right) = panels_of(2.75, 1, 2)
        span = 1e9 * max(float(np.max(np.abs(hold.error_m))) for hold in holds) or 1.0  # an ideal rig holds at 0
        bins = np.linspace(-span, span, 62)
        for hold, colour in zip(holds, colours_of(holds), strict=True):
            error = np.asarray(hold.error_m) * 1e9
            share = 100.0 * np.histogram(error, bins)[0] / error.size
            left.stairs(share, bins, color=colour, alpha=0.18, fill=True)
            rms = Quantity(float(np.sqrt(np.mean(np.asarray(hold.error_m) ** 2))), "m")
            left.stairs(share, bins, color=colour, linewidth=1.1, label=f"{hold.label}: {rms} rms")
            spectrum = cumulative_rms(hold.error_m, hold.dt_s)
            frequency_hz, cumulative = by_decade(spectrum.frequency_hz, spectrum.cumulative_rms_m * 1e9)
            right.plot(frequency_hz, cumulative, color=colour, drawstyle="steps-post")
        kind = "true" if all(hold.is_true for hold in holds) else "measured"
        left.set_xlabel(f"{kind} error of the end (nm)")
        left.set_ylabel("samples per bin (%)")
        left.set_ylim(bottom=0.0)
        right.set_xscale("log")
        right.set_xlabel("frequency (Hz)")
        right.set_ylabel("cumulative rms (nm)")
        right.set_ylim(bottom=0.0)
        right.margins(x=0.0)
        plain_log(right.xaxis)
        legend(drawing, left, columns=2)
        return image_of(drawing, image_format)


def backlash_figure(
    macro_minus_end_m: np.ndarray,
    contact_force_n: np.ndarray,
    identified: BacklashCurve,
    true: BacklashCurve | None = None,
    image_format: str = "svg",
) -> bytes:
    """Contact force over macro minus end: the points that were measured, and the identified law through them."""
    with matplotlib.rc_context(STYLE):
        drawing, (axes,) = panels_of(3.5, 1, 1)
        offset, force_n = np.asarray(macro_minus_end_m) * 1e6, np.asarray(contact_force_n)
        stride = max(1, math.ceil(offset.size / _POINTS_MAX_COUNT))
        axes.plot(
            offset[::stride],
            force_n[::stride],
            ".",
            color=_POINT,
            markersize=2.4,
            alpha=0.45,
            markeredgewidth=0,
            rasterized=True,
        )
        axes.plot([], [], "o", color=_POINT, markersize=3.5, label="contact force from the balance of the micro")
        left_edge, right_edge = -identified.left_m * 1e6, identified.right_m * 1e6
        low, high = min(float(np.min(offset)), left_edge), max(float(np.max(offset)), right_edge)
        corners = np.array([low, left_edge, right_edge, high])
        law_n = [
            identified.left_stiffness_n_per_m * (low - left_edge) * 1e-6,
            0.0,
            0.0,
            identified.right_stiffness_n_per_m * (high - right_edge) * 1e-6,
        ]
        axes.plot(corners, law_n, color=SERIES[1], linewidth=1.6, label="identified (±: 95 %, noise only)")
        axes.plot([left_edge, right_edge], [0.0, 0.0], "o", color=SERIES[1], markersize=4.5)
        true_left_m, true_right_m = (true.left_m, true.right_m) if true else (None, None)
        true_left_k, true_right_k = (
            (true.left_stiffness_n_per_m, true.right_stiffness_n_per_m) if true else (None, None)
        )
        _edge(axes, left_edge, identified.left_m, identified.left_half_width_m, true_left_m, "left edge", -1)
        _edge(axes, right_edge, identified.right_m, identified.right_half_width_m, true_right_m, "right edge", 1)
        _slope(axes, 0.02, "left stiffness", identified.left_stiffness_n_per_m, true_left_k)
        _slope(axes, 0.98, "right stiffness", identified.right_stiffness_n_per_m, true_right_k)
        axes.set_xlabel("macro minus end (µm)")
        axes.set_ylabel("contact force (N)")
        legend(drawing, axes, columns=2)
        return image_of(drawing, image_format)


def convergence_figure(estimates: Sequence[Estimate], image_format: str = "svg") -> bytes:
    """Each parameter as it is identified, with its 95 % band; the true value dashed where it is known."""
    with matplotlib.rc_context(STYLE):
        rows = math.ceil(len(estimates) / 2)
        drawing, panels = panels_of(0.6 + 1.75 * rows, rows, 2, sharex=True)
        for axes, estimate in zip(panels, estimates, strict=False):
            t, value, half = (np.asarray(a, dtype=float) for a in (estimate.t_s, estimate.value, estimate.half_width))
            shown = np.linspace(0, t.size - 1, min(t.size, _CURVE_POINTS_COUNT)).astype(int)
            t, value, half = t[shown], value[shown], half[shown]
            axes.fill_between(t, value - half, value + half, color=SERIES[1], alpha=0.22, linewidth=0.0)
            axes.plot(t, value, color=SERIES[1])
            if estimate.true_value is not None:
                axes.axhline(estimate.true_value, color=SERIES[0], linestyle=(0, (4, 2)), linewidth=1.1)
            axes.set_title(f"{_with_band(value[-1], half[-1])} {estimate.unit}")
            axes.set_ylabel(f"{estimate.label} ({estimate.unit})")
            axes.set_ylim(*_settled_range(value, half, estimate.true_value))
            axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            axes.set_xlim(float(t[0]), float(t[-1]))
        for axes in panels[len(estimates) :]:
            axes.set_visible(False)
        for axes in panels[max(len(estimates) - 2, 0) : len(estimates)]:
            axes.set_xlabel("time (s)")
            axes.tick_params(labelbottom=True)
        names = [
            ("identified", {"color": SERIES[1]}),
            ("95 % band, noise only", {"color": SERIES[1], "alpha": 0.3, "linewidth": 6.0}),
        ]
        if any(estimate.true_value is not None for estimate in estimates):
            names.append(("true (rig)", {"color": SERIES[0], "linestyle": (0, (4, 2))}))
        handles = [Line2D([], [], label=name, **look) for name, look in names]
        drawing.legend(handles=handles, loc="outside upper left", ncols=3, borderaxespad=0.2)
        return image_of(drawing, image_format)


def timing_figure(series: Sequence[TimeSeries], deadline_ns: int | None = None, image_format: str = "svg") -> bytes:
    """How long things took, both axes logarithmic, so that one late cycle in a million is seen."""
    with matplotlib.rc_context(STYLE):
        drawing, (axes,) = panels_of(2.9 + 0.17 * len(series), 1, 1)
        floor_us = 0.1  # below it no clock of ours tells times apart; earlier and zero count there
        columns_us = [np.maximum(np.asarray(one.time_ns) * 1e-3, floor_us) for one in series]
        low_us = min(float(column.min()) for column in columns_us)
        high_us = max(float(column.max()) for column in columns_us)
        if deadline_ns is not None:
            high_us = max(high_us, deadline_ns * 1e-3)
        bins_us = np.geomspace(low_us / 1.2, high_us * 1.2, 90)
        for one, column_us, colour in zip(series, columns_us, colours_of(series), strict=True):
            count = np.histogram(column_us, bins_us)[0]
            times = timing_statistics(one.time_ns, deadline_ns)
            figures = ", ".join(
                f"{name} {rounded(value * 1e-3, 3)}"
                for name, value in (
                    ("p50", times.p50_ns),
                    ("p99", times.p99_ns),
                    ("p99.9", times.p999_ns),
                    ("max", times.max_ns),
                )
            )
            axes.stairs(count, bins_us, color=colour, fill=True, alpha=0.18, baseline=0.5)
            axes.stairs(count, bins_us, color=colour, linewidth=1.1, baseline=0.5, label=f"{one.label}: {figures} µs")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(0.5, axes.get_ylim()[1] * (5.0 if deadline_ns is not None else 1.5))
        plain_log(axes.xaxis)
        plain_log(axes.yaxis)
        if deadline_ns is not None:
            axes.axvline(deadline_ns * 1e-3, color=INK, linewidth=0.9, linestyle=(0, (4, 2)))
            axes.annotate(
                f"deadline {Quantity(deadline_ns * 1e-9, 's')}",
                (deadline_ns * 1e-3, 0.97),
                xycoords=("data", "axes fraction"),
                xytext=(-4, 0),
                textcoords="offset points",
                ha="right",
                va="top",
                fontsize=9.0,
            )
        axes.set_xlabel("time (µs)")
        axes.set_ylabel("cycles per bin")
        legend(drawing, axes, columns=1)
        return image_of(drawing, image_format)


def _settled_range(value: np.ndarray, half: np.ndarray, true_value: float | None) -> tuple[float, float]:
    """Limits that show the last two thirds whole and let the start run off the panel."""
    good = np.flatnonzero(np.isfinite(value) & np.isfinite(half))
    if good.size == 0:
        return -1.0, 1.0
    late = good[good.size // 3 :]
    low, high = float(np.min(value[late] - half[late])), float(np.max(value[late] + half[late]))
    if true_value is not None:
        low, high = min(low, true_value), max(high, true_value)
    margin = 0.25 * (high - low) or 0.01 * abs(high) or 1.0
    return low - margin, high + margin


def _edge(
    axes: Axes, at: float, edge_m: float, half_width_m: float, true_m: float | None, name: str, side: int
) -> None:
    """Mark an identified edge of the gap and say its value."""
    axes.axvline(at, color=SERIES[1], linewidth=0.8, linestyle=(0, (4, 2)))
    lines = [name, f"{_with_band(edge_m * 1e6, half_width_m * 1e6)} µm"]
    if true_m is not None:
        lines.append(f"true {true_m * 1e6:.{_decimals(half_width_m * 1e6)}f} µm")
    # Inside the gap, where no point can be: the force is zero there.
    height, va = (0.97, "top") if side < 0 else (0.03, "bottom")
    axes.annotate(
        "\n".join(lines),
        (at, height),
        xycoords=("data", "axes fraction"),
        xytext=(-6 * side, 0),
        textcoords="offset points",
        ha="left" if side < 0 else "right",
        va=va,
        fontsize=9.0,
        linespacing=1.35,
    )


def _slope(axes: Axes, across: float, name: str, stiffness_n_per_m: float, true_n_per_m: float | None) -> None:
    """Say a contact's stiffness in the corner that its line leaves free."""
    text = f"{name}\n{stiffness_n_per_m * 1e-3:.2f} N/mm"
    if true_n_per_m is not None:
        text += f"\ntrue {true_n_per_m * 1e-3:.2f} N/mm"
    left = across < 0.5
    axes.text(
        across,
        0.97 if left else 0.03,
        text,
        transform=axes.transAxes,
        ha="left" if left else "right",
        va="top" if left else "bottom",
        fontsize=9.0,
        linespacing=1.35,
    )


def _with_band(value: float, half_width: float) -> str:
    """Round a value to the digits that its 95 % half width leaves it."""
    decimals = _decimals(half_width)
    if not (math.isfinite(half_width) and half_width > 0.0):
        return f"{value:.{decimals}f}"
    return f"{value:.{decimals}f} ± {half_width:.{decimals}f}"


def _decimals(half_width: float) -> int:
    """Return how many decimals a 95 % half width leaves: two of its digits, two decimals where it is none."""
    if not (math.isfinite(half_width) and half_width > 0.0):
        return 2
    return max(1 - math.floor(math.log10(half_width)), 0)
