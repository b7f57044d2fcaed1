"""`stagectl reproduce`: sections by name and by number, the page, the numbers as JSON, the bench's figures of it."""

import html
import json
import re

import pytest

from bench import paper as bench_paper
from stagectl.errors import RequestError
from stagectl.paper.chapters import CHAPTERS, asked, work_through
from stagectl.paper.page import COLUMNS, page
from stagectl.paper.rows import Chapter, Row
from stagectl.report import Quantity
from tests.command import call


def test_a_section_is_asked_for_by_name_or_by_number():
    assert asked(None) == tuple(CHAPTERS)
    assert asked("observer") == ("observer",)
    assert asked("5.3") == ("control",)
    assert asked("5.2") == ("observer", "identification")
    assert asked("3.2 b") == ("identification",)
    with pytest.raises(RequestError, match=r"'6\.3' is no section .* control \(5\.3\)"):
        asked("6.3")


def test_one_section_as_json_and_as_a_page(capsys, tmp_path):
    code, out, err = call(capsys, "reproduce", "3.1", "--out", tmp_path, "--json")
    assert code == 0
    assert "quasi-linear" in err
    answer = json.loads(out)
    (section,) = answer["sections"]
    assert section["name"] == "quasi-linear"
    force = next(row for row in section["rows"] if row["unit"] == "N")
    assert (force["printed"], force["corrected"]) == (pytest.approx(50.0), 0.0)
    text = (tmp_path / "paper.html").read_text()
    assert text.count("<svg") == 1
    assert "50.0 N" in text


def test_the_terminal_shows_the_same_rows(capsys, tmp_path):
    code, out, _ = call(capsys, "reproduce", "quasi-linear", "--out", tmp_path)
    assert code == 0
    assert "3.1. Quasi-linear backlash model" in out
    assert re.search(r"50\.0 N\s+0 N", out)


def test_every_number_is_whole_on_a_terminal_of_80_columns(capsys, tmp_path, monkeypatch):
    """Cropped, 1.10 mm were 1.10 m."""
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = call(capsys, "reproduce", "model", "--out", tmp_path)
    assert code == 0
    for number in ("48.7 kA", "734 mA", "1.10 mm", "74.9 mm", "627 mHz"):
        assert re.search(rf"(?<!\S){re.escape(number)}(?!\S)", out)
    assert max(len(line) for line in out.splitlines() if not line.startswith("page:")) <= 80


@pytest.mark.parametrize("columns", [40, 60])
def test_a_narrow_terminal_loses_neither_numbers_nor_labels(capsys, tmp_path, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    code, out, _ = call(capsys, "reproduce", "sliding-mode", "--out", tmp_path)
    assert code == 0
    assert "\u2026" not in out
    assert max(len(line) for line in out.splitlines() if line[:4] not in ("page", "4.2.")) <= columns
    words = " ".join(out.split())
    said = "(32), (33) orbit on s' = 0 from 1 nm off, peak paper's \u2013 as printed 22.6 µm corrected 1.00 nm undamped"
    assert said in words
    assert "hours until k + (k / r) Omega has doubled paper's \u2013 as printed" in words


def test_a_section_that_is_not_there_is_wrong_usage(capsys, tmp_path):
    code, _, err = call(capsys, "reproduce", "9.9", "--out", tmp_path / "new")
    assert code == 2
    assert "choose from model (2, 5.1)" in err
    assert not (tmp_path / "new").exists()


def test_a_folder_that_is_a_file_is_refused(capsys, tmp_path):
    (tmp_path / "page").write_text("")
    code, _, err = call(capsys, "reproduce", "3.1", "--out", tmp_path / "page")
    assert code == 2
    assert "give another folder" in err


def test_words_and_missing_numbers_stand_in_their_columns():
    chapter = Chapter("x", "9", "Nine", [Row("(1)", "a", "m", None, "diverges", 2e-6)], readings=["taken so"])
    text = page([chapter], ["(2)"]).html()
    assert text.index("Nine") < text.index("taken so") < text.index("Beyond the paper")
    assert all(f">{html.escape(name)}</th>" in text for name in COLUMNS)
    assert "<td" in text
    assert "diverges" in text
    assert str(Quantity(2e-6, "m")) == "2.00 µm"
    assert "2.00 µm" in text


def test_what_never_comes_is_infinite_in_the_table_and_null_in_json(capsys, tmp_path):
    """(40) with sigma: its bound never doubles."""
    code, out, _ = call(capsys, "reproduce", "sliding-mode", "--out", tmp_path, "--json")
    assert code == 0
    (section,) = json.loads(out)["sections"]
    (row,) = [one for one in section["rows"] if "hours until" in one["quantity"]]
    assert row["printed"] > 1.0
    assert row["corrected"] is None
    assert re.search(r"hours until .*\n?.*\u221e", (tmp_path / "paper.html").read_text())


def test_progress_counts_chapters():
    heard = []
    (chapter,) = work_through(["quasi-linear"], lambda what, share: heard.append((what, share)))
    assert heard == [("3.1 quasi-linear backlash model", 0.0)]
    assert chapter.name == "quasi-linear"


def test_every_row_that_has_a_number_is_a_figure():
    chapter = Chapter(
        "x", "9", "Nine", [Row("(1)", "a", "m", 1.0, "diverges", 2e-6), Row("(2)", "b", "N", None, 3.0, 4.0)]
    )
    found = {figure.figure: (figure.value, figure.unit) for figure in bench_paper.figures_of(chapter)}
    assert found == {
        "9 (1) a: corrected": (pytest.approx(2.0), "um"),
        "9 (2) b: as printed": (3.0, "N"),
        "9 (2) b: corrected": (4.0, "N"),
    }
