"""The report page: complete in itself, escaped, with a unit on every number; figures that lose no peak."""

import math
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np
import pytest

from stagectl import drawing, figures, report
from stagectl.errors import RecordError, RequestError
from stagectl.figures import BacklashCurve, ErrorTrace, Estimate, HoldTrace, TimeSeries
from stagectl.report import Figure, Quantity, Report, Section, Table

_RNG = np.random.default_rng(5)
_T_S = np.arange(6000) * 1e-3
_NOISE_M = 5e-9 * _RNG.standard_normal(6000)


def _tracking(image_format="svg", label="PID"):
    peak_m = _NOISE_M.copy()
    peak_m[3000] = 900e-9
    traces = [ErrorTrace(label, _T_S, peak_m, peak_m + _NOISE_M), ErrorTrace("DSMC", _T_S, _NOISE_M)]
    return figures.tracking_figure(_T_S, 0.4 * np.sin(_T_S), traces, image_format)


def _hold(image_format="svg"):
    return figures.hold_figure([HoldTrace("PID", 2 * _NOISE_M, 1e-3), HoldTrace("DSMC", _NOISE_M, 1e-3)], image_format)


def _backlash(image_format="svg"):
    x_m = 70e-6 + 260e-6 * np.sin(_T_S * 6.0)
    force_n = np.where(x_m > 176e-6, 9.87e3 * (x_m - 176e-6), np.where(x_m < -25.4e-6, 13.2e3 * (x_m + 25.4e-6), 0.0))
    identified = BacklashCurve(25.6e-6, 175.9e-6, 13.1e3, 9.9e3, 0.2e-6, 0.1e-6)
    return figures.backlash_figure(
        x_m, force_n, identified, BacklashCurve(25.4e-6, 176e-6, 13.2e3, 9.87e3), image_format
    )


def _convergence(image_format="svg"):
    half = np.where(_T_S < 0.5, math.nan, 2.0 / np.sqrt(np.maximum(_T_S, 0.1)))
    estimates = [
        Estimate(name, "µm", _T_S, 25.4 + 0.3 * half, half, 25.4) for name in ("left edge", "right edge", "width")
    ]
    return figures.convergence_figure(estimates, image_format)


def _timing(image_format="svg"):
    late_ns = (26e3 * np.exp(0.3 * _RNG.standard_normal(6000))).astype(np.int64)
    late_ns[0] = 0
    return figures.timing_figure([TimeSeries("wake-up", late_ns)], 1_000_000, image_format)


_DRAW = {
    "tracking": _tracking,
    "hold": _hold,
    "backlash": _backlash,
    "convergence": _convergence,
    "timing": _timing,
}


def _texts(svg: bytes) -> str:
    return " | ".join(e.text or "" for e in ET.fromstring(svg).iter() if e.tag.endswith(("text", "tspan")))


@pytest.mark.parametrize("name", _DRAW)
def test_figures_are_whole_and_say_their_units(name):
    svg = _DRAW[name]()
    words = _texts(svg)
    assert re.search(r"\((nm|µm|µs|mm|N|s|Hz)\)", words)
    assert _DRAW[name]("png").startswith(b"\x89PNG\r\n\x1a\n")
    assert len(svg) < 600_000


@pytest.mark.parametrize("name", [name for name in _DRAW if name != "timing"])
def test_figures_come_out_the_same_twice(name):
    assert _DRAW[name]() == _DRAW[name]()


def test_figures_say_the_numbers():
    assert "PID: peak 900 nm" in _texts(_tracking())
    assert "25.60 ± 0.20 µm" in _texts(_backlash())
    assert "true 25.40 µm" in _texts(_backlash())
    assert "deadline 1.00 ms" in _texts(_timing())


def test_an_unknown_image_format_is_refused():
    with pytest.raises(RequestError, match="'svg' or 'png'"):
        _timing("gif")


def test_thinning_keeps_every_peak():
    values = _RNG.standard_normal(100_003)
    values[54_321], values[77_777] = 50.0, -60.0
    t, thin = drawing.envelope(np.arange(100_003) * 1e-3, values)
    assert thin.size < 3 * drawing.LINE_BINS_COUNT
    assert (thin.max(), thin.min()) == (50.0, -60.0)
    assert t[np.argmax(thin)] == pytest.approx(54.321)
    assert (t[0], t[-1]) == (0.0, pytest.approx(100.002))
    assert np.all(np.diff(t) > 0.0)


@pytest.mark.parametrize(
    ("quantity", "text"),
    [
        (Quantity(88.04e-9, "m"), "88.0 nm"),
        (Quantity(999.6e-9, "m"), "1.00 µm"),
        (Quantity(1.2346e-6, "m", 4), "1.235 µm"),
        (Quantity(62e-9, "m", prefix="n"), "62.0 nm"),
        (Quantity(1.2e-6, "m", prefix="n"), "1200 nm"),
        (Quantity(13.2e3, "N/m"), "13.2 kN/m"),
        (Quantity(-0.0254, "m"), "−25.4 mm"),
        (Quantity(0.0, "s", prefix="m"), "0 ms"),
        (Quantity(0.43, "%", 2), "0.43 %"),
        (Quantity(70.7, "kg"), "70.7 kg"),
        (Quantity(12.0, "1", 2), "12"),
        (Quantity(math.nan, "m"), "–"),
        (Quantity(None, "s"), "–"),
        (Quantity(math.inf, "s"), "inf s"),
    ],
)
def test_quantities_read_as_people_write_them(quantity, text):
    assert str(quantity) == text


class _Page(HTMLParser):
    """Collects ids, outside addresses and text of a page, and checks that its tags close in order."""

    _VOID = ("meta", "img", "br", "link")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in self._VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href"):
                self.addresses.append(value)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self._VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def _whole_report():
    return Report(
        "Demo <1>",
        'Simulated & said: "rig"',
        [Table("Errors", ["law", "max"], [["PID <b>", Quantity(8e-7, "m")], ["DSMC", Quantity(6e-8, "m")]], "a < b")],
        [
            Figure("Tracking <i>", _tracking(label="P<script>$x$ & _D"), "caption <u>"),
            Figure("Again", _tracking()),
            Figure("Pixels", _timing("png")),
        ],
        [("run <0>", "</dd><script>")],
    )


def test_page_stands_alone():
    text = _whole_report().html()
    page = _Page(text)
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert page.addresses
    for address in page.addresses:
        assert address.startswith(("#", "data:image/png;base64,"))
        assert not address.startswith("#") or address[1:] in page.ids
    for target in re.findall(r"url\(([^)]*)\)", text):
        assert target.strip("'\"").lstrip("#") in page.ids
    assert "@import" not in text
    assert "<script" not in text


def test_words_in_a_column_of_numbers_wrap_and_numbers_dont():
    rows = [["a", Quantity(1.0, "m")], ["b", Quantity(2.0, "m")], ["c", "diverges at last"]]
    page = Report("t", "", tables=[Table("T", ["what", "value"], rows)]).html()
    assert '<td class="n">1.00 m</td>' in page
    assert '<td class="n words">diverges at last</td>' in page
    assert '<th class="n">value</th>' in page
    assert "<td>a</td>" in page


def test_parts_stand_in_the_order_given_and_share_the_figures_numbers():
    figure = Figure("Drawn", _tracking())
    page = Report(
        "t", "", figures=[figure], parts=[Section("First", ["x"]), figure, Table("Last", ["a"], [["b"]])]
    ).html()
    assert page.index("First") < page.index("Figure 1. Drawn") < page.index("Last") < page.index("Figure 2. Drawn")


def test_page_escapes_every_text():
    page = _Page(_whole_report().html())
    words = " ".join(page.words)
    for literal in (
        "Demo <1>",
        'Simulated & said: "rig"',
        "PID <b>",
        "a < b",
        "Tracking <i>",
        "caption <u>",
        "run <0>",
    ):
        assert literal in words
    assert "</dd><script>" in words
    assert "P<script>$x$ & _D: peak" in words
    assert "b" not in page.open


def test_page_follows_the_colour_scheme():
    text = _whole_report().html()
    drawing = text[text.index("<svg") : text.index("</svg>")]
    assert "var(--ink)" in drawing
    assert "var(--series-2)" in drawing
    for colour in report._PAGE_COLOURS:
        assert colour not in drawing
    for name, _ in report._PAGE_COLOURS.values():
        assert text.count(f"--{name}:") == 2


def test_a_bare_number_has_no_unit_and_is_refused():
    for bad in (1.5, 3):
        with pytest.raises(RequestError, match="has no unit"):
            Report("r", "", [Table("t", ["x"], [[bad]])]).html()


def test_rows_must_fit_their_headings():
    with pytest.raises(RequestError, match="2 cells under 1 headings"):
        Report("r", "", [Table("t", ["x"], [["a", "b"]])]).html()


def test_what_is_no_picture_is_refused():
    with pytest.raises(RequestError, match="neither SVG nor PNG"):
        Report("r", "", figures=[Figure("f", b"GIF89a")]).html()


def test_write_replaces_whole(tmp_path):
    file = tmp_path / "report.html"
    file.write_text("old")
    _whole_report().write(file)
    assert file.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_write_names_the_file_it_could_not_write(tmp_path):
    with pytest.raises(RecordError, match="absent"):
        _whole_report().write(tmp_path / "absent" / "report.html")
