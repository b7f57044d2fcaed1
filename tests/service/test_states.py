"""The table of states, transition by transition: what can be reached, and what never can without being asked for."""

from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from stagectl.errors import RequestError
from stagectl.service.states import POWERED, TRANSITIONS, Event, State, after, diagram

DOCUMENT = Path(__file__).parents[2] / "docs" / "service.md"
ASKED_FOR_POWER = (Event.ARM, Event.HOME)

# Written by hand from issue and design, so that a slip in the table is seen: state -> what it may become.
REACHABLE = {
    State.OFF: {State.IDLE, State.FAULT},
    State.IDLE: {State.ARMING, State.MOVING, State.FAULT, State.OFF},
    State.ARMING: {State.ARMED, State.STOPPING, State.FAULT},
    State.ARMED: {State.MOVING, State.IDENTIFYING, State.STOPPING, State.FAULT},
    State.MOVING: {State.ARMED, State.IDLE, State.STOPPING, State.FAULT},
    State.IDENTIFYING: {State.ARMED, State.STOPPING, State.FAULT},
    State.STOPPING: {State.IDLE, State.FAULT},
    State.FAULT: {State.IDLE, State.FAULT, State.OFF},
}


class Walk(RuleBasedStateMachine):
    """Any events in any order."""

    def __init__(self):
        super().__init__()
        self.state = State.OFF
        self.asked_for_power = False

    @rule(event=st.sampled_from(Event))
    def happens(self, event):
        before = self.state
        if (before, event) not in TRANSITIONS:
            with pytest.raises(RequestError, match=f"{event} is not possible in state {before}: ."):
                after(before, event)
            return
        self.state = after(before, event)
        assert self.state in REACHABLE[before]
        if event in ASKED_FOR_POWER:
            self.asked_for_power = True
        if self.state in (State.OFF, State.IDLE, State.FAULT):
            self.asked_for_power = False

    @precondition(lambda self: self.state is State.FAULT)
    @rule(event=st.sampled_from(Event))
    def only_an_acknowledgement_or_the_end_leads_out_of_a_fault(self, event):
        if (State.FAULT, event) in TRANSITIONS and after(State.FAULT, event) is not State.FAULT:
            assert event in (Event.ACKNOWLEDGE, Event.LET_GO)

    @invariant()
    def no_power_that_nobody_asked_for(self):
        assert self.state not in POWERED or self.asked_for_power


TestWalk = Walk.TestCase
TestWalk.settings = settings(max_examples=100, stateful_step_count=40)


def test_the_table_reaches_what_the_design_says_and_nothing_else():
    found = {state: {end for (begin, _), end in TRANSITIONS.items() if begin is state} for state in State}
    assert found == REACHABLE


def test_every_state_with_power_can_be_stopped_and_can_trip():
    for state in POWERED - {State.STOPPING}:
        assert after(state, Event.STOP) is State.STOPPING
    for state in State:
        assert after(state, Event.TRIPPED) is State.FAULT or state is State.OFF


def test_no_acknowledgement_enables():
    ends = {end for (_, event), end in TRANSITIONS.items() if event is Event.ACKNOWLEDGE}
    assert ends == {State.IDLE}
    assert not ends & POWERED


def test_the_drawing_is_the_table():
    assert diagram() in DOCUMENT.read_text()
