"""The figures of a tuning: loop gain and sensitivity before and after, at every place, as SVG or PNG bytes."""

import matplotlib
import numpy as np

from stagectl.drawing import STYLE, image_of, legend, panels_of, plain_log
from stagectl.report import INK, MUTED, SERIES
from stagectl.tuning.rules import Asked, Assessment, Tuned

_DASHES = ("-", (0, (4, 2)), (0, (1, 1.5)), (0, (6, 1.5, 1, 1.5)))


def gain_figure(tuned: Tuned, image_format: str = "svg") -> bytes:
    """Loop gain over frequency, magnitude above phase, in the gap; before pale, after full."""
    with matplotlib.rc_context(STYLE):
        drawing, (above, below) = panels_of(4.6, 2, 1, sharex=True)
        for which, colour, name in ((tuned.before, SERIES[0], "as it was"), (tuned.after, SERIES[1], "tuned")):
            one = which.loops[0]
            above.plot(one.frequency_hz, np.abs(one.loop_gain), color=colour, label=name)
            phase = np.degrees(np.unwrap(np.angle(one.loop_gain)))
            phase -= 360.0 * np.round((np.interp(which.crossover_hz, one.frequency_hz, phase) + 180.0) / 360.0)
            below.plot(one.frequency_hz, phase, color=colour)
        above.axhline(1.0, color=MUTED, linewidth=0.7)
        below.axhline(-180.0, color=MUTED, linewidth=0.7)
        above.set_xscale("log")
        above.set_yscale("log")
        above.set_ylim(1e-2, 1e4)
        above.set_xlim(1.0, tuned.after.loops[0].frequency_hz[-1])
        below.set_ylim(-360.0, 0.0)
        above.set_ylabel("loop gain")
        below.set_ylabel("phase (degrees)")
        below.set_xlabel("frequency (Hz)")
        plain_log(below.xaxis)
        plain_log(above.yaxis)
        legend(drawing, above, columns=2)
        return image_of(drawing, image_format)


def sensitivity_figure(tuned: Tuned, asked: Asked, image_format: str = "svg") -> bytes:
    """Sensitivity over frequency at every place, before and after, and the limit."""
    with matplotlib.rc_context(STYLE):
        drawing, (axes,) = panels_of(3.4, 1, 1)
        _lines(axes, tuned.before, SERIES[0], "as it was")
        _lines(axes, tuned.after, SERIES[1], "tuned")
        axes.axhline(asked.max_sensitivity, color=INK, linewidth=0.8, label=f"limit {asked.max_sensitivity:g}")
        axes.set_xscale("log")
        axes.set_xlim(1.0, tuned.after.loops[0].frequency_hz[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("frequency (Hz)")
        axes.set_ylabel("sensitivity |1 / (1 + L)|")
        plain_log(axes.xaxis)
        legend(drawing, axes, columns=2)
        return image_of(drawing, image_format)


def _lines(axes, which: Assessment, colour: str, name: str) -> None:
    for one, dashes in zip(which.loops, _DASHES, strict=False):
        label = f"{name}, {one.place}"
        axes.plot(
            one.frequency_hz,
            1.0 / np.abs(1.0 + one.loop_gain),
            color=colour,
            linestyle=dashes,
            linewidth=1.0,
            label=label,
        )
