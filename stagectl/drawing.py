"""What every drawing of a page shares: style, panels, thinning of long lines, and rendering as SVG or PNG bytes."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from stagectl.errors import RequestError
from stagectl.report import GRID, INK, MUTED, SERIES

STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "text.parse_math": False,  # a dollar sign in a name is a dollar sign
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "legend.handlelength": 1.4,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "svg.fonttype": "none",  # words stay words: searchable, and in the page's own font
    "svg.hashsalt": "stagectl",
    "axes.unicode_minus": True,
}

_WIDTH_IN = 6.2
_PIXELS_PER_INCH = 200

LINE_BINS_COUNT = 800
"""A line keeps the extremes of so many bins: about its pixels."""


def panels_of(
    height_in: float, rows: int, columns: int, sharex: bool = False, height_ratios: Sequence[float] | None = None
) -> tuple[Drawing, list[Axes]]:
    """An empty drawing and its axes, row by row."""
    drawing = Drawing(figsize=(_WIDTH_IN, height_in), layout="constrained")
    grid = drawing.subplots(rows, columns, sharex=sharex, squeeze=False, gridspec_kw={"height_ratios": height_ratios})
    return drawing, list(grid.flat)


def image_of(drawing: Drawing, image_format: str) -> bytes:
    """Render as SVG without background, or as PNG on white."""
    if image_format not in ("svg", "png"):
        raise RequestError(f"image_format is {image_format!r}; 'svg' or 'png' is needed")
    stream = io.BytesIO()
    if image_format == "png":
        FigureCanvasAgg(drawing).print_figure(stream, format="png", dpi=_PIXELS_PER_INCH, facecolor="white")
    else:
        drawing.savefig(stream, format="svg", dpi=_PIXELS_PER_INCH, transparent=True, metadata={"Date": None})
    return stream.getvalue()


def colours_of(things: Sequence[object]) -> list[str]:
    """One colour for each; a single one gets ours."""
    return [SERIES[1]] if len(things) == 1 else [SERIES[i % len(SERIES)] for i in range(len(things))]


def envelope(t_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thin a long line to the smallest and largest value of each pixel: no peak is lost."""
    t_s, values = np.asarray(t_s), np.asarray(values)
    width = t_s.size // LINE_BINS_COUNT
    if width < 3:
        return t_s, values
    count = t_s.size // width * width
    blocks = values[:count].reshape(-1, width)
    first = np.arange(len(blocks)) * width
    extremes = np.sort(np.stack([first + blocks.argmin(axis=1), first + blocks.argmax(axis=1)], axis=1), axis=1).ravel()
    kept = np.unique(np.concatenate([[0], extremes, np.arange(count, t_s.size), [t_s.size - 1]]))
    return t_s[kept], values[kept]


def by_decade(frequency_hz: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thin a long spectrum evenly in the logarithm of the frequency; it rises, so nothing between is lost."""
    if frequency_hz.size <= LINE_BINS_COUNT:
        return frequency_hz, values
    wanted = np.geomspace(frequency_hz[0], frequency_hz[-1], LINE_BINS_COUNT)
    kept = np.unique(np.minimum(np.searchsorted(frequency_hz, wanted), frequency_hz.size - 1))
    return frequency_hz[kept], values[kept]


def legend(drawing: Drawing, axes: Axes, columns: int) -> None:
    """Put the legend of `axes` on top of the whole drawing, in the order drawn, row by row."""
    handles, labels = axes.get_legend_handles_labels()
    # Matplotlib fills column by column.
    order = [i for column in range(columns) for i in range(column, len(labels), columns)]
    drawing.legend(
        [handles[i] for i in order],
        [labels[i] for i in order],
        loc="outside upper left",
        ncols=min(columns, len(labels)),
        borderaxespad=0.2,
        borderpad=0.1,
        columnspacing=1.6,
    )


def plain_log(axis: Axis) -> None:
    """Decades as plain numbers."""
    axis.set_major_locator(LogLocator(10.0, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.12g}".replace(",", "\u2009")))
    axis.set_minor_formatter(NullFormatter())
