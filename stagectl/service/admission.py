"""How many clients there may be, and why none of them keeps a stop out, or the operator.

Beyond the limit everything is refused but a stop and what the operator asks, and of the connections that ask nothing
the oldest make room, the operator's last: so there is always one left for whoever wants to stop the stage, and a lease
is renewed whoever else is there. uvicorn's own limit refuses whatever comes, a stop too.

Who reads nothing of what waits for it is let go of, or it would be counted until it goes by itself: uvicorn closes a
connection only when all that was written to it has left, and waits as long before it writes more, a close frame too.
"""

import array
import asyncio
import fcntl
import json
import termios
from collections.abc import Callable, Collection
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from stagectl.service.access import Application, Receive, Scope, Send

CONNECTIONS_LIMIT = 100
RESERVE_COUNT = 50
"""Beyond the limit, for stops and for the operator."""

LOOK_S = 1.0
_LOOKS_COUNT = 10
"""In which a client reads nothing before it is let go of; looks and no time, as a host may stand still."""

_STOP_PATH = "/v1/stop"
_FROM_OPERATOR = "stagectl_from_operator"
_TEXT = f"{CONNECTIONS_LIMIT} connections are open, the limit; close some and try again. A stop is taken always."


class Connection(H11Protocol):
    """A client's connection; when too many are open, the one that has asked nothing for longest is closed.

    The operator's are closed last: a renewal that finds its connection closed may be the one that comes too late.
    """

    def connection_made(self, transport) -> None:
        """Take the connection, and make room for the next."""
        super().connection_made(transport)
        self.begun_s = self.loop.time()
        if len(self.connections) > CONNECTIONS_LIMIT + RESERVE_COUNT:
            others = [one for one in self.connections if isinstance(one, Connection) and one is not self]
            silent = [one for one in others if one.is_silent]
            if silent:
                min(silent, key=lambda one: (one.is_the_operators, one.begun_s)).transport.close()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, where nothing was answered yet, and end the connection.

        uvicorn's own would answer twice where such bytes come behind a refusal, and the application after it where they
        come first; h11 raises at the second answer.
        """
        if self.cycle is not None:
            self.cycle.disconnected = True
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg)
        else:
            self.transport.close()

    @property
    def is_the_operators(self) -> bool:
        """Whether the operator asked last here."""
        return self.scope is not None and self.scope.get(_FROM_OPERATOR, False)

    @property
    def is_silent(self) -> bool:
        """Whether nothing that was asked here waits for its answer."""
        return (self.cycle is None or self.cycle.response_complete) and not self.transport.is_closing()


class Admission:
    """Refuses whatever comes over one connection too many, but for a stop and for the operator."""

    def __init__(
        self, application: Application, connections_count: Callable[[], int], from_operator: Callable[[Scope], bool]
    ):
        """`connections_count` says how many are open now, `from_operator` whose request nobody else could have sent."""
        self._application, self._connections_count = application, connections_count
        self._from_operator = from_operator

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on, or refuse it."""
        is_stop = scope["type"] == "http" and scope.get("path") == _STOP_PATH and scope.get("method") == "POST"
        is_client = scope["type"] in ("http", "websocket")
        from_operator = is_client and self._from_operator(scope)
        scope[_FROM_OPERATOR] = from_operator
        if is_stop or from_operator or not is_client or self._connections_count() <= CONNECTIONS_LIMIT:
            await self._application(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1013, "reason": _TEXT[:120]})
        else:
            body = json.dumps({"kind": "Busy", "message": _TEXT}).encode()
            headers = [(b"content-type", b"application/json"), (b"connection", b"close")]
            headers.append((b"content-length", str(len(body)).encode()))
            await send({"type": "http.response.start", "status": 503, "headers": headers})
            await send({"type": "http.response.body", "body": body})


async def let_go_of_the_deaf(connections: Collection[Any]) -> None:
    """Abort connections whose client reads nothing of what waits for it, until cancelled."""
    seen: dict[Any, tuple[tuple[int, int], int]] = {}
    while True:
        now: dict[Any, tuple[tuple[int, int], int]] = {}
        for one in list(connections):
            unread = _unread_bytes(one.transport)
            before, looks_count = seen.get(one, (unread, 0))
            if not any(unread):
                continue
            now[one] = unread, looks_count + 1 if unread == before else 0
            if now[one][1] >= _LOOKS_COUNT:
                one.transport.abort()
        seen = now
        await asyncio.sleep(LOOK_S)


def _unread_bytes(transport: asyncio.Transport) -> tuple[int, int]:
    """Return what waits for a client here and in the kernel; none where all is in the kernel.

    The kernel's part shows a slow reader: a Unix socket takes no more before three quarters of 200 kB are read.
    """
    here = transport.get_write_buffer_size()
    if here == 0:
        return 0, 0
    in_kernel = array.array("i", [0])
    fcntl.ioctl(transport.get_extra_info("socket").fileno(), termios.TIOCOUTQ, in_kernel)
    return here, in_kernel[0]
