"""The figures of findings: residual force before and after, over time, position, velocity and frequency; the gap.

Takes plain arrays, gives SVG or PNG bytes; knows no file.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from stagectl.drawing import STYLE, image_of, legend, panels_of, plain_log
from stagectl.gap.residual import Bins, Residual, Spectrum, binned, spectrum
from stagectl.report import INK, MUTED, SERIES, rounded

_BEFORE, _AFTER, _FLOOR = SERIES[0], SERIES[1], SERIES[2]
_DASHED = (0, (4, 2))
_TIME_BINS_COUNT = 300
_POSITION_BINS_COUNT = 160
_VELOCITY_BINS_COUNT = 60
_DECADES = 1e-5
_ENLARGED_RATIO = 4.0
"""Where what is left is so much smaller than what was, it is shown again in a panel of its own."""


def gap_figure(
    before: tuple[float, float], after: tuple[float, float], residuals: Sequence[Residual], image_format: str = "svg"
) -> bytes:
    """Bars: reducible gap (training, held-out) left of what was, and the rms residual force of every body."""
    with matplotlib.rc_context(STYLE):
        rows = _force_rows(residuals)
        drawing, (left, right) = panels_of(1.5 + 0.36 * max(len(rows), 2), 1, 2)
        names = ["training", "held-out"]
        shares = [100.0 * b / a if a > 0.0 else 0.0 for a, b in zip(before, after, strict=True)]
        left.barh(names, [100.0 if a > 0.0 else 0.0 for a in before], 0.62, color=_BEFORE, alpha=0.3)
        left.barh(names, shares, 0.62, color=_AFTER)
        for k, (first, share) in enumerate(zip(before, shares, strict=True)):
            text = f"{rounded(share, 3)} % left" if first > 0.0 else "nothing above the floor"
            inside = share > 60.0
            left.text(
                share - 2.0 if inside else share + 2.0, k, text,
                ha="right" if inside else "left", va="center", fontsize=9.0, color="#ffffff" if inside else INK,
            )  # fmt: skip
        left.set_xlim(0.0, 103.0)
        left.invert_yaxis()
        left.grid(False, axis="y")
        left.set_xlabel("reducible gap (% of before)")
        height = 0.34
        for k, row in enumerate(rows):
            right.barh(k - 0.5 * height, row["before"], height, color=_BEFORE, label="before" if k == 0 else None)
            right.barh(k + 0.5 * height, row["after"], height, color=_AFTER, label="after" if k == 0 else None)
            label = "floor" if k == 0 else None
            right.plot([row["floor"]] * 2, [k - height, k + height], color=INK, linewidth=1.6, label=label)
        right.set_yticks(range(len(rows)), [row["name"] for row in rows])
        right.invert_yaxis()
        right.grid(False, axis="y")
        right.set_xscale("log")
        right.set_xlabel("residual force (N rms)")
        _number_log(right, [row[key] for row in rows for key in ("before", "after", "floor")])
        legend(drawing, right, columns=3)
        return image_of(drawing, image_format)


def time_figure(residuals: Sequence[Residual], image_format: str = "svg") -> bytes:
    """Residual force of one body over time, a panel for each recording: bin means with twice their standard error."""
    with matplotlib.rc_context(STYLE):
        drawing, panels = panels_of(0.8 + 1.35 * len(residuals), len(residuals), 1)
        for axes, residual in zip(panels, residuals, strict=True):
            bins = binned([residual], "times_s", _TIME_BINS_COUNT)
            _lines(axes, bins, 1.0)
            axes.set_title(_titled(residual))
            axes.set_ylabel("force (N)")
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.set_xlim(0.0, float(residual.times_s[-1]))
        panels[-1].set_xlabel("time (s)")
        drawing.align_ylabels()
        legend(drawing, panels[0], columns=2)
        return image_of(drawing, image_format)


def place_figure(residuals: Sequence[Residual], image_format: str = "svg") -> bytes:
    """Residual force of one body over position and velocity, training and held-out recordings side by side."""
    with matplotlib.rc_context(STYLE):
        sides = _sides(residuals)
        quantities = [
            ("position_m", *_length(residuals), _POSITION_BINS_COUNT),
            ("velocity_m_per_s", 1e3, "velocity (mm/s)", _VELOCITY_BINS_COUNT),
        ]
        drawn = [
            (label, scale, [binned(of_side, over, count) for _, of_side in sides])
            for over, scale, label, count in quantities
        ]
        panel_rows = [(label, scale, bins, False) for label, scale, bins in drawn]
        panel_rows += [(label, scale, bins, True) for label, scale, bins in drawn if _is_small(bins)]
        panel_rows.sort(key=lambda row: [label for label, _, _ in drawn].index(row[0]))
        drawing, panels = panels_of(0.8 + 1.75 * len(panel_rows), len(panel_rows), len(sides))
        for number, (label, scale, bins, enlarged) in enumerate(panel_rows):
            of_row = panels[number * len(sides) : (number + 1) * len(sides)]
            for (name, _), axes, one in zip(sides, of_row, bins, strict=True):
                _lines(axes, one, scale, enlarged)
                axes.set_xlabel(label)
                axes.set_title(name)
            of_row[0].set_ylabel("after, enlarged (N)" if enlarged else "force (N)")
            _share_range(of_row)
        legend(drawing, panels[0], columns=2)
        return image_of(drawing, image_format)


def frequency_figure(residuals: Sequence[Residual], image_format: str = "svg") -> bytes:
    """Spectrum of the residual force of one body, training and held-out recordings side by side, and the floor."""
    with matplotlib.rc_context(STYLE):
        sides = [(name, density) for name, of_side in _sides(residuals) if (density := spectrum(of_side)) is not None]
        drawing, panels = panels_of(3.1, 1, max(len(sides), 1))
        low, high = math.inf, 0.0
        for axes, (name, density) in zip(panels, sides, strict=False):
            low, high = _density_lines(axes, density, low, high)
            axes.set_title(name)
            axes.set_xlabel("frequency (Hz)")
            axes.set_xlim(density.frequency_hz[0], density.frequency_hz[-1])
        if not sides:
            panels[0].text(0.5, 0.5, "no recording is long enough", transform=panels[0].transAxes, ha="center")
            return image_of(drawing, image_format)
        low = max(low, _DECADES * high)
        for axes in panels:
            axes.set_ylim(10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high)))
        panels[0].set_ylabel("residual force (N/√Hz)")
        legend(drawing, max(panels, key=lambda axes: len(axes.lines)), columns=2)
        return image_of(drawing, image_format)


def unknown_figure(unknown: dict[str, Any], image_format: str = "svg") -> bytes:
    """The curve of what repeats and no effect explains, with its 95 % band, whatever it is of."""
    with matplotlib.rc_context(STYLE):
        drawing, (axes,) = panels_of(2.9, 1, 1)
        scale, label = _QUANTITIES.get(unknown["over"], (1.0, unknown["over"]))
        knots = np.asarray(unknown["knots"], float) * scale
        unit, words, what = _CURVES[curve_of(unknown)]
        values, half = unit * np.asarray(unknown["values"], float), 1.96 * unit * np.asarray(unknown["sds"], float)
        axes.fill_between(knots, values - half, values + half, color=_AFTER, alpha=0.22, linewidth=0.0)
        axes.plot(knots, values, color=_AFTER, marker="o", markersize=3.5, label=f"{what} that no effect explains")
        if knots.size == 1:  # no width to fill
            axes.errorbar(knots, values, half, color=_AFTER, alpha=0.3, linewidth=6.0)
        axes.plot([], [], color=_AFTER, alpha=0.3, linewidth=6.0, label="95 % band")
        axes.axhline(0.0, color=MUTED, linewidth=0.6)
        axes.set_xlabel(label)
        axes.set_ylabel(words)
        legend(drawing, axes, columns=2)
        return image_of(drawing, image_format)


def curve_of(unknown: Mapping[str, Any]) -> str:
    """Return what a curve is of: its unit, but of the joint's edges, in metres as readings are, and of what is late."""
    if unknown["over"] == "lateness_s":
        return "spread"
    return {"contact_edge": "edge", "contact_centre": "centre"}.get(unknown["acts_on"], str(unknown["unit"]))


_QUANTITIES = {
    "position_m": (1e3, "position (mm)"),
    "velocity_m_per_s": (1e3, "velocity (mm/s)"),
    "relative_position_m": (1e6, "end minus macro (µm)"),
    "t_s": (1.0, "time (s)"),
    "since_reversal_s": (1.0, "time since the last reversal (s)"),
    "motor_force_ago_s": (1e3, "time since the motor's force (ms)"),
    "lateness_s": (1e3, "how late the reading is (ms)"),
    "mass_kg": (1.0, "mass with what is carried (kg)"),
    "penetration_velocity_m_per_s": (1e3, "closing speed in contact (mm/s)"),
}

_CURVES = {
    "N": (1.0, "force (N)", "force"),
    "m": (1e6, "read too much (µm)", "reading"),
    "edge": (1e6, "edges further out (µm)", "place of the edges"),
    "centre": (1e6, "joint further to the right (µm)", "place of the joint"),
    "ratio": (1.0, "felt of the motor's force (ratio)", "answer"),
    "spread": (1.0, "spread as a lag spreads it (ratio)", "spread of what is late"),
}
"""By what a curve is of: its scale, the label of its axis, what it is."""


def _force_rows(residuals: Sequence[Residual]) -> list[dict[str, Any]]:
    """Sum the residual force by body and side."""
    rows = []
    for axis in dict.fromkeys(r.axis for r in residuals):
        for name, of_side in _sides([r for r in residuals if r.axis == axis]):
            floors = [r.floor_rms_n if math.isfinite(r.floor_rms_n) else r.sensor_rms_n for r in of_side]
            rows.append(
                {
                    "name": f"{axis}, {name}",
                    "before": _root_mean([r.before_rms_n for r in of_side]),
                    "after": _root_mean([r.after_rms_n for r in of_side]),
                    "floor": _root_mean(floors),
                }
            )
    return rows


def _root_mean(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _sides(residuals: Sequence[Residual]) -> list[tuple[str, list[Residual]]]:
    """Part training from held-out recordings; a side that is empty is left out."""
    sides = [(name, [r for r in residuals if r.held_out is held]) for name, held in _NAMES]
    return [(name, of_side) for name, of_side in sides if of_side]


_NAMES = (("training", False), ("held-out", True))


def _titled(residual: Residual) -> str:
    return f"{Path(residual.run).name} ({'held-out' if residual.held_out else 'training'})"


def _lines(axes: Axes, bins: Bins, scale: float, after_only: bool = False) -> None:
    """Draw bin means with twice their standard errors."""
    middle = bins.middle * scale
    both = [
        (bins.before_n, bins.before_error_n, _BEFORE, "before"),
        (bins.after_n, bins.after_error_n, _AFTER, "after"),
    ]
    for mean, error, colour, name in both[1:] if after_only else both:
        known = np.isfinite(error)
        if not known.any():  # too few passes to know how much they scatter
            known = np.isfinite(mean)
        shown = np.where(known, mean, np.nan)  # where nothing was measured the line breaks
        axes.fill_between(middle, shown - 2.0 * error, shown + 2.0 * error, color=colour, alpha=0.25, linewidth=0.0)
        axes.plot(middle, shown, color=colour, linewidth=0.9, label=f"{name} (mean, ±2 standard errors)")
        alone = known & ~np.concatenate([known[1:], [False]]) & ~np.concatenate([[False], known[:-1]])
        axes.errorbar(
            middle[alone], mean[alone], 2.0 * np.nan_to_num(error[alone]), color=colour, fmt=".", markersize=3.0
        )
    axes.axhline(0.0, color=MUTED, linewidth=0.6)
    if not bins.middle.size:
        axes.text(0.5, 0.5, "these recordings do not move", transform=axes.transAxes, ha="center", va="bottom")


def _length(residuals: Sequence[Residual]) -> tuple[float, str]:
    span_m = max(float(np.ptp(r.position_m)) for r in residuals)
    return (1e3, "position (mm)") if span_m > 1e-3 else (1e6, "position (µm)")


def _is_small(bins: Sequence[Bins]) -> bool:
    """Tell whether what is left is too small to be read beside what was."""
    sizes = [[float(np.nanmax(np.abs(values), initial=0.0)) for values in (b.before_n, b.after_n)] for b in bins]
    before, after = (max(size[k] for size in sizes) for k in (0, 1))
    return after > 0.0 and before > _ENLARGED_RATIO * after


def _share_range(panels: Sequence[Axes]) -> None:
    low, high = min(axes.get_ylim()[0] for axes in panels), max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(low, high)
        axes.yaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_locator(MaxNLocator(6))


def _density_lines(axes: Axes, density: Spectrum, low: float, high: float) -> tuple[float, float]:
    """Draw one side; return the range of what matters."""
    curves = [(density.before, _BEFORE, "before", "-"), (density.after, _AFTER, "after", "-")]
    if density.floor is not None:
        curves.append((density.floor, _FLOOR, "floor: scatter from lap to lap", "-"))
    for values, colour, name, style in curves:
        axes.plot(density.frequency_hz, values, color=colour, linestyle=style, linewidth=0.9, label=name)
        low, high = min(low, float(np.min(values))), max(high, float(np.max(values)))
    axes.plot(
        density.frequency_hz, density.sensor,
        color=MUTED, linestyle=_DASHED, label="the sensor's noise, as the profile states it",
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain_log(axes.xaxis)
    plain_log(axes.yaxis)
    return low, high


def _number_log(axes: Axes, values: Sequence[float]) -> None:
    """Give a logarithmic axis room on both sides, and plain numbers."""
    good = [value for value in values if math.isfinite(value) and value > 0.0]
    if good:
        axes.set_xlim(0.5 * min(good), 1.5 * max(good))
    plain_log(axes.xaxis)
