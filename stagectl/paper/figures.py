"""Drawings of the comparison: curves in panels, as SVG, in the colours that the page of `stagectl.report` knows."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from stagectl.drawing import LINE_BINS_COUNT, STYLE, envelope, image_of, legend, panels_of
from stagectl.report import INK, MUTED, SERIES

PRINTED, CORRECTED, THIRD, FOURTH = SERIES
"""As printed is always the first colour, corrected the second."""

REFERENCE = INK
_PANEL_IN = 1.75
_HEAD_IN = 0.75


@dataclass(frozen=True, slots=True)
class Curve:
    """One line: its name in the legend ("" for none), x and y in the panel's units, shapes (n,)."""

    label: str
    x: np.ndarray
    y: np.ndarray
    colour: str
    style: str = "-"
    width: float = 1.0


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes; `lines` are y values worth a thin line."""

    y_label: str
    curves: Sequence[Curve]
    title: str = ""
    lines: Sequence[float] = field(default=())
    y_range: tuple[float, float] | None = None
    x_label: str = ""


def drawn(panels: Sequence[Panel], x_label: str, *, columns: int = 1, share_x: bool = True) -> bytes:
    """Draw panels row by row; one legend above all, of every name once."""
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context(STYLE):
        drawing, axes = panels_of(_HEAD_IN + _PANEL_IN * rows, rows, columns, sharex=share_x)
        for place, panel in zip(axes, panels, strict=True):
            _draw(place, panel)
        for place, panel in zip(axes[-columns:], panels[-columns:], strict=True):
            place.set_xlabel(panel.x_label or x_label)
        for place, panel in zip(axes[:-columns], panels[:-columns], strict=True):
            if panel.x_label:
                place.set_xlabel(panel.x_label)
        drawing.align_ylabels()
        _add_names(axes[0], panels)
        legend(drawing, axes[0], columns=3)
        return image_of(drawing, "svg")


def _draw(axes: Axes, panel: Panel) -> None:
    for curve in panel.curves:
        x, y = _thinned(curve)
        axes.plot(x, y, curve.style, color=curve.colour, linewidth=curve.width)
    for value in panel.lines:
        axes.axhline(value, color=MUTED, linewidth=0.7, linestyle=(0, (4, 3)))
    axes.set_ylabel(panel.y_label)
    if panel.title:
        axes.set_title(panel.title)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)


def _thinned(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Thin a line over rising x to its extremes; a curve that turns back is taken every so many points."""
    if np.all(np.diff(curve.x) > 0.0):
        return envelope(curve.x, curve.y)
    every = max(1, curve.x.size // (4 * LINE_BINS_COUNT))
    return curve.x[::every], curve.y[::every]


def _add_names(axes: Axes, panels: Sequence[Panel]) -> None:
    """Give the first panel the names of all: the legend of the drawing reads them there."""
    named: dict[str, Curve] = {}
    for panel in panels:
        for curve in panel.curves:
            if curve.label:
                named.setdefault(curve.label, curve)
    for label, curve in named.items():
        axes.plot([], [], curve.style, color=curve.colour, linewidth=curve.width, label=label)
