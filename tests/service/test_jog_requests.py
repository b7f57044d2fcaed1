"""Requests of a jog at the desk, on a clock set by hand: what was held up on its way begins nothing."""

import pytest

from stagectl.errors import JogOver
from stagectl.service import messages
from stagectl.service.desk import Busy, Desk
from stagectl.service.lease import LeaseRefused
from stagectl.service.service_log import ServiceLog
from stagectl.service.states import State

HOLD_S = messages.JogAt(velocity_m_per_s=0.0).hold_s
VELOCITY = messages.JogAt(velocity_m_per_s=0.01)


class Pressed:
    """A desk of a stage that is armed, an operator, and a jog that was begun."""

    def __init__(self):
        self.now_s = 0.0
        self.desk = Desk(ServiceLog(None), lambda: self.now_s)
        self.desk._state = State.ARMED
        self.token = self.desk.take_lease(messages.TakeLease(holder="anna", duration_s=30.0)).token
        self.key = self.begin("pressed")
        self.order = self.desk.next_order()
        self.order.begin()

    def begin(self, key):
        return self.desk.begin_jog(messages.BeginJog(), key, self.token).key

    def say(self):
        return self.desk.jog_at(self.key, VELOCITY, self.token)


def test_a_jog_begins_at_rest_and_goes_at_what_is_said_to_it_in_time():
    one = Pressed()
    assert one.order.wanted_m_per_s() == 0.0
    for _ in range(5):
        assert one.say().key == one.key
        assert one.order.wanted_m_per_s() == VELOCITY.velocity_m_per_s
        one.now_s += 0.9 * HOLD_S
    one.now_s += 0.2 * HOLD_S
    assert one.order.wanted_m_per_s() is None


@pytest.mark.parametrize("ended", [False, True], ids=["while it brakes", "behind its end"])
def test_what_is_said_too_late_begins_nothing(ended):
    one = Pressed()
    one.say()
    one.now_s += HOLD_S
    if ended:
        one.order.finish("let go", "FINISHED", "", None)
    with pytest.raises(JogOver, match="the jog pressed is over"):
        one.say()
    assert one.order.wanted_m_per_s() is None
    assert one.desk.next_order() is None


def test_a_beginning_that_comes_late_or_twice_moves_nothing():
    one = Pressed()
    one.say()
    one.now_s += HOLD_S
    one.order.finish("let go", "FINISHED", "", None)
    assert one.begin("pressed") == "pressed"
    assert one.desk.next_order() is None
    assert one.begin("late") == "late"
    assert one.desk.next_order().wanted_m_per_s() == 0.0
    with pytest.raises(JogOver):
        one.say()  # what was said to the jog before is said to no other


def test_a_key_pressed_again_while_the_jog_brakes_goes_on_with_it():
    one = Pressed()
    one.say()
    one.now_s += HOLD_S
    assert one.begin("again") == "pressed"
    assert one.order.wanted_m_per_s() == 0.0
    one.say()
    assert one.order.wanted_m_per_s() == VELOCITY.velocity_m_per_s


def test_a_jog_needs_the_lease_and_a_stop_is_stronger():
    one = Pressed()
    for ask in (
        lambda: one.desk.begin_jog(messages.BeginJog(), "guessed", "guessed"),
        lambda: one.desk.jog_at(one.key, VELOCITY, "guessed"),
    ):
        with pytest.raises(LeaseRefused):
            ask()
    one.desk.ask_to_stop("test")
    for ask in (one.say, lambda: one.begin("again")):
        with pytest.raises(Busy, match="the stage is coming to rest"):
            ask()
