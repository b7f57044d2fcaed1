"""The lease at the desk, on a clock set by hand: what `python -m bench service --part mutants` would change is seen."""

import threading

import pytest

from stagectl.profile import load_profile
from stagectl.service import messages
from stagectl.service.desk import Busy, Desk, Ending, Unfit
from stagectl.service.lease import GRACE_S, Lease, LeaseRefused
from stagectl.service.service_log import ServiceLog
from stagectl.service.states import State

KEY = "a-key-that-nobody-guesses"
ANNA = messages.TakeLease(holder="anna", duration_s=2.0)
BERT = messages.TakeLease(holder="bert", duration_s=1.0)
STEP = messages.JogBy(distance_m=1e-3)
NO_STATUS = messages.Status.model_construct(
    homed=False, positions=messages.Positions.model_construct(setpoint_position_m=0.0)
)


class Manned:
    """A desk of a stage that is armed, as far as it knows, in a world where time passes when told."""

    def __init__(self):
        self.now_s = 100.0
        self.log = ServiceLog(None)
        self.desk = Desk(self.log, lambda: self.now_s)
        self.desk.publish(NO_STATUS, State.ARMED)

    def take(self, body=ANNA, key=""):
        return self.desk.take_lease(body, key).token

    def jogs(self, token):
        """Ask for a jog, and begin it."""
        self.desk.submit("jog", STEP, "jog", token)
        order = self.desk.next_order()
        assert order is not None
        order.begin()
        return order

    def said(self):
        return [(entry.event, entry.fields.get("holder")) for entry in self.log.last(100)]


def shown(message):
    return message.holder, message.left_s, message.duration_s


@pytest.fixture
def one():
    return Manned()


# ---- who holds it ----------------------------------------------------------------------------------------------------


def test_a_lease_is_shown_with_what_is_left_of_it(one):
    assert one.desk.lease_left_s() == 0.0
    assert one.desk.lease_state() is None
    assert one.desk.status().lease is None
    one.take()
    for now_s, left_s in ((100.0, 2.0), (101.0, 1.0), (101.75, 0.25)):
        one.now_s = now_s
        assert one.desk.lease_left_s() == left_s
        assert shown(one.desk.lease_state()) == ("anna", left_s, 2.0)
    assert one.desk.status().lease == one.desk.lease_state()
    one.now_s = 102.0
    assert one.desk.lease_left_s() == 0.0
    assert one.desk.lease_state() is None


def test_only_the_token_of_a_lease_that_lasts_is_the_operator_s(one):
    assert one.desk.is_lease_token("") is False
    token = one.take()
    one.now_s = 101.5
    assert one.desk.is_lease_token(token) is True
    for other in ("", token[:-1], f"{token}x", "é", "\ud800"):
        assert one.desk.is_lease_token(other) is False
    one.now_s = 102.0
    assert one.desk.is_lease_token(token) is False


def test_a_token_can_t_be_guessed_and_comes_with_the_lease(one):
    taken = one.desk.take_lease(ANNA)
    assert (shown(taken), len(taken.token)) == (("anna", 2.0, 2.0), 32)  # 24 random bytes
    assert one.said() == [("lease_taken", "anna")]
    assert one.log.last(1)[0].fields["duration_s"] == 2.0
    one.now_s = 102.0
    assert one.take(BERT) != taken.token


def test_the_same_key_is_the_same_lease_while_it_lasts(one):
    token = one.take(key=KEY)
    one.now_s = 101.0
    again = one.desk.take_lease(ANNA, KEY)
    assert (again.token, shown(again)) == (token, ("anna", 1.0, 2.0))
    with pytest.raises(Unfit, match="was used for another lease"):
        one.desk.take_lease(BERT, KEY)
    one.now_s = 102.0
    with pytest.raises(LeaseRefused, match=f"the lease that key '{KEY}' took is over"):
        one.desk.take_lease(ANNA, KEY)
    assert one.said() == [("lease_taken", "anna")]


def test_a_service_that_ends_gives_no_lease(one):
    one.desk.close()
    with pytest.raises(Ending):
        one.take()
    assert one.desk.lease_state() is None


def test_a_lease_is_renewed_by_its_holder_only(one):
    token = one.take()
    one.now_s = 101.5
    assert shown(one.desk.renew_lease(token)) == ("anna", 2.0, 2.0)
    assert one.desk.lease_left_s() == 2.0
    with pytest.raises(LeaseRefused):
        one.desk.renew_lease("guessed")
    one.now_s = 103.5
    with pytest.raises(LeaseRefused):
        one.desk.renew_lease(token)


# ---- when it is free -------------------------------------------------------------------------------------------------


def test_nobody_takes_the_lease_of_a_stage_with_power_or_with_a_command_on_its_way(one):
    token = one.take()
    one.desk.submit("jog", STEP, "jog", token)
    one.now_s = 200.0
    refused = pytest.raises(LeaseRefused, match="still coming to rest after the last lease")
    with refused:  # it waits
        one.take(BERT)
    order = one.desk.next_order()
    with refused:  # it is being carried out
        one.take(BERT)
    order.finish("done", "FINISHED", "", None)
    one.desk.powered = True
    with refused:
        one.take(BERT)
    one.desk.powered = False
    assert one.desk.lease_state() is None
    one.take(BERT)
    assert one.desk.lease_state().holder == "bert"


def test_a_lease_of_a_stage_at_rest_is_given_back_at_once(one):
    token = one.take()
    with pytest.raises(LeaseRefused):
        one.desk.give_lease_back("guessed")
    one.desk.give_lease_back(token, KEY)
    assert one.desk.lease_state() is None
    assert not one.desk.stop_asked
    assert one.said() == [("lease_taken", "anna"), ("lease_given_back", "anna")]
    one.desk.give_lease_back(token, KEY)  # said again: done already
    with pytest.raises(Unfit, match="was used for another lease given back"):
        one.desk.give_lease_back("other", KEY)
    with pytest.raises(LeaseRefused):
        one.desk.give_lease_back(token)


def test_one_that_is_given_back_under_way_stops_the_stage_and_stays_until_its_power_is_gone(one):
    token = one.take()
    order = one.jogs(token)
    one.desk.powered = True
    one.desk.give_lease_back(token)
    assert (one.desk.stop_asked, one.desk.stop_reason) == (True, "anna gave the lease back")
    assert one.desk.lease_left_s() == GRACE_S
    one.desk.publish(NO_STATUS, State.STOPPING)
    assert one.desk.lease_state().holder == "anna"
    with pytest.raises(LeaseRefused, match="anna is giving it back"):
        one.take(BERT)
    order.finish("stopped", "OPERATOR", "", None)
    one.desk.powered = False
    one.desk.publish(NO_STATUS, State.IDLE)
    assert one.desk.lease_state() is None
    one.take(BERT)
    one.desk.publish(NO_STATUS, State.IDLE)
    assert one.desk.lease_state().holder == "bert"  # of a stage without power too


@pytest.mark.parametrize("meanwhile", [None, Lease("t", "bert", 1.0, 101.0)], ids=["gone", "another's"])
def test_what_happened_to_a_lease_while_the_desk_was_waited_for_is_heeded(one, monkeypatch, meanwhile):
    """The stage's thread sees a lease that was given back, then gets the lock: a client had it until then."""

    class Lock:
        def __enter__(self):
            desk._lease = meanwhile

        def __exit__(self, *_):
            pass

    desk = one.desk
    token = one.take()
    desk.powered = True
    desk.give_lease_back(token)
    desk.powered = False
    monkeypatch.setattr(desk, "_lock", Lock())
    desk.publish(NO_STATUS, State.IDLE)
    assert desk._lease is meanwhile
    monkeypatch.setattr(desk, "_lock", threading.RLock())


def test_a_status_is_put_out_without_a_lease_and_with_one(one):
    for state in (State.IDLE, State.FAULT):
        one.desk.publish(NO_STATUS, state)
        assert one.desk._state is state
        one.now_s += 5.0
        one.take()


# ---- what it is needed for -------------------------------------------------------------------------------------------


def test_an_order_begins_only_under_its_lease_and_when_nobody_asked_for_rest(one):
    token = one.take()
    one.desk.submit("jog", STEP, "jog", token)
    order = one.desk.next_order()
    one.desk.check_order(order)
    one.desk.ask_to_stop("somebody asked")
    with pytest.raises(Busy, match="jog: stopped before it began: somebody asked"):
        one.desk.check_order(order)
    one.desk.stopped()
    one.now_s = 102.0
    with pytest.raises(LeaseRefused):
        one.desk.check_order(order)


SETPOINTS = messages.Setpoints(first_number=0, period_s=0.01, position_m=[0.0, 0.0])
LATER = messages.Setpoints(first_number=5, period_s=0.01, position_m=[0.0])
NEEDS = {
    "a command": lambda desk: desk.submit("jog", STEP, "new", "guessed"),
    "a jog": lambda desk: desk.begin_jog(messages.BeginJog(), "new", "guessed"),
    "a plan": lambda desk: desk.submit_planned("scan", messages.Scan.model_construct(), "new", "guessed"),
    "a question": lambda desk: desk.check("scan", messages.Scan.model_construct(), "guessed"),
    "a stream": lambda desk: desk.take_setpoints(SETPOINTS, "guessed"),
    "more of a stream": lambda desk: desk.take_setpoints(LATER, "guessed"),
}


@pytest.mark.parametrize("what", NEEDS)
def test_nothing_is_taken_over_without_the_lease(one, what):
    for _ in ("nobody holds it", "anna does"):
        with pytest.raises(LeaseRefused):
            NEEDS[what](one.desk)
        assert one.desk.next_order() is None
        if one.desk.lease_state() is None:
            one.take()


def test_a_jog_under_way_obeys_its_holder_only(one):
    token = one.take()
    one.desk.begin_jog(messages.BeginJog(), "held", token)
    order = one.desk.next_order()
    order.begin()
    asked = messages.JogAt(velocity_m_per_s=0.01)
    one.desk.jog_at("held", asked, token)
    for ask in (
        lambda: one.desk.jog_at("held", messages.JogAt(velocity_m_per_s=0.02), "guessed"),
        lambda: one.desk.begin_jog(messages.BeginJog(), "again", "guessed"),
    ):
        with pytest.raises(LeaseRefused):
            ask()
        assert order.wanted_m_per_s() == 0.01


def test_the_service_s_own_command_goes_under_the_lease_that_somebody_holds(one):
    one.desk.submit_own("probe", messages.Probe())
    assert one.desk.next_order() is None
    token = one.take()
    one.desk.submit_own("probe", messages.Probe())
    order = one.desk.next_order()
    assert (order.name, order.token) == ("probe", token)
    one.now_s = 102.0
    one.desk.submit_own("probe", messages.Probe())
    assert one.desk.next_order() is None


# ---- what needs no lease: a run --------------------------------------------------------------------------------------


def test_a_run_is_asked_for_again_only_when_it_shows_what_became_of_the_last(one):
    """Two within a moment were both accepted, and one had no run."""
    idle = NO_STATUS.model_copy(update={"recording": None})
    one.desk.profile = load_profile("single-axis")
    one.desk.publish(idle, State.IDLE)
    one.desk.ask_to_record("first")
    for _ in ("on its way", "taken, and not shown yet"):
        with pytest.raises(Busy, match="another client asks the same just now"):
            one.desk.ask_to_record("second")
        one.desk.next_record_request()
    begins = messages.Recording(run="", trigger="", rows_count=0, trouble="", next_name="first")
    one.desk.publish(NO_STATUS.model_copy(update={"recording": begins}), State.IDLE)
    with pytest.raises(Busy, match="name second: first was asked for before"):
        one.desk.ask_to_record("second")
    one.desk.publish(idle, State.IDLE)
    one.desk.ask_to_record("second")
    assert one.desk.next_record_request() == "second"
