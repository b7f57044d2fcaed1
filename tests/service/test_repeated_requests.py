"""Requests whose answers get lost, and that are said again: each is carried out once, on a stage in virtual time."""

import contextlib
import math

import httpx
import pytest

from stagectl.client import Client
from stagectl.errors import JogOver, LinkError, RequestError
from stagectl.profile import load_profile
from stagectl.service import messages
from stagectl.service.desk import Desk, Unfit
from stagectl.service.lease import LeaseRefused
from stagectl.service.service_log import ServiceLog
from stagectl.service.states import State
from stagectl.service.used_keys import ANSWERS_COUNT, Used, UsedKeys, digest
from tests.service.served import Served

KEY = "a-key-that-nobody-guesses"
STEP_M = 1e-3


class Losing(httpx.HTTPTransport):
    """A link that loses answers, as many as it is told to, behind a service that has heard what was asked."""

    def __init__(self, path):
        super().__init__(uds=str(path))
        self.lost_count = 0
        self.asked = []

    def handle_request(self, request):
        answer = super().handle_request(request)
        self.asked.append((request.method, request.url.path, request.headers.get("Idempotency-Key", "")))
        if self.lost_count > 0:
            self.lost_count -= 1
            answer.read()
            raise httpx.ReadError("the answer was lost on its way")
        return answer


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    made = Served(tmp_path_factory.mktemp("repeated"))
    yield made
    made.close()


@pytest.fixture
def idle(served):
    served.recovers()
    yield served
    served.recovers()


@pytest.fixture
def losing(idle):
    """A client whose answers get lost: (client, its link)."""
    client = Client(idle.socket)
    client.close()
    link = Losing(idle.socket)
    client._http = httpx.Client(transport=link, base_url="http://stagectl", trust_env=False)
    with client:
        yield client, link


def holds_m(served):
    """Where the stage holds, once that is told of it behind its last command."""
    served.until(lambda: served.desk.status().command is None)
    return served.desk.status().positions.setpoint_position_m


def said(served, event):
    """How often the log says so."""
    return sum(entry.event == event for entry in served.log.last(2000))


# ---- the client: an answer that is lost is asked for again -----------------------------------------------------------


def test_a_lease_whose_answer_was_lost_is_had_by_asking_again(idle, losing):
    client, link = losing
    before = said(idle, "lease_taken")
    link.lost_count = 1
    taken = client.take_lease("anna", 5.0)
    assert client.lease_token == taken.token
    assert client.renew_lease().token == taken.token
    assert said(idle, "lease_taken") == before + 1
    (first, second) = [key for method, _, key in link.asked if method == "POST"]
    assert first == second != ""
    with Client(idle.socket) as other, pytest.raises(RequestError, match="anna holds the lease"):
        other.take_lease("anna", 5.0)  # the same words, another key


def test_a_relative_motion_whose_answer_was_lost_is_done_once(idle, losing):
    client, link = losing
    client.take_lease("anna", 30.0)
    client.arm()
    before_m, commands = holds_m(idle), said(idle, "command")
    link.lost_count = 1
    assert client.jog(STEP_M).stop == "FINISHED"
    assert said(idle, "command") == commands + 1
    assert holds_m(idle) == pytest.approx(before_m + STEP_M, abs=1e-9)
    link.lost_count = 1
    client.give_lease_back()
    assert client.lease_token == ""
    idle.state_is("idle")


def test_a_caller_who_lost_every_answer_asks_again_with_his_own_key(idle, losing):
    client, link = losing
    client.take_lease("anna", 30.0)
    client.arm()
    before_m = holds_m(idle)
    body = messages.JogBy(distance_m=STEP_M)
    link.lost_count = 2
    with pytest.raises(LinkError):
        client.begin("jog", body, "mine")
    assert link.lost_count == 0
    assert client.begin("jog", body, "mine").key == "mine"
    idle.until(lambda: client.command("mine").state == "done")
    assert client.begin("jog", body, "mine").state == "done"
    assert holds_m(idle) == pytest.approx(before_m + STEP_M, abs=1e-9)
    with pytest.raises(RequestError, match="key 'mine' was used for another jog; take a new key for a new command"):
        client.begin("jog", messages.JogBy(distance_m=2.0 * STEP_M), "mine")


WATCHING = {"check", "close", "command", "fault", "lease_state", "log", "metrics", "runs", "status", "stream_state"}
BY_OTHER_MEANS = {"lease", "do"}  # made of others that stand here
COMMANDS = {
    "take_lease": lambda client: client.take_lease("anna"),
    "renew_lease": lambda client: client.renew_lease(),
    "give_lease_back": lambda client: client.give_lease_back(),
    "arm": lambda client: client.arm(),
    "home": lambda client: client.home(),
    "move": lambda client: client.move(0.0),
    "jog": lambda client: client.jog(0.0),
    "identify": lambda client: client.identify(),
    "probe": lambda client: client.probe(),
    "acknowledge": lambda client: client.acknowledge(1),
    "swap_backend": lambda client: client.swap_backend("rig"),
    "begin_jog": lambda client: client.begin_jog(),
    "jog_at": lambda client: client.jog_at(KEY, 0.0),
    "scan": lambda client: client.scan(messages.Scan(segments=[messages.Segment(target_m=0.0)])),
    "follow": lambda client: client.follow("table.csv"),
    "send_setpoints": lambda client: client.send_setpoints(0, 0.01, [0.0]),
    "stream": lambda client: client.stream([0.0] * 60, 0.01),
    "stop": lambda client: client.stop(),
    "record": lambda client: client.record(),
    "end_record": lambda client: client.end_record(),
    "set_trigger": lambda client: client.set_trigger(messages.SetTrigger()),
    "end_trigger": lambda client: client.end_trigger(),
    "begin": lambda client: client.begin("arm", messages.Arm()),
}


def test_no_command_of_the_client_is_missing_here():
    public = {name for name in vars(Client) if not name.startswith("_")}
    assert public == WATCHING | BY_OTHER_MEANS | set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_of_the_client_says_itself_again_with_the_same_key(losing, tmp_path, monkeypatch, name):
    client, link = losing
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.csv").write_text("t_s,position_m\n0,0\n1,0\n")
    client.lease_token = "none"  # what needs a lease is refused, when it has been heard
    link.lost_count = 1
    with contextlib.suppress(RequestError, LinkError):
        COMMANDS[name](client)
    client.lease_token = ""
    asked = [one for one in link.asked if one[0] != "GET"]
    if name in ("renew_lease", "jog_at"):  # named by the lease's token and the jog's key; said anew by who holds it
        return
    assert len(asked) == 2
    assert asked[0] == asked[1]
    if name != "stop":  # never refused, whatever was said before
        assert asked[0][2]


# ---- the service: a key is for one request ---------------------------------------------------------------------------


def test_a_trigger_that_comes_twice_waits_once(idle):
    trigger = messages.SetTrigger(name="twice")
    idle.desk.set_trigger(trigger, "t1")
    idle.until(lambda: idle.client.status().recording.waits_for == "reversal, 1 times")
    idle.desk.set_trigger(None, "t2")
    idle.until(lambda: idle.client.status().recording.waits_for == "")
    before = said(idle, "trigger")
    idle.desk.set_trigger(trigger, "t1")
    idle.desk.set_trigger(None, "t2")
    assert said(idle, "trigger") == before
    with pytest.raises(Unfit, match="key 't1' was used for another trigger"):
        idle.desk.set_trigger(messages.SetTrigger(name="other"), "t1")


def test_a_run_that_was_asked_for_twice_begins_once(idle):
    recording = idle.desk.status
    idle.desk.ask_to_record("once", "r1")
    idle.until(lambda: "once" in recording().recording.run)
    idle.desk.ask_to_record("", "r2")
    idle.until(lambda: recording().recording.run == "")
    idle.desk.ask_to_record("once", "r1")
    idle.desk.ask_to_record("", "r2")
    assert idle.desk.next_record_request() is None
    with pytest.raises(Unfit, match="key 'r1' was used for another record"):
        idle.desk.ask_to_record("", "r1")


def test_a_stream_whose_beginning_comes_twice_is_followed_once(idle):
    client = idle.client
    client.take_lease("anna", 30.0)
    client.arm()
    at_m, before = holds_m(idle), said(idle, "command")
    there_and_back = [at_m + 1e-4 * (1.0 - math.cos(2.0 * math.pi * k / 49)) for k in range(50)]
    begun = client.send_setpoints(0, 0.02, there_and_back, last=True, key="s1")
    assert (begun.key, begun.next_number) == ("s1", 50)
    assert client.send_setpoints(0, 0.02, there_and_back, last=True, key="s1").key == "s1"
    idle.until(lambda: client.command("s1").state == "done")
    late = client.send_setpoints(0, 0.02, there_and_back, last=True, key="s1")  # would fit: it ended where it began
    assert (late.key, late.next_number, late.room_count) == ("s1", 50, 0)
    assert said(idle, "command") == before + 1
    with pytest.raises(RequestError, match="key 's1' was used for another setpoints"):
        client.send_setpoints(0, 0.02, there_and_back, key="s1")
    client.send_setpoints(0, 0.02, there_and_back[:1] * 30, key="s2")
    with pytest.raises(RequestError, match="set-point 30 is of the stream s1, not of s2"):
        client.send_setpoints(30, 0.02, there_and_back[:1], key="s1")
    assert client.send_setpoints(30, 0.02, there_and_back[:1], last=True, key="s2").next_number == 31
    idle.until(lambda: client.command("s2").state == "done")


class Counter:
    """A desk of a stage that is armed, with a clock set by hand, whose commands end as soon as they begin."""

    def __init__(self):
        self.now_s = 0.0
        self.desk = Desk(ServiceLog(None), lambda: self.now_s)
        self.desk._state = State.ARMED
        self.body = messages.TakeLease(holder="anna", duration_s=30.0)
        self.token = self.desk.take_lease(self.body, KEY).token
        self.done_count = 0

    def jog(self, key, distance_m=STEP_M):
        """Ask for a jog, and carry it out where that is one to be done."""
        answer = self.desk.submit("jog", messages.JogBy(distance_m=distance_m), key, self.token)
        order = self.desk.next_order()
        if order is not None:
            self.done_count += 1
            order.begin()
            order.finish("done", "FINISHED", "", None)
        return answer


def test_a_key_is_never_done_again_however_many_came_since():
    one = Counter()
    keys = [f"jog-{k}" for k in range(3 * ANSWERS_COUNT)]
    for key in keys:
        one.jog(key)
    assert one.done_count == len(keys)
    for key in keys[-ANSWERS_COUNT:]:
        assert one.jog(key).state == "done"
    for key in keys[:-ANSWERS_COUNT]:
        with pytest.raises(Unfit, match=f"key '{key}' was used more than 1000 keys ago: .* take a new key"):
            one.jog(key)
    with pytest.raises(Unfit, match="more than 1000 keys ago"):
        one.desk.take_lease(one.body, KEY)
    assert one.done_count == len(keys)


def test_who_waits_for_a_command_hears_its_end_whatever_keys_are_used_meanwhile():
    one = Counter()
    one.desk.submit("jog", messages.JogBy(distance_m=STEP_M), "long", one.token)
    order = one.desk.next_order()
    order.begin()
    one.desk.profile = load_profile("single-axis")
    for k in range(ANSWERS_COUNT + 1):
        one.desk.set_trigger(None, f"r{k}")
    assert one.desk.command("long").state == "running"
    with pytest.raises(Unfit, match="key 'long' was used more than 1000 keys ago"):
        one.jog("long")
    order.finish("done", "FINISHED", "", None)
    assert one.desk.command("long").state == "done"
    assert one.desk.command(KEY) is None  # a lease's, and forgotten


def test_the_filter_forgets_no_key_and_takes_few_for_used():
    used, count = UsedKeys(), 20_000
    for k in range(count):
        used.keep(f"used-{k}", Used("jog", digest(""), None))
    assert all(used.was_used_long_ago(f"used-{k}") for k in range(count - ANSWERS_COUNT))
    assert not any(used.was_used_long_ago(f"new-{k}") for k in range(count))
    assert used.find("used-0") is None
    assert used.find(f"used-{count - 1}") is not None


def test_the_same_lease_is_given_again_only_while_it_lasts():
    one = Counter()
    one.now_s = 20.0
    again = one.desk.take_lease(one.body, KEY)
    assert (again.token, again.left_s) == (one.token, 10.0)  # as it stands, not prolonged
    for body in (messages.TakeLease(holder="bert", duration_s=30.0), messages.TakeLease(holder="anna", duration_s=1.0)):
        with pytest.raises(Unfit, match=f"key '{KEY}' was used for another lease"):
            one.desk.take_lease(body, KEY)
    with pytest.raises(LeaseRefused, match="anna holds the lease"):
        one.desk.take_lease(one.body, "another-key-than-that")
    one.now_s = 30.0
    with pytest.raises(LeaseRefused, match="the lease that key 'a-key-that-nobody-guesses' took is over"):
        one.desk.take_lease(one.body, KEY)
    bert = one.desk.take_lease(messages.TakeLease(holder="bert", duration_s=1.0)).token
    with pytest.raises(LeaseRefused, match="is over; take another one with a new key"):
        one.desk.take_lease(one.body, KEY)
    assert one.desk.renew_lease(bert).holder == "bert"


def test_a_lease_given_back_twice_is_no_error_and_takes_nobody_else_s():
    one = Counter()
    one.desk.give_lease_back(one.token, "back")
    one.desk.give_lease_back(one.token, "back")
    bert = one.desk.take_lease(messages.TakeLease(holder="bert", duration_s=1.0)).token
    one.desk.give_lease_back(one.token, "back")
    assert one.desk.renew_lease(bert).holder == "bert"
    with pytest.raises(Unfit, match="key 'back' was used for another lease given back"):
        one.desk.give_lease_back(bert, "back")


def test_a_lease_s_key_is_none_that_two_may_have_by_chance(idle):
    for key in ("1", "fifteen-letters"):
        with pytest.raises(RequestError, match="at least 16 characters"):
            idle.client.take_lease("anna", key=key)


def test_a_jog_that_was_braked_by_a_key_is_not_begun_by_it_later():
    one = Counter()
    begin = messages.BeginJog()
    assert one.desk.begin_jog(begin, "first", one.token).key == "first"
    order = one.desk.next_order()
    order.begin()
    assert one.desk.begin_jog(begin, "second", one.token).key == "first"
    one.desk.jog_at("first", messages.JogAt(velocity_m_per_s=0.01), one.token)
    assert one.desk.begin_jog(begin, "second", one.token).key == "first"  # said twice: brakes once
    assert order.wanted_m_per_s() == 0.01
    order.finish("let go", "FINISHED", "", None)
    assert one.desk.begin_jog(begin, "second", one.token).state == "done"
    assert one.desk.next_order() is None
    with pytest.raises(JogOver):
        one.desk.jog_at("first", messages.JogAt(velocity_m_per_s=0.01), one.token)
