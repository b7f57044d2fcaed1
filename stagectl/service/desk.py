"""Where clients and the stage meet: the lease, the one command at a time, and the newest status.

Any thread may call it; nothing here touches the stage. The stage's thread takes orders and publishes.
"""

import contextlib
import hmac
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from pydantic import BaseModel

from stagectl.errors import JogOver, RequestError, StagectlError
from stagectl.motion import travel_from
from stagectl.profile import Profile
from stagectl.service import lease as leases
from stagectl.service import messages, plans, states
from stagectl.service.lease import Lease, LeaseRefused
from stagectl.service.motions import MOTIONS
from stagectl.service.recording import ARM, REQUEST
from stagectl.service.scope import Scope
from stagectl.service.service_log import ServiceLog, now_text
from stagectl.service.states import State
from stagectl.service.used_keys import ANSWERS_COUNT, Used, UsedKeys, digest
from stagectl.service.view import jog_velocity_m_per_s
from stagectl.streaming import SetpointBuffer


class Busy(RequestError):
    """Another command is under way, or the stage is coming to rest."""


class Unfit(RequestError):
    """A value can't be on this stage, or a key was used for something else, or long ago."""


class Ending(RequestError):
    """The service is ending."""


class Order:
    """A command on its way through the service; kept as text once it is over, for who asks again."""

    def __init__(
        self,
        key: str,
        name: str,
        body: Any,
        token: str,
        clock_s: Callable[[], float],
        plan: plans.Plan | None = None,
    ):
        """Wait to be carried out; `plan` is what was planned for it."""
        self.key, self.name, self.token = key, name, token
        self.body: Any = body
        """What it asks for, until it was put by."""
        self.plan: Any = None if plan is None else plan.motion
        """What was planned for it, until it is over."""
        self._remark = "" if plan is None else plan.remark
        self._clock_s = clock_s
        self._message: messages.Command | bytes
        self._message = messages.Command(key=key, name=name, state="waiting", share=0.0, at=now_text())
        self._velocity_m_per_s, self._until_s = 0.0, -math.inf

    def message(self) -> messages.Command:
        """Return what there is to say of it; the next change makes a new message."""
        message = self._message
        return messages.Command.model_validate_json(message) if isinstance(message, bytes) else message

    def put_by(self) -> None:
        """Become small, where nothing more will become of it: a thousand of them are kept."""
        message = self._message
        if not isinstance(message, bytes) and self.over:
            self.body = None
            self._message = message.model_dump_json().encode()

    @property
    def over(self) -> bool:
        """Whether nothing more will become of it."""
        message = self._message
        return isinstance(message, bytes) or message.state in ("done", "failed")

    def begin(self) -> None:
        """It is being carried out."""
        self._change(state="running")

    def progress(self, what: str, share: float) -> None:
        """Say how far it is."""
        self._change(text=what, share=min(max(share, 0.0), 1.0))

    def finish(self, text: str, stop: str, run: str, backlash: messages.Backlash | None) -> None:
        """It came to an end; `stop` says which."""
        text = f"{text}. {self._remark}" if self._remark else text
        self.plan = None
        self._change(state="done", share=1.0, text=text, stop=stop, run=run, backlash=backlash)

    def fail(self, error: StagectlError) -> None:
        """It was refused, or something broke."""
        self.plan = None
        failure = messages.Failure(kind=type(error).__name__, message=str(error))
        self._change(state="failed", text=str(error), error=failure)

    def _change(self, **changes: Any) -> None:
        if not self.over:  # what was told once stays so
            self._message = self.message().model_copy(update=changes)

    def hold(self, velocity_m_per_s: float, hold_s: float) -> None:
        """Have a jog go on at this velocity for so long."""
        self._velocity_m_per_s, self._until_s = velocity_m_per_s, self._clock_s() + hold_s

    def wanted_m_per_s(self) -> float | None:
        """Return the velocity that is wanted now; None where nobody holds the key any more."""
        return self._velocity_m_per_s if self._clock_s() < self._until_s else None


@contextlib.contextmanager
def _unfit() -> Iterator[None]:
    """Say of what a plan refuses that the values don't fit."""
    try:
        yield
    except RequestError as error:
        raise Unfit(str(error)) from error


_FOUND_LAST = "that is the joint as it was found last: `stagectl home` finds it anew"


def _not_connected(name: str) -> RequestError:
    return RequestError(f"{name}: the stage is not connected; `stagectl status` says what it waits for")


def _stream_begun(order: Order, count: int) -> messages.StreamState:
    """Say how a stream stands to who asks again whether it began, with so many set-points."""
    buffer = order.plan
    over = messages.StreamState(key=order.key, next_number=count, ahead_s=0.0, room_count=0)
    return over if buffer is None else _stream_state(order.key, buffer)


def _stream_state(key: str, buffer: SetpointBuffer) -> messages.StreamState:
    return messages.StreamState(
        key=key, next_number=buffer.next_number, ahead_s=buffer.ahead_s, room_count=buffer.room_count
    )


class Desk:
    """What clients and the stage's thread share."""

    def __init__(self, log: ServiceLog, clock_s: Callable[[], float] = time.monotonic):
        """Nobody holds the lease, nothing is under way."""
        self._log, self._clock_s = log, clock_s
        self._lock = threading.RLock()
        self._lease: Lease | None = None
        self._keys = UsedKeys()
        self._current: Order | None = None
        self._waiting: Order | None = None
        self._own: Order | None = None  # the service's own command, that others wait for
        self._own_began_m: float | None = None  # where the stage held then, and will again
        self._stop_reason = ""
        self._stops_count = 0
        self._stop = threading.Event()
        self._record_request: str | None = None
        self._record_taken = False  # and the status does not show yet what became of it
        self._plans = threading.Lock()
        """One motion is planned at a time: a table of 60,000 rows takes a second of the processor."""
        self._trigger_request: messages.SetTrigger | str | None = None
        self._closed = False
        self._status: messages.Status | None = None
        self._state = State.OFF
        self.powered = False
        """Whether the stage's thread has the stage in a state with power."""
        self.profile: Profile | None = None
        self.joint: dict[str, float] | None = None
        """Edges and stiffnesses that a sweep would go by, as far as is known; None for the profile's."""
        self.scope = Scope(1000.0)

    # ---- what the stage's thread does ------------------------------------------------------------------------

    def publish(self, status: messages.Status, state: State) -> None:
        """Put the newest status out."""
        self._status, self._state = status, state
        self._record_taken = False
        if self._lease is not None and self._lease.released and not self.powered:
            with self._lock:
                if self._lease is not None and self._lease.released:  # not one that was just taken
                    self._lease = None

    def next_order(self) -> Order | None:
        """Take the command that waits."""
        with self._lock:
            order, self._waiting = self._waiting, None
            return order

    def check_order(self, order: Order) -> None:
        """Refuse what may not begin any more."""
        if self._stop.is_set():
            raise Busy(f"{order.name}: stopped before it began: {self._stop_reason}")
        with self._lock:
            leases.holds(self._lease, order.token, self._clock_s())

    @property
    def stop_asked(self) -> bool:
        """Whether somebody asked for rest, and it was not seen to yet."""
        return self._stop.is_set()

    @property
    def stop_reason(self) -> str:
        """Why."""
        return self._stop_reason

    def stopped(self) -> None:
        """The stage was brought to rest; what waited when that was asked for is not begun."""
        with self._lock:  # whoever asked may be on the way here still: what waits must not come before that
            self._drop_waiting(self._stop_reason)
            self._stop.clear()

    def lease_left_s(self) -> float:
        """Return how long the stage may still move."""
        lease = self._lease
        return 0.0 if lease is None else lease.left_s(self._clock_s())

    def close(self) -> None:
        """Take no more commands; what waits is refused."""
        with self._lock:
            self._closed = True
            self._drop_waiting("the service is ending")

    def next_record_request(self) -> str | None:
        """Take the name of a run that somebody asked for, "" for its end; None where nobody asked."""
        if self._record_request is None:
            return None
        with self._lock:
            asked, self._record_request = self._record_request, None
            self._record_taken = True
            return asked

    def next_trigger_request(self) -> messages.SetTrigger | str | None:
        """Take the event that somebody wants recorded, "" where none any more; None where nobody asked."""
        if self._trigger_request is None:
            return None
        with self._lock:
            asked, self._trigger_request = self._trigger_request, None
            return asked

    # ---- what clients do -------------------------------------------------------------------------------------

    def status(self) -> messages.Status:
        """Return the newest status; Ending before there is one."""
        if self._status is None:
            raise Ending("the service has just begun; ask again")
        return self._status.model_copy(update={"lease": self.lease_state()})

    def lease_state(self) -> messages.LeaseState | None:
        """Say who holds the lease, without its token."""
        lease = self._lease
        left_s = 0.0 if lease is None else lease.left_s(self._clock_s())
        if lease is None or left_s == 0.0:
            return None
        return messages.LeaseState(holder=lease.holder, left_s=left_s, duration_s=lease.duration_s)

    def is_lease_token(self, token: str) -> bool:
        """Tell whether a client gave the token of the lease that lasts; compares in a time that says nothing."""
        lease = self._lease
        if lease is None or not lease.left_s(self._clock_s()) > 0.0:
            return False
        return hmac.compare_digest(lease.token.encode(), token.encode(errors="replace"))

    def take_lease(self, body: messages.TakeLease, key: str = "") -> messages.TakenLease:
        """Give the lease to a client; with the same key again, the same one. Errors: LeaseRefused, RequestError."""
        with self._lock:
            used = self._used(key, "lease", body)
            if used is not None:
                return self._taken_before(key, used.answer)
            self._refuse_when_closed()
            token = secrets.token_urlsafe(24)
            now_s = self._clock_s()
            self._lease = leases.take(self._lease, token, body.holder, body.duration_s, now_s, self._busy)
            self._keep(key, "lease", body, token)
            self._log.say("lease_taken", holder=body.holder, duration_s=body.duration_s)
            return self._taken(self._lease)

    def _taken_before(self, key: str, token: str) -> messages.TakenLease:
        try:
            return self._taken(leases.holds(self._lease, token, self._clock_s()))
        except LeaseRefused as error:
            raise LeaseRefused(f"the lease that key {key!r} took is over; take another one with a new key") from error

    def renew_lease(self, token: str) -> messages.TakenLease:
        """Prolong a client's lease. Errors: LeaseRefused."""
        with self._lock:
            self._lease = leases.renew(self._lease, token, self._clock_s())
            return self._taken(self._lease)

    def give_lease_back(self, token: str, key: str = "") -> None:
        """End a client's lease; a stage with power is brought to rest. Errors: LeaseRefused, Unfit."""
        with self._lock:
            if self._used(key, "lease given back", token) is not None:
                return
            held = leases.holds(self._lease, token, self._clock_s())
            busy = self._busy
            self._lease = leases.give_back(self._lease, token, self._clock_s(), busy)
            self._keep(key, "lease given back", token)
            self._log.say("lease_given_back", holder=held.holder)
            if busy:
                self.ask_to_stop(f"{held.holder} gave the lease back")

    @property
    def _busy(self) -> bool:
        """Whether the stage has power, or somebody's command is about to give it some.

        While a run is begun on a slow disk a lease may end; the next holder's would keep alive what the last one asked.
        """
        return self.powered or self._waiting is not None or (self._current is not None and not self._current.over)

    def _taken(self, lease: Lease) -> messages.TakenLease:
        left_s = lease.left_s(self._clock_s())
        return messages.TakenLease(holder=lease.holder, left_s=left_s, duration_s=lease.duration_s, token=lease.token)

    def ask_to_stop(self, reason: str) -> None:
        """Have the stage brought to rest; needs no lease. What waits is not begun.

        The word itself waits for no lock: others hold that while they write to the log.
        """
        self._stop_reason = reason
        self._stops_count += 1
        self._stop.set()
        with self._lock:
            self._drop_waiting(reason)
        self._log.say("stop", reason)

    def ask_to_record(self, name: str, key: str = "") -> None:
        """Begin a run, or end the one that was asked for (""); needs no lease. Errors: Busy, Ending, Unfit."""
        with self._lock:
            if self._used(key, "record", name) is not None:
                return
            self._refuse_when_closed()
            if self._record_request is not None or self._record_taken:
                raise Busy("another client asks the same just now; ask again")
            if self.profile is None:
                raise Busy("there is nothing to record: the stage is not connected")
            if name:
                self._refuse_second_run(name)
            self._record_request = name
            self._keep(key, "record", name)
            self._log.say("record", name or "end")

    def _refuse_second_run(self, name: str) -> None:
        """Refuse a run where one is under way that has the rows already; behind a motion's own it may begin. Busy."""
        under_way = None if self._status is None else self._status.recording
        if under_way is None:
            return
        if under_way.next_name:
            raise Busy(
                f"name {name}: {under_way.next_name} was asked for before, and is about to begin; it has the rows"
            )
        if not under_way.run or under_way.trigger == ARM:
            return
        remedy = "it has the rows already"
        if under_way.trigger == REQUEST:
            remedy = "end it (`stagectl record --end`), and ask again when that is done"
        raise Busy(f"name {name}: {under_way.run} is under way, begun by {under_way.trigger}; {remedy}")

    def set_trigger(self, body: messages.SetTrigger | None, key: str = "") -> None:
        """Wait for an event to record, or for none any more; needs no lease. Errors: Busy, Ending, Unfit."""
        asked = "" if body is None else body
        with self._lock:
            if self._used(key, "trigger", asked) is not None:
                return
            self._refuse_when_closed()
            profile = self.profile
            if body is not None and profile is None:
                raise Busy("there is nothing to record: the stage is not connected")
            if body is not None and profile is not None:
                if body.error_m is not None and body.contact_force_n is not None:
                    raise Unfit("error_m and contact_force_n are both given; give one, or none for a reversal")
                if profile.record.when == "always":
                    raise Unfit("record.when is always: the whole session is one run already; look into that")
                if not body.before_s + body.after_s <= profile.record.flight_s:
                    raise Unfit(
                        f"before_s + after_s are {body.before_s + body.after_s:g} s, record.flight_s keeps "
                        f"{profile.record.flight_s:g} s; ask for less, or raise it"
                    )
            self._trigger_request = asked
            self._keep(key, "trigger", asked)
            self._log.say("trigger", "none" if body is None else body.name)

    def _drop_waiting(self, reason: str) -> None:
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            waiting.fail(Busy(f"{waiting.name}: stopped before it began: {reason}"))

    def submit_planned(self, name: str, body: Any, key: str, token: str) -> messages.Command:
        """Plan a scan or a table, check it, and take it over like `submit`; plans without the desk's lock."""
        stops_count = self._stops_count
        with self._plans:
            with self._lock:
                used = self._used(key, name, plans.kept(body))
                if used is not None:
                    return used.answer.message()
            profile, holds_m = self._where_it_holds(name, token)
            self._check_values(name, body, self._homed_setpoint_m)
            with _unfit():
                plan = plans.planned(body, profile, holds_m)
            return self.submit(name, plans.kept(body), key, token, plan, stops_count)

    def check(self, name: str, body: Any, token: str) -> None:
        """Refuse a motion that this stage can't do, as submitting it would, and begin nothing.

        For whoever must home and arm first: both are motion too. Where the stage is not homed yet it will hold about
        the homed zero. Errors: RequestError and kinds.
        """
        with self._lock:
            self._refuse_when_closed()
            leases.holds(self._lease, token, self._clock_s())
            profile, holds_m, joint = self.profile, self._homed_setpoint_m or 0.0, self.joint
            if profile is None:
                raise _not_connected(name)
            self._check_values(name, body, holds_m)
            found = _FOUND_LAST if joint is not None and self._homed_setpoint_m is None else ""
        with self._plans, _unfit():
            plans.rehearse(body, profile, holds_m, joint, found)

    def take_setpoints(self, body: messages.Setpoints, token: str, key: str = "") -> messages.StreamState:
        """Begin a stream, or take what goes on with it; `key` is the stream's, the same with each of its blocks.

        Errors: RequestError and kinds; then none of it is taken.
        """
        with self._lock:
            used = self._used(key, "setpoints", plans.kept(body)) if body.first_number == 0 else None
            if used is not None:
                return _stream_begun(used.answer, len(body.position_m))
            leases.holds(self._lease, token, self._clock_s())
            order = self._current
            known = order.plan if order is not None and order.name == "setpoints" and not order.over else None
            begun_period_s = order.body.period_s if order is not None and known is not None else None
            if known is not None and self._stop.is_set():
                raise Busy("the stage is coming to rest; wait until it stands")
        if order is not None and known is not None:
            with _unfit():
                if key and key != order.key:
                    raise RequestError(f"set-point {body.first_number} is of the stream {key}, not of {order.key}")
                if body.period_s != begun_period_s:
                    raise RequestError(f"period_s is {body.period_s:g}, the stream began with {begun_period_s:g}")
                known.take(body.first_number, body.position_m, body.last)
            return _stream_state(order.key, known)
        if body.first_number != 0:
            raise Unfit(f"set-point {body.first_number} comes too late: no stream is under way; begin with number 0")
        stops_count = self._stops_count
        profile, holds_m = self._where_it_holds("setpoints", token)
        with _unfit():
            plan = plans.streamed(body, profile, holds_m)
        key = key or f"stream-{secrets.token_hex(8)}"
        command = self.submit("setpoints", plans.kept(body), key, token, plan, stops_count)
        return _stream_state(command.key, plan.motion)

    def stream_state(self) -> messages.StreamState | None:
        """Say how the stream under way stands; None where there is none."""
        with self._lock:
            order = self._current
            buffer = order.plan if order is not None and order.name == "setpoints" else None
            return None if order is None or buffer is None else _stream_state(order.key, buffer)

    def _where_it_holds(self, name: str, token: str) -> tuple[Profile, float]:
        """Return profile and reference of a stage that can move now. Errors: RequestError and kinds."""
        with self._lock:
            self._refuse_when_closed()
            leases.holds(self._lease, token, self._clock_s())
            profile, holds_m = self.profile, self._setpoint_m
            states.after(self._state_then, MOTIONS[name].event, name)
        if profile is None or holds_m is None:
            raise _not_connected(name)
        return profile, holds_m

    def submit(
        self,
        name: str,
        body: Any,
        key: str,
        token: str,
        plan: plans.Plan | None = None,
        stops_count: int | None = None,
    ) -> messages.Command:
        """Take a command over, or return what became of it where its key was seen. Errors: RequestError and kinds.

        `stops_count` is how often a stop had been asked for when its planning began: what was asked for before a stop
        is not begun behind it.
        """
        with self._lock:
            used = self._used(key, name, body)
            if used is not None:
                return used.answer.message()
            if stops_count not in (None, self._stops_count):
                raise Busy(f"{name}: stopped before it began: {self._stop_reason}")
            self._refuse_when_closed()
            leases.holds(self._lease, token, self._clock_s())
            self._refuse_when_busy(name)
            if name in MOTIONS:
                states.after(self._state_then, MOTIONS[name].event, name)
            self._check_values(name, body, self._homed_setpoint_m)
            order = Order(key, name, body, token, self._clock_s, plan)
            if name == "jogging":
                order.hold(0.0, body.hold_s)
            self._keep_order(order, digest(body))
            return order.message()

    def submit_own(self, name: str, body: Any) -> None:
        """Submit a command of the service's own, under the lease that somebody holds; not where one is under way.

        It leaves the stage as it found it: what clients ask for meanwhile waits for its end, instead of being refused.
        """
        with self._lock, contextlib.suppress(RequestError):
            if self._lease is not None:
                holds_m = self._setpoint_m
                self.submit(name, body, f"own-{secrets.token_hex(8)}", self._lease.token)
                self._own, self._own_began_m = self._current, holds_m

    @property
    def _own_is_under_way(self) -> bool:
        """Whether the service's own command is what the stage does, or does next."""
        return self._own is not None and self._current is self._own and not self._own.over

    @property
    def _state_then(self) -> State:
        """The state in which a command begins that is taken over now."""
        return State.ARMED if self._own_is_under_way and self._state is State.IDENTIFYING else self._state

    @property
    def _setpoint_m(self) -> float | None:
        """Where the stage holds when such a command begins; None where nobody knows."""
        if self._own_is_under_way:
            return self._own_began_m
        return None if self._status is None else self._status.positions.setpoint_position_m

    @property
    def _homed_setpoint_m(self) -> float | None:
        """Where the stage holds, from the homed zero; None where that is not known."""
        return self._setpoint_m if self._status is not None and self._status.homed else None

    def begin_jog(self, body: messages.BeginJog, key: str, token: str) -> messages.Command:
        """Begin to jog, at rest, or brake the jog under way to go on with that. Errors: RequestError and kinds."""
        with self._lock:
            order = self._current
            if self._used(key, "jogging", body) is not None or order is None or order.name != "jogging" or order.over:
                return self.submit("jogging", body, key, token)
            leases.holds(self._lease, token, self._clock_s())
            self._refuse_when_stopping("jogging")
            order.hold(0.0, body.hold_s)
            self._keep(key, "jogging", body, order)
            return order.message()

    def jog_at(self, key: str, body: messages.JogAt, token: str) -> messages.Command:
        """Go on with the jog of that key at a velocity; one let go of stays so. Errors: RequestError and kinds.

        A request that was held up on its way begins nothing: whoever sent it may have let go of the key since.
        """
        with self._lock:
            leases.holds(self._lease, token, self._clock_s())
            self._refuse_when_stopping("jogging")
            order = self._current
            under_way = order is not None and order.key == key and order.name == "jogging" and not order.over
            if order is None or not under_way or order.wanted_m_per_s() is None:
                raise JogOver(f"the jog {key} is over: nothing was said in time, or it came to an end; begin a new one")
            self._check_values("jog_at", body, None)
            order.hold(body.velocity_m_per_s, body.hold_s)
            return order.message()

    def command(self, key: str) -> messages.Command | None:
        """Return what became of a command; None where no such key was seen, or long ago."""
        with self._lock:
            used, order = self._keys.find(key), self._current
        if order is None or order.key != key:  # whoever waits for its end may wait while other keys are used
            order = None if used is None else used.answer
        return order.message() if isinstance(order, Order) else None

    def _keep_order(self, order: Order, asked: bytes) -> None:
        self._drop_waiting(f"{order.name} came first")  # the service's own, if any
        if self._current is not None:
            self._current.put_by()
        self._keys.keep(order.key, Used(order.name, asked, order))
        self._current = self._waiting = order

    def _used(self, key: str, name: str, asked: BaseModel | str) -> Used | None:
        """Return what became of the same request; None where its key is new, or none was given. Errors: Unfit."""
        used = self._keys.find(key)
        if used is not None and not used.is_for(name, asked):
            raise Unfit(f"key {key!r} was used for another {used.name}; take a new key for a new command")
        if used is None and key and self._keys.was_used_long_ago(key):
            raise Unfit(
                f"key {key!r} was used more than {ANSWERS_COUNT} keys ago: what became of that is forgotten, and it is "
                "not done again; look where the stage is, and take a new key for a new command"
            )
        return used

    def _keep(self, key: str, name: str, asked: BaseModel | str, answer: Any = None) -> None:
        """Remember what a key was used for, where one was given."""
        if key:
            self._keys.keep(key, Used(name, digest(asked), answer))

    def _refuse_when_closed(self) -> None:
        if self._closed:
            raise Ending("the service is ending; try again when it is back")

    def _refuse_when_stopping(self, name: str) -> None:
        if self._stop.is_set():
            raise Busy(f"{name}: the stage is coming to rest; wait until it stands")

    def _refuse_when_busy(self, name: str) -> None:
        self._refuse_when_stopping(name)
        if self._current is not None and not self._current.over and not self._own_is_under_way:
            raise Busy(f"{name}: {self._current.name} is under way; wait for its end, or stop it")

    def _check_values(self, name: str, body: Any, holds_m: float | None) -> None:
        """Refuse at once what this stage can never do, or not from where it holds (from the homed zero). Unfit."""
        profile = self.profile
        if profile is None:
            return
        low_m, high_m = profile.macro.travel_m
        travel = f"the travel of {profile.name} is [{low_m:g}, {high_m:g}] m"
        for place, position_m in plans.positions(body).items():
            if not low_m <= position_m <= high_m:
                raise Unfit(f"{place} is {position_m:.15g}: {travel}; give a position within it")
        if name == "jog" and not abs(body.distance_m) <= high_m - low_m:
            raise Unfit(f"distance_m is {body.distance_m:g}: {travel}; give a distance within it")
        if name == "jog" and holds_m is not None:
            reached_m, (lowest_m, highest_m) = holds_m + body.distance_m, travel_from(holds_m, profile)
            if not lowest_m <= reached_m <= highest_m:
                raise Unfit(
                    f"distance_m is {body.distance_m:g}: from {holds_m:g} m that leads to {reached_m:g} m, {travel}; "
                    "give a shorter distance"
                )
        top = jog_velocity_m_per_s(profile)
        if name == "jog_at" and not abs(body.velocity_m_per_s) <= top:
            raise Unfit(f"velocity_m_per_s is {body.velocity_m_per_s:g}: a jog may do {top:g} m/s; ask for less")
        if name == "probe" and profile.wear.probe_every_s is None:
            raise Unfit(f"profile {profile.name} permits no touch probe; give wear.probe_every_s, or identify instead")
        if name in ("identify", "probe") and profile.micro is None:
            raise Unfit(f"profile {profile.name}: this stage has no micro; there is no backlash to identify")
