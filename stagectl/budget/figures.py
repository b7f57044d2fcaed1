"""The figures of a budget: cumulative power by source beside the measured one, shares as bars, the loop's sensitivity.

Takes a budget; returns SVG or PNG bytes in the colours that the page of `report` knows.
"""

import matplotlib
import numpy as np

from stagectl.budget.budget import MAX_SENSITIVITY, Budget, Part
from stagectl.budget.disturbances import SOURCES
from stagectl.drawing import STYLE, image_of, legend, panels_of, plain_log
from stagectl.report import INK, MUTED, SERIES

_NM2 = 1e18
_SHADES = (SERIES[1], SERIES[0], SERIES[2], SERIES[3], SERIES[1], SERIES[0], SERIES[2])
_ALPHAS = (0.75, 0.75, 0.75, 0.75, 0.4, 0.4, 0.4)


def spectrum_figure(part: Part, image_format: str = "svg") -> bytes:
    """Cumulative power from the lowest frequency up: every source on top of the others, and what was measured."""
    with matplotlib.rc_context(STYLE):
        drawing, (axes,) = panels_of(3.4, 1, 1)
        found = part.spectra
        top_hz = found.edge_hz[1:]
        floor = np.zeros(top_hz.size)
        for source, colour, alpha in zip(SOURCES, _SHADES, _ALPHAS, strict=True):
            power = np.cumsum(found.by_source[source]) * _NM2
            if not np.any(np.abs(power) > 1e-3 * np.sum(found.total) * _NM2):
                continue
            axes.fill_between(top_hz, floor, floor + power, color=colour, alpha=alpha, linewidth=0.0, label=source)
            floor = floor + power
        axes.plot(top_hz, floor, color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label="predicted, all together")
        measured = np.cumsum(part.measured_cells_m2) * _NM2
        axes.plot(top_hz, measured, color=INK, linewidth=1.4, label="measured")
        axes.set_xscale("log")
        axes.set_xlim(max(0.2, found.edge_hz[0]), found.edge_hz[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("frequency (Hz)")
        axes.set_ylabel("cumulative power (nm²)")
        plain_log(axes.xaxis)
        legend(drawing, axes, columns=3)
        return image_of(drawing, image_format)


def shares_figure(part: Part, image_format: str = "svg") -> bytes:
    """Power of every source, predicted beside measured where it could be switched off."""
    with matplotlib.rc_context(STYLE):
        drawing, (axes,) = panels_of(2.9, 1, 1)
        place = np.arange(len(part.shares))
        predicted = [share.predicted_m2 * _NM2 for share in part.shares]
        axes.barh(place - 0.2, predicted, height=0.36, color=SERIES[1], label="predicted")
        known = [(k, share.measured_m2) for k, share in enumerate(part.shares) if share.measured_m2 is not None]
        if known:
            rows, powers = np.array([k for k, _ in known]), np.array([power for _, power in known]) * _NM2
            axes.barh(
                rows + 0.2, powers, height=0.36, color=SERIES[0], label="measured: what the error loses without it"
            )
        axes.set_yticks(place, [share.source for share in part.shares])
        axes.invert_yaxis()
        axes.axvline(0.0, color=MUTED, linewidth=0.6)
        axes.set_xlabel("power (nm²)")
        legend(drawing, axes, columns=2)
        return image_of(drawing, image_format)


def bounds_figure(budget: Budget, image_format: str = "svg") -> bytes:
    """Hold against stiffness: the law, the least hold, the best and the stiffest loop within the sensitivity."""
    with matplotlib.rc_context(STYLE):
        drawing, (axes,) = panels_of(2.9, 1, 1)
        bounds = budget.bounds
        as_stiff = [] if bounds.as_stiff is None else [("as stiff", bounds.as_stiff.true_rms_m, SERIES[2])]
        marks = (
            (f"{budget.law} as it is (Ms {budget.margins.sensitivity_peak_ratio:.2f})", budget.hold_m, SERIES[0]),
            *((f"{name}, Ms <= {MAX_SENSITIVITY:g}", value_m, colour) for name, value_m, colour in as_stiff),
            (f"stiffest loop at Ms {MAX_SENSITIVITY:g}", bounds.stiff.true_rms_m, SERIES[3]),
            (f"best hold at Ms <= {MAX_SENSITIVITY:g}", bounds.robust.true_rms_m, SERIES[2]),
            (f"least hold at all (Ms {bounds.hold.robustness.max_sensitivity:.2f})", bounds.hold.true_rms_m, SERIES[1]),
        )
        place = np.arange(len(marks))
        for k, (_, value_m, colour) in zip(place, marks, strict=True):
            axes.barh(k, value_m * 1e9, height=0.55, color=colour)
            axes.annotate(
                f"{value_m * 1e9:.2f} nm", (value_m * 1e9, k), xytext=(4, 0), textcoords="offset points", va="center"
            )
        axes.set_yticks(place, [name for name, _, _ in marks])
        axes.invert_yaxis()
        axes.margins(x=0.15)
        axes.set_xlabel("hold, root mean square of the true end position (nm)")
        return image_of(drawing, image_format)
