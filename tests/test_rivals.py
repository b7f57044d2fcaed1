"""Linear rivals: where they are better is said, from numbers that are measured."""

import json
import math

import pytest

from bench.figure import Bar, judged
from bench.paper import beside_ours
from stagectl.commands import reproduce
from stagectl.paper import rivals
from stagectl.paper.rivals import CONTACT, FREE, HOLD, RIVALS, STEP, WHOLE, compared, measured, verdict
from stagectl.paper.rows import Chapter
from tests.command import call


@pytest.fixture(scope="module")
def ours(oled_profile, oled_machine):
    return measured(oled_profile, oled_machine, WHOLE)


def test_who_is_better_where_is_said_with_both_numbers():
    ours = {HOLD: 3e-9, STEP: 90e-9, FREE: 20e-9, CONTACT: 50e-9}
    theirs = {HOLD: 4e-9, STEP: 65e-9, FREE: 20.3e-9, CONTACT: math.nan}
    assert verdict(theirs, ours) == (
        "better in 0.1 N at once, peak of the mean (65.0 nm against 90.0 nm); worse in hold, rms (4.00 nm against "
        "3.00 nm), the same in contact, peak (stopped against 50.0 nm); no different in trapezoid, peak (20.3 nm "
        "against 20.0 nm)."
    )
    assert compared(1.0, math.nan) == "better"
    assert compared(math.nan, math.nan) == "no different"


def test_a_force_is_put_on_the_end_and_rivals_answer_it_otherwise(ours, oled_profile, oled_machine):
    pid, stiff, constant = (measured(oled_profile, oled_machine, rival) for rival in RIVALS)
    assert 1.15 * pid[STEP] < ours[STEP]  # the page's first sentence: the linear rival wins there
    assert 1.3 * stiff[STEP] < ours[STEP] < 150e-9
    assert pid[FREE] > 3.0 * ours[FREE]
    assert pid[CONTACT] > 3.0 * ours[CONTACT] > 3.0 * ours[FREE]
    assert stiff[HOLD] > 1.1 * ours[HOLD]
    assert constant != ours


def test_the_page_the_terminal_and_json_say_it(capsys, tmp_path, monkeypatch):
    made = [Chapter("x", "9", "Nine", [])]
    monkeypatch.setattr(reproduce, "work_through", lambda names, say: made)
    monkeypatch.setattr(rivals, "said", lambda profile, machine: (f"PID on {profile.name} and {machine.name}: better",))
    sentence = "PID on oled-printer and oled-printer: better"
    code, out, _ = call(capsys, "reproduce", "--out", tmp_path)
    assert code == 0
    assert sentence in out
    assert sentence in (tmp_path / "paper.html").read_text()
    code, out, _ = call(capsys, "reproduce", "--out", tmp_path, "--json")
    assert json.loads(out)["rivals"] == [sentence]
    code, out, _ = call(capsys, "reproduce", "model", "--out", tmp_path)
    assert sentence not in out
    assert sentence not in (tmp_path / "paper.html").read_text()


def test_rows_of_the_bench_say_who_is_better():
    def row(name, value, reason=""):
        return judged(Bar(name, "nm"), value, reason=reason)

    rows = list(
        beside_ours(
            [
                row("control, hold", 3.0),
                row("control, touching (macro 6 Hz): peak", 50.0),
                row("control, Ms", 1.9),
                row("PID + feed-forward: hold", 2.0, "no contact"),
                row("PID + feed-forward: touching (macro 12 Hz): peak", 900.0),
            ]
        )
    )
    assert [one.reason for one in rows] == [
        *("", "", ""),
        "no contact; DSMC has 3 nm: PID + feed-forward is better",
        "DSMC has 50 nm: PID + feed-forward is worse",
        "of 2: hold",
    ]
    assert rows[-1].value == 1.0
