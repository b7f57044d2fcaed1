"""Events that begin a recording: found once where they begin, whatever pieces the rows come in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stagectl.recording_trigger import Trigger, TriggerWatch
from stagectl.requests import Phase
from stagectl.row import new_rows


def working(count):
    rows = new_rows(count)
    rows["run_phase"] = int(Phase.TRACKING)
    rows["end_position_m"] = rows["setpoint_position_m"] = rows["setpoint_velocity_m_per_s"] = 0.0
    rows["contact_force_estimate_n"] = 0.0
    rows["sequence"] = rows["cycle"] = np.arange(count)
    rows["samples_new"] = 1
    return rows


def events():
    """200 rows with one event of each kind: (trigger, rows, where)."""
    error, contact, reversal = working(200), working(200), working(200)
    error["end_position_m"][120:140] = -2e-6
    contact["contact_force_estimate_n"][77:] = 1.5
    reversal["setpoint_velocity_m_per_s"][:50] = 0.1
    reversal["setpoint_velocity_m_per_s"][60:] = -0.1
    return [
        (Trigger(error_m=1e-6), error, 120),
        (Trigger(contact_force_n=1.0), contact, 77),
        (Trigger(), reversal, 60),
    ]


def found(trigger, rows, cuts=()):
    watch, at, places = TriggerWatch(trigger), 0, []
    for piece in np.split(rows, sorted(cuts)):
        place = watch.first(piece)
        if place is not None:
            places.append(at + place)
        at += piece.size
    return places


@given(st.lists(st.integers(0, 200), max_size=12))
def test_an_event_is_found_once_however_the_rows_are_cut(cuts):
    for trigger, rows, place in events():
        assert found(trigger, rows, cuts) == [place], trigger.text


@pytest.mark.parametrize("phase", [Phase.IDLE, Phase.QUICK_STOP, Phase.STOPPED])
def test_a_stage_without_a_law_at_work_triggers_nothing(phase):
    for trigger, rows, _ in events():
        rows["run_phase"] = int(phase)
        assert found(trigger, rows) == []


def test_what_holds_from_the_start_or_is_unknown_is_no_event():
    for trigger, rows, _ in events():
        assert found(trigger, rows[150:170] if trigger.text == "reversal" else rows[125:135]) == []
    rows = working(10)
    rows["end_position_m"] = rows["contact_force_estimate_n"] = np.nan
    assert found(Trigger(error_m=1e-9), rows) == found(Trigger(contact_force_n=1e-9), rows) == []


def test_a_late_line_begins_no_event_and_ends_none():
    trigger, rows, place = events()[0]
    late = rows[[50, 51, 130]]
    late["sequence"] -= 1
    late["end_position_m"] = [-0.25e-3, -0.25e-3, 0.0]  # the way of a millisecond; and what is no end of it
    rows[[50, 51, 130]] = late
    lost = rows[[60, 135]]
    lost["samples_new"] = 0
    lost["end_position_m"] = [-0.25e-3, 0.0]
    rows[[60, 135]] = lost
    assert found(trigger, rows) == [place]
    assert found(trigger, rows, range(200)) == [place]
