"""The lease on motion: one holder, renewed, with a deadman. Pure; time is an argument, seconds of any steady clock."""

import math
from dataclasses import dataclass

from stagectl.errors import RequestError

LEAST_S, MOST_S = 0.2, 30.0
"""How long a lease may last without being renewed."""

GRACE_S = 1.0
"""What a stage that holds still has of a lease that was given back: time to be asked to stop."""


@dataclass(frozen=True, slots=True)
class Lease:
    """Who may move the stage, and until when."""

    token: str
    holder: str
    duration_s: float
    until_s: float
    released: bool = False

    def left_s(self, now_s: float) -> float:
        """Time until the stage stops by itself, 0 from then on."""
        return max(self.until_s - now_s, 0.0)


class LeaseRefused(RequestError):
    """Somebody else holds the lease, or this one is none."""


def take(lease: Lease | None, token: str, holder: str, duration_s: float, now_s: float, powered: bool) -> Lease:
    """Begin a lease; LeaseRefused while another lasts, and while the stage that it moved still has power.

    A lease that ran out is no way to a stage that moves: the next holder's would keep alive what the last one began.
    """
    if not LEAST_S <= duration_s <= MOST_S:  # nan is refused too
        raise RequestError(f"duration_s is {duration_s:g}; a lease lasts {LEAST_S:g} .. {MOST_S:g} s between renewals")
    if lease is not None and lease.left_s(now_s) > 0.0:
        how = "is giving it back" if lease.released else "holds the lease"
        raise LeaseRefused(
            f"{lease.holder} {how} for {lease.left_s(now_s):.1f} s more; one operator at a time: ask them, or wait"
        )
    if powered:
        raise LeaseRefused("the stage is still coming to rest after the last lease; wait until it has no power")
    return Lease(token, holder, duration_s, now_s + duration_s)


def renew(lease: Lease | None, token: str, now_s: float) -> Lease:
    """Prolong a lease by its duration; LeaseRefused where it is over, given back or another's."""
    held = holds(lease, token, now_s)
    return Lease(held.token, held.holder, held.duration_s, now_s + held.duration_s)


def give_back(lease: Lease | None, token: str, now_s: float, powered: bool) -> Lease | None:
    """End a lease; of a stage with power a short rest stays, in which it is brought to rest. Errors: LeaseRefused."""
    held = holds(lease, token, now_s)
    if not powered:
        return None
    return Lease(held.token, held.holder, held.duration_s, now_s + min(GRACE_S, held.left_s(now_s)), released=True)


def holds(lease: Lease | None, token: str, now_s: float) -> Lease:
    """Return the lease that `token` is for; LeaseRefused where it holds none."""
    if lease is None or not math.isfinite(now_s):
        raise LeaseRefused("nobody holds the lease on motion; take it first")
    if lease.token != token:
        raise LeaseRefused(f"this is not the lease that {lease.holder} holds; take one when it is free")
    if lease.released or not lease.left_s(now_s) > 0.0:
        raise LeaseRefused(
            f"the lease of {lease.holder} is over, after {lease.duration_s:g} s without a renewal; take a new one"
        )
    return lease
