"""A stage's service from another program, with types: `with Client() as stage: with stage.lease("me"): stage.home()`.

Talks over the Unix socket, or over TCP with a token. Imports neither numpy nor the stage. Errors: RequestError where
the service refuses, with its text; LinkError where it doesn't answer.
"""

import contextlib
import secrets
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, TypeAdapter, ValidationError

from stagectl.errors import (
    DriveError,
    JogOver,
    LinkError,
    ProfileError,
    RecordError,
    RequestError,
    StagectlError,
    TimingError,
)
from stagectl.service import messages
from stagectl.service.places import default_socket

_JOIN = "join the group of its service (stagectl), or ask who runs it"
_TIMEOUT_S = 5.0
_WAIT_S = 5.0
_RENEWALS_PER_LEASE = 4
_BLOCK_COUNT = 50
_STOP = "/v1/stop"
_STOP_TRIES, _KEYED_TRIES = 3, 2
_REST_S, _LOOK_S = 30.0, 0.05
_WITHOUT_POWER = ("off", "idle", "fault")
_KINDS = {
    kind.__name__: kind
    for kind in (DriveError, JogOver, LinkError, ProfileError, RecordError, RequestError, TimingError)
}
ModelT = TypeVar("ModelT", bound=BaseModel)


def error_of(failure: messages.Failure) -> StagectlError:
    """Return the error that the service tells of."""
    return _KINDS.get(failure.kind, RequestError)(failure.message)


def _checked(kind: type[ModelT], **values: Any) -> ModelT:
    """Make a request of the API; RequestError where a value can't be in it."""
    try:
        return kind(**values)
    except ValidationError as error:
        raise RequestError(messages.sentence(error.errors()[0])) from error


def _new_key() -> str:
    return f"client-{secrets.token_hex(12)}"


def _blocks(positions_m: Iterable[float]) -> Iterator[tuple[list[float], bool]]:
    """Cut positions into what goes in one request, and say which is the last."""
    positions, block = iter(positions_m), list[float]()
    for position_m in positions:
        if len(block) == _BLOCK_COUNT:
            yield block, False
            block = []
        block.append(float(position_m))
    if block:
        yield block, True


class Client:
    """A connection to one service. Motion needs a lease: take one with `lease`, which renews it while it is open."""

    def __init__(self, socket_path: Path | None = None, *, tcp_port: int | None = None, token: str = ""):
        """Over the service's socket (default: where it usually is), or a port of this machine with a token."""
        self._path = None if tcp_port is not None else Path(socket_path or default_socket())
        self.place = f"127.0.0.1:{tcp_port}" if tcp_port is not None else str(self._path)
        transport = None if tcp_port is not None else httpx.HTTPTransport(uds=self.place)
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        url = f"http://{self.place}" if tcp_port is not None else "http://stagectl"
        self._http = httpx.Client(
            transport=transport, base_url=url, headers=headers, timeout=_TIMEOUT_S, trust_env=False
        )
        self.lease_token = ""
        """Token of the lease that commands go by."""

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; a lease that is held is not given back by that."""
        self._http.close()

    # ---- watching --------------------------------------------------------------------------------------------

    def status(self) -> messages.Status:
        """Return where things stand."""
        return messages.Status.model_validate(self._ask("GET", "/v1/status"))

    def fault(self) -> messages.Fault | None:
        """Return why the stage stopped by itself; None where it did not."""
        return TypeAdapter(messages.Fault | None).validate_python(self._ask("GET", "/v1/fault"))

    def log(self, after: int | None = None, limit: int = 100) -> list[messages.LogEntry]:
        """Return what the service did, behind a number, or the newest."""
        asked = {"limit": limit} if after is None else {"after": after, "limit": limit}
        return TypeAdapter(list[messages.LogEntry]).validate_python(self._ask("GET", "/v1/log", params=asked))

    def runs(self) -> list[messages.RunEntry]:
        """Return what was recorded, oldest first."""
        return TypeAdapter(list[messages.RunEntry]).validate_python(self._ask("GET", "/v1/runs"))

    def metrics(self) -> str:
        """Return what Prometheus scrapes."""
        return self._answer("GET", "/metrics").text

    # ---- the lease -------------------------------------------------------------------------------------------

    def lease_state(self) -> messages.LeaseState | None:
        """Return who may move the stage; None where nobody does."""
        return TypeAdapter(messages.LeaseState | None).validate_python(self._ask("GET", "/v1/lease"))

    def take_lease(self, holder: str, duration_s: float = 2.0, key: str = "") -> messages.TakenLease:
        """Take the lease; it has to be renewed within `duration_s`, again and again, or the stage stops.

        The same key (16 characters or more) again gets the same lease, while that lasts.
        """
        body = _checked(messages.TakeLease, holder=holder, duration_s=duration_s)
        taken = messages.TakenLease.model_validate(self._once("POST", "/v1/lease", body, key))
        self.lease_token = taken.token
        return taken

    def renew_lease(self) -> messages.TakenLease:
        """Renew the lease that is held."""
        return messages.TakenLease.model_validate(self._ask("PUT", "/v1/lease"))

    def give_lease_back(self) -> None:
        """Give the lease back; a stage with power comes to rest."""
        self._once("DELETE", "/v1/lease")
        self.lease_token = ""

    @contextlib.contextmanager
    def lease(self, holder: str, duration_s: float = 2.0) -> Iterator[messages.TakenLease]:
        """Hold the lease and renew it from a thread; leaving gives it back and waits until the stage has no power."""
        taken = self.take_lease(holder, duration_s)
        over = threading.Event()
        renewing = threading.Thread(target=self._renew_until, args=(over, duration_s), daemon=True)
        renewing.start()
        try:
            yield taken
        finally:
            over.set()
            renewing.join(_TIMEOUT_S)
            with contextlib.suppress(StagectlError):  # it may be over already, and the stage with it
                self.give_lease_back()
                self._await_rest()

    def _await_rest(self) -> None:
        give_up_s = time.monotonic() + _REST_S
        while self.status().state not in _WITHOUT_POWER and time.monotonic() < give_up_s:
            time.sleep(_LOOK_S)

    def _renew_until(self, over: threading.Event, duration_s: float) -> None:
        while not over.wait(duration_s / _RENEWALS_PER_LEASE):
            try:
                self.renew_lease()
            except LinkError:
                continue  # the next may come through; the lease's end is the deadman
            except StagectlError:
                return

    # ---- commands --------------------------------------------------------------------------------------------

    def arm(self, law: messages.LawName | None = None) -> messages.Command:
        """Give the drives power and hold."""
        return self.do("arm", _checked(messages.Arm, law=law))

    def home(self) -> messages.Command:
        """Home both axes; ends armed."""
        return self.do("home", messages.Home())

    def move(self, target_m: float, law: messages.LawName | None = None) -> messages.Command:
        """Move the end to a position."""
        return self.do("move", _checked(messages.Move, target_m=target_m, law=law))

    def jog(self, distance_m: float, law: messages.LawName | None = None) -> messages.Command:
        """Move the end by a distance."""
        return self.do("jog", _checked(messages.JogBy, distance_m=distance_m, law=law))

    def identify(self, frequency_hz: float | None = None, duration_s: float = 20.0) -> messages.Command:
        """Identify the backlash."""
        return self.do("identify", _checked(messages.Identify, frequency_hz=frequency_hz, duration_s=duration_s))

    def probe(self) -> messages.Command:
        """Touch both edges of the joint, where the profile permits it."""
        return self.do("probe", messages.Probe())

    def acknowledge(self, number: int) -> messages.Command:
        """Take note of a fault; enables nothing."""
        return self.do("acknowledge", _checked(messages.Acknowledge, number=number))

    def swap_backend(self, backend: str) -> messages.Command:
        """Work in another world; without power only."""
        return self.do("backend", _checked(messages.SwapBackend, backend=backend))

    def begin_jog(self, hold_s: float = 0.3) -> messages.Command:
        """Begin to jog, at rest; `jog_at` with the answer's key says how fast, before `hold_s` is over."""
        return self.begin("jogging", _checked(messages.BeginJog, hold_s=hold_s))

    def jog_at(self, key: str, velocity_m_per_s: float, hold_s: float = 0.3) -> messages.Command:
        """Jog at a velocity; to be said again before `hold_s` is over. JogOver where it was not: begin a new one."""
        body = _checked(messages.JogAt, velocity_m_per_s=velocity_m_per_s, hold_s=hold_s)
        return messages.Command.model_validate(self._ask("PUT", f"/v1/jogging/{key}", body))

    def scan(self, program: messages.Scan) -> messages.Command:
        """Follow a scan program and wait for its end."""
        return self.do("scan", program)

    def follow(self, table: Path | str, name: str = "", law: messages.LawName | None = None) -> messages.Command:
        """Follow a CSV file (`t_s,position_m`) and wait for its end; RequestError where it can't be read."""
        path = Path(table)
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise RequestError(f"trajectory {path}: {error}; give a readable CSV file") from error
        return self.do("follow", _checked(messages.Follow, text=text, name=name or "trajectory", law=law))

    def send_setpoints(
        self, first_number: int, period_s: float, position_m: list[float], last: bool = False, key: str = ""
    ) -> messages.StreamState:
        """Send set-points ahead, numbered from 0; the answer says what must come next and how many have room.

        `key` is the stream's, of the first answer or one's own; with it nothing goes into another stream.
        """
        body = _checked(
            messages.Setpoints, first_number=first_number, period_s=period_s, position_m=position_m, last=last
        )
        return messages.StreamState.model_validate(self._once("PUT", "/v1/setpoints", body, key))

    def stream_state(self) -> messages.StreamState | None:
        """Return how the stream under way stands; None where there is none."""
        return TypeAdapter(messages.StreamState | None).validate_python(self._ask("GET", "/v1/setpoints"))

    def stream(self, positions_m: Iterable[float], period_s: float) -> messages.Command:
        """Send positions ahead as fast as there is room, and wait for the end of the motion."""
        state: messages.StreamState | None = None
        blocks, key = _blocks(positions_m), _new_key()
        block, last = next(blocks, ([], True))
        while block:
            first_number = 0 if state is None else state.next_number
            if state is not None and state.room_count < len(block):
                time.sleep(_LOOK_S)
                stands = self.stream_state()
                if stands is None or stands.key != state.key:
                    return self._ended(self.command(state.key))
                state = stands
                continue
            try:
                state = self.send_setpoints(first_number, period_s, block, last, key)
            except RequestError as error:
                if state is None or (command := self.command(state.key)).state not in ("done", "failed"):
                    raise
                raise RequestError(f"{error} ({command.text})") from error
            if last:
                break
            block, last = next(blocks, ([], True))
        if state is None:
            raise RequestError("there are no set-points to send; give one or more")
        return self._ended(self.command(state.key))

    def stop(self) -> messages.Status:
        """Bring the stage to rest and take the power away; needs no lease. Tried again where the link fails."""
        return messages.Status.model_validate(self._again(_STOP_TRIES, "POST", _STOP))

    def record(self, name: str = "request") -> messages.Status:
        """Begin a run, where none is under way; needs no lease."""
        return messages.Status.model_validate(
            self._once("POST", "/v1/record", _checked(messages.StartRecord, name=name))
        )

    def end_record(self) -> messages.Status:
        """End the run that was asked for; needs no lease."""
        return messages.Status.model_validate(self._once("DELETE", "/v1/record"))

    def set_trigger(self, trigger: messages.SetTrigger) -> messages.Status:
        """Record what is around an event; needs no lease."""
        return messages.Status.model_validate(self._once("PUT", "/v1/record/trigger", trigger))

    def end_trigger(self) -> messages.Status:
        """Wait for no event any more; needs no lease."""
        return messages.Status.model_validate(self._once("DELETE", "/v1/record/trigger"))

    def begin(self, name: str, body: BaseModel, key: str = "") -> messages.Command:
        """Send a command and don't wait; the same key again is the same command."""
        return messages.Command.model_validate(self._once("POST", f"/v1/{name}", body, key))

    def check(self, name: str, body: BaseModel) -> None:
        """Ask under the lease whether the stage could do a motion, before it is homed and armed for it.

        RequestError where it can't.
        """
        self._again(_KEYED_TRIES, "POST", f"/v1/check/{name}", body)

    def command(self, key: str, wait_s: float = 0.0) -> messages.Command:
        """Return what became of a command; waits for its end where asked to."""
        asked = {"wait_s": wait_s}
        return messages.Command.model_validate(self._ask("GET", f"/v1/commands/{key}", params=asked, more_s=wait_s))

    def do(self, name: str, body: BaseModel) -> messages.Command:
        """Send a command and wait for its end. Errors: what the service says; a stop by itself is no error."""
        return self._ended(self.begin(name, body))

    def _ended(self, found: messages.Command) -> messages.Command:
        while found.state not in ("done", "failed"):
            found = self.command(found.key, _WAIT_S)
        if found.error is not None:
            raise error_of(found.error)
        return found

    # ---- bytes -----------------------------------------------------------------------------------------------

    def _once(self, method: str, path: str, body: BaseModel | None = None, key: str = "") -> Any:
        """Ask for what is done once however often it is said; said again where the answer got lost."""
        return self._again(_KEYED_TRIES, method, path, body, {"Idempotency-Key": key or _new_key()})

    def _again(
        self,
        tries_count: int,
        method: str,
        path: str,
        body: BaseModel | None = None,
        headers: dict[str, str] | None = None,
    ) -> Any:
        for _ in range(tries_count - 1):
            with contextlib.suppress(LinkError):
                return self._ask(method, path, body, headers)
        return self._ask(method, path, body, headers)

    def _ask(
        self,
        method: str,
        path: str,
        body: BaseModel | None = None,
        headers: dict[str, str] | None = None,
        params: dict[str, Any] | None = None,
        more_s: float = 0.0,
    ) -> Any:
        answer = self._answer(method, path, body, headers, params, more_s)
        return answer.json() if answer.content else None

    def _look_for(self, path: Path) -> None:
        """Say what stands in the way to the service's socket. Errors: LinkError."""
        try:
            is_there = path.is_socket()
        except PermissionError as error:
            raise LinkError(f"{self.place}: its folder is not for this user; {_JOIN}") from error
        except OSError as error:
            raise LinkError(f"{self.place}: no socket can be there: {error.strerror}; give another --socket") from error
        if not is_there:
            raise LinkError(f"{self.place}: no service has its socket there; is `stagectl serve` running?")

    def _answer(
        self,
        method: str,
        path: str,
        body: BaseModel | None = None,
        headers: dict[str, str] | None = None,
        params: dict[str, Any] | None = None,
        more_s: float = 0.0,
    ) -> httpx.Response:
        if self._path is not None:
            self._look_for(self._path)
        lease = {"Stagectl-Lease": self.lease_token} if self.lease_token else {}
        if not (self.lease_token.isascii() and self.lease_token.isprintable()):
            if path != _STOP:  # which needs none
                raise RequestError(
                    f"the lease (--lease, $STAGECTL_LEASE) is {self.lease_token[:60]!r}, which is no token; give "
                    "that of `stagectl lease --hold`"
                )
            lease = {}
        try:
            answer = self._http.request(
                method,
                path,
                headers={**lease, **(headers or {})},
                params=params,
                timeout=_TIMEOUT_S + more_s,
                json=None if body is None else body.model_dump(),
            )
        except httpx.HTTPError as error:
            if "Permission denied" in str(error):
                raise LinkError(f"{self.place}: it is not for this user; {_JOIN}") from error
            raise LinkError(
                f"{self.place}: no answer from the service ({error}); is `stagectl serve` running?"
            ) from error
        if answer.is_success:
            return answer
        try:
            failure = messages.Failure.model_validate_json(answer.content)
        except ValueError as error:
            raise LinkError(f"{self.place}: answered {answer.status_code} and no reason; is it a stagectl?") from error
        raise error_of(failure)
