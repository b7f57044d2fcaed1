"""The lease: one holder at a time, whatever order requests come in, and no way to prolong what is over."""

import math

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from stagectl.errors import RequestError
from stagectl.service import lease as leases
from stagectl.service.lease import GRACE_S, LEAST_S, MOST_S, LeaseRefused

TOKENS = ("anna", "bert", "carl")


class Operators(RuleBasedStateMachine):
    """Three operators, a clock, and a stage that may have power; beside it a model of one line each."""

    def __init__(self):
        super().__init__()
        self.now_s = 100.0
        self.lease = None
        self.powered = False
        self.holder, self.until_s, self.duration_s, self.released = "", 0.0, 0.0, False

    def holds(self, who):
        return who == self.holder and self.now_s < self.until_s and not self.released

    @rule(passed_s=st.sampled_from([0.0, 0.1, 0.5, 1.0, 5.0]))
    def time_passes(self, passed_s):
        self.now_s += passed_s

    @rule(powered=st.booleans())
    def power(self, powered):
        self.powered = powered

    @rule(who=st.sampled_from(TOKENS), duration_s=st.sampled_from([LEAST_S, 1.0, MOST_S]))
    def take(self, who, duration_s):
        free = not (self.holder and self.now_s < self.until_s) and not self.powered
        try:
            self.lease = leases.take(self.lease, who, who, duration_s, self.now_s, self.powered)
        except LeaseRefused:
            assert not free
            return
        assert free
        self.holder, self.until_s, self.duration_s, self.released = who, self.now_s + duration_s, duration_s, False

    @rule(who=st.sampled_from(TOKENS))
    def renew(self, who):
        try:
            self.lease = leases.renew(self.lease, who, self.now_s)
        except LeaseRefused:
            assert not self.holds(who)
            return
        assert self.holds(who)
        self.until_s = self.now_s + self.duration_s

    @rule(who=st.sampled_from(TOKENS))
    def give_back(self, who):
        try:
            self.lease = leases.give_back(self.lease, who, self.now_s, self.powered)
        except LeaseRefused:
            assert not self.holds(who)
            return
        assert self.holds(who)
        if self.powered:
            self.released, self.until_s = True, min(self.until_s, self.now_s + GRACE_S)
        else:
            self.holder = ""

    @invariant()
    def one_holder_and_its_time(self):
        assert sum(self.accepted(who) for who in TOKENS) <= 1
        for who in TOKENS:
            assert self.accepted(who) == self.holds(who)
        left_s = 0.0 if self.lease is None else self.lease.left_s(self.now_s)
        assert left_s == pytest.approx(max(self.until_s - self.now_s, 0.0) if self.holder else 0.0)

    def accepted(self, who):
        try:
            leases.holds(self.lease, who, self.now_s)
        except LeaseRefused:
            return False
        return True


TestOperators = Operators.TestCase
TestOperators.settings = settings(max_examples=150, stateful_step_count=40)


@pytest.mark.parametrize("duration_s", [0.0, -1.0, 0.19, 30.1, math.nan, math.inf])
def test_a_lease_lasts_what_it_may(duration_s):
    with pytest.raises(RequestError, match=r"a lease lasts 0.2 .. 30 s"):
        leases.take(None, "t", "anna", duration_s, 0.0, powered=False)


def test_a_lease_that_ran_out_is_no_way_to_a_stage_that_moves():
    held = leases.take(None, "t", "anna", 1.0, 0.0, powered=False)
    assert held.left_s(1.0) == 0.0
    with pytest.raises(LeaseRefused, match="still coming to rest"):
        leases.take(held, "u", "bert", 1.0, 1.5, powered=True)
    with pytest.raises(LeaseRefused, match="over, after 1 s"):
        leases.renew(held, "t", 1.0)


def test_the_clock_may_not_be_nan():
    held = leases.take(None, "t", "anna", 1.0, 0.0, powered=False)
    with pytest.raises(LeaseRefused):
        leases.holds(held, "t", math.nan)
