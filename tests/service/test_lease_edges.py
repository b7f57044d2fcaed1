"""The lease at its edges, each by hand: what `python -m bench service --part mutants` would change is noticed here."""

import math

import pytest

from stagectl.errors import RequestError
from stagectl.service import lease as leases

HELD = leases.Lease("t", "anna", 2.0, 10.0)
GIVEN = leases.Lease("t", "anna", 2.0, 10.0, released=True)


def test_the_limits_are_what_the_documents_say():
    assert (leases.LEAST_S, leases.MOST_S, leases.GRACE_S) == (0.2, 30.0, 1.0)


def test_what_is_left_never_is_less_than_nothing():
    assert HELD.left_s(9.5) == 0.5
    assert HELD.left_s(10.0) == HELD.left_s(11.0) == 0.0


@pytest.mark.parametrize("duration_s", [0.2, 30.0])
def test_the_shortest_and_the_longest_lease(duration_s):
    taken = leases.take(None, "u", "bert", duration_s, 5.0, powered=False)
    assert taken == leases.Lease("u", "bert", duration_s, 5.0 + duration_s)
    assert taken.released is False


@pytest.mark.parametrize("duration_s", [0.1999, 30.001, math.nan])
def test_a_lease_of_another_length_is_refused_before_anything_else(duration_s):
    with pytest.raises(RequestError, match=r"a lease lasts 0\.2 \.\. 30 s") as refused:
        leases.take(HELD, "u", "bert", duration_s, 5.0, powered=True)
    assert not isinstance(refused.value, leases.LeaseRefused)


def test_who_stands_in_the_way_is_said():
    with pytest.raises(leases.LeaseRefused, match=r"^anna holds the lease for 0\.5 s more; one operator at a time"):
        leases.take(HELD, "u", "bert", 1.0, 9.5, powered=False)
    with pytest.raises(leases.LeaseRefused, match=r"^anna is giving it back for 0\.5 s more"):
        leases.take(GIVEN, "u", "bert", 1.0, 9.5, powered=False)


def test_a_lease_is_over_at_its_end_and_only_a_stage_without_power_is_taken():
    assert leases.take(HELD, "u", "bert", 1.0, 10.0, powered=False).holder == "bert"
    for lease in (HELD, None):
        with pytest.raises(leases.LeaseRefused, match="still coming to rest after the last lease"):
            leases.take(lease, "u", "bert", 1.0, 10.0, powered=True)


def test_renewing_counts_from_now():
    assert leases.renew(HELD, "t", 9.5) == leases.Lease("t", "anna", 2.0, 11.5)


def test_giving_back_leaves_a_moving_stage_time_to_be_stopped():
    assert leases.give_back(HELD, "t", 8.5, powered=False) is None
    assert leases.give_back(HELD, "t", 8.5, powered=True) == leases.Lease("t", "anna", 2.0, 9.5, released=True)
    assert leases.give_back(HELD, "t", 9.75, powered=True) == leases.Lease("t", "anna", 2.0, 10.0, released=True)


@pytest.mark.parametrize(
    ("lease", "token", "now_s", "words"),
    [
        (None, "t", 1.0, "nobody holds the lease"),
        (HELD, "t", math.nan, "nobody holds the lease"),
        (HELD, "t", math.inf, "nobody holds the lease"),
        (None, "t", math.nan, "nobody holds the lease"),
        (HELD, "u", 1.0, "not the lease that anna holds"),
        (GIVEN, "t", 9.0, "the lease of anna is over"),
        (HELD, "t", 10.0, r"is over, after 2 s without a renewal"),
        (GIVEN, "u", 11.0, "not the lease that anna holds"),
    ],
)
@pytest.mark.parametrize("ask", ["holds", "renew", "give_back"])
def test_whoever_does_not_hold_it_is_refused(lease, token, now_s, words, ask):
    asked = {
        "holds": lambda: leases.holds(lease, token, now_s),
        "renew": lambda: leases.renew(lease, token, now_s),
        "give_back": lambda: leases.give_back(lease, token, now_s, powered=True),
    }
    with pytest.raises(leases.LeaseRefused, match=words):
        asked[ask]()


def test_the_holder_is_told_what_is_held():
    assert leases.holds(HELD, "t", 9.999) is HELD
